# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the page shows, as a pure value: messages go in, sections of plain values for the browser come out.

``PageState`` is what was heard. Each ``on_…`` takes a message and returns the state afterwards; what does not fit
is refused there. ``SECTIONS`` says of each part of the page how it follows from which fields, so that only what
has changed is made and sent again. Texts and numbers are written here, in the units of the report (mm and
degrees), and the page's script puts them on the screen as they are. Nothing here needs a node, a server or a
browser.

*Where a measured point is.* Points come in the frame of the tracker. The drawing is in the frame of the robot's
base, and the newest estimate says where that is. Until there is an estimate no point is drawn.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import CalibrationEstimate, CampaignStatus, Measurement, Plan, Residuals, Verdict
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from calib_planner.arrays import FloatArray, plain
from calib_planner.errors import InputError
from calib_planner.report import (
    REJECTED,
    TEMPLATES,
    USED,
    MeasuredPoints,
    bodies,
    embedded,
    origin_of_points,
    posture_drawings,
    render,
    visits_scene,
)
from calib_planner.robot import Robot
from calib_planner.units import cut, joint_factor, joint_unit, milli, signed

MOST_VISITS, MOST_AHEAD, MOST_TARGETS = 2000, 300, 20
"""Measurements, configurations ahead, and targets of one measurement that the page keeps: the newest."""
MOST_ROWS = 100
"""Measurements in the list, the newest first."""
MOST_LINES, MOST_REASONS, MOST_STREAMS, MOST_HISTORY = 30, 30, 20, 500
LONGEST = 600
"""Characters of a text from a topic."""
LEAST_REST = 0.2
"""A shorter rest is taken for motion [s]: two samples at a turning point are one."""
UNKNOWN = "–"
"""Shown where a number is not known."""


# ── what was heard ───────────────────────────────────────────────────────────────────────────────────


class Why(NamedTuple):
    """A reason of a verdict: PASS, WARN or FAIL, what it is, what to do."""

    level: str
    text: str
    advice: str


class Ahead(NamedTuple):
    """A configuration that is to be measured: its number in the campaign and its joints [rad | m]."""

    number: int
    q: tuple[float, ...]


class Visit(NamedTuple):
    """A standstill, as ``Measurement``; lengths in m.

    Attributes:
        q: Joints [rad | m].
        points: Position of each target in the tracker's frame; NaN where it was not seen.
        status: A constant of ``Measurement``.
        validation: Whether it was measured for validation.
        unused: Targets whose points are not used, from 0.
        reason: Why it was rejected, or targets are not used.
        campaign: Name of the campaign that it is part of; empty if of none.
    """

    number: int
    q: tuple[float, ...]
    points: tuple[tuple[float, float, float], ...]
    status: int
    validation: bool
    unused: tuple[int, ...]
    reason: str
    campaign: str


class Stream(NamedTuple):
    """What the identifier says of one stream on ``/diagnostics``: its topic, OK to STALE, and its values."""

    name: str
    level: str
    text: str
    values: Mapping[str, str]


class Line(NamedTuple):
    """An entry of the page's log: time of day [s since the epoch], ``good``, ``bad`` or empty, and its text."""

    time: float
    kind: str
    text: str


@dataclass(frozen=True)
class Campaign:
    """``CampaignStatus``, checked; lengths in m, NaN where not known."""

    id: str
    robot: str
    state: int
    outcome: int
    round: int
    measured: int
    left: int
    budget: int
    validated: int
    validation: int
    excluded: int
    predicted_accuracy: float
    required_accuracy: float
    left_out_rms: float
    validation_rms: float
    validation_predicted_rms: float
    rounds: tuple[tuple[int, float], ...]
    number: int
    joint_names: tuple[str, ...]
    q: tuple[float, ...]
    ahead: tuple[Ahead, ...]
    level: str
    reasons: tuple[Why, ...]
    reason: str


@dataclass(frozen=True, eq=False)
class Estimated:
    """What the page needs of ``CalibrationEstimate``; lengths in m, NaN where not known.

    Attributes:
        deviations: Parameter → identified − nominal [m | rad].
        accuracy: Root mean square of the predicted accuracy over the test poses.
        test_poses: Configurations [rad | m].
    """

    deviations: Mapping[str, float]
    points: int
    sigma: float
    residual_rms: float
    before_rms: float
    left_out_rms: float
    left_out_predicted_rms: float
    accuracy: float
    test_poses: tuple[tuple[float, ...], ...]
    joint_names: tuple[str, ...]
    level: str
    reasons: tuple[Why, ...]
    message: str


