# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The planner on the KR-270: gradient, bound, honesty of what it reports, refusals."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace

import numpy as np
import pytest
from robots import mixed, random_configurations

from calib_planner import InfeasibleError, InputError, Measurements, PlanProblem, Robot, UnknownNameError, plan
from calib_planner.planning import Candidates, Search, tour, visiting_order
from calib_planner.planning.search.descent import descend

TEST_POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])


def kuka():
    return Robot.load("kuka_kr270")


TWO_TARGETS = Measurements(kuka().joint_names, np.zeros((2, 6)), np.zeros((2, 2, 3)))


@pytest.mark.parametrize("m", [3, 4, 12])
def test_plan_is_near_its_bound(m):
    """The continuous problem ends at m·ρ0²/σ² = 3 for this test pose."""
    found = plan(PlanProblem(kuka(), TEST_POSE, m))
    assert found.quality.status == "ok"
    assert found.quality.lower_bound <= 3e-5 * np.sqrt(3.0 / m) * (1 + 1e-6)
    assert 0.9 < found.quality.efficiency <= 1.0
    low, high = kuka().joint_limits.T
    assert ((low <= found.configurations) & (found.configurations <= high)).all()
    assert np.isfinite(found.quality.parameter_std).all()


def test_predicted_accuracy_is_equation_14():
    robot = kuka()
    poses = random_configurations(robot, 3, 4)
    found = plan(
        PlanProblem(robot, poses, 5, repetitions=2, weights=[1, 2, 1], noise=1e-4, search=Search(starts=8))
    )
    rows = np.repeat(found.configurations, 2, axis=0)
    stacked = robot.jacobian(rows).reshape(-1, 9)
    cov = 1e-8 * np.linalg.inv(stacked.T @ stacked)
    expected = [np.sqrt(np.trace(j @ cov @ j.T)) for j in robot.jacobian(poses)]
    np.testing.assert_allclose(found.quality.predicted_accuracy_per_test_pose, expected, rtol=1e-6)
    mean = np.sqrt(np.average(np.square(expected), weights=[1, 2, 1]))
    assert found.quality.predicted_accuracy == pytest.approx(mean, rel=1e-6)
    np.testing.assert_allclose(found.quality.parameter_std, np.sqrt(np.diag(cov)), rtol=1e-5)
    assert found.quality.efficiency == pytest.approx(found.quality.lower_bound / found.quality.predicted_accuracy)


def test_same_seed_same_plan():
    problem = PlanProblem(Robot.load("planar_2r"), [0.2, 0.9], 4, search=Search(starts=8, seed=11))
    first, second = plan(problem), plan(problem)
    np.testing.assert_array_equal(first.configurations, second.configurations)
    other = plan(dataclasses.replace(problem, search=Search(starts=8, seed=12)))
    assert not np.array_equal(first.configurations, other.configurations)


def test_without_a_bound_the_plan_is_as_good_and_says_none():
    problem = PlanProblem(kuka(), TEST_POSE, 6, search=Search(starts=8))
    bounded, without = plan(problem), plan(problem, bounded=False)
    assert not np.isfinite(without.quality.lower_bound) and not np.isfinite(without.quality.efficiency)
    assert without.quality.predicted_accuracy <= 1.01 * bounded.quality.predicted_accuracy
    assert without.quality.predicted_accuracy >= bounded.quality.lower_bound


def test_progress_and_cancel_return_a_valid_plan():
    seen = []

    def cancel_soon(progress):
        seen.append(progress)
        return len(seen) >= 3

    found = plan(PlanProblem(kuka(), TEST_POSE, 6), cancel_soon)
    assert found.quality.status == "cancelled"
    assert found.configurations.shape == (6, 6)
    assert found.quality.lower_bound <= found.quality.predicted_accuracy
    assert seen[0].starts_total == 48


def test_time_limit_returns_a_valid_plan():
    found = plan(PlanProblem(kuka(), TEST_POSE, 12, search=Search(time_limit=1e-6)))
    assert found.quality.status == "time_limit"
    assert np.isfinite(found.quality.predicted_accuracy)


def test_parameters_that_no_plan_can_see_are_named_and_left_out():
    """Only joint 1 can move: the offsets of the others turn into one another."""
    robot = kuka()
    limits = np.array(robot.joint_limits)
    limits[1:] = np.stack([TEST_POSE[1:] - 1e-12, TEST_POSE[1:] + 1e-12], axis=1)
    stiff = dataclasses.replace(robot, joint_limits=limits)
    found = plan(PlanProblem(stiff, TEST_POSE, 6, search=Search(starts=4)))
    assert found.quality.status == "ok"
    assert len(found.quality.unidentifiable) == np.isnan(found.quality.parameter_std).sum() == 6
    assert found.quality.unidentifiable[0] in found.quality.message


def test_unknown_base_and_tool_can_be_planned_for():
    robot = kuka().with_parameters("offsets", ("base", "tool"))
    found = plan(PlanProblem(robot, TEST_POSE, 8, search=Search(starts=8)))
    assert np.isfinite(found.quality.predicted_accuracy)
    assert "1·q1 - 1·base.rz" in found.quality.unidentifiable


