"""Identification: from measurements to parameters, in the order in which doubt is resolved.

1. start       tracker pose and targets in closed form (``registration``)
2. which       an irreducible set of parameters (``design.identifiability``)
3. who         points to believe, if the loss is robust (``robust``)
4. how much    the paper's iteration with weights (``least_squares``), and where the scatter comes from
               (``noise_levels``): a fit that measurement noise does not explain gets a discrepancy, and with it
               new weights, before 3 and 4 are looked at again
5. how sure    other starts must end in the same place; cov(Π̂) of eq. (11) with the final weights
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_planner._arrays import FloatArray, IntArray
from calib_planner.design.identifiability import Identifiability, analyse
from calib_planner.errors import NotEnoughDataError
from calib_planner.identification.equations import Equations, configuration_labels, point_whitening
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.evidence import Evidence, estimate_of
from calib_planner.identification.least_squares import Fit, gauss_newton
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.noise_levels import (
    FEWEST_REPEATS,
    DiscrepancyModel,
    NoiseLevels,
    estimate_variances,
    improbable,
    repeat_scatter,
)
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.registration import register
from calib_planner.identification.robust import (
    MEDIAN,
    gate_of,
    normalised,
    residual_covariance,
    robust_registration,
    select,
)
from calib_planner.identification.structure import SIGNIFICANT, Structure, residual_structure
from calib_planner.identification.suspicions import check_units
from calib_planner.identification.transmission import Transmission, fit_transmission
from calib_planner.robot.chain import Robot

MOST_GATES = 12
"""Rounds of the gate; a selection that still changes then is taken as it is."""
FIRST_ITERATIONS = 3
"""Iterations of the fit that tells how much the points scatter, roughly."""
UNSEEN = 0.05
"""A parameter that the data leave this uncertain is not identified by them [m | rad]."""
TINY = 1e-6
"""Share of the stand-in covariance that keeps matrices regular where the noise is estimated anew."""
START_LENGTH = 5e-3
"""Standard deviation of the lengths of other starts [m]."""
START_ANGLE = 2e-2
"""The same for angles [rad]."""


def identify(problem: IdentificationProblem, start: Estimate | None = None) -> Estimate:
    """Identify the active parameters.

    Args:
        problem: What is asked.
        start: Values to begin from, such as the estimate before the newest measurement; saves time, the answer
            is the same.

    Raises:
        NotEnoughDataError: Fewer equations than parameters, or fewer good points than are needed.
        InputError: The points look like millimetres.
    """
    began = time.perf_counter()
    check_units(problem.robot, problem.data)
    seen = problem.data.seen
    robot = start_robot(problem.robot, problem.data, robust=problem.loss == "robust")
    _check_count(problem, seen)
    work, first = _without_unseen(_Work.of(problem, robot), seen, start)
    found = _robust(work, first) if problem.loss == "robust" else _solve(work, seen, first)
    found, starts, agreeing = _other_starts(work, found)
    structure = _structure(work, found)
    evidence = Evidence(
        problem=problem,
        robot=robot,
        equations=found.equations,
        fit=found.fit,
        identifiability=work.identifiability,
        resolved=tuple(sorted(set(found.fit.kept) & set(work.identifiability.held))),
        levels=found.levels,
        covariance=found.covariance,
        factor=found.factor,
        chi_square=found.chi_square,
        freedom=found.freedom,
        normalised=_normalised(work, found),
        gate=_gate(found),
        jacobian=work.jacobian,
        structure=structure,
        transmission=_transmission(work, found, structure),
        starts=starts,
        agreeing=agreeing,
        seconds=time.perf_counter() - began,
    )
    return estimate_of(evidence)


def start_robot(robot: Robot, data: Measurements, *, robust: bool = False) -> Robot:
    """``robot`` with its unknown base and targets, if any, at their closed-form values for these data."""
    active = robot.parameter_names
    base = all(f"base.{a}" in active for a in ("x", "y", "z", "rx", "ry", "rz"))
    tool = all(f"target_{t + 1}.{a}" in active for t in range(len(robot.targets)) for a in "xyz")
    how = robust_registration if robust else register
    return how(robot, data, base=base, tool=tool)


# ── what stays the same while points come and go ─────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class _Work:
    """A problem, its robot at the start, the instrument's covariance and which parameters can be found."""

    problem: IdentificationProblem
    robot: Robot
    instrument: FloatArray  # (N, targets, 3, 3); the identity where nothing is known
    source: str
    labels: IntArray
    jacobian: FloatArray  # (N, targets, 3, P) at the start
    identifiability: Identifiability
    kept: tuple[int, ...]

    @staticmethod
    def of(problem: IdentificationProblem, robot: Robot) -> _Work:
        data = problem.data
        instrument, source = problem.instrument_covariance()
        jacobian = robot.jacobian(data.q).reshape(*data.p.shape, -1)
        found = analyse(jacobian[data.seen].reshape(-1, jacobian.shape[-1]), robot.parameter_names)
        labels = configuration_labels(data.q)
        work = _Work(problem, robot, instrument, source, labels, jacobian, found, found.kept)
        return work.seeing(0.0)

    @property
    def unit(self) -> float:
        """Standard deviation of one coordinate that the instrument has [m]."""
        return float(np.sqrt(np.mean(np.einsum("kii->ki", self.instrument[self.problem.data.seen]))))

    def seeing(self, sigma: float) -> _Work:
        """The same with what can be seen in spite of coordinates that scatter ``sigma`` [m]."""
        names, prior = self.robot.parameter_names, self.problem.prior
        placed = np.array([n.startswith(("base.", "target_")) for n in names])
        shortest = np.where(placed, 0.0, sigma / UNSEEN)
        found = self.identifiability
        if (np.array(found.lengths) < shortest[list(found.kept)]).any():
            seen = self.jacobian[self.problem.data.seen].reshape(-1, len(names))
            found = analyse(seen, names, shortest=shortest)
        kept = found.kept
        if prior is not None and found.held:
            # A prior is worth as many metres of the points as their scatter leaves undecided.
            rows = (sigma or self.unit) * prior.rows(names, np.zeros(len(names)))[0]
            seen = self.jacobian[self.problem.data.seen].reshape(-1, len(names))
            kept = analyse(np.vstack([seen, rows]), names, shortest=shortest).kept
        return replace(self, identifiability=found, kept=kept)

    def equations(self, use: NDArray[np.bool_], covariance: FloatArray) -> Equations:
        """Point by point, under ``covariance`` (N, targets, 3, 3)."""
        whitening = point_whitening(covariance, use)
        return Equations(self.robot, self.problem.data, use, whitening, self.problem.prior)

    def start_values(self, start: Estimate | None) -> FloatArray:
        """(P,) deviations to begin from."""
        if start is None or start.parameters != self.robot.parameter_names:
            return np.zeros(len(self.robot.parameter_names))
        nominal = np.array([p.nominal for p in self.robot.parameters])
        warm = np.zeros(len(nominal))
        warm[list(self.kept)] = (start.values - nominal)[list(self.kept)]
        return warm


