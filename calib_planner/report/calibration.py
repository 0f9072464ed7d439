"""The report of a calibration: is it good, how good, what says so, what to do with it, where it comes from.

``calibration_report`` gathers what was asked and what was found; ``write_report`` makes one HTML file of it that
needs nothing else. All of it is in the page once more as JSON, ``<script id="report-data">``: ``estimate`` is
``Estimate.to_dict()`` unchanged, and every number shown names the key that it was taken from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray, plain
from calib_planner.errors import InputError
from calib_planner.identification import Estimate, IdentificationProblem, fit_placement, start_robot
from calib_planner.measurements import Measurements
from calib_planner.report.provenance import Provenance
from calib_planner.report.scene import Scene, scene_of


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """A question, its answer, and what is drawn of them.

    Attributes:
        problem: What was asked.
        estimate: What was found, with its validation if there was one.
        provenance: Where it comes from.
        before: (N, targets, 3) measured − predicted with the nominal kinematics, base and targets fitted where
            they are unknown [m], NaN where not measured.
        scene: The 3-D view.
    """

    problem: IdentificationProblem
    estimate: Estimate
    provenance: Provenance
    before: FloatArray
    scene: Scene

    def to_dict(self) -> dict[str, Any]:
        """What the page holds as JSON; non-finite numbers are ``None``."""
        known: dict[str, Any] = plain(
            {
                "estimate": self.estimate.to_dict(),
                "required_accuracy": self.estimate.required_accuracy,
                "distances_before": np.linalg.norm(self.before, axis=2),
                "distances_after": np.linalg.norm(self.estimate.residuals, axis=2),
                "target_offsets": self.estimate.calibrated.target_offsets,
                "scene": self.scene.to_dict(),
                "provenance": self.provenance.to_dict(),
            }
        )
        return known


def calibration_report(
    problem: IdentificationProblem, estimate: Estimate, provenance: Provenance | None = None
) -> CalibrationReport:
    """Gather the report.

    Args:
        problem: What was asked.
        estimate: ``identify(problem)``, possibly with ``validate`` and ``cross_validate``.
        provenance: See ``provenance.provenance``; default: versions and date alone.

    Raises:
        InputError: The estimate is of other data or another robot.
    """
    same = estimate.parameters == problem.robot.parameter_names and estimate.robot == problem.robot.name
    if not same or estimate.residuals.shape != problem.data.p.shape:
        size = "{} rows and {} parameters of {}"
        got = size.format(len(estimate.residuals), len(estimate.parameters), estimate.robot)
        asked = size.format(len(problem.data), len(problem.robot.parameter_names), problem.robot.name)
        raise InputError("estimate", got, asked, "give the problem that the estimate answers")
    before = _before(problem, estimate)
    return CalibrationReport(
        problem, estimate, provenance or Provenance(), before, scene_of(problem, estimate, before)
    )


def _before(problem: IdentificationProblem, estimate: Estimate) -> FloatArray:
    """As ``Estimate.residual_before``, for every point."""
    data = problem.data
    points = np.array(data.p)
    for rejected in estimate.rejected:
        points[rejected["row"], rejected["target"] - 1] = np.nan
    used = Measurements(data.joint_names, data.q, points, data.std)
    start = start_robot(problem.robot, data, robust=problem.loss == "robust")
    return np.asarray(data.p - fit_placement(start, used).positions(data.q))
