# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner init``: ask what a cell has, try it on measurements, and write ``cell.yaml``."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Console

from calib_planner.arrays import plain
from calib_planner.cli.arguments import (
    Commands,
    add_command,
    add_parameters,
    add_robot,
    add_seed,
    add_test_path,
    add_test_poses,
    choose_parameters,
    load_robot,
    numbers,
    option,
    switch,
    test_poses,
)
from calib_planner.cli.gravity import add_gravity, error_model_of
from calib_planner.cli.terminal import Terminal
from calib_planner.error_model import ACCURACIES
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError, NotEnoughDataError
from calib_planner.identification import IdentificationProblem, find_misplacement, place_nominal
from calib_planner.io import (
    CELL_KEYS,
    Cell,
    Reading,
    read_constraints,
    read_instrument,
    read_sources,
    read_text,
    shipped_robots,
    user_path,
    write_cell,
)
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot
from calib_planner.units import Units, counted, length

EXAMPLE = """calib-planner init --robot irb120.urdf --data calibration.csv --sigma 20um
  calib-planner identify --cell cell.yaml --data calibration.csv"""
DESCRIPTION = """Write cell.yaml: robot, reflectors, what is unknown, payload, mounting, instrument, constraints.

Without --robot on a terminal it asks; Enter leaves a question open. With --data it tries the cell at once: it
says what it understood of the file, and whether the points agree with the robot once base and reflectors are
placed. Every command then takes the file for its options; docs/reference/cell.md lists the keys."""
AGREES = 0.02
"""Median distance up to which points agree with a robot that is placed, as ``find_misplacement`` has it [m]:
nominal arms err by a few millimetres."""
OF_SPREAD = 0.1
"""That distance is at most this share of the median distance of the points from their centre: in units that are
too small every robot agrees."""
PATHS = ("robot", "instrument", "constraints", "error-model", "test-path")
"""Keys whose value may be the path of a file."""
QUESTIONS = {
    "robot": "Robot: path of a URDF or robot YAML, or {robots}",
    "data": "A file of measurements to try it on",
    "targets": "Reflector in the frame of the last link, x y z (such as 60mm 20mm 90mm); empty if unknown",
    "payload": "Payload: mass in kg, and x y z of its centre of gravity",
    "mounting": "Mounted on floor, ceiling, or which way is down in the frame of the base (x y z)",
    "sigma": "Noise of a coordinate of the tracker (such as 20um)",
    "instrument": "Or a file that describes the instrument",
    "constraints": "File of constraints: workspace, floor, the tracker's view",
    "required-accuracy": "Accuracy that is needed (such as 0.1mm)",
}
"""Key → the question about it, in this order."""
TRIED_UNITS: tuple[tuple[str, ...], ...] = ((), ("mm",), ("deg",), ("mm", "deg"))
"""Units of a data file, in the order in which they are tried."""


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "init", summary, run, EXAMPLE, DESCRIPTION, cell=False)
    add_robot(parser, "a question on a terminal")
    add_parameters(parser, "told by --data")
    add_gravity(parser)
    work = parser.add_argument_group("instrument, constraints and what is wanted")
    noise = work.add_mutually_exclusive_group()
    option(noise, "--sigma", "S", "standard deviation of one coordinate of the tracker [m]", kind=float)
    option(noise, "--instrument", "FILE", "YAML: noise by direction (config/instruments/)")
    option(work, "--constraints", "FILE", "YAML: workspace, floor, tracker's view, …")
    option(work, "--error-model", "E", "how the robot errs: typical, paper, or YAML, also an estimate")
    option(work, "--accuracy-frame", None, "what an accuracy is", choices=ACCURACIES)
    option(work, "--required-accuracy", "A", "largest acceptable error at a test pose [m]", kind=float)
    add_test_poses(work, "where accuracy matters")
    add_test_path(work)
    trial = parser.add_argument_group("trial and output")
    option(trial, "--data", "FILE", "measurements to try the cell on")
    switch(trial, "--millimetres", "points of data files are in mm")
    option(trial, "--output", "FILE", "the file to be written", "cell.yaml")
    switch(trial, "--overwrite", "replace a file that is there")
    add_seed(trial)
    parser.set_defaults(own_parser=parser)


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    if user_path(args.output).exists() and not args.overwrite:
        raise InputError("--output", f"{args.output}, which is there", "a new file", "or give --overwrite")
    asking = args.robot is None and sys.stdin.isatty()
    if asking:
        _ask(args, terminal)
    if args.robot is None:
        raise InputError("--robot", "nothing", "a robot", f"a file, or one of: {', '.join(shipped_robots())}")
    robot = load_robot(args)
    _check(args, robot)
    trial = None if args.data is None else try_cell(args, robot, terminal)
    cell = write_cell(args.output, _values(args, trial), "--output")
    terminal.answer(_answer(cell, robot, trial), lambda console: _show(cell, robot, trial, console))


