# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What is new at each visit and the same for all targets seen there.

A joint does not come back to exactly where it was: at visit i the joints err by h_i ~ N(0, σ_j² I), and the
targets move by c(q_i) h_i. What else the targets of one visit share (the tracker's frame as it is that moment,
warmth of the arm, a base that gives way) is a common shift s_i ~ N(0, σ_c² I). Together they are, with c the
levers of the visit and 1 the column that repeats the three axes for every target,

    cov = σ_j² c cᵀ + σ_c² (1 1ᵀ ⊗ I_3) .

Visits are independent of each other. With a single target s_i cannot be told from the floor of the point, which
then stands for both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.error_model.poses import Poses
from calib_planner.robot import Robot


@dataclass(frozen=True)
class Visits:
    """Errors of a visit.

    Attributes:
        joints: Whether the joints' repeatability is in the model.
        shared: Whether the common shift is.
    """

    joints: bool = True
    shared: bool = True

    name: ClassVar[str] = "visits"
    title: ClassVar[str] = "repeatability: new each time that the robot comes to a configuration"

    @property
    def scales(self) -> tuple[str, ...]:
        """Names of the standard deviations of the error model that this term uses."""
        wanted = (("repeatability", self.joints), ("shared", self.shared))
        return tuple(name for name, there in wanted if there)

    def parts(self, poses: Poses, values: dict[str, float]) -> dict[str, FloatArray]:
        """Scale → (N, 3·targets, 3·targets) its part of the covariance of a visit [m²]."""
        result: dict[str, FloatArray] = {}
        count = len(poses.robot.targets)
        if self.joints:
            columns = poses.levers * values["repeatability"]
            result["repeatability"] = columns @ columns.transpose(0, 2, 1)
        if self.shared and count > 1:
            block = values["shared"] ** 2 * np.kron(np.ones((count, count)), np.eye(3))
            result["shared"] = np.broadcast_to(block, (len(poses), 3 * count, 3 * count))
        return result

    def draw(
        self, robot: Robot, values: dict[str, float], count: int, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """h (count, joints) in units of ``joint_units``, and s (count, targets, 3) [m], of ``count`` visits.

        Switching one of them off leaves the draws of the other as they are.
        """
        targets = len(robot.targets)
        turned, moved = rng.standard_normal((count, len(robot.joint_names))), rng.standard_normal((count, 1, 3))
        size = values["shared"] if self.shared and targets > 1 else 0.0
        shifts = np.broadcast_to(size * moved, (count, targets, 3))
        return (values["repeatability"] if self.joints else 0.0) * turned, shifts