@dataclass(frozen=True, eq=False)
class _Found:
    """A fit to some of the points and what it says about the scatter."""

    equations: Equations
    fit: Fit
    levels: NoiseLevels
    total: FloatArray  # (N, targets, 3, 3) Σ of each point, discrepancy included
    factor: float  # what multiplies cov(Π̂): 1 where the noise is known
    chi_square: float  # of measurement noise alone
    freedom: int

    @property
    def covariance(self) -> FloatArray:
        return self.factor * self.fit.covariance()


def _without_unseen(work: _Work, use: NDArray[np.bool_], start: Estimate | None) -> tuple[_Work, FloatArray]:
    """What can be seen in spite of the scatter that a first fit leaves, and where that fit ended."""
    first = work.start_values(start)
    if work.problem.iterations <= FIRST_ITERATIONS:
        return work, first
    fit = gauss_newton(work.equations(use, work.instrument), first, work.kept, FIRST_ITERATIONS)
    count = int(use.sum())
    squares = np.sum(fit.residuals[: 3 * count].reshape(-1, 3) ** 2, axis=1)
    spare = max(3 * count - len(work.kept), 1) / (3 * count)
    sigma = work.unit * float(np.sqrt(np.median(squares) / MEDIAN / spare))
    work = work.seeing(sigma)
    first[list(work.kept)] = fit.deviations[list(work.kept)]
    return work, first


