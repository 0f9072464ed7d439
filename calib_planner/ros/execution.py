# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Executing a plan with a real robot, as a value: events go in, actions come out. No ROS, and nothing waits here.

    READYING ──▶ MOVING ──▶ MEASURING ──▶ LEAVING ──▶ READYING … ──▶ ENDED
     │    ▲                                                            ▲
     ▼    │            (halted, beam lost, silence, error …)           │
    PLANNING, CONFIRMING        any of them ──▶ STOPPING ──────────────┘

*READYING* is before every move: joint states are fresh, the robot stands still, the controller is there, the
tracker holds its targets. Where a planner of ways is used, the way is planned then (*PLANNING*); step by step, a
person confirms it (*CONFIRMING*). *MOVING* sends one trajectory and follows it until the joint states say that
the robot stands still at its end: the controller's word alone does not count. *MEASURING* is the standstill,
*LEAVING* waits until the controller, too, says that its move has ended. Whatever ends an execution early cancels
the controller's goal first (*STOPPING*) and ends when the robot is seen to stand, or says loudly that it is not.

*Following.* The controller takes the trajectory some time after it was sent, at the latest ``start_delay`` after
it was accepted. So at the time t of a joint state, every joint has to be where the trajectory has it at some time
between t − accepted − ``start_delay`` and t − sent, give or take ``tracking_tolerance``.

*Standing still.* The joints have stayed within ``still_tolerance`` of one position for ``still_time``.

All times are seconds of one clock, the node's; stamps of joint states are compared with it. Every phase has a
longest time, so that every execution ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from calib_planner.arrays import FloatArray, check_ranges, ranged
from calib_planner.errors import InputError
from calib_planner.planning import Pace, Plan, Trajectory, joined, smooth_trajectory, timetable
from calib_planner.robot import Robot
from calib_planner.units import counted, cut

BEAM_ADVICE = "bring the beam back, then send the rest of the plan"
REFUSED = "the controller refused the move"
CANCEL_AGAIN = 1.0
"""After so long without an end a goal is cancelled once more, since a request can get lost [s]."""
SET_BACK = 1.0
"""A clock that goes back by more than this was set, or a simulation began again [s]."""


@dataclass(frozen=True)
class Watch:
    """What an execution tolerates, with units and ranges."""

    tracking_tolerance: float = ranged(
        0.02,
        "largest distance of a joint from where the trajectory has it; beyond it the robot is stopped",
        "rad or m",
        1e-4,
        1.0,
    )
    start_delay: float = ranged(
        0.5, "the controller begins a trajectory so long after accepting it, at most", "s", 0.0, 60.0
    )
    arrival_tolerance: float = ranged(
        0.005,
        "largest distance of a joint from the configuration at which the robot has arrived",
        "rad or m",
        1e-5,
        0.05,
    )
    still_tolerance: float = ranged(
        1e-3, "a robot whose joints stay within this for still_time stands still", "rad or m", 1e-6, 0.05
    )
    still_time: float = ranged(0.3, "how long they have to", "s", 0.01, 60.0)
    patience: float = ranged(
        5.0,
        "longest wait for an answer of the controller, for an arrival, and for a robot to stop",
        "s",
        0.1,
        600.0,
    )
    silence: float = ranged(
        0.5, "largest difference between the time and the newest stamp on joint_states", "s", 0.01, 60.0
    )
    beam_patience: float = ranged(0.5, "a beam that is lost for longer stops the robot", "s", 0.0, 600.0)
    beam_silence: float = ranged(
        2.0,
        "a tracker that was heard and says nothing for so long has lost the beam; 0 = it speaks at changes only",
        "s",
        0.0,
        600.0,
    )
    confirm_patience: float = ranged(600.0, "longest wait for ~/confirm", "s", 1.0, 86400.0)

    def __post_init__(self) -> None:
        check_ranges(self, Watch)
        if self.tracking_tolerance < self.arrival_tolerance:
            expected = f"at least arrival_tolerance = {self.arrival_tolerance:g}"
            raise InputError("tracking_tolerance", self.tracking_tolerance, expected)


