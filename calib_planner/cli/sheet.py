# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner sheet``: a plan as the person at the robot needs it — page, tables, trajectory."""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.arrays import plain
from calib_planner.cli.arguments import (
    Commands,
    add_command,
    add_pace,
    add_robot,
    chosen_pace,
    load_planned_robot,
    option,
    start_of,
)
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import FileFormatError
from calib_planner.io import (
    SHEET_FILES,
    WORDS,
    read_constraints,
    read_instrument,
    read_plan,
)
from calib_planner.planning import PlanSheet, plan_sheet
from calib_planner.units import duration, joint_unit, length, signed

EXAMPLE = """calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" --configurations 6 \\
      --constraints config/constraints.yaml --output plan.yaml
  calib-planner sheet --plan plan.yaml --constraints config/constraints.yaml --output sheet"""


def add(commands: Commands, summary: str) -> None:
    text = (
        "Write everything that a person at the robot needs to measure a plan: with --output a printable page,\n"
    )
    text += "CSV, YAML and a trajectory_msgs/JointTrajectory as YAML. The sheet says what was not checked."
    parser = add_command(commands, "sheet", summary, run, EXAMPLE, text)
    option(parser, "--plan", "FILE", "plan .yaml, written by plan --output", required=True)
    add_robot(parser, "the plan's, if it is a shipped one")
    known = parser.add_argument_group("what is to be checked")
    option(known, "--constraints", "FILE", "YAML: the plan's constraints, or others")
    option(known, "--instrument", "FILE", "YAML: where the tracker stands, if the constraints do not say")
    add_pace(parser)
    option(parser, "--output", "DIR", f"folder for {', '.join(SHEET_FILES)}")


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    if not args.plan.lower().endswith((".yaml", ".yml")):
        advice = "a CSV of configurations carries no accuracy; write the plan with --output plan.yaml"
        raise FileFormatError(args.plan, "file", "another kind of file", "a plan .yaml", advice)
    plan = read_plan(args.plan)
    robot = load_planned_robot(args, plan.robot)
    sheet = plan_sheet(
        plan,
        robot,
        () if args.constraints is None else read_constraints(args.constraints, robot),
        None if args.instrument is None else read_instrument(args.instrument),
        pace=chosen_pace(robot, args),
        start=start_of(robot, args),
    )
    written: list[str] = []
    if args.output:
        from calib_planner.report import write_sheet  # 0.1 s for templates, which only a sheet waits for

        written = write_sheet(args.output, sheet, "--output")
        tell_sheet(written, terminal)
    result = sheet.to_dict() | ({"output": args.output, "files": written} if args.output else {})
    terminal.answer(plain(result), partial(show_sheet, sheet))
    if written:
        terminal.note(f"In {args.output}: {', '.join(written)}")


def tell_sheet(written: list[str], terminal: Terminal) -> None:
    """Say so if the sheet came without its trajectory."""
    if len(written) < len(SHEET_FILES):
        terminal.note("No trajectory was written: not every configuration is reachable.")


# ── a plan sheet for the terminal: what the plan promises, its visits, what was checked and what not ───────


def show_sheet(sheet: PlanSheet, console: Console) -> None:
    """Print a sheet."""
    plan, checks, times = sheet.plan, sheet.checks, sheet.timetable
    console.print(
        f"Plan {sheet.identity} for {sheet.robot.name}: {plan.measurements} measurements at "
        f"{len(plan.configurations)} visits, about {duration(times.seconds)}"
    )
    console.print(_promise(sheet))
    console.print(_visits(sheet))
    console.print(f"Checked: {', '.join(checks.checked)}. Not checked: {', '.join(checks.unchecked)}.")
    if plan.robot != sheet.robot.name:
        console.print(f"The plan was made for {plan.robot}.", style="yellow")
    for i, broken in enumerate(checks.breaks, 1):
        if broken:
            console.print(f"Visit {i} breaks: {', '.join(broken)}", style="red")


def _promise(sheet: PlanSheet) -> str:
    quality = sheet.plan.quality
    accuracy = quality.criterion
    if len(sheet.plan.test_poses):
        accuracy = f"Expected accuracy ρ0 {length(quality.predicted_accuracy)}"
    if not np.isfinite(quality.efficiency):
        return f"{accuracy}."
    bound = f", lower bound {length(quality.lower_bound)}" if np.isfinite(quality.lower_bound) else ""
    return f"{accuracy}{bound} ({quality.bound}), efficiency {100 * quality.efficiency:.1f} %."


def _visits(sheet: PlanSheet) -> Table:
    table = Table(title="visits, in their order")
    table.add_column("#", justify="right")
    turns = sheet.robot.joint_is_revolute
    for name, turning in zip(sheet.plan.joint_names, turns, strict=True):
        table.add_column(f"{name}\n[{joint_unit(turning)}]", justify="right", overflow="fold")
    visible = sheet.checks.visible  # a column of nothing but "not checked" is left to the line below the table
    for heading in ("times\nmin:s", "travel\nmax", "reach", "visible")[: 3 if visible is None else 4]:
        table.add_column(heading, justify="right", overflow="fold")
    for i, row in enumerate(sheet.degrees):
        arrival = round(sheet.timetable.arrive[i])
        table.add_row(
            str(i + 1),
            *(signed(v, 3) for v in row),
            f"{sheet.plan.repetitions[i]}×\n{arrival // 60}:{arrival % 60:02d}",
            _travel(sheet, i),
            WORDS[bool(sheet.checks.reachable[i])],
            *(() if visible is None else (WORDS[bool(visible[i])],)),
        )
    return table


def _travel(sheet: PlanSheet, i: int) -> str:
    """The longest way of a joint to visit i, in degrees or mm."""
    if np.isnan(sheet.timetable.travel[i]).any():
        return "–"
    turns = sheet.robot.joint_is_revolute
    ways = [(t, sheet.total_travel(True, t)[i]) for t in (True, False) if (turns == t).any()]
    return "\n".join(f"{np.degrees(w):.1f}°" if t else f"{1e3 * w:.1f} mm" for t, w in ways)
