"""The report of a calibration as one HTML page: for a screen, a phone and paper; without network.

Every number is made by ``Numbers.shown``: it takes the value from the JSON that the page holds and writes it as
``<data value="exact" data-key="where in the JSON">rounded</data>``, so that page and JSON cannot differ. All text
from outside (names of robots, joints, parameters and files) is escaped by the template engine.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from shlex import quote
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from calib_planner.identification import SIGNIFICANT, STRONG, Estimate, IdentificationProblem
from calib_planner.io import URDF_SUFFIXES, write_text
from calib_planner.report import charts
from calib_planner.report.calibration import CalibrationReport, calibration_report
from calib_planner.report.charts import legend
from calib_planner.report.provenance import Provenance
from calib_planner.report.scene import still_picture
from calib_planner.units import length, signed

TEMPLATES = Path(__file__).parent / "templates"
HEADLINES = {
    "PASS": ("✓", "Good: apply it"),
    "WARN": ("!", "Usable with care: read the reasons first"),
    "FAIL": ("✗", "Do not apply it as it stands"),
}
"""Mark and words of each level."""
MOST_PAIRS = 40
"""Correlated pairs that are listed by name."""
PLACEMENT = ("base.", "target_")
"""Parameters whose nominal value is only a start: how far they moved says nothing."""
POINT_MARKS = (
    ("dots before", "before"),
    ("dots after", "after"),
    ("dots suspect", "suspect, used"),
    ("cross rejected", "rejected"),
)
JOINT_MARKS = (
    ("dots along", "along the joint's motion"),
    ("dots axial", "along its axis"),
    ("dots across", "across both"),
)
"""Class of a mark in the charts, and what it means."""
SHOWN = {"m": "mm", "rad": "mrad"}


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
    data = report.to_dict()
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("calibration.html").render(
        data=data,
        e=data["estimate"],
        provenance=data["provenance"],
        show=Numbers(data).shown,
        headline=HEADLINES[data["estimate"]["verdict"]["level"]],
        sets=_sets(report.estimate),
        parameters=_parameters(report.estimate),
        placed=any(name.startswith(PLACEMENT) for name in report.estimate.parameters),
        structure=_structure(report.estimate),
        ways=ways_to_apply(report),
        pictures=_pictures(report),
        counts=_counts(report),
        corrected=data["estimate"]["joint_corrections"] is not None,
        shown_unit=SHOWN,
        most_pairs=MOST_PAIRS,
        strong=STRONG,
        css=_file("calibration.css"),
        scripts=[_file(f"calibration_{name}.js") for name in ("view", "controls", "table")],
        json_text=embedded(data),
    )


def embedded(data: Mapping[str, Any]) -> Markup:
    """JSON that no HTML parser takes for the end of a script."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))