@dataclass(frozen=True, eq=False)
class PageState:
    """Everything that the page shows.

    Attributes:
        robot: The robot, as its description says.
        residuals: (number of the visit, target from 0) → measured − estimated [m], and whether it is used.
        history: (measurements, predicted accuracy [m]) of each estimate.
        phase: What the executor does, a constant of ``ExecutePlan.Feedback``; ``None`` if it is silent.
        joints: Where the robot is now [rad | m], in the robot's order; empty before it is heard.
        there: Names of services that are offered, and of nodes that are there.
        names: Part (``campaign``, ``identifier``, ``executor``) → name of its node.
        namespace: Of the page, in which these names are, unless they begin with a slash.
        waiting: Buttons whose answer has not come.
        report: Name of the newest report that the page can show.
    """

    robot: Robot | None = None
    campaign: Campaign | None = None
    estimate: Estimated | None = None
    residuals: Mapping[tuple[int, int], tuple[tuple[float, float, float], bool]] = field(default_factory=dict)
    visits: Mapping[int, Visit] = field(default_factory=dict)
    history: tuple[tuple[int, float], ...] = ()
    streams: tuple[Stream, ...] = ()
    phase: int | None = None
    joints: tuple[float, ...] = ()
    there: frozenset[str] = frozenset()
    names: Mapping[str, str] = field(default_factory=dict)
    namespace: str = ""
    waiting: frozenset[str] = frozenset()
    journal: tuple[Line, ...] = ()
    report: str = ""


LEVELS = {Verdict.UNKNOWN: "", Verdict.PASS: "PASS", Verdict.WARN: "WARN", Verdict.FAIL: "FAIL"}
HEALTH = {
    DiagnosticStatus.OK: "OK",
    DiagnosticStatus.WARN: "WARN",
    DiagnosticStatus.ERROR: "ERROR",
    DiagnosticStatus.STALE: "STALE",
}


def on_status(state: PageState, message: CampaignStatus) -> PageState:
    """The campaign's status; another campaign's measurements are forgotten.

    Raises:
        InputError: A configuration is not of the joints that are named.
    """
    names = tuple(cut(n, LONGEST) for n in message.joint_names)
    rows = zip(message.ahead[:MOST_AHEAD], message.ahead_configurations[:MOST_AHEAD], strict=False)
    campaign = Campaign(
        id=cut(message.campaign_id, LONGEST),
        robot=cut(message.robot, LONGEST),
        q=_joints("configuration", message.configuration, names, empty=True),
        joint_names=names,
        ahead=tuple(Ahead(int(n), _joints("ahead_configurations", c, names)) for n, c in rows),
        number=int(message.configuration_index),
        rounds=tuple(zip(message.round_measured.tolist(), message.round_accuracy.tolist(), strict=False)),
        reason=cut(message.reason, LONGEST),
        level=LEVELS.get(message.verdict.level, ""),
        reasons=_reasons(message.verdict),
        **{name: getattr(message, name) for name in _SAME},
    )
    before = state.campaign
    state = replace(state, campaign=campaign)
    if campaign.id and (before is None or before.id != campaign.id):
        mine = {number: visit for number, visit in state.visits.items() if visit.campaign == campaign.id}
        state = replace(state, visits=mine)
    if before is not None and campaign.id and before.id != campaign.id:
        state = replace(state, residuals={}, history=(), report="")
    return state


_OWN = {"id", "robot", "q", "joint_names", "ahead", "number", "rounds", "reason", "level", "reasons"}
_SAME = [f.name for f in fields(Campaign) if f.name not in _OWN]
"""Numbers that are the same in message and state."""


