"""How good could any plan be? An upper bound on its worth from the relaxed problem.

Relax "n measurements, each at one configuration" to a probability measure ξ, with M(ξ) = M_0 + n Σ w_k I_1(q_k).
By (B) of ``criteria``, for any M with slope G and sensitivity d(q) = tr(G I_1(q)),

    Ψ(M*) ≤ tr(G M*) ≤ tr(G M_0) + n max_q d(q)          for every plan M* of n measurements,

whatever its configurations and repetitions: n measurements with σ_c count at most as n at different places.
That is the equivalence theorem; it is tight at the optimal measure. For eq. (14) it reads
ρ0² ≥ φ²/d_max with φ = tr(A M⁻¹) and d = tr(A M⁻¹ I M⁻¹).

The measure improves by alternating multiplicative updates w_k ← w_k √(d_k / mean) with adding maxima of d. The
bound is as good as the maximisation of d: by search it is "numerical".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.errors import InfeasibleError
from calib_planner.planning.criteria import Criterion
from calib_planner.planning.feasibility import Feasibility
from calib_planner.planning.information import InformationModel
from calib_planner.planning.search.descent import Descent, climb, descend

SPREAD = 256
FIRST_FLOOR, LAST_FLOOR = 1e-2, 1e-4
"""Weight of a spread of random configurations in every measure, first and last. The optimum is often singular:
it keeps M invertible and d smooth, and costs the bound about its weight times the price of a random
plan."""


@dataclass(frozen=True, eq=False)
class RelaxedProblem:
    """What the measure is to be best for.

    Attributes:
        model: Information of one measurement (repetitions = 1).
        criterion: A concave criterion.
        prior: (p, p) M_0.
        measurements: n.
        feasibility: Where measuring is possible.
        pool: (C, joints) the only configurations there are, or ``None`` for all within the limits.
        distinct: Number of rows of the pool if each may be chosen once only.
    """

    model: InformationModel
    criterion: Criterion
    prior: FloatArray
    measurements: int
    feasibility: Feasibility
    pool: FloatArray | None = None
    distinct: int | None = None


@dataclass(frozen=True, eq=False)
class RelaxedDesign:
    """The relaxed optimum, as far as found.

    Attributes:
        worth: Ψ of the best measure found.
        bound: Smallest upper bound found on Ψ of any plan; numerical until proven.
        support: (K, joints) configurations of the measure.
        weights: (K,) their weights.
        slope: (p, p) G that gave the bound.
    """

    worth: float
    bound: float
    support: FloatArray
    weights: FloatArray
    slope: FloatArray


def relaxed_design(
    problem: RelaxedProblem,
    start: FloatArray,
    rng: np.random.Generator,
    stop: Callable[[], bool] = lambda: False,
    *,
    rounds: int = 60,
    gap: float = 3e-3,
) -> RelaxedDesign:
    """Grow a discrete measure until the bound is within ``gap`` of its worth."""
    if problem.pool is not None:
        return _relaxed_pool(problem, problem.pool, stop)
    model, n = problem.model, problem.measurements
    everywhere = model.at(problem.feasibility.sample(rng, SPREAD)).mean(axis=0)
    support: FloatArray = np.concatenate([start, problem.feasibility.sample(rng, 16)])
    weights: FloatArray = np.full(len(support), 1.0 / len(support))
    best: RelaxedDesign | None = None
    for step in range(rounds):
        floor = max(FIRST_FLOOR * 0.7**step, LAST_FLOOR)
        ground = problem.prior + n * floor * everywhere
        unit = n * (1.0 - floor) * model.at(support)
        weights, matrix = _multiplicative(problem.criterion, unit, weights, ground)
        slope = problem.criterion.supporting_slope(matrix)
        peaks = maximise_sensitivity(problem, slope, _probes(problem, slope, support, weights, rng))
        worth = problem.criterion.exact(matrix)
        ceiling = float(np.sum(slope * problem.prior)) + n * float(np.exp(-peaks.value.min()))
        best = _better(best, RelaxedDesign(worth, max(ceiling, worth), support, weights, slope))
        if best.worth >= (1.0 - gap) * best.bound or stop():
            break
        new = peaks.x[np.argsort(peaks.value)[:6]]
        keep = weights > 1e-6
        share = 0.02 if floor > LAST_FLOOR else 0.005
        support = np.concatenate([support[keep], new])
        weights = np.concatenate([weights[keep], np.full(len(new), share / len(new))])
        weights /= weights.sum()
    assert best is not None
    return _checked(problem, best, rng) if problem.feasibility.constraints else best


def _checked(problem: RelaxedProblem, best: RelaxedDesign, rng: np.random.Generator) -> RelaxedDesign:
    """The bound once more from a thorough maximisation of d: along the edge of what is allowed, descents stop
    short, and of many bounds the least would be the one that stopped first."""

    def height(q: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("nab,ab->n", problem.model.at(q), best.slope))

    drawn = problem.feasibility.sample(rng, 4096)
    starts = np.concatenate([best.support, drawn[np.argsort(-height(drawn))[:32]]])
    inside = maximise_sensitivity(problem, best.slope, starts).x
    top = climb(problem.feasibility, height, inside, rng)[1].max()
    ceiling = float(np.sum(best.slope * problem.prior)) + problem.measurements * float(top)
    return replace(best, bound=max(ceiling, best.bound))


def _relaxed_pool(problem: RelaxedProblem, pool: FloatArray, stop: Callable[[], bool]) -> RelaxedDesign:
    """The same over a finite pool: every d is computed, so the bound is exact (see ``pool_bound``)."""
    q = pool[problem.feasibility.mask(pool)]
    if not len(q):
        raise InfeasibleError("candidates", "no row of the pool satisfies the constraints")
    rows = problem.model.whitened(q)
    found = relax_pool(rows, problem.criterion, problem.prior, problem.measurements, problem.distinct, stop)
    return RelaxedDesign(found.worth, found.bound, q, found.weights, found.slope)


def _better(best: RelaxedDesign | None, new: RelaxedDesign) -> RelaxedDesign:
    """The best measure and the best bound seen so far, which need not come from the same round."""
    if best is None:
        return new
    top = new if new.worth > best.worth else best
    low = new if new.bound < best.bound else best
    return RelaxedDesign(top.worth, max(low.bound, top.worth), top.support, top.weights, low.slope)


def _probes(
    problem: RelaxedProblem,
    slope: FloatArray,
    support: FloatArray,
    weights: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Starts for the maximisation of d: the support, and the best of many random configurations."""
    known = support[np.argsort(-weights)[:10]]
    random = problem.feasibility.sample(rng, 512)
    height = np.einsum("nab,ab->n", problem.model.at(random), slope)
    return np.concatenate([known, random[np.argsort(-height)[:14]]])


