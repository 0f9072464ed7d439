# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The figures: one look, colours that colour-blind readers can tell apart, SVG and PNG.

Each figure comes wide (panels side by side) and narrow (panels below each other, for phones).
"""

from __future__ import annotations

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from calib_planner_paper.calibrations import Calibrations
from calib_planner_paper.kuka import Figure5
from calib_planner_paper.two_link import TwoLinkFigure

BLUE, ORANGE = "#0072B2", "#D55E00"
"""Of the Okabe–Ito palette; they differ in lightness too."""

TITLES = {
    "figure_2": "Fig. 2: two lengths from two measurements",
    "figure_3": "Fig. 3: lengths and joint offsets from three measurements",
    "figure_5": "Fig. 5: simulated calibrations of the KUKA KR 270",
}
"""Name of a figure → its title, in the file and on the page."""
STYLE: dict[str, Any] = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "calib_planner",  # same numbers, same file
    "svg.fonttype": "path",
}
in_style = matplotlib.rc_context(STYLE)


@in_style
def draw_two_link_figure(result: TwoLinkFigure, *, narrow: bool = False) -> Figure:
    """Errors left at the test pose, a panel per plan on the same axes; circles have the radius ρ0."""
    layout = ConstrainedLayoutEngine(h_pad=0.1)
    figure = Figure(figsize=(3.9, 11.6) if narrow else (9.6, 4.1), layout=layout)
    panels = figure.subplots(3, 1) if narrow else figure.subplots(1, 3, sharex=True, sharey=True)
    reach = 1e3 * max(max(np.abs(p.errors).max(), p.expected, p.simulated) for p in result.plans)
    reach = np.ceil(2.1 * reach) / 2
    for axes, one, angles in zip(panels, result.plans, result.settings.angles, strict=True):
        _draw_errors(axes, one)
        title = f"({one.label})  q2 = {', '.join(f'{a:g}°' for a in angles)}".replace("-", "−")
        axes.set_title(f"{title}\nρ0 {1e3 * one.expected:.2f} mm, simulated {1e3 * one.simulated:.2f} mm")
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="error in x [mm]")
        if narrow or axes is panels[0]:
            axes.set_ylabel("error in y [mm]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=1 if narrow else 3, frameon=False)
    return figure


def _draw_errors(axes: Any, one: Calibrations) -> None:
    x, y, _ = 1e3 * one.errors.T
    axes.axhline(0, color="0.85", lw=0.8, zorder=0)
    axes.axvline(0, color="0.85", lw=0.8, zorder=0)
    axes.plot(x, y, "o", ms=4, mfc=BLUE, mec="none", alpha=0.6, label="one calibration")
    around = np.linspace(0.0, 2 * np.pi, 181)
    circle = np.array([np.cos(around), np.sin(around)])
    axes.plot(*(1e3 * one.expected * circle), color="black", lw=1.5, label="radius ρ0 by (14)")
    axes.plot(*(1e3 * one.simulated * circle), color=ORANGE, lw=1.5, ls="--", label="radius simulated RMS")


@in_style
def draw_figure_5(result: Figure5, *, narrow: bool = False) -> Figure:
    """Distance left at the test pose by experiment, a panel per plan on the same axes."""
    figure = Figure(figsize=(3.9, 7.6) if narrow else (9.6, 3.9), layout="constrained")
    shape = (2, 2) if narrow else (1, 4)
    panels = figure.subplots(*shape, sharex=True, sharey=True).ravel()
    for number, (axes, one) in enumerate(zip(panels, result.plans, strict=True)):
        count = len(one.distances)
        axes.plot(np.arange(1, count + 1), 1e6 * one.distances, "o", ms=4, mfc=BLUE, mec="none", alpha=0.6,
                  label="one calibration")  # fmt: skip
        axes.axhline(1e6 * one.expected, color="black", lw=1.5, label="ρ0 by (14)")
        axes.axhline(1e6 * one.simulated, color=ORANGE, lw=1.5, ls="--", label="simulated RMS")
        axes.set_title(f"{one.label.replace('random', 'random, 12')}\nρ0 {1e6 * one.expected:.1f} µm")
        axes.set(xlim=(0, count + 1), ylim=(0, None))
        if number % shape[1] == 0:
            axes.set_ylabel("error at the test pose [µm]")
        if number >= len(panels) - shape[1]:
            axes.set_xlabel("experiment number")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=1 if narrow else 3, frameon=False)
    return figure


@in_style
def titled(figure: Figure, name: str) -> Figure:
    """The same figure with its title, for a file that stands alone; on the page the heading says it."""
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.35)
    figure.suptitle(TITLES[name], fontsize=11, fontweight="bold")
    return figure


@in_style
def svg(figure: Figure) -> bytes:
    """The figure as SVG without a date: same numbers, same bytes."""
    return _saved(figure, format="svg", metadata={"Date": None})


@in_style
def png(figure: Figure) -> bytes:
    """The figure as PNG, 150 dots per inch."""
    return _saved(figure, format="png", dpi=150)


def _saved(figure: Figure, **options: Any) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, **options)
    return data.getvalue()