def on_estimate(state: PageState, message: CalibrationEstimate) -> PageState:
    """The identifier's newest estimate.

    Raises:
        InputError: Numbers and names do not fit.
    """
    names = tuple(message.parameters)
    deviation = np.asarray(message.deviation, float)
    if deviation.shape != (len(names),):
        raise InputError("deviation", f"{len(deviation)} numbers", f"{len(names)}, one per parameter")
    joints = tuple(message.joint_names)
    accuracy = np.asarray(message.predicted_accuracy, float)
    estimate = Estimated(
        deviations=dict(zip(names, np.where(np.isfinite(deviation), deviation, 0.0).tolist(), strict=True)),
        points=int(message.measurements),
        sigma=message.sigma_estimate,
        residual_rms=message.residual_rms_after,
        before_rms=message.residual_rms_before,
        left_out_rms=message.left_out_rms,
        left_out_predicted_rms=message.left_out_predicted_rms,
        accuracy=float(np.sqrt(np.mean(accuracy**2))) if accuracy.size else math.nan,
        test_poses=tuple(_joints("test_poses", c, joints) for c in message.test_poses[:MOST_AHEAD]),
        joint_names=joints,
        level=LEVELS.get(message.verdict.level, ""),
        reasons=_reasons(message.verdict),
        message=cut(message.message, LONGEST),
    )
    history = state.history
    if math.isfinite(estimate.accuracy):
        each = max((len(v.points) for v in state.visits.values()), default=1) or 1
        history = (*history, (round(estimate.points / each), estimate.accuracy))[-MOST_HISTORY:]
    return replace(state, estimate=estimate, history=history)


def on_measurement(state: PageState, message: Measurement) -> PageState:
    """A standstill, or what became of one that was heard before; those of other campaigns are passed over.

    Raises:
        InputError: Joints or points do not fit.
    """
    names = tuple(message.joint_names)
    visit = Visit(
        number=int(message.id),
        q=_joints("configuration", message.configuration, names),
        points=tuple((p.x, p.y, p.z) for p in message.points[:MOST_TARGETS]),
        status=int(message.status),
        validation=message.purpose == Plan.VALIDATION,
        unused=tuple(int(t) for t in message.unused_targets[:MOST_TARGETS]),
        reason=cut(message.reason, LONGEST),
        campaign=cut(message.campaign_id, LONGEST),
    )
    if visit.campaign and state.campaign is not None and visit.campaign != state.campaign.id:
        return state
    if not visit.number:
        return told(state, "bad", f"A standstill was not accepted: {visit.reason}") if visit.reason else state
    visits = {**state.visits, visit.number: visit}
    return replace(state, visits=dict(list(visits.items())[-MOST_VISITS:]))


def on_residuals(state: PageState, message: Residuals) -> PageState:
    """The residuals of the newest estimate.

    Raises:
        InputError: The lists differ in length.
    """
    count = len(message.ids)
    if {len(message.targets), len(message.residuals), len(message.used)} != {count}:
        raise InputError("residuals", "lists of different lengths", f"{count} of each, as there are ids")
    rows = zip(message.ids, message.targets, message.residuals, message.used, strict=True)
    given = {(int(i), int(t)): ((v.x, v.y, v.z), bool(used)) for i, t, v, used in rows}
    return replace(state, residuals=dict(list(given.items())[-MOST_VISITS * MOST_TARGETS :]))


def on_diagnostics(state: PageState, message: DiagnosticArray) -> PageState:
    """The streams of the identifier; what other nodes say is passed over."""
    name = state.names.get("identifier", "")
    full = name if name.startswith("/") else f"{state.namespace}/{name}"
    begin = f"{full.strip('/')}: stream "
    mine = [s for s in message.status if s.name.lstrip("/").startswith(begin)]
    if not mine:
        return state
    streams = tuple(
        Stream(
            cut(s.name.lstrip("/")[len(begin) :], LONGEST),
            HEALTH.get(s.level, "STALE"),
            cut(s.message, LONGEST),
            {cut(v.key, LONGEST): cut(v.value, LONGEST) for v in s.values[:MOST_STREAMS]},
        )
        for s in mine[:MOST_STREAMS]
    )
    return replace(state, streams=streams)


def on_feedback(state: PageState, message: ExecutePlan.Feedback | None) -> PageState:
    """What the executor does; ``None``: it has been silent."""
    phase = None if message is None else int(message.phase)
    return state if phase == state.phase else replace(state, phase=phase)


def told(state: PageState, kind: str, text: str, time: float = 0.0) -> PageState:
    """A further line of the log; ``kind`` is ``good``, ``bad`` or empty."""
    return replace(state, journal=(*state.journal, Line(time, kind, cut(text, LONGEST)))[-MOST_LINES:])


def _joints(where: str, message: Any, names: Sequence[str], *, empty: bool = False) -> tuple[float, ...]:
    """The positions of a ``JointConfiguration`` [rad | m]."""
    q = tuple(message.positions.tolist())
    if (empty and not q) or (len(q) == len(names) and all(map(math.isfinite, q))):
        return q
    raise InputError(where, f"{len(q)} joints", f"{len(names)} finite numbers, one per joint name")


def _sentence(text: str) -> str:
    """With a capital letter."""
    return text[:1].upper() + text[1:]


