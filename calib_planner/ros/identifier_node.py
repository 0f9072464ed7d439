"""Node ``calibration_identifier``: hears joints and tracker points, publishes the calibrated parameters.

Standstills are found by ``instrument.standstill``, matched to the plan and identified by ``campaign``; this
file only carries messages. Identification takes some 10 ms and runs in the callback that completes a
standstill.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from geometry_msgs.msg import PointStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from calib_planner.design.plan import Plan
from calib_planner.errors import CalibPlannerError, InputError
from calib_planner.instrument.standstill import Rejection, Standstill, StandstillDetector
from calib_planner.robot.chain import Robot
from calib_planner.ros import saving
from calib_planner.ros.campaign import Campaign, Decision, Matching, TooFew
from calib_planner.ros.conversions import (
    ESTIMATE_STATUS,
    estimate_to_message,
    joints_from_message,
    measurement_message,
    nanoseconds,
    plan_from_message,
    point_from_message,
    stamp_message,
)
from calib_planner.ros.parameters import NodeParameters
from calib_planner.ros.qos import EVENTS, LATCHED, SENSOR_IN
from calib_planner.ros.run import run
from calib_planner.ros.settings import IdentifierParameters, load_shipped


class IdentifierNode(Node):
    """See the module."""

    THREADS = 1

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        super().__init__("calibration_identifier", context=context, parameter_overrides=list(overrides))
        self.settings = NodeParameters(self, IdentifierParameters())
        chosen = self.settings.value
        self._campaign = Campaign(_robot(chosen, chosen.parameters or "lengths+offsets"), self._follow)
        robot = self._campaign.nominal
        self._detector = StandstillDetector(len(robot.joint_names), len(robot.targets), chosen.standstill)
        self._frame = "tracker"
        self._newest = 0
        self._estimate_publisher = self.create_publisher(CalibrationEstimate, "~/estimate", LATCHED)
        self._measurement_publisher = self.create_publisher(Measurement, "~/measurements", EVENTS)
        self._inputs = [
            self.create_subscription(PlanMessage, chosen.plan_topic, self._on_plan, LATCHED),
            self.create_subscription(JointState, "joint_states", self._on_joints, SENSOR_IN),
        ]
        for k, topic in enumerate(chosen.tracker_topics):
            hear = partial(self._on_point, k)
            self._inputs.append(self.create_subscription(PointStamped, topic, hear, SENSOR_IN))
        actions = {"reset": self._reset, "undo": self._undo, "save": self._save}
        self._offers = [
            self.create_service(Trigger, f"~/{name}", partial(self._serve, action))
            for name, action in actions.items()
        ]
        self._publish_estimate()
        self.get_logger().info(f"ready to identify {robot.name}")

    @property
    def _how(self) -> Matching:
        s = self.settings.value
        return Matching(s.plan_tolerance, s.accept_unplanned, s.sigma, s.repeatability, s.most_measurements)

    def _follow(self, plan: Plan) -> Robot:
        chosen = self.settings.value
        return _robot(chosen, chosen.parameters or ",".join(plan.parameters))

    # ── what comes in ────────────────────────────────────────────────────────────────────────────────

    def _on_plan(self, message: PlanMessage) -> None:
        dropped = len(self._campaign.accepted)
        try:
            received = plan_from_message(message)
            if not self._campaign.begin(received.plan_id, received.plan):
                return
        except CalibPlannerError as error:
            self.get_logger().error(f"plan {message.plan_id[:40]!r} refused: {error}")
            return
        if dropped:
            self.get_logger().warning(f"new plan: {dropped} measurements of the previous one dropped")
        self.get_logger().info(f"plan {message.plan_id[:40]!r}: {received.plan.measurements} measurements")
        self._publish_estimate()

    def _on_joints(self, message: JointState) -> None:
        try:
            joints = joints_from_message(message, self._campaign.nominal.joint_names)
        except InputError as error:
            self.get_logger().warning(f"joint_states: {error}", throttle_duration_sec=5.0)
            return
        self._handle(self._detector.add_joints(nanoseconds(message.header.stamp), joints))

    def _on_point(self, target: int, message: PointStamped) -> None:
        self._frame = message.header.frame_id or self._frame
        stamp = nanoseconds(message.header.stamp)
        self._handle(self._detector.add_point(target, stamp, point_from_message(message)))

    # ── what goes out ────────────────────────────────────────────────────────────────────────────────

    def _handle(self, results: list[Standstill | Rejection]) -> None:
        for found in results:
            if isinstance(found, Rejection):
                self._campaign.rejected += 1
                self._publish_measurement(found, found.reason.value, found.message)
                continue
            decision = self._campaign.take(found, self._how)
            self._publish_decision(decision)
            if decision.status == "accepted":
                self._newest = found.stop
                self._publish_estimate()

    def _publish_decision(self, decision: Decision) -> None:
        self._publish_measurement(
            decision.found, decision.status, decision.reason, decision.index, decision.repetition
        )

    def _publish_measurement(
        self,
        found: Standstill | Rejection,
        status: str,
        reason: str,
        index: int | None = None,
        repetition: int = 0,
    ) -> None:
        message = measurement_message(
            found,
            self._campaign.nominal.joint_names,
            self._frame,
            status=status,
            reason=reason,
            plan_id=self._campaign.plan_id if index is not None else "",
            index=index,
            repetition=repetition,
        )
        self._measurement_publisher.publish(message)
        self.get_logger().info(f"configuration {index}: {status} {reason}".rstrip())

    def _publish_estimate(self) -> None:
        campaign = self._campaign
        others = {
            "plan_id": campaign.plan_id,
            "configurations": len(campaign.done()),
            "rejected": campaign.rejected,
            "complete": campaign.complete,
        }
        try:
            found = campaign.estimate(self._how)
        except (CalibPlannerError, ArithmeticError, ValueError) as error:
            self.get_logger().error(f"identification failed: {error}")
            found = TooFew(0, str(error))
        if isinstance(found, TooFew):
            message = CalibrationEstimate(
                robot=campaign.robot.name,
                measurements=len(campaign.accepted),
                status=ESTIMATE_STATUS["too_few" if found.missing else "error"],
                message=found.message,
                **others,
            )
        else:
            message = estimate_to_message(found, **others)
        message.header.stamp = stamp_message(self._newest)
        self._estimate_publisher.publish(message)

    # ── services ─────────────────────────────────────────────────────────────────────────────────────

    def _serve(self, action: object, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message, response.success = action(), True  # type: ignore[operator]
        except (CalibPlannerError, OSError) as error:
            response.message, response.success = str(error), False
        return response

    def _reset(self) -> str:
        count = self._campaign.reset()
        self._publish_estimate()
        return f"{count} measurements forgotten"

    def _undo(self) -> str:
        withdrawn = self._campaign.undo()
        if withdrawn is None:
            raise InputError("undo", "no measurement", "a measurement to withdraw", "measure first")
        self._publish_decision(withdrawn)
        self._publish_estimate()
        return f"measurement {withdrawn.repetition} of configuration {withdrawn.index} withdrawn"

    def _save(self) -> str:
        paths = saving.save(self.settings.value.save_folder, self._campaign, self._how)
        return "saved " + ", ".join(map(str, paths))


def _robot(settings: IdentifierParameters, parameters: str) -> Robot:
    return load_shipped(settings.robot, parameters, settings.unknown, len(settings.tracker_topics))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(IdentifierNode, IdentifierNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
