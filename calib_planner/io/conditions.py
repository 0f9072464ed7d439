# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What may be measured and with which instrument, as YAML that users write; every section may be left out.

Constraints; config/constraints.yaml shows every key:

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

The noise of an instrument, see ``tracker.Noise`` and config/instruments/:

    type: isotropic                     type: laser_tracker
    sigma: 3.0e-5                       range_sigma: 5.0e-6         # [m]
                                        range_per_metre: 1.5e-7     # [m/m]
                                        azimuth: 5.5e-6             # [rad]
                                        elevation: 5.5e-6           # [rad]
                                        station: [4.0, 1.5, 1.2]    # frame of positions [m]
                                        up: [0, 0, 1]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, gravity_of
from calib_planner.io.error_model import read_error_model
from calib_planner.io.yaml import Node, read_yaml
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
    usual_error_model,
    with_wide_placement,
)
from calib_planner.robot import Capsules, Robot
from calib_planner.tracker import Isotropic, LaserTracker, Noise

KEYS = ("joint_range", "joint_range_deg", "workspace", "minimum_height", "capsules", "tracker", "self_collision")
TRACKER_KEYS = ("station", "up", "range", "elevation", "elevation_deg", "acceptance", "line_of_sight")
TRACKER_NUMBERS = ("range_sigma", "range_per_metre", "azimuth", "elevation")
INSTRUMENT_KEYS = {"isotropic": ("sigma",), "laser_tracker": (*TRACKER_NUMBERS, "station", "up")}


def read_constraints(path: str | Path, robot: Robot) -> tuple[Constraint, ...]:
    """Read the constraints on ``robot``; joints, radii and normals are checked against it.

    Raises:
        FileFormatError: Names the key at fault, what it holds and what is valid.
    """
    top = read_yaml(path, "a YAML file of constraints").mapping(KEYS)
    capsules = _capsules(top, robot)
    constraints: list[Constraint] = []
    constraints += [_joint_range(top[k], robot, k) for k in ("joint_range", "joint_range_deg") if k in top]
    if "workspace" in top:
        constraints.append(_workspace(top["workspace"]))
    if "minimum_height" in top:
        constraints.append(_height(top["minimum_height"], capsules))
    if "tracker" in top:
        constraints += _tracker(top["tracker"], capsules, robot)
    if "self_collision" in top:
        constraints.append(_self_collision(top["self_collision"]))
    return tuple(constraints)


def read_instrument(path: str | Path) -> Noise:
    """Read a noise model; keys left out have the values of its class.

    Raises:
        FileFormatError: Names the key at fault, what it holds and what is valid.
    """
    top = read_yaml(path, "a YAML file of an instrument")
    top.get("type").text()
    kind = top["type"].choice(INSTRUMENT_KEYS)
    required = ("sigma",) if kind == "isotropic" else ("station",)
    top.mapping(("type", *INSTRUMENT_KEYS[kind]), required)
    if kind == "isotropic":
        return top.build(lambda: Isotropic(top["sigma"].number()))
    nominal, station = LaserTracker(), top["station"].numbers(3)
    along, growth, azimuth, elevation = (top.get(k, getattr(nominal, k)).number() for k in TRACKER_NUMBERS)
    up = top["up"].numbers(3) if "up" in top else nominal.up
    return top.build(lambda: LaserTracker(along, growth, azimuth, elevation, station, up))


def read_vertical(path: str | Path) -> tuple[float, float, float] | None:
    """The direction upwards in the frame of the points that an instrument's file states; ``None`` if it does not.

    Raises:
        FileFormatError: Not readable, or no direction.
    """
    top = read_yaml(path, "a YAML file of an instrument")
    if "up" not in top:
        return None
    x, y, z = (float(v) for v in top["up"].numbers(3))
    return x, y, z


def _capsules(top: Node, robot: Robot) -> Capsules:
    if "capsules" not in top:
        return Capsules()
    section = top["capsules"].mapping(("radii",), ("radii",))
    radii = section["radii"]
    capsules = section.build(
        lambda: Capsules(radii.numbers() if isinstance(radii.value, list) else radii.number())
    )
    section.build(lambda: capsules.of(robot))
    return capsules


