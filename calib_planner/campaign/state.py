# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A campaign as a value: what was planned, what was measured, what failed; events in, the next action out.

Nothing here computes: ``next_action`` and the events take microseconds, so that whoever moves the robot always
knows what to do. What takes seconds is a ``NextStep``, made by ``decide`` from a state anywhere (a worker thread)
and taken in by ``decided`` whenever it is ready; events that came meanwhile are kept.

    Replan ──decide──▶ Measure … Measure ──▶ Replan ──▶ … ──▶ Validate ──▶ Measure … ──▶ Validate ──▶ Finished
             (a batch)                                (outcome)          (validation)            (verdict)

*Visits* wait in a queue in the order of travel. A measurement takes its visit out; a failed attempt leaves it
there until the configuration's attempts are used up; a configuration given up leaves with all its visits and with
those in its neighbourhood, and when the batch is through the rest is planned around it. A measurement that is
withdrawn (as an outlier, or undone) puts its visit back. Pausing changes nothing but the next action.

The measurements are all that cannot be made again: ``from_measurements`` begins where they end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_array, frozen
from calib_planner.campaign.problem import (
    AwayFrom,
    CampaignProblem,
    CampaignResult,
    Exclusion,
    Round,
    distances,
    joint_scale,
    radius_of,
)
from calib_planner.errors import InputError
from calib_planner.measurements import Measurements, configuration_labels
from calib_planner.planning import Constraint

FIT, VALIDATION, FINISHED = "fit", "validation", "finished"
PHASES = (FIT, VALIDATION, FINISHED)
LARGEST = 1e5
"""Coordinates beyond this [m | rad] are no measurement, and their squares would spoil every fit to come."""


