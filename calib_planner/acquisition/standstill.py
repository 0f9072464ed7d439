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

The tolerance on points has to be several times the tracker's noise: with σ = 0.03 mm the range of a thousand
samples is about 6.5σ = 0.2 mm. Nothing here knows ROS; messages from a bag do as well as live ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import takewhile

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.acquisition.clocks import NANO, ClockOffsets
from calib_planner.acquisition.stamps import StampOrder
from calib_planner.arrays import FloatArray, IntArray, check_array, check_count, check_ranges, frozen, ranged
from calib_planner.errors import InputError
from calib_planner.units import length, milliseconds

MOST_SAMPLES = 20_000
"""Samples of one stream that a standstill holds at most."""
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


REJECTIONS = {
    RejectionReason.MOVED.value: "The robot or a target moved. Wait until it stands still, measure again.",
    RejectionReason.TOO_FEW_SAMPLES.value: "The standstill was too short. Dwell longer, or raise the rate.",
    RejectionReason.TIME_SKEW.value: "The stamps of joints and tracker do not overlap. Synchronise the clocks.",
    RejectionReason.OTHER_FRAME.value: "Points came in another frame_id than before. Publish all in one frame.",
    RejectionReason.NOT_FINITE.value: "Values are not finite. Check line of sight and the drivers.",
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
        self._order: StampOrder[FloatArray] = StampOrder(1 + targets, _ns(s.window), _ns(s.skew))
        horizon, gap = _ns(s.settle + max(s.patience, s.duration) + s.gap), _ns(s.gap)
        self._joints = RestWindow(s.joint_tolerance, gap, _ns(s.settle), horizon)
        self._targets = [RestWindow(s.point_tolerance, gap, _ns(s.settle), horizon) for _ in range(targets)]
        self.clocks = ClockOffsets(targets, _ns(s.skew), _ns(s.duration) // 2)
        self._measured: FloatArray | None = None
        self._rest = (0, 0)  # stamps of the rest in which something was measured, so far
        self._joints_until: int | None = None  # last stamp of the joints in order
        self._waiting: deque[tuple[int, int, FloatArray]] = deque()  # (target, stamp, point) after it
        self._complained = False
        self._saw_nan = False
        self._nan_in_a_row = [0] * (1 + targets)
        self._complained_at = [-(2**63)] * (1 + targets)  # about a stream, stamps [ns]

    def add_joints(self, stamp: int, positions: ArrayLike) -> list[Standstill | Rejection]:
        """Take joint positions (joints,) [rad | m] with their stamp [ns]; NaN = unusable."""
        meaning = "joint positions in rad or m"
        shape = (self.joint_count,)
        return self._add(0, stamp, check_array("positions", positions, shape, finite=False, meaning=meaning))

    def add_point(self, target: int, stamp: int, xyz: ArrayLike) -> list[Standstill | Rejection]:
        """Take a point (3,) [m] of target number ``target``, from 0; NaN = not seen."""
        if not 0 <= target < self.target_count:
            raise InputError("target", target, f"0 to {self.target_count - 1}")
        return self._add(1 + target, stamp, check_array("xyz", xyz, (3,), finite=False))

    def flush(self) -> list[Standstill | Rejection]:
        """Take what still waits, and the last standstill as ended: the end of a recording."""
        results = self._process(everything=True) + self._ended()
        self.clocks.clear()
        self._waiting.clear()
        self._joints.samples.clear()
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

    @property
    def dropped(self) -> tuple[int, ...]:
        """Finite messages that took no part, joints first, then each target: too late, twice or set back."""
        return tuple(self._order.dropped(k) for k in range(1 + self.target_count))

    # ── from messages to events in order ─────────────────────────────────────────────────────────────

    def _add(self, stream: int, stamp: int, value: FloatArray) -> list[Standstill | Rejection]:
        stamp = int(stamp)
        if not np.isfinite(value).all():
            self._saw_nan = True
            self._nan_in_a_row[stream] += 1
            text = f"{self._nan_in_a_row[stream]} messages in a row from {_name(stream)} are not finite"
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

    def _lags(self, stream: int) -> bool:
        """Whether a stream lies so far behind the others that it takes no part."""
        return self._order.late(stream) >= IN_A_ROW

    def _lag_text(self, stream: int) -> str:
        text = f"stamps from {_name(stream)} lie {self._order.lag(stream) / NANO:.3g} s behind the others"
        return f"{text}: synchronise the clocks, or raise skew if its messages take that long"

    def _process(self, *, everything: bool = False) -> list[Standstill | Rejection]:
        results: list[Standstill | Rejection] = []
        for stamp, stream, value in self._order.ready(everything=everything):
            if stream:
                self._waiting.append((stream - 1, stamp, value))
                results += self._on_silence(stamp)
            else:
                results += self._on_joints(stamp, value)
                self._on_points()
            results += self._complete(stamp)
        return results

    def _on_joints(self, stamp: int, value: FloatArray) -> list[Standstill | Rejection]:
        joints, results = self._joints, []
        self._joints_until = stamp
        if self._measured is not None:
            if np.max(np.abs(value - self._measured)) <= joints.tolerance:
                self._rest = (self._rest[0], stamp)
                return []
            self.clocks.add_joints(*self._rest)
            self._measured = None
            joints.samples.clear()
        elif joints.samples and not joints.goes_on(stamp, value) and not joints.begin_later(stamp, value):
            results = self._moved_on()
        if not joints.samples:
            self._complained = self._saw_nan = False
            for window in self._targets:
                window.moved_by, window.before = 0.0, None
        joints.push(stamp, value)
        return results

    def _moved_on(self) -> list[Standstill | Rejection]:
        """The joints' rest has ended without a result so far."""
        rest = self._joints.since, self._joints.last
        results = self._ended()
        if self._measured is None:
            self.clocks.add_joints(*rest)
            self._joints.samples.clear()
        return results

    def _on_silence(self, stamp: int) -> list[Standstill | Rejection]:
        """Let the points in without a joint state, if the joints' last one is a gap before ``stamp`` [ns]."""
        until, gap = self._joints_until, self._joints.gap
        if until is not None and 0 <= stamp - until <= gap and len(self._waiting) < MOST_SAMPLES:
            return []
        over = self._measured is None and self._joints.samples and stamp - self._joints.last > gap
        results = self._moved_on() if over else []
        self._on_points()
        return results

    def _on_points(self) -> None:
        """Take the points that waited."""
        while self._waiting:
            self._on_point(*self._waiting.popleft())

    def _on_point(self, target: int, stamp: int, value: FloatArray) -> None:
        window, begin = self._targets[target], self._joints.since + _ns(self.settings.settle)
        at_rest = self._joints.samples and self._measured is None and window.last >= begin
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
        if self._measured is not None or not joints.samples or stamp - begin < _ns(s.duration):
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
        if self._measured is not None or not self._joints.samples or brief:
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
        self._rest = (self._joints.since, self._joints.last)
        self._joints.samples.clear()
        return [standstill]

    def _average(self, start: int, end: int, least: int, windows: Sequence[RestWindow]) -> Standstill | None:
        """Means over [start, end] of the targets with at least ``least`` samples; None if there are none."""
        q = self._joints.between(start, end)
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
        if not len(q) or not samples.any():
            return None
        return Standstill(start, end, *map(frozen, (q.mean(axis=0), points, std, samples)))

    def _why(self, begin: int, end: int) -> tuple[RejectionReason, str]:
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
        behind = next((k for k in range(1, 1 + self.target_count) if self._lags(k)), None)
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
        last = self._joints.samples[-1][1] if self._joints.samples else np.full(self.joint_count, np.nan)
        samples = np.array([len(w.between(start, end)) if w.samples else 0 for w in self._targets])
        return Rejection(start, end, reason, message, frozen(last), frozen(samples))


def _name(stream: int) -> str:
    return f"target {stream}" if stream else "the joints"


def _ns(seconds: float) -> int:
    return round(seconds * NANO)


# ── The samples of one stream since it came to rest; one that breaks the rest begins a new one ──────────────


@dataclass
class RestWindow:
    """See the module.

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
