"""A CSV file as a table of text cells that know their line, so that every error can name row and column.

Comma, semicolon or tab separate the cells (the header decides); a byte order mark, CRLF, blank lines and
lines that start with ``#`` are tolerated.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.errors import FileFormatError
from calib_planner.files.text import read_text

MAX_ROWS = 1_000_000


@dataclass(frozen=True)
class Table:
    """Cells of a CSV file.

    Attributes:
        path: The file.
        columns: Names in the header, in its order.
        cells: One tuple per row, in the order of ``columns``.
        lines: Line number of each row in the file, for errors.
    """

    path: str
    columns: tuple[str, ...]
    cells: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]

    def numbers(self, names: Sequence[str], *, empty: bool = False) -> FloatArray:
        """(rows, names) the named columns as numbers; an empty cell is NaN where ``empty`` allows it."""
        at = [self.columns.index(n) for n in names]
        out = np.empty((len(self.cells), len(at)))
        for i, row in enumerate(self.cells):
            for k, j in enumerate(at):
                out[i, k] = self._number(i, names[k], row[j], empty)
        return out

    def error(self, row: int, column: str, got: str, expected: str, advice: str = "") -> FileFormatError:
        """An error that names line and column."""
        where = f"line {self.lines[row]}, column {column}"
        return FileFormatError(self.path, where, got, expected, advice)

    def _number(self, row: int, column: str, cell: str, empty: bool) -> float:
        if not cell:
            if empty:
                return math.nan
            raise self.error(row, column, "an empty cell", "a number", "remove the row or fill it")
        try:
            value = float(cell) if "_" not in cell else math.nan
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            hint = "leave the cell empty where nothing was measured" if empty else ""
            hint = "use a decimal point" if "," in cell else hint
            raise self.error(row, column, repr(cell[:40]), "a finite number", hint)
        return value


def read_table(path: str | Path, what: str) -> Table:
    """Read a CSV file with a header.

    Raises:
        FileFormatError: Not readable, no header or no rows, names twice, ragged or too many rows.
    """
    rows = _rows(path, what, read_text(path, what))
    if not rows:
        raise FileFormatError(path, "header", "an empty file", "a first line with column names")
    header = rows[0][1]
    doubled = sorted({n for n in header if header.count(n) > 1 and n})
    if doubled:
        raise FileFormatError(path, "header", f"{', '.join(doubled)} twice", "each column name once")
    body = rows[1:]
    if not body:
        raise FileFormatError(path, "rows", "a header only", "at least one row of numbers")
    for line, cells in body:
        if len(cells) != len(header):
            wanted = f"{len(header)} cells, one per column"
            raise FileFormatError(path, f"line {line}", f"{len(cells)} cells", wanted)
    return Table(str(path), header, tuple(c for _, c in body), tuple(n for n, _ in body))


def require_columns(table: Table, names: Sequence[str], what: str) -> None:
    """Refuse a table without all the named columns.

    Raises:
        FileFormatError: Names what is missing and what the file has.
    """
    missing = [n for n in names if n not in table.columns]
    if not missing:
        return
    others = {c.casefold(): c for c in table.columns if c not in names}
    close = get_close_matches(missing[0].casefold(), others, n=1)
    advice = f"is {others[close[0]]!r} meant to be {missing[0]!r}?" if close else "rename or add them"
    raise FileFormatError(
        table.path,
        "header",
        f"no column {', '.join(missing)} among {', '.join(table.columns)}",
        f"{what} {', '.join(names)}",
        advice,
    )


def _rows(path: str | Path, what: str, text: str) -> list[tuple[int, tuple[str, ...]]]:
    """Line number and stripped cells of every row that holds something, the header first."""
    lines = text.splitlines()
    kept = [(i, s) for i, s in enumerate(lines, 1) if s.strip() and not s.lstrip().startswith("#")]
    if len(kept) > MAX_ROWS + 1:
        raise FileFormatError(path, "rows", len(kept) - 1, f"at most {MAX_ROWS}", "split the file")
    mark = next((m for m in ",;\t" if kept and m in kept[0][1]), ",")
    try:
        cells = [next(csv.reader([s], delimiter=mark, strict=True)) for _, s in kept]
    except csv.Error as error:
        raise FileFormatError(path, "text", error, what) from None
    found = [(i, tuple(c.strip() for c in row)) for (i, _), row in zip(kept, cells, strict=True)]
    return [(i, row) for i, row in found if any(row)]


def format_table(columns: Sequence[str], rows: Sequence[Sequence[float]]) -> str:
    """CSV text, exact to the bit; NaN becomes an empty cell and whole numbers given as int stay so."""
    lines = [",".join(columns)]
    lines += [",".join("" if math.isnan(v) else repr(v) for v in row) for row in rows]
    return "\n".join(lines) + "\n"