def _multiplicative(
    criterion: Criterion, unit: FloatArray, w: FloatArray, ground: FloatArray, iterations: int = 100
) -> tuple[FloatArray, FloatArray]:
    """Improve the weights of ``unit`` (K, p, p); returns them and M.

    The exponent ½ is monotone for traces; sharper criteria (worst case, smallest eigenvalue) overshoot with it,
    so it is halved whenever the worth falls.
    """
    flat = unit.reshape(len(unit), -1)
    matrix = (w @ flat).reshape(ground.shape) + ground
    worth, slope = (part[0] for part in criterion.worth_and_slope(matrix[None]))
    exponent = 0.5
    for _ in range(iterations):
        d = np.maximum(flat @ slope.ravel(), 1e-300)
        trial = w * (d / (w @ d)) ** exponent
        trial = trial / trial.sum()
        moved = (trial @ flat).reshape(ground.shape) + ground
        new_worth, new_slope = (part[0] for part in criterion.worth_and_slope(moved[None]))
        if new_worth >= worth * (1.0 - 1e-12):
            w, matrix, worth, slope = trial, moved, new_worth, new_slope
            exponent = min(1.1 * exponent, 0.5)
        elif exponent > 1e-3:
            exponent *= 0.5
        else:
            break
    return w, matrix


def maximise_sensitivity(problem: RelaxedProblem, slope: FloatArray, starts: FloatArray) -> Descent:
    """Local maxima of d(q) over the feasible configurations, as minima of −log d."""
    low, high = problem.model.robot.joint_limits.T
    constrained = bool(problem.feasibility.constraints)

    def objective(q: FloatArray) -> tuple[FloatArray, FloatArray]:
        info = problem.model.linearised(q)
        d = np.einsum("nip,nip->n", info.jacobian @ slope, info.weighted)
        d = np.maximum(d, 1e-300)
        value = np.where(problem.feasibility.mask(q), -np.log(d), np.inf) if constrained else -np.log(d)
        return value, info.gradient(-slope / d[:, None, None])

    return descend(objective, starts, low, high, iterations=40, tolerance=1e-4)


