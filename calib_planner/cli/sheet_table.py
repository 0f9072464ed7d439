"""A plan sheet for the terminal: what the plan promises, its stops, what was checked and what not."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.design.plan_sheet import PlanSheet
from calib_planner.files.plan_sheet_files import WORDS
from calib_planner.report.quantities import duration, length, signed


def show_sheet(sheet: PlanSheet, console: Console) -> None:
    """Print a sheet."""
    plan, checks, times = sheet.plan, sheet.checks, sheet.timetable
    console.print(
        f"Plan {sheet.identity} for {sheet.robot.name}: {plan.measurements} measurements at "
        f"{len(plan.configurations)} stops, about {duration(times.seconds)}"
    )
    console.print(_promise(sheet))
    console.print(_stops(sheet))
    console.print(f"Checked: {', '.join(checks.checked)}. Not checked: {', '.join(checks.unchecked)}.")
    if plan.robot != sheet.robot.name:
        console.print(f"The plan was made for {plan.robot}.", style="yellow")
    for i, broken in enumerate(checks.breaks, 1):
        if broken:
            console.print(f"Stop {i} breaks: {', '.join(broken)}", style="red")


def _promise(sheet: PlanSheet) -> str:
    plan = sheet.plan
    accuracy = (
        f"Expected accuracy ρ0 {length(plan.predicted_accuracy)}" if len(plan.test_poses) else plan.criterion
    )
    if not np.isfinite(plan.efficiency):
        return f"{accuracy}."
    bound = f", lower bound {length(plan.lower_bound)}" if np.isfinite(plan.lower_bound) else ""
    return f"{accuracy}{bound} ({plan.bound}), efficiency {100 * plan.efficiency:.1f} %."


def _stops(sheet: PlanSheet) -> Table:
    table = Table(title="stops, in the order of visiting")
    table.add_column("#", justify="right")
    turns = sheet.robot.joint_is_revolute
    for name, turning in zip(sheet.plan.joint_names, turns, strict=True):
        table.add_column(f"{name}\n[{'°' if turning else 'mm'}]", justify="right", overflow="fold")
    for heading in ("times", "travel\nmax", "reach", "visible"):
        table.add_column(heading, justify="right", overflow="fold")
    visible = sheet.checks.visible
    for i, row in enumerate(sheet.degrees):
        table.add_row(
            str(i + 1),
            *(signed(v, 3) for v in row),
            f"{sheet.plan.repetitions[i]}×",
            _travel(sheet, i),
            WORDS[bool(sheet.checks.reachable[i])],
            WORDS[None if visible is None else bool(visible[i])],
        )
    return table


def _travel(sheet: PlanSheet, i: int) -> str:
    """The longest way of a joint to stop i, in what people read."""
    if np.isnan(sheet.timetable.travel[i]).any():
        return "–"
    turns = sheet.robot.joint_is_revolute
    ways = [(t, sheet.total_travel(True, t)[i]) for t in (True, False) if (turns == t).any()]
    return "\n".join(f"{np.degrees(w):.1f}°" if t else f"{1e3 * w:.1f} mm" for t, w in ways)
