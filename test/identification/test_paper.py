# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The paper's model is plain least squares, eqs. (6), (7) and (11): against scipy and the covariance formula."""

from __future__ import annotations

import numpy as np
import pytest
from cells import SIGMA, bare, placed_cell, plain_cell
from robots import mixed, random_configurations
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from calib_planner import Estimate, IdentificationProblem, Measurements, NotEnoughDataError, Robot, identify
from calib_planner.error_model import ErrorModel
from calib_planner.simulation import SimulatedCell, random_deviations
from calib_planner.tracker import LaserTracker

KUKA = Robot.load("kuka_kr270")
POSES = np.array(
    [[0.2, -1.0, 1.2, 0.4, 0.6, 0.0], [0.4, -1.3, 1.0, -0.5, 0.9, 0.3], [-0.3, -0.8, 1.5, 0.1, -0.7, 0.0]]
)
TRACKER = LaserTracker(station=np.array([6.0, -2.0, 1.0]), azimuth=1.5e-5, elevation=3e-5)


def plain(robot: Robot, data: Measurements, sigma: float | None = None, **options: object) -> Estimate:
    return identify(IdentificationProblem(robot, data, sigma, error_model=ErrorModel.paper(), **options))


def least_squares_of(
    robot: Robot, data: Measurements, left: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Deviations, residuals and Jacobian (numeric) of scipy's least squares; ``left`` whitens the points."""
    scale = np.full(len(robot.parameter_names), 1e-3)  # near the size of the deviations [m | rad]
    white = np.eye(data.p.size) if left is None else left

    def residuals(scaled: np.ndarray) -> np.ndarray:
        return white @ (data.p - robot.positions(data.q, scaled * scale)).ravel()

    def differences(scaled: np.ndarray) -> np.ndarray:
        """Central: one-sided ones are not exact enough to find the minimum to a thousandth of a deviation."""
        steps = 1e-3 * np.eye(len(scaled))
        return np.stack([(residuals(scaled + s) - residuals(scaled - s)) / 2e-3 for s in steps], axis=1)

    tight = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
    oracle = least_squares(residuals, np.zeros(len(scale)), differences, method="lm", **tight)
    return oracle.x * scale, oracle.fun, oracle.jac / scale


@pytest.mark.parametrize("sigma", [SIGMA, None], ids=["stated", "unknown"])
@pytest.mark.parametrize("name", ["kuka", "mixed"])
def test_values_and_covariance_are_those_of_least_squares(name: str, sigma: float | None) -> None:
    """Where σ is unknown, it is the scatter of the residuals, with the degrees of freedom that are left."""
    robot = KUKA if name == "kuka" else mixed().with_parameters("offsets")
    cell = SimulatedCell(robot, random_deviations(robot, 2), SIGMA)
    data = bare(cell.measure(random_configurations(robot, 25, 2), 1, 2))
    poses = random_configurations(robot, 3, 8)
    estimate = plain(robot, data, sigma, test_poses=poses)
    deviations, residuals, jacobian = least_squares_of(robot, data)
    scatter = np.sqrt(np.sum(residuals**2) / (residuals.size - len(deviations)))
    level = scatter if sigma is None else sigma
    covariance = level**2 * np.linalg.inv(jacobian.T @ jacobian)
    std = np.sqrt(np.diag(covariance))
    assert estimate.fit.status == "ok" and estimate.observability.rank == len(deviations)
    np.testing.assert_allclose(estimate.fit.deviations, deviations, rtol=0, atol=1e-3 * std.min())
    np.testing.assert_allclose(
        estimate.fit.covariance / np.outer(std, std), covariance / np.outer(std, std), atol=1e-4
    )
    np.testing.assert_allclose(estimate.residuals.vectors.ravel(), residuals, rtol=0, atol=1e-8)
    assert estimate.residuals.sigma == pytest.approx(scatter, rel=1e-4)
    assert estimate.noise.sigma == pytest.approx(level, rel=1e-4)
    at = robot.jacobian(poses, deviations)
    accuracy = np.sqrt(np.einsum("kip,pq,kiq->k", at, covariance, at) / len(robot.targets))
    np.testing.assert_allclose(estimate.accuracy.predicted, accuracy, rtol=1e-4)
    assert estimate.accuracy.overall == pytest.approx(np.sqrt(np.mean(accuracy**2)), rel=1e-4)
    assert not estimate.points.rejected and [t.name for t in estimate.terms] == ["placement", "points"]


def test_an_instrument_weighs_each_point_by_its_direction() -> None:
    true = KUKA.with_deviations(random_deviations(KUKA, 3)).positions(q := random_configurations(KUKA, 12, 3))
    unit = np.random.default_rng(8).standard_normal((*true.shape, 1))
    points = true + (np.linalg.cholesky(TRACKER.covariance(true)) @ unit)[..., 0]
    data = Measurements(KUKA.joint_names, q, points)
    estimate = plain(KUKA, data, instrument=TRACKER)
    left = np.linalg.inv(np.linalg.cholesky(block_diag(*TRACKER.covariance(points).reshape(-1, 3, 3))))
    deviations, _, jacobian = least_squares_of(KUKA, data, left)
    std = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    # The covariance is that at the predicted points, a ten-thousandth of a standard deviation from these.
    np.testing.assert_allclose(estimate.fit.deviations / std, deviations / std, rtol=0, atol=5e-3)
    np.testing.assert_allclose(estimate.fit.std, std, rtol=1e-3)


def test_what_nothing_tells_stays_fixed_and_predictions_are_those_of_least_squares() -> None:
    """Base and tool unknown: scipy's own minimum and the pseudo-inverse of its Jacobian."""
    cell, robot = placed_cell(3)
    data = bare(cell.measure(random_configurations(robot, 30, 3), 1, 3))
    estimate = plain(robot, data, SIGMA, test_poses=POSES)
    assert estimate.fit.status == "rank_deficient"
    sight = estimate.observability
    assert sight.rank == len(robot.parameter_names) - len(sight.fixed)
    assert len(sight.fixed) == len(sight.unidentifiable) > 10
    fixed = [estimate.fit.parameters.index(n) for n in sight.fixed]
    assert np.isnan(estimate.fit.std[fixed]).all() and not estimate.fit.deviations[fixed].any()
    start = estimate.knowledge.robot
    deviations, residuals, jacobian = least_squares_of(start, data)
    reached = start.positions(POSES, deviations)
    np.testing.assert_allclose(estimate.positions(POSES), reached, rtol=0, atol=1e-2 * SIGMA)
    assert np.sum(estimate.residuals.vectors**2) == pytest.approx(np.sum(residuals**2), rel=1e-5)
    norms = np.linalg.norm(jacobian, axis=0)
    scale = np.where(norms > 0.0, norms, 1.0)
    inverse = SIGMA**2 * np.linalg.pinv(jacobian / scale, rcond=1e-6)
    covariance = inverse @ inverse.T / SIGMA**2 / np.outer(scale, scale)
    at = start.jacobian(POSES, deviations)
    accuracy = np.sqrt(np.einsum("kip,pq,kiq->k", at, covariance, at) / len(robot.targets))
    np.testing.assert_allclose(estimate.accuracy.predicted, accuracy, rtol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_covariance_is_equation_11(seed: int) -> None:
    cell, robot = plain_cell(seed)
    data = bare(cell.measure(random_configurations(robot, 8, seed), 1, seed))
    estimate = plain(robot, data, SIGMA)
    jacobian = robot.jacobian(data.q, estimate.fit.deviations).reshape(-1, 9)
    expected = SIGMA**2 * np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(estimate.fit.covariance, expected, rtol=1e-5, atol=1e-20)


def test_predicted_accuracy_matches_what_happens() -> None:
    """Predicted ρ0, eq. (14), against the root mean square over 200 simulated calibrations."""
    pose = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])
    cell = SimulatedCell(KUKA, random_deviations(KUKA, 5), SIGMA)
    q = random_configurations(KUKA, 8, 8)
    squares, predicted = [], []
    for seed in range(200):
        estimate = plain(KUKA, bare(cell.measure(q, 1, seed)), SIGMA, test_poses=pose)
        squares.append(cell.position_errors(estimate.calibrated, pose)[0, 0] ** 2)
        predicted.append(estimate.accuracy.overall)
    error = 0.5 * np.std(squares) / np.mean(squares) / np.sqrt(len(squares))
    assert np.sqrt(np.mean(squares)) == pytest.approx(np.mean(predicted), rel=4 * error)


def test_every_point_counts_and_a_far_one_is_said() -> None:
    cell, robot = plain_cell(4)
    data = bare(cell.measure(random_configurations(robot, 25, 4), 1, 4))
    points = np.array(data.p)
    points[7] += 0.01
    estimate = plain(robot, bare(data, points), SIGMA)
    assert not estimate.points.rejected and estimate.points.used == 25
    assert 7 in {s.row for s in estimate.points.suspects} and estimate.verdict.level != "PASS"


def test_what_no_visit_shows_makes_the_accuracy_infinite() -> None:
    q = np.repeat(random_configurations(KUKA, 1, 5), 15, axis=0)
    q[:, 0] = np.linspace(-1, 1, 15)
    cell, _ = plain_cell(1)
    estimate = plain(KUKA, bare(cell.measure(q, 1, 5)), SIGMA, test_poses=POSES)
    assert np.isinf(estimate.accuracy.predicted).all() and estimate.verdict.level == "FAIL"


def test_too_few_points_are_refused_with_how_many_are_needed() -> None:
    cell, robot = plain_cell(1)
    data = bare(cell.measure(random_configurations(robot, 2, 1), 1, 1))
    with pytest.raises(NotEnoughDataError, match="at least 3 configurations"):
        plain(robot, data)