# ── what is seen of robot and tracker ────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Beam:
    """What is known of one target's beam.

    Attributes:
        topic: Where it is said.
        locked: Whether the tracker holds the target; ``None``: it never said.
        heard: When it was said last [s].
        changed: Since when it has been so [s].
    """

    topic: str
    locked: bool | None = None
    heard: float = 0.0
    changed: float = 0.0

    def said(self, locked: bool, now: float) -> Beam:
        """The tracker says so at ``now`` [s]."""
        return Beam(self.topic, locked, now, self.changed if locked == self.locked else now)

    def trouble(self, watch: Watch, now: float) -> str:
        """Why the beam counts as lost; empty if it does not."""
        if self.locked is None:
            return ""
        if 0 < watch.beam_silence < now - self.heard:
            words = "set beam_silence to 0 if it speaks at changes only"
            return f"{self.topic}: the tracker has said nothing for {now - self.heard:.1f} s ({words})"
        lost = not self.locked and now - self.changed >= watch.beam_patience
        return f"{self.topic}: the tracker has lost the reflector" if lost else ""


@dataclass(frozen=True, eq=False)
class Joined:
    """Joint states that name some of the joints each, put together.

    Attributes:
        joints: (joints,) the newest positions [rad | m]; NaN before the first.
        stamps: (joints,) and when they were read [s], those that came since the last whole state; NaN elsewhere.
    """

    joints: FloatArray
    stamps: FloatArray

    @staticmethod
    def of(count: int) -> Joined:
        """Before the first state of so many joints."""
        return Joined(np.full(count, np.nan), np.full(count, np.nan))

    def part(
        self, stamp: float, columns: Sequence[int] | None, joints: FloatArray
    ) -> tuple[Joined, float | None]:
        """Take a state of the joints ``columns``, ``None``: all.

        Also gives the oldest stamp [s] of a state that is whole now, ``None`` if it is not.
        """
        q, stamps = self.joints.copy(), self.stamps.copy()
        rows = slice(None) if columns is None else list(columns)
        q[rows], stamps[rows] = joints, stamp
        whole = not np.isnan(stamps).any()
        return Joined(q, np.full(len(q), np.nan) if whole else stamps), float(stamps.min()) if whole else None


@dataclass(frozen=True, eq=False)
class View:
    """What is seen of robot and tracker.

    Attributes:
        watch: What is tolerated.
        beams: Of the targets.
        missing: What is not there, one text each with what to do.
        stamp: Of the newest joint state [s]; ``None`` before the first.
        joints: (joints,) the newest positions [rad | m].
        rest: Since when the robot has been at rest [s] …
        rest_joints: … and where (joints,) [rad | m].
    """

    watch: Watch
    beams: tuple[Beam, ...] = ()
    missing: tuple[str, ...] = ()
    stamp: float | None = None
    joints: FloatArray = field(default_factory=lambda: np.empty(0))
    rest: float = 0.0
    rest_joints: FloatArray = field(default_factory=lambda: np.empty(0))

    def seen(self, stamp: float, joints: FloatArray) -> View:
        """A joint state; one that is older than the newest changes nothing, unless the clock was set back."""
        if not np.isfinite(joints).all() or (
            self.stamp is not None and self.stamp - SET_BACK <= stamp <= self.stamp
        ):
            return self
        goes_on = (
            self.stamp is not None
            and 0 < stamp - self.stamp <= self.watch.silence
            and np.abs(joints - self.rest_joints).max() <= self.watch.still_tolerance
        )
        rest = {} if goes_on else {"rest": stamp, "rest_joints": joints}
        return replace(self, stamp=stamp, joints=joints, **rest)  # type: ignore[arg-type]

    def beam(self, index: int, locked: bool, now: float) -> View:
        """The tracker says whether it holds target ``index``."""
        beams = list(self.beams)
        beams[index] = beams[index].said(locked, now)
        return replace(self, beams=tuple(beams))

    @property
    def stands(self) -> bool:
        """Whether the robot stands still, as far as it was seen."""
        return self.stamp is not None and self.stamp - self.rest >= self.watch.still_time

    def silence(self, now: float) -> str:
        """Why it is not known where the robot is at ``now`` [s]; empty if it is."""
        if self.stamp is None:
            return "nothing usable was heard on joint_states: start the robot's driver"
        age = now - self.stamp
        if age > self.watch.silence:
            return f"the newest joint state is {age:.2f} s old, {self.watch.silence:g} s are allowed"
        if age < -self.watch.silence:
            return f"joint_states are stamped {-age:.2f} s ahead of this node's clock: synchronise the clocks"
        return ""

    def dark(self, now: float) -> str:
        """Why a beam counts as lost; empty if none does."""
        return next(filter(None, (b.trouble(self.watch, now) for b in self.beams)), "")


