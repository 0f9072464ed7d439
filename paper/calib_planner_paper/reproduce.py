# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner reproduce``: the paper's tables and figures in one run, computed again.

Settings → ``reproduce`` → numbers → ``publish`` → files.

The files are ``tables.json``, the figures as PNG and SVG, and the page ``index.html``, which shows the paper's
numbers beside those computed here, and says what agrees and what cannot be compared. The page's words are in the
template ``reproduction.html``; every number comes from the result, whatever its seed.
"""

from __future__ import annotations

import argparse
import json
from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table as ConsoleTable

from calib_planner import __version__
from calib_planner.arrays import check_count, plain
from calib_planner.cli import Commands, Terminal, add_command, add_seed
from calib_planner.errors import InputError
from calib_planner.io import make_folder, write_text
from calib_planner.report import render
from calib_planner.units import signed
from calib_planner_paper import printed
from calib_planner_paper.drawing import TITLES, draw_figure_5, draw_two_link_figure, png, svg, titled
from calib_planner_paper.kuka import (
    DRAWN,
    ROBOT,
    SEPARATE,
    SIGMA,
    TEST_POSES,
    WORKSPACE,
    Figure5,
    Rows,
    Table2,
    figure_5,
    scaled,
    table_2,
)
from calib_planner_paper.two_link import FIGURE_2, FIGURE_3, Table1, TwoLinkFigure, table_1, two_link_figure

Update = Callable[[float, str], None]
TEMPLATE = Path(__file__).parent / "reproduction.html"
PLANS = {"a": "a, poor", "b": "b, D-optimal", "c": "c, for the test pose"}


@dataclass(frozen=True)
class ReproductionSettings:
    """How much is computed.

    Attributes:
        random_plans: Random plans per column of Table 2; the paper's 20 000.
        calibrations: Simulated calibrations per plan of Figs 2, 3 and 5; the paper's 100.
        seed: Same seed, same numbers.
    """

    random_plans: int = 20_000
    calibrations: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("random", self.random_plans, low=100, high=1_000_000)
        check_count("calibrations", self.calibrations, low=10, high=100_000)
        check_count("seed", self.seed, low=0, high=2**63 - 1)


@dataclass(frozen=True, eq=False)
class Reproduction:
    """The paper's tables and figures as numbers.

    Attributes:
        settings: How much was computed.
        table_1: The two-link arm.
        figure_2, figure_3: Simulated calibrations of it.
        table_2: The KUKA KR 270, one table per test pose; the first is the one to compare.
        figure_5: Simulated calibrations of it at the first test pose.
    """

    settings: ReproductionSettings
    table_1: Table1
    figure_2: TwoLinkFigure
    figure_3: TwoLinkFigure
    table_2: tuple[Table2, ...]
    figure_5: Figure5

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers, SI units and radians: the content of ``tables.json``."""
        return {
            "seed": self.settings.seed,
            "random_plans": self.settings.random_plans,
            "calibrations": self.settings.calibrations,
            "table_1": self.table_1.to_dict(),
            "figure_2": self.figure_2.to_dict(),
            "figure_3": self.figure_3.to_dict(),
            "table_2": {
                "robot": ROBOT,
                "sigma": SIGMA,
                "workspace": plain({"low": WORKSPACE.low, "high": WORKSPACE.high}),
                "columns": [{"configurations": m, "repetitions": r} for m, r in printed.SIZES],
                "printed": {row: list(values) for row, values in printed.TABLE_2.items()},
                "printed_contradictions": [vars(d) for d in printed.contradictions()],
                "test_poses": {t.pose.name: t.to_dict() for t in self.table_2},
            },
            "figure_5": self.figure_5.to_dict(),
        }


def reproduce(settings: ReproductionSettings, update: Update = lambda share, text: None) -> Reproduction:
    """Compute everything.

    Args:
        update: Told of the share done (0 … 1) and what comes next.
    """
    count, seed = settings.calibrations, settings.seed
    update(0.0, "Table 1")
    first = table_1(seed)
    update(0.05, "Fig. 2")
    second = two_link_figure(FIGURE_2, count, seed)
    update(0.15, "Fig. 3")
    third = two_link_figure(FIGURE_3, count, seed)
    tables = []
    for k, pose in enumerate(TEST_POSES):
        update(0.25 + 0.2 * k, f"Table 2, test pose {pose.name}")
        tables.append(table_2(pose, settings.random_plans, seed))
    update(0.85, "Fig. 5")
    last = figure_5(tables[0], count, seed)
    return Reproduction(settings, first, second, third, tuple(tables), last)


