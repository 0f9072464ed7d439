# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""An estimate for people: the verdict with reasons, before → after, predicted against achieved, then details.

Long lists are cut; the files and ``--json`` hold all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from calib_planner.error_model import MEANINGS
from calib_planner.identification import Estimate, LeftOutError, Reason, Validation
from calib_planner.measurements import RejectedPoint
from calib_planner.robot import is_nuisance
from calib_planner.units import counted, length, milli, signed

SHOWN = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}
STYLES = {"PASS": "bold green", "WARN": "bold yellow", "FAIL": "bold red"}
WORDS = {
    "PASS": "PASS: no reason to distrust this calibration",
    "WARN": "WARN: usable, but look at the reasons",
    "FAIL": "FAIL: do not rely on this calibration",
}
HEADINGS = ("count", "mean before", "mean after", "rms", "max", "rms predicted", "in 95 %")
MOST_POINTS = 10
MOST_COMBINATIONS = 8
MOST_POSES = 6


def show_estimate(estimate: Estimate, console: Console, where: Callable[[int], str] | None = None) -> None:
    """Print an estimate; ``where`` says in which line of which file a row of the data stands."""
    _show_verdict(estimate, console)
    console.print(_distances(estimate))
    console.print(_noise(estimate), soft_wrap=True)
    console.print(_terms(estimate))
    if len(estimate.accuracy.test_poses):
        console.print(_accuracy(estimate), soft_wrap=True)
    console.print(_counts(estimate), soft_wrap=True)
    console.print(_parameters(estimate))
    combinations = [
        f"{n}: {c}"
        for n, c in zip(estimate.observability.fixed, estimate.observability.unidentifiable, strict=True)
    ]
    _show_list(console, "Held at nominal; these combinations cannot be seen:", combinations)
    _show_list(console, "Decided by the prior; the data cannot see:", estimate.observability.resolved_by_prior)
    _show_list(console, "Hardly seen by the data, weakest first:", estimate.observability.nearly_dependent)
    _show_points(console, "Rejected", estimate.points.rejected, where)
    _show_points(console, "Used, but far off", estimate.points.suspects, where)
    _show_remarks(estimate, console)


# ── is it good? ──────────────────────────────────────────────────────────────────────────────────────


def _show_verdict(estimate: Estimate, console: Console) -> None:
    """The level and its foremost reasons; the rest stands at the end."""
    verdict = estimate.verdict
    console.print(WORDS[verdict.level], style=STYLES[verdict.level])
    for reason in verdict.foremost:
        console.print(Padding(_reason(reason), (0, 0, 0, 2)))
    if verdict.further:
        more = f"{counted(len(verdict.further), 'more remark')} at the end"
        console.print(Padding(Text(more, style="dim"), (0, 0, 0, 2)))


def _show_remarks(estimate: Estimate, console: Console) -> None:
    """The reasons that the first screen does not show."""
    if estimate.verdict.further:
        console.print("Further remarks:")
    for reason in estimate.verdict.further:
        console.print(Padding(_reason(reason), (0, 0, 0, 2)))


def _reason(reason: Reason) -> Text:
    label = "note" if reason.level == "PASS" else reason.level
    text = Text(f"{label}  ", style="dim" if reason.level == "PASS" else STYLES[reason.level])
    text.append(reason.text, style="not dim not bold default")
    if reason.advice:
        text.append(f" → {reason.advice}", style="not bold italic default")
    return text


def _distances(estimate: Estimate) -> Table:
    """Before → after, predicted → achieved: for the data and for what was held out."""
    table = Table(title="distance between measured and predicted points [mm]")
    table.add_column("points", no_wrap=True)
    for heading in HEADINGS:
        table.add_column(heading, justify="right")
    before, after = estimate.residuals.before, estimate.residuals.after
    cells = [milli(before.mean), milli(after.mean), milli(after.rms), milli(after.max)]
    table.add_row("fitted", str(estimate.points.used), *cells)
    systematic = len(estimate.knowledge.model.systematic) > 1
    if systematic:
        alone = estimate.residuals.placement_alone
        cells = ["", milli(alone.mean), milli(alone.rms), milli(alone.max)]
        table.add_row("… placement alone", "", *cells)
    _add_left_out(table, "left out, visit by visit", estimate.left_out)
    if systematic:
        _add_left_out(table, "… placement alone", estimate.placement_alone)
    if estimate.validation is not None:
        v = estimate.validation
        table.add_row("held out", str(v.count), *_held_out(v))
        if systematic:
            cells = ["", milli(v.placement_mean), milli(v.placement_rms)]
            table.add_row("… placement alone", "", *cells)
    return table


def _add_left_out(table: Table, label: str, left: LeftOutError) -> None:
    lengths = [milli(v) for v in (left.rms, left.max, left.predicted_rms)]
    table.add_row(label, str(left.count), "", milli(left.mean), *lengths, "")


def _held_out(v: Validation) -> list[str]:
    lengths = (v.before_mean, v.mean, v.rms, v.max, v.predicted_rms)
    inside = f"{100 * v.within_95:.0f} %" if np.isfinite(v.within_95) else "unknown"
    return [*(milli(v) for v in lengths), inside]