@dataclass(frozen=True, eq=False)
class PlannedConfiguration:
    """A configuration q (joints,) [rad | m], to be measured ``times`` times for ``fit`` or ``validation``."""

    q: FloatArray
    role: str
    times: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", frozen(np.asarray(self.q, float)))


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measurement.

    Attributes:
        number: Its own, by which it can be withdrawn.
        index: Number of its configuration.
        q: (joints,) where the robot stood [rad | m].
        points: (targets, 3) [m]; NaN where a target was not seen.
        std: (targets, 3) standard deviation of each coordinate [m]; ``None`` where nobody says it.
    """

    number: int
    index: int
    q: FloatArray
    points: FloatArray
    std: FloatArray | None = None


# ── what to do next ──────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class Measure:
    """Visit configuration ``index``, at q (joints,) [rad | m], for the ``repetition``-th time, from 0."""

    index: int
    q: FloatArray
    role: str
    repetition: int


@dataclass(frozen=True)
class Replan:
    """Identify and plan the next batch: ``decide``."""


@dataclass(frozen=True)
class Validate:
    """Choose configurations to validate with, or compare and judge: ``decide``."""


@dataclass(frozen=True)
class Paused:
    """Wait for ``resume``."""


@dataclass(frozen=True, eq=False)
class Finished:
    """There is a result."""

    result: CampaignResult


Action = Measure | Replan | Validate | Paused | Finished


@dataclass(frozen=True, eq=False)
class CampaignState:
    """Everything about a campaign; made by ``begin`` or ``from_measurements``.

    Attributes:
        problem: Robot, requirement and budget.
        configurations: All that were planned so far; their place is their number.
        queue: Numbers of the configurations still to be visited, in order, one entry a visit.
        measurements: In the order of coming.
        failures: ``(index, reason)`` of every attempt that gave no measurement.
        exclusions: Configurations given up that were never measured.
        dropped: Numbers of configurations that were measured and are not measured again.
        spared: Those of them that a person wanted to skip.
        rounds: What was decided after each batch.
        phase: One of ``PHASES``.
        outcome: Why no more is measured for the fit, a key of ``OUTCOMES``; empty before.
        message: The outcome or what goes on, in words.
        left: Forecast of measurements still needed for the fit; infinite: it cannot be reached.
        paused: Whether nothing is to be sent to the robot.
        result: The end.
    """

    problem: CampaignProblem
    configurations: tuple[PlannedConfiguration, ...] = ()
    queue: tuple[int, ...] = ()
    measurements: tuple[Measurement, ...] = ()
    failures: tuple[tuple[int, str], ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    dropped: tuple[int, ...] = ()
    spared: tuple[int, ...] = ()
    rounds: tuple[Round, ...] = ()
    phase: str = FIT
    outcome: str = ""
    message: str = ""
    left: float = float("nan")
    paused: bool = False
    result: CampaignResult | None = None

    # ── looking ──────────────────────────────────────────────────────────────────────────────────────

    @property
    def action(self) -> Action:
        """What to do next."""
        if self.result is not None:
            return Finished(self.result)
        if self.paused:
            return Paused()
        if self.queue:
            index = self.queue[0]
            done = sum(r.index == index for r in self.measurements)
            return Measure(index, self.configurations[index].q, self.configurations[index].role, done)
        return Replan() if self.phase == FIT else Validate()

    @property
    def ahead(self) -> tuple[int, ...]:
        """Numbers of the configurations to be visited next, one entry a visit, without the visit under way."""
        return self.queue if self.paused else self.queue[1:]

    def measurements_of(self, role: str) -> tuple[Measurement, ...]:
        """Measurements for the fit, or for the validation."""
        return tuple(r for r in self.measurements if self.configurations[r.index].role == role)

    def data(self, role: str = FIT) -> Measurements | None:
        """The same as the library's value, or ``None``; with standard deviations if all have some."""
        rows = self.measurements_of(role)
        return together(self.problem, rows) if rows else None

    def spent(self, role: str | None = None) -> int:
        """Measurements made, those that failed included; skipped and unreachable configurations cost none."""
        made = [r.index for r in self.measurements] + [i for i, _ in self.failures]
        return sum(role is None or self.configurations[i].role == role for i in made)

    @property
    def given_up(self) -> int:
        """Configurations that could not be measured, without those that a person wanted to skip."""
        return sum(not e.requested for e in self.exclusions) + len(set(self.dropped) - set(self.spared))

    @property
    def measured_q(self) -> FloatArray:
        """(N, joints) where something was measured."""
        q = [r.q for r in self.measurements]
        return np.array(q).reshape(len(q), len(self.problem.robot.joint_names))

    @cached_property
    def scale(self) -> FloatArray:
        """(joints,) see ``joint_scale`` [1/rad | 1/m]."""
        return joint_scale(self.problem.robot)

    @property
    def constraints(self) -> tuple[Constraint, ...]:
        """Conditions on the next configurations: the problem's, and to stay away from what was given up."""
        away = (AwayFrom(self.exclusions, self.scale),) if self.exclusions else ()
        return (*self.problem.constraints, *away)

    # ── events ───────────────────────────────────────────────────────────────────────────────────────

    def measured(
        self,
        index: int,
        q: ArrayLike,
        points: ArrayLike,
        number: int | None = None,
        std: ArrayLike | None = None,
    ) -> CampaignState:
        """A configuration was measured; a measurement whose ``number`` is there already is replaced.

        Args:
            q: (joints,) where the robot stood [rad | m].
            points: (targets, 3) [m], NaN where a target was not seen; (3,) will do for one target.
            std: Like ``points``: standard deviation of each coordinate [m]. Unless every point that was seen has
                finite ones > 0, none of them counts.

        Raises:
            InputError: No such configuration, wrong shape, not a robot's numbers, no target seen at all.
        """
        self._check_index(index)
        robot = self.problem.robot
        joints = check_array("q", q, (len(robot.joint_names),), meaning="joints in rad or m")
        array = np.asarray(points, float)
        shaped = array.reshape(1, 3) if array.shape == (3,) else array
        clean = check_array(
            "points", shaped, (len(robot.targets), 3), finite=False, meaning="(targets, xyz) in m"
        )
        for name, values in (("q", joints), ("points", clean)):
            if (np.abs(values) > LARGEST).any():
                got = f"{np.nanmax(np.abs(values)):.3g}"
                raise InputError(name, got, f"at most {LARGEST:g}, in m or rad", "look at who sends it")
        if np.isnan(clean).all():
            raise InputError("points", "NaN only", "at least one target that was seen", "report it as failed")
        if number is None:
            number = max((r.number for r in self.measurements), default=-1) + 1
        row = Measurement(number, index, joints, clean, _stated(std, clean))
        if any(r.number == number for r in self.measurements):
            return replace(self, measurements=tuple(row if r.number == number else r for r in self.measurements))
        return replace(self, measurements=(*self.measurements, row), queue=_without_first(self.queue, index))

    def adopted(
        self, role: str, q: ArrayLike, points: ArrayLike, number: int, std: ArrayLike | None = None
    ) -> CampaignState:
        """A measurement of this campaign that was not heard of when it was made, at a configuration of its own.

        Args:
            role: What it was measured for.
            q, points, number, std: See ``measured``.

        Raises:
            InputError: As ``measured``.
        """
        more = (*self.configurations, PlannedConfiguration(np.asarray(q, float), role))
        return replace(self, configurations=more).measured(len(more) - 1, q, points, number, std)

    def withdrawn(self, number: int, reason: str) -> CampaignState:
        """A measurement no longer counts (an outlier, undone): it is visited again if attempts are left."""
        gone = next((r for r in self.measurements if r.number == number), None)
        if gone is None:
            return self
        state = replace(self, measurements=tuple(r for r in self.measurements if r.number != number))
        if self.configurations[gone.index].role != self.phase or gone.index in self._gone:
            return replace(state, failures=(*self.failures, (gone.index, reason)))
        return replace(state, queue=(*self.queue, gone.index)).failed(gone.index, reason)

    def failed(self, index: int, reason: str) -> CampaignState:
        """A visit gave no measurement; after the last attempt the configuration is given up."""
        self._check_index(index)
        state = replace(self, failures=(*self.failures, (index, reason)))
        tries = sum(i == index for i, _ in state.failures)
        return state._exclude(index, reason, requested=False) if tries >= self.problem.attempts else state

    def unreachable(self, index: int, reason: str) -> CampaignState:
        """The robot cannot get there."""
        self._check_index(index)
        return self._exclude(index, reason, requested=False)

    def skipped(self, index: int, reason: str = "skipped on request", *, replan: bool = False) -> CampaignState:
        """A person does not want the robot there.

        Args:
            index: Number of the configuration.
            reason: Why, in words.
            replan: Whether the visits that are still ahead are planned anew around it; a visit that is under way
                is made all the same.
        """
        self._check_index(index)
        under_way = () if self.paused else self.queue[:1]
        state = self._exclude(index, reason, requested=True)
        return replace(state, queue=tuple(i for i in under_way if i in state.queue)) if replan else state

    def pause(self) -> CampaignState:
        """Send the robot nowhere from now on."""
        return replace(self, paused=True)

    def resume(self) -> CampaignState:
        """Go on."""
        return replace(self, paused=False)

    def decided(self, step: NextStep) -> CampaignState:
        """Take in what ``decide`` returned."""
        planned = [replace(s, role=FIT) for s in self.configurations] if step.joins else list(self.configurations)
        return replace(
            self,
            configurations=(*planned, *step.configurations),
            queue=(*self.queue, *(i for i in step.queue if i not in self._gone)),
            rounds=self.rounds if step.round is None else (*self.rounds, step.round),
            phase=step.phase,
            outcome="" if step.joins else step.outcome or self.outcome,
            message=step.message,
            left=step.left,
            result=step.result,
        )

    def _exclude(self, index: int, reason: str, *, requested: bool) -> CampaignState:
        state = replace(self, queue=tuple(i for i in self.queue if i != index))
        if any(r.index == index for r in self.measurements):
            spared = (*self.spared, index) if requested else self.spared
            return replace(state, dropped=(*self.dropped, index), spared=spared)
        q, scale = self.configurations[index].q, self.scale
        radius = radius_of(q, self.exclusions, self.measured_q, scale, self.problem.exclusion)
        state = replace(state, exclusions=(*self.exclusions, Exclusion(index, q, radius, reason, requested)))
        if state.given_up > self.problem.most_failures:
            return replace(state, queue=())
        near = [i for i in state.queue if distances(self.configurations[i].q[None], q, scale)[0] < radius]
        return replace(state, queue=tuple(i for i in state.queue if i not in near))

    @property
    def _gone(self) -> set[int]:
        """Numbers of configurations that are not visited any more."""
        return {e.index for e in self.exclusions} | set(self.dropped)

    def _check_index(self, index: int) -> None:
        if not 0 <= index < len(self.configurations):
            raise InputError("index", index, f"a configuration, 0 to {len(self.configurations) - 1}")


