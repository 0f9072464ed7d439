"""The world we test in: a robot with hidden true parameters and a tracker with noise. Seeded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib_planner._arrays import FloatArray, check_configurations, check_count, check_number
from calib_planner.errors import InputError
from calib_planner.identification.measurements import Measurements
from calib_planner.robot.chain import Robot

LENGTH_ERROR = 1e-3
"""Default standard deviation of true length errors [m]."""
ANGLE_ERROR = 1e-3
"""Default standard deviation of true angle errors [rad]."""


def random_deviations(
    robot: Robot, seed: int, length: float = LENGTH_ERROR, angle: float = ANGLE_ERROR
) -> dict[str, float]:
    """True errors of the active parameters, drawn from normal distributions [m | rad]."""
    rng = np.random.default_rng([seed, 1])  # a stream of its own: noise may have the same seed
    draw = rng.standard_normal(len(robot.parameters))
    return {
        p.name: float(d * (length if p.unit == "m" else angle))
        for p, d in zip(robot.parameters, draw, strict=True)
    }


@dataclass(frozen=True, eq=False)
class SimulatedCell:
    """A real robot, as far as we can have one, in front of a tracker.

    Attributes:
        nominal: What the controller believes.
        deviations: True deviation of each named parameter [m | rad].
        sigma: Standard deviation of one tracker coordinate [m].
    """

    nominal: Robot
    deviations: Mapping[str, float]
    sigma: float = 3e-5

    def __post_init__(self) -> None:
        check_number("sigma", self.sigma, low=0, high=1, unit="m")
        object.__setattr__(self, "deviations", dict(self.deviations))
        object.__setattr__(self, "truth", self.nominal.with_deviations(self.deviations))

    truth: Robot = None  # type: ignore[assignment]

    def measure(self, configurations: ArrayLike, repetitions: ArrayLike | int, seed: int) -> Measurements:
        """Measure each configuration ``repetitions`` times; one row per measurement."""
        q = check_configurations("configurations", configurations, self.nominal.joint_names)
        if np.ndim(repetitions) == 0:
            check_count("repetitions", repetitions)
        elif np.shape(repetitions) != (len(q),):
            raise InputError("repetitions", np.shape(repetitions), f"one number or {len(q)} numbers")
        rows = np.repeat(q, np.asarray(repetitions, np.int64), axis=0)
        rng = np.random.default_rng(seed)
        points = self.truth.positions(rows)
        noisy = points + self.sigma * rng.standard_normal(points.shape)
        std = np.full(points.shape, self.sigma) if self.sigma > 0 else None
        return Measurements(self.nominal.joint_names, rows, noisy, std)

    def position_errors(self, model: Robot, configurations: ArrayLike) -> FloatArray:
        """(N, targets) distances between the true robot and ``model``, eq. (4) [m]."""
        difference = self.truth.positions(configurations) - model.positions(configurations)
        return np.linalg.norm(difference, axis=2)
