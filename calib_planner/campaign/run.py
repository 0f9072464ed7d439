# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A campaign from beginning to end, for whoever can measure one configuration at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.campaign.decide import decide
from calib_planner.campaign.problem import CampaignProblem, CampaignResult
from calib_planner.campaign.state import CampaignState, Finished, Measure, Paused, begin
from calib_planner.errors import CalibPlannerError, InputError


class Unreachable(CalibPlannerError):
    """Raised by whoever measures: the robot cannot get to that configuration; the text says why."""


Instrument = Callable[[Measure], FloatArray]
"""Measures: (targets, 3) [m], NaN where a target was not seen. Raises ``Unreachable``."""


def run_campaign(
    problem: CampaignProblem | CampaignState,
    measure: Instrument,
    watch: Callable[[CampaignState], None] = lambda state: None,
) -> CampaignResult:
    """Do what the campaign says until it says that it is done.

    Args:
        problem: The campaign's problem, or a state from which it continues.
        measure: See ``Instrument``.
        watch: Told of every new state; what it raises ends the campaign.

    Raises:
        InputError: The state is paused, and nobody is here to resume it.
        InfeasibleError: There is no first plan: constraints that leave nothing, or too small a budget.
    """
    state = problem if isinstance(problem, CampaignState) else begin(problem)
    while True:
        watch(state)
        action = state.action
        if isinstance(action, Finished):
            return action.result
        if isinstance(action, Paused):
            raise InputError("state", "paused", "a campaign that runs", "use state.resume()")
        state = _measured(state, action, measure) if isinstance(action, Measure) else state.decided(decide(state))


def _measured(state: CampaignState, action: Measure, measure: Instrument) -> CampaignState:
    try:
        points = measure(action)
    except Unreachable as error:
        return state.unreachable(action.index, str(error))
    if np.isnan(points).all():
        return state.failed(action.index, "no target was seen")
    return state.measured(action.index, action.q, points)
