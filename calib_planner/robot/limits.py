# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint limits and reflectors that cannot be meant as they stand, and what is made of them.

Descriptions of robots state limits in radians and metres. Three kinds of numbers are something else:

* A joint "without limits" is often written as a huge number (1e16). A plan within it would stop anywhere, 1e17
  degrees away: the joint is treated as continuous, from −180° to 180°.
* Limits of −180 and 180 are degrees: 28 turns either way are no arm's. They are read as degrees. If they
  were radians after all, the range would be narrower than it could be, and never wider.
* A sliding joint of hundreds of metres was written in millimetres, or has no limits. Nothing can be assumed.

Joints of arms turn by less than two turns either way (in 110 public URDFs of six and seven axes: by 1.25), and
those that turn further have limits of whole half turns in radians, which stay.

A reflector that is farther from the flange than the whole arm is long, and than a metre, is on no tool: its
numbers are millimetres. That is an error and not a remark: everything computed with it would be wrong, silently.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from calib_planner.errors import InputError
from calib_planner.robot.capsules import chain_length
from calib_planner.robot.chain import Robot
from calib_planner.units import listed

MOST_TURN = 4.0 * np.pi
"""No joint's own limit is further than this from zero, two turns, unless it is of whole half turns [rad]."""
MOST_DEGREES = 720.0
"""The same two turns in degrees: up to this the number may have been meant as degrees."""
HALF_TURNS = 1e-3
"""A number this near to a whole number of half turns is one [half turns]."""
MOST_SLIDE = 100.0
"""No joint slides further than this from its zero [m]."""
LONGEST_TOOL = 1.0
"""Any arm may carry a tool of this length [m]."""


def believable_limits(name: str, low: float, high: float, *, turns: bool) -> tuple[float, float, str]:
    """Limits that plans may use, and what to say about it.

    Args:
        name: The joint.
        low, high: Limits as they stand in its file [rad | m].
        turns: Whether the joint turns.

    Returns:
        Lower and upper limit [rad | m], and what is to be said of them, for ``limit_remarks``; empty if they stay
        as they are.

    Raises:
        InputError: A sliding joint whose limits cannot be metres.
    """
    far = max(abs(low), abs(high))
    if not turns:
        if far > MOST_SLIDE:
            advice = "limits of a sliding joint are metres: are these millimetres?"
            raise InputError(f"limits of {name}", f"[{low:g}, {high:g}]", f"within {MOST_SLIDE:g} m", advice)
        return low, high, ""
    if far <= MOST_TURN or _half_turns(low, high):
        return low, high, ""
    stated = f"{low:g} and {high:g} rad"
    if far <= MOST_DEGREES:
        return float(np.deg2rad(low)), float(np.deg2rad(high)), f"{stated}: they are read as degrees"
    return -np.pi, np.pi, f"{stated}: treated as continuous, from -180 to 180 degrees"


def limit_remarks(said: Iterable[tuple[str, str]]) -> list[str]:
    """Sentences from pairs of a joint's name and what ``believable_limits`` says; those alike in one."""
    alike: dict[str, list[str]] = {}
    for name, text in said:
        if text:
            alike.setdefault(text, []).append(name)
    return [f"limits of {listed(names)} are {text}" for text, names in alike.items()]


def check_reflectors(robot: Robot, field: str = "targets") -> None:
    """Refuse reflectors that no tool can carry.

    Raises:
        InputError: Names the reflector, how far it is, and the unit that was probably meant.
    """
    most = max(chain_length(robot), LONGEST_TOOL)
    for k, xyz in enumerate(robot.target_offsets, 1):
        away = float(np.linalg.norm(xyz))
        if away > most:
            got = f"reflector {k} at {away:.3g} m from the flange"
            raise InputError(field, got, f"metres, at most the arm's length of {most:.3g}", "millimetres?")


def _half_turns(low: float, high: float) -> bool:
    count = np.array([low, high]) / np.pi
    return bool(np.abs(count).max() < MOST_DEGREES and np.abs(count - np.rint(count)).max() < HALF_TURNS)
