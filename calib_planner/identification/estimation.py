# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification with one error model: from measurements to parameters, coefficients and scales.

    1. start      Base and targets, where they are unknown, in closed form (``registration``), then generalised
                  least squares at typical scales and wide tolerances until the predictions stand still.
    2. scales     Linearise at the current values, (M1); the scales maximise the restricted likelihood times their
                  priors (``likelihood``); generalised least squares gives parameters and coefficients. Repeat.
    3. doubt      Where points or a run of visits are impossible beside the others, these lose their weight
                  (``doubt``).
    4. terms      A term with which the left-out score is surely worse goes (``left_out``).
    5. all        Many points: 1 to 4 are done with some of the visits; all of them then better the scales, and
                  generalised least squares is done with all.

The paper's model has no scales and no terms to choose: what is left are its steps (6) and (7), and (11).

An estimate of most of the same measurements is a *start* (``fit_error_model``): its scales and terms are kept,
and the few visits that came or went are brought in by (4), doubts included. The full fit is made all the same
where that would not be good enough (``update_error_model``). What a full fit says depends on the data alone.

All visits of an update are linearised at the same β, that of the last relinearisation. Where base and first joint
can hardly be told apart, the columns say so only if they are taken at one place: columns from two places disagree
on which combination nothing tells, and would tell it, which is not true (of the first-estimates Jacobian of
Huang, Mourikis & Roumeliotis 2010). Estimates then wander along what nobody sees, visit by visit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calib_planner.arrays import FloatArray, IntArray, remembered
from calib_planner.error_model import ErrorModel, Knowledge, Payload, Poses
from calib_planner.errors import NotEnoughDataError
from calib_planner.identification.doubt import (
    LARGEST,
    OUT,
    impossible,
    many_are_wrong,
    part_of,
    shifted_run,
    student,
)
from calib_planner.identification.left_out import LeftOut, left_out
from calib_planner.identification.likelihood import (
    UNBOUNDED,
    LinearProblem,
    Solution,
    exchange,
    joined,
    maximise,
    scale_covariance,
    solve,
    updatable,
    with_points_moved,
    with_uncertain_scales,
)
from calib_planner.identification.registration import place, tip_poses
from calib_planner.identification.term_gain import TermGain, term_gains
from calib_planner.measurements import Measurements, configuration_labels
from calib_planner.robot import BASE_PARAMETERS, Robot, target_parameters
from calib_planner.tracker import Isotropic

MOST_STARTS = 20
"""Most relinearisations at typical scales."""
WIDE = 10.0
"""Times the tolerances of the error model that lengths and angles have at the start."""
MOST_ROUNDS = 6
"""Most relinearisations with new scales."""
STUDENT_ROUNDS = 12
"""Most rounds of Student weights."""
CAUCHY_ROUNDS = 30
"""Most rounds of weights that place tracker and targets."""
FAR = 30.0
"""Points this many medians away are doubted from the start."""
BENT = 1e-4
"""Predictions that move by more than this are looked at before the step is taken [m]."""
SWELLS = 10.0
"""Scales of visits and points this many times their median are taken for gross errors until that is disproved."""
MOST_DOUBTS = 8
"""Most rounds in which impossible points come and go."""
MATERIAL = 3.0
"""A run that is shifted by fewer standard deviations of a point is left alone."""
COMMON = 2.0
"""A shift of a run is that many times as large as its visits differ, or it is none."""
LEAST = 1e-8
"""Predictions that move by less than this stand still [m]."""
EXACT = 1e-3
"""Share of these limits to which the paper's least squares goes, whose equations are to be met exactly."""
STILL = 1e-3
"""Predictions that move by less than this share of a point's standard deviation stand still."""
FALLS = 0.1
"""Changes that fall at least by this factor from one relinearisation to the next go on falling."""
ENOUGH = 450
"""Coordinates from which scales and terms are decided; more visits than that do not take part."""
GROWN = 2.0
"""Times as many visits as the scales come from: by then their standard deviations could be a third less."""
OFF = 1.25
"""Squared left-out residuals, over what is predicted, that change by this factor show that the scales are off."""
MOST_POSES = 2
"""Places whose poses are remembered: where it was linearised, and where a step went."""
BASE_ELEMENTS = 9
"""The first elements of a robot place its base (``Robot.with_base``)."""
CHORDS = 8
"""Most steps of an update with the columns as they are; then all visits are linearised anew."""
BENDS = 3e-2
"""Share of a point's standard deviation that kinematics and linearisation may differ by: it is not seen."""
ROUNDING = 1e-6
"""Left-out scores that differ by less are the same but for rounding, as of gravity along all axes."""
OPTIONAL = ("short", "smooth", "gravity")
"""Terms that go if the left-out score is surely worse with them."""


