# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The charts of a calibration, as drawings: before and after, predicted and achieved, residuals, correlations.

*By joint.* A residual r at a configuration is shown in the axes that belong to joint l there: along its motion
c_l/|c_l| with c_l = ∂p/∂q_l, along its axis a_l, and across both. What depends on the joint's angle along its
motion is an error of its transmission; along the axis, a tilt; across, an eccentricity.

Where there are many points, the charts show ``MOST_DOTS`` of them: the largest, and an even choice of the others.
Many dots are one path, and axes have round numbers, so that a page stays small and can be read on a phone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.error_model import Poses
from calib_planner.identification import Estimate
from calib_planner.report.calibration import CalibrationReport
from calib_planner.report.render import Drawing, Shape, shape
from calib_planner.report.scene import REJECTED, SUSPECT, USED, point_states, thinned
from calib_planner.units import joint_factor, joint_unit, length

MOST_DOTS = 1200
BINS = 12
FEWEST = 10
"""Different configurations below which means over bins say nothing."""
SHORT = 0.05
"""Where a joint's lever is shorter than this share of its longest, its motion has no direction to speak of."""
PARTS = ("along", "axial", "across")
"""Classes of the three parts of a residual by joint."""
SHADES = 10
"""Shades of each sign in the chart of correlations."""


# ── a frame with two axes ────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Axis:
    """Values ``low`` … ``high`` over ``start`` … ``end`` [drawing units]; ``log``: by their logarithm."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, values: FloatArray | float) -> FloatArray:
        """Positions of values, same shape [drawing units]; those outside are put on the border."""
        v = np.clip(np.asarray(values, float), self.low, self.high)
        a, b = self.low, self.high
        if self.log:
            v, a, b = np.log10(v), np.log10(a), np.log10(b)
        return np.asarray(self.start + (self.end - self.start) * (v - a) / (b - a))

    def ticks(self, most: int) -> FloatArray:
        """Round values, at most about ``most``."""
        if not self.log:
            step = _round_step((self.high - self.low) / most)
            first = np.ceil(self.low / step - 1e-9)
            return step * np.arange(first, np.floor(self.high / step + 1e-9) + 1)
        decades = np.arange(np.floor(np.log10(self.low)), np.ceil(np.log10(self.high)) + 1)
        for steps in ((1, 2, 5), (1,)):
            values = np.array([s * 10.0**d for d in decades for s in steps])
            values = values[(values >= self.low * (1 - 1e-9)) & (values <= self.high * (1 + 1e-9))]
            if len(values) <= most:
                return values
        return values[:: -(-len(values) // most)]


def _round_step(value: float) -> float:
    """The next 1, 2 or 5 times a power of ten, not below ``value``."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(s * power for s in (1, 2, 5, 10) if s * power >= value * (1 - 1e-9)))


