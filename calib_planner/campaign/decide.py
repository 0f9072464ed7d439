# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""After a batch: identify, and stop or plan the next one. Seconds of work; the state it is about does not change.

For the fit, in this order:

1. The error predicted of a visit to the worst test pose, see ``assess``, is what was required, there are
   ``minimum`` configurations, different ones give ``FEWEST_SPARE`` more equations than there are parameters
   (repetitions cannot show that the model is wrong), and the verdict on the estimate, which knows its left-out
   error, is not FAIL: **reached**.
2. More than ``most_failures`` configurations had to be given up: **unreachable**.
3. No measurement is left but those of the validation: **budget_spent**.
4. The robot's repeatability is surely more than required at a test pose even if nothing else were uncertain:
   **limited**. More measurements cannot help.
5. Else the next batch is planned on the robot as identified so far, with the sizes of its errors and the noise
   as estimated and all that was measured. A term that the estimate left out, because nothing told of it so far,
   is in the plan: it may be measured next.

Then the validation. Good plans measure at few places, where a wrong model fits well enough; configurations that
were chosen to lie elsewhere contradict it best. If they do (see ``finish``) although the accuracy seemed to be
reached, they join the fit, which goes on, and others are held out in the end; where the budget does not allow
that, the accuracy was not reached. The validation that is reported is always of configurations that took no part
in the fit.

The uncertain part ρ of the predicted error falls with 1/√N, its floor φ stays, so that what is required, ρ̄, takes

    n = N (ρ²/(ρ̄² − φ²) − 1)

more measurements: the forecast, and the size of the batch if that is less. The first batch identifies with enough
redundancy to judge, and measures ``REPEATED`` of its configurations a second time, at the end of the tour.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calib_planner.campaign.assess import (
    FEWEST_SPARE,
    Assessment,
    assess,
    different,
    expected,
    forecast,
    outcome_of,
    ready,
    round_of,
)
from calib_planner.campaign.finish import ended, toured, validation
from calib_planner.campaign.state import FIT, VALIDATION, CampaignState, NextStep, PlannedConfiguration
from calib_planner.errors import CalibPlannerError, InfeasibleError, NotEnoughDataError
from calib_planner.planning import (
    PlanProblem,
    Search,
    plan,
    plan_space,
    smallest_size,
)

REPEATED = 4
"""Configurations of the first batch measured twice: 12 degrees of freedom for the noise of one target."""


def decide(state: CampaignState, stopped: Callable[[], bool] = lambda: False) -> NextStep:
    """What follows from what was measured.

    Args:
        state: Its ``action`` is ``Replan`` or ``Validate``.
        stopped: Called while a plan is searched; true: take the best so far.

    Raises:
        InfeasibleError: There is no first plan: constraints that leave nothing, or too small a budget.
    """
    if state.phase == VALIDATION:
        return validation(state)
    try:
        known = assess(state)
    except NotEnoughDataError:
        known = None
    except CalibPlannerError as error:
        return ended(state, None, "failed", str(error))
    outcome, message = outcome_of(state, known)
    if outcome:
        return ended(state, known, outcome, message)
    try:
        return next_batch(state, known, stopped)
    except InfeasibleError as error:
        if not state.rounds and not state.measurements:
            raise
        return ended(state, known, "unreachable", str(error))


# ── The next batch ──────────────────────────────────────────────────────────────────────────────────────────


def next_batch(state: CampaignState, known: Assessment | None, stopped: Callable[[], bool]) -> NextStep:
    problem = state.problem
    allowed = problem.fit_budget - state.spent(FIT)
    request = plan_problem(state, known)
    size, repeated = _size(state, known, request, allowed)
    made = plan(replace(request, configurations=size), lambda progress: stopped(), bounded=False)
    q = made.configurations
    first = len(state.configurations)
    queue = toured(state, q, tuple(range(first, first + len(q))))
    twice = _spread(queue, min(repeated, allowed - len(q)))
    planned = tuple(PlannedConfiguration(row, FIT, 1 + (first + k in twice)) for k, row in enumerate(q))
    left = _left(state, known)
    if known is None and np.isfinite(made.quality.predicted_accuracy):
        share = max(made.quality.predicted_accuracy / problem.required_accuracy, 0.0) ** 2
        left = max(float(np.ceil(len(q) * share)), float(len(q) + len(twice)))
    total = len(queue) + len(twice)
    text = f"{total} measurements planned"
    made_round = round_of(state, known, total, text)
    queue = (*queue, *reversed(twice))
    return NextStep(FIT, text, planned, queue=queue, round=made_round, left=left)


def plan_problem(state: CampaignState, known: Assessment | None) -> PlanProblem:
    """The plan problem of the next batch, but for the number of configurations."""
    problem = state.problem
    poses = problem.test_pose_array
    return PlanProblem(
        problem.robot if known is None else known.estimate.calibrated,
        poses,
        1,
        error_model=expected(problem) if known is None else known.model,
        accuracy_frame=problem.accuracy_frame,
        criterion="test_pose" if len(poses) == 1 else "worst_pose",
        constraints=state.constraints,
        measured=None if known is None else known.used,
        search=Search(
            starts=problem.starts or None, seed=problem.seed + len(state.rounds), time_limit=problem.time_limit
        ),
    )


def _size(state: CampaignState, known: Assessment | None, request: PlanProblem, allowed: int) -> tuple[int, int]:
    """Configurations to plan, and how many of them to measure twice.

    Raises:
        InfeasibleError: The budget does not allow what identification needs.
    """
    problem = state.problem
    if known is not None and ready(state, known):
        return int(np.clip(forecast(known, problem.required_accuracy), 1, min(problem.batch, allowed))), 0
    least = smallest_size(request)
    space = plan_space(replace(request, configurations=max(least, 1)))
    apart = None if known is None else different(known.used)
    have, seen = (0, 0) if apart is None else (len(apart), int(apart.seen.sum()))
    wanted = -(-(len(space.robot.parameter_names) + FEWEST_SPARE) // 3) - seen
    size = max(least, problem.minimum - have, -(-wanted // len(problem.robot.targets)), 1)
    if size > allowed:
        text = f"{allowed} measurements are left for the fit, {size} at least are needed to judge it: raise it"
        raise InfeasibleError("budget", text)
    return size, REPEATED if known is None else 0


def _spread(queue: tuple[int, ...], count: int) -> tuple[int, ...]:
    """``count`` of the visits, spread evenly over the tour."""
    rows = np.unique(np.linspace(0, len(queue) - 1, max(min(count, len(queue)), 0)).round().astype(int))
    return tuple(queue[k] for k in rows)


def _left(state: CampaignState, known: Assessment | None) -> float:
    return float("nan") if known is None else forecast(known, state.problem.required_accuracy)
