# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner compare``: the proposed plan beside random ones, the paper's Table 2."""

from __future__ import annotations

import argparse
import re
from functools import partial

from rich.console import Console
from rich.table import Table

from calib_planner.cli.arguments import Commands, add_command, option
from calib_planner.cli.plan import add_jobs, add_problem, make_problem
from calib_planner.cli.terminal import Terminal
from calib_planner.errors import InputError
from calib_planner.planning import Comparison, compare, processes

EXAMPLE = """calib-planner compare --robot kuka_kr270 --degrees --test-pose "0 -60 90 0 45 0" \\
      --configurations 3 4 12 --replicate 3x4 4x3 --random 20000"""


def add(commands: Commands, summary: str) -> None:
    parser = add_command(commands, "compare", summary, run, EXAMPLE)
    work = add_problem(parser, any_criterion=False)
    option(work, "--configurations", "M", "numbers of configurations", kind=int, nargs="+")
    option(work, "--replicate", "KxR", "K configurations measured R times each", nargs="+")
    option(parser, "--random", "N", "number of random plans", 20_000)
    add_jobs(parser)


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    sizes = [(m, 1) for m in args.configurations or ()] + [_size(word) for word in args.replicate or ()]
    if not sizes:
        raise InputError("--configurations", "none", "at least one number", "or give --replicate 3x4")
    problem = make_problem(args, sizes[0][0], sizes[0][1])
    with terminal.working("comparing with random plans"), processes(args.jobs, "--jobs") as executor:
        columns = compare(problem, sizes, args.random, executor)
    result = {
        "robot": problem.robot.name,
        "sigma": problem.instrument.typical,
        "seed": problem.search.seed,
        "columns": [column.to_dict() for column in columns],
    }
    terminal.answer(result, partial(show_comparison, columns))


def _size(word: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)[x×](\d+)", word)
    if match is None:
        raise InputError("--replicate", repr(word), "KxR, such as 3x4")
    return int(match[1]), int(match[2])


def show_comparison(columns: list[Comparison], console: Console) -> None:
    """Print Table 2."""
    table = Table(title="ρ0 at the test pose [µm], by number of configurations")
    table.add_column("")
    for column in columns:
        table.add_column(column.label.replace("x", "×"), justify="right")
    rows = {
        "random, max": [c.random.max() for c in columns],
        "random, min": [c.random.min() for c in columns],
        "random, mean": [c.random.mean() for c in columns],
        "proposed": [c.proposed.quality.predicted_accuracy for c in columns],
        "lower bound": [c.proposed.quality.lower_bound for c in columns],
    }
    for label, values in rows.items():
        table.add_row(label, *(f"{1e6 * v:.4g}" for v in values))
    console.print(table)
    console.print(f"{len(columns[0].random)} random plans per column.")
