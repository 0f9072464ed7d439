"""What was predicted for held-out points is what happens there, over many cells; the bookkeeping is exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import SIGMA, WrongRobot, bare, placed_cell, plain_cell, spoil
from robots import random_configurations

from calib_planner import IdentificationProblem, InputError, Measurements, NotEnoughDataError, identify, validate
from calib_planner.identification import cross_validate
from calib_planner.simulation import SimulatedCell


def plain(seed: int, count: int = 12):
    cell, asked = plain_cell(seed)
    data = bare(cell.measure(random_configurations(asked, count, seed), 1, seed))
    fresh = bare(cell.measure(random_configurations(asked, 25, seed + 500), 1, seed + 500))
    return IdentificationProblem(asked, data, sigma=SIGMA, starts=0), [fresh], 0


def placed(seed: int):
    cell, asked = placed_cell(seed)
    data = bare(cell.measure(random_configurations(asked, 30, seed), 1, seed))
    fresh = bare(cell.measure(random_configurations(asked, 20, seed + 500), 1, seed + 500))
    return IdentificationProblem(asked, data, starts=0), [fresh], 0


def wrong(seed: int):
    robot = WrongRobot(seed)
    data = robot.measure(random_configurations(robot.asked, 40, seed))
    fresh = robot.measure(random_configurations(robot.asked, 25, seed + 500))
    problem = IdentificationProblem(robot.asked, data, sigma=SIGMA, starts=0, joint_corrections="off")
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
    return IdentificationProblem(asked, data, sigma=SIGMA, starts=0), sets, 4


@pytest.mark.parametrize(("make", "seeds"), [(plain, 40), (placed, 8), (wrong, 25), (reseated, 40)])
def test_achieved_is_what_was_predicted(make, seeds):
    """Mean squares over seeds, and 95 % of the points in their regions."""
    achieved, predicted, inside, better = [], [], [], 0
    for seed in range(seeds):
        problem, held_out, target_from = make(seed)
        found = validate(problem, identify(problem), held_out, target_from).validation
        assert found.count == sum(s.seen[target_from:].sum() for s in held_out)
        achieved.append(found.rms**2)
        predicted.append(found.predicted_rms**2)
        inside.append(found.within_95)
        better += found.mean < found.before_mean
    error = np.std(achieved) / np.mean(achieved) / np.sqrt(seeds)
    assert np.mean(achieved) / np.mean(predicted) == pytest.approx(1.0, abs=4 * error + 0.02)
    assert np.mean(inside) == pytest.approx(0.95, abs=4 * np.std(inside) / np.sqrt(seeds) + 0.005)
    assert better == seeds


def test_statistics_are_those_of_the_distances():
    """Against positions of the calibrated robot, by hand; missing points do not count."""
    problem, (fresh,), _ = plain(1)
    points = np.array(fresh.p)
    points[[2, 9]] = np.nan
    found = validate(problem, estimate := identify(problem), [bare(fresh, points)]).validation
    length = np.linalg.norm(points - estimate.calibrated.positions(fresh.q), axis=2)[:, 0]
    length = length[np.isfinite(length)]
    nominal = np.linalg.norm(points - problem.robot.positions(fresh.q), axis=2)
    got = (found.count, found.mean, found.median, found.rms, found.max, found.before_mean)
    rms = np.sqrt(np.mean(length**2))
    expected = (23, length.mean(), np.median(length), rms, length.max(), np.nanmean(nominal))
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    assert (found.geometry_mean, found.geometry_rms, found.folds) == (found.mean, found.rms, 0)


def test_cross_validation_predicts_each_configuration_by_the_others():
    """Repetitions stay together: by hand, fold by fold; and the expected rms is achieved over seeds."""
    ratios = []
    for seed in range(12):
        cell, asked = plain_cell(seed)
        data = bare(cell.measure(random_configurations(asked, 15, seed), 2, seed))
        problem = IdentificationProblem(asked, data, sigma=SIGMA, starts=0)
        found = cross_validate(problem, identify(problem), folds=5, seed=seed).cross_validation
        assert found.folds == 5 and found.count == 30
        ratios.append((found.rms / found.predicted_rms) ** 2)
    assert np.mean(ratios) == pytest.approx(1.0, abs=4 * np.std(ratios) / np.sqrt(len(ratios)))
    everyone = cross_validate(problem, identify(problem), folds=15).cross_validation
    lengths = []
    for k in range(15):
        rest = np.setdiff1d(np.arange(30), [2 * k, 2 * k + 1])
        part = identify(replace(problem, data=data.select(rest)))
        own = data.select([2 * k, 2 * k + 1])
        lengths += np.linalg.norm(own.p - part.calibrated.positions(own.q), axis=2).ravel().tolist()
    assert everyone.rms == pytest.approx(float(np.sqrt(np.mean(np.square(lengths)))), rel=1e-5)


def test_rejected_points_take_no_part_in_cross_validation():
    cell, asked = plain_cell(3)
    spoilt, bad = spoil(cell.measure(random_configurations(asked, 40, 3), 1, 3), 3, exchange=False)
    problem = IdentificationProblem(asked, spoilt, sigma=SIGMA, loss="robust", starts=0)
    found = cross_validate(problem, identify(problem), folds=4).cross_validation
    assert found.count == 40 - bad.sum()
    assert found.max < 20 * SIGMA


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
    for folds in (0, 1, 13):
        with pytest.raises(InputError, match="folds"):
            cross_validate(problem, estimate, folds=folds)
    with pytest.raises(InputError, match="targets"):
        validate(problem, estimate, [bare(fresh, np.repeat(fresh.p, 2, axis=1))])