def _reasons(verdict: Verdict) -> tuple[Why, ...]:
    return tuple(
        Why(LEVELS.get(f.level, ""), _sentence(cut(f.text, LONGEST)), _sentence(cut(f.advice, LONGEST)))
        for f in verdict.reasons[:MOST_REASONS]
    )


# ── buttons: what can be done, and why not ───────────────────────────────────────────────────────────


class Button(NamedTuple):
    """What a person can ask for.

    Attributes:
        part: Whose service it is: ``campaign``, ``identifier`` or ``executor``.
        service: Name of the service, after ``~/``.
        label: What stands on the button.
        hint: What happens.
        refused: Why it makes no sense now; empty if it does.
        sure: What the page asks before; empty if nothing.
    """

    part: str
    service: str
    label: str
    hint: str
    refused: Callable[[PageState], str]
    sure: str = ""


S, F = CampaignStatus, ExecutePlan.Feedback
RUNNING = (S.PLANNING, S.MEASURING, S.VALIDATING, S.WAITING)


def _at(state: PageState) -> int:
    return S.IDLE if state.campaign is None else state.campaign.state


def _no_start(state: PageState) -> str:
    campaign, at = state.campaign, _at(state)
    begun = campaign is not None and campaign.measured + campaign.validated > 0
    return "A campaign is under way." if at in RUNNING or (at == S.PAUSED and begun) else ""


def _no_pause(state: PageState) -> str:
    return "" if _at(state) in RUNNING else "It is paused." if _at(state) == S.PAUSED else "Nothing is under way."


def _no_resume(state: PageState) -> str:
    return "" if _at(state) == S.PAUSED else "It is not paused."


def _no_skip(state: PageState) -> str:
    return "" if _at(state) in (S.MEASURING, S.VALIDATING) else "Nothing is being measured."


def _no_confirm(state: PageState) -> str:
    return "" if state.phase == F.CONFIRMING else "The robot waits for no confirmation."


def _no_undo(state: PageState) -> str:
    return "" if any(v.status == Measurement.ACCEPTED for v in state.visits.values()) else "Nothing was measured."


def _no_estimate(state: PageState) -> str:
    return "" if state.estimate is not None and state.estimate.points else "Nothing was measured."


def _always(state: PageState) -> str:
    return ""


MOVES = "The robot will move. Is its way free, and nobody near it?"
BUTTONS = {
    "start": Button("campaign", "start", "Start", "Begin a campaign", _no_start, MOVES),
    "pause": Button("campaign", "pause", "Pause", "The robot ends its move; nothing is lost", _no_pause),
    "resume": Button("campaign", "resume", "Resume", "Go on", _no_resume, MOVES),
    "confirm": Button("executor", "confirm", "Confirm", "The robot may make its next move", _no_confirm),
    "skip": Button("campaign", "skip", "Skip", "Leave out the present configuration", _no_skip),
    "undo": Button(
        "identifier",
        "undo",
        "Undo",
        "Withdraw the newest measurement",
        _no_undo,
        "Withdraw the newest measurement?",
    ),
    "save": Button("identifier", "save", "Save", "Write measurements and estimate", _no_estimate),
    "report": Button("identifier", "report", "Report", "Write the report", _no_estimate),
    "stop": Button("executor", "stop", "STOP", "The robot stops, the campaign pauses", _always),
    "skip_configuration": Button("campaign", "skip_configuration", "Leave out", "", _always),
}
"""Name → button. ``skip_configuration`` stands beside every configuration that is ahead."""


def refusal(state: PageState, name: str) -> str:
    """Why a button makes no sense now; empty if it does."""
    button = BUTTONS[name]
    if name in state.waiting:
        return "The answer has not come yet."
    reason = button.refused(state)
    if not reason and service_of(state, name) not in state.there:
        return f"{state.names.get(button.part, button.part)} is not there."
    return reason


def service_of(state: PageState, name: str) -> str:
    """The service that a button calls now: without an executor STOP pauses the campaign."""
    service = service_name(state, name)
    return service_name(state, "pause") if name == "stop" and service not in state.there else service


def service_name(state: PageState, name: str) -> str:
    """The service of a button, as ``node/service``."""
    button = BUTTONS[name]
    return f"{state.names.get(button.part, button.part)}/{button.service}"


# ── sections: what the browser gets ──────────────────────────────────────────────────────────────────


def mm(metres: float) -> str:
    """A length in mm, as in the report."""
    return f"{milli(metres)} mm" if math.isfinite(metres) else UNKNOWN


