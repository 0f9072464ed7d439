# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Small linear problems and simulated measurements that the tests of the estimation share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from robots import random_configurations

from calib_planner import Robot
from calib_planner.arrays import FloatArray, IntArray
from calib_planner.error_model import ErrorModel, JointFunctions, Placement, typical
from calib_planner.error_model.knowledge import Knowledge
from calib_planner.identification.estimation import _Work
from calib_planner.identification.likelihood import LinearProblem
from calib_planner.measurements import Measurements

TARGETS = [[0.0, 0.05, 0.1], [0.08, -0.03, 0.05], [-0.04, 0.02, 0.12]]
NOTHING = {
    "gravity": 1e-12,
    "smooth.size": 1e-12,
    "short.size": 1e-12,
    "repeatability": 1e-12,
    "shared": 1e-12,
    "placement.length": 3e-4,
    "placement.angle": 6e-4,
    "floor": 3e-5,
}


def ur10e(targets: int = 2) -> Robot:
    """Placement only; base and targets known."""
    return Robot.load("ur10e").with_targets(TARGETS[:targets]).with_parameters("full")


def unknown(robot: Robot) -> Robot:
    """The same with base and tool unknown."""
    return robot.with_parameters("full", ("base", "tool"))


def of_visits(problem: LinearProblem, rows: IntArray) -> LinearProblem:
    """The same for some visits, by number; one may come several times."""
    parts = {name: part[rows] for name, part in problem.parts.items()}
    y, columns, seen = problem.y[rows], problem.columns[rows], problem.seen[rows]
    return replace(problem, y=y, columns=columns, parts=parts, seen=seen, poses=None)


def simulated(
    robot: Robot, scales: dict[str, float], count: int, seed: int, heavy: bool = False
) -> tuple[Measurements, Knowledge]:
    """``count`` visits of a robot drawn from the model, noise Student t (ν = 3) if ``heavy``; the truth."""
    rng = np.random.default_rng(seed)
    model = typical().with_values(NOTHING | scales)
    variances = model.variances(robot)
    beta = np.sqrt(np.where(np.isfinite(variances), variances, 0.0)) * rng.standard_normal(len(variances))
    truth = Knowledge(robot, model, beta, np.zeros((len(beta),) * 2), np.zeros((len(beta), 0)))
    q = random_configurations(robot, count, seed) / 3.0
    poses, values = truth.poses(q), model.values
    error = np.einsum("nij,nj->ni", poses.levers, values["repeatability"] * rng.standard_normal(q.shape))
    error = error + np.tile(values["shared"] * rng.standard_normal((count, 3)), len(robot.targets))
    draw = rng.standard_t(3, error.shape) / np.sqrt(3.0) if heavy else rng.standard_normal(error.shape)
    points = poses.points + (error + values["floor"] * draw).reshape(count, -1, 3)
    return Measurements(robot.joint_names, q, points), truth


def problem_of(
    visits: int = 8,
    targets: int = 2,
    prior: str = "tolerance",
    missing: tuple[tuple[int, int], ...] = (),
    seed: int = 0,
) -> LinearProblem:
    """A linear problem with all terms, a few harmonics, base and tool unknown."""
    robot = ur10e(targets)
    data, _ = simulated(robot, {"gravity": 2e-3, "repeatability": 5e-5, "shared": 3e-5}, visits, seed)
    points = np.array(data.p)
    for at in missing:
        points[at] = np.nan
    model: ErrorModel = replace(
        typical(), placement=Placement(prior), joint_functions=JointFunctions(harmonics=6)
    )
    return _Work(unknown(robot), Measurements(robot.joint_names, data.q, points), model).linearised()


def total_covariance(problem: LinearProblem) -> FloatArray:
    """V by brute force: (N·m, N·m)."""
    n, m = problem.y.shape
    variances = problem.model.variances(problem.robot)
    columns = problem.columns.reshape(n * m, -1)
    finite = np.isfinite(variances)
    total = (columns[:, finite] * variances[finite]) @ columns[:, finite].T
    for i in range(n):
        total[i * m : i * m + m, i * m : i * m + m] += problem.covariance[i]
    return total
