# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The linear problem of one relinearisation: generalised least squares and the restricted likelihood.

With the flat columns F (base, targets, and placement where its prior is flat), all other columns B with
coefficients u ~ N(0, Λ), and V = blockdiag(R_i) + B Λ Bᵀ, the measured minus the predicted coordinates are

    y = F γ + B u + e ,      y ~ N(F γ, V),

    P = V⁻¹ − V⁻¹F S⁻¹ FᵀV⁻¹ ,   S = FᵀV⁻¹F ,   γ̂ = S⁻¹FᵀV⁻¹y ,   û = Λ Bᵀ P y ,                            (1)
    −2 log L = log|V| + log|S| + yᵀ P y      (Patterson & Thompson 1971, without its constants).               (2)

Its derivative by a scale θ is tr(P ∂V) − (Py)ᵀ ∂V (Py). R has blocks and Λ is diagonal, so that three things tell
all derivatives: the blocks P_ii, the vector Py, and for every column b_k both b_kᵀ P b_k and b_kᵀ P y.

Two forms give them. The *dense* one factorises V, of the size of the measured coordinates. The one *by
coefficients* factorises, with W = [F, B Λ^½] and D = diag(0, 1) (Woodbury),

    A = Wᵀ R⁻¹ W + D ,   P = R⁻¹ − R⁻¹ W A⁻¹ Wᵀ R⁻¹ ,   log|V| + log|S| = log|R| + log|A|,                     (3)

of the size of the coefficients: for thousands of points. Columns scaled by Λ^½ keep A regular when a term
vanishes, and R is regular because its scales have priors. Flat columns enter as an orthonormal basis of what they
span, so that redundant ones do no harm: β_flat = Z γ with the shortest solution. Coordinates that were not
measured are rows of zeros with variance one; they change nothing.

At the same scales a few visits that come, go or count less change A by Uᵀ Δ U only: U are their rows of W, and Δ
has the blocks R_i⁻¹ of those that came, −R_i⁻¹ of those that went and the difference of the others. Then

    A'⁻¹ = A⁻¹ − A⁻¹Uᵀ X U A⁻¹ ,     X = (I + Δ U A⁻¹ Uᵀ)⁻¹ Δ ,                                               (4)

and the blocks of P follow from W_i A'⁻¹ W_iᵀ, for the price of a few products with a vector (``exchange``).

Most columns are those of the joint functions, and these are products: b_lh(i) = c_l(i) w_lh(i), the lever (m,) of
joint l at visit i times a wave. With the Gram matrices K_l = w_l Λ_l w_lᵀ (N, N) of its waves

    (B Λ Bᵀ)_ij = Σ_l c_l(i) K_l(i, j) c_l(j)ᵀ ,                                                              (5)
    b_lhᵀ P b_lh = w_lhᵀ Q_l w_lh ,     Q_l(i, j) = c_l(i)ᵀ P_ij c_l(j) ,

so that the dense form needs up to m² times fewer operations for them.

The scales are the maximum of L times their log-normal priors (``maximise``), by Newton steps with the average
information f_aᵀ P f_b, f_a = ∂_a V P y (Gilmour, Thompson & Cullis 1995), in the logarithms of the scales.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dgemm, dsyrk
from scipy.linalg.lapack import dpotri, dtrtri

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.error_model import ErrorModel, Poses
from calib_planner.robot import Robot

