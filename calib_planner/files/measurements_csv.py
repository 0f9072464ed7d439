"""Measurements as CSV: joint columns in any order, ``x1,y1,z1[,x2…]`` and optionally ``std_x1,…``.

One row per configuration, [rad | m] and [m] in the tracker's frame; empty cells: target not measured. Other
columns are ignored, unless their name is nearly one of these.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib_planner._arrays import FloatArray, IntArray
from calib_planner.errors import FileFormatError
from calib_planner.files.configurations_csv import joint_columns
from calib_planner.files.table import Table, format_table, read_table, require_columns, shown
from calib_planner.files.text import write_text
from calib_planner.identification.measurements import Measurements
from calib_planner.robot.chain import Robot

WHAT = "a CSV of measurements"
COORDINATE = re.compile(r"(std_)?([xyz])([1-9][0-9]{0,3})")
NEARLY = re.compile(r"(std|sigma)?[_ ]*[xyz][_ ]*[0-9]*", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class MeasurementFile:
    """What a file held.

    Attributes:
        data: The measurements.
        ignored: Names of the columns that were ignored.
        lines: Line of the file that each row of ``data`` stands in.
    """

    data: Measurements
    ignored: tuple[str, ...]
    lines: IntArray


def read_measurements(path: str | Path, robot: Robot, *, degrees: bool = False) -> MeasurementFile:
    """Read measurements of ``robot``; joints come in the robot's order whatever the file's.

    Args:
        path: The file.
        robot: Gives the names of the joint columns and which of them are angles.
        degrees: The angles in the file are degrees.

    Raises:
        FileFormatError: Names line and column at fault, what stands there and what is valid.
    """
    table = read_table(path, WHAT)
    q = joint_columns(table, robot, degrees=degrees)
    others = [c for c in table.columns if c not in robot.joint_names]
    count = _target_count(table, others)
    points = _coordinates(table, count, "")
    std = _deviations(table, others, points)
    known = {*robot.joint_names, *_names(count, ""), *_names(count, "std_")}
    ignored = tuple(c for c in table.columns if c not in known)
    for name in ignored:
        if NEARLY.fullmatch(name):
            valid = f"{shown(_names(count, ''))} and std_ of each"
            raise FileFormatError(path, f"column {name[:40]!r}", "an unknown name", valid, "rename it")
    return MeasurementFile(Measurements(robot.joint_names, q, points, std), ignored, table.lines)


def write_measurements(path: str | Path, data: Measurements, field: str = "output") -> None:
    """Write measurements [rad | m], exact to the bit."""
    write_text(path, measurements_text(data), field)


def measurements_text(data: Measurements) -> str:
    """The text that ``write_measurements`` writes."""
    n, count = data.p.shape[:2]
    blocks = [data.q, data.p.reshape(n, -1)]
    columns = [*data.joint_names, *_names(count, "")]
    if data.std is not None:
        std = np.where(data.seen[:, :, None], np.asarray(data.std), np.nan)
        blocks.append(std.reshape(n, -1))
        columns += _names(count, "std_")
    return format_table(columns, np.hstack(blocks).tolist())


def _names(count: int, prefix: str) -> list[str]:
    return [f"{prefix}{a}{t}" for t in range(1, count + 1) for a in "xyz"]


def _target_count(table: Table, columns: list[str]) -> int:
    matches = [m for m in map(COORDINATE.fullmatch, columns) if m and not m[1]]
    count = len({m[3] for m in matches})
    require_columns(table, _names(max(count, 1), ""), "coordinates")
    return count


def _coordinates(table: Table, count: int, prefix: str) -> FloatArray:
    """(rows, targets, 3), NaN where empty; a target is measured in all coordinates or not at all."""
    values = table.numbers(_names(count, prefix), empty=True).reshape(-1, count, 3)
    partly = np.isnan(values).any(axis=2) & ~np.isnan(values).all(axis=2)
    for i, t in np.argwhere(partly):
        columns = ", ".join(f"{prefix}{a}{t + 1}" for a in "xyz")
        raise table.error(int(i), columns, "some of the three cells empty", "all three or none")
    return values


def _deviations(table: Table, columns: list[str], points: FloatArray) -> FloatArray | None:
    """(rows, targets, 3) standard deviations, or ``None`` if the file has none."""
    if not any(m and m[1] for m in map(COORDINATE.fullmatch, columns)):
        return None
    count = points.shape[1]
    require_columns(table, _names(count, "std_"), "standard deviations of every coordinate")
    std = _coordinates(table, count, "std_")
    bad = ~np.isnan(points) & ~(std > 0)
    for i, t, a in np.argwhere(bad):
        got = "an empty cell" if np.isnan(std[i, t, a]) else repr(float(std[i, t, a]))
        raise table.error(int(i), f"std_{'xyz'[a]}{t + 1}", got, "a standard deviation > 0 [m]")
    return std
