# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Node ``calibration_planner``: makes plans on request (service and action) and publishes the newest plan.

How a request is answered is in ``planning``, for which robot in ``model``; this file carries the messages. A plan
is made in one of the executor's threads, one request at a time: a second one is answered BUSY. A thread is
enough: while a search fills a core, a request for a parameter is answered within milliseconds, because NumPy
releases the interpreter many times per millisecond.
"""

from __future__ import annotations

import math
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import replace

from calib_planner_msgs.action import PlanCalibration as PlanAction
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import PlanCalibration as PlanService
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.parameter import Parameter
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from calib_planner.errors import CalibPlannerError
from calib_planner.planning import Progress
from calib_planner.ros.lifecycle import ERROR, OK, WARN, Finding, ManagedNode, OneAtATime, reason_of
from calib_planner.ros.markers import plan_markers
from calib_planner.ros.messages import duration_message, in_ros, no_plan, plan_to_message, trajectory_message
from calib_planner.ros.model import TOPIC, Model, ModelSource
from calib_planner.ros.parameters import LATCHED
from calib_planner.ros.planning import Answer, answer, constraints_of, plan_pace
from calib_planner.ros.rclpy_ext.run import run
from calib_planner.ros.settings import PlannerParameters

FEEDBACK_PERIOD = 0.1
"""Shortest time between two feedback messages [s]."""
PATIENCE = 4.0
"""Time that a search gets to end when it is stopped [s]; it looks every few milliseconds."""


class PlannerNode(ManagedNode[PlannerParameters]):
    """The planner as a node."""

    THREADS = 4

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        self._work = OneAtATime()
        super().__init__("calibration_planner", PlannerParameters(), context, overrides)

    def configure(self) -> None:
        """Load the robot, listen for another one, offer planning."""
        chosen = self.settings.value
        self._source = ModelSource(chosen)
        if isinstance(self._source.model, Model):
            constraints_of(chosen, self._source.model.robot)
        self._publishers_of = (
            self.create_publisher(PlanMessage, "~/current_plan", LATCHED),
            self.create_publisher(JointTrajectory, "~/trajectory", LATCHED),
            self.create_publisher(MarkerArray, "~/markers", LATCHED),
        )
        self._source.follow(self, self._on_model, callback_group=MutuallyExclusiveCallbackGroup())
        self.create_service(
            PlanService, "~/request_plan", self._on_request, callback_group=ReentrantCallbackGroup()
        )
        self.create_action_server(PlanAction, "~/plan", self._on_goal)

    def activate(self) -> None:
        """Answer requests."""
        self._work.closing.clear()
        model = self._source.model
        ready = f"ready to plan for {model.robot.name}" if isinstance(model, Model) else str(model)
        self.get_logger().info(ready)

    def deactivate(self) -> None:
        """End a search that is under way."""
        self._work.end(PATIENCE)

    def close(self) -> bool:
        """End everything; returns whether a search ended in time."""
        super().close()
        return self._work.ended

    def _on_model(self, model: Model) -> None:
        self.get_logger().info(f"{TOPIC}: {model.robot.name}, joints {', '.join(model.robot.joint_names)}")

    def _on_request(self, request: PlanService.Request, response: PlanService.Response) -> PlanService.Response:
        with self._work.turn() as mine:
            return self._fill(response, self._answer(mine, request, lambda _: self._work.closing.is_set()))

    def _on_goal(self, goal: ServerGoalHandle) -> PlanAction.Result:
        last = -math.inf

        def progress(state: Progress) -> bool:
            nonlocal last
            if state.seconds - last >= FEEDBACK_PERIOD and not self._work.closing.is_set():
                last = state.seconds
                goal.publish_feedback(feedback_message(state))
            return goal.is_cancel_requested or self._work.closing.is_set()

        with self._work.turn() as mine:
            result = self._answer(mine, goal.request, progress)
            response = self._fill(PlanAction.Result(), result)
            if self.context.ok():
                if goal.is_cancel_requested:
                    goal.canceled()
                elif result.status == "SUCCESS":
                    goal.succeed()
                else:
                    goal.abort()
        return response

    def _answer(
        self,
        mine: bool,
        request: PlanService.Request | PlanAction.Goal,
        callback: Callable[[Progress], bool],
    ) -> Answer:
        """The answer to a request; never an exception."""
        if not self.is_active:
            return Answer("NOT_READY", "", f"the node is {self.state}, not active: activate it")
        if not mine:
            return Answer("BUSY", "", "another request is being worked on: ask again later")
        began = time.perf_counter()
        try:
            result = answer(request.request, self.settings.value, self._source.model, callback)
            if result.plan is not None and self._source.refusal and not request.request.robot:
                result = replace(result, message=f"{result.message}; {self._source.refusal}")
        except Exception as error:
            result = Answer("INTERNAL_ERROR", "", reason_of(error))
        if self.context.ok():
            text = f"{result.status} after {time.perf_counter() - began:.2f} s: {result.message}"
            if result.status == "INTERNAL_ERROR":
                self.get_logger().error(text)
            else:
                self.get_logger().info(text)
            level = {"SUCCESS": OK, "INTERNAL_ERROR": ERROR}.get(result.status, WARN)
            self.outcome("plan", level, in_ros(text))
        return result

    def findings(self) -> Sequence[Finding]:
        """Whether there is a robot, whether a plan is searched, and what came of the newest request."""
        model = self._source.model
        ready = isinstance(model, Model)
        robot = Finding("robot", OK if ready else WARN, f"plans for {self.robot_name}" if ready else str(model))
        searching = Finding("search", OK, "waits for a request" if self._work.ended else "searches a plan")
        return (robot, searching, *self.newest)

    @property
    def robot_name(self) -> str:
        """The robot that is planned for, unless a request names another one."""
        model = self._source.model
        return model.robot.name if isinstance(model, Model) else ""

    def _fill(
        self, response: PlanService.Response | PlanAction.Result, result: Answer
    ) -> PlanService.Response | PlanAction.Result:
        """Put the answer into a response, and publish its plan."""
        if not hasattr(type(response), result.status):  # a service cannot be cancelled: the node was deactivated
            result = Answer("NOT_READY", "", "the node was deactivated while it planned: activate it, ask again")
        response.status = getattr(type(response), result.status)
        response.field, response.message = result.field, in_ros(result.message)
        if result.plan is None or result.model is None:
            response.plan = no_plan()
        else:
            settings, stamp = self.settings.value, self.now
            response.plan = plan_to_message(result.plan, uuid.uuid4().hex[:12], stamp, settings.frame_id)
            if not self._work.closing.is_set():
                self._publish(response.plan, result, stamp)
        return response

    def _publish(self, message: PlanMessage, result: Answer, stamp: int) -> None:
        """Publish the plan; the trajectory and the markers follow, since the client need not wait for them."""
        self._publishers_of[0].publish(message)
        if self.executor is not None:
            self.executor.create_task(self._safe(self._publish_more), result, stamp)

    def _publish_more(self, result: Answer, stamp: int) -> None:
        assert result.plan is not None and result.model is not None
        made, robot, settings = result.plan, result.model.robot, self.settings.value
        _, trajectories, pictures = self._publishers_of
        pace = plan_pace(settings, result.model)
        try:
            trajectories.publish(trajectory_message(made, robot, pace, settings.frame_id))
        except CalibPlannerError as error:
            self.get_logger().error(f"no ~/trajectory: {error}")
        pictures.publish(plan_markers(made, robot, stamp, settings.frame_id))


def feedback_message(state: Progress) -> PlanAction.Feedback:
    """Progress as feedback; NaN stands for what is not known yet."""
    best = state.best_accuracy if math.isfinite(state.best_accuracy) else math.nan
    bound = state.lower_bound or math.nan
    return PlanAction.Feedback(
        best_accuracy=best,
        lower_bound=bound,
        efficiency=bound / best,
        starts_done=state.starts_done,
        starts_total=state.starts_total,
        elapsed=duration_message(state.seconds),
    )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(PlannerNode, PlannerNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
