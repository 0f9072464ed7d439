"""``calib-planner plan``: choose where to measure."""

from __future__ import annotations

import argparse
from functools import partial

from calib_planner.cli.arguments import (
    Commands,
    add_command,
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
from calib_planner.cli.plan_table import show_plan
from calib_planner.cli.terminal import Terminal
from calib_planner.design.plan import Plan
from calib_planner.design.planner import Progress
from calib_planner.design.planner import plan as find_plan
from calib_planner.design.problem import CRITERIA, PlanProblem
from calib_planner.errors import InputError
from calib_planner.files.configurations_csv import write_configurations
from calib_planner.files.plan_yaml import write_plan

EXAMPLE = """calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" \\
      --configurations 4 --repetitions 3 --output plan.yaml"""


def add(commands: Commands) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "plan", "choose the configurations to be measured", run, EXAMPLE)
    add_robot(parser)
    add_parameters(parser)
    wanted = parser.add_argument_group("where accuracy matters")
    add_test_poses(wanted, "where accuracy matters")
    wanted.add_argument(
        "--test-path", metavar="FILE", help="CSV with a column per joint; every row is a test pose"
    )
    wanted.add_argument("--weights", type=numbers, metavar='"w1 …"', help="one per test pose (equal)")
    work = parser.add_argument_group("what may be measured")
    work.add_argument("--configurations", type=int, required=True, metavar="M", help="how many different")
    work.add_argument("--repetitions", type=int, default=1, metavar="K", help="measurements at each (1)")
    add_conditions(work)
    search = parser.add_argument_group("search")
    search.add_argument("--criterion", choices=CRITERIA, default="test_pose", help="what is minimised")
    search.add_argument(
        "--general-weight",
        type=float,
        default=1e-4,
        metavar="W",
        help="share of the criterion for accuracy everywhere, 0 … 1 (1e-4)",
    )
    search.add_argument("--prove", action="store_true", help="make the bound rigorous, by branch and bound")
    search.add_argument("--starts", type=int, default=64, metavar="N", help="random starts (64)")
    search.add_argument("--time-limit", type=float, default=float("inf"), metavar="S", help="seconds (none)")
    add_seed(search)
    parser.add_argument("--output", metavar="FILE", help="write the plan: .yaml, or .csv for a table")


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    _check_output(args.output)
    problem = _problem(args)
    with terminal.progress("searching plans") as update:

        def report(progress: Progress) -> None:
            text = f"best ρ0 {1e3 * progress.best_accuracy:.4f} mm" if progress.starts_done else ""
            update(progress.starts_done / progress.starts_total, text)

        found = find_plan(problem, report, prove=args.prove)
    if args.output:
        _write(args.output, found)
    result = found.to_dict() | ({"output": args.output} if args.output else {})
    terminal.answer(result, partial(show_plan, found, problem.robot))
    if args.output:
        terminal.note(f"Plan written to {args.output}")


def _problem(args: argparse.Namespace) -> PlanProblem:
    robot = choose_parameters(load_robot(args), args)
    poses = test_poses(robot, args)
    if poses is None:
        wanted = f"{len(robot.joint_names)} numbers: {', '.join(robot.joint_names)}"
        raise InputError("--test-pose", "none", wanted, "give --test-pose or --test-path")
    return PlanProblem(
        robot=robot,
        test_poses=poses,
        configurations=args.configurations,
        repetitions=args.repetitions,
        weights=args.weights,
        **conditions(args, robot),
        criterion=args.criterion,
        general_weight=args.general_weight,
        starts=args.starts,
        seed=args.seed,
        time_limit=args.time_limit,
    )


def _check_output(output: str | None) -> None:
    if output and not output.lower().endswith((".yaml", ".yml", ".csv")):
        raise InputError("--output", repr(output), "a name that ends in .yaml or .csv")


def _write(output: str, found: Plan) -> None:
    if output.lower().endswith(".csv"):
        write_configurations(output, found.joint_names, found.configurations, found.repetitions, field="--output")
    else:
        write_plan(output, found, "--output")
