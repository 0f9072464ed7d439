# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Executing plans: which ones a robot can execute, and one ``ExecutePlan`` goal at a time that always ends.

``check_executable`` serves the simulated robot and the adapter of a real one alike.

A goal of ``PlanExecution`` ends with the robot's result, or as *lost*: nothing was heard of it (no answer, no
feedback) for ``silence`` seconds, as the node counts them. A lost goal may be running all the same; it is
cancelled by the id that ``PlanExecution`` gave it, as soon as somebody offers the service. Everything is called
in the executor's thread.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from action_msgs.srv import CancelGoal
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import Plan as PlanMessage
from unique_identifier_msgs.msg import UUID

from calib_planner.arrays import check_number
from calib_planner.errors import CalibPlannerError, InputError, UnknownNameError
from calib_planner.planning import Plan
from calib_planner.robot import Robot
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.messages import duration_message, seconds_of
from calib_planner.ros.parameters import LATCHED
from calib_planner.ros.rclpy_ext.polling import take_answers
from calib_planner.units import cut

ACTION = "~/execute_plan"
LONGEST_DWELL = 600.0
"""Length of a standstill, at most [s]."""
MOST_STANDSTILLS = 100_000
"""Standstills of one plan, at most; at a second each that is more than a day."""
AGAIN = 0.3
"""A request to cancel that is not answered is sent again after this time [s]; an answer takes milliseconds."""
LOOK = 0.01
"""Time between two looks for an answer [s]."""


def check_executable(plan: Plan, robot: Robot) -> None:
    """Refuse a plan that this robot cannot execute.

    Raises:
        InputError: Another robot, other joints, a configuration outside the limits, or too many standstills.
    """
    if plan.robot != robot.name:
        raise UnknownNameError("plan.robot", plan.robot, [robot.name])
    if plan.joint_names != robot.joint_names:
        raise InputError("plan.joint_names", ", ".join(plan.joint_names), ", ".join(robot.joint_names))
    if plan.measurements > MOST_STANDSTILLS:
        expected = f"at most {MOST_STANDSTILLS}"
        raise InputError("plan.repetitions, their sum", plan.measurements, expected, "send it in parts")
    robot.check_within_limits("plan.configurations", plan.configurations)


def dwell_of(goal: ExecutePlan.Goal) -> float:
    """Length of a standstill that a goal wants [s]; 0: the node's default.

    Raises:
        InputError: It is negative or longer than ``LONGEST_DWELL``.
    """
    return check_number(
        "dwell", seconds_of(goal.dwell), low=0.0, high=LONGEST_DWELL, unit="s; 0: the node's default"
    )


def feedback_message(phase: str, index: int, total: int, executed: int, elapsed: float) -> ExecutePlan.Feedback:
    """Feedback about an execution.

    Args:
        phase: Name of a phase's constant.
        index: Row of the configuration under way.
        total: Configurations of the plan.
        executed: Standstills completed.
        elapsed: Time since the execution began [s].
    """
    kind = ExecutePlan.Feedback
    feedback = kind(index=index, total=total, executed=executed, elapsed=duration_message(elapsed))
    feedback.phase = getattr(kind, phase)
    return feedback


class NewestPlan:
    """The service ``~/execute`` of a node that offers ``~/execute_plan``: executes the newest plan.

    It sends the goal as any other client would, so that everybody can watch it; made in ``activate`` of ``node``.

    Args:
        node: Offers the service.
        topic: Where plans are heard.
        check: Raises a ``CalibPlannerError`` that says why a goal would not be executed; returns what it means.
    """

    def __init__(self, node: ManagedNode[Any], topic: str, check: Callable[[ExecutePlan.Goal], str]) -> None:
        self._topic, self._check, self._plan = topic, check, PlanMessage()
        self._client = node.create_action_client(ExecutePlan, ACTION)
        node.create_subscription(PlanMessage, topic, self._on_plan, LATCHED)
        node.create_trigger("~/execute", self._execute)

    def _on_plan(self, message: PlanMessage) -> None:
        self._plan = message

    def _execute(self) -> str:
        goal = ExecutePlan.Goal(plan=self._plan)
        if not self._plan.plan_id:
            raise CalibPlannerError(f"no plan was heard on {self._topic}: have one made, by ~/request_plan")
        words = self._check(goal)
        if not self._client.server_is_ready():
            raise CalibPlannerError("the node has just been started: call it again")
        self._client.send_goal_async(goal)
        return f"executing plan {cut(self._plan.plan_id, 40)}: {words}; ~/stop ends it, the log says how it went"


