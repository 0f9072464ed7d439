# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Points and runs of visits that the others find impossible lose weight: their variance grows.

The judge of a point is its left-out residual (M4), which its own weight does not touch. A doubtful point gets a
variance D of its own beside R_i (so that it tells the scales nothing either), and with D taken off again

    d² = eᵀ (P_ii⁻¹ − D)⁻¹ e     (χ² of its coordinates, if the model is right).

*Student*: while it is not known who is wrong, every point counts as under a Student t with few degrees of freedom
ν, D = R (d² − 3)/(ν + 3), and the scales are estimated beside it; gross errors then neither bend the fit nor
swell the scales. *Impossible*: in the end only points less probable than ``IMPOSSIBLE`` among that many stay
doubtful, with D so large that they count no more, and the rest counts in full.

A run of visits that are all shifted alike excuse each other. A common shift of the visits a … b is the columns G,
an identity for each of their points; with the linear problem's P its score statistic

    (GᵀPy)ᵀ (GᵀPG)⁻¹ GᵀPy      (χ² with 3 degrees of freedom if nothing is shifted)

is had for all runs at once from cumulative sums of the blocks of P.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.identification.left_out import left_out
from calib_planner.identification.likelihood import Solution

FREEDOM = 2.0
"""ν of the Student t while it is not known who is wrong."""
IMPOSSIBLE = 0.01
"""Probability that one among all points, or all runs, of a sound calibration is called impossible."""
FEW = 0.02
"""Share of impossible points up to which they are taken out one by one."""
SWOLLEN = 0.6
"""Median of d² over that of χ² below which gross errors have swollen the scales."""
OUT = 10.0
"""Variance of what is impossible, as a multiple of its squared left-out residual."""
LARGEST = 1e7
"""Most by which a doubtful point's variance exceeds that of a good one: the point has no weight left."""
FEWEST = 3
"""Visits of the shortest run."""


def many_are_wrong(solution: Solution, doubt: FloatArray) -> bool:
    """Whether more than a few points are impossible, or gross errors seem to have swollen the scales."""
    squares, seen, _ = squares_of_points(solution, doubt)
    far = squares[seen] > gate_of(int(seen.sum()))
    return bool(far.mean() > FEW or np.median(squares[seen]) < SWOLLEN * float(chdtri(3, 0.5)))


def student(solution: Solution, doubt: FloatArray) -> FloatArray:
    """D (N, targets) of every point by the Student t [m²], from the D in force."""
    squares, seen, own = squares_of_points(solution, doubt)
    return np.where(seen, own * np.clip((squares - 3.0) / (FREEDOM + 3.0), 0.0, LARGEST), 0.0)


def impossible(solution: Solution, doubt: FloatArray) -> FloatArray:
    """D (N, targets) of impossible points [m²], 0 for all others."""
    squares, seen, own = squares_of_points(solution, doubt)
    gate = gate_of(int(seen.sum()))
    length = np.sum(left_out(solution).residuals ** 2, axis=2)
    return np.where(seen & (squares > gate), np.minimum(OUT * length, LARGEST * own), 0.0)


def gate_of(points: int) -> float:
    """d² beyond which one of so many points is impossible."""
    return float(chdtri(3, IMPOSSIBLE / max(points, 1)))


def part_of(doubt: FloatArray) -> FloatArray:
    """D (N, targets) as a part of R_i: (N, 3·targets, 3·targets)."""
    return np.repeat(doubt, 3, axis=1)[:, :, None] * np.eye(3 * doubt.shape[1])


def shifted_run(solution: Solution) -> IntArray | None:
    """Numbers of the visits of the most impossible run, the smaller part of all; ``None``: there is none."""
    seen = solution.problem.seen
    n, m = seen.shape
    if n < 2 * FEWEST:
        return None
    shift = np.tile(np.eye(3), (m // 3, 1))
    columns = (seen[:, :, None] * shift).reshape(n * m, 3)
    spread = np.zeros((n * m, n, 3))
    spread[np.arange(n * m), np.repeat(np.arange(n), m)] = columns
    blocks = spread.reshape(n * m, 3 * n)
    middle = (blocks.T @ solution.project(blocks)).reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    pull = (blocks.T @ solution.weighted.ravel()).reshape(n, 3)
    area = np.zeros((n + 1, n + 1, 3, 3))
    area[1:, 1:] = middle.cumsum(axis=0).cumsum(axis=1)
    total = np.vstack([np.zeros(3), pull.cumsum(axis=0)])
    first, last = np.triu_indices(n + 1, FEWEST)
    keep = last - first <= n - FEWEST
    first, last = first[keep], last[keep]
    inner = area[last, last] - area[first, last] - area[last, first] + area[first, first]
    right = total[last] - total[first]
    trace = np.trace(inner, axis1=1, axis2=2)
    inner = inner + 1e-9 * (trace[:, None, None] + 1e-300) * np.eye(3)
    statistic = np.einsum("wi,wi->w", right, np.linalg.solve(inner, right[:, :, None])[:, :, 0])
    best = int(np.argmax(statistic))
    if statistic[best] < float(chdtri(3, IMPOSSIBLE / len(first))):
        return None
    inside = np.arange(first[best], last[best])
    outside = np.setdiff1d(np.arange(n), inside)
    if len(inside) == len(outside):
        return inside if first[best] > 0 else outside  # of two halves the first is believed
    return inside if len(inside) < len(outside) else outside


def squares_of_points(solution: Solution, doubt: FloatArray) -> tuple[FloatArray, NDArray[np.bool_], FloatArray]:
    """(N, targets) d²; which points were measured; mean variance of a coordinate in R_i without D [m²]."""
    known = solution.__dict__.get("squares_of_points")
    if known is None or not np.array_equal(known[0], doubt):
        known = solution.__dict__["squares_of_points"] = (doubt, _squares_of_points(solution, doubt))
    return known[1]


def _squares_of_points(solution: Solution, doubt: FloatArray) -> tuple[FloatArray, NDArray[np.bool_], FloatArray]:
    left = left_out(solution)
    n, targets, _ = left.residuals.shape
    every = np.arange(targets)

    def own(matrix: FloatArray) -> FloatArray:
        blocks = matrix.reshape(n, targets, 3, targets, 3)[:, every, :, every, :]
        return np.asarray(np.moveaxis(blocks, 0, 1))

    variance = np.trace(own(solution.problem.covariance - part_of(doubt)), axis1=2, axis2=3) / 3.0
    # Rounding must not make what remains negative: a doubt may be a million times larger.
    floor = 1e-3 * variance[..., None, None] * np.eye(3)
    total = own(left.covariance - part_of(doubt)) + floor
    values, vectors = np.linalg.eigh(total)
    turned = np.einsum("ntij,nti->ntj", vectors, left.residuals)
    values = np.maximum(values, 0.5 * variance[..., None])
    return np.sum(turned**2 / values, axis=2), left.seen, variance
