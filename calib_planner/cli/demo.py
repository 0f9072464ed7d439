"""``calib-planner demo``: the whole way in simulation, without ROS."""

from __future__ import annotations

import argparse

from calib_planner.cli.arguments import Commands, add_command, add_seed
from calib_planner.cli.terminal import Terminal
from calib_planner.demo import DemoSettings, print_table, run_demo
from calib_planner.planning import Progress

DESCRIPTION = """Plan for a KUKA KR 270, measure with a simulated tracker, identify, compare with the truth
and with random plans of the same size. Needs no ROS. Shown in mm; with --json in metres and radians."""


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    usual = DemoSettings()
    parser = add_command(
        commands,
        "demo",
        summary,
        run,
        "calib-planner demo --seed 3",
        DESCRIPTION,
    )
    parser.add_argument(
        "--configurations",
        type=int,
        default=usual.configurations,
        metavar="M",
        help=f"different configurations ({usual.configurations})",
    )
    parser.add_argument(
        "--repetitions",
        type=int,
        default=usual.repetitions,
        metavar="K",
        help=f"measurements at each ({usual.repetitions})",
    )
    parser.add_argument(
        "--sigma",
        type=float,
        default=usual.sigma,
        metavar="S",
        help=f"tracker's std of one coordinate [m] ({usual.sigma:g})",
    )
    add_seed(parser)
    parser.add_argument(
        "--output", default="results/demo", metavar="DIR", help="folder for the files (results/demo)"
    )


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    settings = DemoSettings(args.configurations, args.repetitions, args.sigma, seed=args.seed)
    with terminal.progress("planning, then random plans to compare with") as update:

        def report(progress: Progress) -> None:
            text = f"best ρ0 {1e3 * progress.best_accuracy:.4f} mm" if progress.starts_done else ""
            update(progress.starts_done / progress.starts_total, text)

        result = run_demo(settings, args.output, report)
    terminal.answer(result.to_dict(), lambda console: print_table(result, console))
    terminal.note(f"Plan, measurements, estimate, picture and report (calibration.html) are in {args.output}")