Watch = Callable[[float, str], None]
"""Told what share of the work is done, 0 … 1, and what is done next."""


def silent(share: float, text: str) -> None:
    """Nobody watches."""


@dataclass(frozen=True, eq=False)
class ModelEstimate:
    """What the measurements say.

    Attributes:
        knowledge: Robot, model with the scales estimated, coefficients and their covariance; it predicts.
        left_out: (M4) of every visit.
        doubt: (N, targets) variance of each point beside the model's [m²]; 0 where it counts in full.
        terms: Every term of the problem's model, with its size and gain.
        solution: The last linear problem and its solution.
        rounds: Relinearisations made.
        converged: Whether the predictions stood still at the end.
        origin: What an update goes on from.
    """

    knowledge: Knowledge
    left_out: LeftOut
    doubt: FloatArray
    terms: tuple[TermGain, ...]
    solution: Solution
    rounds: int
    converged: bool
    origin: Origin


@dataclass(frozen=True, eq=False)
class Origin:
    """What an estimate was made from, for an update of it.

    Attributes:
        model: The model before scales were estimated and terms went.
        data: The measurements, joints in the robot's order.
        robust: Whether impossible points lose weight; default: with every model but the paper's.
        shifted: (N, targets) D of the points of a run of visits that is shifted [m²].
        coefficients: (coefficients,) β of the fit.
        linearised: (coefficients,) β at which the columns of its linear problem were taken.
        scales: Names of the scales that were estimated, and the covariance of their logarithms.
        visits: How many visits the last full fit had.
        surprise: Sum of the squared left-out residuals over its expectation at the last full fit.
    """

    model: ErrorModel
    data: Measurements
    robust: bool
    shifted: FloatArray
    coefficients: FloatArray
    linearised: FloatArray
    scales: tuple[tuple[str, ...], FloatArray]
    visits: int
    surprise: float


@dataclass(frozen=True, eq=False)
class _State:
    """Where it is linearised: β (coefficients,), the model's scales, D of every point (N, targets)."""

    coefficients: FloatArray
    model: ErrorModel
    doubt: FloatArray


