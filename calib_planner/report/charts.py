"""Small charts as SVG text: axes with round numbers, many dots in one path, sizes that read on a phone.

A chart is a string for the inside of a page. Its colours come from the page's style sheet, by class.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.identification import FEWEST, Estimate, Validation
from calib_planner.report.calibration import CalibrationReport
from calib_planner.report.scene import REJECTED, SUSPECT, USED, point_states, thinned
from calib_planner.units import length


@dataclass(frozen=True)
class Axis:
    """Values ``low`` … ``high`` over ``start`` … ``end`` [drawing units]; ``log``: by their logarithm."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, values: FloatArray | float) -> FloatArray:
        """Where values lie; those outside are put on the border."""
        v = np.clip(np.asarray(values, float), self.low, self.high)
        a, b = self.low, self.high
        if self.log:
            v, a, b = np.log10(v), np.log10(a), np.log10(b)
        return np.asarray(self.start + (self.end - self.start) * (v - a) / (b - a))

    def ticks(self, most: int) -> FloatArray:
        """Round values, at most about ``most``."""
        if not self.log:
            step = round_step((self.high - self.low) / most)
            first = np.ceil(self.low / step - 1e-9)
            return step * np.arange(first, np.floor(self.high / step + 1e-9) + 1)
        decades = np.arange(np.floor(np.log10(self.low)), np.ceil(np.log10(self.high)) + 1)
        for steps in ((1, 2, 5), (1,)):
            found = np.array([s * 10.0**d for d in decades for s in steps])
            found = found[(found >= self.low * (1 - 1e-9)) & (found <= self.high * (1 + 1e-9))]
            if len(found) <= most:
                return found
        return found[:: -(-len(found) // most)]


def round_step(value: float) -> float:
    """The next 1, 2 or 5 times a power of ten, not below ``value``."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(s * power for s in (1, 2, 5, 10) if s * power >= value * (1 - 1e-9)))


def log_range(values: FloatArray, least: float = 1e-12) -> tuple[float, float]:
    """From below the smallest positive value to above the largest; at least a decade."""
    positive = values[np.isfinite(values) & (values > least)]
    if not positive.size:
        return 0.1, 10.0
    low, high = float(positive.min()) / 1.3, float(positive.max()) * 1.3
    middle = np.sqrt(low * high)
    return float(min(low, middle / np.sqrt(10))), float(max(high, middle * np.sqrt(10)))


@dataclass(frozen=True)
class Chart:
    """A frame with two axes.

    Attributes:
        x, y: Axes; ``y`` starts at the bottom.
        width, height: Of the drawing.
        x_label, y_label: What is along them, with the unit.
        title: For those who cannot see it.
        x_ticks: Ticks along x, at most about so many.
    """

    x: Axis
    y: Axis
    width: float
    height: float
    x_label: str
    y_label: str
    title: str
    x_ticks: int = 6

    def svg(self, *parts: str) -> str:
        """The frame with ``parts`` in it."""
        inside = "".join((self._grid(), *parts))
        return (
            f'<svg class="chart" viewBox="0 0 {self.width:g} {self.height:g}" role="img" '
            f'aria-label="{escape(self.title)}">{inside}</svg>'
        )

    def dots(self, name: str, x: ArrayLike, y: ArrayLike) -> str:
        """One path of dots of class ``name``; values that are not finite are left out."""
        pairs = self._inside(x, y)
        return f'<path class="dots {name}" d="{"".join(f"M{_n(a)} {_n(b)}h0" for a, b in pairs)}"/>'

    def crosses(self, name: str, x: ArrayLike, y: ArrayLike) -> str:
        """One path of × of class ``name``."""
        pairs = self._inside(x, y)
        marks = "".join(f"M{_n(a - 3.5)} {_n(b - 3.5)}l7 7m0-7l-7 7" for a, b in pairs)
        return f'<path class="cross {name}" d="{marks}"/>'

    def _inside(self, x: ArrayLike, y: ArrayLike) -> Iterator[tuple[float, float]]:
        """Where the pairs of finite values lie."""
        a, b = np.asarray(x, float), np.asarray(y, float)
        ok = np.isfinite(a) & np.isfinite(b)
        yield from zip(self.x(a[ok]).tolist(), self.y(b[ok]).tolist(), strict=True)

    def line(self, name: str, x: FloatArray, y: FloatArray) -> str:
        """A polyline of class ``name``."""
        points = " ".join(f"{_n(a)} {_n(b)}" for a, b in zip(self.x(x).tolist(), self.y(y).tolist(), strict=True))
        return f'<polyline class="{name}" points="{points}"/>'

    def level(self, name: str, y: float, label: str) -> str:
        """A horizontal line of class ``name`` with a label at its right end."""
        at = float(self.y(y))
        words = _text(_n(self.x.end - 4), _n(at - 4), "end", label, "label")
        return f'<path class="{name}" d="M{_n(self.x.start)} {_n(at)}H{_n(self.x.end)}"/>{words}'

    def _grid(self) -> str:
        left, right, bottom, top = (_n(v) for v in (self.x.start, self.x.end, self.y.start, self.y.end))
        parts = [f'<path class="axis" d="M{left} {bottom}H{right}"/>']
        for value in self.x.ticks(self.x_ticks):
            at = _n(float(self.x(value)))
            parts.append(f'<path class="grid" d="M{at} {bottom}V{top}"/>')
            parts.append(_text(at, _n(self.y.start + 15), "middle", plain_number(value)))
        for value in self.y.ticks(6):
            level = float(self.y(value))
            parts.append(f'<path class="grid" d="M{left} {_n(level)}H{right}"/>')
            parts.append(_text(_n(self.x.start - 5), _n(level + 4), "end", plain_number(value)))
        middle = _n((self.x.start + self.x.end) / 2)
        parts.append(_text(middle, _n(self.height - 5), "middle", self.x_label))
        parts.append(_text("2", "12", "start", self.y_label))
        return "".join(parts)


def _text(x: str, y: str, anchor: str, words: str, name: str = "axis-text") -> str:
    return f'<text class="{name}" x="{x}" y="{y}" text-anchor="{anchor}">{escape(words)}</text>'


def framed(
    width: float,
    height: float,
    x: tuple[float, float],
    y: tuple[float, float],
    labels: tuple[str, str, str],
    *,
    left: float = 44.0,
    log: tuple[bool, bool] = (False, False),
    x_ticks: int = 6,
) -> Chart:
    """A chart of the usual margins; ``labels`` are x, y and title."""
    across = Axis(*x, left, width - 8.0, log[0])
    up = Axis(*y, height - 38.0, 22.0, log[1])
    return Chart(across, up, width, height, *labels, x_ticks=x_ticks)


def plain_number(value: float) -> str:
    """A tick's value, with a true minus sign."""
    text = f"{value:.6g}" if abs(value) > 1e-12 else "0"
    return text.replace("-", "−")


def spread(count: int) -> tuple[float, float]:
    """Axis for rows 0 … count − 1."""
    return -0.02 * count - 0.5, 1.02 * count - 0.5


def _n(value: float) -> str:
    """One decimal, no more characters than needed."""
    text = f"{value:.1f}"
    return text[:-2] if text.endswith(".0") else text


def legend(entries: Sequence[tuple[str, str]]) -> str:
    """HTML for pairs (class of the mark, words)."""
    items = "".join(
        f'<span><svg class="mark" viewBox="0 0 16 12">{_mark(name)}</svg>{escape(words)}</span>'
        for name, words in entries
    )
    return f'<p class="legend">{items}</p>'


def _mark(name: str) -> str:
    if name.startswith("cross"):
        return f'<path class="{name}" d="M4.5 2.5l7 7m0-7l-7 7"/>'
    if name.startswith("dots"):
        return f'<path class="{name} big" d="M8 6h0"/>'
    return f'<path class="{name}" d="M1 6h14"/>'


# ── Charts of a calibration: before and after, predicted and achieved, residuals by point and joint, correlat
# *By joint.* A residual r at a configuration is seen in the axes that belong to joint l there: along its motion
# c_l/|c_l| with c_l = ∂p/∂q_l, along its axis a_l, and across both. What depends on the joint's angle along its
# motion is an error of its transmission; along the axis, a tilt; across, an eccentricity.
#
# Where points are many, ``MOST_DOTS`` of them are drawn: the largest, and an even choice of the others.

MOST_DOTS = 1200
BINS = 12
SHORT = 0.05
"""Where a joint's lever is shorter than this share of its longest, its motion has no direction to speak of."""


class Points(NamedTuple):
    """Measured points to be drawn, in order of rows: (K,) each, distances [mm]."""

    rows: IntArray
    before: FloatArray
    after: FloatArray
    normalised: FloatArray
    states: IntArray


def drawn_points(report: CalibrationReport) -> Points:
    """At most ``MOST_DOTS`` of the measured points."""
    e = report.estimate
    where = np.argwhere(report.problem.data.seen)
    seen = tuple(where.T)
    states = point_states(e)[seen]
    keep = thinned(np.where(states == USED, e.normalised_residuals[seen], np.inf), MOST_DOTS)
    before = 1e3 * np.linalg.norm(report.before[seen], axis=1)[keep]
    after = 1e3 * np.linalg.norm(e.residuals[seen], axis=1)[keep]
    return Points(where[keep, 0], before, after, e.normalised_residuals[seen][keep], states[keep])


def residual_chart(report: CalibrationReport, points: Points) -> str:
    """Distance of each point before and after, on a logarithmic scale."""
    labels = ("row of the data, from 0", "mm", "distance of each point before and after calibration")
    scale = log_range(np.concatenate([points.before, points.after]))
    chart = framed(460, 250, spread(len(report.problem.data)), scale, labels, log=(False, True))
    out = points.states == REJECTED
    return chart.svg(
        chart.dots("before", points.rows, points.before),
        chart.dots("after", points.rows[~out], points.after[~out]),
        chart.crosses("rejected", points.rows[out], points.after[out]),
    )


def gate_chart(report: CalibrationReport, points: Points) -> str:
    """Each residual in standard deviations of what it should be, and the gate."""
    gate = report.estimate.gate
    labels = ("row of the data, from 0", "standard deviations", "normalised residual of each point and the gate")
    largest = max(1.25 * gate, 1.05 * float(np.nanmax(points.normalised, initial=0.0)))
    far = largest > 5 * gate
    scale = log_range(np.append(points.normalised, [gate, largest])) if far else (0.0, largest)
    chart = framed(460, 250, spread(len(report.problem.data)), scale, labels, log=(False, far))
    parts = [
        chart.crosses("rejected", points.rows[out], points.normalised[out])
        if state == REJECTED
        else chart.dots(name, points.rows[out], points.normalised[out])
        for state, name in ((USED, "after"), (SUSPECT, "suspect"), (REJECTED, "rejected"))
        if (out := points.states == state).any()
    ]
    return chart.svg(chart.level("limit", gate, f"gate {gate:.3g}"), *parts)


# ── before and after, predicted and achieved ─────────────────────────────────────────────────────────


class Row(NamedTuple):
    """A line of ``compared``: name, the hollow and the full mark [m], ``None`` where there is none."""

    name: str
    hollow: float | None
    full: float | None
    lines: tuple[float, ...] = ()


def compared(rows: list[Row], title: str, required: float | None = None) -> str:
    """Distances on one logarithmic scale: per row a hollow mark, a full one, and ticks."""
    known = [v for r in rows for v in (r.hollow, r.full, *r.lines, required) if v is not None and np.isfinite(v)]
    height = 58.0 + 34.0 * len(rows)
    chart = framed(
        460, height, log_range(1e3 * np.array(known)), (0, 1), ("mm", "", title), left=12, log=(True, False)
    )
    parts = [_grid_free(chart)]
    if required is not None:
        at = float(chart.x(1e3 * required))
        parts.append(f'<path class="limit" d="M{at:.1f} 4V{height - 38:.1f}"/>')
    for i, row in enumerate(rows):
        parts.append(_compared_row(chart, row, 30.0 + 34.0 * i))
    inside = "".join(parts)
    return (
        f'<svg class="chart" viewBox="0 0 460 {height:g}" role="img" aria-label="{escape(title)}">{inside}</svg>'
    )


def _grid_free(chart: Chart) -> str:
    """Vertical lines only."""
    bottom = chart.y.start
    parts = [f'<path class="axis" d="M{chart.x.start:.1f} {bottom:.1f}H{chart.x.end:.1f}"/>']
    for value in chart.x.ticks(7):
        at = float(chart.x(value))
        parts.append(f'<path class="grid" d="M{at:.1f} {bottom:.1f}V6"/>')
        parts.append(f'<text x="{at:.1f}" y="{bottom + 15:.1f}" text-anchor="middle">{value:.6g}</text>')
    parts.append(f'<text x="{chart.x.end:.1f}" y="{chart.height - 5:.1f}" text-anchor="end">mm</text>')
    return "".join(parts)


def _compared_row(chart: Chart, row: Row, y: float) -> str:
    parts = [f'<text class="name" x="{chart.x.start:.1f}" y="{y - 11:.1f}">{escape(row.name)}</text>']
    marks = [v for v in (row.hollow, row.full) if v is not None and np.isfinite(v)]
    at = [float(chart.x(1e3 * v)) for v in marks]
    if len(at) == 2:
        parts.append(f'<path class="between" d="M{at[0]:.1f} {y:.1f}H{at[1]:.1f}"/>')
    for value, name in ((row.hollow, "hollow"), (row.full, "full")):
        if value is not None and np.isfinite(value):
            parts.append(f'<circle class="{name}" cx="{float(chart.x(1e3 * value)):.1f}" cy="{y:.1f}" r="5"/>')
    for value in row.lines:
        if np.isfinite(value):
            parts.append(f'<path class="tick" d="M{float(chart.x(1e3 * value)):.1f} {y - 7:.1f}v14"/>')
    return "".join(parts)


# ── by joint ─────────────────────────────────────────────────────────────────────────────────────────

PARTS = ("along", "axial", "across")


def joint_charts(report: CalibrationReport) -> list[str]:
    """A chart per joint: the residual's parts against the joint's coordinate."""
    robot, e, data = report.estimate.calibrated, report.estimate, report.problem.data
    use = data.seen & (point_states(e) != REJECTED)
    parts = joint_residuals(report)
    shown = 1e3 * np.abs(np.where(use[None, :, :, None], parts, 0.0))
    highest = float(np.nanmax(shown, initial=0.0)) or 1.0
    where = np.argwhere(use)
    keep = where[thinned(e.normalised_residuals[tuple(where.T)], MOST_DOTS // 2)]
    charts = []
    for k, name in enumerate(robot.joint_names):
        factor, unit = (180 / np.pi, "°") if robot.joint_is_revolute[k] else (1e3, "mm")
        q = factor * data.q[:, k]
        pad = 0.03 * float(np.ptp(q)) or 1.0
        labels = (f"{name} [{unit}]", "mm", f"residuals against {name}")
        chart = framed(340, 200, (q.min() - pad, q.max() + pad), (-highest, highest), labels)
        charts.append(chart.svg(*_joint_marks(chart, q, 1e3 * parts[k], keep, use)))
    return charts


def _joint_marks(chart: Chart, q: FloatArray, parts: FloatArray, keep: IntArray, use: np.ndarray) -> list[str]:
    """Dots of the points ``keep`` (row, target), and means over bins of all in ``use``, if q varies."""
    drawn = []
    for c in (2, 1, 0):
        drawn.append(chart.dots(f"{PARTS[c]} small", q[keep[:, 0]], parts[keep[:, 0], keep[:, 1], c]))
    if len(np.unique(q[keep[:, 0]])) < FEWEST:
        return drawn
    rows = np.broadcast_to(q[:, None], use.shape)[use]
    for c in (2, 1, 0):
        drawn.append(chart.line(f"mean {PARTS[c]}", *_means(rows, parts[..., c][use])))
    return drawn


def _means(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means over ``BINS`` bins of equally many points."""
    ok = np.isfinite(y)
    x, y = x[ok], y[ok]
    order = np.argsort(x, kind="stable")
    groups = [g for g in np.array_split(order, min(BINS, max(len(order) // 3, 1))) if len(g)]
    return np.array([x[g].mean() for g in groups]), np.array([y[g].mean() for g in groups])


def joint_residuals(report: CalibrationReport) -> FloatArray:
    """(joints, N, targets, 3) residual along the joint's motion, its axis, across [m]; NaN: no direction."""
    robot, data, residuals = report.estimate.calibrated, report.problem.data, report.estimate.residuals
    n, targets = data.seen.shape
    levers = robot.joint_jacobian(data.q).reshape(n, targets, 3, -1)
    axes = robot.posture(data.q).joint_axes
    found = np.full((len(robot.joint_names), n, targets, 3), np.nan)
    for k, turns in enumerate(robot.joint_is_revolute):
        size = np.linalg.norm(levers[..., k], axis=2, keepdims=True)
        motion = levers[..., k] / np.where(size > SHORT * size.max(), size, np.nan)
        found[k, ..., 0] = np.sum(motion * residuals, axis=2)
        if turns:
            axis = np.broadcast_to(axes[:, None, k], residuals.shape)
            found[k, ..., 1] = np.sum(axis * residuals, axis=2)
            found[k, ..., 2] = np.sum(np.cross(motion, axis) * residuals, axis=2)
    return found


def correction_charts(report: CalibrationReport) -> list[str]:
    """φ of each joint over the angles that were measured, if joint corrections were learnt."""
    found, q = report.estimate.transmission, report.problem.data.q
    if found is None:
        return []
    grid = np.linspace(q.min(axis=0), q.max(axis=0), 121)
    phi = 1e3 * found.corrections.at(grid)
    highest = 1.1 * float(np.abs(phi).max()) or 1.0
    charts = []
    for k, name in enumerate(report.estimate.joint_names):
        turns = report.estimate.calibrated.joint_is_revolute[k]
        factor, units = (180 / np.pi, ("°", "mrad")) if turns else (1e3, ("mm", "mm"))
        along = factor * grid[:, k]
        pad = 0.03 * float(np.ptp(along)) or 1.0
        labels = (f"{name} [{units[0]}]", units[1], f"joint correction of {name}")
        chart = framed(340, 160, (along.min() - pad, along.max() + pad), (-highest, highest), labels)
        charts.append(chart.svg(chart.line("mean along", along, phi[:, k])))
    return charts


# ── correlations ─────────────────────────────────────────────────────────────────────────────────────

LEVELS = 10
"""Shades of each sign."""


def correlation_matrix(estimate: Estimate) -> tuple[tuple[str, ...], FloatArray]:
    """Names of the parameters that were identified, and their correlations."""
    kept = [i for i, v in enumerate(np.diag(estimate.covariance)) if v > 0]
    std = np.sqrt(np.diag(estimate.covariance)[kept])
    matrix = estimate.covariance[np.ix_(kept, kept)] / np.outer(std, std)
    return tuple(estimate.parameters[i] for i in kept), matrix


def correlation_chart(names: tuple[str, ...], matrix: FloatArray) -> str:
    """A square per pair: blue below zero, orange above, the stronger the darker; one path per shade."""
    cell, count = 12, len(names)
    margin = 8 + 6.2 * max(map(len, names), default=0)
    side = margin + cell * count + 2
    shades = np.rint(np.clip(matrix, -1, 1) * LEVELS).astype(int)
    parts = []
    for shade in np.unique(shades[shades != 0]):
        squares = "".join(
            f"M{margin + cell * j:g} {margin + cell * i:g}h{cell}v{cell}h-{cell}z"
            for i, j in np.argwhere(shades == shade).tolist()
        )
        sign = "plus" if shade > 0 else "minus"
        parts.append(f'<path class="{sign}" fill-opacity="{abs(int(shade)) / LEVELS:g}" d="{squares}"/>')
    for i, name in enumerate(names):
        at = margin + cell * i + 9
        parts.append(f'<text x="{margin - 4:g}" y="{at:g}" text-anchor="end">{escape(name)}</text>')
        parts.append(f'<text transform="translate({at:g} {margin - 4:g}) rotate(-90)">{escape(name)}</text>')
    parts.append(
        f'<rect class="frame" x="{margin:g}" y="{margin:g}" width="{cell * count}" height="{cell * count}"/>'
    )
    size = f'viewBox="0 0 {side:g} {side:g}" style="max-width:{1.15 * side:.0f}px"'
    title = f'role="img" aria-label="correlations of {count} parameters"'
    return f'<svg class="chart heat" {size} {title}>{"".join(parts)}</svg>'


def accuracy_charts(estimate: Estimate) -> tuple[str, str]:
    """Mean distances before and after; and what was predicted beside what was achieved."""
    required = estimate.required_accuracy if np.isfinite(estimate.required_accuracy) else None
    held_out = validation_sets(estimate)
    means = [Row("points of the fit", estimate.residual_before.mean, estimate.residual_after.mean)]
    means += [Row(name, v.before_mean, v.mean) for name, v in held_out]
    promised = [Row(f"{name}: {length(v.rms)}", None, v.rms, (v.predicted_rms,)) for name, v in held_out]
    per = estimate.predicted_accuracy_per_test_pose
    finite = per[np.isfinite(per)]
    if finite.size:
        what = "the test pose" if len(per) == 1 else f"{len(per)} test poses"
        promised.append(Row(f"{what}: not measured, prediction only", None, None, tuple(finite.tolist())))
    first = compared(means, "mean distance before and after calibration")
    return first, compared(promised, "achieved and predicted error", required) if promised else ""


def validation_sets(estimate: Estimate) -> list[tuple[str, Validation]]:
    """Name and statistics of each validation there is."""
    found: list[tuple[str, Validation]] = []
    if estimate.validation is not None:
        found.append(("held-out points", estimate.validation))
    if estimate.cross_validation is not None:
        found.append((f"left out in turn, {estimate.cross_validation.folds} folds", estimate.cross_validation))
    return found