# ── what is to be done ───────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class Visit:
    """A standstill: configuration ``index`` of the plan, over ``waypoints`` (k, joints), the last one is where it
    is [rad | m]."""

    index: int
    waypoints: FloatArray


@dataclass(frozen=True, eq=False)
class Job:
    """A plan to be executed.

    Attributes:
        joint_names: The robot's joints …
        units: … and their units, rad or m.
        visits: The standstills in their order.
        total: Configurations of the plan.
        seconds: How long it will take, without waiting for people [s].
        pace: How fast the robot moves.
        standstill: Length of a standstill [s].
        step: Whether a person confirms every move.
        planning_time: Longest time for the planning of a way [s]; 0: ways are straight lines of the joints.
    """

    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    visits: tuple[Visit, ...]
    total: int
    seconds: float
    pace: Pace
    standstill: float
    step: bool = False
    planning_time: float = 0.0


def job_of(
    plan: Plan,
    robot: Robot,
    pace: Pace,
    start: FloatArray,
    *,
    dwell: float = 0.0,
    step: bool = False,
    planning_time: float = 0.0,
) -> Job:
    """The visits of a plan, in its order; before a further visit to the same place the robot backs off.

    Args:
        plan: A plan of this robot, see ``check_executable``.
        robot: The robot.
        pace: Speeds and standstill.
        start: (joints,) where the robot stands [rad | m].
        dwell: Length of a standstill [s]; 0: that of the pace.
        step: Whether a person confirms every move.
        planning_time: See ``Job``.

    Raises:
        InputError: The plan would take longer than a ROS duration can say.
    """
    if dwell > 0:
        pace = replace(pace, dwell=dwell, settle=0.0)
    table = timetable(plan, robot, pace, start)
    visits = []
    for place, turn in zip(table.places, table.ways_back, strict=True):
        here = plan.configurations[place]
        visits.append(Visit(int(place), np.stack([table.aside[place], here] if np.isfinite(turn) else [here])))
    return Job(
        joint_names=robot.joint_names,
        units=tuple("rad" if turns else "m" for turns in robot.joint_is_revolute),
        visits=tuple(visits),
        total=len(plan.configurations),
        seconds=table.seconds,
        pace=pace,
        standstill=pace.standstill,
        step=step,
        planning_time=planning_time,
    )


# ── events ───────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Looked:
    """Time has passed, or something was seen."""


@dataclass(frozen=True)
class Answered:
    """The controller accepted or refused goal ``number``."""

    number: int
    accepted: bool


@dataclass(frozen=True)
class Finished:
    """The controller's goal ``number`` is over; ``reason`` says how if not successfully."""

    number: int
    succeeded: bool
    reason: str = ""


@dataclass(frozen=True, eq=False)
class WayPlanned:
    """The answer to ``PlanWay`` number ``number``: a way, or why there is none."""

    number: int
    way: Trajectory | None
    reason: str = ""


@dataclass(frozen=True)
class Confirmed:
    """A person confirms the next move."""


@dataclass(frozen=True)
class Halted:
    """Somebody wants the execution to end: ``STOPPED`` or ``CANCELLED``."""

    status: str
    message: str


Event = Looked | Answered | Finished | WayPlanned | Confirmed | Halted


# ── actions ──────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class Send:
    """Send the controller a goal."""

    number: int
    way: Trajectory


@dataclass(frozen=True)
class Cancel:
    """Cancel the controller's goal ``number``, whether or not it has been accepted."""

    number: int


@dataclass(frozen=True, eq=False)
class PlanWay:
    """Have the way from ``start`` to ``goal`` planned, both (joints,) [rad | m]."""

    number: int
    start: FloatArray
    goal: FloatArray


Action = Send | Cancel | PlanWay
Actions = tuple[Action, ...]


# ── the state ────────────────────────────────────────────────────────────────────────────────────────


