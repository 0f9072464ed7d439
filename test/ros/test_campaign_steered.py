# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A person at a campaign: looks at the first plan, leaves out, replaces, remedies, and starts the node anew."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import SkipConfiguration
from desk import ASKED, NAME, Desk, S
from fake_cell import FakeCell
from rclpy.parameter import Parameter

from calib_planner.ros import campaign as campaign_measuring
from calib_planner.ros.nodes import campaign as campaign_node
from calib_planner.ros.nodes.campaign import CampaignNode
from calib_planner.ros.parameters import LATCHED

Answer = SkipConfiguration.Response


@pytest.fixture
def cell(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> FakeCell:
    """It answers at once: then the node need not take its time between two steps, or two attempts."""
    monkeypatch.setattr(campaign_node, "PERIOD", 0.01)
    monkeypatch.setattr(campaign_measuring, "RETRY", 0.2)
    return bench.start(FakeCell)


def skip(desk: Desk, index: int, *, replace: bool = False) -> Any:
    request = SkipConfiguration.Request(configuration_index=index, replace=replace)
    return desk.bench.call(SkipConfiguration, f"{NAME}/skip_configuration", request)


def ahead(status: S) -> dict[int, tuple[float, ...]]:
    """Number → joints of what is ahead [rad]."""
    assert len(status.ahead) == len(status.ahead_configurations)
    return {i: tuple(c.positions) for i, c in zip(status.ahead, status.ahead_configurations, strict=True)}


def near(q: Any, others: Any) -> bool:
    """Whether ``q`` is measured among ``others``."""
    return bool((np.abs(np.array(list(others)) - np.array(q)).max(axis=1) < 1e-6).any())


# ── before the start ─────────────────────────────────────────────────────────────────────────────────


def test_the_first_plan_is_looked_at_left_out_and_replaced(bench: Bench, cell: FakeCell) -> None:
    desk = Desk(bench, review=True)
    assert skip(desk, 0).status == Answer.NOT_ACTIVE
    assert desk.call("start")[0]
    first = desk.until(S.PAUSED, said="review")
    assert "skip_configuration" in first.reason and first.round == 1 and len(first.ahead) >= 4
    gone = first.ahead[0]
    wrong = skip(desk, 99)
    assert wrong.status == Answer.UNKNOWN_INDEX and "one of" in wrong.message
    answer = skip(desk, gone)
    assert answer.status == Answer.SUCCESS and "others stay" in answer.message
    bench.wait(lambda: desk.now.excluded == 1)
    assert set(desk.now.ahead) <= set(first.ahead) - {gone} and desk.now.state == S.PAUSED
    assert skip(desk, gone).status == Answer.UNKNOWN_INDEX
    replaced = desk.now.ahead[-1]
    begun = len(desk.heard)
    assert skip(desk, replaced, replace=True).status == Answer.SUCCESS
    bench.wait(lambda: desk.now.round == 2 and desk.now.excluded == 2)
    assert desk.now.state == S.PAUSED and not set(desk.now.ahead) & set(first.ahead)
    assert "paused for review" in desk.now.reason
    planning = [m for m in desk.heard[begun:] if m.state == S.PLANNING]
    assert planning and all("planned anew" in m.reason and not m.ahead for m in planning)
    second = ahead(desk.now)
    assert not cell.visited and len(second) >= len(ahead(first)) - 1
    assert desk.call("resume")[0]
    bench.wait(lambda: cell.visited)
    assert near(cell.visited[0], second.values())
    done = desk.until(S.DONE)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded == 2 and not done.ahead
    for index in (gone, replaced):
        assert not near(ahead(first)[index], cell.visited)
    assert skip(desk, 0).status == Answer.NOT_ACTIVE


def test_only_the_first_plan_waits(bench: Bench, cell: FakeCell) -> None:
    desk = Desk(bench, review=True, validation=0)
    assert desk.call("start")[0] and desk.until(S.PAUSED, said="review")
    assert desk.call("resume")[0]
    desk.until(S.DONE)
    assert sum("review" in m.reason for m in desk.heard) == 1


def test_what_is_ahead_of_a_robot_at_work_is_left_out_or_replaced(bench: Bench, cell: FakeCell) -> None:
    """The visit under way is not disturbed."""
    held = {"on": True}
    cell.answer = lambda q: "hang" if held["on"] and len(cell.visited) == 3 else "ok"
    desk = Desk(bench, exclusion=0.005)  # the plan of this robot lies close together
    assert desk.call("start")[0]
    before = desk.until(S.MEASURING, measured=2)
    bench.wait(lambda: len(cell.visited) == 3)
    begun = {r.index for r in desk.node.campaign.measurements} | {before.configuration_index}
    one = next(i for i in before.ahead if i not in begun)
    assert skip(desk, one).status == Answer.SUCCESS
    bench.wait(lambda: desk.now.excluded == 1)
    assert desk.now.configuration_index == before.configuration_index and set(desk.now.ahead) <= set(before.ahead)
    other = next(i for i in desk.now.ahead if i not in begun)
    assert skip(desk, other, replace=True).status == Answer.SUCCESS
    bench.wait(lambda: not desk.now.ahead)
    assert desk.now.configuration_index == before.configuration_index and len(cell.visited) == 3
    held["on"] = False
    for client in ("pause", "resume"):
        assert desk.call(client)[0]
    done = desk.until(S.DONE)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded == 2
    for index in (one, other):
        assert not near(ahead(before)[index], cell.visited)


def test_what_cannot_be_stored_is_not_left_out(bench: Bench, cell: FakeCell, tmp_path: Path) -> None:
    desk = Desk(bench, review=True, store_folder=str(tmp_path / "store"))
    assert desk.call("start")[0]
    first = desk.until(S.PAUSED, said="review")
    (tmp_path / "store").rename(tmp_path / "gone")
    answer = skip(desk, first.ahead[0])
    assert answer.status == Answer.NOT_STORED and "not stored" in answer.message
    assert desk.now.state == S.PAUSED and list(desk.now.ahead) == list(first.ahead) and not desk.now.excluded


# ── on the way ───────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(("how", "said"), [("beam_lost", "the beam was lost"), ("stopped", "was stopped")])
def test_a_halt_pauses_and_costs_no_attempt(bench: Bench, cell: FakeCell, how: str, said: str) -> None:
    """As often as it may be: more halts than attempts at a configuration."""
    halts = {"left": 3}

    def answer(q: np.ndarray) -> str:
        if len(cell.visited) > 2 and halts["left"]:
            halts["left"] -= 1
            return how
        return "ok"

    cell.answer = answer
    desk = Desk(bench, attempts=1)
    assert desk.call("start")[0]
    for k in range(3):
        bench.wait(lambda k=k: halts["left"] == 2 - k)
        paused = desk.until(S.PAUSED, said=said)
        assert f"cannot go there: {how}" in paused.reason and "~/resume" in paused.reason
        assert desk.call("resume")[0]
    done = desk.until(S.DONE)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded == 0
    np.testing.assert_array_equal(cell.visited[2:5], [cell.visited[5]] * 3)
    assert desk.node.campaign.spent() == done.measured + done.validated


def test_a_robot_that_is_not_ready_is_waited_for(bench: Bench, cell: FakeCell) -> None:
    cell.answer = lambda q: "not_ready" if len(cell.visited) in (2, 3) else "ok"
    desk = Desk(bench, attempts=1)
    assert desk.call("start")[0]
    assert desk.until(S.WAITING, said="cannot go there: not_ready").excluded == 0
    done = desk.until(S.DONE)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded == 0


def test_what_an_identifier_accepted_before_a_crash_is_not_measured_again(bench: Bench, cell: FakeCell) -> None:
    """It tells it when the plan is told again; also what belongs to no plan of the campaign's memory."""
    answers = {3: "untold"}
    cell.answer = lambda q: answers.get(len(cell.visited), "ok")
    desk = Desk(bench, attempts=1, patience=0.5)
    assert desk.call("start")[0]
    done = desk.until(S.DONE)
    assert done.excluded == 0 and desk.node.campaign.spent() == done.measured + done.validated == len(
        cell.visited
    )
    last = len(cell.visited) + 3
    answers[last] = "hang"
    assert desk.call("start")[0]
    bench.wait(lambda: len(cell.visited) == last)
    assert desk.now.campaign_id != done.campaign_id
    unplanned = {"configuration_index": Measurement.UNPLANNED, "campaign_id": desk.now.campaign_id}
    q = desk.node.campaign.problem.test_pose_array[0] + 0.3
    cell.publish(q, **unplanned | {"campaign_id": done.campaign_id})
    cell.publish(q, **unplanned)
    cell.publish(q + 0.1, **unplanned, purpose=PlanMessage.VALIDATION)
    bench.wait(lambda: (desk.now.measured, desk.now.validated) == (3, 1))
    assert desk.call("pause")[0] and desk.call("resume")[0]
    again = desk.until(S.DONE)
    state = desk.node.campaign
    assert [c.role for c in state.configurations if near(c.q, [q, q + 0.1])] == ["fit", "validation"]
    assert len(state.measurements) == again.measured + again.validated and again.validated == 3


def test_what_was_undone_while_the_campaign_was_away_is_measured_again(
    bench: Bench, cell: FakeCell, tmp_path: Path
) -> None:
    """The identifier tells it with the plan; what the campaign never knew changes nothing."""
    cell.answer = lambda q: "hang" if len(cell.visited) == 4 else "ok"
    desk = Desk(bench, store_folder=str(tmp_path), attempts=1)
    assert desk.call("start")[0]
    bench.wait(lambda: len(cell.visited) == 4)
    desk.until(S.MEASURING, measured=3)
    desk.transitions("deactivate", "cleanup")
    undone = {"status": Measurement.REJECTED_UNDONE, "reason": "withdrawn on request"}
    first = cell.visited[0]
    cell.untold += [(first, undone | {"number": 1}), (first, undone | {"number": 99})]
    cell.answer = lambda q: "ok"
    desk.transitions("configure", "activate")
    desk.until(S.PAUSED, measured=3)
    assert desk.call("resume")[0]
    bench.wait(lambda: desk.node.campaign.failures)
    cell.number = 200
    done = desk.until(S.DONE)
    state = desk.node.campaign
    assert 1 not in {r.number for r in state.measurements}
    assert [reason for _, reason in state.failures] == ["withdrawn on request"]
    assert done.outcome == S.OUTCOME_REACHED


# ── goals and counters ───────────────────────────────────────────────────────────────────────────────


def test_a_restart_goes_on_with_the_goals_of_the_record(bench: Bench, cell: FakeCell, tmp_path: Path) -> None:
    """Also where the parameters say something else by now, or nothing."""
    cell.answer = lambda q: "abort" if len(cell.visited) in (2, 3) else "hang" if len(cell.visited) == 7 else "ok"
    desk = Desk(bench, store_folder=str(tmp_path))
    assert desk.call("start")[0]
    bench.wait(lambda: len(cell.visited) == 7)
    before = desk.until(S.MEASURING, measured=4)
    node = desk.node
    spent, rounds = node.campaign.spent(), node.campaign.rounds
    assert spent == before.measured + 2 and before.excluded == 1
    desk.transitions("deactivate", "cleanup")
    changes = {"budget": 50, "required_accuracy": 1e-3, "test_poses": "", "seed": 0}
    assert all(r.successful for r in node.set_parameters([Parameter(n, value=v) for n, v in changes.items()]))
    desk.transitions("configure", "activate")
    again = desk.until(S.PAUSED, measured=before.measured)
    for text in (
        "budget is '40' in the record, '50' here",
        "required_accuracy is '5e-06'",
        "test_poses is '0.17 0.87'",
    ):
        assert text in again.reason, again.reason
    assert "seed" not in again.reason and "another store_folder" in again.reason
    problem = node.campaign.problem
    assert (problem.budget, problem.required_accuracy) == (40, 5e-6) == (again.budget, again.required_accuracy)
    assert node.campaign.spent() == spent and again.excluded == 1 and repr(node.campaign.rounds) == repr(rounds)
    cell.answer = lambda q: "ok"
    assert desk.call("resume")[0]
    assert desk.until(S.DONE).outcome == S.OUTCOME_REACHED


def test_a_record_that_says_nothing_takes_the_parameters(bench: Bench, tmp_path: Path) -> None:
    """Of a journal of an earlier version."""
    written = Path(__file__).parents[1] / "io" / "written_before" / "campaign_journal.jsonl"
    (tmp_path / written.name).write_bytes(written.read_bytes())
    desk = Desk(bench, elsewhere=True)
    bench.start(CampaignNode, **(ASKED | {"store_folder": str(tmp_path)}))
    bench.wait(lambda: desk.heard)
    paused = desk.until(S.PAUSED, measured=2)
    assert "record" not in paused.reason and paused.budget == 40


def test_counters_are_true(bench: Bench, cell: FakeCell) -> None:
    estimates = bench.hear(CalibrationEstimate, f"{NAME}/estimate", LATCHED)
    cell.answer = lambda q: "reject" if len(cell.visited) in (2, 3, 5) else "ok"
    desk = Desk(bench, patience=0.3)
    idle = desk.now
    for name in ("predicted_accuracy", "required_accuracy", "sigma", "left_out_rms", "validation_rms"):
        assert math.isnan(getattr(idle, name)), name
    assert desk.call("start")[0]
    first = desk.until(S.MEASURING)
    assert (
        math.isnan(first.left_out_rms)
        and math.isnan(first.validation_rms)
        and math.isnan(first.round_accuracy[0])
    )
    done = desk.until(S.DONE)
    bench.wait(lambda: estimates)
    message, state = estimates[-1], desk.node.campaign
    assert done.excluded == 1 and done.validated == 3 and message.rejected == 3
    assert message.campaign_id == done.campaign_id and message.complete
    assert message.measurements + message.outliers == done.measured
    assert message.configurations == len({r.index for r in state.measurements_of("fit")})
    assert 0 < done.left_out_rms == message.left_out_rms < 1e-4 and message.condition >= 1
    assert list(done.round_measured) == [r.measured for r in state.rounds] and done.round == len(
        done.round_accuracy
    )
    used = [m.left_out_rms for m in desk.heard if m.round > 1 and m.state != S.DONE]
    assert used and np.isfinite(used).all()
