"""From a finished fit to the answer: eqs. (11) and (14), with both parts of the scatter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray
from calib_planner.identification.checks import Disturbance, HiddenErrors, Structure, copied_rows, explain
from calib_planner.identification.estimate import (
    Accuracy,
    ChiSquare,
    Diagnostics,
    Estimate,
    Observability,
    ParameterFit,
    Points,
    Residuals,
    residual_statistics,
)
from calib_planner.identification.least_squares import Equations, Fit, Motion, gauss_newton, point_whitening
from calib_planner.identification.noise_levels import NoiseLevels
from calib_planner.identification.problem import UNKNOWN_SIGMA, IdentificationProblem
from calib_planner.identification.transmission import Transmission
from calib_planner.identification.verdict import judged
from calib_planner.measurements import Measurements, RejectedPoint
from calib_planner.robot import Identifiability, Robot, describe, is_nuisance
from calib_planner.units import length

BLIND = 1e-5
"""A test pose that moves less than this per unit of an unseen combination does not depend on it [m/m | m/rad]."""
PLACED = 1e-9
"""Share of the sum of squares that a better placement of the nominal robot must take off."""
WEAK = 1e-2
"""Unit columns whose combination is shorter than this are nearly dependent."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """A finished fit and the results of all checks; see ``Estimate`` for the meanings."""

    problem: IdentificationProblem
    robot: Robot
    equations: Equations
    fit: Fit
    identifiability: Identifiability
    resolved: tuple[int, ...]
    levels: NoiseLevels
    covariance: FloatArray
    chi_square: float
    freedom: int
    normalised: FloatArray
    gate: float
    structure: tuple[Structure, ...]
    disturbances: tuple[Disturbance, ...]
    moved_since: int | None
    transmission: Transmission | None
    hidden: HiddenErrors | None
    at: FloatArray
    jacobian: FloatArray
    starts: int
    agreeing: int
    seconds: float


def estimate_of(evidence: Evidence) -> Estimate:
    """The answer, with its verdict."""
    robot, fit, data = evidence.robot, evidence.fit, evidence.problem.data
    names, use = robot.parameter_names, evidence.equations.use
    free = list(fit.kept)
    std = np.full(len(names), np.nan)
    std[free] = np.sqrt(np.diag(evidence.covariance)[free])
    predicted = evidence.equations.motion.at(fit.deviations)[0]
    residuals = data.p - predicted
    before = data.p - _placed_positions(evidence)
    fixed = [i for i in evidence.identifiability.fixed if i not in evidence.resolved]
    combination = dict(zip(evidence.identifiability.fixed, evidence.identifiability.combinations, strict=True))
    status = "not_converged" if not fit.converged else "rank_deficient" if fixed else "ok"
    estimate = Estimate(
        calibrated=robot.with_deviations(dict(zip(names, fit.deviations, strict=True))),
        transmission=evidence.transmission,
        fit=ParameterFit(
            parameters=names,
            units=tuple(p.unit for p in robot.parameters),
            nominal=np.array([p.nominal for p in robot.parameters]),
            deviations=fit.deviations,
            std=std,
            covariance=evidence.covariance,
            iterations=fit.iterations,
            status=status,
        ),
        observability=Observability(
            rank=len(free),
            fixed=tuple(names[i] for i in fixed),
            unidentifiable=tuple(combination[i] for i in fixed),
            resolved_by_prior=tuple(combination[i] for i in evidence.resolved),
            nearly_dependent=_nearly_dependent(fit, names),
            prior="" if evidence.problem.prior is None else evidence.problem.prior.source,
        ),
        points=Points(
            measured=int(data.seen.sum()),
            used=int(use.sum()),
            rejected=_rejected(evidence, predicted),
            suspects=_suspects(evidence, predicted),
            copies=copied_rows(data),
        ),
        residuals=Residuals(
            vectors=residuals,
            normalised=evidence.normalised,
            gate=evidence.gate,
            before=residual_statistics(distances(before[use])),
            after=residual_statistics(distances(residuals[use])),
            sigma=_scatter(evidence, residuals),
            chi_square=ChiSquare(evidence.chi_square, evidence.freedom),
        ),
        noise=evidence.levels,
        accuracy=_accuracy(evidence, evidence.problem.test_pose_array),
        diagnostics=Diagnostics(
            structure=evidence.structure,
            disturbances=evidence.disturbances,
            moved_since=evidence.moved_since,
            hidden=evidence.hidden,
            starts=evidence.starts,
            agreeing_starts=evidence.agreeing,
            seconds=evidence.seconds,
        ),
    )
    return judged(estimate)


def fit_placement(robot: Robot, data: Measurements) -> Robot:
    """The nominal kinematics with base and targets fitted to the data where they are unknown.

    Args:
        robot: At its closed-form start.
        data: The measurements, all of which count alike.
    """
    if not _placement(robot):
        return robot
    motion, deviations = _placed(robot, data, data.seen)
    return robot.with_deviations(dict(zip(motion.robot.parameter_names, deviations, strict=True)))


def _placement(robot: Robot) -> list[str]:
    """Names of the unknown base's and targets' parameters."""
    return [n for n in robot.parameter_names if is_nuisance(n)]


def _placed(robot: Robot, data: Measurements, use: NDArray[np.bool_]) -> tuple[Motion, FloatArray]:
    """The nominal kinematics moved by its placement alone; deviations of that which fit the points ``use``."""
    fitted = robot.with_parameters(_placement(robot))
    unit = np.broadcast_to(UNKNOWN_SIGMA**2 * np.eye(3), (*data.p.shape, 3))
    alike = Equations(fitted, data, use, point_whitening(unit, use))
    count = len(fitted.parameter_names)
    fit = gauss_newton(alike, np.zeros(count), tuple(range(count)), 50, gain=PLACED)
    return alike.motion, fit.deviations


def _placed_positions(evidence: Evidence) -> FloatArray:
    """(N, targets, 3) of the nominal kinematics, placed by the points in use [m]."""
    if not _placement(evidence.robot):
        return evidence.equations.motion.at(np.zeros(len(evidence.robot.parameter_names)))[0]
    motion, deviations = _placed(evidence.robot, evidence.problem.data, evidence.equations.use)
    return motion.at(deviations)[0]


def distances(residuals: FloatArray) -> FloatArray:
    """Lengths (count,) [m] of the residual vectors (…, 3) that were measured."""
    lengths = np.linalg.norm(residuals, axis=-1)
    return lengths[np.isfinite(lengths)]


def _scatter(evidence: Evidence, residuals: FloatArray) -> float:
    """σ̂ [m]: root of the sum of squares over the degrees of freedom, all coordinates alike; NaN without any."""
    use = evidence.equations.use
    freedom = 3 * int(use.sum()) - len(evidence.fit.kept)
    return float(np.sqrt(np.sum(residuals[use] ** 2) / freedom)) if freedom > 0 else float("nan")


def _accuracy(evidence: Evidence, poses: FloatArray) -> Accuracy:
    """Eq. (14), discrepancy and joint corrections at the test poses (K, joints)."""
    robot, fit, required = evidence.robot, evidence.fit, evidence.problem.required_accuracy
    required = float("nan") if required is None else required
    if not len(poses):
        return Accuracy(poses, np.empty(0), np.empty(0), None, required)
    targets = len(robot.targets)
    jacobians = robot.jacobian(poses, fit.deviations)
    per = np.sqrt(np.einsum("kia,ab,kib->k", jacobians, evidence.covariance, jacobians) / targets)
    per[_blind(evidence, poses)] = np.inf
    spread = evidence.levels.discrepancy_covariance(robot, poses)
    complete = None
    if evidence.transmission is not None:
        squares = np.einsum("ktii->kt", evidence.transmission.error_covariance(poses)).mean(axis=1)
        complete = np.sqrt(squares)
    return Accuracy(poses, per, np.sqrt(np.einsum("ktii->k", spread) / targets), complete, required)


def _blind(evidence: Evidence, poses: FloatArray) -> NDArray[np.bool_]:
    """(K,) whether a pose moves with a combination that is fixed because hardly any measured point does."""
    unseen = [k for k, i in enumerate(evidence.identifiability.fixed) if i not in evidence.resolved]
    if not unseen:
        return np.zeros(len(poses), bool)
    directions = evidence.identifiability.directions[unseen].T
    seen = np.linalg.norm(evidence.jacobian @ directions, axis=2).max(axis=(0, 1))
    return _felt(seen, evidence.robot.jacobian(poses, evidence.at) @ directions)


def blind_poses(robot: Robot, data: Measurements, directions: FloatArray, poses: FloatArray) -> NDArray[np.bool_]:
    """(K,) the same for ``directions`` (fixed, P) that were found where ``robot`` is."""
    if not len(directions):
        return np.zeros(len(poses), bool)
    moved = robot.jacobian(data.q) @ directions.T
    moved = np.where(np.repeat(data.seen, 3, axis=1)[:, :, None], moved, 0.0)
    seen = np.linalg.norm(moved.reshape(*data.p.shape, -1), axis=2).max(axis=(0, 1))
    return _felt(seen, robot.jacobian(poses) @ directions.T)


def _felt(seen: FloatArray, moved: FloatArray) -> NDArray[np.bool_]:
    """(K,) whether ``moved`` (K, 3·targets, fixed) at a pose is far more than ``seen`` (fixed,) at any point."""
    return np.asarray((np.linalg.norm(moved, axis=1) > 10.0 * seen + BLIND).any(axis=1))


def _nearly_dependent(fit: Fit, names: tuple[str, ...]) -> tuple[str, ...]:
    """Combinations of the parameters kept that the data hardly see, weakest first."""
    if not fit.kept:
        return ()
    _, values, vt = np.linalg.svd(fit.triangle)
    weakest = []
    columns = list(fit.kept)
    for value, row in zip(values[::-1], vt[::-1], strict=True):
        if value > WEAK:
            break
        change = np.zeros(len(names))
        change[columns] = np.where(np.abs(row) > 0.1 * np.abs(row).max(), row / fit.scale, 0.0)
        first = int(np.argmax(np.abs(change)))
        weakest.append(describe(change / change[first], names, first))
    return tuple(weakest)


def _rejected(evidence: Evidence, predicted: FloatArray) -> tuple[RejectedPoint, ...]:
    """A row per point not used: where, how far off, and why."""
    data, use = evidence.problem.data, evidence.equations.use
    out = data.seen & ~use
    # A point belongs to another row's prediction if it meets it as well as the used points meet theirs.
    reach = 3.0 * float(distances((data.p - predicted)[use]).max(initial=0.0)) + 1e-6
    words = explain(predicted, data, out, reach) if out.any() else {}
    return tuple(_point(evidence, predicted, i, t, words.get((i, t), "")) for i, t in np.argwhere(out).tolist())


def _suspects(evidence: Evidence, predicted: FloatArray) -> tuple[RejectedPoint, ...]:
    """Points that were used although they lie beyond the gate."""
    far = evidence.equations.use & (np.nan_to_num(evidence.normalised) > evidence.gate)
    return tuple(_point(evidence, predicted, i, t, "used nevertheless") for i, t in np.argwhere(far).tolist())


def _point(evidence: Evidence, predicted: FloatArray, i: int, t: int, words: str) -> RejectedPoint:
    """Row (from 0), target (from 1), reason, residual in standard deviations and in metres."""
    ratio = float(evidence.normalised[i, t])
    error = float(np.linalg.norm(evidence.problem.data.p[i, t] - predicted[i, t]))
    reason = f"{ratio:.3g} standard deviations (gate {evidence.gate:.3g}), {length(error)} off"
    reason += f"; {words}" if words else ""
    return RejectedPoint(i, t + 1, reason, ratio, error)