@dataclass(frozen=True)
class Chart:
    """A frame of ``width`` × ``height`` with the usual margins and two axes, for values x and y within ``across``
    and ``up``; ``labels`` are those of x and of y with the unit, and the title."""

    width: float
    height: float
    across: tuple[float, float]
    up: tuple[float, float]
    labels: tuple[str, str, str]
    left: float = 44.0
    log: tuple[bool, bool] = (False, False)

    @property
    def x(self) -> Axis:
        return Axis(*self.across, self.left, self.width - 8.0, self.log[0])

    @property
    def y(self) -> Axis:
        """From the bottom upwards."""
        return Axis(*self.up, self.height - 38.0, 22.0, self.log[1])

    def drawing(self, *parts: Shape) -> Drawing:
        """The frame with ``parts`` in it."""
        return Drawing("chart", f"{self.width:g} {self.height:g}", self.labels[2], [*self._grid(), *parts])

    def dots(self, name: str, x: ArrayLike, y: ArrayLike) -> Shape:
        """One path of dots of class ``name``; values that are not finite are left out."""
        marks = "".join(f"M{_n(a)} {_n(b)}h0" for a, b in self._inside(x, y))
        return shape("path", class_=f"dots {name}", d=marks)

    def crosses(self, name: str, x: ArrayLike, y: ArrayLike) -> Shape:
        """One path of × of class ``name``."""
        marks = "".join(f"M{_n(a - 3.5)} {_n(b - 3.5)}l7 7m0-7l-7 7" for a, b in self._inside(x, y))
        return shape("path", class_=f"cross {name}", d=marks)

    def _inside(self, x: ArrayLike, y: ArrayLike) -> Iterator[tuple[float, float]]:
        """Positions of the pairs of finite values."""
        a, b = np.asarray(x, float), np.asarray(y, float)
        ok = np.isfinite(a) & np.isfinite(b)
        yield from zip(self.x(a[ok]).tolist(), self.y(b[ok]).tolist(), strict=True)

    def line(self, name: str, x: FloatArray, y: FloatArray) -> Shape:
        """A polyline of class ``name``."""
        points = " ".join(f"{_n(a)} {_n(b)}" for a, b in zip(self.x(x).tolist(), self.y(y).tolist(), strict=True))
        return shape("polyline", class_=name, points=points)

    def level(self, name: str, y: float, label: str) -> list[Shape]:
        """A horizontal line of class ``name`` with a label at its right end."""
        at = float(self.y(y))
        line = shape("path", class_=name, d=f"M{_n(self.x.start)} {_n(at)}H{_n(self.x.end)}")
        return [line, _label(self.x.end - 4, at - 4, "end", label, "label")]

    def _grid(self) -> Iterator[Shape]:
        left, right, bottom, top = (_n(v) for v in (self.x.start, self.x.end, self.y.start, self.y.end))
        yield shape("path", class_="axis", d=f"M{left} {bottom}H{right}")
        for value in self.x.ticks(6):
            at = float(self.x(value))
            yield shape("path", class_="grid", d=f"M{_n(at)} {bottom}V{top}")
            yield _label(at, self.y.start + 15, "middle", _plain(value))
        for value in self.y.ticks(6):
            at = float(self.y(value))
            yield shape("path", class_="grid", d=f"M{left} {_n(at)}H{right}")
            yield _label(self.x.start - 5, at + 4, "end", _plain(value))
        yield _label((self.x.start + self.x.end) / 2, self.height - 5, "middle", self.labels[0])
        yield _label(2, 12, "start", self.labels[1])


def _label(x: float, y: float, anchor: str, words: str, name: str = "axis-text") -> Shape:
    return shape("text", words, class_=name, x=_n(x), y=_n(y), text_anchor=anchor)


def _n(value: float) -> str:
    """One decimal, no more characters than needed."""
    return f"{value:.1f}".removesuffix(".0")


def _plain(value: float) -> str:
    """A tick's value, with a true minus sign."""
    return (f"{value:.6g}" if abs(value) > 1e-12 else "0").replace("-", "−")


def _log_range(values: FloatArray) -> tuple[float, float]:
    """From below the smallest positive value to above the largest; at least a decade."""
    positive = values[np.isfinite(values) & (values > 1e-12)]
    if not positive.size:
        return 0.1, 10.0
    low, high = float(positive.min()) / 1.3, float(positive.max()) * 1.3
    middle = np.sqrt(low * high)
    return float(min(low, middle / np.sqrt(10))), float(max(high, middle * np.sqrt(10)))


# ── before and after, predicted and achieved ─────────────────────────────────────────────────────────


class Row(NamedTuple):
    """A line of ``_compared``: name, the hollow and the full mark, the ticks [m]; ``None``: no mark."""

    name: str
    hollow: float | None
    full: float | None
    ticks: tuple[float, ...] = ()


class ComparedSet(NamedTuple):
    """Points whose distances are compared: name for people, then places in the report's JSON, empty: it has none.

    ``number`` is their number; ``key`` has mean, rms, max and, if ``predicted``, predicted_rms; ``alone`` has
    mean and rms with placement alone.
    """

    name: str
    key: str
    number: str
    before: str
    alone: str
    predicted: bool
    inside: str


def compared_sets(estimate: Estimate) -> list[ComparedSet]:
    """The points of the fit, those left out visit by visit, and those held out, as far as there are any."""
    fit, left, tested = "estimate.residual_after", "estimate.left_out", "estimate.validation"
    alone, before = "estimate.placement_alone.", "estimate.residual_before.mean"
    sets = [ComparedSet("points of the fit", fit, "estimate.used", before, f"{alone}residual_after.", False, "")]
    if estimate.left_out.count:
        sets.append(
            ComparedSet("left out, visit by visit", left, f"{left}.count", "", f"{alone}left_out.", True, "")
        )
    if estimate.validation is not None:
        inside = f"{tested}.within_95"
        own = (f"{tested}.count", f"{tested}.before_mean", f"{tested}.placement_")
        sets.append(ComparedSet("held-out points", tested, *own, True, inside))
    return sets


