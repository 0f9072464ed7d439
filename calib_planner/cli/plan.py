"""``calib-planner plan``: choose where to measure, and how often."""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

from calib_planner.cli.arguments import Commands, add_command
from calib_planner.cli.plan_problem import add_problem, make_problem
from calib_planner.cli.plan_table import show_plan, show_tried
from calib_planner.cli.sheet import make_folder, robot_pace, write_sheet
from calib_planner.cli.terminal import Terminal
from calib_planner.design.budget import Split, plan_for_accuracy, split_budget
from calib_planner.design.plan import Plan
from calib_planner.design.plan_sheet import plan_sheet
from calib_planner.design.planner import Progress
from calib_planner.design.planner import plan as find_plan
from calib_planner.errors import InputError
from calib_planner.files.configurations_csv import write_configurations
from calib_planner.files.plan_yaml import write_plan

EXAMPLE = """calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" \\
      --configurations 4 --repetitions 3 --output plan.yaml
  calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" --accuracy 0.02e-3"""


def add(commands: Commands) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "plan", "choose the configurations to be measured", run, EXAMPLE)
    work = add_problem(parser, any_criterion=True)
    size = work.add_mutually_exclusive_group(required=True)
    size.add_argument("--configurations", type=int, metavar="M", help="how many different ones")
    size.add_argument(
        "--measurements", type=int, metavar="N", help="in all; how many different ones is found out"
    )
    size.add_argument(
        "--accuracy", type=float, metavar="A", help="the fewest measurements that reach this ρ0 [m]"
    )
    work.add_argument("--repetitions", type=int, metavar="K", help="measurements at each of M (1)")
    parser.add_argument("--prove", action="store_true", help="make the bound rigorous, by branch and bound")
    parser.add_argument("--output", metavar="FILE", help="write the plan: .yaml, or .csv for a table")
    parser.add_argument("--sheet", metavar="DIR", help="write the sheet for the person at the robot, see sheet")


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    _check(args)
    size = 1 if args.configurations is None else args.configurations
    problem = make_problem(args, size, 1 if args.repetitions is None else args.repetitions)
    split: Split | None = None
    with terminal.progress("searching plans") as update:

        def report(progress: Progress) -> None:
            update(progress.starts_done / progress.starts_total, _best(progress, problem.criterion))

        def watch(done: int, total: int) -> None:
            update(done / total, f"{done} sizes tried")

        if args.accuracy is not None:
            split = plan_for_accuracy(problem, args.accuracy, watch=watch)
        elif args.measurements is not None:
            split = split_budget(problem, args.measurements, watch=watch)
        found = split.plan if split else find_plan(problem, report, prove=args.prove)
    if args.output:
        _write(args.output, found)
    if args.sheet:
        sheet = plan_sheet(
            found, problem.robot, problem.constraints, problem.noise, pace=robot_pace(problem.robot)
        )
        write_sheet(args.sheet, sheet, terminal, "--sheet")
    result = found.to_dict() | (_tried(split) if split else {})
    result |= {"output": args.output} if args.output else {}
    result |= {"sheet": args.sheet} if args.sheet else {}
    terminal.answer(result, partial(show_plan, found, problem.robot))
    if split and not args.json:
        terminal.answer({}, partial(show_tried, split))
    if args.output:
        terminal.note(f"Plan written to {args.output}")
    if args.sheet:
        terminal.note(f"Sheet in {args.sheet}")


def _best(progress: Progress, criterion: str) -> str:
    if not progress.starts_done:
        return ""
    if criterion in ("test_pose", "worst_pose"):
        return f"best ρ0 {1e3 * progress.best_accuracy:.4f} mm"
    return f"best value {progress.best_accuracy:.4g}"


def _tried(split: Split) -> dict[str, Any]:
    """What was tried, for the JSON: configurations, repetitions, value [m] of each, and the proved minimum."""
    rows = [
        {
            "configurations": len(p.configurations),
            "repetitions": int(p.repetitions[0]),
            "predicted_accuracy": p.value,
        }
        for p in split.tried
    ]
    return {"tried": rows, "fewest_measurements": split.fewest or None}


def _check(args: argparse.Namespace) -> None:
    if args.repetitions is not None and args.configurations is None:
        raise InputError("--repetitions", args.repetitions, "--configurations beside it")
    if args.prove and args.configurations is None:
        raise InputError("--prove", "with --measurements or --accuracy", "--configurations beside it")
    if args.output and not args.output.lower().endswith((".yaml", ".yml", ".csv")):
        raise InputError("--output", repr(args.output), "a name that ends in .yaml or .csv")
    if args.sheet:
        make_folder(args.sheet, "--sheet")  # refused before the search, not after it


def _write(output: str, found: Plan) -> None:
    if output.lower().endswith(".csv"):
        write_configurations(output, found.joint_names, found.configurations, found.repetitions, field="--output")
    else:
        write_plan(output, found, "--output")
