"""HTML pieces of the page: tables, lists, pictures inside the page. Text is escaped here and nowhere else."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np


@dataclass(frozen=True)
class Cell:
    """A cell that is more than text.

    Attributes:
        text: What it says.
        kind: Class: ``wrong`` for a printed value that contradicts the paper itself, ``words`` for prose.
    """

    text: str
    kind: str


@dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
        cells: Text, left to right.
        ours: Whether the numbers were computed here; such rows stand out.
    """

    cells: Sequence[str | Cell]
    ours: bool = False


def table(caption: str, header: Sequence[str], rows: Iterable[Row]) -> str:
    """A table that scrolls by itself on a narrow screen."""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "\n".join(_row(row) for row in rows)
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return (
        f'<div class="scroll"><table>{title}<thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>'
    )


def _row(row: Row) -> str:
    kind = ' class="ours"' if row.ours else ""
    return f"<tr{kind}>{''.join(_cell(c) for c in row.cells)}</tr>"


def _cell(cell: str | Cell) -> str:
    if isinstance(cell, str):
        return f"<td>{escape(cell)}</td>"
    return f'<td class="{cell.kind}">{escape(cell.text)}</td>'


def listed(items: Iterable[str]) -> str:
    """Bullets."""
    return f"<ul>{''.join(f'<li>{escape(i)}</li>' for i in items)}</ul>"


def picture(wide: bytes, narrow: bytes, described: str) -> str:
    """SVG images inside the page: one for wide screens and paper, one for phones; the text describes both."""
    sources = [f"data:image/svg+xml;base64,{b64encode(image).decode()}" for image in (narrow, wide)]
    text = escape(described)
    return (
        f'<figure><picture><source media="screen and (max-width: 620px)" srcset="{sources[0]}">'
        f'<img src="{sources[1]}" alt="{text}"></picture><figcaption>{text}</figcaption></figure>'
    )


def micrometres(metres: float) -> str:
    """A length in µm as ``number`` writes it, without the unit."""
    return number(1e6 * metres)


def number(value: float) -> str:
    """Three significant digits, all digits from 1000 on, powers of ten from a hundred thousand on."""
    if not np.isfinite(value):
        return "∞"
    if value < 999.5:
        return f"{value:#.3g}".rstrip(".")
    if value < 99_999.5:
        return f"{value:.0f}"
    digits, exponent = f"{value:.2e}".split("e")
    superscript = str(int(exponent)).translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{float(digits):g}·10{superscript}"
