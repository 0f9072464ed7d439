"""``calib-planner identify``: what the measurements say about the robot."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.acquisition import StandstillSettings
from calib_planner.arrays import IntArray, plain
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
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError, NotEnoughDataError
from calib_planner.identification import (
    AUTOMATIC,
    LOSSES,
    Estimate,
    IdentificationProblem,
    Prior,
    check_units,
    cross_validate,
    identify,
    typical_prior,
    validate,
)
from calib_planner.io import (
    BagTopics,
    is_bag,
    placement,
    read_bag,
    read_instrument,
    read_measurements,
    read_prior,
    require_urdf,
    write_calibrated_urdf,
    write_estimate,
    write_kinematics,
)
from calib_planner.measurements import Measurements
from calib_planner.report import Provenance, provenance, write_report
from calib_planner.robot import Robot, grouped, not_in_origins
from calib_planner.tracker import LaserTracker, Noise

EXAMPLE = """calib-planner identify --robot irb120.urdf --data calibration.csv --parameters full \\
      --unknown base,tool --prior typical --loss robust --folds 5 \\
      --validate test.csv --validate-target-from 1 --output estimate.yaml"""

DESCRIPTION = """Identify the robot's parameters from measured points.

A CSV has a column per joint [rad | m], in any order, and x1,y1,z1[,x2,…] per reflector in the tracker's
frame [m]; empty cells: not measured. Optional std_x1,… [m] weigh the points. Other columns are ignored. A bag
(folder, .db3, .mcap) gives a row per standstill.

The verdict comes first: PASS, WARN or FAIL, with reasons and what to do. It does not change the exit status:
a calibration that failed its checks is an answer too. Rows count from 0 in JSON and estimate files."""


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "identify", summary, run, EXAMPLE, DESCRIPTION)
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
    settled = estimate.fit.status != "not_converged"
    written = write_outputs(args, problem, estimate) if settled else {}
    sources = {"data": [{"file": s.path, "rows": len(s.data)} for s in rows.sources]}
    result = estimate.to_dict() | plain(placement(estimate)) | sources | written
    terminal.answer(result, partial(show_estimate, estimate, where=rows.where))
    if not settled:
        raise CalibPlannerError(estimate.fit.message + (" Nothing was written." if _asked(args) else ""))
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
    if estimate.fit.status == "not_converged":
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


# ── The measurements that ``identify`` reads: CSV files and bags, and where each row of them came from ──────

STANDSTILL = {
    "joint_tolerance": "largest range of a joint at rest [rad | m]",
    "point_tolerance": "largest range of a coordinate at rest, about ten times the tracker's noise [m]",
    "settle": "left out after the joints came to rest [s]",
    "duration": "shortest interval averaged [s]",
    "samples": "points of a reflector wanted per standstill",
    "minimum_samples": "points of a reflector needed to use it at all",
}
"""Fields of ``StandstillSettings`` that are options, with their help."""
BAG_ONLY = ("joint_topic", "point_topic", *STANDSTILL, "repeatability", "accept_damaged")


@dataclass(frozen=True, eq=False)
class Source:
    """A file of measurements.

    Attributes:
        path: The file.
        data: What it holds.
        numbers: (N,) line of each row in a CSV file; number of each standstill in a bag, from 1.
        word: What ``numbers`` count: ``line`` or ``standstill``.
        frame_id: Frame of a bag's points; empty if none is named.
    """

    path: str
    data: Measurements
    numbers: IntArray
    word: str
    frame_id: str = ""


@dataclass(frozen=True, eq=False)
class Rows:
    """All measurements, the sources' rows one after the other."""

    data: Measurements
    sources: tuple[Source, ...]

    def where(self, row: int) -> str:
        """Where row ``row``, from 0, came from: ``line 12 of points.csv``."""
        for source in self.sources:
            if row < len(source.data):
                return f"{source.word} {source.numbers[row]} of {source.path}"
            row -= len(source.data)
        raise IndexError(row)


def add_data(parser: argparse.ArgumentParser) -> None:
    """--data, --millimetres and what bags need."""
    data = parser.add_argument_group("measurements")
    data.add_argument(
        "--data", required=True, action="append", metavar="FILE", help="CSV or bag; repeat to take them together"
    )
    data.add_argument("--millimetres", action="store_true", help="points and std_… of all CSV files are in mm")
    bags = parser.add_argument_group("measurements from bags (docs/real-robot-data.md)")
    bags.add_argument("--joint-topic", metavar="T", help="sensor_msgs/JointState (joint_states)")
    bags.add_argument(
        "--point-topic",
        action="append",
        metavar="T",
        help="geometry_msgs/PointStamped (tracker/point); repeat, one per reflector",
    )
    defaults = {f.name: f.default for f in fields(StandstillSettings)}
    for name, text in STANDSTILL.items():
        value: Any = defaults[name]
        bags.add_argument(_flag(name), type=type(value), metavar="V", help=f"{text} ({value:g})")
    bags.add_argument(
        "--repeatability", type=float, metavar="S", help="std of a coordinate that averaging leaves [m] (0)"
    )
    bags.add_argument(
        "--accept-damaged", action="store_true", default=None, help="use what can be read of a damaged bag"
    )