def accuracy_charts(estimate: Estimate) -> tuple[Drawing, Drawing | None]:
    """Mean distances before and after; and what was predicted beside what was achieved, if anything was."""
    required = estimate.accuracy.required if np.isfinite(estimate.accuracy.required) else None
    left, test = estimate.left_out, estimate.validation
    means = [Row("points of the fit", estimate.residuals.before.mean, estimate.residuals.after.mean)]
    promised = []
    if left.count:
        means.append(Row("left out, visit by visit", None, left.mean))
        promised.append(
            Row(f"left out, visit by visit: {length(left.rms)}", None, left.rms, (left.predicted_rms,))
        )
    if test is not None:
        means.append(Row("held-out points", test.before_mean, test.mean))
        promised.append(Row(f"held-out points: {length(test.rms)}", None, test.rms, (test.predicted_rms,)))
    per = estimate.accuracy.predicted
    finite = per[np.isfinite(per)]
    if finite.size:
        what = "the test pose" if len(per) == 1 else f"{len(per)} test poses"
        promised.append(Row(f"{what}: not measured, prediction only", None, None, tuple(finite.tolist())))
    first = _compared(means, "mean distance before and after calibration")
    return first, _compared(promised, "achieved and predicted error", required) if promised else None


def _compared(rows: list[Row], title: str, required: float | None = None) -> Drawing:
    """Distances on one logarithmic scale: per row a hollow mark, a full one, and ticks."""
    known = [v for r in rows for v in (r.hollow, r.full, *r.ticks, required) if v is not None and np.isfinite(v)]
    height = 58.0 + 34.0 * len(rows)
    scale = _log_range(1e3 * np.array(known))
    chart = Chart(460, height, scale, (0, 1), ("mm", "", title), left=12, log=(True, False))
    shapes = [*_vertical_grid(chart)]
    if required is not None:
        shapes.append(
            shape("path", class_="limit", d=f"M{float(chart.x(1e3 * required)):.1f} 4V{height - 38:.1f}")
        )
    for i, row in enumerate(rows):
        shapes += _compared_row(chart, row, 30.0 + 34.0 * i)
    return Drawing("chart", f"460 {height:g}", title, shapes)


def _vertical_grid(chart: Chart) -> Iterator[Shape]:
    bottom, right = chart.y.start, f"{chart.x.end:.1f}"
    yield shape("path", class_="axis", d=f"M{chart.x.start:.1f} {bottom:.1f}H{right}")
    for value in chart.x.ticks(7):
        at = f"{float(chart.x(value)):.1f}"
        yield shape("path", class_="grid", d=f"M{at} {bottom:.1f}V6")
        yield shape("text", f"{value:.6g}", x=at, y=f"{bottom + 15:.1f}", text_anchor="middle")
    yield shape("text", "mm", x=right, y=f"{chart.height - 5:.1f}", text_anchor="end")


def _compared_row(chart: Chart, row: Row, y: float) -> Iterator[Shape]:
    yield shape("text", row.name, class_="name", x=f"{chart.x.start:.1f}", y=f"{y - 11:.1f}")
    marks = [(name, v) for name, v in (("hollow", row.hollow), ("full", row.full)) if v is not None]
    places = [(name, f"{float(chart.x(1e3 * v)):.1f}") for name, v in marks if np.isfinite(v)]
    if len(places) == 2:
        yield shape("path", class_="between", d=f"M{places[0][1]} {y:.1f}H{places[1][1]}")
    for name, at in places:
        yield shape("circle", class_=name, cx=at, cy=f"{y:.1f}", r="5")
    for value in filter(np.isfinite, row.ticks):
        yield shape("path", class_="tick", d=f"M{float(chart.x(1e3 * value)):.1f} {y - 7:.1f}v14")


# ── residuals, point by point ────────────────────────────────────────────────────────────────────────


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
    chosen = thinned(np.where(states == USED, e.residuals.normalised[seen], np.inf), MOST_DOTS)
    before = 1e3 * np.linalg.norm(report.before[seen], axis=1)[chosen]
    after = 1e3 * np.linalg.norm(e.residuals.vectors[seen], axis=1)[chosen]
    return Points(where[chosen, 0], before, after, e.residuals.normalised[seen][chosen], states[chosen])


def residual_chart(report: CalibrationReport, points: Points) -> Drawing:
    """Distance of each point before and after, on a logarithmic scale."""
    title = "distance of each point before and after calibration"
    chart = _by_row(report, _log_range(np.concatenate([points.before, points.after])), "mm", title, log=True)
    out = points.states == REJECTED
    return chart.drawing(
        chart.dots("before", points.rows, points.before),
        chart.dots("after", points.rows[~out], points.after[~out]),
        chart.crosses("rejected", points.rows[out], points.after[out]),
    )


