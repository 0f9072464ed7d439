# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""RViz markers of a plan: the robot at every configuration, the targets, their order and the path. And of an
estimate: the measured points, and how far each is from where it should be.

The robot is drawn as a skeleton: base, origins of the joints, tip, and a line to each target. One marker holds
all skeletons, so that a plan of any size is a handful of markers and one text per configuration. At most
MOST_SHOWN configurations are drawn, evenly spread over a larger plan. Positions are in the frame of
``Robot.positions``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.planning import Plan
from calib_planner.robot import Robot, segments
from calib_planner.ros.messages import stamp_message
from calib_planner.ros.residuals import PointResiduals

MOST_SHOWN = 50
"""Configurations, and test poses, that are drawn at most."""
BONE, JOINT, TARGET, TEXT, PATH = 0.012, 0.03, 0.05, 0.08, 0.006
"""Sizes, as a share of the largest extent of what is drawn [1]."""
FIRST, LAST = np.array([0.17, 0.45, 0.70, 0.9]), np.array([0.99, 0.68, 0.38, 0.9])
"""Colours from the first to the last configuration, red, green, blue, opacity."""
TESTS = np.array([0.84, 0.15, 0.16, 1.0])
USED, REJECTED = np.array([0.17, 0.63, 0.90, 1.0]), np.array([0.84, 0.15, 0.16, 1.0])
"""Colours of measured points that the estimate uses, and of those that it does not."""
MOST_POINTS = 2000
"""Measured points that are drawn at most of those used, and of those not used."""
LONGEST_USED, LONGEST, POINT = 0.1, 0.3, 0.012
"""Length of the longest residual of the points used, of any residual, and size of a point, as a share of the
extent [1]."""


def plan_markers(plan: Plan, robot: Robot, stamp: int, frame_id: str) -> MarkerArray:
    """The markers; the first one deletes those of the plan before.

    Args:
        plan: The plan, with configurations [rad | m].
        robot: The robot that it is for.
        stamp: Stamp of the headers [ns].
        frame_id: The frame of ``robot.positions``.
    """
    shown = _shown(len(plan.configurations))
    bones, nodes, targets = skeletons(robot, plan.configurations[shown])
    size = float(np.ptp(nodes.reshape(-1, 3), axis=0).max()) or 1.0
    colours = _shades(len(shown))
    centres = targets.mean(axis=1)
    markers = [
        Marker(action=Marker.DELETEALL),
        _lines("robot", bones, colours, BONE * size),
        _spheres("joints", nodes, colours, JOINT * size),
        _spheres("targets", targets, colours, TARGET * size),
    ]
    if len(shown) > 1:
        markers.append(_marker("path", Marker.LINE_STRIP, centres[:, None], colours, Vector3(x=PATH * size)))
    markers += [
        _text(str(i + 1), k, at, TEXT * size)
        for k, (i, at) in enumerate(zip(shown.tolist(), centres.tolist(), strict=True))
    ]
    if len(plan.test_poses):
        poses = plan.test_poses[_shown(len(plan.test_poses))]
        bones, _, targets = skeletons(robot, poses)
        red = np.tile(TESTS, (len(poses), 1))
        markers += [
            _lines("test_poses", bones, red, BONE * size),
            _spheres("test_targets", targets, red, TARGET * size),
        ]
    for marker in markers:
        marker.header.stamp, marker.header.frame_id = stamp_message(stamp), frame_id
    return MarkerArray(markers=markers)


