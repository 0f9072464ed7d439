# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The identifier node fed over real topics by a robot that is not there, in this process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bench import Bench
from builtin_interfaces.msg import Time
from calib_planner_msgs.msg import Measurement, Verdict
from calib_planner_msgs.srv import UndoMeasurement
from diagnostic_msgs.msg import DiagnosticArray
from poses import poses
from robots import plan_of, random_configurations
from sensor_msgs.msg import JointState
from shift import NAME, Estimate, Shift, change
from std_srvs.srv import Trigger

from calib_planner import Plan, PlanProblem, Robot, plan
from calib_planner.acquisition import NANO
from calib_planner.io.store import FILE
from calib_planner.planning import Search
from calib_planner.ros.messages import plan_to_message, point_message, stamp_message
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.parameters import EVENTS, LATCHED


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.load("planar_2r").with_parameters("lengths+offsets")


@pytest.fixture(scope="module")
def planned(robot: Robot) -> Plan:
    return plan(PlanProblem(robot, [0.3, 0.5], 4, noise=3e-5 / 20**0.5, search=Search(starts=4)))


@pytest.fixture
def shift(bench: Bench, robot: Robot, tmp_path: Path) -> Iterator[Shift]:
    yield Shift(bench, robot, save_folder=str(tmp_path / "campaign"))


def test_a_whole_campaign(shift: Shift, planned: Plan, tmp_path: Path) -> None:
    assert shift.estimates[0].status == Estimate.STATUS_TOO_FEW_MEASUREMENTS
    shift.announce(planned)
    for i, q in enumerate(planned.configurations):
        found = shift.rest(q)
        assert (found.status, found.configuration_index, found.repetition) == (Measurement.ACCEPTED, i, 0)
        assert found.plan_id == "p" and found.header.frame_id == "laser" and found.samples[0] >= 20
        shift.bench.wait(lambda i=i: shift.estimates[-1].configurations == i + 1)
    last = shift.estimates[-1]
    assert last.complete and last.status == Estimate.STATUS_OK and last.measurements == 4
    assert len(last.predicted_accuracy) == 1
    off = np.array(last.deviation) - [shift.truth[n] for n in last.parameters]
    assert (np.abs(off) < 4 * np.array(last.std)).all()
    late = shift.bench.hear(Estimate, f"{NAME}/estimate", LATCHED)
    shift.bench.wait(lambda: late)
    assert late[0].complete

    saved = shift.service("save")
    assert saved.success, saved.message
    assert {p.suffix for p in (tmp_path / "campaign").iterdir()} == {".csv", ".yaml"}
    assert shift.service("undo").success
    shift.bench.wait(lambda: shift.measurements[-1].status == Measurement.REJECTED_UNDONE)
    shift.bench.wait(lambda: shift.estimates[-1].measurements == 3 and not shift.estimates[-1].complete)
    again = shift.rest(planned.configurations[3])
    assert (again.status, again.configuration_index) == (Measurement.ACCEPTED, 3)
    assert "4 measurements" in shift.service("reset").message
    shift.bench.wait(lambda: shift.estimates[-1].status == Estimate.STATUS_TOO_FEW_MEASUREMENTS)
    assert not shift.service("undo").success
    assert not shift.service("save").success


def test_rejections_have_reasons(shift: Shift, planned: Plan) -> None:
    assert shift.rest(planned.configurations[0]).status == Measurement.REJECTED_NOT_IN_PLAN
    shift.announce(planned)
    shaken = shift.rest(planned.configurations[0], shake=1e-3)
    assert shaken.status == Measurement.REJECTED_MOVED and "target 1 moved" in shaken.reason
    far = shift.rest(planned.configurations[0] + 0.1)
    assert far.status == Measurement.REJECTED_NOT_IN_PLAN and "nearest" in far.reason
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED


def test_saving_without_a_folder_says_what_to_set(bench: Bench, robot: Robot) -> None:
    answer = Shift(bench, robot).service("save")
    assert not answer.success and "save_folder" in answer.message