RANK = 1e-7
"""Singular values of the flat columns, of unit length, below this share of the largest count as zero."""
LONGEST_STEP = 1.5
"""Most that the logarithm of a scale changes in one step."""
SMALLEST, LARGEST = 5e-3, 300.0
"""Shares of its median between which a scale stays: smaller is none, and larger ones are gross errors' doing."""
UNBOUNDED = 1e9
"""The same where nothing is known of a scale; a factor from which on this is so."""
ROUNDED_OFF = 1e-9
"""Share of the information in a direction below which what is left of it is rounding."""
MANY = 150
"""Coordinates from which (5) is used. For fewer it saves little, and another order of the sums would change the
last digits of every answer."""
SETTLED = 0.02
"""A step that promises less than this of −2 log L ends the search."""


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """One relinearisation.

    Attributes:
        robot: At which it was linearised.
        model: Its scales are those of ``parts``.
        y: (N, m) measured − predicted + B (u₀ − ū) [m], ū the prior's means; zero where not measured.
        columns: (N, m, coefficients) J⁺, zero rows where not measured.
        parts: Scale → (N, m, m) its part of R_i, zero rows and columns where not measured [m²].
        seen: (N, m) 1 where measured.
        poses: Where the columns were taken, which tells the products of (5); ``None``: at several places.
    """

    robot: Robot
    model: ErrorModel
    y: FloatArray
    columns: FloatArray
    parts: Mapping[str, FloatArray]
    seen: FloatArray
    poses: Poses | None = None

    @cached_property
    def variances(self) -> FloatArray:
        """(model's coefficients,) prior variances, infinite where there is no prior."""
        return self.model.variances(self.robot)

    @cached_property
    def flat(self) -> IntArray:
        """Numbers of the coefficients without a prior."""
        return np.flatnonzero(np.isinf(self.variances))

    @cached_property
    def random(self) -> IntArray:
        """Numbers of the coefficients with one."""
        return np.flatnonzero(np.isfinite(self.variances))

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
    def root(self) -> FloatArray:
        """(K,) Λ^½; of parameters with a stated prior the roots of its variances."""
        return np.sqrt(self.variances[self.random])

    @cached_property
    def means(self) -> FloatArray:
        """(K,) expected u, zero where nothing is stated."""
        return self.model.means(self.robot)[self.random]

    @cached_property
    def stated(self) -> tuple[IntArray, FloatArray] | None:
        """Which of the K have a stated prior, and the root L (stated, stated) of its covariance, if any has."""
        prior = self.model.placement.stated
        if prior is None:
            return None
        return np.searchsorted(self.random, prior.places(self.robot.parameter_names)), prior.root

    def spread(self, standard: FloatArray) -> FloatArray:
        """Λ^½ · standard, (K, …): what it adds to u."""
        result = (self.root * standard.T).T
        if self.stated is not None:
            places, root = self.stated
            result[places] = root @ standard[places]
        return result

    def standard(self, u: FloatArray) -> FloatArray:
        """Λ^-½ u (K,): the inverse; 0 for terms that vanished."""
        result = np.divide(u, self.root, out=np.zeros(len(u)), where=self.root > 0.0)
        if self.stated is not None:
            places, root = self.stated
            result[places] = np.linalg.solve(root, u[places])
        return result

    @cached_property
    def scaled_columns(self) -> FloatArray:
        """(N·m, K) B Λ^½."""
        return self.scaled(self.random_columns)

    def scaled(self, columns: FloatArray) -> FloatArray:
        """Columns (…, K) of B, or the first of them, times Λ^½."""
        result = columns * self.root[: columns.shape[-1]]
        if self.stated is not None:
            places, root = self.stated
            result[..., places] = columns[..., places] @ root
        return result

    @cached_property
    def products(self) -> tuple[FloatArray, FloatArray] | None:
        """c (N, m, joints) and w (joints, N, 2·harmonics) of the last columns of B, those that are products."""
        functions = self.model.joint_functions
        if functions is None or self.poses is None or self.y.size < MANY:
            return None
        waves = functions.remembered_waves(self.poses).transpose(1, 0, 2)
        return self.poses.levers * self.seen[:, :, None], np.ascontiguousarray(waves)

    @cached_property
    def plain_columns(self) -> FloatArray:
        """(N·m, K or fewer) the first columns of B, those that are no products."""
        count = len(self.random) - (0 if self.products is None else self.products[1][:, 0].size)
        return self.columns[:, :, self.random[:count]].reshape(self.y.size, count)

    @cached_property
    def scaled_plain(self) -> FloatArray:
        """(N·m, K or fewer) the same times Λ^½."""
        return self.scaled_columns if self.products is None else self.scaled(self.plain_columns)

    def _product_roots(self) -> FloatArray:
        """(joints, 2·harmonics) Λ^½ of the columns that are products."""
        assert self.products is not None
        return self.root[self.plain_columns.shape[1] :].reshape(len(self.products[1]), -1)

    def systematic_covariance(self) -> FloatArray:
        """(N·m, N·m) B Λ Bᵀ [m²], by (5)."""
        plain, (n, m) = self.scaled_plain, self.y.shape
        result = np.asarray(plain @ plain.T)
        if self.products is not None:
            levers, waves = self.products
            waves = waves * self._product_roots()[:, None]
            gram = (waves @ waves.transpose(0, 2, 1)).transpose(1, 0, 2)  # j, l, i
            wide = gram[..., None] * np.ascontiguousarray(levers.transpose(2, 0, 1))  # K_l(j, i) c_l(i)
            result += (levers @ wide.reshape(n, -1, n * m)).reshape(n * m, n * m)
        return result

    def squares(self, projection: FloatArray) -> FloatArray:
        """(K,) λ_k b_kᵀ P b_k for P = ``projection`` (N·m, N·m), by (5)."""
        plain, (n, m) = self.scaled_plain, self.y.shape
        result = np.einsum("ak,ak->k", plain, projection @ plain)
        if self.products is None:
            return np.asarray(result)
        levers, waves = self.products
        carried = (levers.transpose(0, 2, 1) @ projection.reshape(n, m, n * m)).reshape(n, -1, n, m)
        inner = np.einsum("jlia,ial->lji", carried, levers)
        own = np.einsum("lih,lih->lh", inner @ waves, waves) * self._product_roots() ** 2
        return np.concatenate([result, own.ravel()])

    def scaled_times(self, standard: FloatArray) -> FloatArray:
        """B Λ^½ · standard, (K, n) → (N·m, n)."""
        count, (n, m) = self.scaled_plain.shape[1], self.y.shape
        result = np.ascontiguousarray((standard[:count].T @ self.scaled_plain.T).T)
        if self.products is not None:
            levers, waves = self.products
            roots = self._product_roots()
            turned = waves @ (roots[..., None] * standard[count:].reshape(*roots.shape, -1))
            result += (levers @ turned.transpose(1, 0, 2)).reshape(n * m, -1)
        return result

    def pulled(self, vectors: FloatArray) -> FloatArray:
        """(B Λ^½)ᵀ · vectors, (N·m, n) → (K, n)."""
        plain, (n, m) = self.scaled_plain.T @ vectors, self.y.shape
        if self.products is None:
            return np.asarray(plain)
        levers, waves = self.products
        felt = levers.transpose(0, 2, 1) @ vectors.reshape(n, m, -1)
        own = waves.transpose(0, 2, 1) @ felt.transpose(1, 0, 2) * self._product_roots()[..., None]
        return np.concatenate([plain, own.reshape(-1, vectors.shape[1])])

    @cached_property
    def ratios(self) -> dict[str, FloatArray]:
        """Scale that the data decide → (K,) ∂ log λ_k by its logarithm."""
        gradients = {name: gradient[self.random] for name, gradient in self.model.gradients(self.robot).items()}
        there = self.root > 1e-145
        return {n: np.where(there, s, 0.0) / np.where(there, self.root**2, 1.0) for n, s in gradients.items()}

    def expand(self, reduced: FloatArray) -> FloatArray:
        """β (coefficients, …) of γ and Λ^-½ u (rank + K, …)."""
        rank = self.basis.shape[1]
        result = np.zeros((self.columns.shape[2], *reduced.shape[1:]))
        result[self.flat] = self.basis @ reduced[:rank]
        result[self.random] = self.spread(reduced[rank:])
        return result

    def expand_both(self, reduced: FloatArray) -> FloatArray:
        """T C Tᵀ (coefficients, coefficients) of C = ``reduced`` (rank + K, rank + K), with β = T (γ, Λ^-½ u).

        T is diagonal but for the parameters, which are the first of the coefficients.
        """
        first = len(self.robot.parameter_names)
        own = len(reduced) - (self.columns.shape[2] - first)
        head = self.expand(np.eye(len(reduced))[:, :own])[:first]
        root = self.root[len(self.root) - (len(reduced) - own) :]
        result = np.empty((self.columns.shape[2],) * 2)
        np.multiply(reduced[own:, own:], root, out=result[first:, first:])
        result[first:, first:] *= root[:, None]
        result[:first, first:] = head @ (reduced[:own, own:] * root)
        result[first:, :first] = result[:first, first:].T
        result[:first, :first] = head @ reduced[:own, :own] @ head.T
        return result

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
        for name in ("flat", "random", "basis", "flat_columns", "products", "plain_columns"):
            result.__dict__[name] = getattr(self, name)
        if "random_columns" in self.__dict__:
            result.__dict__["random_columns"] = self.random_columns
        return result


