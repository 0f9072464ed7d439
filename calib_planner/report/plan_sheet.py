# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The plan sheet as one HTML page that needs nothing else: for A4 paper, and for a phone beside the robot.

The page begins with the visits. Above them stands only what the person can act on; what the plan promises, what
was checked and what was not stands below them. A visit says where to set the joints and where to aim. Ticks and
notes are remembered by the browser and can be saved as CSV.

*The drawings* let a person recognise each posture. The robot is the line through base, joint origins, tip and
reflectors, in the axes of its own base, whatever the frame of positions. The side view shows the vertical plane
through joint 1 and the reflector, so that it shows the whole arm wherever it points; across is the distance from
joint 1. The top view has x to the right and y up the page. All drawings have one scale. A robot that moves in the
horizontal plane of its base has no side view.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.io import (
    SHEET_FILES,
    make_folder,
    write_sheet_csv,
    write_sheet_yaml,
    write_text,
    write_trajectory,
)
from calib_planner.planning import NEVER, POSE_CRITERIA, PlanSheet
from calib_planner.report.render import TEMPLATES, Drawing, Shape, embedded, render, shape
from calib_planner.report.scene import bodies
from calib_planner.robot import Robot
from calib_planner.units import clock, duration, joint_factor, joint_unit, length, listed, signed

BOXES = 12
"""More repetitions than this get one box with their number."""
COLUMNS = 7
"""Joints beside each other; more are spread evenly over several lines."""
BLANKS = ("date", "operator", "robot serial no.", "tracker, reflector", "temperature")
"""What the person fills in for the whole sheet."""
BOX, GAP, RIM, CAPTION, BEAM = 100.0, 14.0, 7.0, 10.0, 18.0
"""Height of a view, space between two, room for line widths, for text, length of beam drawn [drawing units]."""
NARROWEST = 140.0
"""No drawing is narrower, or its lines would look fat [drawing units]."""
UPWARDS = np.array([1.0, -1.0])
"""Drawings count downwards."""
FLAT = 1e-6
"""Heights that differ by less are one height [m]."""


def write_sheet_page(path: str | Path, sheet: PlanSheet, field: str = "output") -> None:
    """Write the page.

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    write_text(path, sheet_page(sheet), field)


def write_sheet(folder: str | Path, sheet: PlanSheet, field: str = "output") -> list[str]:
    """Write page, CSV, YAML and trajectory of a sheet into a folder, which is made; returns the files' names.

    No trajectory is written if a configuration is not reachable; an older one in the folder is removed.

    Raises:
        InputError: The folder cannot be made or written to; names ``field``.
    """
    target, reachable = make_folder(folder, field), bool(sheet.checks.reachable.all())
    if not reachable:
        (target / SHEET_FILES[-1]).unlink(missing_ok=True)
    writers = (write_sheet_page, write_sheet_csv, write_sheet_yaml, write_trajectory)
    names = SHEET_FILES if reachable else SHEET_FILES[:-1]
    for name, write in zip(names, writers, strict=False):
        write(target / name, sheet, field)
    return list(names)


def sheet_page(sheet: PlanSheet) -> str:
    """The page as HTML text."""
    turns, first, sight = sheet.robot.joint_is_revolute, sheet.timetable.travel[0], sheet.checks.sight
    units = (("degrees, below radians", turns.any()), ("mm, below m", not turns.all()))
    drawings = posture_drawings(sheet.robot, sheet.plan.configurations, sight.station)
    return render(
        TEMPLATES / "plan_sheet.html",
        plan=sheet.plan,
        robot=sheet.robot.name,
        identity=sheet.identity,
        facts=_facts(sheet),
        alarms=_alarms(sheet),
        never=" and ".join(NEVER).capitalize(),
        checks=sheet.checks,
        pace=sheet.timetable.pace,
        time=duration(sheet.timetable.seconds),
        start_known=bool(np.isfinite(first).all()),
        columns=ceil(len(turns) / ceil(len(turns) / COLUMNS)),
        units="; ".join(unit for unit, there in units if there),
        frame=_frame(sheet.robot),
        station=None if sight.station is None else _triple(sight.station),
        directed=bool(np.isfinite(sight.azimuths).any()),
        rows=[_row(sheet, i, drawing) for i, drawing in enumerate(drawings)],
        side=any(s.words == "side" for s in drawings[0].shapes),
        beam=any(s.attributes.get("class") == "beam" for s in drawings[0].shapes),
        most_boxes=BOXES,
        blanks=BLANKS,
        embedded=embedded,
        repeated=sheet.plan.measurements > len(sheet.plan.configurations),
    )


def _frame(robot: Robot) -> str:
    """The frame of positions: the robot's base, until the robot was placed in another one."""
    turn, place = robot.base_pose
    at_base = np.allclose(turn, np.eye(3), rtol=0, atol=FLAT) and np.allclose(place, 0.0, rtol=0, atol=FLAT)
    return "the robot's base frame" if at_base else "the frame of the points"


