"""Node ``calibration_planner``: plans on request (service and action) and publishes the newest plan.

Planning runs in a thread of the executor's pool beside everything else, one request at a time: a second one
is told BUSY. What is decided is in ``planning``; this file only carries messages.
"""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections.abc import Callable, Sequence

from calib_planner_msgs.action import PlanCalibration as PlanAction
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import PlanCalibration as PlanService
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from trajectory_msgs.msg import JointTrajectory

from calib_planner.design.planner import Progress
from calib_planner.ros.conversions import plan_to_message, trajectory_message
from calib_planner.ros.parameters import NodeParameters
from calib_planner.ros.planning import Answer, answer
from calib_planner.ros.qos import LATCHED
from calib_planner.ros.run import run
from calib_planner.ros.settings import PlannerParameters, load_shipped

FEEDBACK_PERIOD = 0.1
"""Shortest time between two feedback messages [s]."""


class PlannerNode(Node):
    """See the module."""

    THREADS = 4

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        super().__init__("calibration_planner", context=context, parameter_overrides=list(overrides))
        self.settings = NodeParameters(self, PlannerParameters())
        chosen = self.settings.value
        self._robot = load_shipped(chosen.robot, chosen.parameters, chosen.unknown)
        self._busy = threading.Lock()
        self._closing = threading.Event()
        self._plan_publisher = self.create_publisher(PlanMessage, "~/current_plan", LATCHED)
        self._trajectory_publisher = self.create_publisher(JointTrajectory, "~/trajectory", LATCHED)
        group = ReentrantCallbackGroup()
        self._service = self.create_service(PlanService, "~/request_plan", self._on_request, callback_group=group)
        self._action = ActionServer(
            self,
            PlanAction,
            "~/plan",
            self._on_goal,
            callback_group=group,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        self.get_logger().info(f"ready to plan for {self._robot.name}")

    def close(self) -> bool:
        """End a search that is under way; whether it did within a moment."""
        self._closing.set()
        ended = self._busy.acquire(timeout=4.0)
        if ended:
            self._busy.release()
        return ended

    def _on_request(self, request: PlanService.Request, response: PlanService.Response) -> PlanService.Response:
        result = self._work(request, lambda _: self._closing.is_set())
        return self._fill(response, result)

    def _on_goal(self, goal: ServerGoalHandle) -> PlanAction.Result:
        last = -math.inf

        def progress(state: Progress) -> bool:
            nonlocal last
            if state.seconds - last >= FEEDBACK_PERIOD and not self._closing.is_set():
                last = state.seconds
                goal.publish_feedback(feedback_message(state))
            return goal.is_cancel_requested or self._closing.is_set()

        result = self._work(goal.request, progress)
        response = self._fill(PlanAction.Result(), result)
        if not self._closing.is_set():
            if goal.is_cancel_requested:
                goal.canceled()
            elif result.status == "SUCCESS":
                goal.succeed()
            else:
                goal.abort()
        return response

    def _work(
        self,
        request: PlanService.Request | PlanAction.Goal,
        callback: Callable[[Progress], bool],
    ) -> Answer:
        """The way of every request: one at a time, never an exception."""
        if not self._busy.acquire(blocking=False):
            return Answer("BUSY", "", "another request is being worked on: ask again later")
        began = time.perf_counter()
        try:
            result = answer(request, self.settings.value, self._robot, callback)
        except Exception as error:
            self.get_logger().error(f"planning failed: {error!r}")
            result = Answer("INTERNAL_ERROR", "", f"{type(error).__name__}: {error}")
        finally:
            self._busy.release()
        if not self._closing.is_set():
            seconds = time.perf_counter() - began
            self.get_logger().info(f"{result.status} after {seconds:.2f} s: {result.message}")
        return result

    def _fill(
        self, response: PlanService.Response | PlanAction.Result, result: Answer
    ) -> PlanService.Response | PlanAction.Result:
        """Put the answer into a response, and publish its plan."""
        # A search that the service's node ends itself is no outcome the service has a word for.
        known = hasattr(type(response), result.status)
        response.status = getattr(type(response), result.status if known else "INTERNAL_ERROR")
        response.field, response.message = result.field, result.message
        if result.plan is None:
            response.plan = PlanMessage(status=PlanMessage.STATUS_EMPTY)
        else:
            settings, stamp = self.settings.value, self.get_clock().now().nanoseconds
            name = uuid.uuid4().hex[:12]
            response.plan = plan_to_message(result.plan, name, stamp, settings.frame_id)
            if not self._closing.is_set():
                path = trajectory_message(result.plan, settings.joint_speed, stamp, settings.frame_id)
                self._plan_publisher.publish(response.plan)
                self._trajectory_publisher.publish(path)
        return response


def feedback_message(state: Progress) -> PlanAction.Feedback:
    """Progress as feedback; what is not known yet is NaN."""
    best = state.best_accuracy if math.isfinite(state.best_accuracy) else math.nan
    bound = state.lower_bound or math.nan
    return PlanAction.Feedback(
        best_accuracy=best,
        lower_bound=bound,
        efficiency=bound / best,
        starts_done=state.starts_done,
        starts_total=state.starts_total,
        seconds=state.seconds,
    )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(PlannerNode, PlannerNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
