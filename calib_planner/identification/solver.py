"""Identification: from measurements to parameters, in the order in which doubt is resolved.

1. start       tracker pose and targets in closed form (``registration``)
2. which       an irreducible set of parameters (``design.identifiability``)
3. who         points to believe, if the loss is robust (``robust``)
4. how much    the paper's iteration (``least_squares``) with weights (``weighing``): a fit that measurement noise
               does not explain gets a discrepancy, and new weights, before 3 is looked at again
5. how sure    other starts must end in the same place; cov(Π̂) of eq. (11) with the final weights
6. what else   residuals that know where the robot stood: errors of the joints (``transmission``), and those that
               the residuals could not show (``hidden_errors``)
"""

from __future__ import annotations

import time

import numpy as np

from calib_planner.arrays import FloatArray, one_thread
from calib_planner.identification.by_model import identify_by_model
from calib_planner.identification.checks import (
    SIGNIFICANT,
    Disturbance,
    HiddenErrors,
    Structure,
    check_distances,
    check_order,
    check_units,
    hidden_errors,
    instead_of_discrepancy,
    rejected_since,
    residual_structure,
    wholly_whitened,
)
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.evidence import Evidence, estimate_of
from calib_planner.identification.least_squares import Fit, gauss_newton
from calib_planner.identification.noise_levels import improbable
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.robust import (
    gate_of,
    normalised,
    select,
)
from calib_planner.identification.start import check_count, start_robot
from calib_planner.identification.transmission import Transmission, fit_transmission, geometry_covariance
from calib_planner.identification.weighing import TINY, Weighed, Work, weigh, without_unseen
from calib_planner.robot import Robot

MOST_GATES = 12
"""Rounds of the gate; a selection that still changes then is taken as it is."""
START_LENGTH = 5e-3
"""Standard deviation of the lengths of other starts [m]."""
START_ANGLE = 2e-2
"""The same for angles [rad]."""


@one_thread
def identify(problem: IdentificationProblem, start: Estimate | None = None) -> Estimate:
    """Identify the active parameters.

    Args:
        problem: What is asked. With an ``error_model`` the steps are those of ``estimation``.
        start: Values to go on from where a first fit from nominal ones has not come near the minimum, such as the
            estimate before the newest measurement; saves time, the answer is the same.

    Raises:
        NotEnoughDataError: Fewer equations than parameters, or fewer good points than are needed.
        InputError: The points look like millimetres.
    """
    if problem.error_model is not None:
        return identify_by_model(problem)
    began = time.perf_counter()
    check_units(problem.robot, problem.data)
    robot = start_robot(problem.robot, problem.data, robust=problem.loss == "robust")
    check_count(problem, problem.data.seen)
    # What is decided on the way is decided from nominal: no start can tip it.
    work, first, near = _begun(problem, robot)
    if start is not None and problem.loss == "linear" and not near:
        first = work.start_values(start)
    found = weigh(work, work.use, first)
    if problem.loss == "robust":
        found = _gated(work, found)
    found, starts, agreeing = _other_starts(work, found)
    structure = _structure(work, found)
    transmission = _transmission(work, found, structure)
    evidence = Evidence(
        problem=problem,
        robot=robot,
        equations=found.equations,
        fit=found.fit,
        identifiability=work.identifiability,
        resolved=tuple(sorted(set(found.fit.kept) & set(work.identifiability.fixed))),
        levels=found.levels,
        covariance=_covariance(work, found, transmission),
        chi_square=found.chi_square,
        freedom=found.freedom,
        normalised=_normalised(work, found),
        gate=_gate(found),
        at=work.at,
        jacobian=work.jacobian,
        structure=structure,
        disturbances=_disturbances(work, found),
        moved_since=rejected_since(problem.data.seen, found.equations.use),
        transmission=transmission,
        hidden=_hidden(work, found, transmission),
        starts=starts,
        agreeing=agreeing,
        seconds=time.perf_counter() - began,
    )
    return estimate_of(evidence)


# ── points come and go ───────────────────────────────────────────────────────────────────────────────


def _begun(problem: IdentificationProblem, robot: Robot) -> tuple[Work, FloatArray, bool]:
    """``without_unseen`` of the points to begin with: all, or those that a fit forgetting far ones believes."""
    seen = problem.data.seen
    whole = Work.of(problem, robot, seen)
    work, first, near = without_unseen(whole)
    if problem.loss != "robust":
        return work, first, near
    known = work.source != "residuals"
    use = select(work.equations(seen, work.instrument), work.kept, first, scale_known=known)
    check_count(problem, use)
    return (work, first, near) if (use == seen).all() else without_unseen(whole.told_by(use))


def _gated(work: Work, found: Weighed) -> Weighed:
    """Points go and come back until the selection stands still."""
    seen, use = work.problem.data.seen, found.equations.use
    for _ in range(MOST_GATES):
        distance = _normalised(work, found)
        with np.errstate(invalid="ignore"):
            new = seen & (distance <= _gate(found))
        if (new == use).all():
            break
        use = new
        check_count(work.problem, use)
        found = weigh(work, use, found.fit.deviations, found.levels)
    return found


