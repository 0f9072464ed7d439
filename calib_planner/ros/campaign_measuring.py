"""Measuring what a campaign wants measured: tell the identifier the plan, send the robot, hear what was accepted.

One configuration at a time, and every step has an end. A robot that refuses a configuration cannot reach it; a
standstill that the identifier rejects, or of which it says nothing, is a failed attempt. What is not there, does
not answer or would spoil any measurement (``ANYWHERE``) is not the configuration's fault: it is waited for, and
tried again every ``RETRY`` seconds.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import Measurement
from rclpy.publisher import Publisher

from calib_planner.acquisition import pick_joints
from calib_planner.arrays import FloatArray
from calib_planner.campaign import FIT, CampaignState, Measure
from calib_planner.errors import InputError
from calib_planner.ros.campaign_request import Announced, announced
from calib_planner.ros.conversions import plan_to_message
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.plan_execution import Ended, PlanExecution
from calib_planner.ros.settings import CampaignParameters

RETRY = 2.0
"""Time between two attempts at something that did not answer [s]."""
ANYWHERE = (
    Measurement.REJECTED_TIME_SKEW,
    Measurement.REJECTED_CLOCK_OFFSET,
    Measurement.REJECTED_OTHER_FRAME,
    Measurement.REJECTED_BAD_JOINTS,
    Measurement.REJECTED_NOT_STORED,
)
"""Rejections that another configuration would meet as well."""


@dataclass
class Visit:
    """Measuring one configuration once.

    Attributes:
        action: What the campaign wants.
        since: When the phase began [s].
        phase: ``telling`` the plan, ``sending`` the robot, ``moving``, ``judging`` (the identifier does).
        said: The identifier's last reason for a rejection.
        anywhere: Whether that was one of ``ANYWHERE``.
        final: Whether this standstill is not judged again.
    """

    action: Measure
    since: float
    phase: str = "telling"
    said: str = ""
    anywhere: bool = False
    final: bool = False

    def next(self, phase: str) -> None:
        """Begin a phase."""
        self.phase, self.since = phase, time.monotonic()


class Measuring:
    """The robot and the identifier, as a campaign needs them; made in ``configure`` of ``node``.

    Args:
        plans: Where the identifier hears of plans.

    Attributes:
        visit: What is being measured.
        waiting: What is waited for; empty if for nothing.
        taken: The plan that the identifier has.
    """

    def __init__(self, node: ManagedNode[CampaignParameters], plans: Publisher) -> None:
        self._node, self._out = node, plans
        self._execution = PlanExecution(node, node.settings.value.execute_action)
        self.begin("")

    def begin(self, campaign_id: str) -> None:
        """Nothing is known of any plan."""
        self._id, self._plan = campaign_id, None
        self._plans: dict[str, Announced] = {}
        self.visit: Visit | None = None
        self.waiting, self._waited_since, self._tried = "", 0.0, 0.0
        self._spoilt = ""

    taken = ""
    _plan: Announced | None

    @property
    def busy(self) -> bool:
        """Whether the robot is under way for us."""
        return self._execution.busy

    @property
    def waited(self) -> float:
        """How long it has been waiting [s]."""
        return time.monotonic() - self._waited_since if self.waiting else 0.0

    def leave(self) -> None:
        """Nothing is to be measured now: the robot stops."""
        self.visit, self._spoilt = None, ""
        self._wait_for("")
        self._execution.poll(self._settings.silence)
        self._execution.cancel()

    def back_to_fit(self) -> None:
        """Tell the identifier the last plan of the fit again."""
        fits = [p for p in self._plans.values() if p.role == FIT]
        if fits and self._plan is not fits[-1]:
            self._announce(fits[-1])

    # ── what comes in ────────────────────────────────────────────────────────────────────────────────

    def heard(self, message: Measurement, state: CampaignState) -> CampaignState:
        """What the identifier says of a standstill.

        What it holds for an outlier counts as measured: the campaign looks for outliers itself, and its fit shall
        not depend on what is measured for validation.

        Raises:
            InputError: A measurement of other joints.
        """
        known = any(r.number == message.id for r in state.rows)
        if message.status not in (Measurement.ACCEPTED, Measurement.REJECTED_OUTLIER):
            if known:
                return state.withdrawn(int(message.id), message.reason[:300] or "undone")
            self._rejected(message)
            return state
        self._spoilt = ""
        plan = self._plans.get(message.plan_id)
        if known or plan is None or message.configuration_index >= len(plan.stops):
            return state
        points = np.array([[p.x, p.y, p.z] for p in message.points])
        stop = plan.stops[message.configuration_index]
        return state.measured(stop, _joints(message, state), points, int(message.id))

    def _rejected(self, message: Measurement) -> None:
        visit = self.visit
        if visit is None or visit.phase not in ("moving", "judging"):
            return
        visit.said, visit.anywhere = message.reason[:300], message.status in ANYWHERE
        # Points tell a standstill that was rejected from one that was none, and may become one yet.
        plan, row = self._plans.get(message.plan_id), message.configuration_index
        here = plan is not None and row < len(plan.stops) and plan.stops[row] == visit.action.index
        visit.final = here and len(message.points) > 0

    # ── one step further ─────────────────────────────────────────────────────────────────────────────

    def step(self, state: CampaignState, action: Measure) -> CampaignState:
        """Go on measuring; the state as it is then."""
        ended = self._execution.poll(self._settings.silence)
        visit = self.visit
        if visit is None or (visit.action.index, visit.action.repetition) != (action.index, action.repetition):
            self.visit = visit = Visit(action, time.monotonic())
            self._wait_for("")
        if visit.phase == "moving":
            if self._execution.begun:
                self._wait_for("")
            return state if ended is None else self._moved(state, visit, ended)
        if self._execution.busy:
            self._execution.cancel()  # of the visit before
        elif visit.phase == "telling":
            self._tell(state, visit)
        elif visit.phase == "sending":
            self._send(visit)
        elif visit.final or time.monotonic() - visit.since > self._settings.patience:
            return self._not_measured(state, visit)
        return state

    @property
    def _settings(self) -> CampaignParameters:
        return self._node.settings.value

    def _tell(self, state: CampaignState, visit: Visit) -> None:
        """The identifier has to know the plan before the robot stands there."""
        plan = self._plan
        if plan is None or not plan.covers(visit.action.index, state):
            plan = announced(state, self._id, visit.action.role)
            self._announce(plan)
        if self.taken == plan.plan_id:
            self._wait_for("")
            visit.next("sending")
        elif time.monotonic() - visit.since > RETRY:
            own = f"{self._node.get_fully_qualified_name()}/plan"
            self._wait_for(f"{self._settings.identifier} does not take the plan: is it there, plan_topic {own}?")
            if self._due():
                self._announce(plan)

    def _announce(self, plan: Announced) -> None:
        stamp = self._node.get_clock().now().nanoseconds
        self._plan, self._plans[plan.plan_id] = plan, plan
        self._out.publish(plan_to_message(plan.plan, plan.plan_id, stamp, self._settings.frame_id))

    def _send(self, visit: Visit) -> None:
        """The robot goes there."""
        settings, plan = self._settings, self._plan
        assert plan is not None
        if not self._execution.ready:
            self._wait_for(f"nobody offers {settings.execute_action}: is the robot's node there?")
        elif not self.waiting or self._due():
            stamp, row = self._node.get_clock().now().nanoseconds, plan.stops.index(visit.action.index)
            goal = plan_to_message(plan.part(row), plan.plan_id, stamp, settings.frame_id)
            self._execution.send(ExecutePlan.Goal(plan=goal, dwell=settings.dwell))
            visit.next("moving")

    def _moved(self, state: CampaignState, visit: Visit, ended: Ended) -> CampaignState:
        index = visit.action.index
        if ended.how == "done":
            self._wait_for("")
            visit.next("judging")
        elif ended.how == "refused":
            return state.unreachable(index, ended.message or "refused by the robot")
        elif ended.how == "aborted":
            self.visit = None
            return state.failed(index, ended.message or "the robot stopped")
        else:
            self._wait_for(ended.message or f"{ended.how} by the robot")
            visit.next("sending")
        return state

    def _not_measured(self, state: CampaignState, visit: Visit) -> CampaignState:
        """The robot stood there, and the identifier did not accept it in time."""
        name = self._settings.identifier
        if not visit.said and not self._node.count_publishers(f"{name}/measurements"):
            self._wait_for(f"{name} is not there")
            visit.next("telling")
            return state
        if visit.anywhere:
            self.visit, self._spoilt = None, visit.said
            self._wait_for("")
            return state
        reason = visit.said or f"{name} said nothing within {self._settings.patience:g} s"
        self._node.get_logger().warning(f"configuration {visit.action.index}: {reason}")
        self.visit = None
        return state.failed(visit.action.index, reason)

    def _wait_for(self, what: str) -> None:
        """For nothing, if it is empty, but that what spoils measurements passes."""
        what = what or self._spoilt
        if what and not self.waiting:
            self._waited_since = self._tried = time.monotonic()
            self._node.get_logger().warning(f"waiting: {what}")
        self.waiting = what

    def _due(self) -> bool:
        """Whether it is time for another attempt."""
        now = time.monotonic()
        due = now - self._tried > RETRY
        self._tried = now if due else self._tried
        return due


def _joints(message: Measurement, state: CampaignState) -> FloatArray:
    """Where the robot stood, in its own order of joints."""
    names = state.problem.robot.joint_names
    if sorted(message.joint_names) != sorted(names):
        raise InputError("measurement.joint_names", ", ".join(message.joint_names)[:200], ", ".join(names))
    return pick_joints(message.joint_names, message.joint_positions, names)
