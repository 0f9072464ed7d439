# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification, from a problem to its estimate.

1. start      Base and targets, where they are unknown, in closed form (``registration``).
2. which      Combinations of the parameters that neither data nor error model determine are left out: one
              parameter of each stays at its nominal value (or at its closed-form start).
3. fit        Parameters, all other coefficients and the scales of the error model (``estimation``).
4. alone      The same without gravity and joint functions: what a URDF can hold.
5. estimate   What the fit says, in the words of ``Estimate``, with its verdict.

With a start, 1 to 4 are left out where the start can be brought up to date. Its scales and terms stay, and so do
what one visit more or less hardly changes: the errors before calibration, and which combinations the data hardly
see or the prior decides. The next full fit finds them anew.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray, one_thread
from calib_planner.error_model import ErrorModel, Knowledge
from calib_planner.errors import InputError, NotEnoughDataError
from calib_planner.identification.alternatives import Alternative, explain_gross, find_alternatives
from calib_planner.identification.doubt import gate_of, squares_of_points
from calib_planner.identification.estimate import (
    Accuracy,
    ChiSquare,
    Estimate,
    LeftOutError,
    Observability,
    ParameterFit,
    PointNoise,
    Points,
    Residuals,
    ResidualStatistics,
    residual_statistics,
)
from calib_planner.identification.estimation import (
    ModelEstimate,
    Watch,
    fit_error_model,
    placement_alone,
    silent,
    update_error_model,
)
from calib_planner.identification.left_out import LeftOut
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.registration import register
from calib_planner.identification.rejection import copied_rows, explain, rejected_since
from calib_planner.identification.verdict import judged
from calib_planner.measurements import Measurements, RejectedPoint
from calib_planner.robot import BASE_PARAMETERS, Identifiability, Robot, analyse, describe, target_parameters
from calib_planner.units import length

BoolArray = NDArray[np.bool_]
NOTHING_HIDDEN = Identifiability((), (), (), np.empty((0, 0)), ())
BLIND = 1e-5
"""Least motion of a point that tells that a test pose feels what the data cannot see [m per unit]."""
MOST_STEPS, STOOD = 10, 1e-9
"""Most steps that fit base and targets to nominal kinematics, and a step that ends it [m | rad]."""
WEAK = 1e-2
"""Directions of unit-length columns with less than this length are hardly seen."""


@one_thread
def identify(problem: IdentificationProblem, start: Estimate | None = None, watch: Watch = silent) -> Estimate:
    """Identify the active parameters and all else that the error model has.

    Args:
        problem: What is to be identified, from what.
        start: An estimate of the same robot by the same error model from most of these data, which is brought up
            to date at its own scales and terms: many times quicker. A full fit is made where that does not do.
            ``residuals.before``, ``observability.resolved_by_prior`` and ``nearly_dependent`` of an update are
            those of the start.
        watch: Told what share of a full fit is done, 0 … 1, about, and what is done next.

    Raises:
        NotEnoughDataError: Fewer equations than unknown parameters, or most points disagree.
        InputError: The points are not in metres, or the joints not in radians.
    """
    began = time.perf_counter()
    mistake = None if start is not None else explain_gross(problem.robot, problem.data)
    _refuse_units(mistake)
    try:
        estimate = _identify(problem, start, mistake, began, watch)
    except NotEnoughDataError as error:
        if mistake is None:
            raise
        message = f"{error}; {mistake.text}: {mistake.advice}"
        raise NotEnoughDataError(error.have, error.need, message) from None
    return judged(estimate)


def _identify(
    problem: IdentificationProblem,
    start: Estimate | None,
    mistake: Alternative | None,
    began: float,
    watch: Watch,
) -> Estimate:
    """The estimate without its verdict; ``mistake``: what is grossly wrong with the data."""
    check_count(problem, problem.data.seen)
    updated = None if start is None else _updated(problem, start, began)
    if updated is not None:
        return updated
    robot = start_robot(problem.robot, problem.data, robust=problem.robust)
    # A fit may run so far along what it cannot see that it seems to see it: this is decided first at the start.
    rows = np.repeat(problem.data.seen, 3, axis=1)
    hidden = _hidden(problem.model, robot, robot.jacobian(problem.data.q)[rows])
    fit = _fit(problem, robot, hidden, watch)
    if fit.knowledge.hidden.shape[1]:
        poses = fit.knowledge.poses(problem.data.q, problem.data.payload)
        hidden = _hidden(problem.model, robot, poses.jacobian[rows])
        fit = _fit(problem, robot, hidden, watch)
    watch(0.95, "looking for other explanations")
    check_count(problem, problem.data.seen & (fit.doubt == 0.0))
    alternatives: tuple[Alternative, ...] = ()
    if mistake is not None:
        alternatives = (mistake,)
    elif start is None and fit.converged and not problem.model.is_papers:
        at, frame = problem.test_pose_array, problem.accuracy_frame
        alternatives = find_alternatives(robot, problem.data, fit, at, frame)
    return _estimate(problem, fit, hidden, alternatives, robot, began)


