# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner campaign``: measure until it is accurate enough, by hand round by round or in simulation."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.arrays import FloatArray, check_count, check_number, plain
from calib_planner.campaign import (
    FIT,
    OUTCOMES,
    VALIDATION,
    CampaignProblem,
    CampaignResult,
    CampaignState,
    Finished,
    Round,
    decide,
    from_measurements,
    identification_problem,
)
from calib_planner.cli.arguments import (
    Commands,
    add_command,
    add_conditions,
    add_parameters,
    add_reading,
    add_robot,
    add_seed,
    add_test_path,
    add_test_poses,
    choose_parameters,
    conditions,
    configurations_in,
    load_robot,
    option,
    reading_of,
    require_test_poses,
    test_poses,
)
from calib_planner.cli.gravity import add_gravity, error_model_of
from calib_planner.cli.terminal import Terminal, configurations_table
from calib_planner.error_model import ACCURACIES
from calib_planner.errors import InputError
from calib_planner.io import (
    check_writable,
    make_folder,
    read_data,
    read_error_model,
    write_configurations,
    write_estimate,
    write_measurements,
)
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot
from calib_planner.simulation import simulate_campaign
from calib_planner.units import counted, length, lengths

DESCRIPTION = """Plan a batch, measure it, identify, plan the rest from what was measured, until the accuracy is
reached, the budget is spent, or more measurements cannot help; then validate on configurations that took no part.

By hand: run it, measure what it says (--next FILE), run it again with all that was measured (--measured FILE);
when it asks for validation, measure that into a file of its own (--held-out FILE). In simulation: --simulate
SEED."""
EXAMPLE = """calib-planner campaign --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" \\
      --required-accuracy 3e-4 --budget 40 --simulate 1
  calib-planner campaign --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" \\
      --required-accuracy 3e-4 --measured points.csv --next next.csv"""
SIMULATED = "typical"
"""How the simulated robot of a campaign errs besides its parameters, where nothing else is said."""
DEFAULTS = {name: field.default for name, field in CampaignProblem.__dataclass_fields__.items()}
NUMBERS = {
    "budget": "number of measurements allowed in all",
    "batch": "number of configurations planned at a time",
    "validation": "number of measurements, part of the budget, that take no part in the fit",
    "minimum": "smallest number of different configurations, however accurate they look",
}


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    parser = add_command(commands, "campaign", summary, run, EXAMPLE, DESCRIPTION)
    add_robot(parser)
    add_reading(parser)
    add_parameters(parser)
    wanted = parser.add_argument_group("what is wanted")
    add_test_poses(wanted, "where accuracy matters")
    add_test_path(wanted)
    text = "largest error of a visit that is acceptable at a test pose, repeatability included [m]"
    option(wanted, "--required-accuracy", "A", text, kind=float, required=True)
    text = "error in the frame of the points (world), or up to a rigid motion of the base (robot)"
    option(wanted, "--accuracy-frame", None, text, DEFAULTS["accuracy_frame"], choices=ACCURACIES)
    work = parser.add_argument_group("what may be measured")
    for name, text in NUMBERS.items():
        option(work, f"--{name}", "N", text, DEFAULTS[name])
    add_conditions(work)
    text = "how the robot errs, for the identification: typical, paper (noise alone), or YAML, also an estimate"
    option(work, "--error-model", "E", text, "typical")
    add_gravity(parser, measured=False)
    hand = parser.add_argument_group("by hand")
    option(hand, "--measured", "FILE", "table of what was measured for the fit so far")
    option(hand, "--held-out", "FILE", "table of what was measured for validation")
    option(hand, "--next", "FILE", "write what to measure next: .csv with repetitions")
    play = parser.add_argument_group("in simulation")
    option(play, "--simulate", "SEED", "measure a simulated robot with hidden errors", kind=int)
    text = "true standard deviation of one coordinate of its tracker [m] (as --sigma or --instrument)"
    option(play, "--simulate-sigma", "S", text, kind=float)
    text = "how it errs besides its parameters: typical, paper (not at all), or YAML, also an estimate"
    option(play, "--simulate-error-model", "E", text, SIMULATED)
    text = "rms error of its joints' transmissions, on top [rad]"
    option(play, "--simulate-transmission", "S", text, 0.0)
    option(parser, "--output", "DIR", "folder for measurements, validation and estimate")
    option(
        parser, "--starts", "N", "number of random starts of each search; 0: as many as usual", DEFAULTS["starts"]
    )
    add_seed(parser)


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    _check(args)
    robot = choose_parameters(load_robot(args), args)
    problem = _problem(args, robot)
    if args.simulate is None:
        _by_hand(args, problem, terminal)
    else:
        _simulated(args, problem, terminal)


