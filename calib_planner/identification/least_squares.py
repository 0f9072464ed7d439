"""Gauss–Newton with Levenberg–Marquardt damping: the paper's iteration, eqs. (6) and (7).

Linearise at the current parameters, eq. (3); solve min ‖J ΔΠ − Δp‖² for the whitened Jacobian of an irreducible
set of parameters, its columns scaled to unit length; add ΔΠ; repeat. A step that does not lower the sum of
squares is damped: the plain iteration is what happens when nothing goes wrong. Only the triangle of
[J Δp] = Q R is formed, which holds the step, the new sum of squares and the covariance, eq. (11), and keeps the
digits that normal equations would lose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from calib_planner._arrays import FloatArray
from calib_planner.identification.equations import Equations

STEP_TOLERANCE = 1e-9
"""A step that moves the predictions by less than this share of the residuals ends the iteration."""
STEP_FLOOR = 1e-9
"""The same without residuals, in standard deviations."""
ROUNDING = 1e-9
"""A sum of squares that is larger by this share at most is not larger: near the minimum rounding decides."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Where the iteration ended.

    Attributes:
        deviations: (P,) of all active parameters [m | rad]; 0 where held.
        kept: Indices of the parameters solved for, the order of ``triangle``.
        triangle: (kept, kept) R of the scaled whitened Jacobian, prior rows included.
        scale: (kept,) column lengths that were divided out.
        residuals: (equations + prior rows,) whitened.
        iterations: Linear problems solved.
        converged: Whether the last step was negligible, or the next one not worth making.
    """

    deviations: FloatArray
    kept: tuple[int, ...]
    triangle: FloatArray
    scale: FloatArray
    residuals: FloatArray
    iterations: int
    converged: bool

    @property
    def cost(self) -> float:
        """Sum of squares of the whitened residuals, prior rows included."""
        return float(self.residuals @ self.residuals)

    def covariance(self) -> FloatArray:
        """(P, P) eq. (11) for equations of unit variance; zero rows and columns where held."""
        result = np.zeros((len(self.deviations),) * 2)
        if self.kept:
            half = solve_triangular(self.triangle, np.eye(len(self.kept))) / self.scale[:, None]
            result[np.ix_(self.kept, self.kept)] = half @ half.T
        return result


def gauss_newton(
    equations: Equations,
    start: FloatArray,
    kept: tuple[int, ...],
    most: int,
    enough: float = 0.0,
    gain: float = 0.0,
) -> Fit:
    """Minimise the sum of squares over the parameters ``kept``.

    Args:
        equations: What is to be fitted.
        start: (P,) deviations to begin from; those not kept stay as they are.
        kept: Indices of an irreducible set of parameters.
        most: Most iterations.
        enough: Sum of squares below which it need not go on.
        gain: Share of the sum of squares that a step must promise to take off to be worth making.
    """
    columns = list(kept)
    deviations = start
    residuals, jacobian = equations.linearise(deviations)
    triangle, scale, right = _triangle(jacobian[:, columns], residuals)
    damping, done, converged = 0.0, 0, not columns
    while done < most and not converged:
        if not damping and right @ right < gain * (residuals @ residuals):
            converged = True
            break
        done += 1
        step = _step(triangle, right, damping)
        trial = deviations.copy()
        trial[columns] += step / scale
        size = float(np.linalg.norm(triangle @ step))
        converged = bool(size <= STEP_FLOOR + STEP_TOLERANCE * np.linalg.norm(residuals))
        if converged and not damping:
            # Nothing changes by so small a step but the parameters that hardly anything depends on.
            equations.motion.carry(deviations, trial)
            deviations, residuals = trial, residuals - jacobian[:, columns] @ (step / scale)
            break
        cost, new_cost = float(residuals @ residuals), np.inf
        if np.isfinite(trial).all():
            # With its Jacobian at once: hardly any step is refused.
            new, new_jacobian = equations.linearise(trial)
            new_cost = float(new @ new)
        if new_cost <= (1.0 + ROUNDING) * cost:
            deviations, residuals, jacobian = trial, new, new_jacobian
            triangle, scale, right = _triangle(jacobian[:, columns], residuals)
            damping = 0.0 if damping < 1e-6 else damping / 10
        else:
            damping = max(10 * damping, 1e-6)
        converged = converged or new_cost <= enough
    return Fit(deviations, tuple(kept), triangle, scale, residuals, done, converged)


def _triangle(jacobian: FloatArray, residuals: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """R (p, p), column lengths (p,) and Qᵀ Δp (p,)."""
    p = jacobian.shape[1]
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    augmented = np.asarray(np.linalg.qr(np.column_stack([jacobian / scale, residuals]), mode="r"))
    return np.ascontiguousarray(augmented[:p, :p]), scale, augmented[:p, p].copy()


def _step(triangle: FloatArray, right: FloatArray, damping: float) -> FloatArray:
    """The scaled step; where the triangle has lost rank on the way, the shortest one."""
    p = len(right)
    if damping:
        padded = np.vstack([triangle, np.sqrt(damping) * np.eye(p)])
        return np.asarray(np.linalg.lstsq(padded, np.append(right, np.zeros(p)), rcond=None)[0])
    diagonal = np.abs(np.diag(triangle))
    if diagonal.min() > 1e-13 * diagonal.max():
        return np.asarray(solve_triangular(triangle, right))
    return np.asarray(np.linalg.lstsq(triangle, right, rcond=1e-13)[0])
