# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The executor over its real action and a controller's real action, in accelerated time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from bench import Bench
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import Plan as PlanMessage
from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import Log
from rclpy.node import Node
from robots import plan_of, repeats
from std_srvs.srv import Trigger

from calib_planner import Robot
from calib_planner.planning import Pace, smooth_trajectory
from calib_planner.ros.execution import Outcome
from calib_planner.ros.messages import plan_to_message
from calib_planner.ros.nodes import executor as executor_module
from calib_planner.ros.nodes.executor import ExecutorNode, Run
from calib_planner.ros.parameters import EVENTS, LATCHED
from calib_planner.ros.ways import way_to_message

pytest.importorskip("control_msgs.action", reason="control_msgs is not installed")

from arm import NEVER, Manner
from fake_controller import ACTION, PREEMPTED, FakeController

ROBOT = Robot.load("planar_2r")
Q = np.array([[0.5, -0.3], [-0.4, 0.6]])
QUICK = {"robot": "planar_2r", "joint_speed": 1.0, "settle": 0.4, "dwell": 0.6, "use_sim_time": True}
PATIENT = {"silence": 5.0, "beam_patience": 1.0}
"""A message that is late by 20 ms is late by 0.2 s in accelerated time."""
Result = ExecutePlan.Result


class Shop:
    """Executor and controller on a bench."""

    def __init__(self, bench: Bench, **parameters: Any) -> None:
        self.bench = bench
        self.controller: FakeController = bench.start(FakeController)
        self.node: ExecutorNode = bench.start(ExecutorNode, **(QUICK | PATIENT | parameters))
        self.client = bench.action(ExecutePlan, "plan_executor/execute_plan")
        self.feedback: list[Any] = []
        bench.wait(lambda: self.node._view.stands or self.controller.deaf)

    def goal(self, times: int = 1, rows: np.ndarray = Q, **changes: Any) -> Any:
        message = plan_to_message(plan_of(ROBOT, rows, times), "p", 0, "base")
        for name, value in changes.items():
            setattr(message, name, value)
        return self.bench.goal(
            self.client, ExecutePlan.Goal(plan=message), feedback_callback=self.feedback.append
        )

    def result(self, handle: Any) -> tuple[str, str, int]:
        """Name of the status, message and number of standstills."""
        answer = self.bench.future(handle.get_result_async())
        result = answer.result
        names = [n for n in dir(Result) if n.isupper() and getattr(Result, n) == result.status]
        ends = {"SUCCESS": GoalStatus.STATUS_SUCCEEDED, "CANCELLED": GoalStatus.STATUS_CANCELED}
        assert answer.status == ends.get(names[0], GoalStatus.STATUS_ABORTED)
        self.bench.wait(lambda: self.node._run is None)
        return names[0], result.message, result.executed

    def run(self, **options: Any) -> tuple[str, str, int]:
        return self.result(self.goal(**options))

    def reach(self, phase: str, visit: int = 0) -> None:
        def there() -> bool:
            it = self.node._run and self.node._run.execution
            return it is not None and (it.phase.name, it.visit) == (phase, visit)

        self.bench.wait(there)

    def call(self, name: str) -> Any:
        return self.bench.call(Trigger, f"plan_executor/{name}", Trigger.Request())


@pytest.fixture
def shop(bench: Bench) -> Iterator[Shop]:
    yield Shop(bench)


def test_it_executes_plans_one_at_a_time(shop: Shop) -> None:
    handle = shop.goal(times=2)
    shop.reach("MOVING")
    assert shop.result(shop.goal()) == ("BUSY", "another plan is being executed: wait for it or cancel it", 0)
    status, message, executed = shop.result(handle)
    assert (status, executed) == ("SUCCESS", 4), message
    assert len(shop.controller.goals) == 4 and shop.controller.cancels == 0
    last = shop.controller.goals[-1].trajectory
    assert last.joint_names == ["q1", "q2"] and np.allclose(last.points[-1].positions, Q[1])
    assert (last.header.stamp.sec, last.header.stamp.nanosec) == (0, 0)
    phases = {f.feedback.phase for f in shop.feedback}
    assert {f.feedback.index for f in shop.feedback} == {0, 1} and len(phases) >= 2


