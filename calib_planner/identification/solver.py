"""Identification: the paper's iterative least squares, eqs. (6) and (7).

Linearise at the current parameters, eq. (3); solve min ‖J ΔΠ − Δp‖² for the whitened, column-scaled Jacobian
of an irreducible set of parameters (see ``identifiability``); add ΔΠ; repeat. A step that does not lower the
sum of squares is damped (Levenberg–Marquardt): the plain iteration is what happens when nothing goes wrong.
Afterwards cov(Π̂) = σ² (JᵀJ)⁻¹, eq. (11), with σ given, or estimated from the residuals.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.design.identifiability import Identifiability, analyse
from calib_planner.design.information import error_variance
from calib_planner.errors import NotEnoughDataError
from calib_planner.identification.estimate import STATUS, Estimate, residual_statistics
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.registration import register
from calib_planner.robot.chain import Robot

STEP_TOLERANCE = 1e-7
"""A step that moves the predictions by less than this share of the residuals ends the iteration."""
STEP_FLOOR = 1e-10
"""The same without residuals, in whitened units (standard deviations, or metres where none are known)."""


def identify(problem: IdentificationProblem) -> Estimate:
    """Identify the active parameters.

    Raises:
        NotEnoughDataError: Fewer equations than parameters.
    """
    began = time.perf_counter()
    robot = start_robot(problem.robot, problem.data)
    equations = 3 * int(problem.data.seen.sum())
    count = len(robot.parameter_names)
    if equations < count:
        each = 3 * problem.data.p.shape[1]
        raise NotEnoughDataError(
            equations,
            count,
            f"{equations} equations for {count} parameters: measure at least {-(-count // each)} "
            "configurations, or ask for fewer parameters",
        )
    system = _System(robot, problem.data, _weights(problem))
    fit = _iterate(system, np.zeros(count), problem.iterations)
    return _estimate(problem, robot, system, fit, began)


def start_robot(robot: Robot, data: Measurements) -> Robot:
    """``robot`` with its unknown base and targets, if any, at their closed-form values for these data."""
    active = robot.parameter_names
    base = all(f"base.{a}" in active for a in ("x", "y", "z", "rx", "ry", "rz"))
    tool = all(f"target_{t + 1}.{a}" in active for t in range(len(robot.targets)) for a in "xyz")
    return register(robot, data, base=base, tool=tool)


# ── the iteration ────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class _System:
    """Whitened residuals and Jacobian as functions of the deviations."""

    robot: Robot
    data: Measurements
    weights: FloatArray  # (equations,) 1/σ of each coordinate

    @property
    def mask(self) -> FloatArray:
        """(N, targets, 3) which coordinates were measured."""
        return np.repeat(self.data.seen[:, :, None], 3, axis=2)

    def residuals(self, deviations: FloatArray) -> FloatArray:
        """(equations,) whitened measured − predicted."""
        predicted = self.robot.positions(self.data.q, deviations)
        return (self.data.p - predicted)[self.mask] * self.weights

    def linearise(self, deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals and whitened Jacobian (equations, P)."""
        predicted, jacobian = self.robot.positions_and_jacobian(self.data.q, deviations)
        residuals = (self.data.p - predicted)[self.mask] * self.weights
        rows = jacobian.reshape(*self.data.p.shape, -1)[self.mask]
        return residuals, rows * self.weights[:, None]


@dataclass(frozen=True)
class _Fit:
    deviations: FloatArray
    identifiability: Identifiability
    jacobian: FloatArray
    residuals: FloatArray
    iterations: int
    converged: bool


def _iterate(system: _System, deviations: FloatArray, most: int) -> _Fit:
    residuals, jacobian = system.linearise(deviations)
    found = analyse(jacobian / system.weights.max(), system.robot.parameter_names)
    kept = list(found.kept)
    damping, done = 0.0, 0
    converged = not kept
    while kept and done < most and not converged:
        done += 1
        scale = np.linalg.norm(jacobian[:, kept], axis=0)
        unit = jacobian[:, kept] / scale
        if damping:
            padded = np.vstack([unit, np.sqrt(damping) * np.eye(len(kept))])
            step = np.linalg.lstsq(padded, np.append(residuals, np.zeros(len(kept))), rcond=None)[0]
        else:
            step = np.linalg.lstsq(unit, residuals, rcond=None)[0]
        trial = deviations.copy()
        trial[kept] += step / scale
        cost, new_cost = float(residuals @ residuals), np.inf
        if np.isfinite(trial).all():
            new = system.residuals(trial)
            new_cost = float(new @ new)
        size = np.linalg.norm(unit @ step)
        floor = STEP_FLOOR + STEP_TOLERANCE * np.linalg.norm(residuals)
        if new_cost <= cost or size <= floor:
            deviations = trial if new_cost <= cost else deviations
            residuals, jacobian = system.linearise(deviations)
            damping = 0.0 if damping < 1e-6 else damping / 10
            converged = bool(size <= floor)
        else:
            damping = max(10 * damping, 1e-6)
    return _Fit(deviations, found, jacobian, residuals, done, converged)


