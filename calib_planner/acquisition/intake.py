"""The robot's joints out of a joint state that names them in its own order, among others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, frozen
from calib_planner.errors import InputError, UnknownNameError

MOST_NAMES = 50
"""Names that an error lists."""


def pick_joints(names: Sequence[str], positions: ArrayLike, joint_names: Sequence[str]) -> FloatArray:
    """Positions (joints,) [rad | m] in the order wanted; other joints are ignored, values may be NaN.

    Args:
        names: Joints of the message, in any order.
        positions: (names,) their positions [rad | m].
        joint_names: Joints wanted.

    Raises:
        UnknownNameError: A joint is missing.
        InputError: A name is there twice, or names and positions differ in number.
    """
    names, values = list(names), np.asarray(positions, dtype=float)
    if len(names) != len(values):
        raise InputError("position", f"{len(values)} positions for {len(names)} names", "one position per name")
    where = {name: i for i, name in enumerate(names)}
    for name in joint_names:
        if name not in where:
            raise UnknownNameError("name", name, list(dict.fromkeys(filter(None, names)))[:MOST_NAMES])
    if len(where) != len(names):
        doubled = sorted({n for n in joint_names if names.count(n) > 1})
        if doubled:
            raise InputError("name", f"{', '.join(doubled)} more than once", "each joint once")
    return frozen(values[[where[name] for name in joint_names]])
