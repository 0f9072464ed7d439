# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw the rooms of docs/architecture.md: docs/pictures/rooms.svg, from the table of that page.

    python tools/room_picture.py [FILE]

A room stands below all rooms that it may use. Lines go to those that none of the others uses already, so that
every way down stays visible. ``test/test_release.py`` compares the picture with the page.
"""

from __future__ import annotations

import re
import sys
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
PICTURE = ROOT / "docs" / "pictures" / "rooms.svg"
ROW = re.compile(r"^\| ((?:`[\w/]+` ?)+)\|(.*)\|(.*)\|$", re.MULTILINE)
WIDTH, HEIGHT, ACROSS, DOWN = 150, 36, 172, 78
"""Of a box, and from one box to the next [px]."""


def rooms(page: str) -> dict[str, set[str]]:
    """Room → all rooms that it may use, from the table "room, holds, may use"."""
    result: dict[str, set[str]] = {}
    for cell, _, uses in ROW.findall(page.partition("## A plan request")[0]):
        names = [name.strip("/") for name in re.findall(r"`([\w/]+)`", cell)]
        if len(names) > 1:
            continue  # the ground, which everybody uses
        used = set(re.findall(r"`(\w+)`", uses))
        if "rooms above" in uses:
            used = set(result) - used  # "all rooms above it but …"
        result[names[0]] = used
    return result


def nearest(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """Room → the used ones that none of the other used ones uses."""
    return {room: {u for u in used if not any(u in graph[v] for v in used - {u})} for room, used in graph.items()}


def drawn(graph: dict[str, set[str]]) -> str:
    """The picture as SVG."""
    level: dict[str, int] = {}
    for room, used in graph.items():
        level[room] = 1 + max((level[u] for u in used), default=-1)
    rows: dict[int, list[str]] = {}
    for room, at in level.items():
        rows.setdefault(at, []).append(room)
    widest = max(map(len, rows.values()))
    place = {
        room: (20 + ACROSS * (column + (widest - len(row)) / 2), 20 + DOWN * at)
        for at, row in rows.items()
        for column, room in enumerate(row)
    }
    width, height = 40 + ACROSS * widest, 40 + DOWN * len(rows)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" '
        'font-size="15">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for room, used in nearest(graph).items():
        x, y = place[room][0] + WIDTH / 2, place[room][1]
        for other in sorted(used):
            u, v = place[other][0] + WIDTH / 2, place[other][1] + HEIGHT
            curve = f"M{x:g} {y:g} C{x:g} {y - 26:g} {u:g} {v + 26:g} {u:g} {v:g}"
            lines.append(f'<path d="{curve}" fill="none" stroke="#8696a0"/>')
    for room, (x, y) in place.items():
        fill = "#e4eef7" if room != "ros" else "#fbe9d7"
        box = f'x="{x:g}" y="{y:g}" width="{WIDTH}" height="{HEIGHT}" rx="5" fill="{fill}"'
        text = f'x="{x + WIDTH / 2:g}" y="{y + 23:g}" text-anchor="middle" fill="#16202a"'
        lines.append(f'<rect {box} stroke="#16202a"/><text {text}>{escape(room)}</text>')
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else PICTURE
    target.write_text(drawn(rooms(PAGE.read_text(encoding="utf-8"))), encoding="utf-8")
    print(target)
