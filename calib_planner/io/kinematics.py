# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A calibration as kinematics YAML in the convention of Universal Robots: xyz and rpy per joint, and a hash.

    format: calib_planner/kinematics
    robot: ur10
    joints: {shoulder: shoulder_pan_joint, …}   # which joint each entry below is
    axes: {shoulder: [0.0, 0.0, 1.0], …}        # in which direction it moves, in its own frame
    tip: {x: …, yaw: …}                         # only robots that are not from a URDF: after the last joint
    kinematics:                                 # what Universal Robots' description reads; it ignores the rest
      shoulder: {x: 0.0, y: 0.0, z: 0.1273, roll: 0.0, pitch: 0.0, yaw: 0.0}    # [m], [rad]
      …
      hash: calib_…

Each entry is the joint's ``<origin>``: roll, pitch, yaw as in URDF. A UR's joints (``shoulder_pan_joint`` …
``wrist_3_joint``, with any common prefix) are called as in ur_description's ``default_kinematics.yaml``:
shoulder, upper_arm, forearm, wrist_1, wrist_2, wrist_3. Other robots' joints keep their names.

The hash is ``calib_`` and the SHA-256, in hexadecimal, of the UTF-8 text with one line ``name numbers`` for
each entry of ``kinematics`` (x y z roll pitch yaw, then its axis) and for ``tip``; numbers in the shortest
decimal form that reads back exactly (Python's ``repr``), separated by one space, lines by one line feed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.errors import FileFormatError, InputError
from calib_planner.io.yaml import Node, read_yaml, write_document
from calib_planner.robot import JointOrigins, Origin, Robot, joint_origins, with_origins

FORMAT = "calib_planner/kinematics"
WHAT = "a kinematics YAML, as identify --kinematics-output writes it"
POSE_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
UR_KEYS = {
    "shoulder_pan_joint": "shoulder",
    "shoulder_lift_joint": "upper_arm",
    "elbow_joint": "forearm",
    "wrist_1_joint": "wrist_1",
    "wrist_2_joint": "wrist_2",
    "wrist_3_joint": "wrist_3",
}
"""Joint name → entry, as in ur_description."""


def write_kinematics(path: str | Path, robot: Robot, field: str = "--kinematics-output") -> None:
    """Write where the joints of a calibrated robot are, e.g. of ``Estimate.calibrated``.

    The pose of the base in the tracker's frame and the targets are not part of it.

    Raises:
        InputError: The path cannot be written (names ``field``), or a joint is called ``hash``.
    """
    write_document(path, "kinematics", kinematics(robot), field)


def kinematics(robot: Robot) -> dict[str, Any]:
    """What ``write_kinematics`` writes, without its format line."""
    origins = joint_origins(robot)
    keys = entry_names(tuple(origins.joints))
    poses = {keys[name]: _entry(origin) for name, origin in origins.joints.items()}
    axes = {keys[name]: axis.tolist() for name, axis in origins.axes.items()}
    tip = {} if origins.tip is None else {"tip": _entry(origins.tip)}
    joints = {key: name for name, key in keys.items()}
    numbers = {"kinematics": {**poses, "hash": _hash(poses, axes, tip)}}
    return {"robot": robot.name, "joints": joints, "axes": axes, **tip, **numbers}


def read_kinematics(path: str | Path, robot: Robot) -> Robot:
    """``robot`` with its joints where the file says.

    Args:
        path: What ``write_kinematics`` wrote.
        robot: The nominal robot; limits, base and targets are its own.

    Raises:
        FileFormatError: Not such a file, changed since it was written (the hash differs), or of a robot with
            other joints or axes.
    """
    document = read_yaml(path, WHAT)
    if document.get("format").value != FORMAT:
        advice = "its hash could not be checked; give a file that identify --kinematics-output wrote"
        raise document.get("format").refused(FORMAT, advice)
    origins = _read(document)
    here = joint_origins(robot)
    if tuple(origins.joints) != tuple(here.joints):
        raise document["joints"].error(", ".join(origins.joints), f"{', '.join(here.joints)}: the robot's")
    for name, axis in here.axes.items():
        if np.abs(axis - origins.axes[name]).max() > 1e-9:
            raise FileFormatError(path, f"axes of {name}", origins.axes[name], f"{axis}: the robot's")
    if (origins.tip is None) != (here.tip is None):
        raise document.get("tip").error("the other kind of robot", "a robot read from the same kind of file")
    return with_origins(robot, origins.joints, origins.tip)


def entry_names(joints: Sequence[str]) -> dict[str, str]:
    """Joint name → name of its entry: Universal Robots' names for their joints, else the joint's own.

    Raises:
        InputError: A joint is called ``hash``, which is taken.
    """
    if "hash" in joints:
        raise InputError("joint", "'hash'", "another name: hash is an entry of its own", "rename it in the URDF")
    prefix = joints[0].removesuffix("shoulder_pan_joint")
    if tuple(joints) == tuple(prefix + name for name in UR_KEYS):
        return {prefix + name: key for name, key in UR_KEYS.items()}
    return {name: name for name in joints}


def _read(document: Node) -> JointOrigins:
    required = ("format", "robot", "joints", "axes", "kinematics")
    document.mapping((*required, "tip"), required)
    joints = document["joints"].mapping().value
    if not all(isinstance(name, str) for pair in joints.items() for name in pair):
        raise document["joints"].refused("a mapping from entry to joint name")
    axes = document["axes"].mapping(joints, joints)
    entries = document["kinematics"].mapping((*joints, "hash"), (*joints, "hash"))
    poses = {key: _pose(entries[key]) for key in joints}
    axis_of = {key: axes[key].array((3,)) for key in joints}
    tip = {"tip": _pose(document["tip"])} if "tip" in document else {}
    expected = _hash(poses, {k: v.tolist() for k, v in axis_of.items()}, tip)
    if entries["hash"].value != expected:
        raise entries["hash"].refused(expected, "the numbers were changed since; write the file anew")
    return JointOrigins(
        joints={joints[key]: _as_origin(pose) for key, pose in poses.items()},
        axes={joints[key]: axis for key, axis in axis_of.items()},
        tip=_as_origin(tip["tip"]) if tip else None,
    )


def _entry(origin: Origin) -> dict[str, float]:
    return dict(zip(POSE_KEYS, [*origin.xyz.tolist(), *origin.rpy.tolist()], strict=True))


def _as_origin(pose: Mapping[str, float]) -> Origin:
    values = np.array([pose[k] for k in POSE_KEYS])
    return Origin(values[:3], values[3:])


def _pose(entry: Node) -> dict[str, float]:
    entry.mapping(POSE_KEYS, POSE_KEYS)
    return {key: float(entry[key].array(())) for key in POSE_KEYS}


def _hash(
    poses: Mapping[str, Mapping[str, float]],
    axes: Mapping[str, Sequence[float]],
    tip: Mapping[str, Mapping[str, float]],
) -> str:
    rows = {key: [*pose.values(), *axes[key]] for key, pose in poses.items()}
    rows |= {key: [*pose.values()] for key, pose in tip.items()}
    lines = [" ".join([key, *map(repr, numbers)]) for key, numbers in rows.items()]
    return "calib_" + hashlib.sha256("\n".join(lines).encode()).hexdigest()