class Phase(Enum):
    """What an execution does; see the top of this file."""

    READYING = "getting ready"
    PLANNING = "the way is being planned"
    CONFIRMING = "waiting for ~/confirm"
    MOVING = "moving"
    MEASURING = "standing still"
    LEAVING = "waiting for the controller to report the end of its move"
    STOPPING = "stopping"
    ENDED = "ended"


@dataclass(frozen=True)
class Outcome:
    """How an execution ended.

    Attributes:
        status: Name of a status constant of ``ExecutePlan``'s result.
        message: For a person.
        alarm: Whether the robot was not seen to stand.
        advice: What to do, at the end of the message once it has ended.
    """

    status: str
    message: str
    alarm: bool = False
    advice: str = ""

    def with_words(self, words: str, alarm: bool = False) -> Outcome:
        """The same with more words before the advice."""
        return Outcome(self.status, "; ".join(filter(None, (self.message, words, self.advice))), alarm)


@dataclass(frozen=True, eq=False)
class Goal:
    """A trajectory at the controller.

    Attributes:
        number: Its own.
        way: The trajectory.
        sent: When it was sent [s].
        accepted: When it was accepted [s]; ``None`` as long as it was not.
        over: When it was over [s]; ``None`` as long as it is not known to be.
        failure: How it ended if not successfully.
        arrived: Whether the robot stood at its end once.
        cancelled: When it was cancelled last [s]; ``None`` if it was not.
    """

    number: int
    way: Trajectory
    sent: float
    accepted: float | None = None
    over: float | None = None
    failure: str = ""
    arrived: bool = False
    cancelled: float | None = None


@dataclass(frozen=True, eq=False)
class Execution:
    """An execution under way; made by ``begin``, changed by ``advance``.

    Attributes:
        job: What is to be done.
        view: What is seen.
        began, now: When it began, and the time of the last event [s].
        phase: What it does …
        since: … since when [s].
        visit: Number of the visit under way.
        executed: Standstills completed.
        number: Of the last request to controller or planner.
        goal: The controller's goal, the last one.
        parts: Planned parts of the way to the visit.
        confirmed: Whether a person has confirmed the move.
        moved: Whether the controller ever accepted a goal.
        ending: Why it ends early, once it does.
        outcome: How it ended, once it has.
    """

    job: Job
    view: View
    began: float
    now: float
    phase: Phase
    since: float
    number: int
    visit: int = 0
    executed: int = 0
    goal: Goal | None = None
    parts: tuple[Trajectory, ...] = ()
    confirmed: bool = False
    moved: bool = False
    ending: Outcome | None = None
    outcome: Outcome | None = None

    @property
    def ended(self) -> bool:
        """Whether it has ended."""
        return self.outcome is not None

    @property
    def index(self) -> int:
        """Row of the configuration under way, or of the last one."""
        return self.job.visits[min(self.visit, len(self.job.visits) - 1)].index

    @property
    def elapsed(self) -> float:
        """Time since it began [s]."""
        return max(self.now - self.began, 0.0)

    def refused_confirmation(self) -> str:
        """Why ``Confirmed`` would change nothing now; empty if it would."""
        if self.phase is not Phase.CONFIRMING:
            return f"nothing waits for a confirmation ({self.phase.value})"
        return self.view.dark(self.now)


def begin(job: Job, view: View, now: float, number: int = 0) -> tuple[Execution, Actions]:
    """Begin at ``now`` [s]; requests are numbered from ``number`` + 1 on."""
    state = Execution(job, view, now, now, Phase.READYING, now, number)
    return _settled(state, ())


def advance(state: Execution, event: Event, view: View, now: float) -> tuple[Execution, Actions]:
    """What follows from an event at ``now`` [s], seen as ``view`` says."""
    if state.ended:
        # A controller that accepts late must not move a robot that nobody watches any more.
        late = isinstance(event, Answered) and event.accepted
        return state, (Cancel(event.number),) if late else ()  # type: ignore[union-attr]
    back = now < state.now - SET_BACK
    state = replace(state, view=view, now=now if back else max(now, state.now))
    if back:
        state = replace(state, since=now, began=now)
        state, actions = _end(state, "ABORTED", "the clock was set back: start again")
        return _settled(state, actions)
    state, actions = _taken(state, event)
    return _settled(state, actions)


