# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner export``: everything that can be made of an estimate file, without another fit."""

from __future__ import annotations

import argparse
import shlex
import sys
from functools import partial
from typing import Any

from rich.console import Console

from calib_planner.arrays import plain
from calib_planner.cli.arguments import Commands, add_command, add_reading, add_robot, add_seed, option
from calib_planner.cli.compensate import (
    add_correction,
    corrected,
    corrected_text,
    robot_of,
    show_compensation,
    tell_compensation,
)
from calib_planner.cli.estimate_table import show_estimate
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import InputError
from calib_planner.identification import Estimate
from calib_planner.io import (
    SavedEstimate,
    calibrated_urdf,
    make_folder,
    read_estimate,
    require_urdf,
    user_path,
    write_calibrated_urdf,
    write_kinematics,
    write_text,
)
from calib_planner.robot import Robot, grouped, not_in_origins

EXAMPLE = """calib-planner export estimate.yaml --urdf calibrated.urdf --report report.html
  calib-planner export estimate.yaml --degrees --targets path.csv corrected.csv"""
DESCRIPTION = """Write what controllers, planners and people need of an estimate, as often as wanted.

The file that identify writes holds the measurements and the robot's file, so that nothing else is needed
and nothing is fitted again. Files of older versions need the robot (--robot) and give no report. Without options
the estimate is shown; --json prints it as identify does."""
PAGE = "calibration.html"
"""Name of the report in a folder."""


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "export", summary, run, EXAMPLE, DESCRIPTION)
    parser.add_argument("estimate", metavar="ESTIMATE", help="estimate file, as identify writes it")
    add_robot(parser, "the one in the estimate", targets=False)
    add_reading(parser)
    what = parser.add_argument_group("what to write")
    option(what, "--urdf", "FILE", "the calibrated URDF: the nominal one with its joints' origins changed")
    text = "xyz and rpy per joint as YAML, as the driver of Universal Robots reads it"
    option(what, "--kinematics", "FILE", text)
    option(what, "--report", "FILE", f"one HTML page; a folder gets {PAGE}")
    text = "table of joint targets [rad | m], and where to write them corrected, in the same units"
    option(what, "--targets", "FILE", text, nargs=2, dest="joint_targets")
    add_correction(parser.add_argument_group("how targets are corrected (see compensate)"))
    add_seed(parser)


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    saved = read_estimate(args.estimate)
    nominal = robot_of(args, saved)
    _check(args, nominal)
    whole = saved.estimate(nominal) if "problem" in saved.document else None
    written: dict[str, str] = {}
    if args.urdf:
        _write_urdf(args, saved, nominal)
        written["urdf"] = args.urdf
    if args.kinematics:
        write_kinematics(args.kinematics, saved.calibrated(nominal), "--kinematics")
        written["kinematics"] = args.kinematics
    if args.report:
        written["report"] = _write_report(args, saved, nominal, whole)
    result = None
    if args.joint_targets:
        targets, output = args.joint_targets
        result, file = corrected(args, saved, nominal, targets, terminal)
        write_text(output, corrected_text(result, nominal, file), "--targets")
        written["targets"] = output
    more: dict[str, Any] = {"written": written}
    more |= {"compensation": result.to_dict()} if result is not None else {}
    if args.urdf or args.kinematics:
        more["not_written"] = list(not_in_origins(saved.calibrated(nominal)))
    terminal.answer(_shown(saved) | plain(more), partial(_show, written, whole, saved))
    if result is not None:
        if not args.json:
            show_compensation(result, nominal, terminal.err)
        tell_compensation(args, saved, result, terminal)
    if more.get("not_written"):
        places = " and ".join(written[key] for key in ("urdf", "kinematics") if key in written)
        names = ", ".join(grouped(more["not_written"]))
        terminal.note(f"Not written to {places}, which cannot hold it: {names} (tracker's frame and reflectors)")


def _check(args: argparse.Namespace, nominal: Robot) -> None:
    """Refuse what could not be written.

    Raises:
        InputError: Two outputs of one name, an input as output, or no URDF to calibrate.
    """
    sources = [args.estimate, *(args.joint_targets or ())[:1]]
    taken = {user_path(path).resolve(): "what is read" for path in sources}
    outputs = {f"--{name}": getattr(args, name) for name in ("urdf", "kinematics", "report")}
    outputs |= {"--targets": args.joint_targets[1]} if args.joint_targets else {}
    for flag, path in outputs.items():
        place = None if path is None else user_path(path).resolve()
        if place in taken:
            raise InputError(flag, path, f"another file than {taken[place]}")
        if place is not None:
            taken[place] = flag
    if args.urdf:
        require_urdf(nominal, "--urdf")


def _write_urdf(args: argparse.Namespace, saved: SavedEstimate, nominal: Robot) -> None:
    """The nominal URDF, that of --robot or the one in the estimate, with its joints' origins changed."""
    robot = saved.calibrated(nominal)
    if args.robot is not None:
        write_calibrated_urdf(args.urdf, robot, field="--urdf")
        return
    text, _ = calibrated_urdf(saved.nominal_urdf(), robot, nominal.source)
    write_text(args.urdf, text, "--urdf")


def _write_report(args: argparse.Namespace, saved: SavedEstimate, nominal: Robot, whole: Estimate | None) -> str:
    """Write the page; returns where it is."""
    if whole is None:
        advice = "identify again with --output, or with --report"
        raise InputError("--report", f"{args.estimate}, without its measurements", "a file that has them", advice)
    from calib_planner.report import provenance, write_report  # 0.1 s for templates

    place = user_path(args.report)
    if place.is_dir() or args.report.endswith("/") or not place.suffix:
        place = make_folder(args.report, "--report") / PAGE
    command = shlex.join(["calib-planner", *sys.argv[1:]])
    source = provenance([("estimate", args.estimate)], command=command, seed=args.seed, estimate=args.estimate)
    write_report(place, saved.problem(nominal), whole, source, "--report")
    return str(place)


def _shown(saved: SavedEstimate) -> dict[str, Any]:
    """The keys of ``identify --json``: the file's without what only files hold."""
    document = {key: value for key, value in saved.document.items() if key != "problem"}
    if saved.learnt is not None:
        model = document["error_model"]
        document["error_model"] = {key: model[key] for key in ("terms", "model")}
    shown: dict[str, Any] = plain(document)
    return shown


def _show(written: dict[str, str], whole: Estimate | None, saved: SavedEstimate, console: Console) -> None:
    for kind, path in written.items():
        console.print(f"{kind} written to {path}", soft_wrap=True)
    if written:
        return
    if whole is not None:
        show_estimate(whole, console)
        return
    level = "" if saved.verdict is None else f"{saved.verdict.level}, "
    console.print(f"{saved.robot}: {level}{saved.status}, {len(saved.parameters)} parameters", soft_wrap=True)
