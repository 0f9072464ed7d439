# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Points in files of their own, as trackers export them, and the rows of joints that they belong to.

A list of points has x, y and z, and a name or a time where it has one; each target has a list of its own, or
columns of its own in one list. A row of joints and a point belong together

* by *name*, if both files have names, and half of the rows at least are in the list: names alike but for
  capitals; or alike behind the last ``::`` or ``/``, where a tracker puts its folders; or alike in the number
  at their end;
* by *time*, if both files have times: the point nearest in time, no further away than half the shortest time
  between two rows, so that no point can belong to two;
* by *order*, if there are as many points as rows.

The first that is possible is taken and said, unless one is stated. A row without its point is not measured.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.errors import FileFormatError, InputError
from calib_planner.io.columns import Meaning, knows_columns, meaning_of
from calib_planner.io.table import Table, is_number, read_table
from calib_planner.io.understanding import (
    Reading,
    Source,
    Understanding,
    check_std,
    columns_from,
    coordinates,
    facts_of,
    joint_values,
    length_factors,
    meaning_names,
    payload_in,
)
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot
from calib_planner.units import Units, counted

MATCHES = ("name", "time", "order")
"""How points and rows of joints belong together."""
ENDINGS: tuple[Callable[[str], str], ...] = (
    lambda name: name.casefold(),
    lambda name: re.split(r"::|/", name)[-1].strip().casefold(),
    lambda name: m[1] if (m := re.search(r"0*(\d+)$", name)) else "",
)
"""What of two names has to be alike, the strictest first."""


def read_with_points(path: str | Path, robot: Robot, reading: Reading) -> Source:
    """The rows of a file of joints with the points of ``reading.points``.

    Raises:
        FileFormatError: A file cannot be read, or its points cannot be told apart.
        InputError: ``reading.match`` is unknown.
    """
    if reading.match and reading.match not in MATCHES:
        raise InputError("--match", repr(reading.match), f"one of: {', '.join(MATCHES)}")
    knows = knows_columns(robot.joint_names)
    what = "a table of joint values"
    table = read_table(path, what, knows, separator=reading.separator, columns=reading.columns)
    meaning = meaning_of(table, robot.joint_names, points=False, keys=True)
    q, angle, source, remarks = joint_values(table, meaning, robot, reading)
    points, stds, told = [], [], []
    unit = length_from = ""
    for name in reading.points:
        of_file, std, unit, length_from, text = _points_of(name, table, meaning, robot, reading)
        points.append(of_file)
        stds.append(std)
        told.append(text)
    without = [n for n, s in zip(reading.points, stds, strict=True) if s is None]
    if without and len(without) < len(stds):
        got, wanted = "no standard deviations", "them, as in the other files"
        raise FileFormatError(without[0], "header", got, wanted, "add them, or remove them from the others")
    std = None if without else np.concatenate([s for s in stds if s is not None], axis=1)
    understanding = Understanding(
        **facts_of(table),
        columns=meaning_names(meaning, robot.joint_names),
        columns_from=columns_from(meaning, reading.columns),
        units=Units(unit, angle),
        angle_from=source,
        length_from=length_from,
        remarks=(*remarks, *told),
    )
    data = Measurements(robot.joint_names, q, np.concatenate(points, axis=1), std, payload_in(table, meaning))
    return Source(table.path, data, table.lines, table.word, understanding)


def _points_of(
    path: str, joints: Table, joint_meaning: Meaning, robot: Robot, reading: Reading
) -> tuple[FloatArray, FloatArray | None, str, str, str]:
    """(rows, targets, 3) the points that belong to each row of ``joints`` [m], their std, the unit, how it was
    told, and how they were matched, in words."""
    table = read_table(
        path, "a list of points", knows_columns(()), separator=reading.separator, columns=reading.point_columns
    )
    meaning = meaning_of(table, (), points=True, joints=False, keys=True)
    points = coordinates(table, meaning, "point")
    factors, unit, source, _ = length_factors(table, meaning, "point", points, robot, reading)
    std = None
    if meaning.has_std:
        std = coordinates(table, meaning, "std")
        check_std(table, points, std)
        std = std * length_factors(table, meaning, "std", points, robot, reading)[0]
    how, rows = _match(joints, joint_meaning, table, meaning, reading.match)
    taken = rows >= 0
    at = np.where(taken, rows, 0)
    put: list[FloatArray | None] = []
    for values in (points * factors, std):
        put.append(None if values is None else np.where(taken[:, None, None], values[at], np.nan))
    columns = " ".join(meaning_names(meaning, ()))
    text = f"points of {path} ({columns}; {table.kind}) by {how}: {int(taken.sum())} of {len(joints)} rows"
    spare = len(table) - len(set(rows[taken].tolist()))
    text += f", {counted(spare, 'point')} of no row" if spare else ""
    assert put[0] is not None
    return put[0], put[1], unit, source, text


