"""What is asked of the identification: a robot, its measurements and how they may err."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib_planner._arrays import FloatArray, check_configurations, check_count, check_number
from calib_planner.errors import InputError, NotEnoughDataError, UnknownNameError
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.prior import Prior
from calib_planner.instrument.noise import Noise
from calib_planner.robot.chain import Robot

LOSSES = ("linear", "robust")
AUTOMATIC = ("auto", "off")
UNKNOWN_SIGMA = 1e-4
"""Standard deviation of one coordinate that stands in until the residuals have told it [m]."""


@dataclass(frozen=True, eq=False)
class IdentificationProblem:
    """Find the active parameters of ``robot`` from ``data``.

    Where the base (all six ``base.*``) or the targets (all ``target_*``) are among the active parameters,
    they start from a closed form (see ``registration``), whatever the robot's own values are.

    Attributes:
        robot: The nominal robot, its active parameters being those to be identified.
        data: The measurements; the joint order may differ from the robot's.
        sigma: Standard deviation of one coordinate [m]; ``None``: the instrument's, else the data's own, else
            estimated from repetitions or residuals.
        loss: ``linear``: every point counts; ``robust``: points beyond the χ² gate are rejected and listed.
        test_poses: (K, joints) where the predicted accuracy is wanted, or ``None``.
        iterations: Most iterations.
        prior: What is known of the parameters beforehand, or ``None``.
        instrument: The tracker's noise by direction, in the frame of the points; ``None``: see ``sigma``.
        discrepancy: ``auto``: residuals that measurement noise does not explain are a model discrepancy, which
            is estimated, weighs the points and adds to every predicted accuracy; ``off``: they are not.
        joint_corrections: ``auto``: if the residuals know where the robot stood, errors of the joints'
            transmissions are looked for and, where the data show them, learnt; ``off``: they are not.
        order_check: ``auto``: ask whether the residuals know when they were measured; ``off``: do not.
        starts: Other starts that must end in the same minimum.
        required_accuracy: Largest error at a pose that the user can live with [m], for the verdict.
    """

    robot: Robot
    data: Measurements
    sigma: float | None = None
    loss: str = "linear"
    test_poses: ArrayLike | None = None
    iterations: int = 50
    prior: Prior | None = None
    instrument: Noise | None = None
    discrepancy: str = "auto"
    joint_corrections: str = "auto"
    order_check: str = "auto"
    starts: int = 2
    required_accuracy: float | None = None

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
        for name in ("discrepancy", "joint_corrections", "order_check"):
            if getattr(self, name) not in AUTOMATIC:
                raise UnknownNameError(name, str(getattr(self, name)), AUTOMATIC)
        if self.sigma is not None and self.instrument is not None:
            raise InputError("sigma", "a sigma and an instrument", "one of the two")
        if self.test_poses is not None:
            poses = check_configurations("test_poses", self.test_poses, self.robot.joint_names)
            put(self, "test_poses", poses)
        put(self, "iterations", check_count("iterations", self.iterations, high=10_000))
        put(self, "starts", check_count("starts", self.starts, low=0, high=1000))
        if self.required_accuracy is not None:
            value = check_number("required_accuracy", self.required_accuracy, low=0, low_open=True, unit="m")
            put(self, "required_accuracy", value)
        if self.prior is not None:
            self.prior.rows(self.robot.parameter_names, np.zeros(len(self.robot.parameter_names)))
        if not self.data.seen.any():
            raise NotEnoughDataError(0, len(self.robot.parameter_names), "there are no measured points")

    @property
    def test_pose_array(self) -> FloatArray:
        """(K, joints); K = 0 when no test pose was given."""
        if self.test_poses is None:
            return np.empty((0, len(self.robot.joint_names)))
        return np.asarray(self.test_poses)

    def instrument_covariance(self) -> tuple[FloatArray, str]:
        """(N, targets, 3, 3) covariance of each measured point [m²], and what it comes from.

        Where nothing is known it is that of ``UNKNOWN_SIGMA``, from ``residuals``.
        """
        shape = (*self.data.p.shape, 3)
        if self.sigma is not None:
            return np.broadcast_to(self.sigma**2 * np.eye(3), shape), "sigma"
        if self.instrument is not None:
            return self.instrument.covariance(np.where(np.isnan(self.data.p), 1.0, self.data.p)), "instrument"
        if self.data.std is not None:
            std = np.where(self.data.seen[:, :, None], np.asarray(self.data.std), 1.0)
            return std[..., None] ** 2 * np.eye(3), "data"
        return np.broadcast_to(UNKNOWN_SIGMA**2 * np.eye(3), shape), "residuals"
