# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulated robot errs as its error model says: in its cell, at each arrival, and with faults on top."""

from __future__ import annotations

import numpy as np
import pytest

from calib_planner import InputError, Robot
from calib_planner.campaign import Measure
from calib_planner.error_model import ErrorModel, typical
from calib_planner.simulation import (
    ANGLE_ERROR,
    LENGTH_ERROR,
    NANO,
    Faults,
    SimulatedCell,
    Stand,
    World,
    make_tour,
    play,
    random_deviations,
    simulated,
)
from calib_planner.tracker import LaserTracker

ROBOT = Robot.load("kuka_kr270").with_targets([[0.1, 0.02, 0.3], [-0.05, 0.2, 0.1]])
DEVIATIONS = {"d1": 1e-3, "q2": -5e-4}
CELL = SimulatedCell(ROBOT, DEVIATIONS, 0.0, error_model=typical(), seed=3)
LOW, HIGH = ROBOT.joint_limits.T
Q = np.random.default_rng(1).uniform(LOW, HIGH, (6, 6))


def stand(arrivals: list[int], since: float) -> Stand:
    """At the first configuration, at arrivals of these numbers."""
    count = len(arrivals)
    return Stand(np.repeat(Q[:1], count, axis=0), np.array(arrivals), np.full(count, since))


def test_true_errors_are_those_that_the_typical_model_expects() -> None:
    values = typical().values
    assert (values["placement.length"], values["placement.angle"]) == (LENGTH_ERROR, ANGLE_ERROR)
    many = [random_deviations(ROBOT, seed) for seed in range(400)]
    for p in ROBOT.parameters:
        spread = np.std([d[p.name] for d in many])
        # A standard deviation of 400 draws errs by 1/√800: none by 4.5 of these.
        assert spread == pytest.approx(LENGTH_ERROR if p.unit == "m" else ANGLE_ERROR, rel=4.5 / np.sqrt(800))


def test_a_cell_measures_the_robot_of_its_error_model() -> None:
    paper = SimulatedCell(ROBOT, DEVIATIONS, 0.0)
    np.testing.assert_array_equal(paper.truth.positions(Q), ROBOT.with_deviations(DEVIATIONS).positions(Q))
    assert paper.measure(Q, 1, 5).p == pytest.approx(paper.truth.positions(Q), abs=1e-15)
    # The same placement; gravity, joint functions, and what is new at each visit on top.
    bent = CELL.truth.positions(Q) - paper.truth.positions(Q)
    assert np.sqrt(np.mean(bent**2)) > 5e-4
    data = CELL.measure(np.repeat(Q, 50, axis=0), 1, 5)
    scatter = (data.p - CELL.truth.positions(data.q)).reshape(6, 50, 2, 3)
    told = np.sqrt(sum(v**2 for k, v in CELL.truth.sizes(Q).items() if k in ("visits", "points")))
    assert np.sqrt(np.mean(np.sum(scatter**2, axis=3))) == pytest.approx(told, rel=0.1)
    again, other = CELL.measure(Q, 1, 5), CELL.measure(Q, 1, 6)
    np.testing.assert_array_equal(again.p, CELL.measure(Q, 1, 5).p)
    assert np.abs(again.p - other.p).min() > 0.0
    assert data.std is None


def test_seeds_of_the_coefficients() -> None:
    same, other = (SimulatedCell(ROBOT, DEVIATIONS, error_model=typical(), seed=seed) for seed in (3, 4))
    np.testing.assert_array_equal(same.truth.positions(Q), CELL.truth.positions(Q))
    assert np.abs(other.truth.positions(Q) - CELL.truth.positions(Q)).max() > 1e-4


def test_position_errors_are_those_of_the_whole_robot() -> None:
    errors = CELL.position_errors(CELL.truth.robot, Q)
    bent = CELL.truth.positions(Q) - CELL.truth.robot.positions(Q)
    np.testing.assert_allclose(errors, np.linalg.norm(bent, axis=2))
    assert errors.max() > 1e-4


