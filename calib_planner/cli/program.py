# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner program``: a plan as the program of a robot's controller."""

from __future__ import annotations

import argparse
import sys
from functools import partial

import numpy as np
from rich.console import Console

from calib_planner.arrays import FloatArray, plain
from calib_planner.cli.arguments import (
    Commands,
    add_command,
    add_robot,
    load_planned_robot,
    numbers,
    option,
    rows,
)
from calib_planner.cli.terminal import Terminal
from calib_planner.io import (
    HANDSHAKES,
    SETTLE,
    SPEED_SHARE,
    ProgramFormat,
    ProgramSettings,
    angle_factors,
    controller_axes,
    program_formats,
    program_name,
    program_text,
    read_constraints,
    read_plan,
    read_program_format,
    write_text,
)
from calib_planner.planning import PlanSheet, plan_sheet
from calib_planner.robot import Robot
from calib_planner.units import counted, joint_unit, joint_value

EXAMPLE = """calib-planner program plan.yaml --for krl --output visits.src
  calib-planner program plan.yaml --for fanuc --handshake io --ready 5 --done 7 --output visits.ls"""


def add(commands: Commands, summary: str) -> None:
    text = (
        "Write a program that moves the robot to every visit of a plan, slowly, and waits there to be measured.\n"
    )
    text += (
        "Nothing is written if a visit breaks a limit. Nobody has checked the moves between the visits: run the\n"
    )
    text += "program at reduced speed first, hand on the stop. Without --output it goes to stdout."
    parser = add_command(commands, "program", summary, run, EXAMPLE, text)
    parser.add_argument("plan", metavar="PLAN", help="plan .yaml, written by plan --output")
    form = parser.add_mutually_exclusive_group(required=True)
    option(form, "--for", "NAME", f"the controller: {', '.join(program_formats())}", dest="form")
    option(form, "--template", "FILE", "a template of your own, .j2 (see config/programs)", dest="form")
    option(parser, "--output", "FILE", "the program's file")
    add_robot(parser, "the plan's, if it is a shipped one", targets=False)
    option(parser, "--constraints", "FILE", "YAML: what every visit has to keep, besides the joint limits")
    at_rest = parser.add_argument_group("at each visit")
    text = "pause: a person confirms on the screen; io: a handshake of signals for each measurement"
    option(at_rest, "--handshake", None, text, HANDSHAKES[0], choices=HANDSHAKES)
    option(at_rest, "--ready", "SIGNAL", "output that is on while the robot stands and waits (the template's)")
    option(at_rest, "--done", "SIGNAL", "input that is on once the point is measured (the template's)")
    option(at_rest, "--settle", "S", "standstill before a measurement [s]", SETTLE)
    more = parser.add_argument_group("the program")
    option(more, "--name", "NAME", "the program's name (cal_ and four digits of the plan)")
    option(more, "--speed-share", "F", "speed as a share of the largest, 0 … 1", SPEED_SHARE)
    option(more, "--tool", "T", "number or name of the tool on the controller (the template's)")
    axes = parser.add_argument_group("the controller's axes: sign · joint + zero")
    option(axes, "--signs", '"s1 … sn"', "1 or -1 for each joint (1)", kind=numbers)
    option(
        axes, "--zeros", '"z1 … zn"', "what the controller shows where the joint is 0 [rad | m] (0)", kind=numbers
    )
    text = "what axis 3 has of axis 2: -1 if axis 3 counts from the horizontal (the template's)"
    option(axes, "--coupling", "C", text, kind=float)


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    form = read_program_format(args.form)
    plan = read_plan(args.plan)
    robot = load_planned_robot(args, plan.robot)
    constraints = () if args.constraints is None else read_constraints(args.constraints, robot)
    sheet = plan_sheet(plan, robot, constraints)
    settings = _settings(args, robot)
    text = program_text(sheet, form, settings)
    axes = controller_axes(sheet, form, settings)
    result = {
        "format": form.name,
        "title": form.title,
        "name": program_name(sheet, form, settings),
        "id": sheet.identity,
        "visits": len(axes),
        "measurements": plan.measurements,
        "axes": axes,
        "output": args.output,
    }
    if args.output:
        write_text(args.output, text, "--output")
        terminal.answer(plain(result), partial(show_program, sheet, form, axes, args.output))
    elif terminal.json_wanted:
        terminal.answer(plain(result | {"program": text}), lambda console: None)
    else:
        sys.stdout.write(text)


def _settings(args: argparse.Namespace, robot: Robot) -> ProgramSettings:
    names, factors = robot.joint_names, angle_factors(robot, degrees=args.degrees)
    return ProgramSettings(
        name=args.name or "",
        handshake=args.handshake,
        ready=args.ready,
        done=args.done,
        tool=args.tool,
        speed_share=args.speed_share,
        settle=args.settle,
        signs=None if args.signs is None else rows("--signs", [args.signs], names)[0],
        zeros=None if args.zeros is None else rows("--zeros", [args.zeros], names)[0] * factors,
        coupling=args.coupling,
    )


def show_program(sheet: PlanSheet, form: ProgramFormat, axes: FloatArray, output: str, console: Console) -> None:
    """Say what was written and what is to be compared on the controller before it runs."""
    visits = f"{counted(len(axes), 'visit')}, {counted(sheet.plan.measurements, 'measurement')}"
    console.print(f"Plan {sheet.identity} for {form.title}: {visits}, in {output}")
    turns = sheet.robot.joint_is_revolute
    shown = [f"{joint_value(q, t, 3)} {joint_unit(t)}" for q, t in zip(axes[0], turns, strict=True)]
    console.print(f"Visit 1 on the controller's axes: {', '.join(shown)}")
    console.print(
        "Compare signs and zeros before it runs: jog one joint at a time and read the controller. "
        f"Not checked: {', '.join(sheet.checks.unchecked)}.",
        style="yellow",
    )
    if not np.all(sheet.checks.visible if sheet.checks.visible is not None else True):
        console.print("Not every visit is visible for the tracker: see calib-planner sheet.", style="red")
