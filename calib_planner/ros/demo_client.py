"""The demo's own node: asks for a plan, has it executed, follows the estimates.

Calls are repeated with a time-out, since an answer can be published before discovery has matched its reader.
Nothing waits without a deadline.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import PlanCalibration
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from calib_planner.errors import CalibPlannerError, InfeasibleError
from calib_planner.ros.qos import EVENTS, LATCHED

ATTEMPT = 8.0
"""Seconds after which an unanswered call is repeated."""
NOT_YET = (PlanCalibration.Response.BUSY, PlanCalibration.Response.NOT_READY)
"""Answers of a planner that is still planning or not active yet: asked again after a pause."""
PAUSE = 0.3
"""That pause [s]."""


class DemoClient:
    """Talks to the three nodes; spins itself while it waits.

    Args:
        domain: ROS domain id.
        check: Called while waiting; raises if something is wrong, e.g. a node has ended.
        name: Of the node.
    """

    def __init__(
        self, domain: int, check: Callable[[], None] = lambda: None, name: str = "calibration_demo"
    ) -> None:
        self._check = check
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self._node = Node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.estimate: CalibrationEstimate | None = None
        self.measurements: list[Measurement] = []
        self.feedback: ExecutePlan.Feedback | None = None
        create = self._node.create_subscription
        create(CalibrationEstimate, "calibration_identifier/estimate", self._on_estimate, LATCHED)
        create(Measurement, "calibration_identifier/measurements", self.measurements.append, EVENTS)
        self._plan = self._node.create_client(PlanCalibration, "calibration_planner/request_plan")
        self._save = self._node.create_client(Trigger, "calibration_identifier/save")
        self._execute = ActionClient(self._node, ExecutePlan, "tracker_simulator/execute_plan")

    def close(self) -> None:
        """Leave the graph."""
        self._execute.destroy()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait(self, condition: Callable[[], bool], seconds: float, what: str = "") -> bool:
        """Spin until ``condition``; ``False`` after ``seconds``, or an error if ``what`` names the thing."""
        deadline = time.monotonic() + seconds
        while not condition():
            self._check()
            if time.monotonic() > deadline:
                if what:
                    raise CalibPlannerError(f"no {what} within {seconds:g} s")
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def request_plan(self, request: PlanCalibration.Request, seconds: float = 90.0) -> PlanMessage:
        """A plan for ``request``.

        Raises:
            InfeasibleError: The planner refused; says why.
        """
        response = self._call(self._plan, request, seconds, "plan")
        if response.status != PlanCalibration.Response.SUCCESS:
            raise InfeasibleError(response.field or "request", response.message)
        return response.plan

    def save(self, seconds: float = 20.0) -> str:
        """Have the identifier save; returns what it says."""
        response = self._call(self._save, Trigger.Request(), seconds, "answer from save")
        if not response.success:
            raise CalibPlannerError(f"saving failed: {response.message}")
        return str(response.message)

    def identifier_has(self, plan_id: str) -> bool:
        """Whether the identifier has taken the plan."""
        return self.estimate is not None and self.estimate.plan_id == plan_id

    def measured(self, plan: PlanMessage) -> list[int]:
        """Accepted measurements per configuration."""
        counts = [0] * len(plan.repetitions)
        for m in self.measurements:
            if m.plan_id == plan.plan_id and m.status == Measurement.ACCEPTED:
                counts[m.configuration_index] += 1
        return counts

    def complete(self, plan: PlanMessage) -> bool:
        """Whether the newest estimate covers the whole plan."""
        return self.identifier_has(plan.plan_id) and bool(self.estimate.complete)  # type: ignore[union-attr]

    def execute(self, plan: PlanMessage, seconds: float, on_progress: Callable[[], None] = lambda: None) -> None:
        """Have a plan measured until the estimate covers it; what was missed is done again.

        Raises:
            CalibPlannerError: The simulator refused, or time ran out.
        """
        deadline = time.monotonic() + seconds

        def progressing() -> bool:
            on_progress()
            return self.complete(plan)

        self.wait(self._execute.server_is_ready, 30.0, "simulator (tracker_simulator/execute_plan)")
        while not self.complete(plan) and time.monotonic() < deadline:
            result = self._run(self._missing(plan), progressing, deadline)
            if result is not None and result.status == ExecutePlan.Result.INVALID_PLAN:
                raise CalibPlannerError(f"the simulator refused the plan: {result.message}")
            self.wait(progressing, 2.0)
        if not self.complete(plan):
            reasons = {m.reason for m in self.measurements if m.reason}
            text = f"only {sum(self.measured(plan))} measurements after {seconds:g} s"
            raise CalibPlannerError(f"{text}; {'; '.join(sorted(reasons))}")

    def _run(self, plan: PlanMessage, done: Callable[[], bool], deadline: float) -> ExecutePlan.Result | None:
        """One execution to its end; ``None`` if nobody answered."""
        self.feedback = None
        sent = self._execute.send_goal_async(ExecutePlan.Goal(plan=plan), feedback_callback=self._on_feedback)
        self.wait(lambda: sent.done() or done(), ATTEMPT)
        if not sent.done() or sent.result() is None:
            # Unanswered: if it runs all the same, its end shows in the estimates.
            self.wait(done, ATTEMPT)
            return None
        finished = sent.result().get_result_async()
        self.wait(lambda: finished.done() or done(), max(deadline - time.monotonic(), 0.0))
        return finished.result().result if finished.done() else None

    def _missing(self, plan: PlanMessage) -> PlanMessage:
        """The part of a plan that was not measured yet."""
        n = len(plan.joint_names)
        left = [max(r - c, 0) for r, c in zip(plan.repetitions, self.measured(plan), strict=True)]
        rows = [i for i, count in enumerate(left) if count] or list(range(len(left)))
        part = PlanMessage(
            plan_id=plan.plan_id,
            robot=plan.robot,
            parameters=plan.parameters,
            joint_names=plan.joint_names,
            configurations=[x for i in rows for x in plan.configurations[i * n : (i + 1) * n]],
            repetitions=[max(left[i], 1) for i in rows],
            sigma=plan.sigma,
        )
        return part

    def _call(self, client: Any, request: Any, seconds: float, what: str) -> Any:
        deadline = time.monotonic() + seconds
        self.wait(client.service_is_ready, seconds, f"service {client.srv_name}")
        while time.monotonic() < deadline:
            future = client.call_async(request)
            if self.wait(future.done, ATTEMPT):
                response = future.result()
                later = time.monotonic() + PAUSE < deadline
                if not later or getattr(response, "status", 0) not in NOT_YET:
                    return response
                self.wait(lambda: False, PAUSE)
            client.remove_pending_request(future)
        raise CalibPlannerError(f"no {what} within {seconds:g} s")

    def _on_estimate(self, message: CalibrationEstimate) -> None:
        self.estimate = message

    def _on_feedback(self, message: Any) -> None:
        self.feedback = message.feedback
