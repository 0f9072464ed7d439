"""Fit some of the points, and find out what they weigh.

The first fit takes the instrument's word. Repetitions may contradict it. Residuals that it does not explain have
a discrepancy (see ``noise_levels``), which the points of a configuration share, and then the covariance of least
squares is no longer eq. (11) but, with weights W = (R + d² I)⁻¹, d² the mean square of the discrepancy,

    cov(Π̂) = N⁻¹ Jᵀ W Σ W J N⁻¹,     N = Jᵀ W J,     Σ = R + D.

So points count about alike where the discrepancy is larger than their noise. Weights Σ⁻¹ did not predict better
on measured robots, and rest on more assumptions (docs/theory.md).

Where no instrument says anything, the residuals give the scale, eq. (11) with σ̂². If the targets of one
configuration then err alike, it is two scales: what differs between them is the measurement, what they share is
the robot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_planner._arrays import FloatArray
from calib_planner.identification.equations import Equations
from calib_planner.identification.least_squares import Fit, gauss_newton
from calib_planner.identification.noise_levels import (
    FEWEST_REPEATS,
    FEWEST_SPARE,
    DiscrepancyModel,
    NoiseLevels,
    estimate_variances,
    improbable,
    repeat_scatter,
)
from calib_planner.identification.problem import UNKNOWN_SIGMA
from calib_planner.identification.robust import spread
from calib_planner.identification.structure import SIGNIFICANT, residual_structure
from calib_planner.identification.work import Work

LEAST_SCATTER = 1e-8
"""Repetitions that agree better than this are copies, and say nothing of the noise [m]."""
LEAST_SPARE = 0.5
"""Degrees of freedom below which residuals say nothing of the noise."""
TINY = 1e-6
"""Share of the stand-in covariance that keeps matrices regular where the noise is estimated anew."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """A fit to some of the points and what it says about the scatter."""

    equations: Equations
    fit: Fit
    levels: NoiseLevels
    total: FloatArray  # (N, targets, 3, 3) Σ of each point, discrepancy included
    cross: FloatArray  # (N, targets, 3, 3) covariance of each used point's prediction with its error
    covariance: FloatArray  # (P, P) cov(Π̂)
    chi_square: float  # of measurement noise alone
    freedom: int

    @property
    def rows(self) -> FloatArray:
        """(N, targets, 3, P) ∂p/∂Π where the fit ended."""
        return self.equations.motion.at(self.fit.deviations)[1]

    @property
    def residuals(self) -> FloatArray:
        """(N, targets, 3) measured − predicted [m]."""
        return self.equations.data.p - self.equations.motion.at(self.fit.deviations)[0]

    def residual_covariance(self) -> FloatArray:
        """(N, targets, 3, 3) of measured − predicted: Σ + JCJᵀ, and less its cross terms where a point took part.

        With W = Σ⁻¹ the cross terms are JCJᵀ, and Σ − JCJᵀ is left.
        """
        rows = self.rows
        known = bool(np.isfinite(self.covariance).all())
        covariance = self.covariance if known else self.fit.covariance()
        cross = self.cross + np.swapaxes(self.cross, 2, 3)
        inside = np.where(self.equations.use[:, :, None, None], cross, 0.0)
        # A point that alone determines a parameter has no residual variance: a floor keeps 0/0 at 0.
        return (1.0 + 1e-6) * self.total + spread(rows, covariance) - inside


def weigh(work: Work, use: NDArray[np.bool_], first: FloatArray, like: NoiseLevels | None = None) -> Weighed:
    """Fit the points in use and split the scatter.

    Args:
        work: What is asked.
        use: (N, targets) points in use.
        first: (P,) deviations to begin from.
        like: Levels of nearly the same points, to begin from.
    """
    most = work.problem.iterations
    instrument, source = work.instrument, work.source
    equations = work.equations(use, instrument)
    fit = gauss_newton(equations, first, work.kept, most)
    seen = 3 * int(use.sum())
    freedom = len(fit.residuals) - len(work.kept)
    scatter, repeats = repeat_scatter(_whole(equations, fit), work.labels, use)
    unit = float(np.sqrt(np.mean(np.einsum("kii->k", instrument[use])) / 3.0))
    repeatability = float(np.sqrt(scatter)) * unit if repeats else float("nan")
    scaled = 1.0
    if (
        repeats >= FEWEST_REPEATS
        and repeatability > LEAST_SCATTER
        and (source == "residuals" or improbable(scatter * repeats, repeats))
    ):
        instrument = scatter * instrument
        scaled, source = (1.0, "repetitions") if source == "residuals" else (float(np.sqrt(scatter)), source)
        equations = work.equations(use, instrument)
        fit = gauss_newton(equations, fit.deviations, work.kept, most)
    levels = NoiseLevels(0.0, source, scaled, repeatability, repeats)
    if source == "residuals":
        found = _with_scale(work, equations, fit, levels, freedom)
        apart = work.problem.discrepancy == "auto" and freedom >= FEWEST_SPARE and _targets_err_alike(work, found)
        return _with_discrepancy(work, found, TINY * instrument, like) if apart else found
    cost = fit.cost
    levels = replace(levels, measurement=float(np.sqrt(np.mean(np.einsum("kii->k", instrument[use])) / 3.0)))
    covariance = fit.covariance()
    cross = spread(equations.motion.at(fit.deviations)[1], covariance)
    found = Weighed(equations, fit, levels, instrument, cross, covariance, cost, freedom)
    told_by = repeats if source == "repetitions" else 0
    if work.problem.discrepancy == "off" or not improbable(cost, freedom, told_by) or seen <= len(work.kept):
        return found
    return _with_discrepancy(work, found, instrument, like)


def _with_scale(work: Work, equations: Equations, fit: Fit, levels: NoiseLevels, freedom: int) -> Weighed:
    """The noise level from the residuals themselves, eq. (11) with σ̂²."""
    instrument, scale = work.instrument, 1.0
    # Without a prior the parameters do not depend on the scale; with one, both settle together.
    for _ in range(1 if equations.prior is None else 20):
        own = fit.residuals[: 3 * int(equations.use.sum())]
        prior, _ = equations.prior_rows(fit.deviations)
        # Parameters that the prior decides cost the data no degree of freedom.
        spare = len(own) - len(fit.kept) + float(np.trace(prior @ fit.covariance() @ prior.T))
        factor = float(own @ own) / spare if freedom > 0 and spare > LEAST_SPARE else float("nan")
        if equations.prior is None or not np.isfinite(factor) or abs(factor - 1.0) < 1e-6:
            break
        least = (LEAST_SCATTER / UNKNOWN_SIGMA) ** 2
        if scale * factor < least:
            break
        scale *= factor
        equations = work.equations(equations.use, scale * instrument)
        fit = gauss_newton(equations, fit.deviations, work.kept, work.problem.iterations)
    unit = float(np.sqrt(instrument[0, 0, 0, 0]))
    levels = replace(levels, measurement=float(np.sqrt(factor * scale)) * unit)
    weights = scale * instrument
    total = (factor if np.isfinite(factor) else 1.0) * weights
    covariance = (factor if equations.prior is None else 1.0) * fit.covariance()
    known = covariance if np.isfinite(factor) else fit.covariance()
    cross = spread(equations.motion.at(fit.deviations)[1], known)
    return Weighed(equations, fit, levels, total, cross, covariance, float("nan"), freedom)


def _with_discrepancy(work: Work, found: Weighed, instrument: FloatArray, like: NoiseLevels | None) -> Weighed:
    """The same points with the scatter that they have, discrepancy included."""
    equations, data, columns = found.equations, work.problem.data, list(found.fit.kept)
    model = DiscrepancyModel.of(equations, instrument, work.labels)
    jacobian = found.rows
    rows = jacobian[equations.use].reshape(-1, jacobian.shape[-1])[:, columns]
    prior = equations.prior_rows(found.fit.deviations)
    residuals = found.residuals[equations.use].ravel()
    start = None if like is None else np.array([getattr(like, name) ** 2 for name in model.names])
    variances = estimate_variances(model, residuals, rows, (prior[0][:, columns], prior[1]), start)
    weights = instrument + model.mean_square(variances) * np.eye(3)
    equations = work.equations(equations.use, weights)
    fit = gauss_newton(equations, found.fit.deviations, found.fit.kept, work.problem.iterations)
    levels = replace(found.levels, **dict(zip(model.names, np.sqrt(variances).tolist(), strict=True)))
    measured, left = instrument, variances
    if levels.source == "residuals":
        # What differs between the targets of a configuration cannot be told from the measurement.
        levels = replace(levels, measurement=levels.point, point=0.0)
        measured = instrument + levels.measurement**2 * np.eye(3)
        left = np.where([n == "point" for n in model.names], 0.0, variances)
    levels = replace(levels, discrepancy=float(np.sqrt(model.mean_square(left))))
    covariance, cross = _sandwich(equations, fit, model, variances, weights)
    total = measured + levels.discrepancy_covariance(work.robot, data.q)
    return replace(
        found, equations=equations, fit=fit, levels=levels, total=total, cross=cross, covariance=covariance
    )


def _sandwich(
    equations: Equations, fit: Fit, model: DiscrepancyModel, variances: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """For W⁻¹ = ``weights``: N⁻¹ (JᵀWΣWJ + prior) N⁻¹, and JN⁻¹JᵀWΣ of each point with itself."""
    use, inverse = equations.use, fit.covariance()
    rows = equations.motion.at(fit.deviations)[1]
    pulled = np.linalg.solve(weights[use], rows[use])
    columns = np.hstack([np.sqrt(v) * c for v, c in zip(variances, model.columns, strict=True)])
    # ΣWJ, block by block: the instrument's part of each point, and what the points of a configuration share.
    mixed = (model.instrument @ pulled).reshape(len(columns), -1)
    flat = pulled.reshape(mixed.shape)
    for index in model.blocks:
        part = columns[index]
        mixed[index] += part @ (np.swapaxes(part, 1, 2) @ flat[index])
    prior, _ = equations.prior_rows(fit.deviations)
    covariance = inverse @ (flat.T @ mixed + prior.T @ prior) @ inverse
    cross = np.zeros((*use.shape, 3, 3))
    cross[use] = rows[use] @ inverse @ np.swapaxes(mixed.reshape(pulled.shape), 1, 2)
    return covariance, cross


def _targets_err_alike(work: Work, found: Weighed) -> bool:
    use = found.equations.use
    if use.shape[1] < 2:
        return False
    structure = residual_structure(work.robot, work.problem.data.q, found.residuals, use, work.labels)
    return any(s.kind == "configuration" and s.probability < SIGNIFICANT for s in structure)


def _whole(equations: Equations, fit: Fit) -> FloatArray:
    """(N, targets, 3) whitened residuals of the points in use; zero elsewhere."""
    whole = np.zeros(equations.data.p.shape)
    count = 3 * int(equations.use.sum())
    whole[equations.use] = fit.residuals[:count].reshape(-1, 3)
    return whole
