# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Local improvement of many plans at once inside the allowed set, along its edges where it ends there.

A row of X is a plan: the coordinates of ``size`` configurations, one after the other. Constraints say of every
configuration by how much it keeps them, its *margins* m_k(q) ≥ 0 (see ``feasibility``). Projected BFGS alone
(``descent``) would end where its direction points outside, although the plan could slide along the edge. So the
rows minimise, for a *pressure* µ that falls to next to nothing,

    φ(x) = f(x) − µ Σ_k log m_k(x) ,

whose minimum is at most µ times the number of active margins above the constrained one. With multipliers
λ_k ≈ µ / m_k and the normals a_k = ∂m_k/∂x, Newton's step of the conditions λ_k m_k = µ (primal-dual interior
point; Nocedal and Wright, Numerical Optimization, 2006, section 19.3) is

    (B + Σ_k (λ_k / m_k) a_k a_kᵀ) d = −∇f + Σ_k (µ / m_k) a_k ,   Δλ_k = µ/m_k − λ_k − (λ_k / m_k) a_kᵀd ,    (1)

B being the quasi-Newton matrix of f − Σ λ_k m_k. As m_k → 0 the second term on the left leaves d no component
along a_k: the step is projected on the tangent of the active margins. We keep H = B⁻¹, with which (1) is
(1 + H Σ …) d = H(…). The normals of a configuration are about its own joints only: the sum is block-diagonal.

Every configuration goes at most ``NEAREST`` of the way to its nearest edge by the linearised margins, whatever
the others do. What is infeasible all the same, because edges are curved, the ``Walls`` bring back; what
a constraint forbids without a margin they take back. So whatever comes out is feasible if the start was. Joint
limits are treated as in ``descent``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.planning.search.descent import ARMIJO, Descent, Objective, bound_coordinates, update

HALVINGS = 5
"""Trials of a step: all rows wait for the last one, and one that fails starts afresh from steepest descent."""
NEAREST = 0.95
"""Share of the way to the nearest edge that one step may go."""
FALL = 0.4
"""Factor by which the pressure falls at every step."""
CENTRAL = 100.0
"""Multipliers keep within this factor of µ / m: far from it, (1) is no model of φ."""
LEAST_MARGIN = 1e-9
"""Margins count as at least this, so that a start on an edge has a logarithm."""
STIFFEST = 1e10
"""Largest λ / m: beyond it (1) is singular to working precision, and a step keeps to the tangent long before."""


