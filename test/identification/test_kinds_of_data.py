# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Kinds of measurements that have misled an identification: each gives an estimate that says what is the case."""

from __future__ import annotations

import numpy as np
import pytest
from cells import SIGMA, TARGETS, bare, placed_cell, plain_cell
from robots import random_configurations, repeats

from calib_planner import Estimate, IdentificationProblem, Measurements, Robot, identify
from calib_planner.error_model import Prior, typical_prior
from calib_planner.simulation import SimulatedCell, random_deviations


def achieved_and_predicted(estimate: Estimate, cell: SimulatedCell, robot: Robot) -> tuple[float, float]:
    """Root mean square error of the mean at fresh configurations, and what the estimate expects of it [m]."""
    q = random_configurations(robot, 60, 99)
    apart = np.sum((estimate.positions(q) - cell.truth.positions(q)) ** 2, axis=2)
    told = np.trace(estimate.knowledge.predict(q).position, axis1=2, axis2=3)
    return float(np.sqrt(np.mean(apart))), float(np.sqrt(np.mean(told)))


def test_several_targets_and_errors_that_no_free_parameter_explains() -> None:
    """Two targets, all parameters wrong, zeros alone free, nothing said of the noise: not reported as good."""
    cell, _ = placed_cell(0, "full", TARGETS[:2])
    robot = Robot.load("kuka_kr270").with_targets(np.zeros((2, 3))).with_parameters("offsets", ("base", "tool"))
    data = bare(cell.measure(random_configurations(robot, 24, 0), 1, 0))
    estimate = identify(IdentificationProblem(robot, data))
    assert estimate.fit.status == "ok" and np.isfinite(estimate.fit.std).all()
    assert estimate.left_out.rms > 10 * SIGMA
    assert 0.7 < estimate.left_out.predicted_rms / estimate.left_out.rms < 1.4


@pytest.mark.parametrize("sigma", repeats([None], [None, 1e-6]))
def test_joints_that_do_not_repeat_are_told_from_the_instrument(sigma: float | None) -> None:
    """Three targets, 0.4 mrad of repeatability, 1 µm of noise: both are in the model at their sizes."""
    cell, robot = placed_cell(1)
    rng = np.random.default_rng(1)
    q = random_configurations(robot, 40, 1)
    points = cell.truth.positions(q + 4e-4 * rng.standard_normal(q.shape))
    data = Measurements(robot.joint_names, q, points + 1e-6 * rng.standard_normal(points.shape))
    estimate = identify(IdentificationProblem(robot, data, sigma))
    assert estimate.verdict.level == "PASS"
    assert estimate.knowledge.model.values["repeatability"] == pytest.approx(4e-4, rel=0.25)
    assert estimate.noise.sigma < 5e-6
    achieved, predicted = achieved_and_predicted(estimate, cell, robot)
    assert 0.6 < predicted / achieved < 1.6


def test_repetitions_tell_the_noise_and_places_the_rest() -> None:
    """13 µm from visit to visit, 27 µm more from place to place, nothing said of either."""
    cell, robot = placed_cell(0, targets=TARGETS[:1])
    rng = np.random.default_rng(0)
    q = random_configurations(robot, 12, 0)
    places = cell.truth.positions(q) + 27e-6 * rng.standard_normal((12, 1, 3))
    points = np.repeat(places, 3, axis=0) + 13e-6 * rng.standard_normal((36, 1, 3))
    data = Measurements(robot.joint_names, np.repeat(q, 3, axis=0), points)
    estimate = identify(IdentificationProblem(robot, data, prior=typical_prior(robot)))
    assert estimate.noise.sigma == pytest.approx(13e-6, rel=0.4)
    assert estimate.fit.status == "ok" and not estimate.points.rejected
    assert estimate.points.moved_since is None
    told = estimate.left_out
    assert told.rms > 2 * np.sqrt(3) * 13e-6 and 0.7 < told.predicted_rms / told.rms < 1.5


