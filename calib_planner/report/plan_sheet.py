"""The plan sheet as one HTML page that needs nothing else: for A4 paper, and for a phone beside the robot.

The page says what was checked and what was not; a cell is empty or says ``not checked`` rather than look good.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from math import ceil
from pathlib import Path
from string import Template

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.io import write_text
from calib_planner.planning import NEVER, POSE_CRITERIA, PlanSheet
from calib_planner.robot import Robot
from calib_planner.units import duration, length, signed

TEMPLATE = Path(__file__).parent / "templates" / "plan_sheet.html"
BOXES = 12
"""More repetitions than this get one box with their number."""
COLUMNS = 6
"""Joints beside each other; more are spread evenly over several lines."""


def write_sheet_page(path: str | Path, sheet: PlanSheet, field: str = "output") -> None:
    """Write the page.

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    write_text(path, sheet_page(sheet), field)


def sheet_page(sheet: PlanSheet) -> str:
    """The page as HTML text."""
    plan, turns = sheet.plan, sheet.robot.joint_is_revolute
    drawings = posture_drawings(sheet.robot, plan.configurations, sheet.checks.sight.station)
    units = [
        u for u, there in (("degrees, below radians", turns.any()), ("mm, below m", not turns.all())) if there
    ]
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        robot=escape(sheet.robot.name),
        identity=sheet.identity,
        criterion=escape(f"criterion {plan.criterion}"),
        facts="\n".join(_fact(*fact) for fact in _facts(sheet)),
        alarms="\n".join(f'<p class="safety alarm"><strong>{escape(a)}</strong></p>' for a in _alarms(sheet)),
        never=_sentence(NEVER),
        told="\n".join(f"<p>{line}</p>" for line in _told(sheet)),
        columns=str(ceil(len(turns) / ceil(len(turns) / COLUMNS))),
        stops=str(len(plan.configurations)),
        measurements=str(plan.measurements),
        units="; ".join(units),
        rows="\n".join(_row(sheet, i, drawing) for i, drawing in enumerate(drawings)),
        legend=_legend(sheet, drawings[0]),
    )


# ── the head ─────────────────────────────────────────────────────────────────────────────────────────


def _fact(name: str, value: str, more: str) -> str:
    return f"<div><dt>{escape(name)}</dt><dd>{escape(value)}<small>{escape(more)}</small></dd></div>"


def _facts(sheet: PlanSheet) -> list[tuple[str, str, str]]:
    """Name, value and remark of what the plan promises and costs."""
    plan, times = sheet.plan, sheet.timetable
    metric = plan.criterion in POSE_CRITERIA
    facts = []
    if len(plan.test_poses):
        poses = f"at {len(plan.test_poses)} test poses, rms" if len(plan.test_poses) > 1 else "at the test pose"
        facts.append(("expected accuracy ρ0", length(plan.predicted_accuracy), poses))
    if not metric:
        facts.append((f"criterion {plan.criterion}", f"{plan.value:.5g}", "its own unit"))
    if plan.bound == "none":
        facts.append(("lower bound", "none", "this criterion has none"))
    else:
        best = length(plan.value_bound) if metric else f"{plan.value_bound:.5g}"
        facts.append(
            (
                "lower bound" if metric else "bound",
                best,
                f"no plan of {plan.measurements} is better ({plan.bound})",
            )
        )
        meaning = "lower bound over expected" if metric else "by the criterion's own measure"
        facts.append(("efficiency", f"{100 * plan.efficiency:.1f} %", meaning))
    stops = len(plan.configurations)
    facts.append(("measurements", str(plan.measurements), f"at {stops} stops"))
    facts.append(("estimated time", duration(times.seconds), f"{duration(times.standing)} of it at standstill"))
    facts.append(("tracker", f"σ = {length(plan.sigma)}", "of one coordinate, assumed by the plan"))
    return facts


def _alarms(sheet: PlanSheet) -> list[str]:
    """What must not be overlooked."""
    plan, checks = sheet.plan, sheet.checks
    found = []
    for word, mask in (("reachable", checks.reachable), ("visible", checks.visible)):
        wrong = [] if mask is None else [str(i + 1) for i in np.flatnonzero(~mask)]
        if wrong:
            found.append(
                f"Not {word}: stop{'s' if len(wrong) > 1 else ''} {', '.join(wrong)}. See the rows below."
            )
    if plan.robot != sheet.robot.name:
        found.append(f"The plan was made for {plan.robot}, this sheet for {sheet.robot.name}.")
    if plan.status != "ok":
        found.append(f"{plan.status}: {plan.message}")
    return found


def _told(sheet: PlanSheet) -> list[str]:
    """What was checked, what not, how the time was estimated; as HTML."""
    checks, pace = sheet.checks, sheet.timetable.pace
    first = (
        ""
        if np.isfinite(sheet.timetable.travel[0]).all()
        else "; the first move is from the farthest possible start"
    )
    return [
        f"<strong>Checked</strong> at every stop: {escape(', '.join(checks.checked))}.",
        f"<strong>Not checked:</strong> {escape(', '.join(checks.unchecked))}.",
        f"Time: {pace.dwell:g} s for each measurement; joint speeds {escape(pace.origin)}{first}.",
    ]