@dataclass(frozen=True, eq=False)
class Solution:
    """Generalised least squares at given scales.

    Attributes:
        problem: What was solved.
        value: −2 log L of (2) or (3), constants left out.
        coefficients: (coefficients,) γ̂ as Z γ̂, and û − ū; flat ones are changes from where it was linearised.
        weighted: (N, m) P y [1/m].
        pulls: (K,) λ_k^½ b_kᵀ P y.
    """

    problem: LinearProblem
    value: float
    coefficients: FloatArray
    weighted: FloatArray
    pulls: FloatArray

    @cached_property
    def squares(self) -> FloatArray:
        """(K,) λ_k b_kᵀ P b_k; a step that is tried and given up never needs them."""
        raise NotImplementedError

    @cached_property
    def blocks(self) -> FloatArray:
        """(N, m, m) P_ii [1/m²]; many solutions never need them."""
        raise NotImplementedError

    def project(self, vectors: FloatArray) -> FloatArray:
        """P · vectors, (N·m, n) → (N·m, n)."""
        raise NotImplementedError

    def between(self, visits: IntArray) -> FloatArray:
        """(k·m, k·m) the block of P for k ``visits`` [1/m²]."""
        raise NotImplementedError

    def _reduced(self, vectors: FloatArray) -> FloatArray:
        """γ̂ and Λ^-½ û if ``vectors`` (N·m, n) had been measured: (rank + K, n)."""
        raise NotImplementedError

    def _reduced_covariance(self) -> FloatArray:
        """(rank + K, rank + K) of γ and Λ^-½ u."""
        raise NotImplementedError

    def coefficients_of(self, vectors: FloatArray) -> FloatArray:
        """β if ``vectors`` (N·m, n) had been measured: (coefficients, n)."""
        return self.problem.expand(self._reduced(vectors))

    def posterior(self) -> FloatArray:
        """(coefficients, coefficients) C of β given the data, (M2); zero in directions no point shows."""
        return self.problem.expand_both(self._reduced_covariance())