OUTCOMES = {
    S.OUTCOME_OPEN: "Done.",
    S.OUTCOME_REACHED: "Done: the required accuracy is reached.",
    S.OUTCOME_BUDGET_SPENT: "Done: the budget of measurements is spent.",
    S.OUTCOME_LIMITED: "Done: more measurements do not help, the robot's repeatability is the limit.",
    S.OUTCOME_UNREACHABLE: "Done: no configuration is left that can be measured.",
    S.OUTCOME_FAILED: "Done: the identification failed.",
}
PHASES = {
    F.MOVING: "The robot moves to configuration {}.",
    F.MEASURING: "The robot stands still at configuration {} and is measured.",
    F.CONFIRMING: "The robot waits until you confirm the move to configuration {}.",
    F.PLANNING: "The way to configuration {} is being planned.",
}
KINDS = {
    S.IDLE: ("idle", "ready"),
    S.PLANNING: ("planning", "planning"),
    S.MEASURING: ("measuring", "measuring"),
    S.VALIDATING: ("measuring", "validating"),
    S.WAITING: ("waiting", "waiting"),
    S.PAUSED: ("paused", "paused"),
    S.DONE: ("done", "done"),
}
"""State of the campaign → class of its colour, and the word on the badge."""


def _now(state: PageState) -> dict[str, Any]:
    """What happens, in a sentence; which visit of how many; the posture."""
    campaign, there = state.campaign, state.there
    name = state.names.get("campaign", "campaign")
    if campaign is None or name not in there:
        text = (
            "What is shown is the last that was heard of it. Its robot may still be moving." if campaign else ""
        )
        gone = {
            "kind": "gone",
            "word": "away",
            "title": f"{name} is not there.",
            "done": 0,
            "total": 0,
            "count": "",
        }
        return gone | {"reason": text or "Start it: the page waits for it."}
    kind, word = KINDS.get(campaign.state, ("idle", "unknown"))
    reason = SERVICE.sub(_pressed, campaign.reason)
    done = campaign.measured + campaign.validated
    total = done + campaign.left + max(campaign.validation - campaign.validated, 0)
    title, number = "", campaign.number
    if campaign.state == S.PLANNING:
        title = "The next configurations are being planned."
    elif campaign.state in (S.MEASURING, S.VALIDATING):
        phase = F.MOVING if state.phase is None else state.phase
        title = PHASES.get(phase, PHASES[F.MOVING]).format(number)
        word = "confirm" if phase == F.CONFIRMING else word
    elif campaign.state == S.WAITING:
        title = "The campaign waits, and goes on by itself."
    elif campaign.state == S.PAUSED:
        title = "Paused: the robot is sent nowhere until you press Resume."
        if not done and campaign.round and campaign.ahead:
            word, title = "review", "Look at the planned configurations, then press Resume."
            reason = "Choose one to see it. Leave out or replace what the robot should not do."
        elif not done and campaign.round:
            word, title = "review", "Paused: no planned configuration is left."
            reason = "Press Resume, and others are planned."
    elif campaign.state == S.DONE:
        title = OUTCOMES.get(campaign.outcome, OUTCOMES[S.OUTCOME_OPEN])
    else:
        title = "Nothing is under way."
    count: dict[str, Any] = {"done": 0, "total": 0, "count": ""}
    if total and campaign.state != S.IDLE:
        ended = campaign.state == S.DONE
        text = f"{done} measured" if ended else f"visit {min(done + 1, total)} of about {total}"
        text = f"about {total} visits" if campaign.state == S.PAUSED and not done else text
        count = {"done": done, "total": done if ended else total, "count": text}
    return {"kind": kind, "word": word, "title": title, "reason": _sentence(reason), **count}


SERVICE = re.compile(r"(\bcall )?~/([a-z_]+)")
"""How a text on a topic names a service."""


def _pressed(named: re.Match[str]) -> str:
    """The service as a person at the page knows it."""
    button = BUTTONS.get(named[2])
    if button is None:
        return named[0]
    return f"press {button.label}" if named[1] else button.label


def _posture(state: PageState) -> dict[str, Any] | None:
    """The drawing of the configuration that is being measured, or comes first, with its joints."""
    campaign, robot = state.campaign, state.robot
    if campaign is None or robot is None or campaign.joint_names != robot.joint_names:
        return None
    rows = [a for a, _ in _coming(campaign)]
    if not rows:
        return None
    drawing = posture_drawings(robot, np.array([a.q for a in rows]))[0]
    shapes = [[s.tag, s.attributes, s.words] for s in drawing.shapes]
    number = rows[0].number
    views = " and ".join(s.words for s in drawing.shapes if s.words)
    title = f"configuration {number}: {views} view of the robot"
    return {
        "number": number,
        "size": drawing.size,
        "title": title,
        "shapes": shapes,
        "joints": _shown(robot, rows[0].q),
    }


