# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages to values and back, without a node."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from geometry_msgs.msg import Point, PointStamped
from poses import poses
from sensor_msgs.msg import JointState

from calib_planner import IdentificationProblem, Plan, PlanProblem, Robot, identify, plan
from calib_planner.acquisition import Rejection, RejectionReason, Standstill, pick_joints
from calib_planner.arrays import FloatArray
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.identification import STATUS as LIBRARY_ESTIMATE_STATUS
from calib_planner.identification import alternatives, verdict
from calib_planner.planning import Search
from calib_planner.planning.certify.prove import PROOF_STATUS
from calib_planner.planning.result import STATUS as LIBRARY_PLAN_STATUS
from calib_planner.ros import messages as c
from calib_planner.simulation import SimulatedCell, random_deviations


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.load("planar_2r").with_parameters("lengths+offsets")


@pytest.fixture(scope="module")
def planned(robot: Robot) -> Plan:
    return plan(PlanProblem(robot, [[0.3, 0.5], [0.1, 0.2]], 4, search=Search(starts=4)))


@pytest.fixture
def message(planned: Plan) -> PlanMessage:
    return c.plan_to_message(planned, "abc", 5_000_000_007, "base")


def test_every_status_has_a_constant() -> None:
    assert set(LIBRARY_PLAN_STATUS) <= set(c.PLAN_STATUS)
    assert set(LIBRARY_ESTIMATE_STATUS) <= set(c.ESTIMATE_STATUS)
    assert {r.value for r in RejectionReason} <= set(c.MEASUREMENT_STATUS)
    assert len(set(c.MEASUREMENT_STATUS.values())) == len(c.MEASUREMENT_STATUS)
    for message, table, prefix in (
        (PlanMessage, c.PLAN_STATUS, "STATUS_"),
        (CalibrationEstimate, c.ESTIMATE_STATUS, "STATUS_"),
    ):
        names = [n for n in dir(type(message)) + dir(message) if n.startswith(prefix)]
        assert {getattr(message, n) for n in names} == set(table.values())


def test_plan_there_and_back(planned: Plan, message: PlanMessage) -> None:
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 7)
    back = c.plan_from_message(message)
    assert back.plan_id == "abc"
    lost = {"weights", "parameter_std", "general_accuracy", "starts", "evaluations", "unidentifiable"}
    for name, a in planned.values().items():
        b = a if name in lost else back.plan.values()[name]
        if name == "seconds":  # a duration has nanoseconds
            assert abs(a - b) < 1e-9
        else:
            assert np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b, name


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("configurations", poses([0.0, 1.0], [2.0])),
        ("configurations", []),
        ("configurations", poses([math.nan] * 2) * 4),
        ("configurations", poses([math.inf] * 2) * 4),
        ("configurations", poses([0.0, 0.0]) * (c.MOST_ROWS + 1)),
        ("repetitions", [1, 1, 1]),
        ("repetitions", [0, 1, 1, 1]),
        ("repetitions", [4_000_000_000, 1, 1, 1]),
        ("test_poses", poses([0.0, 1.0], [2.0])),
        ("test_poses", poses([0.0, math.nan], [0.0, 0.0])),
        ("predicted_accuracy_per_test_pose", [1.0]),
        ("joint_names", []),
        ("joint_names", ["q1", "q1"]),
        ("sigma", math.nan),
        ("status", 200),
        ("purpose", 9),
        ("status", PlanMessage.STATUS_EMPTY),
    ],
)
def test_bad_plans_are_refused(message: PlanMessage, field: str, value: object) -> None:
    setattr(message, field, value)
    with pytest.raises(InputError) as caught:
        c.plan_from_message(message)
    assert caught.value.field == field or caught.value.field.startswith(f"{field}[")


def joint_state(**values: float) -> JointState:
    return JointState(name=list(values), position=list(values.values()))


def joints(message: JointState, names: Sequence[str]) -> FloatArray:
    return pick_joints(message.name, message.position, names)


def test_joints_in_any_order_with_strangers() -> None:
    found = joints(joint_state(b=2.0, gripper=9.0, a=1.0), ["a", "b"])
    assert found.tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    "state",
    [
        joint_state(a=1.0),
        JointState(),
        JointState(name=["a", "b"], position=[1.0]),
        JointState(name=["a", "b", "a"], position=[1.0, 2.0, 3.0]),
        JointState(name=[f"j{i}" for i in range(10_000)], position=[0.0] * 10_000),
    ],
)
def test_joint_states_that_do_not_fit(state: JointState) -> None:
    with pytest.raises(InputError) as caught:
        joints(state, ["a", "b"])
    assert len(str(caught.value)) < 2000


def test_a_missing_joint_is_named() -> None:
    with pytest.raises(UnknownNameError, match="'b'"):
        joints(joint_state(a=1.0), ["a", "b"])
    nameless = JointState(name=["", "", "a", "a"], position=[0.0] * 4)
    with pytest.raises(UnknownNameError, match="one of: a, got 'b'"):
        joints(nameless, ["b"])
    with pytest.raises(UnknownNameError, match="there are none"):
        joints(JointState(name=["", ""], position=[0.0] * 2), ["b"])


def test_points_and_joints_there_and_back() -> None:
    xyz = np.array([1.0, -2.0, 3.0])
    message = c.point_message(xyz, 1_700_000_000_123_456_789, "tracker")
    assert isinstance(message, PointStamped) and message.header.frame_id == "tracker"
    assert c.nanoseconds(message.header.stamp) == 1_700_000_000_123_456_789
    assert [message.point.x, message.point.y, message.point.z] == xyz.tolist()
    state = c.joints_message(("a", "b"), np.array([0.1, 0.2]), 7)
    assert joints(state, ("b", "a")).tolist() == [0.2, 0.1]


