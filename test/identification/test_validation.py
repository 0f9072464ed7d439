# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What was predicted for held-out points is what happens there, over many cells; the bookkeeping is exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import SIGMA, WrongRobot, bare, placed_cell, plain_cell, spoil
from robots import random_configurations, repeats
from scipy.stats import chi2

from calib_planner import (
    IdentificationProblem,
    InputError,
    Measurements,
    NotEnoughDataError,
    Robot,
    identify,
    validate,
)
from calib_planner.error_model import ErrorModel, JointFunctions, Knowledge, typical
from calib_planner.identification.validation import _Prediction, _squared_trace, _statistics, normalised
from calib_planner.simulation import SimulatedCell


def plain(seed: int, count: int = 12):
    cell, asked = plain_cell(seed)
    data = bare(cell.measure(random_configurations(asked, count, seed), 1, seed))
    fresh = bare(cell.measure(random_configurations(asked, 25, seed + 500), 1, seed + 500))
    return IdentificationProblem(asked, data, SIGMA, ErrorModel.paper()), [fresh], 0


def placed(seed: int):
    cell, asked = placed_cell(seed)
    data = bare(cell.measure(random_configurations(asked, 30, seed), 1, seed))
    fresh = bare(cell.measure(random_configurations(asked, 20, seed + 500), 1, seed + 500))
    return IdentificationProblem(asked, data), [fresh], 0


def wrong(seed: int):
    robot = WrongRobot(seed)
    data = robot.measure(random_configurations(robot.asked, 40, seed))
    fresh = robot.measure(random_configurations(robot.asked, 25, seed + 500))
    problem = IdentificationProblem(robot.asked, data, sigma=SIGMA)
    return problem, [fresh], 0


def reseated(seed: int):
    """The target sits elsewhere for each of two validation sets."""
    cell, asked = plain_cell(seed)
    data = bare(cell.measure(random_configurations(asked, 12, seed), 1, seed))
    sets = []
    for k in range(2):
        rng = np.random.default_rng([seed, k])
        seat = cell.truth.robot.target_offsets + rng.normal(0, 2e-3, (1, 3))
        moved = SimulatedCell(cell.truth.robot.with_targets(seat), {}, SIGMA)
        q = random_configurations(asked, 15, seed + 500 + k)
        points = moved.truth.positions(q)
        sets.append(Measurements(asked.joint_names, q, points + SIGMA * rng.standard_normal(points.shape)))
    return IdentificationProblem(asked, data, SIGMA, ErrorModel.paper()), sets, 4


@pytest.mark.parametrize(
    ("make", "seeds"),
    [(plain, 40), (placed, repeats(2, 8)), (wrong, repeats(4, 25)), (reseated, repeats(20, 40))],
)
def test_achieved_is_what_was_predicted(make, seeds):
    """Mean squares over seeds, and 95 % of the points in their regions.

    Where the error model has terms that the truth has not (``placed``), or none for what the truth has (an error
    of each configuration, ``wrong``), the root mean square predicted is 0.85 to 1.2 times the one achieved.
    """
    achieved, predicted, inside, better = [], [], [], 0
    for seed in range(seeds):
        problem, held_out, target_from = make(seed)
        told = validate(problem, identify(problem), held_out, target_from).validation
        assert told.count == sum(s.seen[target_from:].sum() for s in held_out)
        achieved.append(told.rms**2)
        predicted.append(told.predicted_rms**2)
        inside.append(told.within_95)
        better += told.mean < told.before_mean
    assert better == seeds
    if make in (placed, wrong):
        assert 0.85 < np.sqrt(np.mean(predicted) / np.mean(achieved)) < 1.2
        assert np.mean(inside) > 0.92
        return
    error = np.std(achieved) / np.mean(achieved) / np.sqrt(seeds)
    assert np.mean(achieved) / np.mean(predicted) == pytest.approx(1.0, abs=4 * error + 0.02)
    assert np.mean(inside) == pytest.approx(0.95, abs=4 * np.std(inside) / np.sqrt(seeds) + 0.005)


def test_statistics_are_those_of_the_distances():
    """Against positions by hand; missing points do not count."""
    problem, (fresh,), _ = plain(1)
    points = np.array(fresh.p)
    points[[2, 9]] = np.nan
    estimate = validate(problem, identify(problem), [bare(fresh, points)])
    told = estimate.validation

    def length(there):
        every = np.linalg.norm(points - there, axis=2)[:, 0]
        return every[np.isfinite(every)]

    complete, alone = length(estimate.positions(fresh.q)), length(estimate.calibrated.positions(fresh.q))
    nominal = length(problem.robot.positions(fresh.q))
    got = (told.count, told.mean, told.median, told.rms, told.max, told.before_mean)
    rms = np.sqrt(np.mean(complete**2))
    expected = (23, complete.mean(), np.median(complete), rms, complete.max(), nominal.mean())
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    np.testing.assert_allclose(told.placement_mean, alone.mean(), rtol=1e-12)
    np.testing.assert_allclose(told.placement_rms, np.sqrt(np.mean(alone**2)), rtol=1e-12)
    assert told.noise_rms == pytest.approx(np.sqrt(3.0) * estimate.noise.sigma)


