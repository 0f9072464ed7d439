"""A plan as a trajectory for a controller: slow enough, also on the unknown way to its first stop."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Duration
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from calib_planner.acquisition import NANO
from calib_planner.arrays import FloatArray
from calib_planner.planning import Pace, Plan, timetable
from calib_planner.robot import Robot
from calib_planner.ros.conversions import stamp_message


def pace_of(robot: Robot, turning: float, sliding: float, limits: FloatArray, dwell: float) -> Pace:
    """Joint speeds: ``turning`` [rad/s] or ``sliding`` [m/s], and never above ``limits`` (joints,)."""
    wanted = np.where(robot.joint_is_revolute, turning, sliding)
    return Pace(np.minimum(wanted, limits), dwell, "of the node's parameters and the robot description")


def trajectory_message(plan: Plan, robot: Robot, pace: Pace, stamp: int, frame_id: str) -> JointTrajectory:
    """Arrival at and departure from every stop, at rest; only the arrival if nobody stands there.

    Args:
        plan: Its configurations [rad | m], in the order of visiting.
        robot: Its limits bound the way to the first stop, which begins nobody knows where.
        pace: Speeds and standstill.
        stamp: Of the header [ns].
        frame_id: Of the header.

    Raises:
        InputError: The tour is longer than a ROS duration can say.
    """
    times = timetable(plan, robot, pace)
    result = JointTrajectory(joint_names=list(plan.joint_names))
    result.header.stamp, result.header.frame_id = stamp_message(stamp), frame_id
    for q, arrive, leave in zip(plan.configurations.tolist(), times.arrive, times.leave, strict=True):
        result.points += [_point(q, t) for t in ((arrive, leave) if pace.dwell > 0 else (arrive,))]
    return result


def _point(positions: list[float], seconds: float) -> JointTrajectoryPoint:
    after = round(float(seconds) * NANO)
    point = JointTrajectoryPoint(positions=positions, velocities=[0.0] * len(positions))
    point.time_from_start = Duration(sec=after // NANO, nanosec=after % NANO)
    return point