def read_rows(paths: Sequence[str], robot: Robot, args: argparse.Namespace, terminal: Terminal) -> Rows:
    """All files of --data, as many reflectors in each.

    Raises:
        FileFormatError: A file does not read, or does not fit the others.
    """
    sources = tuple(read_source(path, robot, args, terminal) for path in paths)
    first = sources[0]
    for other in sources[1:]:
        if other.data.p.shape[1] != first.data.p.shape[1]:
            wanted = f"{first.data.p.shape[1]}, as in {first.path}"
            raise FileFormatError(other.path, "points", f"{other.data.p.shape[1]} targets", wanted)
    frames = {s.frame_id: s for s in sources if s.frame_id}
    if len(frames) > 1:
        a, b = list(frames.values())[:2]
        got, advice = repr(b.frame_id), "transform the points: one identification has one tracker frame"
        raise FileFormatError(b.path, "frame_id of the points", got, f"{a.frame_id!r}, as in {a.path}", advice)
    return Rows(_together(sources, given=args.sigma is not None or args.instrument is not None), sources)


def read_source(path: str, robot: Robot, args: argparse.Namespace, terminal: Terminal) -> Source:
    """A CSV file or a bag.

    Raises:
        FileFormatError: As ``read_measurements`` and ``read_bag``, or the points are in millimetres.
    """
    source = _bag(path, robot, args, terminal) if is_bag(path) else _csv(path, robot, args, terminal)
    count = source.data.p.shape[1]
    try:
        check_units(
            robot if len(robot.targets) == count else robot.with_targets(np.zeros((count, 3))), source.data
        )
    except InputError as error:
        doubtful = args.millimetres and error.field == "robot"
        advice = "they are metres already: leave out --millimetres" if doubtful else error.advice
        raise FileFormatError(path, error.field, error.got, error.expected, advice) from None
    return source


def check_files(args: argparse.Namespace) -> None:
    """Refuse what does not go with the files given.

    Raises:
        InputError: A file twice, an option for bags without a bag, or --millimetres with one.
    """
    taken: set[Path] = set()
    for flag, path in [("--data", p) for p in args.data] + [("--validate", p) for p in args.validate or ()]:
        place = Path(path).expanduser().resolve()
        if place in taken:
            advice = "a copy is no measurement" if flag == "--data" else "what was fitted proves nothing"
            raise InputError(flag, f"{path} again", "each file once", advice)
        taken.add(place)
    bags = [path for path in (*args.data, *(args.validate or ())) if is_bag(path)]
    if bags and args.millimetres:
        advice = "points in bags are in metres (REP-103)"
        raise InputError("--millimetres", f"the bag {bags[0]}", "CSV files", advice)
    for name in BAG_ONLY:
        if not bags and getattr(args, name) is not None:
            raise InputError(_flag(name), getattr(args, name), "a bag among --data or --validate")


# ── one file ─────────────────────────────────────────────────────────────────────────────────────────


def _csv(path: str, robot: Robot, args: argparse.Namespace, terminal: Terminal) -> Source:
    file = read_measurements(path, robot, degrees=args.degrees)
    if file.ignored:
        terminal.note(f"{path}: columns ignored: {', '.join(file.ignored)}")
    turning = np.abs(file.data.q[:, robot.joint_is_revolute])
    if not args.degrees and turning.size and turning.max() > 4 * np.pi:
        terminal.note(f"{path}: joint angles up to {turning.max():.4g} rad; are they degrees (--degrees)?")
    return Source(path, _metres(file.data) if args.millimetres else file.data, file.lines, "line")


def _metres(data: Measurements) -> Measurements:
    std = None if data.std is None else np.asarray(data.std) / 1e3
    return Measurements(data.joint_names, data.q, data.p / 1e3, std)


