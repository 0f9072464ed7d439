# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The verb: ``plan(problem)`` → ``Plan``. Prepare, bound, search, prove what was reached.

The approximate design comes first: it gives the bound, and its support is where good plans are. Then the
search, in independent parts that any ``concurrent.futures`` executor may do, as it may do what the design has to
know of every candidate. Compound criteria are geometric means of efficiencies, so their parts' approximate
designs are computed before them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, one_thread
from calib_planner.error_model import FELT, Poses, covariance, error_variance
from calib_planner.errors import InfeasibleError, InputError
from calib_planner.planning.bound import (
    GAP,
    ApproximateDesign,
    DesignProblem,
    approximate_design,
    maximised,
    raised,
)
from calib_planner.planning.certify.prove import CLOSELY, TOLERANCE, USUAL_WORK, Proof, prove_bound
from calib_planner.planning.criteria import (
    POSE_CRITERIA,
    Compound,
    Criterion,
    is_sharp,
    reported_value,
)
from calib_planner.planning.extended import ExtendedModel
from calib_planner.planning.information import PlanSpace, plan_space, spread_spaces
from calib_planner.planning.problem import PlanProblem
from calib_planner.planning.result import STATUS, Plan, PlannedTerm, PlanQuality
from calib_planner.planning.search.enumeration import best_of_all
from calib_planner.planning.search.exchange import ChoiceProblem, check_choice, choose
from calib_planner.planning.search.multistart import SearchProblem, SearchResult, parts, search_chunk
from calib_planner.planning.search.rounding import heaviest_places, improved, rounded_rows
from calib_planner.planning.search.swaps import drawn_plan, swapped
from calib_planner.planning.tour import visiting_order
from calib_planner.robot import NO_LEVER

GOOD_ENOUGH = 0.012
"""Distance of a plan's value from its bound, as a share, at which the search ends; half as much in ρ0."""

AGREEMENT = 2e-4
"""Difference of log values below which two parts of the search have reached the same plan."""


UNEXPLAINED = 0.99
"""Efficiency below which a plan says how much whole numbers of visits may have to do with it."""

ROUNDING = 1e-9
"""Relative error of Ψ of a plan; one that is better than its bound by more has shown that the bound was wrong."""


@dataclass(frozen=True)
class Progress:
    """What a callback is told while the planner works.

    Attributes:
        starts_done, starts_total: Descents finished and wanted.
        best_accuracy: Best value of the criterion so far (ρ0 [m] for test poses); NaN before the first.
        lower_bound: Bound on that value; NaN before it is known.
        seconds: Time spent.
    """

    starts_done: int
    starts_total: int
    best_accuracy: float
    lower_bound: float
    seconds: float


Callback = Callable[[Progress], bool | None]
"""Told of progress; what returns ``True`` cancels the search."""


@one_thread
def plan(
    problem: PlanProblem,
    callback: Callback | None = None,
    executor: Executor | None = None,
    *,
    prove: bool = False,
    bounded: bool = True,
) -> Plan:
    """Find the best configurations, and a bound on how good any could be.

    Args:
        problem: The request.
        callback: Told of progress; returning ``True`` cancels, the best plan so far being returned.
        executor: Any ``concurrent.futures`` executor; the plan is the same whichever, or without one. With
            one, time limit and cancellation act between the parts of the work.
        prove: Make the bound rigorous (see ``prove``); the message says how close and, if not, why.
        bounded: Whether a bound is wanted, which takes time; without one the plan says none, and none is proved.

    Raises:
        InfeasibleError: Nothing satisfies the problem; names what stands in the way.
    """
    space = plan_space(problem)
    clock = _Clock(problem, len(space.interest), callback)
    *seeds, own = np.random.SeedSequence(problem.search.seed).spawn(len(parts(problem.starts)) + 1)
    criterion, target = _criteria(space, np.random.default_rng(own))
    rng = np.random.default_rng(own)
    gap = CLOSELY if prove else GAP  # a required proof is worth a design that is near its own bound
    design = _approximate(space, target, rng, clock.over, executor, gap) if target.concave else None
    proof = None
    if design is not None and bounded:
        design, proof = _proven(space, target, design, np.random.default_rng(own.spawn(1)[0]), clock, prove)
    clock.tell(bound=design.bound if design else None)
    best, rounded = None, _Rounded(space, criterion, design)
    if problem.candidates is not None:
        result, best = _choose(space, criterion, target, design, rng, clock)
    else:
        result = _search(space, criterion, design, seeds, rounded, clock, executor)
    return _assemble(space, target, design if bounded else None, proof, best, rounded, result, clock)


