"""The page's tables and numbers on the KUKA KR 270: Table 2 and Fig. 5."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from calib_planner.report.quantities import signed
from calib_planner.report.reproduction import printed
from calib_planner.report.reproduction.figure_5 import DRAWN, Figure5
from calib_planner.report.reproduction.markup import Cell, Row, listed, micrometres, number, picture, table
from calib_planner.report.reproduction.table_2 import SEPARATE, SIGMA, WORKSPACE, Rows, Table2, scaled

LABELS = tuple(str(m) if r == 1 else f"{m}×{r}" for m, r in printed.SIZES)
ONE_FOUR, FEW, FOUR, TWELVE = (LABELS.index(label) for label in ("4", "3×4", "4×3", "12"))


# ── Table 2 ──────────────────────────────────────────────────────────────────────────────────────────


def table_2_values(tables: Sequence[Table2]) -> dict[str, str]:
    """Template values: choices, tables, words."""
    first = tables[0]
    box = zip("xyz", np.asarray(WORKSPACE.low), np.asarray(WORKSPACE.high), strict=True)
    poses = [f"{t.pose.name}: ({_angles(t)}), {t.pose.why}" for t in tables]
    bounds = {plan.bound for one in tables for plan in one.plans.values()}
    return {
        "workspace": ", ".join(f"{n} {signed(a, 1)} … {signed(b, 1)} m" for n, a, b in box),
        "poses": listed(poses),
        "bound_kuka": " or ".join(sorted(bounds)),
        **_tables(tables),
        **_agreement(first, tables[-1]),
        "at_pose": micrometres(SIGMA * (3 / 12) ** 0.5),
        "spread": ", ".join(f"{_normalised(t.rows()['proposed'], 12):.2f} ({t.pose.name})" for t in tables),
        "tail_3": f"{first.tail(3):.1f}",
        "tail_4": f"{first.tail(4):.1f}",
        "tail_12": f"{first.tail(12):.1f}",
        "elsewhere": ", ".join(micrometres(first.plans[m].general_accuracy) for m in SEPARATE),
        "contradictions": "\n".join(_contradictions()),
    }


def _angles(found: Table2) -> str:
    return ", ".join(f"{signed(a, 0)}°" for a in found.pose.degrees)


def _tables(tables: Sequence[Table2]) -> dict[str, str]:
    rows = tables[0].rows()
    paper, here = (micrometres(r["proposed"][TWELVE]) for r in (printed.TABLE_2, rows))
    header = ("", "", *LABELS)
    title = f"The same over each one's own proposed plan of 12 (paper {paper} µm, here {here} µm)"
    return {
        "micrometres": table(
            "ρ0 [µm] at test pose A, by number of experiments", header, _pairs(printed.TABLE_2, rows, micrometres)
        ),
        "scaled": table(title, header, _pairs(scaled(printed.TABLE_2), scaled(rows), number)),
        "others": table("Other test poses, ρ0 [µm]", header, _others(tables[1:])),
    }


def _pairs(paper: Rows, here: Rows, write: Callable[[float], str]) -> list[Row]:
    """Each row of the paper above ours; rows that the paper does not have alone."""
    wrong = {(d.row, d.column) for d in printed.contradictions()}
    rows = []
    for name, values in here.items():
        if name in paper:
            pairs = zip(LABELS, map(write, paper[name]), strict=True)
            cells = [Cell(text, "wrong") if (name, label) in wrong else text for label, text in pairs]
            rows.append(Row((name, "paper", *cells)))
        rows.append(Row(("" if name in paper else name, "here", *map(write, values)), True))
    return rows


def _others(tables: Sequence[Table2]) -> list[Row]:
    shown = ("random, mean", "random, median", "proposed", "lower bound")
    return [
        Row((name, one.pose.name, *map(micrometres, one.rows()[name])), True) for one in tables for name in shown
    ]


def _agreement(first: Table2, unmeasurable: Table2) -> dict[str, str]:
    """The figures behind "what agrees", here and in the paper."""
    other = unmeasurable.scaled()["proposed"]
    values = {
        "own": _numbers([_normalised(first.rows()["proposed"], m) for m in SEPARATE]),
        "theirs": _numbers([_normalised(printed.TABLE_2["proposed"], m) for m in SEPARATE]),
        "few_c": signed(100 * (other[FEW] - 1), 1),
        "four_c": signed(100 * (other[FOUR] - 1), 1),
    }
    for end, rows in (("", first.scaled()), ("_paper", scaled(printed.TABLE_2))):
        values["few" + end] = signed(100 * (rows["proposed"][FEW] - 1), 1)
        values["four" + end] = signed(100 * (rows["proposed"][FOUR] - 1), 1)
        values["min_12" + end] = number(rows["random, min"][TWELVE])
        values["mean_12" + end] = number(rows["random, mean"][TWELVE])
        values["mean_4" + end] = f"{rows['random, mean'][ONE_FOUR] / rows['proposed'][ONE_FOUR]:.1f}"
    return values


def _normalised(row: tuple[float, ...], m: int) -> float:
    """m·ρ0²/σ²."""
    return m * (row[printed.SIZES.index((m, 1))] / SIGMA) ** 2


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{v:.2f}" for v in values)


def _contradictions() -> list[str]:
    return [
        f"<li>{d.row}, {d.column}: printed {micrometres(d.printed)} µm. Column 4 over √3 is "
        f"{micrometres(d.implied)} µm; the print is column 4 over 3.</li>"
        for d in printed.contradictions()
    ]


# ── Fig. 5 ───────────────────────────────────────────────────────────────────────────────────────────


def figure_5_values(result: Figure5, pictures: tuple[bytes, bytes]) -> dict[str, str]:
    """Template values: the figure, its table, words."""
    count, twelve = len(result.plans[0].errors), result.plans[-1]
    caption = (
        f"Error left at test pose A by {count} simulated calibrations with 12 measurements per plan; "
        f"σ = 0.03 mm. The random plan is the median one of {DRAWN}."
    )
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
        "figure_5": picture(*pictures, caption),
        "plans_5": table("Expected ρ0 [µm]; ± standard error", header, rows),
        "gain_5": signed(100 * result.gain, 0),
        "worst_5": f"{max(abs(p.simulated - p.expected) / p.standard_error for p in result.plans):.1f}",
        "error_5": f"{100 * twelve.standard_error / twelve.expected:.0f}",
    }
