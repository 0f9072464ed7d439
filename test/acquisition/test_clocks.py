# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The clocks' offset out of when joints and points stand still, against offsets that were put in."""

from __future__ import annotations

import numpy as np
import pytest
from test_standstill import STOPS, feed, place, stream

from calib_planner.acquisition import NANO, Standstill, StandstillDetector
from calib_planner.acquisition.clocks import FEWEST, LATELY, ClockOffsets

MANY = [*STOPS, *STOPS]


OFFSETS = (-0.4, -0.15, -0.02, 0.0, 0.02, 0.15, 0.4)


@pytest.mark.parametrize(
    ("offset", "move", "rate"),
    [*((x, move, 50) for x in OFFSETS for move in (0.5, 3.0)), *((x, 0.5, 1000) for x in OFFSETS[::3])],
)
def test_an_offset_is_found(offset: float, move: float, rate: int) -> None:
    detector = StandstillDetector(2)
    feed(detector, stream(MANY, 1, offset, point_rate=rate, move=move), flush=False)
    found = detector.clocks.offset(0)
    assert found is not None and found.standstills >= 5
    assert abs(found.seconds - offset) < 0.5 / rate + 0.01 * move + 0.005
    assert bool(detector.offset_text(0.1)) == (abs(offset) > 0.1)


def test_the_text_says_which_way() -> None:
    detector = StandstillDetector(2)
    feed(detector, stream(MANY, 1, 0.2), flush=False)
    assert "target 1" in detector.offset_text(0.1) and "+" in detector.offset_text(0.1)
    detector = StandstillDetector(2)
    feed(detector, stream(MANY, 1, -0.2), flush=False)
    assert "-" in detector.offset_text(0.1)


def test_targets_have_offsets_of_their_own() -> None:
    messages = stream(MANY, 2, targets=2)
    shifted = [(t + (NANO // 4 if k == 2 else 0), k, v) for t, k, v in messages]
    detector = StandstillDetector(2, 2)
    feed(detector, sorted(shifted, key=lambda m: m[0]), flush=False)
    first, second = detector.clocks.offset(0), detector.clocks.offset(1)
    assert first is not None and second is not None
    assert abs(first.seconds) < 0.02 and abs(second.seconds - 0.25) < 0.02
    assert "target 2" in detector.offset_text(0.1)


def test_a_target_that_does_not_move_says_nothing() -> None:
    messages = [(t, k, np.array([1.0, 2.0, 3.0]) if k else v) for t, k, v in stream(MANY)]
    detector = StandstillDetector(2)
    feed(detector, messages, flush=False)
    assert detector.clocks.offset(0) is None and not detector.offset_text(0.001)


def test_broken_beams_are_no_offset() -> None:
    """The points begin 0.3 s after every stop: half of that in the middle, all of it doubtful."""
    messages = [m for m in stream(MANY) if not (m[1] and m[0] / NANO % 1.5 < 0.3)]
    detector = StandstillDetector(2)
    feed(detector, messages, flush=False)
    assert not detector.offset_text(0.05)


def test_too_few_standstills_say_nothing() -> None:
    clocks = ClockOffsets(1, NANO, 0)
    for k in range(FEWEST):
        assert clocks.offset(0) is None
        clocks.add_joints(4 * k * NANO, (4 * k + 1) * NANO)
        clocks.add_point(0, 4 * k * NANO + 300, (4 * k + 1) * NANO + 100)
    found = clocks.offset(0)
    assert found is not None and (found.seconds, found.doubt) == pytest.approx((200e-9, 100e-9))
    clocks.clear()
    assert clocks.offset(0) is None


def test_synchronised_again_it_recovers() -> None:
    clocks = ClockOffsets(1, NANO, 0)
    for k in range(20):
        shift = NANO // 3 if k < 10 else 0
        clocks.add_point(0, 4 * k * NANO + shift, (4 * k + 1) * NANO + shift)
        clocks.add_joints(4 * k * NANO, (4 * k + 1) * NANO)
        found = clocks.offset(0)
        assert found is None or found.exceeds(0.1) == (k < 12)


def test_rests_that_had_the_offset_are_named_and_no_others() -> None:
    clocks = ClockOffsets(1, NANO, 0)
    rests = [(4 * k * NANO, (4 * k + 1) * NANO) for k in range(12)]
    shifts = [0 if k < 4 else NANO // 3 for k in range(12)]
    for k, (rest, shift) in enumerate(zip(rests, shifts, strict=True)):
        clocks.add_point(0, rest[0] + shift, rest[1] + shift)
        clocks.add_joints(*rest)
        found = clocks.offset(0)
        noticed = found is not None and found.exceeds(0.1)
        assert noticed == (k >= 6)
        assert clocks.beyond(0, 0.1) == (rests[max(4, k - 4) : k + 1] if noticed else [])


def test_a_target_that_is_not_seen_to_move_any_more_loses_its_offset() -> None:
    clocks = ClockOffsets(1, NANO, 0)
    for k in range(20):
        if k < 6:
            clocks.add_point(0, 4 * k * NANO + NANO // 3, (4 * k + 1) * NANO + NANO // 3)
        clocks.add_joints(4 * k * NANO, (4 * k + 1) * NANO)
        found = clocks.offset(0)
        assert (found is not None and found.exceeds(0.1)) == (FEWEST - 1 <= k <= 3 + LATELY - 1)
    assert clocks.beyond(0, 0.1) == []


def test_a_doubtful_rest_is_not_named() -> None:
    clocks = ClockOffsets(1, NANO, 0)
    for k in range(5):
        start, stop = (NANO // 2, 0) if k == 2 else (NANO // 5, NANO // 5)  # the third: a broken beam
        clocks.add_point(0, 4 * k * NANO + start, (4 * k + 1) * NANO + stop)
        clocks.add_joints(4 * k * NANO, (4 * k + 1) * NANO)
    assert [start // (4 * NANO) for start, _ in clocks.beyond(0, 0.1)] == [0, 1, 3, 4]


@pytest.mark.parametrize("offset", [0.0, 0.15, 0.3, 0.45])
def test_ends_of_motions_are_left_out_whatever_the_offset(offset: float) -> None:
    """Points without noise: what a mean is off by comes from motion; 0.02 mm were it not left out."""
    ahead = round(offset * NANO)
    exact = [
        (t + ahead, k, np.array([place(t / NANO, MANY), 0.0, 1.0])) if k else (t, k, v)
        for t, k, v in stream(MANY)
    ]
    results = feed(StandstillDetector(2), sorted(exact, key=lambda m: m[0]))
    assert len(results) >= len(MANY) - 1
    for found in results:
        assert isinstance(found, Standstill)
        assert min(abs(found.points[0, 0] - s) for s in MANY) < 2e-7
