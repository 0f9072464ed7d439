# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What plans are compared by: information functions of the information matrix M (Pukelsheim, Optimal Design of
Experiments, 1993).

Every criterion here is written as a function Ψ(M) to be *maximised* that is positive, concave and homogeneous,
Ψ(cM) = c Ψ(M): twice the measurements, twice the value. Then with a (super)gradient G = ∂Ψ/∂M

    Ψ(M*) ≤ trace(G M*)       for every M*,                                                            (B)

the supporting hyperplane at M passing through the origin; ``bound`` rests on nothing else. The search
maximises log Ψ. Three criteria of the calibration literature (O2, O4 and plain conditioning) are not concave;
they can be searched for but have no bound.

    name        value Ψ(M)                                value reported
    test_pose   1 / Σ_k w_k tr(J_k M⁻¹ J_kᵀ)              ρ0 = Ψ^(−1/2) [m], eq. (14)
    worst_pose  1 / max_k tr(J_k M⁻¹ J_kᵀ)                largest ρ0 [m]
    d, o1       det(M)^(1/p)                              det(M)^(1/p); O1 = det(M)^(1/2p)/√m
    d_star      (Π_i (M⁻¹)_ii)^(−1/p)                     the same
    a           p / tr(M⁻¹)                               tr(M⁻¹)
    e, o3       λ_min(M)                                  λ_min(M); O3 = √λ_min
    o5          (tr M^(−1/2) / p)^(−2)                    O5 = 1 / tr M^(−1/2)
    o2          λ_min / λ_max                             O2 = √(λ_min / λ_max)
    o4          λ_min² / λ_max                            O4 = λ_min / √λ_max

D: Wald 1943; E: Ehrenfeld 1955; A: Elfving 1952; D*: Klimchik et al.; O1: Borm and Menq 1989; O2: Driels and
Pathre 1990; O3, O4: Nahvi et al. 1994, 1996; O5: Sun and Hollerbach 2008.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from calib_planner.arrays import FloatArray

RIDGE = 1e-12
"""Added to the information of a plan while searching, relative to its mean diagonal, so that singular plans stay
finite."""