def _shown(robot: Robot, q: Sequence[float]) -> list[tuple[str, str]]:
    """(joint, value with its unit) of a configuration [rad | m]."""
    return [
        (name, f"{signed(joint_factor(turns) * v, 2)}{'' if turns else ' '}{joint_unit(turns)}")
        for name, turns, v in zip(robot.joint_names, robot.joint_is_revolute, q, strict=True)
    ]


def _numbers(state: PageState) -> list[dict[str, str]]:
    """The facts above the charts: what it is, its value, a remark."""
    campaign, estimate = state.campaign, state.estimate
    if campaign is None or campaign.state == S.IDLE:
        return []
    accuracy = campaign.predicted_accuracy
    met = math.isfinite(accuracy) and accuracy <= campaign.required_accuracy
    rows = [
        ("predicted accuracy", mm(accuracy), f"required {mm(campaign.required_accuracy)}", "good" if met else ""),
        ("measurements", f"{campaign.measured + campaign.validated}", f"of at most {campaign.budget}", ""),
    ]
    left_out = campaign.left_out_rms
    remark = ""
    if estimate is not None and math.isfinite(estimate.left_out_rms):
        left_out = estimate.left_out_rms if campaign.state != S.DONE else left_out
        remark = f"predicted {mm(estimate.left_out_predicted_rms)}"
    rows.append(("left-out error, rms", mm(left_out), remark, ""))
    if estimate is not None:
        rows.append(("residuals, rms", mm(estimate.residual_rms), f"before {mm(estimate.before_rms)}", ""))
    checked = mm(campaign.validation_rms)
    predicted = f"predicted {mm(campaign.validation_predicted_rms)}"
    count = f"{campaign.validated} of {campaign.validation} measured"
    rows.append(("validation, rms", checked, count if checked == UNKNOWN else predicted, ""))
    if campaign.excluded:
        rows.append(("left out", f"{campaign.excluded}", "configurations, and what is near", ""))
    return [dict(zip(("label", "value", "remark", "kind"), row, strict=True)) for row in rows]


def _accuracy(state: PageState) -> dict[str, Any]:
    """Predicted accuracy against measurements [mm]: of each estimate, and at the end of each round."""
    campaign = state.campaign
    rounds = [] if campaign is None else [(m, 1e3 * a) for m, a in campaign.rounds if math.isfinite(a)]
    return {
        "live": [(m, 1e3 * a) for m, a in state.history],
        "rounds": rounds,
        "required": math.nan if campaign is None else 1e3 * campaign.required_accuracy,
    }


def _residuals(state: PageState) -> dict[str, Any]:
    """Distance of each point from where the estimate puts it [mm], in the order of measuring."""
    order = {number: i + 1 for i, number in enumerate(sorted({n for n, _ in state.residuals}))}
    rows = [
        (order[n], 1e3 * math.hypot(*vector), used) for (n, _), (vector, used) in sorted(state.residuals.items())
    ]
    left_out = math.nan if state.estimate is None else 1e3 * state.estimate.left_out_rms
    return {"points": [r for r in rows if math.isfinite(r[1])], "left_out": left_out}


def _visits(state: PageState) -> dict[str, Any]:
    """Configurations ahead, and standstills, the newest first, as rows of words."""
    campaign, robot = state.campaign, state.robot
    fits = robot is not None and campaign is not None and campaign.joint_names == robot.joint_names
    ahead: list[dict[str, Any]] = []
    if campaign is not None and robot is not None and fits:
        for row, (a, note) in enumerate(_coming(campaign), len(state.visits)):
            key = f"ahead {a.number}"
            here = {"key": key, "row": row, "number": a.number, "note": note, "joints": _shown(robot, a.q)}
            ahead.append(here)
    done = [_measured(state, row, visit) for row, visit in enumerate(state.visits.values())]
    refused = refusal(state, "skip_configuration")
    return {"ahead": ahead, "done": done[: -MOST_ROWS - 1 : -1], "measured": len(done), "refused": refused}


