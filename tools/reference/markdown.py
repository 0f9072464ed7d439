# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Text as Markdown that GitHub and MyST read alike."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

MADE = "<!-- Made by tools/reference from the code; do not edit. -->"


def escaped(text: str) -> str:
    """Plain text: nothing in it is markup."""
    return re.sub(r"([\\*|<~`])", r"\\\1", text)


def code(text: str) -> str:
    """A word of the machine's."""
    return f"`{text}`" if text else ""


def table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> list[str]:
    """Lines of a table; cells are Markdown already. Without rows no lines.

    On narrow screens its rows become paragraphs (``docs/_static/phone.css``); ``kind`` chooses their labels.
    """
    lines = [f"| {' | '.join(row)} |" for row in rows]
    if not lines:
        return []
    opened = f'<div class="{" ".join(["stacked", *kind.split()])}">'
    return [opened, "", f"| {' | '.join(head)} |", "|" + "---|" * len(head), *lines, "", "</div>", ""]


def joined(lines: Iterable[str]) -> str:
    """A page of lines: one empty line between paragraphs, one line end at its end."""
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).strip() + "\n"
