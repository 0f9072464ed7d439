"""A robot with a saved estimate applied: what every use of a calibration begins with."""

from __future__ import annotations

import re

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.files.saved_estimate import SavedEstimate
from calib_planner.robot.chain import Robot

TARGET = re.compile(r"target_([1-9]\d{0,2})\.([xyz])")


def calibrated_robot(robot: Robot, saved: SavedEstimate) -> Robot:
    """The robot with the parameters and targets of a saved estimate as its nominal ones.

    The pose of the base is left out: it says where the robot stood before the tracker.

    Args:
        robot: The nominal robot that the estimate was made with.
        saved: The estimate; ``read_estimate``.

    Raises:
        InputError: The estimate is of another robot, or of another version of it.
        UnknownNameError: The robot has no parameter of that name.
    """
    targets: dict[tuple[int, int], float] = {}
    for name, value in zip(saved.parameters, saved.values.tolist(), strict=True):
        target = TARGET.fullmatch(name)
        if target:
            targets[int(target[1]) - 1, "xyz".index(target[2])] = value
    moved = saved.corrected(robot)
    return moved.with_targets(_places(robot, targets)) if targets else moved


def _places(robot: Robot, targets: dict[tuple[int, int], float]) -> FloatArray:
    """(targets, 3) the robot's targets [m], or as many as the estimate has, at the places found."""
    count = max(len(robot.targets), *(t + 1 for t, _ in targets))
    places = np.zeros((count, 3))
    places[: len(robot.targets)] = robot.target_offsets
    for at, value in targets.items():
        places[at] = value
    return places