@one_thread
def judged(
    problem: PlanProblem,
    configurations: FloatArray,
    repetitions: ArrayLike,
    searched: Plan | None = None,
    bounded: bool = True,
) -> Plan:
    """What given configurations promise, in their order, each with its own number of visits; no search.

    Args:
        problem: The request; its ``configurations`` and ``repetitions`` are not looked at.
        configurations: (m, joints) [rad | m].
        repetitions: One number, or (m,).
        searched: The plan whose configurations these are: it says what the search took.
        bounded: Whether a bound is wanted, which takes longer than the rest.

    Raises:
        InputError: Not a number of visits for each.
        InfeasibleError: As for ``plan``.
    """
    space = space_of(problem, configurations, repetitions)
    clock = _Clock(space.problem, len(space.interest), None)
    rng = np.random.default_rng(problem.search.seed)
    target = _criteria(space, rng)[1]
    design, proof = None, None
    if target.concave and bounded:
        design = _approximate(space, target, rng, clock.over)
        design, proof = _proven(space, target, design, rng, clock, False)
    work = (0, 0) if searched is None else (searched.quality.starts, searched.quality.evaluations)
    result, rounded = SearchResult(configurations, np.nan, *work), _Rounded(space, target, design)
    made = _assemble(space, target, design, proof, None, rounded, result, clock, True)
    return made if searched is None else _as_searched(made, searched.quality)


def _as_searched(made: Plan, search: PlanQuality) -> Plan:
    """The plan with the time of the search that it comes from, and with how that ended if it did not end well."""
    quality, status = made.quality, made.quality.status
    if status == "ok" and search.status in ("time_limit", "cancelled"):
        status = search.status
    message = quality.message.replace(STATUS[quality.status], STATUS[status])
    seconds = quality.seconds + search.seconds
    return replace(made, quality=replace(quality, status=status, message=message, seconds=seconds))


def space_of(problem: PlanProblem, configurations: FloatArray, repetitions: ArrayLike) -> PlanSpace:
    """The space of ``problem`` for exactly these configurations (m, joints), with r_i visits to each.

    Raises:
        InputError: Not a number of visits for each.
    """
    counts, size = np.asarray(repetitions), len(configurations)
    if counts.shape not in ((), (size,)) or counts.dtype.kind not in "iu" or (counts < 1).any():
        raise InputError("repetitions", counts.tolist(), f"a whole number >= 1, or {size} of them")
    space = plan_space(replace(problem, configurations=size, repetitions=1))
    return space.repeated(counts)


def value_of(problem: PlanProblem, configurations: FloatArray) -> float:
    """Value of the criterion (ρ0 [m] for accuracies) of given configurations (m, joints); no search."""
    return value_in(plan_space(problem), configurations)


def value_in(space: PlanSpace, configurations: FloatArray) -> float:
    """``value_of`` in the space of the problem."""
    name = space.problem.criterion
    psi = psi_of(space, space.criterion(name), configurations)
    return reported_value(name, psi, len(space.interest), space.measurements)


# ── the parts ────────────────────────────────────────────────────────────────────────────────────────


class _Clock:
    """Time limit, cancellation and progress of one plan."""

    def __init__(self, problem: PlanProblem, size: int, callback: Callback | None) -> None:
        self.began = time.perf_counter()
        self.deadline = self.began + problem.search.time_limit
        self.callback = callback
        self.problem, self.size = problem, size
        self.cancelled = self.late = False
        self.last = Progress(0, problem.starts, float("nan"), float("nan"), 0.0)

    def over(self) -> bool:
        self.late = self.late or time.perf_counter() > self.deadline
        self.tell()
        return self.late or self.cancelled

    def tell(self, done: int | None = None, log_value: float | None = None, bound: float | None = None) -> None:
        if self.callback is None:
            return
        changes: dict[str, float] = {"seconds": self.seconds}
        if done is not None:
            changes["starts_done"] = done
        if log_value is not None:
            changes["best_accuracy"] = self._value(float(np.exp(log_value)))
        if bound is not None:
            changes["lower_bound"] = self._value(bound)
        self.last = replace(self.last, **changes)  # type: ignore[arg-type]
        if self.callback(self.last):
            self.cancelled = True

    def _value(self, psi: float) -> float:
        return reported_value(self.problem.criterion, psi, self.size, self.problem.measurements)

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.began


