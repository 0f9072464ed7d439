"""What a set of configurations tells about the parameters: the information matrix of eqs. (10) and (11).

Measuring configuration q r times gives, with the point covariance Σ(p) of the instrument and an error of the
configuration itself that repetition does not average away (robot repeatability, standard deviation σ_c),

    I(q) = J(q)ᵀ W(q) J(q),      W = (Σ(p(q))/r + σ_c² I)⁻¹  per target,
    M = M_0 + Σ_i I(q_i),        cov(Π̂) = M⁻¹,

M_0 being what is known beforehand (prior standard deviations, earlier measurements). For Σ = σ² I, σ_c = 0 and
M_0 = 0 this is eq. (11). All matrices are in physical units, 1/(parameter unit)².

Gradient. For ψ(M) with slope G, dψ = Σ_i tr(G dI(q_i)) and

    tr(G dI) = 2 tr(G Jᵀ W dJ) − tr(K dΣ)/r,     K = W J G Jᵀ W  per target:

the first term goes back to the joints by ``Linearisation.pull_back``, the second by ∂Σ/∂p and ∂p/∂q.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.instrument.noise import Isotropic, Noise, covariance_gradient
from calib_planner.robot.chain import Robot
from calib_planner.robot.linearisation import Linearisation

RANK_TOLERANCE = 1e-9
"""Eigenvalues of a scaled information matrix below this share of the largest count as zero."""


@dataclass(frozen=True, eq=False)
class InformationModel:
    """How configurations turn into information.

    Attributes:
        robot: Its active parameters are the order of all matrices.
        noise: Covariance of one measured point.
        configuration_sigma: σ_c [m].
        repetitions: r, measurements at each configuration.
    """

    robot: Robot
    noise: Noise
    configuration_sigma: float = 0.0
    repetitions: int = 1

    def at(self, q: FloatArray) -> FloatArray:
        """I(q) of each configuration: (N, joints) → (N, p, p)."""
        points, jacobian = self.robot.positions_and_jacobian(q)
        jacobian = np.ascontiguousarray(jacobian)
        return np.swapaxes(jacobian, 1, 2) @ self._weigh(points, jacobian)

    def whitened(self, q: FloatArray) -> FloatArray:
        """Rows W^½ J with I(q) = rowsᵀ rows: (N, joints) → (N, 3·targets, p)."""
        points, jacobian = self.robot.positions_and_jacobian(q)
        jacobian = np.ascontiguousarray(jacobian)
        if isinstance(self.noise, Isotropic):
            return jacobian / np.sqrt(self.noise.sigma**2 / self.repetitions + self.configuration_sigma**2)
        whitener = np.linalg.inv(np.linalg.cholesky(self._covariance(points)))
        return (whitener @ jacobian.reshape(*points.shape, -1)).reshape(jacobian.shape)

    def linearised(self, q: FloatArray) -> LinearisedInformation:
        """The same with what its gradient needs."""
        lin = self.robot._linearise(q, np.zeros(len(self.robot.parameter_names)))
        jacobian = lin.jacobian()
        weighted = self._weigh(lin.points.transpose(2, 0, 1), jacobian)
        return LinearisedInformation(self, lin, jacobian, weighted)

    def _weigh(self, points: FloatArray, jacobian: FloatArray) -> FloatArray:
        """W J, (N, 3·targets, p)."""
        if isinstance(self.noise, Isotropic):
            variance = self.noise.sigma**2 / self.repetitions + self.configuration_sigma**2
            return jacobian / variance
        blocks = jacobian.reshape(*points.shape, -1)
        return (np.linalg.inv(self._covariance(points)) @ blocks).reshape(jacobian.shape)

    def _covariance(self, points: FloatArray) -> FloatArray:
        common = self.configuration_sigma**2 * np.eye(3)
        return self.noise.covariance(points) / self.repetitions + common


@dataclass(frozen=True, eq=False)
class LinearisedInformation:
    """I(q) at a batch of configurations, ready to be differentiated.

    Attributes:
        model: Where it comes from.
        lin: The chain's linearisation.
        jacobian: (N, 3·targets, p) J.
        weighted: (N, 3·targets, p) W J.
    """

    model: InformationModel
    lin: Linearisation
    jacobian: FloatArray
    weighted: FloatArray

    def sums(self, size: int) -> FloatArray:
        """Σ I over each run of ``size`` configurations: (N/size, p, p)."""
        rows, p = size * self.jacobian.shape[1], self.jacobian.shape[2]
        left = self.jacobian.reshape(-1, rows, p)
        return np.swapaxes(left, 1, 2) @ self.weighted.reshape(-1, rows, p)

    def gradient(self, slopes: FloatArray) -> FloatArray:
        """∂ψ/∂q (N, joints) for slopes G: (N/size, p, p), each serving a run of ``size`` configurations."""
        n, rows, p = self.jacobian.shape
        targets = rows // 3
        size = n // len(slopes)
        pull = (self.weighted.reshape(len(slopes), size * rows, p) @ slopes).reshape(n, rows, p)
        weights = 2.0 * pull.transpose(2, 1, 0)
        gradient = self.lin.pull_back(weights.reshape(p, targets, 3, n))
        noise = self.model.noise
        if isinstance(noise, Isotropic):
            return gradient
        points = self.lin.points.transpose(2, 0, 1)
        blocks = pull.reshape(n, targets, 3, p) @ np.swapaxes(self.weighted.reshape(n, targets, 3, p), -1, -2)
        slope = covariance_gradient(noise, points) / self.model.repetitions
        force = -np.einsum("ntij,ntijx->ntx", blocks, slope)
        return gradient + np.einsum("ntx,jtxn->nj", force, self.lin.joint_columns)


def covariance(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse of an information matrix on the space it spans, and a basis of the rest.

    Scaled to unit diagonal first, so that the rank does not depend on the units of the parameters.

    Returns:
        (p, p) pseudo-inverse, and (p, p − rank) directions that the data cannot see (unit columns).
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
    """ρ0² of eq. (14) for J0 (3·targets, p): infinite if J0 needs what the plan cannot see.

    With several targets, the mean over the targets of the squared distance.
    """
    inverse, hidden = covariance(matrix)
    if hidden.size and np.abs(test_jacobian @ hidden).max() > 1e-6 * np.abs(test_jacobian).max():
        return float("inf")
    targets = test_jacobian.shape[0] / 3
    return float(np.einsum("ij,jk,ik->", test_jacobian, inverse, test_jacobian)) / targets