def test_a_target_that_was_seated_anew_is_placed_by_the_first_rows_of_its_set():
    """Offsets by least squares on p = R t + o of the first four rows, of the nominal and the calibrated robot."""
    problem, held_out, seat = reseated(2)
    estimate = validate(problem, identify(problem), held_out, seat)
    frame, lengths = np.vstack([np.zeros(3), np.eye(3)]), {"calibrated": [], "nominal": []}
    for name, robot in (("calibrated", estimate.calibrated), ("nominal", problem.robot)):
        for data in held_out:
            tips = replace(robot, parameter_names=()).with_targets(frame).positions(data.q)
            turns, origins = (tips[:, 1:] - tips[:, :1]).transpose(0, 2, 1), tips[:, 0]
            right = (data.p[:seat, 0] - origins[:seat]).ravel()
            offset = np.linalg.lstsq(turns[:seat].reshape(-1, 3), right, rcond=None)[0]
            lengths[name].append(
                np.linalg.norm(data.p[seat:, 0] - origins[seat:] - turns[seat:] @ offset, axis=1)
            )
    alone, before = (np.concatenate(lengths[name]) for name in ("calibrated", "nominal"))
    told = estimate.validation
    assert told.placement_mean == pytest.approx(alone.mean(), rel=1e-6)
    assert told.placement_rms == pytest.approx(np.sqrt(np.mean(alone**2)), rel=1e-6)
    assert told.before_mean == pytest.approx(before.mean(), rel=1e-6) and told.count == 22


def test_left_out_errors_are_those_of_fits_without_the_visit():
    """(M4) against one fit of plain least squares a visit, by hand; and what is predicted is achieved."""
    ratios = []
    for seed in range(12):
        cell, robot = plain_cell(seed)
        data = bare(cell.measure(random_configurations(robot, 15, seed), 1, seed))
        problem = IdentificationProblem(robot, data, SIGMA, ErrorModel.paper())
        left = identify(problem).left_out
        assert left.count == 15
        ratios.append((left.rms / left.predicted_rms) ** 2)
    assert np.mean(ratios) == pytest.approx(1.0, abs=4 * np.std(ratios) / np.sqrt(len(ratios)))
    lengths = []
    for k in range(15):
        part = identify(replace(problem, data=data.select(np.setdiff1d(np.arange(15), [k]))))
        lengths.append(np.linalg.norm(data.p[k] - part.calibrated.positions(data.q[[k]])[0]))
    assert left.rms == pytest.approx(float(np.sqrt(np.mean(np.square(lengths)))), rel=1e-3)
    assert left.max == pytest.approx(max(lengths), rel=1e-3)


@pytest.mark.parametrize("held_out", [False, True])
def test_chance_moves_errors_as_far_as_the_degrees_of_freedom_say(held_out):
    """Variance of the mean square over many robots against that of a χ² with ``freedom``."""
    squares, freedom = [], []
    robot = plain_cell(0)[1]
    q = random_configurations(robot, 12, 1)
    rows = np.arange(6)
    for seed in range(repeats(60, 200)):
        cell = plain_cell(seed)[0]
        data = bare(cell.measure(q, 1, seed))
        problem = IdentificationProblem(robot, data.select(rows), SIGMA, ErrorModel.paper())
        estimate = identify(problem)
        if held_out:
            estimate = validate(problem, estimate, [data.select(np.setdiff1d(np.arange(12), rows))])
        told = estimate.validation if held_out else estimate.left_out
        squares.append((told.rms / told.predicted_rms) ** 2)
        freedom.append(told.freedom)
    expected = 2.0 / np.mean(freedom)
    assert np.mean(squares) == pytest.approx(1.0, abs=4 * np.sqrt(expected / len(squares)))
    assert np.var(squares) == pytest.approx(expected, rel=0.6)


def test_rejected_points_take_no_part_in_the_left_out_error():
    cell, robot = plain_cell(3)
    spoilt, bad = spoil(cell.measure(random_configurations(robot, 40, 3), 1, 3), 3, exchange=False)
    estimate = identify(IdentificationProblem(robot, spoilt, SIGMA))
    left = estimate.left_out
    assert left.count == 40 - bad.sum() == estimate.points.used
    assert left.max < 20 * SIGMA


