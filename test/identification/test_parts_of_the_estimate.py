# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Small parts of the answer of an identification, each against its definition."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from robots import random_configurations
from scipy.stats import chi2

from calib_planner import IdentificationProblem, Measurements, Robot, identify
from calib_planner.error_model import ErrorModel, JointFunctions, Knowledge, typical
from calib_planner.identification import (
    ChiSquare,
    LeftOutError,
    ParameterFit,
    chance_of,
    solver,
    without_noise,
)
from calib_planner.identification.estimate import residual_statistics
from calib_planner.identification.rejection import copied_rows, explain, rejected_since
from calib_planner.identification.solver import (
    _blind_poses,
    _hardly_seen,
    _point_rows,
    _variances,
    _with_fixed,
    place_nominal,
)
from calib_planner.robot import BASE_PARAMETERS, rotation, target_parameters

SIGMA = 3e-5


def kuka(parameters: str) -> Robot:
    return Robot.load("kuka_kr270").with_targets([[0.0, 0.1, 0.05]]).with_parameters(parameters)


@pytest.mark.parametrize(("apart", "told"), [(1e-3, ("1·a - 0.5·c",)), (5e-2, ())])
def test_a_combination_is_hardly_seen_if_unit_columns_almost_cancel(apart: float, told: tuple[str, ...]) -> None:
    """Columns 2·a and c of a design are alike but for ``apart``; d is fixed and has no part."""
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(30, 3))
    columns[:, 2] = 2.0 * columns[:, 0] + 2.0 * apart * columns[:, 2]
    covariance = np.zeros((4, 4))
    covariance[np.ix_([0, 1, 2], [0, 1, 2])] = 1e-8 * np.linalg.inv(columns.T @ columns)
    names = ("a", "b", "c", "d")
    got = _hardly_seen(names, covariance, (3,))
    assert got == told  # the larger change stands first
    assert _hardly_seen(names, covariance, (0, 1, 2, 3)) == ()


def test_a_parameter_that_was_fixed_is_at_its_nominal_value_without_doubt() -> None:
    robot = kuka("d1,q2,d2,q3")
    model = replace(typical(), joint_functions=JointFunctions(("smooth",), 3))
    few = replace(robot, parameter_names=("d1", "q3"))
    names, rng = model.names(few), np.random.default_rng(0)
    half, hidden = rng.normal(size=(len(names), len(names))), rng.normal(size=(len(names), 2))
    known = Knowledge(few, model, rng.normal(size=len(names)), half @ half.T, hidden)
    whole = _with_fixed(known, robot.parameter_names)
    every = list(model.names(robot))
    at = [every.index(name) for name in names]
    rest = [k for k in range(len(every)) if k not in at]
    assert {every[k] for k in rest} == {"q2", "d2"}
    np.testing.assert_array_equal(whole.coefficients[at], known.coefficients)
    np.testing.assert_array_equal(whole.covariance[np.ix_(at, at)], known.covariance)
    np.testing.assert_array_equal(whole.hidden[at], hidden)
    assert (
        not whole.coefficients[rest].any() and not whole.covariance[rest].any() and not whole.hidden[rest].any()
    )
    assert not whole.covariance[:, rest].any()
    assert _with_fixed(whole, robot.parameter_names) is whole


