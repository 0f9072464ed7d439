"""Joint names from files: what they may be, since the names of parameters are made of them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from calib_planner.errors import FileFormatError

RESERVED = re.compile(r"base|target_[0-9]+")
"""Prefixes of the parameters that place base and targets."""


def check_joint_names(path: object, names: Sequence[str]) -> None:
    """Refuse names that would give two parameters one name, or that no list of names could hold.

    Raises:
        FileFormatError: Naming the joint.
    """
    for name in names:
        where = f"joint {name!r}"
        if list(names).count(name) > 1:
            raise FileFormatError(path, where, "this name twice", "each name once", "rename one of them")
        if RESERVED.fullmatch(name):
            expected = "a name other than base and target_1, target_2, …"
            raise FileFormatError(
                path, where, "a name that base or target parameters have", expected, "rename it"
            )
        if not name.strip() or "," in name or name != name.strip():
            raise FileFormatError(path, where, repr(name), "a name without commas and outer spaces", "rename it")
