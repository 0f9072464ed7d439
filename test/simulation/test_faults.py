# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Every fault does what its description says, and nothing else: messages with it beside messages without."""

from __future__ import annotations

from collections import Counter
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom, chi2

from calib_planner import Robot
from calib_planner.errors import InputError
from calib_planner.simulation import (
    NANO,
    Faults,
    Itinerary,
    Message,
    Rates,
    SimulatedCell,
    Streams,
    Tour,
    World,
    make_tour,
    play,
)
from calib_planner.tracker import LaserTracker

ROBOT = Robot.load("kuka_kr270").with_targets([[0.1, 0.02, 0.3], [-0.05, 0.2, 0.1]])
CELL = SimulatedCell(ROBOT, {"d1": 1e-3, "q2": -5e-4}, sigma=0.0)
SIGMA = 3e-5
START = 1_700_000_000 * NANO
VISITS = 8
EVERYTHING = Faults(
    transmission_error=1e-4,
    encoder_resolution=1e-5,
    unsettled_probability=0.5,
    creep=1e-4,
    reseat_at=3,
    drift_translation=1e-5,
    drift_rotation=1e-5,
    bump_at=5,
    outlier_probability=0.05,
    outlier_standstills=0.3,
    beam_break_interval=2.0,
    relock_error=1e-4,
    dropout_probability=0.1,
    tracker_latency=0.1,
    tracker_jitter=0.01,
    joint_latency=0.02,
    joint_jitter=0.01,
    tracker_clock_offset=0.2,
    tracker_clock_drift=1e-3,
    duplicate_probability=0.1,
    reorder_probability=0.1,
)


@pytest.fixture(scope="module")
def tour() -> Tour:
    low, high = ROBOT.joint_limits.T
    q = np.random.default_rng(1).uniform(low, high, (VISITS, len(low)))
    return make_tour((low + high) / 2, q, np.ones(VISITS, int), ROBOT.joint_limits, 6.0, 1.0)


def messages(tour: Tour, seed: int = 0, cell: SimulatedCell = CELL, **faults: Any) -> list[Message]:
    return list(play(World(cell, Faults(**faults), seed), tour, start=START))


def stream(heard: list[Message], k: int) -> tuple[np.ndarray, np.ndarray]:
    """Stamps [s since START] and values of one stream, in the order of the stamps, each once."""
    one = {m.stamp: m.values for m in heard if m.stream == k}
    stamps = sorted(one)
    return (np.array(stamps) - START) / NANO, np.array([one[s] for s in stamps])


def arrivals(tour: Tour, times: np.ndarray) -> np.ndarray:
    """Number of the arrival at which the robot stands at each time; −1 while it moves. By plain search."""
    rests = [p for p in tour.phases if p.measuring]
    result = np.full(len(times), -1)
    for k, p in enumerate(rests):
        last = k == len(rests) - 1
        result[(times >= p.begin) & ((times < p.end) | last)] = k
    return result


