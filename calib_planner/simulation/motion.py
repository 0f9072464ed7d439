"""How the simulated robot moves through a plan: a function of time, without a clock of its own.

Between rests all joints move together along s(τ) = 10τ³ − 15τ⁴ + 6τ⁵, at rest at both ends with zero
acceleration; the fastest joint reaches ``speed``. Every measurement is a standstill of its own, so the robot
backs off a little between two at (nearly) the same place.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray, IntArray, frozen

PEAK = 1.875
"""Largest value of ds/dτ."""
BACK_OFF = 0.05
"""How far the robot backs off between two standstills at nearly the same place [rad | m]."""


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
        x = min(max((time - self.begin) / (self.end - self.begin), 0.0), 1.0)
        return self.start + (self.goal - self.start) * (x**3 * (10.0 - 15.0 * x + 6.0 * x * x))


@dataclass(frozen=True, eq=False)
class Tour:
    """All phases of an execution, from time 0."""

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


def make_tour(
    start: FloatArray,
    configurations: FloatArray,
    repetitions: IntArray,
    limits: FloatArray,
    speed: float,
    dwell: float,
) -> Tour:
    """Visit every configuration as often as wanted.

    Args:
        start: (n,) where the robot is [rad | m].
        configurations: (m, n) [rad | m].
        repetitions: (m,) standstills at each.
        limits: (n, 2) joint limits [rad | m].
        speed: Largest joint speed [rad/s | m/s].
        dwell: Length of a standstill [s].
    """
    phases: list[Phase] = []
    here, now = frozen(start), 0.0

    def go(goal: FloatArray, index: int) -> None:
        nonlocal here, now
        length = PEAK * float(np.max(np.abs(goal - here))) / speed
        phases.append(Phase(now, now + length, here, frozen(goal), index, False))
        here, now = frozen(goal), now + length

    for index, (goal, count) in enumerate(zip(configurations, repetitions, strict=True)):
        for _ in range(int(count)):
            if np.max(np.abs(goal - here)) < BACK_OFF:
                go(backed_off(goal, limits), index)
            go(goal, index)
            phases.append(Phase(now, now + dwell, here, here, index, True))
            now += dwell
    return Tour(tuple(phases))


def backed_off(q: FloatArray, limits: FloatArray) -> FloatArray:
    """``q`` (n,) moved by ``BACK_OFF`` towards the middle of the limits."""
    middle = limits.mean(axis=1)
    return q + BACK_OFF * np.where(q <= middle, 1.0, -1.0)
