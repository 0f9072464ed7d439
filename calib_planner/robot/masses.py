# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Masses of the links, as the robot's file states them, and whether they can be believed.

Only what a joint carries loads it, so that a mass belongs to a joint: the last one before it in the chain. Many
files hold masses that nobody measured; a robot keeps what its file says, and ``fault_of`` says why it
cannot be what the links weigh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

CARRIED = 0.5
"""Masses are believed if at least this share of the joints carries one right behind it: with fewer, most of what
hangs on the arm is not in the file. Some links of real files are frames without a mass."""


@dataclass(frozen=True)
class LinkMass:
    """A mass that moves with a link.

    Attributes:
        joint: Number of the joint that carries it.
        mass: What it weighs [kg]; NaN where the file holds no number.
        xyz: Its centre of gravity in the frame of the link, right behind the joint's motion [m].
    """

    joint: int
    mass: float
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)


def fault_of(masses: Sequence[LinkMass], joint_names: Sequence[str], reach: float) -> str:
    """Why ``masses`` are not what the links weigh, in words; empty if nothing speaks against them.

    Args:
        masses: What the file says.
        joint_names: The robot's joints.
        reach: Length of the stretched chain: no link is longer [m].
    """
    if not masses:
        return "the robot's file states no masses of its links"
    for part in masses:
        link = f"the link behind {joint_names[part.joint]}"
        if not 0.0 <= part.mass < np.inf:
            return f"{link} has a mass of {part.mass:g} kg"
        distance = float(np.linalg.norm(part.xyz))
        if not distance <= reach:
            return f"the centre of gravity of {link} is {distance:.3g} m away, and the arm {reach:.3g} m long"
    heavy = [part for part in masses if part.mass > 0.0]
    carrying = {part.joint for part in heavy}
    if len(carrying) < CARRIED * len(joint_names):
        return f"{len(carrying)} of {len(joint_names)} joints carry a link with a mass"
    at_origin = sum(not any(part.xyz) for part in heavy)
    if len(heavy) > 1 and len({part.mass for part in heavy}) == 1 and 2 * at_origin > len(heavy):
        return "all masses are alike and in the origins of their links, as a program writes that knows none"
    return ""


def lumped(masses: Sequence[LinkMass]) -> tuple[LinkMass, ...]:
    """One mass for each joint that carries some, at their common centre of gravity."""
    result = []
    for joint in sorted({part.joint for part in masses if part.mass > 0.0}):
        parts = [part for part in masses if part.joint == joint]
        total = sum(part.mass for part in parts)
        x, y, z = (float(sum(p.mass * p.xyz[a] for p in parts) / total) for a in range(3))
        result.append(LinkMass(joint, total, (x, y, z)))
    return tuple(result)