def test_the_newest_plan_by_a_service(shop: Shop) -> None:
    refused = shop.call("execute")
    assert not refused.success and "no plan was heard on calibration_planner/current_plan" in refused.message
    plans = shop.bench.client.create_publisher(PlanMessage, "calibration_planner/current_plan", LATCHED)
    plans.publish(plan_to_message(plan_of(Robot.load("ur10e"), np.zeros((1, 6))), "other", 0, "base"))
    shop.bench.wait(lambda: shop.node._newest._plan.plan_id == "other")
    refused = shop.call("execute")
    assert not refused.success and "plan.robot" in refused.message
    plans.publish(plan_to_message(plan_of(ROBOT, Q), "mine", 0, "base"))
    shop.bench.wait(lambda: shop.node._newest._plan.plan_id == "mine")
    answer = shop.call("execute")
    assert answer.success and "executing plan mine: 2 configurations, 2 standstills, about" in answer.message
    shop.reach("MOVING")
    again = shop.call("execute")
    assert not again.success and "another plan" in again.message
    shop.bench.wait(lambda: shop.node._run is None)
    assert np.allclose(shop.controller.joints, Q[1])


BAD = [
    (Manner(refuse=True), "NOT_READY", "the controller refused the move: is it active"),
    (Manner(answer=NEVER), "ABORTED", "does not answer"),
    (Manner(failure="q1: 0.3 rad"), "ABORTED", "it was aborted, PATH_TOLERANCE_VIOLATED (-4), q1: 0.3 rad"),
    (Manner(result=NEVER), "ABORTED", "does not report the end"),
    (Manner(rate=0.0), "ABORTED", "q2 is at 0.2000 rad"),
    (Manner(rate=0.4), "ABORTED", "rad are allowed"),
    (Manner(beyond=0.4), "ABORTED", "rad are allowed"),
]
"""How a controller may behave, the status that follows and words of its message; `test_execution` has more."""


@pytest.mark.parametrize(("manner", "status", "words"), BAD[: repeats(5, 7)])
def test_a_bad_controller(shop: Shop, manner: Manner, status: str, words: str) -> None:
    shop.controller.manner = manner
    got = shop.run()
    assert got[0] == status and words in got[1], got
    assert len(shop.controller.goals) == 1


def test_good_and_bad_ends_of_one_node(shop: Shop) -> None:
    """What ends well is logged otherwise than what does not; rclpy refuses both from one line of code."""
    assert shop.run()[0] == "SUCCESS"
    shop.controller.manner = Manner(answer=NEVER)
    assert shop.run(rows=Q[::-1])[0] == "ABORTED"


def test_a_late_controller(shop: Shop) -> None:
    shop.controller.manner = Manner(answer=3.0, result=3.0)
    assert shop.run()[0] == "SUCCESS"


def test_who_accepts_too_late_is_cancelled(shop: Shop) -> None:
    shop.controller.manner = Manner(answer=14.0, delay=0.5)
    before = shop.controller.joints
    assert "does not answer" in shop.run()[1]
    shop.bench.wait(lambda: shop.controller.cancels)
    shop.controller.manner = Manner()
    assert np.abs(shop.controller.joints - before).max() < 0.1


def test_preempted_by_somebody_else(shop: Shop) -> None:
    handle = shop.goal()
    shop.reach("MOVING")
    shop.bench.wait(lambda: shop.controller.goals and shop.controller.arm.way is not None)
    other = shop.bench.action(executor_module.FollowJointTrajectory, ACTION)
    shop.bench.goal(other, shop.controller.goals[0])
    status, message, executed = shop.result(handle)
    assert (status, executed) == ("ABORTED", 0) and PREEMPTED in message, message


