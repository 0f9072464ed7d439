# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A campaign over ROS: its problem from the parameters, measuring its configurations, its status and its results.

``Measuring`` tells the identifier the plan, sends the robot to one configuration at a time and listens to what
was accepted. Every step has an end. A robot that refuses a configuration cannot reach it; a standstill that the
identifier rejects, or does not mention, is a failed attempt. A robot or identifier that is not there or does not
answer, and what would spoil any measurement (``ANYWHERE``), is not the configuration's fault: ``Measuring`` waits
for it to pass, and tries again every ``RETRY`` seconds. A robot that was stopped by a person, or by a lost beam,
goes on when a person says so: ``Measuring`` is ``halted``.
"""

from __future__ import annotations

import hashlib
import json
import math
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import CalibrationEstimate, CampaignStatus, JointConfiguration, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from rclpy.publisher import Publisher

from calib_planner.acquisition import pick_joints
from calib_planner.arrays import FloatArray
from calib_planner.campaign import (
    FIT,
    VALIDATION,
    CampaignProblem,
    CampaignResult,
    CampaignState,
    Finished,
    Measure,
    Paused,
)
from calib_planner.errors import InputError
from calib_planner.io import config_folder, write_estimate, write_measurements
from calib_planner.measurements import configuration_labels
from calib_planner.planning import Plan, PlanQuality
from calib_planner.ros.cell import error_model_of, instrument_of
from calib_planner.ros.executor import Ended, PlanExecution
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.messages import (
    NAN,
    PURPOSE,
    duration_message,
    estimate_to_message,
    in_ros,
    plan_to_message,
    verdict_message,
)
from calib_planner.ros.model import Model, NotReady, with_targets
from calib_planner.ros.planning import constraints_of
from calib_planner.ros.session import condition_of, confined
from calib_planner.ros.settings import CampaignParameters, unknown_words
from calib_planner.units import cut, listed

SAME = ("budget", "batch", "validation", "minimum", "attempts", "most_failures", "exclusion", "sigma", "starts",
        "time_limit", "seed", "accuracy_frame")  # fmt: skip
"""Parameters that are fields of ``CampaignProblem``."""
GOALS = (
    "required_accuracy",
    "test_poses",
    "parameters",
    "unknown",
    "targets",
    "cell",
    "constraints",
    "error_model",
    *SAME,
)
"""Parameters that say what a campaign has to reach, and how: they stay what they were when it began."""


def goals_of(settings: CampaignParameters) -> dict[str, Any]:
    """What the record of a campaign keeps of the parameters, and marks of the files that they name."""
    return {name: getattr(settings, name) for name in GOALS} | {"sha256": _marks_of_files(settings)}


def _marks_of_files(settings: CampaignParameters) -> dict[str, str]:
    """Name of a parameter → hash of the file that it names."""
    folder = Path(settings.constraints_folder) if settings.constraints_folder else config_folder()
    places = {"cell": Path(settings.cell), "error_model": Path(settings.error_model)}
    places["constraints"] = folder / settings.constraints
    files = {name: path.expanduser() for name, path in places.items() if getattr(settings, name)}
    return {name: hashlib.sha256(p.read_bytes()).hexdigest() for name, p in files.items() if p.is_file()}


def with_goals(settings: CampaignParameters, goals: Mapping[str, Any]) -> tuple[CampaignParameters, list[str]]:
    """The parameters with the goals of a record, and in words what differs.

    Args:
        settings: The parameters now.
        goals: Those of the record; what it does not name is taken from the parameters.

    Raises:
        InputError: The record holds a value that is none.
    """
    stored: dict[str, Any] = {}
    differing: list[str] = []
    for name in GOALS:
        now, value = getattr(settings, name), goals.get(name)
        if isinstance(value, list):  # poses, as earlier versions wrote them
            value = "; ".join(" ".join(map(repr, row)) for row in value)
        if value is None:
            continue
        if type(value) is not type(now) and not (type(now) is float and type(value) is int):
            got, expected = f"{json.dumps(value)} in the record", type(now).__name__
            raise InputError(name, cut(got, 200), expected, "choose another store_folder")
        stored[name] = type(now)(value)
        if stored[name] != now:
            differing.append(f"{name} is {cut(str(value), 100)!r} in the record, {cut(str(now), 100)!r} here")
    restored = replace(settings, **stored)
    now_there, then = _marks_of_files(restored), goals.get("sha256")
    for name, mark in then.items() if isinstance(then, dict) else ():
        if now_there.get(name) != mark:
            differing.append(f"the file that {name} names has changed since, and counts as it is now")
    return restored, differing


def problem_of(settings: CampaignParameters, model: Model | NotReady) -> CampaignProblem:
    """The campaign's problem.

    Raises:
        NotReady: There is no robot yet.
        InputError: A parameter is not usable for this robot.
    """
    if not isinstance(model, Model):
        raise model
    if not settings.test_pose_rows:
        names = ", ".join(model.robot.joint_names)
        raise InputError("test_poses", "none", f"joint coordinates in the order {names}", "set the parameter")
    robot = with_targets(model.robot, settings.targets or None, settings.unknown)
    robot = robot.with_parameters(settings.parameters, unknown_words(settings.unknown))
    lengths = {len(row) for row in settings.test_pose_rows}
    if lengths != {len(robot.joint_names)}:
        expected = f"{len(robot.joint_names)} numbers a pose: {', '.join(robot.joint_names)}"
        raise InputError("test_poses", f"{sorted(lengths)} numbers", expected)
    return CampaignProblem(
        robot,
        np.array(settings.test_pose_rows),
        settings.required_accuracy,
        constraints=constraints_of(settings, robot),
        noise=instrument_of(settings),
        identification={"error_model": error_model_of(settings, robot)},
        **{name: getattr(settings, name) for name in SAME},
    )


@dataclass(frozen=True, eq=False)
class Announced:
    """A plan that the identifier is told.

    Attributes:
        plan_id: Name of the plan.
        plan: The plan.
        numbers: Number of each row's configuration in the campaign.
        role: What they are measured for, ``fit`` or ``validation``.
    """

    plan_id: str
    plan: Plan
    numbers: tuple[int, ...]
    role: str

    def covers(self, number: int, state: CampaignState) -> bool:
        """Whether the plan has the configuration as the campaign wants it now: for that role, and as often."""
        if number not in self.numbers or state.configurations[number].role != self.role:
            return False
        return bool(self.plan.repetitions[self.numbers.index(number)] == state.configurations[number].times)

    def part(self, row: int) -> Plan:
        """A plan of one row, to be measured once."""
        q = self.plan.configurations[row : row + 1]
        return replace(self.plan, configurations=q, repetitions=np.array([1]))


def announced(state: CampaignState, campaign_id: str, role: str) -> Announced:
    """The plan of all configurations of ``role`` that were measured or are to be, for the identifier to match."""
    measured = {r.index for r in state.measurements}
    rows = [
        i for i, s in enumerate(state.configurations) if s.role == role and (i in measured or i in state.queue)
    ]
    problem, last = state.problem, state.rounds[-1] if state.rounds else None
    poses = problem.test_pose_array
    accuracy = float("nan") if last is None else last.accuracy
    plan = Plan(
        robot=problem.robot.name,
        parameters=problem.robot.parameter_names,
        joint_names=problem.robot.joint_names,
        configurations=np.array([state.configurations[i].q for i in rows]),
        repetitions=np.array([state.configurations[i].times for i in rows]),
        test_poses=poses,
        weights=np.full(len(poses), 1.0 / len(poses)),
        sigma=problem.instrument.typical,
        quality=PlanQuality(
            predicted_accuracy_per_test_pose=np.full(len(poses), accuracy),
            parameter_std=np.full(len(problem.robot.parameter_names), np.nan),
            predicted_accuracy=accuracy,
            value=accuracy,
            message=state.message,
            seed=problem.seed,
        ),
    )
    return Announced(f"{campaign_id}-{role}-{uuid.uuid4().hex[:8]}", plan, tuple(rows), role)


RETRY = 2.0
"""Time between two attempts at something that did not answer [s]."""
ANYWHERE = (
    Measurement.REJECTED_TIME_SKEW,
    Measurement.REJECTED_CLOCK_OFFSET,
    Measurement.REJECTED_OTHER_FRAME,
    Measurement.REJECTED_NOT_STORED,
)
"""Rejections that another configuration would meet as well."""
ROLE = {value: role for role, value in PURPOSE.items()}
HALTED = {"stopped": "the robot was stopped", "beam_lost": "the beam was lost"}
"""Ends of a goal after which a person has to look: what is said of each."""


@dataclass
class Visit:
    """Measuring one configuration once.

    Attributes:
        action: What the campaign wants measured.
        since: When the phase began [s].
        phase: ``telling`` the plan, ``sending`` the robot, ``moving``, ``judging`` (the identifier does).
        reason: Why the identifier rejected a standstill meanwhile; empty if it rejected none.
        anywhere: Whether it was for one of ``ANYWHERE``.
        final: Whether the identifier will not judge this standstill again.
        told_again: Whether the plan was told again, because the identifier said nothing.
    """

    action: Measure
    since: float
    phase: str = "telling"
    reason: str = ""
    anywhere: bool = False
    final: bool = False
    told_again: bool = False

    def next(self, phase: str, now: float) -> None:
        """Begin a phase at ``now`` [s]."""
        self.phase, self.since = phase, now


class Measuring:
    """The robot and the identifier, as a campaign needs them; made in ``configure`` of ``node``.

    Args:
        node: The campaign's node.
        plans: Publishes plans to the identifier.

    Attributes:
        visit: What is being measured; ``None`` if nothing is.
        waiting: What is awaited; empty if nothing is.
        halted: Why the robot goes on only when a person says so; empty if it does by itself.
        taken: Name of the plan that the identifier has.
    """

    def __init__(self, node: ManagedNode[CampaignParameters], plans: Publisher) -> None:
        self._node, self._out, self.taken = node, plans, ""
        self._execution = PlanExecution(node, node.settings.value.execute_action)
        self.begin("")

    def begin(self, campaign_id: str) -> None:
        """Begin a campaign, or go on with one."""
        self._id = campaign_id
        self._plan: Announced | None = None
        self._plans: dict[str, Announced] = {}
        self.visit: Visit | None = None
        self.waiting, self.halted, self._waited_since, self._tried = "", "", 0.0, 0.0
        self._spoilt = ""  # reason of ANYWHERE of the last standstill; empty once a measurement succeeded

    @property
    def busy(self) -> bool:
        """Whether the robot executes a goal of this campaign."""
        return self._execution.busy

    @property
    def waited(self) -> float:
        """How long ``waiting`` has lasted [s]."""
        return self._node.seconds - self._waited_since if self.waiting else 0.0

    def leave(self) -> None:
        """Measure nothing now: the robot stops."""
        self.visit, self._spoilt, self.halted = None, "", ""
        self._wait_for("")
        self._execution.poll(self._settings.silence)
        self._execution.cancel()

    def end(self, seconds: float) -> None:
        """``leave``, and wait until the robot's node has answered, at most so long [s]."""
        self.leave()
        self._execution.insist(seconds)

    def tell_fit(self, state: CampaignState) -> None:
        """Tell the identifier a plan of everything that is measured for the fit.

        So it hears that a validation joined the fit, and has the plan of the fit in the end.
        """
        measured = {r.index for r in state.measurements_of(FIT)}
        told = [p for p in self._plans.values() if p.role == FIT and measured <= set(p.numbers)]
        if measured and (self._plan is None or self._plan not in told):
            self._announce(told[-1] if told else announced(state, self._id, FIT))

    def heard(self, message: Measurement, state: CampaignState) -> CampaignState:
        """Take what the identifier publishes about a standstill.

        An outlier counts as measured: the campaign looks for outliers itself, and its fit must not depend on what
        is measured for validation. A measurement of this campaign that belongs to no plan known here is one that
        was made just before a crash: it counts, too.

        Raises:
            InputError: A measurement of other joints.
        """
        known = any(r.number == message.id for r in state.measurements)
        if message.status not in (Measurement.ACCEPTED, Measurement.REJECTED_OUTLIER):
            if known:
                return state.withdrawn(int(message.id), cut(message.reason, 300) or "undone")
            if message.status != Measurement.REJECTED_UNDONE:  # told again: not of the visit under way
                self._rejected(message)
            return state
        self._spoilt = ""
        if known:
            return state
        plan = self._plans.get(message.plan_id)
        points, std = (np.array([[v.x, v.y, v.z] for v in many]) for many in (message.points, message.std))
        what = points, int(message.id), std if std.shape == points.shape else None
        if plan is not None and message.configuration_index < len(plan.numbers):
            number = plan.numbers[message.configuration_index]
            return state.measured(number, _joints(message, state), *what)
        if self._id and message.campaign_id == self._id and message.purpose in ROLE:
            return state.adopted(ROLE[message.purpose], _joints(message, state), *what)
        return state

    def _rejected(self, message: Measurement) -> None:
        visit = self.visit
        if visit is None or visit.phase not in ("moving", "judging"):
            return
        visit.reason, visit.anywhere = cut(message.reason, 300), message.status in ANYWHERE
        # Only a standstill has points; what has none was no standstill and may still become one.
        plan, row = self._plans.get(message.plan_id), message.configuration_index
        here = plan is not None and row < len(plan.numbers) and plan.numbers[row] == visit.action.index
        visit.final = here and len(message.points) > 0

    def step(self, state: CampaignState, action: Measure) -> CampaignState:
        """Go on measuring; returns the state afterwards."""
        ended = self._execution.poll(self._settings.silence)
        visit = self.visit
        if visit is None or (visit.action.index, visit.action.repetition) != (action.index, action.repetition):
            self.visit = visit = Visit(action, self._node.seconds)
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
        elif visit.final or self._node.seconds - visit.since > self._settings.patience:
            return self._not_measured(state, visit)
        return state

    @property
    def _settings(self) -> CampaignParameters:
        return self._node.settings.value

    def _tell(self, state: CampaignState, visit: Visit) -> None:
        """Announce the plan and wait until the identifier has it, before the robot goes there."""
        plan, role = self._plan, visit.action.role
        if plan is None or plan.role != role or not plan.covers(visit.action.index, state):
            plan = announced(state, self._id, role)
            self._announce(plan)
        if self.taken == plan.plan_id:
            self._wait_for("")
            visit.next("sending", self._node.seconds)
        elif self._node.seconds - visit.since > RETRY:
            own = f"{self._node.get_fully_qualified_name()}/plan"
            self._wait_for(f"{self._settings.identifier} does not take the plan: is it there, plan_topic {own}?")
            if self._due():
                self._announce(plan)

    def _announce(self, plan: Announced) -> None:
        self._plan, self._plans[plan.plan_id] = plan, plan
        self._out.publish(self._message(plan, plan.plan))

    def _message(self, told: Announced, plan: Plan) -> PlanMessage:
        stamp, frame = self._node.now, self._settings.frame_id
        return plan_to_message(plan, told.plan_id, stamp, frame, self._id, told.role)

    def _send(self, visit: Visit) -> None:
        """Send the robot to the configuration."""
        settings, plan = self._settings, self._plan
        assert plan is not None
        if not self._execution.ready:
            self._wait_for(f"nobody offers {settings.execute_action}: is the robot's node there?")
        elif not self.waiting or self._due():
            goal = self._message(plan, plan.part(plan.numbers.index(visit.action.index)))
            self._execution.send(ExecutePlan.Goal(plan=goal, dwell=duration_message(settings.dwell)))
            visit.next("moving", self._node.seconds)

    def _moved(self, state: CampaignState, visit: Visit, ended: Ended) -> CampaignState:
        index = visit.action.index
        if ended.how == "done":
            self._wait_for("")
            visit.next("judging", self._node.seconds)
        elif ended.how == "refused":
            return state.unreachable(index, ended.message or "refused by the robot")
        elif ended.how == "aborted":
            self.visit = None
            return state.failed(index, ended.message or "the robot stopped")
        elif ended.how in HALTED:
            self.halted = f"{HALTED[ended.how]}: {ended.message or 'the robot says no more'}"
        else:
            self._wait_for(ended.message or f"{ended.how} by the robot")
            visit.next("sending", self._node.seconds)
        return state

    def _not_measured(self, state: CampaignState, visit: Visit) -> CampaignState:
        """Decide what it means that the robot stood there and the identifier did not accept it in time."""
        name = self._settings.identifier
        if not visit.reason and not self._node.count_publishers(f"{name}/measurements"):
            self._wait_for(f"{name} is not there")
            visit.next("telling", self._node.seconds)
            return state
        if not visit.reason and not visit.told_again and self._plan is not None:
            # It may have accepted it and was started anew since: a plan that is told again is answered with
            # what was measured.
            visit.told_again = True
            self._announce(self._plan)
            visit.next("judging", self._node.seconds - max(self._settings.patience - RETRY, 0.0))
            return state
        if visit.anywhere:
            self.visit, self._spoilt = None, visit.reason
            self._wait_for("")
            return state
        reason = visit.reason or f"{name} said nothing within {self._settings.patience:g} s"
        self._node.get_logger().warning(f"configuration {visit.action.index}: {reason}")
        self.visit = None
        return state.failed(visit.action.index, reason)

    def _wait_for(self, what: str) -> None:
        """Note what is awaited.

        An empty string means that nothing is awaited, unless a disturbance is still active.
        """
        what = what or self._spoilt
        if what and not self.waiting:
            self._waited_since = self._tried = self._node.seconds
            self._node.get_logger().warning(f"waiting: {what}")
        self.waiting = what

    def _due(self) -> bool:
        """Whether it is time for another attempt."""
        now = self._node.seconds
        due = now - self._tried > RETRY
        self._tried = now if due else self._tried
        return due


