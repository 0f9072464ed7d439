# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A tracker that loses its targets where the robot arrives or departs, and gets them back."""

from __future__ import annotations

import numpy as np
import pytest

from calib_planner import Robot
from calib_planner.planning import Pace, smooth_trajectory
from calib_planner.simulation import (
    NANO,
    Faults,
    Followed,
    Itinerary,
    Rates,
    SimulatedCell,
    Streams,
    World,
    make_tour,
    play,
)

ROBOT = Robot.load("planar_2r")
Q = np.array([[1.0, -1.0], [-1.0, 1.0], [0.5, 0.5]])
TOUR = make_tour(np.zeros(2), Q, np.array([1, 1, 1]), ROBOT.joint_limits, 2.0, 1.0)
RATES = Rates(100.0, 50.0)


def world(seed: int = 0, **faults: float) -> World:
    return World(SimulatedCell(ROBOT, {}), Faults(**faults), seed)  # type: ignore[arg-type]


def seen(made: World) -> np.ndarray:
    """Stamps [s] at which the target was seen."""
    return np.array([m.stamp for m in play(made, TOUR, RATES) if m.stream]) / NANO


@pytest.mark.parametrize("fault", ["beam_lost_standing", "beam_lost_moving"])
def test_it_is_lost_where_the_fault_says_and_comes_back(fault: str) -> None:
    stamps = seen(world(**{fault: 1.0}, beam_lost_duration=0.5))
    begins = [p.begin for p in TOUR.phases if p.measuring == (fault == "beam_lost_standing")]
    for begin in begins:
        assert not ((stamps > begin + 0.05) & (stamps < begin + 0.48)).any()
        assert ((stamps > begin + 0.55) & (stamps < begin + 0.95)).any()
    everything = seen(world())
    assert len(everything) - len(stamps) == pytest.approx(len(begins) * 25, abs=6)


def test_a_share_of_them_by_the_seed() -> None:
    counts = [len(seen(world(seed, beam_lost_standing=0.5, beam_lost_duration=0.5))) for seed in range(8)]
    assert len(set(counts)) > 2 and counts == [
        len(seen(world(seed, beam_lost_standing=0.5, beam_lost_duration=0.5))) for seed in range(8)
    ]


def test_without_an_end_somebody_brings_it_back() -> None:
    walk = Itinerary(np.zeros(2))
    streams = Streams(world(beam_lost_moving=1.0, beam_lost_duration=0.0), walk.at, RATES)
    streams.advance(NANO // 2)
    assert streams.locked(NANO // 2) == (True, False) and not streams.restore_beam(NANO // 2)
    walk.begin(TOUR, NANO // 2)
    now = NANO
    streams.advance(now)
    assert streams.locked(now) == (False, True)
    assert not [m for m in streams.advance(now + NANO // 2) if m.stream]
    assert streams.restore_beam(now + NANO // 2) and streams.locked(now + NANO // 2) == (True, False)
    assert [m for m in streams.advance(now + NANO) if m.stream]


def test_a_break_is_not_a_loss() -> None:
    walk = Itinerary(np.zeros(2))
    streams = Streams(world(beam_break_interval=0.1, beam_break_duration=3600.0), walk.at, RATES)
    streams.advance(5 * NANO)
    assert streams.locked(5 * NANO) == (False, False)


def test_the_end_of_a_trajectory_is_an_arrival() -> None:
    walk, way = Itinerary(np.zeros(2)), smooth_trajectory([np.zeros(2), Q[0], Q[1]], Pace([2.0, 2.0]))
    for number in range(3):
        begin = (1 + 20 * number) * NANO
        walk.begin(Followed(way), begin)
        stamps = begin + np.array([0, 1, round(way.seconds * NANO) + 1, round((way.seconds + 2.0) * NANO)])
        there = walk.at(stamps)
        assert there.arrival.tolist() == [number - 1, number - 1, number, number]
        assert np.isinf(there.since[:2]).all() and np.allclose(there.since[2:], [0.0, 2.0], atol=1e-6)
        assert np.allclose(there.joints[[0, 3]], [np.zeros(2), Q[1]])
        walk.halt(int(stamps[-1]))
        assert walk.at(stamps[-1:] + NANO).since[0] == pytest.approx(3.0)