@dataclass(frozen=True, eq=False)
class DenseSolution(Solution):
    """By (1): ``projection`` P, ``spread`` S⁻¹ and ``carried`` V⁻¹F."""

    projection: FloatArray
    spread: FloatArray
    carried: FloatArray

    @cached_property
    def squares(self) -> FloatArray:
        return self.problem.squares(self.projection)

    @cached_property
    def blocks(self) -> FloatArray:
        (n, m), every = self.problem.y.shape, np.arange(len(self.problem.y))
        return self.projection.reshape(n, m, n, m)[every, :, every, :]

    def project(self, vectors: FloatArray) -> FloatArray:
        return self.projection @ vectors

    def between(self, visits: IntArray) -> FloatArray:
        rows = _rows(visits, self.problem.y.shape[1])
        return self.projection[np.ix_(rows, rows)]

    def _reduced(self, vectors: FloatArray) -> FloatArray:
        flat = self.spread @ (self.carried.T @ vectors)
        return np.vstack([flat, self.problem.pulled(self.projection @ vectors)])

    def _reduced_covariance(self) -> FloatArray:
        """From the singular values s of the whitened columns that F does not explain: 1/(1 + s²) along each.

        I − Λ^½BᵀPBΛ^½ is the same, but a wide prior leaves a small difference of numbers near one.
        """
        problem, (n, m) = self.problem, self.problem.y.shape
        inverse = np.linalg.inv(np.linalg.cholesky(problem.covariance))
        flat, scaled = (
            (inverse @ columns.reshape(n, m, -1)).reshape(n * m, -1)
            for columns in (problem.flat_columns, problem.scaled_columns)
        )
        basis, triangle = np.linalg.qr(flat)
        shared = basis.T @ scaled
        _, values, vectors = np.linalg.svd(scaled - basis @ shared, full_matrices=False)
        own = np.eye(scaled.shape[1]) - (vectors.T * (values**2 / (1.0 + values**2))) @ vectors
        lever = np.linalg.solve(triangle, np.eye(len(triangle)))
        cross = -lever @ shared @ own
        return np.block([[lever @ lever.T - cross @ shared.T @ lever.T, cross], [cross.T, own]])


@dataclass(frozen=True, eq=False)
class CoefficientSolution(Solution):
    """By (3).

    ``inverse`` (N, m, m) holds L⁻¹ of R_i = L Lᵀ, ``white`` (N·m, rank + K) is L⁻¹W, and half halfᵀ = A⁻¹.
    """

    inverse: FloatArray
    white: FloatArray
    half: FloatArray

    @cached_property
    def squares(self) -> FloatArray:
        rank = self.problem.flat_columns.shape[1]
        return np.asarray(1.0 - np.sum(self.half[rank:] ** 2, axis=1))

    @cached_property
    def blocks(self) -> FloatArray:
        n, m = self.problem.y.shape
        share = (self.white @ self.half).reshape(n, m, -1)
        inner = np.eye(m) - share @ share.transpose(0, 2, 1)
        return np.asarray(self.inverse.transpose(0, 2, 1) @ inner @ self.inverse)

    def project(self, vectors: FloatArray) -> FloatArray:
        turned = self._times(self.inverse, vectors)
        turned = turned - self.white @ (self.half @ (self.half.T @ (self.white.T @ turned)))
        return self._times(self.inverse.transpose(0, 2, 1), turned)

    def between(self, visits: IntArray) -> FloatArray:
        share = self.white[_rows(visits, self.problem.y.shape[1])] @ self.half
        inner = np.eye(len(share)) - share @ share.T
        turned = _blocks_times(self.inverse[visits].transpose(0, 2, 1), inner)
        return _blocks_times(self.inverse[visits].transpose(0, 2, 1), turned.T).T

    def _times(self, blocks: FloatArray, vectors: FloatArray) -> FloatArray:
        n, m = self.problem.y.shape
        return np.asarray((blocks @ vectors.reshape(n, m, -1)).reshape(n * m, -1))

    def _reduced(self, vectors: FloatArray) -> FloatArray:
        turned = self._times(self.inverse, vectors)
        return np.asarray(self.half @ (self.half.T @ (self.white.T @ turned)))

    def _reduced_covariance(self) -> FloatArray:
        return np.asarray(self.half @ self.half.T)


