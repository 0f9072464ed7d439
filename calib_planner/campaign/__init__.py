# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Measuring as long as it takes: plan, measure, identify, plan the rest from what was measured, validate.

docs/glossary.md explains the words.
"""

from calib_planner.campaign.assess import identification_problem
from calib_planner.campaign.decide import decide
from calib_planner.campaign.finish import RULES
from calib_planner.campaign.problem import OUTCOMES, CampaignProblem, CampaignResult, Exclusion, Round
from calib_planner.campaign.run import Instrument, Unreachable, run_campaign
from calib_planner.campaign.state import (
    FIT,
    VALIDATION,
    CampaignState,
    Finished,
    Measure,
    Measurement,
    NextStep,
    Paused,
    PlannedConfiguration,
    Replan,
    Validate,
    begin,
    from_measurements,
)