def _criteria(space: PlanSpace, rng: np.random.Generator) -> tuple[Criterion, Criterion]:
    """What the search maximises, and what the bound is about."""
    problem = space.problem
    if not problem.compound:
        return space.search_criterion(), space.criterion(problem.criterion)
    shares = {problem.criterion: 1.0 - sum(problem.compound.values()), **problem.compound}
    parts = tuple(space.criterion(name) for name in shares)
    references = tuple(_approximate(space, part, rng, lambda: False).value for part in parts)
    made = Compound(parts, tuple(shares.values()), references)
    return made, made


def _approximate(
    space: PlanSpace,
    criterion: Criterion,
    rng: np.random.Generator,
    cancel: Callable[[], bool],
    executor: Executor | None = None,
    gap: float = GAP,
) -> ApproximateDesign:
    tests = space.problem.test_pose_array
    usable = tests[space.feasibility.mask(tests)] if space.problem.candidates is None else tests[:0]
    return approximate_design(_design_problem(space, criterion), usable, rng, cancel, executor, gap=gap)


def _design_problem(space: PlanSpace, criterion: Criterion) -> DesignProblem:
    problem = space.problem
    if np.ndim(space.model.repetitions):
        # Unequal repetitions may be of any numbers, so that each measurement counts as a visit of its own.
        visits = space.measurements
        return DesignProblem(
            space.single, criterion, space.prior, visits, space.feasibility, problem.candidate_array
        )
    return DesignProblem(
        space.model,
        criterion,
        space.prior,
        problem.configurations,
        space.feasibility,
        problem.candidate_array,
        problem.once_each,
    )


def _proven(
    space: PlanSpace,
    criterion: Criterion,
    design: ApproximateDesign,
    rng: np.random.Generator,
    clock: _Clock,
    prove: bool,
) -> tuple[ApproximateDesign, Proof | None]:
    """The design with a proven bound, or with a numerical one that was maximised thoroughly.

    A proof is tried where it is quick. With constraints it is tried on demand only: over the joint limits alone
    the bound is a looser one.
    """
    request, proof = _design_problem(space, criterion), None
    if prove or request.candidates is not None or not request.feasibility.constraints:
        work, tolerance = (float("inf"), CLOSELY) if prove else (USUAL_WORK, TOLERANCE)
        design, proof = prove_bound(request, design, rng, tolerance=tolerance, most_work=work, cancel=clock.over)
    if proof is None or not proof.holds:
        design = maximised(request, design, rng, clock.over)
    return design, proof


def _search(
    space: PlanSpace,
    criterion: Criterion,
    design: ApproximateDesign | None,
    seeds: list[np.random.SeedSequence],
    rounded: _Rounded,
    clock: _Clock,
    executor: Executor | None,
) -> SearchResult:
    """Parts of the work, here or by the executor, until enough is known; the best, the first one if equal.

    The rounded design comes last, where the others are not enough. With a whole error model every part begins
    with one, after swaps.
    """
    nobody = np.empty((0, len(space.robot.joint_names)))

    def searched(space: PlanSpace, criterion: Criterion) -> SearchProblem:
        return SearchProblem(
            model=space.model,
            criterion=criterion,
            prior=space.prior,
            size=space.problem.configurations,
            feasibility=space.feasibility,
            support=design.support if design else nobody,
            weights=design.weights if design else np.empty(0),
            tests=space.problem.test_pose_array,
        )

    search = replace(
        searched(space, criterion),
        beside=tuple(searched(other, _criterion_of(other, criterion)) for other in spread_spaces(space)),
    )
    sizes = parts(space.problem.starts)
    work = [(search, n, np.random.default_rng(seed)) for n, seed in zip(sizes, seeds, strict=True) if n]
    best: SearchResult | None = None
    done = evaluations = 0
    tops: list[float] = []
    futures = [executor.submit(search_chunk, *job) for job in work] if executor else []
    for index, job in enumerate(work):
        if index and (clock.over() or _agreed(tops) or _good_enough(space, design, best)):
            break
        result = futures[index].result() if futures else search_chunk(*job, clock.over)
        tops.append(result.log_value)
        done, evaluations = done + result.starts, evaluations + result.evaluations
        if best is None or result.log_value > best.log_value:
            best = result
        # With other sizes of the errors beside them, ``log_value`` is a mean over all of them.
        psi = psi_of(space, criterion, best.configurations) if search.beside else np.exp(best.log_value)
        clock.tell(done, float(np.log(max(psi, 1e-300))))
    for future in futures:
        future.cancel()
    assert best is not None
    whole = isinstance(space.model, ExtendedModel)
    if not clock.over() and (is_sharp(criterion) or not (whole or _good_enough(space, design, best))):
        plans = [best.configurations, *([] if whole else rounded.plans)]
        result = improved(search, np.stack(plans), clock.over)
        evaluations += result.evaluations
        if is_sharp(criterion) or result.log_value > best.log_value:
            best = result
    return replace(best, starts=done, evaluations=evaluations)