def added(tour: Tour, target: int = 1, seed: int = 0, **faults: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, what the faults add to the points (n, 3), and the points without them."""
    times, clean = stream(messages(tour, seed), target)
    other, points = stream(messages(tour, seed, **faults), target)
    assert np.array_equal(times, other)
    return times, points - clean, clean


# ── without faults ───────────────────────────────────────────────────────────────────────────────────


def test_without_faults_every_sample_comes_at_once_and_is_right(tour: Tour) -> None:
    heard = messages(tour)
    assert all(a.delivered <= b.delivered for a, b in pairwise(heard))
    assert all(m.delivered == m.stamp for m in heard)
    times, joints = stream(heard, 0)
    assert np.allclose(np.diff(times), 0.01, atol=1e-9) and times[0] == 0.0 and times[-1] > tour.seconds
    assert np.allclose(joints, [tour.at(t).joints(t) for t in times], atol=1e-12)
    for k in (1, 2):
        times, points = stream(heard, k)
        assert np.allclose(np.diff(times), 0.02, atol=1e-9)
        q = np.array([tour.at(t).joints(t) for t in times])
        assert np.allclose(points, CELL.truth.positions(q)[:, k - 1], atol=1e-9)


@pytest.mark.parametrize("instrument", [None, LaserTracker(station=np.array([4.0, 1.5, 1.2]))])
def test_noise_is_the_instruments(tour: Tour, instrument: LaserTracker | None) -> None:
    cell = SimulatedCell(ROBOT, CELL.deviations, SIGMA, instrument)
    _, clean = stream(messages(tour), 1)
    _, noisy = stream(messages(tour, cell=cell), 1)
    error = noisy - clean
    covariance = SIGMA**2 * np.eye(3)[None] if instrument is None else instrument.covariance(clean)
    squares = np.einsum(
        "ni,nij,nj->n", error, np.linalg.inv(np.broadcast_to(covariance, (len(error), 3, 3))), error
    )
    assert 1e-4 < chi2.sf(squares.sum(), 3 * len(error)) < 1 - 1e-4


def test_rates(tour: Tour) -> None:
    heard = list(play(World(CELL), tour, Rates(1000.0, 3.0)))
    counts = Counter(m.stream for m in heard)
    assert counts[0] == pytest.approx(1000 * (tour.seconds + 0.5), abs=600)
    assert counts[1] == counts[2] == pytest.approx(3 * (tour.seconds + 0.5), abs=3)


# ── drawn once, whatever is asked ────────────────────────────────────────────────────────────────────


def listed(heard: list[Message]) -> list[tuple[Any, ...]]:
    return [(m.delivered, m.stream, m.stamp, *m.values) for m in heard]


def test_the_same_however_often_one_asks(tour: Tour) -> None:
    world = World(SimulatedCell(ROBOT, CELL.deviations, SIGMA), EVERYTHING, 3)
    runs = []
    for step in (1.0, 0.05, 0.0131):
        itinerary = Itinerary(tour.phases[0].start)
        itinerary.begin(tour, START)
        streams, heard = Streams(world, itinerary.at, None, START), []
        end = START + 8 * NANO
        for now in np.arange(START, end, round(step * NANO))[1:]:
            heard += streams.advance(int(now))
        heard += streams.advance(end)
        runs.append(listed(heard))
    assert runs[0] == runs[1] == runs[2] and len(runs[0]) > 1000


def test_seeds(tour: Tour) -> None:
    world = World(SimulatedCell(ROBOT, CELL.deviations, SIGMA), EVERYTHING, 3)
    same, other = World(world.cell, EVERYTHING, 3), World(world.cell, EVERYTHING, 4)
    assert listed(list(play(world, tour))) == listed(list(play(same, tour)))
    assert listed(list(play(world, tour))) != listed(list(play(other, tour)))


def test_a_fault_of_messages_leaves_their_values_alone(tour: Tour) -> None:
    cell = SimulatedCell(ROBOT, CELL.deviations, SIGMA)
    clean = {(m.stream, m.stamp): m.values for m in messages(tour, cell=cell)}
    faults = {"dropout_probability": 0.3, "duplicate_probability": 0.2, "reorder_probability": 0.2}
    heard = messages(tour, cell=cell, tracker_latency=0.1, **faults)
    assert all(np.array_equal(m.values, clean[m.stream, m.stamp]) for m in heard)


# ── robot ────────────────────────────────────────────────────────────────────────────────────────────


def test_transmission_errors(tour: Tour) -> None:
    world = World(CELL, Faults(transmission_error=2e-4, transmission_harmonics=4), 5)
    turn = np.linspace(-np.pi, np.pi, 400, endpoint=False)
    phi = world.truth.actual(np.tile(turn[:, None], 6)) - turn[:, None]
    assert np.allclose(np.sqrt(np.mean(phi**2, axis=0)), 2e-4) and np.allclose(phi.mean(axis=0), 0, atol=1e-12)
    times, points = stream(list(play(world, tour, start=START)), 1)
    q = np.array([tour.at(t).joints(t) for t in times])
    assert np.allclose(points, CELL.truth.robot.positions(world.truth.actual(q))[:, 0], atol=1e-9)
    assert np.array_equal(stream(list(play(world, tour, start=START)), 0)[1], stream(messages(tour), 0)[1])


def test_encoder_resolution(tour: Tour) -> None:
    _, joints = stream(messages(tour), 0)
    heard = messages(tour, encoder_resolution=1e-3)
    _, coarse = stream(heard, 0)
    assert np.allclose(coarse / 1e-3, np.rint(coarse / 1e-3), atol=1e-6)
    assert 4e-4 < np.abs(coarse - joints).max() <= 5e-4 + 1e-12
    assert np.array_equal(stream(heard, 1)[1], stream(messages(tour), 1)[1])


def test_an_arm_that_swings_and_creeps(tour: Tour) -> None:
    faults = {"oscillation": 1e-3, "oscillation_decay": 0.2, "creep": 3e-4, "creep_time": 5.0}
    times, extra, _ = added(tour, unsettled_probability=1.0, **faults)
    number = arrivals(tour, times)
    size = np.linalg.norm(extra, axis=1)
    assert size[number < 0].max() == 0.0
    since = times - np.array([p.begin for p in tour.phases if p.measuring])[np.maximum(number, 0)]
    assert (size[number >= 0] <= 1e-3 * np.exp(-since / 0.2)[number >= 0] + 3e-4 + 1e-9).all()
    late = (number >= 0) & (since > 0.9)
    assert np.allclose(size[late], 3e-4 * np.exp(-since[late] / 5.0), rtol=0.06)
    # About as often as asked for, and all of a standstill or none.
    _, half, _ = added(tour, seed=9, unsettled_probability=0.5)
    moving = [bool(np.any(half[number == k] != 0)) for k in range(VISITS)]
    assert 0 < sum(moving) < VISITS


# ── target and station ───────────────────────────────────────────────────────────────────────────────


def test_a_target_seated_elsewhere(tour: Tour) -> None:
    times, extra, _ = added(tour, reseat_at=3, reseat_by=2e-4)
    last = np.maximum.accumulate(arrivals(tour, times))
    assert np.abs(extra[last < 3]).max() == 0.0
    assert np.allclose(np.linalg.norm(extra[last >= 3], axis=1), 2e-4)
    _, second, _ = added(tour, target=2, reseat_at=3, reseat_by=2e-4)
    assert np.abs(second - extra).max() > 1e-5
    # One vector in the tip's frame: the offset that explains one standstill explains all.
    truth, q = CELL.truth.robot, np.array([tour.at(t).joints(t) for t in times[last >= 3]])
    free = truth.with_parameters(["target_1.x", "target_1.y", "target_1.z"])
    jacobian = free.jacobian(q)[:, :3].reshape(-1, 3)
    offset = np.linalg.lstsq(jacobian, extra[last >= 3].ravel(), rcond=None)[0]
    assert np.allclose(jacobian @ offset, extra[last >= 3].ravel(), atol=1e-9)


def test_a_station_that_moves(tour: Tour) -> None:
    times, extra, _ = added(tour, drift_translation=2e-5)
    assert np.allclose(np.linalg.norm(extra, axis=1), 2e-5 * times, atol=1e-12)
    unit = extra[1:] / np.linalg.norm(extra[1:], axis=1)[:, None]
    assert np.allclose(unit, unit[-1], atol=1e-6)


def test_a_station_that_turns_about_itself(tour: Tour) -> None:
    station = np.array([4.0, 1.5, 1.2])
    tiny = LaserTracker(1e-12, 0.0, 1e-12, 1e-12, station)
    cell = SimulatedCell(ROBOT, CELL.deviations, instrument=tiny)
    times, clean = stream(messages(tour, cell=cell), 1)
    _, turned = stream(messages(tour, cell=cell, drift_rotation=1e-3), 1)
    assert np.allclose(
        np.linalg.norm(turned - station, axis=1), np.linalg.norm(clean - station, axis=1), atol=1e-9
    )
    k = len(times) - 1
    # Seen from the station, the last point turned by at most the angle, and some point by nearly that.
    angle = np.linalg.norm(turned - clean, axis=1) / np.linalg.norm(clean - station, axis=1)
    assert (angle <= 1e-3 * times * 1.0001 + 1e-9).all() and angle[k] > 0.1 * 1e-3 * times[k]


def test_a_station_that_is_pushed(tour: Tour) -> None:
    times, extra, _ = added(tour, bump_at=4, bump_translation=3e-4, bump_rotation=0.0)
    last = np.maximum.accumulate(arrivals(tour, times))
    assert np.abs(extra[last < 4]).max() == 0.0
    assert np.allclose(extra[last >= 4], extra[-1]) and np.linalg.norm(extra[-1]) == pytest.approx(3e-4)


# ── what the tracker sees ────────────────────────────────────────────────────────────────────────────


def test_single_outliers(tour: Tour) -> None:
    _, extra, _ = added(tour, outlier_probability=0.1)
    size = np.linalg.norm(extra, axis=1)
    odd = size > 0
    assert binom.sf(odd.sum() - 1, len(odd), 0.1) > 1e-4 and binom.cdf(odd.sum(), len(odd), 0.1) > 1e-4
    assert (size[odd] >= 0.01).all() and (size[odd] <= 0.05).all()
    assert np.linalg.norm((extra[odd] / size[odd, None]).mean(axis=0)) < 0.5


def test_standstills_that_are_off(tour: Tour) -> None:
    times, extra, _ = added(tour, outlier_standstills=0.5, seed=2)
    number = arrivals(tour, times)
    assert np.abs(extra[number < 0]).max() == 0.0
    sizes = []
    for k in range(VISITS):
        assert np.ptp(extra[number == k], axis=0).max() < 1e-9
        sizes.append(np.linalg.norm(extra[number == k][0]))
    off = [s for s in sizes if s > 0]
    assert 0 < len(off) < VISITS and all(0.01 <= s <= 0.05 for s in off)


def test_beam_breaks(tour: Tour) -> None:
    heard = messages(tour, beam_break_interval=2.0, beam_break_duration=0.5, relock_error=2e-4)
    times, points = stream(heard, 1)
    all_times, clean = stream(messages(tour), 1)
    gaps = np.diff(times)
    assert ((gaps < 0.03) | (gaps > 0.48)).all() and (gaps > 0.48).sum() >= 2
    assert np.array_equal(times, stream(heard, 2)[0])
    assert len(stream(heard, 0)[0]) == len(stream(messages(tour), 0)[0])
    # After each break one error of the distance, along the beam from the station.
    extra = points - clean[np.searchsorted(all_times, times)]
    here = clean[np.searchsorted(all_times, times)]
    unit = here / np.linalg.norm(here, axis=1)[:, None]
    distance = np.sum(extra * unit, axis=1)
    assert np.allclose(extra, distance[:, None] * unit, atol=1e-9)
    parts = np.split(distance, np.flatnonzero(gaps > 0.48) + 1)
    assert all(np.ptp(p) < 1e-9 for p in parts) and parts[0][0] == 0.0
    assert len({round(p[0], 9) for p in parts}) == len(parts)


# ── messages ─────────────────────────────────────────────────────────────────────────────────────────


def test_dropouts(tour: Tour) -> None:
    clean, heard = messages(tour), messages(tour, dropout_probability=0.3)
    for k in (0, 1, 2):
        n, left = (len([m for m in some if m.stream == k]) for some in (clean, heard))
        if k == 0:
            assert left == n
        else:
            assert 1e-4 < binom.cdf(left, n, 0.7) < 1 - 1e-4


def test_latency_keeps_stamps_and_order(tour: Tour) -> None:
    heard = messages(tour, tracker_latency=0.3, tracker_jitter=0.05, joint_latency=0.1)
    clean = messages(tour)
    assert sorted((m.stream, m.stamp) for m in clean) == sorted((m.stream, m.stamp) for m in heard)
    for k, least in ((0, 0.1), (1, 0.3), (2, 0.3)):
        mine = [m for m in heard if m.stream == k]
        late = np.array([(m.delivered - m.stamp) / NANO for m in mine])
        assert late.min() >= least - 1e-9
        assert [m.stamp for m in mine] == sorted(m.stamp for m in mine)
        assert (np.ptp(late) > 0.02) == (k > 0)


def test_clock_of_the_tracker(tour: Tour) -> None:
    heard = messages(tour, tracker_clock_offset=-0.25, tracker_clock_drift=1e-3)
    for clean, skewed in zip(messages(tour), heard, strict=True):
        assert (clean.stream, clean.delivered) == (skewed.stream, skewed.delivered)
        assert np.array_equal(clean.values, skewed.values)
        true = (clean.stamp - START) / NANO
        wanted = true if clean.stream == 0 else true - 0.25 + 1e-3 * true
        assert (skewed.stamp - START) / NANO == pytest.approx(wanted, abs=2e-9)


def test_duplicates_and_reordered(tour: Tour) -> None:
    clean = messages(tour)
    twice = messages(tour, duplicate_probability=0.2, shuffle_delay=0.1)
    more = len(twice) - len(clean)
    assert 1e-4 < binom.cdf(more, len(clean), 0.2) < 1 - 1e-4
    counts = Counter((m.stream, m.stamp) for m in twice)
    assert set(counts.values()) == {1, 2} and len(counts) == len(clean)
    held = messages(tour, reorder_probability=0.2, shuffle_delay=0.1)
    assert Counter((m.stream, m.stamp) for m in held) == Counter((m.stream, m.stamp) for m in clean)
    stamps = [m.stamp for m in held if m.stream == 0]
    back = np.array(stamps) < np.maximum.accumulate(stamps)
    assert 0.1 < back.mean() < 0.25
    assert max(m.delivered - m.stamp for m in held) <= 0.1 * NANO


# ── clocks that jump, and values that are refused ────────────────────────────────────────────────────


@pytest.mark.parametrize("jump", [-5.0, 5.0, 1e8])
def test_a_clock_that_jumps_begins_anew(tour: Tour, jump: float) -> None:
    itinerary = Itinerary(tour.phases[0].start)
    world = World(CELL, Faults(drift_translation=1e-3, tracker_latency=0.2))
    streams = Streams(world, itinerary.at, None, START)
    for k in range(1, 40):
        streams.advance(START + k * NANO // 10)
    after = START + round((4.0 + jump) * NANO)
    streams.advance(after)
    heard = [m for k in range(1, 11) for m in streams.advance(after + k * NANO // 10)]
    assert len([m for m in heard if m.stream == 0]) == pytest.approx(100, abs=2)
    assert all(m.stamp >= after for m in heard)
    assert all(np.isfinite(m.values).all() and np.abs(m.values).max() < 10 for m in heard)


@pytest.mark.parametrize("item", fields(Faults), ids=lambda f: f.name)
def test_values_out_of_range_are_refused_by_name(item: Any) -> None:
    low, high = item.metadata["low"], item.metadata["high"]
    assert low <= item.default <= high and item.metadata["description"]
    for value in (low - 1, high + 1, float("nan"), "a", None):
        with pytest.raises(InputError) as caught:
            replace(Faults(), **{item.name: value})
        assert caught.value.field == item.name
    with pytest.raises(AttributeError):
        setattr(Faults(), item.name, item.default)


def test_smallest_and_largest_outlier_fit_together() -> None:
    with pytest.raises(InputError, match="outlier_smallest"):
        Faults(outlier_smallest=0.1, outlier_largest=0.05)
