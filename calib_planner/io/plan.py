# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Plans as YAML, and plan sheets as CSV, YAML and trajectory; all exact to the bit.

*The CSV* of a sheet has a row per visit. Joint columns bear the joints' own names and are in rad or m, and there
is a column ``repetitions``: whatever reads a plan from a CSV reads the sheet. ``<joint>_deg`` and ``<joint>_mm``
repeat them for people. Empty cells are not known; ``not checked`` says so.

*The YAML* holds ``PlanSheet.to_dict``: numbers that are not known are ``.nan``, what was not checked is ``null``.

*The trajectory* is the YAML of one trajectory_msgs/msg/JointTrajectory with every field, as ``ros2 topic echo``
prints it and ``ros2 topic pub`` takes it:

    ros2 topic pub --once TOPIC trajectory_msgs/msg/JointTrajectory "$(cat trajectory.yaml)"

The robot arrives at every visit at rest and stands for its measurements: two points per visit, or one if the
standstill has no length. Between the points a controller interpolates; nobody has checked what is in its way.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib_planner.errors import InfeasibleError, InputError
from calib_planner.io.columns import REPETITIONS
from calib_planner.io.robots import URDF_SUFFIXES
from calib_planner.io.text import write_text
from calib_planner.io.urdf import read_speed_limits
from calib_planner.io.xacro import split_arguments
from calib_planner.io.yaml import Node, read_document, write_document
from calib_planner.planning import DWELL, KEYS, KINDS, SETTLE, Pace, Plan, PlanSheet, usual_pace
from calib_planner.robot import Robot

SHAPES: dict[str, tuple[str, ...]] = {
    "configurations": ("configurations", "joint_names"),
    "repetitions": ("configurations",),
    "test_poses": ("weights", "joint_names"),
    "weights": ("weights",),
    "predicted_accuracy_per_test_pose": ("weights",),
    "parameter_std": ("parameters",),
}
"""Per array the fields whose lengths its axes have."""

FINITE = ("configurations", "test_poses", "weights")


def write_plan(path: str | Path, plan: Plan, field: str = "output") -> None:
    """Write a plan [rad | m].

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    write_document(path, "plan", plan.values(), field)


def read_plan(path: str | Path) -> Plan:
    """Read a plan.

    Raises:
        FileFormatError: Not a plan of ours; names the key at fault, what it holds and what is valid.
    """
    return parse_plan(read_document(path, "plan"))


def parse_plan(document: Node, finite: Sequence[str] = FINITE) -> Plan:
    """The plan in a mapping of its values, of which the arrays in ``finite`` have to be.

    Raises:
        FileFormatError: As ``read_plan``.
    """
    document.mapping(KEYS, KEYS, "was it written by another version?")
    values = {name: document[name].of_kind(KINDS[name]) for name in KEYS}
    for name, axes in SHAPES.items():
        wanted = tuple(len(values[a]) for a in axes)
        if not values[name].size and 0 in wanted:  # a list without rows does not tell their length
            values[name] = values[name].reshape(wanted)
        if values[name].shape != wanted:
            expected = f"an array of shape {wanted} (as {', '.join(axes)})"
            raise document[name].error(f"shape {values[name].shape}", expected)
    for name in finite:
        if not np.isfinite(values[name]).all():
            raise document[name].error("a number that is not finite", "finite numbers only")
    if not (values["repetitions"] >= 1).all():
        raise document["repetitions"].error("a number below 1", "whole numbers >= 1")
    return Plan.from_values(values)


# ── plan sheets ──────────────────────────────────────────────────────────────────────────────────────

SHEET_FILES = ("plan_sheet.html", "plan_sheet.csv", "plan_sheet.yaml", "trajectory.yaml")
"""The files of a sheet; ``report.write_sheet`` writes them."""
SHARE = 0.25
"""Share of a robot's speed limits at which its joints move between the visits."""
NANO = 1_000_000_000
WORDS = {True: "yes", False: "no", None: "not checked"}


def robot_pace(robot: Robot, dwell: float = DWELL, share: float = SHARE, settle: float = SETTLE) -> Pace:
    """A share of the speed limits in the robot's URDF, or assumed speeds where there are none.

    Args:
        dwell: Time of each measurement, at rest [s].
        settle: Time at rest before it [s].
    """
    usual, path = usual_pace(robot, dwell, settle), split_arguments(robot.source)[0]
    speeds = path.suffix.lower() in URDF_SUFFIXES
    limits = read_speed_limits(robot.source, robot.joint_names) if speeds else None
    if limits is None:
        return usual
    origin = f"at most {share:.3g} of the URDF's speed limits"
    return replace(usual, speeds=share * limits, accelerations=None, origin=origin)


