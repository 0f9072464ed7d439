# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""From a table to numbers in SI units, and what was recognised on the way.

A file becomes a table (``table.py``), the table's columns get a meaning (``columns.py``), and here the cells
become numbers. What was recognised is an ``Understanding``, of which people are told in one line if the
file is not as this package writes it.

*Units* are told in this order: what is written with a column (in its name, below it, or beside the data); what
the user states; what the sizes of the numbers tell (``sizes.py``). Written and stated units that contradict one
another are refused. The rest is taken as metres and radians; whether these fit the robot, the identification
tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner.acquisition import Standstill, StandstillSettings
from calib_planner.arrays import FloatArray, IntArray
from calib_planner.errors import FileFormatError, InputError
from calib_planner.io.columns import PAYLOAD, Meaning, coordinate_names
from calib_planner.io.sizes import angles_by_size, lengths_by_size, sliding_by_size
from calib_planner.io.table import SEPARATORS, Table, separator_named
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot
from calib_planner.units import ANGLES, LENGTHS, SI, UNSAID, Units, counted, listed

STORAGE = (".db3", ".mcap")
"""Endings of the storage files of a bag."""


def no_progress(label: str) -> AbstractContextManager[Callable[[float, str], None] | None]:
    """Shows nothing."""
    return nullcontext()


def no_note(text: str) -> None:
    """Tells nobody."""


