# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The identification problem that an estimate answers, as a part of its file.

An estimate is applied weeks later and on other computers. Its file therefore holds the measurements and the
robot's file themselves, not their paths: report, URDF, kinematics and corrected targets come from it alone,
whatever became of the data. That costs about eleven characters a number, as base64 of little-endian doubles:

    problem:
      robot: {source: irb120.urdf, links: [base, tool0], text: …}   # zlib and base64 of the robot's file
      targets: [[x, y, z], …]                                       # nominal, in the tip's frame [m]
      measurements: {visits: N, targets: T, configurations: …, points: …, std: …, payload: …}
      loss, required_accuracy, accuracy_frame, test_poses

Measurements are (N, joints) [rad | m] in the robot's order, (N, T, 3) [m] and (N,) [kg]; what is unknown is NaN.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray, plain
from calib_planner.error_model import ErrorModel
from calib_planner.errors import CalibPlannerError
from calib_planner.identification import IdentificationProblem
from calib_planner.io.robots import Robot, config_folder, parse_robot_yaml
from calib_planner.io.text import MAX_BYTES, read_text
from calib_planner.io.urdf import parse_urdf
from calib_planner.io.xacro import read_urdf_text, split_arguments
from calib_planner.io.yaml import Node
from calib_planner.measurements import Measurements
from calib_planner.tracker import LaserTracker

PARTS = ("configurations", "points", "std", "payload")
"""Arrays of the measurements, in the order of the file."""


def problem_mapping(problem: IdentificationProblem) -> dict[str, Any]:
    """What a file holds of a problem, as plain values."""
    data = problem.data
    arrays = {name: getattr(data, name) for name in PARTS}
    mapping: dict[str, Any] = plain(
        {
            "robot": _robot_mapping(problem.robot),
            "targets": problem.robot.target_offsets,
            "measurements": {
                "visits": len(data),
                "targets": data.p.shape[1],
                **{name: packed(np.asarray(a)) for name, a in arrays.items() if a is not None},
            },
            "loss": problem.loss,
            "required_accuracy": problem.required_accuracy,
            "accuracy_frame": problem.accuracy_frame,
            "test_poses": problem.test_pose_array,
        }
    )
    return mapping


def _robot_mapping(robot: Robot) -> dict[str, Any]:
    """The robot's file; without its text where it cannot be read any more."""
    mapping: dict[str, Any] = {"source": robot.source, "links": list(robot.links)}
    path, _ = split_arguments(robot.source)
    try:
        text = read_urdf_text(robot.source) if robot.from_urdf else read_text(path, "a robot")
    except CalibPlannerError:
        return mapping
    shipped = path.resolve().is_relative_to((config_folder() / "robots").resolve())
    named = {"source": path.name} if shipped else {}
    return {**mapping, **named, "text": base64.b64encode(zlib.compress(text.encode(), 9)).decode()}


def saved_robot(node: Node) -> Robot:
    """The nominal robot of a file, with its nominal targets.

    Raises:
        FileFormatError: The file does not hold it, or no robot can be made of what it holds.
    """
    robot = node["robot"].mapping(("source", "links", "text"), ("source", "links"))
    if "text" not in robot:
        advice = "give it with --robot"
        raise robot.error(
            "no text", "the robot's file, which could not be read when the estimate was made", advice
        )
    text, source = _unpacked_text(robot["text"]), robot["source"].text()
    links = robot["links"].of_kind("tuple[str, ...]")
    nominal = parse_urdf(text, source, *links) if links else parse_robot_yaml(text, Path(source))
    return nominal.with_targets(node["targets"].array((None, 3)))


def urdf_text(node: Node) -> str:
    """The text of the nominal URDF that a file holds.

    Raises:
        FileFormatError: It holds none.
    """
    robot = node["robot"]
    if "text" not in robot or not robot["links"].value:
        raise robot.refused("the text of a URDF", "give the URDF with --robot")
    return _unpacked_text(robot["text"])


def saved_problem(node: Node, robot: Robot, model: ErrorModel) -> IdentificationProblem:
    """The problem again.

    Args:
        node: What ``problem_mapping`` wrote.
        robot: The nominal robot, with the parameters of the estimate.
        model: How robot and measurement err by the estimate; it holds the instrument.

    Raises:
        FileFormatError: The part of the file is not what was written.
    """
    keys = ("robot", "targets", "measurements", "loss", "required_accuracy", "accuracy_frame", "test_poses")
    node.mapping(keys, keys)
    part = node["measurements"].mapping(("visits", "targets", *PARTS), ("visits", "targets", *PARTS[:2]))
    visits, targets = (int(part[key].of_kind("int")) for key in ("visits", "targets"))
    shapes = {
        "configurations": (visits, len(robot.joint_names)),
        "points": (visits, targets, 3),
        "std": (visits, targets, 3),
        "payload": (visits,),
    }
    arrays = {name: unpacked(part[name], shapes[name]) for name in PARTS if name in part}
    poses = node["test_poses"].value
    noise = model.points.noise
    return node.build(
        lambda: IdentificationProblem(
            robot,
            Measurements(robot.joint_names, **arrays),
            error_model=model,
            instrument=noise if isinstance(noise, LaserTracker) else None,
            loss=node["loss"].text(),
            test_poses=np.array(poses) if poses else None,
            required_accuracy=node["required_accuracy"].value,
            accuracy_frame=node["accuracy_frame"].text(),
        )
    )


# ── numbers as text ──────────────────────────────────────────────────────────────────────────────────


def packed(array: FloatArray) -> str:
    """Base64 of little-endian doubles, row by row."""
    return base64.b64encode(np.ascontiguousarray(array, "<f8").tobytes()).decode()


def unpacked(node: Node, shape: tuple[int, ...]) -> FloatArray:
    """The numbers of a text that ``packed`` made.

    Raises:
        FileFormatError: Not such a text, or of another shape.
    """
    try:
        numbers = np.frombuffer(base64.b64decode(node.text(), validate=True), "<f8")
    except (binascii.Error, ValueError):
        raise node.error("text", "base64 of doubles, as it was written") from None
    if numbers.size != np.prod(shape):
        raise node.error(f"{numbers.size} numbers", f"{' × '.join(map(str, shape))} of them")
    return numbers.reshape(shape)


def _unpacked_text(node: Node) -> str:
    unpack = zlib.decompressobj()
    try:
        data = unpack.decompress(base64.b64decode(node.text(), validate=True), MAX_BYTES)
        if unpack.unconsumed_tail or not unpack.eof:
            raise ValueError
        return data.decode()
    except (binascii.Error, ValueError, zlib.error):
        raise node.error("text", "base64 of a compressed text, as it was written") from None
