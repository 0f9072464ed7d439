"""Measuring as long as it takes: plan, measure, identify, plan the rest from what was measured, validate."""

from calib_planner.adaptive.campaign import (
    CampaignState,
    Finished,
    Measure,
    Paused,
    Replan,
    Validate,
    begin,
    from_measurements,
)
from calib_planner.adaptive.decision import decide
from calib_planner.adaptive.problem import CampaignProblem
from calib_planner.adaptive.result import CampaignResult
from calib_planner.adaptive.run import Unreachable, run_campaign

__all__ = [
    "CampaignProblem",
    "CampaignResult",
    "CampaignState",
    "Finished",
    "Measure",
    "Paused",
    "Replan",
    "Unreachable",
    "Validate",
    "begin",
    "decide",
    "from_measurements",
    "run_campaign",
]