def _bag(path: str, robot: Robot, args: argparse.Namespace, terminal: Terminal) -> Source:
    given = {n: getattr(args, n) for n in STANDSTILL if getattr(args, n) is not None}
    topics = BagTopics(args.joint_topic or "joint_states", tuple(args.point_topic or ("tracker/point",)))
    with terminal.progress(f"reading {path}") as update:
        bag = read_bag(
            path,
            robot,
            topics,
            StandstillSettings(**given),
            repeatability=args.repeatability or 0.0,
            accept_damaged=bool(args.accept_damaged),
            progress=update,
        )
    for line in bag.describe():
        terminal.note(f"{path}: {line}")
    return Source(path, bag.data, np.arange(1, len(bag.data) + 1), "standstill", bag.frame_id)


def _together(sources: Sequence[Source], *, given: bool) -> Measurements:
    """One after the other; ``given``: the noise is stated, so the files' own does not matter."""
    parts = [s.data for s in sources]
    if len(parts) == 1:
        return parts[0]
    std = None
    if not given:
        without = [s.path for s in sources if s.data.std is None]
        if without and len(without) < len(sources):
            advice = "add them, or state the noise of all with --sigma or --instrument"
            raise FileFormatError(without[0], "header", "no std_… columns", "them, as in other files", advice)
        std = None if without else np.concatenate([np.asarray(d.std) for d in parts])
    q, p = np.concatenate([d.q for d in parts]), np.concatenate([d.p for d in parts])
    return Measurements(parts[0].joint_names, q, p, std)


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


# ── What ``identify`` may be told of noise, of the parameters beforehand and of what is wanted ──────────────

DEFAULTS = {name: field.default for name, field in IdentificationProblem.__dataclass_fields__.items()}
TYPICAL = "typical"


def add_noise(parser: argparse.ArgumentParser) -> None:
    """How the measurements may err, and how the fit is made."""
    group = parser.add_argument_group("how the measurements err")
    noise = group.add_mutually_exclusive_group()
    noise.add_argument(
        "--sigma", type=float, metavar="S", help="std of one coordinate [m] (the file's, else the residuals')"
    )
    noise.add_argument(
        "--instrument",
        metavar="FILE",
        help="YAML: noise by direction (config/instruments/); the station is in the frame of the points",
    )
    group.add_argument(
        "--loss",
        choices=LOSSES,
        default=DEFAULTS["loss"],
        help="linear: every point counts; robust: points that do not fit are rejected, with the reason (linear)",
    )
    group.add_argument(
        "--discrepancy",
        choices=AUTOMATIC,
        default=DEFAULTS["discrepancy"],
        help="auto: residuals beyond the noise are what no geometric model holds; off: they are not (auto)",
    )
    group.add_argument(
        "--joint-corrections",
        choices=AUTOMATIC,
        default=DEFAULTS["joint_corrections"],
        help="auto: errors of the joints' transmissions are learnt where the data show them; off: never (auto)",
    )
    for name, text in (("iterations", "most iterations"), ("starts", "other starts, to meet other minima")):
        value = DEFAULTS[name]
        group.add_argument(f"--{name}", type=int, default=value, metavar="N", help=f"{text} ({value})")


def add_prior(parser: argparse.ArgumentParser) -> None:
    """What is known beforehand."""
    group = parser.add_argument_group("what is known beforehand")
    group.add_argument(
        "--prior",
        metavar="FILE",
        help=f"YAML of expected values and their std, or an earlier estimate (without its base and targets); "
        f"{TYPICAL}: data sheet within usual manufacturing errors",
    )
    group.add_argument(
        "--prior-includes",
        choices=("tool",),
        metavar="tool",
        help="the reflectors sit where they did in the earlier estimate: take their places over too",
    )


def add_checks(parser: argparse.ArgumentParser) -> None:
    """How good it is and has to be."""
    check = parser.add_argument_group("how good is it")
    add_test_poses(check, "where the predicted accuracy is wanted")
    check.add_argument("--required-accuracy", type=float, metavar="A", help="largest error that will do [m]")
    check.add_argument(
        "--validate", action="append", metavar="FILE", help="held-out CSV or bag; repeat for several"
    )
    check.add_argument(
        "--validate-target-from",
        type=int,
        default=0,
        metavar="N",
        help="the reflector was re-seated: its offset comes from the first N rows of each held-out file",
    )
    check.add_argument(
        "--folds", type=int, metavar="K", help="cross-validation: leave out each of K parts of --data in turn"
    )
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
        if args.prior is None:
            return None
        prior = typical_prior(robot)
        if prior is None:
            terminal.note("No prior: it knows nothing of base and targets, and nothing else is asked for.")
        return prior
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


# ── What ``identify`` writes: the estimate, and the calibrated robot as other programs take it ──────────────

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
