# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The one door for measurements and for tables of configurations, whatever kind of file they come in."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.io.bag import read_bag
from calib_planner.io.columns import REPETITIONS, Meaning, knows_columns, meaning_of
from calib_planner.io.point_lists import read_with_points
from calib_planner.io.table import Table, read_table
from calib_planner.io.text import user_path
from calib_planner.io.understanding import (
    STORAGE,
    JointTable,
    Reading,
    Source,
    Understanding,
    columns_from,
    facts_of,
    joint_values,
    meaning_names,
    measurements_in,
)
from calib_planner.robot import Robot
from calib_planner.units import ANGLES, LENGTHS, Units, listed

CONFIGURATIONS = "a table of joint configurations"
MEASUREMENTS = "a table of measurements"


def read_data(path: str | Path, robot: Robot, reading: Reading | None = None) -> Source:
    """Read measurements of ``robot`` from a file of any kind; joints come in the robot's order whatever the
    file's.

    Args:
        path: A table (text, XLSX, MAT, NPY, NPZ, JSON) or a bag.
        robot: Gives the names of the joints, which of them are angles, their limits, and the reach.
        reading: What is stated about the file; the rest is table out.

    Raises:
        FileFormatError: Names line and column at fault, what stands there, what is valid and what to do.
        MissingExtraError: A package is missing that this kind of file needs.
    """
    reading = reading or Reading()
    if is_bag(path):
        return _bag(path, robot, reading)
    if reading.points:
        return _told(reading, read_with_points(path, robot, reading))
    table = read_table(
        path,
        MEASUREMENTS,
        knows_columns(robot.joint_names),
        separator=reading.separator,
        columns=reading.columns,
    )
    meaning = meaning_of(table, robot.joint_names, points=True)
    return _told(reading, measurements_in(table, meaning, robot, reading))


def is_bag(path: str | Path) -> bool:
    """Whether ``path`` is to be read as a bag: a folder, or a storage file by its name."""
    place = user_path(path)
    return place.is_dir() or place.suffix in STORAGE or place.name == "metadata.yaml"


def _told(reading: Reading, source: Source) -> Source:
    if not source.understanding.plain:
        reading.note(f"{source.path}: {source.understanding.describe()}")
    if source.ignored:
        reading.note(f"{source.path}: columns ignored: {listed(source.ignored)}")
    return source


def _bag(path: str | Path, robot: Robot, reading: Reading) -> Source:
    said, other = reading.units, reading.otherwise
    stated = Units(said.length or other.length, said.angle or other.angle)
    with reading.progress(f"reading {path}") as update:
        bag = read_bag(
            path,
            robot,
            reading.topics,
            reading.standstill,
            repeatability=reading.repeatability,
            accept_damaged=reading.accept_damaged,
            units=stated,
            progress=update,
        )
    for line in bag.describe():
        reading.note(f"{path}: {line}")
    length_from = "stated" if stated.length else "size" if bag.units.length != "m" else "nothing"
    angle_from = "stated" if stated.angle else "size" if bag.units.angle != "rad" else "nothing"
    understanding = Understanding(
        path=str(path),
        kind="bag",
        rows=len(bag.data),
        units=bag.units,
        length_from=length_from,
        angle_from=angle_from,
    )
    numbers = np.arange(1, len(bag.data) + 1)
    return Source(str(path), bag.data, numbers, "standstill", understanding, (), bag.frame_id, bag.standstills)


# ── configurations ───────────────────────────────────────────────────────────────────────────────────


def read_joints(path: str | Path, robot: Robot, reading: Reading | None = None) -> JointTable:
    """Read configurations of ``robot``: candidates, test paths, plans to be measured.

    Other columns play no part, but for ``repetitions``.

    Raises:
        FileFormatError: As ``read_data``.
    """
    reading = reading or Reading()
    knows = knows_columns(robot.joint_names)
    table = read_table(path, CONFIGURATIONS, knows, separator=reading.separator, columns=reading.columns)
    meaning = meaning_of(table, robot.joint_names, points=False)
    q, unit, source, remarks = joint_values(table, meaning, robot, reading)
    understanding = Understanding(
        **facts_of(table),
        columns=meaning_names(meaning, robot.joint_names),
        columns_from=columns_from(meaning, reading.columns),
        units=Units(reading.units.length or "m", unit),
        angle_from=source,
        remarks=tuple(remarks),
    )
    if not understanding.plain:
        reading.note(f"{path}: {understanding.describe()}")
    return JointTable(q, _repetitions(table, meaning), understanding)


def _repetitions(table: Table, meaning: Meaning) -> IntArray:
    at = meaning.at(REPETITIONS)
    if not at:
        return np.ones(len(table), np.int64)
    counts = table.numbers(at, [REPETITIONS])[:, 0]
    for i in np.flatnonzero((counts < 1) | (counts > 100_000) | (counts % 1 != 0)):
        got = f"{counts[i]:g}"
        raise table.error(int(i), REPETITIONS, got, "a whole number from 1 to 100000")
    return counts.astype(np.int64)


def read_configurations(path: str | Path, robot: Robot, reading: Reading | None = None) -> FloatArray:
    """(N, joints) in the robot's joint order [rad | m], of ``read_joints``."""
    return read_joints(path, robot, reading).configurations


def read_plan_csv(path: str | Path, robot: Robot, reading: Reading | None = None) -> tuple[FloatArray, IntArray]:
    """Configurations as ``read_configurations`` and the repetitions of each, 1 where not told."""
    table = read_joints(path, robot, reading)
    return table.configurations, table.repetitions


def in_units(robot: Robot, configurations: FloatArray, units: Units) -> FloatArray:
    """(N, joints) configurations [rad | m] as numbers in ``units``, for output; what is not said is SI."""
    angle, metre = ANGLES[units.angle or "rad"], LENGTHS[units.length or "m"]
    return configurations / np.where(robot.joint_is_revolute, angle, metre)


def with_units(robot: Robot, units: Units) -> tuple[str, ...]:
    """Names of the joints with the unit of their numbers behind, as this reader understands it: ``j1 [deg]``."""
    said = [(units.angle or "rad") if turns else (units.length or "m") for turns in robot.joint_is_revolute]
    return tuple(f"{n} [{u}]" for n, u in zip(robot.joint_names, said, strict=True))