def _updated(problem: IdentificationProblem, start: Estimate, began: float) -> Estimate | None:
    """``start`` brought up to date, without its verdict; ``None`` where a full fit is needed."""
    before, hidden = start.model_fit, start.observability.fixed
    if before is None or problem.robot.parameter_names != start.fit.parameters:
        return None
    seen = replace(problem.robot, parameter_names=before.solution.problem.robot.parameter_names)
    fit = update_error_model(seen, problem.data, problem.model, before, robust=problem.robust)
    if fit is None:
        return None
    robot, rows = start.knowledge.robot, np.repeat(problem.data.seen, 3, axis=1)
    now = _hidden(problem.model, robot, robot.jacobian(problem.data.q)[rows])
    if tuple(robot.parameter_names[i] for i in now.fixed) != hidden:
        return None
    check_count(problem, problem.data.seen & (fit.doubt == 0.0))
    return _estimate(problem, fit, now, (), robot, began, start)


# ── before the fit ───────────────────────────────────────────────────────────────────────────────────


def start_robot(robot: Robot, data: Measurements, *, robust: bool = False) -> Robot:
    """``robot`` with its unknown base and targets, if any, at their closed-form values for these data."""
    active = set(robot.parameter_names)
    base, tool = active.issuperset(BASE_PARAMETERS), active.issuperset(target_parameters(len(robot.targets)))
    return register(robot, data, base=base, tool=tool, robust=robust)


def check_count(problem: IdentificationProblem, use: BoolArray) -> None:
    """More equations than parameters, and not more points rejected than used."""
    names = problem.robot.parameter_names
    count, equations = len(names), 3 * int(use.sum())
    flat = int(np.isinf(problem.model.variances(problem.robot)[:count]).sum())
    measured = int(problem.data.seen.sum())
    if 2 * int(use.sum()) < measured:
        raise NotEnoughDataError(
            equations,
            count,
            f"only {int(use.sum())} of {measured} points agree with one another: check joint order, units and "
            "which point belongs to which row before calibrating",
        )
    if equations < flat:
        each = 3 * problem.data.p.shape[1]
        raise NotEnoughDataError(
            equations,
            flat,
            f"{equations} equations for {flat} parameters of which nothing is known: measure at least "
            f"{-(-flat // each)} configurations, or ask for fewer parameters",
        )


def check_units(robot: Robot, data: Measurements) -> None:
    """Refuse points that are not in metres, and joint angles that are not in radians.

    Raises:
        InputError: Another unit makes sense of data that make none as they are; says which.
    """
    _refuse_units(explain_gross(robot, data))


def _refuse_units(mistake: Alternative | None) -> None:
    if mistake is not None and mistake.code == "units":
        raise InputError("measurements", mistake.text, "metres and radians", mistake.advice)


def place_nominal(problem: IdentificationProblem, start: Robot | None = None) -> Robot:
    """The nominal kinematics with base and targets, where they are unknown, fitted to the data.

    ``start``: ``start_robot`` of the same data, if it is known already.
    """
    active = set(problem.robot.parameter_names)
    groups = (BASE_PARAMETERS, target_parameters(len(problem.robot.targets)))
    names = [n for group in groups if active.issuperset(group) for n in group]
    if not names:
        return problem.robot
    robot = start_robot(problem.robot, problem.data, robust=problem.robust) if start is None else start
    data, free = problem.data, replace(robot, parameter_names=tuple(names))
    deviations, use = np.zeros(len(names)), np.repeat(data.seen, 3, axis=1).ravel()
    for _ in range(MOST_STEPS):
        points, jacobian = free.positions_and_jacobian(data.q, deviations)
        apart = np.where(data.seen[:, :, None], data.p - points, 0.0).ravel()
        step = np.linalg.lstsq(jacobian.reshape(-1, len(names))[use], apart[use], rcond=None)[0]
        deviations = deviations + step
        if np.abs(step).max() < STOOD:
            break
    return robot.with_deviations(dict(zip(names, deviations.tolist(), strict=True)))


# ── what cannot be seen ──────────────────────────────────────────────────────────────────────────────


