"""What is asked of the identification: a robot, its measurements and how they may err."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib_planner._arrays import FloatArray, check_configurations, check_count, check_number
from calib_planner.errors import InputError, NotEnoughDataError, UnknownNameError
from calib_planner.identification.measurements import Measurements
from calib_planner.robot.chain import Robot

LOSSES = ("linear",)


@dataclass(frozen=True, eq=False)
class IdentificationProblem:
    """Find the active parameters of ``robot`` from ``data``.

    Where the base (all six ``base.*``) or the targets (all ``target_*``) are among the active parameters,
    they start from a closed form (see ``registration``), whatever the robot's own values are.

    Attributes:
        robot: The nominal robot, its active parameters being those to be identified.
        data: The measurements; the joint order may differ from the robot's.
        sigma: Standard deviation of one coordinate [m]; ``None``: the data's own, estimated from the
            residuals if they have none.
        loss: One of ``LOSSES``.
        test_poses: (K, joints) where the predicted accuracy is wanted, or ``None``.
        iterations: Most iterations.
    """

    robot: Robot
    data: Measurements
    sigma: float | None = None
    loss: str = "linear"
    test_poses: ArrayLike | None = None
    iterations: int = 50

    def __post_init__(self) -> None:
        put = object.__setattr__
        if not self.robot.parameter_names:
            raise InputError("robot", "a robot without active parameters", "use robot.with_parameters(...)")
        put(self, "data", self.data.in_order_of(self.robot.joint_names))
        targets = len(self.robot.targets)
        if self.data.p.shape[1] != targets:
            raise InputError(
                "data",
                f"{self.data.p.shape[1]} targets",
                f"{targets} targets, as the robot has",
                "give the robot's targets with with_targets(...)",
            )
        if self.sigma is not None:
            put(self, "sigma", check_number("sigma", self.sigma, low=0, low_open=True, unit="m"))
        if self.loss not in LOSSES:
            raise UnknownNameError("loss", str(self.loss), LOSSES)
        if self.test_poses is not None:
            poses = check_configurations("test_poses", self.test_poses, self.robot.joint_names)
            put(self, "test_poses", poses)
        put(self, "iterations", check_count("iterations", self.iterations, high=10_000))
        if not self.data.seen.any():
            raise NotEnoughDataError(0, len(self.robot.parameter_names), "there are no measured points")

    @property
    def test_pose_array(self) -> FloatArray:
        """(K, joints); K = 0 when no test pose was given."""
        if self.test_poses is None:
            return np.empty((0, len(self.robot.joint_names)))
        return np.asarray(self.test_poses)
