"""The order of the visits, how far the joints travel from visit to visit, and how long the tour takes.

``visiting_order`` sorts the same configurations for little joint travel between them. For ``timetable`` all
joints of a move start and end together at rest. A smooth move runs fastest at PEAK times its mean speed: 15/8
for the minimum-jerk polynomial 10τ³ − 15τ⁴ + 6τ⁵, 3/2 for a cubic. A joint with travel Δ_j and speed limit v_j
stays below it when the move takes

    T = max(SHORTEST, max_j PEAK·|Δ_j| / v_j).

If it is not known where the robot stands before the first visit, the way there has no travel that could be
stated, and its time is that from the farthest end of every joint's range, which is enough for any start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, IntArray, check_array, check_number, frozen
from calib_planner.errors import InputError
from calib_planner.planning.result import Plan
from calib_planner.robot import Robot

LARGE = 200
"""Above this many configurations the tour is not improved after its construction."""


def visiting_order(configurations: FloatArray, robot: Robot) -> IntArray:
    """Row numbers in an order with little travel: nearest neighbour from mid-range, then 2-opt.

    Travel between two configurations is the slowest joint's, as a share of its range.
    """
    scale = np.diff(robot.joint_limits, axis=1)[:, 0]
    home = robot.joint_limits.mean(axis=1)
    points = np.vstack([home, configurations]) / scale
    distance = np.abs(points[:, None] - points[None]).max(axis=2)
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
SHORTEST = 1.0
"""No move is shorter than this: a limit on speed alone would ask for any acceleration on a short way [s]."""
DWELL = 5.0
"""Time for one measurement at standstill [s]."""
TURNING, SLIDING = 0.5, 0.1
"""Joint speeds where neither robot nor user names any [rad/s], [m/s]."""
LONGEST = 2**31 - 1
"""Seconds that a ROS duration can hold."""


@dataclass(frozen=True, eq=False)
class Pace:
    """How fast the tour is.

    Attributes:
        speeds: (joints,) speed that no joint exceeds [rad/s | m/s].
        dwell: Standstill for one measurement [s].
        origin: What the speeds are and where they come from, for people: joint speeds …
    """

    speeds: ArrayLike
    dwell: float = DWELL
    origin: str = "as given"

    def __post_init__(self) -> None:
        speeds = check_array("speeds", self.speeds, (None,), meaning="rad/s or m/s")
        if not (speeds > 0).all():
            raise InputError("speeds", speeds.tolist(), "speeds > 0 [rad/s | m/s]")
        object.__setattr__(self, "speeds", speeds)
        dwell = check_number("dwell", self.dwell, low=0, high=86_400, unit="s")
        object.__setattr__(self, "dwell", dwell)


@dataclass(frozen=True, eq=False)
class Timetable:
    """When the robot is where; visits in the order of the plan.

    Attributes:
        pace: What it was made with.
        travel: (m, joints) joint coordinates at a visit minus those at the visit before [rad | m]; the first row
            is NaN if the start is not known.
        arrive, leave: (m,) seconds from the start.
    """

    pace: Pace
    travel: FloatArray
    arrive: FloatArray
    leave: FloatArray

    @property
    def seconds(self) -> float:
        """Length of the whole [s]."""
        return float(self.leave[-1])

    def points(self, configurations: FloatArray) -> list[tuple[list[float], int]]:
        """Where the robot is at rest, and when: rows of ``configurations`` (m, joints) [rad | m], and time [ns].

        A visit has a point of arrival and, if the standstill has a length, one of departure.
        """
        visits = zip(configurations.tolist(), self.arrive, self.leave, strict=True)
        ends = 2 if self.pace.dwell > 0 else 1
        return [(q, round(float(t) * 1_000_000_000)) for q, *times in visits for t in times[:ends]]

    @property
    def standing(self) -> float:
        """Share of it at standstill [s]."""
        return float((self.leave - self.arrive).sum())


def usual_pace(robot: Robot, dwell: float = DWELL) -> Pace:
    """For a robot of which no speed limits are known."""
    speeds = np.where(robot.joint_is_revolute, TURNING, SLIDING)
    sliding = "" if robot.joint_is_revolute.all() else f" and {SLIDING:g} m/s"
    text = f"at most {TURNING:g} rad/s{sliding} (assumed: the robot's speed limits are not known)"
    return Pace(speeds, dwell, text)


def timetable(plan: Plan, robot: Robot, pace: Pace, start: ArrayLike | None = None) -> Timetable:
    """Visit the plan's configurations in its order.

    Args:
        plan: Its ``joint_names`` have to be in the robot's order.
        robot: Its limits say how far the first visit may be.
        pace: Speeds and standstill.
        start: (joints,) where the robot stands [rad | m]; ``None`` if that is not known.

    Raises:
        InputError: Arrays of another shape, or a tour longer than a ROS duration can say.
    """
    count = len(robot.joint_names)
    q = plan.configurations
    speeds = check_array("speeds", pace.speeds, (count,), meaning=", ".join(robot.joint_names))
    here = np.full(count, np.nan) if start is None else check_array("start", start, (count,))
    travel = np.diff(np.vstack([here, q]), axis=0)
    ways = np.abs(travel)
    if start is None:
        ways[0] = np.abs(robot.joint_limits.T - q[0]).max(axis=0)
    moves = np.maximum((PEAK * ways / speeds).max(axis=1), SHORTEST)
    stands = pace.dwell * plan.repetitions
    leave = np.cumsum(moves + stands)
    if leave[-1] > LONGEST:
        advice = "raise the speed or shorten the standstill"
        raise InputError("timetable", f"{leave[-1]:g} s", f"at most {LONGEST} s", advice)
    return Timetable(pace, frozen(travel), frozen(leave - stands), frozen(leave))
