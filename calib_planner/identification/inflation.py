"""Points, visits and runs of visits that the others find impossible lose weight: their variance is inflated.

The judge is the left-out residual (M4), which a point's own weight does not touch. With the covariance of the
prediction C = P_ii⁻¹ − R_i and the covariance R⁰ that the point would have uninflated,

    d² = eᵀ (C + R⁰)⁻¹ e     (χ² with as many degrees of freedom as coordinates, if the model is right).

Two rules follow one another. While it is not known who is wrong, every point gets the weight of a Student t,
inflation (ν + d²)/(ν + 3) with few degrees of freedom ν, and the scales are estimated beside it: gross errors then
neither bend the fit nor swell the scales. In the end only what is impossible, less probable than ``IMPOSSIBLE``
among that many, stays inflated, by d² over its degrees of freedom, and the rest counts in full. A visit more than
half of whose points are impossible is inflated as a whole. A run of visits, each of which the other visits of the
run excuse, is judged by leaving out all of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri

from calib_planner._arrays import FloatArray
from calib_planner.identification.left_out import LeftOut, left_out, left_out_together
from calib_planner.identification.likelihood import Solution

FREEDOM = 2.0
"""ν of the Student t while it is not known who is wrong."""
IMPOSSIBLE = 0.01
"""Probability that among all points of a sound calibration one is called impossible."""
SWOLLEN = 0.6
"""Median of d² over that of χ² below which gross errors have swollen the scales."""
RUN_RATIO = 4.0
"""Least d² per degree of freedom of a run that is wrong as a whole: smaller ones may be a term that is missing."""
RUNS = (2, 4, 8, 16)
"""Parts into which the visits are cut, in their order, to look for runs."""
LONGEST_RUN = 400
"""Most coordinates of a run that is looked at."""
LARGEST = 1e8
"""Largest inflation of a variance: beyond it the point is out."""


@dataclass(frozen=True, eq=False)
class Inflation:
    """Factors on variances, all at least one.

    Attributes:
        points: (N, targets) of each point.
        visits: (N,) of each visit as a whole.
    """

    points: FloatArray
    visits: FloatArray

    @staticmethod
    def none(seen: NDArray[np.bool_]) -> Inflation:
        """Everything counts in full."""
        return Inflation(np.ones(seen.shape), np.ones(len(seen)))

    @property
    def doubtful(self) -> NDArray[np.bool_]:
        """(N, targets) points that count less."""
        return (self.points > 1.0) | (self.visits > 1.0)[:, None]

    def parts(self, parts: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """Parts of R_i (N, m, m), inflated: those of the point by both, those of the visit by its own."""
        root = np.repeat(np.sqrt(self.points), 3, axis=1)
        own = root[:, :, None] * root[:, None, :]
        whole = self.visits[:, None, None]
        return {n: p * whole * own if n in ("instrument", "floor") else p * whole for n, p in parts.items()}


def student(solution: Solution, plain: FloatArray) -> Inflation:
    """Every point by the Student t; ``plain`` (N, m, m) R⁰."""
    squares = _point_squares(left_out(solution), solution, plain)
    points = np.clip((FREEDOM + squares) / (FREEDOM + 3.0), 1.0, LARGEST)
    return Inflation(points, np.ones(len(points)))


def impossible(solution: Solution, plain: FloatArray) -> Inflation:
    """Only what the others find impossible; ``plain`` (N, m, m) R⁰."""
    left = left_out(solution)
    seen, whole = left.seen, _visit_squares(left, solution, plain)
    count = max(int(seen.sum()), 1)
    far = seen & (_point_squares(left, solution, plain) > float(chdtri(3, IMPOSSIBLE / count)))
    points = np.where(far, np.clip(_point_squares(left, solution, plain) / 3.0, 1.0, LARGEST), 1.0)
    each = np.maximum(left.freedom, 1)
    bad = (chdtrc(each, whole) < IMPOSSIBLE / len(seen)) & (2 * far.sum(axis=1) > seen.sum(axis=1))
    visits = np.where(bad, np.clip(whole / each, 1.0, LARGEST), 1.0)
    points[bad] = 1.0
    return Inflation(points, np.maximum(visits, _runs(solution, seen)))


def suspicious(solution: Solution, plain: FloatArray) -> bool:
    """Whether some point is impossible, or gross errors seem to have swollen the scales."""
    left = left_out(solution)
    squares = _point_squares(left, solution, plain)[left.seen]
    gate = float(chdtri(3, IMPOSSIBLE / max(len(squares), 1)))
    return bool((squares > gate).any() or np.median(squares) < SWOLLEN * float(chdtri(3, 0.5)))


def _runs(solution: Solution, seen: NDArray[np.bool_]) -> FloatArray:
    """(N,) inflation of the visits of runs that are impossible as a whole."""
    count = len(seen)
    result = np.ones(count)
    cuts = [np.linspace(0, count, parts + 1).astype(int) for parts in RUNS if count // parts >= 4]
    runs = [np.arange(a, b) for cut in cuts for a, b in zip(cut[:-1], cut[1:], strict=True)]
    runs = [r for r in runs if 3 * int(seen[r].sum()) <= LONGEST_RUN]
    worst, ratio = None, RUN_RATIO
    for run in runs:
        squares, freedom = left_out_together(solution, run)
        if freedom and squares / freedom > ratio and chdtrc(freedom, squares) < IMPOSSIBLE / len(runs):
            worst, ratio = run, squares / freedom
    if worst is not None:
        result[worst] = min(ratio, LARGEST)
    return result


def _point_squares(left: LeftOut, solution: Solution, plain: FloatArray) -> FloatArray:
    """(N, targets) d² of every point by itself, 0 where not measured."""
    n, targets, _ = left.residuals.shape
    every = np.arange(targets)
    total = _plain_covariance(left, solution, plain).reshape(n, targets, 3, targets, 3)
    blocks = np.moveaxis(total[:, every, :, every, :], 0, 1)
    return np.einsum("nti,nti->nt", left.residuals, np.linalg.solve(blocks, left.residuals[..., None])[..., 0])


def _visit_squares(left: LeftOut, solution: Solution, plain: FloatArray) -> FloatArray:
    """(N,) d² of every visit."""
    flat = left.residuals.reshape(len(left.residuals), -1)
    total = _plain_covariance(left, solution, plain)
    return np.asarray(np.sum(flat * np.linalg.solve(total, flat[:, :, None])[:, :, 0], axis=1))


def _plain_covariance(left: LeftOut, solution: Solution, plain: FloatArray) -> FloatArray:
    """C + R⁰ (N, m, m); the difference to the inflated covariance is never negative."""
    missing = (1.0 - solution.problem.seen)[:, :, None] * np.eye(plain.shape[1])
    return left.covariance - solution.problem.covariance + plain + missing + 1e-9 * plain