def _settled(state: Execution, actions: Actions) -> tuple[Execution, Actions]:
    """Go on as long as something follows."""
    while not state.ended:
        then, more = NEXT[state.phase](state)
        actions += more
        if then is state:
            break
        state = then
    return state, actions


def _taken(state: Execution, event: Event) -> tuple[Execution, Actions]:
    """Note what an event says."""
    goal = state.goal
    if isinstance(event, Halted):
        return _end(state, event.status, event.message)
    if isinstance(event, Confirmed):
        return (state if state.refused_confirmation() else _to(state, Phase.READYING, confirmed=True)), ()
    if isinstance(event, WayPlanned):
        return _way_planned(state, event)
    if isinstance(event, Answered):
        if goal is None or event.number != goal.number or goal.over is not None or goal.accepted is not None:
            ours = goal is not None and event.number == goal.number and goal.accepted is not None
            return state, (Cancel(event.number),) if event.accepted and not ours else ()
        if event.accepted:
            state = replace(state, goal=replace(goal, accepted=state.now), moved=True)
            return state, (Cancel(goal.number),) if state.ending else ()
        return replace(state, goal=replace(goal, over=state.now, failure=REFUSED)), ()
    if isinstance(event, Finished) and goal is not None and event.number == goal.number and goal.over is None:
        failure = "" if event.succeeded else cut(event.reason, 300) or "it did not say why"
        return replace(state, goal=replace(goal, over=state.now, failure=failure), moved=True), ()
    return state, ()


def _to(state: Execution, phase: Phase, **changes: object) -> Execution:
    return replace(state, phase=phase, since=state.now, **changes)  # type: ignore[arg-type]


def _end(
    state: Execution, status: str, message: str, advice: str = "", *, place: bool = False
) -> tuple[Execution, Actions]:
    """End early, for the first reason there is; ``place``: the message is about the configuration under way."""
    if state.ending is not None:
        return state, ()
    words = f"configuration {state.index}: {message}" if place else message
    goal = state.goal
    under_way = goal is not None and goal.over is None
    ending = Outcome(status, words, advice=advice)
    state = _to(state, Phase.STOPPING, ending=ending)
    if goal is None:
        return _to(state, Phase.ENDED, outcome=ending.with_words("")), ()
    return _cancelled(state, goal) if under_way else (state, ())


def _cancelled(state: Execution, goal: Goal) -> tuple[Execution, Actions]:
    return replace(state, goal=replace(goal, cancelled=state.now)), (Cancel(goal.number),)


# ── what follows in each phase ───────────────────────────────────────────────────────────────────────


def _readying(state: Execution) -> tuple[Execution, Actions]:
    """Before a move: wait until all is well, have the way planned and confirmed, send it."""
    if state.visit == len(state.job.visits):
        return _to(state, Phase.ENDED, outcome=Outcome("SUCCESS", "every configuration was visited")), ()
    view, now = state.view, state.now
    dark = view.dark(now)
    if dark and state.moved:
        return _end(state, "BEAM_LOST", dark, BEAM_ADVICE)
    trouble = view.silence(now) or next(iter(view.missing), "")
    if not trouble and not view.stands:
        trouble = "the robot moves though nothing was sent: somebody else commands it"
    trouble = trouble or (dark and f"{dark}: bring the beam back")
    if trouble:
        if now - state.since <= view.watch.patience:
            return state, ()
        return _end(state, "ABORTED" if state.moved else "NOT_READY", trouble, place=state.moved)
    if state.job.planning_time > 0 and len(state.parts) < len(_waypoints(state)):
        return _plan_way(state)
    if state.job.step and not state.confirmed:
        return _to(state, Phase.CONFIRMING), ()
    return _send(state)


def _waypoints(state: Execution) -> FloatArray:
    return state.job.visits[state.visit].waypoints


def _plan_way(state: Execution) -> tuple[Execution, Actions]:
    start = state.parts[-1].goal if state.parts else state.view.joints
    number, goal = state.number + 1, _waypoints(state)[len(state.parts)]
    return _to(state, Phase.PLANNING, number=number), (PlanWay(number, start, goal),)


