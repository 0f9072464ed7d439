"""``calib-planner sheet``: a plan as the person at the robot needs it — page, tables, trajectory."""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.arrays import FloatArray, check_number, plain
from calib_planner.cli.arguments import Commands, add_command, add_robot, load_robot, numbers
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import FileFormatError, InputError
from calib_planner.io import (
    URDF_SUFFIXES,
    WORDS,
    angle_factors,
    make_folder,
    read_constraints,
    read_instrument,
    read_plan,
    read_speed_limits,
    write_sheet_csv,
    write_sheet_yaml,
    write_trajectory,
)
from calib_planner.planning import DWELL, Pace, PlanSheet, plan_sheet, usual_pace
from calib_planner.report import write_sheet_page
from calib_planner.robot import Robot
from calib_planner.units import duration, length, signed

EXAMPLE = """calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" --configurations 6 \\
      --constraints config/constraints.yaml --output plan.yaml
  calib-planner sheet --plan plan.yaml --constraints config/constraints.yaml --output sheet"""
SHARE = 0.25
FILES = ("plan_sheet.html", "plan_sheet.csv", "plan_sheet.yaml", "trajectory.yaml")


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    text = (
        "Everything a person at the robot needs to measure a plan: with --output a printable page, CSV, YAML and "
    )
    text += "a trajectory_msgs/JointTrajectory as YAML.\nWhat was not checked is called so."
    parser = add_command(commands, "sheet", summary, run, EXAMPLE, text)
    parser.add_argument("--plan", required=True, metavar="FILE", help="plan .yaml, of plan --output")
    add_robot(parser, "the plan's, if it is a shipped one")
    known = parser.add_argument_group("what is to be checked")
    known.add_argument("--constraints", metavar="FILE", help="YAML: the plan's constraints, or others")
    known.add_argument(
        "--instrument", metavar="FILE", help="YAML: where the tracker stands, if constraints do not say"
    )
    time = parser.add_argument_group("travel and time")
    time.add_argument(
        "--start", type=numbers, metavar='"q1 … qn"', help="where the robot stands before [rad | m]"
    )
    speed = time.add_mutually_exclusive_group()
    speed.add_argument("--speed", type=float, metavar="V", help="of every joint, at most [rad/s | m/s]")
    speed.add_argument(
        "--speed-share",
        type=float,
        default=SHARE,
        metavar="F",
        help=f"share of the URDF's speed limits, 0 … 1 ({SHARE:g}; 0.5 rad/s, 0.1 m/s without limits)",
    )
    time.add_argument(
        "--dwell", type=float, default=DWELL, metavar="S", help=f"standstill per measurement [s] ({DWELL:g})"
    )
    parser.add_argument("--output", metavar="DIR", help=f"folder for {', '.join(FILES)}")


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    if not args.plan.lower().endswith((".yaml", ".yml")):
        advice = "a CSV of configurations carries no accuracy; write the plan with --output plan.yaml"
        raise FileFormatError(args.plan, "file", "another kind of file", "a plan .yaml", advice)
    plan = read_plan(args.plan)
    args.robot = plan.robot if args.robot is None else args.robot
    robot = load_robot(args)
    sheet = plan_sheet(
        plan,
        robot,
        () if args.constraints is None else read_constraints(args.constraints, robot),
        None if args.instrument is None else read_instrument(args.instrument),
        pace=_pace(robot, args),
        start=_start(robot, args),
    )
    written = write_sheet(args.output, sheet, terminal) if args.output else []
    result = sheet.to_dict() | ({"output": args.output, "files": written} if args.output else {})
    terminal.answer(plain(result), partial(show_sheet, sheet))
    if written:
        terminal.note(f"In {args.output}: {', '.join(written)}")


def write_sheet(folder: str, sheet: PlanSheet, terminal: Terminal, field: str = "--output") -> list[str]:
    """Write all files of a sheet into ``folder``; returns their names.

    No trajectory is written to a stop that is not reachable; an older one in the folder is removed.

    Raises:
        InputError: The folder cannot be made or written to; names ``field``.
    """
    target, reachable = make_folder(folder, field), bool(sheet.checks.reachable.all())
    if not reachable:
        (target / FILES[3]).unlink(missing_ok=True)
    writers = (write_sheet_page, write_sheet_csv, write_sheet_yaml, write_trajectory)
    written = FILES if reachable else FILES[:3]
    for name, write in zip(written, writers, strict=False):
        write(target / name, sheet, field)
    if len(written) < len(FILES):
        terminal.note("No trajectory was written: not every stop is reachable.")
    return list(written)


def robot_pace(robot: Robot, dwell: float = DWELL, share: float = SHARE) -> Pace:
    """A share of the speed limits in the robot's URDF, or assumed speeds where there are none."""
    usual, path = usual_pace(robot, dwell), Path(robot.source)
    limits = read_speed_limits(path, robot.joint_names) if path.suffix.lower() in URDF_SUFFIXES else None
    if limits is None:
        return usual
    return replace(usual, speeds=share * limits, origin=f"at most {share:.3g} of the URDF's speed limits")


def _pace(robot: Robot, args: argparse.Namespace) -> Pace:
    """Speeds as asked for, or the robot's."""
    dwell = check_number("--dwell", args.dwell, low=0, high=86_400, unit="s")
    if args.speed is not None:
        speed = check_number("--speed", args.speed, low=0, low_open=True, high=100.0, unit="rad/s or m/s")
        return Pace(np.full(len(robot.joint_names), speed), dwell, f"at most {speed:g} rad/s or m/s")
    share = check_number("--speed-share", args.speed_share, low=0, low_open=True, high=1.0)
    return robot_pace(robot, dwell, share)


def _start(robot: Robot, args: argparse.Namespace) -> FloatArray | None:
    if args.start is None:
        return None
    if len(args.start) != len(robot.joint_names):
        wanted = f"{len(robot.joint_names)} numbers: {', '.join(robot.joint_names)}"
        raise InputError("--start", f"{len(args.start)} numbers", wanted)
    if not np.isfinite(args.start).all():
        raise InputError("--start", "a number that is not finite", "finite numbers", "correct that number")
    return np.array(args.start) * angle_factors(robot, degrees=args.degrees)


# ── A plan sheet for the terminal: what the plan promises, its stops, what was checked and what not ─────────


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
    quality = sheet.plan.quality
    accuracy = quality.criterion
    if len(sheet.plan.test_poses):
        accuracy = f"Expected accuracy ρ0 {length(quality.predicted_accuracy)}"
    if not np.isfinite(quality.efficiency):
        return f"{accuracy}."
    bound = f", lower bound {length(quality.lower_bound)}" if np.isfinite(quality.lower_bound) else ""
    return f"{accuracy}{bound} ({quality.bound}), efficiency {100 * quality.efficiency:.1f} %."


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
