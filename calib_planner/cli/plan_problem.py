"""The arguments that make a plan problem, shared by ``plan`` and ``compare``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.cli.arguments import (
    add_parameters,
    add_robot,
    add_seed,
    add_test_poses,
    choose_parameters,
    load_robot,
    numbers,
    test_poses,
)
from calib_planner.cli.conditions import add_conditions, conditions
from calib_planner.cli.identify_options import TYPICAL
from calib_planner.design.criteria import CRITERIA
from calib_planner.design.discrepancy import ModelDiscrepancy
from calib_planner.design.problem import POSE_CRITERIA, PlanProblem
from calib_planner.errors import InputError
from calib_planner.files.configurations_csv import read_configurations
from calib_planner.files.measurements_csv import read_measurements
from calib_planner.files.prior_yaml import read_prior
from calib_planner.identification.prior import typical_prior
from calib_planner.robot.catalogue import URDF_SUFFIXES
from calib_planner.robot.chain import Robot

DEFAULTS = {name: field.default for name, field in PlanProblem.__dataclass_fields__.items()}


def add_problem(parser: argparse.ArgumentParser, *, any_criterion: bool) -> argparse._ArgumentGroup:
    """Add the arguments; returns the group about what may be measured, for the sizes."""
    add_robot(parser)
    add_parameters(parser)
    wanted = parser.add_argument_group("where accuracy matters")
    add_test_poses(wanted, "where accuracy matters")
    wanted.add_argument(
        "--test-path", metavar="FILE", help="CSV with a column per joint; every row is a test pose"
    )
    wanted.add_argument("--weights", type=numbers, metavar='"w1 …"', help="one per test pose (equal)")
    if any_criterion:
        _add_criteria(wanted)
    work = parser.add_argument_group("what may be measured")
    add_conditions(work)
    work.add_argument(
        "--configuration-sigma",
        type=float,
        default=0.0,
        metavar="S",
        help="error of one coordinate that repeating a configuration does not average away [m] (0)",
    )
    known = parser.add_argument_group("what is known beforehand")
    known.add_argument(
        "--prior",
        metavar="FILE",
        help="YAML: parameter name to standard deviation [m | rad], or a prior as for identify, but no estimate; "
        f"{TYPICAL}: the data sheet within usual manufacturing errors",
    )
    known.add_argument("--measured", metavar="FILE", help="CSV of measurements already taken: plan the next ones")
    search = parser.add_argument_group("search")
    weight = DEFAULTS["general_weight"]
    search.add_argument(
        "--general-weight",
        type=float,
        default=weight,
        metavar="W",
        help=f"share of the criterion for accuracy everywhere, 0 … 1 ({weight:g}; 0 is the paper's)",
    )
    starts = DEFAULTS["starts"]
    search.add_argument("--starts", type=int, default=starts, metavar="N", help=f"random starts ({starts})")
    search.add_argument("--time-limit", type=float, default=float("inf"), metavar="S", help="seconds (none)")
    add_seed(search)
    return work


def _add_criteria(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--criterion",
        choices=CRITERIA,
        default="test_pose",
        help="what is best: accuracy at the test poses (rms or worst), or a criterion of the literature",
    )
    group.add_argument(
        "--compound",
        action="append",
        default=[],
        metavar="NAME=SHARE",
        help="mix in the efficiency by another criterion with this share (below 1); repeat for several",
    )
    group.add_argument(
        "--candidates", metavar="FILE", help="CSV of joint configurations to choose from, one per row"
    )
    group.add_argument(
        "--discrepancy",
        choices=("auto", "on", "off"),
        default="auto",
        help="expect the systematic errors of a real robot when choosing candidates; auto: for robots from a "
        "URDF; off: the paper's white noise alone",
    )
    group.add_argument(
        "--repeat-candidates", action="store_true", help="a candidate may be chosen more than once"
    )


def make_problem(args: argparse.Namespace, configurations: int, repetitions: int = 1) -> PlanProblem:
    """The problem of ``add_problem``'s arguments.

    Raises:
        InputError: Names the option at fault.
    """
    robot = choose_parameters(load_robot(args), args)
    poses = test_poses(robot, args)
    criterion = getattr(args, "criterion", "test_pose")
    if poses is None and criterion in POSE_CRITERIA:
        wanted = f"{len(robot.joint_names)} numbers: {', '.join(robot.joint_names)}"
        raise InputError("--test-pose", "none", wanted, "give --test-pose or --test-path")
    return PlanProblem(
        robot=robot,
        test_poses=poses,
        configurations=configurations,
        repetitions=repetitions,
        weights=args.weights,
        **conditions(args, robot),
        criterion=criterion,
        compound=_compound(getattr(args, "compound", [])),
        general_weight=args.general_weight,
        configuration_sigma=args.configuration_sigma,
        prior_std=_prior(args.prior, robot),
        measured=_measured(args, robot),
        candidates=_candidates(args, robot),
        discrepancy=_discrepancy(args, robot),
        repeat_candidates=getattr(args, "repeat_candidates", False),
        starts=args.starts,
        seed=args.seed,
        time_limit=args.time_limit,
    )


def _discrepancy(args: argparse.Namespace, robot: Robot) -> ModelDiscrepancy | None:
    """What a real robot has beyond its geometric model, where that is asked for or to be expected."""
    wanted = getattr(args, "discrepancy", "off")
    if wanted == "auto":
        plain = args.criterion == "test_pose" and not args.compound and not args.repeat_candidates
        real = Path(robot.source).suffix.lower() in URDF_SUFFIXES
        wanted = "on" if real and plain and args.candidates is not None else "off"
    return ModelDiscrepancy() if wanted == "on" else None


def _compound(words: list[str]) -> dict[str, float]:
    shares = {}
    for word in words:
        name, _, share = word.partition("=")
        try:
            shares[name.strip()] = float(share)
        except ValueError:
            raise InputError("--compound", repr(word), "NAME=SHARE, such as d=0.3") from None
    return shares


def _prior(given: str | None, robot: Robot) -> dict[str, float]:
    """Standard deviations by parameter, of a file or of the typical prior."""
    if given is None:
        return {}
    prior = typical_prior(robot) if given == TYPICAL else read_prior(given, robot).prior
    if prior is None:
        return {}
    covariance = np.asarray(prior.covariance)
    variances = np.diag(covariance)
    if (covariance != np.diag(variances)).any():
        got, valid = f"{given}, whose parameters err together", "independent standard deviations"
        raise InputError("--prior", got, valid, "give the measurements of that estimate: --measured FILE")
    return dict(zip(prior.names, np.sqrt(variances).tolist(), strict=True))


def _measured(args: argparse.Namespace, robot: Robot) -> Any:
    if args.measured is None:
        return None
    return read_measurements(args.measured, robot, degrees=args.degrees).data


def _candidates(args: argparse.Namespace, robot: Robot) -> Any:
    path = getattr(args, "candidates", None)
    return None if path is None else read_configurations(path, robot, degrees=args.degrees)
