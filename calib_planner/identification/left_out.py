"""What the model says of a visit that it has not seen: left-out residuals in closed form, (M4).

With P of the linear problem (``likelihood``), the residual of visit i under an estimate from all other visits, at
the same scales, and its covariance are

    e_i = P_ii⁻¹ (P y)_i ,     cov e_i = P_ii⁻¹ .                                                           (M4)

So cross-validation by visits costs nothing. The log score of a visit is the log of the density that the others
gave its measurement, ½ log|P_ii| − ½ e_iᵀ P_ii e_i − ½ m log 2π; of two models the one with the larger sum
predicts better. A visit that alone tells a parameter has no left-out residual: R_i^½ P_ii R_i^½ is singular
there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray
from calib_planner.identification.likelihood import Solution

ALONE = 1e-9
"""Share of its own precision below which nothing but the visit itself says anything of a direction."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Left-out residuals of every visit.

    Attributes:
        residuals: (N, targets, 3) measured − predicted without the visit [m]; 0 where not measured.
        covariance: (N, m, m) of these, rows x, y, z target by target [m²].
        squares: (N,) e_iᵀ P_ii e_i; χ² with ``freedom`` degrees of freedom if the model is right.
        freedom: (N,) measured coordinates that other visits predict.
        scores: (N,) log score.
        seen: (N, targets) points that were measured.
        doubted: (N, targets) points that lost their weight; their covariance says so.
    """

    residuals: FloatArray
    covariance: FloatArray
    squares: FloatArray
    freedom: FloatArray
    scores: FloatArray
    seen: NDArray[np.bool_]
    doubted: NDArray[np.bool_]

    @property
    def score(self) -> float:
        """Sum of the log scores."""
        return float(self.scores.sum())

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(N, targets) points that were measured, are not doubted, and that the other visits predict."""
        whole = self.freedom == 3 * self.seen.sum(axis=1)
        return self.seen & whole[:, None] & ~self.doubted

    @property
    def distances(self) -> FloatArray:
        """(points,) left-out distances of the usable points [m]."""
        return np.asarray(np.linalg.norm(self.residuals, axis=2)[self.usable])

    @property
    def rms(self) -> float:
        """Root mean square of the left-out distances [m]."""
        return float(np.sqrt(np.mean(self.distances**2))) if self.usable.any() else float("nan")

    @property
    def predicted_rms(self) -> float:
        """What ``rms`` should be by the model [m]."""
        variances = np.diagonal(self.covariance, axis1=1, axis2=2).reshape(*self.seen.shape, 3).sum(axis=2)
        return float(np.sqrt(np.mean(variances[self.usable]))) if self.usable.any() else float("nan")


def left_out(solution: Solution) -> LeftOut:
    """(M4) of every visit."""
    problem = solution.problem
    n, m = problem.y.shape
    lower = np.linalg.cholesky(problem.covariance)
    upper = lower.transpose(0, 2, 1)
    shares, vectors = np.linalg.eigh(upper @ solution.blocks @ lower)
    known = shares > ALONE
    shares = np.where(known, shares, 1.0)
    turned = vectors.transpose(0, 2, 1) @ (upper @ solution.weighted[:, :, None])
    turned = np.where(known, turned[:, :, 0], 0.0)
    residuals = (lower @ (vectors @ (turned / shares)[:, :, None]))[:, :, 0]
    half = lower @ (vectors / np.sqrt(shares)[:, None, :])
    squares = np.sum(turned**2 / shares, axis=1)
    coordinates = problem.seen.sum(axis=1)
    dark = m - known.sum(axis=1)
    determinant = np.sum(np.log(shares), axis=1) - 2.0 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
    scores = 0.5 * (determinant - squares - coordinates * np.log(2.0 * np.pi))
    seen, every = problem.seen.reshape(n, -1, 3)[:, :, 0] > 0, np.arange(m // 3)
    doubts = problem.parts.get("doubt", np.zeros_like(problem.covariance))
    doubted = np.trace(doubts.reshape(n, m // 3, 3, m // 3, 3)[:, every, :, every, :], axis1=2, axis2=3).T > 0
    return LeftOut(
        residuals.reshape(n, -1, 3) * seen[:, :, None],
        half @ half.transpose(0, 2, 1),
        squares,
        coordinates - dark,
        scores,
        seen,
        doubted,
    )