def _solve(work: _Work, use: NDArray[np.bool_], first: FloatArray) -> _Found:
    """Fit the points in use and split the scatter."""
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
    if repeats >= FEWEST_REPEATS and (source == "residuals" or improbable(scatter * repeats, repeats)):
        instrument = scatter * instrument
        scaled, source = (1.0, "repetitions") if source == "residuals" else (float(np.sqrt(scatter)), source)
        equations = work.equations(use, instrument)
        fit = gauss_newton(equations, fit.deviations, work.kept, most)
    levels = NoiseLevels(0.0, source, scaled, repeatability, repeats)
    if source == "residuals":
        return _with_scale(work, equations, fit, levels, freedom)
    cost = fit.cost
    levels = replace(levels, measurement=float(np.sqrt(np.mean(np.einsum("kii->k", instrument[use])) / 3.0)))
    found = _Found(equations, fit, levels, instrument, 1.0, cost, freedom)
    if work.problem.discrepancy == "off" or not improbable(cost, freedom) or seen <= len(work.kept):
        return found
    return _with_discrepancy(work, found, instrument)


def _with_scale(work: _Work, equations: Equations, fit: Fit, levels: NoiseLevels, freedom: int) -> _Found:
    """The noise level from the residuals themselves, eq. (11) with σ̂²."""
    instrument, scale = work.instrument, 1.0
    # Without a prior the parameters do not depend on the scale; with one, both settle together.
    for _ in range(1 if equations.prior is None else 20):
        own = fit.residuals[: 3 * int(equations.use.sum())]
        factor = float(own @ own) / freedom if freedom > 0 else float("nan")
        if equations.prior is None or not np.isfinite(factor) or abs(factor - 1.0) < 1e-6:
            break
        scale *= max(factor, 1e-12)
        equations = work.equations(equations.use, scale * instrument)
        fit = gauss_newton(equations, fit.deviations, work.kept, work.problem.iterations)
    unit = float(np.sqrt(instrument[0, 0, 0, 0]))
    levels = replace(levels, measurement=float(np.sqrt(factor * scale)) * unit)
    total = (factor * scale if np.isfinite(factor) else 1.0) * instrument
    inflate = factor if equations.prior is None else 1.0
    return _Found(equations, fit, levels, total, inflate, float("nan"), freedom)


def _with_discrepancy(work: _Work, found: _Found, instrument: FloatArray) -> _Found:
    """The same points with the weights that their discrepancy leaves them."""
    equations, data = found.equations, work.problem.data
    model = DiscrepancyModel.of(equations, instrument, work.labels)
    fit, columns = found.fit, list(found.fit.kept)
    for _ in range(2):
        predicted, jacobian = work.robot.positions_and_jacobian(data.q, fit.deviations)
        rows = jacobian.reshape(*data.p.shape, -1)[equations.use].reshape(-1, jacobian.shape[-1])[:, columns]
        prior = equations.prior_rows(fit.deviations)
        residuals = (data.p - predicted)[equations.use].ravel()
        variances = estimate_variances(model, residuals, rows, (prior[0][:, columns], prior[1]))
        equations = replace(equations, whitening=model.whitening(variances))
        fit = gauss_newton(equations, fit.deviations, fit.kept, work.problem.iterations)
    amplitude = dict(zip(model.names, np.sqrt(variances).tolist(), strict=True))
    spread = float(np.sqrt(model.mean_square(variances)))
    levels = replace(found.levels, **amplitude, discrepancy=spread)
    total = instrument + levels.discrepancy_covariance(work.robot, data.q)
    return replace(found, equations=equations, fit=fit, levels=levels, total=total)


def _whole(equations: Equations, fit: Fit) -> FloatArray:
    """(N, targets, 3) whitened residuals of the points in use; zero elsewhere."""
    whole = np.zeros(equations.data.p.shape)
    count = 3 * int(equations.use.sum())
    whole[equations.use] = fit.residuals[:count].reshape(-1, 3)
    return whole


# ── points come and go ───────────────────────────────────────────────────────────────────────────────


