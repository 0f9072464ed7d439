# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The plan sheet: all that the person at the robot needs to measure a plan, and nothing that was not checked.

The visits are the plan's configurations in the plan's order. Everything else is checked (``check_visits``) or
follows (``timetable``).

A visit is *reachable* within the joint limits and if every constraint allows it that is not about the tracker.
It is *visible* if every constraint about the tracker allows it (those with a ``station``); without such a
constraint nothing is said about it. What the tracker would see — range, elevation, incidence — is computed
wherever one station is known, be it from a constraint or from the instrument, and is no verdict.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_planner.arrays import FloatArray, check_configurations, frozen
from calib_planner.errors import InputError
from calib_planner.planning.constraints import (
    LineOfSight,
    ReflectorAcceptance,
    TrackerElevation,
    TrackerRange,
)
from calib_planner.planning.constraints.self_collision import SelfCollision
from calib_planner.planning.feasibility import Constraint
from calib_planner.planning.result import Plan
from calib_planner.planning.tour import Pace, Timetable, timetable, usual_pace
from calib_planner.robot import Robot
from calib_planner.tracker import LaserTracker, Noise, azimuths, distances, elevations, incidence_cosines

HEAD = (
    "criterion", "status", "message", "sigma", "predicted_accuracy", "lower_bound", "bound", "efficiency",
    "value", "value_bound",
)  # fmt: skip
"""What the sheet repeats of the plan."""


@dataclass(frozen=True, eq=False)
class PlanSheet:
    """A plan, visit by visit, m visits.

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
    checks: VisitChecks
    timetable: Timetable

    @property
    def degrees(self) -> FloatArray:
        """(m, joints) what people type: degrees, for sliding joints mm."""
        return np.asarray(self.plan.configurations * person_factors(self.robot))

    def total_travel(self, largest: bool, turning: bool) -> FloatArray:
        """(m,) travel to every visit: the largest joint's or the sum; of turning or sliding joints [rad | m]."""
        ways = np.abs(self.timetable.travel[:, self.robot.joint_is_revolute == turning])
        return np.asarray(ways.max(axis=1, initial=0.0) if largest else ways.sum(axis=1))

    def tightest(self) -> list[tuple[int, float]]:
        """Per visit the joint nearest to a limit, as a share of its range, and its margin [rad | m]."""
        margins = self.checks.margins
        joints = (margins / np.diff(self.robot.joint_limits, axis=1)[:, 0]).argmin(axis=1)
        return [(int(j), float(row[j])) for j, row in zip(joints, margins, strict=True)]

    def to_dict(self) -> dict[str, Any]:
        """Head, joints, checks, time and visits as plain values, SI units; ``None`` stands for not checked."""
        plan, checks, times = self.plan, self.checks, self.timetable
        promised = plan.values()
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
            **{name: promised[name] for name in HEAD},
            "configurations": len(plan.configurations),
            "measurements": plan.measurements,
            "joints": [
                {"name": n, "unit": "rad" if r else "m", "lower": lo, "upper": hi, "speed": v}
                for n, r, (lo, hi), v in joints
            ],
            "checked": checks.checked,
            "not_checked": checks.unchecked,
            "station": checks.sight.station,
            "minutes": times.seconds / 60.0,
            "seconds": times.seconds,
            "seconds_standing": times.standing,
            "settle": times.pace.settle,
            "dwell": times.pace.dwell,
            "speeds_from": times.pace.origin,
            "reachable": bool(checks.reachable.all()),
            "visible": None if checks.visible is None else bool(checks.visible.all()),
            "stops": [self._visit(i) | row for i, row in enumerate(times.rows())],
        }

    def _visit(self, i: int) -> dict[str, Any]:
        """What ``to_dict`` tells of one visit; keys with a unit at their end are for people."""
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
            "points": checks.sight.points[i],
            "ranges": checks.sight.ranges[i],
            "azimuths": checks.sight.azimuths[i],
            "elevations": checks.sight.elevations[i],
            "incidences": checks.sight.incidences[i],
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
        checks=check_visits(robot, ordered.configurations, constraints, noise),
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


# ── checks ───────────────────────────────────────────────────────────────────────────────────────────

VIEWS = (TrackerRange, TrackerElevation, ReflectorAcceptance, LineOfSight)
"""The constraints about the tracker."""
LIMITS = "joint limits"
NEVER = ("other objects in the cell", "the moves between the visits")
"""What nothing here can check."""


