"""How to apply a calibration: the ways that this estimate and this robot allow, with commands to copy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePath
from shlex import quote

from calib_planner.report.calibration_report import CalibrationReport
from calib_planner.robot.catalogue import URDF_SUFFIXES


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
