# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The order of the visits, how far the joints travel from visit to visit, and how long the tour takes.

``visiting_order`` sorts the same configurations for little joint travel between them, or for little time.

*A move.* All joints of a move start and end together at rest. A smooth move runs fastest at PEAK times its mean
speed: 15/8 for the minimum-jerk polynomial 10τ³ − 15τ⁴ + 6τ⁵, 3/2 for a cubic. Its largest acceleration is
PUSH·|Δ|/T²: 10/√3 for that polynomial. A joint with travel Δ_j, speed limit v_j and acceleration limit a_j stays
below both when the move takes

    T = max(SHORTEST, max_j PEAK·|Δ_j| / v_j, max_j √(PUSH·|Δ_j| / a_j)).

*A visit* is the move there, the time to settle and the time of the measurement. A repetition is a further visit
to the same configuration: the robot backs off a little and comes back, since only what is new at each visit can
be averaged, and since a standstill is one measurement. So a configuration with r visits takes

    move + r (settle + dwell) + (r − 1) (there and back).

If it is not known where the robot stands before the first visit, the way there has no travel that could be
stated, and its time is that from the farthest end of every joint's range, which is enough for any start.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_planner.arrays import FloatArray, IntArray, check_array, check_number, frozen
from calib_planner.errors import InputError
from calib_planner.planning.result import Plan
from calib_planner.robot import Robot

LARGE = 200
"""Above this many configurations the tour is not improved after its construction."""


def visiting_order(
    configurations: FloatArray, robot: Robot, pace: Pace | None = None, start: FloatArray | None = None
) -> IntArray:
    """Row numbers in an order with little travel: nearest neighbour from the start, then 2-opt.

    Args:
        configurations: (m, joints) [rad | m].
        robot: Its joint limits are the scale of travel.
        pace: With it a way counts by the time that it takes; without, by the slowest joint's share of its range.
        start: (joints,) where the robot stands before [rad | m]; ``None``: in the middle of its range.
    """
    home = robot.joint_limits.mean(axis=1) if start is None else start
    points = np.vstack([home, configurations])
    ways = np.abs(points[:, None] - points[None])
    if pace is None:
        distance = (ways / np.diff(robot.joint_limits, axis=1)[:, 0]).max(axis=2)
    else:
        distance = pace.times(ways)
    tour, left = [0], set(range(1, len(points)))
    while left:
        row = distance[tour[-1]]
        tour.append(min(left, key=lambda i: (row[i], i)))
        left.remove(tour[-1])
    if len(tour) <= LARGE:
        _two_opt(tour, distance)
    return np.array(tour[1:]) - 1


def _two_opt(tour: list[int], distance: FloatArray) -> None:
    """Turn round stretches of the tour, in place, while that shortens it; its start stays."""
    improved = True
    while improved:
        improved = False
        for i in range(1, len(tour) - 1):
            for j in range(i + 1, len(tour)):
                change = distance[tour[i - 1], tour[j]] - distance[tour[i - 1], tour[i]]
                if j + 1 < len(tour):
                    change += distance[tour[i], tour[j + 1]] - distance[tour[j], tour[j + 1]]
                if change < -1e-12:
                    tour[i : j + 1] = tour[i : j + 1][::-1]
                    improved = True


# ── the timetable ────────────────────────────────────────────────────────────────────────────────────────

PEAK = 1.875
"""Fastest over mean speed of a minimum-jerk move."""
PUSH = 10.0 / np.sqrt(3.0)
"""Largest acceleration of a minimum-jerk move times T²/|Δ|."""
SHORTEST = 1.0
"""No move is shorter than this: controllers need time to start and to report [s]."""
SETTLE, DWELL = 2.0, 3.0
"""Time until an arm has come to rest, and for one measurement then [s]."""
TURNING, SLIDING = 0.5, 0.1
"""Joint speeds where neither robot nor user names any [rad/s], [m/s]."""
BRISK = 2.0
"""Accelerations where nobody names any: so many times the speed, per second."""
BACK_OFF = 0.05
"""How far the robot backs off between two standstills at nearly the same place [rad | m]."""
LONGEST = 2**31 - 1
"""Seconds that a ROS duration can hold."""


