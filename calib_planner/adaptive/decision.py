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

from calib_planner.adaptive.batch import next_batch
from calib_planner.adaptive.campaign import VALIDATION, CampaignState, Decision
from calib_planner.adaptive.ending import ended, validation
from calib_planner.adaptive.judging import found_in, outcome_of
from calib_planner.errors import CalibPlannerError, InfeasibleError, NotEnoughDataError


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
