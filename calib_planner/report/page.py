# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration as one HTML page: for a screen, a phone and paper; without network.

Every number of the page is taken from the JSON that the page holds, by its key there, and written as
``<data value="exact" data-key="where in the JSON">rounded</data>``, so that page and JSON cannot differ.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path, PurePath
from shlex import quote
from typing import Any

from markupsafe import Markup

from calib_planner.error_model import MEANINGS
from calib_planner.identification import FOREMOST, STRONG, Estimate, IdentificationProblem
from calib_planner.io import URDF_SUFFIXES, write_text
from calib_planner.report import charts
from calib_planner.report.calibration import CalibrationReport, Provenance, calibration_report
from calib_planner.report.render import TEMPLATES, embedded, render
from calib_planner.report.scene import still_picture
from calib_planner.robot import is_nuisance
from calib_planner.units import MILLI_UNIT, length, lengths, signed

HEADLINES = {
    "PASS": ("✓", "Good: apply it"),
    "WARN": ("!", "Usable with care: read the reasons first"),
    "FAIL": ("✗", "Do not apply it as it stands"),
}
"""Mark and words of each level."""
FRAMES = {"world": " in the frame of the points", "robot": " up to a new registration of the robot"}
"""Frame of the accuracy at the test poses → the words behind it."""
MOST_PAIRS = 40
"""Correlated pairs that are listed by name."""


def write_report(
    path: str | Path,
    problem: IdentificationProblem,
    estimate: Estimate,
    provenance: Provenance | None = None,
    field: str = "output",
) -> None:
    """Write the page; arguments as for ``calibration_report``.

    Raises:
        InputError: The path cannot be written, names ``field``; or as for ``calibration_report``.
    """
    write_text(path, report_page(calibration_report(problem, estimate, provenance)), field)


def report_page(report: CalibrationReport) -> str:
    """The page as HTML text."""
    data, points = report.to_dict(), int(report.problem.data.seen.sum())
    mark, advice = HEADLINES[data["estimate"]["verdict"]["level"]]
    gain, promise = charts.accuracy_charts(report.estimate)
    return render(
        TEMPLATES / "calibration.html",
        report=report,
        charts=charts,
        points=charts.drawn_points(report),
        gain=gain,
        promise=promise,
        still=still_picture(report.scene),
        data=data,
        e=data["estimate"],
        provenance=data["provenance"],
        value=lambda key: value_at(data, key),
        rounded=rounded,
        one_unit=lambda keys: "mm" if max(value_at(data, k) or 0.0 for k in keys) >= 1e-3 else "µm",
        mark=mark,
        advice=advice,
        sets=charts.compared_sets(report.estimate),
        frame=FRAMES[data["estimate"]["accuracy_frame"]],
        source=report.estimate.noise_source,
        meanings=MEANINGS,
        deflection_marks=charts.deflection_marks(report.estimate),
        papers=report.estimate.knowledge.model.is_papers,
        parameters=_parameters(report.estimate),
        placed=any(map(is_nuisance, report.estimate.fit.parameters)),
        ways=ways_to_apply(report),
        counts={
            "rows": len(report.problem.data),
            "points": points,
            "dots": min(points, charts.MOST_DOTS),
            "robots": len(report.scene.robot_rows),
            "joint_dots": min(points, charts.MOST_DOTS // 2),
        },
        systematic=len(report.estimate.knowledge.model.systematic) > 1,
        shown_unit=MILLI_UNIT,
        most_pairs=MOST_PAIRS,
        most_reasons=FOREMOST,
        strong=STRONG,
        embedded=embedded,
        json_text=_json(data),
    )


def _json(data: Mapping[str, Any]) -> Markup:
    """JSON that no HTML parser takes for the end of a script."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))


def value_at(data: Any, key: str) -> Any:
    """What the JSON holds under ``a.b.0``, that is ``data["a"]["b"][0]``."""
    for part in key.split("."):
        data = data[int(part)] if isinstance(data, list) else data[part]
    return data


def rounded(value: float, style: str) -> str:
    """A number for people: ``length`` with its unit, ``milli`` (mm, mrad), ``change`` (signed), …"""
    if style == "length":
        return "< 1 nm" if 0 < abs(value) < 1e-9 else length(value)
    if style in ("mm", "µm"):  # one unit for what is compared, digits as in ``lengths``
        return lengths(value, 1.0)[0] if style == "mm" else f"{1e6 * value:.3g} µm"
    if style == "milli":
        return signed(1e3 * value, 4)
    if style == "change":
        return signed(1e3 * value, 4, plus=True)
    if style == "gain":
        return signed(value, 1, plus=True)
    if style == "percent":
        return f"{100 * value:.0f} %"
    if style == "correlation":
        return signed(value, 3, plus=True)
    if style == "short":
        return (f"{value:.0f}" if 1e3 <= abs(value) < 1e7 else f"{value:.3g}").replace("-", "−")
    if style == "count":
        return str(value)
    raise ValueError(style)


# ── what the template lists ──────────────────────────────────────────────────────────────────────────


def _parameters(e: Estimate) -> list[dict[str, Any]]:
    """Index, name, unit and remarks of each parameter."""
    partners: dict[str, list[str]] = {}
    for a, b, c in e.fit.correlations:
        for one, other in ((a, b), (b, a)):
            partners.setdefault(one, []).append(f"{other} ({signed(c, 2)})")
    fixed = dict(zip(e.observability.fixed, e.observability.unidentifiable, strict=True))
    return [
        {
            "index": i,
            "name": name,
            "unit": MILLI_UNIT[unit],
            "fixed": fixed.get(name, ""),
            "partners": partners.get(name, []),
            "sigmas": None
            if is_nuisance(name) or not e.fit.std[i] > 0
            else abs(e.fit.deviations[i] / e.fit.std[i]),
        }
        for i, (name, unit) in enumerate(zip(e.fit.parameters, e.fit.units, strict=True))
    ]


def ways_to_apply(report: CalibrationReport) -> list[tuple[str, str, str]]:
    """How to apply this estimate to this robot: (for which controller, what it does, command to copy)."""
    made = report.provenance
    robot = made.named("robot") or report.problem.robot.source or report.problem.robot.name
    learnt = len(report.estimate.knowledge.model.systematic) > 1
    without = " It holds placement alone: gravity and joint functions are not in it." if learnt else ""
    export = f"calib-planner export {quote(made.estimate or 'estimate.yaml')}"
    ways = []
    if PurePath(robot).suffix.lower() in URDF_SUFFIXES:
        text = (
            "Your URDF with the identified origins of the joints, all else byte for byte: your robot_description."
        )
        command = f"{export} --urdf calibrated.urdf"
        ways.append(("A controller or planner that reads a URDF", text + without, command))
    text = "x, y, z, roll, pitch, yaw per joint and a hash, in the form of Universal Robots' description."
    command = f"{export} --kinematics my_kinematics.yaml"
    ways.append(("Kinematics from xyz + rpy per joint", text + without, command))
    text = "Joint targets corrected one by one, so that the real tool goes where the nominal model says."
    if learnt:
        text += " With gravity and joint functions: this alone reaches the accuracy of the whole error model."
    command = f"{export} --targets path.csv corrected.csv"
    return [*ways, ("A controller whose model cannot be changed", text, command)]
