"""The measurements that ``identify`` reads: CSV files and bags, and where each row of them came from."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner._arrays import IntArray
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import FileFormatError, InputError
from calib_planner.files.bag import read_bag
from calib_planner.files.bag_storage import BagTopics, is_bag
from calib_planner.files.measurements_csv import read_measurements
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.suspicions import check_units
from calib_planner.instrument.standstill import StandstillSettings
from calib_planner.robot.chain import Robot

STANDSTILL = {
    "joint_tolerance": "largest range of a joint at rest [rad | m]",
    "point_tolerance": "largest range of a coordinate at rest, about ten times the tracker's noise [m]",
    "settle": "left out after the joints came to rest [s]",
    "duration": "shortest interval averaged [s]",
    "samples": "points of a reflector wanted per standstill",
    "minimum_samples": "points of a reflector needed to use it at all",
}
"""Fields of ``StandstillSettings`` that are options, with their help."""
BAG_ONLY = ("joint_topic", "point_topic", *STANDSTILL, "repeatability", "accept_damaged")


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
class Rows:
    """All measurements, the sources' rows one after the other."""

    data: Measurements
    sources: tuple[Source, ...]

    def where(self, row: int) -> str:
        """Where row ``row``, from 0, came from: ``line 12 of points.csv``."""
        for source in self.sources:
            if row < len(source.data):
                return f"{source.word} {source.numbers[row]} of {source.path}"
            row -= len(source.data)
        raise IndexError(row)


def add_data(parser: argparse.ArgumentParser) -> None:
    """--data, --millimetres and what bags need."""
    data = parser.add_argument_group("measurements")
    data.add_argument(
        "--data", required=True, action="append", metavar="FILE", help="CSV or bag; repeat to take them together"
    )
    data.add_argument("--millimetres", action="store_true", help="points and std_… of all CSV files are in mm")
    bags = parser.add_argument_group("measurements from bags (docs/real-robot-data.md)")
    bags.add_argument("--joint-topic", metavar="T", help="sensor_msgs/JointState (joint_states)")
    bags.add_argument(
        "--point-topic",
        action="append",
        metavar="T",
        help="geometry_msgs/PointStamped (tracker/point); repeat, one per reflector",
    )
    defaults = {f.name: f.default for f in fields(StandstillSettings)}
    for name, text in STANDSTILL.items():
        value: Any = defaults[name]
        bags.add_argument(_flag(name), type=type(value), metavar="V", help=f"{text} ({value:g})")
    bags.add_argument(
        "--repeatability", type=float, metavar="S", help="std of a coordinate that averaging leaves [m] (0)"
    )
    bags.add_argument(
        "--accept-damaged", action="store_true", default=None, help="use what can be read of a damaged bag"
    )


def read_rows(paths: Sequence[str], robot: Robot, args: argparse.Namespace, terminal: Terminal) -> Rows:
    """All files of --data, as many reflectors in each.

    Raises:
        FileFormatError: A file does not read, or does not fit the others.
    """
    sources = tuple(read_source(path, robot, args, terminal) for path in paths)
    first = sources[0]
    for other in sources[1:]:
        if other.data.p.shape[1] != first.data.p.shape[1]:
            wanted = f"{first.data.p.shape[1]}, as in {first.path}"
            raise FileFormatError(other.path, "points", f"{other.data.p.shape[1]} targets", wanted)
    frames = {s.frame_id: s for s in sources if s.frame_id}
    if len(frames) > 1:
        a, b = list(frames.values())[:2]
        got, advice = repr(b.frame_id), "transform the points: one identification has one tracker frame"
        raise FileFormatError(b.path, "frame_id of the points", got, f"{a.frame_id!r}, as in {a.path}", advice)
    return Rows(_together(sources, given=args.sigma is not None or args.instrument is not None), sources)


