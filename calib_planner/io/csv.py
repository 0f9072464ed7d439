"""Tables of joint configurations and of measurements as CSV files.

*A table* is text that knows its lines, so that every error can name row and column. Comma, semicolon or tab
separate the cells (the header decides); a byte order mark, CRLF, blank lines and lines that start with ``#``
are tolerated. Lines stay text until their numbers are read, a block at a time: a million rows take seconds
and a few times the file's size.

*Configurations* (candidates, test paths, plans to be measured) have a column per joint, in any order. A column
``repetitions`` says how often each is to be measured; other columns are ignored.

*Measurements* have the joint columns, ``x1,y1,z1[,x2…]`` and optionally ``std_x1,…``: a row per configuration,
[rad | m] and [m] in the tracker's frame. Empty cells: the target was not measured. Other columns are ignored,
unless their name is nearly one of these.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, IntArray, check_configurations
from calib_planner.errors import FileFormatError
from calib_planner.io.text import read_text, write_text
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot
from calib_planner.units import brief, listed

MAX_ROWS = 1_000_000
MAX_COLUMNS = 10_000
BLOCK = 10_000
"""Rows turned into numbers at a time."""
LINE_END = re.compile(r"\r\n|\r|\n")
CONFIGURATIONS = "a CSV of joint configurations"
MEASUREMENTS = "a CSV of measurements"
REPETITIONS = "repetitions"
PAYLOAD = "payload"
"""Column of the mass that the robot carried [kg]."""
COORDINATE = re.compile(r"(std_)?([xyz])([1-9][0-9]{0,3})")
NEARLY = re.compile(r"(std|sigma)?[_ ]*[xyz][_ ]*[0-9]*", re.IGNORECASE)

# ── tables ───────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class Table:
    """The rows of a CSV file.

    Attributes:
        path: The file.
        columns: Names in the header, in its order.
        rows: Text of each row that holds something.
        lines: Line number of each row in the file, for errors.
        mark: What separates the cells.
    """

    path: str
    columns: tuple[str, ...]
    rows: Sequence[str] = field(repr=False)
    lines: IntArray = field(repr=False)
    mark: str

    def __len__(self) -> int:
        return len(self.rows)

    def numbers(self, names: Sequence[str], *, empty: bool = False) -> FloatArray:
        """(rows, names) the named columns as numbers; an empty cell is NaN where ``empty`` allows it."""
        index = {name: j for j, name in enumerate(self.columns)}
        at = [index[n] for n in names]
        out = np.empty((len(self), len(at)))
        for start in range(0, len(self), BLOCK):
            block = self.rows[start : start + BLOCK]
            try:
                out[start : start + len(block)] = _plain_numbers(block, self.mark, at)
            except ValueError:  # an empty cell, or one to complain about
                out[start : start + len(block)] = self._careful_numbers(start, block, names, at, empty)
        return out

    def error(self, row: int, column: str, got: str, expected: str, advice: str = "") -> FileFormatError:
        """An error that names line and column."""
        where = f"line {self.lines[row]}, column {column}"
        return FileFormatError(self.path, where, got, expected, advice)

    def _careful_numbers(
        self, start: int, block: Sequence[str], names: Sequence[str], at: list[int], empty: bool
    ) -> list[list[float]]:
        rows = enumerate((_cells(s, self.mark) for s in block), start)
        return [
            [self._number(i, n, cells[j], empty) for n, j in zip(names, at, strict=True)] for i, cells in rows
        ]

    def _number(self, row: int, column: str, cell: str, empty: bool) -> float:
        if not cell:
            if empty:
                return math.nan
            raise self.error(row, column, "an empty cell", "a number", "remove the row or fill it")
        try:
            value = float(cell) if cell.isascii() and "_" not in cell else math.nan
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            hint = "leave the cell empty where nothing was measured" if empty else ""
            hint = "use a decimal point" if "," in cell else hint
            raise self.error(row, column, brief(cell, 40), "a finite number", hint)
        return value


def read_table(path: str | Path, what: str) -> Table:
    """Read a CSV file with a header.

    Raises:
        FileFormatError: Not readable, no header or no rows, names twice, ragged or too many rows or columns.
    """
    lines, rows = _filled_lines(path, read_text(path, what))
    if not rows:
        raise FileFormatError(path, "header", "an empty file", "a first line with column names")
    mark = max(",;\t", key=rows[0].count)
    header = _cells_or_error(path, lines[0], rows[0], mark, what)
    if len(header) > MAX_COLUMNS:
        got = f"{len(header)} columns"
        raise FileFormatError(path, "header", got, f"at most {MAX_COLUMNS}", "leave some out")
    doubled = sorted(n for n, count in Counter(header).items() if count > 1 and n)
    if doubled:
        raise FileFormatError(path, "header", f"{listed(doubled)} twice", "each column name once")
    body, numbers = [], []
    for line, text in zip(lines[1:], rows[1:], strict=True):
        count = len(_cells_or_error(path, line, text, mark, what)) if '"' in text else text.count(mark) + 1
        if count != len(header):
            if not text.strip(mark + " \t"):
                continue
            advice = "use decimal points, or semicolons between cells" if count > len(header) else ""
            wanted = f"{len(header)} cells, one per column"
            raise FileFormatError(path, f"line {line}", f"{count} cells", wanted, advice)
        if text.strip(mark + ' "\t'):
            body.append(text)
            numbers.append(line)
    if not body:
        raise FileFormatError(path, "rows", "a header only", "at least one row of numbers")
    return Table(str(path), tuple(header), body, np.array(numbers, np.int64), mark)


def require_columns(table: Table, names: Sequence[str], what: str) -> None:
    """Refuse a table without all the named columns.

    Raises:
        FileFormatError: Names what is missing and what the file has.
    """
    present, wanted = set(table.columns), set(names)
    missing = [n for n in names if n not in present]
    if not missing:
        return
    others = {c.casefold(): c for c in table.columns if c not in wanted and len(c) <= 100}
    close = get_close_matches(missing[0].casefold(), others, n=1)
    advice = f"is {others[close[0]]!r} meant to be {missing[0]!r}?" if close else "rename or add them"
    got = f"no column {listed(missing)} among {listed(table.columns)}"
    raise FileFormatError(table.path, "header", got, f"{what} {listed(names)}", advice)


def format_table(columns: Sequence[str], rows: Sequence[Sequence[float]]) -> str:
    """CSV text, exact to the bit; NaN becomes an empty cell and whole numbers given as int stay so."""
    lines = [",".join(columns)]
    lines += [",".join("" if math.isnan(v) else repr(v) for v in row) for row in rows]
    return "\n".join(lines) + "\n"


def _filled_lines(path: str | Path, text: str) -> tuple[list[int], list[str]]:
    """Numbers and texts of the lines that are neither blank nor comments, the header first."""
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise FileFormatError(path, f"line {line}", "a NUL character", "text", "save it as UTF-8, not UTF-16")
    lines = text.split("\n") if "\r" not in text else LINE_END.split(text)
    filled = [(i, s) for i, s in enumerate(lines, 1) if s and not s.isspace() and s.lstrip()[0] != "#"]
    if len(filled) > MAX_ROWS + 1:
        raise FileFormatError(path, "rows", len(filled) - 1, f"at most {MAX_ROWS}", "split the file")
    return [i for i, _ in filled], [s for _, s in filled]


def _cells(text: str, mark: str) -> list[str]:
    """Stripped cells of one line; quotes as in CSV."""
    cells = next(csv.reader([text], delimiter=mark, strict=True)) if '"' in text else text.split(mark)
    return [c.strip() for c in cells]


def _cells_or_error(path: str | Path, line: int, text: str, mark: str, what: str) -> list[str]:
    try:
        return _cells(text, mark)
    except csv.Error as error:
        advice = "quotes enclose whole cells and end on their line"
        raise FileFormatError(path, f"text of line {line}", error, what, advice) from None


def _plain_numbers(block: Sequence[str], mark: str, at: list[int]) -> FloatArray:
    """(rows, names) of a block in which all is as it should be.

    Raises:
        ValueError: It is not: look closely.
    """
    if any('"' in s or "_" in s or not s.isascii() for s in block):
        raise ValueError("quotes, underscores or other letters")
    rows: Iterable[list[str]] = (s.split(mark) for s in block)
    cells = chain.from_iterable([row[j] for j in at] for row in rows)
    values = np.fromiter(map(float, cells), float, len(block) * len(at)).reshape(len(block), len(at))
    if not np.isfinite(values).all():
        raise ValueError("not finite")
    return values


# ── configurations ───────────────────────────────────────────────────────────────────────────────────


def read_configurations(path: str | Path, robot: Robot, *, degrees: bool = False) -> FloatArray:
    """(N, joints) in the robot's joint order [rad | m].

    Args:
        path: The file.
        robot: Gives the names of the joint columns and which of them are angles.
        degrees: The angles in the file are degrees.

    Raises:
        FileFormatError: Names line and column at fault, what stands there and what is valid.
    """
    return joint_columns(read_table(path, CONFIGURATIONS), robot, degrees=degrees)


def read_plan_csv(path: str | Path, robot: Robot, *, degrees: bool = False) -> tuple[FloatArray, IntArray]:
    """Configurations as ``read_configurations`` and the repetitions of each, 1 where not told."""
    table = read_table(path, CONFIGURATIONS)
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


# ── measurements ─────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class MeasurementFile:
    """What a file of measurements holds.

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
    table = read_table(path, MEASUREMENTS)
    q = joint_columns(table, robot, degrees=degrees)
    others = [c for c in table.columns if c not in robot.joint_names]
    count = _target_count(table, others)
    points = _coordinates(table, count, "")
    std = _deviations(table, others, points)
    payload = _payload(table, robot)
    known = {*robot.joint_names, *_names(count, ""), *_names(count, "std_"), PAYLOAD}
    ignored = tuple(c for c in table.columns if c not in known)
    for name in ignored:
        if NEARLY.fullmatch(name):
            valid = f"{listed(_names(count, ''))} and std_ of each"
            raise FileFormatError(path, f"column {brief(name, 40)}", "an unknown name", valid, "rename it")
    return MeasurementFile(Measurements(robot.joint_names, q, points, std, payload), ignored, table.lines)


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
    if data.payload is not None and PAYLOAD not in data.joint_names:
        blocks.append(np.asarray(data.payload)[:, None])
        columns.append(PAYLOAD)
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


def _payload(table: Table, robot: Robot) -> FloatArray | None:
    """(rows,) masses [kg], or ``None`` if the file has none."""
    if PAYLOAD not in table.columns or PAYLOAD in robot.joint_names:
        return None
    masses = table.numbers([PAYLOAD])[:, 0]
    for i in np.flatnonzero(masses < 0.0):
        raise table.error(int(i), PAYLOAD, f"{masses[i]:g}", "a mass of 0 kg or more")
    return masses
