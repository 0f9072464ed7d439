"""The report of a calibration: is it good, how good, which numbers say so, how to apply it, where it comes from.

``calibration_report`` gathers a problem, its estimate and what is drawn of them; ``write_report`` makes one HTML
file of it that needs nothing else. The page also holds all of it as JSON, ``<script id="report-data">``, where
``estimate`` is ``Estimate.to_dict()`` unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray, plain
from calib_planner.errors import InputError
from calib_planner.identification import Estimate, IdentificationProblem, fit_placement, start_robot
from calib_planner.report.provenance import Provenance
from calib_planner.report.scene import Scene, scene_of


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """An identification problem, its estimate, and what is drawn of them.

    Attributes:
        problem: The problem that was solved.
        estimate: Its estimate, with the validation if there was one.
        provenance: Where it comes from.
        before: (N, targets, 3) measured − predicted with the nominal kinematics, base and targets fitted where
            they are unknown, in the frame of the measurements [m]; NaN where not measured.
        scene: The 3-D view.
    """

    problem: IdentificationProblem
    estimate: Estimate
    provenance: Provenance
    before: FloatArray
    scene: Scene

    def to_dict(self) -> dict[str, Any]:
        """What the page holds as JSON; non-finite numbers are ``None``."""
        values: dict[str, Any] = plain(
            {
                "estimate": self.estimate.to_dict(),
                "required_accuracy": self.estimate.accuracy.required,
                "distances_before": np.linalg.norm(self.before, axis=2),
                "distances_after": np.linalg.norm(self.estimate.residuals.vectors, axis=2),
                "target_offsets": self.estimate.calibrated.target_offsets,
                "scene": self.scene.to_dict(),
                "provenance": self.provenance.to_dict(),
            }
        )
        return values


def calibration_report(
    problem: IdentificationProblem, estimate: Estimate, provenance: Provenance | None = None
) -> CalibrationReport:
    """Gather the report.

    Args:
        problem: The problem that was solved.
        estimate: ``identify(problem)``, possibly with ``validate`` and ``cross_validate``.
        provenance: See ``provenance.provenance``; default: versions and date alone.

    Raises:
        InputError: The estimate is of other data or another robot.
    """
    robot, data = problem.robot, problem.data
    same = estimate.fit.parameters == robot.parameter_names and estimate.calibrated.name == robot.name
    if not same or estimate.residuals.vectors.shape != data.p.shape:
        size = "{} rows and {} parameters of {}"
        got = size.format(len(estimate.residuals.vectors), len(estimate.fit.parameters), estimate.calibrated.name)
        valid = size.format(len(data), len(robot.parameter_names), robot.name)
        raise InputError("estimate", got, valid, "give the problem that the estimate answers")
    used = data.without(estimate.points.rejected)
    nominal = fit_placement(start_robot(robot, data, robust=problem.loss == "robust"), used)
    before = np.asarray(data.p - nominal.positions(data.q))
    scene = scene_of(problem, estimate, before)
    return CalibrationReport(problem, estimate, provenance or Provenance(), before, scene)
