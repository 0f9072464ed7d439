# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The messages of robot and tracker in virtual time: what is sent when, what arrives when, and in which order.

Every stream takes its samples at its own rate. A sample becomes a message with a stamp of its sender's clock, and
the message arrives, once or twice or not at all, at a time of the receiver's. All times are integer nanoseconds
of the robot's clock unless they are stamps. The same seed gives the same messages, however often one asks.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray, IntArray, check_number
from calib_planner.simulation.cell import Purpose, draws
from calib_planner.simulation.motion import NANO, Itinerary, Stand, Tour
from calib_planner.simulation.world import Sight, World

LONGEST_STEP = 1.0
"""Time that is made up for when nobody read for longer; beyond that the streams begin anew [s]."""
ANOTHER_DAY = 3600.0
"""A jump of the clock beyond which the simulation starts again [s]; so does one back."""
PHASE = 0.37
"""Trackers do not sample when joints do: part of their period by which they are late."""


@dataclass(frozen=True, eq=False)
class Message:
    """One message.

    Attributes:
        delivered: When it arrives [ns].
        stream: 0: joint positions; from 1: the point of that target.
        stamp: What its sender's clock said when the sample was taken [ns].
        values: (joints,) [rad | m], or (3,) [m] in the tracker's frame.
    """

    delivered: int
    stream: int
    stamp: int
    values: FloatArray


@dataclass(frozen=True)
class Rates:
    """Samples per second of the joints and of every target [Hz]."""

    joints: float = 100.0
    tracker: float = 50.0

    def __post_init__(self) -> None:
        for name in ("joints", "tracker"):
            check_number(name, getattr(self, name), low=0.0, low_open=True, high=10_000.0, unit="Hz")


class Streams:
    """Read again and again for what has arrived.

    Args:
        world: Robot, tracker and faults.
        where: Tells where the robot is at stamps (n,) [ns]; only ever of the past.
        rates: Of the samples.
        start: When the simulation begins [ns].
    """

    def __init__(
        self, world: World, where: Callable[[IntArray], Stand], rates: Rates | None = None, start: int = 0
    ) -> None:
        self.world, self._where, self._start = world, where, start
        self._sight = Sight(world)
        rates = rates or Rates()
        targets = range(len(world.robot.targets))
        self._samplers = [_Sampler(rates.joints, 0.0), *(_Sampler(rates.tracker, PHASE) for _ in targets)]
        self._posts = [_Post(world, k) for k in range(len(self._samplers))]
        self._now, self._count = start, 0
        self._waiting: list[tuple[int, int, int, Message]] = []
        self._begin(start)

    def advance(self, until: int) -> list[Message]:
        """What arrives after the last time read, up to ``until`` [ns], in the order of arrival.

        After a pause beyond ``LONGEST_STEP``, or a jump of the clock, the streams begin anew at ``until``.
        """
        jump = (until - self._now) / NANO
        if jump > LONGEST_STEP or jump < 0:
            self._start = self._start if 0 < jump < ANOTHER_DAY else until
            self._begin(until)
        self._now = until
        for k in range(len(self._samplers)):
            for message in self._sampled(k, until):
                # Ties go by stream, then as sent: the same whether asked for at once or step by step.
                heapq.heappush(self._waiting, (message.delivered, k, self._count, message))
                self._count += 1
        arrived = []
        while self._waiting and self._waiting[0][0] <= until:
            arrived.append(heapq.heappop(self._waiting)[3])
        return arrived

    def drain(self) -> list[Message]:
        """What is still under way, in the order of arrival; nothing is sampled."""
        return [heapq.heappop(self._waiting)[3] for _ in range(len(self._waiting))]

    def locked(self, now: int) -> tuple[bool, bool]:
        """Whether the tracker holds its targets at ``now`` [ns], and whether they are lost for long, if not."""
        stand, seconds = self._where(np.array([now])), (now - self._start) / NANO
        return self._sight.locked(stand, seconds), self._sight.lost(stand, seconds)

    def restore_beam(self, now: int) -> bool:
        """Bring a lost beam back at ``now`` [ns]; whether it was lost."""
        return self._sight.restore((now - self._start) / NANO)

    def _begin(self, now: int) -> None:
        self._now = now
        self._waiting.clear()
        for sampler, post in zip(self._samplers, self._posts, strict=True):
            sampler.begin(now)
            post.latest = now

    def _sampled(self, k: int, until: int) -> list[Message]:
        times = self._samplers[k].take(until)
        if not len(times):
            return []
        stand, seconds = self._where(times), (times - self._start) / NANO
        reported = self.world.reported(stand.joints)
        return self._posts[k].send(times, seconds, self._sight.look(k - 1, stand, seconds) if k else reported)


