# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How good could any plan be? An upper bound on its value Ψ from the best approximate design.

Let an *approximate design* be a probability measure ξ in place of "m visits, each to one configuration, with r
measurements at each", with M(ξ) = M_0 + m Σ w_k I_r(q_k), I_r(q) being what a visit tells (see
``information``). By (B) of ``criteria``, for any M with gradient G and sensitivity d(q) = tr(G I_r(q)),

    Ψ(M*) ≤ tr(G M*) ≤ tr(G M_0) + m max_q d(q)          for every plan M* of m visits,                   (1)

whatever its configurations. That is the equivalence theorem; it is tight at the optimal measure. For eq. (14)
it reads ρ0² ≥ φ²/d_max with φ = tr(A M⁻¹) and d = tr(A M⁻¹ I M⁻¹).

The repetitions r are part of the bound, because an error σ_c of the configuration makes r measurements of one
visit tell less than r visits: I_r(q) ⪯ r I_1(q), with equality for σ_c = 0. A plan in which two of the m
configurations coincide counts as two visits, each with an error of its own. If σ_c belongs to the place, so that
both have the same error, they tell less, (Σ/2r + σ_c² I)⁻¹ ⪯ 2 (Σ/r + σ_c² I)⁻¹, and (1) holds all the more.

The measure improves by multiplicative updates w_k ← w_k (d_k / mean)^e in turn with adding maxima of d. The bound
is as good as the maximisation of d: by search it is "numerical". Then ``maximised`` goes on from further random
configurations until they raise the bound no more than a tolerance. If a plan M* is better than its bound, G
itself says which part of the work was at fault: Ψ(M*) ≤ tr(G M_0) + Σ d(q_i), so that d is larger at a
configuration of that plan than the maximum that was taken. ``raised`` maximises d again from there.

Among a finite number of candidates every d_j is computed, so that the bound is exact. If each of m candidates may
be chosen only once, (B) gives

    Ψ(M*) ≤ tr(G M_0) + Σ (the m largest d_j),                                                            (2)

at most the m·max d_j of (1); the measure that makes it tight has weights capped at 1/m. Most candidates get no
weight: the updates run over those that have some, and after every round all candidates are looked at again. One
round costs one product over the candidates.

*Whole numbers.* A measure may divide its m visits among any number of configurations; a plan cannot. For small m
this alone keeps the best plan below the bound. No bound that knows whole numbers is computed: ``rounded`` says
what the best whole-number plan at the configurations of the measure reaches.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.planning.criteria import Criterion, is_sharp, sharpened
from calib_planner.planning.extended import ExtendedModel, LinearisedExtension
from calib_planner.planning.feasibility import Feasibility, PlanWalls
from calib_planner.planning.information import Model
from calib_planner.planning.parallel import cut, results_of
from calib_planner.planning.search.descent import Descent, climb, descend
from calib_planner.planning.search.interior import descend_inside

SPREAD = 256
DRAWN_FIRST = 400
"""Random configurations that share the first measure: a good one has some of them near its own."""
GAP = 3e-3
"""Relative, of Ψ: how near the bound of a design its value is; half of it for ρ0."""
FIRST_FLOOR, LAST_FLOOR = 1e-2, 1e-4
"""Weight of a spread of random configurations in every measure, first and last. The optimum is often singular:
the spread makes M invertible and d smooth, and costs the bound about its weight times the price of a random
plan."""


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """What the approximate design is to be best for.

    Attributes:
        model: Information of one visit, with its repetitions.
        criterion: A concave criterion.
        prior: (p, p) M_0.
        visits: m.
        feasibility: Where measuring is possible.
        candidates: (C, joints) the only configurations there are, some of them feasible, or ``None`` for all
            within the limits.
        distinct: Whether every candidate may be chosen once only.
    """

    model: Model
    criterion: Criterion
    prior: FloatArray
    visits: int
    feasibility: Feasibility
    candidates: FloatArray | None = None
    distinct: bool = False


