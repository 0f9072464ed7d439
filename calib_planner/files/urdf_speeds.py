"""How fast the joints of a URDF may move: the ``velocity`` of their ``<limit>``.

Not part of a ``Robot``: where things are does not depend on it, only timetables do.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from calib_planner._arrays import FloatArray, frozen
from calib_planner.errors import FileFormatError
from calib_planner.files.text import read_text

WHAT = "a URDF"


def read_speed_limits(path: str | Path, joint_names: Sequence[str]) -> FloatArray | None:
    """(joints,) speed limits in the order of ``joint_names`` [rad/s | m/s].

    ``None`` unless every joint has one above zero: exporters write 0 for a limit that nobody entered.

    Raises:
        FileFormatError: Not readable, not XML, or a velocity that is no number.
    """
    return parse_speed_limits(read_text(path, WHAT), str(path), joint_names)


def parse_speed_limits(text: str, path: str, joint_names: Sequence[str]) -> FloatArray | None:
    """Like ``read_speed_limits``, from the text itself; ``path`` names it in errors."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # no entity is ever expanded
        raise FileFormatError(path, "document", "a document type declaration", "plain URDF without one")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise FileFormatError(path, "XML", error, "well-formed XML") from None
    found = {j.get("name", ""): _velocity(path, j) for j in root.findall("joint")}
    speeds = np.array([found.get(name, 0.0) for name in joint_names])
    return frozen(speeds) if (speeds > 0).all() else None


def _velocity(path: str, joint: ElementTree.Element) -> float:
    """The joint's speed limit [rad/s | m/s]; 0 where there is none."""
    limit = joint.find("limit")
    word = "0" if limit is None else limit.get("velocity", "0")
    try:
        speed = float(word)
    except ValueError:
        speed = np.nan
    if not np.isfinite(speed):
        where = f"joint {joint.get('name', '')!r} limit velocity"
        raise FileFormatError(path, where, repr(word)[:60], "a finite number [rad/s | m/s]")
    return speed
