# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the 3-D view of a calibration shows, in the axes of the robot's own base so that the robot stands upright.

Points x in the tracker's frame become Rᵀ (x − t), with R, t the identified pose of the base; vectors Rᵀ v. The
tracker stands at the origin of its own frame, that is at −Rᵀ t. Where the points are in the base's frame already,
nothing says where it stood, unless the instrument does.

Every point is in the scene. Robots are thinned to ``MOST_ROBOTS`` configurations: the largest errors, what was
rejected, and an even choice of the others.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray, IntArray, plain
from calib_planner.identification import Estimate, IdentificationProblem
from calib_planner.report.render import Drawing, Shape, shape
from calib_planner.robot import BASE, Robot

MOST_ROBOTS = 300
"""Configurations whose robot can be shown."""
USED, SUSPECT, REJECTED = range(3)
"""States of a point."""

WIDTH, HEIGHT, RIM = 640.0, 420.0, 24.0
YAW, PITCH = np.radians(-50.0), np.radians(22.0)
MOST_POINTS = 800
"""Of the still picture: its size, from where it looks, and how many points it shows."""


@dataclass(frozen=True, eq=False)
class Scene:
    """All positions in the frame of the robot's base [m]; K points were measured, N configurations.

    Attributes:
        joint_names: Order of ``q``.
        revolute: (joints,) whether each turns.
        q: (N, joints) measured configurations [rad | m].
        rows, targets: (K,) row from 0 and target from 1 of each point.
        points: (K, 3) measured.
        after, before: (K, 3) measured − predicted with the identified and with the nominal kinematics.
        states: (K,) ``USED``, ``SUSPECT`` or ``REJECTED``.
        robot_rows: (D,) configurations whose robot is drawn.
        robots: (D, B, 3) base, a point on each joint's axis, tip, then the targets.
        test_robots: (T, B, 3) the same at the test poses.
        target_count: The last of the B points that are targets.
        tracker: (3,) where the tracker stood, or ``None``.
    """

    joint_names: tuple[str, ...]
    revolute: tuple[bool, ...]
    q: FloatArray
    rows: IntArray
    targets: IntArray
    points: FloatArray
    after: FloatArray
    before: FloatArray
    states: IntArray
    robot_rows: IntArray
    robots: FloatArray
    test_robots: FloatArray
    target_count: int
    tracker: FloatArray | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, rounded to what can be seen: positions to 10 µm, errors to 10 nm, angles to 10 µrad."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        digits = {"q": 5, "points": 5, "after": 8, "before": 8, "robots": 4, "test_robots": 4}
        digits |= {"tracker": 4} if self.tracker is not None else {}
        rounded: dict[str, Any] = plain(values | {name: values[name].round(n) for name, n in digits.items()})
        return rounded


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """K points that were measured, in the frame of the measurements.

    Attributes:
        rows: (K,) configuration of each, from 0.
        targets: (K,) target of each, from 1.
        points: (K, 3) measured [m].
        after, before: (K, 3) measured − predicted with the identified and with the nominal kinematics [m].
        states: (K,) ``USED``, ``SUSPECT`` or ``REJECTED``.
    """

    rows: IntArray
    targets: IntArray
    points: FloatArray
    after: FloatArray
    before: FloatArray
    states: IntArray


def scene_of(problem: IdentificationProblem, estimate: Estimate, before: FloatArray) -> Scene:
    """The scene; ``before`` (N, targets, 3) measured − predicted with the nominal kinematics [m]."""
    data, known = problem.data, estimate.knowledge
    robot = known.placed
    where = np.argwhere(data.seen)
    seen = tuple(where.T)
    points = MeasuredPoints(
        rows=where[:, 0],
        targets=where[:, 1] + 1,
        points=data.p[seen],
        after=estimate.residuals.vectors[seen],
        before=before[seen],
        states=point_states(estimate)[seen],
    )
    actual = known.actual(data.q, data.payload)
    tests = known.actual(estimate.accuracy.test_poses.reshape(-1, len(robot.joint_names)))
    return visits_scene(robot, data.q, points, actual, tests, _tracker(problem, *robot.base_pose))


