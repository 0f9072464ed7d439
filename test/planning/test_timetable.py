"""Timetables: no joint exceeds its speed, every stop has its standstill, and what is not known is not stated."""

from __future__ import annotations

import numpy as np
import pytest
from robots import mixed, plan_of, random_configurations

from calib_planner import Robot
from calib_planner.errors import InputError
from calib_planner.planning import Pace, timetable, usual_pace
from calib_planner.planning.tour import LONGEST, SHORTEST


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
    times = timetable(plan_of(robot, q, 2), robot, Pace(speeds, 4.0), start)
    np.testing.assert_allclose(times.leave - times.arrive, 8.0, rtol=0, atol=1e-9)
    before = np.vstack([start, q[:-1]])
    np.testing.assert_array_equal(times.travel, q - before)
    began = np.concatenate([[0.0], times.leave[:-1]])
    for way, length in zip(q - before, times.arrive - began, strict=True):
        ratio = fastest(length, way) / speeds
        assert ratio.max() == pytest.approx(1.0, abs=1e-6)
    assert times.seconds == times.leave[-1] and times.standing == pytest.approx(9 * 8.0)


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
    times = timetable(plan_of(robot, q), robot, Pace([1.0, 1.0], 0.0), np.zeros(2))
    np.testing.assert_array_equal(times.arrive, SHORTEST * np.arange(1, 5))
    np.testing.assert_array_equal(times.travel, 0.0)


def test_bad_paces_and_endless_tours_are_refused():
    robot = Robot.load("planar_2r")
    plan = plan_of(robot, np.zeros((2, 2)), 100_000)
    for speeds in ([0.0, 1.0], [-1.0, 1.0], [np.nan, 1.0], [[1.0]]):
        with pytest.raises(InputError, match="speeds"):
            Pace(speeds)
    with pytest.raises(InputError, match="dwell"):
        Pace([1.0, 1.0], -1.0)
    with pytest.raises(InputError, match="q1, q2"):
        timetable(plan, robot, Pace([1.0]))
    with pytest.raises(InputError, match=str(LONGEST)):
        timetable(plan, robot, Pace([1.0, 1.0], 80_000.0))
