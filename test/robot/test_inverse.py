# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics: formulas against products of matrices, differences and dense algebra; answers, SciPy's.

What compensation makes of it is in ``test_compensation``.
"""

from __future__ import annotations

import numpy as np
import pytest
from robots import mixed, random_chain, random_configurations
from scipy.optimize import least_squares, minimize

from calib_planner import Robot
from calib_planner.robot import Coupling, Element, Goals, goals_of, residuals, solve
from calib_planner.robot.elements import rotation
from calib_planner.robot.inverse import LONGEST_STEP, _best_of_each, _residual_and_jacobian, _step, _unwound

POINT, LEVER = np.array([0.1, -0.2, 0.3]), 0.7
NEVER = np.inf


def placed(robot: Robot, q: np.ndarray) -> np.ndarray:
    """(4, 4) pose of the tip in the frame of positions, by the product of eq. (2)."""
    pose = np.eye(4)
    for e in robot.elements:
        amount = e.sign * (e.value + (0.0 if e.joint is None else q[e.joint]))
        step = np.eye(4)
        if e.is_rotation:
            step[:3, :3] = rotation(e.axis, amount)
        else:
            step[e.axis, 3] = amount
        pose = pose @ step
    return pose


def robots() -> dict[str, Robot]:
    base = rotation(2, 0.8) @ rotation(1, -0.3)
    return {
        "mixed": mixed().with_base(base, [1.0, 2.0, -3.0]),
        "chain": random_chain(3),
        "coupled": mixed().with_couplings((Coupling("nod", "turn", 0.5),)),
    }


@pytest.mark.parametrize("case", robots())
def test_what_is_left_is_the_way_and_the_turn_to_the_goal(case: str) -> None:
    robot = robots()[case]
    here, there = (random_configurations(robot, 8, seed) for seed in (1, 2))
    left = residuals(robot, goals_of(robot, there, POINT, False, LEVER), here)
    assert left.shape == (8, 6)
    for row, a, b in zip(left, robot.motions(here), robot.motions(there), strict=True):
        now, goal = placed(robot, a), placed(robot, b)
        np.testing.assert_allclose(row[:3], ((goal - now) @ np.append(POINT, 1.0))[:3], atol=1e-12)
        # By Rodrigues: a turn by θ about n has the trace 1 + 2 cos θ and the skew part sin θ [n]×.
        turn = goal[:3, :3] @ now[:3, :3].T
        angle = np.arccos((np.trace(turn) - 1.0) / 2.0)
        skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        np.testing.assert_allclose(row[3:], LEVER * angle * skew / (2.0 * np.sin(angle)), atol=1e-9)
    near = residuals(robot, goals_of(robot, there, POINT, True, LEVER), here)
    np.testing.assert_array_equal(near, left[:, :3])


@pytest.mark.parametrize("case", robots())
@pytest.mark.parametrize("position_only", [True, False])
def test_the_gradient_is_exact_however_much_is_left_and_the_derivative_at_the_goal(
    case: str, position_only: bool
) -> None:
    robot = robots()[case]
    q, there = (random_configurations(robot, 6, seed) for seed in (3, 4))
    far, near = (goals_of(robot, at, POINT, position_only, LEVER) for at in (there, q))
    r, jacobian = _residual_and_jacobian(robot, far, q)
    slopes = _residual_and_jacobian(robot, near, q)[1]
    h = 1e-6
    for k, e in enumerate(h * np.eye(q.shape[1])):
        gain = [-0.5 * np.sum(residuals(robot, far, x) ** 2, axis=1) for x in (q + e, q - e)]
        np.testing.assert_allclose((jacobian[:, :, k] * r).sum(axis=1), (gain[0] - gain[1]) / (2 * h), atol=1e-7)
        change = (residuals(robot, near, q - e) - residuals(robot, near, q + e)) / (2 * h)
        np.testing.assert_allclose(slopes[:, :, k], change, atol=1e-8)


def test_a_step_is_the_damped_one_of_the_joints_that_are_free() -> None:
    """As least squares with the root of the damping below; a joint that would cross its bound has no column."""
    rng = np.random.default_rng(0)
    jacobian, r = rng.normal(size=(40, 6, 4)), 0.01 * rng.normal(size=(40, 6))
    damping = 10.0 ** rng.uniform(-6, 0, 40)
    q, low, high = np.zeros((40, 4)), np.full((40, 4), -1.0), np.full((40, 4), 1.0)
    low[10:25, 1] = high[20:40, 2] = 0.0
    low[30:] = high[30:] = 0.0
    high[30:, 3] = 1.0
    r[5] *= 1e3
    step = _step(r, jacobian, damping, q, low, high)
    held = 0
    for n in range(40):
        gradient = jacobian[n].T @ r[n]
        free = ((q[n] > low[n]) | (gradient >= 0)) & ((q[n] < high[n]) | (gradient <= 0))
        held += np.count_nonzero(~free)
        columns = jacobian[n][:, free]
        expected = np.zeros(4)
        if free.any():
            largest = np.max(np.sum(columns**2, axis=0))
            rows = np.vstack([columns, np.sqrt(damping[n] * largest) * np.eye(columns.shape[1])])
            expected[free] = np.linalg.lstsq(rows, np.append(r[n], np.zeros(columns.shape[1])), rcond=None)[0]
        expected *= min(1.0, LONGEST_STEP / max(np.abs(expected).max(), 1e-300))
        np.testing.assert_allclose(step[n], expected, rtol=1e-9, atol=1e-15)
    assert 20 < held < 100
    assert np.abs(step[5]).max() == pytest.approx(LONGEST_STEP, rel=1e-12)


@pytest.mark.parametrize("case", ["mixed", "chain", "coupled"])
@pytest.mark.parametrize("position_only", [True, False])
def test_within_bounds_no_other_optimiser_comes_closer_from_there(case: str, position_only: bool) -> None:
    robot = robots()[case]
    q, there = (random_configurations(robot, 12, seed) for seed in (5, 6))
    there = q + 0.3 * (there - q)
    goals = goals_of(robot, there, POINT, position_only, LEVER)
    low, high = q - 0.15, q + 0.1
    ends = solve(robot, goals, q, low, high)
    assert ((ends >= low) & (ends <= high)).all()
    left = np.linalg.norm(residuals(robot, goals, ends), axis=1)
    for n in range(len(q)):
        one = goals.rows(np.array([n]))
        bounds = (low[n] - 1e-12, high[n] + 1e-12)
        best = least_squares(
            lambda x, one=one: residuals(robot, one, x[None])[0], ends[n], bounds=bounds, xtol=1e-12, ftol=1e-12
        )
        assert left[n] <= np.sqrt(2.0 * best.cost) * (1.0 + 1e-4) + 1e-9


def test_what_is_reached_is_reached_to_rounding() -> None:
    robot = Robot.load("kuka_kr270")
    q = random_configurations(robot, 30, 8)
    q[:, 2], q[:, 4] = 1.2, 0.9
    goals = goals_of(robot, q + 0.03, POINT, False, LEVER)
    ends = solve(robot, goals, q, np.full(q.shape, -NEVER), np.full(q.shape, NEVER))
    np.testing.assert_allclose(ends, q + 0.03, atol=1e-10)
    assert np.abs(residuals(robot, goals, ends)).max() < 1e-11


def test_whole_turns_are_taken_back_where_the_bounds_allow_it() -> None:
    robot = mixed()  # turn, slide, spin, nod
    start = np.array([[0.1, 0.0, 0.2, 0.3]] * 3)
    turns = np.array([[1.0, 1.0, -2.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]])
    q = start + 0.4 + 2.0 * np.pi * turns
    low, high = np.full((3, 4), -4.0), np.full((3, 4), 20.0)
    low[1, 0] = start[1, 0] + 0.5  # the way back is barred
    expected = start + 0.4
    expected[0, 1] += 2.0 * np.pi  # a slide makes no turns
    expected[1, 0] = q[1, 0]
    np.testing.assert_allclose(_unwound(robot, q, start, low, high), expected, atol=1e-12)


def test_the_closest_end_counts_and_the_nearest_among_those_that_arrived() -> None:
    rows = np.array([0, 0, 0, 2, 2, 2, 3])
    reached = np.array([1e-3, 2e-3, 1e-3, 5e-12, 1e-15, 1e-3, 1.0])
    away = np.array([0.5, 0.1, 0.4, 0.1, 0.2, 0.0, 9.0])
    assert _best_of_each(rows, reached, away).tolist() == [2, 3, 6]


def test_the_arm_bends_from_its_stretched_posture_to_whichever_side_is_free() -> None:
    """Law of cosines: the elbow that brings the tip 10 mm nearer to the shoulder."""
    robot = Robot.load("planar_2r")
    l1, l2 = (p.nominal for p in robot.with_parameters("l1,l2").parameters)
    away = l1 + l2 - 0.01
    bend = np.arccos((away**2 - l1**2 - l2**2) / (2 * l1 * l2))
    q = np.array([[0.3, 0.0]] * 3)
    xyz = np.tile([away * np.cos(0.3), away * np.sin(0.3), 0.0], (3, 1))
    low, high = np.full((3, 2), -3.0), np.full((3, 2), 3.0)
    low[1, 1], high[2, 1] = 0.0, 0.0
    ends = solve(robot, Goals(np.zeros(3), xyz, None, LEVER), q, low, high)
    np.testing.assert_allclose(np.abs(ends[:, 1]), bend, atol=1e-9)
    assert ends[1, 1] > 0 > ends[2, 1]


@pytest.mark.parametrize("size", [1.0, 20.0])
@pytest.mark.parametrize("first", [2.0, -1.0, 0.3])
def test_of_the_ways_to_bend_one_of_nearly_least_motion_is_taken(size: float, first: float) -> None:
    """Three links, stretched out, that shall reach a little less far: SciPy minimises the motion itself."""
    lengths = size * np.array([1.0, 0.8, 0.5])
    links = [e for k, x in enumerate(lengths) for e in (Element("Rz", joint=k), Element("Tx", x))]
    robot = Robot("arm", tuple(links), (), ("a", "b", "c"), np.array([[-9.0, 9.0]] * 3))
    robot = robot.with_targets([[0.0, 0.0, 0.0]])
    start, wide = np.array([[first, 0.0, 0.0]]), np.full((1, 3), 9.0)
    xyz = 0.999 * robot.positions(start)[0]
    end = solve(robot, Goals(np.zeros(3), xyz, None, LEVER), start, -wide, wide)
    np.testing.assert_allclose(robot.positions(end)[0], xyz, atol=1e-11)
    gap = {"type": "eq", "fun": lambda q: (robot.positions(q)[0, 0, :2] - xyz[0, :2]) / size}
    least = minimize(
        lambda q: np.sum((q - start[0]) ** 2), end[0], method="SLSQP", constraints=[gap], options={"ftol": 1e-14}
    )
    assert np.linalg.norm(end - start) < 1.1 * np.sqrt(least.fun) + 1e-9
    assert np.abs(gap["fun"](least.x)).max() < 1e-8 and least.fun > 1e-3


def test_where_nothing_is_gained_nothing_moves() -> None:
    """Out of reach: the arm stretches towards the goal, and a roll that brings it no closer stays."""
    links = (Element("Rz", joint=0), Element("Tx", 1.0), Element("Rz", joint=1), Element("Tx", 0.8))
    robot = Robot("arm", (*links, Element("Rx", joint=2)), (), ("a", "b", "roll"), np.array([[-4.0, 4.0]] * 3))
    robot = robot.with_targets([[0.0, 0.0, 0.0]])
    start, low, high = (np.array([[a, b, c]]) for a, b, c in ((0.5, 0.3, 0.7), (-4, -4, 0.69), (4, 4, 0.71)))
    goals = Goals(np.zeros(3), np.array([[0.0, 1.9, 0.0]]), None, LEVER)
    end = solve(robot, goals, start, low, high)
    np.testing.assert_allclose(end, [[np.pi / 2, 0.0, 0.7]], atol=1e-5)
    assert np.linalg.norm(residuals(robot, goals, end)) == pytest.approx(0.1, rel=1e-9)


def test_joints_that_move_nothing_stay_where_they_are() -> None:
    """A point on the axis of the only joint: there is nothing to solve for."""
    robot = Robot("roll", (Element("Tx", 0.5), Element("Rx", joint=0)), (), ("roll",), np.array([[-1.0, 1.0]]))
    robot = robot.with_targets([[0.0, 0.0, 0.0]])
    goals = Goals(np.zeros(3), np.array([[0.5, 0.1, 0.0]]), None, LEVER)
    start = np.array([[0.3]])
    np.testing.assert_array_equal(solve(robot, goals, start, start - 1.0, start + 1.0), start)
