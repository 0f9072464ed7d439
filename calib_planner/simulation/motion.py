# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How the simulated robot moves through a plan: a function of time, without a clock of its own.

Between rests all joints move together along s(τ) = 10τ³ − 15τ⁴ + 6τ⁵, at rest at both ends with zero
acceleration; the fastest joint reaches ``speed``. Every measurement is a standstill of its own, so the robot
backs off a little between two at (nearly) the same place.

A ``Tour`` is one execution, from its time 0, and a ``Followed`` trajectory is one move that somebody else thought
of; an ``Itinerary`` is all of them, one after the other, on a clock.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib_planner.acquisition import NANO
from calib_planner.arrays import FloatArray, IntArray, frozen
from calib_planner.planning import PEAK, Trajectory, backed_off, near, smooth


@dataclass(frozen=True, eq=False)
class Phase:
    """A move or a rest: from ``begin`` to ``end`` [s], joints from ``start`` to ``goal`` [rad | m]."""

    begin: float
    end: float
    start: FloatArray
    goal: FloatArray
    index: int
    measuring: bool

    def joints(self, time: float) -> FloatArray:
        """(joints,) at ``time`` [s]."""
        if self.end <= self.begin:
            return self.goal
        return self.start + (self.goal - self.start) * smooth((time - self.begin) / (self.end - self.begin))


@dataclass(frozen=True, eq=False)
class Stand:
    """Where the robot is at n times.

    Attributes:
        joints: (n, joints) [rad | m].
        arrival: (n,) number of the last arrival for a measurement, from 0; −1 before the first.
        since: (n,) time since that arrival [s]; infinite unless the robot still stands there.
    """

    joints: FloatArray
    arrival: IntArray
    since: FloatArray


@dataclass(frozen=True, eq=False)
class Tour:
    """All phases of an execution, from time 0; at least one."""

    phases: tuple[Phase, ...]

    @property
    def seconds(self) -> float:
        """Length of the whole [s]."""
        return self.phases[-1].end if self.phases else 0.0

    def at(self, time: float) -> Phase:
        """The phase at ``time`` [s], the last one after the end."""
        k = bisect_right([p.begin for p in self.phases], time) - 1
        return self.phases[max(k, 0)]

    def standstills(self, time: float) -> int:
        """Standstills completed by ``time`` [s]."""
        return sum(p.measuring and p.end <= time for p in self.phases)

    def stands(self, times: FloatArray) -> Stand:
        """Where the robot is at ``times`` (n,) [s], in the last place after the end."""
        begin, end, start, goal, measuring, arrival = self._columns
        k = np.maximum(np.searchsorted(begin, times, side="right") - 1, 0)
        length = np.maximum(end[k] - begin[k], 1e-12)
        joints = start[k] + (goal[k] - start[k]) * smooth((times - begin[k]) / length)[:, None]
        return Stand(joints, arrival[k], np.where(measuring[k], times - begin[k], np.inf))

    @cached_property
    def _columns(self) -> tuple[FloatArray, ...]:
        """Begin, end, start, goal, measuring and number of the last arrival, a row per phase."""
        p = self.phases
        measuring = np.array([x.measuring for x in p])
        times = (np.array([x.begin for x in p]), np.array([x.end for x in p]))
        places = (np.array([x.start for x in p]), np.array([x.goal for x in p]))
        return (*times, *places, measuring, np.cumsum(measuring) - 1)


def make_tour(
    start: FloatArray,
    configurations: FloatArray,
    repetitions: IntArray,
    limits: FloatArray,
    speed: float,
    dwell: float,
    coupling: FloatArray | None = None,
    shortest: float = 0.0,
) -> Tour:
    """Visit every configuration as often as wanted.

    Args:
        start: (n,) where the robot is [rad | m].
        configurations: (m, n) [rad | m].
        repetitions: (m,) standstills at each.
        limits: (n, 2) limits of the joints' own motions [rad | m].
        speed: Largest joint speed [rad/s | m/s].
        dwell: Length of a standstill [s].
        coupling: (n, n) of a robot that shows joints against others, see ``Robot.coupling``.
        shortest: Least length of a move [s]; if it is a period of the joint states, at least one of them shows
            that the robot backed off, whatever the speed.
    """
    phases: list[Phase] = []
    here, now = frozen(start), 0.0

    def go(goal: FloatArray, index: int) -> None:
        nonlocal here, now
        length = max(PEAK * float(np.max(np.abs(goal - here))) / speed, shortest)
        phases.append(Phase(now, now + length, here, frozen(goal), index, False))
        here, now = frozen(goal), now + length

    for index, (goal, count) in enumerate(zip(configurations, repetitions, strict=True)):
        for _ in range(int(count)):
            if near(goal - here):
                go(backed_off(goal, limits, coupling), index)
            go(goal, index)
            phases.append(Phase(now, now + dwell, here, here, index, True))
            now += dwell
    return Tour(tuple(phases))


@dataclass(frozen=True, eq=False)
class Followed:
    """A trajectory that is followed exactly, from time 0; at its end the robot has arrived for a measurement."""

    way: Trajectory

    def stands(self, times: FloatArray) -> Stand:
        """Where the robot is at ``times`` (n,) [s], at the end of the trajectory after that."""
        since = times - self.way.seconds
        there = since >= 0.0
        return Stand(self.way.at(times), np.where(there, 0, -1), np.where(there, since, np.inf))


@dataclass(frozen=True, eq=False)
class _Leg:
    """From ``began`` [ns] on: a tour, a trajectory, or a rest at ``joints``; ``arrivals`` were made before, the
    last at ``arrived`` [ns] if the robot still stands there."""

    began: int
    joints: FloatArray
    arrivals: int
    arrived: int | None
    tour: Tour | Followed | None = None


class Itinerary:
    """Where the robot is at any time of a clock [ns]: at rest, but for the tours it is sent on.

    All that changes is one reference to an immutable value: one thread may send while another looks.

    Args:
        rest: (joints,) where it stands at first [rad | m].
    """

    def __init__(self, rest: FloatArray) -> None:
        self._leg = _Leg(0, frozen(rest), 0, None)

    def begin(self, tour: Tour | Followed, stamp: int) -> None:
        """Send it on ``tour`` at ``stamp`` [ns]."""
        self.halt(stamp)
        rest = self._leg
        self._leg = _Leg(stamp, rest.joints, rest.arrivals, None, tour)

    def halt(self, stamp: int) -> None:
        """It stands still where it is at ``stamp`` [ns], from then on."""
        here = self.at(np.array([stamp]))
        since = float(here.since[0])
        arrived = stamp - round(since * NANO) if np.isfinite(since) else None
        self._leg = _Leg(stamp, frozen(here.joints[0]), int(here.arrival[0]) + 1, arrived)

    def at(self, stamps: IntArray) -> Stand:
        """Where it is at ``stamps`` (n,) [ns]."""
        leg = self._leg
        if leg.tour is not None:
            stand = leg.tour.stands((stamps - leg.began) / NANO)
            return Stand(stand.joints, stand.arrival + leg.arrivals, stand.since)
        n = len(stamps)
        since = np.full(n, np.inf) if leg.arrived is None else (stamps - leg.arrived) / NANO
        return Stand(np.tile(leg.joints, (n, 1)), np.full(n, leg.arrivals - 1), since)