def _gate(found: Weighed) -> float:
    """Largest believable normalised residual."""
    count = int(found.equations.data.seen.sum())
    stated = found.levels.source in ("sigma", "data", "instrument") and not found.levels.discrepancy
    if not stated:
        return gate_of(count, found.freedom)
    if not improbable(found.chi_square, found.freedom):
        return gate_of(count)
    # No discrepancy was allowed to explain the residuals: far is what is far from the others.
    return gate_of(count, found.freedom) * float(np.sqrt(found.chi_square / found.freedom))


def _normalised(work: Work, found: Weighed) -> FloatArray:
    """(N, targets) length of each residual in standard deviations of what it should be."""
    return normalised(found.residuals, found.residual_covariance())


# ── is it the only minimum? ──────────────────────────────────────────────────────────────────────────


def _other_starts(work: Work, found: Weighed) -> tuple[Weighed, int, int]:
    """Begin elsewhere, with the same points and weights: best fit, starts made, starts that ended with it."""
    rng = np.random.default_rng(0)
    angle = np.array([p.unit == "rad" for p in work.robot.parameters])
    spread = np.where(angle, START_ANGLE, START_LENGTH)
    kept, best, agreeing = list(found.fit.kept), found.fit, 0
    for _ in range(work.problem.starts):
        first = found.fit.deviations.copy()
        first[kept] += spread[kept] * rng.standard_normal(len(kept))
        close = 1e-6 * best.cost + 1e-6
        same = best.cost + 0.5 * close
        other = gauss_newton(found.equations, first, found.fit.kept, work.problem.iterations, enough=same)
        if other.cost < best.cost - close and other.converged:
            best, agreeing = other, 0
        agreeing += int(abs(other.cost - best.cost) <= close and _same(other, best))
    if best is not found.fit:
        # The first start was one of those that ended elsewhere.
        found, agreeing = (
            weigh(work, found.equations.use, best.deviations),
            min(agreeing, work.problem.starts - 1),
        )
    return found, work.problem.starts, agreeing


def _same(one: Fit, other: Fit) -> bool:
    """Whether two fits ended in one place: closer than a standard deviation in every parameter."""
    kept = list(one.kept)
    std = np.sqrt(np.diag(one.covariance())[kept])
    return bool((np.abs(one.deviations - other.deviations)[kept] <= std).all())


# ── do the residuals know where the robot stood, or when? ─────────────────────────────────────────────────────


def _structure(work: Work, found: Weighed) -> tuple[Structure, ...]:
    use, q = found.equations.use, work.problem.data.q
    return residual_structure(work.robot, q, found.residuals, use, work.labels)


def _transmission(work: Work, found: Weighed, structure: tuple[Structure, ...]) -> Transmission | None:
    """Errors of the joints' transmissions, if there is reason to look for them."""
    reason = found.levels.discrepancy > 0 or any(s.probability < SIGNIFICANT for s in structure)
    if work.problem.joint_corrections == "off" or not reason or not found.fit.converged:
        return None
    instrument = _instrument(work, found)
    return fit_transmission(found.equations, found.fit.deviations, found.fit.kept, instrument, work.labels)


def _instrument(work: Work, found: Weighed) -> FloatArray:
    """Where the instrument's noise is unknown it is part of the white noise that is estimated there."""
    if found.levels.source == "residuals":
        return TINY * work.instrument
    if found.levels.source == "repetitions":
        return (found.levels.measurement / work.unit) ** 2 * work.instrument
    return found.levels.scaled**2 * work.instrument


def _covariance(work: Work, found: Weighed, transmission: Transmission | None) -> FloatArray:
    """cov(Π̂): configurations that share a joint angle share its error, as far as that is known."""
    if transmission is None:
        return found.covariance
    return geometry_covariance(transmission, found.equations, found.fit, _instrument(work, found), work.labels)


def _hidden(work: Work, found: Weighed, transmission: Transmission | None) -> HiddenErrors | None:
    """Errors of the joints that the data would not have shown, where none were learnt."""
    if work.problem.joint_corrections == "off" or transmission is not None or not found.fit.converged:
        return None
    white = wholly_whitened(found.equations, work.instrument, found.levels, work.labels)
    return hidden_errors(found.equations, white, found.fit, found.levels, work.problem.test_pose_array)


def _disturbances(work: Work, found: Weighed) -> tuple[Disturbance, ...]:
    """What seems to have moved during the campaign, and matters."""
    if work.problem.order_check == "off" or not found.fit.converged:
        return ()
    white = wholly_whitened(found.equations, work.instrument, found.levels, work.labels)
    fitted, levels = (found.fit.deviations, found.fit.kept, found.covariance), found.levels
    asked = check_order(white, *fitted)
    if levels.discrepancy > 0 and levels.source != "residuals" and not any(d.matters for d in asked):
        noisy = work.equations(found.equations.use, _instrument(work, found))
        repeats = levels.repeat_freedom if levels.source == "repetitions" else 0
        distances = check_distances(noisy, *fitted)
        others = (*check_order(noisy, *fitted), *(() if distances is None else (distances,)))
        other = instead_of_discrepancy(others, repeats)
        asked = () if other is None else (other,)
    return tuple(d for d in asked if d.matters)
