"""What ``identify`` writes: the estimate, and the calibrated robot as other programs take it."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from calib_planner.cli.estimate_table import grouped
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import InputError
from calib_planner.files.estimate_yaml import write_estimate
from calib_planner.files.kinematics_yaml import write_kinematics
from calib_planner.files.urdf_output import require_urdf, write_calibrated_urdf
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.report.calibration_report import write_report
from calib_planner.report.provenance import Provenance, provenance
from calib_planner.robot.chain import Robot
from calib_planner.robot.origins import not_in_origins

FLAGS = ("--output", "--report", "--urdf-output", "--kinematics-output")


def add_outputs(parser: argparse.ArgumentParser) -> None:
    """One option per kind of file."""
    group = parser.add_argument_group("what to write")
    group.add_argument("--output", metavar="FILE", help="the estimate as YAML")
    group.add_argument("--report", metavar="FILE", help="one HTML page: verdict, accuracy, 3-D view, residuals")
    group.add_argument(
        "--urdf-output", metavar="FILE", help="the calibrated URDF: the nominal one, its joints' origins changed"
    )
    group.add_argument(
        "--kinematics-output",
        metavar="FILE",
        help="xyz and rpy per joint as YAML, as Universal Robots' driver reads it",
    )


def check_outputs(args: argparse.Namespace, robot: Robot) -> None:
    """Find out before the work what could not be written after it.

    Raises:
        InputError: Two outputs of one name, a folder that is not there, no URDF to calibrate.
    """
    taken: dict[Path, str] = {}
    for flag, path in _wanted(args).items():
        place = Path(path).expanduser().resolve()
        if place in taken:
            raise InputError(flag, path, f"another file than {taken[place]}")
        if not place.parent.is_dir():
            raise InputError(flag, f"{path} (no such folder)", "a file in a folder that exists", "make it first")
        taken[place] = flag
    if args.urdf_output:
        require_urdf(robot, "--urdf-output")


def write_outputs(args: argparse.Namespace, problem: IdentificationProblem, estimate: Estimate) -> dict[str, Any]:
    """Write what is asked for; the answer's keys about it."""
    robot = estimate.calibrated
    if args.output:
        write_estimate(args.output, estimate, "--output")
    if args.report:
        write_report(args.report, problem, estimate, _provenance(args), "--report")
    if args.urdf_output:
        write_calibrated_urdf(args.urdf_output, robot, field="--urdf-output")
    if args.kinematics_output:
        write_kinematics(args.kinematics_output, robot)
    written: dict[str, Any] = {_key(flag): path for flag, path in _wanted(args).items()}
    if args.urdf_output or args.kinematics_output:
        written["not_written"] = list(not_in_origins(robot))
    return written


def _provenance(args: argparse.Namespace) -> Provenance:
    inputs = [("robot", args.robot), *(("data", f) for f in args.data)]
    inputs += [("held out", f) for f in args.validate or ()]
    command = shlex.join(["calib-planner", *sys.argv[1:]])
    return provenance(inputs, command=command, seed=args.seed, estimate=args.output or "")


def tell_outputs(args: argparse.Namespace, written: dict[str, Any], terminal: Terminal) -> None:
    """Say what was written and what has no place there."""
    words = ("Estimate", "Report", "Calibrated URDF", "Kinematics")
    for flag, word in zip(FLAGS, words, strict=True):
        if _key(flag) in written:
            terminal.note(f"{word} written to {written[_key(flag)]}")
    if written.get("not_written"):
        places = " and ".join(p for p in (args.urdf_output, args.kinematics_output) if p)
        shown = ", ".join(grouped(written["not_written"]))
        terminal.note(f"Not in {places}, which have no place for it: {shown} (tracker's frame and reflectors)")


def _wanted(args: argparse.Namespace) -> dict[str, str]:
    paths = {flag: getattr(args, _key(flag)) for flag in FLAGS}
    return {flag: path for flag, path in paths.items() if path}


def _key(flag: str) -> str:
    return flag[2:].replace("-", "_")
