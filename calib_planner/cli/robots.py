"""``calib-planner robots``: which robots there are, and what each has."""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console
from rich.table import Table

from calib_planner.arrays import plain
from calib_planner.cli.arguments import Commands, add_command, add_links, add_seed
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import InputError
from calib_planner.io import shipped_robots
from calib_planner.robot import Robot
from calib_planner.units import joint_unit, joint_value, milli

EXAMPLE = "calib-planner robots show kuka_kr270"


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser, and those of list and show."""
    parser = add_command(commands, "robots", summary, run_list, EXAMPLE, cell=False)
    add_seed(parser)
    actions = parser.add_subparsers(dest="action", metavar="list|show")
    example = "calib-planner robots list --json"
    add_command(actions, "list", "list the shipped robots", run_list, example, cell=False)
    show = add_command(
        actions,
        "show",
        "show a robot's joints, parameters and targets",
        run_show,
        EXAMPLE,
        "Show a robot's joints, parameters (the names for --parameters) and targets.\n"
        "Shown in degrees and mm; with --json in radians and m.",
    )
    text = "name of a shipped robot, robot YAML or URDF (the cell's)"
    show.add_argument("robot", metavar="R", nargs="?", help=text)
    add_links(show)


def run_list(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work of list."""
    robots = [Robot.load(name) for name in shipped_robots()]
    rows: list[dict[str, Any]] = [
        {"name": r.name, "joints": len(r.joint_names), "parameters": list(r.parameter_names)} for r in robots
    ]

    def show(console: Console) -> None:
        table = Table("robot", "joints", "parameters")
        for row in rows:
            table.add_row(row["name"], str(row["joints"]), ", ".join(row["parameters"]))
        console.print(table)

    terminal.answer({"robots": rows}, show)


def run_show(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work of show."""
    if args.robot is None:
        raise InputError("R", "nothing", "a robot", "give its name or file, or --cell")
    robot = Robot.load(args.robot, base_link=args.base_link, tip_link=args.tip_link)
    terminal.answer(describe(robot), lambda console: _show(robot, console))


def describe(robot: Robot) -> dict[str, Any]:
    """Plain values, SI units."""
    everything = robot.with_parameters(robot.available_parameters).parameters
    result: dict[str, Any] = plain(
        {
            "name": robot.name,
            "joint_names": robot.joint_names,
            "joint_limits": robot.joint_limits,
            "joint_units": ["rad" if turns else "m" for turns in robot.joint_is_revolute],
            "targets": robot.target_offsets,
            "parameters": robot.parameter_names,
            "levels": dict(robot.levels),
            "available_parameters": [{"name": p.name, "unit": p.unit, "nominal": p.nominal} for p in everything],
        }
    )
    return result


def _show(robot: Robot, console: Console) -> None:
    console.print(f"{robot.name}: {len(robot.joint_names)} joints, {len(robot.targets)} target(s)")
    joints = Table("joint", "unit", title="joints, in this order")
    joints.add_column("lower", justify="right")
    joints.add_column("upper", justify="right")
    for name, turns, limits in zip(robot.joint_names, robot.joint_is_revolute, robot.joint_limits, strict=True):
        joints.add_row(name, joint_unit(turns), *(joint_value(v, turns) for v in limits))
    console.print(joints)
    parameters = Table("parameter", "unit", "levels", title="parameters unless --parameters says otherwise")
    parameters.add_column("nominal", justify="right")
    for p in robot.parameters:
        levels = [k for k, names in robot.levels.items() if p.name in names]
        unit = "mm" if p.unit == "m" else "mrad"
        parameters.add_row(p.name, unit, ", ".join(levels), milli(p.nominal))
    console.print(parameters)
    levels = [f"{k} ({len(names)})" for k, names in robot.levels.items() if names]
    console.print(f"Levels for --parameters: {', '.join(levels)}")
    more = [n for n in robot.available_parameters if n not in robot.parameter_names]
    console.print(f"Further parameters: {', '.join(more)}")
