"""The linear problem of one relinearisation: generalised least squares and the restricted likelihood.

With the flat columns F (base, targets, and placement where its prior is flat), all other columns B with coefficients
u ~ N(0, Λ), and V = blockdiag(R_i) + B Λ Bᵀ, the measured minus the predicted coordinates are

    y = F γ + B u + e ,      y ~ N(F γ, V),

    P = V⁻¹ − V⁻¹F S⁻¹ FᵀV⁻¹ ,   S = FᵀV⁻¹F ,   γ̂ = S⁻¹FᵀV⁻¹y ,   û = Λ Bᵀ P y ,                            (1)
    −2 log L = log|V| + log|S| + yᵀ P y      (Patterson & Thompson 1971, without its constants).                (2)

Its derivative by a scale θ is tr(P ∂V) − (Py)ᵀ ∂V (Py). R has blocks and Λ is diagonal, so that three things tell all
derivatives: the blocks P_ii, the vector Py, and for every column b_k both b_kᵀ P b_k and b_kᵀ P y.

Two forms give them. The *dense* one factorises V, of the size of the measured coordinates. The one *by
coefficients* factorises, with W = [F, B Λ^½] and D = diag(0, 1) (Woodbury),

    A = Wᵀ R⁻¹ W + D ,   P = R⁻¹ − R⁻¹ W A⁻¹ Wᵀ R⁻¹ ,   log|V| + log|S| = log|R| + log|A|,                       (3)

of the size of the coefficients: for thousands of points. Columns scaled by Λ^½ keep A regular when a term vanishes,
and R is regular because its scales have priors. Flat columns enter as an orthonormal basis of what they span, so
that redundant ones do no harm: β_flat = Z γ with the shortest solution. Coordinates that were not measured are rows
of zeros with variance one; they change nothing.

The scales are the maximum of L times their log-normal priors (``maximise``), by Newton steps with the average
information f_aᵀ P f_b, f_a = ∂_a V P y (Gilmour, Thompson & Cullis 1995), in the logarithms of the scales.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

from calib_planner._arrays import FloatArray
from calib_planner.error_model.model import ErrorModel
from calib_planner.robot.chain import Robot

RANK = 1e-7
"""Singular values of the flat columns, of unit length, below this share of the largest count as zero."""
LONGEST_STEP = 1.5
"""Most that the logarithm of a scale changes in one step."""
SETTLED = 0.02
"""A step that promises less than this of −2 log L ends the search."""


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """One relinearisation.

    Attributes:
        robot: At which it was linearised.
        model: Its scales are those of ``parts``.
        y: (N, m) measured − predicted + B u₀ [m], zero where not measured.
        columns: (N, m, coefficients) J⁺, zero rows where not measured.
        parts: Scale → (N, m, m) its part of R_i, zero rows and columns where not measured [m²].
        seen: (N, m) 1 where measured.
    """

    robot: Robot
    model: ErrorModel
    y: FloatArray
    columns: FloatArray
    parts: Mapping[str, FloatArray]
    seen: FloatArray

    @cached_property
    def flat(self) -> FloatArray:
        """Numbers of the coefficients without a prior."""
        return np.flatnonzero(np.isinf(self.model.variances(self.robot)))

    @cached_property
    def random(self) -> FloatArray:
        """Numbers of the coefficients with one."""
        return np.flatnonzero(np.isfinite(self.model.variances(self.robot)))

    @cached_property
    def basis(self) -> FloatArray:
        """Z (flat, rank): the flat coefficients are Z γ, and columns · Z are orthonormal."""
        rows = self.columns[:, :, self.flat].reshape(self.y.size, -1)
        if not rows.shape[1]:
            return np.zeros((0, 0))
        length = np.linalg.norm(rows, axis=0)
        length[length == 0.0] = np.inf
        triangle = np.linalg.qr(rows / length, mode="r")
        _, values, vectors = np.linalg.svd(triangle)
        keep = values > RANK * values[0] if len(values) and values[0] > 0 else values > 0
        return (vectors[: len(values)][keep] / values[keep][:, None]).T / length[:, None]

    @cached_property
    def flat_columns(self) -> FloatArray:
        """(N·m, rank) columns · Z."""
        return self.columns[:, :, self.flat].reshape(self.y.size, -1) @ self.basis

    @cached_property
    def random_columns(self) -> FloatArray:
        """(N·m, K) B."""
        return np.ascontiguousarray(self.columns[:, :, self.random].reshape(self.y.size, -1))

    @cached_property
    def covariance(self) -> FloatArray:
        """(N, m, m) R_i."""
        identity = np.eye(self.y.shape[1])
        return np.sum(list(self.parts.values()), axis=0) + (1.0 - self.seen)[:, :, None] * identity

    def at(self, model: ErrorModel) -> LinearProblem:
        """The same with other values of the scales."""
        new, old = model.values, self.model.values
        parts = {n: p * (new[n] / old[n]) ** 2 if n in new else p for n, p in self.parts.items()}
        result = replace(self, model=model, parts=parts)
        for name in ("flat", "random", "basis", "flat_columns", "random_columns"):
            result.__dict__[name] = getattr(self, name)
        return result


@dataclass(frozen=True, eq=False)
class Solution:
    """Generalised least squares at given scales.

    Attributes:
        problem: What was solved.
        value: −2 log L of (2) or (3), constants left out.
        coefficients: (coefficients,) γ̂ as Z γ̂, and û; flat ones are changes from where it was linearised.
        weighted: (N, m) P y [1/m].
        blocks: (N, m, m) P_ii [1/m²].
        squares: (K,) λ_k b_kᵀ P b_k.
        pulls: (K,) λ_k^½ b_kᵀ P y.
        factors: What ``project`` and ``posterior`` need.
    """

    problem: LinearProblem
    value: float
    coefficients: FloatArray
    weighted: FloatArray
    blocks: FloatArray
    squares: FloatArray
    pulls: FloatArray
    factors: tuple[FloatArray, ...]

    def project(self, vectors: FloatArray) -> FloatArray:
        """P · vectors, (N·m, n) → (N·m, n)."""
        if len(self.factors) == 2:
            return self.factors[0] @ vectors
        inverse, white, half = self.factors
        n, m = self.problem.y.shape
        turned = (inverse @ vectors.reshape(n, m, -1)).reshape(n * m, -1)
        turned = turned - white @ (half @ (half.T @ (white.T @ turned)))
        back = inverse.transpose(0, 2, 1) @ turned.reshape(n, m, -1)
        return back.reshape(n * m, -1)

    def blocks_of(self, rows: FloatArray) -> FloatArray:
        """P of some of the N·m coordinates: (len(rows), len(rows))."""
        if len(self.factors) == 2:
            return self.factors[0][np.ix_(rows, rows)]
        inverse, white, half = self.factors
        n, m = self.problem.y.shape
        visits = np.unique(rows // m)
        own = (visits[:, None] * m + np.arange(m)).ravel()
        share = white[own] @ half
        middle = (np.eye(len(own)) - share @ share.T).reshape(len(visits), m, -1)
        left = inverse[visits].transpose(0, 2, 1) @ middle
        back = inverse[visits].transpose(0, 2, 1) @ left.reshape(len(own), -1).T.reshape(len(visits), m, -1)
        at = np.searchsorted(own, rows)
        return back.reshape(len(own), -1).T[np.ix_(at, at)]

    def posterior(self) -> FloatArray:
        """(coefficients, coefficients) covariance C of β given the data, (M2); zero in directions no point shows."""
        problem = self.problem
        flat, random, basis = problem.flat, problem.random, problem.basis
        root = np.sqrt(problem.model.variances(problem.robot)[random])
        size, rank = len(flat) + len(random), basis.shape[1]
        if len(self.factors) == 2:
            projection, spread = self.factors
            scaled = problem.random_columns * root
            inner = spread @ problem.flat_columns.T @ self._weigh(scaled)
            small = np.block([[spread, -inner], [-inner.T, np.eye(len(random)) - scaled.T @ projection @ scaled]])
        else:
            small = self.factors[2] @ self.factors[2].T
        turn = np.zeros((size, rank + len(random)))
        turn[flat, :rank] = basis
        turn[random, rank + np.arange(len(random))] = root
        return turn @ small @ turn.T

    def _weigh(self, vectors: FloatArray) -> FloatArray:
        """V⁻¹ · vectors in the dense form: V is made anew, since only P was kept."""
        total, _ = _dense_covariance(self.problem)
        return np.asarray(cho_solve(cho_factor(total, lower=True), vectors))


def solve(problem: LinearProblem) -> Solution:
    """The cheaper of both forms."""
    coordinates, coefficients = problem.y.size, problem.columns.shape[2]
    return dense(problem) if coordinates <= coefficients else by_coefficients(problem)


def _dense_covariance(problem: LinearProblem) -> tuple[FloatArray, FloatArray]:
    """V (N·m, N·m) and B Λ^½ (N·m, K)."""
    n, m = problem.y.shape
    scaled = problem.random_columns * np.sqrt(problem.model.variances(problem.robot)[problem.random])
    total = scaled @ scaled.T
    every = np.arange(n)
    total.reshape(n, m, n, m)[every, :, every, :] += problem.covariance
    return total, scaled


def dense(problem: LinearProblem) -> Solution:
    """By factorising V, (1)."""
    n, m = problem.y.shape
    y, flat = problem.y.ravel(), problem.flat_columns
    total, scaled = _dense_covariance(problem)
    factor = np.linalg.cholesky(total)
    half, _ = dpotri(factor, lower=1)
    inverse = np.tril(half) + np.tril(half, -1).T
    weighted = inverse @ flat
    normal = flat.T @ weighted
    spread = _inverse(normal)
    projection = inverse - weighted @ spread @ weighted.T
    pulled = projection @ y
    value = 2.0 * np.log(np.diag(factor)).sum() + np.linalg.slogdet(normal)[1] + y @ pulled
    every = np.arange(n)
    squares = np.einsum("ak,ak->k", scaled, projection @ scaled)
    pulls = scaled.T @ pulled
    return Solution(
        problem,
        float(value),
        _coefficients(problem, spread @ (weighted.T @ y), pulls),
        pulled.reshape(n, m),
        projection.reshape(n, m, n, m)[every, :, every, :],
        squares,
        pulls,
        (projection, spread),
    )


def by_coefficients(problem: LinearProblem) -> Solution:
    """By factorising A, (3)."""
    n, m = problem.y.shape
    root = np.sqrt(problem.model.variances(problem.robot)[problem.random])
    rank = problem.flat_columns.shape[1]
    lower = np.linalg.cholesky(problem.covariance)
    inverse = np.linalg.inv(lower)
    columns = np.hstack([problem.flat_columns, problem.random_columns * root])
    white = (inverse @ columns.reshape(n, m, -1)).reshape(n * m, -1)
    right = (inverse @ problem.y[:, :, None]).ravel()
    normal = white.T @ white
    normal[np.diag_indices(len(normal))] += np.append(np.zeros(rank), np.ones(len(root)))
    scale = 1.0 / np.sqrt(np.diag(normal))
    factor = np.linalg.cholesky(normal * np.outer(scale, scale))
    # A⁻¹ = half halfᵀ
    half = scale[:, None] * np.linalg.inv(factor).T
    solution = half @ (half.T @ (white.T @ right))
    rest = right - white @ solution
    value = 2.0 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum()
    value += 2.0 * (np.log(np.diag(factor)) - np.log(scale)).sum() + right @ rest
    share = (white @ half).reshape(n, m, -1)
    transposed = inverse.transpose(0, 2, 1)
    blocks = transposed @ (np.eye(m) - share @ share.transpose(0, 2, 1)) @ inverse
    return Solution(
        problem,
        float(value),
        _coefficients(problem, solution[:rank], solution[rank:]),
        (transposed @ rest.reshape(n, m, 1))[:, :, 0],
        blocks,
        1.0 - np.sum(half[rank:] ** 2, axis=1),
        solution[rank:],
        (inverse, white, half),
    )


def _coefficients(problem: LinearProblem, flat: FloatArray, pulls: FloatArray) -> FloatArray:
    """β of γ̂ and Λ^-½ û."""
    result = np.zeros(problem.columns.shape[2])
    result[problem.flat] = problem.basis @ flat
    root = np.sqrt(problem.model.variances(problem.robot)[problem.random])
    result[problem.random] = root * pulls
    return result


def _inverse(matrix: FloatArray) -> FloatArray:
    """Of a positive definite matrix, scaled to unit diagonal first."""
    if not len(matrix):
        return matrix
    scale = 1.0 / np.sqrt(np.diag(matrix))
    half = np.linalg.inv(np.linalg.cholesky(matrix * np.outer(scale, scale))) * scale
    return np.asarray(half.T @ half)


# ── the scales ───────────────────────────────────────────────────────────────────────────────────────


def unknown_scales(model: ErrorModel, parts: Mapping[str, FloatArray], robot: Robot) -> tuple[str, ...]:
    """Scales that the data decide: not known, and with a part or a column here."""
    slopes = model.slopes(robot)
    return tuple(s.name for s in model.scales if not s.known and (s.name in parts or s.name in slopes))


def penalty(model: ErrorModel, names: tuple[str, ...]) -> tuple[float, FloatArray, FloatArray]:
    """−2 log of the scales' log-normal priors, its gradient by their logarithms and its curvature."""
    chosen = {s.name: s for s in model.scales}
    apart = np.array([np.log(chosen[n].value / chosen[n].median) for n in names])
    weight = np.array([1.0 / np.log(chosen[n].factor) ** 2 for n in names])
    return float(apart @ (weight * apart)), 2.0 * weight * apart, 2.0 * weight


