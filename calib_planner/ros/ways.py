# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Ways of the robot as messages: to a controller, and from MoveIt.

Both kinds of messages are optional: where ``control_msgs`` or ``moveit_msgs`` is not installed, ``None`` stands
here, and the nodes say what to install.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from calib_planner.arrays import FloatArray
from calib_planner.errors import CalibPlannerError, InputError
from calib_planner.planning import Trajectory
from calib_planner.ros.messages import duration_message, seconds_of
from calib_planner.units import listed

try:
    from control_msgs.action import FollowJointTrajectory
except ImportError:  # pragma: no cover - depends on what is installed
    FollowJointTrajectory = None
try:
    from moveit_msgs.msg import Constraints, JointConstraint, MotionPlanRequest
    from moveit_msgs.srv import GetMotionPlan
except ImportError:  # pragma: no cover - depends on what is installed
    GetMotionPlan = None

INSTALL = "{0} is not installed: sudo apt install ros-$ROS_DISTRO-{1}, or build it in your workspace"
NO_CONTROL = INSTALL.format("control_msgs", "control-msgs")
NO_MOVEIT = INSTALL.format("moveit_msgs", "moveit-msgs")
STRAY = 1e-4
"""Joints of others that move less than this along a way stand still [rad | m]."""
GOAL_RANGE = 1e-4
"""How near MoveIt has to plan to a configuration, either side [rad | m]."""
SUCCESS = 1
"""``moveit_msgs/MoveItErrorCodes.SUCCESS``."""


def way_to_message(way: Trajectory, joint_names: Sequence[str]) -> JointTrajectory:
    """A way for a controller, which begins when it gets it: the stamp is zero.

    The first point is left out. There the robot stands already, as exactly as its controller holds it, which is
    not exactly where its encoders say.
    """
    message = JointTrajectory(joint_names=list(joint_names))
    for time, q, speed in zip(way.times[1:], way.positions[1:], way.velocities[1:], strict=True):
        after = duration_message(time)
        message.points.append(
            JointTrajectoryPoint(positions=q.tolist(), velocities=speed.tolist(), time_from_start=after)
        )
    return message


def way_from_message(message: JointTrajectory, joint_names: Sequence[str], start: FloatArray) -> Trajectory:
    """A way that came over the wire, from ``start`` (joints,) [rad | m] if it has no point at time 0.

    Where velocities are missing, they are those of the neighbouring points; at both ends the robot rests.

    Raises:
        InputError: Joints are missing or others move, lengths do not fit, times do not ascend.
    """
    names = list(message.joint_names)
    missing = [n for n in joint_names if n not in names]
    if missing or len(set(names)) != len(names):
        raise InputError("trajectory.joint_names", listed(names, none="none"), ", ".join(joint_names))
    for k, point in enumerate(message.points):
        if len(point.positions) != len(names) or len(point.velocities) not in (0, len(names)):
            got = f"{len(point.positions)} positions, {len(point.velocities)} velocities"
            raise InputError(f"trajectory.points[{k}]", got, f"{len(names)} of each, or no velocities")
    columns = [names.index(n) for n in joint_names]
    rows = np.array([p.positions for p in message.points], float).reshape(len(message.points), len(names))
    others = [k for k in range(len(names)) if k not in columns]
    if len(rows) and others and np.ptp(rows[:, others], axis=0).max() > STRAY:
        got = listed(names[k] for k in others)
        raise InputError("trajectory", f"a way that moves {got} as well", f"one of {', '.join(joint_names)}")
    times = np.array([seconds_of(p.time_from_start) for p in message.points], float)
    q = rows[:, columns]
    if len(q) and all(len(p.velocities) for p in message.points):
        speeds = np.array([p.velocities for p in message.points], float)[:, columns]
    else:
        speeds = np.full(q.shape, np.nan)
    if not len(times) or times[0] > 0:
        times, q = np.append(0.0, times), np.vstack([start, q])
        speeds = np.vstack([np.zeros(len(start)), speeds])
    if np.isnan(speeds).any() and len(times) > 2 and (np.diff(times) > 0).all():
        speeds = np.gradient(q, times, axis=0)
    speeds[[0, -1]] = 0.0
    return Trajectory(times, q, np.nan_to_num(speeds))


def planning_request(
    group: str,
    joint_names: Sequence[str],
    start: FloatArray,
    goal: FloatArray,
    seconds: float,
    share: float,
) -> Any:
    """The request for a way from ``start`` to ``goal``, both (joints,) [rad | m], in a group of MoveIt.

    Args:
        group: Name of the planning group.
        joint_names: The robot's joints; all others stand where they are.
        start, goal: Where the way begins and ends.
        seconds: Longest time for the planning [s].
        share: Share of the robot's speeds and accelerations.
    """
    request = MotionPlanRequest(group_name=group, num_planning_attempts=1, allowed_planning_time=seconds)
    request.max_velocity_scaling_factor = request.max_acceleration_scaling_factor = share
    request.start_state.is_diff = True
    request.start_state.joint_state.name = list(joint_names)
    request.start_state.joint_state.position = start.tolist()
    near = {"tolerance_above": GOAL_RANGE, "tolerance_below": GOAL_RANGE, "weight": 1.0}
    joints = [
        JointConstraint(joint_name=name, position=float(q), **near)
        for name, q in zip(joint_names, goal, strict=True)
    ]
    request.goal_constraints = [Constraints(joint_constraints=joints)]
    return GetMotionPlan.Request(motion_plan_request=request)


def planned_way(response: Any, joint_names: Sequence[str], start: FloatArray) -> tuple[Trajectory | None, str]:
    """The way of an answer of MoveIt that begins at ``start`` (joints,) [rad | m], or ``None`` and why not."""
    answer = response.motion_plan_response
    code = answer.error_code
    if code.val != SUCCESS:
        said = getattr(code, "message", "")
        return None, f"MoveIt says {error_name(code)} ({code.val}){': ' * bool(said)}{said}"
    try:
        return way_from_message(answer.trajectory.joint_trajectory, joint_names, start), ""
    except CalibPlannerError as error:
        return None, f"MoveIt's answer is not usable: {error}"


def error_name(code: Any) -> str:
    """The name of the constant of a ``MoveItErrorCodes``."""
    names = (n for n in dir(type(code)) if n.isupper() and getattr(type(code), n) == code.val)
    return next(names, "an unknown error")


FAILURES = {
    -1: "INVALID_GOAL",
    -2: "INVALID_JOINTS",
    -3: "OLD_HEADER_TIMESTAMP",
    -4: "PATH_TOLERANCE_VIOLATED",
    -5: "GOAL_TOLERANCE_VIOLATED",
}
"""Error codes of ``FollowJointTrajectory``."""


def failure_of(status: str, result: Any) -> str:
    """Why a goal of a controller did not succeed: how it ended, error code and text; empty if it did succeed."""
    code = int(result.error_code)
    if status == "succeeded" and code == 0:
        return ""
    name = f"{FAILURES.get(code, 'error')} ({code})" if code else ""
    return ", ".join(filter(None, (f"it was {status}", name, str(result.error_string))))
