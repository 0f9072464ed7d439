# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A validation that contradicts joins the fit: the identifier hears of it, before and after a restart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import CalibrationEstimate
from calib_planner_msgs.msg import Plan as PlanMessage
from desk import IDENTIFIER, NAME, SIMULATOR, Desk, S
from fake_cell import FakeCell
from robots import repeats

from calib_planner.campaign import FIT, finish
from calib_planner.ros import campaign as campaign_measuring
from calib_planner.ros.nodes import campaign as campaign_node
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.nodes.simulator import SimulatorNode
from calib_planner.ros.parameters import EVENTS, LATCHED

VALIDATION = 3
"""Configurations of a validation, as the desk asks for them."""


@pytest.fixture
def contradicts(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Answers of the first comparisons with a validation; by chance it contradicts once in 1000 times."""
    answers, compare = [True], finish.contradicted
    monkeypatch.setattr(finish, "contradicted", lambda *args: answers.pop(0) if answers else compare(*args))
    return answers


@pytest.fixture
def cell(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> FakeCell:
    """It answers at once: then the node need not take its time between two steps, or two attempts."""
    monkeypatch.setattr(campaign_node, "PERIOD", 0.01)
    monkeypatch.setattr(campaign_measuring, "RETRY", 0.2)
    return bench.start(FakeCell)


def told(plans: list[PlanMessage]) -> list[tuple[str, int]]:
    """Role and measurements of the plans, in the order of telling; those told again at once only once."""
    role = {PlanMessage.FIT: "fit", PlanMessage.VALIDATION: "validation"}
    found = {m.plan_id: (role[m.purpose], sum(m.repetitions)) for m in plans}
    ids = [m.plan_id for k, m in enumerate(plans) if k == 0 or plans[k - 1].plan_id != m.plan_id]
    return [found[i] for i in ids]


def test_the_identifier_is_told_the_fit_that_grew(bench: Bench, cell: FakeCell, contradicts: list[bool]) -> None:
    """As soon as the validation has joined it, and in the end."""
    desk = Desk(bench)
    assert desk.call("start")[0]
    done = desk.until(S.DONE)
    assert not contradicts and done.outcome == S.OUTCOME_REACHED and done.validated == VALIDATION
    grown = done.measured
    bench.wait(lambda: told(cell.plans)[-2:] == [("validation", VALIDATION), ("fit", grown)])
    roles = [role for role, _ in told(cell.plans)]
    assert told(cell.plans)[-3] == ("fit", grown) and roles.count("validation") == 2
    assert {m.campaign_id for m in cell.plans} == {done.campaign_id}
    state = desk.node.campaign
    plan = next(m for m in reversed(cell.plans) if m.purpose == PlanMessage.FIT)
    np.testing.assert_array_equal(
        np.unique([c.positions for c in plan.configurations], axis=0),
        np.unique([r.q for r in state.measurements_of(FIT)], axis=0),
    )
    numbers = [r.number for r in state.measurements]
    assert len(numbers) == len(set(numbers)) == len(cell.visited) == grown + VALIDATION


@pytest.mark.parametrize("validated", [0, 1], ids=["before the validation", "in the validation"])
def test_a_restart_goes_on_in_the_validation(
    bench: Bench, cell: FakeCell, contradicts: list[bool], tmp_path: Path, validated: int
) -> None:
    """Nothing is measured twice, and the identifier hears of everything that is in the fit."""
    desk = Desk(bench, store_folder=str(tmp_path))
    held, second = {"on": True}, list[np.ndarray]()

    def answer(q: np.ndarray) -> str:
        if contradicts or cell.plans[-1].purpose != PlanMessage.VALIDATION:
            return "ok"
        second.append(q)
        return "hang" if held["on"] and len(second) > validated else "ok"

    cell.answer = answer
    assert desk.call("start")[0]
    first = desk.until(S.VALIDATING)
    before = desk.until(S.VALIDATING, round=first.round + 1, validated=validated)
    bench.wait(lambda: len(cell.visited) == before.measured + validated + 1)
    desk.restart()
    count, held["on"] = len(cell.plans), False
    assert desk.now.round == before.round and list(desk.now.round_measured) == list(before.round_measured)
    assert desk.call("resume")[0]
    done = desk.until(S.DONE)
    assert done.measured == before.measured and done.validated == VALIDATION
    bench.wait(lambda: told(cell.plans[count:]) == [("validation", VALIDATION), ("fit", before.measured)])


# ── with the real identifier ─────────────────────────────────────────────────────────────────────────


def measured_in_the_end(bench: Bench, desk: Desk, identified: list[CalibrationEstimate]) -> S:
    """The campaign's last status, once the identifier's own estimate is that of the fit."""
    done = desk.until(S.DONE, 90.0)
    assert done.outcome == S.OUTCOME_REACHED and done.validated == VALIDATION
    bench.wait(lambda: "-fit-" in identified[-1].plan_id)
    assert identified[-1].measurements + identified[-1].outliers == done.measured
    assert identified[-1].campaign_id == done.campaign_id
    return done


def test_the_identifier_ends_with_all_of_the_fit(bench: Bench, contradicts: list[bool]) -> None:
    identified = bench.hear(CalibrationEstimate, "calibration_identifier/estimate", LATCHED)
    bench.start(SimulatorNode, **SIMULATOR)
    bench.start(IdentifierNode, **IDENTIFIER)
    desk = Desk(bench)
    assert desk.call("start")[0]
    measured_in_the_end(bench, desk, identified)
    assert not contradicts


@pytest.mark.parametrize("joins", repeats([True], [False, True]))
def test_so_it_does_after_a_restart_in_the_validation(
    bench: Bench, contradicts: list[bool], tmp_path: Path, joins: bool
) -> None:
    """Every standstill counts once: what was validated before the restart stays validation."""
    contradicts[0] = joins
    identified = bench.hear(CalibrationEstimate, "calibration_identifier/estimate", LATCHED)
    plans: list[Any] = bench.hear(PlanMessage, f"{NAME}/plan", EVENTS)
    bench.start(SimulatorNode, **SIMULATOR)
    bench.start(IdentifierNode, **IDENTIFIER)
    desk = Desk(bench, store_folder=str(tmp_path))
    assert desk.call("start")[0]
    desk.until(S.VALIDATING, 60.0, validated=1)
    assert desk.call("pause")[0]
    bench.wait(lambda: not desk.node._measuring.busy)
    desk.restart()
    count = len(plans)
    assert desk.call("resume")[0]
    measured_in_the_end(bench, desk, identified)
    assert not contradicts
    roles = [role for role, _ in told(plans[count:])]
    assert roles == (["validation", "fit", "validation", "fit"] if joins else ["validation", "fit"])
