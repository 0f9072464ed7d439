"""A plan sheet as the YAML of one trajectory_msgs/msg/JointTrajectory, every field of it.

It is what ``ros2 topic echo`` would print and what ``ros2 topic pub`` takes:

    ros2 topic pub --once TOPIC trajectory_msgs/msg/JointTrajectory "$(cat trajectory.yaml)"

The robot arrives at every stop at rest and stands for its measurements: two points per stop, or one if the
standstill has no length. Between the points a controller interpolates; nobody has checked what is in its way.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from calib_planner.design.plan_sheet import PlanSheet
from calib_planner.errors import InfeasibleError
from calib_planner.files.text import write_text

NANO = 1_000_000_000


def write_trajectory(path: str | Path, sheet: PlanSheet, field: str = "output") -> None:
    """Write the trajectory [rad | m, s].

    Raises:
        InfeasibleError: A stop is not reachable: nothing is written that a robot could be sent to.
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


def trajectory(sheet: PlanSheet) -> dict[str, Any]:
    """The message as a mapping, fields in the order of their definition.

    Raises:
        InfeasibleError: A stop is not reachable; names it and what it breaks.
    """
    for i, broken in enumerate(sheet.checks.reach_breaks, 1):
        if broken:
            raise InfeasibleError(", ".join(broken), f"stop {i} of the plan breaks it; no trajectory goes there")
    times, points = sheet.timetable, []
    for q, arrive, leave in zip(sheet.plan.configurations.tolist(), times.arrive, times.leave, strict=True):
        points.append(_point(q, arrive))
        if times.pace.dwell > 0:
            points.append(_point(q, leave))
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(sheet.plan.joint_names),
        "points": points,
    }


def _point(positions: list[float], seconds: float) -> dict[str, Any]:
    after = round(float(seconds) * NANO)
    return {
        "positions": list(positions),
        "velocities": [0.0] * len(positions),
        "accelerations": [],
        "effort": [],
        "time_from_start": {"sec": after // NANO, "nanosec": after % NANO},
    }
