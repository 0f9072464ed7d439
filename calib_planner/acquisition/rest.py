# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Rests of streams: the samples since a stream came to rest, and the rest of joints that come in parts.

A ``RestWindow`` is the rest of one stream. The joints of a robot may come in parts, each in messages of its own
and at a rate of its own: a rail and an arm, say. Each part is then judged by itself, as a stream, and the robot
is at rest where all of its parts are: from the latest beginning to the earliest of their last samples. Between
two samples of a slow part nobody knows whether it moves: the rest is known to last up to the earlier one.

Which joints form a part is not stated but seen. In the beginning all joints are one part. A message that names
some joints of a part only divides the part into those that it names and the others. So every joint belongs to one
part, whatever messages name it, and there are never more parts than joints.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import takewhile

import numpy as np

from calib_planner.arrays import FloatArray

MOST_SAMPLES = 20_000
"""Samples of one stream that a standstill holds at most."""


@dataclass
class RestWindow:
    """The samples of one stream since it came to rest; one that breaks the rest begins a new one.

    Attributes:
        tolerance: Largest range of a coordinate [rad | m].
        gap: Longest pause between samples [ns].
        settle: Time after a motion whose samples may be farther from later ones [ns].
        horizon: Samples older than this are forgotten [ns].
        since, last: Stamps of the first and the last sample of the rest [ns].
        arrived: Whether a motion came before the rest, as far as seen: not a gap.
        left: Stamp of the sample that broke this rest, which was kept; 0 while it is the newest [ns].
        moved_by: Kept for who asks why there was no standstill [m].
        before: The longest rest during the standstill of the joints that was broken.
        samples: ``(stamp, value)``, the oldest first.
    """

    tolerance: float
    gap: int
    settle: int
    horizon: int
    since: int = 0
    last: int = 0
    arrived: bool = False
    left: int = 0
    moved_by: float = 0.0
    before: RestWindow | None = None
    samples: deque[tuple[int, FloatArray]] = field(default_factory=lambda: deque(maxlen=MOST_SAMPLES))
    _low: FloatArray = field(default_factory=lambda: np.empty(0))
    _high: FloatArray = field(default_factory=lambda: np.empty(0))
    _first: int = 0  # stamp of the first sample, also where the rest begins later by now
    _late: tuple[int, FloatArray, FloatArray] | None = None  # from ``settle`` after it: first stamp, range

    def on_time(self, stamp: int) -> bool:
        """Whether ``stamp`` follows the last sample without a gap."""
        return bool(self.samples) and 0 < stamp - self.last <= self.gap

    def goes_on(self, stamp: int, value: FloatArray) -> bool:
        """Whether the rest goes on with ``value`` at ``stamp`` [ns]."""
        return self.on_time(stamp) and self.spread_with(value) <= self.tolerance

    def settled(self, settle: int) -> int:
        """Stamp from which on it is at rest, ``settle`` [ns] after a motion."""
        return self.since + settle * self.arrived

    def spread_with(self, value: FloatArray) -> float:
        """Range, largest over the coordinates, were ``value`` to join."""
        return float(np.max(np.maximum(self._high, value) - np.minimum(self._low, value)))

    def push(self, stamp: int, value: FloatArray) -> tuple[int, int] | None:
        """Take a sample; one that breaks the rest begins a new one, and gives the old one's interval [ns]."""
        ended = None
        if not self.goes_on(stamp, value) and not self.begin_later(stamp, value):
            self.arrived = self.on_time(stamp)
            ended = (self.since, self.last) if self.samples else None
            self.samples.clear()
            self._late = None
            self._low = self._high = value
            self.since = self._first = stamp
        self._low, self._high = np.minimum(self._low, value), np.maximum(self._high, value)
        if stamp > self._first + self.settle:
            _, low, high = self._late or (stamp, value, value)
            self._late = (
                (stamp if self._late is None else self._late[0]),
                np.minimum(low, value),
                np.maximum(high, value),
            )
        self.last = stamp
        self.samples.append((stamp, value))
        while self.samples[0][0] < stamp - self.horizon:
            self.samples.popleft()
        return ended

    def begin_later(self, stamp: int, value: FloatArray) -> bool:
        """Whether the rest goes on with ``value`` at ``stamp`` [ns] if it begins later; from now on it does.

        It may begin with any sample up to the first one ``settle`` after its first.
        """
        if not self.on_time(stamp):
            return False
        head = list(takewhile(lambda s: s[0] <= self._first + self.settle, self.samples))
        stamps = [t for t, _ in head] + ([] if self._late is None else [self._late[0]])
        rows = np.array([v for _, v in head] + ([] if self._late is None else list(self._late[1:])) + [value])
        low, high = (f.accumulate(rows[::-1])[::-1] for f in (np.minimum, np.maximum))
        fits = np.flatnonzero(np.max(high - low, axis=1)[: len(stamps)] <= self.tolerance)
        if not len(fits):
            return False
        k = int(fits[0])
        self.since, self.arrived, self._low, self._high = stamps[k], True, low[k], high[k]
        for _ in range(k):
            self.samples.popleft()
        return True

    def restart(self) -> None:
        """Begin the rest with its newest sample, as if it had come alone."""
        stamp, value = self.samples[-1]
        self.samples.clear()
        self.samples.append((stamp, value))
        self._low = self._high = value
        self.since = self._first = stamp
        self._late, self.arrived = None, False

    def keep(self, stamp: int, begin: int) -> None:
        """Keep this rest, which ``stamp`` breaks, unless a longer one lasted beyond ``begin`` [ns]."""
        other = self.before
        if other is None or other.last < begin or len(other.samples) <= len(self.samples):
            self.before = replace(self, left=stamp, before=None, samples=self.samples.copy())

    def until_it_left(self, after: int) -> RestWindow:
        """The rest before, if it was broken at ``after`` [ns] or later; else this one."""
        return self.before if self.before is not None and self.before.left >= after else self

    def between(self, start: int, end: int) -> FloatArray:
        """(samples, n) values with stamps in [start, end]."""
        rows = [v for t, v in self.samples if start <= t <= end]
        return np.array(rows).reshape(len(rows), len(self._low))


