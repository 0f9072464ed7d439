"""What constraints on the robot's posture share: many of them cost one pass of kinematics."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_planner._arrays import FloatArray
from calib_planner.robot.chain import Robot
from calib_planner.robot.posture import Posture


class PostureConstraint:
    """A condition on where joints, tip and targets are; ``holds`` is what a child says."""

    def allowed(self, robot: Robot, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) [rad | m] → (N,) bool."""
        return self.holds(robot, robot.posture(q))

    def holds(self, robot: Robot, posture: Posture) -> NDArray[np.bool_]:
        """N postures of ``robot`` → (N,) bool."""
        raise NotImplementedError
