"""A robot with a saved estimate applied: what every use of a calibration begins with."""

from __future__ import annotations

import re

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.files.estimate_yaml import SavedEstimate
from calib_planner.robot.chain import Robot

TARGET = re.compile(r"target_([1-9]\d{0,2})\.([xyz])")
SAME = 1e-9
"""Nominal values may differ by this much between the estimate and the robot [m | rad]."""


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
    if set(saved.joint_names) != set(robot.joint_names):
        wanted = f"the robot's joints {', '.join(robot.joint_names)}"
        raise InputError("estimate", f"joints {', '.join(saved.joint_names)}", wanted, "give the robot it is of")
    chain: dict[str, float] = {}
    targets: dict[tuple[int, int], float] = {}
    nominal = {p.name: p.nominal for p in robot.with_parameters(robot.available_parameters).parameters}
    for name, start, deviation in zip(saved.parameters, saved.nominal, saved.deviations, strict=True):
        target = TARGET.fullmatch(name)
        if target:
            targets[int(target[1]) - 1, "xyz".index(target[2])] = float(start + deviation)
        elif not name.startswith("base."):
            _check_nominal(name, float(start), nominal)
            chain[name] = float(deviation)
    moved = robot.with_deviations(chain)
    return moved.with_targets(_places(robot, targets)) if targets else moved


def _check_nominal(name: str, start: float, nominal: dict[str, float]) -> None:
    if name not in nominal:
        raise UnknownNameError("estimate", name, list(nominal))
    if not abs(start - nominal[name]) <= SAME:
        got, wanted = f"nominal {start!r}", f"{nominal[name]!r}, the robot's"
        raise InputError(f"estimate: {name}", got, wanted, "give the robot that the estimate was made with")


def _places(robot: Robot, targets: dict[tuple[int, int], float]) -> FloatArray:
    """(targets, 3) the robot's targets [m], or as many as the estimate has, at the places found."""
    count = max(len(robot.targets), *(t + 1 for t, _ in targets))
    places = np.zeros((count, 3))
    places[: len(robot.targets)] = robot.target_offsets
    for at, value in targets.items():
        places[at] = value
    return places