@dataclass(frozen=True, eq=False)
class ApproximateDesign:
    """The best approximate design known, and the bound that it gives.

    Attributes:
        value: Ψ of the design.
        bound: Smallest upper bound known on Ψ of any plan; numerical until proven.
        weights: (K,) weights of the configurations, summing to one.
        gradient: (p, p) G that gave the bound.
        support: (K, joints) its configurations [rad | m]; empty where the caller knows them.
        seen: The model whose sensitivity gave the bound: the problem's own, or that of (2) of ``extended``.
        ground: tr(G M_0), with what ``extended`` adds to M_0.
        missed: Relative rise of the bound below which the maximisation of d ended; 0 where every d is known.
    """

    value: float
    bound: float
    weights: FloatArray
    gradient: FloatArray
    support: FloatArray
    seen: Model | None = None
    ground: float = 0.0
    missed: float = 0.0


def approximate_design(
    problem: DesignProblem,
    start: FloatArray,
    rng: np.random.Generator,
    cancel: Callable[[], bool] = lambda: False,
    executor: Executor | None = None,
    *,
    rounds: int = 60,
    gap: float = GAP,
) -> ApproximateDesign:
    """Grow a discrete measure until the bound is within ``gap`` of its value.

    Args:
        problem: What the design is for.
        start: (K, joints) configurations to begin with, beside random ones [rad | m].
        rng: Of the random configurations.
        cancel: Called after every round; ``True`` ends the work with what there is.
        executor: Any ``concurrent.futures`` executor, for what is to be known of every candidate.
        rounds: Most rounds.
        gap: Relative.
    """
    if isinstance(problem.model, ExtendedModel):
        return _extended_design(problem, problem.model, start, rng, cancel, executor)
    if problem.candidates is None:
        return _grown(problem, *_first_measure(problem, start, rng), rng, cancel, rounds=rounds, gap=gap)
    q = problem.candidates[problem.feasibility.mask(problem.candidates)]
    rows = np.concatenate(results_of(executor, _whitened, [(problem.model, part) for part in cut(q)]))
    distinct = problem.visits if problem.distinct else None
    design = candidate_design(rows, problem.criterion, problem.prior, problem.visits, distinct, cancel)
    return replace(design, support=q, seen=problem.model)


def continued(
    problem: DesignProblem,
    design: ApproximateDesign,
    more: FloatArray,
    rng: np.random.Generator,
    cancel: Callable[[], bool] = lambda: False,
) -> ApproximateDesign:
    """The design grown on with the configurations ``more`` (K, joints), where d is larger than it had seen."""
    strong = design.weights > 1e-6
    support = np.concatenate([design.support[strong], more])
    weights = np.concatenate([design.weights[strong], np.full(len(more), 0.02)])
    everywhere = problem.model.at(problem.feasibility.sample(rng, SPREAD)).mean(axis=0)
    first = FIRST_FLOOR * FALL**4
    return _grown(problem, support, weights / weights.sum(), everywhere, rng, cancel, floor=first)


