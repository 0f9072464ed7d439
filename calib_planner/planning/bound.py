"""How good could any plan be? An upper bound on its value Ψ from the best approximate design.

Let an *approximate design* be a probability measure ξ in place of "n measurements, each at one configuration",
with M(ξ) = M_0 + n Σ w_k I_1(q_k). By (B) of ``criteria``, for any M with gradient G and sensitivity
d(q) = tr(G I_1(q)),

    Ψ(M*) ≤ tr(G M*) ≤ tr(G M_0) + n max_q d(q)          for every plan M* of n measurements,              (1)

whatever its configurations and repetitions: n measurements with σ_c count at most as n at different places.
That is the equivalence theorem; it is tight at the optimal measure. For eq. (14) it reads
ρ0² ≥ φ²/d_max with φ = tr(A M⁻¹) and d = tr(A M⁻¹ I M⁻¹).

The measure improves by multiplicative updates w_k ← w_k (d_k / mean)^e in turn with adding maxima of d. The bound
is as good as the maximisation of d: by search it is "numerical".

Among a finite number of candidates every d_j is computed, so that the bound is exact. If each of m candidates may
be chosen only once, with r measurements at it, (B) gives

    Ψ(M*) ≤ tr(G M_0) + r Σ (the m largest d_j),                                                           (2)

at most the n·max d_j of (1); the measure that makes it tight has weights capped at 1/m. Most candidates get no
weight: the updates run over those that have some, and after every round all candidates are looked at again. One
round costs one product over the candidates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.errors import InfeasibleError
from calib_planner.planning.criteria import Criterion
from calib_planner.planning.extended import ExtendedModel, LinearisedExtension
from calib_planner.planning.feasibility import Feasibility
from calib_planner.planning.information import Model
from calib_planner.planning.search.descent import Descent, climb, descend

SPREAD = 256
FIRST_FLOOR, LAST_FLOOR = 1e-2, 1e-4
"""Weight of a spread of random configurations in every measure, first and last. The optimum is often singular:
the spread makes M invertible and d smooth, and costs the bound about its weight times the price of a random
plan."""


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """What the approximate design is to be best for.

    Attributes:
        model: Information of one measurement (repetitions = 1).
        criterion: A concave criterion.
        prior: (p, p) M_0.
        measurements: n.
        feasibility: Where measuring is possible.
        candidates: (C, joints) the only configurations there are, or ``None`` for all within the limits.
        distinct: m if every candidate may be chosen once only, else ``None``.
    """

    model: Model
    criterion: Criterion
    prior: FloatArray
    measurements: int
    feasibility: Feasibility
    candidates: FloatArray | None = None
    distinct: int | None = None


@dataclass(frozen=True, eq=False)
class ApproximateDesign:
    """The best approximate design known, and the bound that it gives.

    Attributes:
        value: Ψ of the design.
        bound: Smallest upper bound known on Ψ of any plan; numerical until proven.
        weights: (K,) weights of the configurations, summing to one.
        gradient: (p, p) G that gave the bound.
        support: (K, joints) its configurations [rad | m]; empty where the caller knows them.
    """

    value: float
    bound: float
    weights: FloatArray
    gradient: FloatArray
    support: FloatArray


def approximate_design(
    problem: DesignProblem,
    start: FloatArray,
    rng: np.random.Generator,
    cancel: Callable[[], bool] = lambda: False,
    *,
    rounds: int = 60,
    gap: float = 3e-3,
) -> ApproximateDesign:
    """Grow a discrete measure until the bound is within ``gap`` of its value.

    Args:
        problem: What the design is for.
        start: (K, joints) configurations to begin with, beside random ones [rad | m].
        rng: Of the random configurations.
        cancel: Called after every round; ``True`` ends the work with what there is.
        rounds: Most rounds.
        gap: Relative.
    """
    model, n = problem.model, problem.measurements
    if isinstance(model, ExtendedModel):
        return _extended_design(problem, model, start, rng, cancel)
    if problem.candidates is not None:
        q = problem.candidates[problem.feasibility.mask(problem.candidates)]
        if not len(q):
            raise InfeasibleError("candidates", "no row of the candidates satisfies the constraints")
        rows = model.whitened(q)
        design = candidate_design(rows, problem.criterion, problem.prior, n, problem.distinct, cancel)
        return replace(design, support=q)
    everywhere = model.at(problem.feasibility.sample(rng, SPREAD)).mean(axis=0)
    support: FloatArray = np.concatenate([start, problem.feasibility.sample(rng, 16)])
    weights: FloatArray = np.full(len(support), 1.0 / len(support))
    best: ApproximateDesign | None = None
    for step in range(rounds):
        floor = max(FIRST_FLOOR * 0.7**step, LAST_FLOOR)
        ground = problem.prior + n * floor * everywhere
        unit = n * (1.0 - floor) * model.at(support)
        # Exponent ½ is monotone for traces; sharper criteria (worst case, smallest eigenvalue) overshoot with it.
        weights, matrix = _reweighted(
            problem.criterion, unit, weights, ground, iterations=100, exponent=0.5, growth=1.1
        )
        gradient = problem.criterion.supporting_gradient(matrix)
        peaks = maximise_sensitivity(problem, gradient, _probes(problem, gradient, support, weights, rng))
        value = problem.criterion.exact(matrix)
        ceiling = float(np.sum(gradient * problem.prior)) + n * float(np.exp(-peaks.value.min()))
        best = _better(best, ApproximateDesign(value, max(ceiling, value), weights, gradient, support))
        if best.value >= (1.0 - gap) * best.bound or cancel():
            break
        new = peaks.x[np.argsort(peaks.value)[:6]]
        strong = weights > 1e-6
        share = 0.02 if floor > LAST_FLOOR else 0.005
        support = np.concatenate([support[strong], new])
        weights = np.concatenate([weights[strong], np.full(len(new), share / len(new))])
        weights /= weights.sum()
    assert best is not None
    return _checked(problem, best, rng) if problem.feasibility.constraints else best


def _better(best: ApproximateDesign | None, new: ApproximateDesign) -> ApproximateDesign:
    """The best measure and the best bound so far, which need not come from the same round."""
    if best is None:
        return new
    top, low = (new if new.value > best.value else best), (new if new.bound < best.bound else best)
    return replace(top, bound=max(low.bound, top.value), gradient=low.gradient)


def _checked(problem: DesignProblem, best: ApproximateDesign, rng: np.random.Generator) -> ApproximateDesign:
    """The bound once more from a thorough maximisation of d: along the edge of what is allowed, descents end too
    early, and of many bounds the least would be the one that ended first."""

    def height(q: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("nab,ab->n", problem.model.at(q), best.gradient))

    drawn = problem.feasibility.sample(rng, 4096)
    starts = np.concatenate([best.support, drawn[np.argsort(-height(drawn))[:32]]])
    inside = maximise_sensitivity(problem, best.gradient, starts).x
    top = climb(problem.feasibility, height, inside, rng)[1].max()
    ceiling = float(np.sum(best.gradient * problem.prior)) + problem.measurements * float(top)
    return replace(best, bound=max(ceiling, best.bound))


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


def maximise_sensitivity(problem: DesignProblem, gradient: FloatArray, starts: FloatArray) -> Descent:
    """Local maxima of d(q) over the feasible configurations, as minima of −log d, from ``starts`` (N, joints)."""
    low, high = problem.model.robot.joint_limits.T
    constrained = bool(problem.feasibility.constraints)

    def objective(q: FloatArray) -> tuple[FloatArray, FloatArray]:
        info = problem.model.linearised(q)
        d = np.einsum("nip,nip->n", info.jacobian @ gradient, info.weighted)
        d = np.maximum(d, 1e-300)
        value = np.where(problem.feasibility.mask(q), -np.log(d), np.inf) if constrained else -np.log(d)
        return value, info.gradient(-gradient / d[:, None, None])

    if isinstance(problem.model, ExtendedModel):
        return descend(objective, starts, low, high, iterations=20, tolerance=1e-3)
    return descend(objective, starts, low, high, iterations=40, tolerance=1e-4)


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
    if isinstance(model, ExtendedModel):
        rows = model.whitened(q)
        return np.asarray(np.sum((rows @ gradient) * rows, axis=(1, 2)))
    return np.asarray(np.einsum("nab,ab->n", model.at(q), gradient))


def _extended_design(
    problem: DesignProblem,
    model: ExtendedModel,
    start: FloatArray,
    rng: np.random.Generator,
    cancel: Callable[[], bool],
) -> ApproximateDesign:
    """The same as ``approximate_design`` with (2) of ``extended``: heights are those of the model seen from the
    design, and M₀ has Σ_l Θ_lᵀΘ_l beside it."""
    n, feasibility = problem.measurements, problem.feasibility
    candidates = problem.candidates
    if candidates is not None:
        candidates = candidates[feasibility.mask(candidates)]
        if not len(candidates):
            raise InfeasibleError("candidates", "no row of the candidates satisfies the constraints")
        drawn = candidates[rng.permutation(len(candidates))]
    else:
        drawn = np.concatenate([start, feasibility.sample(rng, SPREAD)])
    everywhere = model.at(drawn[-SPREAD:]).mean(axis=0)
    support: FloatArray = drawn[:LARGEST_SUPPORT]
    weights: FloatArray = np.full(len(support), 1.0 / len(support))
    best: ApproximateDesign | None = None
    for step in range(ROUNDS):
        floor = max(FIRST_FLOOR * 0.5**step, LAST_FLOOR)
        ground = problem.prior + n * floor * everywhere
        mass = n * (1.0 - floor)
        weights, matrix, seen, extra = _reweighted_together(
            problem.criterion, model.linearised(support), weights, mass, ground
        )
        gradient = problem.criterion.supporting_gradient(matrix)
        lifted = replace(problem, model=seen.model)
        if candidates is not None:
            where, heights = candidates, _heights(seen.model, gradient, candidates)
        else:
            peaks = maximise_sensitivity(lifted, gradient, _probes(lifted, gradient, support, weights, rng))
            where, heights = peaks.x, np.exp(-peaks.value)
        value, distinct = problem.criterion.exact(matrix), problem.distinct
        top = float(np.mean(np.sort(heights)[-distinct:])) if distinct else float(heights.max())
        ceiling = float(np.sum(gradient * (problem.prior + extra))) + n * top
        best = _better(best, ApproximateDesign(value, max(ceiling, value), weights, gradient, support))
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

    def at(w: FloatArray) -> tuple[float, FloatArray, FloatArray, LinearisedExtension, FloatArray]:
        seen, extra = info.seen_from(mass * np.maximum(w, 1e-9))
        rows = seen.whitened
        matrix = ground + extra + mass * np.tensordot(rows * w[:, None, None], rows, axes=([0, 1], [0, 1]))
        psi, gradient = (part[0] for part in criterion.value_and_gradient(matrix[None]))
        heights = np.maximum(np.sum((rows @ gradient) * rows, axis=(1, 2)), 1e-300)
        return float(psi), matrix, heights, seen, extra

    psi, matrix, heights, seen, extra = at(w)
    exponent = 0.7
    for _ in range(UPDATES):
        trial = _normalised(w * (heights / (w @ heights)) ** exponent)
        moved = at(trial)
        if moved[0] >= psi * (1.0 - 1e-12):
            w, (psi, matrix, heights, seen, extra) = trial, moved
        else:
            exponent *= 0.5
    return w, matrix, seen, extra


# ── among candidates ─────────────────────────────────────────────────────────────────────────────────


def candidate_design(
    rows: FloatArray,
    criterion: Criterion,
    prior: FloatArray,
    measurements: int,
    distinct: int | None,
    cancel: Callable[[], bool] = lambda: False,
    *,
    gap: float = 2e-3,
    rounds: int = 40,
) -> ApproximateDesign:
    """Improve a measure over candidates until its value is within ``gap`` of the bound, eq. (2).

    Args:
        rows: (C, k, p) W^½ J of one measurement at each candidate.
        criterion: A concave criterion.
        prior: (p, p) M_0.
        measurements: Measurements in all.
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
            measurements * (np.swapaxes(own, 1, 2) @ own),
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
        ceiling = float(np.sum(gradient * prior) + measurements * np.mean(top))
        best = _better(best, ApproximateDesign(criterion.exact(matrix), ceiling, weights, gradient, nowhere))
        if best.value >= (1.0 - gap) * best.bound or cancel():
            break
        promising = np.where(weights > 0, -np.inf, height)
        missing = np.argsort(-promising, kind="stable")[:8]
        share = np.zeros(len(rows))
        share[missing[promising[missing] > np.min(top)]] = 1e-3 * cap
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
