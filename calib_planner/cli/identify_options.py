"""What ``identify`` may be told of noise, of the parameters beforehand and of what is wanted."""

from __future__ import annotations

import argparse

import numpy as np

from calib_planner.cli.arguments import add_seed, add_test_poses
from calib_planner.cli.estimate_table import grouped
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import InputError
from calib_planner.files.instrument_yaml import read_instrument
from calib_planner.files.prior_yaml import read_prior
from calib_planner.identification.prior import Prior, typical_prior
from calib_planner.identification.problem import AUTOMATIC, LOSSES, IdentificationProblem
from calib_planner.instrument.noise import LaserTracker, Noise
from calib_planner.robot.chain import Robot

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