# ── The relaxed problem over a finite pool, where every sensitivity is computed: the bound is exact ─────────
# With distinct rows (no candidate more than once, r measurements at each) (B) of ``criteria`` gives
#
#     Ψ(M*) ≤ tr(G M_0) + r Σ (the m largest tr(G I_1(q_j))),
#
# at most the m·r·max d_j of ``bound``; the measure that makes it tight has weights capped at 1/m. Most
# candidates get no weight: the multiplicative updates run over those that have some, and after every round the
# whole pool is looked at again. Cost per round: one product over the pool, linear in its size.


@dataclass(frozen=True, eq=False)
class PoolMeasure:
    """Relaxed optimum over a pool.

    Attributes:
        worth: Ψ of the measure.
        bound: No plan has a larger Ψ.
        weights: (C,) summing to one.
        slope: (p, p) G that gave the bound.
    """

    worth: float
    bound: float
    weights: FloatArray
    slope: FloatArray


def relax_pool(
    rows: FloatArray,
    criterion: Criterion,
    prior: FloatArray,
    measurements: int,
    distinct: int | None,
    stop: Callable[[], bool] = lambda: False,
    *,
    gap: float = 2e-3,
    rounds: int = 40,
) -> PoolMeasure:
    """Improve a measure over the pool until its worth is within ``gap`` of the bound.

    Args:
        rows: (C, k, p) W^½ J of one measurement at each candidate.
        measurements: Measurements in all.
        distinct: m when every candidate may be used once only, else ``None``.
    """
    flat = rows.reshape(-1, rows.shape[2])
    cap = 1.0 / distinct if distinct else 1.0
    weights: FloatArray = np.full(len(rows), 1.0 / len(rows))
    best: PoolMeasure | None = None
    for step in range(rounds):
        active = np.flatnonzero(weights > 1e-4 * weights.max()) if step else np.arange(len(rows))
        part, matrix = _improve(criterion, measurements * _units(rows[active]), weights[active], prior, cap, step)
        weights = np.zeros(len(rows))
        weights[active] = part
        slope = criterion.supporting_slope(matrix)
        height = ((flat @ slope) * flat).sum(axis=1).reshape(len(rows), -1).sum(axis=1)
        top = np.sort(np.partition(height, len(height) - distinct)[-distinct:]) if distinct else height.max()
        ceiling = float(np.sum(slope * prior) + measurements * np.mean(top))
        found = PoolMeasure(criterion.exact(matrix), ceiling, weights, slope)
        best = found if best is None else _better_choice(best, found)
        if best.worth >= (1.0 - gap) * best.bound or stop():
            break
        promising = np.where(weights > 0, -np.inf, height)
        missing = np.argsort(-promising, kind="stable")[:8]
        share = np.zeros(len(rows))
        share[missing[promising[missing] > np.min(top)]] = 1e-3 * cap
        weights = _capped(weights + share, cap)
    assert best is not None
    return PoolMeasure(best.worth, max(best.bound, best.worth), best.weights, best.slope)


def _better_choice(best: PoolMeasure, new: PoolMeasure) -> PoolMeasure:
    top, low = (new if new.worth > best.worth else best), (new if new.bound < best.bound else best)
    return PoolMeasure(top.worth, low.bound, top.weights, low.slope)


def _units(rows: FloatArray) -> FloatArray:
    return np.swapaxes(rows, 1, 2) @ rows


def _improve(
    criterion: Criterion, unit: FloatArray, w: FloatArray, prior: FloatArray, cap: float, step: int
) -> tuple[FloatArray, FloatArray]:
    """Multiplicative updates w ← w √d, capped; the exponent is halved whenever the worth falls."""
    flat = unit.reshape(len(unit), -1)
    w = _capped(w, cap)
    matrix = (w @ flat).reshape(prior.shape) + prior
    worth, slope = (part[0] for part in criterion.worth_and_slope(matrix[None]))
    exponent = 1.0
    for _ in range(30 if step else 12):
        d = np.maximum(flat @ slope.ravel(), 1e-300)
        trial = _capped(w * (d / (w @ d)) ** exponent, cap)
        moved = (trial @ flat).reshape(prior.shape) + prior
        new_worth, new_slope = (part[0] for part in criterion.worth_and_slope(moved[None]))
        if new_worth >= worth * (1.0 - 1e-12):
            w, matrix, worth, slope = trial, moved, new_worth, new_slope
        elif exponent > 1e-3:
            exponent *= 0.5
        else:
            break
    return w, matrix


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
