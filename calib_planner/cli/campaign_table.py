"""A campaign for people: its verdict and outcome first, then how it went."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner._arrays import FloatArray
from calib_planner.adaptive import CampaignResult, CampaignState
from calib_planner.adaptive.campaign import VALIDATION
from calib_planner.adaptive.result import OUTCOMES, Round
from calib_planner.identification.verdict import counted
from calib_planner.report.quantities import length

STYLES = {"PASS": "bold green", "WARN": "bold yellow", "FAIL": "bold red"}
SCATTER = {
    "": "",
    "as_stated": "as stated",
    "noise": "noise, as repeated",
    "discrepancy": "the robot's own",
    "open": "open: more than stated",
}


def show_result(result: CampaignResult, achieved: FloatArray | None, console: Console) -> None:
    """Print the end of a campaign; ``achieved`` (K,) is the truth of a simulation [m]."""
    console.print(
        f"{result.verdict.level}: {result.outcome.replace('_', ' ')}", style=STYLES[result.verdict.level]
    )
    console.print(f"{result.message}: {OUTCOMES[result.outcome]}.", soft_wrap=True)
    for reason in (r for r in result.verdict.reasons if r.level != "PASS" or "test_pose" in r.code):
        advice = f" → {reason.advice}" if reason.advice else ""
        console.print(f"  {reason.level}  {reason.text}{advice}", soft_wrap=True)
    console.print(rounds_table(result.rounds))
    estimate = result.estimate
    if estimate is not None and estimate.validation is not None:
        v = estimate.validation
        console.print(
            f"Validation on {counted(v.count, 'point')}: {length(v.rms)} achieved, {length(v.predicted_rms)} "
            f"predicted (rms); before calibration {length(v.before_mean)} (mean)."
        )
    if achieved is not None:
        true = ", ".join(length(a) for a in achieved)
        console.print(f"True error at the test poses: {true}; {length(result.accuracy)} predicted.")
    console.print(f"{result.spent} of {counted(result.budget, 'measurement')} spent, "
                  f"{counted(len(result.exclusions), 'configuration')} given up.")  # fmt: skip


def rounds_table(rounds: Sequence[Round]) -> Table:
    """What was known after each batch."""
    table = Table(title="rounds")
    for heading in ("#", "measured", "different", "predicted", "σ", "still needed", "planned"):
        table.add_column(heading, justify="right")
    table.add_column("scatter")
    for r in rounds:
        known = np.isfinite(r.sigma)
        cells = [str(r.measured), str(r.configurations), length(r.accuracy) if known else "–"]
        cells += [length(r.sigma) if known else "–", _left(r.left), str(r.planned)]
        table.add_row(str(r.number), *cells, SCATTER[r.scatter])
    return table


def show_next(state: CampaignState, q: FloatArray, times: Sequence[int], console: Console) -> None:
    """Print what to measure next: configurations ``q`` (m, joints) [rad | m], each ``times``."""
    robot = state.problem.robot
    console.print(f"{state.outcome + ': ' if state.outcome else ''}{state.message}")
    if state.rounds:
        console.print(rounds_table(state.rounds))
    held_out = state.stops[state.queue[0]].role == VALIDATION
    table = Table(title="measure next, for validation" if held_out else "measure next, in this order")
    table.add_column("#", justify="right")
    for name, turns in zip(robot.joint_names, robot.joint_is_revolute, strict=True):
        table.add_column(f"{name}\n[{'°' if turns else 'mm'}]", justify="right")
    table.add_column("measure", justify="right")
    factors = np.where(robot.joint_is_revolute, 180.0 / np.pi, 1e3)
    for i, (row, count) in enumerate(zip(q * factors, times, strict=True), 1):
        table.add_row(str(i), *(f"{v:.2f}" for v in row), f"{count}×")
    console.print(table)


def _left(number: float) -> str:
    if np.isnan(number):
        return "–"
    return f"{number:.0f}" if np.isfinite(number) else "out of reach"
