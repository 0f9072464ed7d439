# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the tracker and the reflectors are, for the tree of transforms: ``/tf_static``.

Each frame of a tree has one parent. ``robot_state_publisher`` gives every link of the robot its parent, and the
base may have one in the cell. What the identifier finds is therefore hung below the robot: base → tracker, tip →
target. The tracker's frame must not have another parent, and the frames of the targets must not be those that the
tracker's driver publishes. What others say on ``/tf_static`` is heard, and a frame with another parent there is
left out.

The transforms are those of the robot on ``~/robot_description``, of the fit of placement alone, which a URDF can
hold. As ``tf2_ros.StaticTransformBroadcaster`` does, all of the node's are in one message, latched. The package
``tf2_msgs`` is optional.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from calib_planner.acquisition import TRANSFORMS
from calib_planner.arrays import FloatArray
from calib_planner.errors import InputError
from calib_planner.identification import Estimate
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.messages import stamp_message
from calib_planner.ros.parameters import LATCHED
from calib_planner.ros.streams import type_named

TF_STATIC = "/tf_static"
OTHERS = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""What all publishers of static transforms have latched."""


@dataclass(frozen=True, eq=False)
class PlacedFrame:
    """Where a frame is in its parent's: ``rotation`` (3, 3) and ``xyz`` (3,) [m]."""

    parent: str
    child: str
    rotation: FloatArray
    xyz: FloatArray


def placed_frames(
    estimate: Estimate, base: str, tip: str, tracker: str, targets: Sequence[str]
) -> list[PlacedFrame]:
    """The tracker in the base, and every target in the tip, as far as they are known or identified.

    What the measurements do not determine is left out, and the tracker as well if its frame is the base.

    Args:
        estimate: Its ``calibrated`` robot is placed.
        base, tip, tracker: Names of the frames of the robot's base and tip, and of the points.
        targets: Names of the frames of the targets.
    """
    if estimate.fit.status == "not_converged":
        return []
    robot, doubtful = estimate.calibrated, {name.partition(".")[0] for name in estimate.observability.fixed}
    rotation, xyz = robot.base_pose
    frames = []
    if tracker != base and "base" not in doubtful:
        frames.append(PlacedFrame(base, tracker, rotation.T, -rotation.T @ xyz))
    for k, (name, offset) in enumerate(zip(targets, robot.target_offsets, strict=True), start=1):
        if f"target_{k}" not in doubtful:
            frames.append(PlacedFrame(tip, name, np.eye(3), offset))
    return frames


def transform_message(frame: PlacedFrame, stamp: int) -> TransformStamped:
    """A frame as message with this stamp [ns]."""
    from scipy.spatial.transform import Rotation  # 0.1 s, which only who has an estimate waits for

    message = TransformStamped(child_frame_id=frame.child)
    message.header.stamp, message.header.frame_id = stamp_message(stamp), frame.parent
    at, turn = message.transform.translation, message.transform.rotation
    at.x, at.y, at.z = map(float, frame.xyz)
    turn.x, turn.y, turn.z, turn.w = map(float, Rotation.from_matrix(frame.rotation).as_quat())
    return message


class StaticFrames:
    """In ``configure``: publishes frames on ``/tf_static``, if ``tf2_msgs`` is installed.

    Args:
        node: The node.
    """

    def __init__(self, node: ManagedNode[Any]) -> None:
        self._node = node
        self._others: dict[str, str] = {}  # frame → its parent, as others say
        self._own: set[tuple[str, str]] = set()  # (frame, parent) that were published here
        self._refused: set[str] = set()
        try:
            kind = type_named(TRANSFORMS)
        except InputError:
            node.get_logger().info("tf2_msgs is not installed: tracker and targets are not on /tf_static")
            self._publisher = None
            return
        self._message: Any = kind
        self._publisher = node.create_publisher(kind, TF_STATIC, LATCHED)
        node.create_subscription(kind, TF_STATIC, self._on_others, OTHERS)

    def _on_others(self, message: Any) -> None:
        for transform in message.transforms:
            pair = transform.child_frame_id, transform.header.frame_id
            if pair not in self._own:
                self._others[pair[0]] = pair[1]

    def publish(self, frames: Sequence[PlacedFrame], stamp: int) -> None:
        """Publish these frames in place of those before, without those that have another parent."""
        if self._publisher is None or not (frames or self._own):
            return
        free = [f for f in frames if self._others.get(f.child, f.parent) == f.parent]
        for frame in frames:
            if frame not in free and frame.child not in self._refused:
                self._refused.add(frame.child)
                text = f"{frame.child} is not published below {frame.parent}: {self._others[frame.child]} is its"
                advice = "name it otherwise (frame_id of the points, target_frames), or set publish_transforms"
                self._node.get_logger().error(f"{text} parent on /tf_static; {advice}")
        self._own |= {(f.child, f.parent) for f in free}
        self._publisher.publish(self._message(transforms=[transform_message(f, stamp) for f in free]))
