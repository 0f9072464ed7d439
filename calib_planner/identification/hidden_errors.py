"""What could turning joints do that these data would not show? Then the values hold only where it was measured.

A joint's transmission errs by φ_l(q_l) (see ``transmission``). Where all configurations stand round one posture,
φ_l is hardly more than a constant there and its joint's zero takes it up: the fit is as good as ever, and so is a
prediction nearby, but the zero is not the robot's. Spread configurations show the same error in their residuals.

Take coefficients c of smooth errors, c ~ N(0, S), S the kernel's variances at ``LENGTH`` (shorter waves show
earlier) and amplitude ``TYPICAL``, B = ∂p/∂c. With the weights of the fit, J Jacobian, C = (Jᵀ J + prior)⁻¹,

    parameters move by D c,  D = C Jᵀ B;     a prediction at * errs by (B* − J* D) c;

and with the residuals whitened by all of their scatter, P⊥ what a fit leaves of them, ν their degrees of freedom,

    ‖r‖² = Σ (1 + λ_i) χ²₁ + χ²_rest,     λ eigenvalues of S^½ Bᵀ P⊥ B S^½.

They are *hidden* if the test of ``noise_levels.improbable`` finds ‖r‖² too large in no more than every other case
(a χ² with the same two moments, Satterthwaite 1946). Where the residuals themselves told how much they scatter
there is no such test; but errors that leave more than all of it, Σ λ > ν, are not there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as fisher_f

from calib_planner._arrays import FloatArray, frozen
from calib_planner.identification.equations import Equations
from calib_planner.identification.least_squares import Fit
from calib_planner.identification.noise_levels import DOUBT, FEWEST_SPARE, NoiseLevels
from calib_planner.identification.transmission import model_columns, prior_variances, spectrum
from calib_planner.robot.joint_corrections import JointCorrections, phases

TYPICAL = 1e-4
"""Amplitude of a good robot's transmission errors: the two measured ones have four times that or more [rad]."""
LENGTH = 1.2
"""Angle over which they are alike: a wave or two per turn, those that a small region shows least [rad]."""
SEEN = 0.5
"""Probability of being found from which errors are not hidden."""


@dataclass(frozen=True, eq=False)
class HiddenErrors:
    """Errors of the joints' transmissions that these data would hardly have shown, and what they would do.

    Attributes:
        amplitude: Their standard deviation [rad].
        length: Angle over which they are alike [rad].
        probability: Of having been found.
        shifts: (P,) root mean square of what they move each parameter by; 0 where held [m | rad].
        at_test_poses: (K,) root mean square distance that they put a prediction off by [m].
    """

    amplitude: float
    length: float
    probability: float
    shifts: FloatArray
    at_test_poses: FloatArray


def hidden_errors(
    equations: Equations, whole: Equations, fit: Fit, levels: NoiseLevels, poses: FloatArray
) -> HiddenErrors | None:
    """Ask.

    Args:
        equations: Of the finished fit; says which points count.
        whole: The same whitened by all of their scatter (see ``order_check.wholly_whitened``).
        fit: Where it ended.
        levels: The parts of the scatter.
        poses: (K, joints) test poses.

    Returns:
        ``None`` if the data would have shown them.
    """
    robot, use, kept = equations.robot, equations.use, list(fit.kept)
    here = robot.with_deviations(dict(zip(robot.parameter_names, fit.deviations, strict=True)))
    scale, shift = phases(robot)
    none = np.zeros((len(scale), len(spectrum(LENGTH))))
    straight = JointCorrections(robot.joint_names, scale, shift, none, none)
    turning = np.where(robot.joint_is_revolute[:, None], prior_variances(LENGTH, TYPICAL, scale), 0.0)
    size = np.sqrt(np.tile(np.ravel(turning), 2))
    waves = model_columns(here, straight, equations.data.q, [])[use].reshape(-1, len(size)) * size
    rows, columns = _whitened(equations, fit, waves)
    moved = np.zeros((len(robot.parameter_names), len(size)))
    moved[kept] = fit.covariance()[np.ix_(kept, kept)] @ (rows.T @ columns)
    if whole is not equations:
        rows, columns = _whitened(whole, fit, waves)
    basis = np.linalg.qr(rows)[0]
    absorbed = basis.T @ columns
    left = np.maximum(np.linalg.eigvalsh(columns.T @ columns - absorbed.T @ absorbed), 0.0)
    probability = _found(left, len(rows) - len(kept), levels)
    if probability > SEEN:
        return None
    there = np.zeros((len(poses), 3 * len(robot.targets), len(size)))
    if len(poses):
        there += model_columns(here, straight, poses, []).reshape(there.shape) * size
        there -= here.jacobian(poses) @ moved
    return HiddenErrors(
        amplitude=TYPICAL,
        length=LENGTH,
        probability=probability,
        shifts=frozen(np.sqrt(np.sum(moved**2, axis=1))),
        at_test_poses=frozen(np.sqrt(np.sum(there**2, axis=(1, 2)) / len(robot.targets))),
    )


def _whitened(equations: Equations, fit: Fit, waves: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(equations + prior rows, kept) Jacobian and (…, coefficients) of the errors, none in the prior."""
    rows = equations.linearise(fit.deviations)[1][:, list(fit.kept)]
    columns = np.zeros((len(rows), waves.shape[1]))
    columns[: len(waves)] = equations.whitening.apply(waves)
    return rows, columns


def _found(left: FloatArray, freedom: int, levels: NoiseLevels) -> float:
    """Probability that the residuals show errors that leave ``left`` (λ) in them."""
    more = float(left.sum())
    if levels.source == "residuals" or levels.discrepancy > 0:
        return float(more > freedom)
    repeats = levels.repeat_freedom if levels.source == "repetitions" else 0
    rest = freedom - repeats
    if rest < FEWEST_SPARE:
        return 0.0
    limit = rest * fisher_f.isf(DOUBT, rest, repeats) if repeats else chi2.isf(DOUBT, rest)
    mean, variance = rest + more, 2.0 * (rest + 2.0 * more + float(np.sum(left**2)))
    return float(chi2.sf(limit * 2.0 * mean / variance, 2.0 * mean**2 / variance))
