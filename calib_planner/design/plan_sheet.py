"""The plan sheet: all that the person at the robot needs to measure a plan, and nothing that was not checked.

The stops are the plan's configurations in the plan's order, which is that of visiting. Everything else is looked
up (``stop_checks``) or follows (``timetable``).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calib_planner._arrays import FloatArray
from calib_planner.design.feasibility import Constraint
from calib_planner.design.plan import Plan
from calib_planner.design.stop_checks import StopChecks, check_stops
from calib_planner.design.timetable import Pace, Timetable, timetable, usual_pace
from calib_planner.errors import InputError
from calib_planner.instrument.noise import Noise
from calib_planner.robot.chain import Robot

HEAD = (
    "criterion",
    "status",
    "message",
    "sigma",
    "predicted_accuracy",
    "lower_bound",
    "bound",
    "efficiency",
    "value",
    "value_bound",
)
"""What the sheet repeats of the plan."""


@dataclass(frozen=True, eq=False)
class PlanSheet:
    """A plan, stop by stop, m stops.

    Attributes:
        plan: The plan, its columns in the robot's joint order.
        robot: The robot that is to be moved.
        identity: Hash of what is to be measured, see ``plan_identity``.
        checks: What was checked.
        timetable: Travel and times.
    """

    plan: Plan
    robot: Robot
    identity: str
    checks: StopChecks
    timetable: Timetable

    @property
    def degrees(self) -> FloatArray:
        """(m, joints) what people type: degrees, for sliding joints mm."""
        return np.asarray(self.plan.configurations * person_factors(self.robot))

    def total_travel(self, largest: bool, turning: bool) -> FloatArray:
        """(m,) travel to every stop: the largest joint's or the sum; of turning or sliding joints [rad | m]."""
        ways = np.abs(self.timetable.travel[:, self.robot.joint_is_revolute == turning])
        return np.asarray(ways.max(axis=1, initial=0.0) if largest else ways.sum(axis=1))

    def tightest(self) -> list[tuple[int, float]]:
        """Per stop the joint nearest to a limit, as a share of its range, and its margin [rad | m]."""
        margins = self.checks.margins
        joints = (margins / np.diff(self.robot.joint_limits, axis=1)[:, 0]).argmin(axis=1)
        return [(int(j), float(row[j])) for j, row in zip(joints, margins, strict=True)]

    def to_dict(self) -> dict[str, Any]:
        """Head, joints, checks, time and stops as plain values, SI units; ``None`` stands for not checked."""
        plan, checks, times = self.plan, self.checks, self.timetable
        joints = zip(
            plan.joint_names,
            self.robot.joint_is_revolute,
            self.robot.joint_limits,
            np.asarray(times.pace.speeds),
            strict=True,
        )
        return {
            "id": self.identity,
            "robot": self.robot.name,
            "planned_for": plan.robot,
            **{name: getattr(plan, name) for name in HEAD},
            "configurations": len(plan.configurations),
            "measurements": plan.measurements,
            "joints": [
                {"name": n, "unit": "rad" if r else "m", "lower": lo, "upper": hi, "speed": v}
                for n, r, (lo, hi), v in joints
            ],
            "checked": checks.checked,
            "not_checked": checks.unchecked,
            "station": checks.sight.station,
            "seconds": times.seconds,
            "seconds_standing": times.standing,
            "dwell": times.pace.dwell,
            "speeds_from": times.pace.origin,
            "reachable": bool(checks.reachable.all()),
            "visible": None if checks.visible is None else bool(checks.visible.all()),
            "stops": [self._stop(i) for i in range(len(plan.configurations))],
        }

    def _stop(self, i: int) -> dict[str, Any]:
        """What ``to_dict`` tells of one stop; keys with a unit at their end are for people."""
        names, checks, times = self.plan.joint_names, self.checks, self.timetable
        joint, margin = self.tightest()[i]
        return {
            "order": i + 1,
            "configuration_index": i,
            "joints": dict(zip(names, self.plan.configurations[i].tolist(), strict=True)),
            "joints_deg_mm": dict(zip(names, self.degrees[i].tolist(), strict=True)),
            "repetitions": int(self.plan.repetitions[i]),
            "travel": dict(zip(names, times.travel[i].tolist(), strict=True)),
            "margin": margin,
            "margin_joint": names[joint],
            "reachable": bool(checks.reachable[i]),
            "visible": None if checks.visible is None else bool(checks.visible[i]),
            "breaks": checks.breaks[i],
            "ranges": checks.sight.ranges[i],
            "elevations": checks.sight.elevations[i],
            "incidences": checks.sight.incidences[i],
            "arrive": float(times.arrive[i]),
            "leave": float(times.leave[i]),
        }


def plan_sheet(
    plan: Plan,
    robot: Robot,
    constraints: Sequence[Constraint] = (),
    noise: Noise | None = None,
    *,
    pace: Pace | None = None,
    start: ArrayLike | None = None,
) -> PlanSheet:
    """Make the sheet of a plan.

    Args:
        plan: What is to be measured.
        robot: The robot that is to be moved; it has the plan's joints, in any order.
        constraints: What is to be checked besides the joint limits.
        noise: The instrument; one with a station says how far and how high it looks.
        pace: Speeds and standstill; ``None`` for ``usual_pace``.
        start: (joints,) where the robot stands before, in the robot's joint order [rad | m].

    Raises:
        InputError: The plan has other joints, or no configurations.
    """
    ordered = in_joint_order(plan, robot)
    if not len(ordered.configurations):
        raise InputError("plan", "no configurations", "at least one")
    return PlanSheet(
        plan=ordered,
        robot=robot,
        identity=plan_identity(plan),
        checks=check_stops(robot, ordered.configurations, constraints, noise),
        timetable=timetable(ordered, robot, usual_pace(robot) if pace is None else pace, start),
    )


def in_joint_order(plan: Plan, robot: Robot) -> Plan:
    """The plan with its columns in the robot's joint order.

    Raises:
        InputError: Its joints are not the robot's.
    """
    if sorted(plan.joint_names) != sorted(robot.joint_names):
        wanted = f"those of {robot.name}: {', '.join(robot.joint_names)}"
        raise InputError(
            "joint_names of the plan", ", ".join(plan.joint_names), wanted, "name the robot planned for"
        )
    columns = [plan.joint_names.index(n) for n in robot.joint_names]
    return replace(
        plan,
        joint_names=robot.joint_names,
        configurations=plan.configurations[:, columns],
        test_poses=plan.test_poses[:, columns],
    )


def plan_identity(plan: Plan) -> str:
    """Twelve hexadecimal digits that change with every bit of what is to be measured.

    The beginning of the SHA-256 of the JSON list [joint_names, configurations, repetitions]: two plans with the
    same identity lead to the same measurements.
    """
    content = [plan.joint_names, plan.configurations.tolist(), plan.repetitions.tolist()]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]


def person_factors(robot: Robot) -> FloatArray:
    """(joints,) what turns rad into degrees and m into mm."""
    return np.where(robot.joint_is_revolute, 180.0 / np.pi, 1e3)
