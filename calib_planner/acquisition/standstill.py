# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""When does the robot stand still, and what are the mean joints and points then?

Still means: over an interval, max − min of every joint and of every coordinate of every point stays within a
tolerance, and no gap between messages is longer than allowed. Velocities play no part (they are
missing, noisy or zero at turning points), nor do arrival times: all that counts is the stamps, integer
nanoseconds.

The average begins ``settle`` after the joints came to rest, and as long after the points did: the end of a motion
is within the tolerance, and were the tracker's clock ahead, the joints' rest alone would not leave it out. A
result comes once per standstill: as soon as there are enough samples; after ``patience`` with what there is; or
when the robot moves on. A standstill that ends without a result gives a rejection that says why.

The two streams see a motion at different times, and a motion must not spoil the standstill before or after it:

* Points wait for the next joint state. If that one shows a motion, the points after the last joint state at rest
  belong to the motion and do not count.
* A motion begins slowly: points leave their tolerance before the joints leave theirs. If that happens less than
  ``settle`` before the joints were last seen at rest, what was measured before it counts.
* A motion ends slowly: its end is within the tolerance of the first samples at rest, and noise may break the rest
  for it much later. Then the rest begins later, within ``settle`` of its first sample, and goes on.

Joints may come in parts (``rest.py``): all of this then holds for the part that moves first and comes to rest
last, and points wait for the next state of every part.

A tracker may say that it has lost a target. It says so without a stamp: what counts is which points came before.
Those stamped within ``window`` before the newest one are taken for lost as well, since they may have been
overtaken; and so are all up to the newest one that came while the target was lost.

The tolerance on points has to be several times the tracker's noise: with σ = 0.03 mm the range of a thousand
samples is about 6.5σ = 0.2 mm. Nothing here knows ROS; messages from a bag do as well as live ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.acquisition.clocks import NANO, ClockOffsets
from calib_planner.acquisition.rest import MOST_SAMPLES, JointPart, JointRest, RestWindow
from calib_planner.acquisition.stamps import StampOrder
from calib_planner.arrays import FloatArray, IntArray, check_array, check_count, check_ranges, frozen, ranged
from calib_planner.errors import InputError
from calib_planner.units import length, listed, milliseconds

SAME_PLACE = 0.01
"""Joints differ by no more at one place [rad | m]: what an identifier takes for a planned configuration."""
IN_A_ROW = 50
"""So many unusable messages in a row get a rejection of their own."""


@dataclass(frozen=True)
class StandstillSettings:
    """What counts as standing still, with units and ranges."""

    joint_tolerance: float = ranged(1e-4, "largest range of a joint during a standstill", "rad or m", 1e-9, 1.0)
    point_tolerance: float = ranged(
        3e-4,
        "largest range of a coordinate during a standstill, about ten times sigma",
        "m",
        1e-7,
        1.0,
    )
    settle: float = ranged(0.1, "time left out after joints and points came to rest", "s", 0.0, 60.0)
    duration: float = ranged(0.4, "shortest interval that is averaged", "s", 0.01, 600.0)
    samples: int = ranged(20, "points of every target that are wanted", "", 1, MOST_SAMPLES)
    minimum_samples: int = ranged(5, "points of a target that are needed to use it", "", 1, MOST_SAMPLES)
    patience: float = ranged(
        2.0, "time at rest, beyond settle, after which fewer points than wanted are used", "s", 0.01, 600.0
    )
    gap: float = ranged(0.25, "longest pause between two messages of a stream", "s", 1e-3, 60.0)
    window: float = ranged(0.1, "how late a message may come after a later one of its stream", "s", 0.0, 60.0)
    skew: float = ranged(0.5, "largest difference between the stamps of the streams", "s", 1e-3, 60.0)

    def __post_init__(self) -> None:
        check_ranges(self, StandstillSettings)
        if self.minimum_samples > self.samples:
            raise InputError("minimum_samples", self.minimum_samples, f"at most samples = {self.samples}")


class RejectionReason(Enum):
    """Why a standstill gave no measurement."""

    MOVED = "moved"
    TOO_FEW_SAMPLES = "too_few_samples"
    TIME_SKEW = "time_skew"
    OTHER_FRAME = "other_frame"
    NOT_FINITE = "not_finite"
    TARGET_LOST = "target_lost"


