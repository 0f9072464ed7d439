"""The verdict on a campaign: that on the estimate, and whether it is what was asked for.

The requirement is about the test poses. The validation configurations elsewhere are judged by what was predicted
*there*; only those at a test pose are held against the requirement itself. What the tracker adds to such a point
is not the robot's error: three coordinates of variance σ² each, and two standard deviations more than that, are
taken off,

    e² = mean ‖r‖² − 3σ² (1 + 2 √(2/(3n))).

A validation *contradicts* the estimate if Σ rᵀ(J C Jᵀ + D + R)⁻¹r over its points is improbable as χ².
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from calib_planner.adaptive.result import OUTCOMES
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.noise_levels import DOUBT
from calib_planner.identification.robust import normalised
from calib_planner.identification.verdict import LEVELS, Reason, Verdict, counted, mm
from calib_planner.instrument.noise import Noise


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
    reasons.sort(key=lambda r: -LEVELS.index(r.level))
    return Verdict(reasons[0].level, tuple(reasons))


def contradicted(estimate: Estimate, noise: Noise, held_out: Measurements) -> bool:
    """Whether held-out measurements are improbably far from what was predicted, for as sure as it was."""
    q, seen = held_out.q, held_out.seen
    if estimate.transmission is not None:
        covariance = estimate.transmission.error_covariance(q)
    else:
        robot = estimate.calibrated
        columns = np.ascontiguousarray(robot.jacobian(q)).reshape(*held_out.p.shape, -1)
        covariance = columns @ estimate.covariance @ np.swapaxes(columns, 2, 3)
        covariance = covariance + estimate.noise.discrepancy_covariance(robot, q)
    predicted = estimate.positions(q)
    distance = normalised(held_out.p - predicted, covariance + noise.covariance(predicted))[seen]
    return float(chi2.sf(np.sum(distance**2), 3 * len(distance))) < DOUBT


def without_estimate(outcome: str, message: str) -> Verdict:
    """The verdict on a campaign that identified nothing."""
    return Verdict("FAIL", (Reason("FAIL", outcome, message, OUTCOMES[outcome]),))


def _predicted(estimate: Estimate, required: float) -> Reason:
    worst = float(np.max(estimate.predicted_accuracy_per_test_pose))
    level = "PASS" if worst <= required else "FAIL"
    said = mm(worst) if np.isfinite(worst) else "nothing"
    text = f"predicted at the worst test pose: {said} where {mm(required)} are required"
    return Reason(
        level, "required_accuracy", text, "" if level == "PASS" else "the outcome says what stands in the way"
    )


def _achieved(estimate: Estimate, required: float, data: Measurements) -> Reason:
    residuals = (data.p - estimate.positions(data.q))[data.seen]
    square = float(np.mean(np.sum(residuals**2, axis=1)))
    noise = 3.0 * estimate.noise.measurement**2
    error = float(np.sqrt(max(square - noise * (1.0 + 2.0 * np.sqrt(2.0 / (3.0 * len(residuals)))), 0.0)))
    level = "PASS" if error <= required else "FAIL"
    points, rms, tracker = counted(len(residuals), "point"), float(np.sqrt(square)), float(np.sqrt(noise))
    text = f"achieved at the test poses, {points}: {mm(rms)} with the tracker's noise of {mm(tracker)}"
    text += f", {mm(required)} required"
    advice = "" if level == "PASS" else "something differs there: load, temperature, approach, the target's seat"
    return Reason(level, "achieved_at_test_poses", text, advice)