def _hidden(model: ErrorModel, robot: Robot, rows: FloatArray) -> Identifiability:
    """Combinations of the parameters that nothing tells, from the Jacobian's ``rows`` (equations, P)."""
    names = robot.parameter_names
    flat = np.flatnonzero(np.isinf(model.variances(robot)[: len(names)]))
    if not flat.size:
        return NOTHING_HIDDEN
    seen = analyse(rows[:, flat], [names[i] for i in flat])
    directions = np.zeros((len(seen.fixed), len(names)))
    directions[:, flat] = seen.directions
    return replace(seen, fixed=tuple(int(flat[i]) for i in seen.fixed), directions=directions)


def _decided_by_prior(robot: Robot, rows: FloatArray, hidden: Identifiability) -> tuple[str, ...]:
    """Combinations that the data cannot see, and that the error model's prior decides."""
    seen = analyse(rows, robot.parameter_names)
    pairs = zip(seen.fixed, seen.combinations, strict=True)
    return tuple(text for i, text in pairs if i not in hidden.fixed)


def _hardly_seen(names: tuple[str, ...], covariance: FloatArray, fixed: tuple[int, ...]) -> tuple[str, ...]:
    """Combinations of the free parameters that data and prior hardly tell, weakest first."""
    free = [i for i in range(len(names)) if i not in fixed]
    if not free:
        return ()
    scale = np.sqrt(np.diag(covariance)[free])
    values, vectors = np.linalg.eigh(covariance[np.ix_(free, free)] / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-14)) @ vectors.T / np.outer(scale, scale)
    length_of = np.sqrt(np.diag(inverse))
    weak, directions = np.linalg.eigh(inverse / np.outer(length_of, length_of))
    result = []
    for value, direction in zip(np.sqrt(np.maximum(weak, 0.0)), directions.T, strict=True):
        if value > WEAK:
            break
        change = np.zeros(len(names))
        change[free] = np.where(np.abs(direction) > 0.1 * np.abs(direction).max(), direction / length_of, 0.0)
        first = int(np.argmax(np.abs(change)))
        result.append(describe(change / change[first], names, first))
    return tuple(result)


def _blind_poses(problem: IdentificationProblem, robot: Robot, directions: FloatArray) -> BoolArray:
    """(K,) whether a test pose moves with one of ``directions`` (fixed, P) far more than any measured point."""
    poses, data = problem.test_pose_array, problem.data
    if not len(directions):
        return np.zeros(len(poses), bool)
    moved = robot.jacobian(data.q) @ directions.T
    moved = np.where(np.repeat(data.seen, 3, axis=1)[:, :, None], moved, 0.0)
    seen = np.linalg.norm(moved.reshape(*data.p.shape, -1), axis=2).max(axis=(0, 1))
    felt = robot.jacobian(poses) @ directions.T
    return np.asarray((np.linalg.norm(felt, axis=1) > 10.0 * seen + BLIND).any(axis=1))


def _fit(problem: IdentificationProblem, robot: Robot, hidden: Identifiability, watch: Watch) -> ModelEstimate:
    """The fit without one parameter of each hidden combination; these are in no part of it."""
    free = tuple(n for i, n in enumerate(robot.parameter_names) if i not in hidden.fixed)
    seen = replace(robot, parameter_names=free or robot.parameter_names)
    return fit_error_model(seen, problem.data, problem.model, robust=problem.robust, watch=watch)


def _with_fixed(known: Knowledge, names: tuple[str, ...]) -> Knowledge:
    """With all parameters ``names``; those that it does not have are at their nominal values, without doubt."""
    if known.robot.parameter_names == names:
        return known
    robot = replace(known.robot, parameter_names=names)
    own = known.model.names(robot)
    place = [own.index(n) for n in known.model.names(known.robot)]
    coefficients, covariance = np.zeros(len(own)), np.zeros((len(own), len(own)))
    coefficients[place] = known.coefficients
    covariance[np.ix_(place, place)] = known.covariance
    unseen = np.zeros((len(own), known.hidden.shape[1]))
    unseen[place] = known.hidden
    return Knowledge(robot, known.model, coefficients, covariance, unseen)


# ── the parts of the estimate ────────────────────────────────────────────────────────────────────────