def _check(args: argparse.Namespace) -> None:
    by_hand = [o for o in ("measured", "held_out", "next") if getattr(args, o) is not None]
    if args.simulate is not None and by_hand:
        option = f"--{by_hand[0].replace('_', '-')}"
        raise InputError(option, "with --simulate", "one of the two", "a simulated campaign measures by itself")
    if args.simulate is None and args.simulate_sigma is not None:
        raise InputError("--simulate-sigma", "without --simulate", "--simulate SEED beside it")
    if args.held_out is not None and args.measured is None:
        raise InputError("--held-out", "without --measured", "--measured FILE beside it")
    if args.next is not None and not args.next.lower().endswith(".csv"):
        raise InputError("--next", repr(args.next), "a name that ends in .csv")
    if args.next is not None:
        check_writable(args.next, "--next")
    if args.output is not None:
        make_folder(args.output, "--output")


def _problem(args: argparse.Namespace, robot: Robot) -> CampaignProblem:
    poses = require_test_poses(robot, test_poses(robot, args))
    return CampaignProblem(
        robot,
        poses,
        args.required_accuracy,
        **{name: getattr(args, name) for name in NUMBERS},
        sigma=args.sigma,
        **conditions(args, robot),
        accuracy_frame=args.accuracy_frame,
        identification={"error_model": error_model_of(args, args.error_model, robot)},
        starts=args.starts,
        seed=args.seed,
    )


# ── by hand ──────────────────────────────────────────────────────────────────────────────────────────


def _by_hand(args: argparse.Namespace, problem: CampaignProblem, terminal: Terminal) -> None:
    """One round: what the measurements say, and what to measure next."""
    state = from_measurements(problem, _read(args, problem, "measured"), _read(args, problem, "held_out"))
    with terminal.working("identifying and planning"):
        while not state.queue and not isinstance(state.action, Finished):
            state = state.decided(decide(state))
    action = state.action
    if isinstance(action, Finished):
        _answer(args, problem, terminal, action.result, {})
        return
    numbers = list(dict.fromkeys(state.queue))
    q = np.array([state.configurations[i].q for i in numbers])
    times = [state.queue.count(i) for i in numbers]
    role = state.configurations[numbers[0]].role
    if args.next:
        names, rows = configurations_in(args.units, problem.robot, q)
        write_configurations(args.next, names, rows, times, field="--next")
    result = {
        "outcome": state.outcome or None,
        "message": state.message,
        "next": {
            "role": role,
            "joint_names": problem.robot.joint_names,
            "configurations": q,
            "repetitions": times,
            "output": args.next,
        },
        "left": state.left,
        "rounds": [vars(r) for r in state.rounds],
        "required_accuracy": problem.required_accuracy,
    }
    terminal.answer(plain(result), partial(show_next, state, q, times))
    if args.next:
        target = "--held-out" if role == VALIDATION else "--measured"
        terminal.note(f"What to measure next is in {args.next} (rad, m); then add it to the file of {target}")


def _read(args: argparse.Namespace, problem: CampaignProblem, option: str) -> Measurements | None:
    path = getattr(args, option)
    return None if path is None else read_data(path, problem.robot, reading_of(args)).data


# ── in simulation ────────────────────────────────────────────────────────────────────────────────────


def _simulated(args: argparse.Namespace, problem: CampaignProblem, terminal: Terminal) -> None:
    check_count("--simulate", args.simulate, low=0, high=2**63 - 1)
    sigma = args.sigma if args.simulate_sigma is None else args.simulate_sigma
    check_number("--simulate-sigma", sigma, low=0, high=1, unit="m")
    check_number("--simulate-transmission", args.simulate_transmission, low=0, high=0.1, unit="rad")
    model = read_error_model(args.simulate_error_model)
    if model.gravity is not None:
        model = error_model_of(args, args.simulate_error_model, problem.robot)
    same = args.simulate_sigma is None and args.instrument is not None
    noise = problem.noise if same else None
    with terminal.progress("measuring") as update:

        def watch(state: CampaignState) -> None:
            accuracy = f", {length(state.rounds[-1].accuracy)}" if len(state.rounds) > 1 else ""
            update(state.spent() / problem.budget, f"{len(state.measurements_of(FIT))} measured{accuracy}")

        result, world, errors = simulate_campaign(
            problem, args.simulate, sigma, noise, args.simulate_transmission, watch, model
        )
    more: dict[str, Any] = {"seed": args.seed, "simulate": args.simulate, "true": errors}
    if result.estimate is not None:
        more["achieved_per_test_pose"] = world.errors(result.estimate.positions, problem.test_pose_array)
    _answer(args, problem, terminal, result, more)