def _joint_range(section: Node, robot: Robot, key: str) -> JointRange:
    section.mapping(robot.joint_names)
    ranges = {joint: pair.numbers(2) for joint, pair in section.entries()}
    if key == "joint_range_deg":
        for joint, turns in zip(robot.joint_names, robot.joint_is_revolute, strict=True):
            if joint in ranges and not turns:
                raise section[joint].error("degrees for a sliding joint", "its range in m, in joint_range")
        ranges = {joint: np.radians(pair) for joint, pair in ranges.items()}
    constraint = section.build(lambda: JointRange(ranges))
    constraint.limits(robot)
    return constraint


def _workspace(section: Node) -> WorkspaceBox:
    s = section.mapping(("low", "high", "tip"), ("low", "high"))
    return s.build(lambda: WorkspaceBox(s["low"].numbers(3), s["high"].numbers(3), s.get("tip", False).truth()))


def _height(section: Node, capsules: Capsules) -> MinimumHeight:
    s = section.mapping(("height", "up", "links"), ("height",))
    body = capsules if s.get("links", True).truth() else None
    return s.build(lambda: MinimumHeight(s["height"].number(), _up(s), body))


def _tracker(section: Node, capsules: Capsules, robot: Robot) -> Iterator[Constraint]:
    s = section.mapping(TRACKER_KEYS, ("station",))
    station, up = s["station"].numbers(3), _up(s)
    if "range" in s:
        near, far = s["range"].numbers(2)
        yield s.build(lambda: TrackerRange(station, near, far))
    if "elevation" in s or "elevation_deg" in s:
        low, high = s.angles("elevation", 2)
        yield s.build(lambda: TrackerElevation(station, up, low, high))
    if "acceptance" in s:
        yield _acceptance(s["acceptance"], station, robot)
    if s.get("line_of_sight", False).value is not False:
        yield _line_of_sight(s["line_of_sight"], station, capsules)


def _acceptance(section: Node, station: FloatArray, robot: Robot) -> ReflectorAcceptance:
    s = section.mapping(("normal", "half_angle", "half_angle_deg"), ("normal",))
    normals, targets = s["normal"].directions(), len(robot.targets)
    if len(normals) not in (1, targets):
        raise s["normal"].error(f"{len(normals)} directions", f"one, or {targets}: one per target")
    return s.build(lambda: ReflectorAcceptance(station, normals, float(s.angles("half_angle", 1)[0])))


def _line_of_sight(section: Node, station: FloatArray, capsules: Capsules) -> LineOfSight:
    if section.value is True:
        return LineOfSight(station, capsules)
    s = section.mapping(("near",), ("near",))
    return s.build(lambda: LineOfSight(station, capsules, s["near"].number()))


def _self_collision(section: Node) -> SelfCollision:
    s, folder = section.mapping(("urdf", "packages"), ("urdf",)), Path(section.path).parent
    packages = folder / s["packages"].text() if "packages" in s else None
    return SelfCollision(folder / s["urdf"].text(), packages)


def _up(section: Node) -> ArrayLike:
    return section["up"].numbers(3) if "up" in section else (0.0, 0.0, 1.0)


# ── how a plan expects the robot to err ──────────────────────────────────────────────────────────────────


def planned_error_model(source: str | None, robot: Robot, noise: Noise | float) -> ErrorModel:
    """The error model of a plan, by name or from a file.

    Args:
        source: As for ``read_error_model``; ``None`` or empty for the robot's usual one.
        robot: The robot that is planned for; ``typical`` takes the masses that it knows.
        noise: The instrument, or the standard deviation of one coordinate [m].

    Raises:
        FileFormatError: As for ``read_error_model``.
    """
    if not source:
        return usual_error_model(robot, noise)
    instrument = Isotropic(noise) if isinstance(noise, (float, int)) else noise
    model = read_error_model(source, instrument)
    return with_wide_placement(replace(model, gravity=gravity_of(robot))) if source == "typical" else model
