# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Streams of thousands of messages per second: fetched a hundred times per second, in the order of their stamps.

*What rclpy does.* Its executor is woken by every message, builds a new wait set, makes a task and takes one
message of every stream: several times the processor time of the message itself. After the process stood still for
a moment it hands out what has queued up in turns, one message a stream: streams of different rates then run
apart, and the slower one seems to come late.

*What is done here.* The subscriptions are in a callback group that never lets them run, so that the executor does
not wait for them; a timer fetches everything that has come since and sorts it by the stamps. The events of the
subscriptions (messages lost, qualities of service that do not match) are in that group, too, since every message
would wake those as well; they may run now and then.

Where a clock was set back meanwhile, or a recording began again, what came before is handed out first: by the
stamps alone the end of what was before would come after what is now.

*Upstream.* ros2/rclpy#1223 and #1452 (cost per message). This file may go when an executor of rclpy hands out
what has queued up in the order of arrival, at a cost per message that is small against the callback's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from calib_planner.acquisition import NANO, stamp_of

PERIOD = 0.01
"""Usual time between two looks at the streams [s]."""
EVENTS_EVERY = 100
"""The events may run after every so many looks."""
MOST_AT_ONCE = 1000
"""Messages of one stream that are fetched at a time; the others wait in its queue for the next look."""

SET_BACK = NANO
"""Stamps this far behind earlier ones of their stream [ns], and rising, are of a clock that was set back."""
SURE = 5
"""So many of them in a row are."""

Waiting = tuple[tuple[int, int], Any, Callable[[Any], None]]
"""How often the clock was set back, and the stamp of a message [ns]; the message; the callback that takes it."""


@dataclass(frozen=True)
class Stream:
    """A topic to listen to.

    Attributes:
        kind: Type of its messages.
        topic: Name of the topic.
        callback: Takes a message.
        lost: Takes the number of messages that were not delivered.
        stamp: Gives the stamp of a message [ns]; by default that in its header.
    """

    kind: type
    topic: str
    callback: Callable[[Any], None]
    lost: Callable[[int], None]
    stamp: Callable[[Any], int] = stamp_of


class StreamPoller:
    """Subscribes to streams and hands out their messages.

    Args:
        node: Makes the subscriptions and the timer.
        streams: The topics to listen to.
        qos: Quality of service of the subscriptions.
        period: Time between two looks [s].
    """

    def __init__(self, node: Node, streams: Sequence[Stream], qos: QoSProfile, period: float = PERIOD) -> None:
        self._node, self._qos, self._looks, self._group = node, qos, 0, _Unwoken()
        self._streams = list(streams)
        self._subscriptions = [self._subscribe(stream) for stream in streams]
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # simulated time may stand still
        node.create_timer(period, self.poll, clock=steady)

    def _subscribe(self, stream: Stream) -> Subscription:
        events = SubscriptionEventCallbacks(message_lost=lambda event: stream.lost(event.total_count_change))
        options = {"callback_group": self._group, "event_callbacks": events}
        return self._node.create_subscription(stream.kind, stream.topic, stream.callback, self._qos, **options)

    def topic(self, number: int) -> str:
        """Full name of the topic of a stream, from 0, as remapped."""
        return str(self._subscriptions[number].topic_name)

    def change(self, number: int, stream: Stream) -> None:
        """Listen to another type of messages in place of stream ``number``, from 0."""
        self._node.destroy_subscription(self._subscriptions[number])
        self._streams[number] = stream
        self._subscriptions[number] = self._subscribe(stream)

    def poll(self) -> None:
        """Hand out all that has come, in the order of the stamps."""
        self._looks += 1
        self._group.events = self._looks % EVENTS_EVERY == 0
        self.hand_out(self.fetch())

    def fetch(self) -> list[Waiting]:
        """What has come, stream by stream."""
        waiting: list[Waiting] = []
        for stream, made in zip(self._streams, self._subscriptions, strict=True):
            messages = _fetched(made)
            stamps = [stream.stamp(m) for m in messages]
            order = zip(times_set_back(stamps), stamps, strict=True)
            waiting += [(place, m, made.callback) for place, m in zip(order, messages, strict=True)]
        return waiting

    @staticmethod
    def hand_out(waiting: list[Waiting]) -> None:
        """Call back in the order of the stamps."""
        for _, message, callback in sorted(waiting, key=lambda w: w[0]):
            callback(message)


def times_set_back(stamps: Sequence[int]) -> list[int]:
    """For each stamp [ns] of a stream, in the order of arrival: how often its clock had been set back before."""
    times, newest, result = 0, 0, list[int]()
    for k, stamp in enumerate(stamps):
        if stamp < newest - SET_BACK:
            following = stamps[k : k + SURE]
            rising = all(a < b for a, b in pairwise((*following, newest - SET_BACK)))
            if rising and len(following) == SURE:
                times, newest = times + 1, stamp
        newest = max(newest, stamp)
        result.append(times)
    return result


class _Unwoken(CallbackGroup):
    """Subscriptions never run; their events run only while ``events`` is set."""

    def __init__(self) -> None:
        super().__init__()
        self.events = False

    def can_execute(self, entity: object) -> bool:
        return self.events and not isinstance(entity, Subscription)

    def beginning_execution(self, entity: object) -> bool:
        return self.can_execute(entity)

    def ending_execution(self, entity: object) -> None:
        return


def take_answers(client: Client) -> None:
    """Hand out the answers that have come to a client, where no executor does."""
    try:
        with client.handle:
            while True:
                header, response = client.handle.take_response(client.srv_type.Response)
                if header is None:
                    return
                with suppress(KeyError):  # nobody waits for it any more
                    client.get_pending_request(header.request_id.sequence_number).set_result(response)
    except InvalidHandle:  # the client was destroyed
        return


def _fetched(subscription: Subscription) -> list[Any]:
    """What is in the queue of a subscription, at most ``MOST_AT_ONCE``."""
    messages: list[Any] = []
    try:
        with subscription.handle:
            while len(messages) < MOST_AT_ONCE:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if taken is None:
                    break
                messages.append(taken[0])
    except InvalidHandle:  # another thread destroyed the subscription while the timer was due
        return []
    return messages