@pytest.mark.parametrize(
    ("size", "sigma"),
    repeats([(1.0, None)], [(1.0, None), (1.0, SIGMA), (0.1, None), (0.1, SIGMA)]),
)
def test_a_block_of_rows_that_is_shifted_is_named(size: float, sigma: float | None) -> None:
    """The tracker was pushed for twelve visits of forty, and put back."""
    for seed in range(repeats(1, 10)):
        cell, robot = placed_cell(seed)
        data = bare(cell.measure(random_configurations(robot, 40, seed), 1, seed))
        points = np.array(data.p)
        points[12:24] += size * np.array([2e-3, -1e-3, 1.5e-3])
        estimate = identify(IdentificationProblem(robot, bare(data, points), sigma))
        assert {p.row for p in estimate.points.rejected} == set(range(12, 24))
        assert estimate.verdict.level == "FAIL" and estimate.verdict.reasons[0].code == "rejected"
        assert all("shifted" in p.reason or p.normalised_residual > 4 for p in estimate.points.rejected)
        achieved, predicted = achieved_and_predicted(estimate, cell, robot)
        assert achieved < 2 * predicted


@pytest.mark.parametrize("sigma", [SIGMA, None])
def test_errors_twice_as_large_as_the_prior_says_are_an_estimate(sigma: float | None) -> None:
    """1 mm and 3 mrad; a prior of 0.5 mm and 1 mrad is in the way no more than it has to be."""
    robot = Robot.load("ur10e").with_targets(TARGETS).with_parameters("full", ("base", "tool"))
    chain = Robot.load("ur10e").with_targets(TARGETS).with_parameters("full")
    for seed in range(repeats(1, 8)):
        cell = SimulatedCell(chain, random_deviations(chain, seed, 1e-3, 3e-3), SIGMA)
        data = bare(cell.measure(random_configurations(chain, 30, seed), 1, seed))
        estimate = identify(IdentificationProblem(robot, data, sigma, prior=typical_prior(robot)))
        assert estimate.fit.status == "ok" and len(estimate.points.rejected) <= 3
        assert estimate.points.moved_since is None
        achieved, predicted = achieved_and_predicted(estimate, cell, robot)
        assert achieved < 2e-4 and predicted < 3 * achieved


@pytest.mark.parametrize("seed", range(3))
def test_what_standard_deviations_of_the_file_do_not_say_is_added(seed: int) -> None:
    """Columns from 1 to 40 µm, 25 µm more in truth: with the typical error model that is its floor."""
    cell, robot = plain_cell(seed)
    rng = np.random.default_rng(seed)
    q = np.repeat(random_configurations(robot, 20, seed), 2, axis=0)
    std = rng.uniform(1e-6, 4e-5, (40, 1, 3))
    points = (
        cell.truth.positions(q) + std * rng.standard_normal(std.shape) + 25e-6 * rng.standard_normal(std.shape)
    )
    estimate = identify(IdentificationProblem(robot, Measurements(robot.joint_names, q, points, std)))
    assert estimate.noise.source == "data" and estimate.verdict.level == "PASS"
    assert estimate.knowledge.model.values["floor"] == pytest.approx(25e-6, rel=0.4)
    achieved, predicted = achieved_and_predicted(estimate, cell, robot)
    assert 0.5 < predicted / achieved < 2.0


def test_twelve_points_and_nothing_held_out_have_a_left_out_error() -> None:
    """It is beside its prediction, in the estimate and in its verdict."""
    cell, robot = plain_cell(6)
    data = bare(cell.measure(random_configurations(robot, 12, 6), 1, 6))
    for sigma in (SIGMA, None):
        estimate = identify(IdentificationProblem(robot, data, sigma))
        left, document = estimate.left_out, estimate.to_dict()
        assert left.count == 12 and left.freedom > 10
        assert 0.5 < left.rms / left.predicted_rms < 2.0
        assert document["left_out"]["predicted_rms"] == left.predicted_rms
        assert "left_out" in {r.code for r in estimate.verdict.reasons[:3]}


def test_a_prior_of_one_parameter_promises_no_less_than_none() -> None:
    """What is known already never makes a prediction worse than it is without."""
    cell, robot = plain_cell(3)
    data = bare(cell.measure(random_configurations(robot, 10, 3), 1, 3))
    poses = random_configurations(robot, 3, 8)
    vague = Prior(("q2",), [next(p.nominal for p in robot.parameters if p.name == "q2")], [0.02])
    with_it, without = (
        identify(IdentificationProblem(robot, data, SIGMA, prior=prior, test_poses=poses)).accuracy.overall
        for prior in (vague, None)
    )
    assert with_it == pytest.approx(without, rel=0.05)
