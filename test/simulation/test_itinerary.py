# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Tours one after the other on one clock."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from calib_planner.simulation import NANO, Itinerary, make_tour

LIMITS = np.array([[-3.0, 3.0], [-3.0, 3.0]])
Q = np.array([[1.0, -2.0], [-2.0, 2.0]])


def test_many_times_at_once_are_one_after_the_other() -> None:
    tour = make_tour(np.zeros(2), Q, np.array([2, 1]), LIMITS, 4.0, 0.5)
    times = np.linspace(-0.1, tour.seconds + 1.0, 997)
    found = tour.stands(times)
    assert np.allclose(found.joints, [tour.at(t).joints(t) for t in times], atol=1e-12)
    for t, arrival, since in zip(times, found.arrival, found.since, strict=True):
        phase = tour.at(t)
        begun = sum(p.measuring and p.begin <= t for p in tour.phases)
        assert arrival == begun - 1
        assert since == (t - phase.begin if phase.measuring else np.inf)


def test_however_fast_a_joint_state_shows_that_the_robot_backed_off() -> None:
    """At 50 rad/s the way aside and back takes 4 ms, joint states come every 20 ms."""
    period = 0.02
    tour = make_tour(np.zeros(2), Q[:1], np.array([5]), LIMITS, 50.0, 0.1, shortest=period)
    rests = [p for p in tour.phases if p.measuring]
    for before, after in pairwise(rests):
        for phase in np.linspace(0.0, 1.0, 23):
            times = (np.arange(before.end / period, after.begin / period + 1) + phase) * period
            between = [float(t) for t in times if before.end < t < after.begin]
            assert max(np.abs(tour.at(t).joints(t) - Q[0]).max() for t in between) > 0.02


def test_arrivals_are_counted_over_all_tours() -> None:
    walk = Itinerary(np.zeros(2))
    assert walk.at(np.array([0, 10**18])).arrival.tolist() == [-1, -1]
    first = make_tour(np.zeros(2), Q, np.array([1, 1]), LIMITS, 4.0, 0.5)
    begin = 7 * NANO
    walk.begin(first, begin)
    end = begin + round((first.seconds + 2.0) * NANO)
    there = walk.at(np.array([end]))
    assert there.arrival[0] == 1 and np.array_equal(there.joints[0], Q[1])
    second = make_tour(there.joints[0], Q[:1], np.array([1]), LIMITS, 4.0, 0.5)
    walk.begin(second, end)
    assert walk.at(np.array([end])).arrival[0] == 1
    assert walk.at(np.array([end + round(second.seconds * NANO)])).arrival[0] == 2


def test_stopped_on_the_way_it_stands_there() -> None:
    walk = Itinerary(np.zeros(2))
    tour = make_tour(np.zeros(2), Q, np.array([1, 1]), LIMITS, 4.0, 0.5)
    walk.begin(tour, 0)
    moment = NANO // 3
    before = walk.at(np.array([moment]))
    walk.halt(moment)
    later = walk.at(np.array([moment, 10 * moment]))
    assert np.array_equal(later.joints, np.repeat(before.joints, 2, axis=0))
    assert np.isinf(later.since).all() and (later.arrival == -1).all()


def test_stopped_at_rest_the_time_since_the_arrival_goes_on() -> None:
    walk = Itinerary(np.zeros(2))
    tour = make_tour(np.zeros(2), Q[:1], np.array([1]), LIMITS, 4.0, 0.5)
    walk.begin(tour, 0)
    end = round(tour.seconds * NANO)
    walk.halt(end)
    found = walk.at(np.array([end, end + NANO]))
    assert np.allclose(found.since, [0.5, 1.5], atol=1e-8) and (found.arrival == 0).all()
