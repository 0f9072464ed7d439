"""A campaign's state as message."""

from __future__ import annotations

import math

from calib_planner_msgs.msg import CampaignStatus

from calib_planner.campaign import FIT, VALIDATION, CampaignResult, CampaignState, Finished, Measure, Paused
from calib_planner.ros.campaign_results import reasons_of

OUTCOME = {
    "": CampaignStatus.OUTCOME_OPEN,
    "reached": CampaignStatus.OUTCOME_REACHED,
    "budget_spent": CampaignStatus.OUTCOME_BUDGET_SPENT,
    "limited": CampaignStatus.OUTCOME_LIMITED,
    "unreachable": CampaignStatus.OUTCOME_UNREACHABLE,
    "failed": CampaignStatus.OUTCOME_FAILED,
}
NAN = float("nan")


def idle_status(reason: str) -> CampaignStatus:
    """No campaign was begun."""
    numbers = dict.fromkeys(
        ("predicted_accuracy", "required_accuracy", "sigma", "validation_rms", "validation_predicted"), NAN
    )
    return CampaignStatus(state=CampaignStatus.IDLE, reason=reason[:1000], **numbers)


def status_message(state: CampaignState, campaign_id: str, waiting: str, reason: str) -> CampaignStatus:
    """How a campaign stands, without stamp.

    Args:
        waiting: What it waits for; empty if for nothing.
        reason: What else there is to say.
    """
    problem, action, last = state.problem, state.action, state.rounds[-1] if state.rounds else None
    allowed = max(problem.fit_budget - state.spent(FIT), 0)
    left = 0 if state.outcome else allowed if not math.isfinite(state.left) else min(int(state.left), allowed)
    message = CampaignStatus(
        campaign_id=campaign_id,
        robot=problem.robot.name,
        state=_state(state, waiting),
        outcome=OUTCOME[state.outcome],
        round=len(state.rounds),
        measured=len(state.of_role(FIT)),
        left=left,
        budget=problem.budget,
        validated=len(state.of_role(VALIDATION)),
        validation=problem.validation,
        excluded=len(state.exclusions),
        predicted_accuracy=NAN if last is None or math.isinf(last.accuracy) else last.accuracy,
        required_accuracy=problem.required_accuracy,
        sigma=NAN if last is None else last.sigma,
        validation_rms=NAN,
        validation_predicted=NAN,
        round_measured=[r.measured for r in state.rounds],
        round_accuracy=[r.accuracy for r in state.rounds],
        joint_names=list(problem.robot.joint_names),
        reason="; ".join(filter(None, (waiting, reason, state.message)))[:1000],
    )
    if isinstance(action, Measure):
        message.configuration_index, message.configuration = action.index, action.q.tolist()
    if isinstance(action, Finished):
        _fill_result(message, action.result)
    return message


def _state(state: CampaignState, waiting: str) -> int:
    action = state.action
    if isinstance(action, Finished):
        return int(CampaignStatus.DONE)
    if isinstance(action, Paused):
        return int(CampaignStatus.PAUSED)
    if waiting:
        return int(CampaignStatus.WAITING)
    if isinstance(action, Measure):
        return int(CampaignStatus.MEASURING if action.role == FIT else CampaignStatus.VALIDATING)
    return int(CampaignStatus.PLANNING)


def _fill_result(message: CampaignStatus, result: CampaignResult) -> None:
    message.predicted_accuracy = NAN if math.isinf(result.accuracy) else result.accuracy
    message.verdict = result.verdict.level
    message.reasons = reasons_of(result.verdict)
    found = None if result.estimate is None else result.estimate.validation
    if found is not None:
        message.validation_rms, message.validation_predicted = found.rms, found.predicted_rms
