# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner identify``: what the measurements say about the robot."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np

from calib_planner.acquisition import StandstillSettings
from calib_planner.arrays import plain
from calib_planner.cli.arguments import (
    KNOWN,
    TYPICAL,
    Commands,
    Group,
    add_command,
    add_parameters,
    add_reading,
    add_robot,
    add_seed,
    add_test_poses,
    choose_parameters,
    column_names,
    load_robot,
    option,
    reading_of,
    switch,
    tell_coarse,
    test_poses,
)
from calib_planner.cli.estimate_table import show_estimate
from calib_planner.cli.gravity import add_gravity, error_model_of, gravity_note
from calib_planner.cli.terminal import Terminal
from calib_planner.error_model import ACCURACIES, Prior, with_tolerances
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError
from calib_planner.identification import (
    LOSSES,
    Estimate,
    IdentificationProblem,
    find_misplacement,
    identify,
    validate,
)
from calib_planner.io import (
    BagTopics,
    Reading,
    Sources,
    check_writable,
    is_bag,
    placement,
    read_instrument,
    read_prior,
    read_source,
    read_sources,
    require_urdf,
    user_path,
    write_calibrated_urdf,
    write_estimate,
    write_kinematics,
)
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot, grouped, not_in_origins
from calib_planner.tracker import LaserTracker, Noise
from calib_planner.units import length

EXAMPLE = """calib-planner identify --robot irb120.urdf --data calibration.csv --parameters full \\
      --unknown base,tool --validate test.csv --validate-target-from 1 --output estimate.yaml"""

DESCRIPTION = """Identify the robot's parameters from measured points.

A table has a column per joint, in any order, and x1,y1,z1[,x2,…] per reflector in the tracker's frame; empty
cells: not measured. Optional std_x1,… weigh the points. Other columns are ignored. What a file is like
(separator, decimal mark, columns, units) is recognised and said. A bag (folder, .db3, .mcap) gives a row per
standstill.

The verdict comes first: PASS, WARN or FAIL, with reasons and what to do. It does not change the exit status:
a calibration that failed its checks is an answer too. Rows count from 0 in JSON and estimate files."""


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "identify", summary, run, EXAMPLE, DESCRIPTION)
    add_robot(parser)
    add_reading(parser)
    add_parameters(parser, "told by the points; none: both are as the robot and --targets say")
    add_data(parser)
    add_noise(parser)
    add_gravity(parser)
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
    reading = source_reading(args, terminal)
    noise_given = args.sigma is not None or args.instrument is not None
    sources = read_sources(args.data, robot, reading, noise_given=noise_given)
    _find_unknown(robot, sources, args, terminal)
    robot = _with_targets(robot, sources, args)
    problem = _problem(robot, sources, args, terminal)
    held_out = [_held_out(path, robot, args, replace(reading, points=())) for path in args.validate or ()]
    with terminal.progress("identifying") as update:
        estimate = _estimate(problem, held_out, args, update)
    settled = estimate.fit.status != "not_converged"
    written = write_outputs(args, problem, estimate) if settled else {}
    data = {"data": [{"file": s.path, "rows": len(s.data)} for s in sources.files]}
    result = estimate.to_dict() | plain(placement(estimate)) | data | written
    terminal.answer(result, partial(show_estimate, estimate, where=sources.where))
    if problem.error_model is not None and problem.error_model.gravity is not None:
        terminal.note(gravity_note(estimate.knowledge.model.gravity, problem.error_model.gravity, robot))
    if not settled:
        raise CalibPlannerError(estimate.fit.message + (" Nothing was written." if _outputs(args) else ""))
    tell_outputs(args, written, terminal)


