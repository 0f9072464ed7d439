# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Joints in parts, a rail and an arm: a standstill that is long enough is accepted, and a motion is not.

As ``test_standstill_rates.py``, whose lever now stands on a rail: the rail and the arm have messages of their
own, at rates from 5 Hz to 1 kHz that have nothing to do with one another, and arrive late each in its own way. At
a stop both may have moved, or only one of them. Long enough is what is so for the slower part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from robots import repeats
from test_standstill_rates import ENCODER, JITTER, LEVER, MOVE, SIGMA, Case, angle, stops_of

from calib_planner.acquisition import (
    NANO,
    Rejection,
    RejectionReason,
    Standstill,
    StandstillDetector,
    StandstillSettings,
)
from calib_planner.errors import InputError

RAIL, ARM, POINT = 0, 1, 2
Results = list[Standstill | Rejection]


@dataclass(frozen=True)
class Parts(Case):
    """``joint_rate`` and ``joint_delay`` are those of the rail; see ``Case``."""

    arm_rate: float = 100.0
    arm_delay: float = 0.0

    def name(self) -> str:
        return f"{self.joint_rate:.0f}-{self.arm_rate:.0f}-{self.point_rate:.0f}-Hz"

    @property
    def enough(self) -> float:
        """Dwell of a standstill that has to be accepted [s]."""
        slower = min(self.joint_rate, self.arm_rate)
        return Case(slower, self.point_rate, 0.0, 0.0, self.seed).enough

    @property
    def streams(self) -> tuple[tuple[float, float], ...]:
        """Rate [Hz] and delay [s] of every stream."""
        arm = self.arm_rate, self.arm_delay
        return (self.joint_rate, self.joint_delay), arm, (self.point_rate, self.point_delay)


def cases(count: int) -> list[Parts]:
    made = []
    for seed in range(count):
        rng = np.random.default_rng([6, seed])
        rail, arm, point = np.exp(rng.uniform(np.log(5.0), np.log(1000.0), 3)).tolist()
        delays = rng.uniform(0.0, 0.3, 3).tolist()
        made.append(Parts(rail, point, delays[0], delays[2], seed, arm, delays[1]))
    return made


CASES = repeats(cases(9), cases(150))


def place(q: np.ndarray) -> np.ndarray:
    """(n, 3) points [m] of (n, 2) joints [m, rad]."""
    return LEVER * np.column_stack([np.cos(q[:, 1]), np.sin(q[:, 1]), 0 * q[:, 1]]) + q[:, :1] * np.eye(3)[2]


def run(case: Parts, length: float, where: dict[int, object]) -> Results:
    """What comes of ``length`` [s]; ``where`` gives the (n, 2) joints at times (n,), for every stream."""
    rng, sent = np.random.default_rng([case.seed, 1]), []
    for stream, (rate, delay) in enumerate(case.streams):
        n = int(length * rate)
        times = (np.arange(n) + rng.uniform(0.0, 1.0) + rng.uniform(0.0, JITTER, n)) / rate
        q = where[stream](times)  # type: ignore[operator]
        noisy = q + rng.normal(0.0, ENCODER, (n, 2))
        values = place(q) + rng.normal(0.0, SIGMA, (n, 3)) if stream == POINT else noisy[:, stream : stream + 1]
        arrivals = times + delay + rng.uniform(0.0, 0.09, n)
        sent += [(a, round(t * NANO), stream, v) for a, t, v in zip(arrivals, times, values, strict=True)]
    detector, results = StandstillDetector(2, 1, case.settings), []
    for _, stamp, stream, value in sorted(sent, key=lambda m: m[0]):
        if stream == POINT:
            results += detector.add_point(0, stamp, value)
        else:
            results += detector.add_joints(stamp, value, (stream,))
    return results + detector.flush()