RESULTS = {
    ExecutePlan.Result.SUCCESS: "done",
    ExecutePlan.Result.INVALID_PLAN: "refused",
    ExecutePlan.Result.CANCELLED: "cancelled",
    ExecutePlan.Result.ABORTED: "aborted",
    ExecutePlan.Result.BUSY: "busy",
    ExecutePlan.Result.STOPPED: "stopped",
    ExecutePlan.Result.BEAM_LOST: "beam_lost",
    ExecutePlan.Result.NOT_READY: "not_ready",
}


@dataclass(frozen=True)
class Ended:
    """How a goal ended: a value of ``RESULTS`` (``busy`` also if it was not accepted) or ``lost``; and why."""

    how: str
    message: str


class PlanExecution:
    """Sends goals to ``action``; made in ``configure`` of ``node``."""

    def __init__(self, node: ManagedNode[Any], action: str) -> None:
        self._client = node.create_action_client(ExecutePlan, action)
        self._canceller = node.create_client(CancelGoal, f"{action}/_action/cancel_goal")
        self._node, self.action = node, action
        self._goal: UUID | None = None
        self._ended: Ended | None = None
        self._heard = 0.0
        self._begun = self._cancelling = False
        self._answers: list[Any] = []

    @property
    def ready(self) -> bool:
        """Whether somebody offers the action."""
        return bool(self._client.server_is_ready())

    @property
    def busy(self) -> bool:
        """Whether a goal is under way."""
        return self._goal is not None

    @property
    def begun(self) -> bool:
        """Whether there was feedback: a robot that accepts a goal need not execute it."""
        return self._begun

    def send(self, goal: ExecutePlan.Goal) -> None:
        """Begin a goal; the one before must have ended."""
        name = UUID(uuid=list(uuid.uuid4().bytes))
        self._goal, self._ended, self._begun, self._cancelling = name, None, False, False
        self._heard = self._node.seconds
        sent = self._client.send_goal_async(goal, lambda _: self._alive(name, begun=True), goal_uuid=name)
        sent.add_done_callback(lambda future: self._answered(name, future))

    def cancel(self) -> None:
        """Ask once for an early end; ``poll`` tells of it."""
        if self._goal is None or self._cancelling:
            return
        self._cancelling = True
        self._heard = self._node.seconds
        self._answers = []
        self._cancel(self._goal)

    def insist(self, seconds: float) -> None:
        """Cancel again until that is answered, at most so long [s], where no executor listens.

        For the end of a node: a request that is under way when its client is destroyed may be lost.
        """
        now = sent = time.monotonic()
        until = now + seconds
        while self._goal is not None and self._cancelling and now < until:
            take_answers(self._canceller)
            if any(future.done() for future in self._answers):
                return
            if now - sent > AGAIN:
                sent = now
                self._cancel(self._goal)
            time.sleep(LOOK)
            now = time.monotonic()

    def poll(self, silence: float) -> Ended | None:
        """How the goal ended, told once; ``None`` while it runs.

        Args:
            silence: Longest time without an answer or feedback [s].
        """
        if self._goal is not None and self._ended is None and self._node.seconds - self._heard > silence:
            self._cancel(self._goal)
            self._ended = Ended("lost", f"nothing heard from {self.action} for {silence:g} s")
        ended = self._ended
        if ended is not None:
            self._goal = self._ended = None
        return ended

    def _alive(self, name: UUID, begun: bool = False) -> None:
        if name is self._goal:
            self._heard = self._node.seconds
            self._begun |= begun

    def _answered(self, name: UUID, future: Any) -> None:
        if name is not self._goal:
            return
        self._alive(name)
        handle = future.result() if future.exception() is None else None
        if handle is None or not handle.accepted:
            self._ended = Ended("busy", f"{self.action} did not accept the goal")
            return
        handle.get_result_async().add_done_callback(lambda result: self._finished(name, result))

    def _finished(self, name: UUID, future: Any) -> None:
        if name is not self._goal or self._ended is not None:
            return
        if future.exception() is not None:
            self._ended = Ended("lost", f"no result from {self.action}")
            return
        result = future.result().result
        how = RESULTS.get(result.status, "aborted")
        self._ended = Ended(how, cut(result.message, 500))

    def _cancel(self, name: UUID) -> None:
        request = CancelGoal.Request()
        request.goal_info.goal_id = name
        if self._canceller.service_is_ready():
            self._answers.append(self._canceller.call_async(request))
