"""Does the calibrated robot predict poses that took no part in the fit, and as well as it said it would?

At a held-out point the expected covariance of measured − predicted is

    J C Jᵀ + D + R,

of the parameters, of the errors that no geometric model describes, and of the measurement itself. If the
covariance is right, 95 % of the points lie inside their 95 % region (χ²₃).

A *re-seated target* has a new offset, which comes from a few rows of the validation data. The systematic error
that no geometric model describes would go into that offset, so what the calibration residuals predict of it at
those rows (see ``fit_discrepancy``) is subtracted first. The test rows are not changed. With G the
pseudoinverse that turns errors e₀ at those rows into an error of the offset, and J_t = ∂p/∂t, the error at a
test row is (J − J_t G J₀) ΔΠ + e − J_t G e₀.

With an error model the mean and the covariance of ``Knowledge.predict`` stand for all of this, and a re-seated
target is a new one that the rows of the seat tell (``Knowledge.with_new_targets``, ``updated``).

*Cross-validation* needs no further data: the configurations are dealt into folds, and each is predicted by
the fit to the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri

from calib_planner.arrays import FloatArray, check_count, one_thread
from calib_planner.errors import InputError, NotEnoughDataError
from calib_planner.identification.estimate import Estimate, Validation
from calib_planner.identification.evidence import fit_placement
from calib_planner.identification.least_squares import configuration_labels
from calib_planner.identification.noise_levels import Discrepancy, fit_discrepancy
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.registration import register
from calib_planner.identification.robust import normalised
from calib_planner.identification.solver import identify
from calib_planner.identification.start import start_robot
from calib_planner.identification.transmission import Transmission
from calib_planner.identification.verdict import judged
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot, target_parameters

INSIDE = float(np.sqrt(chdtri(3, 0.05)))


@one_thread
def validate(
    problem: IdentificationProblem,
    estimate: Estimate,
    held_out: Sequence[Measurements],
    target_from: int = 0,
) -> Estimate:
    """``estimate`` with the distances on held-out data.

    Args:
        held_out: One or more sets; the statistics are over all their points.
        target_from: The target was re-seated for each set: the first ``target_from`` rows of each give its
            offset, all else being kept, and only the other rows are the test. 0: target 1 … as identified.

    Raises:
        NotEnoughDataError: A set has no rows left to test.
    """
    if target_from < 0:
        raise InputError("validate_target_from", target_from, "a whole number >= 0")
    models, learnt = _models(estimate), estimate.error_model
    before = _Geometry(_before(problem), estimate)
    guess = target_from and estimate.transmission is None and learnt is None
    discrepancy = _discrepancy(problem, estimate) if guess else None
    predictions: list[list[_Prediction]] = []
    for data in (d.in_order_of(problem.robot.joint_names) for d in held_out):
        if len(data) <= target_from:
            raise NotEnoughDataError(
                len(data),
                target_from + 1,
                f"{len(data)} validation rows, the first {target_from} of "
                "which give the target: nothing is left to test",
            )
        seat, rest = data.select(np.arange(target_from)), data.select(np.arange(target_from, len(data)))
        expected = np.zeros((len(seat), 3)) if discrepancy is None else discrepancy.predict(seat.q)
        cleaned = Measurements(seat.joint_names, seat.q, seat.p - expected[:, None], seat.std)
        best = _predict(models[0], cleaned, rest) if learnt is None else _predict_known(estimate, seat, rest)
        predictions.append([best, _predict(models[1], cleaned, rest), _predict(before, seat, rest)])
    return judged(replace(estimate, validation=_statistics(predictions)))


@one_thread
def cross_validate(problem: IdentificationProblem, estimate: Estimate, folds: int = 5, seed: int = 0) -> Estimate:
    """``estimate`` with the distances of configurations that were left out in turn.

    Args:
        folds: Parts of the data; repetitions of a configuration stay together.
        seed: How the configurations are dealt.

    Raises:
        NotEnoughDataError: What a fold leaves is too little.
        InputError: More folds than configurations, or an estimate by an error model.
    """
    if estimate.error_model is not None:
        advice = "its left-out error is what all other visits predict of each"
        raise InputError("folds", folds, "none beside an error model", advice)
    labels = configuration_labels(problem.data.q)
    count = int(labels.max()) + 1
    check_count("folds", folds, low=2, high=count)
    fold = np.random.default_rng(seed).permutation(np.arange(count) % folds)[labels]
    used = problem.data.without(estimate.points.rejected)
    again = "off" if estimate.transmission is None else "auto"
    parts: list[list[_Prediction]] = []
    for k in range(folds):
        rows = problem.data.select(np.flatnonzero(fold != k))
        part = replace(problem, data=rows, test_poses=None, starts=0, joint_corrections=again)
        others = identify(part, start=estimate)
        rest = used.select(np.flatnonzero(fold == k))
        models = (*_models(others), _Geometry(_before(part), others))
        parts.append([_predict(m, rest.select(np.arange(0)), rest) for m in models])
    return judged(replace(estimate, cross_validation=replace(_statistics(parts), folds=folds)))


# ── predictions of one set ───────────────────────────────────────────────────────────────────────────


class _Model(Protocol):
    """What predicts, and how far off it expects to be."""

    @property
    def estimate(self) -> Estimate: ...

    @property
    def robot(self) -> Robot: ...

    def actual(self, q: FloatArray) -> FloatArray:
        """Joint values at which ``robot`` is right."""
        ...

    def with_targets(self, xyz: FloatArray) -> _Model: ...

    def columns(self, q: FloatArray) -> FloatArray:
        """(N, targets, 3, K) ∂p/∂(all that is uncertain)."""
        ...

    def covariance(self) -> FloatArray:
        """(K, K) of what is uncertain."""
        ...

    def discrepancy(self, q: FloatArray) -> FloatArray:
        """(N, targets, 3, 3) of what the model does not hold [m²]."""
        ...


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Geometric parameters alone."""

    robot: Robot
    estimate: Estimate

    def actual(self, q: FloatArray) -> FloatArray:
        return q

    def with_targets(self, xyz: FloatArray) -> _Geometry:
        return replace(self, robot=self.robot.with_targets(xyz))

    def columns(self, q: FloatArray) -> FloatArray:
        return np.ascontiguousarray(self.robot.jacobian(q)).reshape(len(q), len(self.robot.targets), 3, -1)

    def covariance(self) -> FloatArray:
        own = [self.estimate.fit.parameters.index(n) for n in self.robot.parameter_names]
        return self.estimate.fit.covariance[np.ix_(own, own)]

    def discrepancy(self, q: FloatArray) -> FloatArray:
        return self.estimate.noise.discrepancy_covariance(self.robot, q)