class _Work:
    """The measurements, and a state that goes from one relinearisation to the next.

    Attributes:
        robot: With base and targets about where they are; β are deviations from it.
        data: The visits that take part.
        state: Where it is linearised.
        at: (coefficients,) β where it was linearised last.
        rounds: Relinearisations made.
        converged: Whether the predictions stand still after the last one.
        moved: How far they moved in the last one, as a multiple of what stands still.
        shifted: (N, targets) D of the points of a run of visits that is shifted [m²]; 0 for all others.
    """

    def __init__(self, robot: Robot, data: Measurements, model: ErrorModel) -> None:
        self.robot, self.data = robot, data
        self.state = _State(np.zeros(len(model.variances(robot))), model, np.zeros(data.seen.shape))
        self.at = self.state.coefficients
        self.rounds, self.converged, self.moved = 0, False, 0.0
        self.shifted = np.zeros(data.seen.shape)
        self._known: dict[bytes, Poses] = {}

    @cached_property
    def groups(self) -> IntArray:
        """(N,) number of each visit's configuration: what is left out together."""
        return configuration_labels(self.data.q)

    def linearised(self) -> LinearProblem:
        """(M1) at the state."""
        data, state = self.data, self.state
        self.at = state.coefficients
        poses = self._poses(state.coefficients)
        seen = np.repeat(data.seen, 3, axis=1).astype(float)
        columns = state.model.columns(poses) * seen[:, :, None]
        apart = np.where(data.seen[:, :, None], data.p - poses.points, 0.0).reshape(seen.shape)
        random = np.isfinite(state.model.variances(self.robot))
        stated = None
        if data.std is not None:
            std = np.where(data.seen[:, :, None], np.asarray(data.std), 1.0)
            stated = std[..., None] ** 2 * np.eye(3)
        parts = state.model.visit_parts(poses, stated)
        if state.doubt.any():
            parts = parts | {"doubt": part_of(state.doubt)}
        both = seen[:, :, None] * seen[:, None, :]
        parts = {n: p * both for n, p in parts.items()}
        beyond = state.coefficients[random] - state.model.means(self.robot)[random]
        y = apart + columns[:, :, random] @ beyond
        return LinearProblem(self.robot, state.model, y, columns, parts, seen, poses)

    def accept(self, solution: Solution) -> bool:
        """Go to the solution; whether the predictions stood still."""
        problem, old = solution.problem, self.state.coefficients
        new = solution.coefficients.copy()
        new[problem.flat] += old[problem.flat]
        new[problem.random] += problem.means
        step = new - old
        change = np.abs(problem.columns @ step)
        shares = (1.0, 0.5, 0.25, 0.1, 0.03) if change.max() > BENT else (1.0,)
        if len(shares) > 1:
            cost = self._cost(problem, old)
            step = next(
                (share * step for share in shares if self._cost(problem, old + share * step) <= cost), 0.0 * step
            )
        std = np.sqrt(np.diagonal(problem.covariance, axis1=1, axis2=2))
        self.state = replace(self.state, coefficients=old + step, model=problem.model)
        self.rounds += 1
        # In units of what stands still; the next change falls as this one fell beside the one before, or faster.
        fine = EXACT if problem.model.is_papers else 1.0
        share = float((change / (fine * (STILL * std + LEAST))).max())
        self.converged = share <= 1.0 or bool(share < FALLS * self.moved and share**2 <= self.moved)
        self.moved = share
        return self.converged or not step.any()

    def _cost(self, problem: LinearProblem, coefficients: FloatArray) -> float:
        """What least squares minimises, through the kinematics and not its linearisation."""
        flat = self.apart(coefficients)[:, :, None]
        prior = np.sum(problem.standard(coefficients[problem.random] - problem.means) ** 2)
        return float(np.sum(flat * np.linalg.solve(problem.covariance, flat)) + prior)

    def here(self, coefficients: FloatArray) -> Robot:
        """The robot with the parameters of β (coefficients,)."""
        names = self.robot.parameter_names
        return self.robot.with_deviations(dict(zip(names, coefficients[: len(names)], strict=True)))

    def _poses(self, coefficients: FloatArray) -> Poses:
        """Parameters and deflected joints at β (coefficients,)."""

        def poses() -> Poses:
            model, here = self.state.model, self.here(coefficients)
            readings = Poses(here, self.data.q, model.payloads(self.data.payload, len(self.data)))
            return model.deflected(readings, coefficients)

        return remembered(self._known, coefficients.tobytes(), MOST_POSES, poses)

    def apart(self, coefficients: FloatArray) -> FloatArray:
        """(N, m) measured − predicted at β (coefficients,) [m]; 0 where not measured."""
        difference = self.data.p - self._poses(coefficients).points
        return np.where(self.data.seen[:, :, None], difference, 0.0).reshape(len(difference), -1)

    def bent(self, solution: Solution) -> FloatArray | None:
        """(N, m) by how much the kinematics leave other residuals at the state than the linear problem does [m].

        ``None`` where that is not seen (``BENDS``).
        """
        problem = solution.problem
        straight = (problem.covariance @ solution.weighted[:, :, None])[:, :, 0] * problem.seen
        apart = self.apart(self.state.coefficients)
        usual = problem.covariance - problem.parts.get("doubt", 0.0)
        allowed = BENDS * np.sqrt(np.diagonal(usual, axis1=1, axis2=2)) + LEAST
        difference = apart - straight
        return difference if (np.abs(difference) > allowed).any() else None

    def start(self, model: ErrorModel) -> None:
        """Relinearise at the scales of ``model``, but with wide tolerances: a narrow prior that fights the data
        makes the way there so crooked that no step along a line gets far."""
        wide = {s.name: WIDE * s.value for s in model.scales if s.name in model.placement.scales}
        self.state = replace(self.state, model=model.with_values(wide))
        self.settle(MOST_STARTS, 0)
        self.state = replace(self.state, model=model)

    def settle(self, most: int, scales: int = 30) -> Solution:
        """Relinearise until the predictions stand still; ``scales``: rounds for the scales each time."""
        self.moved = 0.0
        for _ in range(most):
            problem = self.linearised()
            solution = maximise(problem, scales) if scales else solve(problem)
            if self.accept(solution):
                break
        return solution

    def doubt(self, solution: Solution, squares: FloatArray) -> Solution:
        """Take the weight of what is impossible, and fit again.

        Where many are wrong, it is begun anew as the registration saw them: ``squares`` (N, targets), how far
        each point was from where the others had put it [m²]. A fit of all points alike may have come to terms
        with gross errors that are alike.
        """
        solution = self._without_run(solution)
        if many_are_wrong(solution, self.state.doubt) or self.swollen():
            model = self.state.model.with_values({s.name: s.median for s in self.state.model.scales})
            self.state = _State(np.zeros(len(self.state.coefficients)), model, np.maximum(squares, self.shifted))
            self.start(model)
            for _ in range(STUDENT_ROUNDS):
                solution = self.settle(1, 3)
                old = self.state.doubt
                new = np.maximum(student(solution, old), self.shifted)
                self.state = replace(self.state, doubt=new)
                own = np.trace(solution.problem.covariance, axis1=1, axis2=2).min() / new.shape[1]
                if np.abs(np.log((new + own) / (old + own))).max() < 0.1:
                    break
            solution = self.settle(1, 3)
        return self.reconsider(solution, MOST_DOUBTS, 30)

    def swollen(self) -> bool:
        """Whether what is new at visits and points is larger than robots and instruments make it."""
        model = self.state.model
        new = {n for term in (model.visits, model.points) if term is not None for n in term.scales}
        return any(s.value > SWELLS * s.median for s in model.scales if s.name in new and s.factor < UNBOUNDED)

    def reconsider(self, solution: Solution, rounds: int, scales: int) -> Solution:
        """Only what is impossible stays doubted; fit again as long as that changes."""
        for _ in range(rounds):
            old = self.state.doubt
            new = np.maximum(impossible(solution, old), self.shifted)
            if ((new > 0) == (old > 0)).all() and (new <= 2.0 * old).all():
                break
            self.state = replace(self.state, doubt=new)
            solution = self.settle(2, scales)
        return solution

    def _without_run(self, solution: Solution) -> Solution:
        """Without the run of visits that is shifted, if there is one and it matters; its D is ``shifted``."""
        run, before = shifted_run(solution), (self.state, self.rounds, self.converged)
        if run is None:
            return solution
        far = OUT * len(run) * float(np.sum(left_out(solution).residuals ** 2, axis=2).max())
        own = float(np.median(np.diagonal(solution.problem.covariance, axis1=1, axis2=2)))
        doubt = np.zeros(self.data.seen.shape)
        doubt[run] = np.where(self.data.seen[run], min(far, LARGEST * own), 0.0)
        self.state = replace(self.state, doubt=np.maximum(doubt, self.state.doubt))
        without = self.settle(MOST_ROUNDS)
        # Medians, and a shift that most share: gross points do not make one of the sound visits between them.
        apart = left_out(without).residuals[run][self.data.seen[run]]
        shift = np.median(apart, axis=0)
        scatter = float(np.median(np.linalg.norm(apart - shift, axis=1)))
        rest = without.problem.covariance[np.setdiff1d(np.arange(len(doubt)), run)]
        std = np.sqrt(np.median(np.trace(rest, axis1=1, axis2=2)) / doubt.shape[1])
        if np.linalg.norm(shift) > max(MATERIAL * std, COMMON * scatter):
            self.shifted = doubt
            return without
        self.state, self.rounds, self.converged = before
        return solution

    def choose_terms(self, solution: Solution) -> tuple[Solution, dict[str, float]]:
        """Without the terms with which the left-out score is worse by more than chance; term → gain.

        Chance is one standard deviation of the sum, from the groups' differences: what few groups cannot tell
        stays, since a robot that does not bend at all is not what the prior expects.
        """
        gains: dict[str, float] = {}
        while True:
            scores = left_out(solution, self.groups).scores
            trials = {t: maximise(_without(solution.problem, t), 6) for t in _optional(solution.problem.model)}
            differences = {t: scores - left_out(trial, self.groups).scores for t, trial in trials.items()}
            gains |= {t: float(d.sum()) for t, d in differences.items()}
            surely = {t: float(d.sum() + np.sqrt(len(d)) * d.std()) for t, d in differences.items()}
            if not surely or min(surely.values()) > -ROUNDING:
                return solution, gains
            worst = min(surely, key=lambda t: surely[t])
            before = self.state
            solution = trials[worst]
            left = _place(before.model, solution.problem.model, self.robot)
            self.state = replace(before, coefficients=before.coefficients[left], model=solution.problem.model)


