"""The best plan from a finite pool of candidates: greedy start, then exchange (Fedorov 1972), batched.

With M the information of the chosen rows and G = ∂Ψ/∂M, tr(G I_j) is the gain per unit weight of candidate j:
one matrix product ranks the whole pool. A pass takes the chosen row of least worth out and tries the best
candidates in its place exactly; it ends when no single exchange improves Ψ.

The determinant of a rank-3T change is exact and cheap: det(M + JᵀWJ) = det(M) det(I + W^½ J M⁻¹ Jᵀ W^½), so
for D the whole pool is tried exactly at every step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray, IntArray
from calib_planner.design.criteria import Criterion
from calib_planner.errors import InfeasibleError

SHORTLIST = 24
"""Candidates tried exactly in place of each row."""


@dataclass(frozen=True, eq=False)
class PoolProblem:
    """Choose ``size`` rows of a pool.

    Attributes:
        unit: (C, p, p) information of each candidate.
        criterion: Its worth is maximised.
        prior: (p, p) M_0.
        size: Number of rows.
        repeat: Whether a row may be chosen more than once.
        weights: (C,) relaxed weights to start from, or empty.
    """

    unit: FloatArray
    criterion: Criterion
    prior: FloatArray
    size: int
    repeat: bool
    weights: FloatArray


@dataclass(frozen=True, eq=False)
class PoolResult:
    """Chosen rows (size,), the log of their worth, exchanges tried."""

    rows: IntArray
    log_worth: float
    evaluations: int


def choose(
    problem: PoolProblem, rng: np.random.Generator, stop: Callable[[], bool] = lambda: False
) -> PoolResult:
    """Choose rows; the best of a rounded relaxed start and a random one, both exchanged to the end.

    Raises:
        InfeasibleError: The pool cannot identify the parameters, whichever rows are chosen.
    """
    flat = problem.unit.reshape(len(problem.unit), -1)
    full = (flat.sum(axis=0)).reshape(problem.prior.shape) + problem.prior
    scale = np.sqrt(np.maximum(np.diag(full), 1e-300))
    if np.linalg.eigvalsh(full / np.outer(scale, scale))[0] < 1e-12:
        raise InfeasibleError("candidates", "even all rows together do not identify the parameters")
    starts = [_greedy(problem, flat, _rounded(problem))]
    starts.append(_greedy(problem, flat, np.empty(0, np.int64)))
    best: PoolResult | None = None
    for rows in starts:
        result = _exchange(problem, flat, rows, stop)
        if best is None or result.log_worth > best.log_worth:
            best = result
        if stop():
            break
    assert best is not None
    return best


def _rounded(problem: PoolProblem) -> IntArray:
    """Rows whose relaxed weight asks for at least half a measurement, heaviest first."""
    if not len(problem.weights):
        return np.empty(0, np.int64)
    shares = problem.weights * problem.size
    counts = np.floor(shares + 0.5).astype(np.int64)
    if not problem.repeat:
        counts = np.minimum(counts, 1)
    order = np.argsort(-shares)
    return np.repeat(order, counts[order])[: problem.size]


def _greedy(problem: PoolProblem, flat: FloatArray, rows: IntArray) -> IntArray:
    """Fill up with the candidate of largest first-order gain, from a small multiple of the pool's mean."""
    chosen = list(rows)
    ground = problem.prior + 1e-3 * problem.size * flat.mean(axis=0).reshape(problem.prior.shape)
    matrix = ground + flat[chosen].sum(axis=0).reshape(ground.shape)
    while len(chosen) < problem.size:
        slope = problem.criterion.worth_and_slope(matrix[None])[1][0]
        gain = flat @ slope.ravel()
        if not problem.repeat:
            gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        matrix = matrix + problem.unit[chosen[-1]]
    return np.array(chosen, np.int64)


def _exchange(problem: PoolProblem, flat: FloatArray, rows: IntArray, stop: Callable[[], bool]) -> PoolResult:
    rows = rows.copy()
    shape = problem.prior.shape
    matrix = problem.prior + flat[rows].sum(axis=0).reshape(shape)
    worth = _worths(problem, matrix[None])[0]
    evaluations, improved = 1, True
    while improved and not stop():
        improved = False
        for position in range(problem.size):
            without = matrix - problem.unit[rows[position]]
            pool = _shortlist(problem, flat, matrix, rows)
            trial = _worths(problem, without + problem.unit[pool])
            evaluations += len(pool)
            best = int(np.argmax(trial))
            if trial[best] > worth * (1.0 + 1e-9):
                rows[position], worth = pool[best], float(trial[best])
                matrix = without + problem.unit[pool[best]]
                improved = True
    return PoolResult(rows, float(np.log(worth)) if worth > 0 else -np.inf, evaluations)


def _worths(problem: PoolProblem, matrices: FloatArray) -> FloatArray:
    diagonal = np.einsum("spp->sp", matrices)
    floor = 1e-13 * diagonal.mean(axis=1)[:, None, None] * np.eye(matrices.shape[-1])
    worth = problem.criterion.worth_and_slope(matrices + floor)[0]
    return np.where(np.isfinite(worth), worth, 0.0)


def _shortlist(problem: PoolProblem, flat: FloatArray, matrix: FloatArray, rows: IntArray) -> IntArray:
    slope = problem.criterion.worth_and_slope(matrix[None])[1][0]
    gain = flat @ slope.ravel()
    if not problem.repeat:
        gain[rows] = -np.inf
    count = min(SHORTLIST, int(np.isfinite(gain).sum()))
    return np.argpartition(-gain, count - 1)[:count] if count else rows[:1]