@dataclass(frozen=True, eq=False)
class _Rounded:
    """Whole-number plans at the configurations of the approximate design."""

    space: PlanSpace
    criterion: Criterion
    design: ApproximateDesign | None

    @cached_property
    def plans(self) -> list[FloatArray]:
        """Some (m, joints); none with candidates, where exchange starts from such a plan anyway."""
        space, design = self.space, self.design
        if design is None or np.ndim(space.model.repetitions) or space.problem.candidates is not None:
            return []
        if isinstance(space.model, ExtendedModel):
            heavy, size = design.weights > 0, space.problem.configurations
            support, weights = design.support[heavy], design.weights[heavy]
            if len(support) < size:
                return []
            rng, sizes = (
                np.random.default_rng(space.problem.search.seed),
                [(space.model, self.criterion, space.prior)],
            )
            return [swapped(sizes, *drawn_plan(size, support, weights, support[:0], rng), rng)[0]]
        request = _choice(space, self.criterion, design.support, design)
        low, high = space.robot.joint_limits.T
        places = heaviest_places(design.support, design.weights, high - low)
        try:
            rows = rounded_rows(request, places, np.random.default_rng(space.problem.search.seed))
        except InfeasibleError:  # some of its weight is on the spread that keeps it regular
            return []
        return [design.support[each] for each in rows]


def _agreed(tops: list[float]) -> bool:
    """Whether two parts with starts of their own ended at the same best value: more would hardly end above."""
    best = sorted(tops)[-2:]
    return len(best) == 2 and best[1] - best[0] < AGREEMENT


def _good_enough(space: PlanSpace, design: ApproximateDesign | None, best: SearchResult | None) -> bool:
    """Whether the best plan is so near its bound that more starts cannot pay."""
    if design is None or best is None or space.problem.compound:
        return False
    psi = psi_of(space, space.criterion(space.problem.criterion), best.configurations)
    return psi >= (1.0 - GOOD_ENOUGH) * design.bound


def _choose(
    space: PlanSpace,
    criterion: Criterion,
    target: Criterion,
    design: ApproximateDesign | None,
    rng: np.random.Generator,
    clock: _Clock,
) -> tuple[SearchResult, _Bound | None]:
    """The choice, and the bound where every choice there is was evaluated."""
    problem = space.problem
    candidates = np.asarray(problem.candidate_array)
    allowed = candidates[space.feasibility.mask(candidates)]
    request = _choice(space, criterion, allowed, design)
    check_choice(request)
    if request.together is not None:
        request = replace(request, beside=tuple(_scaled_choices(space, criterion, request)))
    one = criterion is target or problem.criterion != "test_pose" or problem.general_weight == 0.0
    exact = replace(request, criterion=target) if one else request
    every = best_of_all(exact, target, lambda matrix: _psi_of_matrix(space, target, matrix), clock.over)
    if every is None:
        chosen = choose(request, rng, clock.over)
        clock.tell(problem.starts, chosen.log_value)
        return SearchResult(allowed[chosen.rows], chosen.log_value, chosen.starts, chosen.evaluations), None
    clock.tell(problem.starts, every.log_value)
    psi = psi_of(space, target, allowed[every.top_rows])
    text = f" The bound is proven: each of the {every.choices} choices there are was evaluated."
    if not one:
        sizes = " and over several sizes of the robot's errors" if request.beside else ""
        text += f" The plan is the best of them with a share for accuracy everywhere{sizes}."
    result = SearchResult(allowed[every.rows], every.log_value, 1, every.choices)
    return result, _Bound(psi, "proven", 0.0, text=text)


