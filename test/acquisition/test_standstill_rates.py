# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A standstill that is long enough is accepted, and a motion is not, whatever the rates, delays and dwells.

The messages of a lever of 2 m are computed: it rests at stops for times that differ, and moves smoothly between.
Both streams have rates from 5 Hz to 1 kHz, their samples are irregular and noisy, and messages arrive late and in
another order within the window of a stream. How long is long enough follows from the settings. With the longest
pauses P of the joints and p of the points, the joints are seen at rest for the dwell less 2P, and the points come
to rest at most p later than the joints. What remains after ``settle`` has to be ``duration`` long and to hold
``minimum_samples``.

``settle`` is 0.05 s at least: the smooth motion (10 τ³ at its beginning, τ = time / 0.3 s) needs some 0.02 s to
pass the tolerance of the joints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from calib_planner.acquisition import (
    NANO,
    Rejection,
    RejectionReason,
    Standstill,
    StandstillDetector,
    StandstillSettings,
)

Messages = list[tuple[int, int, np.ndarray]]
LEVER = 2.0
SIGMA = 3e-5
ENCODER = 5e-6
MOVE = 0.3
JITTER = 0.1
"""How late a sample may be, as part of its period."""


@dataclass(frozen=True)
class Case:
    """Rates [Hz], delays of arrival [s], and the seed of everything else."""

    joint_rate: float
    point_rate: float
    joint_delay: float
    point_delay: float
    seed: int

    def name(self) -> str:
        return f"{self.joint_rate:.0f}-{self.point_rate:.0f}-Hz"

    @property
    def settings(self) -> StandstillSettings:
        rng = np.random.default_rng(self.seed)
        few = int(rng.integers(2, 8))
        return StandstillSettings(
            samples=few + int(rng.integers(0, 30)),
            minimum_samples=few,
            settle=float(rng.uniform(0.05, 0.2)),
            duration=float(rng.uniform(0.2, 0.6)),
            patience=float(rng.uniform(2.5, 4.0)),  # at 5 Hz 8 samples take 1.8 s, settling is 0.4 s at most
            window=0.1,
        )

    @property
    def enough(self) -> float:
        """Dwell of a standstill that has to be accepted [s]."""
        s, longest = self.settings, [(1 + JITTER) / rate for rate in (self.joint_rate, self.point_rate)]
        counted = max(s.duration, (s.minimum_samples + 1) * longest[1])
        return 2 * longest[0] + longest[1] + s.settle + counted


def cases(count: int) -> list[Case]:
    rng = np.random.default_rng(5)
    made = []
    for seed in range(count):
        rates = np.exp(rng.uniform(np.log(5.0), np.log(1000.0), 2))
        delays = rng.uniform(0.0, 0.3, 2)
        made.append(Case(float(rates[0]), float(rates[1]), float(delays[0]), float(delays[1]), seed))
    return made


CASES = cases(28)


def angle(times: np.ndarray, ends: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """(n,) angle [rad] at times [s]; stop k is left at ``ends[k]``, the next one reached ``MOVE`` later."""
    k = np.searchsorted(ends, times)
    before = np.maximum(k - 1, 0)
    tau = np.clip((times - ends[before]) / MOVE, 0.0, 1.0) * (k > 0)
    share = tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)
    here, there = stops[before], stops[np.minimum(k, len(stops) - 1)]
    return np.where(k > 0, here + (there - here) * share, stops[0])


def messages(case: Case, length: float, where: Callable[[np.ndarray], np.ndarray]) -> Messages:
    """(stamp, stream, value) in the order of arrival, for ``length`` [s]; ``where`` gives the angle."""
    rng = np.random.default_rng([case.seed, 1])
    out = []
    for stream, rate, delay in ((0, case.joint_rate, case.joint_delay), (1, case.point_rate, case.point_delay)):
        n = int(length * rate)
        times = (np.arange(n) + rng.uniform(0.0, 1.0) + rng.uniform(0.0, JITTER, n)) / rate
        q = where(times)
        values = (q + rng.normal(0.0, ENCODER, n))[:, None]
        if stream:
            values = LEVER * np.column_stack([np.cos(q), np.sin(q), 0 * q]) + rng.normal(0.0, SIGMA, (n, 3))
        arrivals = times + delay + rng.uniform(0.0, 0.09, n)
        out += [(a, round(t * NANO), stream, v) for a, t, v in zip(arrivals, times, values, strict=True)]
    return [m[1:] for m in sorted(out, key=lambda m: m[0])]


