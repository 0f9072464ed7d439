# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the columns of a table mean, told by their names, and the units that stand with them.

A name is taken apart into its unit, if one stands with it (``x [mm]``, ``q1_deg``, ``z/m``), and the words of
the rest. The robot's own joint names come first, then ``x1,y1,z1`` and their relatives (``X``, ``P1_x``,
``target 2.y``, ``Measured Z``), ``std_x1`` and its relatives, then the joints numbered as controllers do (``J1
… J6``, ``A1 … A6``, ``actual_q_0 … actual_q_5``): the n-th moves the n-th joint, and all of them have to be
there.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import pairwise

from calib_planner.errors import FileFormatError
from calib_planner.io.table import Table, is_number
from calib_planner.units import ANGLES, LENGTHS, SPELLINGS, brief, counted, listed

REPETITIONS = "repetitions"
"""Column of a plan: how often each configuration is measured."""
PAYLOAD = "payload"
"""Column of the mass that the robot carried [kg]."""
COORDINATE = re.compile(r"(std_)?([xyz])([1-9][0-9]{0,3})")
NEARLY = re.compile(r"(std|sigma)?[_ ]*[xyz][_ ]*[0-9]*", re.IGNORECASE)


def words_of(text: str) -> frozenset[str]:
    """The words of a text."""
    return frozenset(text.split())


BRACKETS = re.compile(r"(.*?)\s*[\[({<]\s*([^\])}>]*?)\s*[\])}>]\s*")
KILOGRAMS = re.compile(r"\s*[\[(]\s*kg\s*[\])]$")
BEHIND = re.compile(r"(.+?)(?:\s*/\s*|[_\s]+in[_\s]+|[_\s]+|(?=°|º))([^\s_/]+)")
WORDS = re.compile(r"[^\W\d_]+|\d+")
POINT_WORDS = words_of(
    "p pt pnt point t target tgt refl reflector smr prism marker pos position measured meas tracker laser leica "
    "act actual m coord coordinate coordinates pose translation tcp tool val value koordinate punkt messpunkt"
)
"""Words that may stand with x, y or z."""
SPLIT = {f"{p}{a}": (p, a) for p in "ptm" for a in "xyz"}
STD_WORDS = {"std", "sigma", "sd", "stdev", "stddev", "σ", "unc", "uncertainty"}
JOINT_WORDS = words_of(
    "q j a joint joints jnt axis axes ax achse theta th θ angle angles ang rax jangle value values pos position "
    "positions state actual act measured meas current feedback fb robot m"
)
"""Words that may stand with the number of a joint."""
ACTUAL = {"actual", "act", "measured", "meas", "current", "feedback", "fb"}
"""Words that tell what a joint did from what it was told."""
NAME_WORDS = words_of("name id pointname pointid point target nr no number index label pose")
TIME_WORDS = words_of("time timestamp stamp datetime t zeit date secs seconds")


@dataclass(frozen=True)
class Column:
    """What a column means.

    Attributes:
        kind: ``joint``, ``point``, ``std``, ``payload``, ``repetitions``, ``name``, ``time`` or empty: no part.
        index: Number of the joint or target, from 0.
        axis: 0, 1, 2 for x, y, z.
        unit: A key of ``LENGTHS`` or ``ANGLES`` where one stands with it; else empty.
    """

    kind: str = ""
    index: int = 0
    axis: int = 0
    unit: str = ""


def unit_of(name: str) -> tuple[str, str]:
    """A column's name without its unit, and the unit: a key of ``LENGTHS`` or ``ANGLES``, or empty."""
    for pattern in (BRACKETS, BEHIND):
        match = pattern.fullmatch(name.strip())
        if match and (unit := SPELLINGS.get(match[2].casefold(), "")):
            return match[1].strip(), unit
    return name.strip(), ""


def knows_columns(joint_names: Sequence[str]) -> _Knows:
    """Whether a text is the name of a column that measurements of these joints have."""
    return _Knows(tuple(joint_names))