@dataclass(frozen=True, eq=False)
class UpdatedSolution(Solution):
    """By (3), kept so that (4) can change it.

    ``rows`` (N·m, rank + K) is W, ``precision`` (N, m, m) R_i⁻¹, ``inverse`` (rank + K, rank + K) A⁻¹,
    ``log_determinant`` log|A|, ``spread`` (N, m, m) W_i A⁻¹ W_iᵀ, ``reduced`` (rank + K,) γ̂ and Λ^-½ û, and
    ``fitted`` (N, m) W times these [m].
    """

    rows: FloatArray
    precision: FloatArray
    inverse: FloatArray
    log_determinant: float
    spread: FloatArray
    reduced: FloatArray
    fitted: FloatArray

    @cached_property
    def squares(self) -> FloatArray:
        rank = self.problem.basis.shape[1]
        return np.asarray(1.0 - np.diag(self.inverse)[rank:])

    @cached_property
    def blocks(self) -> FloatArray:
        return np.asarray(self.precision - self.precision @ self.spread @ self.precision)

    def project(self, vectors: FloatArray) -> FloatArray:
        turned = self._times(vectors)
        return turned - self._times(self.rows @ (self.inverse @ (self.rows.T @ turned)))

    def between(self, visits: IntArray) -> FloatArray:
        rows = self.rows[_rows(visits, self.problem.y.shape[1])]
        own = _blocks_times(self.precision[visits], np.eye(len(rows)))
        return own - own @ (rows @ self.inverse @ rows.T) @ own

    def _times(self, vectors: FloatArray) -> FloatArray:
        n, m = self.problem.y.shape
        return np.asarray((self.precision @ vectors.reshape(n, m, -1)).reshape(n * m, -1))

    def _reduced(self, vectors: FloatArray) -> FloatArray:
        few = np.ascontiguousarray(self._times(vectors).T)
        return np.asarray(((few @ self.rows) @ self.inverse).T)

    def _reduced_covariance(self) -> FloatArray:
        return self.inverse


def solve(problem: LinearProblem) -> Solution:
    """The cheaper of both forms."""
    coordinates, coefficients = problem.y.size, problem.columns.shape[2]
    return dense(problem) if coordinates <= coefficients else by_coefficients(problem)


def dense(problem: LinearProblem) -> DenseSolution:
    """By factorising V, (1)."""
    n, m = problem.y.shape
    y, flat, every = problem.y.ravel(), problem.flat_columns, np.arange(n)
    total = problem.systematic_covariance()
    total.reshape(n, m, n, m)[every, :, every, :] += problem.covariance
    factor = np.asarray(np.linalg.cholesky(total), np.float64)
    inverse = _inverse_of(factor)
    carried = inverse @ flat
    normal = flat.T @ carried
    spread = _inverse(normal)
    projection = inverse - carried @ spread @ carried.T
    pulled = projection @ y
    value = 2.0 * np.log(np.diag(factor)).sum() + np.linalg.slogdet(normal)[1] + y @ pulled
    pulls = problem.pulled(pulled[:, None])[:, 0]
    return DenseSolution(
        problem,
        float(value),
        problem.expand(np.append(spread @ (carried.T @ y), pulls)),
        pulled.reshape(n, m),
        pulls,
        projection,
        spread,
        carried,
    )


def by_coefficients(problem: LinearProblem) -> CoefficientSolution:
    """By factorising A, (3)."""
    n, m = problem.y.shape
    rank = problem.flat_columns.shape[1]
    lower = np.linalg.cholesky(problem.covariance)
    inverse = np.linalg.inv(lower)
    columns = np.empty((n, m, rank + len(problem.random)))
    np.matmul(inverse, problem.flat_columns.reshape(n, m, -1), out=columns[:, :, :rank])
    np.matmul(inverse, problem.scaled_columns.reshape(n, m, -1), out=columns[:, :, rank:])
    white = columns.reshape(n * m, -1)
    right = (inverse @ problem.y[:, :, None]).ravel()
    normal = white.T @ white
    normal[np.diag_indices(len(normal))] += np.repeat([0.0, 1.0], [rank, len(normal) - rank])
    scale = 1.0 / np.sqrt(np.diag(normal))
    factor = np.linalg.cholesky(normal * np.outer(scale, scale))
    half = scale[:, None] * np.asarray(dtrtri(factor, lower=1)[0]).T
    solution = half @ (half.T @ (white.T @ right))
    rest = right - white @ solution
    value = 2.0 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum()
    value += 2.0 * (np.log(np.diag(factor)) - np.log(scale)).sum() + right @ rest
    transposed = inverse.transpose(0, 2, 1)
    return CoefficientSolution(
        problem,
        float(value),
        problem.expand(solution),
        (transposed @ rest.reshape(n, m, 1))[:, :, 0],
        solution[rank:],
        inverse,
        white,
        half,
    )


