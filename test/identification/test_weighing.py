"""What a fit's parameters and residuals scatter like, against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import IdentificationProblem, Measurements, Robot
from calib_planner.identification.weighing import Work, weigh

SIGMA = 2e-5
TARGETS = [[0.1, 0.0, 0.2], [0.0, 0.15, 0.1]]


def erring(seed: int, targets: int, own_std: bool) -> tuple[Robot, Measurements]:
    """Joints with white errors, the same for all repetitions of a configuration; one point is missing."""
    rng = np.random.default_rng(seed)
    robot = Robot.load("kuka_kr270").with_targets(TARGETS[:targets]).with_parameters("lengths+offsets")
    q = np.repeat(random_configurations(robot, 25, seed), [2] * 5 + [1] * 20, axis=0)
    off = np.repeat(4e-4 * rng.standard_normal((25, 6)), [2] * 5 + [1] * 20, axis=0)
    points = robot.positions(q + off)
    std = SIGMA * (rng.uniform(0.5, 3.0, points.shape) if own_std else np.ones(points.shape))
    points = points + std * rng.standard_normal(points.shape)
    points[7, 0] = np.nan
    return robot, Measurements(robot.joint_names, q, points, std)


@pytest.mark.parametrize("targets", [1, 2])
@pytest.mark.parametrize("own_std", [False, True], ids=["one sigma", "std of each"])
def test_scatter_under_a_discrepancy(targets, own_std):
    """cov(Π̂) = N⁻¹JᵀWΣWJN⁻¹ and cov(r) = (I − K)Σ(I − K)ᵀ, K = JN⁻¹JᵀW, with Σ written out."""
    robot, data = erring(1, targets, own_std)
    problem = IdentificationProblem(robot, data)
    work = Work.of(problem, robot, data.seen)
    found = weigh(work, data.seen, np.zeros(len(robot.parameter_names)))
    levels, use = found.levels, data.seen
    assert levels.discrepancy > 5 * SIGMA
    deviations = found.fit.deviations
    rows = np.ascontiguousarray(robot.jacobian(data.q, deviations)).reshape(*data.p.shape, -1)[use]
    rows = rows.reshape(-1, rows.shape[-1])
    variance = (np.asarray(data.std)[use] * levels.scaled).ravel() ** 2
    levers = (
        np.ascontiguousarray(robot.joint_jacobian(data.q)).reshape(*data.p.shape, -1)[use].reshape(len(rows), -1)
    )
    owner = np.repeat(np.repeat(work.labels[:, None], targets, axis=1)[use], 3)
    target = np.repeat(np.repeat(np.arange(targets)[None], len(data), axis=0)[use], 3)
    axis = np.tile(np.arange(3), int(use.sum()))
    same = owner[:, None] == owner[None, :]
    alike = same & (axis[:, None] == axis[None, :])
    sigma = np.diag(variance) + same * (levels.turning**2 * levers @ levers.T)
    sigma += levels.shared**2 * alike + levels.point**2 * (alike & (target[:, None] == target[None, :]))
    mean = np.mean(np.diag(sigma) - variance)
    assert levels.discrepancy == pytest.approx(np.sqrt(mean), rel=1e-9)
    weight = np.diag(1.0 / (variance + mean))
    normal = rows.T @ weight @ rows
    gain = np.linalg.solve(normal, rows.T @ weight)
    np.testing.assert_allclose(found.covariance, gain @ sigma @ gain.T, rtol=1e-6, atol=1e-22)
    left = np.eye(len(rows)) - rows @ gain
    dense = left @ sigma @ left.T
    got = found.residual_covariance()
    for k, block in enumerate(got[use]):
        part = slice(3 * k, 3 * k + 3)
        np.testing.assert_allclose(block, dense[part, part], atol=1e-5 * sigma.max())
    jacobian = np.ascontiguousarray(robot.jacobian(data.q[7], deviations)).reshape(targets, 3, -1)[0]
    outside = found.total[7, 0] + jacobian @ found.covariance @ jacobian.T
    np.testing.assert_allclose(got[7, 0], outside, rtol=1e-5)


def test_without_discrepancy_it_is_equation_11():
    robot, data = erring(2, 1, False)
    quiet = Measurements(data.joint_names, data.q, robot.positions(data.q) + 1e-6, data.std)
    found = weigh(Work.of(IdentificationProblem(robot, quiet), robot, quiet.seen), quiet.seen, np.zeros(9))
    assert found.levels.discrepancy == 0.0
    rows = robot.jacobian(quiet.q, found.fit.deviations).reshape(-1, 9)
    covariance = SIGMA**2 * np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-6, atol=1e-22)
    dense = SIGMA**2 * np.eye(len(rows)) - rows @ covariance @ rows.T
    for k, block in enumerate(found.residual_covariance()[:, 0]):
        np.testing.assert_allclose(block, dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], atol=1e-5 * SIGMA**2)