def _facts(sheet: PlanSheet) -> Iterator[tuple[str, str, str]]:
    """Name, value and remark of what the plan promises and costs."""
    plan, quality, times = sheet.plan, sheet.plan.quality, sheet.timetable
    metric = quality.criterion in POSE_CRITERIA
    if len(plan.test_poses):
        poses = f"at {len(plan.test_poses)} test poses, rms" if len(plan.test_poses) > 1 else "at the test pose"
        yield "expected accuracy ρ0", length(quality.predicted_accuracy), poses
    if not metric:
        yield f"criterion {quality.criterion}", f"{quality.value:.5g}", "its own unit"
    if quality.bound == "none":
        yield "lower bound", "none", "this criterion has none"
    else:
        best = length(quality.value_bound) if metric else f"{quality.value_bound:.5g}"
        remark = f"no plan of {plan.measurements} is better ({quality.bound})"
        yield "lower bound" if metric else "bound", best, remark
        meaning = "lower bound over expected" if metric else "by the criterion's own measure"
        yield "efficiency", f"{100 * quality.efficiency:.1f} %", meaning
    yield "measurements", str(plan.measurements), f"at {len(plan.configurations)} visits"
    yield "estimated time", duration(times.seconds), f"{duration(times.standing)} of it at standstill"
    yield "tracker", f"σ = {length(plan.sigma)}", "of one coordinate, assumed by the plan"


def _alarms(sheet: PlanSheet) -> Iterator[str]:
    plan, checks = sheet.plan, sheet.checks
    for word, mask in (("reachable", checks.reachable), ("visible", checks.visible)):
        wrong = [] if mask is None else (np.flatnonzero(~mask) + 1).tolist()
        if wrong:
            visits = f"visit{'s' if len(wrong) > 1 else ''} {listed(wrong)}"
            yield f"Not {word}: {visits}. Leave out what is marked below, or plan again."
    if plan.robot != sheet.robot.name:
        yield f"The plan was made for {plan.robot}, this sheet for {sheet.robot.name}."
    if plan.quality.status == "singular":
        yield f"{plan.quality.status}: {plan.quality.message}"


# ── the rows ─────────────────────────────────────────────────────────────────────────────────────────


def _row(sheet: PlanSheet, i: int, drawing: Drawing) -> dict[str, Any]:
    """What the template lists of visit i."""
    plan, turns = sheet.plan, sheet.robot.joint_is_revolute
    values = zip(plan.joint_names, turns, plan.configurations[i], strict=True)
    return {
        "drawing": drawing,
        "joints": [(name, _joint(q, is_turning, 3), signed(q, 6)) for name, is_turning, q in values],
        "travel": list(_travel(sheet, i)),
        "breaks": sheet.checks.breaks[i],
        "aims": list(_aims(sheet, i)),
        "repetitions": int(plan.repetitions[i]),
        "clock": (clock(sheet.timetable.arrive[i]), clock(sheet.timetable.leave[i])),
    }


def _joint(value: float, turns: bool, digits: int) -> str:
    """A joint value [rad | m] in ° or mm, with its unit."""
    return f"{signed(joint_factor(turns) * value, digits)}{_unit_of(turns)}"


def _unit_of(turns: bool) -> str:
    return joint_unit(turns) if turns else f" {joint_unit(turns)}"


def _travel(sheet: PlanSheet, i: int) -> Iterator[str]:
    """The longest ways to visit i, of joints that turn and that slide; none if the start is not known."""
    if np.isnan(sheet.timetable.travel[i]).any():
        return
    for turns in (True, False):
        if (sheet.robot.joint_is_revolute == turns).any():
            yield f"{joint_factor(turns) * sheet.total_travel(True, turns)[i]:.0f}{_unit_of(turns)}"


def _aims(sheet: PlanSheet, i: int) -> Iterator[tuple[str, str]]:
    """Of each reflector at visit i: x, y, z in mm; and azimuth, elevation, range, incidence as far as known."""
    sight = sheet.checks.sight
    for t, point in enumerate(sight.points[i]):
        seen = [
            f"{name}\u00a0{signed(factor * row[i, t], digits)}{unit}"
            for name, row, factor, digits, unit in (
                ("az", sight.azimuths, 180.0 / np.pi, 1, "°"),
                ("el", sight.elevations, 180.0 / np.pi, 1, "°"),
                ("range", sight.ranges, 1.0, 3, "\u00a0m"),
                ("incidence", sight.incidences, 180.0 / np.pi, 0, "°"),
            )
            if np.isfinite(row[i, t])
        ]
        yield _triple(point), ", ".join(seen)