def visits_scene(
    robot: Robot,
    q: FloatArray,
    measured: MeasuredPoints,
    actual: FloatArray,
    tests: FloatArray,
    tracker: FloatArray | None,
) -> Scene:
    """The scene of configurations, of which some or none were measured.

    Args:
        robot: The robot, placed in the frame of the measurements.
        q: (N, joints) configurations as the robot reads them [rad | m].
        measured: The points.
        actual: (N, joints) where its joints really are [rad | m]; ``q`` where that is not known.
        tests: (T, joints) test poses, likewise.
        tracker: (3,) where the tracker stood in the frame of the base [m], or ``None``.
    """
    turn, place = robot.base_pose
    size = np.linalg.norm(measured.after, axis=1)
    worst = np.full(len(q), -1.0)
    np.maximum.at(worst, measured.rows, np.where(measured.states == USED, size, np.inf))
    rows = thinned(worst, MOST_ROBOTS)
    return Scene(
        joint_names=robot.joint_names,
        revolute=tuple(bool(r) for r in robot.joint_is_revolute),
        q=q,
        rows=measured.rows,
        targets=measured.targets,
        points=(measured.points - place) @ turn,
        after=measured.after @ turn,
        before=measured.before @ turn,
        states=measured.states,
        robot_rows=rows,
        robots=bodies(robot, actual[rows]),
        test_robots=bodies(robot, tests),
        target_count=len(robot.targets),
        tracker=tracker,
    )


def point_states(estimate: Estimate) -> IntArray:
    """(N, targets) state of each point; ``USED`` where there is none."""
    states = np.full(estimate.residuals.normalised.shape, USED)
    for state, points in ((SUSPECT, estimate.points.suspects), (REJECTED, estimate.points.rejected)):
        for point in points:
            states[point.row, point.target - 1] = state
    return states