@dataclass
class JointPart:
    """Joints that come together.

    Attributes:
        columns: Numbers of the joints, from 0, ascending; the first one is the number of their stream.
        window: Their rest; values are in the order of ``columns`` [rad | m].
        until: Stamp of the last sample [ns]; ``None`` before the first.
    """

    columns: tuple[int, ...]
    window: RestWindow
    until: int | None = None


class JointRest:
    """The rest of all joints, n of them, in parts; there may be none, then ``at_rest`` is false.

    Args:
        window: A window without samples, by which all parts are judged.
        joints: Number of joints.

    Attributes:
        parts: The parts, in the order of their first joints.
        at_rest: Whether every part has samples of a rest.
        since, last: From when on, and until when, all are seen at rest [ns].
        until: Stamp up to which every part was heard, at rest or not [ns]; ``None`` before.
    """

    at_rest: bool
    since: int
    last: int
    until: int | None

    def __init__(self, window: RestWindow, joints: int) -> None:
        self._window = window
        self.parts = [self._part(range(joints))]
        self._follow()

    def _part(self, columns: Iterable[int]) -> JointPart:
        return JointPart(tuple(columns), replace(self._window, samples=self._window.samples.copy()))

    def divide(self, columns: Iterable[int]) -> list[JointPart]:
        """Divide the parts that hold some of ``columns`` and other joints as well; the divided ones."""
        wanted, parts, divided = set(columns), [], []
        for part in self.parts:
            both = [[c for c in part.columns if (c in wanted) == inside] for inside in (True, False)]
            parts += [self._part(half) for half in both] if all(both) else [part]
            divided += [part] if all(both) else []
        self.parts = sorted(parts, key=lambda p: p.columns)
        self._follow()
        return divided

    def begin(self) -> None:
        """Forget everything but the parts."""
        self.parts = [self._part(p.columns) for p in self.parts]
        self._follow()

    @property
    def gap(self) -> int:
        """Longest pause between samples of a part [ns]."""
        return self._window.gap

    @property
    def tolerance(self) -> float:
        """Largest range of a joint [rad | m]."""
        return self._window.tolerance

    def _follow(self) -> None:
        """Note what the parts say together: it is looked up at every message, and changes with joints only."""
        windows = [p.window for p in self.parts]
        stamps = [p.until for p in self.parts if p.until is not None]
        self.at_rest = all(w.samples for w in windows)
        self.since, self.last = max([w.since for w in windows]), min([w.last for w in windows])
        self.until = min(stamps) if len(stamps) == len(windows) else None

    def hear(self, part: JointPart, stamp: int) -> None:
        """A part was heard, whose samples do not matter now."""
        part.until = stamp
        self._follow()

    def push(self, part: JointPart, stamp: int, value: FloatArray) -> None:
        """Take a sample of a part."""
        part.until = stamp
        part.window.push(stamp, value)
        self._follow()

    @property
    def newest(self) -> FloatArray:
        """(n,) last positions of the rest [rad | m], NaN where there are none."""
        values = np.full(sum(len(p.columns) for p in self.parts), np.nan)
        for part in self.parts:
            if part.window.samples:
                values[list(part.columns)] = part.window.samples[-1][1]
        return values

    def clear(self) -> None:
        """Forget the samples."""
        for part in self.parts:
            part.window.samples.clear()
        self._follow()

    def end(self, moved: JointPart) -> None:
        """The rest is over, since ``moved`` moves or is silent; others begin anew with their newest sample.

        Else the range of a part that never moves would grow with its noise, standstill by standstill.
        """
        moved.window.samples.clear()
        for part in self.parts:
            if part.window.samples:
                part.window.restart()
        self._follow()

    def mean(self, start: int, end: int) -> FloatArray:
        """(n,) mean positions over [start, end] [ns], in a rest that lasts from before to after.

        A part without a sample in this interval counts with the nearest one of its rest.
        """
        values = np.empty(sum(len(p.columns) for p in self.parts))
        for part in self.parts:
            rows = part.window.between(start, end)
            if not len(rows):
                rows = np.array([min(part.window.samples, key=lambda s: abs(2 * s[0] - start - end))[1]])
            values[list(part.columns)] = rows.mean(axis=0)
        return values
