"""Which plans a robot can execute: the same for the simulated one and for the adapter of a real one."""

from __future__ import annotations

import numpy as np

from calib_planner.errors import InputError, UnknownNameError
from calib_planner.planning import Plan
from calib_planner.robot import Robot

MOST_STANDSTILLS = 100_000
"""Standstills of one plan; at a second each that is more than a day."""


def check_executable(plan: Plan, robot: Robot) -> None:
    """Refuse a plan that this robot cannot execute.

    Raises:
        InputError: Other robot or joints, a configuration outside the limits, or standstills without end.
    """
    if plan.robot != robot.name:
        raise UnknownNameError("plan.robot", plan.robot, [robot.name])
    if plan.joint_names != robot.joint_names:
        raise InputError("plan.joint_names", ", ".join(plan.joint_names), ", ".join(robot.joint_names))
    if plan.measurements > MOST_STANDSTILLS:
        expected = f"at most {MOST_STANDSTILLS}"
        raise InputError("plan.repetitions, their sum", plan.measurements, expected, "send it in parts")
    low, high = robot.joint_limits.T
    outside = (plan.configurations < low - 1e-6) | (plan.configurations > high + 1e-6)
    if outside.any():
        i, j = (int(k) for k in np.argwhere(outside)[0])
        expected = f"within the limits [{low[j]:.4f}, {high[j]:.4f}] of {robot.joint_names[j]}"
        raise InputError(f"plan.configurations, row {i}", f"{plan.configurations[i, j]:.4f}", expected)