def test_a_test_pose_is_blind_if_it_feels_what_no_point_shows() -> None:
    """Far more, ten times, than any point that was measured, and more than rounding."""
    robot = kuka("d1,q2,q5")
    low, high = robot.joint_limits.T
    q = np.tile(low + 0.4 * (high - low), (4, 1))
    q[:, 0] += [0.0, 0.1, 0.2, 0.3]
    poses = np.vstack([q[0], random_configurations(robot, 2, 3)])
    points = robot.positions(q).copy()
    points[3] = np.nan
    problem = IdentificationProblem(
        robot, Measurements(robot.joint_names, q, points), SIGMA, ErrorModel.paper(), test_poses=poses
    )
    rng = np.random.default_rng(0)
    for scale in (1.0, 1e-8):
        directions = scale * rng.normal(size=(2, 3))
        seen = np.linalg.norm(np.einsum("nij,kj->nki", robot.jacobian(q[:3]), directions), axis=2).max(axis=0)
        felt = np.linalg.norm(np.einsum("nij,kj->nki", robot.jacobian(poses), directions), axis=2)
        expected = (felt > 10.0 * seen + 1e-5).any(axis=1)
        np.testing.assert_array_equal(_blind_poses(problem, robot, directions), expected)
        assert not expected[0]
    assert not _blind_poses(problem, robot, np.zeros((0, 3))).any()
    # One configuration tells three of five; another, where no point was seen, tells nothing.
    more = kuka("d1,q2,d2,q3,q5")
    q = np.vstack([np.tile(q[0], (3, 1)), poses[1]])
    told = Measurements(more.joint_names, q, np.concatenate([more.positions(q[:3]), np.full((1, 1, 3), np.nan)]))
    problem = IdentificationProblem(more, told, SIGMA, ErrorModel.paper(), test_poses=poses)
    directions = np.linalg.svd(more.jacobian(q[:1])[0])[2][3:]
    assert _blind_poses(problem, more, directions).tolist() == [False, True, True]


def test_variances_of_the_points_in_use() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(3, 6, 6))
    part, use = half @ np.swapaxes(half, 1, 2), np.array([[True, False], [True, True], [False, True]])
    expected = [np.trace(part[n, 3 * t : 3 * t + 3, 3 * t : 3 * t + 3]) for n, t in np.argwhere(use)]
    np.testing.assert_allclose(_variances(part, use), expected, rtol=1e-12)


def test_rows_that_are_copies_are_counted() -> None:
    robot = kuka("d1")
    q = random_configurations(robot, 4, 1)[[0, 1, 0, 2, 0, 3]]
    points = robot.positions(q).copy()
    assert copied_rows(Measurements(robot.joint_names, q, points)) == 2
    assert copied_rows(Measurements(robot.joint_names, q[[2, 2, 2, 2]], points[[2, 2, 2, 2]])) == 3
    points[2] += 1e-9
    points[1] = points[3] = np.nan
    assert copied_rows(Measurements(robot.joint_names, q, points)) == 1


@pytest.mark.parametrize(
    ("visits", "gone", "since"),
    [
        (40, range(35, 40), 35),  # one of 658008 choices
        (40, (34, 36, 37, 38, 39), None),  # not the last ones
        (40, range(38, 40), None),  # one of 780: it may be chance
        (46, range(44, 46), 44),  # one of 1035
        (1000, range(999, 1000), None),  # one of a thousand is not less than that
        (1001, range(1000, 1001), 1000),
        (40, range(40), None),
        (40, (), None),
    ],
)
def test_something_moved_if_the_last_visits_are_rejected(visits: int, gone: range, since: int | None) -> None:
    seen, use = np.ones((visits, 2), bool), np.ones((visits, 2), bool)
    use[list(gone)] = False
    assert rejected_since(seen, use) == since
    seen = np.vstack([np.zeros((3, 2), bool), seen])  # visits without a point do not count
    use = np.vstack([np.zeros((3, 2), bool), use])
    assert rejected_since(seen, use) == (None if since is None else since + 3)


def test_what_happened_to_points_that_fit_elsewhere() -> None:
    robot = Robot.load("kuka_kr270").with_targets([[0.0, 0.1, 0.05], [0.2, 0.0, 0.1], [0.0, -0.2, 0.0]])
    q = random_configurations(robot, 8, 2)
    predicted = robot.positions(q)
    points, rejected = predicted + 1e-5, np.zeros((8, 3), bool)
    points[1, [0, 2]] = points[1, [2, 0]]
    rejected[1, [0, 2]] = True
    points[[3, 4]] = points[[4, 3]]
    points[3, 0] += 0.2  # wrong besides
    rejected[[3, 4]] = True
    points[6, 1] = predicted[2, 1] + 2e-5
    rejected[6, 1] = True
    points[7, 0] += 0.3
    rejected[7, 0] = True
    points[5] = points[5, [1, 2, 1]]
    rejected[5] = True
    words = explain(predicted, Measurements(robot.joint_names, q, points), rejected, 1e-4)
    expected = {
        (1, 0): "fits target 3: targets exchanged?",
        (1, 2): "fits target 1: targets exchanged?",
        (6, 1): "fits the configuration of row 2: rows exchanged?",
        (5, 0): "fits target 2: targets exchanged?",
        (5, 1): "fits target 3: targets exchanged?",
        (5, 2): "fits target 2: targets exchanged?",
    }
    for target in range(3):
        expected[3, target] = "fits the configuration of row 4: rows exchanged?"
        expected[4, target] = "fits the configuration of row 3: rows exchanged?"
    assert words == expected
    assert explain(predicted, Measurements(robot.joint_names, q, points), rejected, 1e-6) == {}