def updatable(solution: Solution) -> UpdatedSolution:
    """The same solution in the form that ``exchange`` changes."""
    if isinstance(solution, UpdatedSolution):
        return solution
    problem = solution.problem
    n, m = problem.y.shape
    rows = np.hstack([problem.flat_columns, problem.scaled_columns])
    if isinstance(solution, CoefficientSolution):
        half = solution.half
        precision = np.asarray(solution.inverse.transpose(0, 2, 1) @ solution.inverse, np.float64)
        inverse = _mirrored(dsyrk(1.0, half.T, trans=1, lower=1))
        spread = problem.covariance - problem.covariance @ solution.blocks @ problem.covariance
        logarithm = -2.0 * float(np.log(np.diag(half)).sum())
    else:
        whitening = np.linalg.inv(np.linalg.cholesky(problem.covariance))
        precision = np.asarray(whitening.transpose(0, 2, 1) @ whitening, np.float64)
        white = (whitening @ rows.reshape(n, m, -1)).reshape(n * m, -1)
        normal = white.T @ white
        rank = problem.flat_columns.shape[1]
        normal[np.diag_indices(len(normal))] += np.repeat([0.0, 1.0], [rank, len(normal) - rank])
        scale = 1.0 / np.sqrt(np.diag(normal))
        factor = np.linalg.cholesky(normal * np.outer(scale, scale))
        inverse = _inverse_of(factor) * np.outer(scale, scale)
        spread = (rows @ inverse).reshape(n, m, -1) @ rows.reshape(n, m, -1).transpose(0, 2, 1)
        logarithm = 2.0 * float((np.log(np.diag(factor)) - np.log(scale)).sum())
    reduced = inverse @ (rows.T @ (precision @ problem.y[:, :, None]).ravel())
    fitted = (rows @ reduced).reshape(n, m)
    return _finished(problem, rows, precision, inverse, logarithm, spread, reduced, fitted)


def exchange(solution: UpdatedSolution, problem: LinearProblem, old: IntArray) -> UpdatedSolution:
    """The solution of ``problem``, which differs from the one solved by a few visits, by (4).

    Args:
        solution: Of the problem before, at the same scales.
        problem: The visits wanted; those that stay have the same columns, and may have another R_i.
        old: (N,) number of each visit in the problem before, −1 where it is new.

    Raises:
        numpy.linalg.LinAlgError: A visit that went had been the only one to tell a direction.
    """
    before = solution.problem
    (n, m), stays = problem.y.shape, old >= 0
    gone = np.setdiff1d(np.arange(len(before.y)), old[stays])
    if np.array_equal(old, np.arange(len(before.y))):
        rows = solution.rows
    else:
        new = problem.columns[~stays]
        flat = new[:, :, problem.flat] @ before.basis
        fresh = np.concatenate([flat, problem.scaled(new[:, :, problem.random])], axis=2)
        rows = joined(solution.rows.reshape(len(before.y), m, -1), fresh, old).reshape(n * m, -1)
    problem.__dict__["basis"] = before.basis
    problem.__dict__["flat_columns"] = rows[:, : before.basis.shape[1]]
    problem.__dict__["scaled_columns"] = rows[:, before.basis.shape[1] :]
    precision = np.zeros((n, m, m))
    precision[stays] = solution.precision[old[stays]]
    other = ~stays
    other[stays] = (problem.covariance[stays] != before.covariance[old[stays]]).any(axis=(1, 2))
    precision[other] = np.linalg.inv(problem.covariance[other])
    changed, was = np.flatnonzero(other), np.where(stays, old, 0)
    blocks = precision[changed] - stays[changed, None, None] * solution.precision[was[changed]]
    blocks = np.concatenate([blocks, -solution.precision[gone]])
    theirs = np.concatenate(
        [rows.reshape(n, m, -1)[changed], solution.rows.reshape(len(before.y), m, -1)[gone]]
    ).reshape(len(blocks) * m, rows.shape[1])
    carried = np.ascontiguousarray((theirs @ solution.inverse).T)
    middle = np.eye(len(theirs)) + _blocks_times(blocks, theirs @ carried)
    shares = np.linalg.eigvals(middle).real  # of the information in each direction that is left
    if not shares.min(initial=1.0) > ROUNDED_OFF:
        raise np.linalg.LinAlgError("a visit that went had been the only one to tell a direction")
    inner = np.linalg.solve(middle, _blocks_times(blocks, np.eye(len(theirs))))
    inner = 0.5 * (inner + inner.T)
    inverse = solution.inverse.copy()
    dgemm(-1.0, (carried @ inner).T, carried.T, 1.0, inverse.T, trans_a=1, overwrite_c=1)
    spread, fitted = np.zeros((n, m, m)), np.zeros((n, m))
    spread[stays] = solution.spread[old[stays]]
    moved = np.asarray(dgemm(1.0, rows.T, carried.T, trans_a=1, trans_b=1)).reshape(n, m, -1)
    spread -= moved @ inner @ moved.transpose(0, 2, 1)
    own = rows.reshape(n, m, -1)[~stays]
    spread[~stays] = (own @ inverse) @ own.transpose(0, 2, 1)
    # Of R⁻¹ y what came and went: A⁻¹Wᵀ of it is ``carried`` times it, and (4) makes A'⁻¹ of A⁻¹.
    measured = np.concatenate([problem.y[changed], before.y[gone]])
    came = _blocks_times(blocks, measured.reshape(-1, 1))[:, 0]
    step = came - inner @ (theirs @ (solution.reduced + carried @ came))
    reduced = solution.reduced + carried @ step
    fitted[stays] = solution.fitted[old[stays]]
    fitted[stays] += (moved @ step)[stays]
    fitted[~stays] = own @ reduced
    logarithm = solution.log_determinant + float(np.log(shares).sum())
    return _finished(problem, rows, precision, inverse, logarithm, spread, reduced, fitted)