def gate_chart(report: CalibrationReport, points: Points) -> Drawing:
    """Each residual in standard deviations of what it should be, and the gate."""
    gate = report.estimate.residuals.gate
    largest = max(1.25 * gate, 1.05 * float(np.nanmax(points.normalised, initial=0.0)))
    far = largest > 5 * gate
    scale = _log_range(np.append(points.normalised, [gate, largest])) if far else (0.0, largest)
    title = "normalised residual of each point and the gate"
    chart = _by_row(report, scale, "standard deviations", title, log=far)
    marks = [
        (chart.crosses if state == REJECTED else chart.dots)(name, points.rows[chosen], points.normalised[chosen])
        for state, name in ((USED, "after"), (SUSPECT, "suspect"), (REJECTED, "rejected"))
        if (chosen := points.states == state).any()
    ]
    return chart.drawing(*chart.level("limit", gate, f"gate {gate:.3g}"), *marks)


def _by_row(report: CalibrationReport, y: tuple[float, float], unit: str, title: str, *, log: bool) -> Chart:
    count = len(report.problem.data)
    rows = (-0.02 * count - 0.5, 1.02 * count - 0.5)
    return Chart(460, 250, rows, y, ("row of the data, from 0", unit, title), log=(False, log))


# ── residuals, joint by joint ────────────────────────────────────────────────────────────────────────


