# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of measurements read together: one set of rows, and where each row came from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_planner.acquisition import Standstill
from calib_planner.errors import FileFormatError, InputError
from calib_planner.identification import check_units
from calib_planner.io.data import read_data
from calib_planner.io.understanding import Reading, Source
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot
from calib_planner.units import counted


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


def read_sources(
    paths: Sequence[str], robot: Robot, reading: Reading, *, noise_given: bool, placed: bool = True
) -> Sources:
    """Read files that hold points of as many targets each; a standstill that is in two bags counts once.

    Args:
        noise_given: The noise is stated elsewhere; the files' own standard deviations are left out.
        placed: As for ``read_source``.

    Raises:
        FileFormatError: A file cannot be read, or does not fit the others.
    """
    files = _once([read_source(path, robot, reading, placed=placed) for path in paths], reading)
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


def read_source(path: str, robot: Robot, reading: Reading, *, placed: bool = True) -> Source:
    """Read a file of measurements, and test whether its units make sense of the robot.

    Args:
        placed: The robot says where base and targets are; else they are wherever the points put them.

    Raises:
        FileFormatError: As ``read_data``, or the file is in other units.
    """
    source = read_data(path, robot, reading)
    count = source.data.p.shape[1]
    alike = robot if placed and len(robot.targets) == count else robot.with_targets(np.zeros((count, 3)))
    if not placed:
        alike = alike.with_parameters(robot.parameter_names, ["base", "tool"])
    try:
        check_units(alike, source.data)
    except InputError as error:
        raise FileFormatError(path, error.field, error.got, error.expected, error.advice) from None
    return source


def _once(files: Sequence[Source], reading: Reading) -> tuple[Source, ...]:
    """The files without standstills that are in one before: recordings that overlap, copies of one.

    Raises:
        FileFormatError: Nothing is left of a file.
    """
    taken: list[Standstill] = []
    result = []
    for source in files:
        new = [k for k, s in enumerate(source.standstills) if not any(s.is_again(t) for t in taken)]
        repeated = len(source.standstills) - len(new)
        if repeated and not new:
            got = f"{counted(repeated, 'standstill')} that other bags have"
            raise FileFormatError(source.path, "standstills", got, "new ones", "a copy is no measurement")
        if repeated:
            text = f"{counted(repeated, 'standstill')} that a bag before has, which count once"
            reading.note(f"{source.path}: {text}")
            standstills = tuple(source.standstills[k] for k in new)
            rows = np.array(new)
            source = replace(
                source, data=source.data.select(rows), numbers=source.numbers[rows], standstills=standstills
            )
        taken += source.standstills
        result.append(source)
    return tuple(result)


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
