"""An estimate by one error model: what ``fit_error_model`` says, in the words of every estimate.

Combinations of the parameters that neither data nor model determine are left out, as in every identification: one
parameter of each stays at its nominal value (or at its closed-form start), and the fit is made without it.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, Knowledge
from calib_planner.identification.checks import check_units, copied_rows, explain, rejected_since
from calib_planner.identification.doubt import gate_of, squares_of_points
from calib_planner.identification.estimate import (
    Accuracy,
    ChiSquare,
    Diagnostics,
    Estimate,
    Learnt,
    LeftOutError,
    Observability,
    ParameterFit,
    Points,
    Residuals,
    residual_statistics,
)
from calib_planner.identification.estimation import ModelEstimate, fit_error_model
from calib_planner.identification.evidence import blind_poses, distances, fit_placement
from calib_planner.identification.noise_levels import NoiseLevels
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.start import check_count, start_robot
from calib_planner.identification.verdict import judged
from calib_planner.measurements import RejectedPoint
from calib_planner.robot import Identifiability, Robot, analyse
from calib_planner.units import length

BoolArray = NDArray[np.bool_]
NOTHING_HIDDEN = Identifiability((), (), (), np.empty((0, 0)), ())


def identify_by_model(problem: IdentificationProblem) -> Estimate:
    """Identify with ``problem.error_model``.

    Raises:
        NotEnoughDataError: Fewer equations than unknown parameters, or most points disagree.
        InputError: The points look like millimetres.
    """
    began = time.perf_counter()
    check_units(problem.robot, problem.data)
    check_count(problem, problem.data.seen)
    model = with_stated_noise(problem)
    robot = start_robot(problem.robot, problem.data, robust=not model.is_papers)
    # A fit may run so far along what it cannot see that it seems to see it: this is asked first at the start.
    hidden = _hidden(model, robot, robot.jacobian(problem.data.q)[np.repeat(problem.data.seen, 3, axis=1)])
    found = _fit(problem, model, robot, hidden)
    if found.knowledge.hidden.shape[1]:
        there = found.knowledge.poses(problem.data.q)
        hidden = _hidden(model, robot, there.jacobian[np.repeat(problem.data.seen, 3, axis=1)])
        found = _fit(problem, model, robot, hidden)
    check_count(problem, problem.data.seen & (found.doubt == 0.0))
    return _estimate(problem, found, hidden, robot, began)


def with_stated_noise(problem: IdentificationProblem) -> ErrorModel:
    """The error model with the noise that the problem states, if it does.

    The paper's has nothing but noise, so that a stated one leaves nothing to be estimated.
    """
    model, noise = problem.error_model, problem.sigma if problem.instrument is None else problem.instrument
    assert model is not None
    if noise is None:
        return model
    paper = ErrorModel.paper(noise)
    return paper if model.is_papers else replace(model, points=replace(model.points, noise=paper.points.noise))


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


def _fit(
    problem: IdentificationProblem, model: ErrorModel, robot: Robot, hidden: Identifiability
) -> ModelEstimate:
    """The fit without one parameter of each hidden combination; all of them are in its knowledge again."""
    names = robot.parameter_names
    kept = tuple(n for i, n in enumerate(names) if i not in hidden.fixed)
    if not hidden.fixed or not kept:
        return fit_error_model(robot, problem.data, model)
    found = fit_error_model(replace(robot, parameter_names=kept), problem.data, model)
    known = found.knowledge
    own = known.model.names(replace(known.robot, parameter_names=names))
    place = [own.index(n) for n in known.model.names(known.robot)]
    coefficients, covariance = np.zeros(len(own)), np.zeros((len(own), len(own)))
    coefficients[place] = known.coefficients
    covariance[np.ix_(place, place)] = known.covariance
    unseen = np.zeros((len(own), known.hidden.shape[1]))
    unseen[place] = known.hidden
    placed = replace(known.robot, parameter_names=names)
    return replace(found, knowledge=Knowledge(placed, known.model, coefficients, covariance, unseen))


# ── the parts of the estimate ────────────────────────────────────────────────────────────────────────


def _estimate(
    problem: IdentificationProblem, found: ModelEstimate, hidden: Identifiability, start: Robot, began: float
) -> Estimate:
    """The answer, with its verdict."""
    known, data, model = found.knowledge, problem.data, found.knowledge.model
    robot, names = known.robot, known.robot.parameter_names
    seen, use = data.seen, data.seen & (found.doubt == 0.0)
    deviations, covariance = known.coefficients[: len(names)], known.covariance[: len(names), : len(names)]
    std = np.sqrt(np.diag(covariance))
    std[list(hidden.fixed)] = np.nan
    status = "not_converged" if not found.converged else "rank_deficient" if hidden.fixed else "ok"
    predicted = known.poses(data.q).points
    residuals = data.p - predicted
    normalised = np.where(seen, np.sqrt(squares_of_points(found.solution, found.doubt)[0]), np.nan)
    before = data.p - fit_placement(start, data).positions(data.q)
    levels = _levels(problem, found, use)
    linear, rank = found.solution.problem, len(names) - len(hidden.fixed)
    flat, spare = linear.basis.shape[1], 3 * int(use.sum()) - rank
    chi = float(np.sum(linear.y * found.solution.weighted))
    scatter = float(np.sqrt(np.sum(residuals[use] ** 2) / spare)) if spare > 0 else float("nan")
    estimate = Estimate(
        calibrated=robot.with_deviations(dict(zip(names, deviations, strict=True))),
        transmission=None,
        fit=ParameterFit(
            parameters=names,
            units=tuple(p.unit for p in robot.parameters),
            nominal=np.array([p.nominal for p in robot.parameters]),
            deviations=deviations,
            std=std,
            covariance=covariance,
            iterations=found.rounds,
            status=status,
        ),
        observability=Observability(
            rank=rank,
            fixed=tuple(names[i] for i in hidden.fixed),
            unidentifiable=hidden.combinations,
            resolved_by_prior=(),
            nearly_dependent=(),
            prior="" if model.is_papers else f"the error model '{model.name}'",
        ),
        points=Points(
            measured=int(seen.sum()),
            used=int(use.sum()),
            rejected=_rejected(problem, predicted, normalised, seen & ~use),
            suspects=(),
            copies=copied_rows(data),
        ),
        residuals=Residuals(
            vectors=residuals,
            normalised=normalised,
            gate=float(np.sqrt(gate_of(int(seen.sum())))),
            before=residual_statistics(distances(before[use])),
            after=residual_statistics(distances(residuals[use])),
            sigma=scatter,
            chi_square=ChiSquare(chi, int(linear.seen.sum()) - flat),
        ),
        noise=levels,
        accuracy=_accuracy(problem, known, blind_poses(start, data, hidden.directions, problem.test_pose_array)),
        diagnostics=Diagnostics((), (), rejected_since(seen, use), None, 0, 0, time.perf_counter() - began),
        error_model=Learnt(known, found.terms, _left_out(found, levels.source), problem.accuracy_frame),
    )
    return judged(estimate)


def _left_out(found: ModelEstimate, source: str) -> LeftOutError:
    """(M4) of the points that count."""
    left, part = found.left_out, found.solution.problem.parts.get("instrument")
    told = residual_statistics(left.distances)
    noise = float("nan")
    if part is not None and source != "residuals" and left.usable.any():
        noise = float(np.sqrt(np.mean(_variances(part, left.usable))))
    return LeftOutError(int(left.usable.sum()), told.mean, told.rms, told.max, left.predicted_rms, noise)


def _variances(part: FloatArray, use: BoolArray) -> FloatArray:
    """(points,) sum of the three variances of each point in use, from (N, 3·targets, 3·targets) [m²]."""
    diagonal = np.diagonal(part, axis1=1, axis2=2)
    return np.asarray(diagonal.reshape(*use.shape, 3).sum(axis=2)[use])


def _levels(problem: IdentificationProblem, found: ModelEstimate, use: BoolArray) -> NoiseLevels:
    """Noise of a point: the instrument and the floor below it."""
    parts, points = found.solution.problem.parts, found.knowledge.model.points
    own = sum((parts[n] for n in ("instrument", "floor") if n in parts), np.zeros(1))
    sigma = float(np.sqrt(np.mean(_variances(np.asarray(own), use)) / 3.0))
    if problem.sigma is not None:
        return NoiseLevels(sigma, "sigma")
    if problem.data.std is not None and problem.instrument is None:
        return NoiseLevels(sigma, "data")
    return NoiseLevels(sigma, "residuals" if points.noise is None else "instrument")


def _accuracy(problem: IdentificationProblem, known: Knowledge, blind: BoolArray) -> Accuracy:
    """(M3) at the test poses, what the parameters have of it, and what placement alone would lack.

    Infinite at the poses (K,) that are ``blind``.
    """
    poses = problem.test_pose_array
    required = float("nan") if problem.required_accuracy is None else problem.required_accuracy
    if not len(poses):
        return Accuracy(poses, np.empty(0), np.empty(0), None, required)
    complete = np.where(blind, np.inf, known.accuracy(poses, problem.accuracy_frame).per_pose)
    told, names = known.predict(poses), known.robot.parameter_names
    placed = known.robot.with_deviations(dict(zip(names, known.coefficients[: len(names)], strict=True)))
    missed = np.sum((told.mean - placed.positions(poses)) ** 2, axis=2)
    own, systematic = (np.trace(part, axis1=2, axis2=3) for part in (told.parameters, told.systematic))
    parameters = np.where(np.isinf(complete), np.inf, np.sqrt(own.mean(axis=1)))
    beyond = np.sqrt(np.maximum(systematic + missed, 0.0).mean(axis=1))
    return Accuracy(poses, parameters, beyond, complete, required)


def _rejected(
    problem: IdentificationProblem, predicted: FloatArray, normalised: FloatArray, out: BoolArray
) -> tuple[RejectedPoint, ...]:
    """A row per point that lost its weight: where, how far off, and why."""
    data = problem.data
    off = np.linalg.norm(data.p - predicted, axis=2)
    used = off[data.seen & ~out]
    words = explain(predicted, data, out, 3.0 * float(used.max(initial=0.0)) + 1e-6) if out.any() else {}
    gate = gate_of(int(data.seen.sum()))
    result = []
    for i, t in np.argwhere(out).tolist():
        ratio, error = float(normalised[i, t]), float(off[i, t])
        reason = f"{ratio:.3g} standard deviations from where the others put it, {length(error)} off"
        alone = ratio**2 > gate
        reason += "" if alone else "; one of a run of visits that are all shifted"
        reason += f"; {words[i, t]}" if (i, t) in words else ""
        result.append(RejectedPoint(i, t + 1, reason, ratio, error))
    return tuple(result)
