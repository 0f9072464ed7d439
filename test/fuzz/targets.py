# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What is fuzzed: every reader of files, and every conversion of a message. Each target takes bytes.

A target ends: in a value, or in a ``CalibPlannerError`` of one line. Everything else is a fault. What a file
holds is the bytes; a message is a good one of which the bytes change some fields, to whatever its type allows.
"""

from __future__ import annotations

import atexit
import io
import math
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner import CalibPlannerError, Robot
from calib_planner.io import (
    parse_urdf,
    read_bag,
    read_cell,
    read_configurations,
    read_constraints,
    read_data,
    read_error_model,
    read_estimate,
    read_instrument,
    read_kinematics,
    read_plan,
    read_prior,
    read_program_format,
)

LONGEST = 1 << 16
"""Bytes of an input: enough for every kind of file, and few enough that each takes milliseconds."""


@cache
def planar() -> Robot:
    return Robot.load("planar_2r")


@cache
def folder() -> Path:
    """One folder for the whole run: a reader sees one file in it at a time."""
    memory = Path("/dev/shm")
    made = Path(tempfile.mkdtemp(prefix="fuzz", dir=memory if memory.is_dir() else None))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


@contextmanager
def file_of(data: bytes, name: str) -> Iterator[Path]:
    path = folder() / name
    path.write_bytes(data)
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


def ends(read: Callable[[], Any]) -> Any:
    """What it gives, or ``None`` where it refuses; an error is one line of bounded length."""
    try:
        return read()
    except CalibPlannerError as error:
        assert "\n" not in str(error), repr(str(error))
        assert len(str(error)) < 5000, len(str(error))
        return None


# ── files ────────────────────────────────────────────────────────────────────────────────────────────


def table(data: bytes) -> None:
    """Text, NPY, NPZ, MAT, JSON, XLSX: told by the bytes."""
    with file_of(data, "data.csv") as path:
        source = ends(lambda: read_data(path, planar()))
        assert source is None or np.isfinite(source.data.q).all()
        q = ends(lambda: read_configurations(path, planar()))
        assert q is None or np.isfinite(q).all()


def json_table(data: bytes) -> None:
    with file_of(data, "data.json") as path:
        ends(lambda: read_data(path, planar()))


def sheet(data: bytes) -> None:
    """The bytes as the cells of a spreadsheet: a mutated archive would fail its checksum instead."""
    with file_of(_workbook(data), "data.xlsx") as path:
        ends(lambda: read_data(path, planar()))


def _workbook(cells: bytes) -> bytes:
    main = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    office = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    package = "http://schemas.openxmlformats.org/package/2006"
    kind = "application/vnd.openxmlformats-officedocument.spreadsheetml"
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types"><Default Extension="rels" ContentType="'
        'application/vnd.openxmlformats-package.relationships+xml"/><Override PartName="/xl/workbook.xml" '
        f'ContentType="{kind}.sheet.main+xml"/><Override PartName="/xl/worksheets/sheet1.xml" '
        f'ContentType="{kind}.worksheet+xml"/></Types>',
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships"><Relationship Id="r1" Type="{office}/'
        'officeDocument" Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": f'<workbook xmlns="{main}" xmlns:r="{office}"><sheets><sheet name="s" sheetId="1" '
        'r:id="r1"/></sheets></workbook>',
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{package}/relationships"><Relationship Id="r1" '
        f'Type="{office}/worksheet" Target="worksheets/sheet1.xml"/></Relationships>',
    }
    with io.BytesIO() as out:
        with zipfile.ZipFile(out, "w") as archive:
            for name, text in parts.items():
                archive.writestr(name, text)
            head, tail = f'<worksheet xmlns="{main}"><sheetData>'.encode(), b"</sheetData></worksheet>"
            archive.writestr("xl/worksheets/sheet1.xml", head + cells + tail)
        return out.getvalue()


def bag(data: bytes) -> None:
    """An MCAP or SQLite file: the first byte chooses."""
    name = "bag.mcap" if data[:1] != b"S" else "bag.db3"
    with file_of(data, name) as path:
        ends(lambda: read_bag(path, planar()))


def urdf(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    robot = ends(lambda: parse_urdf(text, "robot.urdf"))
    if robot is not None:
        assert np.isfinite(robot.positions(np.zeros((1, len(robot.joint_names))))).all()


def robot_yaml(data: bytes) -> None:
    with file_of(data, "robot.yaml") as path:
        robot = ends(lambda: Robot.load(path))
    if robot is not None:
        assert np.isfinite(robot.positions(np.zeros((1, len(robot.joint_names))))).all()


def _yaml(read: Callable[[Path], Any]) -> Callable[[bytes], None]:
    def run(data: bytes) -> None:
        with file_of(data, "file.yaml") as path:
            ends(lambda: read(path))

    return run


def template(data: bytes) -> None:
    with file_of(data, "mine.j2") as path:
        ends(lambda: read_program_format(str(path)))


FILES: dict[str, Callable[[bytes], None]] = {
    "table": table,
    "json_table": json_table,
    "sheet": sheet,
    "bag": bag,
    "urdf": urdf,
    "robot_yaml": robot_yaml,
    "plan": _yaml(read_plan),
    "estimate": _yaml(read_estimate),
    "kinematics": _yaml(lambda path: read_kinematics(path, planar())),
    "prior": _yaml(lambda path: read_prior(path, planar())),
    "error_model": _yaml(read_error_model),
    "instrument": _yaml(read_instrument),
    "constraints": _yaml(lambda path: read_constraints(path, planar())),
    "cell": _yaml(read_cell),
    "template": template,
}


# ── messages ─────────────────────────────────────────────────────────────────────────────────────────


class Draws:
    """Choices out of bytes; zeros where these end."""

    def __init__(self, data: bytes) -> None:
        self.rest = data

    def take(self, count: int) -> bytes:
        taken, self.rest = self.rest[:count], self.rest[count:]
        return taken.ljust(count, b"\0")

    def below(self, count: int) -> int:
        return int.from_bytes(self.take(2), "little") % max(count, 1)

    def number(self) -> float:
        odd = (0.0, -0.0, 1.0, -1.0, math.nan, math.inf, -math.inf, 5e-324, 1e308, -1e308, 1e-9, 3.2)
        pick = self.below(len(odd) + 4)
        return odd[pick] if pick < len(odd) else struct.unpack("<d", self.take(8))[0]

    def whole(self, low: int, high: int) -> int:
        drawn = low + int.from_bytes(self.take(8), "little") % (high - low + 1)
        return (low, high, 0, min(high, 1), drawn)[self.below(5)]

    def text(self) -> str:
        return self.take(self.below(12)).decode("latin-1").replace("\0", "")


LIMITS = {f"{sign}int{bits}": (0 if sign else -(1 << bits - 1), (1 << bits - (0 if sign else 1)) - 1)
          for sign in ("", "u") for bits in (8, 16, 32, 64)}  # fmt: skip


def altered(message: Any, draws: Draws) -> None:
    """Change one field somewhere below a message, or the length of one of its arrays."""
    fields = message.get_fields_and_field_types()
    name = list(fields)[draws.below(len(fields))]
    value, kind = getattr(message, name), fields[name]
    if hasattr(value, "get_fields_and_field_types"):
        altered(value, draws)
        return
    if kind.startswith("sequence<") or isinstance(value, (list, tuple)) or hasattr(value, "typecode"):
        items = list(value)
        if not items:
            return  # what an empty array would hold, it does not show
        way = draws.below(4)
        if way == 0:
            items = items[: draws.below(len(items) + 1)]
        elif way == 1:
            items += items[: draws.below(len(items)) + 1]
        else:
            at = draws.below(len(items))
            if hasattr(items[at], "get_fields_and_field_types"):
                altered(items[at], draws)
            else:
                items[at] = _other(items[at], draws, kind)
        if len(items) == len(value) or kind.startswith("sequence<"):
            setattr(message, name, items)
        return
    setattr(message, name, _other(value, draws, kind))


def _other(value: Any, draws: Draws, kind: str) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return draws.text()
    if isinstance(value, float):
        return draws.number()
    bounds = next((LIMITS[n] for n in sorted(LIMITS, key=len, reverse=True) if n in kind), (0, 255))
    return draws.whole(*bounds)


@cache
def _ros() -> Any:
    import conversions

    return conversions


def _message(kind: str) -> Callable[[bytes], None]:
    def run(data: bytes) -> None:
        good, convert = _ros().CONVERSIONS[kind]
        message, draws = good(), Draws(data)
        for _ in range(1 + draws.below(8)):
            altered(message, draws)
        ends(lambda: convert(message))

    return run


MESSAGES = {
    name: _message(name)
    for name in (
        "plan_message",
        "estimate_message",
        "plan_request",
        "joint_trajectory",
        "joint_state",
        "point_stamped",
    )
}
"""They need ROS 2 (source env.sh)."""
TARGETS = FILES | MESSAGES
