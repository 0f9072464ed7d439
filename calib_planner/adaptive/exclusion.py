"""Where the robot could not be measured: a neighbourhood that plans keep out of, wider where failures gather.

Around a configuration q_e that failed all q with

    max_l |q_l − q_el| / range_l < r

are left out, l running over the joints that move a target: to turn one that does not would be the same failure
again. One failure says little of how far it is to where the robot can be measured, so r begins small; a failure
next to an earlier one says that this was too small, and its r is twice the earlier one's. Where something was
measured, it can be: no neighbourhood reaches there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_planner._arrays import FloatArray, frozen
from calib_planner.robot.chain import Robot

WIDEST = 0.4
"""Largest half width, as a share of each joint's range."""
NARROWEST = 0.005
"""Smallest, where something was measured close by."""
NEXT_TO = 1.5
"""Failures whose neighbourhoods would be this much wider and touch are next to each other."""
IDLE = 1e-9
"""A joint that moves no target by more than this per radian or metre is idle [m]."""


@dataclass(frozen=True, eq=False)
class Exclusion:
    """A configuration given up.

    Attributes:
        index: Number of the configuration in the campaign.
        q: (joints,) [rad | m].
        radius: r, a share of each joint's range.
        reason: Why, in words.
        asked: Whether a person asked for it.
    """

    index: int
    q: FloatArray
    radius: float
    reason: str
    asked: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", frozen(np.asarray(self.q, float)))


@dataclass(frozen=True, eq=False)
class AwayFrom:
    """The constraint that plans get.

    Attributes:
        exclusions: What to stay away from.
        scale: (joints,) see ``joint_scale``.
    """

    exclusions: tuple[Exclusion, ...]
    scale: FloatArray
    name: str = "away from what could not be measured"

    def allowed(self, robot: Robot, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) → (N,)."""
        ok = np.ones(len(q), bool)
        for out in self.exclusions:
            ok &= distances(q, out.q, self.scale) >= out.radius
        return ok


def joint_scale(robot: Robot) -> FloatArray:
    """(joints,) 1/range of each joint; 0 for one that moves no target."""
    low, high = robot.joint_limits.T
    sample = np.random.default_rng(0).uniform(low, high, (32, len(low)))
    moves = np.abs(np.ascontiguousarray(robot.joint_jacobian(sample))).max(axis=(0, 1)) > IDLE
    return np.where(moves, 1.0 / (high - low), 0.0)


def distances(q: FloatArray, other: FloatArray, scale: FloatArray) -> FloatArray:
    """(N, joints), (joints,) → (N,) largest difference of a joint as a share of its range."""
    return np.asarray((np.abs(q - other) * scale).max(axis=1))


def radius_of(
    q: FloatArray, earlier: Sequence[Exclusion], measured: FloatArray, scale: FloatArray, least: float
) -> float:
    """r for a new failure at ``q`` (joints,), ``measured`` (N, joints) being where it did work."""
    near = [e.radius for e in earlier if distances(e.q[None], q, scale)[0] < NEXT_TO * (e.radius + least)]
    radius = min(2.0 * max(near), WIDEST) if near else least
    if len(measured):
        radius = min(radius, 0.9 * float(distances(measured, q, scale).min()))
    return max(radius, NARROWEST)
