"""A small drawing of every posture, so that a person recognises it: from the side and from above.

The robot is the line through base, joint origins, tip and reflectors, in the axes of its own base, whatever the
frame of positions. From the side: the vertical plane through joint 1 and the reflector, so that an arm is seen
in full wherever it points; across is the distance from joint 1. From above: x to the right, y up the page. One
scale for both views of all postures. A robot that moves in its base's horizontal plane has no view from the side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.robot.chain import Robot

BOX, GAP, RIM, CAPTION, BEAM = 100.0, 14.0, 7.0, 10.0, 18.0
"""Height of a view, space between two, room for line widths, for text, length of beam drawn [drawing units]."""
NARROWEST = 140.0
"""No drawing is narrower, or its lines would look fat [drawing units]."""
UPWARDS = np.array([1.0, -1.0])
"""Drawings count downwards."""
FLAT = 1e-6
"""Heights that differ by less are one height [m]."""


@dataclass(frozen=True, eq=False)
class View:
    """One projection of N bodies of K points.

    Attributes:
        name: What it is.
        points: (N, K, 2) right and up [m]; the last ``targets`` of the K points are the reflectors.
        toward: (N, 2) direction to the tracker, or ``None``.
        ground: Whether its lower edge shows the floor through the base.
    """

    name: str
    points: FloatArray
    toward: FloatArray | None
    ground: bool


def posture_drawings(robot: Robot, configurations: FloatArray, station: FloatArray | None = None) -> list[str]:
    """An ``<svg>`` per configuration (N, joints) [rad | m]; ``station`` (3,) in the frame of positions [m]."""
    views = _views(robot, configurations, station)
    spans = [np.ptp(v.points, axis=(0, 1)) for v in views]
    tall, wide = max(s[1] for s in spans), sum(s[0] for s in spans)
    scale = min(BOX / max(tall, FLAT), 2.0 * BOX / max(wide, FLAT))
    targets = len(robot.targets)
    return [_svg(views, i, scale, targets) for i in range(len(configurations))]


def _views(robot: Robot, q: FloatArray, station: FloatArray | None) -> list[View]:
    turn, place = robot.base_pose
    posture = robot.posture(q)
    base = np.broadcast_to(place, (len(q), 1, 3))
    parts = [base, posture.joint_origins, posture.tip_origin[:, None], posture.targets]
    body = (np.concatenate(parts, axis=1) - place) @ turn
    toward = None if station is None else (station - place) @ turn
    level = body[..., :2]
    heading = _headings(level)
    above = View("top", level, None if toward is None else _unit(toward[:2] - level[:, -1]), False)
    if np.ptp(body[..., 2]) < FLAT:
        return [above]
    out = np.einsum("nki,ni->nk", level - level[:, 1:2], heading)
    return [View("side", np.stack([out, body[..., 2]], axis=2), None, True), above]


def _headings(level: FloatArray) -> FloatArray:
    """(N, K, 2) bodies from above → (N, 2) unit direction from joint 1 to the reflector, x if there is none."""
    way = level[:, -1] - level[:, 1]
    return np.where(np.linalg.norm(way, axis=1, keepdims=True) > FLAT, _unit(way), [1.0, 0.0])


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


def _svg(views: list[View], i: int, scale: float, targets: int) -> str:
    """The views of body i beside each other."""
    tall = max(np.ptp(v.points[..., 1]) for v in views) * scale
    used = sum(np.ptp(v.points[..., 0]) for v in views) * scale + GAP * (len(views) - 1)
    width, height = max(used + 2 * RIM, NARROWEST), tall + 2 * RIM + CAPTION
    parts, left = [], (width - used) / 2
    for view in views:
        low, wide = view.points.min(axis=(0, 1)), np.ptp(view.points[..., 0]) * scale
        xy = (view.points[i] - low) * scale * UPWARDS + [left, RIM + tall]
        parts.append(_drawn(view, i, xy, targets))
        parts.append(f'<text x="{left + wide / 2:.1f}" y="{height - 2:.1f}">{view.name}</text>')
        left += wide + GAP
    names = " and ".join(v.name for v in views)
    return (
        f'<svg class="posture" viewBox="0 0 {width:.1f} {height:.1f}" role="img" '
        f'aria-label="stop {i + 1}, {names} view">{"".join(parts)}</svg>'
    )


def _drawn(view: View, i: int, xy: FloatArray, targets: int) -> str:
    """One view; ``xy`` (K, 2) in drawing units."""
    arm, reflectors = xy[: len(xy) - targets], xy[len(xy) - targets :]
    x, y = arm[0]
    if view.ground:
        drawn = [f'<path class="ground" d="M{x - 14:.1f} {y:.1f}h28"/>']
    else:
        drawn = [f'<rect class="base" x="{x - 5:.1f}" y="{y - 5:.1f}" width="10" height="10"/>']
    drawn += [f'<path class="tool" d="M{_pair(arm[-1])}L{_pair(mark)}"/>' for mark in reflectors]
    drawn.append(f'<polyline class="arm" points="{" ".join(map(_pair, arm))}"/>')
    drawn += [f'<circle class="joint" cx="{x:.1f}" cy="{y:.1f}" r="2.4"/>' for x, y in arm[1:-1]]
    drawn += [f'<circle class="mark" cx="{x:.1f}" cy="{y:.1f}" r="3.6"/>' for x, y in reflectors]
    if view.toward is not None:
        end = reflectors[-1] + BEAM * view.toward[i] * UPWARDS
        drawn.append(f'<path class="beam" d="M{_pair(reflectors[-1])}L{_pair(end)}"/>')
    return "".join(drawn)


def _pair(point: FloatArray) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"
