# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Arguments that several commands share, and how their text becomes numbers and robots."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from calib_planner.arrays import FloatArray, check_number
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import InputError
from calib_planner.io import angle_factors, shipped_robots
from calib_planner.robot import Coupling, Robot, check_reflectors, parse_coupling
from calib_planner.tracker import Isotropic
from calib_planner.units import UNSAID, Units, length, quantity

if TYPE_CHECKING:
    from calib_planner.planning import Pace

if TYPE_CHECKING:
    from calib_planner.io import Reading

Commands = Any  # argparse's own type for what add_subparsers returns is private
Group = argparse._ActionsContainer
TYPICAL = "typical"
"""The word after --prior for the data sheet within usual manufacturing errors."""
ERROR_MODEL = "typical"
"""How a simulated robot errs, where nothing else is said: as measured robots do."""
KNOWN = "none"
"""Value of --unknown for a base and targets that are as the robot and --targets say."""
SIGMA = 3e-5
"""Standard deviation of one coordinate of a laser tracker, where nothing else is said [m]."""
COARSE = 5e-3
"""An instrument that errs by more [m] is told: robots err less before they are calibrated. It is no error, since
plans are the same whatever the scale of σ."""


def add_command(
    commands: Commands,
    name: str,
    summary: str,
    run: Any,
    example: str,
    description: str = "",
    *,
    cell: bool = True,
) -> argparse.ArgumentParser:
    """A command's parser with what every command has: --json, --cell where it is of use, an example in --help."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=description or f"{summary[:1].upper()}{summary[1:]}.",
        epilog=f"Example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument("--json", action="store_true", help="print one JSON object, in SI units and radians")
    if cell:
        text = "cell.yaml, written by init: options for all commands; those that are given here win"
        parser.add_argument("--cell", metavar="FILE", help=text)
    return parser


def option(
    group: Group,
    flag: str,
    metavar: str | None,
    text: str,
    default: Any = None,
    kind: Callable[[str], Any] | None = None,
    **more: Any,
) -> None:
    """Add an option with a value; its help ends with the default value, if it has one.

    Args:
        text: The help; an option whose help names a unit, [m], [rad], [s] or [kg], takes others too: ``20um``.
        kind: What makes the value out of the text: by default the type of ``default``, or text.
        more: Further arguments of ``add_argument``.
    """
    units = set(re.findall(r"\[(m|rad|s|kg)\]", text))
    if default is not None:
        kind = kind or type(default)
    if len(units) == 1 and kind in (float, numbers):
        kind = (quantity_in if kind is float else quantities_in)(units.pop())
    if default is not None:
        shown = f"{default:g}" if isinstance(default, (int, float)) else str(default)
        text = f"{text} ({'none' if shown == 'inf' else shown})"
    group.add_argument(flag, type=kind or str, default=default, metavar=metavar, help=text, **more)


def switch(group: Group, flag: str, text: str) -> None:
    """Add an option without a value."""
    group.add_argument(flag, action="store_true", help=text)


def add_seed(parser: Group, usual: int = 0) -> None:
    option(parser, "--seed", "N", "seed of all random numbers; the same seed gives the same result", usual)


def add_robot(parser: argparse.ArgumentParser, otherwise: str = "", *, targets: bool = True) -> None:
    """The robot's options; ``otherwise`` says what is taken without --robot, which is required if empty.

    Without ``targets`` there is no option for the reflectors: they are as the robot says.
    """
    group = parser.add_argument_group("robot")
    text = "name of a shipped robot, robot YAML or URDF" + (f" ({otherwise})" if otherwise else "")
    option(group, "--robot", "R", text, required=not otherwise)
    add_links(group)
    add_couple(group)
    parser.set_defaults(targets=None)
    if targets:
        text = "a reflector in the frame of the last link [m]; repeat for several"
        option(group, "--targets", '"x y z"', text, kind=numbers, action="append")
    text = "angles in arguments, and in files where nothing else is written, are degrees; output is in radians"
    switch(group, "--degrees", text)


def add_links(group: Group) -> None:
    """The two ends of the chain in a URDF."""
    option(group, "--base-link", "LINK", "first link of the chain in a URDF (its root)")
    option(group, "--tip-link", "LINK", "last link of the chain in a URDF (its only end, or tool0)")


def add_couple(group: Group) -> None:
    """Joints that the controller shows against others."""
    text = "the controller shows j3 plus j2 (parallelogram arms); also j3-=j2, j3+=FACTOR*j2; repeat for several"
    option(group, "--couple", "j3+=j2", text, kind=coupling, action="append")


def coupling(text: str) -> Coupling:
    """``j3+=j2``."""
    try:
        return parse_coupling(text, "--couple")
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error).removeprefix("--couple: ")) from None


def add_parameters(parser: argparse.ArgumentParser, unknown: str = "none") -> None:
    """--parameters and --unknown; ``unknown``: what the help says of the latter's default."""
    group = parser.add_argument_group("what is unknown")
    text = "lengths+offsets, lengths, offsets, full, another level of the robot's file, or NAME,NAME,… "
    text += "(the robot's own; see robots show)"
    option(group, "--parameters", "P", text)
    text = "base (pose of the robot in the tracker's frame), tool (offsets of the reflectors) or base,tool "
    text += f"({unknown})"
    group.add_argument("--unknown", default="", metavar="U", help=text)