def skeletons(robot: Robot, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The robot's skeleton at N configurations ``q`` (N, joints) [rad | m].

    Returns:
        Lines (N, 2·B, 3), ends of line b at 2b and 2b + 1; base, joints and tip (N, joints + 2, 3);
        targets (N, T, 3) [m].
    """
    posture = robot.posture(q)
    start, end = segments(robot, posture)
    tip = np.broadcast_to(posture.tip_origin[:, None], posture.targets.shape)
    lines = np.stack([np.concatenate([start, tip], 1), np.concatenate([end, posture.targets], 1)], axis=2)
    nodes = np.concatenate([start, end[:, -1:]], axis=1)
    return lines.reshape(len(q), -1, 3), nodes, posture.targets


def residual_markers(residuals: PointResiduals, stamp: int, frame_id: str) -> MarkerArray:
    """The measured points, each with a line along its magnified residual; the first marker deletes those before.

    A text says by how much residuals are magnified: 1, 2 or 5 times a power of ten. Lines of points that are not
    used may be far longer, and are cut.

    Args:
        residuals: The points with their residuals.
        stamp: Stamp of the headers [ns].
        frame_id: The tracker's frame.
    """
    markers = [Marker(action=Marker.DELETEALL)]
    points, vectors, used = residuals.points, residuals.vectors, residuals.used
    if len(points):
        extent = points[used] if used.any() else points
        size = float(np.ptp(extent, axis=0).max()) or 1.0
        lengths = np.linalg.norm(vectors, axis=1)
        factor = magnification(float(lengths[used].max(initial=0.0)), LONGEST_USED * size)
        cut = np.minimum(1.0, LONGEST * size / np.maximum(factor * lengths, np.finfo(float).tiny))
        ends = points + factor * cut[:, None] * vectors
        for name, colour, chosen in (("rejected", REJECTED, ~used), ("used", USED, used)):
            rows = np.flatnonzero(chosen)
            if len(rows):
                shown = rows[_shown(len(rows), MOST_POINTS)]
                colours, lines = np.tile(colour, (len(shown), 1)), np.stack([points[shown], ends[shown]], axis=1)
                markers.append(_spheres(f"{name}_points", points[shown, None], colours, POINT * size))
                markers.append(_lines(f"{name}_residuals", lines, colours, 0.4 * POINT * size))
        top = extent.mean(axis=0) + size * np.array([0.0, 0.0, 0.6])
        markers.append(_text(f"residuals x {factor:g}", 0, top.tolist(), TEXT * size))
        markers[-1].ns = "magnification"
    for marker in markers:
        marker.header.stamp, marker.header.frame_id = stamp_message(stamp), frame_id
    return MarkerArray(markers=markers)


def magnification(length: float, wanted: float) -> float:
    """1, 2 or 5 times a power of ten, the largest by which ``length`` stays within ``wanted``; 1 for length 0."""
    if not length > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(wanted / length))
    return float(max(f * power for f in (1.0, 2.0, 5.0) if f * power * length <= wanted * (1 + 1e-9)))


def _shown(count: int, most: int = MOST_SHOWN) -> IntArray:
    """Rows that are drawn: all, or ``most`` spread evenly with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _shades(count: int) -> FloatArray:
    """(count, 4) from FIRST to LAST."""
    share = np.linspace(0, 1, count)[:, None]
    return (1 - share) * FIRST + share * LAST


def _lines(name: str, points: FloatArray, colours: FloatArray, width: float) -> Marker:
    return _marker(name, Marker.LINE_LIST, points, colours, Vector3(x=width))


def _spheres(name: str, points: FloatArray, colours: FloatArray, size: float) -> Marker:
    return _marker(name, Marker.SPHERE_LIST, points, colours, Vector3(x=size, y=size, z=size))


def _marker(name: str, kind: int, points: FloatArray, colours: FloatArray, scale: Vector3) -> Marker:
    """A marker of points (N, K, 3), N groups that have a colour (N, 4) each."""
    marker = Marker(ns=name, type=kind, scale=scale, color=_colour(colours[0]))
    marker.pose.orientation.w = 1.0
    marker.points = [_point(row) for row in points.reshape(-1, 3).tolist()]
    # Making messages takes most of the time here: the points of a group share one colour.
    marker.colors = [one for row in colours.tolist() for one in [_colour(row)] * points.shape[1]]
    return marker


def _text(text: str, number: int, at: Sequence[float], size: float) -> Marker:
    marker = Marker(ns="order", id=number, type=Marker.TEXT_VIEW_FACING, text=text)
    marker.scale.z = size
    marker.color = _colour([1.0, 1.0, 1.0, 1.0])
    marker.pose.orientation.w = 1.0
    marker.pose.position = _point([at[0], at[1], at[2] + size])
    return marker


def _point(row: Sequence[float]) -> Point:
    return Point(x=row[0], y=row[1], z=row[2])


def _colour(row: Sequence[float]) -> ColorRGBA:
    r, g, b, a = map(float, row)
    return ColorRGBA(r=r, g=g, b=b, a=a)
