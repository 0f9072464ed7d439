# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the model says of measurements that it has not seen: left-out residuals in closed form, (M4).

A *group* is all visits at one configuration: repetitions would tell each other what the model has to say. With
P of the linear problem (``likelihood``) and P_gg its block for group g, the residual of the group under an
estimate from all other visits, at the same scales, and its covariance are

    e_g = P_gg⁻¹ (P y)_g ,     cov e_g = P_gg⁻¹ .                                                           (M4)

So cross-validation by configurations costs nothing. The log score of a group is the log of the density that the
others gave its measurements, ½ log|P_gg| − ½ e_gᵀ P_gg e_g − ½ m log 2π; of two models the one with the larger
sum predicts better. A group that alone tells a parameter has no left-out residual: R_g^½ P_gg R_g^½ is singular
there.

How far the sum of the squared residuals may be from its expectation by chance: the residuals are D P y with
D = blockdiag(P_gg⁻¹), their covariance is D P D, and the variance of the sum is 2 tr((D P D)²). Its diagonal
blocks are the cov e_g; they alone make 2 Σ tr((cov e_g)²). The blocks beside them add a part of that which grows
with what the groups tell each other, from nothing to as much again: with the share s of R_g⁻¹ that is left in
P_gg the factor 2 − s is right to a fifth of the standard deviation (a test compares), and costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.identification.likelihood import Solution