REJECTIONS = {
    RejectionReason.MOVED.value: "The robot or a target moved. Wait until it stands still, measure again.",
    RejectionReason.TOO_FEW_SAMPLES.value: "The standstill was too short. Dwell longer, or raise the rate.",
    RejectionReason.TIME_SKEW.value: "The stamps of joints and tracker do not overlap. Synchronise the clocks.",
    RejectionReason.OTHER_FRAME.value: "Points came in another frame_id than before. Publish all in one frame.",
    RejectionReason.NOT_FINITE.value: "Values are not finite. Check line of sight and the drivers.",
    RejectionReason.TARGET_LOST.value: "The tracker had lost the target. Lock on again, then measure again.",
}
"""Value of a ``RejectionReason`` → what it means and what to do."""


@dataclass(frozen=True, eq=False)
class Standstill:
    """Means over an interval in which nothing moved. n joints, T targets.

    Attributes:
        start, end: Stamps of the interval [ns].
        joints: (n,) mean positions [rad | m].
        points: (T, 3) mean points in the tracker's frame [m]; NaN where a target was not seen.
        std: (T,) standard deviation of one coordinate of the mean point, from the scatter of the samples
            pooled over x, y and z [m]; NaN where not seen.
        samples: (T,) points averaged.
    """

    start: int
    end: int
    joints: FloatArray
    points: FloatArray
    std: FloatArray
    samples: IntArray

    @property
    def duration(self) -> float:
        """Length of the interval [s]."""
        return (self.end - self.start) / NANO

    @property
    def stamp(self) -> int:
        """Middle of the interval [ns]."""
        return (self.start + self.end) // 2

    def is_again(self, other: Standstill, tolerance: float = SAME_PLACE) -> bool:
        """Whether it is ``other`` once more: at the same time, as the stamps say, and at the same place.

        A robot cannot stand still twice at the same time: a recording was played twice, or two of them overlap.
        The stamps alone do not tell it, since the clock of a simulation begins at zero each time.

        Args:
            other: The standstill before.
            tolerance: Largest difference of a joint at one place [rad | m].
        """
        overlapping = self.start <= other.end and other.start <= self.end
        return overlapping and bool(np.abs(self.joints - other.joints).max() <= tolerance)


@dataclass(frozen=True, eq=False)
class Rejection:
    """A standstill that cannot be used.

    Attributes:
        start, end: Stamps of the interval [ns].
        reason: Which of the known ones.
        message: In words, with numbers and what to do.
        joints: (n,) last positions [rad | m], NaN if there were none.
        samples: (T,) points seen.
    """

    start: int
    end: int
    reason: RejectionReason
    message: str
    joints: FloatArray
    samples: IntArray