@pytest.mark.parametrize("case", CASES, ids=Parts.name)
def test_every_standstill_of_both_parts_that_is_long_enough_is_accepted_and_nothing_else(case: Parts) -> None:
    ends, stops = stops_of(case)
    rng = np.random.default_rng([case.seed, 4])
    moves = np.array([[True, False], [False, True], [True, True]])[rng.integers(3, size=len(stops) - 1)]
    steps = np.diff(stops)[:, None] * moves
    both = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])

    def where(times: np.ndarray) -> np.ndarray:
        return np.column_stack([angle(times, ends, column) for column in both.T])

    found = run(case, float(ends[-1]), dict.fromkeys((RAIL, ARM, POINT), where))
    assert not any(isinstance(r, Rejection) for r in found), [getattr(r, "message", "") for r in found]
    assert len(found) == len(stops)
    begins = np.concatenate([[0.0], ends[:-1] + MOVE])
    for result, q, begin, end in zip(found, both, begins, ends, strict=True):
        assert isinstance(result, Standstill)
        # The ends of a motion are within the tolerance, a tenth of it at most.
        assert begin - 0.1 * MOVE <= result.start / NANO and result.end / NANO <= end + 0.1 * MOVE
        np.testing.assert_allclose(result.joints, q, atol=1e-4)
        assert np.linalg.norm(result.points[0] - place(q[None])[0]) < 2e-4


@pytest.mark.parametrize("frozen", [(), (RAIL,), (ARM,), (POINT,), (RAIL, ARM), (RAIL, POINT), (ARM, POINT)])
@pytest.mark.parametrize("case", repeats(CASES[::4], CASES[::3]), ids=Parts.name)
def test_a_motion_is_never_accepted(case: Parts, frozen: tuple[int, ...]) -> None:
    """As far as one stream says so: the others may be frozen, and none of them is believed."""
    speed = float(np.exp(np.random.default_rng([case.seed, 3]).uniform(np.log(0.02), np.log(2.0))))
    moving, still = (lambda t: np.column_stack([speed * t, speed * t])), (lambda t: np.zeros((len(t), 2)))
    found = run(case, 5.0, {k: still if k in frozen else moving for k in (RAIL, ARM, POINT)})
    assert not any(isinstance(r, Standstill) for r in found)
    assert bool(found) == (frozen == (RAIL, ARM))  # the robot stood, and no measurement came of it: that is told


# ── what parts there are ─────────────────────────────────────────────────────────────────────────────


def standing(detector: StandstillDetector, seconds: float, begin: float = 0.0, **rates: int) -> Results:
    """Three joints at 1, 2, 3 and a point at rest from ``begin`` on; ``rates`` of joints a, b and c [Hz]."""
    results, sent = [], []
    for letters, rate in ({"p": 50} | rates).items():
        sent += [(begin + (k + 0.01 * len(letters)) / rate, letters) for k in range(int(seconds * rate))]
    for time, letters in sorted(sent):
        stamp = round(time * NANO)
        if letters == "p":
            results += detector.add_point(0, stamp, np.ones(3))
            continue
        columns = tuple("abc".index(letter) for letter in letters)
        values = np.array([1.0, 2.0, 3.0])[list(columns)]
        results += detector.add_joints(stamp, values, None if len(columns) == 3 else columns)
    return results


@pytest.mark.parametrize(
    "rates",
    [
        {"abc": 100},
        {"a": 10, "bc": 100},
        {"ab": 30, "c": 100},
        {"a": 7, "b": 100, "c": 1000},
        {"abc": 10, "a": 100},
        {"ab": 50, "bc": 50},
    ],
)
def test_joints_come_in_any_parts_also_in_some_that_overlap(rates: dict[str, int]) -> None:
    (found,) = standing(StandstillDetector(3), 2.0, **rates)
    assert isinstance(found, Standstill) and found.joints.tolist() == [1.0, 2.0, 3.0]


def test_a_part_that_was_never_heard_makes_no_standstill() -> None:
    assert standing(StandstillDetector(3), 3.0, a=100, b=100) == []


def test_a_part_that_falls_silent_ends_the_rest_and_one_that_comes_back_begins_it() -> None:
    detector = StandstillDetector(3)
    assert standing(detector, 0.25, a=100, bc=100) + standing(detector, 1.15, 0.25, a=100) == []
    (found,) = standing(detector, 1.2, 1.4, a=100, bc=100)
    assert isinstance(found, Standstill) and found.start >= 1.4 * NANO


def test_parts_may_change_and_a_place_is_measured_once_all_the_same() -> None:
    detector = StandstillDetector(3)
    assert [type(r) for r in standing(detector, 1.0, abc=100)] == [Standstill]
    assert standing(detector, 1.0, 2.0, ab=100, c=20) + standing(detector, 1.0, 4.0, abc=100) == []


