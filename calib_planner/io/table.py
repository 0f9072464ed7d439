# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A table out of raw lines: where its header and its rows are, what separates the cells, and which decimal mark.

*Separator.* A semicolon, tab or bar that stands equally often in the lines of numbers is one. Else it is a
comma or white space, whichever leaves more cells that are numbers. Excel's first line ``sep=;`` says it, and so
may the user.

*Decimal mark.* Commas, if cells such as ``1,5`` are there and none such as ``1.5``. Both in one file are refused.

*Header.* The rows of numbers begin at the first line that has as many cells as most lines have, most of them
numbers. Of the lines above, the one with the most names that belong to measurements is the header; a line of
units may follow it, and lines above are titles. Without such a line the table has no header. Comments may hold
a header too, as NumPy writes it. From the first row on, nothing is skipped but blank lines and comments: every
other line is a row or an error.

Lines stay text until their numbers are read, a block at a time: a million rows take seconds and a few times the
file's size.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.errors import FileFormatError, InputError
from calib_planner.io.formats import raw_lines
from calib_planner.io.text import RawLines
from calib_planner.units import SPELLINGS, brief, counted, listed

MAX_ROWS = 1_000_000
MAX_COLUMNS = 10_000
BLOCK = 10_000
"""Rows turned into numbers at a time."""
SAMPLE = 200
"""Lines that separator and decimal mark are told from, spread over the file."""
WHITE = " "
"""The separator that stands for any run of blanks and tabs."""
SEPARATORS = {
    ",": "comma",
    ";": "semicolon",
    "\t": "tab",
    "|": "bar",
    WHITE: "white space",
}
"""Separator → its name for people and options."""
COMMENTS = ("#", "%", "//", "!")
PLAIN = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
UNIT_APART = re.compile(r"\s+([\[(][^\])]*[\])])")
MOST, SOME = 0.8, 0.3
"""A mark separates the cells if it stands equally often in this share of the lines, and this share are numbers:
a few titles above and columns of names beside the numbers do no harm."""
SEP_LINE = re.compile(r"sep=(.)\s*", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class Table:
    """What a file says, cell by cell, before anybody knows what its columns mean.

    Attributes:
        path: The file.
        kind: What kind of file it is.
        columns: Names in the header, in its order; empty texts without a header.
        header: Whether there is one.
        units: The line of units below the header, a text per column; empty without.
        rows: Text of each row that holds something.
        lines: Number of each row in the file, for errors.
        word: What these numbers count: ``line`` or ``row``.
        separator: What separates the cells; ``WHITE`` for any white space.
        decimal: The decimal mark, ``.`` or ``,``.
        titles: Number of lines above the header that were skipped.
        said: Units that the file states apart from its columns, as ``Units.parse`` takes them.
    """

    path: str
    kind: str
    columns: tuple[str, ...]
    header: bool
    units: tuple[str, ...]
    rows: Sequence[str] = field(repr=False)
    lines: IntArray = field(repr=False)
    word: str
    separator: str
    decimal: str = "."
    titles: int = 0
    said: str = ""

    def __len__(self) -> int:
        return len(self.rows)

    def numbers(self, columns: Sequence[int], names: Sequence[str], *, empty: bool = False) -> FloatArray:
        """(rows, columns) these columns as numbers; an empty cell is NaN where ``empty`` allows it.

        Args:
            columns: Numbers of the columns, from 0.
            names: What errors call them.
            empty: Whether cells may be empty.

        Raises:
            FileFormatError: A cell that is no finite number; names line and column.
        """
        at = list(columns)
        out = np.empty((len(self), len(at)))
        for start in range(0, len(self), BLOCK):
            block = self.rows[start : start + BLOCK]
            try:
                out[start : start + len(block)] = self._plain_numbers(block, at)
            except (ValueError, IndexError):  # an empty cell, or one to complain about
                out[start : start + len(block)] = self._careful_numbers(start, block, names, at, empty)
        return out

    def texts(self, column: int) -> list[str]:
        """The cells of a column as they stand."""
        return [self.cells(row)[column] for row in self.rows]

    def cells(self, text: str) -> list[str]:
        """The cells of one row, as many as there are columns."""
        cells = split(text, self.separator)[: len(self.columns)]
        return cells + [""] * (len(self.columns) - len(cells))

    def error(self, row: int, column: str, got: str, expected: str, advice: str = "") -> FileFormatError:
        """An error that names line and column."""
        where = f"{self.word} {self.lines[row]}, column {column}"
        return FileFormatError(self.path, where, got, expected, advice)

    def _plain_numbers(self, block: Sequence[str], at: list[int]) -> FloatArray:
        """(rows, columns) of a block in which all is as it should be.

        Raises:
            ValueError: It is not: look closely.
        """
        if any('"' in s or "_" in s or not s.isascii() for s in block):
            raise ValueError("quotes, underscores or other letters")
        if self.decimal == ",":
            block = [s.replace(",", ".") for s in block]
        mark = None if self.separator == WHITE else self.separator
        rows: Iterable[list[str]] = (s.split(mark) for s in block)
        cells = chain.from_iterable([row[j] for j in at] for row in rows)
        values = np.fromiter(map(float, cells), float, len(block) * len(at)).reshape(len(block), len(at))
        if not np.isfinite(values).all():
            raise ValueError("not finite")
        return values

    def _careful_numbers(
        self, start: int, block: Sequence[str], names: Sequence[str], at: list[int], empty: bool
    ) -> list[list[float]]:
        rows = enumerate(map(self.cells, block), start)
        return [
            [self._number(i, n, cells[j], empty) for n, j in zip(names, at, strict=True)] for i, cells in rows
        ]

    def _number(self, row: int, column: str, cell: str, empty: bool) -> float:
        if not cell:
            if empty:
                return math.nan
            raise self.error(row, column, "an empty cell", "a number", "remove the row or fill it")
        plain = cell
        if self.decimal == ",":
            plain = "" if "." in cell else cell.replace(",", ".")
        try:
            value = float(plain) if plain.isascii() and "_" not in plain else math.nan
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            hint = "leave the cell empty where nothing was measured" if empty else ""
            if "," in cell or (self.decimal == "," and "." in cell):
                other = "comma" if self.decimal == "," else "point"
                hint = f"use a decimal {other} in every number, and no mark between thousands"
            raise self.error(row, column, brief(cell, 40), "a finite number", hint)
        return value


def split(text: str, separator: str) -> list[str]:
    """Stripped cells of one line; quotes as in CSV.

    Raises:
        csv.Error: A quote that does not enclose a whole cell.
    """
    if separator == WHITE:
        if '"' in text:
            text = re.sub(r"\s+", " ", text.strip())
            return [c.strip() for c in next(csv.reader([text], delimiter=" ", strict=True))]
        return text.split()
    cells = next(csv.reader([text], delimiter=separator, strict=True)) if '"' in text else text.split(separator)
    return [c.strip() for c in cells]


def separator_named(text: str) -> str:
    """What ``--separator`` says: the character, or its name.

    Raises:
        InputError: It is none.
    """
    names = {name: mark for mark, name in SEPARATORS.items()} | {"space": WHITE, "\\t": "\t", "semicolon": ";"}
    mark = names.get(text.strip().casefold(), text)
    if mark not in SEPARATORS:
        raise InputError("--separator", repr(text), f"one of: {', '.join(SEPARATORS.values())}")
    return mark


def read_table(
    path: str | Path,
    what: str,
    knows: Callable[[str], bool],
    *,
    separator: str = "",
    columns: Sequence[str] = (),
) -> Table:
    """Read the table in a file.

    Args:
        path: The file.
        what: What it should be, for errors.
        knows: Whether a text is the name of a column that measurements have.
        separator: What separates the cells; empty: to be told from the file.
        columns: Names that replace those of the file; empty: the file's own.

    Raises:
        FileFormatError: Not readable, no rows, names twice, ragged or too many rows or columns.
    """
    return table_of(raw_lines(path, what), what, knows, separator=separator, columns=columns)


def table_of(
    raw: RawLines,
    what: str,
    knows: Callable[[str], bool],
    *,
    separator: str = "",
    columns: Sequence[str] = (),
) -> Table:
    """As ``read_table``, from lines that have been read."""
    return _Sniffer(raw, what, knows, separator, columns).table()


class _Sniffer:
    """Takes raw lines apart."""

    def __init__(
        self, raw: RawLines, what: str, knows: Callable[[str], bool], separator: str, columns: Sequence[str]
    ) -> None:
        self.raw, self.what, self.knows, self.stated = raw, what, knows, tuple(columns)
        self.path = raw.path
        filled = [(i, s) for i, s in enumerate(raw.texts, raw.first) if s and not s.isspace()]
        if filled and (said := SEP_LINE.fullmatch(filled[0][1].strip())):
            separator, filled = separator or said[1], filled[1:]
            if separator not in SEPARATORS:
                valid = f"one of {', '.join(SEPARATORS.values())}"
                raise FileFormatError(self.path, "first line", f"sep={separator}", valid)
        self.remarks = [(i, s) for i, s in filled if s.lstrip().startswith(COMMENTS)]
        self.lines = [(i, s) for i, s in filled if not s.lstrip().startswith(COMMENTS)]
        if not self.lines:
            got = "comments only" if self.remarks else "an empty file"
            raise FileFormatError(self.path, "header", got, "a first line with column names")
        if len(self.lines) > MAX_ROWS + 1:
            raise FileFormatError(self.path, "rows", len(self.lines) - 1, f"at most {MAX_ROWS}", "split the file")
        step = max(1, len(self.lines) // SAMPLE)
        self.sample = [s for _, s in self.lines[::step]]
        self.separator = raw.separator or separator or self._separator()

    def table(self) -> Table:
        """What they hold."""
        begin, width = self._first_row()
        header, units, titles = self._above(begin, width)
        if self.stated:
            self._check_stated(begin, width)
            names, has_header = list(self.stated), False
        elif header is None:
            ended = self.separator != WHITE and all(
                s.rstrip(" ").endswith(self.separator) for s in self.sample[-2:]
            )
            names, has_header = [""] * (width - ended), False  # a separator behind the last cell ends it
        else:
            names, has_header = self._names(*header, width), True
        if len(names) > MAX_COLUMNS:
            got = f"{len(names)} columns"
            raise FileFormatError(self.path, "header", got, f"at most {MAX_COLUMNS}", "leave some out")
        doubled = sorted(n for n, count in Counter(names).items() if count > 1 and n not in ("", "-"))
        if doubled:
            raise FileFormatError(self.path, "header", f"{listed(doubled)} twice", "each column name once")
        if self.separator == WHITE and units:
            units = self._below_names(units, names, self.lines[begin - 1][0])
        rows, numbers = self._body(begin, len(names))
        return Table(
            path=self.path,
            kind=self.raw.kind,
            columns=tuple(names),
            header=has_header,
            units=(*units, *[""] * (len(names) - len(units)))[: len(names)] if units else (),
            rows=rows,
            lines=np.array(numbers, np.int64),
            word=self.raw.word,
            separator=self.separator,
            decimal=self._decimal(rows),
            titles=titles,
            said=",".join(dict.fromkeys(u for u in self.raw.units.values() if u.casefold() in SPELLINGS)),
        )

    # ── separator and decimal mark ───────────────────────────────────────────────────────────────────────

    def _separator(self) -> str:
        lines = self.sample[1:] if len(self.sample) > 1 else self.sample
        for mark in ";\t|":
            count, often = Counter(s.count(mark) for s in lines).most_common(1)[0]
            if count and often >= MOST * len(lines) and _share(lines, mark) >= SOME:
                return mark
        # What is left of rounding must not decide between a comma and white space that are equally good.
        best = max(",;\t| ", key=lambda m: (round(_share(lines, m), 9), max(len(loosely(s, m)) for s in lines)))
        return best if _share(lines, best) > 0 else max(",;\t| ", key=self.sample[0].count)

    def _decimal(self, rows: Sequence[str]) -> str:
        for some in (rows[:: max(1, len(rows) // SAMPLE)], rows):
            cells = [c for s in some if "," in s for c in loosely(s, self.separator)]
            commas = any(COMMA.fullmatch(c) for c in cells)
            if any("." in c and PLAIN.fullmatch(c) for s in some for c in loosely(s, self.separator)):
                return "."
            if commas:
                return ","
            if self.separator == "," or not any("," in s for s in rows):
                return "."
        return "."

    # ── where the rows begin, and what stands above them ─────────────────────────────────────────────────

    def _first_row(self) -> tuple[int, int]:
        """Index of the line in which the rows begin, and the number of cells that most rows have."""
        sampled = [loosely(s, self.separator) for s in self.sample]
        rows = [cells for cells in sampled if _mostly_numbers(cells)] or sampled
        width = Counter(map(len, rows)).most_common(1)[0][0]
        for i, (_, text) in enumerate(self.lines[:SAMPLE]):
            cells = loosely(text, self.separator)
            if abs(len(cells) - width) <= 1 and _mostly_numbers(cells):
                return i, width
        known = [i for i, (_, s) in enumerate(self.lines[:SAMPLE]) if self._known(loosely(s, self.separator))]
        begin = known[0] + 1 if known else 1
        if begin >= len(self.lines):
            raise FileFormatError(self.path, "rows", "a header only", "at least one row of numbers")
        return begin, width

    def _above(self, begin: int, width: int) -> tuple[tuple[int, str] | None, tuple[str, ...], int]:
        """Number and text of the header above the rows, or ``None``; the units; the number of titles."""
        above = self.lines[:begin]
        units: tuple[str, ...] = ()
        if above and _are_units(loosely(above[-1][1], self.separator)):
            units = tuple(loosely(above.pop()[1], self.separator))
        known = [self._known(loosely(s, self.separator)) for _, s in above]
        most = max(known, default=0)
        if self.stated:
            return None, units, 0
        if most:
            at = max(i for i, k in enumerate(known) if k == most)
        else:
            remark = self._in_comments(begin, width)
            if remark is not None:
                return remark, units, len(above)
            if not above or not self._may_be_names(above[-1][1], width):
                return None, units, len(above)
            at = len(above) - 1
        if at + 1 < len(above):
            number, text = above[at + 1]
            where, valid = f"{self.raw.word} {number}", "a row of numbers, or of units below the header"
            raise FileFormatError(self.path, where, brief(text, 40), valid, "remove the line")
        return above[at], units, at

    def _below_names(self, units: tuple[str, ...], names: list[str], number: int) -> tuple[str, ...]:
        """Units, one for each name: between white space nobody sees which column has none."""
        if not names[0] and len(units) == len(names) - 1:
            return ("", *units)
        if len(units) != len(names):
            got, valid = (
                f"{counted(len(units), 'unit')} for {counted(len(names), 'column')}",
                "one for each column",
            )
            advice = "write - where there is none, or use another separator"
            raise FileFormatError(self.path, f"{self.raw.word} {number}", got, valid, advice)
        return units

    def _may_be_names(self, text: str, width: int) -> bool:
        """Whether a line without any known name may be a header rather than a title."""
        cells = loosely(text, self.separator)
        return len(cells) == width and 2 * sum(map(bool, cells)) > width

    def _in_comments(self, begin: int, width: int) -> tuple[int, str] | None:
        """The last comment above the rows that holds the names of as many columns."""
        row = self.lines[begin][0]
        for number, text in reversed([r for r in self.remarks if r[0] < row]):
            plain = text.strip().lstrip("#%!/").strip()
            cells = loosely(plain, self.separator)
            if len(cells) == width and self._known(cells) > 1:
                return number, plain
        return None

    def _known(self, cells: Sequence[str]) -> int:
        return sum(map(self.knows, cells[:MAX_COLUMNS]))

    def _names(self, number: int, text: str, width: int) -> list[str]:
        names = self._cells_or_error(number, text, names=True)
        while names and not names[-1]:
            names.pop()
        if self.separator == WHITE and len(names) == width - 1:  # R writes numbers of rows without a heading
            names.insert(0, "")
        return names

    def _check_stated(self, begin: int, width: int) -> None:
        cells = self._cells_or_error(*self.lines[begin])
        while len(cells) > len(self.stated) and not cells[-1]:
            cells.pop()
        if len(self.stated) != len(cells):
            wanted = f"{len(cells)} names, for cells like {listed(cells, 12, width=20)}"
            advice = "write '-' for a column that plays no part"
            raise FileFormatError(self.path, "--columns", counted(len(self.stated), "name"), wanted, advice)

    # ── rows ─────────────────────────────────────────────────────────────────────────────────────────────

    def _body(self, begin: int, width: int) -> tuple[list[str], list[int]]:
        """Texts and numbers of the rows, each with a cell per column."""
        mark, rows, numbers = self.separator, [], []
        nothing = mark + ' "\t'
        for number, text in self.lines[begin:]:
            if mark == WHITE or '"' in text:
                count = len(self._cells_or_error(number, text))
            else:
                count = text.count(mark) + 1
            if count != width and not self._padded(text, count, width):
                if not text.strip(nothing):
                    continue
                advice = "name all columns" if count > width else ""
                if count > width and mark == ",":
                    advice = "use decimal points, or semicolons between cells"
                elif count < width and mark == WHITE:
                    advice = "an empty cell needs another separator than white space"
                wanted = f"{width} cells, one per column"
                raise FileFormatError(self.path, f"{self.raw.word} {number}", f"{count} cells", wanted, advice)
            if text.strip(nothing):
                rows.append(text)
                numbers.append(number)
        if not rows:
            raise FileFormatError(self.path, "rows", "a header only", "at least one row of numbers")
        return rows, numbers

    def _padded(self, text: str, count: int, width: int) -> bool:
        """Whether a row is of the right length but for empty cells at its end, which a spreadsheet may drop or
        add."""
        if count < width:
            return bool(self.raw.separator)
        return not any(split(text, self.separator)[width:])

    def _cells_or_error(self, number: int, text: str, *, names: bool = False) -> list[str]:
        try:
            return split(_joined(text) if names and self.separator == WHITE else text, self.separator)
        except csv.Error as error:
            advice = "quotes enclose whole cells and end on their line"
            where = f"text of {self.raw.word} {number}"
            raise FileFormatError(self.path, where, error, self.what, advice) from None


def loosely(text: str, mark: str) -> list[str]:
    """Cells of a line that may be anything: as ``split``, without complaint; a unit stays with its name."""
    text = _joined(text) if mark == WHITE else text
    try:
        return split(text, mark)
    except csv.Error:
        return text.split(None if mark == WHITE else mark)


def _joined(text: str) -> str:
    """``x [mm]  y [mm]`` with each unit behind its name, so that white space parts columns only."""
    return UNIT_APART.sub(r"\1", text)


def is_number(cell: str) -> bool:
    """Whether a cell is a number, with either decimal mark."""
    return bool(PLAIN.fullmatch(cell) or COMMA.fullmatch(cell))


def _mostly_numbers(cells: Sequence[str]) -> bool:
    """Whether half of the filled cells at least are numbers."""
    filled = [c for c in cells if c]
    return bool(filled) and 2 * sum(map(is_number, filled)) >= len(filled)


def _share(lines: Sequence[str], mark: str) -> float:
    """Share of the filled cells that are numbers."""
    cells = [c for s in lines for c in loosely(s, mark) if c]
    return sum(map(is_number, cells)) / max(len(cells), 1)


def _are_units(cells: Sequence[str]) -> bool:
    """Whether a line holds units: most of what is filled is one, and nothing is a number."""
    filled = [c.strip("[](){}<> ").casefold() for c in cells if c]
    units = sum(c in SPELLINGS for c in filled)
    return bool(units) and 2 * units > len(filled) and not any(map(is_number, filled))