class StandstillDetector:
    """Fed with stamped messages in any order; returns what they complete.

    Args:
        joints: Number of joints.
        targets: Number of targets.
        settings: What counts as standing still.
    """

    def __init__(self, joints: int, targets: int = 1, settings: StandstillSettings | None = None) -> None:
        self.settings = s = settings or StandstillSettings()
        self.joint_count = check_count("joints", joints, high=1000)
        self.target_count = check_count("targets", targets, high=1000)
        self._order: StampOrder[FloatArray] = StampOrder(joints + targets, _ns(s.window), _ns(s.skew))
        horizon, gap = _ns(s.settle + max(s.patience, s.duration) + s.gap), _ns(s.gap)
        self._joints = JointRest(RestWindow(s.joint_tolerance, gap, _ns(s.settle), horizon), joints)
        self._targets = [RestWindow(s.point_tolerance, gap, _ns(s.settle), horizon) for _ in range(targets)]
        self.clocks = ClockOffsets(targets, _ns(s.skew), _ns(s.duration) // 2)
        self._measured: FloatArray | None = None
        self._measured_since = 0  # stamp from which on the joints were at rest that were measured
        self._waiting: deque[tuple[int, int, FloatArray]] = deque()  # (target, stamp, point) for the next joints
        self._complained = False
        self._saw_nan = False
        self._losses = [TargetLoss() for _ in range(targets)]
        self._nan_in_a_row = [0] * (joints + targets)
        self._complained_at = [-(2**63)] * (joints + targets)  # about a stream, stamps [ns]
        self._arrange()

    def add_joints(
        self, stamp: int, positions: ArrayLike, columns: tuple[int, ...] | None = None
    ) -> list[Standstill | Rejection]:
        """Take joint positions [rad | m] with their stamp [ns]; NaN = unusable.

        Args:
            stamp: When they were read [ns].
            positions: (joints,) of all joints, or (k,) of those in ``columns``.
            columns: Numbers of the k joints, from 0, ascending.
        """
        meaning = "joint positions in rad or m"
        if columns is None:
            values = check_array("positions", positions, (self.joint_count,), finite=False, meaning=meaning)
            if len(self._joints.parts) == 1:
                return self._add(0, stamp, values)
            columns = tuple(range(self.joint_count))
        else:
            values = check_array("positions", positions, (len(columns),), finite=False, meaning=meaning)
        routes = self._routes.get(columns)
        if routes is None:
            routes = self._route(columns)
        results: list[Standstill | Rejection] = []
        for stream, rows in routes:
            results += self._add(stream, stamp, values[rows])
        return results

    def _route(self, columns: tuple[int, ...]) -> list[tuple[int, IntArray]]:
        """(stream, rows) of every part among these joints, from now on."""
        rising = all(a < b for a, b in pairwise((-1, *columns, self.joint_count)))
        if not columns or not rising:
            raise InputError("columns", columns, f"numbers from 0 to {self.joint_count - 1}, ascending")
        divided = self._joints.divide(columns)
        if any(self._order.newest(p.columns[0]) is not None for p in divided):
            self._order.clear()  # states of the whole part may be waiting
            self._waiting.clear()
            self._joints.begin()
        self._arrange()
        row = {column: k for k, column in enumerate(columns)}
        parts = [p for p in self._joints.parts if p.columns[0] in row]
        routes = [(p.columns[0], np.array([row[c] for c in p.columns])) for p in parts]
        self._routes[columns] = routes
        return routes

    def _arrange(self) -> None:
        """Follow the parts of the joints."""
        self._part = {p.columns[0]: p for p in self._joints.parts}
        self._routes: dict[tuple[int, ...], list[tuple[int, IntArray]]] = {}
        n = self.joint_count
        self._order.expect((*self._part, *range(n, n + self.target_count)))

    def add_point(self, target: int, stamp: int, xyz: ArrayLike) -> list[Standstill | Rejection]:
        """Take a point (3,) [m] of target number ``target``, from 0; NaN = not seen."""
        self._check_target(target)
        values = check_array("xyz", xyz, (3,), finite=False)
        if self._losses[target].takes(stamp, _ns(self.settings.window)):
            return []
        return self._add(self.joint_count + target, stamp, values)

    def set_lost(self, target: int, lost: bool) -> None:
        """The tracker says that it has lost target number ``target``, from 0, or that it sees it (again)."""
        self._check_target(target)
        loss, stream = self._losses[target], self.joint_count + target
        if lost and not loss.now:
            newest = self._order.newest(stream)
            if newest is not None:
                self._order.withdraw(stream, newest - _ns(self.settings.window))
        loss.now, loss.seen = lost, loss.seen or lost

    def _check_target(self, target: int) -> None:
        if not 0 <= target < self.target_count:
            raise InputError("target", target, f"0 to {self.target_count - 1}")

    def flush(self) -> list[Standstill | Rejection]:
        """Take what still waits, and the last standstill as ended: the end of a recording."""
        results = self._process(everything=True) + self._ended()
        self.clocks.clear()
        self._waiting.clear()
        self._joints.clear()
        self._measured = None
        return results

    def offset_text(self, bound: float) -> str:
        """In words, which target's stamps are more than ``bound`` [s] from the joints'; empty if none are."""
        for k in range(self.target_count):
            offset = self.clocks.offset(k)
            if offset is not None and offset.exceeds(bound):
                text = f"target {k + 1} is stamped {milliseconds(offset.seconds, plus=True)} from the joints"
                by = f"by when both stopped and started at {offset.standstills} standstills"
                return f"{text}, {by}, {milliseconds(bound)} are allowed: synchronise the clocks"
        return ""

    def misdated(self, bound: float) -> list[tuple[int, int]]:
        """Rests of the joints [ns] with a target's stamps more than ``bound`` [s] off, see ``ClockOffsets``."""
        return [rest for k in range(self.target_count) for rest in self.clocks.beyond(k, bound)]

    def joints_rest(self) -> float:
        """How long all joints have stood still, by their stamps [s]; about 0 while one of them moves."""
        joints = self._joints
        if self._measured is not None:
            return max((joints.until or 0) - self._measured_since, 0) / NANO
        return max(joints.last - joints.since, 0) / NANO if joints.at_rest else 0.0

    def points_rest(self, target: int) -> float:
        """How long a target, from 0, has stood still, by the stamps of its points [s]; about 0 while it moves."""
        window = self._targets[target]
        return (window.last - window.since) / NANO

    def joints_dropped(self, columns: Iterable[int]) -> int:
        """Finite states that took no part: too late, twice or set back; of that of these joints with most."""
        streams = {p.columns[0] for p in self._joints.parts if {*columns} & {*p.columns}}
        return max((self._order.dropped(k) for k in streams), default=0)

    def points_dropped(self, target: int) -> int:
        """Finite points of a target, from 0, that took no part: too late, twice or set back."""
        return self._order.dropped(self.joint_count + target)

    # ── from messages to events in order ─────────────────────────────────────────────────────────────

    def _add(self, stream: int, stamp: int, value: FloatArray) -> list[Standstill | Rejection]:
        stamp = int(stamp)
        if not np.isfinite(value).all():
            self._saw_nan = True
            self._nan_in_a_row[stream] += 1
            text = f"{self._nan_in_a_row[stream]} messages in a row from {self._name(stream)} are not finite"
            text += ": check line of sight and driver"
            bad = self._nan_in_a_row[stream] >= IN_A_ROW
            return self._complaint(stream, stamp, RejectionReason.NOT_FINITE, text) if bad else []
        self._nan_in_a_row[stream] = 0
        if not self._order.add(stream, stamp, value) and self._lags(stream):
            return self._complaint(stream, stamp, RejectionReason.TIME_SKEW, self._lag_text(stream))
        return self._process()

    def _complaint(
        self, stream: int, stamp: int, reason: RejectionReason, text: str
    ) -> list[Standstill | Rejection]:
        """A rejection about a stream, as often as there could have been a standstill."""
        before = self._complained_at[stream]
        if before <= stamp <= before + _ns(self.settings.patience):
            return []
        self._complained_at[stream] = stamp
        return [self._rejection(stamp, stamp, reason, text)]

    def _name(self, stream: int) -> str:
        if stream >= self.joint_count:
            return f"target {stream - self.joint_count + 1}"
        if len(self._joints.parts) == 1:
            return "the joints"
        return "joint " + listed([str(c + 1) for c in self._part[stream].columns])

    def _lags(self, stream: int) -> bool:
        """Whether a stream lies so far behind the others that it takes no part."""
        return self._order.late(stream) >= IN_A_ROW

    def _lag_text(self, stream: int) -> str:
        text = f"stamps from {self._name(stream)} lie {self._order.lag(stream) / NANO:.3g} s behind the others"
        return f"{text}: synchronise the clocks, or raise skew if its messages take that long"

    def _process(self, *, everything: bool = False) -> list[Standstill | Rejection]:
        results: list[Standstill | Rejection] = []
        for stamp, stream, value in self._order.ready(everything=everything):
            if self._waiting and stamp < self._waiting[-1][1]:
                self._on_points()  # a clock was set back: these are from before
            if stream >= self.joint_count:
                self._waiting.append((stream - self.joint_count, stamp, value))
                results += self._on_silence(stamp)
            else:
                results += self._on_joints(self._part[stream], stamp, value)
                self._on_points(self._joints.until)
            results += self._complete(stamp)
        return results

    def _on_joints(self, part: JointPart, stamp: int, value: FloatArray) -> list[Standstill | Rejection]:
        joints, results = self._joints, []
        if self._measured is not None:
            if np.max(np.abs(value - self._measured[list(part.columns)])) <= joints.tolerance:
                joints.hear(part, stamp)
                return []
            self.clocks.add_joints(self._measured_since, joints.until or stamp)
            self._measured = None
            joints.clear()
        elif (
            joints.at_rest and not part.window.goes_on(stamp, value) and not part.window.begin_later(stamp, value)
        ):
            results = self._moved_on(part)
        if not joints.at_rest:
            self._complained = self._saw_nan = False
            for loss in self._losses:
                loss.seen = loss.now
            for window in self._targets:
                window.moved_by, window.before = 0.0, None
        joints.push(part, stamp, value)
        return results

    def _moved_on(self, part: JointPart) -> list[Standstill | Rejection]:
        """The joints' rest has ended, by this part, without a result so far."""
        rest = self._joints.since, self._joints.last
        results = self._ended()
        if self._measured is None:
            self.clocks.add_joints(*rest)
            self._joints.end(part)
        return results

    def _on_silence(self, stamp: int) -> list[Standstill | Rejection]:
        """Let the points in without a joint state, if the joints' last one is a gap before ``stamp`` [ns]."""
        until, gap = self._joints.until, self._joints.gap
        if until is not None and 0 <= stamp - until <= gap and len(self._waiting) < MOST_SAMPLES:
            return []
        results = []
        if self._measured is None and self._joints.at_rest and stamp - self._joints.last > gap:
            results = self._moved_on(min(self._joints.parts, key=lambda p: p.window.last))
        self._on_points()
        return results

    def _on_points(self, until: int | None = None) -> None:
        """Take the points that waited, up to ``until`` [ns] if that is given."""
        while self._waiting and (until is None or self._waiting[0][1] <= until):
            self._on_point(*self._waiting.popleft())

    def _on_point(self, target: int, stamp: int, value: FloatArray) -> None:
        window, begin = self._targets[target], self._joints.since + _ns(self.settings.settle)
        at_rest = self._joints.at_rest and self._measured is None and window.last >= begin
        if at_rest and window.on_time(stamp):
            spread = window.spread_with(value)
            if spread > window.tolerance:
                window.moved_by = max(window.moved_by, spread)
                window.keep(stamp, begin)
        if (rest := window.push(stamp, value)) is not None:
            self.clocks.add_point(target, *rest)

    # ── the decision ─────────────────────────────────────────────────────────────────────────────────

    def _complete(self, stamp: int) -> list[Standstill | Rejection]:
        """The result, if there is enough by ``stamp``, or if patience has run out."""
        s, joints = self.settings, self._joints
        begin = joints.since + _ns(s.settle)
        if self._measured is not None or not joints.at_rest or stamp - begin < _ns(s.duration):
            return []
        end = min(stamp, joints.last)
        if all(len(w.samples) >= s.samples and end - w.last <= w.gap for w in self._targets):
            start = max(begin, *(w.settled(_ns(s.settle)) for w in self._targets))
            if end - start >= _ns(s.duration):
                standstill = self._average(start, end, s.samples, self._targets)
                if standstill is not None and (standstill.samples >= s.samples).all():
                    return self._take(standstill)
        if end - begin < _ns(s.patience) or self._complained:
            return []
        return self._what_there_is(begin, end, self._targets)

    def _ended(self) -> list[Standstill | Rejection]:
        """The joints moved on: the standstill's result, if it was long enough to be one."""
        settle = _ns(self.settings.settle)
        begin, end = self._joints.since + settle, self._joints.last
        brief = end - begin < _ns(self.settings.duration) // 2
        if self._measured is not None or not self._joints.at_rest or brief:
            return []
        windows = [w.until_it_left(end - settle) for w in self._targets]
        return self._what_there_is(begin, end, windows)

    def _what_there_is(self, begin: int, end: int, windows: Sequence[RestWindow]) -> list[Standstill | Rejection]:
        """The result from ``begin`` to ``end`` [ns], if there are few points only; else a rejection, once."""
        least, settle = self.settings.minimum_samples, _ns(self.settings.settle)
        used = [w for w in windows if len(w.samples) >= least]
        if used:
            first = max(begin, *(w.settled(settle) for w in used))
            last = min([end, *(w.last for w in used if w.left)])
            standstill = self._average(first, last, least, windows)
            if standstill is not None and 2 * (last - first) >= _ns(self.settings.duration):
                return self._take(standstill)
        if self._complained:
            return []
        self._complained = True
        return [self._rejection(begin, end, *self._why(begin, end))]

    def _take(self, standstill: Standstill) -> list[Standstill | Rejection]:
        self._measured = standstill.joints
        self._measured_since = self._joints.since
        self._joints.clear()
        return [standstill]

    def _average(self, start: int, end: int, least: int, windows: Sequence[RestWindow]) -> Standstill | None:
        """Means over [start, end] of the targets with at least ``least`` samples; None if there are none."""
        points = np.full((self.target_count, 3), np.nan)
        std = np.full(self.target_count, np.nan)
        samples = np.zeros(self.target_count, np.int64)
        for k, window in enumerate(windows):
            rows = window.between(start, end)
            if len(rows) < least:
                continue
            points[k], samples[k] = rows.mean(axis=0), len(rows)
            if len(rows) > 1:
                std[k] = np.sqrt(rows.var(axis=0, ddof=1).mean() / len(rows))
        if start > end or not samples.any():
            return None
        return Standstill(start, end, *map(frozen, (self._joints.mean(start, end), points, std, samples)))

    def _why(self, begin: int, end: int) -> tuple[RejectionReason, str]:
        lost = [str(k + 1) for k, loss in enumerate(self._losses) if loss.seen]
        if lost:
            text = f"the tracker said that it had lost target {listed(lost)}"
            return RejectionReason.TARGET_LOST, f"{text}: clear the line of sight and lock on"
        moved = [w.moved_by for w in self._targets]
        if max(moved) > 0:
            k = int(np.argmax(moved))
            text = f"target {k + 1} moved by {length(moved[k])} while the joints stood still"
            return RejectionReason.MOVED, f"{text}: wait until nothing vibrates, or raise point_tolerance"
        if self._saw_nan:
            return RejectionReason.NOT_FINITE, "values are not finite: check line of sight and the drivers"
        if end - begin < _ns(min(self.settings.duration, self.settings.patience)):
            return (
                RejectionReason.MOVED,
                f"the robot moved on {(end - begin) / NANO:.2f} s after settling: dwell longer",
            )
        behind = next((k for k in range(self.joint_count, len(self._nan_in_a_row)) if self._lags(k)), None)
        if behind is not None:
            return RejectionReason.TIME_SKEW, self._lag_text(behind)
        s, most = self.settings, max(len(w.between(begin, end)) for w in self._targets)
        text = f"{most} points in {(end - begin) / NANO:.2f} s without a pause over {s.gap:g} s"
        text += f", at least {s.minimum_samples} needed"
        return (
            RejectionReason.TOO_FEW_SAMPLES,
            f"{text}: check the tracker, its topic and its rate, or dwell longer",
        )

    def _rejection(self, start: int, end: int, reason: RejectionReason, message: str) -> Rejection:
        samples = np.array([len(w.between(start, end)) if w.samples else 0 for w in self._targets])
        return Rejection(start, end, reason, message, frozen(self._joints.newest), frozen(samples))


@dataclass
class TargetLoss:
    """What the tracker says of a target.

    Attributes:
        now: Whether it is lost.
        seen: Whether it was, at the same rest of the joints.
        until: Stamp of the newest point that came while it was lost [ns].
    """

    now: bool = False
    seen: bool = False
    until: int = -(2**63)

    def takes(self, stamp: int, window: int) -> bool:
        """Whether a point with this stamp [ns] is one of a lost target, ``window`` [ns] before such a one."""
        self.until = stamp if self.now else self.until
        return self.now or 0 <= self.until - stamp <= window


def _ns(seconds: float) -> int:
    return round(seconds * NANO)


# ── How uncertain the mean points of standstills are ────────────────────────────────────────────────────────
# A mean of n samples has σ/√n, with one σ for all standstills: given, or pooled over their scatter, since that of
# a single standstill of twenty samples is known to 10 % only. What averaging does not reduce (the robot's
# repeatability, how the reflector sits) is added in squares.


def mean_std(
    standstills: Sequence[Standstill], sigma: float = 0.0, repeatability: float = 0.0
) -> FloatArray | None:
    """(N, T, 3) standard deviation of each coordinate of the mean points [m], NaN where a target was not seen.

    Args:
        standstills: N standstills of T targets, at least one.
        sigma: Standard deviation of one coordinate of one sample [m]; 0: from the samples' scatter.
        repeatability: Standard deviation that averaging does not reduce [m].

    Returns:
        ``None`` where it is not known: no scatter, or a single sample each.
    """
    samples = np.array([f.samples for f in standstills])
    sigma = sigma or scatter(standstills)
    with np.errstate(divide="ignore"):
        std = np.sqrt(sigma**2 / samples + repeatability**2)
    std = np.repeat(np.where(samples > 0, std, np.nan)[:, :, None], 3, axis=2)
    return std if bool((std[samples > 0] > 0).all()) else None


def scatter(standstills: Sequence[Standstill]) -> float:
    """Standard deviation of one coordinate of one sample [m], pooled; NaN free, 0 if unknown."""
    freedom = np.array([np.maximum(f.samples - 1, 0) for f in standstills])
    variance = np.array([f.std**2 * f.samples for f in standstills])
    total = float(freedom.sum())
    return float(np.sqrt(np.nansum(freedom * variance) / total)) if total else 0.0
