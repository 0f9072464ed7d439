"""How good could any plan be? A lower bound from the relaxed problem and the equivalence theorem.

Relax "m configurations, each counted once" to a probability measure ξ on configurations, with the
information per measurement M(ξ) = Σ w_k I(q_k), I(q) = J(q)ᵀJ(q). φ(M) = trace(A M⁻¹) is convex and
φ(cM) = φ(M)/c. For any nonsingular M, with the sensitivity

    d(q) = trace(A M⁻¹ I(q) M⁻¹),        d_max = max_q d(q),

convexity at c·M gives φ(M*) ≥ 2φ/c − d(M*)/c², at most d_max in place of d(M*); the best c = d_max/φ yields

    φ(M*) ≥ φ(M)² / d_max        for every measure, hence  m ρ0²/σ² ≥ φ² / d_max  for every plan of m
                                 measurements.

The measure improves by alternating multiplicative updates w ← w·√(d/φ) (monotone for linear criteria) with
adding maxima of d. The bound is as good as the maximisation of d: by search it is "numerical".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.design.search.descent import descend
from calib_planner.robot.chain import Robot

SPREAD = 256
FIRST_FLOOR, LAST_FLOOR = 1e-2, 1e-4
"""Weight of a spread of random configurations in every measure, first and last. The optimum is often singular:
it keeps M invertible and d smooth, and costs the bound about its weight times the price of a random
plan."""


@dataclass(frozen=True)
class RelaxedDesign:
    """The relaxed optimum, as far as found.

    Attributes:
        value: φ of the best measure found (per measurement, σ = 1): no plan needs to be expected below it.
        bound: φ²/d_max, the largest found: no plan is below it if d was maximised globally.
        support: (K, joints) configurations of the measure.
        weights: (K,) their weights.
    """

    value: float
    bound: float
    support: FloatArray
    weights: FloatArray


def relaxed_design(
    robot: Robot,
    weight: FloatArray,
    start: FloatArray,
    rng: np.random.Generator,
    stop: Callable[[], bool] = lambda: False,
    *,
    rounds: int = 60,
    gap: float = 3e-3,
) -> RelaxedDesign:
    """Solve the relaxed problem by growing a discrete measure.

    Args:
        weight: (P, P) matrix A of the criterion.
        start: (K, joints) configurations to begin with, e.g. those of good plans.
        gap: Ends when bound ≥ (1 − gap)·value.
    """
    low, high = robot.joint_limits.T
    everywhere = _unit_information(robot, rng.uniform(low, high, (SPREAD, len(low)))).mean(axis=0)
    support: FloatArray = start
    weights: FloatArray = np.full(len(start), 1.0 / len(start))
    best_value, best_bound, best = np.inf, 0.0, (support, weights)
    for step in range(rounds):
        floor = max(FIRST_FLOOR * 0.7**step, LAST_FLOOR)
        unit = _unit_information(robot, support)
        weights, value, slope = _multiplicative(unit, weight, weights, floor * everywhere, floor)
        probes = _probes(robot, slope, support[np.argsort(-weights)[:10]], rng)
        peaks = descend(_sensitivity(robot, slope), probes, low, high, iterations=40, tolerance=1e-4)
        largest = float(np.exp(-peaks.value.min()))
        if value < best_value:
            best_value, best = value, (support, weights)
        best_bound = max(best_bound, min(value * value / largest, value))
        if best_bound >= (1.0 - gap) * best_value or stop():
            break
        new = peaks.x[np.argsort(peaks.value)[:6]]
        keep = weights > 1e-6
        share = 0.02 if floor > LAST_FLOOR else 0.005
        support = np.concatenate([support[keep], new])
        weights = np.concatenate([weights[keep], np.full(len(new), share / len(new))])
        weights /= weights.sum()
    return RelaxedDesign(best_value, best_bound, *best)


def _probes(robot: Robot, slope: FloatArray, known: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Starts for the maximisation of d: the support, and the best of many random configurations."""
    low, high = robot.joint_limits.T
    random = rng.uniform(low, high, (512, len(low)))
    jacobian = robot.jacobian(random)
    height = np.einsum("nij,jk,nik->n", jacobian, slope, jacobian, optimize=True)
    return np.concatenate([known, random[np.argsort(-height)[:14]]])


def _unit_information(robot: Robot, q: FloatArray) -> FloatArray:
    """I(q) = J(q)ᵀJ(q), shape (K, P, P)."""
    jacobian = robot.jacobian(q)
    return np.einsum("kia,kib->kab", jacobian, jacobian)


def _multiplicative(
    unit: FloatArray,
    weight: FloatArray,
    w: FloatArray,
    ground: FloatArray,
    floor: float,
    iterations: int = 100,
) -> tuple[FloatArray, float, FloatArray]:
    """Improve the weights; returns them, φ, and B = M⁻¹AM⁻¹ (so that d(q) = trace(J B Jᵀ))."""
    flat = unit.reshape(len(unit), -1)
    size = unit.shape[1]
    for step in range(iterations + 1):
        inverse = np.linalg.inv((1.0 - floor) * (w @ flat).reshape(size, size) + ground)
        half = inverse @ weight
        slope, value = half @ inverse, float(np.trace(half))
        if step < iterations:
            d = np.maximum(flat @ slope.ravel(), 0.0)
            w = w * np.sqrt(d / value)
            w = w / w.sum()
    return w, value, (slope + slope.T) / 2


def _sensitivity(robot: Robot, slope: FloatArray):  # type: ignore[no-untyped-def]
    """−log d(q) and its gradient, for ``descend``."""
    targets, parameters = len(robot.targets), len(slope)
    zero = np.zeros(parameters)

    def objective(q: FloatArray) -> tuple[FloatArray, FloatArray]:
        lin = robot._linearise(q, zero)
        jacobian = lin.jacobian()
        pull = jacobian @ slope
        d = np.maximum(np.einsum("nij,nij->n", pull, jacobian), 1e-300)
        weights = (-2.0 * pull / d[:, None, None]).transpose(2, 1, 0)
        return -np.log(d), lin.pull_back(weights.reshape(parameters, targets, 3, len(q)))

    return objective
