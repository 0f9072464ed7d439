# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""An arm and its controller in virtual time: follows a trajectory well or badly, answers soon, late or never.

The tests of the pure execution step through it; the stand-in of the nodes' tests moves by the same model.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.planning import Trajectory
from calib_planner.ros.execution import (
    Action,
    Answered,
    Cancel,
    Confirmed,
    Event,
    Execution,
    Finished,
    Job,
    Looked,
    PlanWay,
    Send,
    View,
    advance,
    begin,
)

NEVER = float("inf")


@dataclass(frozen=True)
class Manner:
    """How arm and controller behave.

    Attributes:
        answer: Delay of the answer to a goal [s]; ``NEVER``: none.
        delay: Time from the answer to the beginning of the motion [s].
        refuse: Whether the controller refuses goals.
        result: Delay of the result after the end of the motion [s].
        failure: What the result says; empty if all went well.
        rate: Speed of the motion, share of the trajectory's; 0: the arm does not move.
        beyond: How far it goes beyond the end, share of the way.
        off: Where it ends beside the goal [rad | m].
        halts: Whether it stops when its goal is cancelled …
        confirms: … and the controller says so.
        preempted: Time from the beginning of the motion until somebody else's goal replaces ours [s].
    """

    answer: float = 0.02
    delay: float = 0.03
    refuse: bool = False
    result: float = 0.05
    failure: str = ""
    rate: float = 1.0
    beyond: float = 0.0
    off: float = 0.0
    halts: bool = True
    confirms: bool = True
    preempted: float = NEVER


GOOD = Manner()


@dataclass
class Arm:
    """The arm; ``joints(now)`` is where it is.

    Attributes:
        rest: (joints,) where it stands or stood before the motion [rad | m].
        way: What it follows, if anything …
        began: … since when [s] …
        manner: … and how.
    """

    rest: FloatArray
    way: Trajectory | None = None
    began: float = 0.0
    manner: Manner = GOOD

    def joints(self, now: float) -> FloatArray:
        """(joints,) where it is at ``now`` [s] → [rad | m]."""
        way, manner = self.way, self.manner
        if way is None:
            return self.rest
        t = max(now - self.began, 0.0) * manner.rate
        share = min(t / way.seconds, 1.0)
        return np.asarray(way.at([t])[0] + manner.beyond * (way.at([t])[0] - way.start) + manner.off * share)

    def done(self, now: float) -> bool:
        """Whether it has gone to the end of its way."""
        return self.way is not None and (now - self.began) * self.manner.rate >= self.way.seconds

    def follow(self, way: Trajectory, now: float, manner: Manner) -> None:
        """Begin a motion at ``now`` [s]."""
        self.rest, self.way, self.began, self.manner = self.joints(now), way, now, manner

    def halt(self, now: float) -> None:
        """Stand still where it is at ``now`` [s]."""
        self.rest, self.way = self.joints(now), None


@dataclass
class Cell:
    """Arm, controller, tracker and an execution on one clock, advanced by ``step``.

    Attributes:
        job: What is executed.
        view: What was seen before it began.
        manner: How the next goals are treated.
        confirming: Whether somebody confirms at once.
        deaf: Whether joint states are missing.
        sent: Every action, with its time.
        been: Where the arm was (joints,) [rad | m], with the times.
        events: Every event.
        phases: Names of the phases that it went through.
    """

    job: Job
    view: View
    arm: Arm
    manner: Manner = GOOD
    now: float = 100.0
    period: float = 0.02
    confirming: bool = True
    deaf: bool = False
    sent: list[tuple[float, Action]] = field(default_factory=list)
    been: list[tuple[float, FloatArray]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    phases: list[str] = field(default_factory=list)
    execution: Execution = field(init=False)
    _due: list[tuple[float, Event]] = field(default_factory=list)
    _waiting: tuple[int, float, float] | None = None  # number, when it is accepted, when the motion begins

    def __post_init__(self) -> None:
        for _ in range(25):
            self._look()
        self.execution, actions = begin(self.job, self.view, self.now)
        self._act(actions)

    def _look(self) -> None:
        self.now += self.period
        self.been.append((self.now, self.arm.joints(self.now)))
        if not self.deaf:
            self.view = self.view.seen(self.now, self.arm.joints(self.now))

    def feed(self, event: Event) -> None:
        """Let something happen now."""
        self.events.append(event)
        self.execution, actions = advance(self.execution, event, self.view, self.now)
        if not self.phases or self.phases[-1] != self.execution.phase.name:
            self.phases.append(self.execution.phase.name)
        self._act(actions)

    def step(self) -> None:
        """One period."""
        self._look()
        self._controller()
        for event in [e for t, e in self._due if t <= self.now]:
            self.feed(event)
        self._due = [(t, e) for t, e in self._due if t > self.now]
        if self.confirming and self.execution.phase.name == "CONFIRMING":
            self.feed(Confirmed())
        self.feed(Looked())

    def run(self, seconds: float) -> None:
        """Until the execution has ended, ``seconds`` at most."""
        end = self.now + seconds
        while not self.execution.ended and self.now < end:
            self.step()

    def run_to(self, phase: str, visit: int = 0, seconds: float = 100.0) -> None:
        """Until the execution is in that phase of that visit."""
        end = self.now + seconds
        while (self.execution.phase.name, self.execution.visit) != (phase, visit):
            assert self.now < end and not self.execution.ended, self.execution.outcome
            self.step()

    def _controller(self) -> None:
        if self._waiting is None or self.now < self._waiting[2]:
            return
        number = self._waiting[0]
        if self.arm.way is None:
            way = next(a.way for _, a in self.sent if isinstance(a, Send) and a.number == number)
            self.arm.follow(way, self.now, self.manner)
        elif self.now - self.arm.began >= self.manner.preempted:
            self._over(number, "preempted by a new goal")
            self.arm.follow(replace(self.arm.way, positions=self.arm.way.positions * 0.0), self.now, GOOD)
        elif self.arm.done(self.now):
            self._over(number, self.manner.failure)
            self.arm.halt(self.now)

    def _over(self, number: int, failure: str) -> None:
        self._waiting = None
        if self.manner.result < NEVER:
            self._due.append((self.now + self.manner.result, Finished(number, not failure, failure)))

    def _act(self, actions: tuple[Action, ...]) -> None:
        for action in actions:
            self.sent.append((self.now, action))
            manner = self.manner
            if isinstance(action, Send) and manner.answer < NEVER:
                answered = self.now + manner.answer
                self._due.append((answered, Answered(action.number, not manner.refuse)))
                if not manner.refuse:
                    self._waiting = action.number, answered, answered + manner.delay
            elif isinstance(action, Cancel):
                self._cancel(action.number)
            elif isinstance(action, PlanWay):
                self.planned(action)

    def _cancel(self, number: int) -> None:
        if self._waiting is None or self._waiting[0] != number or self.now < self._waiting[1]:
            return  # a goal that is not accepted yet is unknown to the controller
        if not self.manner.halts:
            return
        self.arm.halt(self.now)
        self._waiting = None
        if self.manner.confirms:
            self._due.append((self.now + 0.03, Finished(number, False, "cancelled")))

    def planned(self, action: PlanWay) -> None:
        """Answer a request for a way; a test says how."""
        raise NotImplementedError