def _problem(
    robot: Robot, sources: Sources, args: argparse.Namespace, terminal: Terminal
) -> IdentificationProblem:
    if args.sigma is not None:
        tell_coarse("--sigma", args.sigma, args)
    model = error_model_of(args, args.error_model, robot, sources.data)
    if args.prior == TYPICAL:
        model = with_tolerances(model)
    return IdentificationProblem(
        robot=robot,
        data=sources.data,
        error_model=model,
        sigma=args.sigma,
        instrument=instrument_of(args, terminal),
        prior=prior_of(args, robot, terminal),
        loss=args.loss,
        test_poses=test_poses(robot, args),
        required_accuracy=args.required_accuracy,
        accuracy_frame=args.accuracy_frame,
    )


def _estimate(
    problem: IdentificationProblem,
    held_out: list[Measurements],
    args: argparse.Namespace,
    update: Callable[[float, str], None],
) -> Estimate:
    estimate = identify(problem, watch=update)
    if estimate.fit.status == "not_converged" or not held_out:
        return estimate
    return validate(problem, estimate, held_out, args.validate_target_from)


def _held_out(path: str, robot: Robot, args: argparse.Namespace, reading: Reading) -> Measurements:
    """A file of --validate; re-seated targets may be as many as they like."""
    data = read_source(path, robot, reading).data
    count, most = data.p.shape[1], len(robot.targets)
    if count > most and not args.validate_target_from:
        advice = "other reflectors need --validate-target-from N"
        got = f"points of {count} targets"
        raise FileFormatError(path, "header", got, f"at most {most}, as in --data", advice)
    return data


def _find_unknown(robot: Robot, sources: Sources, args: argparse.Namespace, terminal: Terminal) -> None:
    """What --unknown leaves open: base and tool are unknown if the points fit a robot that stands elsewhere."""
    if args.unknown:
        args.unknown = "" if args.unknown.strip() == KNOWN else args.unknown
        return
    count = sources.data.p.shape[1]
    strange = len(robot.targets) != count
    if strange and args.targets is not None:
        return  # which is refused
    answer = find_misplacement(robot.with_targets(np.zeros((count, 3))) if strange else robot, sources.data)
    unknown = [w for w in ("base", "tool") if w in answer.unknown or (strange and w == "tool")]
    args.unknown = ",".join(unknown)
    if answer.unknown:
        words = " and ".join({"base": "the base", "tool": "the reflectors"}[w] for w in unknown)
        placed = (
            f"{length(answer.after)} with {words} where the points put {'it' if len(unknown) == 1 else 'them'}"
        )
        terminal.note(
            f"The points are {length(answer.before)} from the robot as it is stated, and {placed}: "
            f"--unknown {args.unknown} was taken (--unknown {KNOWN} if the places are known)."
        )
    elif answer.unexplained:
        args.unknown = "base,tool"  # a mistake can only be told from a place with all places free
        terminal.note(
            f"The points are {length(answer.before)} from the robot as it is stated, and no place of base and "
            "reflectors explains that (another robot, other units, order or signs of the joints?): "
            "--unknown base,tool was taken to look for the cause."
        )
    elif strange:
        terminal.note(f"The robot has no place for {count} reflectors: --unknown tool was taken.")


def _with_targets(robot: Robot, sources: Sources, args: argparse.Namespace) -> Robot:
    """The robot with as many targets as the data have, and its active parameters."""
    count = sources.data.p.shape[1]
    if args.targets is None and "tool" in args.unknown.split(","):
        robot = robot.with_targets(np.zeros((count, 3)))
    robot = choose_parameters(robot, args)
    if len(robot.targets) != count:
        expected = f"{len(robot.targets)}, as the robot or --targets says"
        advice = 'give --targets "x y z" once per target, or --unknown tool'
        raise FileFormatError(sources.files[0].path, "header", f"points of {count} targets", expected, advice)
    return robot


# ── measurements ─────────────────────────────────────────────────────────────────────────────────────

STANDSTILL = ("joint_tolerance", "point_tolerance", "settle", "duration", "samples", "minimum_samples")
"""Fields of ``StandstillSettings`` that are options."""
BAG_ONLY = (
    "joint_topic",
    "point_topic",
    "child_frame",
    "state_topic",
    *STANDSTILL,
    "repeatability",
    "accept_damaged",
)