def _estimate(
    problem: IdentificationProblem,
    fit: ModelEstimate,
    hidden: Identifiability,
    alternatives: tuple[Alternative, ...],
    start: Robot,
    began: float,
    before: Estimate | None = None,
) -> Estimate:
    """The answer, without its verdict; ``before``: the estimate that ``fit`` is an update of."""
    data, names = problem.data, start.parameter_names
    known = _with_fixed(fit.knowledge, names)
    alone = placement_alone(fit, None if before is None else before.placement_fit)
    seen, use = data.seen, data.seen & (fit.doubt == 0.0)
    deviations, covariance = known.coefficients[: len(names)], known.covariance[: len(names), : len(names)]
    std = np.sqrt(np.diag(covariance))
    std[list(hidden.fixed)] = np.nan
    status = "not_converged" if not fit.converged else "rank_deficient" if hidden.fixed else "ok"
    predicted = known.poses(data.q, data.payload).points
    residuals = data.p - predicted
    normalised = np.where(seen, np.sqrt(squares_of_points(fit.solution, fit.doubt)[0]), np.nan)
    gate = float(np.sqrt(gate_of(int(seen.sum()))))
    source = problem.noise_source
    linear, rank = fit.solution.problem, len(names) - len(hidden.fixed)
    flat, spare = linear.basis.shape[1], 3 * int(use.sum()) - rank
    chi = float(np.sum(linear.y * fit.solution.weighted))
    scatter = float(np.sqrt(np.sum(residuals[use] ** 2) / spare)) if spare > 0 else float("nan")
    off = _point_rows(problem, predicted, normalised, seen & ~use, gate)
    suspects = _point_rows(problem, predicted, normalised, use & (np.nan_to_num(normalised) > gate), gate)
    calibrated = _with_fixed(alone.knowledge, names).placed
    if before is None:
        sight = _observability(problem, start, covariance, hidden)
        errors_before = _before(problem, start, use)
    else:
        sight, errors_before = before.observability, before.residuals.before
    return Estimate(
        calibrated=calibrated,
        knowledge=known,
        fit=ParameterFit(
            parameters=names,
            units=tuple(p.unit for p in known.robot.parameters),
            nominal=np.array([p.nominal for p in known.robot.parameters]),
            deviations=deviations,
            std=std,
            covariance=covariance,
            iterations=fit.rounds,
            status=status,
        ),
        observability=sight,
        points=Points(
            measured=int(seen.sum()),
            used=int(use.sum()),
            rejected=off,
            suspects=suspects if not problem.robust else (),
            copies=copied_rows(data),
            moved_since=rejected_since(seen, use),
        ),
        residuals=Residuals(
            vectors=residuals,
            normalised=normalised,
            gate=gate,
            before=errors_before,
            after=residual_statistics(np.linalg.norm(residuals, axis=2)[use]),
            placement_alone=residual_statistics(
                np.linalg.norm(data.p - calibrated.positions(data.q), axis=2)[use]
            ),
            sigma=scatter,
            spare=_spare(fit),
            chi_square=ChiSquare(chi, int(linear.seen.sum()) - flat),
        ),
        noise=PointNoise(_point_sigma(fit, use), source),
        accuracy=_accuracy(problem, known, calibrated, _blind_poses(problem, start, hidden.directions)),
        left_out=_left_out_error(fit.left_out, fit, source),
        placement_alone=_left_out_error(alone.left_out, fit, source),
        terms=fit.terms,
        alternatives=alternatives,
        seconds=time.perf_counter() - began,
        model_fit=fit,
        placement_fit=alone,
    )


def _observability(
    problem: IdentificationProblem, start: Robot, covariance: FloatArray, hidden: Identifiability
) -> Observability:
    """What the data can see; ``covariance`` (P, P) of the parameters."""
    data, names = problem.data, start.parameter_names
    rows = start.jacobian(data.q)[np.repeat(data.seen, 3, axis=1)]
    return Observability(
        rank=len(names) - len(hidden.fixed),
        fixed=tuple(names[i] for i in hidden.fixed),
        unidentifiable=hidden.combinations,
        resolved_by_prior=_decided_by_prior(start, rows, hidden),
        nearly_dependent=_hardly_seen(names, covariance, hidden.fixed),
        prior=_prior_words(problem.model),
    )


def _before(problem: IdentificationProblem, start: Robot, use: BoolArray) -> ResidualStatistics:
    """Distances of the points in ``use`` (N, targets) with nominal kinematics."""
    apart = problem.data.p - place_nominal(problem, start).positions(problem.data.q)
    return residual_statistics(np.linalg.norm(apart, axis=2)[use])


def _prior_words(model: ErrorModel) -> str:
    """What is known of the parameters beforehand; empty if nothing is."""
    stated = model.placement.stated
    if stated is not None:
        return stated.source
    return "" if model.placement.prior == "flat" else f"the tolerances of the error model '{model.name}'"


