# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Ways in time: against SciPy's cubic Hermite spline, and against what a minimum-jerk move is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from calib_planner import InputError
from calib_planner.planning.tour import Pace
from calib_planner.planning.trajectory import Trajectory, joined, smooth, smooth_trajectory


def random_way(seed: int, points: int = 6, joints: int = 3) -> tuple[Trajectory, CubicHermiteSpline]:
    """Points at uneven times with any velocities, and the spline through them."""
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.0], rng.uniform(0.2, 2.0, points - 1).cumsum()])
    positions, velocities = rng.normal(size=(2, points, joints))
    return Trajectory(times, positions, velocities), CubicHermiteSpline(times, positions, velocities)


@pytest.mark.parametrize("seed", range(3))
def test_a_way_is_the_hermite_spline_and_stands_before_and_after(seed: int) -> None:
    way, spline = random_way(seed)
    times = np.concatenate([way.times, np.linspace(0.0, way.seconds, 57)])
    np.testing.assert_allclose(way.at(times), spline(times), atol=1e-12)
    np.testing.assert_allclose(way.at([-1.0, way.seconds + 1.0]), [way.start, way.goal], atol=1e-12)
    np.testing.assert_array_equal(way.start, way.positions[0])
    np.testing.assert_array_equal(way.goal, way.positions[-1])


@pytest.mark.parametrize("seed", range(6))
def test_the_fastest_and_the_strongest_of_a_way(seed: int) -> None:
    """Speeds by looking closely; accelerations, linear in each piece, at its ends."""
    way, spline = random_way(seed)
    speed, push = way.fastest()
    looks = np.concatenate([np.linspace(0.0, way.seconds, 20_001), way.times])
    fine = np.abs(spline.derivative()(looks)).max(axis=0)
    assert (speed >= fine - 1e-12).all()
    np.testing.assert_allclose(speed, fine, rtol=1e-5)
    ends = np.concatenate([way.times[:-1] + 1e-12, way.times[1:] - 1e-12])
    np.testing.assert_allclose(push, np.abs(spline.derivative(2)(ends)).max(axis=0), rtol=1e-6)


def test_between_two_times_a_way_is_where_its_points_and_nine_looks_are() -> None:
    way, spline = random_way(1)
    begin, end = way.times[1] - 0.1, way.times[4] + 0.1
    low, high = way.between(begin, end)
    seen = spline([*np.linspace(begin, end, 9), *way.times[1:5]])
    np.testing.assert_allclose([low, high], [seen.min(axis=0), seen.max(axis=0)], atol=1e-12)
    far = spline(np.linspace(begin, end, 2001))
    assert (low >= far.min(axis=0) - 1e-12).all() and (high <= far.max(axis=0) + 1e-12).all()


@pytest.mark.parametrize("limit", ["speed", "acceleration", "none"])
def test_a_way_is_slowed_as_much_as_its_limits_need(limit: str) -> None:
    way, spline = random_way(2)
    speed, push = way.fastest()
    speeds = speed / np.array([1.0, 3.0, 2.0]) if limit == "speed" else 2.0 * speed
    pushes = push / np.array([1.0, 2.0, 4.0]) if limit == "acceleration" else 2.0 * push
    slow = way.slowed(Pace(speeds, accelerations=pushes))
    factor = {"speed": 3.0, "acceleration": 2.0, "none": 1.0}[limit]  # accelerations go by its square
    np.testing.assert_allclose(slow.times, factor * way.times)
    np.testing.assert_allclose(
        slow.at(factor * np.linspace(0.0, way.seconds, 9)), spline(np.linspace(0, way.seconds, 9))
    )
    now, hard = slow.fastest()
    assert (now <= speeds * (1 + 1e-9)).all() and (hard <= pushes * (1 + 1e-9)).all()


