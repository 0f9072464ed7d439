"""What stays the same while points come and go: the problem at its start, and which parameters can be found."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.identification.checks import SIGNIFICANT, residual_structure
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.least_squares import (
    Equations,
    Fit,
    Motion,
    configuration_labels,
    gauss_newton,
    point_whitening,
)
from calib_planner.identification.noise_levels import (
    FEWEST_REPEATS,
    FEWEST_SPARE,
    DiscrepancyModel,
    NoiseLevels,
    estimate_variances,
    improbable,
    repeat_scatter,
)
from calib_planner.identification.problem import UNKNOWN_SIGMA, IdentificationProblem
from calib_planner.identification.robust import MEDIAN, spread
from calib_planner.robot import Identifiability, Robot, analyse, is_nuisance

FIRST_ITERATIONS = 3
"""Iterations, at most, of the fit that tells how much the points scatter, roughly."""
ROUGHLY = 0.01
"""A step that takes off less than this share of the sum of squares changes nothing of that."""
UNSEEN = 0.05
"""A parameter that the data leave this uncertain is not identified by them [m | rad]."""


@dataclass(frozen=True, eq=False)
class Work:
    """A problem, its robot at the start, the instrument's covariance and which parameters can be found."""

    problem: IdentificationProblem
    motion: Motion
    use: NDArray[np.bool_]  # (N, targets) points that say what can be found
    instrument: FloatArray  # (N, targets, 3, 3); the identity where nothing is known
    source: str
    labels: IntArray
    at: FloatArray  # (P,) deviations where it was asked what can be found
    jacobian: FloatArray  # (N, targets, 3, P) there
    identifiability: Identifiability
    kept: tuple[int, ...]

    @staticmethod
    def of(problem: IdentificationProblem, robot: Robot, use: NDArray[np.bool_]) -> Work:
        """With the points ``use`` (N, targets) saying what can be found."""
        data, names = problem.data, robot.parameter_names
        instrument, source = problem.instrument_covariance()
        motion, at = Motion(robot, data.q), np.zeros(len(names))
        jacobian = motion.at(at)[1]
        found = analyse(jacobian[use].reshape(-1, len(names)), names)
        labels = configuration_labels(data.q)
        work = Work(problem, motion, use, instrument, source, labels, at, jacobian, found, found.free)
        return replace(work, kept=work._with_prior(work.unit, np.zeros(len(names))))

    def told_by(self, use: NDArray[np.bool_]) -> Work:
        """The same at the start, with the points ``use`` (N, targets) saying what can be found."""
        names, at = self.robot.parameter_names, np.zeros(len(self.robot.parameter_names))
        jacobian = self.motion.at(at)[1]
        found = analyse(jacobian[use].reshape(-1, len(names)), names)
        work = replace(self, use=use, at=at, jacobian=jacobian, identifiability=found, kept=found.free)
        return replace(work, kept=work._with_prior(work.unit, at))

    @property
    def robot(self) -> Robot:
        """At the start, its active parameters being the unknowns."""
        return self.motion.robot

    @property
    def lengths(self) -> FloatArray:
        """(kept,) what each parameter kept adds to its predecessors, by the data or the prior [m per unit]."""
        own = dict(zip(self.identifiability.free, self.identifiability.lengths, strict=True))
        return np.array([own.get(k, np.inf) for k in self.kept])

    @property
    def unit(self) -> float:
        """Standard deviation of one coordinate that the instrument has [m]."""
        return float(np.sqrt(np.mean(np.einsum("kii->ki", self.instrument[self.use]))))

    def seeing(self, deviations: FloatArray, lengths: FloatArray, sigma: float) -> Work:
        """The same with what can be seen at ``deviations`` in spite of coordinates that scatter ``sigma`` [m].

        Args:
            lengths: (kept,) what each parameter kept adds to its predecessors there.
        """
        names = self.robot.parameter_names
        placed = np.array([is_nuisance(n) for n in names])
        shortest = np.where(placed, 0.0, sigma / UNSEEN)
        if not (lengths < shortest[list(self.kept)]).any():
            return self
        jacobian = self.motion.at(deviations)[1]
        # What could not be told apart before stays held, though it may differ a little here.
        held = np.isin(np.arange(len(names)), self.identifiability.fixed)
        rows = jacobian[self.use].reshape(-1, len(names))
        found = analyse(rows, names, shortest=np.where(held, np.inf, shortest))
        there = replace(self, at=deviations, jacobian=jacobian, identifiability=found, kept=found.free)
        held = ~np.isin(np.arange(len(names)), self.kept)
        return replace(there, kept=there._with_prior(sigma, np.where(held, np.inf, shortest)))

    def _with_prior(self, sigma: float, shortest: FloatArray) -> tuple[int, ...]:
        """Parameters that the data or the prior can tell."""
        names, prior = self.robot.parameter_names, self.problem.prior
        if prior is None or not self.identifiability.fixed:
            return self.identifiability.free
        # A prior is worth as many metres of the points as their scatter leaves undecided.
        rows = sigma * prior.rows(names, np.zeros(len(names)))[0]
        seen = self.jacobian[self.use].reshape(-1, len(names))
        return analyse(np.vstack([seen, rows]), names, shortest=shortest).free

    def equations(self, use: NDArray[np.bool_], covariance: FloatArray) -> Equations:
        """Point by point, under ``covariance`` (N, targets, 3, 3)."""
        whitening = point_whitening(covariance, use)
        return Equations(self.robot, self.problem.data, use, whitening, self.problem.prior, self.motion)

    def start_values(self, start: Estimate | None) -> FloatArray:
        """(P,) deviations to begin from."""
        if start is None or start.fit.parameters != self.robot.parameter_names:
            return np.zeros(len(self.robot.parameter_names))
        nominal = np.array([p.nominal for p in self.robot.parameters])
        warm = np.zeros(len(nominal))
        warm[list(self.kept)] = (start.fit.values - nominal)[list(self.kept)]
        return warm