@pytest.mark.parametrize("phase", ["MOVING", "MEASURING"])
def test_stopped_cancelled_or_without_a_beam(shop: Shop, phase: str) -> None:
    shop.controller.locked = True
    shop.bench.wait(lambda: shop.node._view.beams[0].locked)
    handle = shop.goal(times=3)
    shop.reach(phase)
    answer = shop.call("stop")
    assert answer.success and answer.message.startswith("somebody called ~/stop; the robot stands"), answer
    assert shop.result(handle)[0] == "STOPPED"
    handle = shop.goal(times=3)
    shop.reach(phase)
    shop.bench.future(handle.cancel_goal_async())
    status, message, _ = shop.result(handle)
    assert status == "CANCELLED" and message.startswith("stopped on request; the robot stands")
    handle = shop.goal(times=3)
    shop.reach(phase)
    shop.controller.locked = False
    status, message, _ = shop.result(handle)
    assert status == "BEAM_LOST" and "tracker/locked: the tracker has lost the reflector" in message
    goals = len(shop.controller.goals)
    status, message, _ = shop.run()
    assert status == "NOT_READY" and "bring the beam back" in message and len(shop.controller.goals) == goals
    shop.controller.locked = None
    assert shop.call("stop").message == "nothing is being executed"


def test_a_robot_that_does_not_stop(bench: Bench) -> None:
    shop = Shop(bench, joint_speed=0.1, patience=2.0)
    shop.controller.manner = Manner(halts=False)
    handle = shop.goal(rows=np.array([[2.0, -2.0]]), times=1)
    bench.wait(lambda: shop.controller.joints[0] > 0.2)
    answer = shop.call("stop")
    assert not answer.success and "THE ROBOT STILL MOVES" in answer.message
    assert "THE ROBOT STILL MOVES" in shop.result(handle)[1]


def test_every_end_is_said_in_its_severity(shop: Shop) -> None:
    logs = shop.bench.hear(Log, "/rosout", EVENTS)
    shop.bench.wait(lambda: shop.bench.client.count_publishers("/rosout"))
    node = shop.node
    for status, alarm, severity in (("SUCCESS", False, 20), ("ABORTED", False, 30), ("STOPPED", True, 40)):

        def said(status: str = status, alarm: bool = alarm, severity: int = severity) -> bool:
            node._finish(Run(ExecutePlan.Goal(), 0.0), Outcome(status, "some words", alarm))
            return any(m.msg == f"{status}: some words" and m.level == severity for m in logs)

        shop.bench.wait(said)


def test_step_by_step(bench: Bench) -> None:
    shop = Shop(bench, step=True)
    handle = shop.goal()
    for number in range(2):
        shop.reach("CONFIRMING", number)
        assert len(shop.controller.goals) == number
        assert shop.call("confirm").message == "confirmed: the robot moves"
    assert shop.result(handle)[0] == "SUCCESS"
    assert shop.call("confirm").message == "nothing is being executed: send a plan, or call ~/execute"


def test_silence_ends_it(bench: Bench) -> None:
    shop = Shop(bench, silence=2.0)
    handle = shop.goal(times=3)
    shop.reach("MOVING")
    shop.controller.deaf = True
    status, message, _ = shop.result(handle)
    assert status == "ABORTED" and "the newest joint state is" in message
    assert "WHETHER THE ROBOT STANDS IS NOT KNOWN" in message
    status, message, _ = shop.run()
    assert status == "NOT_READY" and "the newest joint state is" in message


def test_bad_plans(shop: Shop) -> None:
    for changes, words in (
        ({"robot": "ur10e"}, "plan.robot"),
        ({"joint_names": ["q2", "q1"]}, "plan.joint_names"),
        ({"repetitions": [1]}, "repetitions"),
    ):
        status, message, executed = shop.run(**changes)
        assert (status, executed) == ("INVALID_PLAN", 0) and words in message
    assert not shop.controller.goals


