"""The samples of one stream since it came to rest; one that breaks the rest begins a new one."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from calib_planner._arrays import FloatArray

MOST_SAMPLES = 20_000
"""Samples of one stream kept at most."""


@dataclass
class RestWindow:
    """See the module.

    Attributes:
        tolerance: Largest range of a coordinate [rad | m].
        gap: Longest pause between samples [ns].
        horizon: Samples older than this are forgotten [ns].
        since, last: Stamps of the first and the last sample of the rest [ns].
        arrived: Whether a motion came before the rest, as far as seen: not a gap.
        moved_by: Kept for who asks why there was no standstill [m].
        samples: ``(stamp, value)``, the oldest first.
    """

    tolerance: float
    gap: int
    horizon: int
    since: int = 0
    last: int = 0
    arrived: bool = False
    moved_by: float = 0.0
    samples: deque[tuple[int, FloatArray]] = field(default_factory=lambda: deque(maxlen=MOST_SAMPLES))
    _low: FloatArray = field(default_factory=lambda: np.empty(0))
    _high: FloatArray = field(default_factory=lambda: np.empty(0))

    def on_time(self, stamp: int) -> bool:
        """Whether ``stamp`` follows the last sample without a gap."""
        return bool(self.samples) and 0 < stamp - self.last <= self.gap

    def settled(self, settle: int) -> int:
        """Stamp from which on it is at rest, ``settle`` [ns] after a motion."""
        return self.since + settle * self.arrived

    def spread_with(self, value: FloatArray) -> float:
        """Range, largest over the coordinates, were ``value`` to join."""
        return float(np.max(np.maximum(self._high, value) - np.minimum(self._low, value)))

    def push(self, stamp: int, value: FloatArray) -> tuple[int, int] | None:
        """Take a sample; one that breaks the rest begins a new one, and gives the old one's interval [ns]."""
        ended = None
        if self.on_time(stamp) and self.spread_with(value) <= self.tolerance:
            self._low, self._high = np.minimum(self._low, value), np.maximum(self._high, value)
        else:
            self.arrived = self.on_time(stamp)
            ended = (self.since, self.last) if self.samples else None
            self.samples.clear()
            self._low = self._high = value
            self.since = stamp
        self.last = stamp
        self.samples.append((stamp, value))
        while self.samples[0][0] < stamp - self.horizon:
            self.samples.popleft()
        return ended

    def between(self, start: int, stop: int) -> FloatArray:
        """(samples, n) values with stamps in [start, stop]."""
        rows = [v for t, v in self.samples if start <= t <= stop]
        return np.array(rows).reshape(len(rows), len(self._low))