@dataclass(frozen=True)
class _Knows:
    joint_names: tuple[str, ...]

    def __call__(self, text: str) -> bool:
        if not text or len(text) > 100:
            return False
        name = text if text in self.joint_names else unit_of(text)[0]
        if name in self.joint_names or plain(name) in {plain(n) for n in self.joint_names}:
            return True
        if COORDINATE.fullmatch(name) or coordinate(name) or numbered(name):
            return True
        return name.casefold() in {REPETITIONS, PAYLOAD}


def plain(name: str) -> str:
    """A name as it is compared: letters and digits, small."""
    return "".join(c for c in name.casefold() if c.isalnum())


def coordinate(name: str) -> tuple[str, int | None, int] | None:
    """``point`` or ``std``, the number of the target if one stands there, and the axis; ``None`` if it is
    none."""
    words = [w for word in WORDS.findall(name) for w in SPLIT.get(word.casefold(), (word.casefold(),))]
    axes = [w for w in words if w in ("x", "y", "z")]
    counts = [int(w) for w in words if w.isdecimal() and len(w) <= 4]
    rest = [w for w in words if w not in axes and not w.isdecimal()]
    std = [w for w in rest if w in STD_WORDS]
    if len(axes) != 1 or len(counts) > 1 or any(w.isdecimal() and len(w) > 4 for w in words):
        return None
    if any(w not in POINT_WORDS for w in rest if w not in std):
        return None
    return "std" if std else "point", counts[0] if counts else None, "xyz".index(axes[0])


def numbered(name: str) -> tuple[str, int] | None:
    """The words and the number of a joint that is called by its number; ``None`` if it is no such name."""
    words = [w.casefold() for w in WORDS.findall(name)]
    counts = [w for w in words if w.isdecimal()]
    rest = [w for w in words if not w.isdecimal()]
    if len(counts) != 1 or len(counts[0]) > 2 or not rest or any(w not in JOINT_WORDS for w in rest):
        return None
    return " ".join(rest), int(counts[0])


@dataclass(frozen=True)
class Meaning:
    """What all columns of a table mean.

    Attributes:
        columns: A column's meaning, in the order of the table.
        joints: (joints,) the column of each joint; empty if the table has none and none are needed.
        targets: Number of targets with points.
        has_std: Whether standard deviations stand with them.
        ignored: Names of the columns that play no part.
        by_number: Whether the joints were called by their numbers.
        by_place: Whether the columns were told by their places, for want of a header.
    """

    columns: tuple[Column, ...]
    joints: tuple[int, ...]
    targets: int
    has_std: bool
    ignored: tuple[str, ...]
    by_number: bool = False
    by_place: bool = False

    def at(self, kind: str, target: int = 0) -> list[int]:
        """The three columns x, y, z of a target, or the columns of another kind."""
        of_kind = [(c.axis, j) for j, c in enumerate(self.columns) if c.kind == kind and c.index == target]
        return [j for _, j in sorted(of_kind)]


def meaning_of(
    table: Table, joint_names: Sequence[str], *, points: bool, joints: bool = True, keys: bool = False
) -> Meaning:
    """Tell the columns of a table.

    Args:
        table: The table; without names its columns are told by their places.
        joint_names: The robot's joints.
        points: Points are needed.
        joints: Joints are needed.
        keys: Names or times of rows play a part, since points and joints are in files of their own.

    Raises:
        FileFormatError: A column is missing, there twice, or cannot be told.
    """
    wanted = _Wanted(tuple(joint_names), points, joints, keys)
    return _by_name(table, wanted) if any(table.columns) else _by_place(table, wanted)


@dataclass(frozen=True)
class _Wanted:
    joint_names: tuple[str, ...]
    points: bool
    joints: bool
    keys: bool


# ── by name ──────────────────────────────────────────────────────────────────────────────────────────


