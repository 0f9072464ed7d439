# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Node ``calibration_identifier``: listens to joints and tracker points, publishes the calibrated parameters.

Standstills are detected by ``acquisition.Intake``; ``session`` matches, stores, identifies and saves. This file
carries the messages. All callbacks take turns in one thread: a standstill costs a commit to disk and an
identification, some 50 ms together and about a second where a full fit of hundreds is due, for which the queues
of the streams are deep enough.

A measurement is acknowledged on ``~/measurements`` after it is on the disk. While that cannot be written,
standstills are rejected as not stored and the node goes on; the next standstill tries again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace

from calib_planner_msgs.msg import CalibrationEstimate, Measurement, Residuals
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import UndoMeasurement
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from calib_planner import __version__
from calib_planner.acquisition import Intake, PointLike, Rejection, Standstill
from calib_planner.campaign import FIT
from calib_planner.errors import CalibPlannerError, InputError, StoreError
from calib_planner.identification import Estimate
from calib_planner.io import (
    ACCEPTED,
    CLOCK_OFFSET,
    Record,
    UnavailableStore,
    calibrated_urdf,
    open_store,
)
from calib_planner.ros import session as saving
from calib_planner.ros.cell import error_model_of
from calib_planner.ros.diagnostics import health, identifier_findings
from calib_planner.ros.lifecycle import Finding, ManagedNode
from calib_planner.ros.markers import residual_markers
from calib_planner.ros.messages import (
    ESTIMATE_NUMBERS,
    ESTIMATE_STATUS,
    NAN,
    ReceivedPlan,
    estimate_to_message,
    in_ros,
    measurement_message,
    plan_from_message,
    stamp_message,
)
from calib_planner.ros.model import TOPIC, IdentifiedModel, first_model, heard_model
from calib_planner.ros.parameters import HISTORY, LATCHED
from calib_planner.ros.rclpy_ext.run import run
from calib_planner.ros.residuals import residuals_message, residuals_of
from calib_planner.ros.session import Matching, Session, TooFew, condition_of
from calib_planner.ros.settings import IdentifierParameters
from calib_planner.ros.streams import DriverStreams, Listener
from calib_planner.ros.transforms import StaticFrames, placed_frames
from calib_planner.units import brief, cut


class IdentifierOutput:
    """The publishers of the identifier; made in ``configure``."""

    def __init__(self, node: ManagedNode[IdentifierParameters]) -> None:
        self._log = node.get_logger
        self._estimates = node.create_publisher(CalibrationEstimate, "~/estimate", LATCHED)
        self._descriptions = node.create_publisher(String, "~/robot_description", LATCHED)
        self._measurements = node.create_publisher(Measurement, "~/measurements", HISTORY)
        self._residuals = node.create_publisher(Residuals, "~/residuals", LATCHED)
        self._markers = node.create_publisher(MarkerArray, "~/markers", LATCHED)
        self._frames = StaticFrames(node) if node.settings.value.publish_transforms else None

    def record(self, session: Session, record: Record) -> None:
        """What became of a standstill."""
        self.tell(session, record)
        self._log().info(f"configuration {record.index}: {record.status} {record.reason}".rstrip())

    def tell(self, session: Session, record: Record) -> None:
        """Publish what became of a standstill."""
        message = measurement_message(
            record.acquired,
            session.nominal.joint_names,
            record.frame or "tracker",
            status=record.status,
            reason=record.reason,
            plan_id=session.plan_id_of(record),
            campaign_id=session.campaign_id,
            purpose=record.role,
            index=record.index,
            repetition=record.repetition,
            number=record.number,
            unused=record.unused,
        )
        self._measurements.publish(message)

    def estimate(self, session: Session, estimate: Estimate | TooFew, frame_id: str) -> None:
        """The estimate, or why there is none; ``frame_id`` is the robot's base."""
        others = {
            "plan_id": session.plan_id,
            "campaign_id": session.campaign_id,
            "configurations": session.configurations,
            "rejected": session.rejections.total(),
            "complete": session.complete,
        }
        fitted = session.of(FIT)
        if isinstance(estimate, Estimate):
            message = estimate_to_message(estimate, frame_id, condition=condition_of(estimate), **others)
        else:
            message = CalibrationEstimate(
                robot=session.robot.name,
                measurements=sum(int((r.standstill.samples > 0).sum()) for r in fitted if r.status == ACCEPTED),
                status=ESTIMATE_STATUS["too_few" if estimate.missing else "error"],
                message=in_ros(estimate.message),
                **dict.fromkeys(ESTIMATE_NUMBERS, NAN),
                **others,
            )
            message.header.frame_id = frame_id
            if not estimate.missing:
                self._log().error(estimate.message)
        message.header.stamp = stamp_message(stamp_of(session))
        self._estimates.publish(message)

    def show(self, model: IdentifiedModel, session: Session, estimate: Estimate | TooFew) -> None:
        """What an estimate means for each point, and where it puts tracker and targets."""
        stamp, tracker = stamp_of(session), session.frame or "tracker"
        residuals = residuals_of(estimate, session.of(FIT))
        self._residuals.publish(residuals_message(residuals, session.plan_id, stamp, tracker))
        self._markers.publish(residual_markers(residuals, stamp, tracker))
        if self._frames is not None:
            names = (*model.ends, tracker, model.settings.target_names)
            self._frames.publish(placed_frames(estimate, *names) if isinstance(estimate, Estimate) else [], stamp)

    def description(self, urdf: str, estimate: Estimate | TooFew) -> None:
        """The calibrated URDF, or the nominal one ``urdf`` while there is no estimate; nothing without a URDF."""
        if urdf and isinstance(estimate, Estimate):
            urdf = calibrated_urdf(urdf, estimate.calibrated, TOPIC)[0]
        if urdf:
            self._descriptions.publish(String(data=urdf))


