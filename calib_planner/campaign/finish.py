# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The end of a campaign: configurations held out of the fit, what they say, the verdict and the result.

*Where to validate.* The user wants to know the error where the robot will work, so the test poses come first, as
far as they can be measured themselves; up to half of the configurations lie near them; the others are spread over
everything that can be measured, which reveals a model that is valid near the test poses only. Each is as far as
possible from all that were measured and from the other validation configurations (farthest-point selection): next
to a measured configuration any model predicts well.

*Whether it is as accurate as that.* A campaign that seems to have reached its accuracy has done so only if
nothing of what was held out speaks against it:

1. What was measured at test poses themselves is no larger than the requirement, the measurement's noise and
   chance explain (``without_noise``; targets of one visit err together, so that a visit has three degrees of
   freedom). For the accuracy frame ``robot`` nothing is said here, since a validation is measured before the
   robot is registered anew.
2. All residuals r of the validation, with the covariance S that the estimate gives them together, those of what
   it does not know included, rᵀS⁻¹r is no more improbable than ``DOUBT``: an F value, since variances that ν
   residuals told are not better known than that.
3. The verdict on the estimate with its validation is not FAIL.

What speaks against it, the campaign says; it is ``reached`` if and only if its verdict is not FAIL.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtrc

from calib_planner.arrays import FloatArray
from calib_planner.campaign.assess import Assessment, assess, forecast, round_of
from calib_planner.campaign.problem import OUTCOMES, CampaignResult, distances
from calib_planner.campaign.state import FINISHED, FIT, VALIDATION, CampaignState, NextStep, PlannedConfiguration
from calib_planner.errors import CalibPlannerError, InfeasibleError
from calib_planner.identification import Estimate, Reason, Rule, Verdict, validate, without_noise
from calib_planner.measurements import SAME_JOINT, Measurements
from calib_planner.planning import Feasibility, visiting_order
from calib_planner.units import counted, lengths

NEAR = 0.1
"""Half width of the neighbourhood of a test pose, as a share of each joint's range."""
APART = 0.02
"""Least distance from what was measured, as a share of the joints' ranges; a test pose keeps to it, too."""
DOUBT = 1e-3
"""Held-out measurements less probable than this contradict the estimate."""
DRAWN = 600
"""Configurations to choose from, near and anywhere."""

RULES = {
    **{outcome: Rule(outcome, "{message}", {"FAIL": advice}) for outcome, advice in OUTCOMES.items()},
    "required_accuracy": Rule(
        "required_accuracy",
        "predicted of a visit to the worst test pose: {worst}, of it {floor} the robot's repeatability, where "
        "{required} are required",
        {"PASS": "", "FAIL": "the outcome says what stands in the way"},
    ),
    "achieved_at_test_poses": Rule(
        "achieved_at_test_poses",
        "achieved at the test poses, {points}: {achieved}, of it {noise} the measurement's, {required} required",
        {"PASS": "", "FAIL": "something differs there: load, temperature, approach, the target's seat"},
    ),
    "contradicted": Rule(
        "contradicted",
        "the validation contradicts the estimate: {achieved} achieved where {predicted} were predicted (rms)",
        {"FAIL": "look for what changed since the fit; raise the budget, so that these measurements join it"},
    ),
}
"""What the verdict of a campaign says beside that of its estimate: its outcome unless it is reached, and why."""


def ended(state: CampaignState, known: Assessment | None, outcome: str, message: str) -> NextStep:
    """The fit has ended: on to the validation, or to the result."""
    text = f"{outcome}: {message}"
    made = None if known is None and not state.measurements else round_of(state, known, 0, text)
    left = 0.0 if outcome == "reached" or known is None else forecast(known, state.problem.required_accuracy)
    after = replace(state, outcome=outcome, message=message, left=left)
    if made is not None:
        after = replace(after, rounds=(*state.rounds, made))
    return replace(validation(after, known), round=made, left=left)


