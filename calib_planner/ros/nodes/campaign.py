# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Node ``calibration_campaign``: has the robot measured until the estimate is accurate enough.

The library's ``campaign`` says what is to be done next (a pure state machine); plans are made by the library in a
thread of their own. This file carries it out: ``Measuring`` tells the identifier the plan (latched ``~/plan``,
the identifier's ``plan_topic``), sends the robot to one configuration at a time, and listens to what was
accepted. Every plan names the campaign, whose plans share their measurements at the identifier, and says whether
it is for the fit or for the validation. A plan of the fit holds everything that was measured for it; one is told
when a validation joins the fit, and in the end.

The robot is sent nowhere before ``~/start``, nor after a restart before ``~/resume``; with ``review`` nor before
the first plan was looked at. A campaign goes on after a restart with what it had to reach when it began, and says
which parameters differ from that. All callbacks take turns in one thread.
"""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial

from calib_planner_msgs.msg import CalibrationEstimate, CampaignStatus, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import SkipConfiguration
from rclpy.context import Context
from rclpy.parameter import Parameter

from calib_planner import __version__
from calib_planner.campaign import (
    CampaignResult,
    CampaignState,
    Finished,
    Measure,
    NextStep,
    Paused,
    begin,
    decide,
)
from calib_planner.errors import CalibPlannerError, InputError, StoreError
from calib_planner.io import CampaignStore, begin_campaign, open_campaign, stored_goals
from calib_planner.ros.campaign import (
    Measuring,
    goals_of,
    idle_status,
    problem_of,
    result_message,
    status_message,
    with_goals,
    write_result,
)
from calib_planner.ros.lifecycle import OK, WARN, Finding, ManagedNode, reason_of
from calib_planner.ros.messages import reasons_of, stamp_message
from calib_planner.ros.model import TOPIC, Model, ModelSource
from calib_planner.ros.parameters import EVENTS, LATCHED
from calib_planner.ros.rclpy_ext.run import run
from calib_planner.ros.settings import CampaignParameters
from calib_planner.units import cut, listed

PERIOD = 0.05
"""Time between two looks at what there is to do [s]."""
PATIENCE = 4.0
"""Time that the search of a plan has to end when it is stopped [s]."""
LONGEST_STOP = 2.0
"""Time that the robot's node has to answer that it stops, when the campaign's node is stopped [s]."""

STATES = {
    CampaignStatus.IDLE: "idle",
    CampaignStatus.PLANNING: "planning",
    CampaignStatus.MEASURING: "measuring",
    CampaignStatus.VALIDATING: "validating",
    CampaignStatus.WAITING: "waiting",
    CampaignStatus.PAUSED: "paused",
    CampaignStatus.DONE: "done",
}
"""State → word for people."""


class CampaignNode(ManagedNode[CampaignParameters]):
    """The campaign as a node.

    Attributes:
        campaign: The state of the campaign; ``None`` before the first.
    """

    THREADS = 1

    def __init__(self, context: Context | None = None, overrides: Sequence[Parameter] = ()) -> None:
        self._ending_plan = threading.Event()
        self._work: Future[NextStep] | None = None
        self._work_for = ""
        self._store: CampaignStore | None = None
        self._forget()
        super().__init__("calibration_campaign", CampaignParameters(), context, overrides)

    def _forget(self) -> None:
        self.campaign: CampaignState | None = None
        self._let_go()
        self._id, self._reason, self._sent = "", "call ~/start", ""
        self._told = idle_status(self._reason)
        self._reported = self._reviewed = self._replanning = False

    def _let_go(self) -> None:
        """Close the campaign's file."""
        if self._store is not None:
            self._store.close()
        self._store = None

    def configure(self) -> None:
        """Load the robot, offer services, listen."""
        chosen = self.settings.value
        self._forget()
        self._source = ModelSource(chosen)
        self._status = self.create_publisher(CampaignStatus, "~/status", LATCHED)
        self._estimates = self.create_publisher(CalibrationEstimate, "~/estimate", LATCHED)
        self._measuring = Measuring(self, self.create_publisher(PlanMessage, "~/plan", LATCHED))
        self._source.follow(self, self._on_model)
        name = chosen.identifier
        self.create_subscription(Measurement, f"{name}/measurements", self._on_measurement, EVENTS)
        self.create_subscription(CalibrationEstimate, f"{name}/estimate", self._on_estimate, LATCHED)
        for name in ("start", "pause", "resume", "skip"):
            self.create_trigger(f"~/{name}", partial(self._serve, getattr(self, f"_{name}")))
        self.create_service(SkipConfiguration, "~/skip_configuration", self._on_skip)

    def activate(self) -> None:
        """Go on with the campaign; one in the store waits for ``~/resume``."""
        self._ending_plan.clear()
        self._thread = ThreadPoolExecutor(1, "campaign")
        self.create_steady_timer(PERIOD, self._tick)
        self._go_on_with_stored()
        self.get_logger().info(self._reason)
        self._publish_status()

    def deactivate(self) -> None:
        """Stop the robot and the search of a plan; measurements stay."""
        self._ending_plan.set()
        self._measuring.end(LONGEST_STOP)
        self._thread.shutdown(wait=False, cancel_futures=True)
        if self._work is not None and self._work in wait([self._work], PATIENCE).done:
            self._work = None

    def clean_up(self) -> None:
        """Forget the campaign; what is in the store stays."""
        self._forget()

    def close(self) -> bool:
        """End everything; returns whether the search of a plan ended in time."""
        super().close()
        self._let_go()
        return self._work is None

    def _go_on_with_stored(self) -> None:
        """Load the campaign of the store, paused, so that no robot moves unexpectedly."""
        chosen, model = self.settings.value, self._source.model
        if self.campaign is not None or not chosen.store_folder or not isinstance(model, Model):
            return
        try:
            goals = stored_goals(chosen.store_folder)
            if goals is None:
                return
            chosen, differing = with_goals(chosen, goals)
            if not chosen.test_pose_rows:
                return
            problem = problem_of(chosen, model)
            stored = open_campaign(chosen.store_folder, problem.robot)
            if stored is None:
                return
            self._store = stored.store
            if stored.finished:
                self._let_go()
                return
            self.campaign = stored.state(problem).pause()
        except CalibPlannerError as error:
            self._let_go()
            self._reason = f"the campaign in the store cannot go on: {error}"
            self.get_logger().error(self._reason)
            return
        self._id = stored.campaign_id
        self._measuring.begin(self._id)
        self._reason = f"{len(stored.rows)} measurements of campaign {self._id} are there: call ~/resume to go on"
        if differing:
            text = f"as its record says ({'; '.join(differing)}); to change that, choose another store_folder"
            self._reason = f"{self._reason} {text}"

    def _serve(self, action: Callable[[], str]) -> str:
        try:
            return action()
        finally:
            self._publish_status()

    def _start(self) -> str:
        before = self.campaign
        if before is not None and before.result is None and before.measurements:
            raise InputError(
                "start", "a campaign that is not finished", "none", "resume it, or clean up the node"
            )
        if self._work is not None or self._measuring.busy:
            raise InputError("start", "what was stopped has not ended", "nothing under way", "ask again")
        chosen = self.settings.value
        problem, folder = problem_of(chosen, self._source.model), chosen.store_folder
        name = uuid.uuid4().hex[:12]
        if self._store is not None:
            self._store.close()  # the new campaign takes its place; if that fails, the next measurement says so
        store = begin_campaign(folder, name, problem.robot, goals_of(chosen), __version__) if folder else None
        self._forget()
        self._id, self._store, self.campaign = name, store, begin(problem)
        self._measuring.begin(name)
        self._reason = ""
        where = f"stored in {folder}" if folder else "in memory only: set store_folder to store it"
        return f"campaign {name} of {problem.robot.name} begun, {where}"

    def _pause(self) -> str:
        self._set(self._running("pause").pause())
        self._reason = "paused on request: call ~/resume"
        return "paused; the robot stops, what was measured stays"

    def _resume(self) -> str:
        state = self._running("resume")
        if not state.paused:
            return "it was not paused"
        self._reason = ""
        self._measuring.leave()
        self._set(state.resume())
        return "goes on"

    def _skip(self) -> str:
        state = self._running("skip")
        visit = self._measuring.visit
        if visit is None or not isinstance(state.action, Measure) or visit.action.index != state.action.index:
            raise InputError("skip", "no configuration is being measured", "one that is", "see ~/status")
        self._set(state.skipped(visit.action.index))
        return f"configuration {visit.action.index} and what is near it are left out"

    def _on_skip(
        self, request: SkipConfiguration.Request, response: SkipConfiguration.Response
    ) -> SkipConfiguration.Response:
        kind, index = SkipConfiguration.Response, request.configuration_index
        response.status = kind.NOT_ACTIVE
        try:
            self.check_active()
            state = self._running("skip_configuration")
            response.status = kind.UNKNOWN_INDEX
            if index not in state.queue:
                expected = (
                    f"one of {listed(map(str, dict.fromkeys(state.queue)))}" if state.queue else "one ahead"
                )
                raise InputError("configuration_index", index, expected, "see ahead on ~/status")
            after = state.skipped(index, replan=request.replace)
            response.status = kind.NOT_STORED
            if not self._stored(lambda store: store.note(state, after)):
                self.campaign = state.pause()
                raise InputError(
                    "store_folder", "no space or no disk", "one that can be written to", self._reason
                )
            self.campaign, self._replanning = after, self._replanning or request.replace
            rest = "the rest is planned anew" if request.replace else f"{len(set(after.ahead))} others stay"
            response.message = f"configuration {index} and what is near it are left out; {rest}"
            response.status = kind.SUCCESS
        except InputError as error:
            response.message = cut(error)
        self._publish_status()
        return response

    def _running(self, what: str) -> CampaignState:
        if self.campaign is None or self.campaign.result is not None:
            raise InputError(what, "no campaign under way", "one", "call ~/start")
        return self.campaign

    def _on_model(self, model: Model) -> None:
        self.get_logger().info(f"{TOPIC}: {model.robot.name}; it counts from the next campaign on")
        if self.is_active:
            self._go_on_with_stored()

    def _on_estimate(self, message: CalibrationEstimate) -> None:
        self._measuring.taken = message.plan_id

    def _on_measurement(self, message: Measurement) -> None:
        state = self.campaign
        if state is None or state.result is not None:
            return
        try:
            self._set(self._measuring.heard(message, state))
        except InputError as error:
            self.get_logger().warning(f"measurement refused: {cut(error, 500)}", throttle_duration_sec=1.0)

    def _set(self, state: CampaignState) -> None:
        """Take a new state; it is on the disk before it counts."""
        before = self.campaign
        if before is state:
            return
        if before is not None and not self._stored(lambda store: store.note(before, state)):
            state = state.pause()
        self.campaign = state

    def _stored(self, write: Callable[[CampaignStore], None]) -> bool:
        """Write to the store, if there is one; ``False`` if that failed: then there is none any more."""
        if self._store is None:
            return True
        try:
            write(self._store)
        except StoreError as error:
            self._let_go()
            self._reason = f"paused: not stored any more, {error}; ~/resume goes on without storing"
            self.get_logger().error(self._reason)
            return False
        return True

    def _tick(self) -> None:
        self._take_step()
        state = self.campaign
        if state is not None:
            self._go_on(state)
        self._publish_status()

    def _go_on(self, state: CampaignState) -> None:
        action, measuring = state.action, self._measuring
        if isinstance(action, Measure):
            self._set(measuring.step(state, action))
            if measuring.halted:
                self._pause_for(f"{measuring.halted}; call ~/resume once that is remedied")
            elif measuring.waited > self.settings.value.longest_wait:
                self._pause_for(f"{measuring.waiting}; call ~/resume once that is remedied")
            return
        measuring.leave()
        wanted = not isinstance(action, Paused) or self._plans_anew
        if isinstance(action, Finished):
            self._finish(action.result)
        elif wanted and self._work is None:
            self._work, self._work_for = self._thread.submit(decide, state, self._ending_plan.is_set), self._id

    @property
    def _plans_anew(self) -> bool:
        """Whether the rest is planned anew, around what was replaced, while the campaign is paused."""
        state = self.campaign
        return self._replanning and state is not None and state.paused and not state.queue

    def _take_step(self) -> None:
        if self._work is None or not self._work.done() or self.campaign is None:
            return
        work, self._work = self._work, None
        if self._work_for != self._id:
            return  # of a campaign that was left
        self._replanning = False
        try:
            step = work.result()
        except Exception as error:
            self._pause_for(reason_of(error))
            return
        self._set(self.campaign.decided(step))
        if step.joins:
            self._measuring.tell_fit(self.campaign)
        self.get_logger().info(f"round {len(self.campaign.rounds)}: {step.message}")
        self._review()

    def _review(self) -> None:
        """With ``review``: pause when the first plan is there, and before anything is measured.

        What was planned anew while it was paused is looked at as well; what comes after ``~/resume`` is not.
        """
        state = self.campaign
        first = state is not None and bool(state.queue) and not state.measurements
        if state is None or not first or not self.settings.value.review or (self._reviewed and not state.paused):
            return
        self._reviewed = True
        self._set(state.pause())
        text = "look at what is ahead on ~/status, leave out or replace with ~/skip_configuration"
        self._reason = f"paused for review: {text}, then call ~/resume"
        self.get_logger().info(self._reason)

    def _pause_for(self, reason: str) -> None:
        self._reason = f"paused: {cut(reason, 800)}"
        self.get_logger().error(self._reason)
        if self.campaign is not None:
            self._set(self.campaign.pause())

    def _finish(self, result: CampaignResult) -> None:
        """Publish and write the result, once; the identifier goes back to the fit."""
        if self._reported:
            return
        self._reported = True
        self._let_go()
        self.get_logger().info(f"{result.outcome}: {result.message}")
        for reason in reasons_of(result.verdict) or [result.verdict.level]:
            self.get_logger().info(reason)
        message = result_message(result, self._id, self.settings.value.frame_id)
        if message is not None:
            message.header.stamp = stamp_message(self.now)
            self._estimates.publish(message)
        if self.campaign is not None:
            self._measuring.tell_fit(self.campaign)
        folder = self.settings.value.store_folder
        if folder:
            try:
                write_result(folder, result, self._id)
                self._reason = f"results are in {folder}"
            except CalibPlannerError as error:
                self._reason = f"the results were not written: {error}"
                self.get_logger().error(self._reason)

    def findings(self) -> Sequence[Finding]:
        """Where the campaign is, and what to do."""
        told = self._told
        done = {"measured": told.measured, "left": told.left, "validated": told.validated, "budget": told.budget}
        fine = (CampaignStatus.OUTCOME_OPEN, CampaignStatus.OUTCOME_REACHED)
        halted = told.state in (CampaignStatus.PAUSED, CampaignStatus.WAITING) or told.outcome not in fine
        words = f"{STATES[told.state]}: {told.reason}" if told.reason else STATES[told.state]
        values = {"campaign": told.campaign_id, **done}
        return (Finding("campaign", WARN if halted else OK, words, values),)

    @property
    def robot_name(self) -> str:
        """The campaign's robot, or the one of the next campaign."""
        model = self._source.model
        return str(self._told.robot) or (model.robot.name if isinstance(model, Model) else "")

    def _publish_status(self) -> None:
        """Publish the status if it has changed."""
        if self.campaign is None:
            message = idle_status(self._reason)
        else:
            anew = self._plans_anew
            reason = "the rest is planned anew, and waits for ~/resume" if anew else self._reason
            message = status_message(self.campaign, self._id, self._measuring.waiting, reason, planning=anew)
        text = repr(message)
        self._told = message
        if text != self._sent:
            self._sent = text
            message.header.stamp = stamp_message(self.now)
            self._status.publish(message)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end."""
    return run(CampaignNode, CampaignNode.THREADS, args)


if __name__ == "__main__":
    raise SystemExit(main())