def _triple(point: FloatArray) -> str:
    """Coordinates (3,) [m] in whole mm: a tracker searches in a wider cone."""
    return " ".join(f"{axis}\u00a0{signed(1e3 * x, 0)}" for axis, x in zip("xyz", point, strict=True))


# ── the drawings ─────────────────────────────────────────────────────────────────────────────────────


class View(NamedTuple):
    """One projection of N robots of K points.

    Attributes:
        name: What it is.
        points: (N, K, 2) right and up [m].
        toward: (N, 2) direction to the tracker, or ``None``.
        ground: Whether its lower edge shows the floor through the base.
    """

    name: str
    points: FloatArray
    toward: FloatArray | None
    ground: bool


def posture_drawings(
    robot: Robot, configurations: FloatArray, station: FloatArray | None = None
) -> list[Drawing]:
    """A drawing per configuration (N, joints) [rad | m]; ``station`` (3,) in the frame of positions [m]."""
    views = _views(robot, configurations, station)
    spans = [np.ptp(v.points, axis=(0, 1)) for v in views]
    tall, wide = max(s[1] for s in spans), sum(s[0] for s in spans)
    scale = min(BOX / max(tall, FLAT), 2.0 * BOX / max(wide, FLAT))
    return [_drawing(views, i, scale, len(robot.targets)) for i in range(len(configurations))]


def _views(robot: Robot, q: FloatArray, station: FloatArray | None) -> list[View]:
    turn, place = robot.base_pose
    body = bodies(robot, q)
    level = body[..., :2]
    toward = None if station is None else _unit(((station - place) @ turn)[:2] - level[:, -1])
    above = View("top", level, toward, False)
    if np.ptp(body[..., 2]) < FLAT:
        return [above]
    way = level[:, -1] - level[:, 1]  # from joint 1 to the reflector; x if it is right above
    heading = np.where(np.linalg.norm(way, axis=1, keepdims=True) > FLAT, _unit(way), [1.0, 0.0])
    out = np.einsum("nki,ni->nk", level - level[:, 1:2], heading)
    return [View("side", np.stack([out, body[..., 2]], axis=2), None, True), above]


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


def _drawing(views: list[View], i: int, scale: float, targets: int) -> Drawing:
    """The views of robot i beside each other."""
    tall = max(np.ptp(v.points[..., 1]) for v in views) * scale
    used = sum(np.ptp(v.points[..., 0]) for v in views) * scale + GAP * (len(views) - 1)
    width, height = max(used + 2 * RIM, NARROWEST), tall + 2 * RIM + CAPTION
    shapes: list[Shape] = []
    left = (width - used) / 2
    for view in views:
        low, wide = view.points.min(axis=(0, 1)), np.ptp(view.points[..., 0]) * scale
        xy = (view.points[i] - low) * scale * UPWARDS + [left, RIM + tall]
        shapes += _drawn(view, i, xy, targets)
        shapes.append(shape("text", view.name, x=f"{left + wide / 2:.1f}", y=f"{height - 2:.1f}"))
        left += wide + GAP
    title = f"visit {i + 1}, {' and '.join(v.name for v in views)} view"
    return Drawing("posture", f"{width:.1f} {height:.1f}", title, shapes)


def _drawn(view: View, i: int, xy: FloatArray, targets: int) -> Iterator[Shape]:
    """One view; ``xy`` (K, 2) in drawing units, the last ``targets`` of them reflectors."""
    arm, reflectors = xy[: len(xy) - targets], xy[len(xy) - targets :]
    x, y = arm[0]
    if view.ground:
        yield shape("path", class_="ground", d=f"M{x - 14:.1f} {y:.1f}h28")
    else:
        yield shape("rect", class_="base", x=f"{x - 5:.1f}", y=f"{y - 5:.1f}", width="10", height="10")
    for mark in reflectors:
        yield shape("path", class_="tool", d=f"M{_pair(arm[-1])}L{_pair(mark)}")
    yield shape("polyline", class_="arm", points=" ".join(map(_pair, arm)))
    for name, radius, points in (("joint", "2.4", arm[1:-1]), ("mark", "3.6", reflectors)):
        for x, y in points:
            yield shape("circle", class_=name, cx=f"{x:.1f}", cy=f"{y:.1f}", r=radius)
    if view.toward is not None:
        end = reflectors[-1] + BEAM * view.toward[i] * UPWARDS
        yield shape("path", class_="beam", d=f"M{_pair(reflectors[-1])}L{_pair(end)}")


def _pair(point: FloatArray) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"