def add_reading(parser: argparse.ArgumentParser) -> None:
    """What may be stated about tables that are read."""
    group = parser.add_argument_group("tables that are read (what is not stated is recognised, and said)")
    text = (
        "units of lengths and angles in files and of angles in arguments, and of a CSV of configurations that is "
    )
    text += "written: m, mm, cm, in, …; rad, deg, …"
    group.add_argument("--units", action=_Units, metavar="U", help=f"{text} (m,rad)")
    text = "names of all columns, in order: joints, x1 y1 z1 x2 …, std_x1 …; '-' for one that plays no part"
    option(group, "--columns", '"q1 … z1"', text, kind=column_names)
    option(
        group, "--separator", "S", "what separates the cells of text: comma, semicolon, tab, bar or white space"
    )


class _Units(argparse.Action):
    """--units, of which degrees hold for arguments too."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        try:
            namespace.units = Units.parse(values)
        except InputError as error:
            raise argparse.ArgumentError(
                self, f"expected {error.expected}, got {error.got}; {error.advice}"
            ) from None
        if namespace.units.angle:
            namespace.degrees = namespace.units.angle == "deg"


def column_names(text: str) -> tuple[str, ...]:
    """Names of columns separated by blanks or commas; ``q1 … q6`` stands for those between."""
    names: list[str] = []
    words = text.replace(",", " ").split()
    for i, word in enumerate(words):
        if word not in ("…", "..."):
            names.append(word)
            continue
        ends = [re.fullmatch(r"(.*?)(\d+)", w) for w in (*words[i - 1 : i], *words[i + 1 : i + 2])]
        if len(ends) != 2 or None in ends or ends[0][1] != ends[1][1]:  # type: ignore[index]
            raise argparse.ArgumentTypeError(
                f"expected numbered names around {word}, as in q1 … q6, got {text!r}"
            )
        first, last = (int(e[2]) for e in ends)  # type: ignore[index]
        names += [f"{ends[0][1]}{k}" for k in range(first + 1, last)]  # type: ignore[index]
    return tuple(names)


def reading_of(args: argparse.Namespace, terminal: Terminal | None = None, **more: Any) -> Reading:
    """How the options of ``add_reading`` say that tables are read; ``more``: further fields of ``Reading``."""
    # What reads tables, 0.05 s, is imported for tables only.
    from calib_planner.io import Reading

    other = Units("mm" if getattr(args, "millimetres", False) else "", "deg" if args.degrees else "")
    note = (terminal or Terminal(json_wanted=args.json)).note
    return Reading(
        units=getattr(args, "units", None) or UNSAID,
        otherwise=other,
        columns=getattr(args, "columns", None) or (),
        separator=getattr(args, "separator", None) or "",
        note=note,
        **more,
    )


def configurations_in(units: Units | None, robot: Robot, q: FloatArray) -> tuple[tuple[str, ...], FloatArray]:
    """Names and numbers (N, joints) of configurations ``q`` [rad | m] for a table in the units of --units.

    Units that are stated stand in the names, so that the table is read again as it is.
    """
    if units is None:
        return robot.joint_names, q
    from calib_planner.io import in_units, with_units  # as in reading_of

    return with_units(robot, units), in_units(robot, q, units)


def add_test_poses(parser: Group, purpose: str) -> None:
    text = f"joint coordinates [rad | m] {purpose}; repeat for several"
    option(parser, "--test-pose", '"q1 … qn"', text, kind=numbers, action="append")


def add_test_path(parser: Group) -> None:
    option(parser, "--test-path", "FILE", "table with a column per joint; every row is a test pose")


def numbers(text: str) -> list[float]:
    """Numbers separated by spaces or commas."""
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected numbers, got {text!r}") from None


def quantity_in(unit: str) -> Callable[[str], float]:
    """What reads a number with or without its unit as a number in ``unit``."""

    def read(text: str) -> float:
        try:
            return quantity(text, unit)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def quantities_in(unit: str) -> Callable[[str], list[float]]:
    """The same for numbers separated by spaces or commas, each with or without its unit: ``60mm 0 90mm``."""
    read = quantity_in(unit)
    return lambda text: [read(word) for word in text.replace(",", " ").split()]


def load_robot(args: argparse.Namespace) -> Robot:
    """The robot of ``add_robot``, with its targets and the parameters of its file, whose oddities are said."""
    robot = Robot.load(args.robot, base_link=args.base_link, tip_link=args.tip_link)
    for remark in robot.remarks:
        Terminal(json_wanted=args.json).note(f"{args.robot}: {remark}")
    if args.couple:
        robot = robot.with_couplings(args.couple, "--couple")
    if args.targets is not None:
        robot = robot.with_targets(rows("--targets", args.targets, "xyz"))
    check_reflectors(robot, "--robot" if args.targets is None else "--targets")
    return robot


def load_planned_robot(args: argparse.Namespace, planned: str) -> Robot:
    """The robot of --robot, else ``planned``, the one that the plan names, which has to be a shipped one."""
    if args.robot is None and planned not in shipped_robots():
        advice = f"state --robot FILE or --cell FILE: the plan holds no more of {planned} than its name"
        raise InputError("--robot", "nothing", f"the file of {planned}", advice)
    args.robot = args.robot or planned
    return load_robot(args)


def tell_coarse(source: str, sigma: float, args: argparse.Namespace) -> None:
    """Say that an instrument with ``sigma`` [m], as ``source`` has it, is too coarse to be true."""
    if sigma > COARSE:
        said = f"{source}: {length(sigma)} in each coordinate is more than robots err by: millimetres?"
        Terminal(json_wanted=args.json).note(said)


def choose_parameters(robot: Robot, args: argparse.Namespace) -> Robot:
    """The robot with the active parameters of ``add_parameters``."""
    request = args.parameters or robot.parameter_names
    return robot.with_parameters(request, [u for u in args.unknown.split(",") if u.strip() not in ("", KNOWN)])


def test_poses(robot: Robot, args: argparse.Namespace) -> FloatArray | None:
    """(K, joints) of --test-pose and --test-path [rad | m], or ``None`` without either."""
    poses = []
    if args.test_pose is not None:
        poses.append(joint_rows("--test-pose", args.test_pose, robot, args))
    if getattr(args, "test_path", None) is not None:
        from calib_planner.io import read_configurations  # as in reading_of

        poses.append(read_configurations(args.test_path, robot, reading_of(args)))
    return np.vstack(poses) if poses else None


def require_test_poses(robot: Robot, poses: FloatArray | None) -> FloatArray:
    """``poses``, unless there are none."""
    if poses is None:
        expected = f"{len(robot.joint_names)} numbers: {', '.join(robot.joint_names)}"
        raise InputError("--test-pose", "none", expected, "give --test-pose or --test-path")
    return poses


def joint_rows(
    option: str, given: Sequence[Sequence[float]], robot: Robot, args: argparse.Namespace
) -> FloatArray:
    """(N, joints) configurations of an option [rad | m]."""
    return rows(option, given, robot.joint_names) * angle_factors(robot, degrees=args.degrees)


def rows(option: str, given: Sequence[Sequence[float]], names: Sequence[str]) -> FloatArray:
    """(N, names) the numbers of an option, checked."""
    for row in given:
        if len(row) != len(names):
            raise InputError(option, f"{len(row)} numbers", f"{len(names)} numbers: {', '.join(names)}")
    array = np.array(given, float)
    if not np.isfinite(array).all():
        raise InputError(option, "a number that is not finite", "finite numbers", "correct that number")
    return array


# ── how long it takes ────────────────────────────────────────────────────────────────────────────────


def add_pace(parser: argparse.ArgumentParser) -> None:
    """How fast the robot moves, settles and is measured; see ``chosen_pace``."""
    group = parser.add_argument_group("travel and time")
    option(group, "--start", '"q1 … qn"', "where the robot stands before the first visit [rad | m]", kind=numbers)
    speed = group.add_mutually_exclusive_group()
    option(speed, "--speed", "V", "largest speed of every joint [rad/s | m/s]", kind=float)
    text = "share of the speed limits in the URDF, 0 … 1 (0.25); 0.5 rad/s and 0.1 m/s without limits"
    option(speed, "--speed-share", "F", text, kind=float)
    text = "largest acceleration of every joint [rad/s² | m/s²] (twice the speed per second)"
    option(group, "--acceleration", "A", text, kind=float)
    option(
        group, "--settle", "S", "time at rest before each measurement, until the arm is still [s] (2)", kind=float
    )
    option(group, "--dwell", "S", "time of each measurement, at rest [s] (3)", kind=float)


def paced(args: argparse.Namespace) -> bool:
    """Whether anything is said about ``add_pace``."""
    names = ("start", "speed", "speed_share", "acceleration", "settle", "dwell")
    return any(getattr(args, name) is not None for name in names)


def chosen_pace(robot: Robot, args: argparse.Namespace) -> Pace:
    """The pace of ``add_pace``'s arguments, of what is usual where nothing is said."""
    from calib_planner.io import robot_pace  # with planning, 0.2 s, for commands that tell of time

    usual = robot_pace(robot)
    if args.speed_share is not None:
        share = check_number("--speed-share", args.speed_share, low=0, low_open=True, high=1.0)
        usual = robot_pace(robot, share=share)
    pace, joints = usual, len(robot.joint_names)
    if args.speed is not None:
        speed = check_number("--speed", args.speed, low=0, low_open=True, high=100.0, unit="rad/s or m/s")
        text = f"at most {speed:g} rad/s or m/s"
        pace = replace(usual, speeds=np.full(joints, speed), accelerations=None, origin=text)
    if args.acceleration is not None:
        push = check_number("--acceleration", args.acceleration, low=0, low_open=True, high=1e4, unit="rad/s²")
        pace = replace(pace, accelerations=np.full(joints, push))
    for name in ("settle", "dwell"):
        if getattr(args, name) is not None:
            seconds = check_number(f"--{name}", getattr(args, name), low=0, high=86_400, unit="s")
            pace = replace(pace, **{name: seconds})  # type: ignore[arg-type]
    return pace