def derivatives(solution: Solution, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Gradient of −2 log L by the logarithms of the scales, and its average information (scales, scales)."""
    problem = solution.problem
    slopes = problem.model.slopes(problem.robot)
    variances = problem.model.variances(problem.robot)[problem.random]
    root = np.sqrt(variances)
    gradient, pushes = np.zeros(len(names)), np.zeros((problem.y.size, len(names)))
    for at, name in enumerate(names):
        if name in problem.parts:
            part = 2.0 * problem.parts[name]
            push = (part @ solution.weighted[:, :, None])[:, :, 0]
            gradient[at] += np.sum(part * solution.blocks) - np.sum(push * solution.weighted)
            pushes[:, at] += push.ravel()
        if name in slopes:
            slope = slopes[name][problem.random]
            ratio = np.divide(slope, variances, out=np.zeros(len(slope)), where=variances > 1e-290)
            gradient[at] += ratio @ (solution.squares - solution.pulls**2)
            pushes[:, at] += problem.random_columns @ (root * ratio * solution.pulls)
    return gradient, pushes.T @ solution.project(pushes)


def maximise(problem: LinearProblem, rounds: int = 30) -> Solution:
    """The scales of greatest restricted likelihood times their priors; the solution there."""
    names = unknown_scales(problem.model, problem.parts, problem.robot)
    best = solve(problem)
    if not names:
        return best
    prior, slope, curve = penalty(problem.model, names)
    for _ in range(rounds):
        gradient, information = derivatives(best, names)
        gradient, information = gradient + slope, information + np.diag(curve)
        step = -np.linalg.solve(information, gradient)
        step *= min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))
        if -(gradient @ step) < SETTLED:
            break
        for _ in range(6):
            values = {n: best.problem.model.values[n] * np.exp(s) for n, s in zip(names, step, strict=True)}
            model = best.problem.model.with_values(values)
            trial = solve(best.problem.at(model))
            trial_prior = penalty(model, names)
            if trial.value + trial_prior[0] < best.value + prior:
                break
            step = 0.5 * step
        else:
            break
        best, (prior, slope, curve) = trial, trial_prior
    return best