def _coming(campaign: Campaign) -> list[tuple[Ahead, str]]:
    """The configuration that is being measured (``now``), then those ahead, each once, with how often."""
    times = Counter(a.number for a in campaign.ahead)
    coming = {a.number: (a, f"{times[a.number]} times" if times[a.number] > 1 else "") for a in campaign.ahead}
    if not campaign.q:
        return list(coming.values())
    coming.pop(campaign.number, None)
    return [(Ahead(campaign.number, campaign.q), "now"), *coming.values()]


def _measured(state: PageState, row: int, visit: Visit) -> dict[str, Any]:
    robot = state.robot
    keys = ((visit.number, target) for target in range(len(visit.points)))
    sizes = [1e3 * math.hypot(*state.residuals[k][0]) for k in keys if k in state.residuals]
    known = robot is not None and len(visit.q) == len(robot.joint_names)
    word = FATES.get(visit.status, "rejected")
    return {
        "key": f"measured {visit.number}",
        "number": visit.number,
        "row": row,
        "joints": _shown(robot, visit.q) if robot is not None and known else [],
        "kind": "good" if visit.status == Measurement.ACCEPTED else "bad",
        "word": "validation" if word == "used" and visit.validation else word,
        "residual": f"{max(sizes):.4f} mm" if sizes else UNKNOWN,
        "reason": visit.reason,
    }


FATES = {
    Measurement.ACCEPTED: "used",
    Measurement.REJECTED_OUTLIER: "outlier",
    Measurement.REJECTED_UNDONE: "withdrawn",
}


@lru_cache(maxsize=4)  # the robot that moves is drawn ten times a second
def placed(robot: Robot, estimate: Estimated | None, targets: int) -> Robot:
    """The robot where the estimate puts it in the frame of the points, with as many targets as are measured."""
    if targets != len(robot.targets):
        robot = robot.with_targets(np.zeros((targets, 3)))
    given = {} if estimate is None else estimate.deviations
    known = {n: d for n, d in given.items() if n in robot.available_parameters}
    return robot.with_parameters(tuple(known)).with_deviations(known) if known else robot


def _placed(state: PageState) -> Robot | None:
    if state.robot is None:
        return None
    targets = max((len(v.points) for v in state.visits.values()), default=0) or len(state.robot.targets)
    return placed(state.robot, state.estimate, targets)


def _scene(state: PageState) -> dict[str, Any] | None:
    """The 3-D scene: the rows are those of ``_visits``."""
    robot, campaign = _placed(state), state.campaign
    if robot is None:
        return None
    joints = len(robot.joint_names)
    fits = campaign is not None and campaign.joint_names == robot.joint_names
    visits = list(state.visits.values())
    ahead = [a for a, _ in _coming(campaign)] if campaign is not None and fits else []
    middle = tuple(robot.joint_limits.mean(axis=1).tolist())
    q = np.array([v.q if len(v.q) == joints else middle for v in visits] + [a.q for a in ahead]).reshape(
        -1, joints
    )
    estimate = state.estimate
    tests: FloatArray = np.empty((0, joints))
    if estimate is not None and estimate.test_poses and estimate.joint_names == robot.joint_names:
        tests = np.array(estimate.test_poses)
    points = _points(state, visits) if estimate is not None and estimate.deviations else _no_points()
    scene = visits_scene(robot, q, points, q, tests, origin_of_points(robot, *robot.base_pose)).to_dict()
    return scene | {"ahead": list(range(len(visits), len(q)))}


def _points(state: PageState, visits: Sequence[Visit]) -> MeasuredPoints:
    """The points that were seen, with their residuals; those of rejected standstills are left out."""
    rows = []
    for row, visit in enumerate(visits):
        if visit.status not in (Measurement.ACCEPTED, Measurement.REJECTED_OUTLIER):
            continue
        for target, point in enumerate(visit.points):
            vector, used = state.residuals.get((visit.number, target), ((0.0, 0.0, 0.0), True))
            fine = used and visit.status == Measurement.ACCEPTED and target not in visit.unused
            if np.isfinite([point, vector]).all():
                rows.append((row, target + 1, point, vector, USED if fine else REJECTED))
    if not rows:
        return _no_points()
    row_numbers, targets, points, vectors, states = zip(*rows, strict=True)
    after = np.array(vectors, float)
    return MeasuredPoints(
        np.array(row_numbers), np.array(targets), np.array(points, float), after, after, np.array(states)
    )


def _no_points() -> MeasuredPoints:
    none, nowhere = np.empty(0, np.int64), np.empty((0, 3))
    return MeasuredPoints(none, none, nowhere, nowhere, nowhere, none)


