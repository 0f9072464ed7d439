# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The campaign node and rejections that no other configuration would escape: clocks, frames, disks."""

from __future__ import annotations

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import Measurement
from desk import Desk, S
from fake_cell import FakeCell

from calib_planner.ros import campaign as campaign_measuring
from calib_planner.ros.nodes import campaign as campaign_node

CLOCK = Measurement.REJECTED_CLOCK_OFFSET


@pytest.fixture
def cell(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> FakeCell:
    monkeypatch.setattr(campaign_measuring, "RETRY", 0.2)
    monkeypatch.setattr(campaign_node, "PERIOD", 0.01)
    return bench.start(FakeCell)


def spoil(cell: FakeCell, status: int, points: bool) -> dict[str, bool]:
    """After three standstills the cell rejects all, until the answer's ``on`` is false."""
    spoilt = {"on": True}

    def answer(q: np.ndarray) -> str:
        if not spoilt["on"] or len(cell.visited) <= 3:
            return "ok"
        others = {} if points else {"points": [], "plan_id": "", "configuration_index": Measurement.UNPLANNED}
        cell.publish(q, status=status, reason="synchronise the clocks", number=0, **others)
        cell.number = 3
        return "ignore"

    cell.answer = answer
    return spoilt


@pytest.mark.parametrize(
    ("status", "points"),
    [(CLOCK, True), (Measurement.REJECTED_TIME_SKEW, False), (Measurement.REJECTED_OTHER_FRAME, False),
     (Measurement.REJECTED_NOT_STORED, True)],
)  # fmt: skip
def test_what_would_spoil_any_measurement_is_waited_for(
    bench: Bench, cell: FakeCell, status: int, points: bool
) -> None:
    spoilt = spoil(cell, status, points)
    desk = Desk(bench, patience=0.2 if not points else 600.0)
    assert desk.call("start")[0]
    assert desk.until(S.WAITING, said="synchronise the clocks").measured == 3
    count = len(cell.visited)
    bench.wait(lambda: len(cell.visited) > count)  # tried again, at the same place
    np.testing.assert_array_equal(cell.visited[-1], cell.visited[3])
    spoilt["on"] = False
    done = desk.until(S.DONE, 60.0)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded == 0 and not desk.node.campaign.failures
    assert "synchronise" not in done.reason


def test_it_pauses_when_that_lasts_too_long(bench: Bench, cell: FakeCell) -> None:
    spoilt = spoil(cell, CLOCK, True)
    desk = Desk(bench, longest_wait=1.0)
    assert desk.call("start")[0]
    paused = desk.until(S.PAUSED, 60.0)
    assert "synchronise the clocks" in paused.reason and paused.excluded == 0
    spoilt["on"] = False
    assert desk.call("resume")[0]
    assert desk.until(S.DONE, 60.0).outcome == S.OUTCOME_REACHED


def test_what_the_identifier_withdraws_is_measured_again(bench: Bench, cell: FakeCell) -> None:
    cell.answer = lambda q: "hang" if len(cell.visited) == 4 else "ok"
    desk = Desk(bench)
    assert desk.call("start")[0]
    desk.until(S.MEASURING, measured=3)
    bench.wait(lambda: len(cell.visited) == 4)
    first = cell.visited[0]
    cell.publish(first, number=1, status=CLOCK, reason="taken before it was seen")
    bench.wait(lambda: desk.now.measured == 2)
    cell.number = 200
    assert desk.call("pause")[0] and desk.call("resume")[0]
    assert desk.until(S.DONE, 60.0).outcome == S.OUTCOME_REACHED
    again = [r.number for r in desk.node.campaign.measurements if np.abs(r.q - first).max() < 1e-9]
    assert again and 1 not in again


def test_a_rejected_standstill_is_not_waited_for(bench: Bench, cell: FakeCell) -> None:
    """It is not judged again before the robot moves: ``patience`` is for those that may settle yet."""
    cell.answer = lambda q: "reject" if q[0] > 0.5 else "ok"
    desk = Desk(bench, patience=600.0)
    assert desk.call("start")[0]
    done = desk.until(S.DONE, 60.0)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded >= 1