def _by_name(table: Table, wanted: _Wanted) -> Meaning:
    joint_names, points, joints = wanted.joint_names, wanted.points, wanted.joints
    columns = [Column()] * len(table.columns)
    written = set(table.columns)
    named = []
    for column in table.columns:
        name, unit = unit_of(column)
        # What stands there without a unit, too, is the column meant; joints may be called as if they had a unit.
        alone = column in joint_names or COORDINATE.fullmatch(column) or (unit and name in written)
        named.append((column, "") if alone else (name, unit))
    for name, unit in named:
        _refuse_strange_unit(table, name, unit, joint_names)
    place, by_number = _joint_places(table, [n for n, _ in named], joint_names, needed=joints)
    for j, at in enumerate(place):
        columns[at] = Column("joint", j)
    free = [j for j, c in enumerate(columns) if not c.kind and named[j][0]]
    targets, has_std = 0, False
    if points:
        targets, has_std = _coordinate_places(table, [named[j][0] for j in free], free, columns)
    for j in free:
        word = KILOGRAMS.sub("", named[j][0].casefold())
        if columns[j].kind:
            continue
        if word in (PAYLOAD, REPETITIONS) and joints:
            columns[j] = Column(word)
        elif wanted.keys:
            columns[j] = _key(word)
    columns = [_with_unit(table, j, c, named[j][1]) for j, c in enumerate(columns)]
    used = ("joint", "point", "std", *((PAYLOAD, "name", "time") if points else (REPETITIONS, "name", "time")))
    every = zip(table.columns, columns, strict=True)
    ignored = [n for n, c in every if n not in ("", "-") and c.kind not in used]
    if points:
        for name in ignored:
            if NEARLY.fullmatch(name):
                valid = f"{listed(coordinate_names(max(targets, 1), ''))} and std_ of each"
                got = "an unknown name"
                raise FileFormatError(table.path, f"column {brief(name, 40)}", got, valid, "rename it")
    return Meaning(tuple(columns), tuple(place), targets, has_std, tuple(ignored), by_number)


def _refuse_strange_unit(table: Table, name: str, unit: str, joint_names: Sequence[str]) -> None:
    """A unit that nobody knows behind the name of a joint or coordinate must not be taken for metres or
    radians."""
    match = None if unit or len(name) > 100 else BRACKETS.fullmatch(name)
    if match and knows_columns(joint_names)(match[1].strip()) and KILOGRAMS.search(name.casefold()) is None:
        where, valid = f"unit of column {brief(name, 40)}", f"one of {', '.join((*LENGTHS, *ANGLES))}"
        raise FileFormatError(table.path, where, repr(match[2]), valid, "state --columns")


def _key(word: str) -> Column:
    """The column by which points are told apart: a name or a time."""
    words = set(WORDS.findall(word))
    if words & TIME_WORDS:
        return Column("time")
    return Column("name") if words and words <= NAME_WORDS else Column()


def _joint_places(
    table: Table, names: Sequence[str], joint_names: Sequence[str], *, needed: bool
) -> tuple[list[int], bool]:
    """Column of each joint, and whether the joints are called by their numbers."""
    exact = {n: j for j, n in enumerate(names)}
    for joint in joint_names:
        twins = [table.columns[j] for j, n in enumerate(names) if n == joint]
        if len(twins) > 1:
            raise FileFormatError(
                table.path, "header", listed(twins), f"one column of {joint}", "state --columns"
            )
    if all(n in exact for n in joint_names):
        return [exact[n] for n in joint_names], False
    alike: dict[str, list[int]] = {}
    for j, name in enumerate(names):
        alike.setdefault(plain(name), []).append(j)
    if all(len(alike.get(plain(n), ())) == 1 for n in joint_names):
        return [alike[plain(n)][0] for n in joint_names], False
    groups: dict[str, dict[int, int]] = {}
    for j, name in enumerate(names):
        if one := numbered(name):
            groups.setdefault(one[0], {})[one[1]] = j
    count = len(joint_names)
    whole = {w: g for w, g in groups.items() if sorted(g) in (list(range(count)), list(range(1, count + 1)))}
    if len(whole) > 1:
        actual = {w: g for w, g in whole.items() if set(w.split()) & ACTUAL}
        whole = actual if len(actual) == 1 else whole
    if len(whole) == 1 and not any(n in exact for n in joint_names):
        (group,) = whole.values()
        return [group[i] for i in sorted(group)], True
    if not needed:
        return [], False
    if len(whole) > 1:
        got = " and ".join(f"{w} 1 … {count}" for w in list(whole)[:4])
        raise FileFormatError(table.path, "header", got, "one set of joints", "state --columns")
    require_columns(table, names, joint_names, "the robot's joints")
    return [], False