def test_base_and_targets_of_the_nominal_robot_are_those_of_least_squares() -> None:
    """No small motion of the base or of the targets brings the points nearer."""
    robot = Robot.load("kuka_kr270").with_targets([[0.0, 0.1, 0.05], [0.2, 0.0, 0.1]])
    robot = robot.with_parameters("full", ("base", "tool"))
    rng, q = np.random.default_rng(0), random_configurations(robot, 12, 2)
    real = robot.with_base(rotation(2, 1.1) @ rotation(0, 0.3), [1.0, -2.0, 0.5])
    points = real.with_targets([[0.1, 0.0, 0.2], [0.0, -0.1, 0.1]]).positions(q).copy()
    points += 5e-3 * rng.standard_normal(points.shape)
    points[3, 1] = np.nan
    data = Measurements(robot.joint_names, q, points)
    placed = place_nominal(IdentificationProblem(robot, data, SIGMA, ErrorModel.paper()))
    names = [*BASE_PARAMETERS, *target_parameters(2)]
    free = replace(placed, parameter_names=tuple(names))
    apart = np.where(data.seen[:, :, None], points - placed.positions(q), 0.0).ravel()
    jacobian = free.jacobian(q).reshape(72, -1) * np.repeat(data.seen.ravel(), 3)[:, None]
    scale = np.linalg.norm(jacobian, axis=0) * np.linalg.norm(apart)
    np.testing.assert_allclose(jacobian.T @ apart / scale, 0.0, atol=1e-7)
    own = robot.with_parameters("full")
    assert place_nominal(IdentificationProblem(own, data, SIGMA, ErrorModel.paper())) is own


def test_a_rejected_point_belongs_elsewhere_if_it_fits_there_as_others_fit_their_places() -> None:
    robot = kuka("d1,q2")
    q = random_configurations(robot, 8, 2)
    predicted = robot.positions(q)
    points, out = predicted + 1e-4, np.zeros((8, 1), bool)
    points[3, 0], points[5, 0] = predicted[6, 0] + 2e-4, predicted[1, 0] + 3.5e-4
    out[[3, 5]] = True
    problem = IdentificationProblem(
        robot, Measurements(robot.joint_names, q, points), SIGMA, ErrorModel.paper(3e-5)
    )
    normalised = np.where(out, 50.0, 1.0)
    normalised[5] = 3.0
    near, far = _point_rows(problem, predicted, normalised, out, 4.0)
    assert [(point.row, point.target) for point in (near, far)] == [(3, 1), (5, 1)]
    assert far.residual == pytest.approx(np.linalg.norm(points[5] - predicted[5]), rel=1e-12)
    assert (near.normalised_residual, far.normalised_residual) == (50.0, 3.0)
    assert "fits the configuration of row 6" in near.reason and "50 standard deviations (gate 4)" in near.reason
    assert "shifted" not in near.reason
    assert "fits" not in far.reason and "one of a run of visits that are all shifted" in far.reason