def _choice(
    space: PlanSpace, criterion: Criterion, candidates: FloatArray, design: ApproximateDesign | None
) -> ChoiceProblem:
    """The choice among ``candidates`` (C, joints), all of them feasible."""
    together = space.model.linearised(candidates) if isinstance(space.model, ExtendedModel) else None
    return ChoiceProblem(
        rows=space.model.whitened(candidates) if together is None else together.whitened,
        criterion=criterion,
        prior=space.prior,
        size=space.problem.configurations,
        repeat=not space.problem.once_each,
        weights=design.weights if design else np.empty(0),
        names=space.robot.parameter_names if together is None else (),
        together=together,
    )


def _scaled_choices(space: PlanSpace, criterion: Criterion, request: ChoiceProblem) -> Iterator[ChoiceProblem]:
    """The same choice for other sizes of the errors."""
    for other in spread_spaces(space):
        assert isinstance(other.model, ExtendedModel)
        wanted = _criterion_of(other, criterion)
        yield replace(request, criterion=wanted, prior=other.prior, factor=other.model.factor, beside=())


def _criterion_of(space: PlanSpace, criterion: Criterion) -> Criterion:
    """The criterion of the search in another space of the same problem."""
    return space.search_criterion() if not space.problem.compound else criterion


# ── the answer ───────────────────────────────────────────────────────────────────────────────────────


def _assemble(
    space: PlanSpace,
    target: Criterion,
    design: ApproximateDesign | None,
    proof: Proof | None,
    best: _Bound | None,
    rounded: _Rounded,
    result: SearchResult,
    clock: _Clock,
    given: bool = False,
) -> Plan:
    """The plan; ``given``: its configurations stay as they are, in their order."""
    problem, robot = space.problem, space.robot
    configurations = result.configurations
    if not given:
        configurations = _rest_idle_joints(space, configurations)
        configurations = configurations[visiting_order(configurations, robot)]
    matrix = space.model.totals(configurations, len(configurations))[0] + space.prior
    inverse, hidden = covariance(matrix)
    squares = np.array([error_variance(rows, inverse, hidden) for rows in space.test_jacobians])
    per = np.sqrt(squares + space.test_floor)
    per[space.blind] = np.inf
    shares = problem.weight_array / max(problem.weight_array.sum(), 1e-300)
    accuracy = float(np.sqrt(shares[shares > 0] @ per[shares > 0] ** 2)) if len(per) else float("nan")
    plain = problem.criterion == "test_pose" and not problem.compound
    # For the paper's criterion Ψ is that of the figure reported, to the last digit.
    floor = float(shares @ space.test_floor) if plain else 0.0
    psi = accuracy**-2 if plain else psi_of(space, target, configurations)
    bound = best or _bound(space, target, design, proof, configurations, rounded)
    bound = _checked(bound.above(floor), psi)
    name = "compound" if problem.compound else problem.criterion
    size, n = len(space.interest), space.measurements
    value = psi if problem.compound else reported_value(name, psi, size, n)
    value_bound = bound.psi if problem.compound or not bound.known else reported_value(name, bound.psi, size, n)
    general = float("inf") if hidden.size else float(np.trace(space.general @ inverse)) + space.general_floor
    status = "cancelled" if clock.cancelled else "time_limit" if clock.late else "ok"
    status = "singular" if (hidden.size or space.blind.any()) and status == "ok" else status
    combinations = space.identifiability.combinations
    note = f" Not identifiable by any plan, fixed at nominal: {', '.join(combinations)}." if combinations else ""
    if space.blind.any():
        note += " No configuration shows what a test pose needs: its error is unlimited."
    elif combinations and (problem.compound or problem.criterion not in POSE_CRITERIA):
        note += " The criterion holds for this choice of parameters."
    if problem.whole_model is not None:
        note += f" Planned for a robot that errs by the error model {problem.whole_model.name!r}."
    note += bound.text
    quality = PlanQuality(
        predicted_accuracy_per_test_pose=per,
        parameter_std=_parameter_deviations(space, inverse, hidden),
        criterion=name,
        predicted_accuracy=accuracy,
        unidentifiable=combinations,
        general_accuracy=float(np.sqrt(general)),
        value=value,
        value_bound=value_bound,
        lower_bound=value_bound if name in POSE_CRITERIA else float("nan"),
        efficiency=_efficiency(name, psi, bound.psi, value, value_bound) if bound.known else float("nan"),
        bound=bound.kind,
        bound_tolerance=bound.tolerance,
        rounded_efficiency=bound.rounded,
        status=status,
        message=STATUS[status] + note,
        seconds=clock.seconds,
        seed=problem.search.seed,
        starts=result.starts,
        evaluations=result.evaluations,
        accuracy_frame=problem.accuracy_frame,
        error_model=problem.model.name,
        terms=_terms(space, inverse),
    )
    return Plan(
        robot=robot.name,
        parameters=problem.robot.parameter_names,
        joint_names=robot.joint_names,
        configurations=configurations,
        repetitions=np.broadcast_to(space.model.repetitions, (len(configurations),)),
        test_poses=problem.test_pose_array,
        weights=shares,
        sigma=problem.instrument.typical,
        quality=quality,
    )