def test_a_part_without_a_sample_in_the_mean_counts_with_the_nearest() -> None:
    settings = StandstillSettings(duration=0.1, settle=0.3, samples=3, minimum_samples=3, gap=2.0, skew=3.0)
    detector, results = StandstillDetector(2, 1, settings), []
    for k in range(350):
        stamp = k * NANO // 100
        if k % 50 == 0:
            column = k // 50 % 2
            results += detector.add_joints(stamp, [5.0 + column], (column,))
        results += detector.add_point(0, stamp, np.ones(3))
    assert isinstance(results[0], Standstill) and results[0].joints.tolist() == [5.0, 6.0]
    assert (results[0].start, results[0].end) == (NANO * 8 // 10, NANO)  # the second one has 0.5 and 1.5 s


def test_a_rail_that_never_moves_may_be_noisy_for_hours() -> None:
    """Over all stops its noise is beyond the tolerance, at each of them it is not."""
    settings, rng, results = StandstillSettings(joint_tolerance=1e-4), np.random.default_rng(1), []
    detector = StandstillDetector(2, 1, settings)
    for stop in range(10):
        for k in range(100):
            stamp = (stop * 120 + k) * NANO // 100
            drift = 2e-5 * stop + rng.uniform(-4e-5, 4e-5)
            results += detector.add_joints(stamp, [drift], (0,))
            results += detector.add_joints(stamp + 1000, [float(stop)], (1,))
            results += detector.add_point(0, stamp + 2000, np.full(3, float(stop)))
    results += detector.flush()
    assert [type(r) for r in results] == [Standstill] * 10


@pytest.mark.parametrize("columns", [(), (1, 0), (0, 0), (0, 3), (-1,)])
def test_columns_that_do_not_fit_are_refused(columns: tuple[int, ...]) -> None:
    with pytest.raises(InputError):
        StandstillDetector(3).add_joints(1, np.zeros(len(columns)), columns)


# ── a tracker that says that it has lost the target ──────────────────────────────────────────────────


def lost_between(begin: float, end: float, seconds: float = 3.0) -> Results:
    """A robot at rest whose target is lost from ``begin`` to ``end`` [s], as is told, with points elsewhere."""
    detector, results = StandstillDetector(1, 1), []
    for k in range(int(seconds * 100)):
        time, stamp = k / 100, k * NANO // 100
        if k in (round(begin * 100), round(end * 100)):
            detector.set_lost(0, k == round(begin * 100))
        results += detector.add_joints(stamp, [0.0])
        elsewhere = begin - 0.05 <= time < end  # the first of them overtook what the tracker said
        results += detector.add_point(0, stamp, np.full(3, 7.0 if elsewhere else 1.0))
    return results + detector.flush()


def test_points_of_a_lost_target_do_not_count() -> None:
    found = lost_between(0.3, 1.0)
    assert [type(r) for r in found] == [Standstill]
    assert isinstance(found[0], Standstill) and found[0].start >= NANO and (found[0].points == 1.0).all()


def test_the_reason_is_that_the_target_was_lost() -> None:
    (found,) = lost_between(0.12, 9.0)
    assert isinstance(found, Rejection) and found.reason is RejectionReason.TARGET_LOST
    assert "lost target 1" in found.message


def test_what_was_lost_at_the_stop_before_is_not_the_reason_at_this_one() -> None:
    detector, results = StandstillDetector(1, 1), []
    for stop in range(2):
        detector.set_lost(0, stop == 0)
        for k in range(300):
            stamp = (stop * 350 + k) * NANO // 100
            results += detector.add_joints(stamp, [float(stop)])
            if k % 100 == 0:
                results += detector.add_point(0, stamp, np.ones(3))
    results += detector.flush()
    reasons = [r.reason for r in results if isinstance(r, Rejection)]
    assert reasons == [RejectionReason.TARGET_LOST, RejectionReason.TOO_FEW_SAMPLES]


def test_a_clock_that_is_set_back_after_a_loss_does_not_blind_the_target() -> None:
    detector = StandstillDetector(1, 1)
    detector.set_lost(0, True)
    detector.add_point(0, 10**15, np.ones(3))
    detector.set_lost(0, False)
    results = []
    for k in range(200):
        results += detector.add_joints(k * NANO // 100, [0.0])
        results += detector.add_point(0, k * NANO // 100, np.ones(3))
    assert [type(r) for r in results] == [Standstill]