def _weights(problem: IdentificationProblem) -> FloatArray:
    """1/σ of each measured coordinate; equal where nothing is known."""
    mask = np.repeat(problem.data.seen[:, :, None], 3, axis=2)
    if problem.sigma is not None:
        return np.full(int(mask.sum()), 1.0 / problem.sigma)
    if problem.data.std is not None:
        return 1.0 / np.asarray(problem.data.std)[mask]
    return np.ones(int(mask.sum()))


# ── the answer ───────────────────────────────────────────────────────────────────────────────────────


def _estimate(problem: IdentificationProblem, robot: Robot, system: _System, fit: _Fit, began: float) -> Estimate:
    names = robot.parameter_names
    kept = list(fit.identifiability.kept)
    redundancy = len(fit.residuals) - len(kept)
    cost = float(fit.residuals @ fit.residuals)
    factor = np.sqrt(cost / redundancy) if redundancy else float("nan")
    unit_sigma = float(1.0 / np.sqrt(np.mean(system.weights**2)))
    known = problem.sigma is not None or problem.data.std is not None
    inflate = 1.0 if known or not redundancy else factor
    covariance = np.zeros((len(names), len(names)))
    scale = np.linalg.norm(fit.jacobian[:, kept], axis=0)
    triangle = np.linalg.qr(fit.jacobian[:, kept] / scale, mode="r")
    half = np.linalg.solve(triangle, np.eye(len(kept))) / scale[:, None]
    covariance[np.ix_(kept, kept)] = inflate**2 * (half @ half.T)
    std = np.full(len(names), np.nan)
    std[kept] = np.sqrt(np.diag(covariance)[kept])
    status = "ok" if fit.converged else "not_converged"
    if fit.converged and fit.identifiability.held:
        status = "rank_deficient"
    predicted = robot.positions(problem.data.q, fit.deviations)
    residuals = problem.data.p - predicted
    before = fit_placement(robot, problem.data).positions(problem.data.q)
    poses = problem.test_pose_array
    parameters = robot.parameters
    return Estimate(
        robot=robot.name,
        joint_names=robot.joint_names,
        parameters=names,
        units=tuple(p.unit for p in parameters),
        nominal=np.array([p.nominal for p in parameters]),
        deviations=fit.deviations,
        std=std,
        covariance=covariance,
        rank=len(kept),
        unidentifiable=fit.identifiability.combinations,
        held=tuple(names[i] for i in fit.identifiability.held),
        measurements=int(problem.data.seen.sum()),
        used=int(problem.data.seen.sum()),
        rejected=(),
        sigma=unit_sigma * inflate,
        sigma_estimate=unit_sigma * factor,
        residual_before=residual_statistics(distances(problem.data.p - before)),
        residual_after=residual_statistics(distances(residuals)),
        residuals=residuals,
        test_poses=poses,
        predicted_accuracy_per_test_pose=_accuracy(robot, poses, fit.deviations, covariance, fit),
        iterations=fit.iterations,
        status=status,
        message=STATUS[status],
        seconds=time.perf_counter() - began,
        calibrated=robot.with_deviations(dict(zip(names, fit.deviations, strict=True))),
    )


def fit_placement(robot: Robot, data: Measurements) -> Robot:
    """The nominal kinematics with base and targets fitted to the data where they are unknown."""
    placement = [n for n in robot.parameter_names if n.startswith(("base.", "target_"))]
    if not placement:
        return robot
    fitted = robot.with_parameters(placement)
    weights = np.ones(3 * int(data.seen.sum()))
    fit = _iterate(_System(fitted, data, weights), np.zeros(len(placement)), 50)
    return robot.with_deviations(dict(zip(placement, fit.deviations, strict=True)))


def distances(residuals: FloatArray) -> FloatArray:
    """Lengths (count,) [m] of the residual vectors (…, 3) that were measured."""
    lengths = np.linalg.norm(residuals, axis=-1)
    return lengths[np.isfinite(lengths)]


def _accuracy(
    robot: Robot, poses: FloatArray, deviations: FloatArray, covariance: FloatArray, fit: _Fit
) -> FloatArray:
    """ρ0 per test pose; infinite if it depends on a combination that the data cannot see."""
    if not len(poses):
        return np.empty(0)
    jacobians = robot.jacobian(poses, deviations)
    per = np.sqrt(np.einsum("kia,ab,kib->k", jacobians, covariance, jacobians) / len(robot.targets))
    if fit.identifiability.held:
        matrix = fit.jacobian.T @ fit.jacobian
        blind = [not np.isfinite(error_variance(j, matrix)) for j in jacobians]
        per[blind] = np.inf
    return per