def _robust(work: _Work, first: FloatArray) -> _Found:
    """Select points, fit, and gate until the selection stands still."""
    seen = work.problem.data.seen
    known = work.source != "residuals"
    selection = select(work.equations(seen, work.instrument), work.kept, first, scale_known=known)
    use = selection.use
    _check_count(work.problem, use)
    found = _solve(work, use, selection.deviations)
    for _ in range(MOST_GATES):
        distance = _normalised(work, found)
        with np.errstate(invalid="ignore"):
            new = seen & (distance <= _gate(found))
        if (new == use).all():
            break
        use = new
        _check_count(work.problem, use)
        found = _solve(work, use, found.fit.deviations)
    return found


def _gate(found: _Found) -> float:
    """Largest believable normalised residual."""
    count = int(found.equations.data.seen.sum())
    stated = found.levels.source in ("sigma", "data", "instrument") and not found.levels.discrepancy
    if not stated:
        return gate_of(count, found.freedom)
    if not improbable(found.chi_square, found.freedom):
        return gate_of(count)
    # No discrepancy was allowed to explain the residuals: far is what is far from the others.
    return gate_of(count, found.freedom) * float(np.sqrt(found.chi_square / found.freedom))


def _normalised(work: _Work, found: _Found) -> FloatArray:
    """(N, targets) length of each residual in standard deviations of what it should be."""
    data = work.problem.data
    predicted, jacobian = work.robot.positions_and_jacobian(data.q, found.fit.deviations)
    blocks = jacobian.reshape(*data.p.shape, -1)
    covariance = residual_covariance(found.total, blocks, found.covariance, found.equations.use)
    return normalised(data.p - predicted, covariance)


def _check_count(problem: IdentificationProblem, use: NDArray[np.bool_]) -> None:
    """More equations than parameters, and not more points rejected than used."""
    count, equations = len(problem.robot.parameter_names), 3 * int(use.sum())
    prior = 0 if problem.prior is None else len(problem.prior.names)
    measured = int(problem.data.seen.sum())
    if 2 * int(use.sum()) < measured:
        raise NotEnoughDataError(
            equations,
            count,
            f"only {int(use.sum())} of {measured} points agree with one another: check joint order, units and "
            "which point belongs to which row before calibrating",
        )
    if equations + prior < count:
        each = 3 * problem.data.p.shape[1]
        raise NotEnoughDataError(
            equations,
            count,
            f"{equations} equations for {count} parameters: measure at least {-(-(count - prior) // each)} "
            "configurations, or ask for fewer parameters",
        )


# ── is it the only minimum? ──────────────────────────────────────────────────────────────────────────


def _other_starts(work: _Work, found: _Found) -> tuple[_Found, int, int]:
    """Begin elsewhere, with the same points and weights: best fit, starts made, starts that ended with it."""
    rng = np.random.default_rng(0)
    angle = np.array([p.unit == "rad" for p in work.robot.parameters])
    spread = np.where(angle, START_ANGLE, START_LENGTH)
    kept, best, agreeing = list(found.fit.kept), found.fit, 0
    for _ in range(work.problem.starts):
        first = found.fit.deviations.copy()
        first[kept] += spread[kept] * rng.standard_normal(len(kept))
        other = gauss_newton(found.equations, first, found.fit.kept, work.problem.iterations)
        close = 1e-6 * best.cost + 1e-6
        if other.cost < best.cost - close and other.converged:
            best, agreeing = other, 0
        agreeing += int(abs(other.cost - best.cost) <= close)
    return replace(found, fit=best), work.problem.starts, agreeing


# ── do the residuals know where the robot stood? ─────────────────────────────────────────────────────


def _structure(work: _Work, found: _Found) -> tuple[Structure, ...]:
    data, use = work.problem.data, found.equations.use
    residuals = data.p - work.robot.positions(data.q, found.fit.deviations)
    return residual_structure(work.robot, data.q, residuals, use, work.labels)


def _transmission(work: _Work, found: _Found, structure: tuple[Structure, ...]) -> Transmission | None:
    """Errors of the joints' transmissions, if there is reason to look for them."""
    reason = found.levels.discrepancy > 0 or any(s.probability < SIGNIFICANT for s in structure)
    if work.problem.joint_corrections == "off" or not reason or not found.fit.converged:
        return None
    # Where the instrument's noise is unknown it is part of the white noise that is estimated there.
    unknown = found.levels.source == "residuals"
    instrument = TINY * work.instrument if unknown else found.levels.scaled**2 * work.instrument
    return fit_transmission(found.equations, found.fit.deviations, found.fit.kept, instrument, work.labels)
