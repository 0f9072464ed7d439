"""What the identifier publishes: estimates, measurements, the calibrated URDF, diagnostics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial

from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import UndoMeasurement
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from calib_planner import __version__
from calib_planner.acquisition import Intake, Rejection, Standstill
from calib_planner.errors import CalibPlannerError, InputError, StoreError
from calib_planner.identification import Estimate
from calib_planner.io import ACCEPTED, Decision, UnavailableStore, calibrated_urdf, open_store
from calib_planner.ros import session
from calib_planner.ros.diagnostics import diagnostics, health
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.messages import (
    ESTIMATE_STATUS,
    ReceivedPlan,
    estimate_to_message,
    measurement_message,
    plan_from_message,
    stamp_message,
)
from calib_planner.ros.model import TOPIC, IdentifiedModel, first_model, heard_model
from calib_planner.ros.qos import EVENTS, LATCHED, STREAM_IN
from calib_planner.ros.rclpy_ext.polling import Stream, StreamPoller
from calib_planner.ros.rclpy_ext.run import run
from calib_planner.ros.session import Campaign, Matching, TooFew, condition_of
from calib_planner.ros.settings import IdentifierParameters
from calib_planner.units import brief, cut


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


# ── Node ``calibration_identifier``: hears joints and tracker points, publishes the calibrated parameters ───
# Standstills are found in ``acquisition.Intake``, matched, stored and identified in ``session``, which
# saves them, too; this file only carries messages. All callbacks take turns in one thread: a standstill costs a
# commit to disk and an identification, some 20 ms together, for which the queues of the streams are deep enough
# by far.
#
# A measurement is acknowledged on ``~/measurements`` after it is on the disk. As long as that cannot be written,
# standstills are rejected as not stored and the node goes on; the next standstill tries again.

JOINTS = "joint_states"


class IdentifierNode(ManagedNode[IdentifierParameters]):
    """See the module."""

    THREADS = 1

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        self._model: IdentifiedModel | None = None
        self._campaign: Campaign | None = None
        self._intake: Intake | None = None
        self._plan: ReceivedPlan | None = None
        self._waiting = f"no robot yet: publish a URDF on {TOPIC} (latched), or set the parameter robot"
        super().__init__("calibration_identifier", IdentifierParameters(), context, overrides)

    # ── lifecycle ────────────────────────────────────────────────────────────────────────────────────

    def configure(self) -> None:
        """Load the robot and the campaign in the store, offer services, listen for plans and streams."""
        chosen = self.settings.value
        if not chosen.store_folder:
            text = "the campaign is in memory only and lost with the node: set store_folder to keep it"
            self.get_logger().warning(text)
        self._output = IdentifierOutput(self)
        self.undo_with(self._leave_campaign)
        self._begin_with_stored()
        self.create_subscription(PlanMessage, chosen.plan_topic, self._on_plan, LATCHED)
        if chosen.use_robot_description:
            self.create_subscription(String, TOPIC, self._on_description, LATCHED)
        streams = [Stream(JointState, JOINTS, self._on_joints, partial(self._on_lost, 0))]
        for k, topic in enumerate(chosen.tracker_topics):
            hear, lost = partial(self._on_point, k), partial(self._on_lost, 1 + k)
            streams.append(Stream(PointStamped, topic, hear, lost))
        StreamPoller(self, streams, STREAM_IN)
        for name in ("reset", "undo", "save", "report"):
            self.create_service(Trigger, f"~/{name}", partial(self._serve, getattr(self, f"_{name}")))
        self.create_service(UndoMeasurement, "~/undo_measurement", self._on_undo)

    def activate(self) -> None:
        """Take what the streams say."""
        chosen = self.settings.value
        joint_names = None if self._campaign is None else self._campaign.nominal.joint_names
        self._intake = Intake(joint_names, JOINTS, chosen.tracker_topics, chosen)
        self._keep_frame()
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # simulated time may stand still
        self.create_timer(chosen.diagnostics_period, self._tick, clock=steady)
        self._update()
        ready = self._waiting if self._campaign is None else f"ready to identify {self._campaign.robot.name}"
        self.get_logger().info(ready)

    def deactivate(self) -> None:
        """Let the streams pass."""
        self._intake = None

    # ── which robot, which campaign ──────────────────────────────────────────────────────────────────

    def _begin_with_stored(self) -> None:
        try:
            model = first_model(self.settings.value)
        except StoreError:
            model = first_model(replace(self.settings.value, store_folder=""))
        if model is not None:
            self._enter_campaign(model)

    def _enter_campaign(self, model: IdentifiedModel) -> None:
        """Go on with the campaign in the store, or begin one.

        Raises:
            CalibPlannerError: The store belongs to another robot, or cannot be used at all.
        """
        chosen = self.settings.value
        try:
            store = open_store(chosen.store_folder, model.stored, asdict(chosen), __version__)
        except StoreError as error:
            self.get_logger().error(f"nothing is accepted until the store can be opened: {error}")
            store = UnavailableStore(model.stored, error)
        self._model, self._campaign = model, Campaign(model.robot, model.follow, store)
        if self._intake is not None:
            self._intake.use(model.robot.joint_names)
        self._keep_frame()
        if self._campaign.kept:
            text = f"campaign of plan {brief(self._campaign.plan_id, 40)} goes on"
            self.get_logger().info(f"{text}: {len(self._campaign.kept)} measurements are in {store.path}")

    def _keep_frame(self) -> None:
        """Points are to come in the frame of those that are kept; if there are none, in any."""
        if self._intake is not None:
            frame = "" if self._campaign is None else self._campaign.frame
            self._intake.frame, self._intake.bound = frame, bool(frame)

    def _leave_campaign(self) -> None:
        if self._campaign is not None:
            self._campaign.store.close()
        self._campaign = self._model = self._intake = None

    def _on_description(self, message: String) -> None:
        model, campaign = self._model, self._campaign
        if model is not None and model.urdf and message.data == model.urdf:
            return
        try:
            if campaign is not None and not campaign.store.empty:
                got, advice = "another one", "choose another store_folder, or clean up and configure"
                raise InputError(TOPIC, got, f"the robot that was measured, {campaign.nominal.name}", advice)
            heard = heard_model(message.data, self.settings.value)
            self._replace_campaign(heard)
        except CalibPlannerError as error:
            self.get_logger().error(f"{TOPIC} refused: {cut(error)}", throttle_duration_sec=1.0)
            self._waiting = f"{TOPIC} refused: {cut(error, 800)}"
            return
        self.get_logger().info(f"{TOPIC}: {heard.robot.name}, joints {', '.join(heard.robot.joint_names)}")

    def _replace_campaign(self, model: IdentifiedModel) -> None:
        """Enter a campaign of another robot, or of the same one with a store that may be there again."""
        before, plan = self._campaign, self._plan
        if before is not None:
            before.store.close()
        self._campaign = None
        self._enter_campaign(model)
        if plan is not None:
            self._begin(plan)
        self._update()

    # ── what comes in ────────────────────────────────────────────────────────────────────────────────

    def _on_plan(self, message: PlanMessage) -> None:
        try:
            self._plan = plan_from_message(message)
        except CalibPlannerError as error:
            self._refuse_plan(message.plan_id, error)
            return
        self._begin(self._plan)

    def _begin(self, received: ReceivedPlan) -> None:
        campaign, chosen = self._campaign, self.settings.value
        if campaign is None:
            return
        before = len(campaign.kept)
        try:
            keep = chosen.keep_measurements
            if not campaign.begin(received.plan_id, received.plan, chosen.plan_tolerance, keep=keep):
                return
        except CalibPlannerError as error:
            self._refuse_plan(received.plan_id, error)
            return
        name = f"plan {brief(received.plan_id, 40)}"
        text = f"{name}: {received.plan.measurements} measurements, {len(campaign.kept)} of them there"
        self.get_logger().info(f"{text}; {before} were there of the plan before" if before else text)
        self._keep_frame()
        self._update()

    def _refuse_plan(self, plan_id: str, error: CalibPlannerError) -> None:
        self.get_logger().error(f"plan {brief(plan_id, 40)} refused: {cut(error)}", throttle_duration_sec=1.0)

    def _on_joints(self, message: JointState) -> None:
        if self._intake is None:
            return
        try:
            results = self._intake.joints(message)
        except InputError as error:
            self.get_logger().warning(f"{JOINTS}: {cut(error)}", throttle_duration_sec=5.0)
            return
        if results:
            self._handle(results)

    def _on_point(self, target: int, message: PointStamped) -> None:
        if self._intake is not None and (results := self._intake.point(target, message)):
            self._handle(results)

    def _on_lost(self, stream: int, count: int) -> None:
        if self._intake is not None:
            self._intake.streams[stream].lost += count

    # ── what goes out ────────────────────────────────────────────────────────────────────────────────

    @property
    def _how(self) -> Matching:
        s = self.settings.value
        return Matching(s.plan_tolerance, s.accept_unplanned, s.sigma, s.repeatability, s.most_measurements)

    def _handle(self, results: list[Standstill | Rejection]) -> None:
        campaign, intake = self._campaign, self._intake
        if campaign is None or intake is None:
            return
        for found in results:
            if isinstance(found, Rejection):
                self._output.decision(campaign, campaign.refuse(found, intake.frame))
                continue
            text = intake.offset_text(self.settings.value.clock_offset)
            decision = campaign.take(found, self._how, intake.frame, ("clock_offset", text) if text else None)
            self._output.decision(campaign, decision)
            if decision.status == ACCEPTED:
                intake.bound = bool(intake.frame)
                self._update()
        self._withdraw_misdated()

    def _withdraw_misdated(self) -> None:
        """What was accepted before it was seen that a clock is wrong does not count."""
        campaign, intake, bound = self._campaign, self._intake, self.settings.value.clock_offset
        rests = [] if campaign is None or intake is None else intake.misdated(bound)
        if campaign is None or intake is None or not rests:
            return
        took = [(d, d.standstill.start, d.standstill.stop) for d in campaign.kept]
        gone = [d for d, start, stop in took if any(a <= start and stop <= b for a, b in rests)]
        try:
            for decision in gone:
                text = f"taken before it was seen: {intake.offset_text(bound)}"
                self._output.decision(campaign, campaign.withdraw(decision, "clock_offset", text))
        except StoreError as error:
            self.get_logger().error(f"not withdrawn, tried again: {error}", throttle_duration_sec=5.0)
        if gone:
            self._update()

    def _update(self) -> None:
        """Identify anew, publish it, and tell which measurements are seen otherwise now; only while active."""
        campaign = self._campaign
        if campaign is None or self._intake is None:
            return
        found = campaign.estimate(self._how)
        changed = campaign.judge()
        self._output.estimate(campaign, found)
        for decision in changed:
            self._output.decision(campaign, decision)
        self._output.description("" if self._model is None else self._model.urdf, found)

    def _tick(self) -> None:
        """Say how it goes; look whether a store that could not be opened can be."""
        campaign, intake, chosen = self._campaign, self._intake, self.settings.value
        if campaign is not None and isinstance(campaign.store, UnavailableStore):
            self._reopen()
        self._withdraw_misdated()
        if intake is not None:
            now, seconds = self.get_clock().now().nanoseconds, chosen.diagnostics_period
            streams = health(intake, now, seconds)
            name = self.get_fully_qualified_name().strip("/")
            message = diagnostics(name, now, streams, chosen.clock_offset, self._campaign, self._waiting)
            self._output.diagnostics(message)

    def _reopen(self) -> None:
        """Go on with the campaign of a store that could not be opened, if it can be now."""
        chosen = self.settings.value
        try:
            model = first_model(chosen) or self._model
            if model is None:
                return
            open_store(chosen.store_folder, model.stored, asdict(chosen), __version__).close()
        except StoreError:
            return
        self.get_logger().info("the store can be opened now")
        self._replace_campaign(model)

    # ── services ─────────────────────────────────────────────────────────────────────────────────────

    def _serve(
        self, action: Callable[[Campaign], str], _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        try:
            response.message, response.success = action(self._working()), True
        except CalibPlannerError as error:
            response.message, response.success = cut(error), False
        return response

    def _working(self) -> Campaign:
        """The campaign, if there is one and the node is active."""
        if not self.is_active:
            raise InputError("node", self.state, "active", "activate it")
        if self._campaign is None:
            raise InputError("robot", "none", "a robot", self._waiting)
        return self._campaign

    def _reset(self, campaign: Campaign) -> str:
        count = campaign.reset()
        self._keep_frame()
        self._update()
        return f"{count} measurements left behind; they stay in the store"

    def _undo(self, campaign: Campaign) -> str:
        return self._withdraw(campaign, 0)[1]

    def _withdraw(self, campaign: Campaign, number: int) -> tuple[int, str]:
        undone = campaign.undo(number)
        if undone is None:
            got = f"no measurement {number}" if number else "no measurement"
            raise InputError("undo", got, "a measurement in use", "see the ids on ~/measurements")
        self._output.decision(campaign, undone)
        self._update()
        return undone.number, f"measurement {undone.repetition} of configuration {undone.index} withdrawn"

    def _on_undo(
        self, request: UndoMeasurement.Request, response: UndoMeasurement.Response
    ) -> UndoMeasurement.Response:
        kind = UndoMeasurement.Response
        try:
            campaign = self._working()
        except InputError as error:
            response.status, response.message = kind.NOT_ACTIVE, str(error)
            return response
        try:
            response.id, response.message = self._withdraw(campaign, request.id)
            response.status = kind.SUCCESS
        except StoreError as error:
            response.status, response.message = kind.NOT_STORED, cut(error)
        except InputError as error:
            response.status, response.message = kind.UNKNOWN_ID, cut(error)
        return response

    @property
    def _folder(self) -> str:
        return self.settings.value.save_folder or self.settings.value.store_folder

    def _save(self, campaign: Campaign) -> str:
        urdf = "" if self._model is None else self._model.urdf
        return "saved " + ", ".join(map(str, session.save(self._folder, campaign, self._how, urdf)))

    def _report(self, campaign: Campaign) -> str:
        return f"report written to {session.report(self._folder, campaign, self._how)}"


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(IdentifierNode, IdentifierNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