def joint_charts(report: CalibrationReport) -> list[Drawing]:
    """A chart per joint: the residual's parts against the joint's coordinate."""
    e, data = report.estimate, report.problem.data
    use = data.seen & (point_states(e) != REJECTED)
    parts = 1e3 * joint_residuals(report)
    highest = float(np.nanmax(np.abs(np.where(use[None, :, :, None], parts, 0.0)), initial=0.0)) or 1.0
    where = np.argwhere(use)
    chosen = where[thinned(e.residuals.normalised[tuple(where.T)], MOST_DOTS // 2)]
    charts = []
    for k in range(len(parts)):
        chart, q = _by_joint(e, k, data.q, 200, "mm", highest, "residuals against")
        charts.append(chart.drawing(*_joint_marks(chart, q, parts[k], chosen, use)))
    return charts


def _by_joint(
    e: Estimate, k: int, q: FloatArray, height: float, unit: str, highest: float, what: str
) -> tuple[Chart, FloatArray]:
    """The frame for values up to ± ``highest`` of joint k, and its coordinates there; q (N, joints) [rad | m]."""
    name, turns = e.calibrated.joint_names[k], bool(e.calibrated.joint_is_revolute[k])
    shown = joint_factor(turns) * q[:, k]
    pad = 0.03 * float(np.ptp(shown)) or 1.0
    across = float(shown.min()) - pad, float(shown.max()) + pad
    labels = (f"{name} [{joint_unit(turns)}]", unit, f"{what} {name}")
    return Chart(340, height, across, (-highest, highest), labels), shown


def _joint_marks(
    chart: Chart, q: FloatArray, parts: FloatArray, chosen: IntArray, use: np.ndarray
) -> Iterator[Shape]:
    """Dots of the points ``chosen`` (row, target), and means over bins of all in ``use``, if q varies."""
    rows, targets = chosen.T
    for c in (2, 1, 0):
        yield chart.dots(f"{PARTS[c]} small", q[rows], parts[rows, targets, c])
    if len(np.unique(q[rows])) >= FEWEST:
        every = np.broadcast_to(q[:, None], use.shape)[use]
        for c in (2, 1, 0):
            yield chart.line(f"mean {PARTS[c]}", *_means(every, parts[..., c][use]))


def _means(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means over ``BINS`` bins of equally many points."""
    ok = np.isfinite(y)
    x, y = x[ok], y[ok]
    order = np.argsort(x, kind="stable")
    groups = [g for g in np.array_split(order, min(BINS, max(len(order) // 3, 1))) if len(g)]
    return np.array([x[g].mean() for g in groups]), np.array([y[g].mean() for g in groups])


def joint_residuals(report: CalibrationReport) -> FloatArray:
    """(joints, N, targets, 3) residual along the joint's motion, its axis, across [m]; NaN: no direction."""
    robot, data, residuals = report.estimate.calibrated, report.problem.data, report.estimate.residuals.vectors
    n, targets = data.seen.shape
    levers = robot.joint_jacobian(data.q).reshape(n, targets, 3, -1)
    axes = robot.posture(data.q).joint_axes
    parts = np.full((len(robot.joint_names), n, targets, 3), np.nan)
    for k, turns in enumerate(robot.joint_is_revolute):
        size = np.linalg.norm(levers[..., k], axis=2, keepdims=True)
        motion = levers[..., k] / np.where(size > SHORT * size.max(), size, np.nan)
        parts[k, ..., 0] = np.sum(motion * residuals, axis=2)
        if turns:
            axis = np.broadcast_to(axes[:, None, k], residuals.shape)
            parts[k, ..., 1] = np.sum(axis * residuals, axis=2)
            parts[k, ..., 2] = np.sum(np.cross(motion, axis) * residuals, axis=2)
    return parts


def deflection_marks(estimate: Estimate) -> list[tuple[str, str]]:
    """Class and words of what ``deflection_charts`` draws."""
    model = estimate.knowledge.model
    own, sag = ("mean along", "by its own angle: gears and encoder"), ("dots axial", "by gravity, where measured")
    return [own] * (model.joint_functions is not None) + [sag] * (model.gravity is not None)


def deflection_charts(report: CalibrationReport) -> list[Drawing]:
    """What each joint turns beyond its reading by its angle: joint functions as lines, gravity as dots."""
    known, data = report.estimate.knowledge, report.problem.data
    q, loads = data.q, known.model.payloads(data.payload, len(data))
    model, place = known.model, known.model.slices(known.robot)
    grid = np.linspace(q.min(axis=0), q.max(axis=0), 121)
    chosen = thinned(np.zeros(len(q)), MOST_DOTS // 4)
    own, sag = np.zeros_like(grid), np.zeros_like(q[chosen])
    if model.joint_functions is not None:
        coefficients = known.coefficients[place[model.joint_functions.name]]
        own = 1e3 * model.joint_functions.deflection(Poses(known.placed, grid), coefficients)
    if model.gravity is not None:
        standing = Poses(known.placed, q[chosen], None if loads is None else loads[chosen])
        sag = 1e3 * model.gravity.deflection(standing, known.coefficients[place["gravity"]])
    highest = 1.1 * float(max(np.abs(own).max(), np.abs(sag).max())) or 1.0
    charts = []
    for k, turns in enumerate(report.estimate.calibrated.joint_is_revolute):
        unit = "mrad" if turns else "mm"
        chart, at = _by_joint(report.estimate, k, grid, 160, unit, highest, "what turns beyond its reading,")
        marks = []
        if model.gravity is not None:
            marks.append(chart.dots("axial small", joint_factor(bool(turns)) * q[chosen, k], sag[:, k]))
        if model.joint_functions is not None:
            marks.append(chart.line("mean along", at, own[:, k]))
        charts.append(chart.drawing(*marks))
    return charts


# ── correlations ─────────────────────────────────────────────────────────────────────────────────────


def correlation_chart(estimate: Estimate) -> Drawing:
    """A square per pair of identified parameters: blue below zero, orange above, the stronger the darker."""
    free = [i for i, v in enumerate(np.diag(estimate.fit.covariance)) if v > 0]
    std = np.sqrt(np.diag(estimate.fit.covariance)[free])
    matrix = estimate.fit.covariance[np.ix_(free, free)] / np.outer(std, std)
    cell, count, names = 12, len(free), [estimate.fit.parameters[i] for i in free]
    margin = 8 + 6.2 * max(map(len, names), default=0)
    side = margin + cell * count + 2
    shades = np.rint(np.clip(matrix, -1, 1) * SHADES).astype(int)
    shapes = []
    for shade in np.unique(shades[shades != 0]):  # one path per shade
        squares = "".join(
            f"M{margin + cell * j:g} {margin + cell * i:g}h{cell}v{cell}h-{cell}z"
            for i, j in np.argwhere(shades == shade).tolist()
        )
        opacity = f"{abs(int(shade)) / SHADES:g}"
        shapes.append(shape("path", class_="plus" if shade > 0 else "minus", fill_opacity=opacity, d=squares))
    edge = f"{margin - 4:g}"
    for i, name in enumerate(names):
        at = f"{margin + cell * i + 9:g}"
        shapes.append(shape("text", name, x=edge, y=at, text_anchor="end"))
        shapes.append(shape("text", name, transform=f"translate({at} {edge}) rotate(-90)"))
    corner, inner = f"{margin:g}", f"{cell * count}"
    shapes.append(shape("rect", class_="frame", x=corner, y=corner, width=inner, height=inner))
    title, style = f"correlations of {count} parameters", f"max-width:{1.15 * side:.0f}px"
    return Drawing("chart heat", f"{side:g} {side:g}", title, shapes, style)
