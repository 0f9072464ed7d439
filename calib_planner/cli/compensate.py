# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner compensate``: joint targets corrected for a controller that cannot change its model."""

from __future__ import annotations

import argparse
from collections import Counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.cli.arguments import (
    Commands,
    Group,
    add_command,
    add_reading,
    add_robot,
    add_seed,
    load_robot,
    numbers,
    option,
    reading_of,
    switch,
)
from calib_planner.cli.gravity import add_payload, payload_of
from calib_planner.cli.terminal import Terminal
from calib_planner.compensation import STATUS, Compensation, compensate
from calib_planner.error_model import Knowledge, Payload
from calib_planner.errors import InputError
from calib_planner.io import (
    SavedEstimate,
    Understanding,
    calibrated_robot,
    check_writable,
    format_table,
    in_units,
    read_estimate,
    read_joints,
    with_units,
    write_text,
)
from calib_planner.robot import Robot
from calib_planner.units import LENGTHS, joint_factor, joint_unit

EXAMPLE = "calib-planner compensate --estimate estimate.yaml --targets path.csv --output corrected.csv"

DESCRIPTION = """Correct joint targets so that the real tool goes where the nominal model says.

The table of targets has a column per joint [rad | m], in any order and in any units. What is written has the
same rows in the same units: the corrected joints; expected_error [m], what the reflectors will be off by
(root mean square) with all that the estimate knows and does not know; and reached: 1, or 0 where the row
could not be reached exactly and is the closest there is. Joint limits are respected. Where the base stands
before the tracker plays no part. Gravity and joint functions that the estimate holds are applied: gravity for
the robot as it was mounted, with the payload that is stated."""


def add(commands: Commands, summary: str) -> None:
    parser = add_command(commands, "compensate", summary, run, EXAMPLE, DESCRIPTION)
    add_robot(parser, "the estimate's", targets=False)
    add_reading(parser)
    what = parser.add_argument_group("what to correct")
    option(what, "--estimate", "FILE", "estimate, written by identify --output", required=True)
    text = "table of joint targets [rad | m]"
    option(what, "--targets", "FILE", text, required=True, dest="joint_targets")
    add_correction(what)
    add_seed(parser)
    option(parser, "--output", "FILE", "CSV of corrected targets (stdout without --json)")


def add_correction(group: Group) -> None:
    """How joint targets are corrected."""
    switch(group, "--position-only", "only the position of a point counts, not how the tool is turned")
    text = "that point, in the frame of the last link [m] (the first reflector, as identified)"
    option(group, "--tool", '"x y z"', text, kind=numbers)
    add_payload(group, "the one that the estimate was made with")
    text = "placement alone, without gravity and joint functions: what a calibrated URDF does"
    switch(group, "--geometry-only", text)
    switch(group, "--ignore-limits", "joint limits do not matter")


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    if args.output:
        check_writable(args.output, "--output")
    saved = read_estimate(args.estimate)
    nominal = robot_of(args, saved)
    result, file = corrected(args, saved, nominal, args.joint_targets, terminal)
    if args.output:
        write_text(args.output, corrected_text(result, nominal, file), "--output")
    elif not args.json:
        print(corrected_text(result, nominal, file), end="")
    plainly = args.geometry_only or saved.learnt is None
    answer = {
        "robot": nominal.name,
        **result.to_dict(),
        "position_only": args.position_only,
        "error_model": None if plainly else {"terms": saved.document["error_model"]["terms"]},
        "output": args.output,
    }
    if args.json:
        terminal.answer(answer, lambda console: None)
    else:
        show_compensation(result, nominal, terminal.out if args.output else terminal.err)
    tell_compensation(args, saved, result, terminal)


def robot_of(args: argparse.Namespace, saved: SavedEstimate) -> Robot:
    """The nominal robot of --robot, or the one that the estimate holds."""
    return saved.nominal_robot() if args.robot is None else load_robot(args)


