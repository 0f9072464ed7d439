# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner robots``: which robots there are, and what each has."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.arrays import plain
from calib_planner.cli.arguments import Commands, add_command, add_couple, add_links, add_seed, option
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import InputError
from calib_planner.io import UrdfChain, read_chain, shipped_robots
from calib_planner.robot import Robot, joint_origins, roll_pitch_yaw
from calib_planner.units import counted, joint_unit, joint_value, listed, milli

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
    add_couple(show)
    text = "draw the chain at zero and in the middle of its range: .svg or .png"
    option(show, "--drawing", "FILE", text)


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
    if args.couple:
        robot = robot.with_couplings(args.couple, "--couple")
    chain = read_chain(robot.source, args.base_link, args.tip_link) if robot.from_urdf else None
    if args.drawing:
        from calib_planner.report import draw_robot  # 0.1 s, for this option alone

        draw_robot(args.drawing, robot, "--drawing")
    answer = describe(robot, chain) | {"drawing": args.drawing}
    terminal.answer(answer, lambda console: _show(robot, answer, console))
    if args.drawing:
        terminal.note(f"Drawing written to {args.drawing}")


def describe(robot: Robot, chain: UrdfChain | None = None) -> dict[str, Any]:
    """Plain values, SI units; ``chain`` is what the URDF says beside the robot."""
    everything = robot.with_parameters(robot.available_parameters).parameters
    origins = joint_origins(robot)
    limits = robot.joint_limits if robot.motion_limits is None else robot.motion_limits
    kinds = {j.name: j.type for j in chain.joints} if chain else {}
    joints = [
        {
            "name": name,
            "type": kinds.get(name, "revolute" if turns else "prismatic"),
            "axis": origins.axes[name],
            "limits": limits[i],
            "xyz": origins.joints[name].xyz,
            "rpy": origins.joints[name].rpy,
        }
        for i, (name, turns) in enumerate(zip(robot.joint_names, robot.joint_is_revolute, strict=True))
    ]
    carrying = {part.joint for part in robot.link_masses if part.mass > 0.0}
    zero = robot.with_base(np.eye(3), np.zeros(3)).posture(np.zeros((1, len(joints))))
    result: dict[str, Any] = plain(
        {
            "name": robot.name,
            "joint_names": robot.joint_names,
            "joint_limits": robot.joint_limits,
            "joint_units": ["rad" if turns else "m" for turns in robot.joint_is_revolute],
            "joints": joints,
            "couple": list(map(str, robot.couplings)),
            "base_link": chain.base if chain else None,
            "tip_link": chain.tip if chain else None,
            "tip_at_zero": {"xyz": zero.tip_origin[0], "rpy": roll_pitch_yaw(zero.tip_rotation[0])},
            "masses": {
                "joints": [robot.joint_names[j] for j in sorted(carrying)],
                "total": sum(part.mass for part in robot.link_masses if part.mass > 0.0),
                "fault": robot.mass_fault,
            },
            "remarks": robot.remarks,
            "ignored": chain.ignored if chain else (),
            "targets": robot.target_offsets,
            "parameters": robot.parameter_names,
            "levels": dict(robot.levels),
            "available_parameters": [{"name": p.name, "unit": p.unit, "nominal": p.nominal} for p in everything],
        }
    )
    return result


def _show(robot: Robot, answer: dict[str, Any], console: Console) -> None:
    ends = f", from {answer['base_link']} to {answer['tip_link']}" if answer["base_link"] else ""
    console.print(f"{robot.name}: {counted(len(robot.joint_names), 'joint')}{ends}", soft_wrap=True)
    joints = Table("joint", "type", "axis", "unit", title="joints, in this order")
    for heading in ("lower", "upper", "x y z [mm]", "roll pitch yaw [°]"):
        joints.add_column(heading, justify="right")
    for row, turns in zip(answer["joints"], robot.joint_is_revolute, strict=True):
        xyz = " ".join(_short(1e3 * v, 2) for v in row["xyz"])
        rpy = " ".join(_short(v, 3) for v in np.rad2deg(row["rpy"]))
        axis = " ".join(_short(v, 4) for v in row["axis"])
        limits = (joint_value(v, turns) for v in row["limits"])
        joints.add_row(row["name"], row["type"], axis, joint_unit(turns), *limits, xyz, rpy)
    console.print(joints)
    for text in _facts(robot, answer):
        console.print(text, soft_wrap=True)
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


def _facts(robot: Robot, answer: dict[str, Any]) -> Iterator[str]:
    """What else was understood, a sentence each."""
    tip = answer["tip_at_zero"]
    place = " ".join(_short(1e3 * v, 2) for v in tip["xyz"])
    turn = " ".join(_short(v, 3) for v in np.rad2deg(tip["rpy"]))
    yield "Each joint stands in the frame of the one before it, at coordinate zero."
    yield f"Tip with all joints at zero: {place} mm, roll pitch yaw {turn}°"
    targets = "; ".join(" ".join(_short(1e3 * v, 2) for v in xyz) for xyz in answer["targets"])
    yield f"Targets in the frame of the tip: {targets} mm"
    for one in robot.couplings:
        yield f"Coupled: {one}; limits are those of the joints, coordinates are what the controller shows"
    masses = answer["masses"]
    said = f"masses of the links behind {listed(masses['joints'])}, {masses['total']:.4g} kg altogether"
    if masses["fault"]:
        said = masses["fault"] + (": they are not used" if masses["joints"] else "")
    yield f"Inertial data: {said}"
    for remark in answer["remarks"]:
        yield f"Note: {remark}"
    for ignored in answer["ignored"]:
        yield f"Ignored: {ignored}"


def _short(value: float, digits: int) -> str:
    """A number with at most ``digits`` decimals, without zeros behind."""
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
