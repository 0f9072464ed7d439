# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Do the clocks of joints and points agree? Seen from when each came to rest and when it moved on.

A standstill is an interval [a, b] in the stamps of the joints and [a', b'] in those of a target. A clock that is
τ ahead shifts both ends: a' − a = b' − b = τ. What else makes them differ (tolerances that are not passed at the
same moment while the robot slows down and speeds up) has opposite signs at the two ends of a motion that is about
as quick at its end as at its beginning, so the middles differ by τ and the lengths by what is doubtful:

    τ = (a' + b')/2 − (a + b)/2,      doubt = |(b' − a') − (b − a)|/2

The offset of a target is the median of its last standstills; what was seen many rests of the joints ago does not
count, or a target that nobody sees move any more would keep the offset that it had. A beam that was broken
shortens the target's interval and shows as doubt, a target that did not move at all has none. An offset shorter
than the time left out after coming to rest does no harm to means over standstills. With a longer one they may
hold ends of motions, as far as the tolerance of standing still lets them, or points of another standstill than
the joints. Some such means were taken before an offset is seen: ``beyond`` names them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from statistics import median

NANO = 1_000_000_000
REMEMBERED = 5
"""Standstills that an offset is the median of; more would be longer in noticing that a clock was set."""
LATELY = 9
"""Rests of the joints after which what was seen is forgotten."""
FEWEST = 3
"""Standstills without which there is no offset."""

Interval = tuple[int, int]


@dataclass(frozen=True)
class Offset:
    """How far a target's stamps are ahead of the joints'.

    Attributes:
        seconds: The offset [s]; positive: the points are stamped later than the joints.
        doubt: How much of it may come from something else [s].
        standstills: Number it rests on.
    """

    seconds: float
    doubt: float
    standstills: int

    def exceeds(self, bound: float) -> bool:
        """Whether it is beyond ``bound`` [s] whatever the doubt."""
        return abs(self.seconds) - self.doubt > bound


@dataclass
class ClockOffsets:
    """Fed with the rests of every stream, in the order in which they end.

    Attributes:
        targets: Number of targets.
        reach: Largest difference of stamps that can belong to one standstill [ns].
        shortest: Shorter rests are left out [ns].
    """

    targets: int
    reach: int
    shortest: int
    _joints: deque[Interval] = field(default_factory=lambda: deque(maxlen=LATELY))
    _points: list[deque[Interval]] = field(default_factory=list)
    _offsets: list[deque[tuple[int, int, Interval]]] = field(default_factory=list)  # (offset, doubt, joints) [ns]

    def __post_init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget everything: a clock was set."""
        self._joints.clear()
        self._points = [deque(maxlen=LATELY) for _ in range(self.targets)]
        self._offsets = [deque(maxlen=REMEMBERED) for _ in range(self.targets)]

    def add_joints(self, start: int, end: int) -> None:
        """The joints were at rest from ``start`` to ``end`` [ns]."""
        if end - start >= self.shortest:
            self._joints.append((start, end))
            for k, points in enumerate(self._points):
                if (nearest := self._nearest((start, end), points)) is not None:
                    self._note(k, (start, end), nearest)

    def add_point(self, target: int, start: int, end: int) -> None:
        """A target, from 0, was at rest from ``start`` to ``end`` [ns]."""
        if end - start >= self.shortest:
            self._points[target].append((start, end))
            if (nearest := self._nearest((start, end), self._joints)) is not None:
                self._note(target, nearest, (start, end))

    def offset(self, target: int) -> Offset | None:
        """The offset of a target, from 0; ``None`` as long as too little was seen."""
        lately = self._lately(target)
        if len(lately) < FEWEST:
            return None
        seconds, doubt = (median(values) / NANO for values in list(zip(*lately, strict=True))[:2])
        return Offset(seconds, doubt, len(lately))

    def beyond(self, target: int, bound: float) -> list[Interval]:
        """Rests of the joints [ns] whose points had an offset beyond ``bound`` [s], once the offset itself is."""
        now = self.offset(target)
        if now is None or not now.exceeds(bound):
            return []
        return [rest for offset, doubt, rest in self._lately(target) if abs(offset) - doubt > bound * NANO]

    def _lately(self, target: int) -> list[tuple[int, int, Interval]]:
        return [f for f in self._offsets[target] if f[2] in self._joints]

    def _nearest(self, rest: Interval, others: deque[Interval]) -> Interval | None:
        """Which of the other stream's rests belongs to ``rest``."""
        near = [o for o in others if max(abs(o[0] - rest[0]), abs(o[1] - rest[1])) <= self.reach]
        return min(near, key=lambda o: abs(sum(o) - sum(rest)), default=None)

    def _note(self, target: int, joints: Interval, points: Interval) -> None:
        offset = (sum(points) - sum(joints)) // 2
        doubt = abs((points[1] - points[0]) - (joints[1] - joints[0])) // 2
        self._offsets[target].append((offset, doubt, joints))
