# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner simulate``: measure a plan with a simulated robot and tracker."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.arrays import FloatArray, IntArray, check_count, check_number, plain
from calib_planner.cli.arguments import (
    ERROR_MODEL,
    SIGMA,
    Commands,
    add_command,
    add_parameters,
    add_reading,
    add_robot,
    add_seed,
    choose_parameters,
    load_robot,
    option,
    reading_of,
)
from calib_planner.cli.gravity import add_gravity, error_model_of
from calib_planner.cli.terminal import Terminal
from calib_planner.error_model import to_mapping
from calib_planner.errors import FileFormatError, InputError
from calib_planner.io import check_writable, measurements_text, read_plan, read_plan_csv, write_measurements
from calib_planner.robot import Robot
from calib_planner.simulation import (
    ANGLE_ERROR,
    LENGTH_ERROR,
    SimulatedCell,
    independent_seeds,
    random_deviations,
)
from calib_planner.units import length, signed

EXAMPLE = """calib-planner simulate --robot kuka_kr270 --plan plan.yaml --seed 7 --output measured.csv
  calib-planner identify --robot kuka_kr270 --data measured.csv"""


def add(commands: Commands, summary: str) -> None:
    parser = add_command(commands, "simulate", summary, run, EXAMPLE)
    add_robot(parser)
    add_reading(parser)
    add_parameters(parser)
    text = "plan .yaml, or a .csv with a column per joint and optionally one named repetitions"
    option(parser, "--plan", "FILE", text, required=True)
    option(parser, "--repetitions", "K", "number of measurements at each configuration (the plan's)", kind=int)
    truth = parser.add_argument_group("the true robot")
    text = "true deviation from nominal [m | rad]; repeat; no others then (drawn from the seed)"
    option(truth, "--true", "NAME=VALUE", text, kind=assignment, action="append")
    text = "how it errs besides: typical (gravity, joint functions, repeatability), paper (not at all), or YAML, "
    option(truth, "--error-model", "E", text + "also an estimate", ERROR_MODEL)
    option(truth, "--length-error", "S", "standard deviation of drawn length errors [m]", LENGTH_ERROR)
    option(truth, "--angle-error", "S", "standard deviation of drawn angle errors [rad]", ANGLE_ERROR)
    option(truth, "--sigma", "S", "standard deviation of one coordinate of the tracker [m]", SIGMA)
    add_seed(truth)
    text = "seed of what is new at each measurement, for another set of the same robot (drawn from --seed)"
    option(truth, "--noise-seed", "N", text, kind=int)
    add_gravity(parser, measured=False)
    option(parser, "--output", "FILE", "CSV of measurements (stdout without --json)")


def assignment(text: str) -> tuple[str, float]:
    """``NAME=VALUE``."""
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, got {text!r}") from None


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    robot = choose_parameters(load_robot(args), args)
    configurations, repetitions = _plan(robot, args)
    if args.output:
        check_writable(args.output, "--output")
    check_count("--seed", args.seed, low=0, high=2**63 - 1)
    truth_seed, noise_seed = independent_seeds(args.seed, 2)
    if args.noise_seed is not None:
        noise_seed = check_count("--noise-seed", args.noise_seed, low=0, high=2**63 - 1)
    errors = _true_errors(robot, args, truth_seed)
    model = error_model_of(args, args.error_model, robot)
    cell = SimulatedCell(robot, errors, args.sigma, error_model=model, seed=truth_seed)
    data = cell.measure(configurations, repetitions, noise_seed)
    result = {
        "robot": robot.name,
        "true": [
            {"name": p.name, "unit": p.unit, "nominal": p.nominal, "deviation": errors[p.name]}
            for p in robot.with_parameters(tuple(errors)).parameters
        ],
        "error_model": {
            "terms": [{"name": name, "size": size} for name, size in cell.truth.sizes(data.q).items()],
            "model": to_mapping(cell.truth.model),
        },
        "joint_names": robot.joint_names,
        "configurations": data.q,
        "points": data.p,
        "measurements": len(data),
        "sigma": args.sigma,
        "seed": args.seed,
        "output": args.output,
    }
    if args.output:
        write_measurements(args.output, data, "--output")
    elif not args.json:
        print(measurements_text(data), end="")
    if args.json:
        terminal.answer(plain(result), lambda console: None)
    else:
        _show(result, terminal.out if args.output else terminal.err)


def _plan(robot: Robot, args: argparse.Namespace) -> tuple[FloatArray, IntArray | int]:
    """Configurations (N, joints) and how often each is measured."""
    if args.plan.lower().endswith((".yaml", ".yml")):
        plan = read_plan(args.plan)
        if set(plan.joint_names) != set(robot.joint_names):
            wanted = f"the robot's joints {', '.join(robot.joint_names)}"
            raise FileFormatError(args.plan, "joint_names", ", ".join(plan.joint_names), wanted)
        q = plan.configurations[:, [plan.joint_names.index(n) for n in robot.joint_names]]
        repetitions = plan.repetitions
    else:
        q, repetitions = read_plan_csv(args.plan, robot, reading_of(args))
    return q, repetitions if args.repetitions is None else args.repetitions


def _true_errors(robot: Robot, args: argparse.Namespace, seed: int) -> dict[str, float]:
    if args.true is None:
        for name in ("length_error", "angle_error"):
            check_number(f"--{name.replace('_', '-')}", getattr(args, name), low=0, high=1)
        return random_deviations(robot, seed, args.length_error, args.angle_error)
    errors: dict[str, float] = dict(args.true)
    for name, value in errors.items():
        if not np.isfinite(value):
            raise InputError(f"--true {name}", value, "a finite deviation [m | rad]")
    robot.with_deviations(errors)  # refuses unknown names
    return errors


def _show(result: dict[str, Any], console: Console) -> None:
    table = Table("parameter", "unit", title="true deviations")
    table.add_column("deviation", justify="right")
    for row in result["true"]:
        unit = "mm" if row["unit"] == "m" else "mrad"
        table.add_row(row["name"], unit, signed(1e3 * row["deviation"], 4, plus=True))
    console.print(table)
    terms = Table("term", title=f"error model {result['error_model']['model']['name']}: what moves the points")
    terms.add_column("rms", justify="right")
    for row in result["error_model"]["terms"]:
        terms.add_row(row["name"], length(row["size"]))
    console.print(terms)
    where = f" written to {result['output']}" if result["output"] else ""
    console.print(f"{result['measurements']} measurements{where}, seed {result['seed']}")
