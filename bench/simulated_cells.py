"""Simulated cells for the benches: everything drawn from a seed, wrong in the ways that a case says.

Model discrepancy is an error of each joint's transmission, a random function of its angle with a squared
exponential spectrum, and a white error of each configuration and target. Gross errors: 10–50 mm, any direction.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_planner import IdentificationProblem, Robot
from calib_planner.arrays import FloatArray
from calib_planner.error_model import Prior
from calib_planner.identification import Estimate, start_robot
from calib_planner.measurements import Measurements
from calib_planner.robot import rotation
from calib_planner.simulation import SimulatedCell, random_deviations

SIGMA, LENGTH, ANGLE = 3e-5, 5e-4, 1e-3
TARGETS = np.array([[0.05, 0.02, 0.12], [-0.06, 0.04, 0.10], [0.01, -0.07, 0.14]])


@dataclass(frozen=True)
class Case:
    """What is simulated and what is asked.

    Attributes:
        robot: Name in the catalogue.
        level: Its parameters.
        placed: Base and targets are unknown.
        targets: Number of reflectors.
        count, repetitions: Configurations, and how often each is measured.
        options: Further arguments of the problem.
        turning: Transmission errors, root mean square [rad], with correlation length ``length`` [rad].
        white: Error of each configuration and target, per coordinate [m].
        gross: Share of the points that are gross errors; a hundredth of the rows are exchanged if ``exchanged``.
        prior: The true errors are drawn from the prior that is given.
    """

    robot: str = "kuka_kr270"
    level: str = "lengths+offsets"
    placed: bool = False
    targets: int = 1
    count: int = 20
    repetitions: int = 1
    options: dict[str, Any] = field(default_factory=dict)
    turning: float = 0.0
    length: float = 0.07
    white: float = 0.0
    gross: float = 0.0
    exchanged: bool = False
    prior: bool = False


@dataclass(frozen=True, eq=False)
class Cell:
    """A cell, the question about it, and what it draws from."""

    case: Case
    truth: SimulatedCell
    asked: Robot
    prior: Prior | None
    rng: np.random.Generator
    waves: tuple[FloatArray, FloatArray]

    def configurations(self, count: int) -> FloatArray:
        low, high = self.asked.joint_limits.T
        return np.asarray(self.rng.uniform(low, high, (count, len(low))))

    def points(self, q: FloatArray) -> FloatArray:
        """Where the targets really are."""
        orders = np.arange(1, len(self.waves[0]) + 1)
        turns = orders[:, None] * q[:, None, :]
        error = np.sum(np.cos(turns) * self.waves[0] + np.sin(turns) * self.waves[1], axis=1)
        points = self.truth.truth.positions(q + error)
        return np.asarray(points + self.case.white * self.rng.standard_normal(points.shape))

    def measure(self, q: FloatArray, repetitions: int) -> Measurements:
        """``repetitions`` 0: once each, the first one three times."""
        often = np.full(len(q), max(repetitions, 1))
        often[0] = repetitions or 3
        points = np.repeat(self.points(q), often, axis=0)
        noisy = points + SIGMA * self.rng.standard_normal(points.shape)
        return Measurements(self.asked.joint_names, np.repeat(q, often, axis=0), noisy)


def cell_of(case: Case, seed: int) -> Cell:
    """Drawn from ``seed``."""
    rng = np.random.default_rng([seed, 7])
    robot = Robot.load(case.robot)
    real = robot if case.robot == "planar_2r" else robot.with_targets(TARGETS[: case.targets])
    real = real.with_parameters(case.level)
    asked, prior = real, None
    if case.placed:
        yaw, pitch, roll = rng.uniform([-np.pi, -0.5, -0.5], [np.pi, 0.5, 0.5])
        place = rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll)
        real = real.with_base(place, rng.uniform(-3.0, 3.0, 3))
        blank = robot.with_targets(np.zeros((case.targets, 3)))
        asked = blank.with_parameters(case.level, ("base", "tool"))
    if case.prior:
        std = np.array([LENGTH if p.unit == "m" else ANGLE for p in real.parameters])
        prior = Prior(real.parameter_names, np.array([p.nominal for p in real.parameters]), std)
    orders = np.arange(1, int(6.0 / case.length) + 6)
    share = np.exp(-((orders * case.length) ** 2) / 2.0)
    size = case.turning * np.sqrt(share / share.sum())[:, None]
    waves = size * rng.standard_normal((2, len(orders), len(real.joint_names)))
    truth = SimulatedCell(real, random_deviations(real, seed, LENGTH, ANGLE), SIGMA)
    return Cell(case, truth, asked, prior, rng, (waves[0], waves[1]))


def spoil(data: Measurements, case: Case, rng: np.random.Generator) -> tuple[Measurements, NDArray[np.bool_]]:
    """Gross errors of 10–50 mm and, if asked for, exchanged rows; and which points they are."""
    points = np.array(data.p)
    bad = np.zeros(points.shape[:2], bool)
    bad.ravel()[rng.choice(bad.size, round(case.gross * bad.size), replace=False)] = True
    off = rng.standard_normal((int(bad.sum()), 3))
    off /= np.linalg.norm(off, axis=1)[:, None]
    points[bad] += off * rng.uniform(0.01, 0.05, len(off))[:, None]
    if case.exchanged:
        half = max(1, round(0.005 * len(points)))
        rows = rng.choice(np.flatnonzero(~bad.any(axis=1)), 2 * half, replace=False)
        points[rows] = points[np.roll(rows, half)]
        bad[rows] = True
    return Measurements(data.joint_names, data.q, points), bad


def true_deviations(problem: IdentificationProblem, found: Estimate, cell: Cell) -> FloatArray:
    """(P,) deviations that reproduce the true robot, those held as they are."""
    if not cell.case.placed:
        return np.array([cell.truth.deviations[name] for name in found.fit.parameters])
    robot = start_robot(problem.robot, problem.data, robust=problem.loss == "robust")
    kept = np.flatnonzero(np.isfinite(found.fit.std))
    low, high = robot.joint_limits.T
    q = np.random.default_rng(1).uniform(low, high, (100, len(low)))
    truth, deviations = cell.truth.truth.positions(q).ravel(), found.fit.deviations.copy()
    for _ in range(6):
        jacobian = np.ascontiguousarray(robot.jacobian(q, deviations)).reshape(len(truth), -1)[:, kept]
        scale = np.linalg.norm(jacobian, axis=0)
        left = truth - robot.positions(q, deviations).ravel()
        deviations[kept] += np.linalg.lstsq(jacobian / scale, left, rcond=1e-12)[0] / scale
    assert np.abs(truth - robot.positions(q, deviations).ravel()).max() < 1e-9
    return deviations