@dataclass(frozen=True)
class _Bound:
    """The bound as it is reported.

    Attributes:
        psi: Upper bound on Ψ; NaN if there is none.
        kind: ``proven``, ``numerical`` or ``none``.
        tolerance: See ``PlanQuality.bound_tolerance``.
        rounded: See ``PlanQuality.rounded_efficiency``.
        text: Sentences for the message.
    """

    psi: float = float("nan")
    kind: str = "none"
    tolerance: float = float("nan")
    rounded: float = float("nan")
    text: str = ""

    @property
    def known(self) -> bool:
        """Whether there is a bound."""
        return self.kind != "none"

    def above(self, floor: float) -> _Bound:
        """The bound on ρ0⁻² where ρ0² has a part ``floor`` [m²] that no measurement changes."""
        return replace(self, psi=1.0 / (1.0 / self.psi + floor)) if floor and self.psi > 0.0 else self


def _checked(bound: _Bound, psi: float) -> _Bound:
    """The bound, if the plan of value ``psi`` is not better than it by more than rounding."""
    if psi > (1.0 + ROUNDING) * bound.psi:
        return _Bound(text=" The plan is better than its bound, which must not be: no bound is given.")
    return replace(bound, psi=max(bound.psi, psi)) if bound.known else bound


def _bound(
    space: PlanSpace,
    target: Criterion,
    design: ApproximateDesign | None,
    proof: Proof | None,
    configurations: FloatArray,
    rounded: _Rounded,
) -> _Bound:
    """The bound on Ψ of the design, raised where the plan shows that its maximisation had missed something."""
    if design is None:
        return _Bound()
    psi, text = psi_of(space, target, configurations), ""
    proven = proof is not None and proof.holds
    if psi > (1.0 + ROUNDING) * design.bound and not proven:
        rng = np.random.default_rng(space.problem.search.seed)
        design = raised(_design_problem(space, target), design, configurations, rng)
        text = " The plan was better than its numerical bound, which was wrong and is now raised."
    missed = proof.tolerance if proof is not None and proven else design.missed
    if proof is not None:
        text += f" {proof.text}"
    if not proven:
        text += f" Further starts of the maximisation raised the bound by less than {100 * missed:.1g} %."
    power = 0.5 if space.problem.criterion in POSE_CRITERIA and not space.problem.compound else 1.0
    share = float("nan")
    if 0.0 < psi < UNEXPLAINED ** (1.0 / power) * design.bound:
        text += " The bound may divide visits among any number of configurations, which no plan can"
        best = max((psi_of(space, target, q) for q in rounded.plans), default=share)
        share = (best / design.bound) ** power
        where = f": its design has efficiency {share:.3f} when rounded to whole visits where it is"
        text += f"{where if np.isfinite(share) else ''}."
    return _Bound(design.bound, "proven" if proven else "numerical", missed, share, text)