def together(problem: CampaignProblem, rows: Sequence[Measurement]) -> Measurements:
    """One or more measurements as the library's value; with standard deviations if all have some."""
    q, points = np.array([r.q for r in rows]), np.array([r.points for r in rows])
    stated = [r.std for r in rows if r.std is not None]
    std = np.array(stated) if len(stated) == len(rows) else None
    return Measurements(problem.robot.joint_names, q, points, std)


@dataclass(frozen=True, eq=False)
class NextStep:
    """What ``CampaignState.decided`` takes in.

    Attributes:
        phase: Of the campaign from now on.
        message: What was decided, in words.
        configurations: New ones, numbered on from the state's.
        queue: Numbers of the configurations to visit, in order.
        outcome: Why the fit ends, if it does.
        round: What is known now.
        joins: Whether the validation's measurements join the fit.
        left: Forecast of measurements still needed for the fit.
        result: The end.
    """

    phase: str
    message: str
    configurations: tuple[PlannedConfiguration, ...] = ()
    queue: tuple[int, ...] = ()
    outcome: str = ""
    round: Round | None = None
    joins: bool = False
    left: float = 0.0
    result: CampaignResult | None = None


def begin(problem: CampaignProblem) -> CampaignState:
    """Before the first plan."""
    return CampaignState(problem)


