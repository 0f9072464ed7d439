# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The way between configurations as a controller gets it: joint positions and velocities at times.

Between rests all joints move together along s(τ) = 10τ³ − 15τ⁴ + 6τ⁵, τ from 0 to 1 over the time that ``Pace``
gives the move: the least jerk, and at rest at both ends without acceleration. The controller gets points of that
way, a tenth of a second apart at most. Between two points, with positions p₀, p₁ and velocities v₀, v₁ and the
time h between them, controllers take the cubic polynomial that has all four (Hermite's),

    p(u) = p₀ + h v₀ u + (3Δ − 2h v₀ − h v₁) u² + (h v₀ + h v₁ − 2Δ) u³ ,   Δ = p₁ − p₀ ,   u from 0 to 1.

The same polynomial says here where the robot has to be at any time, and how fast it is at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_array, frozen
from calib_planner.errors import InputError
from calib_planner.planning.tour import Pace

SPACING = 0.1
"""Time between two points of a move, at most while it has fewer than ``MOST_POINTS`` [s]."""
FEWEST_POINTS, MOST_POINTS = 10, 100
"""Points of one move: with ten the cubic polynomials are within 10⁻⁴ of the way from s(τ)."""
LOOKS = 9
"""Places between two times at which ``between`` looks, besides the points."""


def smooth(tau: ArrayLike) -> FloatArray:
    """s(τ) of times τ (…,) as shares of a move; at rest before and after it."""
    x = np.clip(tau, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x * x))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Points of a way, n of them; at rest before the first and after the last.

    Attributes:
        times: (n,) ascending, the first one 0 [s].
        positions: (n, joints) [rad | m].
        velocities: (n, joints) [rad/s | m/s].

    Raises:
        InputError: Shapes that do not fit, fewer than two points, or times that do not ascend from 0.
    """

    times: FloatArray
    positions: FloatArray
    velocities: FloatArray

    def __post_init__(self) -> None:
        times = check_array("times", self.times, (None,), meaning="s")
        if len(times) < 2 or times[0] != 0.0 or not (np.diff(times) > 0).all():
            raise InputError("times", f"{len(times)} of them", "at least two that ascend from 0 s")
        joints = np.shape(self.positions)[-1] if np.ndim(self.positions) == 2 else None
        shape = (len(times), joints)
        object.__setattr__(self, "times", times)
        for name, meaning in (("positions", "rad | m"), ("velocities", "rad/s | m/s")):
            object.__setattr__(self, name, check_array(name, getattr(self, name), shape, meaning=meaning))

    @property
    def seconds(self) -> float:
        """How long it takes [s]."""
        return float(self.times[-1])

    @property
    def start(self) -> FloatArray:
        """(joints,) the first position [rad | m]."""
        return np.asarray(self.positions[0])

    @property
    def goal(self) -> FloatArray:
        """(joints,) the last position [rad | m]."""
        return np.asarray(self.positions[-1])

    def at(self, times: ArrayLike) -> FloatArray:
        """(k, joints) positions at ``times`` (k,) [s] → [rad | m]."""
        t = np.clip(np.asarray(times, float), 0.0, self.seconds)
        k = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2)
        h, (start, first, second, third) = np.diff(self.times)[k], self._pieces
        u = ((t - self.times[k]) / h)[:, None]
        return np.asarray(start[k] + u * (first[k] + u * (second[k] + u * third[k])))

    def between(self, begin: float, end: float) -> FloatArray:
        """(2, joints) smallest and largest position of each joint from ``begin`` to ``end`` [s] → [rad | m]."""
        inside = self.times[(self.times > begin) & (self.times < end)]
        seen = self.at(np.concatenate([np.linspace(begin, end, LOOKS), inside]))
        return np.stack([seen.min(axis=0), seen.max(axis=0)])

    def fastest(self) -> tuple[FloatArray, FloatArray]:
        """Largest speed and largest acceleration of each joint, both (joints,) [rad/s | m/s], [… /s²]."""
        h, (_, first, second, third) = np.diff(self.times)[:, None], self._pieces
        ends = np.abs(self.velocities).max(axis=0)
        # The velocity of a piece is a parabola in u, whose vertex may lie between its ends.
        with np.errstate(divide="ignore", invalid="ignore"):
            u = -second / (3.0 * third)
        inside = np.where((u > 0) & (u < 1), u, 0.0)
        vertex = np.abs((first + inside * (2.0 * second + inside * 3.0 * third)) / h).max(axis=0)
        push = np.maximum(np.abs(2.0 * second), np.abs(2.0 * second + 6.0 * third)) / h**2
        return np.maximum(ends, vertex), np.asarray(push.max(axis=0))

    def slowed(self, pace: Pace) -> Trajectory:
        """The same way, stretched in time until no joint exceeds the speeds and accelerations of ``pace``."""
        speed, push = self.fastest()
        fast = (speed / np.asarray(pace.speeds)).max()
        brisk = np.sqrt((push / np.asarray(pace.accelerations)).max())
        factor = max(1.0, float(fast), float(brisk))
        return replace(self, times=self.times * factor, velocities=self.velocities / factor)

    @property
    def _pieces(self) -> tuple[FloatArray, ...]:
        """Coefficients of u⁰, u¹, u², u³, each (n − 1, joints) [rad | m]."""
        h, p = np.diff(self.times)[:, None], self.positions
        v0, v1, way = h * self.velocities[:-1], h * self.velocities[1:], np.diff(p, axis=0)
        return p[:-1], v0, 3.0 * way - 2.0 * v0 - v1, v0 + v1 - 2.0 * way


def smooth_trajectory(waypoints: ArrayLike, pace: Pace) -> Trajectory:
    """From rest to rest through ``waypoints`` (k, joints), k >= 2 [rad | m], as fast as ``pace`` allows."""
    points = check_array("waypoints", waypoints, (None, None), meaning="rad | m")
    return joined([_move(start, goal, pace) for start, goal in pairwise(points)])


def _move(start: FloatArray, goal: FloatArray, pace: Pace) -> Trajectory:
    way, seconds = goal - start, float(pace.times(np.abs(goal - start)))
    count = int(np.clip(np.ceil(seconds / SPACING), FEWEST_POINTS, MOST_POINTS))
    tau = np.linspace(0.0, 1.0, count + 1)
    speed = 30.0 * tau**2 * (1.0 - tau) ** 2 / seconds
    positions, velocities = start + np.outer(smooth(tau), way), np.outer(speed, way)
    return Trajectory(np.asarray(tau * seconds), np.asarray(positions), np.asarray(velocities))


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """One after the other: each begins where the one before ends; of the two points there one is left out."""
    ends = np.cumsum([0.0, *(p.seconds for p in parts)])
    times = [p.times[min(k, 1) :] + ends[k] for k, p in enumerate(parts)]
    rows = [(p.positions[min(k, 1) :], p.velocities[min(k, 1) :]) for k, p in enumerate(parts)]
    positions, velocities = (np.concatenate(many) for many in zip(*rows, strict=True))
    return Trajectory(frozen(np.concatenate(times)), positions, velocities)