def _joints(message: Measurement, state: CampaignState) -> FloatArray:
    """(joints,) [rad | m] where the robot stood, in its own order of joints."""
    names = state.problem.robot.joint_names
    if sorted(message.joint_names) != sorted(names):
        raise InputError("measurement.joint_names", listed(message.joint_names), ", ".join(names))
    return pick_joints(message.joint_names, message.configuration.positions, names)


FIELD = "store_folder"


def result_message(result: CampaignResult, campaign_id: str, frame_id: str) -> CalibrationEstimate | None:
    """The estimate of the fit with the campaign's verdict, without stamp; ``None`` if there is none."""
    if result.estimate is None or result.fit is None:
        return None
    return estimate_to_message(
        result.estimate,
        frame_id,
        campaign_id=campaign_id,
        configurations=len(np.unique(configuration_labels(result.fit.q))),
        rejected=result.spent - len(result.fit) - len(result.validation or ()),
        condition=condition_of(result.estimate),
        complete=result.outcome == "reached",
        verdict=verdict_message(result.verdict),
    )


def write_result(folder: str, result: CampaignResult, campaign_id: str) -> None:
    """Write ``measurements_ID.csv``, ``validation_ID.csv`` and ``estimate_ID.yaml``, as far as there are data.

    Raises:
        CalibPlannerError: They cannot be written.
    """
    for name, data in (("measurements", result.fit), ("validation", result.validation)):
        if data is not None:
            write_measurements(confined(folder, f"{name}_{campaign_id}.csv"), data, FIELD)
    if result.estimate is not None:
        write_estimate(confined(folder, f"estimate_{campaign_id}.yaml"), result.estimate, FIELD)


