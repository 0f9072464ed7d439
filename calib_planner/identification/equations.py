"""The measured coordinates as equations of equal weight.

Target t at configuration q_i was measured at p_it = f_t(q_i, Π) + e_it, eq. (1). Linearised, eq. (3),

    J ΔΠ = Δp − e,      cov(e) = Σ,

is whitened: with Σ = L Lᵀ both sides are multiplied by L⁻¹, after which every equation has unit variance and
least squares is eq. (6) with weights. Σ has two parts,

    Σ = blockdiag(R_it) + Σ_k θ_k U_k U_kᵀ.

R_it is the instrument's. The columns U_k spread what no geometric model holds (see ``noise_levels``) over all
points measured at a configuration: it is the same for its repetitions, and averaging does not reduce it. So Σ is
block-diagonal, a block per configuration. Blocks of equal size are kept in one array and treated at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from calib_planner._arrays import FloatArray, IntArray
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.motion import Motion
from calib_planner.identification.prior import Prior
from calib_planner.robot.chain import Robot

SAME_JOINT = 2e-4
"""Configurations closer than this in every joint are repetitions of one [rad | m]."""


@dataclass(frozen=True, eq=False)
class Whitening:
    """L⁻¹ of a block-diagonal covariance.

    Attributes:
        index: Per block size s: (blocks, s) numbers of the equations.
        factor: Per block size: (blocks, s, s) L⁻¹, or (blocks, 1) where s = 1.
    """

    index: tuple[IntArray, ...]
    factor: tuple[FloatArray, ...]

    def apply(self, rows: FloatArray) -> FloatArray:
        """L⁻¹ times ``rows`` (equations,) or (equations, columns)."""
        flat = rows if rows.ndim == 2 else rows[:, None]
        if self.factor[0].ndim == 2:  # one by one, in their order
            return (self.factor[0] * flat).reshape(rows.shape)
        result = np.empty_like(flat)
        for index, factor in zip(self.index, self.factor, strict=True):
            if factor.ndim == 2:
                result[index[:, 0]] = factor * flat[index[:, 0]]
            else:
                result[index] = factor @ flat[index]
        return result.reshape(rows.shape)


@dataclass(frozen=True, eq=False)
class Equations:
    """Whitened residuals and Jacobian as functions of the deviations.

    Attributes:
        robot: At its start; its active parameters are the unknowns.
        data: Rows in the robot's joint order.
        use: (N, targets) which points take part.
        whitening: L⁻¹ of their covariance; equations are ordered row, target, axis.
        prior: What is known beforehand, or ``None``.
        known: Positions and Jacobians of the robot at the data's configurations, if some are known already.
    """

    robot: Robot
    data: Measurements
    use: NDArray[np.bool_]
    whitening: Whitening
    prior: Prior | None = None
    known: Motion | None = None

    @cached_property
    def motion(self) -> Motion:
        """Where the points are and how they move."""
        return self.known or Motion(self.robot, self.data.q)

    def residuals(self, deviations: FloatArray) -> FloatArray:
        """(equations + prior rows,) whitened measured − predicted."""
        predicted = self.robot.positions(self.data.q, deviations)
        own = self.whitening.apply((self.data.p - predicted)[self.use].ravel())
        return np.append(own, self.prior_rows(deviations)[1])

    def linearise(self, deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals as above and whitened Jacobian (equations + prior rows, P)."""
        predicted, blocks = self.motion.at(deviations)
        used = blocks if self.use.all() else blocks[self.use]
        rows = self.whitening.apply(used.reshape(-1, blocks.shape[-1]))
        residuals = self.whitening.apply((self.data.p - predicted)[self.use].ravel())
        if self.prior is None:
            return residuals, rows
        extra, right = self.prior_rows(deviations)
        return np.append(residuals, right), np.vstack([rows, extra])

    def prior_rows(self, deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(K, P) whitened rows and (K,) residuals of the prior; K = 0 without one."""
        if self.prior is None:
            return np.empty((0, len(deviations))), np.empty(0)
        nominal = np.array([p.nominal for p in self.robot.parameters])
        return self.prior.rows(self.robot.parameter_names, nominal + deviations)


def configuration_labels(q: FloatArray) -> IntArray:
    """(N,) number of the configuration of each row of ``q`` (N, joints); repetitions share it."""
    pairs = cKDTree(q).query_pairs(SAME_JOINT, p=np.inf, output_type="ndarray")
    if not len(pairs):
        return np.arange(len(q))
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(q), len(q)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


def point_whitening(covariance: FloatArray, use: NDArray[np.bool_]) -> Whitening:
    """Whitening with every point by itself: ``covariance`` (N, targets, 3, 3) [m²]."""
    blocks = covariance[use]
    index = np.arange(3 * len(blocks)).reshape(-1, 3)
    variance = np.einsum("kii->ki", blocks)
    if not np.count_nonzero(blocks - variance[:, :, None] * np.eye(3)):
        return Whitening((index.reshape(-1, 1),), (1.0 / np.sqrt(variance.reshape(-1, 1)),))
    return Whitening((index,), (np.linalg.inv(np.linalg.cholesky(blocks)),))


def configuration_blocks(labels: IntArray, use: NDArray[np.bool_]) -> tuple[IntArray, ...]:
    """Per block size: (blocks, s) numbers of the equations that share a configuration."""
    owner = np.repeat(labels[:, None], use.shape[1], axis=1)[use]
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner)
    starts = np.cumsum(counts) - counts
    result = []
    for size in np.unique(counts[counts > 0]):
        first = starts[counts == size]
        points = order[first[:, None] + np.arange(size)]
        result.append((3 * points[:, :, None] + np.arange(3)).reshape(len(first), -1))
    return tuple(result)


def block_covariance(index: IntArray, instrument: FloatArray, columns: FloatArray) -> FloatArray:
    """Σ of the blocks of one size: (blocks, s, s) [m²].

    Args:
        index: (blocks, s) numbers of the equations.
        instrument: (points, 3, 3) R of the points in use.
        columns: (equations, K) U with √θ folded in.
    """
    part = columns[index]
    result = part @ np.swapaxes(part, 1, 2)
    points = index[:, ::3] // 3
    for k in range(points.shape[1]):
        result[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += instrument[points[:, k]]
    return result


def block_whitening(blocks: tuple[IntArray, ...], instrument: FloatArray, columns: FloatArray) -> Whitening:
    """Whitening of the whole; arguments as for ``block_covariance``, per block size."""
    factors = tuple(
        np.linalg.inv(np.linalg.cholesky(block_covariance(index, instrument, columns))) for index in blocks
    )
    return Whitening(blocks, factors)