def add_data(parser: argparse.ArgumentParser) -> None:
    """--data, its points, --millimetres and what bags need."""
    data = parser.add_argument_group("measurements")
    text = "table (text, XLSX, MAT, NPY, NPZ, JSON) or bag; repeat to take several together"
    option(data, "--data", "FILE", text, required=True, action="append")
    add_points(data)
    add_bags(parser)


def add_points(data: Group) -> None:
    """--points, what may be stated about them, and --millimetres."""
    text = "list of points beside a table that has the joints only; repeat, one list per reflector"
    option(data, "--points", "FILE", text, action="append")
    option(data, "--point-columns", '"name x y z"', "as --columns, for --points", kind=column_names)
    text = "how points and joints belong together: name, time or order (the first that is possible)"
    option(data, "--match", None, text, choices=("name", "time", "order"))
    switch(data, "--millimetres", "lengths in files where nothing else is written are in mm")


def add_bags(parser: argparse.ArgumentParser) -> None:
    """What bags need."""
    bags = parser.add_argument_group("measurements from bags (docs/real-robot-data.md)")
    text = "topic of sensor_msgs/JointState; repeat, if each has some of the joints (joint_states)"
    option(bags, "--joint-topic", "T", text, action="append")
    text = "topic of points, poses or transforms, stamped; repeat, one per reflector (tracker/point)"
    option(bags, "--point-topic", "T", text, action="append")
    text = "child_frame_id of the reflector, in transforms; repeat, one per reflector (the first one that comes)"
    option(bags, "--child-frame", "NAME", text, action="append")
    text = "topic of std_msgs/Bool: whether the tracker sees the reflector; repeat, one per reflector (none)"
    option(bags, "--state-topic", "T", text, action="append")
    for field in (f for f in fields(StandstillSettings) if f.name in STANDSTILL):
        unit = f" [{field.metadata['unit']}]" if field.metadata["unit"] else ""
        text = f"{field.metadata['description']}{unit} ({field.default:g})"
        option(bags, _flag(field.name), "V", text, kind=type(field.default))
    text = "standard deviation of a coordinate that averaging does not reduce [m] (0)"
    option(bags, "--repeatability", "S", text, kind=float)
    text = "use what can be read of a damaged bag"
    bags.add_argument("--accept-damaged", action="store_true", default=None, help=text)


def source_reading(args: argparse.Namespace, terminal: Terminal) -> Reading:
    """How the options of ``add_data`` and ``add_reading`` say that files are read."""
    given = {name: getattr(args, name) for name in STANDSTILL if getattr(args, name) is not None}
    return reading_of(
        args,
        terminal,
        points=tuple(args.points or ()),
        point_columns=args.point_columns or (),
        match=args.match or "",
        topics=BagTopics(
            args.joint_topic or ("joint_states",),
            args.point_topic or ("tracker/point",),
            args.child_frame or (),
            args.state_topic or (),
        ),
        standstill=StandstillSettings(**given),
        repeatability=args.repeatability or 0.0,
        accept_damaged=bool(args.accept_damaged),
        progress=terminal.progress,
    )


def check_files(args: argparse.Namespace) -> None:
    """Refuse what does not go with the files given.

    Raises:
        InputError: A file twice, points for several files or none, or an option for bags without a bag.
    """
    taken = set()
    for flag, path in [("--data", p) for p in args.data] + [("--validate", p) for p in args.validate or ()]:
        place = user_path(path).resolve()
        if place in taken:
            advice = "a copy is no measurement" if flag == "--data" else "what was fitted proves nothing"
            raise InputError(flag, f"{path} again", "each file once", advice)
        taken.add(place)
    bags = [path for path in (*args.data, *(args.validate or ())) if is_bag(path)]
    check_points(args)
    for name in BAG_ONLY:
        if not bags and getattr(args, name) is not None:
            raise InputError(_flag(name), getattr(args, name), "a bag among --data or --validate")


