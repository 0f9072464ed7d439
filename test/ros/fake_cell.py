# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot and an identifier in one, without standstills: what the campaign node talks to, as bad as a test wants.

It takes plans, executes goals at once, and publishes what it "measured" of a robot with true errors.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Duration
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import CalibrationEstimate, JointConfiguration, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from geometry_msgs.msg import Point
from rclpy.action import CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.node import Node

from calib_planner import Robot
from calib_planner.ros.messages import plan_from_message
from calib_planner.ros.parameters import EVENTS, LATCHED
from calib_planner.ros.rclpy_ext.lasting import LastingActionServer
from calib_planner.simulation import SimulatedCell, random_deviations

Answer = Callable[[np.ndarray], str]
KIND = ExecutePlan.Result
STATUS = {
    "refuse": KIND.INVALID_PLAN,
    "abort": KIND.ABORTED,
    "busy": KIND.BUSY,
    "stopped": KIND.STOPPED,
    "beam_lost": KIND.BEAM_LOST,
    "not_ready": KIND.NOT_READY,
    "nonsense": 255,
}


class FakeCell(Node):
    """``answer`` says what becomes of a configuration (joints,):

    ``ok``, ``refuse`` (INVALID_PLAN), a status by its name, ``nonsense`` (no status there is), ``reject``
    (measured, not accepted), ``ignore`` (nothing is published), ``untold`` (measured, but published only when a
    plan comes: the identifier was started anew), ``hang`` (no end, no feedback until cancelled).
    """

    THREADS = 3

    def __init__(self, context: Context | None = None, overrides: object = (), **options: object) -> None:
        super().__init__("fake_cell", context=context)
        self.robot = Robot.load("planar_2r")
        self.cell = SimulatedCell(self.robot, random_deviations(self.robot, 4), 1e-5)
        self.answer: Answer = lambda q: "ok"
        self.takes_plans = True
        self.plans: list[PlanMessage] = []
        self.untold: list[tuple[np.ndarray, dict[str, object]]] = []
        self.visited: list[np.ndarray] = []
        self.number = self.stopped = self.cancels = 0
        self.closing = threading.Event()
        self._plan: PlanMessage | None = None
        self._rng = np.random.default_rng(1)
        self._estimates = self.create_publisher(CalibrationEstimate, "calibration_identifier/estimate", LATCHED)
        self.measurements = self.create_publisher(Measurement, "calibration_identifier/measurements", EVENTS)
        self.create_subscription(PlanMessage, "calibration_campaign/plan", self._on_plan, LATCHED)
        self._server = LastingActionServer(
            self,
            ExecutePlan,
            "tracker_simulator/execute_plan",
            self._execute,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=self._on_cancel,
        )

    def close(self) -> None:
        self.closing.set()
        self._server.destroy()

    def _on_cancel(self, goal: object) -> CancelResponse:
        self.cancels += 1
        return CancelResponse.ACCEPT

    def _on_plan(self, message: PlanMessage) -> None:
        self.plans.append(message)
        if self.takes_plans:
            self._plan = message
            for q, others in self.untold:
                self.publish(q, **others)
            self.untold.clear()
            self._estimates.publish(CalibrationEstimate(plan_id=message.plan_id))

    def _execute(self, goal: object) -> ExecutePlan.Result:
        q = plan_from_message(goal.request.plan).plan.configurations[0]
        self.visited.append(q)
        kind = ExecutePlan.Result
        answer = self.answer(q)
        if answer == "hang":
            while not goal.is_cancel_requested and not self.closing.wait(0.02):
                pass
            if goal.is_cancel_requested:
                self.stopped += 1
                goal.canceled()
            return kind(status=kind.CANCELLED, message="stopped on request")
        if answer in STATUS:
            if answer == "nonsense":
                feedback = ExecutePlan.Feedback(index=2**32 - 1, phase=255)
                feedback.elapsed = Duration(sec=-(2**31), nanosec=2**32 - 1)
                goal.publish_feedback(feedback)
            goal.abort()
            words = "x" * 10**6 if answer == "nonsense" else f"cannot go there: {answer}"
            return kind(status=STATUS[answer], message=words)
        if answer == "untold":
            self.untold.append((q, {}))
        elif answer != "ignore":
            self.publish(q, accepted=answer == "ok")
        goal.succeed()
        return kind(status=kind.SUCCESS, executed=1)

    def point_at(self, q: np.ndarray) -> np.ndarray:
        """(3,) what the tracker measures at ``q`` (joints,) [m]."""
        return self.cell.truth.positions(q[None])[0, 0] + 1e-5 * self._rng.standard_normal(3)

    def publish(
        self, q: np.ndarray, *, accepted: bool = True, number: int | None = None, **others: object
    ) -> None:
        """A measurement at ``q``."""
        plan = self._plan
        rows = plan_from_message(plan).plan.configurations
        self.number = self.number + 1 if number is None else number
        point = self.point_at(q)
        message = Measurement(
            id=self.number,
            plan_id=plan.plan_id,
            configuration_index=int(np.argmin(np.abs(rows - q).max(axis=1))),
            joint_names=list(self.robot.joint_names),
            configuration=JointConfiguration(positions=q.tolist()),
            points=[Point(x=point[0], y=point[1], z=point[2])],
            status=Measurement.ACCEPTED if accepted else Measurement.REJECTED_MOVED,
            reason="" if accepted else "the target moved",
        )
        for name, value in others.items():
            setattr(message, name, value)
        self.measurements.publish(message)