# ── the files ────────────────────────────────────────────────────────────────────────────────────────


def publish(result: Reproduction, folder: str | Path) -> None:
    """Write all files to ``folder``, made if need be. Same result, same bytes.

    Raises:
        InputError: The folder cannot be made or written.
    """
    target = make_folder(folder)
    drawn = {
        "figure_2": [draw_two_link_figure(result.figure_2, narrow=n) for n in (False, True)],
        "figure_3": [draw_two_link_figure(result.figure_3, narrow=n) for n in (False, True)],
        "figure_5": [draw_figure_5(result.figure_5, narrow=n) for n in (False, True)],
    }
    for name, (wide, _) in drawn.items():
        try:
            alone = titled(wide, name)
            (target / f"{name}.svg").write_bytes(svg(alone))
            (target / f"{name}.png").write_bytes(png(alone))
        except OSError as error:
            got = f"{target} ({error.strerror or error})"
            raise InputError("output", got, "a folder that can be written", "choose another") from None
    text = json.dumps(result.to_dict(), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(target / "tables.json", text + "\n")
    pictures = {name: (svg(wide), svg(narrow)) for name, (wide, narrow) in drawn.items()}
    write_text(target / "index.html", page(result, pictures))


def page(result: Reproduction, pictures: dict[str, tuple[bytes, bytes]]) -> str:
    """The page as HTML text; ``pictures``: figure → SVG for wide screens and paper, SVG for phones."""
    images = {
        name: [f"data:image/svg+xml;base64,{b64encode(image).decode()}" for image in pair]
        for name, pair in pictures.items()
    }
    return render(
        TEMPLATE,
        version=__version__,
        settings=result.settings,
        random=f"{result.settings.random_plans:,}".replace(",", " "),
        images=images,
        titles=TITLES,
        drawn=DRAWN,
        columns=result.table_1.columns,
        table_1=_table_1(result.table_1),
        two_link={2: _two_link(result.figure_2), 3: _two_link(result.figure_3)},
        **_table_2(result.table_2),
        **_figure_5(result.figure_5),
    )


class Table(NamedTuple):
    """A table: caption, names of the columns, rows of texts."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Row]


class Row(NamedTuple):
    """Texts, left to right; ``ours``: computed here; ``wrong``: columns that contradict the rest of the print."""

    cells: Sequence[str]
    ours: bool = False
    wrong: Sequence[int] = ()


def micrometres(metres: float) -> str:
    """A length in µm as ``number`` writes it, without the unit."""
    return number(1e6 * metres)


def number(value: float) -> str:
    """Three significant digits, all digits from 1000 on, powers of ten from a hundred thousand on."""
    if not np.isfinite(value):
        return "∞"
    if value < 999.5:
        return f"{value:#.3g}".rstrip(".")
    if value < 99_999.5:
        return f"{value:.0f}"
    digits, exponent = f"{value:.2e}".split("e")
    superscript = str(int(exponent)).translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{float(digits):g}·10{superscript}"


# ── the two-link arm ─────────────────────────────────────────────────────────────────────────────────


def _table_1(result: Table1) -> Table:
    columns = result.columns
    wrong = [i for i, c in enumerate(columns, 1) if c.misprinted]
    rows = [
        Row(("ρ0²/σ², paper", *(f"{c.printed:g}" for c in columns)), wrong=wrong),
        Row(("by (20)", *(f"{c.closed_form:.3f}" for c in columns)), ours=True),
        Row(("planner's plan, (14)", *(f"{c.planned:.3f}" for c in columns)), ours=True),
        Row(("lower bound", *(f"{c.lower_bound:.3f}" for c in columns)), ours=True),
        Row(("ρD²/σ², D-optimal plan", *(f"{c.d_optimal:.3f}" for c in columns)), ours=True),
        Row(("ρD/ρ0 − 1, paper", *(f"{100 * c.printed_gain:.0f} %" for c in columns)), wrong=wrong),
        Row(("ρD/ρ0 − 1, here", *(f"{100 * c.gain:.1f} %" for c in columns)), ours=True),
    ]
    return Table("", ("q20", *(c.angle for c in columns)), rows)


def _two_link(result: TwoLinkFigure) -> dict[str, Any]:
    """What the template shows of Fig. 2 or 3."""
    plans = [
        Row(
            (
                PLANS[p.label],
                ", ".join(f"{signed(angle, 0)}°" for angle in angles),
                f"{1e3 * p.expected:.3f}",
                f"{1e3 * p.simulated:.3f} ± {1e3 * p.standard_error:.3f}",
            ),
            ours=True,
        )
        for p, angles in zip(result.plans, result.settings.angles, strict=True)
    ]
    gains = [
        Row(
            (
                f"c over {g.over}",
                f"{100 * g.printed:.0f} %",
                f"{100 * g.expected:.1f} %",
                f"{signed(100 * g.simulated, 0)} ± {100 * g.standard_error:.0f} %",
            )
        )
        for g in result.gains()
    ]
    return {
        "plans": Table("ρ0 [mm]; q1 = 0; ± standard error", ("plan", "q2", "by (14)", "simulated"), plans),
        "gains": Table("Gain 1 − ρc/ρ", ("", "paper", "by (14)", "simulated"), gains),
        "gain": [f"{100 * g.expected:.1f}" for g in result.gains()],
        "planned": f"{1e3 * result.planned:.3f}",
        "bound": f"{1e3 * result.lower_bound:.3f}",
        "c": f"{1e3 * result.plans[2].expected:.3f}",
    }


# ── the KUKA KR 270 ──────────────────────────────────────────────────────────────────────────────────


def _table_2(tables: Sequence[Table2]) -> dict[str, Any]:
    """What the template shows of Table 2: choices, tables, numbers in the text."""
    first, unmeasurable = tables[0], tables[-1]
    rows, twelve = first.rows(), printed.LABELS.index("12")
    box = zip("xyz", np.asarray(WORKSPACE.low), np.asarray(WORKSPACE.high), strict=True)
    paper, here = (micrometres(r["proposed"][twelve]) for r in (printed.TABLE_2, rows))
    title = f"The same over each one's own proposed plan of 12 (paper {paper} µm, here {here} µm)"
    shown = ("random, mean", "random, median", "proposed", "lower bound")
    poses = [(t.pose.name, ", ".join(f"{signed(a, 0)}°" for a in t.pose.degrees), t.pose.why) for t in tables]
    others = [
        Row((name, t.pose.name, *map(micrometres, t.rows()[name])), ours=True)
        for t in tables[1:]
        for name in shown
    ]
    header = ("", "", *printed.LABELS)
    return {
        "workspace": ", ".join(f"{n} {signed(a, 1)} … {signed(b, 1)} m" for n, a, b in box),
        "poses": poses,
        "bounds_kuka": sorted({plan.quality.bound for one in tables for plan in one.plans.values()}),
        "tables_2": [
            Table("ρ0 [µm] at test pose A, by number of experiments", header,
                  _pairs(printed.TABLE_2, rows, micrometres)),
            Table(title, header, _pairs(scaled(printed.TABLE_2), scaled(rows), number)),
            Table("Other test poses, ρ0 [µm]", header, others),
        ],
        "normalised": [
            ", ".join(f"{_normalised(row, m):.2f}" for m in SEPARATE)
            for row in (rows["proposed"], printed.TABLE_2["proposed"])
        ],
        "here": _compared(scaled(rows)),
        "paper": _compared(scaled(printed.TABLE_2)),
        "at_c": _compared(unmeasurable.scaled()),
        "at_pose": micrometres(SIGMA * (3 / 12) ** 0.5),
        "spread": ", ".join(f"{_normalised(t.rows()['proposed'], 12):.2f} ({t.pose.name})" for t in tables),
        "tail": {m: f"{first.tail(m):.1f}" for m in SEPARATE},
        "elsewhere": ", ".join(micrometres(first.plans[m].quality.general_accuracy) for m in SEPARATE),
        "contradictions": [
            (d.row, d.column, micrometres(d.printed), micrometres(d.implied)) for d in printed.contradictions()
        ],
    }  # fmt: skip


def _pairs(paper: Rows, here: Rows, write: Callable[[float], str]) -> list[Row]:
    """Each row of the paper above ours; rows that the paper does not have alone."""
    wrong = {(d.row, d.column) for d in printed.contradictions()}
    rows = []
    for name, values in here.items():
        if name in paper:
            columns = [i for i, label in enumerate(printed.LABELS, 2) if (name, label) in wrong]
            rows.append(Row((name, "paper", *map(write, paper[name])), wrong=columns))
        rows.append(Row(("" if name in paper else name, "here", *map(write, values)), ours=True))
    return rows


def _normalised(row: tuple[float, ...], m: int) -> float:
    """m·ρ0²/σ²."""
    return m * (row[printed.SIZES.index((m, 1))] / SIGMA) ** 2


def _compared(rows: Rows) -> dict[str, str]:
    """Numbers of the text on rows over their proposed plan of 12: what repeating costs [%], and random plans."""
    column = {label: {name: values[i] for name, values in rows.items()} for i, label in enumerate(printed.LABELS)}
    return {
        "few": signed(100 * (column["3×4"]["proposed"] - 1), 1),
        "four": signed(100 * (column["4×3"]["proposed"] - 1), 1),
        "min_12": number(column["12"]["random, min"]),
        "mean_12": number(column["12"]["random, mean"]),
        "mean_4": f"{column['4']['random, mean'] / column['4']['proposed']:.1f}",
    }


def _figure_5(result: Figure5) -> dict[str, Any]:
    """What the template shows of Fig. 5."""
    twelve = result.plans[-1]
    rows = [
        Row(
            (
                p.label.replace("random", "12 random"),
                f"{1e6 * printed.FIGURE_5[p.label]:.1f}",
                f"{printed.FIGURE_5[p.label] / printed.FIGURE_5['12']:.2f}",
                f"{1e6 * p.expected:.1f}",
                f"{p.expected / twelve.expected:.2f}",
                f"{1e6 * p.simulated:.1f} ± {1e6 * p.standard_error:.1f}",
            )
        )
        for p in result.plans
    ]
    header = ("plan", "paper", "over its 12", "by (14)", "over our 12", "simulated")
    return {
        "plans_5": Table("Expected ρ0 [µm]; ± standard error", header, rows),
        "gain_5": signed(100 * result.gain, 0),
        "worst_5": f"{max(abs(p.simulated - p.expected) / p.standard_error for p in result.plans):.1f}",
        "error_5": f"{100 * twelve.standard_error / twelve.expected:.0f}",
    }


# ── the command ``calib-planner reproduce`` ──────────────────────────────────────────────────────────

DESCRIPTION = """Compute Tables 1 and 2 and Figs 2, 3 and 5 of the paper again, beside what it prints.
Leaves tables.json (lengths [m], angles [rad], variances of Table 1 over σ²), the figures as PNG and SVG, and a
page, index.html, that says what agrees and what cannot be compared. Shown in µm and %. Half a minute of work."""
MISPRINT = "✗ misprint: contradicts the paper's own (20)"
UNKNOWN = (
    "The paper's test pose and workspace are not known: compare ratios, not values. ✗ contradicts other numbers"
)


def add(commands: Commands, summary: str) -> None:
    usual, example = ReproductionSettings(), "calib-planner reproduce --output results/paper"
    parser = add_command(commands, "reproduce", summary, run, example, DESCRIPTION, cell=False)
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
    console.print(_shown(_table_1(result.table_1), "Table 1: two measurements, by q20", MISPRINT))
    for figure in (result.figure_2, result.figure_3):
        for g in figure.gains():
            console.print(
                f"Fig. {figure.settings.number}: plan c gains {100 * g.expected:.1f} % over {g.over}, "
                f"simulated {100 * g.simulated:.0f} ± {100 * g.standard_error:.0f} %, "
                f"paper {100 * g.printed:.0f} %"
            )
    console.print(
        _shown(
            _table_2(result.table_2)["tables_2"][0],
            "Table 2: ρ0 at the test pose [µm], by number of experiments",
            UNKNOWN,
        )
    )
    console.print(
        f"Fig. 5: proposed plans gain {100 * result.figure_5.gain:.0f} % over a random one, paper about 75 %"
    )


def _shown(table: Table, title: str, caption: str) -> ConsoleTable:
    """A table of the page for the terminal; ✗ behind what contradicts the rest of the print."""
    shown = ConsoleTable(title=title, caption=caption)
    for k, name in enumerate(table.header):
        shown.add_column(name, justify="right" if k else "left")
    for row in table.rows:
        shown.add_row(*(f"{cell} ✗" if k in row.wrong else cell for k, cell in enumerate(row.cells)))
    return shown
