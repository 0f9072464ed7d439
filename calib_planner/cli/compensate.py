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
from calib_planner.io import calibrated_robot, format_table, read_configurations, read_estimate, write_text
from calib_planner.robot import Robot

EXAMPLE = """calib-planner compensate --robot arm.urdf --estimate estimate.yaml \\
      --targets path.csv --output corrected.csv"""

DESCRIPTION = """Correct joint targets so that the real tool goes where the nominal model says.

The CSV of targets has a column per joint [rad | m], in any order. What is written has the same rows: the
corrected joints [rad | m], what remains (position_error [m], rotation_error [rad]), and reached: 1, or 0 where
the row could not be reached exactly and is the closest there is. Joint limits are respected. Where the base
stands before the tracker plays no part. Gravity and joint functions that the estimate holds are applied: gravity
for the robot as it was mounted, with the payload that is stated."""

ERRORS = ("position_error", "rotation_error", "reached")


def add(commands: Commands, summary: str) -> None:
    parser = add_command(commands, "compensate", summary, run, EXAMPLE, DESCRIPTION)
    add_robot(parser, targets=False)
    add_reading(parser)
    what = parser.add_argument_group("what to correct")
    option(what, "--estimate", "FILE", "estimate, written by identify --output", required=True)
    text = "CSV of joint targets [rad | m]"
    option(what, "--targets", "FILE", text, required=True, dest="joint_targets")
    switch(what, "--position-only", "only the position of a point counts, not how the tool is turned")
    text = "that point, in the frame of the last link [m] (the first reflector, as identified)"
    option(what, "--tool", '"x y z"', text, kind=numbers)
    add_payload(what, "the one that the estimate was made with")
    text = "placement alone, without gravity and joint functions: what a calibrated URDF does"
    switch(what, "--geometry-only", text)
    switch(what, "--ignore-limits", "joint limits do not matter")
    add_seed(parser)
    option(parser, "--output", "FILE", "CSV of corrected targets (stdout without --json)")


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    nominal = load_robot(args)
    saved = read_estimate(args.estimate)
    errors = None if args.geometry_only or saved.learnt is None else _carrying(args, saved.knowledge(nominal))
    if errors is None and args.payload is not None:
        got = "--geometry-only beside it" if args.geometry_only else "an estimate without an error model"
        raise InputError("--payload", got, "an estimate by an error model, and its gravity")
    calibrated = calibrated_robot(nominal, saved) if errors is None else errors.placed
    if args.position_only and args.tool is None:
        # The same point of the tool on both robots: a nominal place of a reflector is no more than a guess.
        nominal = nominal.with_targets(calibrated.target_offsets)
    if args.tool is not None:
        nominal, calibrated = _with_tool(args, nominal), _with_tool(args, calibrated)
    q = read_configurations(args.joint_targets, nominal, reading_of(args, terminal))
    with terminal.working("correcting"):
        result = compensate(
            nominal,
            calibrated,
            q,
            position_only=args.position_only,
            limits=not args.ignore_limits,
            corrections=errors,
        )
    if args.output:
        write_text(args.output, _csv(result), "--output")
    elif not args.json:
        print(_csv(result), end="")
    answer = {
        "robot": nominal.name,
        **result.to_dict(),
        "position_only": args.position_only,
        "error_model": None if errors is None else {"terms": saved.document["error_model"]["terms"]},
        "output": args.output,
    }
    if args.json:
        terminal.answer(answer, lambda console: None)
    else:
        show_compensation(result, terminal.out if args.output else terminal.err)
    if saved.learnt is None and not args.geometry_only:
        terminal.note(f"{args.estimate}: {_without_model(saved.document)}")
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


def _csv(result: Compensation) -> str:
    errors = [result.position_error, result.rotation_error]
    rows: list[list[Any]] = np.column_stack([result.corrected, *errors]).tolist()
    for row, reached in zip(rows, result.reached.tolist(), strict=True):
        row.append(int(reached))
    return format_table([*result.joint_names, *ERRORS], rows)


def show_compensation(result: Compensation, console: Console) -> None:
    """Print what the correction does, in mm and mrad."""
    table = Table("tool against nominal", title=f"{len(result.status)} targets")
    for column in ("mean", "largest"):
        table.add_column(column, justify="right")
    rows = [
        ("position uncorrected [mm]", result.position_error_before),
        ("position corrected [mm]", result.position_error),
        ("rotation uncorrected [mrad]", result.rotation_error_before),
        ("rotation corrected [mrad]", result.rotation_error),
        ("joint correction [mrad | mm]", np.abs(result.corrected - result.targets).max(axis=1)),
    ]
    for label, values in rows:
        if not np.isnan(values).any():
            table.add_row(label, *(f"{1e3 * v:.4g}" for v in (values.mean(), values.max())))
    console.print(table)