OUTCOME = {
    "": CampaignStatus.OUTCOME_OPEN,
    "reached": CampaignStatus.OUTCOME_REACHED,
    "budget_spent": CampaignStatus.OUTCOME_BUDGET_SPENT,
    "limited": CampaignStatus.OUTCOME_LIMITED,
    "unreachable": CampaignStatus.OUTCOME_UNREACHABLE,
    "failed": CampaignStatus.OUTCOME_FAILED,
}


NUMBERS = ("predicted_accuracy", "required_accuracy", "sigma", "left_out_rms", "validation_rms",
           "validation_predicted_rms")  # fmt: skip
"""Numbers of a status that are not known before there is a campaign."""


def idle_status(reason: str) -> CampaignStatus:
    """The status before the first campaign."""
    return CampaignStatus(state=CampaignStatus.IDLE, reason=cut(reason), **dict.fromkeys(NUMBERS, NAN))


def status_message(
    state: CampaignState, campaign_id: str, waiting: str, reason: str, *, planning: bool = False
) -> CampaignStatus:
    """The status of a campaign, without stamp.

    Args:
        state: The campaign.
        campaign_id: Its name.
        waiting: What it waits for; empty if for nothing.
        reason: What else there is to say.
        planning: Whether the rest is planned anew while the campaign is paused.
    """
    problem, action, last = state.problem, state.action, state.rounds[-1] if state.rounds else None
    allowed = max(problem.fit_budget - state.spent(FIT), 0)
    left = 0 if state.outcome else allowed if not math.isfinite(state.left) else min(int(state.left), allowed)
    message = CampaignStatus(
        campaign_id=campaign_id,
        robot=problem.robot.name,
        state=CampaignStatus.PLANNING if planning else _state(state, waiting),
        outcome=OUTCOME[state.outcome],
        round=len(state.rounds),
        measured=len(state.measurements_of(FIT)),
        left=left,
        budget=problem.budget,
        validated=len(state.measurements_of(VALIDATION)),
        validation=problem.validation,
        excluded=len(state.exclusions) + len(state.dropped),
        predicted_accuracy=NAN if last is None or math.isinf(last.accuracy) else last.accuracy,
        required_accuracy=problem.required_accuracy,
        sigma=NAN if last is None else last.sigma,
        validation_rms=NAN,
        validation_predicted_rms=NAN,
        left_out_rms=NAN if last is None else last.left_out,
        round_measured=[r.measured for r in state.rounds],
        round_accuracy=[r.accuracy if math.isfinite(r.accuracy) else NAN for r in state.rounds],
        joint_names=list(problem.robot.joint_names),
        ahead=list(state.ahead),
        ahead_configurations=[
            JointConfiguration(positions=state.configurations[i].q.tolist()) for i in state.ahead
        ],
        reason=cut(in_ros("; ".join(filter(None, (waiting, reason, state.message))))),
    )
    if isinstance(action, Measure):
        message.configuration_index = action.index
        message.configuration.positions = action.q.tolist()
    if isinstance(action, Finished):
        _fill_result(message, action.result)
    return message


def _state(state: CampaignState, waiting: str) -> int:
    action = state.action
    if isinstance(action, Finished):
        return int(CampaignStatus.DONE)
    if isinstance(action, Paused):
        return int(CampaignStatus.PAUSED)
    if waiting:
        return int(CampaignStatus.WAITING)
    if isinstance(action, Measure):
        return int(CampaignStatus.MEASURING if action.role == FIT else CampaignStatus.VALIDATING)
    return int(CampaignStatus.PLANNING)


def _fill_result(message: CampaignStatus, result: CampaignResult) -> None:
    message.predicted_accuracy = NAN if math.isinf(result.accuracy) else result.accuracy
    message.verdict = verdict_message(result.verdict)
    if result.estimate is not None:
        message.left_out_rms = float(result.estimate.left_out.rms)
    validation = None if result.estimate is None else result.estimate.validation
    if validation is not None:
        message.validation_rms, message.validation_predicted_rms = validation.rms, validation.predicted_rms
