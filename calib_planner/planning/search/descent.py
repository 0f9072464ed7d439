# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Local improvement of many plans at once: by gradients in a box, and by random steps where there are
constraints.

``descend`` is projected BFGS with all starts in one batch. Each row of X is an independent minimisation over
the same box. Coordinates that sit on a bound and would be pushed through it do not move in that step
(Bertsekas' ε-active set); the others follow the quasi-Newton direction, projected back onto the box along a
backtracking Armijo search. Rows end one by one; a row that has ended costs nothing more.

A descent that may not leave the allowed set ends where its direction points outside, although it could slide
along the edge. In ``wander`` and ``climb`` every configuration gets trial steps of many lengths, in all joints
or in one or two; the infeasible ones are dropped, the best of the others is taken if it improves the value.
Inside, that is slower than gradients, but it needs nothing of the constraints except yes or no.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.planning.criteria import Criterion, log_values, ridged
from calib_planner.planning.feasibility import Feasibility
from calib_planner.planning.information import InformationModel

try:
    from calib_planner.planning._kernel import turn as _turn
except ImportError:  # not built, or an older one: NumPy does the same, more slowly
    _turn = None

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
        evaluations: Rows evaluated in all.
    """

    x: FloatArray
    value: FloatArray
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
    cancel: Callable[[], bool] = lambda: False,
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
        cancel: Called before every iteration; ``True`` ends the work with what there is.
        mend: Takes the points before and after a step, (rows, D) each, to where it may lead.
    """
    x = np.minimum(np.maximum(start, low), high)
    value, gradient = objective(x)
    rows, size = x.shape
    ended, ended_value = x.copy(), value.copy()
    evaluations, done = rows, 0
    # What follows holds the rows that have not ended, ``live`` being their numbers.
    live: IntArray = np.flatnonzero(np.isfinite(value))
    x, value, gradient = x[live], value[live], gradient[live]
    inverse = np.broadcast_to(np.eye(size), (len(live), size, size)).copy()
    fresh: NDArray[np.bool_] = np.ones(len(live), bool)
    idle: IntArray = np.zeros(len(live), np.int64)
    while live.size and done < iterations and not cancel():
        done += 1
        direction = _direction(x, gradient, inverse, low, high)
        norm = np.maximum(_lengths(direction), 1e-300)
        scale = np.minimum(np.where(fresh, first_step / norm, 1.0), 2.0 / norm)
        new_x, new_value, new_gradient, used = _line_search(
            objective, x, value, gradient, direction, scale, low, high, mend
        )
        evaluations += used
        drop = value - new_value
        moved = drop > 0
        # A failed search restarts from steepest descent once before the row is given up.
        lost, over = ~moved & ~fresh, ~moved & fresh
        update(inverse, fresh, np.arange(len(x)), new_x - x, new_gradient - gradient)
        if lost.any():
            inverse[lost], fresh[lost] = np.eye(size), True
        x, value, gradient = new_x, new_value, new_gradient
        idle = np.where(moved & (drop > tolerance), 0, idle + 1)
        go_on = ~over & (idle < 2)
        if not go_on.all():
            ended[live], ended_value[live] = x, value
            live, fresh, idle = live[go_on], fresh[go_on], idle[go_on]
            x, value, gradient, inverse = (part[go_on] for part in (x, value, gradient, inverse))
    ended[live], ended_value[live] = x, value
    return Descent(ended, ended_value, evaluations)


def bound_coordinates(x: FloatArray, g: FloatArray, low: FloatArray, high: FloatArray) -> NDArray[np.bool_]:
    """(rows, D) coordinates on a bound through which −g would push them."""
    margin = 1e-9
    return np.asarray(((x <= low + margin) & (g > 0)) | ((x >= high - margin) & (g < 0)))


def _direction(
    x: FloatArray, g: FloatArray, inverse: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    bound = bound_coordinates(x, g, low, high)
    steepest = np.where(bound, 0.0, -g)
    direction = np.where(bound, 0.0, np.matmul(inverse, steepest[:, :, None])[:, :, 0])
    uphill = (direction * g).sum(axis=1) >= 0
    return np.where(uphill[:, None], steepest, direction) if uphill.any() else direction


def _lengths(rows: FloatArray) -> FloatArray:
    """(rows,) Euclidean norms of (rows, D)."""
    return np.asarray(np.sqrt((rows * rows).sum(axis=1)))


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
    best_x, best_value, best_g = x, value, g
    open_rows: IntArray = np.arange(len(x))
    used = 0
    for step in range(HALVINGS):
        trial = mend(x, np.minimum(np.maximum(x + scale[:, None] * direction, low), high))
        f, df = objective(trial)
        used += len(f)
        decrease = (g * (trial - x)).sum(axis=1)
        good = np.isfinite(f) & (f <= value + ARMIJO * decrease) & (f < value)
        if step == 0:  # of all rows, and most often the last
            best_x, best_value = np.where(good[:, None], trial, x), np.where(good, f, value)
            best_g = np.where(good[:, None], df, g)
        else:
            hit = open_rows[good]
            best_x[hit], best_value[hit], best_g[hit] = trial[good], f[good], df[good]
        if good.all():
            break
        open_rows, x, value, g, direction, scale = (
            part[~good] for part in (open_rows, x, value, g, direction, scale)
        )
        scale *= 0.35
    return best_x, best_value, best_g, used


CACHED = 30_000
"""Numbers in the inverse Hessians that are updated together: they and what is added to them stay in the cache."""


def update(inverse: FloatArray, fresh: NDArray[np.bool_], rows: IntArray, s: FloatArray, y: FloatArray) -> None:
    """BFGS update of the inverse Hessians of ``rows``, scaled at first use, skipped where s·y ≤ 0."""
    sy = (s * y).sum(axis=1)
    good = sy > 1e-10 * _lengths(s) * _lengths(y)
    if not good.all():
        rows, s, y, sy = rows[good], s[good], y[good], sy[good]
    beside = max(CACHED // s.shape[1] ** 2, 1)
    for part in (slice(first, first + beside) for first in range(0, len(rows), beside)):
        inverse[rows[part]] = _updated(inverse[rows[part]], fresh[rows[part]], s[part], y[part], sy[part])
    fresh[rows] = False


def _updated(h: FloatArray, first: NDArray[np.bool_], s: FloatArray, y: FloatArray, sy: FloatArray) -> FloatArray:
    """``update`` of ``h`` (rows, D, D), in place."""
    if first.any():
        h[first] *= (sy[first] / (y[first] ** 2).sum(axis=1))[:, None, None]
    hy = np.matmul(h, y[:, :, None])[:, :, 0]
    rho = 1.0 / sy
    weight = rho * (1.0 + rho * (y * hy).sum(axis=1))
    (_turn or turn_numpy)(h, s, rho[:, None] * hy, weight[:, None] * s)
    return h


def turn_numpy(h: FloatArray, s: FloatArray, u: FloatArray, w: FloatArray) -> None:
    """H − u sᵀ − s uᵀ + w sᵀ of each row, in place, as the compiled kernel does; (rows, D, D) and (rows, D)."""
    cross = u[:, :, None] * s[:, None, :]
    h -= cross
    h -= cross.transpose(0, 2, 1)
    h += np.multiply(w[:, :, None], s[:, None, :], out=cross)


# ── random feasible steps ─────────────────────────────────────────────────────────────────────────────

TRIALS = 48
"""Trial steps of every configuration in a sweep."""
LONGEST, SHORTEST = 0.5, 5e-4
"""Lengths of steps, drawn evenly in the logarithm, as shares of the joint ranges."""


def feasible_steps(
    feasibility: Feasibility, q: FloatArray, rng: np.random.Generator, trials: int = TRIALS
) -> tuple[FloatArray, IntArray]:
    """Random feasible steps from every row of ``q`` (N, joints).

    Returns:
        (K, joints) configurations, K ≤ N·trials, and (K,) the row of ``q`` each one started from.
    """
    low, high = feasibility.limits.T
    n, joints = q.shape
    length = np.exp(rng.uniform(np.log(SHORTEST), np.log(LONGEST), (n, trials, 1)))
    step = length * rng.normal(size=(n, trials, joints))
    few = rng.random((n, trials, joints)) < 1.5 / joints
    step[:, ::2] *= few[:, ::2]
    moved = np.clip(q[:, None] + step * (high - low), low, high).reshape(-1, joints)
    good = np.flatnonzero(feasibility.mask(moved))
    return moved[good], np.asarray(good // trials, np.int64)


def wander(
    model: InformationModel,
    criterion: Criterion,
    prior: FloatArray,
    feasibility: Feasibility,
    start: FloatArray,
    rng: np.random.Generator,
    cancel: Callable[[], bool] = lambda: False,
    *,
    sweeps: int = 40,
    gain: float = 2e-4,
) -> tuple[FloatArray, int]:
    """Improve the plan ``start`` (size, joints) [rad | m].

    Ends when five sweeps gain less than ``gain`` in log value.

    Returns:
        (size, joints) the better plan, and the number of plans evaluated.
    """
    q = start.copy()
    unit = model.at(q)
    matrix = unit.sum(axis=0) + prior
    log_value = log_values(criterion, ridged(matrix[None]))[0]
    marks, evaluations = [log_value], 0
    for _ in range(sweeps):
        if cancel() or (len(marks) > 5 and marks[-1] - marks[-6] < gain):
            break
        trial, origin = feasible_steps(feasibility, q, rng)
        trial_unit = model.at(trial)
        for row in range(len(q)):
            mine = np.flatnonzero(origin == row)
            if not mine.size:
                continue
            psis = log_values(criterion, ridged(matrix - unit[row] + trial_unit[mine]))
            evaluations += len(mine)
            best = int(np.argmax(psis))
            if psis[best] > log_value:
                log_value, chosen = psis[best], mine[best]
                matrix = matrix - unit[row] + trial_unit[chosen]
                q[row], unit[row] = trial[chosen], trial_unit[chosen]
        matrix = unit.sum(axis=0) + prior
        marks.append(log_value)
    return q, evaluations


def climb(
    feasibility: Feasibility,
    height: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    rng: np.random.Generator,
    *,
    rounds: int = 30,
) -> tuple[FloatArray, FloatArray]:
    """Raise ``height`` (N, joints) → (N,) from every row of ``start`` by feasible steps; rows and heights."""
    q, best = start.copy(), height(start)
    for _ in range(rounds):
        trial, origin = feasible_steps(feasibility, q, rng, 24)
        if not len(trial):
            continue
        values = height(trial)
        order = np.argsort(values)  # the last write to a row is its highest
        higher = order[values[order] > best[origin[order]]]
        q[origin[higher]], best[origin[higher]] = trial[higher], values[higher]
    return q, best