class Walls(Protocol):
    """The constraints on the configurations of a plan."""

    def margins(self, x: FloatArray) -> FloatArray:
        """(rows, D) → (rows, size, K)."""
        ...

    def step(
        self, old: FloatArray, new: FloatArray, margins: FloatArray, normals: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """What is feasible of steps from ``old``, which is, to ``new``, (rows, D) each, and the margins there;
        ``margins`` (rows, size, K) and ``normals`` (rows, size, K, joints) are those at ``old``."""
        ...

    def normals(self, x: FloatArray) -> FloatArray:
        """(rows, D) → (rows, size, K, joints) gradients of each configuration's margins in its own joints."""
        ...


def descend_inside(
    objective: Objective,
    walls: Walls,
    start: FloatArray,
    low: FloatArray,
    high: FloatArray,
    *,
    iterations: int = 200,
    tolerance: float = 1e-7,
    pressures: tuple[float, float] = (1e-2, 1e-6),
    first_step: float = 0.2,
    cancel: Callable[[], bool] = lambda: False,
) -> Descent:
    """Minimise ``objective`` from every row of ``start`` within [low, high] and the walls.

    Args:
        objective: Value and gradient of a batch of points.
        walls: What else the points have to keep.
        start: (rows, D), feasible.
        low: (D,) lower bounds.
        high: (D,) upper bounds.
        iterations: Most iterations of any row.
        tolerance: At the last pressure, a row ends when a step lowers φ by less than this (twice in a row).
        pressures: First and last µ [unit of the objective].
        first_step: Length of the first step [unit of x].
        cancel: Called before every iteration; ``True`` ends the work with what there is.
    """
    x = np.clip(start, low, high)
    rows, size = x.shape
    value, gradient = objective(x)
    margins = np.maximum(walls.margins(x), LEAST_MARGIN)
    normals = walls.normals(x)
    pressure = np.full(rows, pressures[0])
    push = pressure[:, None, None] / margins
    inverse = np.broadcast_to(np.eye(size), (rows, size, size)).copy()
    fresh, idle = np.ones(rows, bool), np.zeros(rows, int)
    live = np.flatnonzero(np.isfinite(value))
    evaluations, done = rows, 0
    while live.size and done < iterations and not cancel():
        done += 1
        mu, m, a, force = pressure[live], margins[live], normals[live], push[live]
        total = gradient[live] - _pull(mu[:, None, None] / m, a)
        direction = _direction(x[live], total, inverse[live], np.minimum(force / m, STIFFEST), a, low, high)
        along = _along(a, direction)
        reach = np.min(np.where(along < 0, NEAREST * m / np.maximum(-along, 1e-300), 1.0), axis=2, initial=1.0)
        norm = np.linalg.norm(direction, axis=1)
        scale = np.where(fresh[live], np.minimum(first_step / np.maximum(norm, 1e-300), 1.0), 1.0)
        scale = np.minimum(scale, 2.0 / np.maximum(norm, 1e-300))
        share = np.minimum(reach, scale[:, None])
        new_x, new_value, new_gradient, new_margins, drop, used = _line_search(
            objective, walls, x[live], value[live], gradient[live], m, a, mu, total, direction, share, low, high
        )
        evaluations += used
        moved = drop > 0
        hit = live[moved]
        new_margins = np.maximum(new_margins[moved], LEAST_MARGIN)
        new_normals = walls.normals(new_x[moved])
        # Multipliers follow (1) as far as the step went, and keep near µ / m.
        target = mu[moved, None, None] / new_margins
        dual = force[moved] + share[moved][:, :, None] * (
            mu[moved, None, None] / m[moved] - force[moved] - force[moved] / m[moved] * along[moved]
        )
        dual = np.clip(dual, target / CENTRAL, target * CENTRAL)
        change = new_gradient[moved] - gradient[hit] - _pull(dual, new_normals - a[moved])
        update(inverse, fresh, hit, new_x[moved] - x[hit], change)
        x[hit], value[hit], gradient[hit] = new_x[moved], new_value[moved], new_gradient[moved]
        margins[hit], normals[hit], push[hit] = new_margins, new_normals, dual
        # A failed search restarts from steepest descent once before the row is given up.
        lost = live[~moved & ~fresh[live]]
        inverse[lost] = np.eye(size)
        push[lost] = pressure[lost, None, None] / margins[lost]
        last = mu <= pressures[1]
        over = ~moved & fresh[live] & last
        fresh[lost] = True
        idle[live] = np.where((moved & (drop > tolerance)) | ~last, 0, idle[live] + 1)
        pressure[live] = np.maximum(mu * FALL, pressures[1])
        live = live[~over & (idle[live] < 2)]
    return Descent(x, value, evaluations)


def _pull(weights: FloatArray, normals: FloatArray) -> FloatArray:
    """Σ_k weights_k a_k: (rows, size, K), (rows, size, K, joints) → (rows, D)."""
    rows, size, _, joints = normals.shape
    return np.asarray((weights[:, :, None, :] @ normals).reshape(rows, size * joints))


def _along(normals: FloatArray, direction: FloatArray) -> FloatArray:
    """a_kᵀd: (rows, size, K)."""
    rows, size, _, joints = normals.shape
    return np.asarray((normals @ direction.reshape(rows, size, joints, 1))[..., 0])


def _direction(
    x: FloatArray,
    total: FloatArray,
    inverse: FloatArray,
    weights: FloatArray,
    normals: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """d of (1), for the gradient ``total`` (rows, D) of φ and ``weights`` (rows, size, K) λ/m."""
    rows, dimension = x.shape
    size, joints = normals.shape[1], normals.shape[3]
    bound = bound_coordinates(x, total, low, high)
    free = np.where(bound, 0.0, total)
    h = np.where(bound[:, :, None] | bound[:, None, :], 0.0, inverse)
    curvature = np.swapaxes(normals, 2, 3) @ (weights[..., None] * normals)
    left = (h.reshape(rows, dimension, size, 1, joints) @ curvature[:, None]).reshape(rows, dimension, dimension)
    left += np.eye(dimension)
    direction = -np.linalg.solve(left, h @ free[:, :, None])[:, :, 0]
    uphill = (direction * total).sum(axis=1) >= 0
    direction[uphill] = -free[uphill]
    return np.asarray(direction)


def _line_search(
    objective: Objective,
    walls: Walls,
    x: FloatArray,
    value: FloatArray,
    gradient: FloatArray,
    margins: FloatArray,
    normals: FloatArray,
    pressure: FloatArray,
    total: FloatArray,
    direction: FloatArray,
    share: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, int]:
    """Backtracking on φ; ``share`` (rows, size) of the direction is tried first for each configuration.

    Returns:
        x, f, ∇f and margins behind the step, by how much φ fell (rows,), and rows evaluated.
    """
    rows, size = share.shape
    best_x, best_value, best_gradient = x.copy(), value.copy(), gradient.copy()
    best_margins, drop = margins.copy(), np.zeros(rows)
    open_rows, used, factor = np.arange(rows), 0, 1.0
    spread = (share[:, :, None] * direction.reshape(rows, size, -1)).reshape(rows, -1)
    logs = np.log(margins).sum(axis=(1, 2))
    for _ in range(HALVINGS):
        trial = np.clip(x[open_rows] + factor * spread[open_rows], low, high)
        trial, m = walls.step(x[open_rows], trial, margins[open_rows], normals[open_rows])
        f, df = objective(trial)
        used += len(open_rows)
        rise = np.log(np.maximum(m, LEAST_MARGIN)).sum(axis=(1, 2)) - logs[open_rows]
        fall = value[open_rows] - f + pressure[open_rows] * rise
        wanted = -ARMIJO * (total[open_rows] * (trial - x[open_rows])).sum(axis=1)
        good = np.isfinite(f) & (fall >= wanted) & (fall > 0)
        hit = open_rows[good]
        best_x[hit], best_value[hit], best_gradient[hit] = trial[good], f[good], df[good]
        best_margins[hit], drop[hit] = m[good], fall[good]
        open_rows = open_rows[~good]
        if not open_rows.size:
            break
        factor *= 0.25
    return best_x, best_value, best_gradient, best_margins, drop, used
