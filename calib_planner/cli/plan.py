# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner plan``: choose where to measure, and how often."""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.cli.arguments import (
    TYPICAL,
    Commands,
    Group,
    add_command,
    add_conditions,
    add_pace,
    add_parameters,
    add_reading,
    add_robot,
    add_seed,
    add_test_path,
    add_test_poses,
    choose_parameters,
    chosen_pace,
    conditions,
    configurations_in,
    load_robot,
    numbers,
    option,
    paced,
    reading_of,
    require_test_poses,
    seconds,
    start_of,
    switch,
    test_poses,
)
from calib_planner.cli.gravity import add_gravity, with_gravity_of
from calib_planner.cli.sheet import tell_sheet
from calib_planner.cli.terminal import Terminal, configurations_table
from calib_planner.error_model import ACCURACIES, ErrorModel, Prior, typical_prior
from calib_planner.errors import InputError
from calib_planner.io import (
    check_writable,
    make_folder,
    planned_error_model,
    read_configurations,
    read_data,
    read_prior,
    write_configurations,
    write_plan,
)
from calib_planner.planning import (
    CRITERIA,
    GENERAL_SHARE,
    PAPERS_SHARE,
    POSE_CRITERIA,
    Candidates,
    Plan,
    PlanProblem,
    Progress,
    Search,
    Split,
    Timetable,
    plan_for_accuracy,
    plan_for_accuracy_in_time,
    plan_for_time,
    plan_sheet,
    processes,
    split_budget,
    timetable,
)
from calib_planner.planning import plan as find_plan
from calib_planner.robot import Robot
from calib_planner.tracker import Noise
from calib_planner.units import Units, duration, length

PAPER = "paper"
EXAMPLE = """calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" \\
      --configurations 4 --repetitions 3 --output plan.yaml
  calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" --accuracy 0.02e-3
  calib-planner plan --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" --time-budget 30min --speed 0.2"""
DESCRIPTION = """Choose the configurations to be measured.

Say where accuracy matters (--test-pose, --test-path) and how much may be measured (--configurations,
--measurements, --time-budget, or --accuracy for as little as it takes). The answer is the configurations in
the order of measuring, the accuracy that they will leave, and a bound: what no plan of as many measurements
can beat."""


def add(commands: Commands, summary: str) -> None:
    parser = add_command(commands, "plan", summary, run, EXAMPLE, DESCRIPTION)
    work = add_problem(parser, any_criterion=True)
    size = work.add_mutually_exclusive_group(required=True)
    option(size, "--configurations", "M", "number of different configurations", kind=int)
    text = (
        "time for the measurements, e.g. 2h, 90min, 1h30 or seconds; the program chooses the configurations, how "
    )
    text += "often each is measured, and their order"
    option(size, "--time-budget", "T", text, kind=seconds)
    text = "number of measurements in all; the program chooses the number of different configurations"
    option(size, "--measurements", "N", text, kind=int)
    text = (
        "reach this ρ0 [m] with the fewest measurements, or in the least time if one of the options about travel "
    )
    text += "and time is given"
    option(size, "--accuracy", "A", text, kind=float)
    option(work, "--repetitions", "K", "number of measurements at each configuration (1)", kind=int)
    add_pace(parser)
    add_jobs(parser)
    switch(parser, "--prove", "prove the bound by branch and bound also where that takes longer")
    option(parser, "--output", "FILE", "write the plan: .yaml, or .csv for a table")
    option(parser, "--sheet", "DIR", "write the sheet for the person at the robot, see sheet")


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    _check(args)
    size = 1 if args.configurations is None else args.configurations
    problem = make_problem(args, size, 1 if args.repetitions is None else args.repetitions)
    pace, start = chosen_pace(problem.robot, args), start_of(problem.robot, args)
    split: Split | None = None
    with terminal.progress("searching plans") as update:

        def report(progress: Progress) -> None:
            update(progress.starts_done / progress.starts_total, _best(progress, problem.criterion))

        def watch(done: int, total: int) -> None:
            update(done / total, f"{done} sizes tried")

        if args.time_budget is not None:
            split = plan_for_time(problem, pace, args.time_budget, start, watch)
        elif args.accuracy is not None and paced(args):
            split = plan_for_accuracy_in_time(problem, args.accuracy, pace, start, watch)
        elif args.accuracy is not None:
            split = plan_for_accuracy(problem, args.accuracy, watch=watch)
        elif args.measurements is not None:
            split = split_budget(problem, args.measurements, watch=watch)
        if split:
            plan = split.plan
        else:
            with processes(args.jobs, "--jobs") as executor:
                plan = find_plan(problem, report, executor, prove=args.prove)
    if args.output:
        _write(args.output, plan, problem.robot, args.units)
    if args.sheet:
        # 0.1 s for templates, which only a sheet waits for.
        from calib_planner.report import write_sheet

        sheet = plan_sheet(plan, problem.robot, problem.constraints, problem.instrument, pace=pace, start=start)
        tell_sheet(write_sheet(args.sheet, sheet, "--sheet"), terminal)
    times = timetable(plan, problem.robot, pace, start)
    result = plan.to_dict() | (_tried(split) if split else {}) | _times(times)
    result |= {"output": args.output} if args.output else {}
    result |= {"sheet": args.sheet} if args.sheet else {}
    terminal.answer(result, partial(show_plan, plan, problem.robot))
    if not args.json:
        terminal.answer({}, partial(show_times, times))
    if split and not args.json:
        terminal.answer({}, partial(show_tried, split))
    if args.output:
        terminal.note(f"Plan written to {args.output}")
    if args.sheet:
        terminal.note(f"Sheet in {args.sheet}")