def results_of(settings: StandstillSettings, sent: Messages) -> list[Standstill | Rejection]:
    detector, results = StandstillDetector(1, 1, settings), []
    for stamp, stream, value in sent:
        results += detector.add_point(0, stamp, value) if stream else detector.add_joints(stamp, value)
    return results + detector.flush()


def stops_of(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """(6,) when each stop is left [s], and (6,) its angle [rad]; dwells are 1 to 1.5 times ``enough``."""
    rng = np.random.default_rng([case.seed, 2])
    stops = np.cumsum(rng.choice([-1.0, 1.0], 6) * rng.uniform(0.05, 0.8, 6))
    return np.cumsum(case.enough * rng.uniform(1.0, 1.5, 6) + MOVE) - MOVE, stops


def check(found: list[Standstill | Rejection], ends: np.ndarray, stops: np.ndarray) -> None:
    """Every standstill is one of the stops, and every stop one of the standstills."""
    begins = np.concatenate([[0.0], ends[:-1] + MOVE])
    taken = [r for r in found if isinstance(r, Standstill)]
    assert len(taken) == len(stops), [getattr(r, "message", "") for r in found]
    for result, stop, begin, end in zip(taken, stops, begins, ends, strict=True):
        # The ends of a motion are within the tolerance, a tenth of it at most.
        assert begin - 0.1 * MOVE <= result.start / NANO and result.end / NANO <= end + 0.1 * MOVE
        assert abs(result.joints[0] - stop) < 1e-4
        assert np.linalg.norm(result.points[0] - LEVER * np.array([np.cos(stop), np.sin(stop), 0.0])) < 2e-4


@pytest.mark.parametrize("case", CASES, ids=Case.name)
def test_every_standstill_that_is_long_enough_is_accepted_and_nothing_else(case: Case) -> None:
    ends, stops = stops_of(case)
    found = results_of(case.settings, messages(case, ends[-1], lambda t: angle(t, ends, stops)))
    assert not any(isinstance(r, Rejection) for r in found), found
    check(found, ends, stops)


def test_one_that_needs_more_patience_is_told_and_accepted_all_the_same() -> None:
    case = Case(100.0, 6.0, 0.1, 0.0, 3)
    ends, stops = stops_of(case)
    settings = replace(case.settings, patience=0.3)
    found = results_of(settings, messages(case, ends[-1], lambda t: angle(t, ends, stops)))
    check(found, ends, stops)
    told = [r.reason for r in found if isinstance(r, Rejection)]
    assert told == [RejectionReason.TOO_FEW_SAMPLES] * 6


@pytest.mark.parametrize("still", ["nothing", "joints", "points"])
@pytest.mark.parametrize("case", CASES[::4], ids=Case.name)
def test_a_motion_is_never_accepted(case: Case, still: str) -> None:
    """In half of ``duration`` at least, both streams leave their tolerance: 0.1 s at 0.02 rad/s and 40 mm/s."""
    speed = float(np.exp(np.random.default_rng([case.seed, 3]).uniform(np.log(0.02), np.log(2.0))))
    sent = messages(case, 5.0, lambda t: speed * t)
    if still == "joints":
        sent = [(t, k, v if k else 0 * v) for t, k, v in sent]
    elif still == "points":
        sent = [(t, k, 0 * v if k else v) for t, k, v in sent]
    found = results_of(case.settings, sent)
    assert not any(isinstance(r, Standstill) for r in found)
    assert bool(found) == (still == "joints")  # the robot stood, and no measurement came of it: that is told


def test_a_point_between_the_last_joints_at_rest_and_the_first_that_move_belongs_to_the_motion() -> None:
    """Joints at 10 Hz: a motion begins right after a joint state; nine points of it come before the next."""
    settings = StandstillSettings(samples=200)
    joints = [(i * NANO // 10, 0, np.array([0.0 if i <= 10 else 0.5])) for i in range(13)]
    points = [(i * NANO // 100 + 1, 1, np.array([max(i - 100, 0) * 0.01, 0.0, 0.0])) for i in range(121)]
    found = results_of(settings, sorted(joints + points, key=lambda m: m[0]))
    assert [type(r) for r in found] == [Standstill]
    assert found[0].end == NANO and (found[0].points == 0.0).all()  # type: ignore[union-attr]