def fit_error_model(
    robot: Robot,
    data: Measurements,
    model: ErrorModel,
    *,
    robust: bool | None = None,
    choose: bool = True,
    start: ModelEstimate | None = None,
    watch: Watch = silent,
) -> ModelEstimate:
    """Identify the active parameters of ``robot`` and all else that the model has.

    Args:
        robot: Nominal. Base and targets start in closed form if all their parameters are active.
        data: The measurements; the joint order may differ from the robot's. Where they hold payloads and the
            elastic term knows none, it gets one at the tip.
        model: The terms, with their scales before the data.
        robust: Whether impossible points lose weight; default: with every model but the paper's.
        choose: Whether terms with which the left-out score is surely worse go.
        start: An estimate of the same robot and model from most of these data, to be brought up to date: quick,
            with its scales and terms. A full fit is made where it does not do, see ``update_error_model``.
        watch: Told what share of a full fit is done, about, and what is done next.

    Raises:
        NotEnoughDataError: Too few points to place tracker and targets, or they determine nothing.
    """
    data = data.in_order_of(robot.joint_names)
    robust = not model.is_papers if robust is None else robust
    choose = choose and not model.is_papers
    quick = None if start is None else update_error_model(robot, data, model, start, robust=robust)
    try:
        return _estimate(robot, data, model, robust, choose, watch) if quick is None else quick
    except np.linalg.LinAlgError:
        need = len(robot.parameter_names)
        message = "the measured configurations do not determine the robot's place: measure more that differ"
        raise NotEnoughDataError(3 * int(data.seen.sum()), need, message) from None


