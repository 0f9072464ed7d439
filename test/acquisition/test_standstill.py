# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The standstill detector against streams whose standstills are known."""

from __future__ import annotations

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
from calib_planner.errors import InputError

SIGMA = 3e-5
MESSAGE = tuple[int, int, np.ndarray]


def place(t: float, stops: list[float], move: float = 0.5, dwell: float = 1.0) -> float:
    """Joint 1 at time ``t`` [s]: rests ``dwell`` at each stop, then moves smoothly for ``move``."""
    k, phase = divmod(t, move + dwell)
    here = stops[min(int(k), len(stops) - 1)]
    there = stops[min(int(k) + 1, len(stops) - 1)]
    s = np.clip((phase - dwell) / move, 0.0, 1.0)
    return here + (there - here) * (10 * s**3 - 15 * s**4 + 6 * s**5)


def stream(
    stops: list[float],
    seed: int = 0,
    offset: float = 0.0,
    joint_rate: int = 100,
    point_rate: int = 50,
    targets: int = 1,
    **motion: float,
) -> list[MESSAGE]:
    """(stamp, stream, value) of two joints and points 1 m · joint 1 along x, in stamp order.

    ``offset`` is added to the stamps of the points [s].
    """
    rng = np.random.default_rng(seed)
    end = len(stops) * (motion.get("move", 0.5) + motion.get("dwell", 1.0))
    out: list[MESSAGE] = []
    for i in range(int(end * joint_rate)):
        q = place(i / joint_rate, stops, **motion)
        out.append((i * NANO // joint_rate, 0, np.array([q, -q])))
    for k in range(targets):
        for i in range(int(end * point_rate)):
            t = (i + 0.3) / point_rate
            p = np.array([place(t, stops, **motion), 0.1 * k, 1.0]) + SIGMA * rng.standard_normal(3)
            out.append((round((t + offset) * NANO), 1 + k, p))
    return sorted(out, key=lambda m: m[0])


def feed(
    detector: StandstillDetector, messages: list[MESSAGE], flush: bool = True
) -> list[Standstill | Rejection]:
    results = []
    for stamp, number, value in messages:
        results += detector.add_point(number - 1, stamp, value) if number else detector.add_joints(stamp, value)
    return results + (detector.flush() if flush else [])


def check_stops(results: list[Standstill | Rejection], stops: list[float]) -> None:
    assert [type(r) for r in results] == [Standstill] * len(stops), results
    for found, stop in zip(results, stops, strict=True):
        assert isinstance(found, Standstill)
        assert np.allclose(found.joints, [stop, -stop], atol=1e-4)
        assert np.allclose(found.points[:, 0], stop, atol=5 * SIGMA / np.sqrt(20))


STOPS = [0.0, 0.4, -0.3, 0.4]


def test_one_result_per_standstill_and_honest_std() -> None:
    results = feed(StandstillDetector(2), stream(STOPS))
    check_stops(results, STOPS)
    for found in results:
        assert isinstance(found, Standstill)
        assert found.samples[0] >= 20 and 0.4 <= found.duration < 0.5
        assert found.std[0] == pytest.approx(SIGMA / np.sqrt(found.samples[0]), rel=0.4)
        assert found.start < found.stamp < found.end


def test_results_are_immutable() -> None:
    found = feed(StandstillDetector(2), stream([0.0]))[0]
    with pytest.raises(ValueError):
        found.joints[0] = 1.0
    with pytest.raises(AttributeError):
        found.start = 0  # type: ignore[misc]


def test_the_first_moments_are_left_out() -> None:
    settings = StandstillSettings(settle=0.3)
    results = feed(StandstillDetector(2, 1, settings), stream([0.0, 1.0], dwell=1.5))
    assert results[1].start >= (2.0 - 0.05 + 0.3) * NANO


def test_disorder_and_duplicates_change_nothing() -> None:
    messages = stream(STOPS)
    rng = np.random.default_rng(1)
    late = sorted(messages + messages[::3], key=lambda m: m[0] + rng.uniform(0, 0.08) * NANO)
    plain = feed(StandstillDetector(2), messages)
    mixed = feed(StandstillDetector(2), late)
    assert len(plain) == len(mixed)
    for a, b in zip(plain, mixed, strict=True):
        assert (a.start, a.end) == (b.start, b.end)
        assert isinstance(a, Standstill) and isinstance(b, Standstill)
        assert np.array_equal(a.points, b.points) and np.array_equal(a.joints, b.joints)


def test_late_beyond_the_window_is_dropped() -> None:
    messages = [m for m in stream([0.0]) if m[1] or m[0] != NANO // 2]
    lost = (NANO // 2, 0, np.array([9.0, 9.0]))  # would break the rest
    at = next(i for i, m in enumerate(messages) if m[0] > 0.8 * NANO)
    check_stops(feed(StandstillDetector(2), [*messages[:at], lost, *messages[at:]]), [0.0])


@pytest.mark.parametrize("rates", [(10, 50), (100, 10), (1000, 1000), (30, 30)])
def test_any_rates(rates: tuple[int, int]) -> None:
    settings = StandstillSettings(samples=10)
    messages = stream([0.0, 0.5], joint_rate=rates[0], point_rate=rates[1], dwell=1.5)
    check_stops(feed(StandstillDetector(2, 1, settings), messages), [0.0, 0.5])


def test_live_result_comes_before_the_robot_moves_on() -> None:
    messages = [m for m in stream([0.0]) if m[0] < 0.9 * NANO]
    assert len(feed(StandstillDetector(2), messages, flush=False)) == 1


def test_a_long_rest_gives_one_result() -> None:
    check_stops(feed(StandstillDetector(2), stream([0.0], dwell=20.0)), [0.0])


def test_slow_motion_is_no_standstill() -> None:
    messages = [(i * NANO // 100, k, np.full(3 if k else 2, 5e-4 * i / 100)) for i in range(1000) for k in (0, 1)]
    assert not any(isinstance(r, Standstill) for r in feed(StandstillDetector(2), messages))


def test_short_pauses_are_no_standstill() -> None:
    messages = [m for m in stream(STOPS, dwell=0.15) if m[0] < 1.9 * NANO]  # not the rest at the end
    assert feed(StandstillDetector(2), messages) == []


def one_rejection(results: list[Standstill | Rejection], reason: RejectionReason) -> Rejection:
    assert len(results) == 1 and isinstance(results[0], Rejection), results
    assert results[0].reason is reason and results[0].message
    return results[0]


def test_moving_target_while_joints_rest() -> None:
    shaken = [(t, k, v + np.array([1e-3 * np.sin(20e-9 * t), 0, 0]) if k else v) for t, k, v in stream([0.0])]
    found = one_rejection(feed(StandstillDetector(2), shaken), RejectionReason.MOVED)
    assert "target 1 moved" in found.message


def test_vibration_that_dies_out_is_waited_for() -> None:
    messages = [
        (t, k, v + 2e-3 * np.exp(-t / 1e8) * np.sin(60e-9 * t) * np.eye(3)[0] if k else v)
        for t, k, v in stream([0.0], dwell=1.5)
    ]
    check_stops(feed(StandstillDetector(2), messages), [0.0])


def test_no_tracker() -> None:
    joints = [m for m in stream([0.0, 0.5]) if m[1] == 0]
    results = feed(StandstillDetector(2), joints)
    assert [r.reason for r in results if isinstance(r, Rejection)] == [RejectionReason.TOO_FEW_SAMPLES] * 2


def test_robot_moves_on_too_soon() -> None:
    settings = StandstillSettings(samples=40, minimum_samples=30, duration=0.8)
    results = feed(StandstillDetector(2, 1, settings), stream([0.0, 0.5, 0.0], dwell=0.6))
    assert len(results) == 3
    one_rejection(results[:1], RejectionReason.MOVED)


def test_patience_takes_the_targets_that_are_seen() -> None:
    settings = StandstillSettings(patience=0.8)
    messages = [m for m in stream([0.0], dwell=2.0, targets=2) if m[1] != 2]
    (found,) = feed(StandstillDetector(2, 2, settings), messages)
    assert isinstance(found, Standstill)
    assert found.samples.tolist()[1] == 0 and np.isnan(found.points[1]).all() and found.samples[0] >= 20


def test_two_targets() -> None:
    check_stops(feed(StandstillDetector(2, 2), stream(STOPS, targets=2)), STOPS)


@pytest.mark.parametrize("offset", [10.0, -10.0, 3600.0])
def test_clock_skew_is_reported(offset: float) -> None:
    messages = stream(STOPS, offset=offset)
    live = sorted(messages, key=lambda m: m[0] - (offset * NANO if m[1] else 0))
    results = feed(StandstillDetector(2), live)
    assert not any(isinstance(r, Standstill) for r in results)
    assert results[0].reason is RejectionReason.TIME_SKEW  # type: ignore[union-attr]


@pytest.mark.parametrize("offset", [2.0, -2.0])
def test_clock_skew_is_said_again_and_again_but_not_each_time(offset: float) -> None:
    messages = stream([*STOPS, *STOPS], offset=offset)
    live = sorted(messages, key=lambda m: m[0] - (offset * NANO if m[1] else 0))
    results = [r for r in feed(StandstillDetector(2), live, flush=False) if isinstance(r, Rejection)]
    skew = [r for r in results if r.reason is RejectionReason.TIME_SKEW and r.start == r.end]
    assert 4 <= len(skew) <= 6  # 12 s, and every 2 s after half a second or a whole one
    assert all("behind the others" in r.message for r in skew)
    # A standstill without points does not send anybody to look for the tracker.
    assert all(r.reason is RejectionReason.TIME_SKEW for r in results[1:])


def test_nan_points_are_reported_and_do_no_harm() -> None:
    blind = [(t, k, np.full(3, np.nan) if k else v) for t, k, v in stream([0.0])]
    results = feed(StandstillDetector(2), blind)
    assert {r.reason for r in results if isinstance(r, Rejection)} == {RejectionReason.NOT_FINITE}
    some = [(t, k, v * np.nan if k and i % 7 == 0 else v) for i, (t, k, v) in enumerate(stream(STOPS))]
    check_stops(feed(StandstillDetector(2), some), STOPS)


def test_nan_joints_are_reported() -> None:
    blind = [(t, k, v if k else np.full(2, np.inf)) for t, k, v in stream([0.0])]
    one_rejection(feed(StandstillDetector(2), blind), RejectionReason.NOT_FINITE)


@pytest.mark.parametrize("joint_rate", [50, 100])
def test_a_recording_played_again_shows_the_same_standstills(joint_rate: int) -> None:
    """Points that still waited for joints when the stamps began anew do not keep the later ones back."""
    detector, messages = StandstillDetector(2), stream([0.0, 0.7, -0.4], joint_rate=joint_rate)
    first, again = (feed(detector, messages, flush=False) for _ in range(2))
    assert [r.joints.tolist() for r in again] == [r.joints.tolist() for r in first] and len(first) == 3
    for one, other in zip(first, again, strict=True):
        assert isinstance(other, Standstill) and one.start <= other.end and other.start <= one.end


def test_clock_set_back_recovers() -> None:
    detector = StandstillDetector(2)
    check_stops(feed(detector, stream([0.0, 0.5])), [0.0, 0.5])
    check_stops(feed(detector, stream([0.2, 0.7])), [0.2, 0.7])


def test_one_stamp_far_in_the_future_recovers() -> None:
    messages = stream([0.0, 0.5, 0.2])
    mad = (10**18, 1, np.zeros(3))
    results = feed(StandstillDetector(2), [*messages[:100], mad, *messages[100:]])
    assert np.allclose([r.joints[0] for r in results[-2:]], [0.5, 0.2], atol=1e-4)


def test_gap_breaks_the_rest() -> None:
    messages = [m for m in stream([0.0], dwell=1.3) if not (m[1] == 0 and 0.25 < m[0] / NANO < 0.7)]
    (found,) = feed(StandstillDetector(2), messages)
    assert isinstance(found, Standstill) and found.start >= 0.7 * NANO


def test_memory_is_bounded() -> None:
    settings = StandstillSettings()
    detector = StandstillDetector(2, 1, settings)
    for i in range(30_000):
        detector.add_joints(i * 1_000_000, np.zeros(2))
    assert len(detector._joints.parts[0].window.samples) < 3000
    assert len(detector._order._heap) < 2000


@pytest.mark.parametrize(
    "values",
    [
        {"joint_tolerance": 0.0},
        {"point_tolerance": float("nan")},
        {"samples": 0},
        {"samples": 3, "minimum_samples": 4},
        {"gap": -1.0},
        {"duration": float("inf")},
        {"window": "a"},
    ],
)
def test_settings_out_of_range(values: dict) -> None:
    with pytest.raises(InputError) as caught:
        StandstillSettings(**values)
    assert caught.value.field in values


def test_wrong_shapes_are_refused() -> None:
    detector = StandstillDetector(2)
    with pytest.raises(InputError, match="positions"):
        detector.add_joints(0, [1.0])
    with pytest.raises(InputError, match="xyz"):
        detector.add_point(0, 0, [1.0, 2.0])
    with pytest.raises(InputError, match="target"):
        detector.add_point(1, 0, [0.0, 0.0, 0.0])


def test_it_tells_how_long_joints_and_points_have_stood_still() -> None:
    detector = StandstillDetector(2, 1)
    assert detector.joints_rest() == detector.points_rest(0) == 0.0
    for k in range(400):  # 2 s at rest, of which a result needs less
        detector.add_joints(k * 5_000_000, [0.0, 1.0])
        detector.add_point(0, k * 5_000_000, [1.0, 2.0, 3.0])
    assert detector.joints_rest() == pytest.approx(2.0, abs=0.2)
    assert detector.points_rest(0) == pytest.approx(2.0, abs=0.2)
    for k in range(400, 500):
        detector.add_joints(k * 5_000_000, [0.0, 1.0 + 0.01 * (k - 399)])
        detector.add_point(0, k * 5_000_000, [1.0, 2.0, 3.0 + 0.01 * (k - 399)])
        if k > 450:
            assert detector.joints_rest() < 0.02 and detector.points_rest(0) < 0.02
