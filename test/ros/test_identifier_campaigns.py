# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The identifier node between campaigns and recordings: what it publishes and saves belongs to one campaign."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from robots import plan_of, random_configurations
from shift import NAME, Estimate, Shift, change

from calib_planner import Plan, Robot
from calib_planner.acquisition import NANO
from calib_planner.campaign import FIT, VALIDATION
from calib_planner.io import read_data
from calib_planner.ros.messages import plan_to_message
from calib_planner.ros.parameters import HISTORY

ROBOT = Robot.load("planar_2r").with_parameters("lengths+offsets")
PLAN = plan_of(ROBOT, random_configurations(ROBOT, 5, 3))
HELD_OUT = plan_of(ROBOT, random_configurations(ROBOT, 2, 4))


@pytest.fixture
def shift(bench: Bench, tmp_path: Path) -> Shift:
    return Shift(bench, ROBOT, store_folder=str(tmp_path))


def announce(shift: Shift, campaign: str, purpose: str = FIT, plan: Plan = PLAN) -> str:
    name = f"{campaign}-{purpose}"
    shift.plans.publish(plan_to_message(plan, name, 0, "base", campaign, purpose))
    shift.bench.wait(lambda: shift.estimates[-1].plan_id == name)
    return name


def measured(shift: Shift, plan: Plan, count: int) -> list[Measurement]:
    found = [shift.rest(q) for q in plan.configurations[:count]]
    assert {m.status for m in found} == {Measurement.ACCEPTED}
    return found


def saved(shift: Shift, folder: Path) -> dict[str, int]:
    """Rows of the tables that ``~/save`` writes."""
    assert shift.service("save").success
    return {p.stem: len(read_data(p, ROBOT).data) for p in folder.glob("*.csv")}


def restart(shift: Shift) -> None:
    count = len(shift.estimates)
    for transition in ("deactivate", "cleanup", "configure", "activate"):
        change(shift.bench, transition)
    shift.bench.wait(lambda: len(shift.estimates) > count)
    shift.sent = 0  # as many as the node has counted


def test_two_campaigns_and_a_validation(shift: Shift, tmp_path: Path) -> None:
    announce(shift, "one")
    fitted = measured(shift, PLAN, 5)
    shift.bench.wait(lambda: shift.estimates[-1].measurements == 5)
    fit = shift.estimates[-1]
    name = announce(shift, "one", VALIDATION, HELD_OUT)
    held_out = measured(shift, HELD_OUT, 2)
    shift.bench.wait(lambda: shift.estimates[-1].complete)
    last = shift.estimates[-1]
    assert {(m.campaign_id, m.purpose, m.plan_id) for m in fitted} == {("one", PlanMessage.FIT, "one-fit")}
    assert {(m.campaign_id, m.purpose, m.plan_id) for m in held_out} == {("one", PlanMessage.VALIDATION, name)}
    assert (last.campaign_id, last.plan_id, last.measurements, last.configurations) == ("one", name, 5, 5)
    assert last.value == fit.value and last.std == fit.std and last.header.stamp == fit.header.stamp
    assert any("held-out" in r.text for r in last.verdict.reasons)
    assert not any("held-out" in r.text for r in fit.verdict.reasons)
    assert last.validation_rms > 0.0 and last.validation_predicted_rms > 0.0 and np.isnan(fit.validation_rms)
    rows = {"measurements_one-fit": 5, "validation_one-fit": 2}
    assert saved(shift, tmp_path) == rows

    restart(shift)
    assert shift.estimates[-1].value == fit.value and shift.estimates[-1].plan_id == name
    announce(shift, "two")
    assert shift.estimates[-1].status == Estimate.STATUS_TOO_FEW_MEASUREMENTS
    assert shift.estimates[-1].campaign_id == "two" and np.isnan(shift.estimates[-1].sigma_estimate)
    measured(shift, PLAN, 4)
    shift.bench.wait(lambda: shift.estimates[-1].measurements == 4)
    assert saved(shift, tmp_path) == rows | {"measurements_two-fit": 4}


def undone(shift: Shift, fitted: list[Measurement]) -> dict[int, int]:
    """Withdraw the newest measurement; number → status of all."""
    assert shift.service("undo").success
    shift.bench.wait(lambda: shift.measurements[-1].status == Measurement.REJECTED_UNDONE)
    return {m.id: m.status for m in (*fitted, shift.measurements[-1])}


def test_what_was_measured_is_told_again_after_a_restart(shift: Shift) -> None:
    """To a page that comes late; nobody tells a plan of a campaign."""
    shift.announce(PLAN)
    expected = undone(shift, measured(shift, PLAN, 3))
    restart(shift)
    late = shift.bench.hear(Measurement, f"{NAME}/measurements", HISTORY)
    shift.bench.wait(lambda: len(late) >= 3)
    assert {m.id: m.status for m in late} == expected


def test_a_campaign_that_was_away_hears_what_was_undone(shift: Shift) -> None:
    announce(shift, "one")
    expected = undone(shift, measured(shift, PLAN, 2))
    before = len(shift.measurements)
    shift.plans.publish(plan_to_message(PLAN, "one-fit", 0, "base", "one", FIT))
    shift.bench.wait(lambda: len(shift.measurements) == before + 2)
    assert {m.id: m.status for m in shift.measurements[before:]} == expected


def test_a_bag_that_is_played_twice_counts_once(shift: Shift, tmp_path: Path) -> None:
    """From its beginning, from its middle, and after a restart: the same measurements are told again."""
    announce(shift, "one")
    begin = shift.stamp
    ids = [m.id for m in measured(shift, PLAN, 5)]
    shift.stamp = begin
    assert [m.id for m in measured(shift, PLAN, 5)] == ids
    shift.stamp = begin + NANO // 4
    assert [m.id for m in measured(shift, PLAN, 3)] == ids[:3]
    restart(shift)
    shift.stamp = begin
    assert [m.id for m in measured(shift, PLAN, 5)] == ids
    assert saved(shift, tmp_path) == {"measurements_one-fit": 5}
    last = shift.estimates[-1]
    assert (last.measurements, last.rejected, last.outliers) == (5, 0, 0)
