"""Options that say what the instrument is and what may be measured at all."""

from __future__ import annotations

import argparse
from typing import Any

from calib_planner.files.constraints_yaml import read_constraints
from calib_planner.files.instrument_yaml import read_instrument
from calib_planner.robot.chain import Robot


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
    """The arguments of ``PlanProblem`` that ``add_conditions`` is about."""
    found: dict[str, Any] = {"sigma": args.sigma}
    if args.instrument is not None:
        found["noise"] = read_instrument(args.instrument)
    if args.constraints is not None:
        found["constraints"] = read_constraints(args.constraints, robot)
    return found