def _best(progress: Progress, criterion: str) -> str:
    if not progress.starts_done:
        return ""
    if criterion in POSE_CRITERIA:
        return f"best ρ0 {length(progress.best_accuracy)}"
    return f"best value {progress.best_accuracy:.4g}"


def _tried(split: Split) -> dict[str, Any]:
    """What was tried, for the JSON: numbers, value [m] and time of each, and the proved minimum.

    ``repetitions`` is one number where all configurations have the same, else a list.
    """
    rows: list[dict[str, Any]] = [
        {
            "configurations": len(p.configurations),
            "repetitions": int(p.repetitions[0]) if len(set(p.repetitions)) == 1 else p.repetitions.tolist(),
            "predicted_accuracy": p.quality.value,
        }
        for p in split.tried
    ]
    for row, time in zip(rows, split.seconds, strict=False):
        row["minutes"] = time / 60.0
    return {"tried": rows, "fewest_measurements": split.fewest or None}


def _times(times: Timetable) -> dict[str, Any]:
    """The clock of a plan, for the JSON: minutes in all, and seconds of every configuration."""
    pace = times.pace
    about = {"settle": pace.settle, "dwell": pace.dwell, "speeds_from": pace.origin}
    return {"minutes": times.seconds / 60.0, **about, "stops": times.rows()}


def _check(args: argparse.Namespace) -> None:
    if args.repetitions is not None and args.configurations is None:
        raise InputError("--repetitions", args.repetitions, "--configurations beside it")
    for flag, given in (("--prove", args.prove), ("--jobs", args.jobs != 1)):
        if given and args.configurations is None:
            raise InputError(flag, "without it", "--configurations beside it")
    if args.output and not args.output.lower().endswith((".yaml", ".yml", ".csv")):
        raise InputError("--output", repr(args.output), "a name that ends in .yaml or .csv")
    if args.sheet:
        make_folder(args.sheet, "--sheet")  # refused before the search, not after it
    if args.output:
        check_writable(args.output, "--output")


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """--jobs, for what ``planning.parallel`` cuts in parts."""
    text = "processes that work side by side; the result is the same. It pays for work of half a minute and more"
    option(parser, "--jobs", "N", text, 1)


def _write(output: str, plan: Plan, robot: Robot, units: Units | None) -> None:
    if output.lower().endswith(".csv"):
        names, q = configurations_in(units, robot, plan.configurations)
        write_configurations(output, names, q, plan.repetitions, field="--output")
    else:
        write_plan(output, plan, "--output")


# ── the arguments that make a plan problem, shared by ``plan`` and ``compare`` ─────────────────────────


def add_problem(parser: argparse.ArgumentParser, *, any_criterion: bool) -> argparse._ArgumentGroup:
    """Add the arguments; returns the group about what may be measured, for the sizes."""
    add_robot(parser)
    add_reading(parser)
    add_parameters(parser)
    wanted = parser.add_argument_group("where accuracy matters")
    add_test_poses(wanted, "where accuracy matters")
    add_test_path(wanted)
    text = "what an accuracy is: the error in the frame of the points, or the same up to a rigid motion of the "
    text += "base, for a robot that is registered anew"
    option(wanted, "--accuracy-frame", None, text, "world", choices=ACCURACIES)
    option(wanted, "--weights", '"w1 …"', "weight of each test pose (equal)", kind=numbers)
    if any_criterion:
        _add_criteria(wanted)
    work = parser.add_argument_group("what may be measured")
    add_conditions(work)
    text = "how the robot errs: paper (noise alone), typical (gravity, joint functions and repeatability too) "
    text += "or YAML, also an estimate, which teaches its scales (paper for the paper's robots, else typical)"
    option(work, "--error-model", "E", text)
    text = "error of one coordinate that repeating a configuration does not average away [m]"
    option(work, "--configuration-sigma", "S", text, 0.0)
    add_gravity(parser, measured=False)
    known = parser.add_argument_group("what is known beforehand")
    text = "YAML: parameter name to standard deviation [m | rad], or a prior as for identify; "
    text += f"{TYPICAL}: the data sheet within usual manufacturing errors (none)"
    option(known, "--prior", "FILE", text)
    option(known, "--measured", "FILE", "table of measurements already taken: plan the next ones")
    search = parser.add_argument_group("search")
    text = "share of the criterion for accuracy everywhere, 0 … 1; 0 is the paper's"
    text += f" ({PAPERS_SHARE:g}; {GENERAL_SHARE:g} with a whole error model)"
    option(search, "--general-weight", "W", text, kind=float)
    option(
        search,
        "--starts",
        "N",
        "number of random starts (48; with a whole error model 2, or 1 for 20 configurations and more)",
        kind=int,
    )
    option(search, "--time-limit", "S", "time after which the search ends [s]", float("inf"))
    add_seed(search)
    return work


