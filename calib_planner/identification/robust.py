"""Gross errors: found before they are believed, and listed one by one.

A point whose residual is d standard deviations long (Mahalanobis, three coordinates) has d² ~ χ²₃ if nothing is
wrong with it. *Selection* starts from a fit in which far points count little, Cauchy weights w = 1/(1 + d²/c²s²)
iterated with the scale s from the median of d², and keeps what lies inside the gate. *The gate* then judges every
point by the fit to the others: the covariance of its residual is Σ − JCJᵀ where it took part and Σ + JCJᵀ where
it did not. Points go and come back until the selection stands still. The gate is χ²₃ at a probability of
``ALARM`` for the whole set: one set in a hundred loses a good point.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

from calib_planner.arrays import FloatArray
from calib_planner.identification.least_squares import Equations
from calib_planner.identification.registration import place, tip_poses
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot

ALARM = 0.01
"""Probability that a set without gross errors loses a point."""
CAUCHY = 2.385
"""c: 95 % efficient for normal errors."""
FAR = 0.05
"""What hardly any point sees is kept this close to the start while points are selected [m | rad]."""
BENT = 0.01
"""Points this far from where a step's Jacobian sent them, in standard deviations, need another Jacobian."""
SETTLED = 0.01
"""Weights that change by less do not move a point through the gate; those near it are judged again by the fit."""
LEAST_SCALE = 1e-8
"""Least variance that residuals without any freedom are taken to have, in units of the instrument's."""
MEDIAN = float(chdtri(3, 0.5))


@functools.lru_cache(maxsize=256)
def gate_of(points: int, freedom: float = np.inf) -> float:
    """Largest believable normalised residual of ``points`` points.

    Args:
        points: Their number.
        freedom: Degrees of freedom of the noise level, infinite where it is known.
    """
    probability = ALARM / max(points, 1)
    if np.isinf(freedom):
        return float(np.sqrt(chdtri(3, probability)))
    return float(np.sqrt(3.0 * fdtri(3, max(freedom, 1.0), 1.0 - probability)))


def normalised(residuals: FloatArray, covariance: FloatArray) -> FloatArray:
    """(…,) Mahalanobis lengths of residuals (…, 3) under (…, 3, 3); NaN where not measured."""
    seen = np.isfinite(residuals).all(axis=-1)
    result = np.full(seen.shape, np.nan)
    solved = np.linalg.solve(covariance[seen], residuals[seen][:, :, None])[:, :, 0]
    result[seen] = np.sqrt(np.maximum(np.sum(solved * residuals[seen], axis=-1), 0.0))
    return result


def robust_registration(robot: Robot, data: Measurements, *, base: bool, tool: bool) -> Robot:
    """``register`` with far points counting little."""
    if not (base or tool):
        return robot
    weights, poses = np.ones(data.seen.shape), tip_poses(robot, data.q, at_base=base)
    found = place(robot, data, poses, base=base, tool=tool)
    for _ in range(30):
        lengths = np.linalg.norm(data.p - found.positions(poses), axis=2)
        scale = float(np.nanmedian(lengths))
        if scale == 0.0:
            break
        new = np.where(data.seen, 1.0 / (1.0 + (lengths / scale) ** 2), 0.0)
        settled = np.nanmax(np.abs(new - weights)) < 1e-3
        weights = new
        found = place(robot, data, poses, base=base, tool=tool, weights=weights)
        if settled:
            break
    return found.of(robot, base=base, tool=tool)


def select(
    equations: Equations, kept: tuple[int, ...], start: FloatArray, *, scale_known: bool
) -> NDArray[np.bool_]:
    """Which points to believe; ``equations`` whitened point by point, all measured points in use.

    Args:
        equations: Of all measured points.
        kept: Parameters solved for.
        start: (P,) deviations to begin from.
        scale_known: The instrument's noise is known: the scale is at least one.
    """
    columns, deviations = list(kept), start
    prior = 0 if equations.prior is None else len(equations.prior.names)
    count = int(equations.use.sum())
    freedom = max(3 * count + prior - len(columns), 1) / (3 * count + prior)
    weights, scale = np.ones(count), 1.0
    residuals, jacobian = equations.linearise(deviations)
    # Where the points went since then; up to which distance they were looked at, and what they bent by.
    gone, straight, bend = np.zeros(len(residuals)), 0.0, 0.0
    for _ in range(50):
        squares = np.sum(residuals[: 3 * count].reshape(-1, 3) ** 2, axis=1)
        scale = float(np.median(squares)) / MEDIAN / freedom
        scale = max(scale, 1.0 if scale_known else LEAST_SCALE)
        new = 1.0 / (1.0 + squares / (3.0 * CAUCHY**2 * scale))
        # The scale tells which points are far, not what a prior is worth: else points that are far from the
        # prior's values would count little because of it, and stay far.
        root = np.sqrt(np.append(np.repeat(new, 3), np.ones(prior)))
        rows = np.vstack([jacobian[:, columns] * root[:, None], np.eye(len(columns)) / FAR])
        right = np.append(residuals * root, -(deviations - start)[columns] / FAR)
        length = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        step = np.linalg.lstsq(rows / length, right, rcond=1e-12)[0] / length
        deviations = deviations.copy()
        deviations[columns] += step
        settled = np.abs(new - weights).max() < SETTLED
        weights = new
        if settled:
            break
        change = jacobian[:, columns] @ step
        gone, residuals = gone + change, residuals - change
        distance = float(np.abs(gone).max(initial=0.0))
        most = BENT * np.sqrt(scale)  # less and less, as far points lose their weight
        if not (distance <= straight and bend < most):
            there = equations.residuals(deviations)
            bend = float(np.abs(there - residuals).max())
            residuals, straight = there, distance
            if not bend < most:
                residuals, jacobian = equations.linearise(deviations)
                gone, straight, bend = np.zeros(len(residuals)), 0.0, 0.0
    squares = np.sum(equations.residuals(deviations)[: 3 * count].reshape(-1, 3) ** 2, axis=1)
    use = equations.use.copy()
    use[equations.use] = squares <= scale * gate_of(count) ** 2
    return use


def spread(rows: FloatArray, matrix: FloatArray) -> FloatArray:
    """J C Jᵀ of each block of rows (N, targets, 3, P), the first product of all at once."""
    half = (rows.reshape(-1, rows.shape[3]) @ matrix).reshape(rows.shape)
    return np.asarray(half @ np.swapaxes(rows, 2, 3))
