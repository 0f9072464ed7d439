"""Constraints as YAML; config/constraints.yaml shows every key. Each section may be left out.

    joint_range: {joint_a1: [-1.5, 1.5]}        # [rad | m]; joint_range_deg for degrees
    workspace: {low: [0.5, -2, 0.3], high: [3, 2, 2.5], tip: false}
    minimum_height: {height: 0.2, up: [0, 0, 1], links: true}
    capsules: {radii: 0.15}                     # the robot's body; or a list, base column first
    tracker:
      station: [4, 1.5, 1.2]
      up: [0, 0, 1]
      range: [1, 20]
      elevation_deg: [-45, 60]                  # or elevation: [rad]
      acceptance: {normal: [1, 0, 0], half_angle_deg: 30}
      line_of_sight: {near: 0.15}               # or true
    self_collision: {urdf: robot.urdf}          # needs calib_planner[collision]; path from this file's folder

Points and directions are in the frame of ``Robot.positions``: the robot's base frame, or the tracker's once the
robot's base pose is set; normals are in the tip's frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray
from calib_planner.io.yaml import Section, read_mapping
from calib_planner.planning import (
    Constraint,
    JointRange,
    LineOfSight,
    MinimumHeight,
    ReflectorAcceptance,
    SelfCollision,
    TrackerElevation,
    TrackerRange,
    WorkspaceBox,
)
from calib_planner.robot import Capsules, Robot

KEYS = ("joint_range", "joint_range_deg", "workspace", "minimum_height", "capsules", "tracker", "self_collision")
TRACKER_KEYS = ("station", "up", "range", "elevation", "elevation_deg", "acceptance", "line_of_sight")


def read_constraints(path: str | Path, robot: Robot) -> tuple[Constraint, ...]:
    """Read the constraints on ``robot``; joints, radii and normals are checked against it.

    Raises:
        FileFormatError: Names the key at fault, what it holds and what is valid.
    """
    top = Section(Path(path), "", read_mapping(path, "a YAML file of constraints")).only(KEYS)
    found: list[Constraint] = []
    capsules = _capsules(top, robot)
    found += [_joint_range(top, robot, key) for key in ("joint_range", "joint_range_deg") if key in top.values]
    if "workspace" in top.values:
        found.append(_workspace(top.section("workspace")))
    if "minimum_height" in top.values:
        found.append(_height(top.section("minimum_height"), capsules))
    if "tracker" in top.values:
        found += _tracker(top.section("tracker"), capsules, robot)
    if "self_collision" in top.values:
        found.append(_self_collision(top.section("self_collision")))
    return tuple(found)


def _capsules(top: Section, robot: Robot) -> Capsules:
    if "capsules" not in top.values:
        return Capsules()
    section = top.section("capsules").only(("radii",), ("radii",))
    single = not isinstance(section.values["radii"], list)
    capsules = section.made(lambda: Capsules(section.number("radii") if single else section.numbers("radii")))
    section.made(lambda: capsules.of(robot))
    return capsules


def _joint_range(top: Section, robot: Robot, key: str) -> JointRange:
    section = top.section(key).only(robot.joint_names)
    ranges = {joint: section.numbers(joint, 2) for joint in section.values}
    if key == "joint_range_deg":
        for joint, turns in zip(robot.joint_names, robot.joint_is_revolute, strict=True):
            if joint in ranges and not turns:
                raise section.error(joint, "degrees for a sliding joint", "its range in m, in joint_range")
        ranges = {joint: np.radians(pair) for joint, pair in ranges.items()}
    made = section.made(lambda: JointRange(ranges))
    made.limits(robot)
    return made


def _workspace(section: Section) -> WorkspaceBox:
    s = section.only(("low", "high", "tip"), ("low", "high"))
    return s.made(lambda: WorkspaceBox(s.numbers("low", 3), s.numbers("high", 3), s.truth("tip", False)))


def _height(section: Section, capsules: Capsules) -> MinimumHeight:
    s = section.only(("height", "up", "links"), ("height",))
    body = capsules if s.truth("links", True) else None
    return s.made(lambda: MinimumHeight(s.number("height"), _up(s), body))


def _tracker(section: Section, capsules: Capsules, robot: Robot) -> Iterator[Constraint]:
    s = section.only(TRACKER_KEYS, ("station",))
    station, up = s.numbers("station", 3), _up(s)
    if "range" in s.values:
        near, far = s.numbers("range", 2)
        yield s.made(lambda: TrackerRange(station, near, far))
    if "elevation" in s.values or "elevation_deg" in s.values:
        low, high = s.angles("elevation", 2)
        yield s.made(lambda: TrackerElevation(station, up, low, high))
    if "acceptance" in s.values:
        yield _acceptance(s.section("acceptance"), station, robot)
    if s.values.get("line_of_sight", False) is not False:
        yield _line_of_sight(s, station, capsules)


def _acceptance(section: Section, station: FloatArray, robot: Robot) -> ReflectorAcceptance:
    s = section.only(("normal", "half_angle", "half_angle_deg"), ("normal",))
    normals, targets = s.directions("normal"), len(robot.targets)
    if len(normals) not in (1, targets):
        raise s.error("normal", f"{len(normals)} directions", f"one, or {targets}: one per target")
    return s.made(lambda: ReflectorAcceptance(station, normals, float(s.angles("half_angle", 1)[0])))


def _line_of_sight(tracker: Section, station: FloatArray, capsules: Capsules) -> LineOfSight:
    if tracker.values["line_of_sight"] is True:
        return LineOfSight(station, capsules)
    s = tracker.section("line_of_sight").only(("near",), ("near",))
    return s.made(lambda: LineOfSight(station, capsules, s.number("near")))


def _self_collision(section: Section) -> SelfCollision:
    s = section.only(("urdf", "packages"), ("urdf",))
    packages = s.path.parent / s.text("packages") if "packages" in s.values else None
    return SelfCollision(s.path.parent / s.text("urdf"), packages)


def _up(section: Section) -> ArrayLike:
    return section.numbers("up", 3) if "up" in section.values else (0.0, 0.0, 1.0)
