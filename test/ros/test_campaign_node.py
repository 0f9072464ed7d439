# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The campaign node: with the real three nodes, and with a robot and an identifier that do all that is bad."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import CalibrationEstimate, JointConfiguration, Measurement, Verdict
from calib_planner_msgs.msg import Plan as PlanMessage
from desk import ASKED, IDENTIFIER, NAME, SIMULATOR, Desk, S
from fake_cell import FakeCell
from geometry_msgs.msg import Point
from rclpy.parameter import Parameter
from warm_processes import Forked, Warm

from calib_planner import Robot
from calib_planner.io import open_campaign, read_data, read_estimate
from calib_planner.io.store import CAMPAIGN_FILE as FILE
from calib_planner.io.store import JOURNAL
from calib_planner.ros import campaign as campaign_measuring
from calib_planner.ros.messages import estimate_from_message
from calib_planner.ros.nodes import campaign as campaign_node
from calib_planner.ros.nodes.campaign import CampaignNode
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.nodes.simulator import SimulatorNode
from calib_planner.ros.parameters import EVENTS, LATCHED
from calib_planner.simulation import random_deviations


@pytest.fixture
def cell(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> FakeCell:
    """It answers at once: then the node need not take its time between two steps, or two attempts."""
    monkeypatch.setattr(campaign_node, "PERIOD", 0.01)
    monkeypatch.setattr(campaign_measuring, "RETRY", 0.2)
    return bench.start(FakeCell)


# ── with the real nodes ──────────────────────────────────────────────────────────────────────────────


def test_a_campaign_with_simulator_and_identifier(bench: Bench, tmp_path: Path) -> None:
    estimates = bench.hear(CalibrationEstimate, f"{NAME}/estimate", LATCHED)
    identified = bench.hear(CalibrationEstimate, "calibration_identifier/estimate", LATCHED)
    bench.start(SimulatorNode, **SIMULATOR)
    bench.start(IdentifierNode, **IDENTIFIER)
    desk = Desk(bench, store_folder=str(tmp_path))
    assert desk.now.state == S.IDLE and "start" in desk.now.reason
    assert desk.call("start")[0]
    done = desk.until(S.DONE, 90.0)
    assert done.outcome == S.OUTCOME_REACHED and done.verdict.reasons
    assert done.verdict.level in (Verdict.PASS, Verdict.WARN)
    assert done.predicted_accuracy <= done.required_accuracy == 5e-6
    assert done.validated == 3 and done.measured + done.validated <= done.budget
    assert list(done.round_measured) == sorted(done.round_measured) and done.round == len(done.round_accuracy)
    states = [m.state for m in desk.heard]
    assert {S.IDLE, S.MEASURING, S.VALIDATING, S.DONE} <= set(states)
    bench.wait(lambda: estimates)
    found = estimate_from_message(estimates[-1])
    truth = random_deviations(Robot.load("planar_2r"), 3)
    off = found.deviations - [truth[n] for n in found.parameters]
    seen = np.isfinite(found.std)
    assert (np.abs(off[seen]) < 4 * found.std[seen]).all() and estimates[-1].verdict == done.verdict
    # In the end the identifier's own estimate is that of the fit, too. A point may be an outlier by chance: the
    # campaign counts it as measured, the identifier counts it apart.
    bench.wait(
        lambda: (
            "-fit-" in identified[-1].plan_id
            and identified[-1].measurements + identified[-1].outliers == done.measured
        )
    )
    names = sorted(p.name for p in tmp_path.iterdir())
    ids = {n: f"{n}_{done.campaign_id}" for n in ("measurements", "validation", "estimate")}
    assert set(names) == {
        FILE,
        f"{ids['measurements']}.csv",
        f"{ids['validation']}.csv",
        f"{ids['estimate']}.yaml",
    }
    robot = Robot.load("planar_2r")
    assert len(read_data(tmp_path / f"{ids['measurements']}.csv", robot).data) == done.measured
    saved = read_estimate(tmp_path / f"{ids['estimate']}.yaml")
    np.testing.assert_array_equal(saved.deviations, found.deviations)


def test_measurements_of_a_validation_that_join_the_fit_are_in_the_last_plan_of_the_fit(
    bench: Bench, cell: FakeCell
) -> None:
    """The identifier is told so before the next validation, and again in the end."""
    rng, first = np.random.default_rng(5), set[str]()

    def answer(q: np.ndarray) -> str:
        name = cell._plan.plan_id
        first.update([name] if "-validation-" in name and not first else [])
        if name not in first:
            return "ok"
        x, y, z = cell.cell.truth.positions(q[None])[0, 0] + 1e-4 * rng.standard_normal(3)
        cell.publish(q, points=[Point(x=x, y=y, z=z)])
        return "ignore"

    cell.answer = answer
    desk = Desk(bench)
    assert desk.call("start")[0]
    done = desk.until(S.DONE, 90.0)
    assert any("join the fit" in m.reason for m in desk.heard)
    bench.wait(lambda: "-fit-" in cell.plans[-1].plan_id)
    assert sum(cell.plans[-1].repetitions) == done.measured
    names = [p.plan_id for p in cell.plans]
    joined = names.index(names[-1])
    assert "-validation-" in names[joined - 1] and any("-validation-" in n for n in names[joined + 1 :])


def simulator_process(warm: Warm, folder: Path, domain: int) -> Forked:
    command = [sys.executable, "-m", "calib_planner.ros.nodes.simulator", "--ros-args"]
    for name, value in SIMULATOR.items():
        command += ["-p", f"{name}:={value}"]
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
    with (folder / "simulator.log").open("ab") as log:
        return warm.popen(command, env=environment, stdout=log, stderr=log, stdin=subprocess.DEVNULL)


def test_a_robot_killed_on_the_way_is_waited_for(bench: Bench, warm: Warm, tmp_path: Path) -> None:
    bench.start(IdentifierNode, **IDENTIFIER)
    desk = Desk(bench, silence=1.5)
    processes = [simulator_process(warm, tmp_path, bench.domain)]
    try:
        assert desk.call("start")[0]
        desk.until(S.MEASURING, 60.0, measured=3)
        processes[0].kill()
        assert desk.until(S.WAITING, 60.0, said="execute_plan").measured >= 3
        processes.append(simulator_process(warm, tmp_path, bench.domain))
        done = desk.until(S.DONE, 120.0)
        assert done.outcome == S.OUTCOME_REACHED and done.excluded == 0
    finally:
        for process in processes:
            process.kill()
            process.wait(10.0)


# ── pause, resume, skip ──────────────────────────────────────────────────────────────────────────────


def test_pause_resume_and_skip(bench: Bench, cell: FakeCell) -> None:
    desk = Desk(bench)
    slow = {"on": True}
    cell.answer = lambda q: "hang" if slow["on"] and len(cell.visited) >= 3 else "ok"
    assert desk.call("start")[0]
    stuck = desk.until(S.MEASURING, measured=2)
    bench.wait(lambda: len(cell.visited) >= 3)
    ok, text = desk.call("pause")
    assert ok and desk.until(S.PAUSED).measured == stuck.measured and "resume" in desk.now.reason
    count = len(cell.visited)
    bench.wait(lambda: not desk.node._measuring.busy)
    assert desk.call("skip")[0] is False
    assert desk.call("resume") == (True, "goes on")
    bench.wait(lambda: len(cell.visited) > count)
    np.testing.assert_array_equal(cell.visited[-1], cell.visited[2])
    ok, text = desk.call("skip")
    assert ok and "left out" in text
    bench.wait(lambda: desk.now.excluded == 1)
    slow["on"] = False
    skipped = cell.visited[2]
    done = desk.until(S.DONE)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded == 1
    campaign = desk.node.campaign
    assert not (np.abs(campaign.measured_q - skipped).max(axis=1) < 1e-6).any()
    assert desk.call("resume")[0] is False and desk.call("pause")[0] is False and desk.call("skip")[0] is False


def test_a_second_campaign_follows_the_first(bench: Bench, cell: FakeCell) -> None:
    desk = Desk(bench, validation=0)
    assert desk.call("start")[0]
    first = desk.until(S.DONE)
    assert desk.call("start")[0]
    bench.wait(lambda: desk.now.campaign_id not in ("", first.campaign_id))
    assert desk.until(S.DONE).campaign_id != first.campaign_id


def test_a_campaign_under_way_is_not_begun_anew(bench: Bench, cell: FakeCell) -> None:
    cell.answer = lambda q: "hang" if len(cell.visited) > 2 else "ok"
    desk = Desk(bench)
    assert desk.call("start")[0]
    desk.until(S.MEASURING, measured=2)
    ok, text = desk.call("start")
    assert not ok and "not finished" in text


@pytest.mark.parametrize(
    ("parameters", "named"),
    [({"test_poses": ""}, "test_poses"), ({"test_poses": "1 2 3"}, "test_poses"), ({"robot": ""}, "robot"),
     ({"test_poses": "9 9"}, "test_poses"),
     ({"constraints": "../x.yaml"}, "constraints"), ({"targets": 2}, "targets|topics")],
)  # fmt: skip
def test_what_cannot_be_begun_is_refused_with_the_reason(bench: Bench, parameters: Any, named: str) -> None:
    desk = Desk(bench, **parameters)
    ok, text = desk.call("start")
    assert not ok and any(n in text for n in named.split("|")) and desk.now.state == S.IDLE
    assert not desk.call("pause")[0] and not desk.call("resume")[0]


def test_unknown_parameters_of_the_robot_are_refused_at_configure(bench: Bench) -> None:
    node = bench.start(CampaignNode, **(ASKED | {"parameters": "nothing"}))
    assert node.state == "unconfigured" and "nothing" in node.failure


def test_a_budget_that_is_too_small_pauses_with_the_reason(bench: Bench, cell: FakeCell) -> None:
    desk = Desk(bench, budget=6)
    assert desk.call("start")[0]
    assert "budget" in desk.until(S.PAUSED).reason and not cell.visited
    (result,) = desk.node.set_parameters([Parameter("budget", value=40)])
    assert result.successful and desk.call("start")[0]
    assert desk.until(S.DONE).outcome == S.OUTCOME_REACHED


# ── a robot and an identifier that do all that is bad ────────────────────────────────────────────────


@pytest.mark.parametrize("how", ["refuse", "abort", "reject"])
def test_what_cannot_be_measured_is_planned_around(bench: Bench, cell: FakeCell, how: str) -> None:
    cell.answer = lambda q: how if q[0] > 0.5 else "ok"
    desk = Desk(bench, patience=0.3)
    assert desk.call("start")[0]
    done = desk.until(S.DONE, 60.0)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded >= 1
    assert (desk.node.campaign.measured_q[:, 0] <= 0.5).all()
    words = {"refuse": "cannot go there: refuse", "abort": "cannot go there: abort", "reject": "the target moved"}
    assert {e.reason for e in desk.node.campaign.exclusions} == {words[how]}


def test_a_robot_that_can_go_nowhere_ends_it(bench: Bench, cell: FakeCell) -> None:
    cell.answer = lambda q: "refuse"
    desk = Desk(bench, most_failures=4)
    assert desk.call("start")[0]
    done = desk.until(S.DONE, 60.0)
    assert done.outcome == S.OUTCOME_UNREACHABLE and done.verdict.level == Verdict.FAIL
    assert "cannot go there" in done.reason
    assert done.measured == 0 and done.excluded == 5


def test_an_identifier_that_does_not_take_the_plan_is_named(bench: Bench, cell: FakeCell) -> None:
    cell.takes_plans = False
    desk = Desk(bench, longest_wait=1.0)
    assert desk.call("start")[0]
    waiting = desk.until(S.WAITING, said="does not take the plan")
    assert "calibration_identifier does not take the plan" in waiting.reason and f"{NAME}/plan" in waiting.reason
    paused = desk.until(S.PAUSED)
    assert "does not take the plan" in paused.reason and not cell.visited
    cell.takes_plans = True
    assert desk.call("resume")[0]
    assert desk.until(S.DONE).outcome == S.OUTCOME_REACHED


def test_no_robot_at_all_is_said(bench: Bench) -> None:
    bench.start(IdentifierNode, **IDENTIFIER)
    desk = Desk(bench)
    assert desk.call("start")[0]
    assert desk.until(S.WAITING, said="nobody offers tracker_simulator/execute_plan")
    assert desk.call("pause")[0] and desk.until(S.PAUSED)


def test_a_robot_that_hangs_is_cancelled_and_tried_again(bench: Bench, cell: FakeCell) -> None:
    cell.answer = lambda q: "hang" if len(cell.visited) == 3 else "ok"
    desk = Desk(bench, silence=0.6)
    assert desk.call("start")[0]
    assert desk.until(S.WAITING, said="nothing heard")
    done = desk.until(S.DONE, 60.0)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded == 0
    np.testing.assert_array_equal(cell.visited[2], cell.visited[3])


def test_a_robot_that_is_busy_is_waited_for(bench: Bench, cell: FakeCell) -> None:
    """It accepts goals all the same, and says so in the result, as the simulator does."""
    busy = {"on": True}
    cell.answer = lambda q: "busy" if busy["on"] and len(cell.visited) > 3 else "ok"
    desk = Desk(bench, longest_wait=1.0)
    assert desk.call("start")[0]
    waiting = desk.until(S.WAITING, said="cannot go there: busy")
    assert waiting.measured == 3 and waiting.excluded == 0
    paused = desk.until(S.PAUSED)
    assert "cannot go there: busy" in paused.reason
    assert {m.state for m in desk.heard[desk.heard.index(waiting) : desk.heard.index(paused)]} == {S.WAITING}
    tried = cell.visited[3:]
    assert 2 <= len(tried) <= 8
    np.testing.assert_array_equal(tried, [tried[0]] * len(tried))
    busy["on"] = False
    assert desk.call("resume")[0]
    done = desk.until(S.DONE)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded == 0


def test_an_identifier_that_says_nothing_uses_up_attempts_not_the_campaign(bench: Bench, cell: FakeCell) -> None:
    cell.answer = lambda q: "ignore" if len(cell.visited) in (2, 3) else "ok"
    desk = Desk(bench, patience=0.3)
    assert desk.call("start")[0]
    done = desk.until(S.DONE, 60.0)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded == 1
    assert "said nothing within 0.3 s" in desk.node.campaign.exclusions[0].reason


def test_undone_measurements_are_made_again_and_nonsense_is_refused(bench: Bench, cell: FakeCell) -> None:
    cell.answer = lambda q: "hang" if len(cell.visited) == 4 else "ok"
    desk = Desk(bench)
    assert desk.call("start")[0]
    desk.until(S.MEASURING, measured=3)
    bench.wait(lambda: len(cell.visited) == 4)
    first = cell.visited[0]
    nan = float("nan")
    rubbish: list[dict[str, Any]] = [
        {"number": 100, "joint_names": ["a", "b"]},
        {"number": 101, "configuration": JointConfiguration(positions=[nan, nan])},
        {"number": 102, "configuration": JointConfiguration(positions=[0.0] * 10_000)},
        {"number": 103, "configuration_index": 4_000_000_000},
        {"number": 104, "points": []},
        {"number": 105, "plan_id": "another"},
        {"number": 106, "status": 250},
        {"number": 107, "status": Measurement.REJECTED_UNDONE, "reason": "long ago"},
    ]
    for others in rubbish:
        cell.publish(first, **others)
    cell.publish(first, number=1, status=Measurement.REJECTED_UNDONE, reason="undone")
    bench.wait(lambda: desk.now.measured == 2)
    assert {r.number for r in desk.node.campaign.measurements} == {2, 3}
    assert desk.node._measuring.visit.reason != "long ago", "what nobody knows was not undone at this visit"
    cell.number = 200
    assert desk.call("pause")[0] and desk.call("resume")[0]
    done = desk.until(S.DONE)
    assert done.outcome == S.OUTCOME_REACHED
    assert (np.abs(desk.node.campaign.measured_q - first).max(axis=1) < 1e-9).any()


# ── restarts ─────────────────────────────────────────────────────────────────────────────────────────


def test_it_goes_on_from_its_store(bench: Bench, cell: FakeCell, tmp_path: Path) -> None:
    cell.answer = lambda q: "hang" if len(cell.visited) == 6 else "ok"
    desk = Desk(bench, store_folder=str(tmp_path))
    assert desk.call("start")[0]
    before = desk.until(S.MEASURING, measured=5)
    bench.wait(lambda: len(cell.visited) == 6)
    rows = desk.node.campaign.measurements
    for step in ("deactivate", "cleanup"):
        getattr(desk.node, f"trigger_{step}")()
    assert not (tmp_path / f"{FILE}-wal").exists()
    (tmp_path / f"{FILE}-wal").write_bytes(b"\x37\x7f\x06\x82" + bytes(4000))  # what a crash leaves of a write
    desk.node.trigger_configure()
    desk.node.trigger_activate()
    again = desk.until(S.PAUSED, measured=5)
    assert again.campaign_id == before.campaign_id and "call ~/resume" in again.reason
    restored = desk.node.campaign.measurements
    assert [r.number for r in restored] == [r.number for r in rows]
    for one, other in zip(restored, rows, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.q, other.q)
    visited = len(cell.visited)
    assert desk.call("resume")[0]
    done = desk.until(S.DONE)
    assert done.outcome == S.OUTCOME_REACHED and done.campaign_id == before.campaign_id
    assert len(cell.visited) - visited == done.measured + done.validated - 5
    stored = open_campaign(tmp_path, Robot.load("planar_2r"))
    assert stored is not None
    stored.store.close()
    assert stored.finished == "reached" and len(stored.rows) == done.measured + 3


def test_a_journal_of_another_robot_is_left_alone(bench: Bench, tmp_path: Path) -> None:
    head = {"format": "calib_planner campaign journal 1", "campaign": "x", "robot": "other"}
    (tmp_path / JOURNAL).write_text(json.dumps(head | {"joint_names": ["a"], "targets": 1}) + "\n")
    desk = Desk(bench, store_folder=str(tmp_path))
    assert desk.now.state == S.IDLE and "planar_2r" in desk.now.reason and "other" in desk.now.reason


def test_the_plans_hold_all_that_was_measured(bench: Bench, cell: FakeCell) -> None:
    heard = bench.hear(PlanMessage, f"{NAME}/plan", EVENTS)
    desk = Desk(bench)
    assert desk.call("start")[0]
    done = desk.until(S.DONE)
    bench.wait(lambda: heard and "-fit-" in heard[-1].plan_id)
    fits = [m for m in heard if "-fit-" in m.plan_id]
    sizes = [sum(m.repetitions) for m in fits]
    assert sizes == sorted(sizes) and sizes[-1] == done.measured
    assert fits[-1].plan_id == fits[-2].plan_id, "told again after the validation"
    held_out = [m for m in heard if "-validation-" in m.plan_id]
    assert len(held_out) == 1 and sum(held_out[0].repetitions) == 3