@dataclass(frozen=True, eq=False)
class Sight:
    """Where the targets are and what the tracker sees; NaN where that needs more than is known.

    Attributes:
        points: (N, targets, 3) in the frame of positions [m].
        station: (3,) in the frame of positions [m], or ``None`` if none is known, or several.
        ranges: (N, targets) [m].
        azimuths: (N, targets) about the station's vertical, from the x axis of the frame of positions [rad].
        elevations: (N, targets) above the station's horizontal [rad].
        incidences: (N, targets) between the reflector's normal and the beam [rad].
    """

    points: FloatArray
    station: FloatArray | None
    ranges: FloatArray
    azimuths: FloatArray
    elevations: FloatArray
    incidences: FloatArray


@dataclass(frozen=True, eq=False)
class VisitChecks:
    """One verdict per configuration, N of them.

    Attributes:
        margins: (N, joints) distance to the nearer of the robot's joint limits, negative beyond [rad | m].
        reachable: (N,) bool.
        visible: (N,) bool, or ``None``: not checked.
        reach_breaks, view_breaks: Per configuration the names of what it breaks.
        checked: Names of what was checked.
        unchecked: Names of what was not.
        sight: What the tracker sees.
    """

    margins: FloatArray
    reachable: NDArray[np.bool_]
    visible: NDArray[np.bool_] | None
    reach_breaks: tuple[tuple[str, ...], ...]
    view_breaks: tuple[tuple[str, ...], ...]
    checked: tuple[str, ...]
    unchecked: tuple[str, ...]
    sight: Sight

    @property
    def breaks(self) -> list[tuple[str, ...]]:
        """All that each configuration breaks."""
        return [a + b for a, b in zip(self.reach_breaks, self.view_breaks, strict=True)]


def check_visits(
    robot: Robot, configurations: FloatArray, constraints: Sequence[Constraint] = (), noise: Noise | None = None
) -> VisitChecks:
    """Check configurations (N, joints) [rad | m] against all that is known.

    Raises:
        InputError: Wrong shape, or a constraint that does not fit the robot.
    """
    q = check_configurations("configurations", configurations, robot.joint_names)
    low, high = robot.joint_limits.T
    margins = np.minimum(q - low, high - q)
    reach: dict[str, NDArray[np.bool_]] = {LIMITS: np.asarray(~robot.beyond_limits(q).any(axis=1))}
    seen: dict[str, NDArray[np.bool_]] = {}
    for constraint in constraints:
        masks = seen if isinstance(constraint, VIEWS) else reach
        allowed = constraint.allowed(robot, q)
        masks[constraint.name] = masks.get(constraint.name, True) & allowed
    missing = [k.name for k in (*VIEWS, SelfCollision) if not any(isinstance(c, k) for c in constraints)]
    return VisitChecks(
        margins=frozen(margins),
        reachable=frozen(np.all(list(reach.values()), axis=0)),
        visible=frozen(np.all(list(seen.values()), axis=0)) if seen else None,
        reach_breaks=_breaks(reach, len(q)),
        view_breaks=_breaks(seen, len(q)),
        checked=(*reach, *seen),
        unchecked=(*missing, *NEVER),
        sight=_sight(robot, q, constraints, noise),
    )


def _breaks(masks: dict[str, NDArray[np.bool_]], count: int) -> tuple[tuple[str, ...], ...]:
    """Per configuration the names of the masks (N,) that are false."""
    return tuple(tuple(name for name, mask in masks.items() if not mask[i]) for i in range(count))


def _sight(robot: Robot, q: FloatArray, constraints: Sequence[Constraint], noise: Noise | None) -> Sight:
    """From the one station that constraints and instrument agree on."""
    views = [c for c in constraints if isinstance(c, VIEWS)]
    stations = [np.asarray(c.station) for c in views]
    if isinstance(noise, LaserTracker):
        stations.append(np.asarray(noise.station))
    posture = robot.posture(q)
    points, unknown = frozen(posture.targets), frozen(np.full((len(q), len(robot.targets)), np.nan))
    if not stations or any((s != stations[0]).any() for s in stations):
        return Sight(points, None, unknown, unknown, unknown, unknown)
    station = stations[0]
    ups = [np.asarray(c.up) for c in (*views, noise) if isinstance(c, (TrackerElevation, LaserTracker))]
    normals = next((np.asarray(c.normal) for c in views if isinstance(c, ReflectorAcceptance)), None)
    ways = heights = incidences = np.asarray(unknown)
    if ups and all(np.allclose(u, ups[0], rtol=0, atol=1e-9) for u in ups):
        ways, heights = (angles(station, ups[0], points) for angles in (azimuths, elevations))
    if normals is not None:
        turned = normals @ posture.tip_rotation.transpose(0, 2, 1)
        cosines = incidence_cosines(station, points, turned)
        incidences = np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)))
    ranges = distances(station, points)
    return Sight(points, frozen(station), frozen(ranges), frozen(ways), frozen(heights), frozen(incidences))