ALONE = 1e-9
"""Share of its own precision below which nothing but the group itself says anything of a direction."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Left-out residuals of N visits in G groups.

    Attributes:
        residuals: (N, targets, 3) measured − predicted without the group [m]; 0 where not measured.
        covariance: (N, m, m) of these, rows x, y, z target by target [m²].
        groups: (N,) number of each visit's group.
        squares: (G,) e_gᵀ P_gg e_g; χ² with ``freedom`` degrees of freedom if the model is right.
        freedom: (G,) measured coordinates that other groups predict.
        scores: (G,) log score.
        spread: (G,) variance of the sum of the squared residuals of the usable points [m⁴].
        seen: (N, targets) points that were measured.
        doubted: (N, targets) points that lost their weight; their covariance says so.
    """

    residuals: FloatArray
    covariance: FloatArray
    groups: IntArray
    squares: FloatArray
    freedom: FloatArray
    scores: FloatArray
    spread: FloatArray
    seen: NDArray[np.bool_]
    doubted: NDArray[np.bool_]

    def numbered(self, groups: IntArray) -> LeftOut:
        """The same, every visit a group, with other numbers (N,) of the groups."""
        if np.array_equal(groups, self.groups):
            return self
        places = np.argsort(groups)
        by_group = {n: getattr(self, n)[self.groups[places]] for n in ("squares", "freedom", "scores", "spread")}
        return replace(self, groups=groups, **by_group)

    @property
    def score(self) -> float:
        """Sum of the log scores."""
        return float(self.scores.sum())

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(N, targets) points that were measured, are not doubted, and that the other groups predict."""
        return self.seen & _whole(self.groups, self.freedom, self.seen)[:, None] & ~self.doubted

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

    @property
    def excess(self) -> tuple[float, float]:
        """Achieved over predicted rms, and the standard deviation that it has by chance if the model is right.

        The scales are taken as known: they were estimated from these residuals, so that chance moves the ratio
        less than that.
        """
        count = int(self.usable.sum())
        if not count:
            return float("nan"), float("nan")
        expected = count * self.predicted_rms**2
        return self.rms / self.predicted_rms, 0.5 * float(np.sqrt(self.spread.sum())) / expected


def left_out(solution: Solution, groups: IntArray | None = None) -> LeftOut:
    """(M4).

    Args:
        solution: Of the linear problem.
        groups: (N,) number of each visit's group, from 0; default: every visit is one.
    """
    problem = solution.problem
    n, m = problem.y.shape
    groups = np.arange(n) if groups is None else groups
    count = int(groups.max(initial=-1)) + 1
    size = np.bincount(groups, minlength=count)
    known: LeftOut | None = solution.__dict__.get("one_by_one")
    if known is not None and count == n:
        return known.numbered(groups)
    alone = np.flatnonzero(size[groups] == 1)
    parts: list[tuple[IntArray, FloatArray, FloatArray, FloatArray]] = []
    parts.append((alone[:, None], problem.covariance[alone], solution.blocks[alone], solution.weighted[alone]))
    for group in np.flatnonzero(size > 1):
        visits = np.flatnonzero(groups == group)
        own = np.zeros((len(visits), m, len(visits), m))
        own[np.arange(len(visits)), :, np.arange(len(visits))] = problem.covariance[visits]
        k = m * len(visits)
        between = solution.between(visits)
        parts.append((visits[None], own.reshape(1, k, k), between[None], solution.weighted[visits].reshape(1, k)))
    seen, every = problem.seen.reshape(n, -1, 3)[:, :, 0] > 0, np.arange(m // 3)
    doubts = problem.parts.get("doubt", np.zeros_like(problem.covariance))
    doubted = np.trace(doubts.reshape(n, m // 3, 3, m // 3, 3)[:, every, :, every, :], axis1=2, axis2=3).T > 0
    result = LeftOut(
        np.zeros((n, m // 3, 3)),
        np.zeros((n, m, m)),
        groups,
        np.zeros(count),
        np.zeros(count),
        np.zeros(count),
        np.zeros(count),
        seen,
        doubted,
    )
    for part in parts:
        if len(part[0]):
            _put(result, problem.seen, *part)
    if count == n:
        # Asked for again and again: of every visit, and of every configuration where these are the same.
        solution.__dict__["one_by_one"] = result.numbered(np.arange(n))
    return result


def _put(
    result: LeftOut,
    coordinates: FloatArray,
    visits: IntArray,
    own: FloatArray,
    precision: FloatArray,
    weighted: FloatArray,
) -> None:
    """Puts into ``result`` what groups of equal size say.

    Args:
        result: Whose arrays are filled.
        coordinates: (N, m) 1 where measured.
        visits: (g, k) the visits of each group.
        own: (g, k·m, k·m) R_g.
        precision: (g, k·m, k·m) P_gg.
        weighted: (g, k·m) (P y)_g.
    """
    (g, k), at = visits.shape, result.groups[visits[:, 0]]
    lower = np.linalg.cholesky(own)
    upper = lower.transpose(0, 2, 1)
    shares, vectors = np.linalg.eigh(upper @ precision @ lower)
    known = shares > ALONE
    shares = np.where(known, shares, 1.0)
    turned = vectors.transpose(0, 2, 1) @ (upper @ weighted[:, :, None])
    turned = np.where(known, turned[:, :, 0], 0.0)
    residuals = (lower @ (vectors @ (turned / shares)[:, :, None]))[:, :, 0]
    half = lower @ (vectors / np.sqrt(shares)[:, None, :])
    covariance = half @ half.transpose(0, 2, 1)
    measured = coordinates[visits].reshape(g, -1)
    total, dark = measured.sum(axis=1), (~known).sum(axis=1)
    determinant = np.sum(np.log(shares), axis=1) - 2.0 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
    result.squares[at] = np.sum(turned**2 / shares, axis=1)
    result.freedom[at] = total - dark
    result.scores[at] = 0.5 * (determinant - result.squares[at] - total * np.log(2.0 * np.pi))
    result.residuals[visits] = (residuals * measured).reshape(g, k, -1, 3)
    blocks = covariance.reshape(g, k, -1, k, covariance.shape[1] // k)
    result.covariance[visits] = np.stack([blocks[:, i, :, i] for i in range(k)], axis=1)
    counts = np.repeat(~result.doubted[visits], 3, axis=2).reshape(g, -1) * measured
    counts = counts * (dark == 0)[:, None]
    # The coordinates that were not measured have the share one.
    share = (shares.sum(axis=1) - (shares.shape[1] - total)) / np.maximum(total, 1.0)
    square = np.sum((covariance * counts[:, :, None] * counts[:, None, :]) ** 2, axis=(1, 2))
    result.spread[at] = 2.0 * square * (2.0 - share)


def _whole(groups: IntArray, freedom: FloatArray, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) whether the others predict every measured coordinate of a visit's group."""
    total = np.bincount(groups, weights=3.0 * seen.sum(axis=1), minlength=len(freedom))
    return np.asarray(freedom == total)[groups]