def with_points_moved(solution: UpdatedSolution, change: FloatArray) -> UpdatedSolution:
    """The solution if y (N, m) had been larger by ``change`` [m]."""
    before = solution.problem
    problem = replace(before, y=before.y + change)
    for name in ("flat", "random", "root", "ratios", "basis", "flat_columns", "scaled_columns", "covariance"):
        problem.__dict__[name] = getattr(before, name)
    step = solution.inverse @ (solution.rows.T @ (solution.precision @ change[:, :, None]).ravel())
    moved = _finished(
        problem,
        solution.rows,
        solution.precision,
        solution.inverse,
        solution.log_determinant,
        solution.spread,
        solution.reduced + step,
        solution.fitted + (solution.rows @ step).reshape(change.shape),
    )
    if "blocks" in solution.__dict__:
        moved.__dict__["blocks"] = solution.blocks
    return moved


def joined(before: FloatArray, new: FloatArray, old: IntArray) -> FloatArray:
    """(N, …) the rows ``old`` of ``before``, and where these are −1 those of ``new``, one after the other."""
    stays = old >= 0
    if np.array_equal(old[: len(before)], np.arange(len(before))) and not stays[len(before) :].any():
        return np.concatenate([before, new])  # the usual: as visits come
    result = np.empty((len(old), *before.shape[1:]))
    result[stays], result[~stays] = before[old[stays]], new
    return result


def _rows(visits: IntArray, size: int) -> IntArray:
    """Numbers of the coordinates of ``visits``, ``size`` each."""
    return (size * visits[:, None] + np.arange(size)).ravel()


def _blocks_times(blocks: FloatArray, matrix: FloatArray) -> FloatArray:
    """blockdiag(blocks (n, m, m)) · matrix (n·m, k)."""
    n, m, _ = blocks.shape
    return np.asarray((blocks @ matrix.reshape(n, m, matrix.shape[1])).reshape(matrix.shape))


def _finished(
    problem: LinearProblem,
    rows: FloatArray,
    precision: FloatArray,
    inverse: FloatArray,
    logarithm: float,
    spread: FloatArray,
    reduced: FloatArray,
    fitted: FloatArray,
) -> UpdatedSolution:
    """The solution from A⁻¹ ``inverse``, log|A| ``logarithm`` and the other parts of ``UpdatedSolution``."""
    rank = problem.basis.shape[1]
    weighted = (precision @ (problem.y - fitted)[:, :, None])[:, :, 0]
    value = logarithm - float(np.linalg.slogdet(precision)[1].sum()) + float(np.sum(problem.y * weighted))
    return UpdatedSolution(
        problem,
        value,
        problem.expand(reduced),
        weighted,
        reduced[rank:],
        rows,
        precision,
        inverse,
        logarithm,
        spread,
        reduced,
        fitted,
    )


def _inverse_of(factor: FloatArray) -> FloatArray:
    """Of L Lᵀ, from the lower triangle L."""
    return _mirrored(dpotri(factor, lower=1)[0])


def _mirrored(lower: FloatArray) -> FloatArray:
    """The symmetric matrix of which ``lower`` holds the lower triangle, and zeros above it."""
    whole = np.asarray(lower + lower.T)
    whole[np.diag_indices(len(whole))] *= 0.5
    return whole


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
    gradients = model.gradients(robot)
    return tuple(s.name for s in model.scales if not s.known and (s.name in parts or s.name in gradients))


def penalty(model: ErrorModel, names: tuple[str, ...]) -> tuple[float, FloatArray, FloatArray]:
    """−2 log of the scales' log-normal priors, its gradient by their logarithms and its curvature."""
    chosen = {s.name: s for s in model.scales}
    apart = np.array([np.log(chosen[n].value / chosen[n].median) for n in names])
    weight = np.array([1.0 / np.log(chosen[n].factor) ** 2 for n in names])
    return float(apart @ (weight * apart)), 2.0 * weight * apart, 2.0 * weight