def start_of(robot: Robot, args: argparse.Namespace) -> FloatArray | None:
    """(joints,) of --start [rad | m], or ``None``."""
    return None if args.start is None else joint_rows("--start", [args.start], robot, args)[0]


NUMBER = r"(\d+(?:\.\d*)?)"
TIME = re.compile(rf"(?:{NUMBER}\s*h)?\s*(?:{NUMBER}\s*min)?\s*(?:{NUMBER}\s*s?)?")
"""Hours, minutes and seconds, each with its unit; but see ``seconds``."""


def seconds(text: str) -> float:
    """A time: 2h, 90min, 7200s, 1h30; a number alone is in seconds, and one after hours is in minutes."""
    word = re.sub(r"h\s*(\d+(?:\.\d*)?)$", r"h\1min", text.strip().lower())
    match = TIME.fullmatch(word)
    if match is None or not word:
        raise argparse.ArgumentTypeError(f"expected a time such as 2h, 90min, 1h30 or 7200s, got {text!r}")
    hours, minutes, rest = (float(part or 0) for part in match.groups())
    return 3600.0 * hours + 60.0 * minutes + rest


# ── what the instrument is and what may be measured at all ───────────────────────────────────────────


def add_conditions(parser: Group) -> None:
    """--constraints, and --sigma or --instrument."""
    text = "YAML: workspace, floor, tracker's view, … (config/constraints.yaml shows all)"
    option(parser, "--constraints", "FILE", text)
    noise = parser.add_mutually_exclusive_group()
    option(noise, "--sigma", "S", "standard deviation of one coordinate of the tracker [m]", SIGMA)
    option(noise, "--instrument", "FILE", "YAML: noise by direction (config/instruments/)")


def conditions(args: argparse.Namespace, robot: Robot) -> dict[str, Any]:
    """The fields of ``PlanProblem`` that ``add_conditions`` is about."""
    # Planning, 0.2 s, is imported for these files only.
    from calib_planner.io import read_constraints, read_instrument

    noise = Isotropic(args.sigma) if args.instrument is None else read_instrument(args.instrument)
    tell_coarse("--sigma" if args.instrument is None else args.instrument, noise.typical, args)
    if args.constraints is None:
        return {"noise": noise}
    return {"noise": noise, "constraints": read_constraints(args.constraints, robot)}