def test_without_a_controller(bench: Bench) -> None:
    shop = Shop(bench, controller_action="elsewhere/follow_joint_trajectory")
    status, message, _ = shop.run()
    assert status == "NOT_READY"
    assert message == "nobody offers elsewhere/follow_joint_trajectory: is the controller active?"


def test_without_control_msgs(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor_module, "FollowJointTrajectory", None)
    shop = Shop(bench)
    status, message, _ = shop.run()
    assert status == "NOT_READY" and "sudo apt install ros-$ROS_DISTRO-control-msgs" in message


def test_deactivated_while_it_moves(shop: Shop) -> None:
    shop.goal()
    shop.reach("MOVING")
    shop.bench.wait(lambda: shop.controller.arm.way is not None)
    run = shop.node._run
    assert shop.bench.change_state("plan_executor", Transition.TRANSITION_DEACTIVATE)
    assert run is not None and run.outcome is not None
    assert run.outcome.message.startswith("the node was deactivated; the robot stands")
    assert shop.controller.cancels


# ── MoveIt ───────────────────────────────────────────────────────────────────────────────────────────


class FakeMoveIt(Node):
    """Answers requests for ways, with a detour and a joint that stands still; ``code`` is its error code."""

    def __init__(self, context: Any = None, overrides: object = (), **options: Any) -> None:
        from moveit_msgs.srv import GetMotionPlan

        super().__init__("fake_moveit", context=context)
        self.code, self.requests = 1, []  # type: ignore[var-annotated]
        self.create_service(GetMotionPlan, "plan_kinematic_path", self._answer)

    def _answer(self, request: Any, response: Any) -> Any:
        wanted = request.motion_plan_request
        self.requests.append(wanted)
        answer = response.motion_plan_response
        answer.error_code.val = self.code
        start = np.array(wanted.start_state.joint_state.position)
        goal = np.array([c.position for c in wanted.goal_constraints[0].joint_constraints])
        middle = 0.5 * (start + goal) + 0.05
        way = way_to_message(smooth_trajectory([start, middle, goal], Pace([3.0, 3.0])), ["q1", "q2"])
        for point in way.points:  # in another order, with a joint that stands still
            point.positions = [9.0, point.positions[1], point.positions[0]]
            point.velocities = []
        way.joint_names = ["gripper", "q2", "q1"]
        answer.trajectory.joint_trajectory = way
        return response


def test_moveit_plans_every_move(bench: Bench) -> None:
    pytest.importorskip("moveit_msgs.srv", reason="moveit_msgs is not installed")
    shop = Shop(bench, moveit_group="manipulator", speed_share=0.5)
    status, message, _ = shop.run()
    assert status == "NOT_READY" and "nobody offers plan_kinematic_path: start move_group" in message
    moveit = bench.start(FakeMoveIt)
    bench.wait(shop.node._ways.service_is_ready)
    status, message, executed = shop.run(times=2)
    assert (status, executed) == ("SUCCESS", 4), message
    assert len(moveit.requests) == 6, "there, aside and back, and the same again"
    first = moveit.requests[0]
    assert first.group_name == "manipulator" and first.max_velocity_scaling_factor == 0.5
    sent = shop.controller.goals[0].trajectory
    assert sent.joint_names == ["q1", "q2"]
    assert max(abs(v) for p in sent.points for v in p.velocities) < 0.5 * 1.01, "no faster than half of 1 rad/s"
    moveit.code = -12
    status, message, _ = shop.run(rows=Q[:1])
    assert status == "ABORTED" and "no way there was planned: MoveIt says GOAL_IN_COLLISION (-12)" in message


def test_without_moveit_msgs(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor_module, "GetMotionPlan", None)
    shop = Shop(bench, moveit_group="manipulator")
    status, message, _ = shop.run()
    assert status == "NOT_READY" and "sudo apt install ros-$ROS_DISTRO-moveit-msgs" in message