def _add_criteria(group: Group) -> None:
    text = "what is best: accuracy at the test poses (rms or worst), or a criterion of the literature"
    option(group, "--criterion", None, text, "test_pose", choices=CRITERIA)
    text = "mix in the efficiency by another criterion with this share (below 1); repeat for several"
    group.add_argument("--compound", action="append", default=[], metavar="NAME=SHARE", help=text)
    option(group, "--candidates", "FILE", "table of joint configurations to choose from, one per row")
    text = "older word for --error-model: on is typical, off is paper"
    option(group, "--discrepancy", None, text, "auto", choices=("auto", "on", "off"))
    switch(group, "--repeat-candidates", "a candidate may be chosen more than once")


def make_problem(args: argparse.Namespace, configurations: int, repetitions: int = 1) -> PlanProblem:
    """The problem of ``add_problem``'s arguments.

    Raises:
        InputError: Names the option at fault.
    """
    robot = choose_parameters(load_robot(args), args)
    poses, criterion = test_poses(robot, args), getattr(args, "criterion", "test_pose")
    if criterion in POSE_CRITERIA:
        require_test_poses(robot, poses)
    candidates, compound = _candidates(args, robot), _compound(getattr(args, "compound", []))
    around = conditions(args, robot)
    model = with_gravity_of(args, _error_model(args, robot, around["noise"]))
    return PlanProblem(
        robot=robot,
        test_poses=poses,
        configurations=configurations,
        repetitions=repetitions,
        weights=args.weights,
        **around,
        criterion=criterion,
        accuracy_frame=args.accuracy_frame,
        compound=compound,
        configuration_sigma=args.configuration_sigma,
        error_model=model,
        prior=_prior(args.prior, robot),
        measured=_measured(args, robot),
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


def _error_model(args: argparse.Namespace, robot: Robot, noise: Noise | float) -> ErrorModel:
    older = {"on": TYPICAL, "off": PAPER}.get(getattr(args, "discrepancy", "auto"))
    if older and args.error_model not in (None, older):
        raise InputError("--discrepancy", args.discrepancy, f"--error-model {args.error_model} alone")
    return planned_error_model(args.error_model or older, robot, noise)


def _prior(given: str | None, robot: Robot) -> Prior | None:
    if given is None:
        return None
    return typical_prior(robot) if given == TYPICAL else read_prior(given, robot).prior


def _measured(args: argparse.Namespace, robot: Robot) -> Any:
    if args.measured is None:
        return None
    return read_data(args.measured, robot, reading_of(args)).data


def _candidates(args: argparse.Namespace, robot: Robot) -> Candidates | None:
    if getattr(args, "candidates", None) is None:
        return None
    rows = read_configurations(args.candidates, robot, reading_of(args))
    return Candidates(rows, args.repeat_candidates)


# ── a plan for people: what it promises first, then the configurations ─────────────────────────────────────


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
    title = "configurations, in the order of measuring"
    console.print(configurations_table(title, robot, plan.configurations, plan.repetitions.tolist()))
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


def show_times(times: Timetable, console: Console) -> None:
    """Print how long a plan takes, and what the time goes to."""
    rows = times.rows()
    shares = {name: sum(row[name] for row in rows) for name in ("move", "back_off", "settle", "measure")}
    words = {"move": "moving", "back_off": "coming back", "settle": "settling", "measure": "measuring"}
    parts = ", ".join(f"{duration(time)} {words[name]}" for name, time in shares.items() if time)
    console.print(f"About {duration(times.seconds)}: {parts}. Joint speeds {times.pace.origin}.")


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
    for heading in ("configurations", "each", "measurements", "ρ0", *(("time",) if split.seconds else ())):
        table.add_column(heading, justify="right")
    for i, p in enumerate(split.tried):
        low, high = int(p.repetitions.min()), int(p.repetitions.max())
        each = f"{low}×" if low == high else f"{low}–{high}×"
        value = length(p.quality.value) if p.quality.criterion in POSE_CRITERIA else f"{p.quality.value:.5g}"
        time = [duration(split.seconds[i])] if split.seconds else []
        style = "bold" if p is split.plan else ""
        table.add_row(str(len(p.configurations)), each, str(p.measurements), value, *time, style=style)
    console.print(table)
    if split.seconds and any(split.plan.quality.value > 1.01 * p.quality.value for p in split.tried):
        text = "Chosen by what the search maximises: accuracy elsewhere has a share in it, and where the error "
        console.print(text + "model is typical, so have smaller and larger errors.")
    if split.fewest:
        console.print(f"No plan of fewer than {split.fewest} measurements can reach it.")