def derivatives(solution: Solution, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Gradient of −2 log L by the logarithms of the scales, and its average information (scales, scales)."""
    problem, pushes = solution.problem, _pushes(solution, names)
    gradient = np.zeros(len(names))
    for at, name in enumerate(names):
        if name in problem.parts:
            gradient[at] += 2.0 * np.sum(problem.parts[name] * solution.blocks)
            push = problem.parts[name] @ solution.weighted[:, :, None]
            gradient[at] -= 2.0 * np.sum(push[:, :, 0] * solution.weighted)
        if name in problem.ratios:
            gradient[at] += problem.ratios[name] @ (solution.squares - solution.pulls**2)
    return gradient, pushes.T @ solution.project(pushes)


def _pushes(solution: Solution, names: tuple[str, ...]) -> FloatArray:
    """(N·m, scales) ∂V P y by the logarithm of each scale."""
    problem, nothing = solution.problem, np.zeros(len(solution.pulls))
    ratios = np.stack([problem.ratios.get(n, nothing) for n in names])
    pushes = problem.scaled_times((ratios * solution.pulls).T)
    for at, name in enumerate(names):
        if name in problem.parts:
            pushes[:, at] += 2.0 * (problem.parts[name] @ solution.weighted[:, :, None]).ravel()
    return pushes


def with_uncertain_scales(solution: Solution, scales: tuple[tuple[str, ...], FloatArray]) -> FloatArray:
    """C of β, with what the uncertainty of the scales adds (Kackar & Harville 1984): C + D cov(log θ) Dᵀ.

    D = ∂β̂/∂log θ: of γ̂ and û = Λ Bᵀ P y, with ∂P = −P ∂V P, it is −β̂(∂V P y), β̂(·) being the estimate from
    other measurements, plus ∂Λ Bᵀ P y.

    Args:
        solution: At the estimated scales.
        scales: Their names, and cov(log θ) as ``scale_covariance`` has it.
    """
    problem, (names, covariance) = solution.problem, scales
    result = solution.posterior()
    if not names:
        return result
    direct = np.zeros((len(result), len(names)))
    for at, name in enumerate(names):
        if name in problem.ratios:
            direct[problem.random, at] = problem.ratios[name] * solution.coefficients[problem.random]
    gradient = direct - solution.coefficients_of(_pushes(solution, names))
    dgemm(1.0, (gradient @ covariance).T, gradient.T, 1.0, result.T, trans_a=1, overwrite_c=1)
    return result


def scale_covariance(solution: Solution) -> tuple[tuple[str, ...], FloatArray]:
    """Names of the scales that the data decide, and the covariance of their logarithms."""
    problem = solution.problem
    names = unknown_scales(problem.model, problem.parts, problem.robot)
    if not names:
        return names, np.zeros((0, 0))
    information = derivatives(solution, names)[1] + np.diag(penalty(problem.model, names)[2])
    return names, np.asarray(2.0 * np.linalg.inv(information))


def maximise(problem: LinearProblem, rounds: int = 30, settled: float = SETTLED) -> Solution:
    """The scales of greatest restricted likelihood times their priors; the solution there.

    Args:
        problem: At the scales to begin from.
        rounds: Most Newton steps.
        settled: See ``SETTLED``.
    """
    names = unknown_scales(problem.model, problem.parts, problem.robot)
    best = solve(problem)
    if not names:
        return best
    if len(names) == 1:  # the paper's: the search to the end costs nothing
        settled = min(settled, 1e-12)
    prior, prior_gradient, curve = penalty(problem.model, names)
    for _ in range(rounds):
        gradient, information = derivatives(best, names)
        gradient, information = gradient + prior_gradient, information + np.diag(curve)
        step = np.asarray(-np.linalg.solve(information, gradient), np.float64)
        step *= min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))
        if -(gradient @ step) < settled:
            break
        for _ in range(6):
            model = _moved(best.problem.model, names, step)
            trial = solve(best.problem.at(model))
            trial_prior = penalty(model, names)
            if trial.value + trial_prior[0] < best.value + prior:
                break
            step = 0.5 * step
        else:
            break
        best, (prior, prior_gradient, curve) = trial, trial_prior
    return best


def _moved(model: ErrorModel, names: tuple[str, ...], step: FloatArray) -> ErrorModel:
    """The scales moved by ``step`` of their logarithms, within bounds where anything is known of them."""
    chosen, values = {s.name: s for s in model.scales}, {}
    for name, change in zip(names, step, strict=True):
        scale = chosen[name]
        low, high = (SMALLEST, LARGEST) if scale.factor < UNBOUNDED else (1.0 / UNBOUNDED, UNBOUNDED)
        values[name] = float(np.clip(scale.value * np.exp(change), low * scale.median, high * scale.median))
    return model.with_values(values)
