# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Puts messages of several streams in the order of their stamps, with bounded delay and memory.

A message waits until no earlier one can come any more: until every stream has been heard that far plus the
reordering window. A stream that has fallen behind the others by more than the allowed skew is not waited for:
it is silent, or its clock differs. Its messages then come too late and are counted; many in a row are a skew.
Arrival times play no part.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")

MOST_WAITING = 50_000
"""Messages kept at most; beyond that the earliest are let go ahead of time."""
JUMP_AFTER = 5
"""Messages in a row far before the newest of their own stream that mean: its clock was set back."""


@dataclass
class _Stream:
    newest: int | None = None
    last_out: int | None = None
    behind: int = 0
    late: int = 0
    dropped: int = 0


@dataclass
class StampOrder(Generic[T]):
    """Merges ``streams`` streams; stamps are integer nanoseconds.

    Attributes:
        streams: Number of streams.
        window: How much earlier than the newest of its stream a message may be [ns].
        skew: How far a stream may lie behind the others and still be waited for [ns].
    """

    streams: int
    window: int
    skew: int
    _heap: list[tuple[int, int, int, T]] = field(default_factory=list)
    _state: list[_Stream] = field(default_factory=list)
    _expected: list[_Stream] = field(default_factory=list)
    _numbers: tuple[int, ...] = ()
    _count: int = 0
    _frontier: int | None = None

    def __post_init__(self) -> None:
        self._state = [_Stream() for _ in range(self.streams)]
        self.expect(range(self.streams))

    def expect(self, numbers: Iterable[int]) -> None:
        """Wait for these streams only: no others send messages."""
        self._numbers = tuple(numbers)
        self._expected = [self._state[k] for k in self._numbers]

    def clear(self) -> None:
        """Forget all messages, but not how many were dropped."""
        self._heap.clear()
        self._frontier = None
        self._state = [_Stream(dropped=s.dropped) for s in self._state]
        self.expect(self._numbers)

    def newest(self, stream: int) -> int | None:
        """Largest stamp of the stream [ns]; ``None`` before the first."""
        return self._state[stream].newest

    def withdraw(self, stream: int, after: int) -> None:
        """Forget the stream's messages that wait and are stamped later than ``after`` [ns]."""
        self._heap = [entry for entry in self._heap if entry[1] != stream or entry[0] <= after]
        heapq.heapify(self._heap)

    def add(self, stream: int, stamp: int, value: T) -> bool:
        """Take a message; ``False`` if it came too late and was dropped."""
        state = self._state[stream]
        if state.newest is not None and stamp < state.newest - self.window:
            state.behind += 1
            if state.behind < JUMP_AFTER:
                state.dropped += 1
                return False
            self._set_back(stream)
        state.behind = 0
        state.newest = stamp if state.newest is None else max(stamp, state.newest)
        if self._frontier is not None and stamp <= self._frontier:
            state.late += 1
            state.dropped += 1
            return False
        state.late = 0
        self._count += 1
        heapq.heappush(self._heap, (stamp, stream, self._count, value))
        return True

    def late(self, stream: int) -> int:
        """Messages in a row that came too late because the stream lies behind the others."""
        return self._state[stream].late

    def dropped(self, stream: int) -> int:
        """Messages of the stream that were not passed on: too late, twice, or before a clock was set back."""
        return self._state[stream].dropped

    def lag(self, stream: int) -> int:
        """How far the stream lies behind the most advanced one [ns]."""
        newest = [s.newest for s in self._expected if s.newest is not None]
        own = self._state[stream].newest
        return 0 if own is None else max(newest) - own

    def ready(self, *, everything: bool = False) -> list[tuple[int, int, T]]:
        """Take out (stamp, stream, value) of all messages whose turn has come, duplicates left out."""
        self._advance()
        out = []
        while self._heap and (
            everything
            or len(self._heap) > MOST_WAITING
            or (self._frontier is not None and self._heap[0][0] <= self._frontier)
        ):
            stamp, stream, _, value = heapq.heappop(self._heap)
            self._frontier = stamp if self._frontier is None else max(stamp, self._frontier)
            if stamp != self._state[stream].last_out:
                self._state[stream].last_out = stamp
                out.append((stamp, stream, value))
            else:
                self._state[stream].dropped += 1
        return out

    def _advance(self) -> None:
        newest = [s.newest for s in self._expected]
        heard = [n for n in newest if n is not None]
        if not heard:
            return
        slowest = min(heard) if len(heard) == len(newest) else min(heard) - self.skew
        frontier = max(slowest, max(heard) - self.skew) - self.window
        self._frontier = frontier if self._frontier is None else max(frontier, self._frontier)

    def _set_back(self, stream: int) -> None:
        """Forget a stream's past: its clock was set back, or one stamp was far in the future."""
        others = [entry for entry in self._heap if entry[1] != stream]
        self._state[stream] = _Stream(dropped=self._state[stream].dropped + len(self._heap) - len(others))
        self.expect(self._numbers)
        self._heap = others
        heapq.heapify(self._heap)
        self._frontier = None