def test_freedom_of_the_left_out_error_is_that_of_a_square_of_that_spread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A χ² with f degrees of freedom has a root mean square that is 1/√(2f) of itself uncertain."""
    robot = kuka("d1,q2,d2,q3")
    q = random_configurations(robot, 10, 2)
    points = robot.positions(q) + SIGMA * np.random.default_rng(0).standard_normal((10, 1, 3))
    problem = IdentificationProblem(
        robot, Measurements(robot.joint_names, q, points), SIGMA, ErrorModel.paper(SIGMA)
    )
    fit = identify(problem).model_fit
    assert fit is not None
    assert solver._spare(fit) == pytest.approx(30.0 - 4.0)
    monkeypatch.setattr(solver, "_spare", lambda fit: np.inf)
    freedom = solver._freedom_left_out(fit.left_out, fit)
    assert 1.0 / np.sqrt(2.0 * freedom) == pytest.approx(fit.left_out.excess[1], rel=1e-9)
    monkeypatch.setattr(solver, "_spare", lambda fit: 0.1)
    assert solver._freedom_left_out(fit.left_out, fit) == 0.1


def test_what_the_fit_leaves_counts_configurations_once_and_parameters_by_what_the_data_tell() -> None:
    """Of a parameter with a prior that is 1 − C/σ², of one without it all."""
    robot = kuka("d1,q2,d2,q3")
    q = random_configurations(robot, 9, 2)[[0, 1, 2, 3, 4, 5, 6, 7, 8, 2, 2]]
    points = robot.positions(q) + SIGMA * np.random.default_rng(0).standard_normal((11, 1, 3))
    points[2] = points[5] = np.nan
    model = replace(typical(), joint_functions=None)
    estimate = identify(
        IdentificationProblem(robot, Measurements(robot.joint_names, q, points), error_model=model)
    )
    fit = estimate.model_fit
    assert fit is not None and len(set(fit.left_out.groups.tolist())) == 9
    names, covariance = fit.origin.scales
    assert names and estimate.scale_spread == dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))
    assert replace(estimate, model_fit=None).scale_spread == {}  # as it is read from a file
    variances = fit.knowledge.model.variances(fit.knowledge.robot)[:4]
    told = 1.0 - np.diag(fit.knowledge.covariance)[:4] / variances
    assert np.isfinite(variances).all() and (told > 0.0).all() and (told < 1.0).all() and told.min() < 0.95
    assert solver._spare(fit) == pytest.approx(3.0 * 8 - told.sum(), rel=1e-9)


# ── statistics ───────────────────────────────────────────────────────────────────────────────────────


def test_chance_makes_a_root_mean_square_larger_by_this_factor_once_in_a_hundred() -> None:
    for freedom in (1.0, 3.0, 7.5, 400.0):
        assert chi2.sf(freedom * chance_of(freedom) ** 2, freedom) == pytest.approx(0.01, rel=1e-6)
    assert chance_of(np.inf) == 1.0 and chance_of(0.99) == np.inf


def test_the_noise_is_taken_off_a_mean_square() -> None:
    """Five is what three and four make; by chance it was larger first."""
    assert without_noise(25.0, 9.0) == pytest.approx(4.0) and without_noise(8.0, 9.0) == 0.0
    larger = chance_of(12.0) ** 2
    assert without_noise(25.0 * larger, 9.0, 12.0) == pytest.approx(4.0)
    part = LeftOutError(4, 1.0, 5.0, 9.0, 5.0, 3.0, 12.0)
    assert part.robot_rms == pytest.approx(4.0)
    assert replace(part, rms=5.0 * np.sqrt(larger)).robot_least == pytest.approx(4.0)
    unknown = replace(part, noise_rms=np.nan)
    assert unknown.robot_rms == 5.0 and unknown.robot_least == pytest.approx(5.0 / np.sqrt(larger))


def test_statistics_of_distances_and_of_none() -> None:
    told = residual_statistics(np.array([3.0, 4.0, 0.0]))
    assert (told.mean, told.rms, told.max) == pytest.approx((7.0 / 3.0, 5.0 / np.sqrt(3.0), 4.0))
    nothing = residual_statistics(np.empty(0))
    assert np.isnan([nothing.mean, nothing.rms, nothing.max]).all()


def test_probability_of_a_sum_of_squares() -> None:
    assert ChiSquare(20.0, 7).probability == pytest.approx(chi2.sf(20.0, 7))
    assert ChiSquare(2.0, 1).probability == pytest.approx(chi2.sf(2.0, 1))
    assert np.isnan(ChiSquare(2.0, 0).probability) and np.isnan(ChiSquare(np.nan, 7).probability)


def test_the_rank_is_the_number_of_parameters_that_the_data_tell() -> None:
    """The height of an unknown base is that of the pedestal."""
    robot = Robot.load("kuka_kr270").with_parameters("d0,d2", ("base",))
    q = random_configurations(robot, 8, 2)
    problem = IdentificationProblem(
        robot, Measurements(robot.joint_names, q, robot.positions(q)), SIGMA, ErrorModel.paper()
    )
    sight = identify(problem).observability
    assert sight.rank == 7 and sight.fixed == ("d0",)


def test_correlated_pairs_are_named_the_strongest_first() -> None:
    """Standard deviations 2, 1, 3 and a fixed parameter; beyond 0.95 in either direction."""
    unit = np.array([[1.0, 0.96, 0.2, 0.0], [0.96, 1.0, -0.97, 0.0], [0.2, -0.97, 1.0, 0.0], [0.0] * 4])
    std = np.array([2.0, 1.0, 3.0, 0.0])
    names, zeros = ("a", "b", "c", "d"), np.zeros(4)
    fit = ParameterFit(names, ("m",) * 4, zeros, zeros, std, unit * np.outer(std, std), 1, "ok")
    (one, other) = fit.correlations
    assert one[:2] == ("b", "c") and one[2] == pytest.approx(-0.97)
    assert other[:2] == ("a", "b") and other[2] == pytest.approx(0.96)


def test_accuracy_at_test_poses_by_its_parts() -> None:
    robot = kuka("d1,q2,d2,q3")
    q, poses = random_configurations(robot, 12, 2), random_configurations(robot, 3, 5)
    points = robot.positions(q) + SIGMA * np.random.default_rng(0).standard_normal((12, 1, 3))
    data = Measurements(robot.joint_names, q, points)
    problem = IdentificationProblem(robot, data, SIGMA, ErrorModel.paper(SIGMA), test_poses=poses)
    began = time.perf_counter()
    estimate = identify(problem)
    assert 0.0 < estimate.seconds < time.perf_counter() - began
    told = estimate.accuracy
    rows = robot.jacobian(poses, estimate.fit.deviations)
    expected = np.sqrt(np.trace(rows @ estimate.fit.covariance @ np.swapaxes(rows, 1, 2), axis1=1, axis2=2))
    np.testing.assert_allclose(told.predicted, expected, rtol=1e-6)
    np.testing.assert_allclose(told.parameters, expected, rtol=1e-6)
    assert told.overall == pytest.approx(np.sqrt(np.mean(expected**2))) and told.worst == expected.max()
    blind = replace(told, predicted=np.array([1.0, np.inf, 1.0]))
    np.testing.assert_array_equal(np.isinf(blind.parameters), [False, True, False])
    none = identify(replace(problem, test_poses=None)).accuracy
    assert np.isnan([none.overall, none.worst]).all() and not none.parameters.size
    np.testing.assert_allclose(
        estimate.positions(poses), robot.positions(poses, estimate.fit.deviations), atol=1e-12
    )
    values = dict(zip(robot.parameter_names, [p.nominal for p in robot.parameters], strict=True))
    for name, value, off in zip(
        estimate.fit.parameters, estimate.fit.values, estimate.fit.deviations, strict=True
    ):
        assert value == pytest.approx(values[name] + off)
    np.testing.assert_allclose(estimate.placement_values, estimate.fit.values, atol=1e-12)
    assert estimate.noise_source == "as given" and estimate.scale_spread == {}
    for told_of, deviations in (
        (estimate.residuals.before, np.zeros(4)),
        (estimate.residuals.after, estimate.fit.deviations),
        (estimate.residuals.placement_alone, estimate.fit.deviations),
    ):
        lengths = np.linalg.norm(points - robot.positions(q, deviations), axis=2)
        assert told_of.mean == pytest.approx(lengths.mean(), rel=1e-6)
        assert told_of.rms == pytest.approx(np.sqrt(np.mean(lengths**2)), rel=1e-6)
        assert told_of.max == pytest.approx(lengths.max(), rel=1e-6)
