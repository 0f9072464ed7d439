"""The page: the paper's numbers beside those computed here, and in words what agrees and what cannot be compared.

The words are in the template; every number in them comes from the result, whatever its seed.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from string import Template

import numpy as np

from calib_planner import __version__
from calib_planner.report.quantities import signed
from calib_planner.report.reproduction.markup import Cell, Row, picture, table
from calib_planner.report.reproduction.page_kuka import figure_5_values, table_2_values
from calib_planner.report.reproduction.run import Reproduction
from calib_planner.report.reproduction.table_1 import Table1
from calib_planner.report.reproduction.two_link_figure import TwoLinkFigure

TEMPLATE = Path(__file__).parents[1] / "templates" / "reproduction.html"
PLANS = {"a": "a, poor", "b": "b, D-optimal", "c": "c, for the test pose"}

Pictures = Mapping[str, tuple[bytes, bytes]]
"""Figure → SVG for wide screens and paper, SVG for phones."""


def page(result: Reproduction, pictures: Pictures) -> str:
    """The page as HTML text."""
    settings = result.settings
    values = {
        "version": __version__,
        "seed": str(settings.seed),
        "random": f"{settings.random_plans:,}".replace(",", " "),
        "calibrations": str(settings.calibrations),
        **_table_1_values(result.table_1),
        **_two_link_values(result.figure_2, pictures["figure_2"]),
        **_two_link_values(result.figure_3, pictures["figure_3"]),
        **table_2_values(result.table_2),
        **figure_5_values(result.figure_5, pictures["figure_5"]),
    }
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(values)


# ── Table 1 ──────────────────────────────────────────────────────────────────────────────────────────


def _table_1_values(result: Table1) -> dict[str, str]:
    columns = result.columns
    angles = [f"{np.degrees(c.q20):.0f}°" for c in columns]
    wrong = [(angle, c) for angle, c in zip(angles, columns, strict=True) if c.misprinted]

    def printed(texts: list[str]) -> list[str | Cell]:
        return [Cell(t, "wrong") if c.misprinted else t for t, c in zip(texts, columns, strict=True)]

    rows = [
        Row(("ρ0²/σ², paper", *printed([f"{c.printed:g}" for c in columns]))),
        Row(("by (20)", *(f"{c.closed_form:.3f}" for c in columns)), True),
        Row(("planner's plan, (14)", *(f"{c.planned:.3f}" for c in columns)), True),
        Row(("lower bound", *(f"{c.lower_bound:.3f}" for c in columns)), True),
        Row(("ρD²/σ², D-optimal plan", *(f"{c.d_optimal:.3f}" for c in columns)), True),
        Row(("ρD/ρ0 − 1, paper", *printed([f"{100 * c.printed_gain:.0f} %" for c in columns]))),
        Row(("ρD/ρ0 − 1, here", *(f"{100 * c.gain:.1f} %" for c in columns)), True),
    ]
    return {
        "table_1": table("", ("q20", *angles), rows),
        "right": str(len(columns) - len(wrong)),
        "wrong": " and ".join(angle for angle, _ in wrong),
        "printed_wrong": f"{wrong[0][1].printed:g}",
        "exact_wrong": f"{wrong[0][1].closed_form:.3f}",
        "bound_1": " and ".join(sorted({c.bound for c in columns})),
    }


# ── Figs 2 and 3 ─────────────────────────────────────────────────────────────────────────────────────


def _two_link_values(result: TwoLinkFigure, pictures: tuple[bytes, bytes]) -> dict[str, str]:
    n, gains = result.settings.number, result.gains()
    caption = (
        f"Errors left at the test pose (−45°, 20°) by {len(result.plans[0].errors)} simulated calibrations "
        "per plan; σ = 1 mm."
    )
    return {
        f"figure_{n}": picture(*pictures, caption),
        f"plans_{n}": _plans(result),
        f"gains_{n}": _gains(result),
        f"gain_{n}a": f"{100 * gains[0].expected:.1f}",
        f"gain_{n}b": f"{100 * gains[1].expected:.1f}",
        f"planned_{n}": f"{1e3 * result.planned:.3f}",
        f"bound_{n}": f"{1e3 * result.lower_bound:.3f}",
        f"c_{n}": f"{1e3 * result.plans[2].expected:.3f}",
    }


def _plans(result: TwoLinkFigure) -> str:
    rows = [
        Row(
            (
                PLANS[p.label],
                ", ".join(f"{signed(angle, 0)}°" for angle in angles),
                f"{1e3 * p.expected:.3f}",
                f"{1e3 * p.simulated:.3f} ± {1e3 * p.standard_error:.3f}",
            ),
            True,
        )
        for p, angles in zip(result.plans, result.settings.angles, strict=True)
    ]
    return table("ρ0 [mm]; q1 = 0; ± standard error", ("plan", "q2", "by (14)", "simulated"), rows)


def _gains(result: TwoLinkFigure) -> str:
    rows = [
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
    return table("Gain 1 − ρc/ρ", ("", "paper", "by (14)", "simulated"), rows)