def test_an_arrival_is_a_visit() -> None:
    world = World(CELL, seed=7)
    points = world.targets(stand([0, 1, 2, 1, -1], 0.5))
    np.testing.assert_array_equal(points[1], points[3])
    np.testing.assert_array_equal(points, world.targets(stand([0, 1, 2, 1, -1], 100.0)))
    # One by one, in any order, in another world of the same seed: the same.
    for k in (2, 0, 1):
        np.testing.assert_array_equal(World(CELL, seed=7).targets(stand([k], 0.5))[0], points[k])
    assert np.abs(points[[0, 1, 2]] - points[[1, 2, 0]]).max() > 1e-5
    assert np.abs(World(CELL, seed=8).targets(stand([0], 0.5)) - points[:1]).max() > 1e-5
    # On its way, and before the first arrival, the robot stands as it does on average.
    mean = CELL.truth.positions(Q[:1])[0]
    np.testing.assert_array_equal(points[4], mean)
    np.testing.assert_array_equal(world.targets(stand([3], np.inf))[0], mean)
    many = world.targets(stand(list(range(500)), 0.5)) - mean
    told = CELL.truth.sizes(Q[:1])
    spread = np.sqrt(np.mean(np.sum(many**2, axis=2)))
    assert spread == pytest.approx(np.hypot(told["visits"], told["points"]), rel=0.1)


def test_a_standstill_is_seen_at_one_place_and_another_at_the_next_visit() -> None:
    twice = make_tour((LOW + HIGH) / 2, Q[:1], np.array([3]), ROBOT.joint_limits, 6.0, 1.0)
    heard = list(play(World(CELL, seed=7), twice))
    seen = []
    for rest in (p for p in twice.phases if p.measuring):
        at = [m for m in heard if m.stream == 1 and rest.begin <= m.stamp / NANO < rest.end]
        values = np.array([m.values for m in at])
        assert len(values) > 40 and np.ptp(values, axis=0).max() < 1e-12
        seen.append(values[0])
    assert np.abs(np.diff(seen, axis=0)).max() > 1e-5


def test_a_campaign_visits_anew_each_time() -> None:
    measure = simulated(World(CELL, seed=7), 1)
    action = Measure(0, Q[0], "fit", 0)
    points = np.array([measure(action) for _ in range(3)])
    np.testing.assert_array_equal(points, World(CELL, seed=7).targets(stand([0, 1, 2], 0.5)))


def test_transmission_errors_come_on_top() -> None:
    clean, wrong = World(CELL, seed=7), World(CELL, Faults(transmission_error=2e-4), 7)
    off = wrong.truth.actual(Q) - clean.truth.actual(Q)
    alone = World(SimulatedCell(ROBOT, DEVIATIONS, 0.0), Faults(transmission_error=2e-4), 7).truth.actual(Q) - Q
    np.testing.assert_allclose(off, alone, atol=1e-15)
    assert np.abs(off).max() > 1e-4
    visits = [w.targets(stand([4], 0.5)) - w.targets(stand([4], np.inf)) for w in (clean, wrong)]
    np.testing.assert_allclose(visits[0], visits[1], atol=1e-6)


def test_the_trackers_noise_is_the_cells() -> None:
    model = ErrorModel.paper(1e-3)
    cell = SimulatedCell(ROBOT, {}, 2e-5, error_model=model)
    data = cell.measure(np.repeat(Q, 50, axis=0), 1, 1)
    error = data.p - cell.truth.positions(data.q)
    assert error.std() == pytest.approx(2e-5, rel=0.1) and np.all(np.asarray(data.std) == 2e-5)


def test_repetitions_are_one_number_or_one_of_each_configuration() -> None:
    cell = SimulatedCell(ROBOT, {}, 2e-5)
    data = cell.measure(Q[:3], [2, 1, 3], 1)
    np.testing.assert_array_equal(data.q, np.repeat(Q[:3], [2, 1, 3], axis=0))
    with pytest.raises(InputError, match="repetitions: expected one number or 3 numbers, got"):
        cell.measure(Q[:3], [2, 1], 1)


def test_a_trackers_standard_deviations_are_those_of_its_covariance() -> None:
    tracker = LaserTracker(station=np.array([4.0, 0.0, 1.0]))
    cell = SimulatedCell(ROBOT, {}, instrument=tracker)
    data = cell.measure(Q[:3], 1, 1)
    expected = np.sqrt(np.diagonal(tracker.covariance(cell.truth.positions(data.q)), axis1=-2, axis2=-1))
    np.testing.assert_allclose(
        np.asarray(data.std), expected, rtol=1e-3
    )  # at the points with their visits' errors
