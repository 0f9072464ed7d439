"""``calib-planner identify``: what the measurements say about the robot."""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np

from calib_planner.cli.arguments import (
    Commands,
    add_command,
    add_parameters,
    add_robot,
    add_seed,
    add_test_poses,
    choose_parameters,
    load_robot,
    test_poses,
)
from calib_planner.cli.estimate_table import show_estimate
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError
from calib_planner.files.estimate_yaml import write_estimate
from calib_planner.files.measurements_csv import read_measurements
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.problem import LOSSES, IdentificationProblem
from calib_planner.identification.solver import identify
from calib_planner.identification.validation import validate
from calib_planner.robot.chain import Robot

EXAMPLE = """calib-planner identify --robot irb120.urdf --data calibration.csv --parameters offsets \\
      --unknown base,tool --validate test.csv --validate-target-from 1 --output estimate.yaml"""

DESCRIPTION = """Identify the robot's parameters from measured points.

The CSV has a column per joint [rad | m], in any order, and x1,y1,z1[,x2,…] per reflector in the tracker's
frame [m]; empty cells: not measured. Optional std_x1,… [m] weigh the points. Other columns are ignored."""


def add(commands: Commands) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "identify", "identify parameters from measurements", run, EXAMPLE, DESCRIPTION)
    add_robot(parser)
    add_parameters(parser)
    data = parser.add_argument_group("measurements")
    data.add_argument("--data", required=True, metavar="FILE", help="CSV of measurements [rad | m]")
    data.add_argument(
        "--sigma", type=float, metavar="S", help="std of one coordinate [m] (the file's, else the residuals')"
    )
    data.add_argument("--loss", choices=LOSSES, default="linear", help="how residuals count (linear)")
    data.add_argument("--iterations", type=int, default=50, metavar="N", help="most iterations (50)")
    add_seed(data)
    check = parser.add_argument_group("how good is it")
    add_test_poses(check, "where the predicted accuracy is wanted")
    check.add_argument("--validate", action="append", metavar="FILE", help="held-out CSV; repeat for several")
    check.add_argument(
        "--validate-target-from",
        type=int,
        default=0,
        metavar="N",
        help="the reflector was re-seated: its offset comes from the first N rows of each held-out file",
    )
    parser.add_argument("--output", metavar="FILE", help="write the estimate as YAML")


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    robot = load_robot(args)
    data = _read(args.data, robot, args, terminal)
    robot = _with_targets(robot, data, args)
    problem = IdentificationProblem(
        robot=robot,
        data=data,
        sigma=args.sigma,
        loss=args.loss,
        test_poses=test_poses(robot, args),
        iterations=args.iterations,
    )
    held_out = [_read(path, robot, args, terminal) for path in args.validate or ()]
    if args.validate_target_from and not held_out:
        raise InputError("--validate-target-from", args.validate_target_from, "--validate FILE beside it")
    with terminal.working("identifying"):
        estimate = _estimate(problem, held_out, args.validate_target_from)
    settled = estimate.status != "not_converged"
    if args.output and settled:
        write_estimate(args.output, estimate, "--output")
    result = estimate.to_dict() | ({"output": args.output} if args.output and settled else {})
    terminal.answer(result, partial(show_estimate, estimate))
    if not settled:
        raise CalibPlannerError(estimate.message + (" Nothing was written." if args.output else ""))
    if args.output:
        terminal.note(f"Estimate written to {args.output}")


def _estimate(problem: IdentificationProblem, held_out: list[Measurements], target_from: int) -> Estimate:
    estimate = identify(problem)
    return validate(problem, estimate, held_out, target_from) if held_out else estimate


def _read(path: str, robot: Robot, args: argparse.Namespace, terminal: Terminal) -> Measurements:
    file = read_measurements(path, robot, degrees=args.degrees)
    if file.ignored:
        terminal.note(f"{path}: columns ignored: {', '.join(file.ignored)}")
    turning = np.abs(file.data.q[:, robot.joint_is_revolute])
    if not args.degrees and turning.size and turning.max() > 4 * np.pi:
        terminal.note(f"{path}: joint angles up to {turning.max():.4g} rad; are they degrees (--degrees)?")
    return file.data


def _with_targets(robot: Robot, data: Measurements, args: argparse.Namespace) -> Robot:
    """The robot with as many targets as the data have, and its active parameters."""
    count = data.p.shape[1]
    if args.targets is None and "tool" in args.unknown.split(","):
        robot = robot.with_targets(np.zeros((count, 3)))
    robot = choose_parameters(robot, args)
    if len(robot.targets) != count:
        raise FileFormatError(
            args.data,
            "header",
            f"points of {count} targets",
            f"{len(robot.targets)}, as the robot or --targets says",
            'give --targets "x y z" once per target, or --unknown tool',
        )
    return robot