def thinned(importance: FloatArray, most: int) -> IntArray:
    """Numbers of at most ``most`` items, ascending: a third the most important, the others spread evenly."""
    count = len(importance)
    if count <= most:
        return np.arange(count)
    first = np.argsort(-importance, kind="stable")[: most // 3]
    rest = np.setdiff1d(np.arange(count), first)
    even = rest[np.linspace(0, len(rest) - 1, most - len(first)).astype(int)]
    return np.unique(np.concatenate([first, even]))


def bodies(robot: Robot, q: FloatArray) -> FloatArray:
    """(N, B, 3) base, a point on each joint's axis, tip, then the targets, in the frame of the base [m].

    Args:
        q: (N, joints) configurations [rad | m].
    """
    turn, place = robot.base_pose
    if not len(q):
        return np.empty((0, len(robot.joint_names) + 2 + len(robot.targets), 3))
    posture = robot.posture(q)
    base = np.broadcast_to(place, (len(q), 1, 3))
    parts = [base, posture.joint_origins, posture.tip_origin[:, None], posture.targets]
    return np.asarray((np.concatenate(parts, axis=1) - place) @ turn)


def _tracker(problem: IdentificationProblem, turn: FloatArray, place: FloatArray) -> FloatArray | None:
    """From the instrument if it knows its station, else the origin of a frame that is not the base's own."""
    station = getattr(problem.instrument, "station", None)
    if station is not None:
        return np.asarray((np.asarray(station) - place) @ turn)
    return origin_of_points(problem.robot, turn, place)


def origin_of_points(robot: Robot, turn: FloatArray, place: FloatArray) -> FloatArray | None:
    """(3,) origin of the frame of the points, in that of the base [m]: there the tracker stands.

    ``None`` where the points are in the base's own frame: that is where the pose ``turn`` (3, 3), ``place`` (3,)
    [m] of the base is none, and is not identified either.
    """
    own = np.allclose(turn, np.eye(3), atol=1e-9) and np.allclose(place, 0.0, atol=1e-9)
    if own and not any(p.role == BASE for p in robot.parameters):
        return None
    return np.asarray(-place @ turn)


# ── The scene from one side: for readers without JavaScript, such as mail programs on phones ─────────────────


def still_picture(scene: Scene) -> Drawing:
    """The floor, points, the first robot, the test poses and the tracker, in parallel projection."""
    chosen = thinned(np.linalg.norm(scene.after, axis=1), MOST_POINTS)
    robots = np.concatenate([scene.robots[:1], scene.test_robots])
    tracker = np.empty((0, 3)) if scene.tracker is None else scene.tracker[None]
    inside = scene.points[scene.states != REJECTED]
    fit = _Fit(np.concatenate([robots.reshape(-1, 3), inside, tracker]))
    shapes = [shape("polyline", class_="floor", points=fit.text(_circle(scene)))]
    for i, body in enumerate(robots):
        arm = body[: len(body) - scene.target_count]
        shapes.append(shape("polyline", class_="test" if i else "arm", points=fit.text(arm)))
        if not i:
            shapes += [shape("circle", class_="joint", cx=x, cy=y, r="3.5") for x, y in fit.pairs(arm[1:])]
    states = scene.states[chosen]
    for name, those in (("point", states != REJECTED), ("gross", states == REJECTED)):
        marks = "".join(f"M{x} {y}h0" for x, y in fit.pairs(scene.points[chosen][those]))
        shapes.append(shape("path", class_=f"dots {name}", d=marks))
    for x, y in fit(tracker).tolist():
        corner = {"x": f"{x - 6:.1f}", "y": f"{y - 6:.1f}"}
        shapes.append(Shape("rect", {"class": "tracker", **corner, "width": "12", "height": "12"}))
        shapes.append(shape("text", "tracker", x=f"{x:.1f}", y=f"{y - 10:.1f}", text_anchor="middle"))
    title = "robot, measured points and test poses from one side"
    return Drawing("still", f"{WIDTH:g} {HEIGHT:g}", title, shapes)


class _Fit:
    """Parallel projection, scaled so that the given points fill the picture."""

    def __init__(self, points: FloatArray) -> None:
        flat = _turned(points)
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array([WIDTH, HEIGHT]) - 2 * RIM
        self._scale = float((room / np.maximum(high - low, 1e-9)).min())
        self._middle = (low + high) / 2

    def __call__(self, points: FloatArray) -> FloatArray:
        """(N, 3) in the base's frame [m] → (N, 2) in the picture [drawing units]."""
        flat = (_turned(points) - self._middle) * self._scale * [1, -1] + [WIDTH / 2, HEIGHT / 2]
        return np.clip(flat, 0, [WIDTH, HEIGHT])

    def pairs(self, points: FloatArray) -> list[tuple[str, str]]:
        return [(f"{x:.1f}", f"{y:.1f}") for x, y in self(points).tolist()]

    def text(self, points: FloatArray) -> str:
        return " ".join(f"{x} {y}" for x, y in self.pairs(points))


def _turned(points: FloatArray) -> FloatArray:
    """(…, 3) → (…, 2) right and up, seen from azimuth ``YAW`` and elevation ``PITCH``."""
    right = np.array([-np.sin(YAW), np.cos(YAW), 0.0])
    up = np.array([-np.cos(YAW) * np.sin(PITCH), -np.sin(YAW) * np.sin(PITCH), np.cos(PITCH)])
    return points @ np.stack([right, up], axis=1)


def _circle(scene: Scene) -> FloatArray:
    """(61, 3) on the floor through the base, half as far out as the robot's farthest target."""
    radius = 0.5 * float(np.linalg.norm(scene.robots[..., :2], axis=2).max(initial=0.5))
    angle = np.linspace(0, 2 * np.pi, 61)
    return radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