def _answer(
    args: argparse.Namespace,
    problem: CampaignProblem,
    terminal: Terminal,
    result: CampaignResult,
    more: dict[str, Any],
) -> None:
    if args.output:
        _write(make_folder(args.output, "--output"), problem, result)
    achieved = more.get("achieved_per_test_pose")
    answer = result.to_dict() | plain(more) | {"output": args.output}
    terminal.answer(answer, partial(show_result, result, achieved))
    if args.output:
        terminal.note(f"Measurements and estimate are in {args.output}")


def _write(folder: Path, problem: CampaignProblem, result: CampaignResult) -> None:
    if result.fit is not None:
        write_measurements(folder / "measurements.csv", result.fit, "--output")
    if result.validation is not None:
        write_measurements(folder / "validation.csv", result.validation, "--output")
    if result.estimate is not None and result.fit is not None:
        whole = identification_problem(problem, result.fit)
        write_estimate(folder / "estimate.yaml", result.estimate, "--output", whole)


# ── a campaign for people: its verdict and outcome first, then how it went ─────────────────────────────────

STYLES = {"PASS": "bold green", "WARN": "bold yellow", "FAIL": "bold red"}


def show_result(result: CampaignResult, achieved: FloatArray | None, console: Console) -> None:
    """Print the end of a campaign; ``achieved`` (K,) is the truth of a simulation [m]."""
    console.print(
        f"{result.verdict.level}: {result.outcome.replace('_', ' ')}", style=STYLES[result.verdict.level]
    )
    console.print(f"{result.message}: {OUTCOMES[result.outcome]}.", soft_wrap=True)
    said = {result.outcome}  # by the message
    for reason in (r for r in result.verdict.reasons if r.level != "PASS" or "test_pose" in r.code):
        if reason.code in said:
            continue
        advice = f" → {reason.advice}" if reason.advice else ""
        console.print(f"  {reason.level}  {reason.text}{advice}", soft_wrap=True)
    console.print(rounds_table(result.rounds))
    estimate = result.estimate
    if estimate is not None and estimate.validation is not None:
        v = estimate.validation
        achieved_rms, predicted_rms, before = lengths(v.rms, v.predicted_rms, v.before_mean)
        there = any(r.code == "achieved_at_test_poses" for r in result.verdict.reasons)
        where = "the test poses among them" if there else "away from the test poses, where nothing is required"
        console.print(
            f"Validation on {counted(v.count, 'point')}, {where}: {achieved_rms} achieved, {predicted_rms} "
            f"predicted for them (rms); before calibration {before} (mean)."
        )
    if achieved is not None:
        worst = np.inf if estimate is None else estimate.accuracy.worst
        *true, predicted, of_a_visit = lengths(*achieved, worst, result.accuracy)
        console.print(
            f"True error at the test poses: {', '.join(true)} on average over visits; "
            f"{'nothing' if estimate is None else predicted} predicted, "
            f"{of_a_visit} with the repeatability of a visit."
        )
    console.print(f"{result.spent} of {counted(result.budget, 'measurement')} spent, "
                  f"{counted(len(result.exclusions), 'configuration')} given up.")  # fmt: skip


def rounds_table(rounds: Sequence[Round]) -> Table:
    """What was known after each batch."""
    table = Table(title="rounds")
    headings = ("#", "measured", "different", "predicted", "repeatability", "σ", "still needed", "planned")
    for heading in headings:
        table.add_column(heading, justify="right")
    for r in rounds:
        known = np.isfinite(r.sigma)
        cells = [str(r.measured), str(r.configurations), length(r.accuracy) if known else "–"]
        cells += [length(v) if known else "–" for v in (r.floor, r.sigma)]
        cells += [_left(r.left), str(r.planned)]
        table.add_row(str(r.number), *cells)
    return table


def show_next(state: CampaignState, q: FloatArray, times: Sequence[int], console: Console) -> None:
    """Print what to measure next: configurations ``q`` (m, joints) [rad | m], each ``times``."""
    robot = state.problem.robot
    console.print(f"{state.outcome + ': ' if state.outcome else ''}{state.message}")
    if state.rounds:
        console.print(rounds_table(state.rounds))
    held_out = state.configurations[state.queue[0]].role == VALIDATION
    title = "measure next, for validation" if held_out else "measure next, in this order"
    console.print(configurations_table(title, robot, q, times))


def _left(number: float) -> str:
    if np.isnan(number):
        return "–"
    return f"{number:.0f}" if np.isfinite(number) else "out of reach"