def read_source(path: str, robot: Robot, args: argparse.Namespace, terminal: Terminal) -> Source:
    """A CSV file or a bag.

    Raises:
        FileFormatError: As ``read_measurements`` and ``read_bag``, or the points are in millimetres.
    """
    source = _bag(path, robot, args, terminal) if is_bag(path) else _csv(path, robot, args, terminal)
    count = source.data.p.shape[1]
    try:
        check_units(
            robot if len(robot.targets) == count else robot.with_targets(np.zeros((count, 3))), source.data
        )
    except InputError as error:
        doubtful = args.millimetres and error.field == "robot"
        advice = "they are metres already: leave out --millimetres" if doubtful else error.advice
        raise FileFormatError(path, error.field, error.got, error.expected, advice) from None
    return source


def check_files(args: argparse.Namespace) -> None:
    """Refuse what does not go with the files given.

    Raises:
        InputError: A file twice, an option for bags without a bag, or --millimetres with one.
    """
    taken: set[Path] = set()
    for flag, path in [("--data", p) for p in args.data] + [("--validate", p) for p in args.validate or ()]:
        place = Path(path).expanduser().resolve()
        if place in taken:
            advice = "a copy is no measurement" if flag == "--data" else "what was fitted proves nothing"
            raise InputError(flag, f"{path} again", "each file once", advice)
        taken.add(place)
    bags = [path for path in (*args.data, *(args.validate or ())) if is_bag(path)]
    if bags and args.millimetres:
        advice = "points in bags are in metres (REP-103)"
        raise InputError("--millimetres", f"the bag {bags[0]}", "CSV files", advice)
    for name in BAG_ONLY:
        if not bags and getattr(args, name) is not None:
            raise InputError(_flag(name), getattr(args, name), "a bag among --data or --validate")


# ── one file ─────────────────────────────────────────────────────────────────────────────────────────


def _csv(path: str, robot: Robot, args: argparse.Namespace, terminal: Terminal) -> Source:
    file = read_measurements(path, robot, degrees=args.degrees)
    if file.ignored:
        terminal.note(f"{path}: columns ignored: {', '.join(file.ignored)}")
    turning = np.abs(file.data.q[:, robot.joint_is_revolute])
    if not args.degrees and turning.size and turning.max() > 4 * np.pi:
        terminal.note(f"{path}: joint angles up to {turning.max():.4g} rad; are they degrees (--degrees)?")
    return Source(path, _metres(file.data) if args.millimetres else file.data, file.lines, "line")


def _metres(data: Measurements) -> Measurements:
    std = None if data.std is None else np.asarray(data.std) / 1e3
    return Measurements(data.joint_names, data.q, data.p / 1e3, std)


def _bag(path: str, robot: Robot, args: argparse.Namespace, terminal: Terminal) -> Source:
    given = {n: getattr(args, n) for n in STANDSTILL if getattr(args, n) is not None}
    topics = BagTopics(args.joint_topic or "joint_states", tuple(args.point_topic or ("tracker/point",)))
    with terminal.progress(f"reading {path}") as update:
        bag = read_bag(
            path,
            robot,
            topics,
            StandstillSettings(**given),
            repeatability=args.repeatability or 0.0,
            accept_damaged=bool(args.accept_damaged),
            progress=update,
        )
    for line in bag.describe():
        terminal.note(f"{path}: {line}")
    return Source(path, bag.data, np.arange(1, len(bag.data) + 1), "standstill", bag.frame_id)


def _together(sources: Sequence[Source], *, given: bool) -> Measurements:
    """One after the other; ``given``: the noise is stated, so the files' own does not matter."""
    parts = [s.data for s in sources]
    if len(parts) == 1:
        return parts[0]
    std = None
    if not given:
        without = [s.path for s in sources if s.data.std is None]
        if without and len(without) < len(sources):
            advice = "add them, or state the noise of all with --sigma or --instrument"
            raise FileFormatError(without[0], "header", "no std_… columns", "them, as in other files", advice)
        std = None if without else np.concatenate([np.asarray(d.std) for d in parts])
    q, p = np.concatenate([d.q for d in parts]), np.concatenate([d.p for d in parts])
    return Measurements(parts[0].joint_names, q, p, std)


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