@pytest.mark.parametrize(
    ("stamp", "sec", "nanosec"), [(0, 0, 0), (10**9 - 1, 0, 10**9 - 1), (-5, 0, 0), (10**19, 2**31 - 1, 0)]
)
def test_stamps_always_fit(stamp: int, sec: int, nanosec: int) -> None:
    message = c.stamp_message(stamp)
    assert (message.sec, message.nanosec) == (sec, nanosec)


def test_standstill_to_measurement() -> None:
    points = np.array([[1.0, 2.0, 3.0], [np.nan] * 3])
    found = Standstill(
        10**9, 3 * 10**9, np.array([0.1, 0.2]), points, np.array([1e-5, np.nan]), np.array([20, 0])
    )
    message = c.measurement_message(found, ["a", "b"], "tracker", plan_id="p", index=3, repetition=1)
    assert (message.header.stamp.sec, c.seconds_of(message.duration)) == (2, 2.0)
    assert (message.status, message.configuration_index, message.repetition) == (Measurement.ACCEPTED, 3, 1)
    assert message.points[0] == Point(x=1.0, y=2.0, z=3.0) and math.isnan(message.points[1].x)
    assert message.std[0].z == 1e-5 and list(message.samples) == [20, 0]


def test_rejection_to_measurement() -> None:
    found = Rejection(0, 10**9, RejectionReason.MOVED, "moved", np.array([0.1]), np.array([3]))
    message = c.measurement_message(found, ["a"], "tracker", status="moved", reason="moved")
    assert message.status == Measurement.REJECTED_MOVED and message.reason == "moved"
    assert message.configuration_index == Measurement.UNPLANNED and not message.points


def test_estimate_there_and_back(robot: Robot, planned: Plan) -> None:
    cell = SimulatedCell(robot, random_deviations(robot, 1))
    data = cell.measure(planned.configurations, 2, 1)
    found = identify(IdentificationProblem(robot, data, test_poses=planned.test_poses))
    message = c.estimate_to_message(found, "base_link", plan_id="p", complete=True)
    assert math.isnan(message.validation_rms) and math.isnan(message.validation_predicted_rms)
    assert message.header.frame_id == "base_link"
    assert message.status == CalibrationEstimate.STATUS_OK and message.complete
    assert len(message.covariance) == len(message.parameters) ** 2
    assert message.left_out_rms == found.left_out.rms
    assert message.left_out_predicted_rms == found.left_out.predicted_rms
    assert [(t.name, t.size, t.used) for t in message.terms] == [(t.name, t.size, t.used) for t in found.terms]
    assert message.accuracy_frame == "world" and "placement" in [t.name for t in message.terms]
    assert message.left_out_max == found.left_out.max and len(message.test_poses) == 2
    assert message.verdict.level == c.LEVELS[found.verdict.level]
    assert [r.code for r in message.verdict.reasons] == [r.code for r in found.verdict.reasons]
    back = c.estimate_from_message(message)
    assert back.parameters == found.fit.parameters
    for name in ("nominal", "deviations", "std"):
        assert np.array_equal(getattr(back, name), getattr(found.fit, name))
    message.std = message.std[:-1]
    with pytest.raises(InputError, match="std"):
        c.estimate_from_message(message)


def test_an_estimate_with_infinite_accuracy_travels(robot: Robot, planned: Plan) -> None:
    cell = SimulatedCell(robot, {})
    data = cell.measure(planned.configurations, 1, 1)
    found = identify(IdentificationProblem(robot, data, test_poses=planned.configurations[:1]))
    blind = replace(
        found,
        fit=replace(found.fit, std=np.full(4, np.nan)),
        accuracy=replace(found.accuracy, predicted=np.array([np.inf])),
    )
    assert math.isinf(c.estimate_to_message(blind, "base_link").predicted_accuracy[0])


def test_what_a_message_advises_can_be_done_with_nodes() -> None:
    """No text of a verdict, a test of alternatives or a proof names an option of a command; none is cut."""
    texts = [text for _, said, advice in verdict._TABLE for text in (said, *advice.values())]
    texts += [text for rows in alternatives.TABLE.values() for text in (rows.text, rows.advice)]
    texts += [
        *PROOF_STATUS.values(),
        "add --units cm, and add --degrees",
        "leave out --degrees",
        "add --millimetres",
    ]
    texts += ["leave out --millimetres if the points are in metres, or give the robot's lengths in metres"]
    named = [text for text in texts if "--" in text]
    assert len(named) > 8
    for text in named:
        said = c.in_ros(text)
        assert not re.search("--[a-z]", said) and len(said) > 0.5 * len(text), said
    assert c.in_ros("add --couple j3+=j2 if the controller shows it so") == (
        "declare the coupling j3+=j2 in the robot's YAML (couple:) if the controller shows it so"
    )
    untouched = [text for text in texts if "--" not in text and "calib-planner plan" not in text]
    assert [c.in_ros(text) for text in untouched] == untouched


def test_an_answer_without_a_plan_has_no_numbers() -> None:
    message = c.no_plan()
    assert message.status == PlanMessage.STATUS_EMPTY
    assert all(math.isnan(getattr(message, name)) for name in ("predicted_accuracy", "lower_bound", "efficiency"))
