# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated cells that the tests of the identification share: placed anywhere, spoilt, with bad transmissions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib_planner import IdentificationProblem, Measurements, Robot
from calib_planner.identification import start_robot
from calib_planner.robot.elements import rotation
from calib_planner.simulation import SimulatedCell, random_deviations

SIGMA = 3e-5
LENGTH, ANGLE = 5e-4, 1e-3
TARGETS = np.array([[0.05, 0.02, 0.12], [-0.06, 0.04, 0.10], [0.01, -0.07, 0.14]])


POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])
ROUND = POSE + 1e-3 * np.array(
    [
        [-3, 78, -135, -5, 86, 0],
        [10, 64, -118, -1, 85, 0],
        [-9, 60, -115, -2, 87, 0],
        [-24, 58, -107, -4, 83, 0],
        [-16, 59, -117, -6, 80, 0],
        [-2, 54, -117, -2, 85, 0],
        [17, 39, -82, -7, 76, 0],
        [-10, 30, -69, 0, 78, 0],
        [8, 26, 330, 13, -2, 0],
        [18, 15, 44, 291, -281, 0],
        [0, -80, 203, -302, -332, 0],
        [-14, -370, 236, 10, 15, 0],
    ]
)
"""What the planner chooses for the test pose ``POSE``, to the milliradian."""


def bare(data: Measurements, points: np.ndarray | None = None) -> Measurements:
    """Without standard deviations, and with other points if given."""
    return Measurements(data.joint_names, data.q, data.p if points is None else points)


def plain_cell(seed: int, robot: str = "kuka_kr270") -> tuple[SimulatedCell, Robot]:
    """Everything but the robot's lengths and offsets is known."""
    asked = Robot.load(robot)
    return SimulatedCell(asked, random_deviations(asked, seed, LENGTH, ANGLE), SIGMA), asked


def placed_cell(seed: int, level: str = "full", targets: np.ndarray = TARGETS) -> tuple[SimulatedCell, Robot]:
    """A KUKA anywhere before the tracker; nothing is known of base and targets."""
    robot, rng = Robot.load("kuka_kr270"), np.random.default_rng(seed)
    yaw, pitch, roll = rng.uniform([-np.pi, -0.5, -0.5], [np.pi, 0.5, 0.5])
    place = rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll)
    real = robot.with_targets(targets).with_base(place, rng.uniform(-3, 3, 3)).with_parameters(level)
    cell = SimulatedCell(real, random_deviations(real, seed, LENGTH, ANGLE), SIGMA)
    return cell, robot.with_targets(np.zeros_like(targets)).with_parameters(level, ("base", "tool"))


def true_deviations(problem: IdentificationProblem, found, truth: Robot) -> np.ndarray:
    """(P,) deviations that reproduce ``truth``, those held staying as found: plain least squares, no noise."""
    robot = start_robot(problem.robot, problem.data, robust=problem.loss == "robust")
    low, high = robot.joint_limits.T
    q = np.random.default_rng(1).uniform(low, high, (100, len(low)))
    kept, x = np.flatnonzero(np.isfinite(found.fit.std)), np.array(found.fit.deviations)
    for _ in range(6):
        jacobian = np.ascontiguousarray(robot.jacobian(q, x)).reshape(-1, len(x))[:, kept]
        scale = np.linalg.norm(jacobian, axis=0)
        left = (truth.positions(q) - robot.positions(q, x)).ravel()
        x[kept] += np.linalg.lstsq(jacobian / scale, left, rcond=1e-12)[0] / scale
    np.testing.assert_allclose(robot.positions(q, x), truth.positions(q), atol=1e-9)
    return x


def transmission(joints: int, seed: int, size: float, length: float) -> Callable[[np.ndarray], np.ndarray]:
    """q → (N, joints) smooth random error of each joint in its own angle, root mean square ``size`` [rad]."""
    rng, orders = np.random.default_rng([seed, 3]), np.arange(1, int(6 / length) + 6)
    share = np.exp(-((orders * length) ** 2) / 2)
    a, b = size * np.sqrt(share / share.sum())[:, None] * rng.standard_normal((2, len(orders), joints))

    def error(q: np.ndarray) -> np.ndarray:
        turns = orders[:, None] * q[:, None, :]
        return np.sum(np.cos(turns) * a + np.sin(turns) * b, axis=1)

    return error


class WrongRobot:
    """A robot that no geometry describes: transmission errors and a white error of each configuration."""

    def __init__(self, seed: int, turning: float = 3.5e-4, length: float = 0.07, white: float = 1e-4):
        self.asked = Robot.load("kuka_kr270").with_targets([[0.1, 0.05, 0.1]])
        self.cell = SimulatedCell(self.asked, random_deviations(self.asked, seed, LENGTH, ANGLE), SIGMA)
        self.error = transmission(6, seed, turning, length)
        self.white, self.rng = white, np.random.default_rng([seed, 4])

    def points(self, q: np.ndarray) -> np.ndarray:
        """Where the targets really are."""
        points = self.cell.truth.positions(q + self.error(q))
        return points + self.white * self.rng.standard_normal(points.shape)

    def measure(self, q: np.ndarray, repetitions: int = 1) -> Measurements:
        points = np.repeat(self.points(q), repetitions, axis=0)
        noise = SIGMA * self.rng.standard_normal(points.shape)
        return Measurements(self.asked.joint_names, np.repeat(q, repetitions, axis=0), points + noise)


def spoil(
    data: Measurements, seed: int, share: float = 0.05, exchange: bool = True
) -> tuple[Measurements, np.ndarray]:
    """Gross errors of 10–50 mm in that share of the points, two rows exchanged; and which points they are."""
    rng, points = np.random.default_rng([seed, 5]), np.array(data.p)
    bad = np.zeros(points.shape[:2], bool)
    bad.ravel()[rng.choice(bad.size, round(share * bad.size), replace=False)] = True
    off = rng.standard_normal((int(bad.sum()), 3))
    points[bad] += off / np.linalg.norm(off, axis=1)[:, None] * rng.uniform(0.01, 0.05, (len(off), 1))
    if exchange:
        rows = rng.choice(np.flatnonzero(~bad.any(axis=1)), 2, replace=False)
        points[rows] = points[rows[::-1]]
        bad[rows] = True
    return bare(data, points), bad


def rejected(found) -> set[tuple[int, int]]:
    """(row, target) from 0 of the points not used."""
    return {(point.row, point.target - 1) for point in found.points.rejected}
