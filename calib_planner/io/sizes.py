# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Units told by the sizes of numbers alone, where nothing is written and nothing is stated; and those of options.

Sizes are trusted only where they leave one reading:

* Angles are degrees if they go beyond 4π, and a quarter of those that are not zero, of two joints or more, are
  beyond 2π, one turn read in radians, and beyond the joint's own limits. Of a plan in degrees nearly all are.
  In radians only a joint that turns several times goes there, and a robot has one of these.
* Points of a robot lie in a ball: their coordinates spread over no more than D = 2 (reach + tool). In
  centimetres, inches and feet that is less than 100 D. What spreads over more is in millimetres, of which there
  are 1000 in D.
* Sliding joints are in millimetres if their values go 100 times beyond the joint's limits.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.robot import Robot

TURN = 2.0 * np.pi
MOST_RADIANS = 2.0 * TURN
"""No joint angles are degrees unless one is beyond this; and alone it leads to a question [rad]."""
MOST_LIMIT = 10.0 * TURN
"""Limits further out say nothing about what the joint does [rad]."""
MANY = 0.25
TOOL = 0.5
"""A reflector may be this far from where the robot says [m]."""
CENTIMETRES = 100.0
MILLIMETRES = 1000.0


def angles_by_size(robot: Robot, q: FloatArray, joints: Any) -> tuple[str, list[str]]:
    """``deg`` or ``rad`` for angles of which nothing is said, and the reason or a question.

    Args:
        q: (rows, joints) as the file has them.
        joints: (joints,) which of them are meant.
    """
    limits = np.abs(robot.joint_limits).max(axis=1)
    most = np.maximum(np.where(limits > MOST_LIMIT, 0.0, limits), TURN)
    beyond = (np.abs(q) > most)[:, joints]
    moving = np.count_nonzero(q[:, joints])
    largest = np.abs(q[:, joints]).max(initial=0.0)
    several = min(2, int(np.count_nonzero(joints)))
    many = moving > 0 and beyond.sum() >= MANY * moving and np.count_nonzero(beyond.any(axis=0)) >= several
    if many and largest > MOST_RADIANS:
        return "deg", [f"angles go up to {largest:.4g}"]
    if (beyond & (np.abs(q[:, joints]) > MOST_RADIANS)).any():
        return "rad", [f"joint angles up to {largest:.4g} rad: are they degrees (--degrees)?"]
    return "rad", []


def sliding_by_size(robot: Robot, values: FloatArray, joint: int) -> str:
    """``mm`` or ``m`` for a sliding joint of which nothing is said."""
    most = np.abs(robot.joint_limits[joint]).max()
    return "mm" if np.isfinite(most) and np.abs(values).max(initial=0.0) > CENTIMETRES * most else "m"


def lengths_by_size(robot: Robot, points: FloatArray) -> tuple[str, list[str]]:
    """``mm`` or ``m`` for points of which nothing is said, and the reason.

    Args:
        points: (rows, targets, 3) as the file has them, NaN where not measured.
    """
    each = [of_target[~np.isnan(of_target[:, 0])] for of_target in points.transpose(1, 0, 2)]
    spread = max((float(np.ptp(p, axis=0).max()) for p in each if len(p)), default=0.0)
    widest = 2.0 * (reach(robot) + TOOL)
    if CENTIMETRES * widest < spread <= MILLIMETRES * widest:
        return "mm", [f"points spread over {spread:.4g}, which in metres they cannot: {widest:.3g} m at most"]
    return "m", []


def reach(robot: Robot) -> float:
    """A bound of the distance of any target from the robot's first joint, by the lengths of its links [m]."""
    total, moved = 0.0, False
    for e in robot.elements:
        moved = moved or e.joint is not None
        if not e.is_rotation:
            total += abs(e.value) if moved else 0.0
            if e.joint is not None:
                low, high = np.abs(robot.joint_limits[e.joint])
                total += min(float(max(low, high)), MILLIMETRES)
    tips = [sum(abs(e.value) for e in target) for target in robot.targets]
    return total + max(tips, default=0.0)


def angle_factors(robot: Robot, *, degrees: bool) -> FloatArray:
    """(joints,) what turns input into rad or m: π/180 for angles given in degrees, else 1."""
    return np.where(robot.joint_is_revolute & degrees, np.pi / 180.0, 1.0)
