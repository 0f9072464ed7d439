"""``calib-planner plan``: choose where to measure, and how often."""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.cli.arguments import (
    Commands,
    add_command,
    add_conditions,
    add_parameters,
    add_robot,
    add_seed,
    add_test_poses,
    choose_parameters,
    conditions,
    load_robot,
    numbers,
    test_poses,
)
from calib_planner.cli.identify import TYPICAL
from calib_planner.cli.sheet import robot_pace, write_sheet
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import InputError
from calib_planner.identification import typical_prior
from calib_planner.io import (
    make_folder,
    read_configurations,
    read_measurements,
    read_prior,
    write_configurations,
    write_plan,
)
from calib_planner.planning import (
    CRITERIA,
    POSE_CRITERIA,
    Candidates,
    ModelDiscrepancy,
    Plan,
    PlanPrior,
    PlanProblem,
    Progress,
    Search,
    Split,
    plan_for_accuracy,
    plan_sheet,
    split_budget,
    usual_discrepancy,
)
from calib_planner.planning import plan as find_plan
from calib_planner.robot import Robot
from calib_planner.units import length

EXAMPLE = """calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" \\
      --configurations 4 --repetitions 3 --output plan.yaml
  calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" --accuracy 0.02e-3"""


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "plan", summary, run, EXAMPLE)
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
            found, problem.robot, problem.constraints, problem.instrument, pace=robot_pace(problem.robot)
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
            "predicted_accuracy": p.quality.value,
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


# ── The arguments that make a plan problem, shared by ``plan`` and ``compare`` ──────────────────────────────

USUAL = Search()


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
    search.add_argument(
        "--general-weight",
        type=float,
        default=USUAL.general_weight,
        metavar="W",
        help="share of the criterion for accuracy everywhere, 0 … 1 "
        f"({USUAL.general_weight:g}; 0 is the paper's)",
    )
    search.add_argument(
        "--starts", type=int, default=USUAL.starts, metavar="N", help=f"random starts ({USUAL.starts})"
    )
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
    candidates, compound = _candidates(args, robot), _compound(getattr(args, "compound", []))
    wanted = getattr(args, "discrepancy", "off")
    discrepancy = ModelDiscrepancy() if wanted == "on" else None
    if wanted == "auto":
        discrepancy = usual_discrepancy(robot, criterion, candidates, compound)
    return PlanProblem(
        robot=robot,
        test_poses=poses,
        configurations=configurations,
        repetitions=repetitions,
        weights=args.weights,
        **conditions(args, robot),
        criterion=criterion,
        compound=compound,
        repeatability=args.configuration_sigma,
        discrepancy=discrepancy,
        prior=PlanPrior(std=_prior(args.prior, robot), measured=_measured(args, robot)),
        search=Search(
            general_weight=args.general_weight, starts=args.starts, seed=args.seed, time_limit=args.time_limit
        ),
        candidates=candidates,
    )


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


def _candidates(args: argparse.Namespace, robot: Robot) -> Candidates | None:
    if getattr(args, "candidates", None) is None:
        return None
    rows = read_configurations(args.candidates, robot, degrees=args.degrees)
    return Candidates(rows, args.repeat_candidates)


# ── A plan for people: what it promises first, then the configurations ──────────────────────────────────────


def show_plan(plan: Plan, robot: Robot, console: Console) -> None:
    """Print a plan of ``robot``."""
    quality = plan.quality
    console.print(f"{quality.status}: {quality.message}", style="green" if quality.status == "ok" else "yellow")
    if len(plan.test_poses):
        console.print(
            f"Predicted accuracy ρ0 {length(quality.predicted_accuracy)} at the test pose"
            f"{'s (rms)' if len(plan.test_poses) > 1 else ''}, from {plan.measurements} measurements "
            f"with σ = {length(plan.sigma)}."
        )
    console.print(_bound(plan))
    console.print(_configurations(plan, robot))
    if len(plan.test_poses) > 1:
        per = ", ".join(length(v) for v in quality.predicted_accuracy_per_test_pose)
        console.print(f"ρ0 per test pose: {per}")
    unseen = [n for n, s in zip(plan.parameters, quality.parameter_std, strict=True) if np.isinf(s)]
    if unseen:
        console.print(f"Not seen by this plan: {', '.join(unseen)}", style="yellow")
    for combination in quality.unidentifiable:
        console.print(f"No plan can tell apart: {combination}", soft_wrap=True)
    console.print(
        f"{quality.starts} starts, {quality.evaluations} plans evaluated, {quality.seconds:.1f} s, "
        f"seed {quality.seed}"
    )


def _bound(plan: Plan) -> str:
    quality = plan.quality
    everywhere = f"Over all joint limits {length(quality.general_accuracy)} (rms)."
    metric = quality.criterion in POSE_CRITERIA
    value = length(quality.value) if metric else f"{quality.value:.5g}"
    told = "" if quality.criterion == "test_pose" else f"Criterion {quality.criterion}: {value}. "
    if quality.bound == "none":
        return f"{told}This criterion has no bound. {everywhere}"
    limit = length(quality.value_bound) if metric else f"{quality.value_bound:.5g}"
    return (
        f"{told}No plan of {plan.measurements} measurements is better than {limit} "
        f"({quality.bound} bound): efficiency {100 * quality.efficiency:.1f} %. {everywhere}"
    )


def show_tried(split: Split, console: Console) -> None:
    """Print the sizes that were tried for an accuracy or a budget."""
    table = Table(title="sizes tried")
    for heading in ("configurations", "each", "measurements", "ρ0"):
        table.add_column(heading, justify="right")
    for p in split.tried:
        k, r = len(p.configurations), int(p.repetitions[0])
        table.add_row(
            str(k), f"{r}×", str(p.measurements), length(p.quality.value), style="bold" if p is split.plan else ""
        )
    console.print(table)
    if split.fewest:
        console.print(f"No plan of fewer than {split.fewest} measurements can reach it.")


def _configurations(plan: Plan, robot: Robot) -> Table:
    table = Table(title="configurations, in the order of measuring")
    table.add_column("#", justify="right")
    for name, turns in zip(plan.joint_names, robot.joint_is_revolute, strict=True):
        table.add_column(f"{name}\n[{'°' if turns else 'mm'}]", justify="right")
    table.add_column("measure", justify="right")
    factors = np.where(robot.joint_is_revolute, 180.0 / np.pi, 1e3)
    for i, (row, times) in enumerate(zip(plan.configurations * factors, plan.repetitions, strict=True), 1):
        table.add_row(str(i), *(f"{v:.2f}" for v in row), f"{times}×")
    return table