def check_points(args: argparse.Namespace) -> None:
    """Refuse points that cannot belong to the files of --data.

    Raises:
        InputError: Points for several files, or something about points without any.
    """
    if args.points and (len(args.data) > 1 or is_bag(args.data[0])):
        got = f"{len(args.data)} files" if len(args.data) > 1 else "a bag"
        raise InputError("--points", got, "one table of joints as --data", "import the pairs one by one")
    for flag, value in (("--point-columns", args.point_columns), ("--match", args.match)):
        if value and not args.points:
            raise InputError(flag, value, "--points FILE beside it")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


# ── noise, prior knowledge and what is wanted ────────────────────────────────────────────────────────

DEFAULTS = {name: field.default for name, field in IdentificationProblem.__dataclass_fields__.items()}


def add_noise(parser: argparse.ArgumentParser) -> None:
    """How the measurements may err, and how the fit is made."""
    group = parser.add_argument_group("how the measurements err")
    noise = group.add_mutually_exclusive_group()
    text = "standard deviation of one coordinate [m] (the file's, else that of the residuals)"
    option(noise, "--sigma", "S", text, kind=float)
    text = "YAML: noise by direction (config/instruments/); the station is in the frame of the points"
    option(noise, "--instrument", "FILE", text)
    text = "robust: points that the others find impossible are rejected, with the reason; linear: every point "
    text += "counts; auto: robust, but linear for --error-model paper"
    option(group, "--loss", None, text, DEFAULTS["loss"], choices=LOSSES)
    text = "how the robot errs: typical (gravity, joint functions and repeatability are estimated with the "
    text += "parameters), paper (noise alone), or YAML, also an earlier estimate"
    option(group, "--error-model", "E", text, TYPICAL)


def add_prior(parser: argparse.ArgumentParser) -> None:
    """What is known beforehand."""
    group = parser.add_argument_group("what is known beforehand")
    text = "YAML of expected values and their standard deviations, or an earlier estimate (without its base and "
    text += f"targets); {TYPICAL}: the data sheet within usual manufacturing errors (what the error model says)"
    option(group, "--prior", "FILE", text)
    text = "the reflectors sit where they did in the earlier estimate: take their places over too"
    option(group, "--prior-includes", "tool", text, choices=("tool",))


def add_checks(parser: argparse.ArgumentParser) -> None:
    """How good it is and has to be."""
    check = parser.add_argument_group("how good is it")
    add_test_poses(check, "where the predicted accuracy is wanted")
    text = (
        "world: in the frame of the points; robot: up to a new registration of the robot, at four test poses or "
    )
    text += "more"
    option(check, "--accuracy-frame", None, text, DEFAULTS["accuracy_frame"], choices=ACCURACIES)
    text = "largest error that is acceptable at a test pose [m] (not checked)"
    option(check, "--required-accuracy", "A", text, kind=float)
    option(check, "--validate", "FILE", "held-out table or bag; repeat for several", action="append")
    text = "the reflector was re-seated: its offset comes from the first N rows of each held-out file"
    option(check, "--validate-target-from", "N", text, 0)
    add_seed(check)


def prior_of(args: argparse.Namespace, robot: Robot, terminal: Terminal) -> Prior | None:
    """The prior that the options ask for; ``robot`` has its active parameters.

    Raises:
        InputError: --prior-includes without an estimate to take something from.
        FileFormatError: As ``read_prior``.
    """
    if args.prior is None or args.prior == TYPICAL:
        if args.prior_includes:
            got = f"--prior {args.prior}" if args.prior else "no --prior"
            raise InputError("--prior-includes", got, "--prior FILE with an estimate")
        return None
    file = read_prior(args.prior, robot, targets=args.prior_includes == "tool")
    if file.left_out:
        terminal.note(f"{args.prior}: left out of the prior: {', '.join(grouped(file.left_out))}")
    return file.prior