class Numbers:
    """Numbers of the page, by their key in its JSON; ``a.b.0`` is ``data["a"]["b"][0]``."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        self._data = data

    def value(self, key: str) -> Any:
        """What the JSON holds there."""
        found: Any = self._data
        for part in key.split("."):
            found = found[int(part)] if isinstance(found, list) else found[part]
        return found

    def shown(self, key: str, style: str) -> Markup:
        """HTML of a number; a dash where it is not known."""
        value = self.value(key)
        if value is None:
            return Markup("<span class='unknown'>–</span>")
        tag = Markup('<data value="{}" data-key="{}" data-style="{}">{}</data>')
        return tag.format(repr(value), key, style, rounded(value, style))


def rounded(value: float, style: str) -> str:
    """A number for people: ``length`` with its unit, ``milli`` (mm, mrad), ``change`` (signed), …"""
    if style == "length":
        return "< 1 nm" if 0 < abs(value) < 1e-9 else length(value)
    if style == "milli":
        return signed(1e3 * value, 4)
    if style == "change":
        return signed(1e3 * value, 4, plus=True)
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


def _sets(e: Estimate) -> list[tuple[str, str]]:
    """Name and key of each validation."""
    keys = [k for k in ("validation", "cross_validation") if getattr(e, k) is not None]
    return [(name, f"estimate.{key}") for key, (name, _) in zip(keys, charts.validation_sets(e), strict=True)]


def _parameters(e: Estimate) -> list[dict[str, Any]]:
    """Index, name, unit and remarks of each parameter."""
    partners: dict[str, list[str]] = {}
    for a, b, c in e.correlations:
        for one, other in ((a, b), (b, a)):
            partners.setdefault(one, []).append(f"{other} ({signed(c, 2)})")
    held = dict(zip(e.held, e.unidentifiable, strict=True))
    return [
        {
            "index": i,
            "name": name,
            "unit": SHOWN[unit],
            "held": held.get(name, ""),
            "kind": "held" if name in held else "",
            "partners": partners.get(name, []),
            "sigmas": None if name.startswith(PLACEMENT) or not e.std[i] > 0 else abs(e.deviations[i] / e.std[i]),
        }
        for i, (name, unit) in enumerate(zip(e.parameters, e.units, strict=True))
    ]


def _structure(e: Estimate) -> list[dict[str, Any]]:
    """What the residuals say about where the robot stood, with its key."""
    return [
        {"key": f"estimate.structure.{i}", "joint": s.joint, "kind": s.kind, "found": s.probability < SIGNIFICANT}
        for i, s in enumerate(e.structure)
    ]


def _counts(report: CalibrationReport) -> dict[str, int]:
    points = int(report.problem.data.seen.sum())
    return {
        "rows": len(report.problem.data),
        "points": points,
        "dots": min(points, charts.MOST_DOTS),
        "robots": len(report.scene.robot_rows),
        "joint_dots": min(points, charts.MOST_DOTS // 2),
    }


def _pictures(report: CalibrationReport) -> dict[str, Any]:
    """SVG and legends, all made here; marked as HTML."""
    e, points = report.estimate, charts.drawn_points(report)
    gain, promise = charts.accuracy_charts(e)
    names, matrix = charts.correlation_matrix(e)
    made = {
        "gain": gain,
        "promise": promise,
        "residuals": charts.residual_chart(report, points),
        "gate": charts.gate_chart(report, points),
        "correlations": charts.correlation_chart(names, matrix),
        "still": still_picture(report.scene),
        "residual_legend": legend(POINT_MARKS[:2] + POINT_MARKS[-1:]),
        "gate_legend": legend((("dots after", "used"), *POINT_MARKS[2:])),
        "joint_legend": legend(JOINT_MARKS),
    }
    result: dict[str, Any] = {name: Markup(svg) for name, svg in made.items()}
    joints = zip(e.joint_names, charts.joint_charts(report), strict=True)
    result["joints"] = [(name, Markup(svg)) for name, svg in joints]
    result["corrections"] = [Markup(svg) for svg in charts.correction_charts(report)]
    return result


def _file(name: str) -> Markup:
    return Markup((TEMPLATES / name).read_text(encoding="utf-8"))


# ── How to apply a calibration: the ways that this estimate and this robot allow, with commands to copy ─────


@dataclass(frozen=True)
class Way:
    """One way.

    Attributes:
        title: For what kind of controller.
        text: What it does.
        command: To copy into a terminal; may be empty.
    """

    title: str
    text: str
    command: str


def ways_to_apply(report: CalibrationReport) -> list[Way]:
    """The ways, the most complete first."""
    made = report.provenance
    robot = made.named("robot") or report.problem.robot.source or report.problem.robot.name
    estimate = made.estimate or "estimate.yaml"
    again = _again(report, robot)
    learnt = report.estimate.transmission is not None
    without = " The joint corrections are not in it." if learnt else ""
    ways = []
    if PurePath(robot).suffix.lower() in URDF_SUFFIXES:
        text = (
            "Your URDF with the identified origins of the joints, all else byte for byte: your robot_description."
        )
        ways.append(
            Way(
                "A controller or planner that reads a URDF",
                text + without,
                f"{again} --urdf-output calibrated.urdf",
            )
        )
    text = "x, y, z, roll, pitch, yaw per joint and a hash, in the form of Universal Robots' description."
    ways.append(
        Way(
            "Kinematics from xyz + rpy per joint",
            text + without,
            f"{again} --kinematics-output my_kinematics.yaml",
        )
    )
    text = "Joint targets corrected one by one, so that the real tool goes where the nominal model says."
    text += " With the joint corrections: this alone reaches the accuracy above." if learnt else ""
    command = (
        f"calib-planner compensate --robot {quote(robot)} --estimate {quote(estimate)} "
        "--targets path.csv --output corrected.csv"
    )
    ways.append(Way("A controller whose model cannot be changed", text, command))
    return ways


def _again(report: CalibrationReport, robot: str) -> str:
    """The command that identified, as far as it is known."""
    if "identify" in report.provenance.command:
        return report.provenance.command
    data = report.provenance.named("data") or "points.csv"
    return f"calib-planner identify --robot {quote(robot)} --data {quote(data)} …"
