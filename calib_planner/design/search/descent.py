"""Many bounded descents at once: projected BFGS with all starts in one batch.

Each row of X is an independent minimisation over the same box. Coordinates that sit on a bound and would be
pushed through it are frozen for the step (Bertsekas' ε-active set); the others follow the quasi-Newton
direction, projected back onto the box along a backtracking Armijo search. Rows stop one by one; a row that
has stopped costs nothing more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_planner._arrays import FloatArray, IntArray

Objective = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Maps X (rows, D) to values (rows,) and gradients (rows, D)."""

Mend = Callable[[FloatArray, FloatArray], FloatArray]
"""Maps points before and after a step, (rows, D) each, to points after what is allowed of it."""

ARMIJO = 1e-4
HALVINGS = 12


@dataclass(frozen=True)
class Descent:
    """Where the descents ended.

    Attributes:
        x: (rows, D) final points, inside the box.
        value: (rows,) final values.
        iterations: Iterations done by the longest row.
        evaluations: Rows evaluated in all.
    """

    x: FloatArray
    value: FloatArray
    iterations: int
    evaluations: int


def descend(
    objective: Objective,
    start: FloatArray,
    low: FloatArray,
    high: FloatArray,
    *,
    iterations: int = 200,
    tolerance: float = 1e-7,
    first_step: float = 0.2,
    stop: Callable[[], bool] = lambda: False,
    mend: Mend = lambda old, new: new,
) -> Descent:
    """Minimise ``objective`` from every row of ``start`` within [low, high].

    Args:
        objective: Value and gradient of a batch of points.
        start: (rows, D).
        low: (D,) lower bounds.
        high: (D,) upper bounds.
        iterations: Most iterations of any row.
        tolerance: A row ends when a step lowers its value by less than this (twice in a row).
        first_step: Length of the first step [unit of x].
        stop: Asked before every iteration; ``True`` ends the work with what there is.
        mend: Takes the points before and after a step, (rows, D) each, to where it may lead.
    """
    x = np.clip(start, low, high)
    value, gradient = objective(x)
    rows, size = x.shape
    inverse = np.broadcast_to(np.eye(size), (rows, size, size)).copy()
    fresh = np.ones(rows, bool)
    idle = np.zeros(rows, int)
    live = np.flatnonzero(np.isfinite(value))
    evaluations, done = rows, 0
    while live.size and done < iterations and not stop():
        done += 1
        g = gradient[live]
        direction = _direction(x[live], g, inverse[live], low, high)
        norm = np.linalg.norm(direction, axis=1)
        scale = np.where(fresh[live], first_step / np.maximum(norm, 1e-300), 1.0)
        scale = np.minimum(scale, 2.0 / np.maximum(norm, 1e-300))
        new_x, new_value, new_gradient, used = _line_search(
            objective, x[live], value[live], g, direction, scale, low, high, mend
        )
        evaluations += used
        drop = value[live] - new_value
        moved = drop > 0
        step, change = new_x - x[live], new_gradient - g
        _update(inverse, fresh, live[moved], step[moved], change[moved])
        # A failed search restarts from steepest descent once before the row is given up.
        lost = live[~moved & ~fresh[live]]
        inverse[lost] = np.eye(size)
        over = ~moved & fresh[live]
        fresh[lost] = True
        x[live[moved]] = new_x[moved]
        gradient[live[moved]] = new_gradient[moved]
        value[live[moved]] = new_value[moved]
        idle[live] = np.where(moved & (drop > tolerance), 0, idle[live] + 1)
        live = live[~over & (idle[live] < 2)]
    return Descent(x, value, done, evaluations)


def _direction(
    x: FloatArray, g: FloatArray, inverse: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    margin = 1e-9
    held = ((x <= low + margin) & (g > 0)) | ((x >= high - margin) & (g < 0))
    free_g = np.where(held, 0.0, g)
    direction = -np.matmul(inverse, free_g[:, :, None])[:, :, 0]
    direction[held] = 0.0
    uphill = (direction * g).sum(axis=1) >= 0
    direction[uphill] = -free_g[uphill]
    return direction


def _line_search(
    objective: Objective,
    x: FloatArray,
    value: FloatArray,
    g: FloatArray,
    direction: FloatArray,
    scale: FloatArray,
    low: FloatArray,
    high: FloatArray,
    mend: Mend,
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    best_x, best_value, best_g = x.copy(), value.copy(), g.copy()
    open_rows = np.arange(len(x))
    used = 0
    for _ in range(HALVINGS):
        trial = np.clip(x[open_rows] + scale[open_rows, None] * direction[open_rows], low, high)
        trial = mend(x[open_rows], trial)
        f, df = objective(trial)
        used += len(open_rows)
        slope = (g[open_rows] * (trial - x[open_rows])).sum(axis=1)
        good = np.isfinite(f) & (f <= value[open_rows] + ARMIJO * slope) & (f < value[open_rows])
        hit = open_rows[good]
        best_x[hit], best_value[hit], best_g[hit] = trial[good], f[good], df[good]
        open_rows = open_rows[~good]
        if not open_rows.size:
            break
        scale[open_rows] *= 0.35
    return best_x, best_value, best_g, used


def _update(inverse: FloatArray, fresh: NDArray[np.bool_], rows: IntArray, s: FloatArray, y: FloatArray) -> None:
    """BFGS update of the inverse Hessians of ``rows``, scaled at first use, skipped where s·y ≤ 0."""
    sy = (s * y).sum(axis=1)
    good = sy > 1e-10 * np.linalg.norm(s, axis=1) * np.linalg.norm(y, axis=1)
    rows, s, y, sy = rows[good], s[good], y[good], sy[good]
    if not rows.size:
        return
    h = inverse[rows]
    first = fresh[rows]
    h[first] *= (sy[first] / (y[first] ** 2).sum(axis=1))[:, None, None]
    hy = np.matmul(h, y[:, :, None])[:, :, 0]
    rho = 1.0 / sy
    weight = rho * (1.0 + rho * (y * hy).sum(axis=1))
    cross = (rho[:, None] * hy)[:, :, None] * s[:, None, :]
    h -= cross
    h -= cross.transpose(0, 2, 1)
    h += (weight[:, None] * s)[:, :, None] * s[:, None, :]
    inverse[rows] = h
    fresh[rows] = False