def _here(state: PageState) -> list[Any] | None:
    """The robot as it stands now, as the robots of the scene."""
    robot = _placed(state)
    if robot is None or len(state.joints) != len(robot.joint_names):
        return None
    here: list[Any] = plain(bodies(robot, np.array([state.joints]))[0].round(4))
    return here


def _streams(state: PageState) -> list[dict[str, str]]:
    """Each stream: is it there, and does what it shows stand still."""
    return [
        {
            "name": s.name,
            "level": s.level,
            "text": s.text,
            "motion": _motion(s),
        }
        for s in state.streams
    ]


def _motion(stream: Stream) -> str:
    """Whether what a stream shows stands still, as the identifier says on /diagnostics; empty if it does not."""
    try:
        rest = float(stream.values.get("standing still [s]", ""))
    except ValueError:
        return ""
    return f"stands still, {rest:.1f} s" if rest >= LEAST_REST else "moves"


def _verdict(state: PageState) -> dict[str, Any] | None:
    """The campaign's verdict in the end, the newest estimate's before."""
    campaign, estimate = state.campaign, state.estimate
    if campaign is not None and campaign.state == S.DONE and campaign.level:
        level, reasons, title = campaign.level, campaign.reasons, "Verdict of the campaign"
    elif estimate is not None and estimate.level:
        level, reasons, title = estimate.level, estimate.reasons, "Verdict on what is measured so far"
    else:
        return None
    return {"level": level, "title": title, "reasons": [f._asdict() for f in reasons]}


def _buttons(state: PageState) -> dict[str, dict[str, Any]]:
    return {
        name: {"refused": refusal(state, name), "waiting": name in state.waiting}
        for name in BUTTONS
        if name != "skip_configuration"
    }


def _page(state: PageState) -> dict[str, Any]:
    """What stands at the top, and what is wrong with the picture."""
    campaign, robot = state.campaign, state.robot
    names = () if campaign is None else campaign.joint_names
    notice = ""
    if campaign is not None and names and robot is None:
        notice = (
            f"The page does not know {campaign.robot}: set its parameter robot, or publish robot_description."
        )
    elif robot is not None and names and names != robot.joint_names:
        notice = f"The page draws {robot.name}, and the campaign measures {campaign.robot if campaign else ''}."
    name = campaign.robot if campaign is not None and campaign.robot else robot.name if robot is not None else ""
    return {
        "robot": name,
        "campaign": "" if campaign is None else campaign.id,
        "notice": notice,
        "report": state.report,
    }


def _journal(state: PageState) -> list[dict[str, Any]]:
    return [line._asdict() for line in reversed(state.journal)]


SECTIONS: dict[str, tuple[Callable[[PageState], Any], tuple[str, ...]]] = {
    "page": (_page, ("campaign", "robot", "report")),
    "now": (_now, ("campaign", "phase", "there", "names")),
    "buttons": (_buttons, ("campaign", "phase", "visits", "estimate", "there", "names", "waiting")),
    "posture": (_posture, ("campaign", "robot")),
    "numbers": (_numbers, ("campaign", "estimate")),
    "accuracy": (_accuracy, ("campaign", "history")),
    "residuals": (_residuals, ("residuals", "estimate")),
    "visits": (_visits, ("campaign", "robot", "visits", "residuals", "there", "names", "waiting")),
    "scene": (_scene, ("campaign", "robot", "visits", "residuals", "estimate")),
    "here": (_here, ("joints", "robot", "estimate")),
    "streams": (_streams, ("streams",)),
    "verdict": (_verdict, ("campaign", "estimate")),
    "journal": (_journal, ("journal",)),
}
"""Part of the page → how it is made, and the fields of the state that it follows from."""


def changed(before: PageState | None, after: PageState) -> Iterator[tuple[str, Callable[[], Any]]]:
    """(section, what makes its plain values) of what is not as before; all of it without a state before."""
    for name, (make, names) in SECTIONS.items():
        if before is None or any(getattr(before, n) is not getattr(after, n) for n in names):
            yield name, partial(_plain, make, after)


def _plain(make: Callable[[PageState], Any], state: PageState) -> Any:
    return plain(make(state))


def page_text() -> str:
    """The page as HTML, the same for every state."""
    buttons = [{"name": n, **b._asdict()} for n, b in BUTTONS.items() if n not in ("stop", "skip_configuration")]
    return render(TEMPLATES / "live.html", buttons=buttons, embedded=embedded)
