# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulator as the controller and the tracker of a cell: real actions and topics, in this process."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from bench import Bench
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import Plan as PlanMessage
from robots import plan_of
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from calib_planner import Robot
from calib_planner.planning import Pace, smooth_trajectory
from calib_planner.ros.executor import check_executable
from calib_planner.ros.messages import plan_to_message
from calib_planner.ros.nodes.executor import ExecutorNode
from calib_planner.ros.nodes.simulator import PREEMPTED, SimulatorNode
from calib_planner.ros.parameters import LATCHED, STREAM_IN
from calib_planner.ros.ways import FollowJointTrajectory, way_to_message

ROBOT = Robot.load("planar_2r")
HOME = ROBOT.joint_limits.mean(axis=1)
Q = np.array([[0.5, -0.3], [0.4, 0.2]])
ARM = "joint_trajectory_controller/follow_joint_trajectory"
needs_control = pytest.mark.skipif(FollowJointTrajectory is None, reason="control_msgs is not installed")


def trajectory(*waypoints: np.ndarray, speed: float = 2.0, **changes: Any) -> JointTrajectory:
    message = way_to_message(smooth_trajectory(np.stack(waypoints), Pace([speed, speed])), ROBOT.joint_names)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


class Cell:
    def __init__(self, bench: Bench, **parameters: Any) -> None:
        self.bench = bench
        self.states = bench.hear(JointState, "joint_states", STREAM_IN)
        self.locked = bench.hear(Bool, "tracker/locked", STREAM_IN)
        self.node = bench.start(SimulatorNode, robot="planar_2r", **parameters)
        bench.wait(lambda: self.states)

    def send(self, message: JointTrajectory, **others: Any) -> Any:
        client = self.bench.action(FollowJointTrajectory, ARM)
        goal = FollowJointTrajectory.Goal(trajectory=message, **others)
        return self.bench.future(client.send_goal_async(goal))

    def end(self, handle: Any) -> Any:
        return self.bench.future(handle.get_result_async())

    @property
    def here(self) -> np.ndarray:
        return np.array(self.states[-1].position)

    def call(self, name: str) -> Any:
        return self.bench.call(Trigger, f"tracker_simulator/{name}", Trigger.Request())


@needs_control
def test_it_follows_a_trajectory_in_its_time(bench: Bench) -> None:
    cell = Cell(bench)
    message = trajectory(HOME, Q[0])
    order = [1, 0]
    message.joint_names = [message.joint_names[k] for k in order]
    for point in message.points:
        point.positions, point.velocities = point.positions[::-1], point.velocities[::-1]
    before = cell.node.now
    answer = cell.end(cell.send(message))
    assert (answer.status, answer.result.error_code) == (GoalStatus.STATUS_SUCCEEDED, 0)
    assert cell.node.now - before >= 1_000_000_000
    bench.wait(lambda: np.allclose(cell.here, Q[0], atol=1e-6))
    seen = np.array([s.position for s in cell.states])
    (dx, dy), way = (seen - HOME).T, Q[0] - HOME
    assert np.abs(dx * way[1] - dy * way[0]).max() < 1e-6 and len(np.unique(seen[:, 0])) > 20, (
        "all joints together, step by step"
    )


@needs_control
def test_cancelled_preempted_and_out_of_tolerance(bench: Bench) -> None:
    cell = Cell(bench)
    first = cell.send(trajectory(HOME, HOME + 1.0, speed=0.2))
    bench.wait(lambda: np.abs(cell.here - HOME).max() > 0.01)
    second = cell.send(trajectory(cell.here, HOME + 1.0, speed=0.2))
    answer = cell.end(first)
    assert answer.status == GoalStatus.STATUS_ABORTED and answer.result.error_string == PREEMPTED
    busy = bench.action(ExecutePlan, "tracker_simulator/execute_plan")
    plan = ExecutePlan.Goal(plan=plan_to_message(plan_of(ROBOT, Q), "p", 0, "base"))
    refused = bench.future(bench.goal(busy, plan).get_result_async()).result
    assert refused.status == refused.BUSY
    bench.future(second.cancel_goal_async())
    assert cell.end(second).status == GoalStatus.STATUS_CANCELED
    bench.wait(
        lambda: len(cell.states) > 40 and np.ptp([s.position for s in cell.states[-20:]], axis=0).max() == 0
    )
    assert not np.allclose(cell.here, HOME + 1.0, atol=0.1)
    jump = trajectory(HOME + 2.0, HOME + 2.1)
    jump.points.insert(0, type(jump.points[0])(positions=(HOME + 2.0).tolist()))
    answer = cell.end(cell.send(jump))
    assert answer.result.error_code == FollowJointTrajectory.Result.PATH_TOLERANCE_VIOLATED
    assert "beyond its path tolerance" in answer.result.error_string


