# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Timetables: no joint exceeds its speed, every stop has its standstill, and what is not known is not stated."""

from __future__ import annotations

import numpy as np
import pytest
from robots import mixed, plan_of, random_configurations

from calib_planner import Robot
from calib_planner.errors import InputError
from calib_planner.planning import Pace, backed_off, timetable, usual_pace, visit_times, visiting_order
from calib_planner.planning.tour import BACK_OFF, LONGEST, SHORTEST
from calib_planner.robot import parse_coupling


def fastest(seconds: float, way: np.ndarray) -> np.ndarray:
    """(joints,) largest speed of a minimum-jerk move, by differences on a fine grid."""
    t = np.linspace(0.0, 1.0, 20_001)
    s = t**3 * (10 - 15 * t + 6 * t * t)
    return np.abs(way) * np.max(np.diff(s) / np.diff(t)) / seconds


@pytest.mark.parametrize("make", [lambda: Robot.load("kuka_kr270"), mixed], ids=["kuka", "mixed"])
def test_no_joint_is_too_fast_and_one_is_as_fast_as_it_may(make):
    robot = make()
    q = random_configurations(robot, 9, 3)
    speeds = np.random.default_rng(4).uniform(0.05, 0.2, q.shape[1])
    start = robot.joint_limits.mean(axis=1)
    pace = Pace(speeds, 3.0, settle=1.0, accelerations=1e3 * speeds)
    times = timetable(plan_of(robot, q), robot, pace, start)
    np.testing.assert_allclose(times.leave - times.arrive, 4.0, rtol=0, atol=1e-9)
    before = np.vstack([start, q[:-1]])
    np.testing.assert_array_equal(times.travel, q - before)
    began = np.concatenate([[0.0], times.leave[:-1]])
    for way, length in zip(q - before, times.arrive - began, strict=True):
        ratio = fastest(length, way) / speeds
        assert ratio.max() == pytest.approx(1.0, abs=1e-6)
    assert times.seconds == times.leave[-1] and times.standing == pytest.approx(9 * 4.0)


def test_backing_off_leaves_no_limit():
    """A narrow joint goes to its far limit; of coupled joints the joints' own motions keep theirs."""
    limits = np.array([[-0.01, 0.02], [-1.0, 1.0], [0.0, 0.08]])
    away = backed_off(np.array([[0.0, 0.5, 0.05], [0.02, -0.5, 0.0]]), limits)
    np.testing.assert_allclose(away, [[0.02, 0.45, 0.0], [-0.01, -0.45, 0.05]], rtol=0, atol=1e-15)
    robot = Robot.load("kuka_kr270").with_couplings([parse_coupling("joint_a3-=joint_a2")])
    corners = np.where(np.random.default_rng(6).random((64, 6)) < 0.5, *robot.own_limits.T)
    shown = corners.copy()
    shown[:, 2] -= corners[:, 1]
    plan = plan_of(robot, shown)
    aside = timetable(plan, robot, usual_pace(robot)).aside
    assert not robot.beyond_limits(aside).any()
    np.testing.assert_allclose(np.abs(robot.motions(aside) - corners), BACK_OFF, rtol=0, atol=1e-12)


def test_an_unknown_start_has_no_travel_and_time_enough_from_anywhere():
    robot = Robot.load("kuka_kr270")
    q = random_configurations(robot, 3, 1)
    pace = usual_pace(robot)
    times = timetable(plan_of(robot, q), robot, pace)
    assert np.isnan(times.travel[0]).all() and np.isfinite(times.travel[1:]).all()
    for start in random_configurations(robot, 500, 2):
        assert (fastest(times.arrive[0], q[0] - start) <= np.asarray(pace.speeds)).all()


def test_the_same_configuration_again_takes_its_time():
    robot = Robot.load("planar_2r")
    q = np.zeros((4, 2))
    pace = Pace([1.0, 1.0], 0.0, settle=0.0)
    times = timetable(plan_of(robot, q), robot, pace, np.zeros(2))
    np.testing.assert_array_equal(times.arrive, 2 * SHORTEST * np.arange(1, 5))  # back off, and come again
    np.testing.assert_array_equal(times.travel, 0.0)
    rows = visit_times(robot, q[:1], 4, pace, np.zeros(2))
    np.testing.assert_array_equal(rows.arrivals, times.arrive)
    assert visit_times(robot, q[:1] + 0.06, 4, pace, np.zeros(2)).arrive == SHORTEST