def _coordinate_places(
    table: Table, names: Sequence[str], free: Sequence[int], columns: list[Column]
) -> tuple[int, bool]:
    """Put the meaning of points and their standard deviations into ``columns``; targets, and whether there are
    std."""
    exact = [(j, m) for j, n in zip(free, names, strict=True) if (m := COORDINATE.fullmatch(n))]
    plain_std = [j for j, m in exact if m[1]]
    if any(not m[1] for _, m in exact):
        cells = [("std" if m[1] else "point", int(m[3]), "xyz".index(m[2]), j) for j, m in exact]
        if not plain_std:
            cells += _loose(names, free, "std", columns)
    else:
        cells = _loose(names, free, "", columns)
    counts = Counter((kind, t, axis) for kind, t, axis, _ in cells)
    for (kind, t, axis), times in counts.items():
        if times > 1:
            which = [table.columns[j] for k, u, a, j in cells if (k, u, a) == (kind, t, axis)]
            valid = f"one column of {'xyz'[axis]} per reflector"
            raise FileFormatError(table.path, "header", listed(which), valid, "rename one, or state --columns")
    count = len({t for kind, t, _, _ in cells if kind == "point"})
    numbers = sorted({t for kind, t, _, _ in cells if kind == "point"})
    first = 0 if numbers[:1] == [0] else 1
    for kind in ("point", "std"):
        here = {(t - first, axis): j for k, t, axis, j in cells if k == kind}
        if kind == "std" and not here:
            return count, False
        prefix = "std_" if kind == "std" else ""
        wanted = [(t, axis) for t in range(max(count, 1)) for axis in range(3)]
        if missing := [f"{prefix}{'xyz'[a]}{t + 1}" for t, a in wanted if (t, a) not in here]:
            what = "standard deviations of every coordinate" if prefix else "coordinates"
            missing_error(table, missing, coordinate_names(max(count, 1), prefix), what)
        for t, axis in wanted:
            columns[here[t, axis]] = Column(kind, t, axis)
    return count, True


def _loose(
    names: Sequence[str], free: Sequence[int], only: str, columns: Sequence[Column]
) -> list[tuple[str, int, int, int]]:
    """(kind, target, axis, column) of names that are relatives of x1 and std_x1; without a number it is 1."""
    cells = []
    for j, name in zip(free, names, strict=True):
        one = coordinate(name)
        if one and one[0] in (only or one[0]) and not columns[j].kind:
            cells.append((one[0], 1 if one[1] is None else one[1], one[2], j))
    return cells


def _with_unit(table: Table, j: int, column: Column, unit: str) -> Column:
    """The column with the unit that stands in its name or below it."""
    if column.kind not in ("joint", "point", "std"):
        return column
    below = table.units[j].strip("[](){}<> ") if table.units else ""
    if below and below not in ("-", "–"):
        written = SPELLINGS.get(below.casefold(), "")
        if not written or (unit and written != unit):
            valid = f"a unit that goes with {unit}" if unit else "a unit of length or angle"
            raise FileFormatError(table.path, f"unit of column {brief(table.columns[j], 40)}", below, valid)
        unit = written
    if unit and column.kind != "joint" and unit in ANGLES:
        raise FileFormatError(table.path, f"column {brief(table.columns[j], 40)}", unit, "a unit of length")
    return Column(column.kind, column.index, column.axis, unit)


