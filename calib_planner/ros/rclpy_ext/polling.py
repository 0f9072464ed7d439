"""Streams of thousands of messages per second: fetched a hundred times per second, in the order of their stamps.

An executor of rclpy that is woken for every message spends several times what the message itself costs, and after
the process stood still for a moment it hands out what has queued up stream by stream: two streams of different
rates then run apart, and the slower one seems to be late. Here the subscriptions are left out of the executor's
waiting (their callback group never lets them run), and a timer fetches all that has come since and sorts it.
Their events (messages lost, qualities that do not match) wait with them, since every message would wake those,
too; they get their turn now and then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.subscription import Subscription

from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.qos import STREAM_IN

PERIOD = 0.01
"""Time between two looks [s]."""
EVENTS_EVERY = 100
"""Looks between two at which events have their turn."""
MOST_AT_ONCE = 1000
"""Messages of one stream that are fetched at a time; the others wait in its queue for the next look."""


Waiting = tuple[Any, Callable[[Any], None]]
"""A message and what takes it."""


@dataclass(frozen=True)
class Stream:
    """A stream to be heard.

    Attributes:
        kind: Of its messages, which have a header.
        topic: Its name.
        callback: Takes a message.
        lost: Takes the number of messages that were not delivered.
    """

    kind: type
    topic: str
    callback: Callable[[Any], None]
    lost: Callable[[int], None]


class StreamPoller:
    """Subscribes to streams and hands out their messages; made in ``configure`` or ``activate``.

    Args:
        node: Whose subscriptions and timer they are.
        streams: What to hear; QoS overrides apply.
    """

    def __init__(self, node: ManagedNode[Any], streams: Sequence[Stream]) -> None:
        self._looks, self._group = 0, _Unwoken()
        self._subscriptions = [self._subscribe(node, stream, self._group) for stream in streams]
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # simulated time may stand still
        node.create_timer(PERIOD, self.poll, clock=steady)

    def poll(self) -> None:
        """Hand out all that has come, in the order of the stamps."""
        self._looks += 1
        self._group.events = self._looks % EVENTS_EVERY == 0
        self.hand_out(self.fetch())

    def fetch(self) -> list[Waiting]:
        """What has come, stream by stream."""
        return [(m, s.callback) for s in self._subscriptions for m in _fetched(s)]

    @staticmethod
    def hand_out(waiting: list[Waiting]) -> None:
        """Call back in the order of the stamps; an exception is logged by the node's wrapper of the callback."""
        for message, callback in sorted(waiting, key=_stamp):
            callback(message)

    @staticmethod
    def _subscribe(node: ManagedNode[Any], stream: Stream, group: CallbackGroup) -> Subscription:
        def lost(event: Any) -> None:
            stream.lost(event.total_count_change)

        events = SubscriptionEventCallbacks(message_lost=lost)
        return node.create_subscription(
            stream.kind, stream.topic, stream.callback, STREAM_IN, callback_group=group, event_callbacks=events
        )


class _Unwoken(CallbackGroup):
    """Subscriptions never run, what else there is (their events) only while ``events`` is set."""

    def __init__(self) -> None:
        super().__init__()
        self.events = False

    def can_execute(self, entity: object) -> bool:
        return self.events and not isinstance(entity, Subscription)

    def beginning_execution(self, entity: object) -> bool:
        return self.can_execute(entity)

    def ending_execution(self, entity: object) -> None:
        return


def _stamp(waiting: Waiting) -> tuple[int, int]:
    stamp = waiting[0].header.stamp
    return stamp.sec, stamp.nanosec


def _fetched(subscription: Subscription) -> list[Any]:
    """What is in the queue of a subscription, at most ``MOST_AT_ONCE``."""
    messages: list[Any] = []
    try:
        with subscription.handle:
            while len(messages) < MOST_AT_ONCE:
                found = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if found is None:
                    break
                messages.append(found[0])
    except InvalidHandle:  # it was destroyed while the timer was due
        return []
    return messages