def test_no_joint_is_pushed_harder_than_it_may():
    """The largest acceleration of a minimum-jerk move, by differences on a fine grid."""
    robot = Robot.load("kuka_kr270")
    q = random_configurations(robot, 9, 5)
    pushes = np.random.default_rng(6).uniform(0.02, 0.1, 6)
    times = timetable(plan_of(robot, q), robot, Pace(np.full(6, 50.0), 0.0, settle=0.0, accelerations=pushes))
    t = np.linspace(0.0, 1.0, 20_001)
    s = t**3 * (10 - 15 * t + 6 * t * t)
    largest = np.abs(np.diff(s, 2)).max() / (t[1] - t[0]) ** 2
    lengths = np.diff(times.arrive)[:, None]
    shares = np.abs(times.travel[1:]) * largest / lengths**2 / pushes
    np.testing.assert_allclose(shares.max(axis=1), 1.0, rtol=1e-6)
    assert np.asarray(Pace([2.0, 3.0]).accelerations).tolist() == [4.0, 6.0]


def test_a_row_tells_where_the_time_goes():
    robot = Robot.load("kuka_kr270")
    q, counts = random_configurations(robot, 5, 7), [1, 4, 2, 1, 3]
    pace = Pace(np.full(6, 0.2), 3.0, settle=2.0)
    times = visit_times(robot, q, counts, pace)
    rows = times.rows()
    assert sum(sum(r[k] for k in ("move", "settle", "measure", "back_off")) for r in rows) == pytest.approx(
        times.seconds
    )
    for row, count in zip(rows, counts, strict=True):
        assert (row["settle"], row["measure"]) == (2.0 * count, 3.0 * count)
        back = 2 * pace.times(np.full((1, 6), 0.05))[0]
        assert row["back_off"] == pytest.approx((count - 1) * back, abs=1e-9)
        assert row["leave"] - row["arrive"] == pytest.approx(5.0 * count + row["back_off"])
    points = times.points(q)
    assert len(points) == 2 * sum(counts) + sum(counts) - 5
    stamps = [after for _, after in points]
    assert stamps == sorted(stamps) and stamps[-1] == round(times.seconds * 1e9)
    for goal, _ in points:
        robot.check_within_limits("points", np.array([goal]))


def test_the_order_is_short_in_what_it_is_asked_for():
    robot = Robot.load("kuka_kr270")
    q = random_configurations(robot, 12, 8)
    slow = Pace(np.array([0.02, 1.0, 1.0, 1.0, 1.0, 1.0]))  # joint 1 decides
    here = robot.joint_limits.mean(axis=1)
    by_range, by_time = (visit_times(robot, q[visiting_order(q, robot, p)], 1, slow, here) for p in (None, slow))
    assert by_time.seconds < by_range.seconds


def test_bad_paces_and_endless_tours_are_refused():
    robot = Robot.load("planar_2r")
    plan = plan_of(robot, np.zeros((2, 2)), 100_000)
    for speeds in ([0.0, 1.0], [-1.0, 1.0], [np.nan, 1.0], [[1.0]]):
        with pytest.raises(InputError, match="speeds"):
            Pace(speeds)
    with pytest.raises(InputError, match="dwell"):
        Pace([1.0, 1.0], -1.0)
    with pytest.raises(InputError, match="settle"):
        Pace([1.0, 1.0], settle=-1.0)
    with pytest.raises(InputError, match="accelerations"):
        Pace([1.0, 1.0], accelerations=[1.0, 0.0])
    with pytest.raises(InputError, match="q1, q2"):
        timetable(plan, robot, Pace([1.0]))
    with pytest.raises(InputError, match=str(LONGEST)):
        timetable(plan, robot, Pace([1.0, 1.0], 80_000.0))
