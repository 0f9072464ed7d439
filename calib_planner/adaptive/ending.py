"""The end of a campaign: held-out configurations, what they say, the result; see ``decision``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.adaptive.batch import plan_problem, toured
from calib_planner.adaptive.campaign import FINISHED, FIT, VALIDATION, CampaignState, Decision, Stop
from calib_planner.adaptive.judging import forecast, found_in, round_of
from calib_planner.adaptive.requirement import campaign_verdict, contradicted, without_estimate
from calib_planner.adaptive.result import OUTCOMES, CampaignResult
from calib_planner.adaptive.scatter import Finding
from calib_planner.adaptive.validation_poses import validation_poses
from calib_planner.design.feasibility import Feasibility
from calib_planner.errors import CalibPlannerError, InfeasibleError
from calib_planner.identification.equations import SAME_JOINT
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.validation import validate


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
