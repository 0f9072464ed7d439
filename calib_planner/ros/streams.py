# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The streams of the drivers that the identifier listens to: joints, points, and what the tracker says of itself.

Points come in the type that the driver publishes: it is looked up among the publishers of the topic, unless the
parameter ``tracker_type`` states it. Until somebody publishes, points are expected, and when all publishers of a
type have gone the next ones may have another. A topic is subscribed to with one type at a time: with two, the
command ``ros2 topic echo`` would refuse it.

A tracker's state has no stamp. What counts is which points came before: all that wait are handed out before a
state is. A state that its publisher latches is told only to those who ask for that, and who asks for that does
not hear publishers that do not latch. So there are two subscriptions, and what both hear is said twice.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from calib_planner.acquisition import POINT, POINTS, TRANSFORMS, points_in, stamp_of
from calib_planner.errors import InputError
from calib_planner.io import BagTopics
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.parameters import LATCHED, STREAM_IN, overridable
from calib_planner.ros.rclpy_ext.polling import Stream, StreamPoller
from calib_planner.units import listed

LOOK_PERIOD = 0.2
"""Time between two looks at the publishers of points [s]: that much of their beginning may be missed."""
STATE_IN = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
"""States of a tracker that are not latched, reliable or not."""
NO_EVENTS = SubscriptionEventCallbacks(incompatible_qos=lambda _: None)
"""Of a subscription that is meant for some publishers only: others are heard by another one."""


@dataclass(frozen=True)
class Listener:
    """Who takes what is heard; targets, topics and streams are counted from 0.

    Attributes:
        joints: Takes the number of a topic of joints, and a joint state.
        point: Takes the number of a target, and a point as ``points_in`` reads it.
        state: Takes the number of a target, and whether the tracker sees it.
        lost: Takes the number of a stream, joints first, and of messages that were not delivered.
    """

    joints: Callable[[int, JointState], None]
    point: Callable[[int, Any], None]
    state: Callable[[int, bool], None]
    lost: Callable[[int, int], None]


class DriverStreams:
    """In ``configure``: listens until the node is cleaned up.

    Args:
        node: The node.
        topics: What to listen to.
        kind: Type of the points, a key of ``POINTS``; empty: that of their publishers.
        listener: Who takes what is heard.

    Attributes:
        kinds: The type in which each target is listened to.
        trouble: Why a target cannot be heard; empty if it can.

    Raises:
        InputError: The type that is stated cannot be used.
    """

    def __init__(self, node: ManagedNode[Any], topics: BagTopics, kind: str, listener: Listener) -> None:
        self._node, self._topics, self._listener = node, topics, listener
        count = len(topics.points)
        self.kinds, self.trouble = [kind or POINT] * count, [""] * count
        streams = [
            Stream(JointState, topic, partial(listener.joints, k), partial(listener.lost, k))
            for k, topic in enumerate(topics.joints)
        ]
        points = [self._stream(k, kind) for k, kind in enumerate(self.kinds)]
        self.poller = StreamPoller(node, streams + points, STREAM_IN)
        for k, topic in enumerate(topics.states):
            told = partial(self._on_state, k)
            node.create_subscription(Bool, topic, told, STATE_IN)
            options = {"qos_overriding_options": overridable("latched"), "event_callbacks": NO_EVENTS}
            node.create_subscription(Bool, topic, told, LATCHED, **options)
        self._stated = kind
        node.create_steady_timer(LOOK_PERIOD, self.look)

    def _stream(self, target: int, kind: str) -> Stream:
        child = self._topics.children[target] if self._topics.children else ""
        number = len(self._topics.joints) + target

        def take(message: Any) -> None:
            for point in points_in(kind, message, child):
                self._listener.point(target, point)

        message_type, lost = type_named(kind), partial(self._listener.lost, number)
        if kind != TRANSFORMS:
            return Stream(message_type, self._topics.points[target], take, lost)
        if not child:
            expected = "the child_frame_id of each target in tracker_child_frames"
            raise InputError(self._topics.points[target], "transforms of many frames", expected)
        return Stream(message_type, self._topics.points[target], take, lost, _stamp_of_transforms)

    def _on_state(self, target: int, message: Bool) -> None:
        self.poller.poll()
        self._listener.state(target, message.data)

    def look(self) -> None:
        """Follow the types that are published."""
        for target, before in enumerate(self.trouble):
            self.trouble[target] = ""
            try:
                self._follow(target)
            except InputError as error:
                self.trouble[target] = str(error)
                if self.trouble[target] != before:
                    self._node.get_logger().error(self.trouble[target])

    def _follow(self, target: int) -> None:
        """Listen to a target in the type that is published.

        Raises:
            InputError: That type is not the one stated, or cannot be used.
        """
        topic, number = self._topics.points[target], len(self._topics.joints) + target
        publishers = self._node.get_publishers_info_by_topic(self.poller.topic(number))
        types = sorted({p.topic_type for p in publishers})
        if not types or self.kinds[target] in types:
            return
        if self._stated:
            raise InputError("tracker_type", self._stated, f"the type of {topic}, {listed(types)}")
        usable = [kind for kind in POINTS if kind in types]
        if not usable:
            raise InputError(topic, f"messages of {listed(types)}", listed(POINTS))
        with self._node.as_configured():
            self.poller.change(number, self._stream(target, usable[0]))
        self.kinds[target] = usable[0]
        self._node.get_logger().info(f"{topic} is heard as {usable[0]}")


def type_named(kind: str) -> type:
    """The class of messages of a type named as in ``POINTS``.

    Raises:
        InputError: Its package is not installed.
    """
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError:
        advice = f"install it (ros-jazzy-{package.replace('_', '-')})"
        raise InputError(
            "tracker_type", kind, f"a type of an installed package: {package} is missing", advice
        ) from None


def _stamp_of_transforms(message: Any) -> int:
    return min((stamp_of(transform) for transform in message.transforms), default=0)