def without_unseen(work: Work) -> tuple[Work, FloatArray, bool]:
    """What can be seen in spite of the scatter that a first fit leaves; where that ended; if near the minimum.

    Asked at the start, since a fit may run so far along what it cannot see that it seems to see it; and again
    where the fit ended, since a reflector on the last axis, say, is not there before it has been found.
    """
    first, use = np.zeros(len(work.robot.parameter_names)), work.use
    if work.problem.iterations <= FIRST_ITERATIONS:
        return work, first, False
    equations = work.equations(use, work.instrument)
    fit = gauss_newton(equations, first, work.kept, FIRST_ITERATIONS, gain=ROUGHLY)
    count = int(use.sum())
    squares = np.sum(fit.residuals[: 3 * count].reshape(-1, 3) ** 2, axis=1)
    spare = max(3 * count - len(work.kept), 1) / (3 * count)
    sigma = work.unit * float(np.sqrt(np.median(squares) / MEDIAN / spare))
    seeing = work.seeing(work.at, work.lengths, sigma)
    if seeing is not work:
        fit = gauss_newton(equations, _only(seeing, first), seeing.kept, FIRST_ITERATIONS, gain=ROUGHLY)
    seeing = seeing.seeing(fit.deviations, np.abs(np.diag(fit.triangle)) * fit.scale * work.unit, sigma)
    return seeing, _only(seeing, fit.deviations), fit.converged


def _only(work: Work, deviations: FloatArray) -> FloatArray:
    """Zero but for what is kept."""
    result = np.zeros(len(deviations))
    result[list(work.kept)] = deviations[list(work.kept)]
    return result


# ── Fit some of the points, and find out what they weigh ────────────────────────────────────────────────────
# The first fit takes the instrument's word. Repetitions may contradict it. Residuals that it does not explain
# have a discrepancy (see ``noise_levels``), which the points of a configuration share, and then the covariance of
# least squares is no longer eq. (11) but, with weights W = (R + d² I)⁻¹, d² the mean square of the discrepancy,
#
#     cov(Π̂) = N⁻¹ Jᵀ W Σ W J N⁻¹,     N = Jᵀ W J,     Σ = R + D.
#
# So points count about alike where the discrepancy is larger than their noise. Weights Σ⁻¹ did not predict better
# on measured robots, and rest on more assumptions (docs/theory.md).
#
# Where no instrument says anything, the residuals give the scale, eq. (11) with σ̂². If the targets of one
# configuration then err alike, it is two scales: what differs between them is the measurement, what they share is
# the robot.

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