def _way_planned(state: Execution, event: WayPlanned) -> tuple[Execution, Actions]:
    """Take a planned part of the way, if it leads where it should."""
    if state.phase is not Phase.PLANNING or event.number != state.number:
        return state, ()
    goal, near = _waypoints(state)[len(state.parts)], state.view.watch.arrival_tolerance
    start = state.parts[-1].goal if state.parts else state.view.joints
    if event.way is None:
        return _end(state, "ABORTED", f"no way there was planned: {cut(event.reason, 300)}", place=True)
    for name, wanted, got in (("begin", start, event.way.start), ("end", goal, event.way.goal)):
        if len(got) != len(wanted) or np.abs(got - wanted).max() > near:
            words = f"the planned way does not {name} where it should"
            if len(got) == len(wanted):
                words += f": {_off(state, got, wanted - near, wanted + near)[1]}"
            return _end(state, "ABORTED", words, place=True)
    part = event.way.slowed(state.job.pace)
    return _to(state, Phase.READYING, parts=(*state.parts, part)), ()


def _send(state: Execution) -> tuple[Execution, Actions]:
    if state.parts:
        way, near = joined(state.parts), state.view.watch.arrival_tolerance
        excess, words = _off(state, state.view.joints, way.start - near, way.start + near)
        if excess > 0:
            words = f"the robot has left the place where the planned way begins: {words}"
            return _end(state, "ABORTED", words, place=True)
    else:
        way = smooth_trajectory(np.vstack([state.view.joints, _waypoints(state)]), state.job.pace)
    number = state.number + 1
    goal = Goal(number, way, state.now)
    return _to(state, Phase.MOVING, number=number, goal=goal), (Send(number, way),)


def _planning(state: Execution) -> tuple[Execution, Actions]:
    if state.now - state.since <= state.job.planning_time + state.view.watch.patience:
        return state, ()
    return _end(state, "ABORTED", "the planner of ways does not answer", place=True)


def _confirming(state: Execution) -> tuple[Execution, Actions]:
    waited = state.view.watch.confirm_patience
    if state.now - state.since <= waited:
        return state, ()
    return _end(state, "STOPPED", f"nobody called ~/confirm for {waited:g} s", "send the rest of the plan")


def _moving(state: Execution) -> tuple[Execution, Actions]:
    goal, watch = state.goal, state.view.watch
    assert goal is not None
    troubled = _trouble(state)
    if troubled is not None:
        return troubled
    if goal.accepted is None and state.now - goal.sent > watch.patience:
        return _end(state, "ABORTED", "the controller does not answer: is it active?", place=True)
    strays = _strays(state)
    if strays:
        advice = "find out why the robot does not follow (speed override, load), then lower speed_share"
        return _end(state, "ABORTED", strays, advice, place=True)
    if _there(state):
        return _to(state, Phase.MEASURING, goal=replace(goal, arrived=True)), ()
    return _late(state)


def _trouble(state: Execution) -> tuple[Execution, Actions] | None:
    """What ends a move and a standstill alike; ``None`` if nothing does."""
    goal, view = state.goal, state.view
    assert goal is not None
    silence, dark = view.silence(state.now), view.dark(state.now)
    if silence:
        return _end(state, "ABORTED", silence, place=True)
    if dark:
        return _end(state, "BEAM_LOST", dark, BEAM_ADVICE)
    if goal.failure:
        if goal.accepted is None:
            status = "ABORTED" if state.moved else "NOT_READY"
            return _end(state, status, f"{goal.failure}: is it active, and for these joints?", place=True)
        return _end(state, "ABORTED", f"the controller gave the move up: {goal.failure}", place=True)
    return None


def _strays(state: Execution) -> str:
    """Which joint is not where the trajectory has it: where it is, and where it may be; empty if none."""
    goal, view = state.goal, state.view
    assert goal is not None and view.stamp is not None
    if view.stamp < goal.sent:
        return ""
    latest = view.stamp if goal.accepted is None else goal.accepted + view.watch.start_delay
    low, high = goal.way.between(max(view.stamp - latest, 0.0), view.stamp - goal.sent)
    near = view.watch.tracking_tolerance
    excess, words = _off(state, view.joints, low - near, high + near)
    return words if excess > 0 else ""


def _there(state: Execution) -> bool:
    """Whether the robot stands still at the end of its way, and had the time to go there."""
    goal, view = state.goal, state.view
    assert goal is not None and view.stamp is not None
    had_time = view.stamp - goal.sent >= goal.way.seconds
    near = np.abs(view.joints - goal.way.goal).max() <= view.watch.arrival_tolerance
    return bool(had_time and near and view.stands)