def _check(args: argparse.Namespace, robot: Robot) -> None:
    """Refuse now what a command would refuse later.

    Raises:
        InputError, FileFormatError: As the commands that use it.
    """
    choose_parameters(robot, args)
    error_model_of(args, args.error_model or "typical", robot)
    if args.constraints is not None:
        read_constraints(args.constraints, robot)
    if args.instrument is not None:
        read_instrument(args.instrument)
    test_poses(robot, args)


# ── asking ───────────────────────────────────────────────────────────────────────────────────────────


def _ask(args: argparse.Namespace, terminal: Terminal) -> None:
    """Put the answers of a person into ``args``, each as if its option had been given."""
    actions = args.own_parser._option_string_actions
    for key, question in QUESTIONS.items():
        action = actions[f"--{key}"]
        if getattr(args, action.dest) is not None or (key == "instrument" and args.sigma is not None):
            continue
        while True:
            terminal.err.print(question.format(robots=", ".join(shipped_robots())), end=": ", soft_wrap=True)
            text = sys.stdin.readline()
            if not text.strip():
                if key == "robot" and text:
                    continue
                break
            try:
                value = action.type(text.strip())
                setattr(args, action.dest, [value] if action.dest == "targets" else value)
                _try_answer(key, args)
                break
            except (CalibPlannerError, argparse.ArgumentTypeError, ValueError) as error:
                setattr(args, action.dest, None)
                terminal.note(str(error))


def _try_answer(key: str, args: argparse.Namespace) -> None:
    """Refuse an answer as soon as it is known to be of no use."""
    if key == "robot":
        load_robot(args)
    elif key in ("data", *PATHS) and not os.path.isfile(user_path(getattr(args, key.replace("-", "_")))):
        raise InputError(key, "no such file", "a file that is there")
    elif key in ("payload", "mounting"):
        error_model_of(args, "typical", load_robot(args))
    elif key == "targets" and len(args.targets[0]) != 3:
        raise InputError(key, f"{len(args.targets[0])} numbers", "3 numbers: x, y, z")


# ── the trial ────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Trial:
    """What a file of measurements says about a cell.

    Attributes:
        file: The file.
        visits, targets, points: What it holds.
        units: Of the file: ``mm``, ``deg`` or both; metres and radians otherwise.
        before: Median distance of the points from the robot as it was stated [m].
        unknown: What has to be unknown for the points to fit: ``base``, ``tool``.
        after: Median distance with that placed by the points alone [m]; infinite where they cannot place it.
        spread: Median distance of the points from their centre [m].
        places: Where the points put reflectors that are unknown, in the frame of the last link, to 0.1 mm [m].
    """

    file: str
    visits: int
    targets: int
    points: int
    units: tuple[str, ...]
    before: float
    unknown: tuple[str, ...]
    after: float
    spread: float
    places: tuple[tuple[float, ...], ...] = ()

    @property
    def agrees(self) -> bool:
        """Whether the robot, once placed, is where the points are."""
        return self.after <= min(AGREES, OF_SPREAD * self.spread)

    def describe(self) -> list[str]:
        """What was understood and whether it agrees, in sentences."""
        angles, lengths = ("degrees", "rad")["deg" not in self.units], ("mm", "m")["mm" not in self.units]
        seen = f"{counted(self.visits, 'visit')}, {counted(self.points, 'point')} of "
        seen += counted(self.targets, "reflector")
        lines = [f"{self.file}: {seen}; angles in {angles}, lengths in {lengths}."]
        words = " and ".join({"base": "the base", "tool": "the reflectors"}[w] for w in self.unknown)
        where = f"with {words} where the points put them" if words else "as it is stated"
        if self.agrees:
            lines.append(f"The robot agrees with the points: {length(self.after)} between them {where} (median).")
        else:
            lines.append(
                f"The robot does not agree with the points: {length(self.after)} between them {where} (median); "
                "look at the robot, the order and signs of its joints, and the units. identify names the cause."
            )
        return lines