@dataclass(frozen=True)
class BagTopics:
    """Where the messages are; a leading slash may be left out.

    Attributes:
        joints: Topics of sensor_msgs/JointState: one, or several that hold some of the joints each.
        points: Topics of geometry_msgs/PointStamped, PoseStamped or TransformStamped, or of tf2_msgs/TFMessage,
            one per target, in their order.
        children: The child_frame_id of each target, for transforms; empty: the first one that comes.
        states: Topics of std_msgs/Bool on which the tracker says whether it sees each target; empty: none.
    """

    joints: tuple[str, ...] = ("joint_states",)
    points: tuple[str, ...] = ("tracker/point",)
    children: tuple[str, ...] = ()
    states: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.joints, str):
            object.__setattr__(self, "joints", (self.joints,))
        for name in ("joints", "points", "children", "states"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        names = self.names
        shared = len(set(self.children)) == len(self.points)  # transforms of several targets on one topic
        apart = (*self.joints, *(set(self.points) if shared else self.points), *self.states)
        if not (self.joints and self.points) or "/" in names or len(set(map(_absolute, apart))) != len(apart):
            got = ", ".join(map(repr, (*self.joints, *self.points, *self.states)))
            raise InputError("topics", got, "topics of joints and one per target, each once")
        for name in ("children", "states"):
            if len(getattr(self, name)) not in (0, len(self.points)):
                raise InputError(
                    name, listed(getattr(self, name)), f"{len(self.points)}, one per target, or none"
                )

    @property
    def names(self) -> tuple[str, ...]:
        """All topics as a bag names them: those of the joints, of the points, of the states."""
        return tuple(map(_absolute, (*self.joints, *self.points, *self.states)))


def _absolute(name: str) -> str:
    return "/" + name.strip().strip("/")


@dataclass(frozen=True)
class Reading:
    """How files of measurements and of configurations are read.

    Attributes:
        units: Units of the numbers in the files; empty ones are recognised, and others than written are refused.
        otherwise: Units of what has none written, in place of what the sizes tell.
        columns: Names of all columns, in order, in place of the file's own; ``-`` plays no part.
        separator: What separates the cells of text; empty: recognised.
        points: Files of points that belong to a file of joints, one per target; empty: the file has both.
        point_columns: As ``columns``, for these.
        match: How they belong together: ``name``, ``time`` or ``order``; empty: the first of these that is
            possible.
        topics: The topics of a bag.
        standstill: What counts as standing still in a bag.
        repeatability: Standard deviation of a coordinate that averaging does not reduce, of bags [m].
        accept_damaged: Use what can be read of a damaged bag.
        note: Called with what a person should know about a file.
        progress: Called with a label; a context that yields a function (share done, text), or ``None``.
    """

    units: Units = UNSAID
    otherwise: Units = UNSAID
    columns: tuple[str, ...] = ()
    separator: str = ""
    points: tuple[str, ...] = ()
    point_columns: tuple[str, ...] = ()
    match: str = ""
    topics: BagTopics | None = None
    standstill: StandstillSettings | None = None
    repeatability: float = 0.0
    accept_damaged: bool = False
    note: Callable[[str], None] = no_note
    progress: Callable[[str], AbstractContextManager[Callable[[float, str], None] | None]] = no_progress

    def __post_init__(self) -> None:
        if self.separator:
            object.__setattr__(self, "separator", separator_named(self.separator))


@dataclass(frozen=True)
class Understanding:
    """What was recognised about a file.

    Attributes:
        path: The file.
        kind: What kind of file it is.
        rows: Number of rows.
        separator: Name of what separates the cells; empty where the kind of file decides that.
        decimal: The decimal mark.
        header: Whether there is a header.
        titles: Number of lines above it that were skipped.
        columns: What each column was taken for: a joint, ``x1``, ``std_x1``, …; ``-`` for no part.
        columns_from: ``header``, ``numbers`` (of the joints), ``places`` or ``stated``.
        units: The file's units; of several the first.
        angle_from: How that of angles was told: ``written``, ``stated``, ``size`` or ``nothing``.
        length_from: The same for lengths.
        remarks: What else a person should know.
    """

    path: str
    kind: str
    rows: int
    separator: str = ""
    decimal: str = "."
    header: bool = True
    titles: int = 0
    columns: tuple[str, ...] = ()
    columns_from: str = "header"
    units: Units = SI
    angle_from: str = "nothing"
    length_from: str = "nothing"
    remarks: tuple[str, ...] = ()

    @property
    def plain(self) -> bool:
        """Whether the file is as this package writes it, so that there is nothing to tell."""
        told = {self.angle_from, self.length_from} & {"written", "size"}
        usual = self.kind in ("text", "bag") and self.separator in ("", "comma") and self.decimal == "."
        return usual and not self.titles and self.columns_from == "header" and not told and not self.remarks

    def describe(self) -> str:
        """What was recognised, in one line."""
        kind = self.kind + (f" with {self.separator}" if self.separator else "")
        parts = [f"{kind}, {counted(self.rows, 'row')}"]
        if self.decimal == ",":
            parts.append("decimal comma")
        if self.titles:
            parts.append(f"{counted(self.titles, 'title line')} skipped")
        how = {
            "header": "columns by name",
            "numbers": "columns by name, joints by number",
            "places": "no header, columns by place",
            "stated": "columns as stated",
        }
        parts.append(f"{how[self.columns_from]}: {_shortened(self.columns)}")
        sources = {"written": "as written", "stated": "as stated", "size": "by their size", "nothing": "assumed"}
        parts.append(f"angles in {self.units.angle} ({sources[self.angle_from]})")
        parts.append(f"lengths in {self.units.length} ({sources[self.length_from]})")
        return "; ".join([*parts, *self.remarks])

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values."""
        return {
            "file": self.path,
            "kind": self.kind,
            "rows": self.rows,
            "separator": self.separator,
            "decimal": self.decimal,
            "header": self.header,
            "columns": list(self.columns),
            "columns_from": self.columns_from,
            "units": {"length": self.units.length, "angle": self.units.angle},
            "units_from": {"length": self.length_from, "angle": self.angle_from},
            "remarks": list(self.remarks),
        }


def _shortened(names: Sequence[str]) -> str:
    """``j1 … j6, x1 y1 z1, -``: the columns with the middle of long runs left out."""
    return " ".join(names) if len(names) <= 20 else f"{' '.join(names[:12])} … {' '.join(names[-6:])}"


@dataclass(frozen=True, eq=False)
class Source:
    """A file of measurements.

    Attributes:
        path: The file.
        data: What it holds.
        numbers: (N,) line of each row in a table; number of each standstill in a bag, from 1.
        word: What ``numbers`` count: ``line``, ``row`` or ``standstill``.
        understanding: What was recognised about it.
        ignored: Names of the columns that play no part.
        frame_id: Frame of a bag's points; empty if none is named.
        standstills: Those of a bag, one a row.
    """

    path: str
    data: Measurements
    numbers: IntArray
    word: str
    understanding: Understanding
    ignored: tuple[str, ...] = ()
    frame_id: str = ""
    standstills: tuple[Standstill, ...] = ()


@dataclass(frozen=True, eq=False)
class JointTable:
    """A table of configurations.

    Attributes:
        configurations: (N, joints) in the robot's joint order [rad | m].
        repetitions: (N,) how often each is measured; 1 where nothing is said.
        understanding: What was recognised about the file.
    """

    configurations: FloatArray
    repetitions: IntArray
    understanding: Understanding


# ── measurements ─────────────────────────────────────────────────────────────────────────────────────


def measurements_in(table: Table, meaning: Meaning, robot: Robot, reading: Reading) -> Source:
    """The measurements that a table holds, once its columns have a meaning."""
    q, angle_unit, angle_from, remarks = joint_values(table, meaning, robot, reading)
    points = coordinates(table, meaning, "point")
    std = coordinates(table, meaning, "std") if meaning.has_std else None
    factors, unit, length_from, more = length_factors(table, meaning, "point", points, robot, reading)
    if std is not None:
        check_std(table, points, std)
        std = std / (1.0 / length_factors(table, meaning, "std", points, robot, reading)[0])
    understanding = Understanding(
        **facts_of(table),
        columns=meaning_names(meaning, robot.joint_names),
        columns_from=columns_from(meaning, reading.columns),
        units=Units(unit, angle_unit),
        angle_from=angle_from,
        length_from=length_from,
        remarks=(*remarks, *more),
    )
    metres = points / (1.0 / factors)  # 159.763 mm are 0.159763 m: a product with 1e-3 has other last digits
    data = Measurements(robot.joint_names, q, metres, std, payload_in(table, meaning))
    return Source(table.path, data, table.lines, table.word, understanding, meaning.ignored)


def facts_of(table: Table) -> dict[str, Any]:
    """The fields of ``Understanding`` that the table itself decides."""
    text = table.kind.startswith("text")
    return {
        "path": table.path,
        "kind": table.kind,
        "rows": len(table),
        "separator": SEPARATORS[table.separator] if text else "",
        "decimal": table.decimal,
        "header": table.header,
        "titles": table.titles,
    }


def columns_from(meaning: Meaning, stated: Sequence[str]) -> str:
    """What told the columns' meaning: a value of ``Understanding.columns_from``."""
    if stated:
        return "stated"
    return "places" if meaning.by_place else "numbers" if meaning.by_number else "header"


def meaning_names(meaning: Meaning, joint_names: Sequence[str]) -> tuple[str, ...]:
    """What each column was taken for."""
    names = []
    for column in meaning.columns:
        if column.kind == "joint":
            names.append(joint_names[column.index])
        elif column.kind in ("point", "std"):
            names.append(f"{'std_' * (column.kind == 'std')}{'xyz'[column.axis]}{column.index + 1}")
        else:
            names.append(column.kind or "-")
    return tuple(names)


# ── joints ───────────────────────────────────────────────────────────────────────────────────────────


def joint_values(
    table: Table, meaning: Meaning, robot: Robot, reading: Reading
) -> tuple[FloatArray, str, str, list[str]]:
    """(rows, joints) in the robot's joint order [rad | m]; the unit of angles, how it was told, and remarks."""
    q = table.numbers(meaning.joints, robot.joint_names)
    turns, remarks = robot.joint_is_revolute, []
    said = Units.parse(table.said)
    written = [meaning.columns[j].unit for j in meaning.joints]
    for name, unit, angle in zip(robot.joint_names, written, turns, strict=True):
        if unit and angle != (unit in ANGLES):
            valid = "a unit of angle" if angle else "a unit of length, since this joint slides"
            raise FileFormatError(table.path, f"column {name}", unit, valid)
    written = [u or (said.angle if angle else said.length) for u, angle in zip(written, turns, strict=True)]
    _refuse_contradiction(table, [u for u in written if u], reading.units)
    stated = reading.units.angle or reading.otherwise.angle
    silent = np.array([not u for u in written])
    unit, source = stated or "rad", "stated" if stated else "nothing"
    if not stated and (silent & turns).any():
        unit, why = angles_by_size(robot, q, silent & turns)
        source = "size" if unit != "rad" else "nothing"
        remarks += why
    units = [u or (unit if angle else "") for u, angle in zip(written, turns, strict=True)]
    for j in np.flatnonzero(~turns):
        if not units[j]:
            metre = reading.units.length or reading.otherwise.length
            units[j] = metre or sliding_by_size(robot, q[:, j], int(j))
            if units[j] != "m" and not metre:
                remarks.append(f"{robot.joint_names[j]} in {units[j]} (by its size)")
    factors = [ANGLES[u] if angle else LENGTHS[u] for u, angle in zip(units, turns, strict=True)]
    angles = [u for u, angle in zip(units, turns, strict=True) if angle]
    if any(u for u, angle in zip(written, turns, strict=True) if angle):
        source = "written"
    if len(set(angles)) > 1:
        remarks.append(f"joints in {', '.join(angles)}")
    return q * np.array(factors), (angles or ["rad"])[0], source, remarks


# ── points ───────────────────────────────────────────────────────────────────────────────────────────


def coordinates(table: Table, meaning: Meaning, kind: str) -> FloatArray:
    """(rows, targets, 3) as the file has them, NaN where empty; a target is measured in all coordinates or not
    at all."""
    count, prefix = meaning.targets, "std_" if kind == "std" else ""
    at = [j for t in range(count) for j in meaning.at(kind, t)]
    names = [table.columns[j] or n for j, n in zip(at, coordinate_names(count, prefix), strict=True)]
    values = table.numbers(at, names, empty=True).reshape(-1, count, 3)
    partly = np.isnan(values).any(axis=2) & ~np.isnan(values).all(axis=2)
    for i, t in np.argwhere(partly):
        columns = ", ".join(names[3 * t : 3 * t + 3])
        raise table.error(int(i), columns, "some of the three cells empty", "all three or none")
    return values


def length_factors(
    table: Table, meaning: Meaning, kind: str, points: FloatArray, robot: Robot, reading: Reading
) -> tuple[FloatArray, str, str, list[str]]:
    """(targets, 3) what makes metres of points or their std; the unit, how it was told, and remarks."""
    written = [meaning.columns[j].unit for t in range(meaning.targets) for j in meaning.at(kind, t)]
    if kind == "point":
        said = Units.parse(table.said).length
        written = [u or said for u in written]
        _refuse_contradiction(table, [u for u in written if u], reading.units)
        stated = reading.units.length or reading.otherwise.length
        unit, source = stated or "m", "stated" if stated else "nothing"
        remarks: list[str] = []
        if not stated and not all(written):
            unit, remarks = lengths_by_size(robot, points)
            source = "size" if unit != "m" else "nothing"
        if any(written):
            unit, source = next(u for u in written if u), "written"
    else:
        of_points = length_factors(table, meaning, "point", points, robot, reading)
        unit, source, remarks = of_points[1:]
    units = [u or unit for u in written]
    return np.array([LENGTHS[u] for u in units]).reshape(meaning.targets, 3), unit, source, remarks


def check_std(table: Table, points: FloatArray, std: FloatArray) -> None:
    """Refuse a point whose standard deviation is missing or not positive."""
    for i, t, a in np.argwhere(~np.isnan(points) & ~(std > 0)):
        got = "an empty cell" if np.isnan(std[i, t, a]) else repr(float(std[i, t, a]))
        raise table.error(int(i), f"std_{'xyz'[a]}{t + 1}", got, "a standard deviation > 0 [m]")


def payload_in(table: Table, meaning: Meaning) -> FloatArray | None:
    """(rows,) masses [kg], or ``None`` if the file has none."""
    at = meaning.at(PAYLOAD)
    if not at:
        return None
    masses = table.numbers(at, [PAYLOAD])[:, 0]
    for i in np.flatnonzero(masses < 0.0):
        raise table.error(int(i), PAYLOAD, f"{masses[i]:g}", "a mass of 0 kg or more")
    return masses


def _refuse_contradiction(table: Table, written: Sequence[str], stated: Units) -> None:
    for unit in written:
        other = stated.angle if unit in ANGLES else stated.length
        if other and unit != other:
            got = f"--units {stated}"
            advice = "leave --units out, or replace the names with --columns"
            raise FileFormatError(table.path, "units", got, f"{unit}, as the file says", advice)