@needs_control
@pytest.mark.parametrize(
    "message",
    [
        trajectory(HOME, Q[0], joint_names=["q1", "q3"]),
        trajectory(HOME, Q[0], points=[]),
        trajectory(HOME, Q[0], joint_names=["q1"]),
        JointTrajectory(joint_names=["q1", "q2"], points=trajectory(HOME, Q[0]).points[3:4]),
        JointTrajectory(joint_names=["q1", "q2"], points=trajectory(HOME, Q[0]).points[-1::-1]),
    ],
    ids=["other joints", "empty", "lengths", "moves at its end", "times"],
)
def test_what_is_no_trajectory_is_refused(bench: Bench, message: JointTrajectory) -> None:
    cell = Cell(bench)
    assert not cell.send(message).accepted
    assert cell.send(trajectory(HOME, Q[0])).accepted


def test_it_says_whether_it_holds_the_target(bench: Bench) -> None:
    cell = Cell(bench, beam_lost_standing=1.0, beam_lost_duration=0.0, joint_speed=50.0)
    bench.wait(lambda: cell.locked and cell.locked[-1].data)
    assert cell.call("restore_beam").message == "the beam was not lost"
    plans = bench.client.create_publisher(PlanMessage, "calibration_planner/current_plan", LATCHED)
    assert "no plan was heard" in cell.call("execute").message
    plans.publish(plan_to_message(plan_of(ROBOT, Q), "p", 0, "base"))
    bench.wait(lambda: cell.node._newest._plan.plan_id)
    answer = cell.call("execute")
    assert answer.success and "executing plan p: 2 configurations" in answer.message
    bench.wait(lambda: not cell.locked[-1].data)
    bench.wait(lambda: cell.node._work.ended)
    plan = ExecutePlan.Goal(plan=plan_to_message(plan_of(ROBOT, Q), "p", 0, "base"))
    client = bench.action(ExecutePlan, "tracker_simulator/execute_plan")
    lost = bench.future(bench.goal(client, plan).get_result_async()).result
    assert lost.status == lost.BEAM_LOST and "bring it back (~/restore_beam)" in lost.message
    assert cell.call("restore_beam").message == "the tracker holds the target again"
    bench.wait(lambda: cell.locked[-1].data)
    assert cell.call("stop").message == "the robot stands already"


def test_stopped_by_a_service(bench: Bench) -> None:
    cell = Cell(bench, joint_speed=0.1)
    client = bench.action(ExecutePlan, "tracker_simulator/execute_plan")
    plan = ExecutePlan.Goal(plan=plan_to_message(plan_of(ROBOT, Q), "p", 0, "base"))
    handle = bench.goal(client, plan)
    bench.wait(lambda: not cell.node._work.ended)
    assert cell.call("stop").message == "the robot stops"
    result = cell.end(handle).result
    assert (result.status, result.message) == (result.STOPPED, "somebody called ~/stop")


def test_stopped_before_it_moves(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = Cell(bench, joint_speed=0.1)
    said: list[str] = []

    def checked(*given: Any) -> None:
        check_executable(*given)
        said.append(cell.node._halt())

    monkeypatch.setattr("calib_planner.ros.nodes.simulator.check_executable", checked)
    client = bench.action(ExecutePlan, "tracker_simulator/execute_plan")
    plan = ExecutePlan.Goal(plan=plan_to_message(plan_of(ROBOT, Q), "p", 0, "base"))
    result = cell.end(bench.goal(client, plan)).result
    assert (said, result.status) == (["the robot stops"], result.STOPPED)
    assert result.message == "somebody called ~/stop"
    monkeypatch.undo()
    handle = bench.goal(client, plan)
    bench.future(handle.cancel_goal_async())
    assert cell.end(handle).result.status == result.CANCELLED, "a stop is of one motion only"


@needs_control
def test_the_executor_drives_the_simulator(bench: Bench) -> None:
    """All defaults but the times: one configuration twice, with its way aside."""
    cell = Cell(bench)
    bench.start(ExecutorNode, robot="planar_2r", joint_speed=3.0, settle=0.2, dwell=0.4)
    client = bench.action(ExecutePlan, "plan_executor/execute_plan")
    plan = ExecutePlan.Goal(plan=plan_to_message(plan_of(ROBOT, Q[:1], 2), "p", 0, "base"))
    result = cell.end(bench.goal(client, plan)).result
    assert (result.status, result.executed) == (result.SUCCESS, 2), result.message
    assert np.allclose(cell.here, Q[0], atol=1e-6)