def _left_out_error(left: LeftOut, fit: ModelEstimate, source: str) -> LeftOutError:
    """(M4) of the points that count."""
    part = fit.solution.problem.parts.get("instrument")
    told = residual_statistics(left.distances)
    noise = float("nan")
    if part is not None and source != "residuals" and left.usable.any():
        noise = float(np.sqrt(np.mean(_variances(part, left.usable))))
    count, freedom = int(left.usable.sum()), _freedom_left_out(left, fit)
    return LeftOutError(count, told.mean, told.rms, told.max, left.predicted_rms, noise, freedom)


def _freedom_left_out(left: LeftOut, fit: ModelEstimate) -> float:
    """Degrees of freedom of the mean square left-out distance, as a χ²: no more than the fit leaves.

    A χ² with f degrees of freedom has a root mean square of standard deviation 1/√(2f) of its expectation.
    """
    if not left.usable.any():
        return 0.0
    return float(min(0.5 / left.excess[1] ** 2, _spare(fit)))


def _spare(fit: ModelEstimate) -> float:
    """Coordinates of the points at different configurations, less the parameters that the data determine.

    Repetitions tell the noise, and nothing of whether the model holds elsewhere. Of a parameter the data
    determine what they take off its prior variance, 1 − C_kk/σ_k²; all of one of which nothing was known.
    """
    linear, groups, known = fit.solution.problem, fit.left_out.groups, fit.knowledge
    count = len(known.robot.parameter_names)
    left = np.diag(known.covariance)[:count] / known.model.variances(known.robot)[:count]
    different = np.zeros((int(groups.max()) + 1, linear.seen.shape[1]))
    np.maximum.at(different, groups, linear.seen)
    return max(float(different.sum() - np.sum(1.0 - np.clip(left, 0.0, 1.0))), 0.0)


def _variances(part: FloatArray, use: BoolArray) -> FloatArray:
    """(points,) sum of the three variances of each point in use, from (N, 3·targets, 3·targets) [m²]."""
    diagonal = np.diagonal(part, axis1=1, axis2=2)
    return np.asarray(diagonal.reshape(*use.shape, 3).sum(axis=2)[use])


def _point_sigma(fit: ModelEstimate, use: BoolArray) -> float:
    """Standard deviation of a coordinate of a point [m]: the instrument and the floor below it."""
    parts = fit.solution.problem.parts
    own = sum((parts[n] for n in ("instrument", "floor") if n in parts), np.zeros(1))
    return float(np.sqrt(np.mean(_variances(np.asarray(own), use)) / 3.0))


def _accuracy(problem: IdentificationProblem, known: Knowledge, calibrated: Robot, blind: BoolArray) -> Accuracy:
    """(M3) at the test poses; infinite at those (K,) that are ``blind``."""
    poses = problem.test_pose_array
    required = float("nan") if problem.required_accuracy is None else problem.required_accuracy
    if not len(poses):
        nothing = np.empty(0)
        return Accuracy(poses, nothing, nothing, known, problem.accuracy_frame, required)
    complete = np.where(blind, np.inf, known.accuracy(poses, problem.accuracy_frame).per_pose)
    apart = known.poses(poses).points - calibrated.positions(poses)
    missed = np.sqrt(np.sum(apart**2, axis=2).mean(axis=1))
    return Accuracy(
        test_poses=poses,
        predicted=complete,
        placement=np.hypot(complete, missed),
        knowledge=known,
        frame=problem.accuracy_frame,
        required=required,
    )


def _point_rows(
    problem: IdentificationProblem, predicted: FloatArray, normalised: FloatArray, out: BoolArray, gate: float
) -> tuple[RejectedPoint, ...]:
    """A row per point of ``out`` (N, targets): where, how far off, and why."""
    data = problem.data
    off = np.linalg.norm(data.p - predicted, axis=2)
    # A point belongs to another row's prediction if it meets it as well as the used points meet theirs.
    used = off[data.seen & ~out]
    words = explain(predicted, data, out, 3.0 * float(used.max(initial=0.0)) + 1e-6) if out.any() else {}
    result = []
    for i, t in np.argwhere(out).tolist():
        ratio, error = float(normalised[i, t]), float(off[i, t])
        reason = f"{ratio:.3g} standard deviations (gate {gate:.3g}) from where the others put it"
        reason += f", {length(error)} off"
        reason += "" if ratio > gate else "; one of a run of visits that are all shifted"
        reason += f"; {words[i, t]}" if (i, t) in words else ""
        result.append(RejectedPoint(i, t + 1, reason, ratio, error))
    return tuple(result)
