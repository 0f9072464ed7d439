# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Good messages, and what the nodes make of them, for the fuzz targets; needs ROS 2."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from calib_planner_msgs.msg import PlanRequest
from geometry_msgs.msg import PointStamped
from robots import plan_of, random_configurations
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from calib_planner import IdentificationProblem, Robot, identify
from calib_planner.acquisition import pick_joints, points_in, stamp_of
from calib_planner.ros import messages, planning, ways
from calib_planner.ros.model import Model
from calib_planner.ros.settings import PlannerParameters
from calib_planner.simulation import SimulatedCell

ROBOT = Robot.load("planar_2r")
Q = random_configurations(ROBOT, 12, 3)
ESTIMATE = identify(IdentificationProblem(ROBOT, SimulatedCell(ROBOT, {"l1": 1e-3}, 1e-5).measure(Q, 1, 4)))
PLAN = plan_of(ROBOT, Q[:3], 2)


MODEL = Model(ROBOT, np.full(2, np.inf))
SETTINGS = PlannerParameters()


def request() -> PlanRequest:
    """A request with every field filled."""
    return PlanRequest(
        test_poses=messages.rows_message(Q[:2]),
        weights=[1.0, 2.0],
        candidates=messages.rows_message(Q),
        configurations=3,
        repetitions=2,
        sigma=3e-5,
        criterion="test_pose",
        time_limit=messages.duration_message(1.0),
        time_budget=messages.duration_message(100.0),
    )


def trajectory() -> JointTrajectory:
    """A way with velocities."""
    points = [
        JointTrajectoryPoint(
            positions=q.tolist(), velocities=[0.1, 0.2], time_from_start=messages.duration_message(k)
        )
        for k, q in enumerate(Q[:3])
    ]
    return JointTrajectory(joint_names=list(ROBOT.joint_names), points=points)


def joints_of(message: JointState) -> Any:
    """What a stream of joint states does with a message."""
    return stamp_of(message), pick_joints(message.name, message.position, ROBOT.joint_names)


def points_of(message: PointStamped) -> Any:
    """What a stream of points does."""
    return [(stamp_of(p), p.point) for p in points_in("geometry_msgs/msg/PointStamped", message)]


CONVERSIONS: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {
    "plan_message": (lambda: messages.plan_to_message(PLAN, "abc", 5, "base"), messages.plan_from_message),
    "estimate_message": (lambda: messages.estimate_to_message(ESTIMATE, "base"), messages.estimate_from_message),
    "plan_request": (request, lambda m: planning.problem_of(m, SETTINGS, MODEL)),
    "joint_trajectory": (trajectory, lambda m: ways.way_from_message(m, ROBOT.joint_names, Q[0])),
    "joint_state": (lambda: messages.joints_message(ROBOT.joint_names, Q[0], 5), joints_of),
    "point_stamped": (lambda: messages.point_message(Q[0, [0, 0, 1]], 5, "tracker"), points_of),
}
"""Kind → a good message, new each time, and what the nodes call with one that was heard."""
