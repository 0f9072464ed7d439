"""Planning with model discrepancy: the closed prediction error against simulation and dense algebra."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from robots import SHARED_DATA, mixed, random_configurations

from calib_planner import Robot
from calib_planner.errors import InfeasibleError, InputError
from calib_planner.planning import Candidates, ModelDiscrepancy, PlanProblem, plan
from calib_planner.planning.search.prediction import (
    PredictionModel,
    PredictionProblem,
    choose_for_prediction,
    prediction_problem,
)

WIDE = ModelDiscrepancy(joint_sigma=1e-3, joint_length=0.8, slide_sigma=4e-4, slide_length=0.5, point_sigma=2e-4)


def request(
    robot: Robot, size: int, pool: int = 12, *, discrepancy: ModelDiscrepancy = WIDE
) -> PredictionProblem:
    """A pool and three weighted test poses."""
    problem = PlanProblem(
        robot,
        random_configurations(robot, 3, 5),
        size,
        weights=[1.0, 2.0, 3.0],
        discrepancy=discrepancy,
        candidates=Candidates(random_configurations(robot, pool, 6)),
    )
    return prediction_problem(problem, problem.candidate_array)


def dense(problem: PredictionProblem, rows: list[int]) -> float:
    """Eq. (3) from full matrices: the gain of the estimator and the joint covariance of all errors."""
    robot, process = problem.robot, problem.discrepancy
    q = np.concatenate([problem.candidates[rows], problem.test_poses])
    n, k = len(rows), 3 * len(robot.targets)
    columns, rho = process.joint_columns(robot, q), process.correlation(robot, q, q)
    joint = np.einsum("iaj,jik,kbj->iakb", columns, rho, columns)
    own = process.covariance(robot, q, problem.noise)
    for i in range(len(q)):
        joint[i, :, i] = own[i]
    jacobian = robot.jacobian(q) * problem.prior_std
    design = jacobian[:n].reshape(n * k, -1)
    weight = np.zeros((n * k, n * k))
    for i in range(n):
        weight[i * k : (i + 1) * k, i * k : (i + 1) * k] = np.linalg.inv(own[i])
    gain = np.linalg.solve(design.T @ weight @ design + np.eye(design.shape[1]), design.T @ weight)
    total = 0.0
    for share, t in zip(problem.shares, range(n, len(q)), strict=True):
        bias = jacobian[t] @ (gain @ design - np.eye(design.shape[1]))
        spread = jacobian[t] @ gain
        cross = joint[:n, :, t].reshape(n * k, k)
        total += share * float(
            np.sum(bias**2)
            + np.trace(spread @ joint[:n, :, :n].reshape(n * k, n * k) @ spread.T)
            - 2.0 * np.trace(spread @ cross)
            + np.trace(own[t])
        )
    return total / len(robot.targets)


@pytest.mark.parametrize(
    "make", [mixed, lambda: Robot.load("kuka_kr270").with_parameters("full", ("base", "tool"))]
)
def test_expected_error_against_dense_algebra(make: object) -> None:
    problem = request(make(), 4)  # type: ignore[operator]
    model = PredictionModel(problem)
    for rows in ([0], [3, 1], [2, 5, 7, 11]):
        assert model.error(rows) == pytest.approx(dense(problem, rows), rel=1e-5)
        several = model.errors(rows)
        assert several[9] == pytest.approx(model.error([*rows, 9]), rel=1e-9)


def test_expected_error_against_simulation() -> None:
    problem = request(mixed(), 3)
    robot, process, rng = problem.robot, problem.discrepancy, np.random.default_rng(0)
    rows = [0, 4, 8]
    q = np.concatenate([problem.candidates[rows], problem.test_poses])
    columns, rho = process.joint_columns(robot, q), process.correlation(robot, q, q)
    draws = 20_000
    shape = np.stack([np.linalg.cholesky(r + 1e-10 * np.eye(len(q))) for r in rho])
    function = np.einsum("jik,djk->dij", shape, rng.standard_normal((draws, len(rho), len(q))))
    white = np.hypot(process.point_sigma, problem.noise.typical)
    error = np.einsum("iaj,dij->dia", columns, function)
    error += white * rng.standard_normal(error.shape)
    jacobian = robot.jacobian(q) * problem.prior_std
    truth = rng.standard_normal((draws, jacobian.shape[2]))
    seen = np.einsum("iap,dp->dia", jacobian, truth) + error
    weight = np.linalg.inv(process.covariance(robot, q, problem.noise))[:3]
    information = np.eye(jacobian.shape[2]) + np.einsum("iap,iab,ibr->pr", jacobian[:3], weight, jacobian[:3])
    right = np.einsum("iap,iab,dib->dp", jacobian[:3], weight, seen[:, :3])
    found = np.linalg.solve(information, right.T).T
    off = np.einsum("iap,dp->dia", jacobian[3:], found) - seen[:, 3:]
    squares = (off**2).sum(axis=2).mean(axis=0) / len(robot.targets)
    assert PredictionModel(problem).error(rows) == pytest.approx(problem.shares @ squares, rel=0.05)


def test_choice_against_every_subset() -> None:
    problem = request(mixed(), 3, 10)
    model = PredictionModel(problem)
    best = min(model.error(list(c)) for c in combinations(range(10), 3))
    found = choose_for_prediction(problem, passes=5)
    assert np.exp(-found.log_value) == pytest.approx(model.error(found.rows.tolist()), rel=1e-9)
    assert best * (1 - 1e-9) <= np.exp(-found.log_value) <= 1.1 * best
    assert len(set(found.rows.tolist())) == 3


def test_a_shared_joint_angle_is_worth_less() -> None:
    robot = Robot.load("planar_2r")
    pool = np.array([[0.3, 1.0], [0.3, -1.0], [0.9, -1.0]])  # the third is the second, turned
    asked = PlanProblem(
        robot,
        [[-0.9, 0.4]],
        2,
        discrepancy=ModelDiscrepancy(joint_length=0.2),
        candidates=Candidates(pool),
    )
    model = PredictionModel(prediction_problem(asked, pool))
    assert model.error([0, 2]) < model.error([0, 1])


def test_measured_configurations_count() -> None:
    problem = request(mixed(), 3)
    vars(problem)["measured"] = problem.candidates[:2]
    model = PredictionModel(problem)
    twelve = len(problem.candidates)
    assert model.error([twelve, twelve + 1]) == pytest.approx(model.error([0, 1]))
    assert np.exp(-choose_for_prediction(problem).log_value) < model.error([0, 1])


def test_through_the_planner() -> None:
    robot = Robot.load("kuka_kr270")
    candidates = random_configurations(robot, 60, 1)
    problem = PlanProblem(
        robot, candidates[:5], 6, discrepancy=ModelDiscrepancy(), candidates=Candidates(candidates)
    )
    found, again = plan(problem), plan(problem)
    np.testing.assert_array_equal(found.configurations, again.configurations)
    assert len(np.unique(found.configurations, axis=0)) == 6
    assert 0 < found.quality.efficiency <= 1


@pytest.mark.parametrize(
    "options",
    [{"candidates": None}, {"criterion": "d"}, {"compound": {"d": 0.5}}],
)
def test_what_it_cannot_be_combined_with(options: dict[str, object]) -> None:
    robot = Robot.load("planar_2r")
    candidates = Candidates(random_configurations(robot, 9))
    given = {"candidates": candidates, "discrepancy": ModelDiscrepancy()} | options
    with pytest.raises(InputError, match="discrepancy"):
        PlanProblem(robot, [[0.1, 0.2]], 2, **given)  # type: ignore[arg-type]


def test_bad_values() -> None:
    with pytest.raises(InputError, match="joint_length"):
        ModelDiscrepancy(joint_length=0.0)
    with pytest.raises(InputError, match="point_sigma"):
        ModelDiscrepancy(point_sigma=-1.0)
    problem = request(mixed(), 3)
    vars(problem)["pool"] = problem.candidates[:2]
    with pytest.raises(InfeasibleError, match="2 feasible rows"):
        choose_for_prediction(problem)


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="no measured data here")
def test_all_placement_parameters_of_a_measured_robot() -> None:
    robot = Robot.load(SHARED_DATA / "ur10_tracker" / "ur10.urdf").with_targets([[0.05, 0.02, 0.1]])
    problem = request(robot.with_parameters("full", ("base", "tool")), 12, 40, discrepancy=ModelDiscrepancy())
    model = PredictionModel(problem)
    found = choose_for_prediction(problem)
    chance = [model.error(np.random.default_rng(s).choice(40, 12, replace=False).tolist()) for s in range(20)]
    assert np.exp(-found.log_value) < min(chance)
