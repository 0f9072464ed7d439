"""What is known after a batch: enough to judge by, enough altogether, or never enough; see ``decision``."""

from __future__ import annotations

import numpy as np

from calib_planner.adaptive.campaign import FIT, CampaignState
from calib_planner.adaptive.result import Round
from calib_planner.adaptive.scatter import DISCREPANCY, Finding, find
from calib_planner.identification.equations import configuration_labels
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.verdict import FEWEST_SPARE

LEARNABLE = 24
"""Configurations from which on errors of the joints that could be learnt would have been."""


def found_in(state: CampaignState) -> Finding | None:
    data = state.data(FIT)
    return None if data is None else find(state.problem, data)


def outcome_of(state: CampaignState, found: Finding | None) -> tuple[str, str]:
    """A key of ``OUTCOMES`` and why; empty: go on."""
    problem = state.problem
    if found is not None and ready(state, found) and found.accuracy <= problem.required_accuracy:
        return "reached", f"{_mm(found.accuracy)} predicted, {_mm(problem.required_accuracy)} required"
    if state.given_up > problem.most_failures:
        reasons = sorted({e.reason for e in state.exclusions if not e.asked})
        return "unreachable", f"{state.given_up} configurations given up: {'; '.join(reasons)[:300]}"
    if state.spent(FIT) >= problem.fit_budget:
        now = "nothing identified" if found is None else f"{_mm(found.accuracy)} predicted"
        return "budget_spent", f"{now}, {_mm(problem.required_accuracy)} required{_forecast_text(state, found)}"
    if found is not None and ready(state, found) and limited(state, found):
        text = f"{_mm(found.floor)} at a test pose are the robot's own, {_mm(problem.required_accuracy)} required"
        return "limited", text
    return "", ""


def ready(state: CampaignState, found: Finding) -> bool:
    """Whether there is enough to judge by."""
    apart = different(found.used)
    spare = 3 * int(apart.seen.sum()) - found.estimate.rank
    enough = len(apart) >= state.problem.minimum and spare >= FEWEST_SPARE
    return enough and found.estimate.status != "not_converged"


def limited(state: CampaignState, found: Finding) -> bool:
    """Whether no number of measurements would do."""
    if found.scatter != DISCREPANCY or found.surely <= state.problem.required_accuracy:
        return False
    may_learn = state.problem.identification.get("joint_corrections", "auto") == "auto"
    return not may_learn or len(different(found.used)) >= LEARNABLE


def different(data: Measurements) -> Measurements:
    """Without repetitions."""
    return data.select(np.unique(configuration_labels(data.q), return_index=True)[1])


def forecast(found: Finding, required: float) -> float:
    """Measurements still needed; infinite where the floor is above what is required."""
    floor = found.floor_per_test_pose
    total = found.estimate.predicted_accuracy_per_test_pose
    room = required**2 - floor**2
    if not np.isfinite(total).all() or (room <= 0).any():
        return float("inf")
    more = len(found.used) * (np.maximum(total**2 - floor**2, 0.0) / room - 1.0)
    return max(float(np.ceil(more.max() - 1e-9)), 0.0) + 0.0


def _forecast_text(state: CampaignState, found: Finding | None) -> str:
    left = float("inf") if found is None else forecast(found, state.problem.required_accuracy)
    return f"; about {left:.0f} more measurements would do" if np.isfinite(left) and left > 0 else ""


def round_of(state: CampaignState, found: Finding | None, planned: int, note: str) -> Round:
    number = len(state.rounds)
    if found is None:
        nan = float("nan")
        return Round(number, 0, 0, float("inf"), nan, nan, "", nan, planned, note)
    return Round(
        number,
        len(found.used),
        len(different(found.used)),
        found.accuracy,
        found.floor,
        found.noise.typical,
        found.scatter,
        forecast(found, state.problem.required_accuracy),
        planned,
        note,
    )


def _mm(metres: float) -> str:
    return "unlimited" if not np.isfinite(metres) else f"{1e3 * metres:.4g} mm"