def _terms(space: PlanSpace, inverse: FloatArray) -> tuple[PlannedTerm, ...]:
    """How large the terms of the error model are at the test poses, before and after the plan."""
    poses, robot = space.problem.test_pose_array, space.robot
    if not len(poses):
        return ()
    count, points = len(poses) * len(robot.targets), Poses(robot, poses)
    model = space.problem.model
    rows = space.model.columns(poses).reshape(-1, len(space.prior))
    first = len(robot.parameter_names)
    last = space.model.first if isinstance(space.model, ExtendedModel) else first
    places = {"placement": slice(0, first), "gravity": slice(first, last), "joint_functions": slice(last, None)}
    result = []
    for name, place in places.items():
        own, known = rows[:, place], space.prior[place, place]
        if not own.shape[1]:
            continue
        before, unknown = covariance(known)
        size = np.sqrt(np.sum((own @ before) * own) / count) if not unknown.size else np.nan
        std = np.sqrt(np.sum((own @ inverse[place, place]) * own) / count)
        result.append(PlannedTerm(name, float(size), float(std)))
    parts = model.visit_parts(points)
    for name, members in (("visits", ("repeatability", "shared")), ("points", ("instrument", "floor"))):
        square = sum(float(np.einsum("nii->", parts[m])) for m in members if m in parts)
        if square:
            result.append(PlannedTerm(name, float(np.sqrt(square / count)), float("nan")))
    return tuple(result)


def _rest_idle_joints(space: PlanSpace, configurations: FloatArray) -> FloatArray:
    """Joints that change no measurement stay where the first test pose, or mid-range, has them."""
    problem = space.problem
    if problem.candidates is not None:
        return configurations
    low, high = space.robot.joint_limits.T
    tests = problem.test_pose_array
    rest = tests[0] if len(tests) else (low + high) / 2
    q, other = np.random.default_rng(0).uniform(low, high, (2, 64, len(low)))
    points, information = space.robot.positions(q), space.model.at(q)
    rested = configurations.copy()
    for joint in range(len(low)):
        moved = q.copy()
        moved[:, joint] = other[:, joint]
        still = np.allclose(space.robot.positions(moved), points, rtol=0, atol=NO_LEVER)
        if still and np.allclose(space.model.at(moved), information, rtol=1e-9, atol=1e-9 * information.max()):
            rested[:, joint] = rest[joint]
    return rested if space.feasibility.mask(rested).all() else configurations


def _efficiency(name: str, psi: float, bound: float, value: float, value_bound: float) -> float:
    """At most 1: for accuracies the quotient of the two reported figures, else Ψ/Ψ*."""
    if name in POSE_CRITERIA:
        return value_bound / value if np.isfinite(value) else 0.0
    return psi / bound if bound > 0 else 0.0


def psi_of(space: PlanSpace, criterion: Criterion, configurations: FloatArray) -> float:
    """Ψ of a plan; 0 where it is blind to what the criterion needs."""
    matrix = space.model.totals(configurations, len(configurations))[0] + space.prior
    return _psi_of_matrix(space, criterion, matrix)


def _psi_of_matrix(space: PlanSpace, criterion: Criterion, matrix: FloatArray) -> float:
    """Ψ of an information matrix (p, p), which may be singular."""
    hidden = covariance(matrix)[1]
    return 0.0 if _blind(space, hidden) else criterion.exact(_regular(matrix, hidden))


def _blind(space: PlanSpace, hidden: FloatArray) -> bool:
    """Whether the criterion needs what the plan cannot see."""
    if space.problem.criterion in POSE_CRITERIA and space.blind.any():
        return True
    if not hidden.size:
        return False
    if space.problem.criterion not in POSE_CRITERIA or space.problem.compound:
        return True
    tests = space.test_jacobians
    return bool(np.abs(tests @ hidden).max() > FELT * np.abs(tests).max())


def _regular(matrix: FloatArray, hidden: FloatArray) -> FloatArray:
    """``matrix`` (p, p) made invertible where the plan is blind; criteria that need nothing there stay."""
    return matrix + float(np.trace(matrix)) * hidden @ hidden.T if hidden.size else matrix


def _parameter_deviations(space: PlanSpace, inverse: FloatArray, hidden: FloatArray) -> FloatArray:
    """(P,) standard deviations: infinite where this plan is blind, NaN where every plan is."""
    free = sorted(space.identifiability.free)
    count = len(free)
    unseen = (np.abs(hidden[:count]) > 1e-6).any(axis=1) if hidden.size else np.zeros(count, bool)
    std = np.full(count + len(space.identifiability.fixed), np.nan)
    std[free] = np.where(unseen, np.inf, np.sqrt(np.diag(inverse)[:count]))
    return std