def _estimate(
    robot: Robot, data: Measurements, model: ErrorModel, robust: bool, choose: bool, watch: Watch
) -> ModelEstimate:
    """The same for clean arguments."""
    before = model
    watch(0.0, "placing the robot")
    robot, far, squares = _placed(robot, data)
    model = _with_payload(model, data)
    some = _some(data)
    part = data if some is None else data.select(some)
    work = _Work(robot, part, model)
    if robust:
        work.state = replace(work.state, doubt=far if some is None else far[some])
    work.start(model)
    watch(0.05, "fitting")
    solution = work.settle(MOST_ROUNDS)
    if robust:
        watch(0.35, "looking for impossible points")
        solution = work.doubt(solution, squares if some is None else squares[some])
    gains: dict[str, float] = {}
    if choose:
        watch(0.5, "trying each term")
        solution, gains = work.choose_terms(solution)
        solution = work.settle(2)
    watch(0.7, "settling the sizes of the errors")
    if work.state.model.scales:
        solution = work.settle(MOST_ROUNDS, 0)
    if some is not None:
        whole = _Work(robot, data, work.state.model)
        near = np.clip(np.searchsorted(some, np.arange(len(data))), 0, len(some) - 1)
        whole.shifted = np.where(data.seen, work.shifted[near].max(axis=1)[:, None], 0.0)
        doubt = np.maximum(far, whole.shifted) if robust else np.zeros(data.seen.shape)
        doubt[some] = work.state.doubt
        whole.state, whole.rounds = replace(work.state, doubt=doubt), work.rounds
        # The scales of some visits are a start for those of all.
        whole.settle(1, 2)
        solution = whole.settle(2, 0)
        if robust:
            solution = whole.reconsider(solution, 2, 0)
        work = whole
    watch(0.9, "predicting visits left out")
    scales = scale_covariance(solution)
    covariance = _covariance(solution, scales)
    left = left_out(solution, work.groups)
    return ModelEstimate(
        knowledge=_knowledge(work, covariance, _hidden(solution.problem)),
        left_out=left,
        doubt=work.state.doubt,
        terms=term_gains(model, solution.problem, work.state.coefficients, covariance, gains),
        solution=solution,
        rounds=work.rounds,
        converged=work.converged,
        origin=Origin(
            before,
            data,
            robust,
            work.shifted,
            work.state.coefficients,
            work.at,
            scales,
            len(data),
            _surprise(left),
        ),
    )


def _covariance(solution: Solution, scales: tuple[tuple[str, ...], FloatArray]) -> FloatArray:
    """(coefficients, coefficients) C of β, uncertain scales included, symmetric in all digits."""
    covariance = with_uncertain_scales(solution, scales)
    symmetric = covariance + covariance.T
    symmetric *= 0.5
    return symmetric


def _knowledge(work: _Work, covariance: FloatArray, hidden: FloatArray) -> Knowledge:
    """What the state says."""
    told, data = work.state.model, work.data
    if data.std is not None and told.points.noise is None:
        # What was said of these points is what is expected of others.
        usual = Isotropic(float(np.sqrt(np.mean(np.asarray(data.std)[data.seen] ** 2))))
        told = replace(told, points=replace(told.points, noise=usual))
    if told.gravity is not None:
        told = replace(told, gravity=told.gravity.placed(work.here(work.state.coefficients)))
    return Knowledge(work.robot, told, work.state.coefficients, covariance, hidden)


