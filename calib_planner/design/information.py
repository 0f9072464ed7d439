"""What a set of configurations tells about the parameters: the information matrix of eq. (10) and (11).

    M = Σ_i r_i · J_iᵀ J_i / σ²,        cov(Π̂) = M⁻¹

with r_i repetitions at configuration i and the standard deviation σ of one coordinate of one point. All
matrices here are for σ = 1; whoever reports metres multiplies by σ.
"""

from __future__ import annotations

import numpy as np

from calib_planner._arrays import FloatArray

RANK_TOLERANCE = 1e-9
"""Eigenvalues of a scaled information matrix below this share of the largest count as zero."""


def information(jacobians: FloatArray, repetitions: FloatArray) -> FloatArray:
    """M for σ = 1: ``jacobians`` (m, 3·targets, P), ``repetitions`` (m,); returns (P, P)."""
    weighted = jacobians * np.sqrt(repetitions)[:, None, None]
    stacked = weighted.reshape(-1, jacobians.shape[-1])
    return stacked.T @ stacked


def covariance(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse of an information matrix on the space it spans, and a basis of the rest.

    Scaled to unit diagonal first, so that the rank does not depend on the units of the parameters.

    Returns:
        (P, P) pseudo-inverse, and (P, P − rank) directions that the data cannot see (unit columns).
    """
    diagonal = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale = np.where(diagonal > 0, diagonal, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    seen = values > RANK_TOLERANCE * max(float(values[-1]), 1e-300)
    basis = vectors[:, seen] / scale[:, None]
    hidden = vectors[:, ~seen] / scale[:, None]
    if hidden.size:
        hidden = hidden / np.linalg.norm(hidden, axis=0)
    return (basis / values[seen]) @ basis.T, hidden


def error_variance(test_jacobian: FloatArray, matrix: FloatArray) -> float:
    """ρ0²/σ² of eq. (14) for J0 (3·targets, P): infinite if J0 needs what the plan cannot see.

    With several targets, the mean over the targets of the squared distance.
    """
    inverse, hidden = covariance(matrix)
    if hidden.size and np.abs(test_jacobian @ hidden).max() > 1e-6 * np.abs(test_jacobian).max():
        return float("inf")
    targets = test_jacobian.shape[0] / 3
    return float(np.einsum("ij,jk,ik->", test_jacobian, inverse, test_jacobian)) / targets
