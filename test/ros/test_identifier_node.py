"""The identifier node fed over real topics by a robot that is not there, in this process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from calib_planner import Plan, PlanProblem, Robot, plan
from calib_planner.instrument.standstill import NANO
from calib_planner.ros.conversions import plan_to_message, point_message, stamp_message
from calib_planner.ros.identifier_node import IdentifierNode
from calib_planner.ros.qos import EVENTS, LATCHED, SENSOR_OUT
from calib_planner.simulation import random_deviations

NAME = "calibration_identifier"
RELIABLE = {
    f"qos_overrides./{topic}.subscription.reliability": "reliable" for topic in ("joint_states", "tracker/point")
}
"""So that a test that counts does not lose messages on a busy machine."""
Estimate = CalibrationEstimate


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.load("planar_2r").with_parameters("lengths+offsets")


@pytest.fixture(scope="module")
def planned(robot: Robot) -> Plan:
    return plan(PlanProblem(robot, [0.3, 0.5], 4, starts=4, sigma=3e-5 / 20**0.5))


class Shift:
    """Publishes standstills, faster than real time: only stamps count."""

    def __init__(self, bench: Bench, robot: Robot, **parameters: Any) -> None:
        self.bench, self.robot, self.stamp = bench, robot, 1_000 * NANO
        self.truth = random_deviations(robot, 4)
        self.true_robot = robot.with_deviations(self.truth)
        self.rng = np.random.default_rng(4)
        create = bench.client.create_publisher
        self.joints = create(JointState, "joint_states", SENSOR_OUT)
        self.points = create(PointStamped, "tracker/point", SENSOR_OUT)
        self.plans = create(PlanMessage, "calibration_planner/current_plan", LATCHED)
        self.estimates = bench.hear(Estimate, f"{NAME}/estimate", LATCHED)
        self.measurements = bench.hear(Measurement, f"{NAME}/measurements", EVENTS)
        self.node = bench.start(IdentifierNode, **({"robot": "planar_2r"} | RELIABLE | parameters))
        self.sent = 0
        bench.wait(lambda: self.joints.get_subscription_count() and self.points.get_subscription_count())
        bench.wait(lambda: self.estimates)

    def announce(self, planned: Plan, plan_id: str = "p") -> None:
        self.plans.publish(plan_to_message(planned, plan_id, 0, "base"))
        self.bench.wait(lambda: self.estimates[-1].plan_id == plan_id)

    def rest(self, q: Any, seconds: float = 0.8, shake: float = 0.0) -> Measurement:
        """Stand still at ``q`` with ``shake`` [m] on the point; returns what became of it."""
        count = len(self.measurements)
        self.stamp += NANO  # the way there: a gap, which ends a standstill
        for i in range(int(seconds * 100)):
            stamp = self.stamp + i * 10**7
            state = JointState(name=["gripper", "q2", "q1"], position=[7.0, float(q[1]), float(q[0])])
            state.header.stamp = stamp_message(stamp)
            self.send(self.joints, state)
            if i % 2:
                xyz = self.true_robot.positions(q)[0, 0] + 3e-5 * self.rng.standard_normal(3)
                xyz[0] += shake * np.sin(i)
                self.send(self.points, point_message(xyz, stamp, "laser"))
        self.stamp += int(seconds * NANO)
        self.bench.wait(lambda: self.sent == self.fed)
        self.tick(q)
        self.bench.wait(lambda: len(self.measurements) > count)
        return self.measurements[-1]

    @property
    def fed(self) -> int:
        """Messages that the node took."""
        return sum(w.messages for w in self.node._intake.watches)

    def send(self, publisher: Any, message: Any, ahead: int = 10) -> None:
        """Publish, and wait until all but the last ``ahead`` messages were taken."""
        publisher.publish(message)
        self.sent += 1
        self.bench.wait(lambda: self.sent - self.fed <= ahead)

    def tick(self, q: Any) -> None:
        """Let time go on: one message of each stream after a gap, elsewhere."""
        for k in (1, 2):
            stamp = self.stamp + k * NANO // 2
            state = JointState(name=["q1", "q2"], position=[float(q[0]) + 0.5, float(q[1])])
            state.header.stamp = stamp_message(stamp)
            self.send(self.joints, state, 0)
            self.send(self.points, point_message(np.zeros(3), stamp, "laser"), 0)
        self.stamp += NANO

    def service(self, name: str) -> Trigger.Response:
        return self.bench.call(Trigger, f"{NAME}/{name}", Trigger.Request())


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
        ("configurations", [1.0]),
        ("configurations", [float("nan")] * 8),
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


def test_a_new_plan_begins_anew(shift: Shift, planned: Plan) -> None:
    shift.announce(planned)
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED
    shift.announce(planned, "second")
    assert shift.estimates[-1].measurements == 0
