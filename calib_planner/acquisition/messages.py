# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What is read out of the messages of drivers, the same for the topics of a node and for a recording.

A message is anything with the fields of its type: those of rclpy and those that rosbags decodes are alike.
Joints come as ``sensor_msgs/msg/JointState``, which names them every time, in its own order, among others, and
perhaps only some of them. Where a target is comes as a point, or as a pose or a transform, whose position is
taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.acquisition.clocks import NANO
from calib_planner.arrays import FloatArray, frozen
from calib_planner.errors import InputError, UnknownNameError

JointStateLike: TypeAlias = Any
PointLike: TypeAlias = Any

MOST_NAMES = 50
"""Names that an error lists."""
MOST_LAYOUTS = 100
"""Different lists of names that are remembered: a driver has a few."""
JOINT_STATE, STATE = "sensor_msgs/msg/JointState", "std_msgs/msg/Bool"
POINT, POSE = "geometry_msgs/msg/PointStamped", "geometry_msgs/msg/PoseStamped"
TRANSFORM, TRANSFORMS = "geometry_msgs/msg/TransformStamped", "tf2_msgs/msg/TFMessage"


def stamp_of(message: JointStateLike | PointLike) -> int:
    """The stamp in a message's header [ns]."""
    return int(message.header.stamp.sec) * NANO + int(message.header.stamp.nanosec)


# ── points ───────────────────────────────────────────────────────────────────────────────────────────


def _of_pose(message: Any) -> list[PointLike]:
    return [SimpleNamespace(header=message.header, point=message.pose.position)]


def _of_transform(message: Any) -> list[PointLike]:
    child, at = message.child_frame_id, message.transform.translation
    return [SimpleNamespace(header=message.header, child_frame_id=child, point=at)]


def _of_transforms(message: Any) -> list[PointLike]:
    return [point for transform in message.transforms for point in _of_transform(transform)]


POINTS: dict[str, Callable[[Any], list[PointLike]]] = {
    POINT: lambda message: [message],
    POSE: _of_pose,
    TRANSFORM: _of_transform,
    TRANSFORMS: _of_transforms,
}
"""Types of messages that hold points → what reads them."""


def points_in(kind: str, message: Any, child: str = "") -> list[PointLike]:
    """The points of a target in a message of a type in ``POINTS``.

    Args:
        kind: The type.
        message: The message.
        child: The target's ``child_frame_id``; of ``TRANSFORMS``, which anybody may publish, only these count.

    Returns:
        What has ``header`` and ``point``, and ``child_frame_id`` if it is the position of a transform.
    """
    points = POINTS[kind](message)
    return [p for p in points if p.child_frame_id == child] if kind == TRANSFORMS else points


# ── joints ───────────────────────────────────────────────────────────────────────────────────────────


def pick_joints(names: Sequence[str], positions: ArrayLike, joint_names: Sequence[str]) -> FloatArray:
    """Positions (joints,) [rad | m] in the order wanted; other joints are ignored, values may be NaN.

    Args:
        names: Joints of the message, in any order.
        positions: (names,) their positions [rad | m].
        joint_names: Joints wanted.

    Raises:
        UnknownNameError: A joint is missing.
        InputError: A name is there twice, or names and positions differ in number.
    """
    names, values = list(names), np.asarray(positions, dtype=float)
    if len(names) != len(values):
        raise InputError("position", f"{len(values)} positions for {len(names)} names", "one position per name")
    where = {name: i for i, name in enumerate(names)}
    for name in joint_names:
        if name not in where:
            raise UnknownNameError("name", name, list(dict.fromkeys(filter(None, names)))[:MOST_NAMES])
    if len(where) != len(names):
        doubled = sorted({n for n in joint_names if names.count(n) > 1})
        if doubled:
            raise InputError("name", f"{', '.join(doubled)} more than once", "each joint once")
    return frozen(values[[where[name] for name in joint_names]])


class JointReader:
    """Reads joint states that name the joints in any order, among others, all of them or some.

    Args:
        joint_names: Joints wanted, in the order wanted.
    """

    def __init__(self, joint_names: Sequence[str]) -> None:
        self._wanted = tuple(joint_names)
        self._layouts: dict[tuple[str, ...], tuple[tuple[int, ...] | None, list[int]]] = {}

    def read(self, message: JointStateLike) -> tuple[tuple[int, ...] | None, FloatArray]:
        """Which of the joints wanted there are, from 0, ascending (``None``: all), and their positions [rad | m].

        Values may be NaN.

        Raises:
            UnknownNameError: No joint wanted is there.
            InputError: A name is there twice, or names and positions differ in number.
        """
        names, positions = tuple(message.name), message.position
        if len(names) != len(positions):
            raise InputError(
                "position", f"{len(positions)} positions for {len(names)} names", "one position per name"
            )
        layout = self._layouts.get(names)
        if layout is None:
            layout = self._layout(names)
            if len(self._layouts) >= MOST_LAYOUTS:
                self._layouts.clear()
            self._layouts[names] = layout
        return layout[0], np.array([positions[k] for k in layout[1]])

    def _layout(self, names: tuple[str, ...]) -> tuple[tuple[int, ...] | None, list[int]]:
        """The joints that a list of names holds, and where."""
        there = set(names)
        columns = [k for k, name in enumerate(self._wanted) if name in there]
        mine = [self._wanted[k] for k in columns] or self._wanted[:1]
        pick_joints(names, np.zeros(len(names)), mine)
        where = {name: k for k, name in enumerate(names)}
        whole = len(columns) == len(self._wanted)
        return None if whole else tuple(columns), [where[name] for name in mine]