def try_cell(args: argparse.Namespace, robot: Robot, terminal: Terminal) -> Trial:
    """Read the data and place the robot, in the units stated or in the first others that make it agree.

    Raises:
        FileFormatError: The file cannot be read, in whatever units.
    """
    stated = tuple(u for u, given in (("mm", args.millimetres), ("deg", args.degrees)) if given)
    trials: list[Trial] = []
    refused: FileFormatError | None = None
    for units in (stated, *(u for u in TRIED_UNITS if set(u) > set(stated))):
        otherwise = Units("mm" if "mm" in units else "", "deg" if "deg" in units else "")
        reading = Reading(otherwise=otherwise, progress=terminal.progress)
        try:
            sources = read_sources([args.data], robot, reading, noise_given=False)
        except FileFormatError as error:
            if not error.field.endswith("measurements"):  # which is how check_units refuses units
                raise
            refused = refused or error
            continue
        of_file = sources.files[0].understanding.units
        recognised = tuple(u for u in ("mm", "deg") if u in (of_file.length, of_file.angle))
        trials.append(_trial(args, robot, sources.data, recognised))
        if trials[-1].agrees:
            return trials[-1]
    if not trials:
        assert refused is not None
        raise refused
    return trials[0]


def _trial(args: argparse.Namespace, robot: Robot, data: Measurements, units: tuple[str, ...]) -> Trial:
    count = data.p.shape[1]
    strange = len(robot.targets) != count
    alike = robot.with_targets(np.zeros((count, 3))) if strange else robot
    answer = find_misplacement(alike, data)
    unknown = tuple(w for w in ("base", "tool") if w in answer.unknown or (strange and w == "tool"))
    if args.unknown:
        unknown = tuple(u.strip() for u in args.unknown.split(",") if u.strip() not in ("", "none"))
    placed, after = alike, answer.before
    if unknown:
        placed, after = _placed(alike.with_parameters(alike.parameter_names, unknown), data)
    places = tuple(map(tuple, np.round(placed.target_offsets, 4).tolist())) if "tool" in unknown else ()
    seen = data.p[data.seen]
    spread = float(np.median(np.linalg.norm(seen - seen.mean(axis=0), axis=1)))
    size = (len(data), count, len(seen))
    return Trial(args.data, *size, units, answer.before, unknown, after, spread, places)


def _placed(robot: Robot, data: Measurements) -> tuple[Robot, float]:
    """The robot with what is unknown of its placement fitted, and the points' median distance from it [m]."""
    try:
        placed = replace(place_nominal(IdentificationProblem(robot, data)), parameter_names=())
    except NotEnoughDataError:
        return robot, float("inf")
    return placed, float(np.median(np.linalg.norm(data.p - placed.positions(data.q), axis=2)[data.seen]))


# ── what is written and said ─────────────────────────────────────────────────────────────────────────


def _values(args: argparse.Namespace, trial: Trial | None) -> dict[str, Any]:
    """Key → plain value for the file; paths from its folder."""
    folder = user_path(args.output).resolve().parent
    values: dict[str, Any] = {}
    for key in CELL_KEYS:
        value = getattr(args, key.replace("-", "_"), None)
        if value is None or value == "":
            continue
        if key in PATHS and value not in (*shipped_robots(), "typical", "paper") and not os.path.isabs(value):
            value = os.path.relpath(user_path(value).resolve(), folder)
        if key == "payload":
            value = value[0] if len(value) == 1 else value
        if key == "couple":
            values[key] = [str(one) for one in value]
            continue
        if key == "mounting" and value not in ("floor", "ceiling"):
            value = numbers(str(value))
        values[key] = value
    stated = [u for u, given in (("mm", args.millimetres), ("deg", args.degrees)) if given]
    units = stated if trial is None else list(trial.units)
    if units:
        values["units"] = ",".join(units)
    if trial is not None and trial.agrees:
        values.setdefault("unknown", ",".join(trial.unknown) or "none")
        if trial.places:  # a plan has to know about where they are, and how many
            values.setdefault("targets", [list(place) for place in trial.places])
    return values


def _answer(cell: Cell, robot: Robot, trial: Trial | None) -> dict[str, Any]:
    stated = {key: getattr(cell, key.replace("-", "_")) for key in CELL_KEYS}
    tried = None if trial is None else {**vars(trial), "agrees": trial.agrees}
    result: dict[str, Any] = plain(
        {
            "output": cell.path,
            "cell": {key: value for key, value in stated.items() if value is not None},
            "joint_names": robot.joint_names,
            "data": tried,
        }
    )
    return result


def _show(cell: Cell, robot: Robot, trial: Trial | None, console: Console) -> None:
    console.print(f"{robot.name}: {counted(len(robot.joint_names), 'joint')} ({', '.join(robot.joint_names)})")
    for line in () if trial is None else trial.describe():
        console.print(line, soft_wrap=True)
    console.print(f"Written to {cell.path}:", soft_wrap=True)
    for line in read_text(cell.path, "a cell").splitlines():
        if line and not line.startswith("#"):
            console.print(f"  {line}", soft_wrap=True)
    console.print(f"Next: calib-planner identify --cell {cell.path} --data FILE", soft_wrap=True)
