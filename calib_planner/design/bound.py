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

from calib_planner._arrays import FloatArray
from calib_planner.design.criteria import Criterion
from calib_planner.design.feasibility import Feasibility
from calib_planner.design.information import InformationModel
from calib_planner.design.pool_bound import relax_pool
from calib_planner.design.search.descent import Descent, descend
from calib_planner.design.search.wander import climb
from calib_planner.errors import InfeasibleError

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
