# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The identification problem: a robot, its measurements, how both err, and what is wanted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_configurations, check_number
from calib_planner.error_model import (
    ACCURACIES,
    ErrorModel,
    Prior,
    gravity_of,
    typical,
    without_rigid_motion,
)
from calib_planner.errors import InputError, NotEnoughDataError, UnknownNameError
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot
from calib_planner.tracker import Isotropic, Noise
from calib_planner.units import Told

LOSSES = ("auto", "linear", "robust")


@dataclass(frozen=True, eq=False, repr=False)
class IdentificationProblem(Told):
    """Find the active parameters of ``robot``, and all else that its error model has, from ``data``.

    Where the base (all six ``base.*``) or the targets (all ``target_*``) are among the active parameters,
    they start from a closed form (see ``registration``), whatever the robot's own values are.

    Attributes:
        robot: The nominal robot, its active parameters being those to be identified.
        data: The measurements; the joint order may differ from the robot's.
        sigma: Standard deviation of one coordinate [m], in place of what data and error model say.
        error_model: How robot and measurement err; ``None``: all terms at typical sizes, ``error_model.typical``.
            ``ErrorModel.paper()`` is plain least squares, eqs. (6), (7) and (11).
        instrument: The tracker's noise by direction, in the frame of the points, instead of ``sigma``.
        prior: What is known of some parameters beforehand, in place of what the error model says of these.
        loss: ``robust``: points that the others find impossible lose their weight and are listed; ``linear``:
            every point counts; ``auto``: robust, but linear for the paper's model.
        test_poses: (K, joints) where the predicted accuracy is wanted [rad | m], or ``None``.
        required_accuracy: Largest acceptable error at a pose [m], for the verdict.
        accuracy_frame: Of the accuracy at the test poses, (M3): ``world``, or ``robot`` for users who register
            the robot anew; ``robot`` needs four test poses that are not in a plane.

    Raises:
        InputError, UnknownNameError, NotEnoughDataError: Name the field that cannot be used.
    """

    robot: Robot
    data: Measurements
    sigma: float | None = None
    error_model: ErrorModel | None = None
    instrument: Noise | None = None
    prior: Prior | None = None
    loss: str = "auto"
    test_poses: ArrayLike | None = None
    required_accuracy: float | None = None
    accuracy_frame: str = "world"

    def _facts(self) -> list[tuple[str, object]]:
        return [
            ("robot", self.robot.name),
            ("visits", len(self.data)),
            ("points", int(self.data.seen.sum())),
            ("parameters", len(self.robot.parameter_names)),
            ("error model", self.model.name),
        ]

    def __post_init__(self) -> None:
        put = object.__setattr__
        if not self.robot.parameter_names:
            raise InputError("robot", "no active parameters", "at least one", "use robot.with_parameters(...)")
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
        if self.sigma is not None and self.instrument is not None:
            raise InputError("sigma", "a sigma and an instrument", "one of the two")
        if self.loss not in LOSSES:
            raise UnknownNameError("loss", str(self.loss), LOSSES)
        if self.test_poses is not None:
            poses = check_configurations("test_poses", self.test_poses, self.robot.joint_names)
            put(self, "test_poses", poses)
        if self.required_accuracy is not None:
            value = check_number("required_accuracy", self.required_accuracy, low=0, low_open=True, unit="m")
            put(self, "required_accuracy", value)
        if not self.data.seen.any():
            raise NotEnoughDataError(0, len(self.robot.parameter_names), "there are no measured points")
        put(self, "error_model", self._model())
        if self.sigma is not None or self.instrument is not None:
            put(self, "data", replace(self.data, std=None))
        if self.accuracy_frame not in ACCURACIES:
            raise UnknownNameError("accuracy_frame", str(self.accuracy_frame), ACCURACIES)
        if self.accuracy_frame == "robot":
            points = self.robot.positions(self.test_pose_array)
            without_rigid_motion(points, np.zeros((points.size, 0)))

    def _model(self) -> ErrorModel:
        """The error model with the noise and the prior that are stated beside it."""
        model = typical(gravity=gravity_of(self.robot)) if self.error_model is None else self.error_model
        noise = self.instrument if self.sigma is None else Isotropic(self.sigma)
        if noise is None and self.data.std is not None and model.is_papers:
            noise = Isotropic(float(np.sqrt(np.mean(np.asarray(self.data.std)[self.data.seen] ** 2))))
        if noise is not None:
            model = model.with_noise(noise)
        if self.prior is not None:
            self.prior.places(self.robot.parameter_names)
            model = replace(model, placement=replace(model.placement, stated=self.prior))
        return model

    @property
    def model(self) -> ErrorModel:
        """The error model that is identified with."""
        assert self.error_model is not None
        return self.error_model

    @property
    def robust(self) -> bool:
        """Whether impossible points lose their weight."""
        return self.loss == "robust" or (self.loss == "auto" and not self.model.is_papers)

    @property
    def noise_source(self) -> str:
        """Who says how a point errs: ``sigma``, ``instrument``, ``data`` or ``residuals``."""
        if self.sigma is not None:
            return "sigma"
        if self.data.std is not None:
            return "data"
        return "residuals" if self.model.points.noise is None else "instrument"

    @property
    def test_pose_array(self) -> FloatArray:
        """(K, joints); K = 0 when no test pose was given."""
        if self.test_poses is None:
            return np.empty((0, len(self.robot.joint_names)))
        return np.asarray(self.test_poses)