def _terms(estimate: Estimate) -> Table:
    """How large each term is at the measured points, and what it means."""
    table = Table(title="error model: what moves the measured points, rms [mm]")
    for heading in ("term", "size", "± std", "gain", "what it means"):
        table.add_column(heading, justify="left" if heading in ("term", "what it means") else "right")
    for term in estimate.terms:
        size = milli(term.size) if term.used else "left out"
        std = milli(term.std) if np.isfinite(term.std) else ""
        gain = f"{term.gain:+.1f}" if np.isfinite(term.gain) else ""
        table.add_row(term.name, size, std, gain, MEANINGS[term.name], style="" if term.used else "dim")
    table.caption = "gain: log score of visits predicted from the others, with the term less without it"
    return table


def _noise(estimate: Estimate) -> str:
    """Noise of a point, in one line."""
    noise = estimate.noise
    return f"Noise per coordinate of a point: {length(noise.sigma)} ({estimate.noise_source})."


def _accuracy(estimate: Estimate) -> str:
    per = estimate.accuracy.predicted
    shown = ", ".join(length(v) for v in per[:MOST_POSES]) + _more(len(per), MOST_POSES)
    text = f"Predicted error at the test pose{'s' if len(per) > 1 else ''}: {shown}"
    own, alone = estimate.accuracy.parameters, estimate.accuracy.placement
    if np.isfinite(own).all():
        parts = [length(float(np.sqrt(np.mean(v**2)))) for v in (own, alone)]
        text += f" (parameters: {parts[0]}; with placement alone: {parts[1]})"
    if estimate.accuracy.frame == "robot":
        text += ", up to a new registration of the robot"
    required = estimate.accuracy.required
    return text + (f"; required: {length(required)}" if np.isfinite(required) else "")


# ── the details ──────────────────────────────────────────────────────────────────────────────────────


def _counts(estimate: Estimate) -> str:
    fit, sight, points = estimate.fit, estimate.observability, estimate.points
    text = f"{fit.status}: {sight.rank} of {len(fit.parameters)} parameters from {points.used} points"
    if points.used < points.measured:
        text += f" of {points.measured}"
    return text + (f", prior: {sight.prior}." if sight.prior else ", no prior.")


def _parameters(estimate: Estimate) -> Table:
    table = Table(title="parameters")
    for heading in ("parameter", "unit", "nominal", "identified", "deviation", "± std", "remark"):
        left = heading in ("parameter", "unit", "remark")
        table.add_column(heading, justify="left" if left else "right")
    remarks = _remarks(estimate)
    columns = (estimate.fit.nominal, estimate.fit.values, estimate.fit.deviations, estimate.fit.std)
    for name, unit, *numbers in zip(estimate.fit.parameters, estimate.fit.units, *columns, strict=True):
        label, factor = SHOWN[unit]
        nominal, value, deviation, std = (factor * v for v in numbers)
        fixed = name in estimate.observability.fixed
        change = ["", ""] if fixed else [signed(deviation, 4, plus=True), f"{std:.4f}"]
        table.add_row(
            name,
            label,
            signed(nominal, 4),
            signed(value, 4),
            *change,
            remarks.get(name, ""),
            style="dim" if fixed else "",
        )
    if any(map(is_nuisance, estimate.fit.parameters)):
        table.caption = "nominal of an unknown base or target: its closed-form start"
    return table


def _remarks(estimate: Estimate) -> dict[str, str]:
    """Fixed, or with which other parameter most strongly correlated."""
    remarks = dict.fromkeys(estimate.observability.fixed, "fixed")
    for a, b, correlation in estimate.fit.correlations:  # strongest first
        for one, other in ((a, b), (b, a)):
            remarks.setdefault(one, f"correlated {correlation:+.3f} with {other}")
    return remarks


def _show_list(console: Console, title: str, lines: Sequence[str]) -> None:
    if lines:
        console.print(title)
        for line in lines[:MOST_COMBINATIONS]:
            console.print(f"  {line}", soft_wrap=True)
        if len(lines) > MOST_COMBINATIONS:
            console.print(f" {_more(len(lines), MOST_COMBINATIONS)}")


def _show_points(
    console: Console, title: str, points: Sequence[RejectedPoint], where: Callable[[int], str] | None
) -> None:
    """Points with reasons, farthest first."""
    if not points:
        return
    console.print(f"{title}: {counted(len(points), 'point')}, farthest first (rows count from 0)")
    for point in sorted(points, key=lambda p: -p.normalised_residual)[:MOST_POINTS]:
        place = f" ({where(point.row)})" if where else ""
        console.print(f"  row {point.row}, target {point.target}{place}: {point.reason}", soft_wrap=True)
    if len(points) > MOST_POINTS:
        console.print(f" {_more(len(points), MOST_POINTS)}")


def _more(count: int, shown: int) -> str:
    return f" … and {count - shown} more (all in --json)" if count > shown else ""