def test_nonsense_on_every_topic_does_no_harm(shift: Shift, planned: Plan) -> None:
    good = plan_to_message(planned, "bad", 0, "base")
    for field, value in (
        ("configurations", poses([1.0])),
        ("configurations", poses([float("nan")] * 2) * 4),
        ("robot", "other"),
        ("parameters", ["none"]),
        ("repetitions", []),
        ("status", 99),
    ):
        message = plan_to_message(planned, "bad", 0, "base")
        setattr(message, field, value)
        shift.plans.publish(message)
    assert good.plan_id not in {e.plan_id for e in shift.estimates}
    stamp = stamp_message(shift.stamp)
    for names, positions in (
        ([], []),
        (["q1"], [1.0]),
        (["q1", "q2"], [1.0]),
        (["q1", "q2"], [float("nan")] * 2),
        (["q1", "q1", "q2"], [1.0] * 3),
        ([f"j{i}" for i in range(10_000)], [0.0] * 10_000),
    ):
        state = JointState(name=names, position=positions)
        state.header.stamp = stamp
        shift.send(shift.joints, state)
    for value in (float("nan"), float("inf"), 1e308):
        shift.send(shift.points, point_message(np.full(3, value), shift.stamp, "laser"))
    shift.announce(planned)
    assert shift.rest(planned.configurations[1]).status == Measurement.ACCEPTED


def test_a_new_plan_begins_anew_and_the_old_one_comes_back(shift: Shift, planned: Plan) -> None:
    shift.announce(planned)
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED
    shift.announce(planned, "second")
    assert shift.estimates[-1].measurements == 0
    shift.announce(planned)
    assert shift.estimates[-1].measurements == 1


# ── what is wrong with measurements ──────────────────────────────────────────────────────────────────


def spread(count: int) -> Plan:
    robot = Robot.load("planar_2r").with_parameters("lengths+offsets")
    return plan_of(robot, random_configurations(robot, count))


def test_an_outlier_is_published_again_and_can_be_withdrawn(shift: Shift) -> None:
    planned = spread(9)
    shift.announce(planned)
    for q in planned.configurations[:8]:
        assert shift.rest(q).status == Measurement.ACCEPTED
    shift.rest(planned.configurations[8], error=2e-3)
    shift.bench.wait(lambda: shift.measurements[-1].status == Measurement.REJECTED_OUTLIER)
    first, again = shift.measurements[-2:]
    assert first.id == again.id > 0 and first.status == Measurement.ACCEPTED
    assert "standard deviations" in again.reason and list(again.unused_targets) == [0]
    shift.bench.wait(lambda: shift.estimates[-1].outliers == 1)
    last = shift.estimates[-1]
    assert last.rejected == 1 and last.configurations == 8 and not last.complete
    assert last.verdict.level in (Verdict.PASS, Verdict.WARN, Verdict.FAIL) and last.condition >= 1.0

    undo = UndoMeasurement.Request(id=again.id)
    answer = shift.bench.call(UndoMeasurement, f"{NAME}/undo_measurement", undo, attempts=1)
    assert (answer.status, answer.id) == (UndoMeasurement.Response.SUCCESS, again.id)
    shift.bench.wait(lambda: shift.measurements[-1].status == Measurement.REJECTED_UNDONE)
    answer = shift.bench.call(UndoMeasurement, f"{NAME}/undo_measurement", undo)
    assert answer.status == UndoMeasurement.Response.UNKNOWN_ID and answer.message


