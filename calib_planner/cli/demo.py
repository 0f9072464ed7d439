# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner demo``: the whole way in simulation, without ROS."""

from __future__ import annotations

import argparse

from rich.console import Console

from calib_planner.cli.arguments import Commands, add_command, add_seed, option
from calib_planner.cli.terminal import Terminal
from calib_planner.demo import DemoResult, DemoSettings, print_files, print_table, run_demo
from calib_planner.planning import Progress
from calib_planner.units import length

DESCRIPTION = """Plan for a KUKA KR 270, measure with a simulated tracker, identify, compare with the truth
and with random plans of the same size. Needs no ROS. Shown in mm; with --json in metres and radians."""


def add(commands: Commands, summary: str) -> None:
    usual = DemoSettings()
    parser = add_command(commands, "demo", summary, run, "calib-planner demo --seed 1", DESCRIPTION, cell=False)
    option(parser, "--configurations", "M", "number of different configurations", usual.configurations)
    option(parser, "--repetitions", "K", "number of measurements at each configuration", usual.repetitions)
    option(parser, "--sigma", "S", "standard deviation of one coordinate of the tracker [m]", usual.sigma)
    add_seed(parser, usual.seed)
    option(
        parser, "--output", "DIR", "folder for the files; DIR-2, DIR-3 … beside earlier results", "results/demo"
    )


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    settings = DemoSettings(args.configurations, args.repetitions, args.sigma, seed=args.seed)
    with terminal.progress("planning, then random plans to compare with") as update:

        def report(progress: Progress) -> None:
            text = f"best ρ0 {length(progress.best_accuracy)}" if progress.starts_done else ""
            update(progress.starts_done / progress.starts_total, text)

        result = run_demo(settings, args.output, report)
    terminal.answer(result.to_dict(), lambda console: show(result, console))


def show(result: DemoResult, console: Console) -> None:
    """Print what was achieved; the last line is the report's path."""
    print_table(result, console)
    print_files(result.report, console)