def test_a_move_has_the_least_jerk() -> None:
    """The polynomial of fifth degree that is at rest, with no acceleration, at both ends."""
    tau, h = np.linspace(0.0, 1.0, 21), 1e-4
    np.testing.assert_allclose(smooth(tau), 10 * tau**3 - 15 * tau**4 + 6 * tau**5, atol=1e-15)
    np.testing.assert_array_equal(smooth([-0.5, 0.0, 1.0, 1.5]), [0.0, 0.0, 1.0, 1.0])
    np.testing.assert_allclose((smooth([h, 1.0]) - smooth([0.0, 1.0 - h])) / h, 0.0, atol=1e-6)
    np.testing.assert_allclose(smooth(tau) + smooth(1.0 - tau), 1.0, atol=1e-15)


@pytest.mark.parametrize(("far", "points"), [(1e-3, 10), (1.3, 25), (50.0, 100)])
def test_from_rest_to_rest_as_fast_as_the_pace_allows(far: float, points: int) -> None:
    """Ten points a second, ten at least and a hundred at most for each move."""
    pace = Pace([1.0, 2.0], accelerations=[1e3, 1e3])
    waypoints = np.array([[0.2, -0.1], [0.2 + far, -0.1 - 0.5 * far], [0.2, 0.0]])
    way = smooth_trajectory(waypoints, pace)
    first, second = (float(pace.times(np.abs(step))) for step in np.diff(waypoints, axis=0))
    assert way.seconds == pytest.approx(first + second)
    assert len(way.times) == 1 + 2 * points
    np.testing.assert_allclose(np.diff(way.times[: points + 1]), first / points)
    np.testing.assert_allclose(way.at([0.0, first, first + second]), waypoints, atol=1e-12)
    np.testing.assert_array_equal(way.velocities[[0, points, -1]], 0.0)
    tau = way.times[: points + 1] / first
    expected = waypoints[0] + np.outer(smooth(tau), waypoints[1] - waypoints[0])
    np.testing.assert_allclose(way.positions[: points + 1], expected, atol=1e-12)
    h = 1e-6
    rates = np.outer((smooth(tau + h) - smooth(tau - h)) / (2 * h * first), waypoints[1] - waypoints[0])
    np.testing.assert_allclose(way.velocities[1:points], rates[1:-1], rtol=1e-6, atol=1e-9 * far)
    if far == 1.3:
        assert way.fastest()[0][0] == pytest.approx(1.0, rel=2e-3)  # the slowest joint is as fast as it may


def test_ways_are_joined_end_to_end() -> None:
    parts = [random_way(seed, 3 + seed)[0] for seed in range(3)]
    whole = joined(parts)
    assert whole.seconds == pytest.approx(sum(p.seconds for p in parts))
    assert len(whole.times) == 3 + 4 + 5 - 2
    begin = 0.0
    for part in parts:
        inside = np.linspace(0.0, part.seconds, 11)[1:]
        if part is not parts[0]:
            inside = inside[inside > part.times[1]]  # the joint of two ways has the velocity of the first
        np.testing.assert_allclose(whole.at(begin + inside), part.at(inside), atol=1e-9)
        begin += part.seconds


@pytest.mark.parametrize("times", [[0.0], [0.1, 1.0], [0.0, 1.0, 1.0], [0.0, 2.0, 1.0]])
def test_times_ascend_from_zero(times: list[float]) -> None:
    with pytest.raises(InputError, match="ascend from 0"):
        Trajectory(np.array(times), np.zeros((len(times), 2)), np.zeros((len(times), 2)))


@pytest.mark.parametrize(("positions", "velocities"), [((3, 2), (3, 1)), ((4, 2), (3, 2)), ((3,), (3, 2))])
def test_positions_and_velocities_have_a_row_for_each_time(
    positions: tuple[int, ...], velocities: tuple[int, ...]
) -> None:
    with pytest.raises(InputError, match=r"positions|velocities"):
        Trajectory(np.arange(3.0), np.zeros(positions), np.zeros(velocities))