@dataclass(frozen=True, eq=False)
class _Complete:
    """Geometry and joint corrections."""

    transmission: Transmission
    estimate: Estimate

    @property
    def robot(self) -> Robot:
        return self.transmission.robot

    def actual(self, q: FloatArray) -> FloatArray:
        return self.transmission.corrections.actual(q)

    def with_targets(self, xyz: FloatArray) -> _Complete:
        return replace(self, transmission=self.transmission.with_targets(xyz))

    def columns(self, q: FloatArray) -> FloatArray:
        return self.transmission.columns(q)

    def covariance(self) -> FloatArray:
        return self.transmission.covariance

    def discrepancy(self, q: FloatArray) -> FloatArray:
        return self.transmission.remainder(q)


def _models(estimate: Estimate) -> tuple[_Model, ...]:
    """The best model of the estimate, then its geometry alone."""
    geometry = _Geometry(estimate.calibrated, estimate)
    if estimate.transmission is None:
        return geometry, geometry
    return _Complete(estimate.transmission, estimate), geometry


@dataclass(frozen=True, eq=False)
class _Prediction:
    """(points, 3) measured − predicted, (points, 3, 3) what it should scatter like, (points, 3) variance of the
    measurement alone, NaN where that is not known.
    """

    residuals: FloatArray
    covariance: FloatArray
    measured: FloatArray


def _predict(model: _Model, seat: Measurements, rest: Measurements) -> _Prediction:
    """``model`` against ``rest``, its target from ``seat`` if that has rows."""
    targets = rest.p.shape[1]
    robot = model.robot
    if len(seat):
        there = Measurements(seat.joint_names, model.actual(seat.q), seat.p, seat.std)
        robot = register(robot.with_targets(np.zeros((targets, 3))), there, base=False, tool=True)
    elif len(robot.targets) < targets:
        raise InputError("validation data", f"{targets} targets", f"at most {len(robot.targets)} targets")
    model = model.with_targets(robot.target_offsets[:targets])
    columns, error, measured = model.columns(rest.q), _noise(model, rest), _measured(model, rest)
    if model.estimate.noise.source == "residuals":  # the robot's own scatter may be part of it
        measured = np.full_like(measured, np.nan)
    if len(seat):
        columns, error = _with_seat(model, seat, rest, columns, error)
    points = model.robot.positions(model.actual(rest.q))
    covariance = columns @ model.covariance() @ np.swapaxes(columns, 2, 3) + error
    return _Prediction((rest.p - points)[rest.seen], covariance[rest.seen], measured[rest.seen])


