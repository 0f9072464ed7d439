"""What a plan is worth: scalar functions of the information matrix M (see ``information``, σ = 1).

A criterion gives, for a batch of information matrices, its value and slope ∂value/∂M. Everything else —
gradients in the joints, exchange, the lower bound — follows from those two by the chain rule.

Linear criterion. With A = Σ_k w_k J_kᵀJ_k / Σ_k w_k over the test poses k,

    ρ0² = trace(A M⁻¹),        ∂ρ0²/∂M = −M⁻¹ A M⁻¹,                                    eq. (14)

which is convex in M and homogeneous of degree −1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray


@dataclass(frozen=True)
class LinearCriterion:
    """trace(A M⁻¹) to be minimised: eq. (14) for one or more test poses.

    Attributes:
        weight: (P, P) the matrix A, symmetric and positive semi-definite [m²/unit²].
    """

    weight: FloatArray

    def value_and_slope(self, matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``matrices`` (S, P, P) → values (S,) [m²/m²], slopes (S, P, P)."""
        inverse = np.linalg.inv(matrices)
        half = inverse @ self.weight
        return np.trace(half, axis1=1, axis2=2), -(half @ inverse)


def accuracy_weight(jacobians: FloatArray, weights: FloatArray) -> FloatArray:
    """A of eq. (14): ``jacobians`` (K, 3·targets, P) at the test poses, ``weights`` (K,); returns (P, P)."""
    share = weights / weights.sum() / (jacobians.shape[1] / 3)
    return np.einsum("k,kia,kib->ab", share, jacobians, jacobians)
