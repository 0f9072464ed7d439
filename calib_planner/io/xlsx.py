# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Spreadsheets (XLSX) as raw lines: the values that the cells show, with a tab between them."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from calib_planner.errors import FileFormatError, MissingExtraError
from calib_planner.io.text import RawLines

MOST_ROWS = 1 << 20
"""Rows of a sheet that Excel and LibreOffice have."""
MOST_VALUES = 20_000_000
"""Cells, as many as ``named_arrays`` takes numbers."""


def read_xlsx(path: str | Path, data: bytes, what: str) -> RawLines:
    """The sheet with the most numbers; of formulas the values that were saved with them.

    Raises:
        MissingExtraError: openpyxl is not installed.
        FileFormatError: Not a spreadsheet, no numbers in it, or two sheets with as many.
    """
    try:
        from openpyxl import load_workbook
    except ImportError:
        raise MissingExtraError("files", "openpyxl", "reading XLSX files") from None
    try:
        book = load_workbook(io.BytesIO(data), read_only=True, data_only=True)
        sheets = {s.title: _rows(s.iter_rows(values_only=True)) for s in book.worksheets}
    except Exception as error:  # openpyxl lets through what zipfile and its XML parser raise
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        advice = "open it in a spreadsheet program and save it again"
        raise FileFormatError(path, "file", reason, what, advice) from None
    counts = {name: sum(_is_number(v) for row in rows for v in row) for name, rows in sheets.items()}
    best = max(counts, key=lambda name: counts[name], default="")
    if not best or not counts[best]:
        raise FileFormatError(path, "sheets", ", ".join(sheets) or "none", "a sheet with numbers", "fill one")
    alike = [name for name in counts if counts[name] == counts[best]]
    if len(alike) > 1:
        advice = "delete the others, or save one as CSV"
        raise FileFormatError(path, "sheets", ", ".join(alike) + " alike", "one sheet with the table", advice)
    sheet = f"sheet {best!r}" if len(sheets) > 1 else "one sheet"
    texts = ["\t".join(map(_text, row)).rstrip("\t") for row in sheets[best]]
    return RawLines(str(path), f"XLSX, {sheet}", texts, "row", "\t")


def _rows(read: Iterable[Sequence[Any]]) -> list[list[Any]]:
    """The rows of a sheet. Rows that are not in the file are empty: a number of a row may make endlessly many.

    Raises:
        ValueError: More than a spreadsheet program makes.
    """
    rows, cells = [], 0
    for row in read:
        rows.append(list(row))
        cells += len(row)
        if len(rows) > MOST_ROWS or cells > MOST_VALUES:
            raise ValueError(f"more than {MOST_ROWS} rows or {MOST_VALUES} cells")
    return rows


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _text(value: Any) -> str:
    """A cell as text without tabs or line ends; numbers exact to the bit."""
    if value is None:
        return ""
    return repr(value) if _is_number(value) else " ".join(str(value).split())