def _predict_known(estimate: Estimate, seat: Measurements, rest: Measurements) -> _Prediction:
    """The mean of the error model against ``rest``; targets that were put on anew are told by ``seat``."""
    assert estimate.error_model is not None
    known, targets = estimate.error_model.knowledge, rest.p.shape[1]
    if len(seat):
        offsets = np.zeros((targets, 3))
        there = estimate.calibrated.target_offsets[:targets]
        offsets[: len(there)] = there
        known = known.with_new_targets(offsets)
        known = known.updated(seat.q, np.where(seat.seen[:, :, None], seat.p, 0.0), seat.seen)
    elif len(known.robot.targets) < targets:
        raise InputError("validation data", f"{targets} targets", f"at most {len(known.robot.targets)} targets")
    told = known.predict(rest.q)
    measured = np.diagonal(told.noise, axis1=2, axis2=3)[:, :targets]
    if estimate.noise.source == "residuals":
        measured = np.full_like(measured, np.nan)
    residuals = (rest.p - told.mean[:, :targets])[rest.seen]
    return _Prediction(residuals, told.total[:, :targets][rest.seen], measured[rest.seen])


def _with_seat(
    model: _Model, seat: Measurements, rest: Measurements, columns: FloatArray, error: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """J − J_t G J₀ and the covariance of e − J_t G e₀, target by target."""
    targets = len(model.robot.targets)
    names = target_parameters(targets)
    moved = replace(model.robot, parameter_names=names)
    at_seat = moved.jacobian(model.actual(seat.q)).reshape(len(seat), targets, 3, -1)
    at_rest = moved.jacobian(model.actual(rest.q)).reshape(len(rest), targets, 3, -1)
    known, noise = model.columns(seat.q), _noise(model, seat)
    effective, total = columns.copy(), error.copy()
    for t in range(targets):
        rows = np.flatnonzero(seat.seen[:, t])
        own = slice(3 * t, 3 * t + 3)
        lever = at_rest[:, t, :, own] @ np.linalg.pinv(at_seat[rows, t, :, own].reshape(-1, 3))
        effective[:, t] -= lever @ known[rows, t].reshape(-1, columns.shape[-1])
        scatter = block_diag(*noise[rows, t])
        total[:, t] += lever @ scatter @ np.swapaxes(lever, 1, 2)
    return effective, total


def _noise(model: _Model, data: Measurements) -> FloatArray:
    """D + R of each point: (N, targets, 3, 3) [m²]."""
    return model.discrepancy(data.q) + _measured(model, data)[..., None] * np.eye(3)


def _measured(model: _Model, data: Measurements) -> FloatArray:
    """Diagonal of R, variances of the measurement: (N, targets, 3) [m²]."""
    levels = model.estimate.noise
    measured = np.full(data.p.shape, 0.0 if levels.source == "residuals" else levels.measurement)
    if levels.source == "residuals" and model.estimate.transmission is None:
        measured = np.full(data.p.shape, levels.measurement)
    if data.std is not None and levels.source == "data":
        measured = np.where(data.seen[:, :, None], np.asarray(data.std), 1.0) * levels.scaled
    return measured**2


def _statistics(parts: list[list[_Prediction]]) -> Validation:
    """Of the sets' predictions by the best model, by geometry alone, and before."""

    def lengths(k: int) -> FloatArray:
        return np.concatenate([np.linalg.norm(p[k].residuals, axis=1) for p in parts])

    residuals = np.concatenate([p[0].residuals for p in parts])
    covariance = np.concatenate([p[0].covariance for p in parts])
    best, geometry, before = (lengths(k) for k in range(3))
    if not len(best):
        raise NotEnoughDataError(0, 1, "the validation data hold no measured point")
    known = bool(np.isfinite(covariance).all())
    noise = np.concatenate([p[0].measured for p in parts])
    inside = normalised(residuals, covariance) <= INSIDE if known else np.array([np.nan])
    return Validation(
        count=len(best),
        mean=float(best.mean()),
        median=float(np.median(best)),
        rms=float(np.sqrt(np.mean(best**2))),
        max=float(best.max()),
        before_mean=float(before.mean()),
        predicted_rms=float(np.sqrt(np.mean(np.einsum("kii->k", covariance)))),
        within_95=float(np.mean(inside)),
        geometry_mean=float(geometry.mean()),
        geometry_rms=float(np.sqrt(np.mean(geometry**2))),
        noise_rms=float(np.sqrt(np.mean(np.sum(noise, axis=1)))),
    )


# ── what the predictions start from ─────────────────────────────────────────────────────────────────────


def _before(problem: IdentificationProblem) -> Robot:
    """The nominal kinematics, base and targets fitted to the data where they are unknown."""
    robust = problem.loss == "robust"
    return fit_placement(start_robot(problem.robot, problem.data, robust=robust), problem.data)


def _discrepancy(problem: IdentificationProblem, estimate: Estimate) -> Discrepancy | None:
    """The systematic error over joint space, from the mean residual of each configuration's targets."""
    data = problem.data.without(estimate.points.rejected)
    rows = data.seen.any(axis=1)
    if rows.sum() < 2:
        return None
    residuals = np.where(data.seen[:, :, None], estimate.residuals.vectors, 0.0)[rows]
    mean = residuals.sum(axis=1) / data.seen[rows].sum(axis=1)[:, None]
    return fit_discrepancy(estimate.calibrated, data.q[rows], mean)
