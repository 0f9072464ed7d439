"""Does the calibrated robot predict poses that took no part in the fit, and as well as it said it would?

At a held-out point the expected covariance of measured − predicted is

    J C Jᵀ + D + R,

what is uncertain in the parameters, what no geometric model holds, and the measurement itself. If the covariance
is honest, 95 % of the points lie inside their 95 % region (χ²₃).

A *re-seated target* has a new offset, to be found from a few rows of the validation data. The systematic error
that no geometric model holds would go straight into that offset, so what the calibration residuals predict of it
at those rows (see ``discrepancy``) is taken off first. The rows that are the test stay as they are. With G the
pseudoinverse that turns errors e₀ at those rows into an error of the offset, and J_t = ∂p/∂t, the error at a
test row is (J − J_t G J₀) ΔΠ + e − J_t G e₀.

*Cross-validation* does without further data: the configurations are dealt into folds, and each is predicted by
the fit to the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from calib_planner._arrays import FloatArray, check_count
from calib_planner.errors import InputError, NotEnoughDataError
from calib_planner.identification.discrepancy import Discrepancy, fit_discrepancy
from calib_planner.identification.equations import configuration_labels
from calib_planner.identification.estimate import Estimate, Validation
from calib_planner.identification.evidence import distances, fit_placement
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.registration import register
from calib_planner.identification.robust import normalised
from calib_planner.identification.solver import identify, start_robot
from calib_planner.robot.chain import Robot

INSIDE = float(np.sqrt(chi2.ppf(0.95, 3)))


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
    before_robot = _before(problem)
    discrepancy = _discrepancy(problem, estimate) if target_from else None
    after, before = [], []
    for data in (d.in_order_of(problem.robot.joint_names) for d in held_out):
        if len(data) <= target_from:
            raise NotEnoughDataError(
                len(data),
                target_from + 1,
                f"{len(data)} validation rows, the first {target_from} of "
                "which give the target: nothing is left to test",
            )
        seat, rest = data.select(np.arange(target_from)), data.select(np.arange(target_from, len(data)))
        after.append(_predict(estimate, estimate.calibrated, seat, rest, discrepancy))
        before.append(_predict(estimate, before_robot, seat, rest, None))
    return replace(estimate, validation=_statistics(after, before))


def cross_validate(problem: IdentificationProblem, estimate: Estimate, folds: int = 5, seed: int = 0) -> Estimate:
    """``estimate`` with the distances of configurations that were left out in turn.

    Args:
        folds: Parts of the data; repetitions of a configuration stay together.
        seed: How the configurations are dealt.

    Raises:
        NotEnoughDataError: What a fold leaves is too little.
        InputError: More folds than configurations.
    """
    labels = configuration_labels(problem.data.q)
    count = int(labels.max()) + 1
    check_count("folds", folds, low=2, high=count)
    fold = np.random.default_rng(seed).permutation(np.arange(count) % folds)[labels]
    used = _without(problem.data, estimate)
    after, before = [], []
    for k in range(folds):
        part = replace(problem, data=problem.data.select(np.flatnonzero(fold != k)), test_poses=None, starts=0)
        found = identify(part, start=estimate)
        rest = used.select(np.flatnonzero(fold == k))
        none = rest.select(np.arange(0))
        after.append(_predict(found, found.calibrated, none, rest, None))
        before.append(_predict(found, _before(part), none, rest, None))
    return replace(estimate, cross_validation=replace(_statistics(after, before), folds=folds))


# ── predictions of one set ───────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class _Prediction:
    """(N, targets, 3) measured − predicted and (N, targets, 3, 3) what it should scatter like."""

    residuals: FloatArray
    covariance: FloatArray


def _predict(
    estimate: Estimate, robot: Robot, seat: Measurements, rest: Measurements, discrepancy: Discrepancy | None
) -> _Prediction:
    """``robot`` against ``rest``, its target from ``seat`` if that has rows."""
    targets = rest.p.shape[1]
    if len(seat):
        if discrepancy is not None:
            seat = Measurements(seat.joint_names, seat.q, seat.p - discrepancy.predict(seat.q)[:, None], seat.std)
        robot = register(robot.with_targets(np.zeros((targets, 3))), seat, base=False, tool=True)
    elif len(robot.targets) < targets:
        raise InputError("validation data", f"{targets} targets", f"at most {len(robot.targets)} targets")
    else:
        robot = robot.with_targets(robot.target_offsets[:targets])
    own = [estimate.parameters.index(n) for n in robot.parameter_names]
    parameters = estimate.covariance[np.ix_(own, own)]
    points, jacobian = robot.positions_and_jacobian(rest.q)
    blocks = np.ascontiguousarray(jacobian).reshape(*points.shape, -1)
    error = _noise(estimate, robot, rest)
    if len(seat):
        blocks, error = _with_seat(estimate, robot, seat, rest, blocks, error)
    return _Prediction(rest.p - points, blocks @ parameters @ np.swapaxes(blocks, 2, 3) + error)


def _with_seat(
    estimate: Estimate,
    robot: Robot,
    seat: Measurements,
    rest: Measurements,
    blocks: FloatArray,
    error: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """J − J_t G J₀ and the covariance of e − J_t G e₀, target by target."""
    names = [f"target_{t + 1}.{a}" for t in range(len(robot.targets)) for a in "xyz"]
    moved = replace(robot, parameter_names=(*names,))
    kinematic = robot.jacobian(seat.q).reshape(len(seat), len(robot.targets), 3, -1)
    at_seat = moved.jacobian(seat.q).reshape(len(seat), len(robot.targets), 3, -1)
    at_rest = moved.jacobian(rest.q).reshape(len(rest), len(robot.targets), 3, -1)
    noise = _noise(estimate, robot, seat)
    effective, total = blocks.copy(), error.copy()
    for t in range(len(robot.targets)):
        rows = np.flatnonzero(seat.seen[:, t])
        own = slice(3 * t, 3 * t + 3)
        inverse = np.linalg.pinv(at_seat[rows, t, :, own].reshape(-1, 3))
        lever = at_rest[:, t, :, own] @ inverse
        effective[:, t] -= lever @ kinematic[rows, t].reshape(-1, blocks.shape[-1])
        scatter = np.zeros((3 * len(rows),) * 2)
        for k, i in enumerate(rows):
            scatter[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = noise[i, t]
        total[:, t] += lever @ scatter @ np.swapaxes(lever, 1, 2)
    return effective, total


def _noise(estimate: Estimate, robot: Robot, data: Measurements) -> FloatArray:
    """D + R of each point: (N, targets, 3, 3) [m²]."""
    measured = np.full(data.p.shape, estimate.noise.measurement)
    if data.std is not None and estimate.noise.source == "data":
        measured = np.where(data.seen[:, :, None], np.asarray(data.std), 1.0) * estimate.noise.scaled
    return estimate.noise.discrepancy_covariance(robot, data.q) + measured[..., None] ** 2 * np.eye(3)


def _statistics(after: list[_Prediction], before: list[_Prediction]) -> Validation:
    residuals = np.concatenate([p.residuals.reshape(-1, 3) for p in after])
    covariance = np.concatenate([p.covariance.reshape(-1, 3, 3) for p in after])
    seen = np.isfinite(residuals[:, 0])
    length = distances(residuals)
    if not len(length):
        raise NotEnoughDataError(0, 1, "the validation data hold no measured point")
    known = bool(np.isfinite(covariance[seen]).all())
    inside = normalised(residuals[seen], covariance[seen]) <= INSIDE if known else np.array([np.nan])
    return Validation(
        count=len(length),
        mean=float(length.mean()),
        median=float(np.median(length)),
        rms=float(np.sqrt(np.mean(length**2))),
        max=float(length.max()),
        before_mean=float(np.mean(np.concatenate([distances(p.residuals) for p in before]))),
        predicted_rms=float(np.sqrt(np.mean(np.einsum("kii->k", covariance[seen])))),
        within_95=float(np.mean(inside)),
    )


# ── what the predictions rest on ─────────────────────────────────────────────────────────────────────


def _before(problem: IdentificationProblem) -> Robot:
    """The nominal kinematics, base and targets fitted to the data where they are unknown."""
    robust = problem.loss == "robust"
    return fit_placement(start_robot(problem.robot, problem.data, robust=robust), problem.data)


def _without(data: Measurements, estimate: Estimate) -> Measurements:
    """The data without the points that were rejected."""
    points = np.array(data.p)
    for point in estimate.rejected:
        points[point["row"], point["target"] - 1] = np.nan
    return Measurements(data.joint_names, data.q, points, data.std)


def _discrepancy(problem: IdentificationProblem, estimate: Estimate) -> Discrepancy | None:
    """The systematic error over joint space, from the mean residual of each configuration's targets."""
    data = _without(problem.data, estimate)
    rows = data.seen.any(axis=1)
    if rows.sum() < 2:
        return None
    residuals = np.where(data.seen[:, :, None], estimate.residuals, 0.0)[rows]
    mean = residuals.sum(axis=1) / data.seen[rows].sum(axis=1)[:, None]
    return fit_discrepancy(estimate.calibrated, data.q[rows], mean)