def test_a_robot_that_changed_is_told():
    """Joint 2 slipped by a milliradian between the two sets."""
    problem, (fresh,), _ = plain(4)
    slipped = problem.robot.with_parameters("q2").with_deviations({"q2": 1e-3})
    moved = slipped.positions(fresh.q) - problem.robot.positions(fresh.q)
    found = validate(problem, identify(problem), [bare(fresh, fresh.p + moved)])
    assert found.validation.rms > 3 * found.validation.predicted_rms
    assert found.validation.within_95 < 0.5
    assert found.verdict.level == "FAIL"


def test_refusals():
    problem, (fresh,), _ = plain(5)
    estimate = identify(problem)
    with pytest.raises(InputError, match="validate_target_from"):
        validate(problem, estimate, [fresh], -1)
    with pytest.raises(NotEnoughDataError, match="nothing is left to test"):
        validate(problem, estimate, [fresh.select(np.arange(3))], 3)
    with pytest.raises(NotEnoughDataError, match="no measured point"):
        validate(problem, estimate, [bare(fresh, np.full(fresh.p.shape, np.nan))])
    with pytest.raises(InputError, match="targets"):
        validate(problem, estimate, [bare(fresh, np.repeat(fresh.p, 2, axis=1))])


def test_what_all_points_share_is_in_the_trace_of_their_covariance() -> None:
    """tr S² with S of all measured coordinates written out; points that were not seen have no part in it."""
    robot = Robot.load("ur10e").with_targets([[0.0, 0.05, 0.1], [0.08, -0.03, 0.05]])
    robot = robot.with_parameters("full", ("base", "tool"))
    model = replace(typical(), joint_functions=JointFunctions(harmonics=4))
    known = Knowledge.of_plan(robot, model, random_configurations(robot, 20, 1))
    q = random_configurations(robot, 4, 2)
    points = robot.positions(q).copy()
    points[1, 0] = points[3] = np.nan
    data = Measurements(robot.joint_names, q, points)
    poses = known.poses(q)
    rows = known.model.columns(poses).reshape(24, -1)
    whole = rows @ known.covariance @ rows.T
    for visit, own in enumerate(known.model.visit_covariance(poses)):
        whole[6 * visit : 6 * visit + 6, 6 * visit : 6 * visit + 6] += own
    use = np.flatnonzero(np.repeat(data.seen.ravel(), 3))
    assert _squared_trace(known, data) == pytest.approx(np.sum(whole[np.ix_(use, use)] ** 2), rel=1e-6, abs=0.0)
    alone = Measurements(robot.joint_names, q, points[:, :1])  # of one target where two are known
    use = np.flatnonzero(np.repeat(np.stack([data.seen[:, 0], np.zeros(4, bool)], axis=1).ravel(), 3))
    assert _squared_trace(known, alone) == pytest.approx(np.sum(whole[np.ix_(use, use)] ** 2), rel=1e-6, abs=0.0)


def test_mahalanobis_lengths_and_how_many_are_inside() -> None:
    rng = np.random.default_rng(0)
    half, residuals = rng.normal(size=(5, 2, 3, 3)), rng.normal(size=(5, 2, 3))
    covariance = half @ np.swapaxes(half, 2, 3) + np.eye(3)
    residuals[3, 1] = np.nan
    got = normalised(residuals, covariance)
    assert np.isnan(got[3, 1]) and np.isnan(got).sum() == 1
    for place in np.argwhere(np.isfinite(got)):
        error = residuals[tuple(place)]
        expected = np.sqrt(error @ np.linalg.solve(covariance[tuple(place)], error))
        assert got[tuple(place)] == pytest.approx(expected, rel=1e-9)
    lengths = np.linalg.norm(residuals, axis=2)[:3].ravel()
    parts = [
        _Prediction(
            residuals[k],
            covariance[k],
            np.full((2, 3), 0.25),
            np.array([1.0, 2.0]),
            np.array([3.0, 5.0]),
            float(k + 1),
        )
        for k in range(3)
    ]
    told = _statistics(parts)
    traces = np.trace(covariance[:3], axis1=2, axis2=3).ravel()
    expected = {
        "count": 6,
        "mean": lengths.mean(),
        "median": np.median(lengths),
        "rms": np.sqrt(np.mean(lengths**2)),
        "max": lengths.max(),
        "before_mean": 4.0,
        "predicted_rms": np.sqrt(traces.mean()),
        "within_95": np.mean(got[:3] <= np.sqrt(chi2.ppf(0.95, 3))),
        "placement_mean": 1.5,
        "placement_rms": np.sqrt(2.5),
        "noise_rms": np.sqrt(0.75),
        "freedom": traces.sum() ** 2 / 6.0,
    }
    for name, value in expected.items():
        assert getattr(told, name) == pytest.approx(value, rel=1e-9), name
