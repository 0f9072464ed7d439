"""After a batch: identify, and stop or plan the next one. Seconds of work; the state it is about does not change.

For the fit, in this order:

1. The error predicted at the worst test pose, with noise and discrepancy *as estimated*, is what was required,
   there are ``minimum`` configurations, and different ones give ``FEWEST_SPARE`` more equations than there are
   parameters (repetitions cannot show that the model is wrong): **reached**.
2. More than ``most_failures`` configurations had to be given up: **unreachable**.
3. No measurement is left but those of the validation: **budget_spent**.
4. What repetitions prove to be the robot's own, not noise, is more than required at a test pose even if nothing
   else were uncertain: **limited**. More measurements would be an afternoon burnt. Errors of the joints can be
   learnt, though, so where that is allowed this waits for ``LEARNABLE`` configurations.
5. If it is open whether it is noise, measured configurations are measured again: that is what tells.
6. Else the next batch is planned on the robot as identified so far, with the noise as estimated and all that was
   measured; for a robot with a discrepancy as ``design.discrepancy`` says, from random candidates.

Then the validation. Good plans measure at few places, where a wrong model fits well enough: what contradicts it
best are configurations chosen for nothing but being elsewhere. If they do (χ², see ``requirement``), where the
accuracy seemed to be reached, and the budget allows, they join the fit, which goes on, and others are held out in
the end. What is reported is always of configurations that took no part.

The uncertain part ρ of the predicted error falls with 1/√N, its floor φ stays, so that what is required, ρ̄, takes

    n = N (ρ²/(ρ̄² − φ²) − 1)

more measurements: the forecast, and the size of the batch if that is less. The first batch identifies with enough
redundancy to judge, and measures ``REPEATED`` of its configurations a second time, at the end of the tour.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc

from calib_planner.arrays import FloatArray
from calib_planner.campaign.batch import next_batch, plan_problem, toured, validation_poses
from calib_planner.campaign.findings import Finding, forecast, found_in, outcome_of, round_of
from calib_planner.campaign.problem import OUTCOMES, CampaignResult
from calib_planner.campaign.state import FINISHED, FIT, VALIDATION, CampaignState, Decision, Stop
from calib_planner.errors import CalibPlannerError, InfeasibleError, NotEnoughDataError
from calib_planner.identification import (
    DOUBT,
    LEVELS,
    SAME_JOINT,
    Estimate,
    Reason,
    Verdict,
    normalised,
    validate,
)
from calib_planner.measurements import Measurements
from calib_planner.planning import Feasibility
from calib_planner.tracker import Noise
from calib_planner.units import counted, length


def decide(state: CampaignState, stopped: Callable[[], bool] = lambda: False) -> Decision:
    """What follows from what was measured.

    Args:
        state: Its ``action`` is ``Replan`` or ``Validate``.
        stopped: Asked while a plan is searched; true: take the best so far.

    Raises:
        InfeasibleError: There is no first plan: constraints that leave nothing, or too small a budget.
    """
    if state.phase == VALIDATION:
        return validation(state)
    try:
        found = found_in(state)
    except NotEnoughDataError:
        found = None
    except CalibPlannerError as error:
        return ended(state, None, "failed", str(error))
    outcome, message = outcome_of(state, found)
    if outcome:
        return ended(state, found, outcome, message)
    try:
        return next_batch(state, found, stopped)
    except InfeasibleError as error:
        if not state.rounds and not state.rows:
            raise
        return ended(state, found, "unreachable", str(error))


# ── The end of a campaign: held-out configurations, what they say, the result; see ``decision`` ─────────────


def ended(state: CampaignState, found: Finding | None, outcome: str, message: str) -> Decision:
    """The fit has ended: on to the validation, or to the result."""
    text = f"{outcome}: {message}"
    made = None if found is None and not state.rows else round_of(state, found, 0, text)
    left = 0.0 if outcome == "reached" or found is None else forecast(found, state.problem.required_accuracy)
    after = replace(state, outcome=outcome, message=message, left=left)
    if made is not None:
        after = replace(after, rounds=(*state.rounds, made))
    return replace(validation(after, found), outcome=outcome, round=made, left=left)


def validation(state: CampaignState, found: Finding | None = None) -> Decision:
    """More validation configurations if some are wanting, else the result."""
    problem = state.problem
    if found is None:
        try:
            found = found_in(state)
        except CalibPlannerError:
            found = None
    if found is None:
        return Decision(FINISHED, state.message, result=_result(state, None))
    wanting = min(problem.validation - len(state.of_role(VALIDATION)), problem.budget - state.spent())
    if wanting > 0 and state.given_up <= problem.most_failures + problem.validation:
        q = _held_out(state, found, wanting)
        if len(q):
            first = len(state.stops)
            queue = toured(state, q, tuple(range(first, first + len(q))))
            stops = tuple(Stop(row, VALIDATION) for row in q)
            return Decision(VALIDATION, state.message, stops, (), queue, left=state.left)
    held_out = state.data(VALIDATION)
    if held_out is not None and contradicted(found.estimate, found.noise, held_out):
        if state.outcome == "reached" and problem.budget - state.spent() > problem.validation:
            text = "the validation contradicts what was predicted: its measurements join the fit, which goes on"
            return Decision(FIT, text, joins=True)
        state = replace(state, message=f"{state.message}; the validation contradicts what was predicted")
    return Decision(FINISHED, state.message, left=state.left, result=_result(state, found))


def _held_out(state: CampaignState, found: Finding, count: int) -> FloatArray:
    request = plan_problem(state, found)
    rng = np.random.default_rng([state.problem.seed, len(state.stops), 4])
    taken = np.vstack([state.measured_q, *(s.q for s in state.stops)])
    try:
        allowed = Feasibility(state.problem.robot, request.constraints)
        return validation_poses(allowed, state.problem.test_pose_array, taken, state.scale, count, rng)
    except InfeasibleError:
        return taken[:0]


def _result(state: CampaignState, found: Finding | None) -> CampaignResult:
    held_out = state.data(VALIDATION)
    estimate = None if found is None else found.estimate
    if found is not None and estimate is not None and held_out is not None:
        estimate = validate(found.asked, estimate, [held_out])
    message = state.message or OUTCOMES[state.outcome]
    if estimate is None:
        verdict = without_estimate(state.outcome, message)
    else:
        verdict = campaign_verdict(estimate, state.problem.required_accuracy, _at_test_poses(state))
    return CampaignResult(
        outcome=state.outcome,
        message=message,
        required_accuracy=state.problem.required_accuracy,
        rounds=state.rounds,
        estimate=estimate,
        verdict=verdict,
        fit=state.data(FIT),
        validation=held_out,
        exclusions=state.exclusions,
        spent=state.spent(),
        budget=state.problem.budget,
    )


def _at_test_poses(state: CampaignState) -> Measurements | None:
    """The validation measurements of the test poses themselves."""
    poses, rows = state.problem.test_pose_array, state.of_role(VALIDATION)
    q = [state.stops[r.index].q for r in rows]
    at = [k for k, one in enumerate(q) if (np.abs(poses - one).max(axis=1) < SAME_JOINT).any()]
    data = state.data(VALIDATION)
    return data.select(at) if data is not None and at else None


# ── The verdict on a campaign: that on the estimate, and whether it is what was asked for ───────────────────
# The requirement is about the test poses. The validation configurations elsewhere are judged by what was
# predicted
# *there*; only those at a test pose are held against the requirement itself. What the tracker adds to such a
# point is not the robot's error: three coordinates of variance σ² each, and two standard deviations more than
# that, are taken off,
#
#     e² = mean ‖r‖² − 3σ² (1 + 2 √(2/(3n))).
#
# A validation *contradicts* the estimate if Σ rᵀ(J C Jᵀ + D + R)⁻¹r over its points is improbable as χ².


def campaign_verdict(estimate: Estimate, required: float, at_test_poses: Measurements | None) -> Verdict:
    """PASS, WARN or FAIL with reasons.

    Args:
        estimate: With its validation, without a requirement of its own.
        required: Largest root mean square error at a test pose that will do [m].
        at_test_poses: Held-out measurements of test poses themselves, or ``None``.
    """
    reasons = [_predicted(estimate, required)]
    if at_test_poses is not None:
        reasons.append(_achieved(estimate, required, at_test_poses))
    reasons += estimate.verdict.reasons
    reasons.sort(key=lambda r: -LEVELS.index(r.level))
    return Verdict(reasons[0].level, tuple(reasons))


def contradicted(estimate: Estimate, noise: Noise, held_out: Measurements) -> bool:
    """Whether held-out measurements are improbably far from what was predicted, for as sure as it was."""
    q, seen = held_out.q, held_out.seen
    if estimate.transmission is not None:
        covariance = estimate.transmission.error_covariance(q)
    else:
        robot = estimate.calibrated
        columns = np.ascontiguousarray(robot.jacobian(q)).reshape(*held_out.p.shape, -1)
        covariance = columns @ estimate.fit.covariance @ np.swapaxes(columns, 2, 3)
        covariance = covariance + estimate.noise.discrepancy_covariance(robot, q)
    predicted = estimate.positions(q)
    distance = normalised(held_out.p - predicted, covariance + noise.covariance(predicted))[seen]
    return float(chdtrc(3 * len(distance), np.sum(distance**2))) < DOUBT


def without_estimate(outcome: str, message: str) -> Verdict:
    """The verdict on a campaign that identified nothing."""
    return Verdict("FAIL", (Reason("FAIL", outcome, message, OUTCOMES[outcome]),))


def _predicted(estimate: Estimate, required: float) -> Reason:
    worst = float(np.max(estimate.accuracy.predicted))
    level = "PASS" if worst <= required else "FAIL"
    said = length(worst) if np.isfinite(worst) else "nothing"
    text = f"predicted at the worst test pose: {said} where {length(required)} are required"
    return Reason(
        level, "required_accuracy", text, "" if level == "PASS" else "the outcome says what stands in the way"
    )


def _achieved(estimate: Estimate, required: float, data: Measurements) -> Reason:
    residuals = (data.p - estimate.positions(data.q))[data.seen]
    square = float(np.mean(np.sum(residuals**2, axis=1)))
    noise = 3.0 * estimate.noise.measurement**2
    error = float(np.sqrt(max(square - noise * (1.0 + 2.0 * np.sqrt(2.0 / (3.0 * len(residuals)))), 0.0)))
    level = "PASS" if error <= required else "FAIL"
    points, rms, tracker = counted(len(residuals), "point"), float(np.sqrt(square)), float(np.sqrt(noise))
    text = f"achieved at the test poses, {points}: {length(rms)} with the tracker's noise of {length(tracker)}"
    text += f", {length(required)} required"
    advice = "" if level == "PASS" else "something differs there: load, temperature, approach, the target's seat"
    return Reason(level, "achieved_at_test_poses", text, advice)