def _surprise(left: LeftOut) -> float:
    """Sum of the squared left-out residuals of visits without doubts over its expectation; 1: there are none."""
    sound = np.bincount(left.groups, weights=left.doubted.any(axis=1), minlength=len(left.squares)) == 0.0
    freedom = float(left.freedom[sound].sum())
    return float(left.squares[sound].sum()) / freedom if freedom > 0.0 else 1.0


# ── what a file of lengths and angles can hold ───────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class PlacementAlone:
    """A fit of the parameters alone, without gravity and joint functions: what a URDF can hold.

    Attributes:
        knowledge: Robot, model without these terms, deviations and their covariance.
        left_out: (M4): how well such a file predicts.
        converged: Whether the predictions stood still at the end.
    """

    knowledge: Knowledge
    left_out: LeftOut
    converged: bool


def placement_alone(fit: ModelEstimate, start: PlacementAlone | None = None) -> PlacementAlone:
    """The parameters that predict best where gravity and joint functions are nobody's business.

    They are not those of the whole model: they take over what they can of the terms that are off. What they
    cannot has to be in visits and points, whose scales are estimated anew. Points that were doubted stay so.

    Args:
        fit: Of the whole model.
        start: The same of the fit that ``fit`` is an update of; its scales stay.
    """
    problem, origin = fit.solution.problem, fit.origin
    model, robot = problem.model, problem.robot
    if len(model.systematic) == 1:
        known = replace(fit.knowledge, robot=robot, coefficients=origin.coefficients)
        return PlacementAlone(known, fit.left_out, fit.converged)
    alone = model.placement_alone
    work = _Work(robot, origin.data, alone)
    count = len(robot.parameter_names)
    if start is None:
        work.state = _State(origin.coefficients[:count], alone, fit.doubt)
        solution = work.settle(MOST_ROUNDS)
    else:
        alone = alone.with_values(start.knowledge.model.values)
        work.state = _State(start.knowledge.coefficients, alone, fit.doubt)
        solution = work.settle(MOST_ROUNDS, 0)
    covariance = _covariance(solution, scale_covariance(solution))
    known = _knowledge(work, covariance, _hidden(solution.problem))
    return PlacementAlone(known, left_out(solution, work.groups), work.converged)


# ── an update ────────────────────────────────────────────────────────────────────────────────────────


def update_error_model(
    robot: Robot, data: Measurements, model: ErrorModel, start: ModelEstimate, *, robust: bool | None = None
) -> ModelEstimate | None:
    """``start`` brought up to date with the visits that came and went; ``None``: a full fit is needed.

    Arguments as of ``fit_error_model``. A full fit is needed if ``start`` is of another robot or model, did not
    converge or left a direction hidden; if it has no terms with scales (the paper's model: a full fit is as
    quick); if there are ``GROWN`` times as many visits as the scales come from, or most of these went; if the
    first payload came; if the squared left-out residuals changed by a factor of ``OFF``; or if a visit that went
    was the only one to tell something.
    """
    robust = not model.is_papers if robust is None else robust
    with suppress(np.linalg.LinAlgError):
        return _updated(robot, data.in_order_of(robot.joint_names), model, robust, start)
    return None