def corrected(
    args: argparse.Namespace, saved: SavedEstimate, nominal: Robot, targets: str, terminal: Terminal
) -> tuple[Compensation, Understanding]:
    """The joint targets of a file, corrected as the options of ``add_correction`` say, and what the file is like.

    Raises:
        InputError, FileFormatError: As ``compensate``, and where an option does not fit another.
    """
    known = None if saved.learnt is None else _carrying(args, saved.knowledge(nominal))
    errors = None if args.geometry_only else known
    if errors is None and args.payload is not None:
        got = "--geometry-only beside it" if args.geometry_only else "an estimate without an error model"
        raise InputError("--payload", got, "an estimate by an error model, and its gravity")
    calibrated = calibrated_robot(nominal, saved) if errors is None else errors.placed
    if args.position_only and args.tool is None:
        # The same point of the tool on both robots: a nominal place of a reflector is no more than a guess.
        nominal = nominal.with_targets(calibrated.target_offsets)
    if args.tool is not None:
        nominal, calibrated = _with_tool(args, nominal), _with_tool(args, calibrated)
    table = read_joints(targets, nominal, reading_of(args, terminal))
    with terminal.working("correcting"):
        result = compensate(
            nominal,
            calibrated,
            table.configurations,
            position_only=args.position_only,
            limits=not args.ignore_limits,
            corrections=errors,
            known=known,
        )
    return result, table.understanding


def tell_compensation(
    args: argparse.Namespace, saved: SavedEstimate, result: Compensation, terminal: Terminal
) -> None:
    """Say what is not as it should be."""
    if saved.learnt is None and not args.geometry_only:
        terminal.note(f"{saved.path}: {_without_model(saved.document)}")
    for status, count in Counter(result.status).items():
        if status != "reached":
            terminal.note(f"{count} of {len(result.status)} targets {status}: {STATUS[status]}")


def _without_model(document: dict[str, Any]) -> str:
    """What an estimate of an older version, a ``document``, cannot give."""
    text = "it holds no error model, so placement alone is corrected, without gravity and joint functions"
    if document.get("joint_corrections") is not None:
        text += "; its joint corrections are of an older version and are not applied"
    return f"{text}: identify again for the whole correction"


def _carrying(args: argparse.Namespace, known: Knowledge) -> Knowledge:
    """The robot with the payload of --payload; at the place stated at its identification if only its mass is."""
    stated, gravity = payload_of(args), known.model.gravity
    if stated is None or gravity is None:
        return known
    mass, place = stated
    if len(args.payload) == 1 and gravity.payload is not None:
        place = gravity.payload.xyz
    return known.carrying(Payload(mass, place) if mass else None)


def _with_tool(args: argparse.Namespace, robot: Robot) -> Robot:
    if not args.position_only:
        raise InputError("--tool", "a point", "--position-only beside it", "the pose is that of the last link")
    if len(args.tool) != 3 or not np.isfinite(args.tool).all():
        raise InputError("--tool", f"{len(args.tool)} numbers", "3 finite numbers: x, y, z [m]")
    return robot.with_targets([args.tool])


def corrected_text(result: Compensation, robot: Robot, file: Understanding) -> str:
    """CSV of the corrected targets in the units of ``file``, which the header names if it did there."""
    units, metre = file.units, LENGTHS[file.units.length or "m"]
    joints = in_units(robot, result.corrected, units)
    rows: list[list[Any]] = np.column_stack([joints, result.expected_error / metre]).tolist()
    for row, reached in zip(rows, result.reached.tolist(), strict=True):
        row.append(int(reached))
    names = with_units(robot, units) if file.angle_from == "written" else result.joint_names
    error = "expected_error" if metre == 1.0 else f"expected_error [{units.length}]"
    return format_table([*names, error, "reached"], rows)


def show_compensation(result: Compensation, robot: Robot, console: Console) -> None:
    """Print what the correction does and how accurate it will be."""
    table = Table("", title=f"{len(result.status)} targets, {int(result.reached.sum())} reached")
    for column in ("mean", "largest"):
        table.add_column(column, justify="right")
    rows = [
        ("tool off its nominal place without correction [mm]", 1e3 * result.position_error_before),
        ("tool turned from it [mrad]", 1e3 * result.rotation_error_before),
        ("error to be expected with it, rms [mm]", 1e3 * result.expected_error),
    ]
    change = np.abs(result.corrected - result.targets)
    for turns in (True, False):
        if (robot.joint_is_revolute == turns).any():
            moved = joint_factor(turns) * change[:, robot.joint_is_revolute == turns].max(axis=1)
            rows.append((f"joint correction [{joint_unit(turns)}]", moved))
    for label, values in rows:
        if not np.isnan(values).any():
            table.add_row(label, *(f"{v:.4g}" for v in (values.mean(), values.max())))
    console.print(table)
