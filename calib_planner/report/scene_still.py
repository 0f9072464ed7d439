"""The scene from one side, as SVG: for readers without JavaScript, such as mail programs on phones."""

from __future__ import annotations

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.report.scene import REJECTED, Scene, thinned

WIDTH, HEIGHT, RIM = 640.0, 420.0, 24.0
YAW, PITCH = np.radians(-50.0), np.radians(22.0)
MOST = 800
"""Points drawn."""


def still_picture(scene: Scene) -> str:
    """An ``<svg>``: the floor, every point, the first robot, the test poses and the tracker."""
    keep = thinned(np.linalg.norm(scene.after, axis=1), MOST)
    bodies = np.concatenate([scene.robots[:1], scene.test_robots])
    tracker = np.empty((0, 3)) if scene.tracker is None else scene.tracker[None]
    inside = scene.points[scene.states != REJECTED]
    fit = _Fit(np.concatenate([bodies.reshape(-1, 3), inside, tracker]))
    parts = [f'<polyline class="floor" points="{fit.text(_circle(scene))}"/>']
    for i, body in enumerate(bodies):
        arm = body[: len(body) - scene.target_count]
        parts += [f'<polyline class="{"arm" if i == 0 else "test"}" points="{fit.text(arm)}"/>']
        parts += [f'<circle class="joint" cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>' for x, y in fit(arm[1:])] * (
            i == 0
        )
    for name, chosen in (("point", scene.states[keep] != REJECTED), ("gross", scene.states[keep] == REJECTED)):
        marks = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in fit(scene.points[keep][chosen]))
        parts.append(f'<path class="dots {name}" d="{marks}"/>')
    for x, y in fit(tracker):
        parts.append(f'<rect class="tracker" x="{x - 6:.1f}" y="{y - 6:.1f}" width="12" height="12"/>')
        parts.append(f'<text x="{x:.1f}" y="{y - 10:.1f}" text-anchor="middle">tracker</text>')
    return (
        f'<svg class="still" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" '
        f'aria-label="robot, measured points and test poses from one side">{"".join(parts)}</svg>'
    )


class _Fit:
    """Orthographic view, scaled so that the given points fill the picture."""

    def __init__(self, points: FloatArray) -> None:
        flat = _turned(points)
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array([WIDTH, HEIGHT]) - 2 * RIM
        self._scale = float((room / np.maximum(high - low, 1e-9)).min())
        self._middle = (low + high) / 2

    def __call__(self, points: FloatArray) -> list[tuple[float, float]]:
        flat = (_turned(points) - self._middle) * self._scale * [1, -1] + [WIDTH / 2, HEIGHT / 2]
        return [(float(x), float(y)) for x, y in np.clip(flat, 0, [WIDTH, HEIGHT])]

    def text(self, points: FloatArray) -> str:
        return " ".join(f"{x:.1f} {y:.1f}" for x, y in self(points))


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