def _match(
    joints: Table, joint_meaning: Meaning, points: Table, point_meaning: Meaning, stated: str
) -> tuple[str, IntArray]:
    """How the points were matched, and (rows,) the point of each row of joints, −1 for none.

    Names or times that both files have and that do not agree are said.
    """
    tried: list[str] = []
    for how in (stated,) if stated else MATCHES:
        by = {"name": _by_name, "time": _by_time, "order": _by_order}[how]
        rows, why = by(joints, joint_meaning, points, point_meaning)
        if 2 * np.count_nonzero(rows >= 0) >= len(joints):
            disagree = [t for t in tried if not t.split(": ")[1].startswith("no ")]
            return f"{how} (not {'; '.join(disagree)})" if disagree else how, rows
        tried.append(f"by {how}: {why}")
    advice = f"give both files the same names, or as many rows as {joints.path} has"
    raise FileFormatError(
        points.path, "points", "; ".join(tried), "points that belong to the rows of joints", advice
    )


Matched = tuple[IntArray, str]


def _nothing(joints: Table) -> IntArray:
    return np.full(len(joints), -1)


def _by_name(joints: Table, joint_meaning: Meaning, points: Table, point_meaning: Meaning) -> Matched:
    ours, theirs = joint_meaning.at("name")[:1], point_meaning.at("name")[:1]
    if not ours or not theirs:
        return _nothing(joints), f"no names in {(points if ours else joints).path}"
    left, right = joints.texts(ours[0]), points.texts(theirs[0])
    for ending in ENDINGS:
        row_of: dict[str, int] = {}
        doubled = ""
        for i, name in enumerate(map(ending, right)):
            doubled = doubled or (right[i] if name and name in row_of else "")
            row_of.setdefault(name, i)
        row_of.pop("", None)
        keys = list(map(ending, left))
        rows = np.array([row_of.get(k, -1) for k in keys])
        if 2 * np.count_nonzero(rows >= 0) < len(joints):
            continue
        twice = doubled or next((n for n, k in zip(left, keys, strict=True) if keys.count(k) > 1), "")
        if not twice:
            return rows, ""
        if ending is ENDINGS[0]:
            return _nothing(joints), f"the name {twice!r} is there twice"
    return _nothing(joints), f"names such as {left[0]!r} here and {right[0]!r} there"


def _by_time(joints: Table, joint_meaning: Meaning, points: Table, point_meaning: Meaning) -> Matched:
    ours, theirs = _times(joints, joint_meaning), _times(points, point_meaning)
    if ours is None or theirs is None:
        return _nothing(joints), f"no times in {(joints if ours is None else points).path}"
    gaps = np.diff(np.sort(ours))
    if not len(gaps) or gaps.min() <= 0:
        return _nothing(joints), f"{joints.path} has one time twice"
    apart = np.abs(ours[:, None] - theirs[None, :])
    nearest = apart.argmin(axis=1)
    near = apart[np.arange(len(ours)), nearest] < gaps.min() / 2
    why = f"times from {ours.min():.3f} to {ours.max():.3f} s and from {theirs.min():.3f} to {theirs.max():.3f} s"
    return np.where(near, nearest, -1), why


def _by_order(joints: Table, joint_meaning: Meaning, points: Table, point_meaning: Meaning) -> Matched:
    if len(joints) != len(points):
        return _nothing(joints), f"{len(points)} points for {len(joints)} rows"
    return np.arange(len(joints)), ""


def _times(table: Table, meaning: Meaning) -> FloatArray | None:
    """(rows,) times [s]; ``None`` if there are none. A date and a time of day may have a column each."""
    at = meaning.at("time")
    if not at:
        return None
    texts = [" ".join(cells) for cells in zip(*(table.texts(j) for j in at), strict=True)]
    try:
        return np.array([_seconds(t) for t in texts])
    except ValueError:
        return None


def _seconds(text: str) -> float:
    """A number of seconds, a time of day, or a date with a time [s].

    Raises:
        ValueError: It is none.
    """
    if is_number(text):
        return float(text.replace(",", "."))
    if clock := re.fullmatch(r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)", text):
        return 3600.0 * int(clock[1]) + 60.0 * int(clock[2]) + float(clock[3].replace(",", "."))
    text = text.replace(",", ".").replace("Z", "+00:00")
    for pattern in ("%d.%m.%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S.%f", "%m/%d/%Y %H:%M:%S"):
        try:
            return datetime.strptime(text, pattern).replace(tzinfo=timezone.utc).timestamp()
        except ValueError:
            continue
    fraction = re.search(r"\.\d+", text)
    if fraction:  # Python 3.10 takes three or six digits only
        text = text.replace(fraction[0], f"{fraction[0][:7]:0<7}")
    moment = datetime.fromisoformat(text)
    return (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp()
