"""An estimate for people: the verdict, the distances before and after, then parameter by parameter."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.identification.estimate import Estimate
from calib_planner.report.quantities import length

SHOWN = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}


def show_estimate(estimate: Estimate, console: Console) -> None:
    """Print an estimate."""
    style = "green" if estimate.status == "ok" else "yellow"
    console.print(f"{estimate.status}: {estimate.message}", style=style)
    console.print(_distances(estimate))
    console.print(_precision(estimate))
    if estimate.test_poses.size:
        per = ", ".join(length(v) for v in estimate.predicted_accuracy_per_test_pose)
        console.print(f"Predicted accuracy ρ0 at the test pose: {per}")
    console.print(_parameters(estimate))
    if estimate.held:
        console.print("Not identifiable from these data (sum that cannot be seen; the first one is held):")
        for name, combination in zip(estimate.held, estimate.unidentifiable, strict=True):
            console.print(f"  {name}: {combination}", soft_wrap=True)
    for row in estimate.rejected:
        console.print(f"Rejected: row {row['row']}, target {row['target']}: {row['reason']}")


def _distances(estimate: Estimate) -> Table:
    """Before → after, for the data and for what was held out."""
    table = Table(title="distance between measured and predicted points [mm]")
    for heading in ("points", "count", "before: mean", "after: mean", "rms", "max"):
        table.add_column(heading, justify="left" if heading == "points" else "right")
    before, after = estimate.residual_before, estimate.residual_after
    values = (before.mean, after.mean, after.rms, after.max)
    table.add_row("fitted", str(estimate.used), *(_mm(v) for v in values))
    held_out = estimate.validation
    if held_out is not None:
        values = (held_out.before_mean, held_out.mean, held_out.rms, held_out.max)
        table.add_row("held out", str(held_out.count), *(_mm(v) for v in values))
    return table


def _precision(estimate: Estimate) -> str:
    text = f"{estimate.rank} of {len(estimate.parameters)} parameters from {estimate.used} points. "
    if not np.isfinite(estimate.sigma_estimate):
        return text + "No redundancy: the residuals say nothing about the noise."
    return text + f"One coordinate scatters with σ = {length(estimate.sigma_estimate)} about the fit."


def _parameters(estimate: Estimate) -> Table:
    table = Table(title="parameters")
    for heading in ("parameter", "unit", "nominal", "identified", "deviation", "± std"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    rows = zip(
        estimate.parameters,
        estimate.units,
        estimate.nominal,
        estimate.values,
        estimate.deviations,
        estimate.std,
        strict=True,
    )
    for name, unit, nominal, value, deviation, std in rows:
        label, factor = SHOWN[unit]
        held = name in estimate.held
        numbers = [f"{factor * v:.4f}" for v in (nominal, value)]
        change = ["held", ""] if held else [f"{factor * deviation:+.4f}", f"{factor * std:.4f}"]
        table.add_row(name, label, *numbers, *change)
    return table


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.4f}"