def _late(state: Execution) -> tuple[Execution, Actions]:
    """End where the robot should long have stood at the end of its way."""
    goal, watch, view = state.goal, state.view.watch, state.view
    assert goal is not None
    latest = (goal.sent if goal.accepted is None else goal.accepted) + watch.start_delay + goal.way.seconds
    latest += watch.patience + goal.arrived * (state.job.standstill + watch.silence)
    if state.now <= latest:
        return state, ()
    near, end = watch.arrival_tolerance, goal.way.goal
    excess, words = _off(state, view.joints, end - near, end + near)
    text = f"the robot does not arrive: {words}" if excess > 0 else "the robot does not come to rest"
    return _end(state, "ABORTED", text, place=True)


def _off(state: Execution, joints: FloatArray, low: FloatArray, high: FloatArray) -> tuple[float, str]:
    """How far (joints,) is beyond ``low`` and ``high`` [rad | m], at most, and which joint that is, in words."""
    excess = np.maximum(low - joints, joints - high)
    k = int(np.argmax(excess))
    name, unit = state.job.joint_names[k], state.job.units[k]
    return float(
        excess[k]
    ), f"{name} is at {joints[k]:.4f} {unit}, {low[k]:.4f} to {high[k]:.4f} {unit} are allowed"


def _measuring(state: Execution) -> tuple[Execution, Actions]:
    goal, view = state.goal, state.view
    assert goal is not None and view.stamp is not None
    troubled = _trouble(state)
    if troubled is not None:
        return troubled
    if not _there(state):
        return _to(state, Phase.MOVING), ()
    if view.stamp - max(view.rest, goal.sent + goal.way.seconds) >= state.job.standstill:
        return _to(state, Phase.LEAVING, executed=state.executed + 1), ()
    return _late(state)


def _leaving(state: Execution) -> tuple[Execution, Actions]:
    goal = state.goal
    assert goal is not None
    if goal.failure:
        text = f"the standstill was long enough, but the controller gave the move up: {goal.failure}"
        return _end(state, "ABORTED", text, place=True)
    if goal.over is not None:
        then = state.visit + 1
        return _to(state, Phase.READYING, visit=then, parts=(), confirmed=False), ()
    if state.now - state.since <= state.view.watch.patience:
        return state, ()
    text = "the robot stands there, but the controller does not report the end of its move"
    return _end(state, "ABORTED", text, place=True)


def _stopping(state: Execution) -> tuple[Execution, Actions]:
    """End once the robot is seen to stand and the controller is done, or when that takes too long."""
    goal, view, ending = state.goal, state.view, state.ending
    assert goal is not None and ending is not None
    seen = view.stamp is not None and view.stamp >= max(state.since, goal.over or 0.0)
    stands = seen and view.stands and not view.silence(state.now)
    if stands and goal.over is not None:
        done = f"the robot stands, after {counted(state.executed, 'standstill')}"
        return _to(state, Phase.ENDED, outcome=ending.with_words(done)), ()
    if state.now - state.since <= view.watch.patience:
        again = goal.over is None and goal.cancelled is not None and state.now - goal.cancelled > CANCEL_AGAIN
        return _cancelled(state, goal) if again else (state, ())
    if view.silence(state.now) or not seen:
        words = "WHETHER THE ROBOT STANDS IS NOT KNOWN, since joint_states are missing: look at it"
    elif not stands:
        words = "THE ROBOT STILL MOVES although its goal was cancelled: stop it by hand"
    else:
        words = "the robot stands, but the controller does not say that its move is over: look at it"
    return _to(state, Phase.ENDED, outcome=ending.with_words(words, alarm=True)), ()


NEXT: dict[Phase, Callable[[Execution], tuple[Execution, Actions]]] = {
    Phase.READYING: _readying,
    Phase.PLANNING: _planning,
    Phase.CONFIRMING: _confirming,
    Phase.MOVING: _moving,
    Phase.MEASURING: _measuring,
    Phase.LEAVING: _leaving,
    Phase.STOPPING: _stopping,
}
"""Phase → what follows in it: the state and actions, or the same state if nothing does."""