def _updated(
    robot: Robot, data: Measurements, model: ErrorModel, robust: bool, start: ModelEstimate
) -> ModelEstimate | None:
    """The same for clean arguments.

    Raises:
        numpy.linalg.LinAlgError: A visit that went was the only one to tell something.
    """
    origin, old = start.origin, start.solution.problem
    placed = old.robot
    if not _same_robot(robot, placed) or repr(model) != repr(origin.model) or robust != origin.robust:
        return None
    if model.is_papers or not start.converged or old.basis.shape[0] > old.basis.shape[1]:
        return None
    rows = _common(origin.data, data)
    stays = rows >= 0
    if _with_payload(old.model, data) is not old.model:
        return None
    if len(data) > GROWN * origin.visits or stays.sum() < origin.visits / GROWN:
        return None
    work = _Work(placed, data, old.model)
    flat, reference = old.flat, origin.linearised[old.flat]
    doubt = np.zeros(data.seen.shape)
    doubt[stays] = start.doubt[rows[stays]]
    work.shifted[stays] = origin.shifted[rows[stays]]
    if len(origin.data) and not stays.all() and stays.any():
        # A visit behind a shifted run belongs to it.
        near = np.maximum.accumulate(np.where(stays, np.arange(len(data)), -1))
        late = ~stays & (near >= 0)
        work.shifted[late] = np.where(data.seen[late], work.shifted[near[late]].max(axis=1)[:, None], 0.0)
        doubt = np.maximum(doubt, work.shifted)
    work.state = _State(origin.coefficients, old.model, doubt)
    fresh = np.flatnonzero(~stays)
    new = _Work(placed, data.select(fresh), old.model)
    new.state = _State(origin.linearised, old.model, np.zeros((len(fresh), doubt.shape[1])))
    more = new.linearised() if len(fresh) else None
    if more is not None:
        # The residuals of the newest estimate, the columns of the first: see the top of the file.
        turn = new.apart(origin.coefficients) - new.apart(origin.linearised)
        more = replace(more, y=more.y + turn + more.columns @ (origin.coefficients - origin.linearised))
    problem = _joined(old, more, rows, doubt)
    solution = exchange(updatable(start.solution), problem, rows)
    for _ in range(MOST_DOUBTS if robust else 0):
        changed = np.maximum(impossible(solution, doubt), work.shifted)
        if ((changed > 0) == (doubt > 0)).all() and (changed <= 2.0 * doubt).all():
            break
        doubt = changed
        problem = replace(problem, parts=_with_doubt(problem.parts, doubt))
        problem.__dict__["flat"], problem.__dict__["random"] = old.flat, old.random
        solution = exchange(solution, problem, np.arange(len(data)))
    final: Solution | None = None
    linearised = origin.linearised
    for _ in range(CHORDS):
        coefficients = solution.coefficients.copy()
        coefficients[flat] += reference
        coefficients[old.random] += old.means
        work.state = _State(coefficients, old.model, doubt)
        work.rounds, work.converged = work.rounds + 1, True
        bent = work.bent(solution)
        if bent is None:
            final = solution
            break
        solution = with_points_moved(solution, bent)
    if final is None:
        final = work.settle(4, 0)
        linearised = work.at
    left = left_out(final, work.groups)
    surprise = _surprise(left)
    if not origin.surprise / OFF < surprise < origin.surprise * OFF:
        return None
    return ModelEstimate(
        knowledge=_knowledge(work, _covariance(final, origin.scales), np.zeros((len(coefficients), 0))),
        left_out=left,
        doubt=doubt,
        terms=start.terms,
        solution=final,
        rounds=work.rounds,
        converged=work.converged,
        origin=replace(
            origin, data=data, shifted=work.shifted, coefficients=work.state.coefficients, linearised=linearised
        ),
    )


def _same_robot(robot: Robot, placed: Robot) -> bool:
    """Whether ``placed`` is ``robot`` with its unknown base and targets somewhere else."""
    base, tool = _unknown_places(robot)
    alike = (robot.parameter_names, robot.joint_names) == (placed.parameter_names, placed.joint_names)
    skip = BASE_ELEMENTS if base else 0
    alike = alike and robot.elements[skip:] == placed.elements[skip:]
    return alike and (len(robot.targets) == len(placed.targets) if tool else robot.targets == placed.targets)


def _unknown_places(robot: Robot) -> tuple[bool, bool]:
    """Whether base and targets are unknown altogether, and start in closed form."""
    active = set(robot.parameter_names)
    return active.issuperset(BASE_PARAMETERS), active.issuperset(target_parameters(len(robot.targets)))


def _common(old: Measurements, new: Measurements) -> IntArray:
    """(N,) number of each visit of ``new`` among the old ones, −1 where it is not there."""

    def keys(some: Measurements) -> list[bytes]:
        columns = [some.q, some.p, *(np.asarray(c) for c in (some.std, some.payload) if c is not None)]
        whole = np.hstack([c.reshape(len(some), -1) for c in columns])
        return [row.tobytes() for row in whole]

    there: dict[bytes, list[int]] = {}
    for i, key in reversed(list(enumerate(keys(old)))):
        there.setdefault(key, []).append(i)
    return np.array([there[k].pop() if there.get(k) else -1 for k in keys(new)], int)


