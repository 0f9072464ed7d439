"""Arguments that several commands share, and how their text becomes numbers and robots."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.errors import InputError
from calib_planner.io import angle_factors, read_configurations
from calib_planner.robot import Robot
from calib_planner.tracker import Isotropic

Commands = Any  # argparse's own type for what add_subparsers returns is private


def add_command(
    commands: Commands, name: str, summary: str, run: Any, example: str, description: str = ""
) -> argparse.ArgumentParser:
    """A command's parser with what every command has: --json, --seed, an example in --help."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=description or summary,
        epilog=f"Example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout, SI units and radians")
    return parser


def add_seed(parser: argparse._ActionsContainer) -> None:
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="same seed, same result (0)")


def add_robot(parser: argparse.ArgumentParser, otherwise: str = "", *, targets: bool = True) -> None:
    """The robot's options; ``otherwise`` says what is taken without --robot, which is required if empty.

    Without ``targets`` there is no option for the reflectors: they are as the robot says.
    """
    group = parser.add_argument_group("robot")
    text = "shipped name, robot YAML or URDF" + (f" ({otherwise})" if otherwise else "")
    group.add_argument("--robot", required=not otherwise, metavar="R", help=text)
    group.add_argument("--base-link", metavar="LINK", help="first link of the chain in a URDF (its root)")
    group.add_argument("--tip-link", metavar="LINK", help="last link of the chain in a URDF (its only leaf)")
    parser.set_defaults(targets=None)
    if targets:
        group.add_argument(
            "--targets",
            action="append",
            type=numbers,
            metavar='"x y z"',
            help="a reflector in the frame of the last link [m]; repeat for several",
        )
    group.add_argument(
        "--degrees",
        action="store_true",
        help="angles in arguments and input CSV files are degrees; what is written is always radians",
    )


def add_parameters(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("what is unknown")
    group.add_argument(
        "--parameters",
        metavar="P",
        help="lengths+offsets, lengths, offsets, full, or NAME,NAME,… (the robot's own; see robots show)",
    )
    group.add_argument(
        "--unknown",
        default="",
        metavar="U",
        help="base (pose of the robot in the tracker's frame), tool (the reflectors' offsets) or base,tool",
    )


def add_test_poses(parser: argparse._ActionsContainer, purpose: str) -> None:
    parser.add_argument(
        "--test-pose",
        action="append",
        type=numbers,
        metavar='"q1 … qn"',
        help=f"joint coordinates [rad | m] {purpose}; repeat for several",
    )


def numbers(text: str) -> list[float]:
    """Numbers separated by spaces or commas."""
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected numbers, got {text!r}") from None


def load_robot(args: argparse.Namespace) -> Robot:
    """The robot of ``add_robot``, with its targets, its parameters as the file says."""
    robot = Robot.load(args.robot, base_link=args.base_link, tip_link=args.tip_link)
    return robot if args.targets is None else robot.with_targets(_rows("--targets", args.targets, 3))


def choose_parameters(robot: Robot, args: argparse.Namespace) -> Robot:
    """The robot with the active parameters of ``add_parameters``."""
    request = args.parameters or robot.parameter_names
    return robot.with_parameters(request, [u for u in args.unknown.split(",") if u.strip()])


def test_poses(robot: Robot, args: argparse.Namespace) -> FloatArray | None:
    """(K, joints) of --test-pose and --test-path [rad | m], or ``None`` without either."""
    found = []
    if args.test_pose is not None:
        rows = _rows("--test-pose", args.test_pose, len(robot.joint_names), robot.joint_names)
        found.append(rows * angle_factors(robot, degrees=args.degrees))
    if getattr(args, "test_path", None) is not None:
        found.append(read_configurations(args.test_path, robot, degrees=args.degrees))
    return np.vstack(found) if found else None


def _rows(option: str, rows: Sequence[Sequence[float]], length: int, names: Sequence[str] = "xyz") -> FloatArray:
    for row in rows:
        if len(row) != length:
            raise InputError(option, f"{len(row)} numbers", f"{length} numbers: {', '.join(names)}")
    array = np.array(rows, float)
    if not np.isfinite(array).all():
        raise InputError(option, "a number that is not finite", "finite numbers", "correct that number")
    return array


# ── Options that say what the instrument is and what may be measured at all ─────────────────────────────────


def add_conditions(parser: argparse._ActionsContainer) -> None:
    """--constraints, and --sigma or --instrument."""
    parser.add_argument(
        "--constraints",
        metavar="FILE",
        help="YAML: workspace, floor, tracker's view, … (config/constraints.yaml shows all)",
    )
    noise = parser.add_mutually_exclusive_group()
    noise.add_argument(
        "--sigma", type=float, default=3e-5, metavar="S", help="tracker's std of one coordinate [m] (3e-5)"
    )
    noise.add_argument("--instrument", metavar="FILE", help="YAML: noise by direction (config/instruments/)")


def conditions(args: argparse.Namespace, robot: Robot) -> dict[str, Any]:
    """The fields of ``PlanProblem`` that ``add_conditions`` is about."""
    # Planning, 0.2 s, is imported for these files only.
    from calib_planner.io import read_constraints, read_instrument

    result: dict[str, Any] = {}
    if args.constraints is not None:
        result["constraints"] = read_constraints(args.constraints, robot)
    return result | {
        "noise": Isotropic(args.sigma) if args.instrument is None else read_instrument(args.instrument)
    }