def validation(state: CampaignState, known: Assessment | None = None) -> NextStep:
    """More validation configurations if some are wanting, else the result."""
    problem = state.problem
    if known is None:
        try:
            known = assess(state)
        except CalibPlannerError:
            known = None
    if known is None:
        return NextStep(FINISHED, state.message, outcome=state.outcome, result=_result(state, None))
    wanting = min(problem.validation - len(state.measurements_of(VALIDATION)), problem.budget - state.spent())
    if wanting > 0 and state.given_up <= problem.most_failures + problem.validation:
        q = _held_out(state, wanting)
        if len(q):
            first = len(state.configurations)
            queue = toured(state, q, tuple(range(first, first + len(q))))
            planned = tuple(PlannedConfiguration(row, VALIDATION) for row in q)
            return NextStep(
                VALIDATION, state.message, planned, queue=queue, outcome=state.outcome, left=state.left
            )
    reasons = _reasons(state, known)
    against = next((r for r in reasons if r.level == "FAIL"), None)
    if against is not None and state.outcome == "reached":
        if problem.budget - state.spent() > problem.validation:
            text = f"{against.text}: the measurements of the validation join the fit, which goes on"
            return NextStep(FIT, text, joins=True)
        state = replace(state, outcome="budget_spent", message=f"{against.text}, and the budget is spent")
    result = _result(state, known, reasons)
    return NextStep(FINISHED, state.message, outcome=state.outcome, left=state.left, result=result)


def _held_out(state: CampaignState, count: int) -> FloatArray:
    """(count, joints) configurations to validate with, or fewer where there is no room for more."""
    rng = np.random.default_rng([state.problem.seed, len(state.configurations), 4])
    taken = np.vstack([state.measured_q, *(s.q for s in state.configurations)])
    try:
        allowed = Feasibility(state.problem.robot, state.constraints)
        return validation_poses(allowed, state.problem.test_pose_array, taken, state.scale, count, rng)
    except InfeasibleError:
        return taken[:0]


def _reasons(state: CampaignState, known: Assessment) -> list[Reason]:
    """Everything that is said of the estimate, its validation included."""
    held_out = state.data(VALIDATION)
    worst, floor, required = lengths(known.accuracy, known.floor, state.problem.required_accuracy)
    worst = worst if np.isfinite(known.accuracy) else "nothing"
    level = "PASS" if known.accuracy <= state.problem.required_accuracy else "FAIL"
    reasons = [RULES["required_accuracy"].reason(level, worst=worst, floor=floor, required=required)]
    estimate = validated(known, held_out)
    at_test_poses = _at_test_poses(state)
    if at_test_poses is not None and state.problem.accuracy_frame == "world":
        reasons.append(_achieved(estimate, state.problem.required_accuracy, at_test_poses))
    told = estimate.validation
    if held_out is not None and told is not None and contradicted(estimate, held_out):
        achieved, predicted = lengths(told.rms, told.predicted_rms)
        reasons.append(RULES["contradicted"].reason(achieved=achieved, predicted=predicted))
    return reasons + list(estimate.verdict.reasons)


def validated(known: Assessment, held_out: Measurements | None) -> Estimate:
    """The estimate with its validation, if there is one."""
    return known.estimate if held_out is None else validate(known.problem, known.estimate, [held_out])


def _result(state: CampaignState, known: Assessment | None, reasons: Sequence[Reason] = ()) -> CampaignResult:
    message, held_out = state.message or OUTCOMES[state.outcome], state.data(VALIDATION)
    outcome = [] if state.outcome == "reached" else [RULES[state.outcome].reason(message=message)]
    return CampaignResult(
        outcome=state.outcome,
        message=message,
        required_accuracy=state.problem.required_accuracy,
        rounds=state.rounds,
        estimate=None if known is None else validated(known, held_out),
        verdict=Verdict.of([*outcome, *reasons]),
        fit=state.data(FIT),
        validation=held_out,
        exclusions=state.exclusions,
        spent=state.spent(),
        budget=state.problem.budget,
        accuracy=float("inf") if known is None else known.accuracy,
        floor=float("nan") if known is None else known.floor,
    )


def _at_test_poses(state: CampaignState) -> Measurements | None:
    """The validation measurements of the test poses themselves."""
    poses, rows = state.problem.test_pose_array, state.measurements_of(VALIDATION)
    q = [state.configurations[r.index].q for r in rows]
    at = [k for k, one in enumerate(q) if (np.abs(poses - one).max(axis=1) < SAME_JOINT).any()]
    data = state.data(VALIDATION)
    return data.select(at) if data is not None and at else None


