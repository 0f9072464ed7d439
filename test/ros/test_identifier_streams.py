# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The identifier and streams that do not fit together: clocks that differ or are set, points in another frame."""

from __future__ import annotations

from datetime import datetime, timezone
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import Measurement
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped
from rosgraph_msgs.msg import Clock
from test_identifier_node import Shift, change, spread

from calib_planner import Plan, Robot
from calib_planner.acquisition import NANO
from calib_planner.io import store as stores
from calib_planner.ros.messages import plan_to_message, stamp_message
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.parameters import EVENTS

CLOCK, FRAME = Measurement.REJECTED_CLOCK_OFFSET, Measurement.REJECTED_OTHER_FRAME


@pytest.fixture
def robot() -> Robot:
    return Robot.load("planar_2r").with_parameters("lengths+offsets")


@pytest.fixture
def planned(robot: Robot) -> Plan:
    return spread(20)


def last_told(shift: Shift) -> dict[int, Measurement]:
    return {m.id: m for m in shift.measurements if m.id}


def test_clocks_that_differ_are_noticed_what_was_accepted_withdrawn_and_forgiven(
    bench: Bench, robot: Robot, planned: Plan
) -> None:
    shift = Shift(bench, robot)
    shift.announce(planned)
    good = [shift.rest(q, 1.2).id for q in planned.configurations[:2]]
    wrong = [shift.rest(q, 1.2, offset=0.3) for q in planned.configurations[2:8]]
    assert wrong[0].status == Measurement.ACCEPTED and wrong[-1].status == CLOCK
    bench.wait(lambda: sum(m.status == CLOCK for m in last_told(shift).values()) == 6)
    told = last_told(shift)
    assert [told[n].status for n in good] == [Measurement.ACCEPTED] * 2
    withdrawn = told[wrong[0].id]
    assert "before it was seen" in withdrawn.reason and "ms from the joints" in withdrawn.reason
    bench.wait(lambda: shift.estimates[-1].configurations == 2)
    assert [shift.rest(q, 1.2).status for q in planned.configurations[8:16]][-1] == Measurement.ACCEPTED


def test_what_was_withdrawn_stays_withdrawn(bench: Bench, robot: Robot, planned: Plan, tmp_path: Path) -> None:
    shift = Shift(bench, robot, store_folder=str(tmp_path))
    shift.announce(planned)
    for q in planned.configurations[:5]:
        shift.rest(q, 1.2, offset=0.3)
    bench.wait(lambda: {m.status for m in last_told(shift).values()} == {CLOCK})
    for transition in ("deactivate", "cleanup", "configure", "activate"):
        change(bench, transition)
    assert shift.node._session.records == []
    assert shift.node._session.rejections["clock_offset"] == 5


def test_points_in_another_frame_are_refused_with_the_reason(
    bench: Bench, robot: Robot, planned: Plan, tmp_path: Path
) -> None:
    heard = bench.hear(DiagnosticArray, "/diagnostics", EVENTS)
    shift = Shift(bench, robot, store_folder=str(tmp_path), diagnostics_period=0.1)
    shift.announce(planned)
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED
    shift.frame = "elsewhere"
    refused = shift.rest(planned.configurations[1], 3.2)
    assert refused.status == FRAME and "'elsewhere'" in refused.reason and "'laser'" in refused.reason

    def stream() -> DiagnosticStatus:
        return next(s for s in heard[-1].status if s.name.endswith("stream tracker/point"))

    bench.wait(lambda: heard and "'elsewhere'" in stream().message)
    assert stream().level == DiagnosticStatus.WARN
    shift.frame = ""  # not named: taken for what was named before
    assert shift.rest(planned.configurations[2]).status == Measurement.ACCEPTED
    for transition in ("deactivate", "cleanup", "configure", "activate"):
        change(bench, transition)
    shift.sent, shift.frame = 0, "elsewhere"  # a restart does not forget
    assert shift.rest(planned.configurations[3], 3.2).status == FRAME
    shift.frame = "laser"
    assert shift.rest(planned.configurations[3]).status == Measurement.ACCEPTED
    assert shift.service("reset").success
    shift.frame = "elsewhere"
    assert shift.rest(planned.configurations[0]).header.frame_id == "elsewhere"


def test_as_long_as_nothing_is_kept_another_frame_may_come(bench: Bench, robot: Robot, planned: Plan) -> None:
    shift = Shift(bench, robot)
    shift.frame = "stray"
    shift.rest(planned.configurations[0] + 0.2)  # before there was a plan
    shift.announce(planned)
    shift.frame = "laser"
    found = shift.rest(planned.configurations[0], 3.2)
    assert (found.status, found.header.frame_id) == (Measurement.ACCEPTED, "laser")
    shift.frame = "stray"
    assert shift.rest(planned.configurations[1], 3.2).status == FRAME


