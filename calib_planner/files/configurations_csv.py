"""Joint configurations as CSV: candidates, test paths, plans to be measured. Joint columns in any order.

A column ``repetitions`` says how often each is to be measured; other columns are ignored.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calib_planner._arrays import FloatArray, IntArray, check_configurations
from calib_planner.files.table import Table, format_table, read_table, require_columns
from calib_planner.files.text import write_text
from calib_planner.robot.chain import Robot

WHAT = "a CSV of joint configurations"
REPETITIONS = "repetitions"


def read_configurations(path: str | Path, robot: Robot, *, degrees: bool = False) -> FloatArray:
    """(N, joints) in the robot's joint order [rad | m].

    Args:
        path: The file.
        robot: Gives the names of the joint columns and which of them are angles.
        degrees: The angles in the file are degrees.

    Raises:
        FileFormatError: Names line and column at fault, what stands there and what is valid.
    """
    return joint_columns(read_table(path, WHAT), robot, degrees=degrees)


def read_plan_csv(path: str | Path, robot: Robot, *, degrees: bool = False) -> tuple[FloatArray, IntArray]:
    """Configurations as ``read_configurations`` and the repetitions of each, 1 where not told."""
    table = read_table(path, WHAT)
    q = joint_columns(table, robot, degrees=degrees)
    if REPETITIONS not in table.columns or REPETITIONS in robot.joint_names:
        return q, np.ones(len(q), np.int64)
    counts = table.numbers([REPETITIONS])[:, 0]
    for i in np.flatnonzero((counts < 1) | (counts > 100_000) | (counts % 1 != 0)):
        got = f"{counts[i]:g}"
        raise table.error(int(i), REPETITIONS, got, "a whole number from 1 to 100000")
    return q, counts.astype(np.int64)


def write_configurations(
    path: str | Path,
    joint_names: tuple[str, ...],
    configurations: ArrayLike,
    repetitions: ArrayLike | None = None,
    field: str = "output",
) -> None:
    """Write configurations [rad | m], exact to the bit, with a ``repetitions`` column if given."""
    rows = check_configurations("configurations", configurations, joint_names).tolist()
    columns = list(joint_names)
    if repetitions is not None:
        columns.append(REPETITIONS)
        counts = np.asarray(repetitions, np.int64).tolist()
        rows = [[*row, k] for row, k in zip(rows, counts, strict=True)]
    write_text(path, format_table(columns, rows), field)


def joint_columns(table: Table, robot: Robot, *, degrees: bool) -> FloatArray:
    """(rows, joints) of a table in the robot's joint order [rad | m]."""
    require_columns(table, robot.joint_names, "the robot's joints")
    return table.numbers(robot.joint_names) * angle_factors(robot, degrees=degrees)


def angle_factors(robot: Robot, *, degrees: bool) -> FloatArray:
    """(joints,) what turns input into rad or m: π/180 for angles given in degrees, else 1."""
    return np.where(robot.joint_is_revolute & degrees, np.pi / 180.0, 1.0)
