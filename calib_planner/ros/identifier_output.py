"""What the identifier publishes: estimates, measurements, the calibrated URDF, diagnostics."""

from __future__ import annotations

from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String

from calib_planner.identification import Estimate
from calib_planner.io import Decision, calibrated_urdf
from calib_planner.ros.campaign import Campaign, TooFew, condition_of
from calib_planner.ros.conversions import (
    ESTIMATE_STATUS,
    estimate_to_message,
    measurement_message,
    stamp_message,
)
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.model_source import TOPIC
from calib_planner.ros.qos import EVENTS, LATCHED
from calib_planner.ros.settings import IdentifierParameters


class IdentifierOutput:
    """The publishers of the identifier; made in ``configure``."""

    def __init__(self, node: ManagedNode[IdentifierParameters]) -> None:
        self._log = node.get_logger
        self._estimates = node.create_publisher(CalibrationEstimate, "~/estimate", LATCHED)
        self._descriptions = node.create_publisher(String, "~/robot_description", LATCHED)
        self._measurements = node.create_publisher(Measurement, "~/measurements", EVENTS)
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", EVENTS)

    def decision(self, campaign: Campaign, decision: Decision) -> None:
        """What became of a standstill."""
        message = measurement_message(
            decision.found,
            campaign.nominal.joint_names,
            decision.frame or "tracker",
            status=decision.status,
            reason=decision.reason,
            plan_id=campaign.plan_id if decision.index is not None else "",
            index=decision.index,
            repetition=decision.repetition,
            number=decision.number,
            unused=decision.unused,
        )
        self._measurements.publish(message)
        self._log().info(f"configuration {decision.index}: {decision.status} {decision.reason}".rstrip())

    def estimate(self, campaign: Campaign, found: Estimate | TooFew) -> None:
        """What the campaign says now."""
        others = {
            "plan_id": campaign.plan_id,
            "configurations": len(campaign.done()),
            "rejected": campaign.rejections.total(),
            "complete": campaign.complete,
        }
        if isinstance(found, Estimate):
            message = estimate_to_message(found, condition=condition_of(found), **others)
        else:
            message = CalibrationEstimate(
                robot=campaign.robot.name,
                measurements=sum(int((d.standstill.samples > 0).sum()) for d in campaign.accepted),
                condition=float("nan"),
                status=ESTIMATE_STATUS["too_few" if found.missing else "error"],
                message=found.message,
                **others,
            )
            if not found.missing:
                self._log().error(found.message)
        message.header.stamp = stamp_message(campaign.kept[-1].found.stop if campaign.kept else 0)
        self._estimates.publish(message)

    def description(self, urdf: str, found: Estimate | TooFew) -> None:
        """The calibrated URDF, or the nominal one ``urdf`` as long as there is no estimate; nothing without."""
        if urdf and isinstance(found, Estimate):
            urdf = calibrated_urdf(urdf, found.calibrated, TOPIC)[0]
        if urdf:
            self._descriptions.publish(String(data=urdf))

    def diagnostics(self, message: DiagnosticArray) -> None:
        """How it goes."""
        self._diagnostics.publish(message)
