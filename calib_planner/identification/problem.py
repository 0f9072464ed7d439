"""The identification problem: a robot, its measurements, how they may err, and what is known beforehand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_configurations, check_count, check_number
from calib_planner.error_model import ACCURACIES, ErrorModel, Prior, without_rigid_motion
from calib_planner.errors import InputError, NotEnoughDataError, UnknownNameError
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot, is_nuisance
from calib_planner.tracker import Noise

LOSSES = ("linear", "robust")
AUTOMATIC = ("auto", "off")
UNKNOWN_SIGMA = 1e-4
"""Standard deviation of one coordinate that is assumed until the residuals give one [m]."""


WITHOUT_MODEL: Mapping[str, Any] = MappingProxyType(
    {"loss": "linear", "prior": None, "discrepancy": "auto", "joint_corrections": "auto", "starts": 2}
)
"""Settings that must be left alone beside an error model, which decides what they decide."""
UPDATE: Mapping[str, Any] = MappingProxyType({"starts": 0, "joint_corrections": "off", "order_check": "off"})
"""Settings of a quick update while measurements come in: checks that change no parameter are left to the end."""


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
        iterations: Largest number of iterations.
        prior: What is known of the parameters beforehand, or ``None``.
        instrument: The tracker's noise by direction, in the frame of the points; ``None``: see ``sigma``.
        discrepancy: ``auto``: residuals that measurement noise does not explain are a model discrepancy, which
            is estimated, weighs the points and adds to every predicted accuracy; ``off``: they are not.
        joint_corrections: ``auto``: if the residuals show a trend with a joint's position, errors of the joints'
            transmissions are looked for and, where the data show them, learnt; ``off``: they are not.
        order_check: ``auto``: test whether the residuals show a trend with time; ``off``: do not.
        starts: Number of other starts, which must end in the same minimum.
        required_accuracy: Largest acceptable error at a pose [m], for the verdict.
        error_model: How the robot errs: gravity, joint functions and visits are estimated beside the parameters,
            and every visit has a left-out error. ``None``: noise, discrepancy and joint corrections as above.
        accuracy_frame: Of the accuracy at the test poses, (M3): ``world``, or ``robot`` for users who register
            the robot anew; needs an error model, and four test poses that are not in a plane.
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
    error_model: ErrorModel | None = None
    accuracy_frame: str = "world"

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
        self._check_error_model()

    def _check_error_model(self) -> None:
        """Refuse settings that say the same thing twice, and an accuracy that has no meaning."""
        if self.accuracy_frame not in ACCURACIES:
            raise UnknownNameError("accuracy_frame", str(self.accuracy_frame), ACCURACIES)
        if self.error_model is None:
            if self.accuracy_frame != "world":
                raise InputError("accuracy_frame", self.accuracy_frame, "'world' without an error model")
            return
        for name, usual in WITHOUT_MODEL.items():
            if getattr(self, name) != usual:
                got = getattr(self, name).source if name == "prior" else getattr(self, name)
                advice = "the error model decides this: leave it out, or leave the error model out"
                raise InputError(name, got, f"{usual!r} beside an error model", advice)
        if self.accuracy_frame == "robot":
            points = self.robot.positions(self.test_pose_array)
            without_rigid_motion(points, np.zeros((points.size, 0)))

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


LENGTH_STD = 5e-4
"""Typical deviation of the lengths of an assembled industrial robot from the data sheet [m]."""
ANGLE_STD = 1e-3
"""The same for angles between axes [rad]."""
OFFSET_STD = 0.02
"""The same for the zero positions of joints, which are set by hand [rad | m]."""


def typical_prior(robot: Robot, length_std: float = LENGTH_STD, angle_std: float = ANGLE_STD) -> Prior | None:
    """Nominal values with typical manufacturing errors for all active parameters but base and targets.

    Joint zeros get ``OFFSET_STD``, which is hardly any prior. ``None`` if there is no parameter left.
    """
    zeros = _joint_zeros(robot)
    known = [p for p in robot.parameters if not is_nuisance(p.name)]
    if not known:
        return None
    usual = {"m": length_std, "rad": angle_std}
    std = np.array([OFFSET_STD if p.name in zeros else usual[p.unit] for p in known])
    text = f"typical: {1e3 * length_std:g} mm, {1e3 * angle_std:g} mrad"
    return Prior(tuple(p.name for p in known), np.array([p.nominal for p in known]), std, text)


def _joint_zeros(robot: Robot) -> set[str]:
    """Names of the active parameters that move the targets as a joint does, in every configuration."""
    low, high = robot.joint_limits.T
    sample = np.random.default_rng(0).uniform(low, high, (8, len(low)))
    # Reflectors off every axis: an unknown one starts at the tip, where the last joint moves nothing.
    robot = robot.with_targets(robot.target_offsets + np.array([0.13, 0.17, 0.19]))
    columns, joints = robot.jacobian(sample), robot.joint_jacobian(sample)
    size = np.abs(joints).max()
    return {
        name
        for k, name in enumerate(robot.parameter_names)
        if any(
            min(np.abs(columns[..., k] - s * joints[..., j]).max() for s in (1, -1)) < 1e-9 * size
            for j in range(joints.shape[2])
        )
    }