def stamp_of(session: Session) -> int:
    """Stamp of the newest measurement that is fitted [ns]; 0 if there is none."""
    fitted = session.of(FIT)
    return fitted[-1].acquired.end if fitted else 0


class IdentifierNode(ManagedNode[IdentifierParameters]):
    """The identifier as a node."""

    THREADS = 1

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        self._model: IdentifiedModel | None = None
        self._session: Session | None = None
        self._intake: Intake | None = None
        self._plan: ReceivedPlan | None = None
        self._waiting = f"no robot yet: publish a URDF on {TOPIC} (latched), or set the parameter robot"
        super().__init__("calibration_identifier", IdentifierParameters(), context, overrides)

    def configure(self) -> None:
        """Load the robot and the session in the store, offer services, listen for plans and streams."""
        chosen = self.settings.value
        if not chosen.store_folder:
            text = "the session is in memory only and lost with the node: set store_folder to keep it"
            self.get_logger().warning(text)
        self._error_model = error_model_of(chosen)
        self._output = IdentifierOutput(self)
        self._locked: dict[int, bool] = {}  # target → whether the tracker sees it, as far as it said
        self.undo_with(self._leave_session)
        self._begin_with_stored()
        self.create_subscription(PlanMessage, chosen.plan_topic, self._on_plan, LATCHED)
        if chosen.use_robot_description and not chosen.cell:
            self.create_subscription(String, TOPIC, self._on_description, LATCHED)
        hears = Listener(self._on_joints, self._on_point, self._on_state, self._on_lost)
        self._streams = DriverStreams(self, chosen.topics, chosen.tracker_type, hears)
        for name in ("reset", "undo", "save", "report"):
            self.create_trigger(f"~/{name}", getattr(self, f"_{name}"))
        self.create_service(UndoMeasurement, "~/undo_measurement", self._on_undo)

    def activate(self) -> None:
        """Take the messages of the streams."""
        chosen = self.settings.value
        joint_names = None if self._session is None else self._session.nominal.joint_names
        topics = chosen.topics
        self._intake = Intake(joint_names, topics.joints, topics.points, chosen, topics.children)
        for target, locked in self._locked.items():
            self._intake.tracker_state(target, locked)
        self._keep_frame()
        self._tell_all()
        self.create_steady_timer(chosen.diagnostics_period, self._tick)
        self._update()
        ready = self._waiting if self._session is None else f"ready to identify {self._session.robot.name}"
        self.get_logger().info(ready)

    def deactivate(self) -> None:
        """Ignore the streams."""
        self._intake = None

    def _begin_with_stored(self) -> None:
        try:
            model = first_model(self.settings.value)
        except StoreError:
            model = first_model(replace(self.settings.value, store_folder=""))
        if model is not None:
            self._enter_session(model)

    def _enter_session(self, model: IdentifiedModel) -> None:
        """Go on with the session in the store, or begin one.

        Raises:
            CalibPlannerError: The store belongs to another robot, or cannot be used at all.
        """
        chosen = self.settings.value
        try:
            store = open_store(chosen.store_folder, model.stored, asdict(chosen), __version__)
        except StoreError as error:
            self.get_logger().error(f"nothing is accepted until the store can be opened: {error}")
            store = UnavailableStore(model.stored, error)
        self._model, self._session = model, Session(model.robot, model.follow, store)
        if self._intake is not None:
            self._intake.use(model.robot.joint_names)
        self._keep_frame()
        if self._session.records:
            text = f"session of plan {brief(self._session.plan_id, 40)} goes on"
            self.get_logger().info(f"{text}: {len(self._session.records)} measurements are in {store.path}")

    def _keep_frame(self) -> None:
        """Require the frame of the points in use; without such points any frame will do."""
        if self._intake is not None:
            frame = "" if self._session is None else self._session.frame
            self._intake.frame, self._intake.bound = frame, bool(frame)

    def _leave_session(self) -> None:
        if self._session is not None:
            self._session.store.close()
        self._session = self._model = self._intake = None

    def _on_description(self, message: String) -> None:
        model, session = self._model, self._session
        if model is not None and model.urdf and message.data == model.urdf:
            return
        try:
            if session is not None and not session.store.empty:
                got, advice = "another one", "choose another store_folder, or clean up and configure"
                raise InputError(TOPIC, got, f"the robot that was measured, {session.nominal.name}", advice)
            heard = heard_model(message.data, self.settings.value)
            self._replace_session(heard)
        except CalibPlannerError as error:
            self.get_logger().error(f"{TOPIC} refused: {cut(error)}", throttle_duration_sec=1.0)
            self._waiting = f"{TOPIC} refused: {cut(in_ros(str(error)), 800)}"
            return
        self.get_logger().info(f"{TOPIC}: {heard.robot.name}, joints {', '.join(heard.robot.joint_names)}")

    def _replace_session(self, model: IdentifiedModel) -> None:
        """Enter a session of another robot, or of the same one whose store may be there again."""
        before, plan = self._session, self._plan
        if before is not None:
            before.store.close()
        self._session = None
        self._enter_session(model)
        if plan is not None:
            self._begin(plan)
        self._tell_all()
        self._update()

    def _on_plan(self, message: PlanMessage) -> None:
        try:
            self._plan = plan_from_message(message)
        except CalibPlannerError as error:
            self._refuse_plan(message.plan_id, error)
            return
        self._begin(self._plan)

    def _begin(self, received: ReceivedPlan) -> None:
        session, chosen = self._session, self.settings.value
        if session is None:
            return
        before = len(session.records)
        try:
            new = session.begin(
                received.plan_id,
                received.plan,
                chosen.plan_tolerance,
                campaign_id=received.campaign_id,
                role=received.purpose,
                keep=chosen.keep_measurements,
            )
            if received.campaign_id:
                self._tell_all()
            if not new:
                return
        except CalibPlannerError as error:
            self._refuse_plan(received.plan_id, error)
            return
        name = f"plan {brief(received.plan_id, 40)} for {received.purpose}"
        there = sum(session.done().values())
        text = f"{name}: {received.plan.measurements} measurements, {there} of them there"
        self.get_logger().info(f"{text}; {before} were there of the plan before" if before else text)
        self._keep_frame()
        self._update()

    def _tell_all(self) -> None:
        """While active: tell what was measured once more, to whoever missed some of it.

        That is a campaign that was away and tells its plan again, or a page that comes after a restart.
        """
        if self._session is not None and self._intake is not None:
            for record in self._session.told:
                self._output.tell(self._session, record)

    def _refuse_plan(self, plan_id: str, error: CalibPlannerError) -> None:
        self.get_logger().error(f"plan {brief(plan_id, 40)} refused: {cut(error)}", throttle_duration_sec=1.0)

    def _on_joints(self, topic: int, message: JointState) -> None:
        if self._intake is None:
            return
        try:
            results = self._intake.joints(message, topic)
        except InputError as error:
            name = self.settings.value.joint_topics[topic]
            self.get_logger().warning(f"{name}: {cut(error)}", throttle_duration_sec=5.0)
            return
        if results:
            self._handle(results)

    def _on_point(self, target: int, message: PointLike) -> None:
        if self._intake is not None and (results := self._intake.point(target, message)):
            self._handle(results)

    def _on_state(self, target: int, locked: bool) -> None:
        if self._locked.get(target, True) != locked:
            words = "sees target" if locked else "has lost target"
            self.get_logger().info(f"the tracker {words} {target + 1}")
        self._locked[target] = locked
        if self._intake is not None:
            self._intake.tracker_state(target, locked)

    def _on_lost(self, stream: int, count: int) -> None:
        if self._intake is not None:
            self._intake.streams[stream].lost += count

    @property
    def _how(self) -> Matching:
        s = self.settings.value
        return Matching(
            s.plan_tolerance,
            s.accept_unplanned,
            s.sigma,
            s.repeatability,
            s.most_measurements,
            self._error_model,
            s.accuracy_frame,
        )

    def _handle(self, results: list[Standstill | Rejection]) -> None:
        session, intake = self._session, self._intake
        if session is None or intake is None:
            return
        for result in results:
            if isinstance(result, Rejection):
                self._output.record(session, session.refuse(result, intake.frame))
                continue
            text = intake.offset_text(self.settings.value.clock_offset)
            record = session.take(result, self._how, intake.frame, (CLOCK_OFFSET, text) if text else None)
            self._output.record(session, record)
            if record.status == ACCEPTED:
                intake.bound = bool(intake.frame)
                self._update()
        self._withdraw_misdated()

    def _withdraw_misdated(self) -> None:
        """Withdraw what was accepted before it was known that a clock is wrong."""
        session, intake, bound = self._session, self._intake, self.settings.value.clock_offset
        rests = [] if session is None or intake is None else intake.misdated(bound)
        if session is None or intake is None or not rests:
            return
        taken = ((r, r.standstill.start, r.standstill.end) for r in session.records)
        gone = [r for r, first, last in taken if any(a <= first and last <= b for a, b in rests)]
        try:
            for record in gone:
                text = f"measured before it was seen: {intake.offset_text(bound)}"
                self._output.record(session, session.withdraw(record, CLOCK_OFFSET, text))
        except StoreError as error:
            self.get_logger().error(f"not withdrawn, tried again: {error}", throttle_duration_sec=5.0)
        if gone:
            self._update()

    def _update(self) -> None:
        """While active: identify again, publish the estimate, and tell what became of measurements by it."""
        session = self._session
        if session is None or self._intake is None:
            return
        estimate = session.estimate(self._how)
        changed = session.judge()
        self._output.estimate(session, estimate, self.settings.value.frame_id)
        for record in changed:
            self._output.record(session, record)
        if self._model is not None:
            self._output.description(self._model.urdf, estimate)
            self._output.show(self._model, session, estimate)

    def _tick(self) -> None:
        """Look whether a store that could not be opened can be opened now."""
        session = self._session
        if session is not None and isinstance(session.store, UnavailableStore):
            self._reopen()
        self._withdraw_misdated()

    def findings(self) -> Sequence[Finding]:
        """How streams, session, estimate and store are."""
        intake, chosen = self._intake, self.settings.value
        if intake is None:
            return identifier_findings((), chosen.clock_offset, None, self._waiting)
        for target, trouble in enumerate(self._streams.trouble):
            count = intake.streams[intake.joint_topics + target]
            count.reason = trouble or count.reason
        streams = health(intake, self.now, chosen.diagnostics_period)
        return identifier_findings(streams, chosen.clock_offset, self._session, self._waiting)

    @property
    def robot_name(self) -> str:
        """The session's robot."""
        return "" if self._session is None else self._session.robot.name

    def _reopen(self) -> None:
        """Go on with the session of a store that could not be opened, if that is possible now."""
        chosen = self.settings.value
        try:
            model = first_model(chosen) or self._model
            if model is None:
                return
            open_store(chosen.store_folder, model.stored, asdict(chosen), __version__).close()
        except StoreError:
            return
        self.get_logger().info("the store can be opened now")
        self._replace_session(model)

    def _working(self) -> Session:
        """The session.

        Raises:
            InputError: There is none.
        """
        if self._session is None:
            raise InputError("robot", "none", "a robot", self._waiting)
        return self._session

    def _reset(self) -> str:
        count = self._working().reset()
        self._keep_frame()
        self._update()
        return f"{count} measurements are not used any more; they stay in the store"

    def _undo(self) -> str:
        return self._withdraw(0)[1]

    def _withdraw(self, number: int) -> tuple[int, str]:
        session = self._working()
        undone = session.undo(number)
        if undone is None:
            got = f"no measurement {number}" if number else "no measurement"
            raise InputError("undo", got, "a measurement in use", "see the ids on ~/measurements")
        self._output.record(session, undone)
        self._update()
        return undone.number, f"measurement {undone.repetition} of configuration {undone.index} withdrawn"

    def _on_undo(
        self, request: UndoMeasurement.Request, response: UndoMeasurement.Response
    ) -> UndoMeasurement.Response:
        status = UndoMeasurement.Response.NOT_ACTIVE
        try:
            self.check_active()
            self._working()
            status = UndoMeasurement.Response.UNKNOWN_ID
            response.id, response.message = self._withdraw(request.id)
            response.status = UndoMeasurement.Response.SUCCESS
        except StoreError as error:
            response.status, response.message = UndoMeasurement.Response.NOT_STORED, cut(error)
        except InputError as error:
            response.status, response.message = status, cut(error)
        return response

    @property
    def _folder(self) -> str:
        return self.settings.value.save_folder or self.settings.value.store_folder

    def _save(self) -> str:
        urdf = "" if self._model is None else self._model.urdf
        return "saved " + ", ".join(map(str, saving.save(self._folder, self._working(), self._how, urdf)))

    def _report(self) -> str:
        return f"report written to {saving.report(self._folder, self._working(), self._how)}"


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(IdentifierNode, IdentifierNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
