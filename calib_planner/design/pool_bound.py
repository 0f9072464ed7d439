"""The relaxed problem over a finite pool, where every sensitivity is computed: the bound is exact.

With distinct rows (no candidate more than once, r measurements at each) (B) of ``criteria`` gives

    Ψ(M*) ≤ tr(G M_0) + r Σ (the m largest tr(G I_1(q_j))),

at most the m·r·max d_j of ``bound``; the measure that makes it tight has weights capped at 1/m. Most
candidates get no weight: the multiplicative updates run over those that have some, and after every round the
whole pool is looked at again. Cost per round: one product over the pool, linear in its size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.design.criteria import Criterion


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
        best = found if best is None else _better(best, found)
        if best.worth >= (1.0 - gap) * best.bound or stop():
            break
        promising = np.where(weights > 0, -np.inf, height)
        missing = np.argsort(-promising, kind="stable")[:8]
        share = np.zeros(len(rows))
        share[missing[promising[missing] > np.min(top)]] = 1e-3 * cap
        weights = _capped(weights + share, cap)
    assert best is not None
    return PoolMeasure(best.worth, max(best.bound, best.worth), best.weights, best.slope)


def _better(best: PoolMeasure, new: PoolMeasure) -> PoolMeasure:
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