@dataclass(frozen=True, eq=False)
class Pace:
    """How fast the tour is.

    Attributes:
        speeds: (joints,) speed that no joint exceeds [rad/s | m/s].
        dwell: Time of one measurement, at rest [s].
        origin: What the speeds are and where they come from, for people: joint speeds …
        settle: Time at rest before each measurement, until the arm no longer swings [s].
        accelerations: (joints,) acceleration that no joint exceeds [rad/s² | m/s²]; ``None``: ``BRISK`` · speeds.
    """

    speeds: ArrayLike
    dwell: float = DWELL
    origin: str = "as given"
    settle: float = SETTLE
    accelerations: ArrayLike | None = None

    def __post_init__(self) -> None:
        speeds = _limits("speeds", self.speeds, None, "rad/s | m/s")
        pushes = BRISK * speeds if self.accelerations is None else self.accelerations
        object.__setattr__(self, "speeds", speeds)
        object.__setattr__(self, "accelerations", _limits("accelerations", pushes, len(speeds), "rad/s² | m/s²"))
        for name in ("dwell", "settle"):
            value = check_number(name, getattr(self, name), low=0, high=86_400, unit="s")
            object.__setattr__(self, name, value)

    @property
    def standstill(self) -> float:
        """Time at rest for one measurement [s]."""
        return self.settle + self.dwell

    def times(self, ways: FloatArray) -> FloatArray:
        """(…) time of moves whose joints travel ``ways`` (…, joints), all >= 0 [rad | m] → [s]."""
        fast = PEAK * ways / np.asarray(self.speeds)
        brisk = np.sqrt(PUSH * ways / np.asarray(self.accelerations))
        return np.maximum(np.maximum(fast, brisk).max(axis=-1), SHORTEST)


def _limits(name: str, given: ArrayLike, count: int | None, unit: str) -> FloatArray:
    values = check_array(name, given, (count,), meaning=unit)
    if not (values > 0).all():
        raise InputError(name, values.tolist(), f"{name} > 0 [{unit}]")
    return values


