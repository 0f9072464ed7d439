"""``calib-planner reproduce``: the paper's tables and figures, computed again."""

from __future__ import annotations

import argparse
from functools import partial

from rich.console import Console
from rich.table import Table

from calib_planner.cli import Commands, Terminal, add_command, add_seed
from calib_planner.io import make_folder
from calib_planner_paper import printed
from calib_planner_paper.reproduce import Reproduction, ReproductionSettings, micrometres, publish, reproduce

DESCRIPTION = """Compute Tables 1 and 2 and Figs 2, 3 and 5 of the paper again, beside what it prints.
Leaves tables.json (lengths [m], angles [rad], variances of Table 1 over σ²), the figures as PNG and SVG, and a
page, index.html, that says what agrees and what cannot be compared. Shown in µm and %. Half a minute of work."""


def add(commands: Commands, summary: str) -> None:
    """Add the command's parser."""
    usual, example = ReproductionSettings(), "calib-planner reproduce --output results/paper"
    parser = add_command(commands, "reproduce", summary, run, example, DESCRIPTION)
    parser.add_argument(
        "--output", default="results/paper", metavar="DIR", help="folder for the files (results/paper)"
    )
    for name, value, text in (
        ("--random", usual.random_plans, "random plans per column of Table 2"),
        ("--calibrations", usual.calibrations, "simulated calibrations per plan of the figures"),
    ):
        parser.add_argument(name, type=int, default=value, metavar="N", help=f"{text} ({value})")
    add_seed(parser)


def run(args: argparse.Namespace, terminal: Terminal) -> None:
    """Do the work."""
    settings = ReproductionSettings(args.random, args.calibrations, args.seed)
    folder = make_folder(args.output)  # before the work, not after it
    with terminal.progress("reproducing the paper") as update:
        result = reproduce(settings, update)
        update(0.95, "figures and page")
        publish(result, folder)
    terminal.answer(result.to_dict(), partial(show_reproduction, result))
    terminal.note(f"Page, figures and tables.json are in {args.output}")


def show_reproduction(result: Reproduction, console: Console) -> None:
    """Print Tables 1 and 2 and the gains of the figures."""
    console.print(_table_1(result))
    for figure in (result.figure_2, result.figure_3):
        for g in figure.gains():
            console.print(
                f"Fig. {figure.settings.number}: plan c gains {100 * g.expected:.1f} % over {g.over}, "
                f"simulated {100 * g.simulated:.0f} ± {100 * g.standard_error:.0f} %, "
                f"paper {100 * g.printed:.0f} %"
            )
    console.print(_table_2(result))
    console.print(
        f"Fig. 5: proposed plans gain {100 * result.figure_5.gain:.0f} % over a random one, paper about 75 %"
    )


def _table_1(result: Reproduction) -> Table:
    columns = result.table_1.columns
    table = Table(title="Table 1: ρ0²/σ² of two measurements, by q20")
    table.add_column("")
    for c in columns:
        table.add_column(c.angle, justify="right")
    table.add_row("paper", *(f"{c.printed:g}{' ✗' if c.misprinted else ''}" for c in columns))
    table.add_row("by (20)", *(f"{c.closed_form:.3f}" for c in columns))
    table.add_row("planned", *(f"{c.planned:.3f}" for c in columns))
    table.add_row("lower bound", *(f"{c.lower_bound:.3f}" for c in columns))
    table.caption = "✗ misprint: contradicts the paper's own (20)"
    return table


def _table_2(result: Reproduction) -> Table:
    table = Table(title="Table 2: ρ0 at the test pose [µm], by number of experiments")
    table.add_column("")
    table.add_column("")
    for label in printed.LABELS:
        table.add_column(label, justify="right")
    for row, values in result.table_2[0].rows().items():
        if row in printed.TABLE_2:
            table.add_row(row, "paper", *map(micrometres, printed.TABLE_2[row]))
        table.add_row("" if row in printed.TABLE_2 else row, "here", *map(micrometres, values))
    table.caption = "The paper's test pose and workspace are not known: compare ratios, not values"
    return table
