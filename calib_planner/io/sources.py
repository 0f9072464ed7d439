"""Files of measurements, CSV or bags, read together: one set of rows, and where each row came from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace

import numpy as np

from calib_planner.acquisition import StandstillSettings
from calib_planner.arrays import IntArray
from calib_planner.errors import FileFormatError, InputError
from calib_planner.identification import check_units
from calib_planner.io.bag import BagTopics, is_bag, read_bag
from calib_planner.io.csv import read_measurements
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot

MOST_RADIANS = 4 * np.pi
"""Joint angles beyond this are probably degrees [rad]."""


def no_progress(label: str) -> AbstractContextManager[Callable[[float, str], None] | None]:
    """Shows nothing."""
    return nullcontext()


@dataclass(frozen=True)
class SourceSettings:
    """How files of measurements are read.

    Attributes:
        degrees: Angles in CSV files are degrees.
        millimetres: Points and their standard deviations in CSV files are millimetres.
        topics: The topics of a bag.
        standstill: What counts as standing still in a bag.
        repeatability: Standard deviation of a coordinate that averaging does not reduce, of bags [m].
        accept_damaged: Use what can be read of a damaged bag.
        note: Called with what a person should know about a file.
        progress: Called with a label; a context that yields a function (share done, text), or ``None``.
    """

    degrees: bool = False
    millimetres: bool = False
    topics: BagTopics = field(default_factory=BagTopics)
    standstill: StandstillSettings = field(default_factory=StandstillSettings)
    repeatability: float = 0.0
    accept_damaged: bool = False
    note: Callable[[str], None] = lambda text: None
    progress: Callable[[str], AbstractContextManager[Callable[[float, str], None] | None]] = no_progress


@dataclass(frozen=True, eq=False)
class Source:
    """A file of measurements.

    Attributes:
        path: The file.
        data: What it holds.
        numbers: (N,) line of each row in a CSV file; number of each standstill in a bag, from 1.
        word: What ``numbers`` count: ``line`` or ``standstill``.
        frame_id: Frame of a bag's points; empty if none is named.
    """

    path: str
    data: Measurements
    numbers: IntArray
    word: str
    frame_id: str = ""


@dataclass(frozen=True, eq=False)
class Sources:
    """Several files, their rows one after the other in ``data``."""

    data: Measurements
    files: tuple[Source, ...]

    def where(self, row: int) -> str:
        """Where row ``row``, from 0, came from: ``line 12 of points.csv``."""
        for source in self.files:
            if row < len(source.data):
                return f"{source.word} {source.numbers[row]} of {source.path}"
            row -= len(source.data)
        raise IndexError(row)


def read_sources(paths: Sequence[str], robot: Robot, settings: SourceSettings, *, noise_given: bool) -> Sources:
    """Read files that hold points of as many targets each.

    Args:
        noise_given: The noise is stated elsewhere; the files' own standard deviations are left out.

    Raises:
        FileFormatError: A file cannot be read, or does not fit the others.
    """
    files = tuple(read_source(path, robot, settings) for path in paths)
    first = files[0]
    count = first.data.p.shape[1]
    for other in files[1:]:
        if other.data.p.shape[1] != count:
            got = f"{other.data.p.shape[1]} targets"
            raise FileFormatError(other.path, "points", got, f"{count}, as in {first.path}")
    frames = {s.frame_id: s for s in files if s.frame_id}
    if len(frames) > 1:
        a, b, *_ = frames.values()
        got, advice = repr(b.frame_id), "transform the points: one identification has one tracker frame"
        raise FileFormatError(b.path, "frame_id of the points", got, f"{a.frame_id!r}, as in {a.path}", advice)
    return Sources(_together(files, noise_given), files)


def read_source(path: str, robot: Robot, settings: SourceSettings) -> Source:
    """Read a CSV file or a bag.

    Raises:
        FileFormatError: As ``read_measurements`` and ``read_bag``, or the file is in other units.
    """
    source = (_bag if is_bag(path) else _csv)(path, robot, settings)
    count = source.data.p.shape[1]
    alike = robot if len(robot.targets) == count else robot.with_targets(np.zeros((count, 3)))
    try:
        check_units(alike, source.data)
    except InputError as error:
        raise FileFormatError(path, error.field, error.got, error.expected, error.advice) from None
    return source


def _csv(path: str, robot: Robot, settings: SourceSettings) -> Source:
    file = read_measurements(path, robot, degrees=settings.degrees)
    data = file.data
    if file.ignored:
        settings.note(f"{path}: columns ignored: {', '.join(file.ignored)}")
    turning = np.abs(data.q[:, robot.joint_is_revolute])
    if not settings.degrees and turning.size and turning.max() > MOST_RADIANS:
        settings.note(f"{path}: joint angles up to {turning.max():.4g} rad; are they degrees (--degrees)?")
    if settings.millimetres:
        std = None if data.std is None else np.asarray(data.std) / 1e3
        data = replace(data, points=data.p / 1e3, std=std)
    return Source(path, data, file.lines, "line")


def _bag(path: str, robot: Robot, settings: SourceSettings) -> Source:
    with settings.progress(f"reading {path}") as update:
        bag = read_bag(
            path,
            robot,
            settings.topics,
            settings.standstill,
            repeatability=settings.repeatability,
            accept_damaged=settings.accept_damaged,
            progress=update,
        )
    for line in bag.describe():
        settings.note(f"{path}: {line}")
    return Source(path, bag.data, np.arange(1, len(bag.data) + 1), "standstill", bag.frame_id)


def _together(files: Sequence[Source], noise_given: bool) -> Measurements:
    parts = [s.data for s in files]
    if len(parts) == 1:
        return parts[0]
    std = None
    if not noise_given:
        without = [s.path for s in files if s.data.std is None]
        if without and len(without) < len(files):
            advice = "add them, or state the noise of all with --sigma or --instrument"
            raise FileFormatError(without[0], "header", "no std_… columns", "them, as in other files", advice)
        std = None if without else np.concatenate([np.asarray(d.std) for d in parts])
    q, p = np.concatenate([d.q for d in parts]), np.concatenate([d.p for d in parts])
    without = [s.path for s in files if s.data.payload is None]
    if without and len(without) < len(files):
        advice = "add it: 0 where the robot carried nothing"
        raise FileFormatError(without[0], "header", "no column payload", "it, as in other files", advice)
    payload = None if without else np.concatenate([np.asarray(d.payload) for d in parts])
    return Measurements(parts[0].joint_names, q, p, std, payload)
