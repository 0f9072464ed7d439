"""A robot with hidden true parameters and a tracker with noise; every random number has a seed.

Each purpose has a stream of random numbers of its own, so that switching a fault on changes no other draw.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_configurations, check_count, check_number
from calib_planner.errors import InputError
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot
from calib_planner.tracker import Noise

LENGTH_ERROR = 1e-3
"""Default standard deviation of true length errors [m]."""
ANGLE_ERROR = 1e-3
"""Default standard deviation of true angle errors [rad]."""


def independent_seeds(seed: int, count: int) -> list[int]:
    """``count`` seeds whose random numbers have nothing to do with each other, all from one."""
    return [int(s) for s in np.random.SeedSequence(seed).generate_state(count)]


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
        instrument: The tracker's noise by direction, in the frame of the points; ``None``: ``sigma`` alike.
        truth: The robot with those deviations.
    """

    nominal: Robot
    deviations: Mapping[str, float]
    sigma: float = 3e-5
    instrument: Noise | None = None
    truth: Robot = field(init=False)

    def __post_init__(self) -> None:
        check_number("sigma", self.sigma, low=0, high=1, unit="m")
        object.__setattr__(self, "deviations", dict(self.deviations))
        object.__setattr__(self, "truth", self.nominal.with_deviations(self.deviations))

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
        noisy = points + self.noise(points, rng)
        return Measurements(self.nominal.joint_names, rows, noisy, self._std(points))

    def noise(self, points: FloatArray, rng: np.random.Generator) -> FloatArray:
        """(…, 3) errors of one sample of each of the ``points`` (…, 3) [m]."""
        draw = rng.standard_normal(points.shape)
        if self.instrument is None:
            return self.sigma * draw
        factor = np.linalg.cholesky(self.instrument.covariance(points))
        return np.asarray((factor @ draw[..., None])[..., 0])

    def _std(self, points: FloatArray) -> FloatArray | None:
        """Standard deviation of each coordinate, like ``points`` [m]; ``None`` without noise."""
        if self.instrument is not None:
            covariance = self.instrument.covariance(points)
            return np.asarray(np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)))
        return np.full(points.shape, self.sigma) if self.sigma > 0 else None

    def position_errors(self, model: Robot, configurations: ArrayLike) -> FloatArray:
        """(N, targets) distances between the true robot and ``model``, eq. (4) [m]."""
        difference = self.truth.positions(configurations) - model.positions(configurations)
        return np.linalg.norm(difference, axis=2)


class Purpose(IntEnum):
    """What is drawn; part of the seed, so the numbers stay as they are."""

    NOISE = 101
    TRANSMISSION = 102
    UNSETTLED = 103
    RESEAT = 104
    DRIFT = 105
    BUMP = 106
    OUTLIER = 107
    OUTLIER_SIZE = 108
    OUTLIER_STANDSTILL = 109
    BEAM_BREAK = 110
    DROPOUT = 111
    DELAY = 112
    DUPLICATE = 113
    DUPLICATE_DELAY = 114
    REORDER = 115
    REORDER_DELAY = 116


def draws(seed: int, purpose: Purpose, *which: int) -> np.random.Generator:
    """The generator of a purpose, and of the arrival or stream ``which``."""
    return np.random.default_rng([seed, int(purpose), *which])


def directions(rng: np.random.Generator, count: int) -> FloatArray:
    """(count, 3) unit vectors, uniform on the sphere."""
    raw = rng.standard_normal((count, 3))
    return np.asarray(raw / np.linalg.norm(raw, axis=1)[:, None])