def _first_measure(
    problem: DesignProblem, start: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Configurations (K, joints), weights (K,) and the mean information everywhere (p, p)."""
    drawn = np.concatenate([start, problem.feasibility.sample(rng, DRAWN_FIRST)])
    unit = problem.model.at(drawn)
    everywhere = unit[len(start) :].mean(axis=0)
    ground = problem.prior + problem.visits * FIRST_FLOOR * everywhere
    equal: FloatArray = np.full(len(drawn), 1.0 / len(drawn))
    weights, _ = _reweighted(problem.criterion, problem.visits * unit, equal, ground, iterations=40, exponent=1.0)
    heaviest = np.argsort(-weights)[: max(40, len(ground))]
    heaviest = heaviest[weights[heaviest] > 1e-4]
    return drawn[heaviest], weights[heaviest] / weights[heaviest].sum(), everywhere


FALL = 0.5
"""Factor by which the floor falls from round to round."""
SHARPEST = 16.0
"""Factor of the exponent of non-smooth criteria at the lowest floor."""


def _grown(
    problem: DesignProblem,
    support: FloatArray,
    weights: FloatArray,
    everywhere: FloatArray,
    rng: np.random.Generator,
    cancel: Callable[[], bool],
    *,
    rounds: int = 60,
    gap: float = GAP,
    floor: float = FIRST_FLOOR,
) -> ApproximateDesign:
    model, visits, best = problem.model, problem.visits, None
    for step in range(rounds):
        criterion = sharpened(problem.criterion, min(2.0**step, SHARPEST))
        ground = problem.prior + visits * floor * everywhere
        unit = visits * (1.0 - floor) * model.at(support)
        weights, matrix = _reweighted(
            criterion, unit, weights, ground, iterations=100, exponent=_exponent(criterion), growth=1.1
        )
        gradient = criterion.supporting_gradient(matrix)
        known = ApproximateDesign(
            problem.criterion.exact(matrix),
            np.inf,
            weights,
            gradient,
            support,
            model,
            float(np.sum(gradient * problem.prior)),
        )
        peaks = maximise_sensitivity(problem, gradient, _probes(problem, gradient, support, weights, rng))
        best = _better(best, _with_top(problem, known, float(np.exp(-peaks.value.min()))))
        if best.value >= (1.0 - gap) * best.bound or cancel():
            break
        new = _apart(problem, peaks)
        strong = weights > 1e-6
        share = 0.02 if floor > LAST_FLOOR else 0.005
        support = np.concatenate([support[strong], new])
        weights = np.concatenate([weights[strong], np.full(len(new), share / len(new))])
        weights /= weights.sum()
        floor = max(FALL * floor, LAST_FLOOR)
    assert best is not None
    return best


def _exponent(criterion: Criterion) -> float:
    """First exponent of the updates: sharp criteria (worst case, smallest eigenvalue) overshoot with more."""
    return 0.5 if is_sharp(criterion) else 1.0


DISTINCT = 5e-3
"""Distance of two maxima that are taken as one, as a share of the joint ranges."""


def _apart(problem: DesignProblem, peaks: Descent) -> FloatArray:
    """(K, joints) the highest of ``peaks``, at least half the highest, each place once."""
    low, high = problem.model.robot.joint_limits.T
    order = np.argsort(peaks.value, kind="stable")
    x = peaks.x[order[peaks.value[order] <= peaks.value[order[0]] + np.log(2.0)]]
    distance = np.abs((x[:, None] - x[None]) / (high - low)).max(axis=2)
    return np.asarray(x[~np.triu(distance < DISTINCT, 1).any(axis=0)])


def _with_top(problem: DesignProblem, design: ApproximateDesign, top: float) -> ApproximateDesign:
    """The bound by (1) if d is nowhere above ``top``."""
    return replace(design, bound=max(design.ground + problem.visits * top, design.value))


def _better(best: ApproximateDesign | None, new: ApproximateDesign) -> ApproximateDesign:
    """The best measure and the best bound so far, which need not come from the same round."""
    if best is None:
        return new
    top, low = (new if new.value > best.value else best), (new if new.bound < best.bound else best)
    bound = max(low.bound, top.value)
    return replace(top, bound=bound, gradient=low.gradient, seen=low.seen, ground=low.ground)


# ── what a numerical bound may have missed ───────────────────────────────────────────────────────────────

MAY_MISS = 1e-4
"""Relative rise of the bound, half of it for ρ0, that justifies no further batch of starts: less than what the
measure leaves open."""
QUIET, MOST_BATCHES = 2, 8
"""Batches in succession that raise the bound by less than that before the maximisation ends; most of them."""
STARTS, DRAWN = 24, 2048
"""Starts in a batch: the highest of so many random configurations."""
CONSTRAINED_DRAWN = 512
"""Most random configurations with constraints: of eight constraints two configurations in a hundred keep all, so
that 512 of them cost 26 000 tries."""
EXTENDED_STARTS, EXTENDED_DRAWN = 12, 256
"""The same with a whole error model, whose evaluations take ten times as long."""


def maximised(
    problem: DesignProblem, design: ApproximateDesign, rng: np.random.Generator, cancel: Callable[[], bool]
) -> ApproximateDesign:
    """The bound from a thorough maximisation of d: batches of starts, until some of them raise it no more.

    Of many bounds the least may be the one whose maximisation ended too early. ``missed`` of the result is the
    tolerance that was reached, or the last rise where ``MOST_BATCHES`` or ``cancel`` ended the work.
    """
    if problem.candidates is not None:
        return design
    extended = isinstance(design.seen, ExtendedModel)
    starts, drawn = (EXTENDED_STARTS, EXTENDED_DRAWN) if extended else (STARTS, DRAWN)
    if problem.feasibility.constraints:
        drawn = min(drawn, CONSTRAINED_DRAWN)
    known, quiet, missed = design.support[np.argsort(-design.weights)[:starts]], 0, np.inf
    for _ in range(MOST_BATCHES):
        random = problem.feasibility.sample(rng, drawn)
        highest = np.argsort(-heights_of(design, random), kind="stable")[:starts]
        higher = _from(problem, design, np.concatenate([known, random[highest]]), rng)
        rise = higher.bound / design.bound - 1.0
        quiet = quiet + 1 if rise <= MAY_MISS else 0
        missed = max(rise, MAY_MISS)
        design, known = replace(higher, missed=missed), known[:0]
        if quiet == QUIET or cancel():
            break
    return design


def raised(
    problem: DesignProblem, design: ApproximateDesign, configurations: FloatArray, rng: np.random.Generator
) -> ApproximateDesign:
    """The bound once more, d being maximised from ``configurations`` (K, joints) of a plan that has beaten it.

    The result is above that plan, whatever the maximiser does: the heights at its configurations count too.
    """
    return _from(problem, design, configurations, rng)


def _from(
    problem: DesignProblem, design: ApproximateDesign, starts: FloatArray, rng: np.random.Generator
) -> ApproximateDesign:
    """The bound raised by maxima of d from ``starts`` (K, joints), at least by the heights of these."""
    assert design.seen is not None
    peaks = maximise_sensitivity(replace(problem, model=design.seen), design.gradient, starts)
    top = max(float(heights_of(design, starts).max()), float(np.exp(-peaks.value.min())))
    if problem.feasibility.masks:  # along an edge without a margin descents end too early
        best = peaks.x[np.argsort(peaks.value)[:STARTS]]
        top = max(top, climb(problem.feasibility, lambda q: heights_of(design, q), best, rng)[1].max())
    return replace(design, bound=max(design.bound, design.ground + problem.visits * top))


def heights_of(design: ApproximateDesign, q: FloatArray) -> FloatArray:
    """d(q) of the bound at ``q`` (N, joints): (N,)."""
    assert design.seen is not None
    return _heights(design.seen, design.gradient, q)


def _probes(
    problem: DesignProblem,
    gradient: FloatArray,
    support: FloatArray,
    weights: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Starts for the maximisation of d: the support, and the best of many random configurations."""
    known = support[np.argsort(-weights)[:10]]
    random = problem.feasibility.sample(rng, 512)
    height = _heights(problem.model, gradient, random)
    return np.concatenate([known, random[np.argsort(-height)[:14]]])


EDGE = (1e-2, 1e-4)
"""First and last pressure on the edges of what is allowed: the last one hides 1e-4 of d per active margin."""


def maximise_sensitivity(problem: DesignProblem, gradient: FloatArray, starts: FloatArray) -> Descent:
    """Local maxima of d(q) over the feasible configurations, as minima of −log d, from ``starts`` (N, joints)."""
    feasibility = problem.feasibility
    low, high = feasibility.limits.T

    def objective(q: FloatArray) -> tuple[FloatArray, FloatArray]:
        info = problem.model.linearised(q)
        d = np.einsum("nip,nip->n", info.jacobian @ gradient, info.weighted)
        d = np.maximum(d, 1e-300)
        return -np.log(d), info.gradient(-gradient / d[:, None, None])

    iterations, tolerance = (20, 1e-3) if isinstance(problem.model, ExtendedModel) else (40, 1e-4)
    if not feasibility.constraints:
        return descend(objective, starts, low, high, iterations=iterations, tolerance=tolerance)
    return descend_inside(
        objective, PlanWalls(feasibility, 1), starts, low, high, iterations=12, tolerance=1e-3, pressures=EDGE
    )


def _normalised(w: FloatArray) -> FloatArray:
    return np.asarray(w / w.sum())


def _reweighted(
    criterion: Criterion,
    unit: FloatArray,
    w: FloatArray,
    ground: FloatArray,
    *,
    iterations: int,
    exponent: float,
    growth: float = 1.0,
    normalised: Callable[[FloatArray], FloatArray] = _normalised,
) -> tuple[FloatArray, FloatArray]:
    """Improve the weights w (K,) of ``unit`` (K, p, p) by multiplicative updates; returns them and M (p, p).

    Args:
        criterion: What is maximised.
        unit: (K, p, p) information of all measurements at one configuration of the support.
        w: (K,) weights to begin with.
        ground: (p, p) information that is there without them.
        iterations: Most updates.
        exponent: e of the first update; halved whenever the value falls.
        growth: Factor by which e recovers after every success, up to its first value.
        normalised: Makes the weights sum to one.
    """
    flat = unit.reshape(len(unit), -1)
    matrix = (w @ flat).reshape(ground.shape) + ground
    psi, gradient = (part[0] for part in criterion.value_and_gradient(matrix[None]))
    first = exponent
    for _ in range(iterations):
        d = np.maximum(flat @ gradient.ravel(), 1e-300)
        trial = normalised(w * (d / (w @ d)) ** exponent)
        moved = (trial @ flat).reshape(ground.shape) + ground
        new_psi, new_gradient = (part[0] for part in criterion.value_and_gradient(moved[None]))
        if new_psi >= psi * (1.0 - 1e-12):
            w, matrix, psi, gradient = trial, moved, new_psi, new_gradient
            exponent = min(growth * exponent, first)
        elif exponent > 1e-3:
            exponent *= 0.5
        else:
            break
    return w, matrix


# ── with a whole error model ─────────────────────────────────────────────────────────────────────────────

ROUNDS, UPDATES = 6, 10
"""Most rounds, and updates of the weights in each. A round costs some matrices of the size of the support."""
LARGEST_SUPPORT = 60
"""Configurations that may have weight at the end of a round."""
CLOSE_ENOUGH = 1e-2
"""Relative gap at which the rounds end; ρ0 has half of it."""


def _heights(model: Model, gradient: FloatArray, q: FloatArray) -> FloatArray:
    """d(q) = tr(G I_1(q)) at ``q`` (N, joints): (N,)."""
    rows = model.whitened(q)
    return np.asarray(np.sum((rows @ gradient) * rows, axis=(1, 2)))


def _whitened(model: Model, q: FloatArray) -> FloatArray:
    """(N, 3·targets, p) rows of one visit to each of ``q`` (N, joints)."""
    return model.whitened(q)


def _extended_design(
    problem: DesignProblem,
    model: ExtendedModel,
    start: FloatArray,
    rng: np.random.Generator,
    cancel: Callable[[], bool],
    executor: Executor | None,
) -> ApproximateDesign:
    """The same as ``approximate_design`` with (2) of ``extended``: heights are those of the model seen from the
    design, and M₀ has Σ_l Θ_lᵀΘ_l beside it."""
    visits, feasibility = problem.visits, problem.feasibility
    candidates = problem.candidates
    if candidates is not None:
        candidates = candidates[feasibility.mask(candidates)]
        drawn = candidates[rng.permutation(len(candidates))]
    else:
        drawn = np.concatenate([start, feasibility.sample(rng, SPREAD)])
    every = model.linearised(drawn if candidates is None else candidates)
    everywhere = model.at(drawn[-SPREAD:]).mean(axis=0)
    support: FloatArray = drawn[:LARGEST_SUPPORT]
    weights: FloatArray = np.full(len(support), 1.0 / len(support))
    best: ApproximateDesign | None = None
    for step in range(ROUNDS):
        floor = max(FIRST_FLOOR * 0.5**step, LAST_FLOOR)
        ground = problem.prior + visits * floor * everywhere
        weights, matrix, seen, extra = _reweighted_together(
            problem.criterion, model.linearised(support), weights, visits * (1.0 - floor), ground
        )
        gradient = problem.criterion.supporting_gradient(matrix)
        known = ApproximateDesign(
            problem.criterion.exact(matrix),
            np.inf,
            weights,
            gradient,
            support,
            seen.model,
            float(np.sum(gradient * (problem.prior + extra))),
        )
        lifted = replace(problem, model=seen.model)
        if candidates is not None:
            where, jobs = candidates, [(seen.model, gradient, part) for part in cut(candidates)]
            if len(jobs) == 1:
                rows = every.as_seen_by(seen.model).whitened
                heights = np.sum((rows @ gradient) * rows, axis=(1, 2))
            else:
                heights = np.concatenate(results_of(executor, _heights, jobs))
        else:
            peaks = maximise_sensitivity(lifted, gradient, _probes(lifted, gradient, support, weights, rng))
            where, heights = peaks.x, np.exp(-peaks.value)
        top = np.mean(np.sort(heights)[-visits:]) if problem.distinct else heights.max()
        best = _better(best, _with_top(problem, known, float(top)))
        if best.value >= (1.0 - CLOSE_ENOUGH) * best.bound or cancel():
            break
        new = where[np.argsort(-heights, kind="stable")[:6]]
        strong = np.argsort(-weights)[: LARGEST_SUPPORT - len(new)]
        support = np.concatenate([support[strong], new])
        weights = np.concatenate([weights[strong], np.full(len(new), 0.02 / len(new))])
        weights /= weights.sum()
    assert best is not None
    if candidates is not None:
        shares = np.array([best.weights[(best.support == row).all(axis=1)].sum() for row in candidates])
        return replace(best, weights=shares / shares.sum(), support=candidates)
    return best


def _reweighted_together(
    criterion: Criterion, info: LinearisedExtension, w: FloatArray, mass: float, ground: FloatArray
) -> tuple[FloatArray, FloatArray, LinearisedExtension, FloatArray]:
    """Improve the weights w (K,) of the configurations of ``info``, which share what no coefficient holds.

    There are ``mass`` measurements in all, and M is ``ground`` (p, p) without them.

    Returns:
        The weights, M (p, p), the configurations in the model seen from there, and Σ_l Θ_lᵀΘ_l (p, p).
    """

    n, rows, p = info.jacobian.shape
    columns, every = info.stacked(n)[0], np.arange(n)
    own = info.as_seen_by(replace(info.model, coupled=False)).covariance(1)
    whitener = np.linalg.inv(np.linalg.cholesky(own))
    together = info.covariance(n)[0].reshape(n, rows, n, rows)
    together[every, :, every, :] -= own
    shared = together.reshape(n * rows, n * rows)

    def at(w: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        covariance = together.copy()
        covariance[every, :, every, :] += own / (mass * np.maximum(w, 1e-9))[:, None, None]
        solved = np.linalg.solve(covariance.reshape(shared.shape), columns)
        matrix = ground + columns.T @ solved
        psi, gradient = (part[0] for part in criterion.value_and_gradient(matrix[None]))
        seen = whitener @ (columns - shared @ solved).reshape(n, rows, p)
        heights = np.sum((seen.reshape(n * rows, p) @ gradient).reshape(seen.shape) * seen, axis=(1, 2))
        return float(psi), matrix, np.maximum(heights, 1e-300)

    psi, matrix, heights = at(w)
    exponent = 0.7
    for _ in range(UPDATES):
        trial = _normalised(w * (heights / (w @ heights)) ** exponent)
        moved = at(trial)
        if moved[0] >= psi * (1.0 - 1e-12):
            w, (psi, matrix, heights) = trial, moved
        else:
            exponent *= 0.5
    return w, matrix, *info.seen_from(mass * np.maximum(w, 1e-9))


# ── among candidates ─────────────────────────────────────────────────────────────────────────────────


def candidate_design(
    rows: FloatArray,
    criterion: Criterion,
    prior: FloatArray,
    visits: int,
    distinct: int | None,
    cancel: Callable[[], bool] = lambda: False,
    *,
    gap: float = 2e-3,
    rounds: int = 40,
) -> ApproximateDesign:
    """Improve a measure over candidates until its value is within ``gap`` of the bound, eq. (2).

    Args:
        rows: (C, k, p) W^½ J of one visit to each candidate.
        criterion: A concave criterion.
        prior: (p, p) M_0.
        visits: Visits in all.
        distinct: m when every candidate may be used once only, else ``None``.
        cancel: Called after every round; ``True`` ends the work with what there is.
        gap: Relative.
        rounds: Most rounds.
    """
    flat = rows.reshape(-1, rows.shape[2])
    cap = 1.0 / distinct if distinct else 1.0
    weights: FloatArray = np.full(len(rows), 1.0 / len(rows))
    nowhere = np.empty((0, 0))
    best: ApproximateDesign | None = None
    for step in range(rounds):
        active = np.flatnonzero(weights > 1e-4 * weights.max()) if step else np.arange(len(rows))
        own = rows[active]
        part, matrix = _reweighted(
            criterion,
            visits * (np.swapaxes(own, 1, 2) @ own),
            _capped(weights[active], cap),
            prior,
            iterations=30 if step else 12,
            exponent=1.0,
            normalised=lambda w: _capped(w, cap),
        )
        weights = np.zeros(len(rows))
        weights[active] = part
        gradient = criterion.supporting_gradient(matrix)
        height = ((flat @ gradient) * flat).sum(axis=1).reshape(len(rows), -1).sum(axis=1)
        top = np.sort(np.partition(height, len(height) - distinct)[-distinct:]) if distinct else height.max()
        ground = float(np.sum(gradient * prior))
        ceiling = ground + visits * float(np.mean(top))
        made = ApproximateDesign(criterion.exact(matrix), ceiling, weights, gradient, nowhere, None, ground)
        best = _better(best, made)
        if best.value >= (1.0 - gap) * best.bound or cancel():
            break
        promising = np.where(weights > 0, -np.inf, height)
        missing = np.argsort(-promising, kind="stable")[:8]
        share = np.zeros(len(rows))
        share[missing[promising[missing] >= np.min(top)]] = 1e-3 * cap
        weights = _capped(weights + share, cap)
    assert best is not None
    return replace(best, bound=max(best.bound, best.value))


def _capped(w: FloatArray, cap: float) -> FloatArray:
    """min(s·w, cap) with the s that makes the sum one; equal weights where the cap leaves no choice."""
    if len(w) * cap <= 1.0 + 1e-9:
        return np.full(len(w), 1.0 / len(w))
    w = np.maximum(w, 1e-15 * w.max())
    order = np.argsort(-w, kind="stable")
    falling = w[order]
    rest = np.cumsum(falling[::-1])[::-1]  # with the k largest at the cap, the others share 1 − k·cap
    scale = np.maximum(1.0 - cap * np.arange(len(w)), 0.0) / rest
    first = int(np.argmax(scale * falling <= cap * (1.0 + 1e-12)))
    capped = scale[first] * w
    capped[order[:first]] = cap
    return capped
