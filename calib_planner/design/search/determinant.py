"""Exact changes of log det M over a whole pool at once.

Row blocks R_j = W^½ J_j (k, p) give the information I_j = R_jᵀ R_j. With K_j = R_j M⁻¹ R_jᵀ (k, k), the matrix
determinant lemma says what adding candidate j is worth,

    log det(M + I_j) = log det M + log det(I + K_j),                                                      (1)

for every j of the pool from one product. Taking out row i changes M⁻¹ by Woodbury's identity: with
V = M⁻¹ R_iᵀ, S = I − K_i and X_j = R_j V,

    (M − I_i)⁻¹ = M⁻¹ + V S⁻¹ Vᵀ,      K_j ← K_j + X_j S⁻¹ X_jᵀ,                                          (2)

and adding does the same with S = I + K_i and a minus. So one trial exchange with *all* C candidates costs
O(C k² p), without a factorisation per candidate (Fedorov 1972; Miller and Nguyen 1994 for k = 1).

Rows are scaled by the Cholesky factor of the pool's mean information, which changes log det M by a constant;
a ridge of ``RIDGE`` times that mean keeps M invertible while rows are out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray, IntArray

RIDGE = 1e-9
"""Share of the pool's information that is always added; it moves log det M by about p·RIDGE."""


@dataclass(frozen=True, eq=False)
class PoolRows:
    """Scaled rows of a pool for one determinant.

    Attributes:
        rows: (C, k, p) R_j in coordinates in which the pool's mean information plus prior is I.
        prior: (p, p) M_0 in the same coordinates, ridge included.
        offset: log det of the scaling, to be added to log det M.
    """

    rows: FloatArray
    prior: FloatArray
    offset: float


def pool_rows(rows: FloatArray, prior: FloatArray, size: int) -> PoolRows:
    """Scale ``rows`` (C, k, p) for plans of ``size`` rows; the pool must identify all p parameters."""
    flat = rows.reshape(-1, rows.shape[2])
    mean = size * (flat.T @ flat) / len(rows) + prior
    units = np.sqrt(np.diag(mean))
    triangle = np.linalg.cholesky(mean / np.outer(units, units))
    scaled = np.linalg.solve(triangle, (flat / units).T).T
    inner = np.linalg.solve(triangle, prior / np.outer(units, units))
    ground = np.linalg.solve(triangle, inner.T) + RIDGE * np.eye(len(prior))
    offset = 2.0 * float(np.log(np.diag(triangle)).sum() + np.log(units).sum())
    return PoolRows(np.ascontiguousarray(scaled).reshape(rows.shape), 0.5 * (ground + ground.T), offset)


class RunningDeterminant:
    """log det M of a growing and shrinking choice, and what every candidate would add.

    Attributes:
        log_det: log det M, in physical units.
        leverage: (k, k, C) K_j of every candidate.
        strained: Taking a row out left M nearly singular, which costs digits: ``reset`` soon.
    """

    def __init__(self, pool: PoolRows, chosen: IntArray) -> None:
        self.pool = pool
        count, k, p = pool.rows.shape
        self._columns = np.ascontiguousarray(pool.rows.transpose(2, 1, 0)).reshape(p, k * count)
        self.reset(chosen)

    def reset(self, chosen: IntArray) -> None:
        """Start afresh from ``chosen``, free of accumulated rounding."""
        own = self.pool.rows[chosen].reshape(-1, self.pool.rows.shape[2])
        matrix = self.pool.prior + own.T @ own
        self.inverse = np.linalg.inv(matrix)
        self.inverse = 0.5 * (self.inverse + self.inverse.T)
        self.log_det = float(np.linalg.slogdet(matrix)[1]) + self.pool.offset
        half = self.pool.rows @ self.inverse
        blocks = half @ np.swapaxes(self.pool.rows, 1, 2)
        self.leverage = np.ascontiguousarray(blocks.transpose(1, 2, 0))
        self.strained = False

    def gains(self) -> FloatArray:
        """(C,) log det(I + K_j), eq. (1)."""
        return log_det_plus_identity(self.leverage)

    def change(self, row: int, sign: int) -> None:
        """Add (``sign`` = 1) or take out (−1) one row, eq. (2)."""
        lever = self.inverse @ self.pool.rows[row].T
        small = np.eye(lever.shape[1]) + sign * self.leverage[:, :, row]
        values, vectors = np.linalg.eigh(small)
        self.strained = self.strained or values[0] < 1e-6
        values = np.maximum(values, 1e-12)
        whitened = lever @ (vectors / np.sqrt(values))
        self.inverse -= sign * whitened @ whitened.T
        seen = (whitened.T @ self._columns).reshape(whitened.shape[1], *self.leverage.shape[1:])
        for one in seen:  # (k, C) at a time: long contiguous runs
            for block, part in zip(self.leverage, sign * one, strict=True):
                block -= part * one
        self.log_det += float(np.log(values).sum())


def log_det_plus_identity(blocks: FloatArray) -> FloatArray:
    """log det(I + K) of positive semi-definite blocks (k, k, C)."""
    k = len(blocks)
    if k != 3:
        return np.asarray(np.linalg.slogdet(np.eye(k) + blocks.transpose(2, 0, 1))[1], np.float64)
    a, b, c = blocks[0, 0] + 1.0, blocks[1, 1] + 1.0, blocks[2, 2] + 1.0
    d, e, f = blocks[0, 1], blocks[0, 2], blocks[1, 2]
    return np.log(np.maximum(a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e), 1e-300))