def _sentence(words: tuple[str, ...]) -> str:
    text = " and ".join(words)
    return escape(text[0].upper() + text[1:])


def _legend(sheet: PlanSheet, drawing: str) -> str:
    side = "Side: the vertical plane through joint 1 and the reflector. " if ">side<" in drawing else ""
    beam = " Dashed: towards the tracker." if 'class="beam"' in drawing else ""
    return (
        f"Drawings in the axes of the robot's base. {side}Top: base x to the right, y up the page. "
        f"Orange: reflector.{beam} Plan {sheet.identity}: SHA-256 of joint names, configurations, repetitions."
    )


# ── the rows ─────────────────────────────────────────────────────────────────────────────────────────


def _row(sheet: PlanSheet, i: int, drawing: str) -> str:
    order = f"{i + 1}<small>index {i}</small>"
    return "\n".join(
        (
            f'<tr id="stop{i + 1}">',
            f'<td class="order">{order}</td>',
            f"<td>{drawing}</td>",
            f'<td class="wide"><div class="joints">{_joints(sheet, i)}</div></td>',
            f'<td class="num" data-label="travel since last stop">{_travel(sheet, i)}</td>',
            f'<td data-label="reachable">{_reach(sheet, i)}</td>',
            f'<td data-label="visible">{_view(sheet, i)}</td>',
            f'<td data-label="measured">{_boxes(i + 1, int(sheet.plan.repetitions[i]))}</td>',
            '<td class="notes wide" data-label="notes"></td>',
            "</tr>",
        )
    )


def _joints(sheet: PlanSheet, i: int) -> str:
    cells = []
    columns = zip(
        sheet.plan.joint_names,
        sheet.robot.joint_is_revolute,
        sheet.degrees[i],
        sheet.plan.configurations[i],
        strict=True,
    )
    for name, turns, shown, exact in columns:
        unit = "°" if turns else " mm"
        value = f"<b>{signed(shown, 3)}{unit}</b>"
        cells.append(f"<div><small>{escape(name)}</small>{value}<small>{signed(exact, 6)}</small></div>")
    return "".join(cells)


def _travel(sheet: PlanSheet, i: int) -> str:
    if np.isnan(sheet.timetable.travel[i]).any():
        return '<span class="open">start not<br>known</span>'
    lines = []
    for turning, factor, unit in ((True, 180.0 / np.pi, "°"), (False, 1e3, " mm")):
        if (sheet.robot.joint_is_revolute == turning).any():
            largest, total = (factor * sheet.total_travel(kind, turning)[i] for kind in (True, False))
            lines.append(f"max {largest:.1f}{unit}")
            lines += [f"sum {total:.1f}{unit}"] if (sheet.robot.joint_is_revolute == turning).sum() > 1 else []
    return "<br>".join(lines)


def _reach(sheet: PlanSheet, i: int) -> str:
    joint, margin = sheet.tightest()[i]
    turns = sheet.robot.joint_is_revolute[joint]
    shown = f"{signed(np.degrees(margin), 1)}°" if turns else f"{signed(1e3 * margin, 1)} mm"
    small = f"<small>{shown} to limit of<br>{escape(sheet.plan.joint_names[joint])}</small>"
    return _verdict(sheet.checks.reach_breaks[i]) + small


def _view(sheet: PlanSheet, i: int) -> str:
    visible, sight = sheet.checks.visible, sheet.checks.sight
    lines = []
    for name, row, factor, digits, unit in (
        ("range", sight.ranges[i], 1.0, 2, " m"),
        ("elevation", sight.elevations[i], 180.0 / np.pi, 0, "°"),
        ("incidence", sight.incidences[i], 180.0 / np.pi, 0, "°"),
    ):
        if np.isfinite(row).all():
            lines.append(f"{name} {_span(factor * row, digits)}{unit}")
    said = '<span class="open">not checked</span>' if visible is None else _verdict(sheet.checks.view_breaks[i])
    return said + (f"<small>{'<br>'.join(lines)}</small>" if lines else "")


def _span(values: FloatArray, digits: int) -> str:
    """One value, or the smallest and largest."""
    low, high = signed(values.min(), digits), signed(values.max(), digits)
    return low if low == high else f"{low}…{high}"


def _verdict(breaks: tuple[str, ...]) -> str:
    if not breaks:
        return '<span class="yes">yes</span>'
    return f'<span class="no">NO</span><small class="no">{escape(", ".join(breaks))}</small>'


def _boxes(stop: int, count: int) -> str:
    shown = count if count <= BOXES else 1
    label = f"stop {stop}, measurement"
    boxes = "".join(f'<input type="checkbox" aria-label="{label} {k + 1}">' for k in range(shown))
    return f'<div class="boxes">{boxes}</div>' + (f"<small>{count} ×</small>" if count > BOXES else "")


# ── A small drawing of every posture, so that a person recognises it: from the side and from above ──────────
# The robot is the line through base, joint origins, tip and reflectors, in the axes of its own base, whatever the
# frame of positions. From the side: the vertical plane through joint 1 and the reflector, so that an arm is seen
# in full wherever it points; across is the distance from joint 1. From above: x to the right, y up the page. One
# scale for both views of all postures. A robot that moves in its base's horizontal plane has no view from the
# side.

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