@dataclass(frozen=True, eq=False)
class Timetable:
    """When the robot is where: m configurations in the order of the plan, with r_i visits to configuration i.

    Attributes:
        pace: What it was made with.
        repetitions: (m,) r.
        travel: (m, joints) joint coordinates of a configuration minus those of the one before [rad | m]; the
            first row is NaN if the start is not known.
        aside: (m, joints) where the robot backs off to before it visits the same configuration again [rad | m].
        arrivals: (Σ r,) seconds from the start at which each visit begins, at rest, in their order.
        ways_back: (Σ r,) seconds from the start at which the robot turns round aside; NaN where it came from
            elsewhere.
    """

    pace: Pace
    repetitions: IntArray
    travel: FloatArray
    aside: FloatArray
    arrivals: FloatArray
    ways_back: FloatArray

    def __post_init__(self) -> None:
        for name in ("repetitions", "travel", "aside", "arrivals", "ways_back"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def arrive(self) -> FloatArray:
        """(m,) seconds from the start at which the robot first stands there."""
        return np.asarray(self.arrivals[np.cumsum(self.repetitions) - self.repetitions])

    @property
    def leave(self) -> FloatArray:
        """(m,) seconds from the start at which the last measurement there is done."""
        return np.asarray(self.arrivals[np.cumsum(self.repetitions) - 1] + self.pace.standstill)

    @property
    def seconds(self) -> float:
        """Length of the whole [s]."""
        return float(self.arrivals[-1] + self.pace.standstill)

    @property
    def standing(self) -> float:
        """Share of it at standstill [s]."""
        return float(self.pace.standstill * self.repetitions.sum())

    def points(self, configurations: FloatArray) -> list[tuple[list[float], int]]:
        """Where the robot is at rest, and when: rows of ``configurations`` (m, joints) [rad | m], and time [ns].

        A visit has a point of arrival and, if the standstill has a length, one of departure; before it comes
        back to the same configuration, there is a point aside.
        """
        result: list[tuple[list[float], int]] = []
        stands = self.pace.standstill
        for place, arrival, turn in zip(self.places, self.arrivals, self.ways_back, strict=True):
            here = configurations[place].tolist()
            if np.isfinite(turn):
                result.append((self.aside[place].tolist(), _nanoseconds(turn)))
            result.append((here, _nanoseconds(arrival)))
            if stands > 0:
                result.append((here, _nanoseconds(arrival + stands)))
        return result

    @property
    def places(self) -> IntArray:
        """(Σ r,) number of the configuration of each visit."""
        return np.repeat(np.arange(len(self.repetitions)), self.repetitions)

    def rows(self) -> list[dict[str, Any]]:
        """Per configuration ``move`` before it, ``arrive``, ``settle``, ``measure``, ``back_off``, ``leave`` [s].

        ``settle``, ``measure`` and ``back_off`` are sums over its visits.
        """
        began = np.concatenate([[0.0], self.leave[:-1]])
        times = zip(self.repetitions.tolist(), began, self.arrive, self.leave, strict=True)
        return [
            {
                "move": float(arrive - start),
                "arrive": float(arrive),
                "settle": r * self.pace.settle,
                "measure": r * self.pace.dwell,
                "back_off": float(leave - arrive) - r * self.pace.standstill,
                "leave": float(leave),
            }
            for r, start, arrive, leave in times
        ]


def _nanoseconds(seconds: float) -> int:
    return round(float(seconds) * 1_000_000_000)


def usual_pace(robot: Robot, dwell: float = DWELL, settle: float = SETTLE) -> Pace:
    """For a robot of which no speed limits are known."""
    speeds = np.where(robot.joint_is_revolute, TURNING, SLIDING)
    sliding = "" if robot.joint_is_revolute.all() else f" and {SLIDING:g} m/s"
    text = f"at most {TURNING:g} rad/s{sliding} (assumed: the robot's speed limits are not known)"
    return Pace(speeds, dwell, text, settle)


def backed_off(q: FloatArray, limits: FloatArray, coupling: FloatArray | None = None) -> FloatArray:
    """``q`` (…, joints) moved by ``BACK_OFF`` towards the middle of the limits (joints, 2) [rad | m].

    Where the range is shorter than that, it is moved to its end. With a ``coupling`` (joints, joints), C of
    ``robot.coupling``, limits and the move are those of the joints' own motions: nothing leaves its limits.
    """
    own = q if coupling is None else q @ coupling.T
    low, high = limits.T
    up, down = np.minimum(own + BACK_OFF, high), np.maximum(own - BACK_OFF, low)
    inward = np.where(own <= limits.mean(axis=1), up, down)
    return np.asarray(inward if coupling is None else inward @ np.linalg.inv(coupling).T)


def near(way: FloatArray) -> NDArray[np.bool_]:
    """(…,) whether joints that travel ``way`` (…, joints) end at nearly the same place, so that they back off."""
    return np.asarray(np.abs(way).max(axis=-1) < BACK_OFF)


def timetable(plan: Plan, robot: Robot, pace: Pace, start: ArrayLike | None = None) -> Timetable:
    """Visit the plan's configurations in its order; see ``visit_times``.

    The plan's ``joint_names`` have to be in the robot's order.
    """
    return visit_times(robot, plan.configurations, plan.repetitions, pace, start)


def visit_times(
    robot: Robot,
    configurations: FloatArray,
    repetitions: ArrayLike,
    pace: Pace,
    start: ArrayLike | None = None,
) -> Timetable:
    """Visit configurations in their order.

    Args:
        robot: Its limits say how far the first visit may be, and where there is room to back off to.
        configurations: (m, joints), m >= 1 [rad | m].
        repetitions: Visits to each: one number, or (m,).
        pace: Speeds and standstill.
        start: (joints,) where the robot stands [rad | m]; ``None`` if that is not known.

    Raises:
        InputError: Arrays of another shape, or a tour longer than a ROS duration can say.
    """
    q, count = np.asarray(configurations), len(robot.joint_names)
    check_array("speeds", pace.speeds, (count,), meaning=", ".join(robot.joint_names))
    times = np.broadcast_to(np.asarray(repetitions, np.int64), (len(q),))
    here = np.full(count, np.nan) if start is None else check_array("start", start, (count,))
    place = np.repeat(np.arange(len(q)), times)
    before = np.vstack([here, q[place[:-1]]])
    aside = backed_off(q, robot.own_limits, robot.coupling)
    ways = np.abs(q[place] - before)
    if start is None:
        ways[0] = np.abs(robot.joint_limits.T - q[0]).max(axis=0)
    again = near(ways)
    there = np.where(again, pace.times(np.abs(aside[place] - np.where(np.isnan(before), q[0], before))), 0.0)
    moves = np.where(again, there + pace.times(np.abs(aside - q))[place], pace.times(ways))
    ends = np.cumsum(moves + pace.standstill)
    if ends[-1] > LONGEST:
        advice = "raise the speed or shorten the standstill"
        raise InputError("timetable", f"{ends[-1]:g} s", f"at most {LONGEST} s", advice)
    arrivals = ends - pace.standstill
    began = arrivals - moves
    return Timetable(
        pace=pace,
        repetitions=frozen(np.array(times)),
        travel=frozen(np.diff(np.vstack([here, q]), axis=0)),
        aside=frozen(aside),
        arrivals=frozen(arrivals),
        ways_back=frozen(np.where(again, began + there, np.nan)),
    )
