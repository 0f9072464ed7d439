"""HTML pieces of the page: tables, lists, pictures inside the page. Text is escaped here and nowhere else."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template

import numpy as np

from calib_planner import __version__
from calib_planner.errors import InputError
from calib_planner.io import write_text
from calib_planner.units import signed
from calib_planner_paper import printed
from calib_planner_paper.drawing import draw_figure_5, draw_two_link_figure, png, svg
from calib_planner_paper.kuka import DRAWN, SEPARATE, SIGMA, WORKSPACE, Figure5, Rows, Table2, scaled
from calib_planner_paper.reproduce import Reproduction
from calib_planner_paper.two_link import Table1, TwoLinkFigure


@dataclass(frozen=True)
class Cell:
    """A cell that is more than text.

    Attributes:
        text: What it says.
        kind: Class: ``wrong`` for a printed value that contradicts the paper itself, ``words`` for prose.
    """

    text: str
    kind: str


@dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
        cells: Text, left to right.
        ours: Whether the numbers were computed here; such rows stand out.
    """

    cells: Sequence[str | Cell]
    ours: bool = False


def table(caption: str, header: Sequence[str], rows: Iterable[Row]) -> str:
    """A table that scrolls by itself on a narrow screen."""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "\n".join(_row(row) for row in rows)
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return (
        f'<div class="scroll"><table>{title}<thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>'
    )


def _row(row: Row) -> str:
    kind = ' class="ours"' if row.ours else ""
    return f"<tr{kind}>{''.join(_cell(c) for c in row.cells)}</tr>"


def _cell(cell: str | Cell) -> str:
    if isinstance(cell, str):
        return f"<td>{escape(cell)}</td>"
    return f'<td class="{cell.kind}">{escape(cell.text)}</td>'


def listed(items: Iterable[str]) -> str:
    """Bullets."""
    return f"<ul>{''.join(f'<li>{escape(i)}</li>' for i in items)}</ul>"


def picture(wide: bytes, narrow: bytes, described: str) -> str:
    """SVG images inside the page: one for wide screens and paper, one for phones; the text describes both."""
    sources = [f"data:image/svg+xml;base64,{b64encode(image).decode()}" for image in (narrow, wide)]
    text = escape(described)
    return (
        f'<figure><picture><source media="screen and (max-width: 620px)" srcset="{sources[0]}">'
        f'<img src="{sources[1]}" alt="{text}"></picture><figcaption>{text}</figcaption></figure>'
    )


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


# ── The page: the paper's numbers beside those computed here, and in words what agrees and what cannot be com
# The words are in the template; every number in them comes from the result, whatever its seed.

TEMPLATE = Path(__file__).parent / "reproduction.html"
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


# ── The page's tables and numbers on the KUKA KR 270: Table 2 and Fig. 5 ────────────────────────────────────

LABELS = tuple(str(m) if r == 1 else f"{m}×{r}" for m, r in printed.SIZES)
ONE_FOUR, FEW, FOUR, TWELVE = (LABELS.index(label) for label in ("4", "3×4", "4×3", "12"))


# ── Table 2 ──────────────────────────────────────────────────────────────────────────────────────────


def table_2_values(tables: Sequence[Table2]) -> dict[str, str]:
    """Template values: choices, tables, words."""
    first = tables[0]
    box = zip("xyz", np.asarray(WORKSPACE.low), np.asarray(WORKSPACE.high), strict=True)
    poses = [f"{t.pose.name}: ({_angles(t)}), {t.pose.why}" for t in tables]
    bounds = {plan.quality.bound for one in tables for plan in one.plans.values()}
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
        "elsewhere": ", ".join(micrometres(first.plans[m].quality.general_accuracy) for m in SEPARATE),
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


# ── The files of a reproduction: ``tables.json``, figures as PNG and SVG, and the page ``index.html`` ───────


def make_folder(folder: str | Path) -> Path:
    """The folder, made if need be.

    Raises:
        InputError: It cannot be made.
    """
    path = Path(folder).expanduser()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _refused(path, error) from None
    return path


def publish(result: Reproduction, folder: str | Path) -> None:
    """Write all files to ``folder``, made if need be. Same result, same bytes.

    Raises:
        InputError: The folder cannot be made or written.
    """
    target = make_folder(folder)
    pairs = {
        "figure_2": [draw_two_link_figure(result.figure_2, narrow=n) for n in (False, True)],
        "figure_3": [draw_two_link_figure(result.figure_3, narrow=n) for n in (False, True)],
        "figure_5": [draw_figure_5(result.figure_5, narrow=n) for n in (False, True)],
    }
    pictures = {}
    for name, (wide, narrow) in pairs.items():
        pictures[name] = svg(wide), svg(narrow)
        try:
            (target / f"{name}.svg").write_bytes(pictures[name][0])
            (target / f"{name}.png").write_bytes(png(wide))
        except OSError as error:
            raise _refused(target, error) from None
    text = json.dumps(result.to_dict(), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(target / "tables.json", text + "\n")
    write_text(target / "index.html", page(result, pictures))


def _refused(folder: Path, error: OSError) -> InputError:
    reason = f"{folder} ({error.strerror or error})"
    return InputError("output", reason, "a folder that can be made and written", "choose another")