def _joined(old: LinearProblem, new: LinearProblem | None, rows: IntArray, doubt: FloatArray) -> LinearProblem:
    """The visits ``rows`` of the old problem, and where these are −1 the new one's, with doubts D."""
    nothing = np.zeros(0)

    def join(one: FloatArray, other: FloatArray | None) -> FloatArray:
        return joined(one, nothing.reshape(0, *one.shape[1:]) if other is None else other, rows)

    parts = {
        n: join(p, None if new is None else new.parts[n])
        for n, p in old.parts.items()
        if n != "doubt" and (new is None or n in new.parts)
    }
    problem = LinearProblem(
        old.robot,
        old.model,
        join(old.y, None if new is None else new.y),
        join(old.columns, None if new is None else new.columns),
        _with_doubt(parts, doubt),
        join(old.seen, None if new is None else new.seen),
    )
    for name in ("flat", "random", "root", "ratios"):
        problem.__dict__[name] = getattr(old, name)
    return problem


def _with_doubt(parts: Mapping[str, FloatArray], doubt: FloatArray) -> dict[str, FloatArray]:
    """The parts of R_i with D (N, targets) in place of what they had."""
    result = {n: p for n, p in parts.items() if n != "doubt"}
    return result | {"doubt": part_of(doubt)} if doubt.any() else result


# ── the parts of a full fit ──────────────────────────────────────────────────────────────────────────


def _placed(robot: Robot, data: Measurements) -> tuple[Robot, FloatArray, FloatArray]:
    """``robot`` with unknown base and targets where they fit the nominal chain best; D of far points; squares.

    Each point weighs by how far it is from where the others put it (Cauchy, with the median as scale): some that
    are wrong by metres must not place the tracker. Those ``FAR`` times the median away are doubted from the
    start. The squares are those of the distances, (N, targets) [m²].
    """
    base, tool = _unknown_places(robot)
    weights, seen = data.seen.astype(float), data.seen
    poses = tip_poses(robot, data.q, at_base=base) if base or tool else None
    for _ in range(CAUCHY_ROUNDS if poses else 1):
        if poses:
            put = place(robot, data, poses, base=base, tool=tool, weights=weights).of(robot, base=base, tool=tool)
        else:
            put = robot
        length = np.linalg.norm(np.where(seen[:, :, None], data.p - put.positions(data.q), 0.0), axis=2)
        median = max(float(np.median(length[seen])), LEAST)
        new = np.where(seen, 1.0 / (1.0 + (length / median) ** 2), 0.0)
        settled, weights = np.abs(new - weights).max() < 0.01, new
        if settled:
            break
    return put, np.where(length > FAR * median, OUT * length**2, 0.0), length**2


def _with_payload(model: ErrorModel, data: Measurements) -> ErrorModel:
    """The model with a payload at the tip if the data hold one that its elastic term does not know."""
    heaviest = 0.0 if data.payload is None else float(np.asarray(data.payload).max())
    if model.gravity is None or model.gravity.payload is not None or not heaviest:
        return model
    return replace(model, gravity=model.gravity.with_payload(Payload(heaviest)))


def _some(data: Measurements) -> FloatArray | None:
    """Numbers of the visits that decide scales and terms, in their order; ``None``: all."""
    size = 3 * data.seen.sum(axis=1)
    if size.sum() <= ENOUGH:
        return None
    order = np.random.default_rng(0).permutation(len(size))
    return np.sort(order[np.cumsum(size[order]) <= ENOUGH])


def _optional(model: ErrorModel) -> tuple[str, ...]:
    """Terms of this model that go if the left-out score is surely worse with them."""
    components = () if model.joint_functions is None else model.joint_functions.components
    there = (*components, *(term.name for term in model.systematic))
    return tuple(t for t in OPTIONAL if t in there)


def _place(model: ErrorModel, smaller: ErrorModel, robot: Robot) -> FloatArray:
    """Where the coefficients of ``smaller`` are among those of ``model``."""
    at = {name: i for i, name in enumerate(model.names(robot))}
    return np.array([at[name] for name in smaller.names(robot)], int)


def _without(problem: LinearProblem, term: str) -> LinearProblem:
    """The same linear problem without a term."""
    model = problem.model.without(term)
    columns = problem.columns[:, :, _place(problem.model, model, problem.robot)]
    return replace(problem, model=model, columns=columns)


def _hidden(problem: LinearProblem) -> FloatArray:
    """(coefficients, directions) of flat coefficients that no point shows."""
    rows = problem.columns[:, :, problem.flat].reshape(problem.y.size, -1)
    rank = problem.basis.shape[1]
    result = np.zeros((problem.columns.shape[2], rows.shape[1] - rank))
    if result.shape[1]:
        length = np.linalg.norm(rows, axis=0)
        length[length == 0.0] = 1.0
        vectors = np.linalg.svd(np.linalg.qr(rows / length, mode="r"))[2]
        result[problem.flat] = vectors[rank:].T / length[:, None]
    return result