def write_sheet_yaml(path: str | Path, sheet: PlanSheet, field: str = "output") -> None:
    """Write the whole sheet [rad | m | s]; numbers not known are ``.nan``, what was not checked is ``null``.

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    write_document(path, "plan_sheet", sheet.to_dict(), field)


def write_sheet_csv(path: str | Path, sheet: PlanSheet, field: str = "output") -> None:
    """Write the visits.

    Raises:
        InputError: The path cannot be written; or a joint has the name of another column.
    """
    write_text(path, sheet_csv(sheet), field)


def sheet_csv(sheet: PlanSheet) -> str:
    """The text of ``write_sheet_csv``."""
    rows = [_row(sheet, i, visit) for i, visit in enumerate(sheet.to_dict()["stops"])]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(rows[0])
    writer.writerows([_cell(value) for value in row.values()] for row in rows)
    return out.getvalue()


def _row(sheet: PlanSheet, i: int, visit: dict[str, Any]) -> dict[str, Any]:
    """Column name to value, in order; ``visit`` is the i-th of ``to_dict``."""
    plan, sight = sheet.plan, sheet.checks.sight
    turns = sheet.robot.joint_is_revolute
    row: dict[str, Any] = {"order": visit["order"], "configuration_index": visit["configuration_index"]}

    def put(name: str, value: Any) -> None:
        if name in row:
            raise InputError("joint names", name, "names that are not those of other columns of the sheet")
        row[name] = value

    for name, value in visit["joints"].items():
        put(name, value)
    for name, value, turning in zip(plan.joint_names, sheet.degrees[i], turns, strict=True):
        put(f"{name}_{'deg' if turning else 'mm'}", value)
    put(REPETITIONS, visit["repetitions"])
    for turning, unit in ((True, "rad"), (False, "m")):
        if (turns == turning).any():
            put(f"travel_max_{unit}", sheet.total_travel(True, turning)[i])
            put(f"travel_sum_{unit}", sheet.total_travel(False, turning)[i])
    put("margin", visit["margin"])
    put("margin_joint", visit["margin_joint"])
    put("reachable", WORDS[visit["reachable"]])
    put("visible", WORDS[visit["visible"]])
    put("breaks", "; ".join(" ".join(name.split()) for name in visit["breaks"]))
    for t in range(len(sheet.robot.targets)):
        for axis, value in zip("xyz", sight.points[i, t], strict=True):
            put(f"aim_{axis}{t + 1}_m", value)
        put(f"range{t + 1}_m", sight.ranges[i, t])
        put(f"azimuth{t + 1}_rad", sight.azimuths[i, t])
        put(f"elevation{t + 1}_rad", sight.elevations[i, t])
        put(f"incidence{t + 1}_rad", sight.incidences[i, t])
    for name in ("move", "arrive", "settle", "measure", "back_off", "leave"):
        put(f"{name}_s", visit[name])
    return row


def _cell(value: Any) -> str:
    """Numbers exact to the bit; NaN is an empty cell."""
    if isinstance(value, (str, int)):
        return str(value)
    return "" if math.isnan(value) else repr(float(value))


def write_trajectory(path: str | Path, sheet: PlanSheet, field: str = "output") -> None:
    """Write the trajectory [rad | m, s].

    Raises:
        InfeasibleError: A configuration is not reachable: nothing is written that a robot could be sent to.
        InputError: The path cannot be written; names ``field``.
    """
    write_text(path, trajectory_text(sheet), field)


def trajectory_text(sheet: PlanSheet) -> str:
    """The text of ``write_trajectory``: comments, then the message."""
    pace = sheet.timetable.pace
    words = " ".join(pace.origin.split())
    note = (
        f"# Plan {sheet.identity}, {sheet.plan.measurements} measurements. Joint speeds {words}.\n"
        "# Not checked: the way between the points, other objects in the cell. Run at reduced speed first.\n"
    )
    return note + yaml.safe_dump(trajectory(sheet), sort_keys=False, width=100)


def require_reachable(sheet: PlanSheet, consequence: str) -> None:
    """Refuse to send a robot to a configuration that is not reachable.

    Args:
        sheet: The visits with their checks.
        consequence: What therefore does not happen, for the error.

    Raises:
        InfeasibleError: Names the first such visit and what it breaks.
    """
    for i, broken in enumerate(sheet.checks.reach_breaks, 1):
        if broken:
            raise InfeasibleError(", ".join(broken), f"visit {i} of the plan breaks it; {consequence}")


def trajectory(sheet: PlanSheet) -> dict[str, Any]:
    """The message as a mapping, fields in the order of their definition.

    Raises:
        InfeasibleError: A configuration is not reachable; names its visit and what it breaks.
    """
    require_reachable(sheet, "no trajectory goes there")
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(sheet.plan.joint_names),
        "points": [
            {
                "positions": list(q),
                "velocities": [0.0] * len(q),
                "accelerations": [],
                "effort": [],
                "time_from_start": {"sec": after // NANO, "nanosec": after % NANO},
            }
            for q, after in sheet.timetable.points(sheet.plan.configurations)
        ],
    }