def test_a_frame_that_changes_within_a_standstill_is_not_averaged(
    bench: Bench, robot: Robot, planned: Plan
) -> None:
    shift = Shift(bench, robot)
    shift.announce(planned)
    shift.rest(planned.configurations[0])
    frames, send = chain(["laser"] * 15, repeat("elsewhere")), shift.send

    def framed(publisher: Any, message: Any, ahead: int = 100) -> None:
        if isinstance(message, PointStamped):
            message.header.frame_id = next(frames)
        send(publisher, message, ahead)

    shift.send = framed  # type: ignore[method-assign]
    found = shift.rest(planned.configurations[1], 3.2)
    assert found.status == Measurement.ACCEPTED and found.header.frame_id == "laser"
    assert 5 <= found.samples[0] <= 15  # of 160


def test_an_inactive_identifier_does_not_seem_to_take_plans(bench: Bench, robot: Robot, planned: Plan) -> None:
    shift = Shift(bench, robot)
    change(bench, "deactivate")
    count = len(shift.estimates)
    shift.plans.publish(plan_to_message(planned, "other", 0, "base"))
    node = shift.node
    assert isinstance(node, IdentifierNode)
    bench.wait(lambda: node._session.plan_id == "other")
    assert len(shift.estimates) == count
    change(bench, "activate")
    bench.wait(lambda: shift.estimates[-1].plan_id == "other")


class WallClock:
    """The clock of the whole cell: of the drivers' stamps, of the node, and of the store. It is set in hours.

    Args:
        shift: Its stamps follow the clock.
        monkeypatch: Gives the store the clock.
    """

    def __init__(self, shift: Shift, monkeypatch: pytest.MonkeyPatch) -> None:
        self.shift, self._send, self._ahead, self._until = shift, shift.send, 0, 0
        self._clock = shift.bench.client.create_publisher(Clock, "/clock", 1)
        shift.stamp, shift.send = 24 * 3600 * NANO, self.send  # type: ignore[method-assign]
        monkeypatch.setattr(stores, "_now", self.text)
        self.set(0.0)

    def text(self) -> str:
        return datetime.fromtimestamp(self.shift.stamp / NANO, timezone.utc).isoformat()

    def set(self, hours: float) -> None:
        """Before the next message."""
        self.shift.stamp += round(hours * 3600 * NANO)
        node, now = self.shift.node, Clock(clock=stamp_message(self.shift.stamp))

        def set_there() -> bool:
            self._clock.publish(now)
            return node.now == self.shift.stamp

        self.shift.bench.wait(set_there)

    def set_after(self, messages: int, hours: float) -> None:
        """Within the standstill that is shown next, for all that comes after so many messages."""
        self._until, self._ahead = self.shift.sent + messages, round(hours * 3600 * NANO)

    def send(self, publisher: Any, message: Any, ahead: int = 100) -> None:
        if self._ahead and self.shift.sent >= self._until:
            stamp = message.header.stamp.sec * NANO + message.header.stamp.nanosec
            message.header.stamp = stamp_message(stamp + self._ahead)
        self._send(publisher, message, ahead)

    def go_on(self) -> None:
        """From where the clock was set to within a standstill."""
        hours, self._ahead = self._ahead / 3600 / NANO, 0
        self.set(hours)


def test_a_clock_that_is_set_by_hours_loses_and_misorders_nothing(
    bench: Bench, robot: Robot, planned: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shift = Shift(bench, robot, store_folder=str(tmp_path), use_sim_time=True)
    clock = WallClock(shift, monkeypatch)
    shift.announce(planned)
    told = []
    for row, hours in enumerate((0.0, -3.0, 7.0, -5.0, 0.5)):  # between two points
        clock.set(hours)
        told.append(shift.rest(planned.configurations[row]))
    for hours in (-2.0, 2.0):  # within a standstill, 0.1 s after it began: it is measured after that
        clock.set_after(15, hours)
        told.append(shift.rest(planned.configurations[len(told)], 1.2))
        clock.go_on()
    for hours in (-1.0, 6.0):  # within a standstill that was measured: the rest of it is not another one
        clock.set_after(120, hours)
        told.append(shift.rest(planned.configurations[len(told)], 1.6))
        clock.go_on()
    rows = list(range(len(told)))
    assert [(m.configuration_index, m.status) for m in told] == [(row, Measurement.ACCEPTED) for row in rows]
    assert all(m.reason == "" for m in told)
    bench.wait(lambda: shift.estimates[-1].configurations == len(rows))
    before, count = shift.estimates[-1], len(shift.estimates)
    assert [m.status for m in shift.measurements] == [Measurement.ACCEPTED] * len(rows)  # each told once
    for transition in ("deactivate", "cleanup", "configure", "activate"):
        change(bench, transition)
    assert [(r.number, r.index) for r in shift.node._session.records] == [
        (m.id, row) for m, row in zip(told, rows, strict=True)
    ]
    bench.wait(lambda: len(shift.estimates) > count)
    after = shift.estimates[-1]
    assert after.header.stamp == before.header.stamp and after.configurations == len(rows)
    assert np.allclose(after.value, before.value, rtol=0, atol=1e-12)