def instrument_of(args: argparse.Namespace, terminal: Terminal) -> Noise | None:
    """The noise model of --instrument; says where it stands, which is easily another frame's station."""
    if args.instrument is None:
        return None
    noise = read_instrument(args.instrument)
    if isinstance(noise, LaserTracker):
        x, y, z = np.asarray(noise.station).tolist()
        terminal.note(
            f"{args.instrument}: the tracker stands at {x:g}, {y:g}, {z:g} m in the frame of the points"
        )
    return noise


# ── outputs ──────────────────────────────────────────────────────────────────────────────────────────

OUTPUTS = {
    "--output": ("Estimate", "the estimate as YAML"),
    "--report": ("Report", "one HTML page: verdict, accuracy, 3-D view, residuals"),
    "--urdf-output": ("Calibrated URDF", "the calibrated URDF: the nominal one with its joints' origins changed"),
    "--kinematics-output": (
        "Kinematics",
        "xyz and rpy per joint as YAML, as the driver of Universal Robots reads it",
    ),
}
"""Option → what is written there, and its help."""


def add_outputs(parser: argparse.ArgumentParser) -> None:
    """One option per kind of file."""
    group = parser.add_argument_group("what to write")
    for flag, (_, text) in OUTPUTS.items():
        option(group, flag, "FILE", text)


def check_outputs(args: argparse.Namespace, robot: Robot) -> None:
    """Find out before the work what could not be written after it.

    Raises:
        InputError: Two outputs of one name, a folder that is not there, no URDF to calibrate.
    """
    taken: dict[Any, str] = {}
    for flag, path in _outputs(args).items():
        place = user_path(path).resolve()
        if place in taken:
            raise InputError(flag, path, f"another file than {taken[place]}")
        check_writable(path, flag)
        taken[place] = flag
    if args.urdf_output:
        require_urdf(robot, "--urdf-output")


def write_outputs(args: argparse.Namespace, problem: IdentificationProblem, estimate: Estimate) -> dict[str, Any]:
    """Write the files that the options name; the answer's keys about them."""
    robot = estimate.calibrated
    if args.output:
        write_estimate(args.output, estimate, "--output", problem)
    if args.report:
        from calib_planner.report import (  # 0.1 s for templates, which only a report needs
            provenance,
            write_report,
        )

        inputs = [("robot", args.robot), *(("data", f) for f in args.data)]
        inputs += [("held out", f) for f in args.validate or ()]
        inputs += [("cell", args.cell)] if args.cell else []
        command = shlex.join(["calib-planner", *sys.argv[1:]])
        source = provenance(inputs, command=command, seed=args.seed, estimate=args.output or "")
        write_report(args.report, problem, estimate, source, "--report")
    if args.urdf_output:
        write_calibrated_urdf(args.urdf_output, robot, field="--urdf-output")
    if args.kinematics_output:
        write_kinematics(args.kinematics_output, robot)
    written: dict[str, Any] = {_key(flag): path for flag, path in _outputs(args).items()}
    if args.urdf_output or args.kinematics_output:
        written["not_written"] = list(not_in_origins(robot))
    return written


def tell_outputs(args: argparse.Namespace, written: dict[str, Any], terminal: Terminal) -> None:
    """Say what was written and what has no place there."""
    for flag, path in _outputs(args).items():
        terminal.note(f"{OUTPUTS[flag][0]} written to {path}")
    if written.get("not_written"):
        places = " and ".join(p for p in (args.urdf_output, args.kinematics_output) if p)
        names = ", ".join(grouped(written["not_written"]))
        text = f"Not written to {places}, which cannot hold it: {names} (tracker's frame and reflectors)"
        terminal.note(text)


def _outputs(args: argparse.Namespace) -> dict[str, str]:
    """Option → path of the files to be written."""
    paths = {flag: getattr(args, _key(flag)) for flag in OUTPUTS}
    return {flag: path for flag, path in paths.items() if path}


def _key(flag: str) -> str:
    return flag[2:].replace("-", "_")
