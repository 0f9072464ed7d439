# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The robot's body as capsules: segments along the chain, each with a radius.

The segments join what the kinematic model knows: the base's origin, the joints' origins in order, the tip's
origin. That is coarse — a link that bulges away from the line between its joints needs a larger radius — but
it needs no geometry file. Segment 0 is the base's column, segment k the link moved by joint k, the last one
the flange. A segment without length is a ball.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_array
from calib_planner.errors import InputError
from calib_planner.robot.chain import Robot
from calib_planner.robot.linearisation import Posture

SLENDERNESS = 0.05
"""Default radius as a share of the length of the chain from base to tip: 0.07 m for a reach of 1.3 m."""


@dataclass(frozen=True, eq=False)
class Capsules:
    """Radii of the body's capsules.

    Attributes:
        radii: (joints + 1,) radius of every segment, base column first [m]; one number for all of them;
            ``None`` for ``SLENDERNESS`` times the chain's length.
    """

    radii: ArrayLike | None = None

    def __post_init__(self) -> None:
        if self.radii is None:
            return
        radii = np.atleast_1d(np.asarray(check_array("radii", np.atleast_1d(self.radii), (None,))))
        if not len(radii) or (radii < 0).any():
            raise InputError("radii", radii.tolist(), "radii >= 0 m, base column first")
        object.__setattr__(self, "radii", check_array("radii", radii, (None,)))

    def of(self, robot: Robot) -> FloatArray:
        """(joints + 1,) radii of this robot's segments [m].

        Raises:
            InputError: A list of radii of another length.
        """
        count = len(robot.joint_names) + 1
        if self.radii is None:
            return np.full(count, SLENDERNESS * chain_length(robot))
        radii = np.asarray(self.radii)
        if len(radii) not in (1, count):
            wanted = f"one radius, or {count}: base column, then behind {', '.join(robot.joint_names)}"
            raise InputError("radii", f"{len(radii)} radii", wanted)
        return radii if len(radii) == count else np.full(count, radii[0])


def segments(robot: Robot, posture: Posture) -> tuple[FloatArray, FloatArray]:
    """Start and end points of the segments, each (N, joints + 1, 3), in the frame of positions [m]."""
    base = np.broadcast_to(robot.base_pose[1], (len(posture.tip_origin), 1, 3))
    points = np.concatenate([base, posture.joint_origins, posture.tip_origin[:, None]], axis=1)
    return points[:, :-1], points[:, 1:]


@lru_cache(maxsize=64)
def chain_length(robot: Robot) -> float:
    """Length of all segments in the middle of the joint ranges [m]."""
    start, end = segments(robot, robot.posture(robot.joint_limits.mean(axis=1)))
    return float(np.linalg.norm(end - start, axis=2).sum())
