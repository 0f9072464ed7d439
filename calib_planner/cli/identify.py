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
    choose_parameters,
    load_robot,
    test_poses,
)
from calib_planner.cli.estimate_table import show_estimate
from calib_planner.cli.identify_data import Rows, Source, add_data, check_files, read_rows, read_source
from calib_planner.cli.identify_options import add_checks, add_noise, add_prior, instrument_of, prior_of
from calib_planner.cli.identify_outputs import add_outputs, check_outputs, tell_outputs, write_outputs
from calib_planner.cli.terminal import Terminal
from calib_planner.design.plan import plain
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError, NotEnoughDataError
from calib_planner.files.estimate_yaml import placement
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.solver import identify
from calib_planner.identification.validation import cross_validate, validate
from calib_planner.robot.chain import Robot

EXAMPLE = """calib-planner identify --robot irb120.urdf --data calibration.csv --parameters full \\
      --unknown base,tool --prior typical --loss robust --folds 5 \\
      --validate test.csv --validate-target-from 1 --output estimate.yaml"""

DESCRIPTION = """Identify the robot's parameters from measured points.

A CSV has a column per joint [rad | m], in any order, and x1,y1,z1[,x2,…] per reflector in the tracker's
frame [m]; empty cells: not measured. Optional std_x1,… [m] weigh the points. Other columns are ignored. A bag
(folder, .db3, .mcap) gives a row per standstill.

The verdict comes first: PASS, WARN or FAIL, with reasons and what to do. It does not change the exit status:
a calibration that failed its checks is an answer too. Rows count from 0 in JSON and estimate files."""


def add(commands: Commands) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "identify", "identify parameters from measurements", run, EXAMPLE, DESCRIPTION)
    add_robot(parser)
    add_parameters(parser)
    add_data(parser)
    add_noise(parser)
    add_prior(parser)
    add_checks(parser)
    add_outputs(parser)


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    if args.validate_target_from and not args.validate:
        raise InputError("--validate-target-from", args.validate_target_from, "--validate FILE beside it")
    check_files(args)
    robot = load_robot(args)
    check_outputs(args, robot)
    rows = read_rows(args.data, robot, args, terminal)
    robot = _with_targets(robot, rows, args)
    problem = _problem(robot, rows, args, terminal)
    held_out = [_held_out(path, robot, args, terminal) for path in args.validate or ()]
    with terminal.working("identifying"):
        estimate = _estimate(problem, held_out, args)
    settled = estimate.status != "not_converged"
    written = write_outputs(args, problem, estimate) if settled else {}
    sources = {"data": [{"file": s.path, "rows": len(s.data)} for s in rows.sources]}
    result = estimate.to_dict() | plain(placement(estimate)) | sources | written
    terminal.answer(result, partial(show_estimate, estimate, where=rows.where))
    if not settled:
        raise CalibPlannerError(estimate.message + (" Nothing was written." if _asked(args) else ""))
    tell_outputs(args, written, terminal)


def _problem(robot: Robot, rows: Rows, args: argparse.Namespace, terminal: Terminal) -> IdentificationProblem:
    return IdentificationProblem(
        robot=robot,
        data=rows.data,
        sigma=args.sigma,
        loss=args.loss,
        test_poses=test_poses(robot, args),
        iterations=args.iterations,
        prior=prior_of(args, robot, terminal),
        instrument=instrument_of(args, terminal),
        discrepancy=args.discrepancy,
        joint_corrections=args.joint_corrections,
        starts=args.starts,
        required_accuracy=args.required_accuracy,
    )


def _estimate(problem: IdentificationProblem, held_out: list[Measurements], args: argparse.Namespace) -> Estimate:
    estimate = identify(problem)
    if estimate.status == "not_converged":
        return estimate
    if held_out:
        estimate = validate(problem, estimate, held_out, args.validate_target_from)
    if args.folds is None:
        return estimate
    try:
        return cross_validate(problem, estimate, args.folds, args.seed)
    except NotEnoughDataError as error:
        text = f"--folds {args.folds}: too little is left without one part ({error})"
        raise NotEnoughDataError(error.have, error.need, text) from None


def _held_out(path: str, robot: Robot, args: argparse.Namespace, terminal: Terminal) -> Measurements:
    """A file of --validate; re-seated targets may be as many as they like."""
    source: Source = read_source(path, robot, args, terminal)
    count, most = source.data.p.shape[1], len(robot.targets)
    if count > most and not args.validate_target_from:
        advice = "other reflectors need --validate-target-from N"
        raise FileFormatError(
            path, "header", f"points of {count} targets", f"at most {most}, as in --data", advice
        )
    return source.data


def _with_targets(robot: Robot, rows: Rows, args: argparse.Namespace) -> Robot:
    """The robot with as many targets as the data have, and its active parameters."""
    count = rows.data.p.shape[1]
    if args.targets is None and "tool" in args.unknown.split(","):
        robot = robot.with_targets(np.zeros((count, 3)))
    robot = choose_parameters(robot, args)
    if len(robot.targets) != count:
        raise FileFormatError(
            rows.sources[0].path,
            "header",
            f"points of {count} targets",
            f"{len(robot.targets)}, as the robot or --targets says",
            'give --targets "x y z" once per target, or --unknown tool',
        )
    return robot


def _asked(args: argparse.Namespace) -> bool:
    return any((args.output, args.urdf_output, args.kinematics_output))