def toured(state: CampaignState, q: FloatArray, numbers: tuple[int, ...]) -> tuple[int, ...]:
    """``numbers`` of the configurations ``q`` in an order of short travel, begun at the end nearer the robot."""
    tour = [numbers[k] for k in visiting_order(q, state.problem.robot)]
    if state.measurements:
        here = state.measurements[-1].q
        ends = [np.abs((q[numbers.index(tour[k])] - here) * state.scale).max() for k in (0, -1)]
        tour = tour if ends[0] <= ends[1] else tour[::-1]
    return tuple(tour)


def validation_poses(
    allowed: Feasibility,
    test_poses: FloatArray,
    taken: FloatArray,
    scale: FloatArray,
    count: int,
    rng: np.random.Generator,
) -> FloatArray:
    """(count, joints) configurations, or fewer where there is no room for more.

    Args:
        allowed: What can be measured.
        test_poses: (K, joints) [rad | m].
        taken: (N, joints) measured before, for fit or validation.
        scale: (joints,) see ``joint_scale``.
        count: How many.

    Raises:
        InfeasibleError: Nothing can be measured at all.
    """
    low, high = allowed.limits.T
    step = NEAR * (high - low)
    centre = test_poses[rng.integers(len(test_poses), size=DRAWN)]
    near = np.clip(centre + rng.uniform(-1.0, 1.0, centre.shape) * step, low, high)
    itself = test_poses[((low <= test_poses) & (test_poses <= high)).all(axis=1)]
    at_poses, nearby = (p[allowed.mask(p)] for p in (itself, near))
    half = (count + 1) // 2
    chosen = _farthest(at_poses, taken, scale, half)
    chosen = np.vstack([chosen, _farthest(nearby, np.vstack([taken, chosen]), scale, half - len(chosen))])
    anywhere = allowed.sample(rng, DRAWN)
    return np.vstack([chosen, _farthest(anywhere, np.vstack([taken, chosen]), scale, count - len(chosen))])


def _farthest(candidates: FloatArray, taken: FloatArray, scale: FloatArray, count: int) -> FloatArray:
    """Up to ``count`` rows of ``candidates``, each the farthest from ``taken`` and those before."""
    apart = np.full(len(candidates), np.inf)
    for q in taken:
        apart = np.minimum(apart, distances(candidates, q, scale))
    rows: list[int] = []
    while len(rows) < count and len(candidates):
        best = int(np.argmax(apart))
        if apart[best] < APART:
            break
        rows.append(best)
        apart = np.minimum(apart, distances(candidates, candidates[best], scale))
    return candidates[rows]


def contradicted(estimate: Estimate, held_out: Measurements) -> bool:
    """Whether held-out measurements are improbably far from where the estimate expects them, all together."""
    known, use = estimate.knowledge, np.repeat(held_out.seen, 3, axis=1)
    poses = known.poses(held_out.q, held_out.payload)
    apart = (held_out.p - poses.points).reshape(use.shape)[use]
    rows = known.model.columns(poses)[use]
    own = block_diag(*known.model.visit_covariance(poses))[np.ix_(use.ravel(), use.ravel())]
    square = float(apart @ np.linalg.solve(rows @ known.covariance @ rows.T + own, apart))
    freedom = max(estimate.residuals.chi_square.freedom, 1)
    return float(fdtrc(len(apart), freedom, square / len(apart))) < DOUBT


def _achieved(estimate: Estimate, required: float, data: Measurements) -> Reason:
    residuals = (data.p - estimate.positions(data.q))[data.seen]
    square, noise = float(np.mean(np.sum(residuals**2, axis=1))), 3.0 * estimate.noise.sigma**2
    visits = int(data.seen.any(axis=1).sum())
    achieved, own, wanted = lengths(float(np.sqrt(square)), float(np.sqrt(noise)), required)
    return RULES["achieved_at_test_poses"].reason(
        "PASS" if without_noise(square, noise, 3.0 * visits) <= required else "FAIL",
        points=counted(len(residuals), "point"),
        achieved=achieved,
        noise=own,
        required=wanted,
    )