def test_plan_is_immutable_and_plain():
    found = plan(PlanProblem(Robot.load("planar_2r"), [0.2, 0.9], 3, search=Search(starts=4)))
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.quality.seed = 3
    with pytest.raises(ValueError, match="read-only"):
        found.configurations[0, 0] = 1.0
    keys = set(json.loads(json.dumps(found.to_dict(), allow_nan=False)))
    assert {
        "robot", "criterion", "parameters", "joint_names", "configurations", "repetitions",
        "predicted_accuracy", "predicted_accuracy_per_test_pose", "lower_bound", "efficiency", "bound",
        "status", "message", "seconds", "seed",
    } <= keys  # fmt: skip


def test_visiting_order_shortens_travel():
    robot = kuka()
    q = random_configurations(robot, 20)
    ordered = q[visiting_order(q, robot)]
    assert sorted(map(tuple, ordered)) == sorted(map(tuple, q))
    scale = np.diff(robot.joint_limits, axis=1)[:, 0]

    def travel(rows):
        return np.abs(np.diff(rows / scale, axis=0)).max(axis=1).sum()

    assert travel(ordered) < 0.8 * travel(q)


def test_a_very_long_tour_goes_to_the_nearest_place_that_is_left(monkeypatch):
    """Of more configurations than ``LARGE`` no stretch is turned round: that takes their square."""
    robot, q = kuka(), random_configurations(kuka(), 12)
    short = visiting_order(q, robot)
    monkeypatch.setattr(tour, "LARGE", 5)
    order = visiting_order(q, robot)
    assert sorted(order) == sorted(short) == list(range(12))
    scale = np.diff(robot.joint_limits, axis=1)[:, 0]
    here, left = robot.joint_limits.mean(axis=1), set(range(12))
    for row in order:
        ways = {k: (np.abs(q[k] - here) / scale).max() for k in left}
        assert ways[row] == min(ways.values())
        here, left = q[row], left - {row}


@pytest.mark.parametrize(
    ("change", "field", "needle"),
    [
        ({"test_poses": np.zeros(5)}, "test_poses", "joint_a6"),
        ({"test_poses": np.full(6, np.nan)}, "test_poses", "finite"),
        ({"test_poses": [0, -60, 90, 0, 45, 0]}, "test_poses[0], joint joint_a2", "degrees?"),
        ({"configurations": 0}, "configurations", "from 1"),
        ({"configurations": 2.5}, "configurations", "whole number"),
        ({"repetitions": -1}, "repetitions", "from 1"),
        ({"noise": 0.0}, "sigma", "(0, 1]"),
        ({"noise": float("nan")}, "sigma", "finite"),
        ({"weights": [1.0, 2.0]}, "weights", "(1)"),
        ({"weights": [0.0]}, "weights", "not all zero"),
        ({"time_limit": 0.0}, "time_limit", "> 0"),
        ({"seed": -1}, "seed", "from 0"),
        ({"starts": 0}, "starts", "from 1"),
        ({"robot": "kuka_kr270"}, "robot", "Robot.load"),
        ({"robot": replace(kuka(), parameter_names=())}, "robot", "with_parameters"),
        ({"candidates": Candidates(np.zeros((3, 6)))}, "candidates", "at least 4"),
        (
            {"measured": TWO_TARGETS},
            "measured",
            "1, as the robot",
        ),
        ({"compound": {"o2": 0.5}}, "compound", "concave"),
        ({"compound": {"best": 0.5}}, "compound", "one of"),
        ({"compound": {"d": 0.5, "a": 0.5}}, "compound", "leave some weight"),
    ],
)
def test_refusals(change, field, needle):
    values = {"robot": kuka(), "test_poses": TEST_POSE, "configurations": 4, **change}
    search = {name: values.pop(name) for name in ("time_limit", "seed", "starts") if name in values}
    with pytest.raises(InputError) as caught:
        PlanProblem(**values, search=Search(**search))
    assert caught.value.field == field
    assert needle in str(caught.value)


def test_unknown_criterion_lists_the_known():
    with pytest.raises(UnknownNameError, match="test_pose"):
        PlanProblem(kuka(), TEST_POSE, 4, criterion="best")


def test_too_few_configurations_says_how_many():
    with pytest.raises(InfeasibleError, match="at least 3"):
        plan(PlanProblem(kuka(), TEST_POSE, 2))


def test_parameters_without_any_effect_are_refused():
    with pytest.raises(InfeasibleError, match="q6"):
        plan(PlanProblem(kuka().with_parameters("q6"), TEST_POSE, 4))


def test_descent_finds_known_minima_in_a_batch():
    """Rosenbrock from many starts, one bound active: minimum at (1, 1), or at x = 0.5 on the bound."""

    def rosenbrock(x):
        a, b = x[:, 0], x[:, 1]
        value = (1 - a) ** 2 + 100 * (b - a * a) ** 2
        gradient = np.stack([-2 * (1 - a) - 400 * a * (b - a * a), 200 * (b - a * a)], axis=1)
        return value, gradient

    starts = np.random.default_rng(0).uniform(-2, 2, (16, 2))
    wide = descend(rosenbrock, starts, np.full(2, -3.0), np.full(2, 3.0), iterations=400, tolerance=1e-14)
    np.testing.assert_allclose(wide.x, 1.0, atol=1e-4)
    held = descend(rosenbrock, starts, np.full(2, -3.0), np.array([0.5, 3.0]), iterations=400, tolerance=1e-14)
    np.testing.assert_allclose(held.x, [[0.5, 0.25]] * 16, atol=1e-5)


def test_mixed_robot_with_two_targets_can_be_planned():
    robot = mixed()
    found = plan(PlanProblem(robot, np.zeros(4), 6, search=Search(starts=8)))
    assert found.quality.status == "ok"
    assert found.quality.efficiency <= 1.0