class Criterion(Protocol):
    """An information function."""

    @property
    def concave(self) -> bool:
        """Whether (B) holds, so that there is a bound."""
        ...

    def value_and_gradient(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``matrices`` (S, p, p) → Ψ (S,), to be maximised, and ∂Ψ/∂M (S, p, p)."""
        ...

    def values(self, matrices: FloatArray) -> FloatArray:
        """The same Ψ (S,) without the gradient, to rounding."""
        ...

    def supporting_gradient(self, matrix: FloatArray) -> FloatArray:
        """G (p, p) of (B) at ``matrix`` for the *exact* criterion, where the search uses a smooth one."""
        ...

    def exact(self, matrix: FloatArray) -> float:
        """Ψ itself at one matrix (p, p), unsmoothed."""
        ...

    def exact_values(self, matrices: FloatArray) -> FloatArray:
        """The same of matrices (S, p, p): (S,)."""
        ...


def _symmetric(gradient: FloatArray) -> FloatArray:
    result = gradient + gradient.swapaxes(-1, -2)
    result *= 0.5
    return result


class _Exact:
    """What follows from ``exact_values`` and ``value_and_gradient``."""

    def value_and_gradient(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        raise NotImplementedError

    def values(self, matrices: FloatArray) -> FloatArray:
        return self.value_and_gradient(matrices)[0]

    def exact_values(self, matrices: FloatArray) -> FloatArray:
        raise NotImplementedError

    def exact(self, matrix: FloatArray) -> float:
        return float(self.exact_values(matrix[None])[0])


class _Smooth(_Exact):
    """Methods that all differentiable criteria share."""

    concave = True

    def supporting_gradient(self, matrix: FloatArray) -> FloatArray:
        return self.value_and_gradient(matrix[None])[1][0]

    def exact_values(self, matrices: FloatArray) -> FloatArray:
        return self.values(matrices)


@dataclass(frozen=True)
class Accuracy(_Smooth):
    """1 / trace(A M⁻¹): eq. (14), for one or several test poses, or the A-criterion with A = I/p.

    Attributes:
        weight: (p, p) the matrix A, symmetric and positive semi-definite.
    """

    weight: FloatArray

    def value_and_gradient(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        inverse = np.linalg.inv(matrices)
        half = inverse @ self.weight
        psi = 1.0 / np.einsum("sii->s", half)
        gradient = half @ inverse
        gradient *= (psi**2)[:, None, None]
        return psi, _symmetric(gradient)

    def values(self, matrices: FloatArray) -> FloatArray:
        return np.asarray(1.0 / np.einsum("sab,ba->s", np.linalg.inv(matrices), self.weight))


@dataclass(frozen=True)
class WorstAccuracy(_Exact):
    """1 / max_k trace(A_k M⁻¹): the worst of several test poses.

    The search uses the power mean Σ_k (…)^s with s = ``sharpness`` for the maximum. For (B) any mixture
    Σ λ_k A_k gives a valid gradient, since the largest is at least the mixture; the power mean supplies λ.

    Attributes:
        weights: (K, p, p) the matrices A_k.
    """

    weights: FloatArray
    sharpness: float = 16.0
    concave: bool = True

    def _values(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        inverse = np.linalg.inv(matrices)
        return np.asarray(inverse, np.float64), np.einsum("sab,kba->sk", inverse, self.weights)

    def _power_mean(self, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Ψ (S,), powers (S, K) and their mean (S,) of the variances ``values`` (S, K)."""
        top = values.max(axis=1, keepdims=True)
        powers = (values / top) ** self.sharpness
        total = powers.mean(axis=1)
        return 1.0 / (top[:, 0] * total ** (1.0 / self.sharpness)), powers, total

    def values(self, matrices: FloatArray) -> FloatArray:
        return self._power_mean(self._values(matrices)[1])[0]

    def value_and_gradient(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        inverse, values = self._values(matrices)
        psi, powers, total = self._power_mean(values)
        share = powers / values / (total * len(self.weights))[:, None]
        mixed = np.einsum("sk,kab->sab", share, self.weights)
        return psi, _symmetric(psi[:, None, None] * (inverse @ mixed @ inverse))

    def supporting_gradient(self, matrix: FloatArray) -> FloatArray:
        _, values = self._values(matrix[None])
        powers = (values[0] / values[0].max()) ** self.sharpness / values[0]
        mixed = np.einsum("k,kab->ab", powers / powers.sum(), self.weights)
        return Accuracy(mixed).supporting_gradient(matrix)

    def exact_values(self, matrices: FloatArray) -> FloatArray:
        return np.asarray(1.0 / self._values(matrices)[1].max(axis=1))


@dataclass(frozen=True)
class Determinant(_Smooth):
    """det(M)^(1/p): the D-criterion, invariant under the units of the parameters up to a constant."""

    def values(self, matrices: FloatArray) -> FloatArray:
        sign, log = np.linalg.slogdet(matrices)
        return np.where(sign > 0, np.exp(log / matrices.shape[-1]), 0.0)

    def value_and_gradient(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        size, psi = matrices.shape[-1], self.values(matrices)
        return psi, _symmetric(psi[:, None, None] / size * np.linalg.inv(matrices))


@dataclass(frozen=True)
class DiagonalDeterminant(_Smooth):
    """(Π (M⁻¹)_ii)^(−1/p): D*, small variances *and* independence, since Π (M⁻¹)_ii ≥ det M⁻¹."""

    def value_and_gradient(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        size = matrices.shape[-1]
        inverse = np.linalg.inv(matrices)
        diagonal = np.einsum("sii->si", inverse)
        psi = np.exp(-np.log(np.maximum(diagonal, 1e-300)).mean(axis=1))
        middle = inverse / diagonal[:, None, :]
        return psi, _symmetric(psi[:, None, None] / size * (middle @ inverse))


@dataclass(frozen=True)
class PowerMean(_Smooth):
    """(tr M^(−s) / p)^(−1/s): s = 1 is A, s = ½ is O5, s → ∞ is E (searched with s = 8, reported exactly)."""

    power: float
    smallest: bool = False

    def value_and_gradient(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        s = self.power
        values, vectors = np.linalg.eigh(matrices)
        values = np.maximum(values, 1e-300)
        lowest = values[:, :1]
        scaled = (lowest / values) ** s
        psi = lowest[:, 0] * scaled.mean(axis=1) ** (-1.0 / s)
        weights = psi[:, None] * scaled / values / scaled.sum(axis=1, keepdims=True)
        return psi, np.einsum("sik,sk,sjk->sij", vectors, weights, vectors)

    def supporting_gradient(self, matrix: FloatArray) -> FloatArray:
        if not self.smallest:
            return super().supporting_gradient(matrix)
        values, vectors = np.linalg.eigh(matrix)
        weights = (values[0] / np.maximum(values, 1e-300)) ** (self.power + 1.0)
        return (vectors * (weights / weights.sum())) @ vectors.T

    def exact_values(self, matrices: FloatArray) -> FloatArray:
        if self.smallest:
            return np.maximum(np.linalg.eigvalsh(matrices)[:, 0], 0.0)
        return super().exact_values(matrices)


@dataclass(frozen=True)
class EigenvalueRatio(_Exact):
    """λ_min^a / λ_max: O2 (a = 1) and O4 (a = 2); not concave, searched through power means."""

    numerator: float
    power: float = 8.0
    concave: bool = False

    def value_and_gradient(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        values, vectors = np.linalg.eigh(matrices)
        values = np.maximum(values, 1e-300)
        s, a = self.power, self.numerator
        low = (values[:, :1] / values) ** s
        high = (values / values[:, -1:]) ** s
        smallest = values[:, 0] * low.sum(axis=1) ** (-1.0 / s)
        largest = values[:, -1] * high.sum(axis=1) ** (1.0 / s)
        psi = smallest**a / largest
        d_log = a * low / low.sum(axis=1, keepdims=True) - high / high.sum(axis=1, keepdims=True)
        weights = psi[:, None] * d_log / values
        return psi, np.einsum("sik,sk,sjk->sij", vectors, weights, vectors)

    def supporting_gradient(self, matrix: FloatArray) -> FloatArray:
        raise NotImplementedError("this criterion is not concave: it has no bound")

    def exact_values(self, matrices: FloatArray) -> FloatArray:
        values = np.linalg.eigvalsh(matrices)
        return np.asarray(np.maximum(values[:, 0], 0.0) ** self.numerator / values[:, -1])


@dataclass(frozen=True)
class Compound(_Smooth):
    """Π_i (Ψ_i / r_i)^(w_i): a weighted geometric mean of efficiencies; concave and homogeneous if all are.

    Attributes:
        criteria: The parts, all concave.
        shares: (n,) weights, summing to one.
        references: (n,) the best known value r_i of each, per measurement.
    """

    criteria: tuple[Criterion, ...]
    shares: tuple[float, ...]
    references: tuple[float, ...]

    def _mean(self, values: Iterable[FloatArray]) -> FloatArray:
        """Ψ (S,) of those of the parts (S,)."""
        log = sum(
            w * np.log(np.maximum(psi / r, 1e-300))
            for w, r, psi in zip(self.shares, self.references, values, strict=True)
        )
        return np.asarray(np.exp(log))

    def values(self, matrices: FloatArray) -> FloatArray:
        return self._mean(c.values(matrices) for c in self.criteria)

    def value_and_gradient(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        parts = [c.value_and_gradient(matrices) for c in self.criteria]
        value = self._mean(psi for psi, _ in parts)
        gradient = sum(
            (w * value / psi)[:, None, None] * g for w, (psi, g) in zip(self.shares, parts, strict=True)
        )
        return value, np.asarray(gradient)


@dataclass(frozen=True)
class Eliminating(_Exact):
    """A criterion of the parameters of interest, the nuisance ones eliminated.

    What M says about the first block once the second is estimated with it is the Schur complement

        S = M_ii − M_in M_nn⁻¹ M_ni = Kᵀ M K,   K = [I; −M_nn⁻¹ M_ni],

    concave in M and homogeneous; by the envelope theorem ∂Ψ(S)/∂M = K G Kᵀ.

    Attributes:
        inner: The criterion of the parameters of interest.
        interest: Indices of the parameters of interest.
        nuisance: Indices of the others.
    """

    inner: Criterion
    interest: tuple[int, ...]
    nuisance: tuple[int, ...]

    @property
    def concave(self) -> bool:
        return self.inner.concave

    def _reduce(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        i, n = list(self.interest), list(self.nuisance)
        cross = matrices[:, n][:, :, i]
        solved = np.linalg.solve(matrices[:, n][:, :, n], cross)
        lift = np.zeros((len(matrices), matrices.shape[1], len(i)))
        lift[:, i] = np.eye(len(i))
        lift[:, n] = -solved
        schur = matrices[:, i][:, :, i] - np.swapaxes(cross, 1, 2) @ solved
        return _symmetric(schur), lift

    def values(self, matrices: FloatArray) -> FloatArray:
        return self.inner.values(self._reduce(matrices)[0])

    def value_and_gradient(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        schur, lift = self._reduce(matrices)
        psi, gradient = self.inner.value_and_gradient(schur)
        return psi, lift @ gradient @ np.swapaxes(lift, 1, 2)

    def supporting_gradient(self, matrix: FloatArray) -> FloatArray:
        schur, lift = self._reduce(matrix[None])
        return lift[0] @ self.inner.supporting_gradient(schur[0]) @ lift[0].T

    def exact_values(self, matrices: FloatArray) -> FloatArray:
        return self.inner.exact_values(self._reduce(matrices)[0])


def sharpened(criterion: Criterion, factor: float) -> Criterion:
    """The same criterion, its smooth form closer to the exact one by a larger exponent. Smooth ones stay, and
    so do compound ones, which are defined by the smooth form of their parts."""
    if isinstance(criterion, PowerMean) and criterion.smallest:
        return replace(criterion, power=factor * criterion.power)
    if isinstance(criterion, WorstAccuracy) and len(criterion.weights) > 1:
        return replace(criterion, sharpness=factor * criterion.sharpness)
    if isinstance(criterion, EigenvalueRatio):
        return replace(criterion, power=factor * criterion.power)
    if isinstance(criterion, Eliminating):
        return replace(criterion, inner=sharpened(criterion.inner, factor))
    return criterion


def is_sharp(criterion: Criterion) -> bool:
    """Whether the exact criterion has no gradient everywhere, so that a smooth form of it is searched with."""
    if isinstance(criterion, Eliminating):
        return is_sharp(criterion.inner)
    several = isinstance(criterion, WorstAccuracy) and len(criterion.weights) > 1
    smallest = isinstance(criterion, PowerMean) and criterion.smallest
    return several or smallest or isinstance(criterion, EigenvalueRatio)


def accuracy_weights(jacobians: FloatArray) -> FloatArray:
    """(K, p, p) matrices A_k = J_kᵀJ_k / targets of (K, 3·targets, p) Jacobians at test poses."""
    return np.einsum("kia,kib->kab", jacobians, jacobians) / (jacobians.shape[1] / 3)


@dataclass(frozen=True)
class Row:
    """A criterion that a problem may ask for by its name.

    Attributes:
        make: Makes Ψ of p, the number of parameters of interest, and A (p, p), the weighted mean of the matrices
            A_k of ``accuracy_weights``, and these (K, p, p); without test poses there are none.
        reported: Ψ, p and the number of measurements → the value reported, last column of the table at the top.
        poses: Whether it needs test poses; its values are accuracies [m].
        minimised: Whether a smaller reported value is the better one.
    """

    make: Callable[[int, FloatArray, FloatArray], Criterion]
    reported: Callable[[float, int, int], float] = lambda psi, size, measurements: psi
    poses: bool = False
    minimised: bool = False


def _root(psi: float, size: int, measurements: int) -> float:
    return float(np.sqrt(psi))


def _accuracy(psi: float, size: int, measurements: int) -> float:
    return float(psi**-0.5)


TABLE = {
    "test_pose": Row(lambda p, mean, each: Accuracy(mean), _accuracy, poses=True, minimised=True),
    "worst_pose": Row(lambda p, mean, each: WorstAccuracy(each), _accuracy, poses=True, minimised=True),
    "d": Row(lambda p, mean, each: Determinant()),
    "d_star": Row(lambda p, mean, each: DiagonalDeterminant()),
    "a": Row(lambda p, mean, each: Accuracy(np.eye(p) / p), lambda psi, size, m: size / psi, minimised=True),
    "e": Row(lambda p, mean, each: PowerMean(8.0, smallest=True)),
    "o1": Row(lambda p, mean, each: Determinant(), lambda psi, size, m: float(np.sqrt(psi / m))),
    "o2": Row(lambda p, mean, each: EigenvalueRatio(1.0), _root),
    "o3": Row(lambda p, mean, each: PowerMean(8.0, smallest=True), _root),
    "o4": Row(lambda p, mean, each: EigenvalueRatio(2.0), _root),
    "o5": Row(lambda p, mean, each: PowerMean(0.5), lambda psi, size, m: float(np.sqrt(psi)) / size),
}
"""Name → criterion. Options, parameters, messages and tests read it."""
CRITERIA = tuple(TABLE)
"""Names that a problem may use."""
POSE_CRITERIA = tuple(name for name, row in TABLE.items() if row.poses)
"""Those that need test poses; their values are accuracies [m]."""


def make_criterion(
    name: str, size: int, test_weights: FloatArray, shares: Sequence[float] | FloatArray
) -> Criterion:
    """The criterion of that name.

    Args:
        name: One of ``CRITERIA``.
        size: p, number of parameters of interest.
        test_weights: (K, p, p) from ``accuracy_weights``; only criteria with test poses look at them.
        shares: (K,) weights of the test poses.
    """
    row = TABLE[name]
    share = np.asarray(shares, float) / np.sum(shares)
    mean = np.einsum("k,kab->ab", share, test_weights) if row.poses else test_weights
    return row.make(size, mean, test_weights)


def ridged(matrices: FloatArray) -> FloatArray:
    """(S, p, p) information matrices with so small a ridge that a singular one has a small value, not none."""
    result = np.array(matrices)
    diagonal = np.einsum("sii->si", result)  # a view
    diagonal += RIDGE * diagonal.mean(axis=1, keepdims=True)
    return result


def log_values(criterion: Criterion, matrices: FloatArray) -> FloatArray:
    """log Ψ (S,) of information matrices (S, p, p), −∞ where it is none."""
    psi = criterion.values(matrices)
    usable = np.isfinite(psi) & (psi > 0)
    return np.where(usable, np.log(np.where(usable, psi, 1.0)), -np.inf)


def reported_value(name: str, psi: float, size: int, measurements: int) -> float:
    """The reported value (last column of the table at the top) for Ψ."""
    row = TABLE[name]
    if psi <= 0:
        return float("inf") if row.minimised else 0.0
    return row.reported(psi, size, measurements)