def from_measurements(
    problem: CampaignProblem,
    fit: Measurements | None,
    validation: Measurements | None = None,
    exclusions: tuple[Exclusion, ...] = (),
) -> CampaignState:
    """A campaign that goes on from measurements made before, such as those that a store kept over a crash.

    What was planned and not measured is planned anew. Rows with equal joint values are repetitions.

    Raises:
        InputError: Other joints or targets than the robot's.
    """
    state = CampaignState(problem)
    for role, data in ((FIT, fit), (VALIDATION, validation)):
        if data is None or not len(data):
            continue
        ordered = data.in_order_of(problem.robot.joint_names)
        labels = configuration_labels(ordered.q)
        first = len(state.configurations)
        planned = [
            PlannedConfiguration(ordered.q[labels == k][0], role, int((labels == k).sum()))
            for k in range(labels.max() + 1)
        ]
        state = replace(state, configurations=(*state.configurations, *planned))
        stated = [None] * len(ordered) if ordered.std is None else list(np.asarray(ordered.std))
        for q, points, std, label in zip(ordered.q, ordered.p, stated, labels, strict=True):
            if not np.isnan(points).all():
                state = state.measured(first + int(label), q, points, std=std)
    return replace(state, exclusions=exclusions)


def _without_first(queue: tuple[int, ...], index: int) -> tuple[int, ...]:
    if index not in queue:
        return queue
    at = queue.index(index)
    return queue[:at] + queue[at + 1 :]


def _stated(std: ArrayLike | None, points: FloatArray) -> FloatArray | None:
    """``std`` as (targets, 3) [m], NaN where ``points`` are; ``None`` where it does not say all."""
    if std is None:
        return None
    values = np.asarray(std, float).reshape(points.shape)
    seen = ~np.isnan(points)
    if not (np.isfinite(values[seen]) & (values[seen] > 0.0)).all():
        return None
    return frozen(np.where(seen, values, np.nan))