def coordinate_names(count: int, prefix: str) -> list[str]:
    """``x1, y1, z1, x2, …`` behind a prefix."""
    return [f"{prefix}{a}{t}" for t in range(1, count + 1) for a in "xyz"]


def require_columns(table: Table, names: Sequence[str], wanted: Sequence[str], what: str) -> None:
    """Refuse a table without all the wanted columns.

    Raises:
        FileFormatError: Names what is missing and what the file has.
    """
    missing = [n for n in wanted if n not in names]
    if missing:
        missing_error(table, missing, wanted, what)


def missing_error(table: Table, missing: Sequence[str], wanted: Sequence[str], what: str) -> None:
    """The refusal of a table in which columns are missing."""
    others = {c.casefold(): c for c in table.columns if c not in set(wanted) and 0 < len(c) <= 100}
    close = get_close_matches(missing[0].casefold(), others, n=1)
    advice = f"is {others[close[0]]!r} meant to be {missing[0]!r}?" if close else "rename or add them"
    got = f"no column {listed(missing)} among {listed(table.columns)}"
    raise FileFormatError(table.path, "header", got, f"{what} {listed(wanted)}", f"{advice}; or state --columns")


# ── by place ─────────────────────────────────────────────────────────────────────────────────────────


def _by_place(table: Table, wanted: _Wanted) -> Meaning:
    """Columns without names: joints first, then x, y, z of each target.

    Columns of texts may stand before these, and one that counts the rows, or, where times play a part, that
    grows.
    """
    count, width = len(wanted.joint_names), len(table.columns)
    first = table.cells(table.rows[0])
    columns: list[Column] = []
    while len(columns) < width and first[len(columns)] and not is_number(first[len(columns)]):
        clock = re.search(r"\d:\d\d|\d{4}-\d\d|\d\.\d\d\.\d{4}", first[len(columns)])
        columns.append(Column("time" if clock else "name") if wanted.keys else Column())
    rest = width - len(columns) - count
    if rest > 0 and rest % 3 == 1:
        if _counts_rows(table, len(columns)):
            columns.append(Column("name") if wanted.keys else Column())
        elif wanted.keys and _grows(table, len(columns)):
            columns.append(Column("time"))
    skip = len(columns)
    rest = width - skip - count
    good = rest >= 3 and rest % 3 == 0 if wanted.points else rest >= 0 and rest % 3 == 0
    if not good:
        example = " ".join([*wanted.joint_names, *(("x1", "y1", "z1") if wanted.points else ())])
        got = f"no header, and {counted(width, 'column')} for {example}"
        option = "--columns" if wanted.joints else "--point-columns"
        raise FileFormatError(table.path, "header", got, "column names", f'state {option} "{example}"')
    columns += [_with_unit(table, skip + j, Column("joint", j), "") for j in range(count)]
    for k in range(rest):
        column = Column("point", k // 3, k % 3) if wanted.points else Column()
        columns.append(_with_unit(table, skip + count + k, column, ""))
    targets = rest // 3 if wanted.points else 0
    return Meaning(tuple(columns), tuple(range(skip, skip + count)), targets, False, (), by_place=True)


def _grows(table: Table, column: int) -> bool:
    """Whether the numbers of a column grow from row to row, as times do."""
    cells = [c.replace(",", ".") for c in table.texts(column)]
    if not all(map(is_number, cells)):
        return False
    values = [float(c) for c in cells]
    return all(a < b for a, b in pairwise(values))


def _counts_rows(table: Table, column: int) -> bool:
    """Whether a column counts the rows, from any number."""
    cells = table.texts(column)
    if not all(c.isascii() and c.isdecimal() and len(c) < 10 for c in cells):
        return False
    first = int(cells[0])
    return [int(c) for c in cells] == list(range(first, first + len(cells)))
