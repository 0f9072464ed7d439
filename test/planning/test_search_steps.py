# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The steps that searches and tours are made of, each against its definition."""

from __future__ import annotations

from itertools import combinations, combinations_with_replacement
from typing import Any

import numpy as np
import pytest
from robots import mixed, random_configurations

from calib_planner import InputError, PlanProblem, Robot
from calib_planner.error_model import Prior, typical
from calib_planner.planning import Custom, Feasibility, InformationModel, plan_space, random_plans
from calib_planner.planning.criteria import Determinant, log_values, ridged
from calib_planner.planning.search import descent, enumeration
from calib_planner.planning.search.apart import nearest, repelling
from calib_planner.planning.search.descent import (
    _direction,
    bound_coordinates,
    climb,
    descend,
    feasible_steps,
    update,
    wander,
)
from calib_planner.planning.search.enumeration import _batches, choices_of
from calib_planner.planning.search.exchange import ChoiceProblem
from calib_planner.planning.search.rounding import heaviest_places
from calib_planner.planning.search.swaps import SHARES, drawn_plan
from calib_planner.planning.search.swaps import mixed as mixed_configurations
from calib_planner.planning.tour import Pace, visit_times, visiting_order
from calib_planner.tracker import Isotropic


def test_a_step_of_the_inverse_hessian_is_bfgs() -> None:
    """(I − ρ s yᵀ) H (I − ρ y sᵀ) + ρ s sᵀ; of a fresh H the identity times s·y / y·y; none where s·y <= 0."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(5, 3, 3))
    inverse, fresh = half @ np.swapaxes(half, 1, 2) + np.eye(3), np.array([False, True, False, False, True])
    before, rows = inverse.copy(), np.array([0, 1, 3, 4])
    s, y = rng.normal(size=(2, 4, 3))
    s[:3] *= np.sign(np.sum(s * y, axis=1))[:3, None]
    s[3] *= -np.sign(s[3] @ y[3])
    update(inverse, fresh, rows, s, y)
    for row, step, change in zip(rows[:3], s, y, strict=False):
        h = before[row] * (step @ change / (change @ change) if row == 1 else 1.0)
        rho = 1.0 / (step @ change)
        turn = np.eye(3) - rho * np.outer(step, change)
        np.testing.assert_allclose(inverse[row], turn @ h @ turn.T + rho * np.outer(step, step), rtol=1e-10)
        np.testing.assert_allclose(inverse[row] @ change, step, rtol=1e-9)
    np.testing.assert_array_equal(inverse[[2, 4]], before[[2, 4]])
    assert fresh.tolist() == [False, False, False, False, True]


@pytest.mark.skipif(descent._turn is None, reason="the kernel is not built here")
@pytest.mark.parametrize("shape", [(1, 1), (5, 6), (3, 17)], ids=str)
def test_the_compiled_step_of_the_inverse_hessian_is_numpys(shape: tuple[int, int]) -> None:
    """To the last digit, so that plans are the same with it and without."""
    rng = np.random.default_rng(0)
    got, (s, u, w) = rng.normal(size=(*shape, shape[1])), rng.normal(size=(3, *shape))
    want = got.copy()
    descent._turn(got, s, u, w)
    descent.turn_numpy(want, s, u, w)
    np.testing.assert_array_equal(got, want)
    for wrong in ((got, s, u), (got, s, u, w[:, None]), (got, s, u, w.astype(np.float32)), (s, s, u, w)):
        with pytest.raises(ValueError, match="fit"):
            descent._turn(*wrong)


def test_a_direction_goes_down_and_through_no_bound() -> None:
    low, high = np.array([0.0, 0.0, -1.0]), np.array([1.0, 2.0, 1.0])
    x = np.array([[0.0, 1.0, 1.0], [0.0, 2.0, 1.0], [0.5, 0.5, 0.0]])
    g = np.array([[1.0, 2.0, -3.0], [-1.0, -2.0, 3.0], [1.0, -2.0, 0.5]])
    expected = [[True, False, True], [False, True, False], [False, False, False]]
    np.testing.assert_array_equal(bound_coordinates(x, g, low, high), expected)
    inverse = np.stack([np.diag([2.0, 3.0, 4.0]), np.diag([2.0, 3.0, 4.0]), -np.eye(3)])  # the last leads uphill
    got = _direction(x, g, inverse, low, high)
    np.testing.assert_allclose(got, [[0.0, -6.0, 0.0], [2.0, 0.0, -12.0], [-1.0, 2.0, -0.5]])


def test_a_descent_ends_where_the_gradient_pushes_through_bounds_only() -> None:
    """Convex quadratics in a box: each coordinate is free and flat, or at the bound that it is pushed to."""
    rng = np.random.default_rng(2)
    half, target = rng.normal(size=(4, 4)), rng.normal(0.0, 2.0, (6, 4))
    matrix = half @ half.T + np.eye(4)

    def objective(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        apart = x - target[: len(x)]
        return 0.5 * np.einsum("ni,ij,nj->n", apart, matrix, apart), apart @ matrix

    low, high = -np.ones(4), np.array([1.0, 0.5, 2.0, 1.0])
    for row in range(6):
        own = target[row]

        def one(x: np.ndarray, own: np.ndarray = own) -> tuple[np.ndarray, np.ndarray]:
            return 0.5 * np.einsum("ni,ij,nj->n", x - own, matrix, x - own), (x - own) @ matrix

        found = descend(one, rng.uniform(-3.0, 3.0, (2, 4)), low, high, tolerance=1e-12)
        assert (found.x >= low).all() and (found.x <= high).all()
        gradient = (found.x - own) @ matrix
        inside = (found.x > low + 1e-9) & (found.x < high - 1e-9)
        np.testing.assert_allclose(gradient[inside], 0.0, atol=1e-5)
        assert (gradient[found.x <= low + 1e-9] >= -1e-9).all() and (
            gradient[found.x >= high - 1e-9] <= 1e-9
        ).all()
        np.testing.assert_allclose(found.value, one(found.x)[0], rtol=1e-12)
    assert found.evaluations >= 2


def test_trial_steps_are_feasible_and_know_where_they_started() -> None:
    """Every other one moves one or two joints; lengths are shares of the ranges, even in the logarithm."""
    robot = Robot.load("kuka_kr270")
    low, high = robot.joint_limits.T
    feasibility = Feasibility(robot, (Custom("right half", lambda q: q[:, 0] > 0.0),))
    q = np.stack([low + share * (high - low) for share in (0.55, 0.7)])
    got, origin = feasible_steps(feasibility, q, np.random.default_rng(0), 200)
    assert (got >= low).all() and (got <= high).all() and (got[:, 0] > 0.0).all()
    assert got.shape == (len(origin), 6) and set(origin.tolist()) == {0, 1} and len(got) < 400
    apart = np.abs(got[:, None] - q[None]) / (high - low)
    moved = apart[np.arange(len(got)), origin]
    small = moved.max(axis=1) < 0.05
    assert small.sum() > 100
    np.testing.assert_array_equal(apart[small].max(axis=2).argmin(axis=1), origin[small])
    few = (moved > 0.0).sum(axis=1)
    assert 0.35 < np.mean(few < 6) < 0.65 and 0.5 < np.mean(few[few < 6]) < 2.5
    median = np.median(moved[few == 6].max(axis=1))
    assert 5e-4 < median < 0.5 and moved.max() < 2.5


def test_wandering_and_climbing_gain_and_tell_what_they_reached() -> None:
    robot = Robot.load("kuka_kr270").with_parameters("lengths+offsets")
    feasibility = Feasibility(robot, (Custom("not far down", lambda q: q[:, 1] < 0.5),))
    model, criterion = InformationModel(robot, Isotropic(3e-5)), Determinant()
    start = feasibility.sample(np.random.default_rng(0), 6)
    prior = 1e4 * np.eye(len(robot.parameter_names))

    def value(q: np.ndarray) -> float:
        return float(log_values(criterion, ridged((model.at(q).sum(axis=0) + prior)[None]))[0])

    better, evaluations = wander(model, criterion, prior, feasibility, start, np.random.default_rng(1), sweeps=3)
    assert (
        value(better) > value(start) + 0.05 and feasibility.mask(better).all() and 100 < evaluations <= 3 * 6 * 48
    )
    longer, more = wander(model, criterion, prior, feasibility, start, np.random.default_rng(1), sweeps=9)
    assert value(longer) >= value(better) and more > evaluations
    counts = [
        wander(model, criterion, prior, feasibility, start, np.random.default_rng(1), sweeps=many, gain=gain)[1]
        for many, gain in ((5, 1e-9), (9, 1e-9), (9, np.inf))
    ]
    assert counts[0] == counts[2] < counts[1]  # it ends when five sweeps gain less than that
    height = lambda q: -np.sum((q - 0.1) ** 2, axis=1)  # noqa: E731
    top, best = climb(feasibility, height, start, np.random.default_rng(1), rounds=8)
    np.testing.assert_array_equal(best, height(top))
    assert (best > height(start)).all() and feasibility.mask(top).all()


def test_the_distance_of_two_visits() -> None:
    """Chords of the turns, and slides as shares of half a turn."""
    robot = mixed()
    low, high = robot.joint_limits.T
    plans = random_configurations(robot, 12, 1).reshape(3, 4, -1)
    expected = []
    for plan in plans:
        least = np.inf
        for one, other in combinations(plan, 2):
            way = np.where(
                robot.joint_is_revolute, 2.0 * np.sin((one - other) / 2.0), np.pi * (one - other) / (high - low)
            )
            least = min(least, float(np.linalg.norm(way)))
        expected.append(least)
    np.testing.assert_allclose(nearest(robot, plans), expected, rtol=1e-9)
    assert np.isinf(nearest(robot, plans[:, :1])).all()


def test_places_of_a_design_are_taken_together_the_heaviest_first() -> None:
    """Within 3 % of the ranges of the heaviest of them is one place; its weight is the sum."""
    support = np.array([[0.0, 0.0], [0.02, 0.05], [1.0, 1.0], [0.5, 0.0], [1.02, 1.0], [0.0, 0.07]])
    weights = np.array([0.19, 0.1, 0.18, 0.3, 0.15, 0.08])
    assert heaviest_places(support, weights, np.array([1.0, 2.0])).tolist() == [2, 3, 0, 5]


@pytest.mark.parametrize("together", [None, object()], ids=["alone", "together"])
def test_every_choice_comes_once(together: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many at once as there is memory for: 3·4² numbers a choice, or 3·(4 + 3·3)² with shared errors."""
    monkeypatch.setattr(enumeration, "BATCH", 1100)
    rows, many = np.random.default_rng(0).normal(size=(6, 3, 4)), 22 if together is None else 2
    for repeat, every in ((False, combinations), (True, combinations_with_replacement)):
        problem = ChoiceProblem(rows, Determinant(), np.eye(4), 3, repeat=repeat, together=together)
        batches = [batch.tolist() for batch in _batches(problem)]
        choices = [tuple(row) for batch in batches for row in batch]
        assert choices == list(every(range(6), 3)) and len(choices) == choices_of(problem)
        assert {len(batch) for batch in batches[:-1]} <= {many} and len(batches) == -(-len(choices) // many)


def test_a_plan_is_drawn_from_the_design_and_completed_by_others() -> None:
    rng = np.random.default_rng(0)
    support, others = rng.normal(size=(5, 2)), rng.normal(size=(4, 2))
    weights = 7.0 * np.array([0.5, 1e-12, 0.2, 1e-12, 0.3])
    for count in (3, 5, 7):
        drawn, rest = drawn_plan(count, support, weights, others, rng)
        assert drawn.shape == (count, 2) and rest.shape == (9 - count, 2)
        both = np.concatenate([drawn, rest])
        np.testing.assert_array_equal(np.sort(both, axis=0), np.sort(np.concatenate([support, others]), axis=0))
        if count == 3:
            assert {tuple(row) for row in drawn} == {tuple(row) for row in support[[0, 2, 4]]}
        if count == 7:
            np.testing.assert_array_equal(drawn, np.concatenate([support, others[:2]]))


def test_mixed_configurations_keep_a_share_of_the_first() -> None:
    one, other = np.zeros((3000, 6)), np.ones((3000, 6))
    got = mixed_configurations(one, other, np.random.default_rng(0))
    assert set(np.unique(got)) == {0.0, 1.0}
    assert np.mean(got == 0.0) == pytest.approx(np.mean(SHARES), abs=0.02)


@pytest.mark.parametrize("paced", [False, True])
@pytest.mark.parametrize("from_start", [False, True])
def test_no_stretch_of_a_tour_turned_round_makes_it_shorter(paced: bool, from_start: bool) -> None:
    robot = Robot.load("kuka_kr270")
    low, high = robot.joint_limits.T
    q = random_configurations(robot, 12, 4)
    pace = Pace([0.3, 2.0, 0.5, 1.0, 5.0, 0.1]) if paced else None
    start = low + 0.1 * (high - low) if from_start else None
    order = visiting_order(q, robot, pace, start)
    assert sorted(order.tolist()) == list(range(12))

    def length(rows: list[int]) -> float:
        points = np.vstack([robot.joint_limits.mean(axis=1) if start is None else start, q[rows]])
        ways = np.abs(np.diff(points, axis=0))
        return float((ways / (high - low)).max(axis=1).sum() if pace is None else pace.times(ways).sum())

    tour = order.tolist()
    for i, j in combinations(range(13), 2):
        assert length([*tour[:i], *tour[i:j][::-1], *tour[j:]]) >= length(tour) - 1e-9


def test_a_long_tour_goes_to_the_nearest_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calib_planner.planning.tour.LARGE", 10)
    robot = Robot.load("kuka_kr270")
    low, high = robot.joint_limits.T
    q = random_configurations(robot, 10, 4)
    here, left, expected = robot.joint_limits.mean(axis=1), set(range(10)), []
    while left:
        row = min(left, key=lambda i: float((np.abs(q[i] - here) / (high - low)).max()))
        expected.append(row)
        left.remove(row)
        here = q[row]
    assert visiting_order(q, robot).tolist() == expected
    monkeypatch.setattr("calib_planner.planning.tour.LARGE", 11)
    assert visiting_order(q, robot).tolist() != expected  # it is improved


@pytest.mark.parametrize("known", [False, True])
def test_a_timetable_is_what_a_robot_that_does_one_thing_after_the_other_needs(known: bool) -> None:
    robot = Robot.load("kuka_kr270")
    low, high = robot.joint_limits.T
    q = random_configurations(robot, 4, 4)
    q[2] = q[1] + 0.01  # so near that the robot backs off on its way
    times, pace = [1, 2, 1, 3], Pace([0.3, 2.0, 0.5, 1.0, 5.0, 0.1], dwell=4.0, settle=1.5)
    start = low + 0.1 * (high - low) if known else None
    table = visit_times(robot, q, times, pace, start)
    clock, here, arrivals, turns = 0.0, start, [], []
    for place, count in enumerate(times):
        inward = np.where(q[place] <= 0.5 * (low + high), 1.0, -1.0)
        aside = np.clip(q[place] + 0.05 * inward, low, high)
        for _ in range(count):
            if here is None:  # from the farthest end of every joint's range
                clock += float(pace.times(np.maximum(q[place] - low, high - q[place])))
                turns.append(np.nan)
            elif np.abs(q[place] - here).max() < 0.05:
                clock += float(pace.times(np.abs(aside - here)))
                turns.append(clock)
                clock += float(pace.times(np.abs(aside - q[place])))
            else:
                clock += float(pace.times(np.abs(q[place] - here)))
                turns.append(np.nan)
            arrivals.append(clock)
            clock, here = clock + 5.5, q[place]
        np.testing.assert_allclose(table.aside[place], aside)
    np.testing.assert_allclose(table.arrivals, arrivals, rtol=1e-12)
    np.testing.assert_allclose(table.ways_back, turns, rtol=1e-12)
    assert table.seconds == pytest.approx(clock) and table.standing == pytest.approx(7 * 5.5)
    first = np.cumsum([0, *times[:-1]])
    np.testing.assert_allclose(table.arrive, np.array(arrivals)[first])
    np.testing.assert_allclose(table.leave, np.array(arrivals)[first + np.array(times) - 1] + 5.5)
    assert table.places.tolist() == [0, 1, 1, 2, 3, 3, 3]
    np.testing.assert_allclose(table.travel[1:], np.diff(q, axis=0))
    if start is None:
        assert np.isnan(table.travel[0]).all()
    else:
        np.testing.assert_allclose(table.travel[0], q[0] - start)
    rows, points = table.rows(), table.points(q)
    assert sum(r["move"] + r["settle"] + r["measure"] + r["back_off"] for r in rows) == pytest.approx(clock)
    for row, count in zip(rows, times, strict=True):
        assert (row["settle"], row["measure"]) == (1.5 * count, 4.0 * count)
        assert row["back_off"] == pytest.approx(row["leave"] - row["arrive"] - 5.5 * count)
    assert len(points) == 2 * 7 + np.isfinite(turns).sum()
    assert [t for _, t in points] == sorted(t for _, t in points)
    assert points[-1] == (q[3].tolist(), round(clock * 1e9))


@pytest.mark.parametrize(("noise", "size", "batches"), [(3e-5, 4, (3, 3, 1)), (1.0, 2, (6, 1))])
@pytest.mark.parametrize("known", [False, True])
def test_random_plans_have_the_accuracy_of_their_configurations(
    noise: float, size: int, batches: tuple[int, ...], known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each batch draws its plans with a seed of its own; ρ0 = σ √tr(J₀ (Σ JᵀJ)⁻¹ J₀ᵀ), eq. (14)."""
    monkeypatch.setattr(random_plans, "BATCH", 12)
    robot = Robot.load("kuka_kr270").with_parameters("d1,q2,d2")
    pose, std = random_configurations(robot, 1, 3), noise * np.array([0.3, 0.5, 2.0])
    prior = Prior(list(robot.parameter_names), np.zeros(3), std) if known else None
    space = plan_space(PlanProblem(robot, pose, size, repetitions=2, noise=noise, prior=prior))
    got = random_plans.random_accuracies(space, 7, np.random.default_rng(5))
    seeds, expected = np.random.default_rng(5).integers(0, 2**63, len(batches)).tolist(), []
    before = np.diag((noise / std) ** 2) if known else np.zeros((3, 3))
    for many, seed in zip(batches, seeds, strict=True):
        q = space.feasibility.sample(np.random.default_rng(seed), size * many).reshape(many, size, -1)
        j0 = robot.jacobian(pose)[0]
        for plan in q:
            jacobian = robot.jacobian(plan).reshape(-1, 3)
            hidden = np.linalg.inv(before + 2.0 * jacobian.T @ jacobian)
            expected.append(noise * np.sqrt(np.trace(j0 @ hidden @ j0.T)))
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    assert noise < 1.0 or known or (got > 1.0).any()


@pytest.mark.parametrize(("most", "batches"), [(110, (2, 2, 2, 1)), (30, (1,) * 7)])
def test_random_plans_with_a_whole_error_model_go_in_smaller_batches(
    most: int, batches: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tenth at once: of 110 configurations 11, two plans of four; and one plan at least."""
    monkeypatch.setattr(random_plans, "BATCH", most)
    robot = Robot.load("planar_2r").with_parameters("l1,l2")
    pose = random_configurations(robot, 1, 3)
    space = plan_space(PlanProblem(robot, pose, 4, error_model=typical(Isotropic(3e-5))))
    got = random_plans.random_accuracies(space, 7, np.random.default_rng(5))
    expected, seeds = [], np.random.default_rng(5).integers(0, 2**63, len(batches)).tolist()
    for many, seed in zip(batches, seeds, strict=True):
        q = space.feasibility.sample(np.random.default_rng(seed), 4 * many)
        matrices, weight = space.model.totals(q, 4) + space.prior, space.criterion("test_pose").weight  # type: ignore[attr-defined]
        expected += [np.sqrt(np.trace(weight @ np.linalg.inv(matrix))) for matrix in matrices]
    np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_a_tour_may_be_as_long_as_a_duration_can_say(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot.load("planar_2r")
    q, pace = np.array([[0.1, 0.0], [0.3, 0.0]]), Pace([10.0, 10.0], dwell=4.0, settle=1.0)
    monkeypatch.setattr(
        "calib_planner.planning.tour.LONGEST", 12
    )  # two moves of a second, two standstills of five
    assert visit_times(robot, q, 1, pace, q[0] - 0.2).seconds == 12.0
    monkeypatch.setattr("calib_planner.planning.tour.LONGEST", 11)
    with pytest.raises(InputError, match="shorten the standstill"):
        visit_times(robot, q, 1, pace, q[0] - 0.2)


def test_the_cost_of_near_visits_has_the_gradient_that_is_said() -> None:
    """By central differences, of a robot that turns and slides."""
    robot = mixed()
    size, joints = 3, len(robot.joint_names)
    rows = (0.1 + 0.02 * np.random.default_rng(4).standard_normal((2, size, joints))).reshape(2, -1)
    cost = repelling(lambda x: (np.zeros(len(x)), np.zeros(x.shape)), robot, size)
    value, gradient = cost(rows)
    assert (value > 0.0).all()
    steps = 1e-6 * np.eye(rows.shape[1])
    differences = [(cost(rows + step)[0] - cost(rows - step)[0]) / 2e-6 for step in steps]
    np.testing.assert_allclose(gradient, np.transpose(differences), rtol=1e-5, atol=1e-6)