def play(
    world: World, tour: Tour, rates: Rates | None = None, start: int = 0, rest: float = 0.5
) -> Iterator[Message]:
    """A whole tour from ``start`` [ns], as fast as it can be computed; sampling ends ``rest`` [s] after it."""
    itinerary = Itinerary(tour.phases[0].start)
    itinerary.begin(tour, start)
    streams = Streams(world, itinerary.at, rates, start)
    end = start + round((tour.seconds + rest) * NANO)
    for now in range(start + NANO // 2, end, NANO // 2):
        yield from streams.advance(now)
    yield from streams.advance(end)
    yield from streams.drain()


class _Sampler:
    """Sample times of one stream."""

    def __init__(self, rate: float, phase: float) -> None:
        self._rate, self._phase = rate, phase

    def begin(self, start: int) -> None:
        self._start, self._next = start, 0

    def take(self, until: int) -> IntArray:
        """Those up to ``until`` [ns] that were not taken yet."""
        count = int((until - self._start) * self._rate / NANO - self._phase) + 2 - self._next
        index = self._next + np.arange(max(count, 0))
        times = self._start + np.rint((index + self._phase) * NANO / self._rate).astype(np.int64)
        times = times[times <= until]
        self._next += len(times)
        return times


class _Post:
    """The way of one stream's messages: lost, late, twice, in another order, with another clock's stamps."""

    def __init__(self, world: World, stream: int) -> None:
        self._faults, self._stream = world.faults, stream
        self._rng = {p: draws(world.seed, p, stream) for p in Purpose}
        self.latest = 0

    def send(self, times: IntArray, seconds: FloatArray, values: FloatArray) -> list[Message]:
        f = self._faults
        stamps, delay, jitter = times, f.joint_latency, f.joint_jitter
        if self._stream:
            ahead = f.tracker_clock_offset + f.tracker_clock_drift * seconds
            stamps, delay, jitter = (
                times + np.rint(ahead * NANO).astype(np.int64),
                f.tracker_latency,
                f.tracker_jitter,
            )
        on_time = times + _ns(delay + self._draw(Purpose.DELAY, len(times), jitter))
        on_time = np.maximum.accumulate(np.maximum(on_time, self.latest))
        self.latest = int(on_time[-1])
        arrivals = on_time + self._extra(
            Purpose.REORDER, Purpose.REORDER_DELAY, f.reorder_probability, len(times)
        )
        again = self._extra(Purpose.DUPLICATE, Purpose.DUPLICATE_DELAY, f.duplicate_probability, len(times))
        sent = np.isfinite(values).all(axis=1)
        if self._stream and f.dropout_probability > 0:
            sent &= self._rng[Purpose.DROPOUT].random(len(times)) >= f.dropout_probability
        result = []
        for i in np.flatnonzero(sent):
            result.append(Message(int(arrivals[i]), self._stream, int(stamps[i]), values[i]))
            if again[i] > 0:
                result.append(Message(int(on_time[i] + again[i]), self._stream, int(stamps[i]), values[i]))
        return result

    def _draw(self, purpose: Purpose, count: int, scale: float) -> FloatArray:
        return self._rng[purpose].exponential(scale, count) if scale > 0 else np.zeros(count)

    def _extra(self, purpose: Purpose, size: Purpose, probability: float, count: int) -> IntArray:
        """(count,) further delay [ns], at least 1 where it happens, 0 elsewhere."""
        if probability == 0.0:
            return np.zeros(count, np.int64)
        happens: NDArray[np.bool_] = self._rng[purpose].random(count) < probability
        # As many numbers as samples: the same whether asked for at once or one by one.
        late = self._rng[size].uniform(0.0, self._faults.shuffle_delay, count)
        return np.where(happens, np.maximum(_ns(late), 1), 0)


def _ns(seconds: FloatArray) -> IntArray:
    return np.rint(seconds * NANO).astype(np.int64)
