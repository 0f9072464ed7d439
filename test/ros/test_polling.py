# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Streams fetched by a timer: nothing is missed, the stamps decide the order, one bad message harms no other."""

from __future__ import annotations

import functools
import time
from typing import Any

from bench import Bench, overrides
from geometry_msgs.msg import PointStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy

from calib_planner.acquisition import NANO
from calib_planner.ros.lifecycle import LifecycleParameters, ManagedNode
from calib_planner.ros.messages import nanoseconds, point_message
from calib_planner.ros.parameters import STREAM_IN
from calib_planner.ros.rclpy_ext.polling import EVENTS_EVERY, MOST_AT_ONCE, Stream, StreamPoller, times_set_back

DEEP = QoSProfile(depth=4000, reliability=ReliabilityPolicy.RELIABLE)
RELIABLE = {f"qos_overrides./{topic}.subscription.reliability": "reliable" for topic in ("a", "b")}


class Listener(ManagedNode[LifecycleParameters]):
    """Notes what it hears; a point with x < 0 makes it fail."""

    def __init__(self, **options: Any) -> None:
        self.heard: list[tuple[str, int]] = []
        super().__init__("listener", LifecycleParameters(), **options)

    def configure(self) -> None:
        streams = [Stream(PointStamped, t, functools.partial(self._note, t), lambda _: None) for t in ("a", "b")]
        self.poller = StreamPoller(self, streams, STREAM_IN)

    def _note(self, topic: str, message: PointStamped) -> None:
        if message.point.x < 0:
            raise ValueError("made for this test")
        self.heard.append((topic, nanoseconds(message.header.stamp)))


def publishers(bench: Bench) -> list[Any]:
    made = [bench.client.create_publisher(PointStamped, topic, DEEP) for topic in ("a", "b")]
    bench.wait(lambda: all(p.get_subscription_count() for p in made))
    return made


def test_nothing_is_missed_and_each_comes_once(bench: Bench) -> None:
    node = bench.start(Listener, **RELIABLE)
    a, b = publishers(bench)
    for k in range(1500):
        a.publish(point_message([1.0, 0, 0], (k + 1) * NANO, ""))
        b.publish(point_message([1.0, 0, 0], (k + 1) * NANO + 1, ""))
        if k % 10 == 0:
            time.sleep(0.001)
    bench.wait(lambda: len(node.heard) >= 3000)
    for topic in ("a", "b"):
        stamps = [s for t, s in node.heard if t == topic]
        assert stamps == sorted(stamps) and len(set(stamps)) == 1500


def test_what_queued_up_is_handed_out_by_the_stamps(bench: Bench) -> None:
    """The node is not spun while the streams run apart: one far ahead of the other, and backwards."""
    node = Listener(context=bench.context, overrides=overrides({"autostart": False, **RELIABLE}))
    bench.nodes.append(node)
    node.trigger_configure()
    a, b = publishers(bench)
    for k in reversed(range(50)):
        b.publish(point_message([1.0, 0, 0], (3 * k + 1) * NANO, ""))
    for k in range(50):
        a.publish(point_message([-1.0 if k == 7 else 1.0, 0, 0], (3 * k + 2) * NANO, ""))
    fetched: list[Any] = []
    bench.wait(lambda: fetched.extend(node.poller.fetch()) or len(fetched) >= 100)
    node.poller.hand_out(fetched)
    wanted = [("b" if i == 1 else "a", (3 * k + i) * NANO) for k in range(50) for i in (1, 2) if (k, i) != (7, 2)]
    assert node.heard == wanted


def test_what_came_before_a_clock_was_set_back_comes_first() -> None:
    day = [NANO * k for k in range(3600, 3700)]
    before = [s - 3600 * NANO for s in day]
    assert times_set_back(day) == [0] * 100
    assert times_set_back([*day, *before, *before]) == [0] * 100 + [1] * 100 + [2] * 100
    mixed = list(day)
    mixed[3:5] = mixed[4], mixed[3]
    late = [*mixed[:50], day[2], day[3], *mixed[50:]]
    assert times_set_back(late) == [0] * 102  # too few to be sure
    assert times_set_back(day[::-1]) == [0] * 100  # a clock does not run backwards
    assert times_set_back([*before[:10], day[0], *before[10:]]) == [0] * 11 + [1] * 90  # one stamp in the future


def test_events_have_their_turn(bench: Bench) -> None:
    node = bench.start(Listener)
    group, subscription = node.poller._group, node.poller._subscriptions[0]
    seen = set()
    for _ in range(2 * EVENTS_EVERY):
        node.poller.poll()
        assert not group.can_execute(subscription)
        seen.add(group.can_execute(subscription.event_handlers[0]))
    assert seen == {True, False} and MOST_AT_ONCE > 100
