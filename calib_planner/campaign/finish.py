"""The end of a campaign: configurations held out of the fit, what they say, the verdict and the result.

*Where to validate.* The user wants to know the error where the robot will work, so the test poses come first, as
far as they can be measured themselves; up to half of the configurations lie near them; the others are spread over
everything that can be measured, which reveals a model that is valid near the test poses only. Each is as far as
possible from all that were measured and from the other validation configurations (farthest-point selection): next
to a measured configuration any model predicts well.

*The verdict* is that on the estimate, and whether the requirement is met, which is about the test poses: the
predicted error there, and the measured one (without the tracker's part, see ``without_noise``) of
validation configurations that are test poses. The others are judged by what was predicted *there*. A validation
*contradicts* the estimate if Σ rᵀ(J C Jᵀ + D + R)⁻¹r over its points is improbable as χ².
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtrc

from calib_planner.arrays import FloatArray
from calib_planner.campaign.assess import Assessment, assess, forecast, round_of
from calib_planner.campaign.problem import OUTCOMES, CampaignResult, distances
from calib_planner.campaign.state import FINISHED, FIT, VALIDATION, CampaignState, NextStep, PlannedConfiguration
from calib_planner.errors import CalibPlannerError, InfeasibleError
from calib_planner.identification import (
    Estimate,
    Reason,
    Rule,
    Verdict,
    normalised,
    validate,
    without_noise,
)
from calib_planner.measurements import SAME_JOINT, Measurements
from calib_planner.planning import Feasibility, visiting_order
from calib_planner.units import counted, length

NEAR = 0.1
"""Half width of the neighbourhood of a test pose, as a share of each joint's range."""
APART = 0.02
"""Least distance from what was measured, as a share of the joints' ranges; a test pose keeps to it, too."""
DOUBT = 1e-3
"""Held-out measurements less probable than this contradict the estimate."""
DRAWN = 600
"""Configurations to choose from, near and anywhere."""

RULES = {
    "required_accuracy": Rule(
        "required_accuracy",
        "predicted at the worst test pose: {worst} where {required} are required",
        {"PASS": "", "FAIL": "the outcome says what stands in the way"},
    ),
    "achieved_at_test_poses": Rule(
        "achieved_at_test_poses",
        "achieved at the test poses, {points}: {achieved}, of it {noise} the tracker's, {required} required",
        {"PASS": "", "FAIL": "something differs there: load, temperature, approach, the target's seat"},
    ),
    **{outcome: Rule(outcome, "{message}", {"FAIL": advice}) for outcome, advice in OUTCOMES.items()},
}
"""What the verdict of a campaign says beside that of its estimate; without an estimate it says the outcome."""


def ended(state: CampaignState, known: Assessment | None, outcome: str, message: str) -> NextStep:
    """The fit has ended: on to the validation, or to the result."""
    text = f"{outcome}: {message}"
    made = None if known is None and not state.measurements else round_of(state, known, 0, text)
    left = 0.0 if outcome == "reached" or known is None else forecast(known, state.problem.required_accuracy)
    after = replace(state, outcome=outcome, message=message, left=left)
    if made is not None:
        after = replace(after, rounds=(*state.rounds, made))
    return replace(validation(after, known), outcome=outcome, round=made, left=left)


def validation(state: CampaignState, known: Assessment | None = None) -> NextStep:
    """More validation configurations if some are wanting, else the result."""
    problem = state.problem
    if known is None:
        try:
            known = assess(state)
        except CalibPlannerError:
            known = None
    if known is None:
        return NextStep(FINISHED, state.message, result=_result(state, None))
    wanting = min(problem.validation - len(state.measurements_of(VALIDATION)), problem.budget - state.spent())
    if wanting > 0 and state.given_up <= problem.most_failures + problem.validation:
        q = _held_out(state, wanting)
        if len(q):
            first = len(state.configurations)
            queue = toured(state, q, tuple(range(first, first + len(q))))
            planned = tuple(PlannedConfiguration(row, VALIDATION) for row in q)
            return NextStep(VALIDATION, state.message, planned, (), queue, left=state.left)
    held_out = state.data(VALIDATION)
    if held_out is not None and contradicted(known.estimate, held_out):
        if state.outcome == "reached" and problem.budget - state.spent() > problem.validation:
            text = "the validation contradicts what was predicted: its measurements join the fit, which goes on"
            return NextStep(FIT, text, joins=True)
        state = replace(state, message=f"{state.message}; the validation contradicts what was predicted")
    return NextStep(FINISHED, state.message, left=state.left, result=_result(state, known))


def _held_out(state: CampaignState, count: int) -> FloatArray:
    """(count, joints) configurations to validate with, or fewer where there is no room for more."""
    rng = np.random.default_rng([state.problem.seed, len(state.configurations), 4])
    taken = np.vstack([state.measured_q, *(s.q for s in state.configurations)])
    try:
        allowed = Feasibility(state.problem.robot, state.constraints)
        return validation_poses(allowed, state.problem.test_pose_array, taken, state.scale, count, rng)
    except InfeasibleError:
        return taken[:0]


def _result(state: CampaignState, known: Assessment | None) -> CampaignResult:
    held_out = state.data(VALIDATION)
    estimate = None if known is None else known.estimate
    if known is not None and estimate is not None and held_out is not None:
        estimate = validate(known.problem, estimate, [held_out])
    message = state.message or OUTCOMES[state.outcome]
    if estimate is None:
        verdict = Verdict.of([RULES[state.outcome].reason(message=message)])
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
    return Verdict.of(reasons)


def contradicted(estimate: Estimate, held_out: Measurements) -> bool:
    """Whether held-out measurements are improbably far from the predictions, given their covariance."""
    told, seen = estimate.knowledge.predict(held_out.q), held_out.seen
    distance = normalised(held_out.p - told.mean, told.total)[seen]
    return float(chdtrc(3 * len(distance), np.sum(distance**2))) < DOUBT


def _predicted(estimate: Estimate, required: float) -> Reason:
    worst = estimate.accuracy.worst
    said = length(worst) if np.isfinite(worst) else "nothing"
    level = "PASS" if worst <= required else "FAIL"
    return RULES["required_accuracy"].reason(level, worst=said, required=length(required))


def _achieved(estimate: Estimate, required: float, data: Measurements) -> Reason:
    residuals = (data.p - estimate.positions(data.q))[data.seen]
    square = float(np.mean(np.sum(residuals**2, axis=1)))
    noise = 3.0 * estimate.noise.sigma**2
    return RULES["achieved_at_test_poses"].reason(
        "PASS" if without_noise(square, noise, 3.0 * len(residuals)) <= required else "FAIL",
        points=counted(len(residuals), "point"),
        achieved=length(float(np.sqrt(square))),
        noise=length(float(np.sqrt(noise))),
        required=length(required),
    )
