"""The simulated robot and tracker over real topics and its action, in this process."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from bench import Bench
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import Plan as PlanMessage
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import JointState

from calib_planner import Plan, PlanProblem, Robot, plan
from calib_planner.instrument.standstill import NANO
from calib_planner.ros.conversions import nanoseconds, plan_to_message
from calib_planner.ros.qos import SENSOR_IN
from calib_planner.ros.simulator_node import SimulatorNode

ACTION = "tracker_simulator/execute_plan"
Result = ExecutePlan.Result


@pytest.fixture(scope="module")
def planned() -> Plan:
    robot = Robot.load("planar_2r").with_parameters("lengths+offsets")
    return plan(PlanProblem(robot, [0.3, 0.5], 3, starts=2))


def goal_of(planned: Plan, **changes: Any) -> ExecutePlan.Goal:
    message = plan_to_message(planned, "p", 0, "base")
    for name, value in changes.items():
        setattr(message, name, value)
    return ExecutePlan.Goal(plan=message, dwell=0.3)


def test_it_visits_every_configuration(bench: Bench, planned: Plan) -> None:
    states = bench.hear(JointState, "joint_states", SENSOR_IN)
    points = bench.hear(PointStamped, "tracker/point", SENSOR_IN)
    bench.start(SimulatorNode, robot="planar_2r", true_deviations="l1=0.002", joint_speed=50.0, sigma=1e-5)
    bench.wait(lambda: states and points)
    feedback: list[Any] = []
    client = bench.action(ExecutePlan, ACTION)
    handle = bench.goal(client, goal_of(planned), feedback_callback=feedback.append)
    result = bench.future(handle.get_result_async(), 20.0)
    assert result.status == GoalStatus.STATUS_SUCCEEDED
    assert (result.result.status, result.result.executed) == (Result.SUCCESS, 3)
    assert {f.feedback.phase for f in feedback} <= {"moving", "measuring"}
    assert {f.feedback.index for f in feedback} == {0, 1, 2}
    q = np.array([s.position for s in states])
    for wanted in planned.configurations:
        assert (np.abs(q - wanted).max(axis=1) < 1e-9).sum() >= 5
    truth = Robot.load("planar_2r").with_deviations({"l1": 0.002})
    last = np.array([points[-1].point.x, points[-1].point.y, points[-1].point.z])
    assert np.allclose(last, truth.positions(planned.configurations[-1])[0, 0], atol=1e-4)
    # A busy machine skips messages; those that come keep to the rates of 100 Hz and 50 Hz.
    for heard, period in ((states, 0.01), (points, 0.02)):
        stamps = np.sort([nanoseconds(m.header.stamp) for m in heard]) / NANO
        assert 0.8 * period < np.median(np.diff(stamps)) < 3.0 * period


@pytest.mark.parametrize(
    "changes",
    [
        {"robot": "kuka_kr270"},
        {"joint_names": ["q2", "q1"]},
        {"configurations": [0.0] * 5},
        {"configurations": [math.nan] * 6},
        {"configurations": [100.0] * 6},
        {"repetitions": [1]},
        {"status": PlanMessage.STATUS_EMPTY},
    ],
    ids=str,
)
def test_bad_plans_are_refused_and_it_stays_up(bench: Bench, planned: Plan, changes: dict[str, Any]) -> None:
    bench.start(SimulatorNode, robot="planar_2r", joint_speed=100.0)
    client = bench.action(ExecutePlan, ACTION)
    handle = bench.goal(client, goal_of(planned, **changes))
    result = bench.future(handle.get_result_async())
    assert result.status == GoalStatus.STATUS_ABORTED
    assert result.result.status == Result.INVALID_PLAN and next(iter(changes)) in result.result.message
    handle = bench.goal(client, goal_of(planned))
    bench.future(handle.cancel_goal_async())
    assert bench.future(handle.get_result_async()).result.status == Result.CANCELLED


def test_one_execution_at_a_time_and_cancel(bench: Bench, planned: Plan) -> None:
    bench.start(SimulatorNode, robot="planar_2r", joint_speed=0.1)
    client = bench.action(ExecutePlan, ACTION)
    feedback: list[Any] = []
    first = bench.goal(client, goal_of(planned), feedback_callback=feedback.append)
    bench.wait(lambda: feedback)
    second = bench.goal(client, goal_of(planned))
    refused = bench.future(second.get_result_async()).result
    assert refused.status == Result.ABORTED and "another plan" in refused.message
    bench.future(first.cancel_goal_async())
    result = bench.future(first.get_result_async())
    assert result.status == GoalStatus.STATUS_CANCELED
    assert (result.result.status, result.result.executed) == (Result.CANCELLED, 0)