@pytest.mark.parametrize("stamp", [0, -5 * NANO])
def test_messages_without_a_stamp_are_refused_with_a_reason(shift: Shift, planned: Plan, stamp: int) -> None:
    shift.announce(planned)
    state = JointState(name=["q1", "q2"], position=[0.0, 0.0])
    state.header.stamp = Time(sec=stamp // NANO)
    shift.send(shift.joints, state)
    shift.bench.wait(lambda: "stamp" in shift.node._intake.streams[0].reason)
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED


# ── nothing lost ─────────────────────────────────────────────────────────────────────────────────────


def test_what_cannot_be_stored_is_not_accepted(shift: Shift, planned: Plan) -> None:
    shift.announce(planned)
    database = shift.node._session.store._database
    database.execute("PRAGMA query_only = ON")
    refused = shift.rest(planned.configurations[0])
    assert refused.status == Measurement.REJECTED_NOT_STORED and refused.reason.startswith("not stored: ")
    assert refused.id == 0 and not shift.service("reset").success
    answer = shift.bench.call(UndoMeasurement, f"{NAME}/undo_measurement", UndoMeasurement.Request())
    assert answer.status == UndoMeasurement.Response.UNKNOWN_ID
    database.execute("PRAGMA query_only = OFF")
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED


def test_a_configured_again_node_goes_on(bench: Bench, robot: Robot, planned: Plan, tmp_path: Path) -> None:
    shift = Shift(bench, robot, store_folder=str(tmp_path))
    shift.announce(planned)
    for q in planned.configurations:
        assert shift.rest(q).status == Measurement.ACCEPTED
    shift.bench.wait(lambda: shift.estimates[-1].complete)
    before, count = shift.estimates[-1], len(shift.estimates)
    assert shift.service("save").success and shift.service("report").success
    names = {p.name for p in tmp_path.iterdir()}
    assert {"estimate_p.yaml", "measurements_p.csv", "report_p.html"} <= names
    for transition in ("deactivate", "cleanup", "configure", "activate"):
        change(bench, transition)
    bench.wait(lambda: len(shift.estimates) > count)
    after = shift.estimates[-1]
    assert after.complete and after.plan_id == "p"
    assert np.allclose(after.value, before.value, rtol=0, atol=1e-12)


def test_services_of_a_node_that_is_not_active_say_so(bench: Bench) -> None:
    bench.start(IdentifierNode, robot="planar_2r", autostart=False)
    change(bench, "configure")
    for name in ("reset", "undo", "save", "report"):
        answer = bench.call(Trigger, f"{NAME}/{name}", Trigger.Request())
        assert not answer.success and "inactive" in answer.message
    undo = bench.call(UndoMeasurement, f"{NAME}/undo_measurement", UndoMeasurement.Request())
    assert undo.status == UndoMeasurement.Response.NOT_ACTIVE


def test_a_store_of_another_robot_is_refused(bench: Bench, robot: Robot, planned: Plan, tmp_path: Path) -> None:
    shift = Shift(bench, robot, store_folder=str(tmp_path))
    shift.announce(planned)
    shift.rest(planned.configurations[0])
    change(bench, "deactivate")
    change(bench, "cleanup")
    before = (tmp_path / FILE).read_bytes()
    other = bench.start(IdentifierNode, robot="kuka_kr270", store_folder=str(tmp_path))
    assert other.state == "unconfigured" and "planar_2r" in other.failure
    assert (tmp_path / FILE).read_bytes() == before


def test_two_nodes_cannot_share_a_folder(bench: Bench, tmp_path: Path) -> None:
    bench.start(IdentifierNode, robot="planar_2r", store_folder=str(tmp_path))
    second = bench.start(IdentifierNode, robot="planar_2r", store_folder=str(tmp_path))
    assert second.state == "unconfigured" and "another process uses" in second.failure


def test_a_folder_that_cannot_be_opened_yet(bench: Bench, robot: Robot, planned: Plan, tmp_path: Path) -> None:
    (tmp_path / "blocked").write_text("a file where the folder should be")
    shift = Shift(bench, robot, store_folder=str(tmp_path / "blocked"), diagnostics_period=0.05)
    shift.announce(planned)
    assert shift.rest(planned.configurations[0]).status == Measurement.REJECTED_NOT_STORED
    (tmp_path / "blocked").unlink()
    bench.wait(lambda: (c := shift.node._session) is not None and not c.store.trouble)
    assert (tmp_path / "blocked" / FILE).exists()
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED
    assert shift.estimates[-1].plan_id == "p"


def test_two_targets(bench: Bench) -> None:
    robot = Robot.load("planar_2r").with_targets(np.zeros((2, 3))).with_parameters("lengths+offsets", ["tool"])
    bench.start(IdentifierNode, robot="planar_2r", unknown="tool", tracker_topics=["a", "b"])
    assert len(robot.targets) == 2 and len(bench.nodes[0]._session.robot.targets) == 2
    assert {w.name for w in bench.nodes[0]._intake.streams} == {"joint_states", "a", "b"}


def test_simulated_time_that_stands_still_stops_nothing(bench: Bench, robot: Robot, planned: Plan) -> None:
    told = bench.hear(DiagnosticArray, "/diagnostics", EVENTS)
    shift = Shift(bench, robot, use_sim_time=True, diagnostics_period=0.05)
    shift.announce(planned)
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED
    bench.wait(lambda: told)
    assert told[-1].header.stamp.sec == 0
