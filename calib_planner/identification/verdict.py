"""Is this calibration good? PASS, WARN or FAIL, with reasons that a person can act on.

Every reason has a level of its own; the verdict is the worst. A reason at PASS is worth knowing and needs nothing
to be done. The judge sees nothing but the estimate: what it says is said by the numbers there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib_planner.identification.order_check import HARMFUL
from calib_planner.identification.structure import SIGNIFICANT

if TYPE_CHECKING:
    from calib_planner.identification.estimate import Estimate, Validation

LEVELS = ("PASS", "WARN", "FAIL")

LARGEST_RESIDUAL = 5e-3
"""No industrial robot is left with more than this after a calibration that was set up rightly [m]."""
FEWEST_SPARE = 10
"""Redundant equations below which little can be said about noise and gross errors."""
REJECTED = (0.05, 0.20)
"""Shares of rejected points that deserve a warning, and distrust."""
MANY, INSIDE = 30, 0.8
"""Of as many held-out points at least this share must lie in their 95 % region."""
APART = (1.5, 3.0)
"""Achieved over predicted error that deserves a warning, and distrust."""
FAR = 4.0
"""Standard deviations from which nobody expects the truth; what moves a parameter as far is said."""


@dataclass(frozen=True)
class Reason:
    """One finding.

    Attributes:
        level: ``PASS``, ``WARN`` or ``FAIL``.
        code: A stable word for programs.
        text: What was found.
        advice: What to do; may be empty.
    """

    level: str
    code: str
    text: str
    advice: str = ""


@dataclass(frozen=True)
class Verdict:
    """The answer.

    Attributes:
        level: The worst of the reasons' levels.
        reasons: Worst first.
    """

    level: str
    reasons: tuple[Reason, ...]


def judge(estimate: Estimate) -> Verdict:
    """Look at an estimate from every side."""
    checks = (
        _solution,
        _data,
        _rejections,
        _scatter,
        _order,
        _structure,
        _local,
        _parameters,
        _accuracy,
        _held_out,
    )
    reasons = [reason for check in checks for reason in check(estimate)]
    reasons.sort(key=lambda r: -LEVELS.index(r.level))
    return Verdict(reasons[0].level if reasons else "PASS", tuple(reasons))


def _solution(e: Estimate) -> Iterator[Reason]:
    if e.status == "not_converged":
        yield Reason("FAIL", "not_converged", "the iteration did not settle", e.message)
    if e.agreeing_starts < e.starts:
        text = f"{e.starts - e.agreeing_starts} of {e.starts} other starts ended elsewhere"
        yield Reason(
            "WARN", "other_minimum", text, "the best was taken: measure more configurations, or add a prior"
        )
    after = e.residual_after
    if after.rms > LARGEST_RESIDUAL:
        text = f"{mm(after.rms)} are left after the fit: more than any robot's geometry explains"
        yield Reason("FAIL", "large_residuals", text, "check joint order, signs, units, and which point is whose")
    elif after.mean > 0.9 * e.residual_before.mean:
        text = f"the fit improved the points from {mm(e.residual_before.mean)} to {mm(after.mean)} only"
        yield Reason("WARN", "no_gain", text, "these parameters are not what ails the robot: free others")


def _data(e: Estimate) -> Iterator[Reason]:
    spare = 3 * e.used - e.rank
    if e.copies:
        text = f"{counted(e.copies, 'row')} repeated digit for digit"
        yield Reason("WARN", "copies", text, "a measurement given twice counts twice: leave the copies out")
    if spare < FEWEST_SPARE:
        text = f"{3 * e.used} coordinates for {counted(e.rank, 'parameter')}"
        advice = "too few to check noise and gross errors: measure more configurations or free fewer parameters"
        yield Reason("WARN", "too_few_measurements", text, advice)
    if not np.isfinite(e.sigma):
        text = "nothing is known of the noise: no standard deviations"
        yield Reason("FAIL", "no_uncertainty", text, "give sigma or an instrument, or measure more")


def _rejections(e: Estimate) -> Iterator[Reason]:
    share = len(e.rejected) / max(e.measurements, 1)
    if e.rejected:
        level = "FAIL" if share > REJECTED[1] else "WARN" if share > REJECTED[0] else "PASS"
        text = f"{len(e.rejected)} of {counted(e.measurements, 'point')} rejected"
        yield Reason(
            level, "rejected", text, "each is listed with its reason; measure those configurations again"
        )
    if e.suspects:
        rows = ", ".join(str(s["row"]) for s in e.suspects[:5]) + (" …" if len(e.suspects) > 5 else "")
        number = counted(len(e.suspects), "point")
        text = f"{number} beyond {e.gate:.3g} standard deviations (rows {rows}), used nevertheless"
        yield Reason("WARN", "suspects", text, "look at them, or use the robust loss (--loss robust)")


def _scatter(e: Estimate) -> Iterator[Reason]:
    noise = e.noise
    if noise.scaled > 1.0:
        text = f"repetitions scatter {noise.scaled:.2g} times as much as the {noise.source} says"
        yield Reason("WARN", "repeatability", text, "check the robot's standstill, the nest and the tracker")
    if noise.discrepancy > 0:
        text = (
            f"{mm(noise.discrepancy)} per coordinate is left that measurement noise ({mm(noise.measurement)}) "
            "does not explain: no geometric model holds it, and measuring more often does not reduce it"
        )
        yield Reason("PASS", "model_discrepancy", text, "it is part of every accuracy predicted here")
        return
    probability = e.chi_square.probability
    if probability < 1e-3:
        text = f"measurement noise of {mm(noise.measurement)} explains such residuals in {probability:.1g} only"
        yield Reason("WARN", "poor_fit", text, "free more parameters, look for gross errors, check sigma")
    elif probability > 1.0 - 1e-6:
        text = f"the residuals scatter {mm(e.sigma_estimate)}, far less than the {mm(noise.measurement)} stated"
        yield Reason("WARN", "noise_overstated", text, "the standard deviations are too large: check sigma")


def _order(e: Estimate) -> Iterator[Reason]:
    words = {
        "drift": "the tracker drifted",
        "bump": "the tracker was moved",
        "reseat": "was seated elsewhere",
        "distance": "the tracker's distances err",
    }
    for found in e.disturbances:
        sure = found.certain and not found.instead
        level = "FAIL" if sure and found.shift > HARMFUL else "WARN"
        who = f"target {found.target} " if found.target else ""
        when = "" if found.row is None else f" before row {found.row}"
        far = float(np.linalg.norm(found.translation))
        sign = f"by chance {found.probability:.1g}" if not found.instead else "noise explains the rest"
        text = (
            f"{who}{words[found.kind]}{when}, it seems, by {mm(far)} ({sign}); "
            f"{found.parameter} may be off by {found.shift:.2g} standard deviations"
        )
        yield Reason(
            level, found.kind, text, "measure again, or identify the parts before and after on their own"
        )
    if e.moved_since is not None:
        text = f"every point from row {e.moved_since} on was rejected: something moved for good"
        yield Reason("WARN", "moved", text, "the fit is to the rows before; measure those after again")


def _structure(e: Estimate) -> Iterator[Reason]:
    if e.transmission is not None:
        size = f"{1e3 * e.transmission.amplitude:.2g} mrad, alike over {e.transmission.length:g} rad"
        text = f"the joints' transmissions err ({size}): corrections were learnt and are part of every prediction"
        advice = "a URDF cannot hold them: apply them to the joint targets (calib-planner compensate)"
        yield Reason("PASS", "joint_corrections", text, advice)
    for found in (s for s in e.structure if s.probability < SIGNIFICANT):
        level = "PASS" if e.noise.discrepancy > 0 or e.transmission is not None else "WARN"
        if found.joint:
            size = f"{1e3 * found.amplitude:.2g} {'mrad' if found.unit == 'rad' else 'mm'}"
            text = (
                f"errors of {found.joint} depend on where it stands, {size} (correlation {found.correlation:.2f})"
            )
            advice = "gear, encoder or compliance: no geometric parameter removes it"
        elif found.kind == "configuration":
            text = f"the targets of one configuration err alike (correlation {found.correlation:.2f})"
            advice = "what is left is the robot's, not the tracker's: measuring a point again does not reduce it"
        else:
            text = f"neighbouring configurations err alike (correlation {found.correlation:.2f})"
            advice = (
                "parameters are missing, or the robot bends: free more parameters; keep to the measured region"
            )
        yield Reason(level, "residual_structure", text, advice)


def _local(e: Estimate) -> Iterator[Reason]:
    if e.hidden is None:
        return
    shifts = e.hidden.shifts / np.where(np.isfinite(e.std) & (e.std > 0), e.std, np.inf)
    worst = int(np.argmax(shifts))
    if not shifts[worst] > FAR:
        return
    size = f"{1e3 * e.hidden.amplitude:.2g} mrad"
    text = (
        f"joints that err by {size} would hardly show in these data, but move {e.parameters[worst]} by "
        f"{shifts[worst]:.2g} standard deviations: the values hold round the measured postures only"
    )
    there = _unpromised(e)
    if there.any():
        off = mm(float(e.hidden.at_test_poses[there].max()))
        text = f"{text}; predictions at {there.sum()} of {len(there)} test poses may be off by {off} more"
        yield Reason("WARN", "local", text, "measure round the test poses too, or wherever the robot works")
    else:
        safe = "predictions at the test poses are safe: use the robot near them"
        advice = safe if len(there) else "give the test poses that matter, or measure wherever the robot works"
        level = "PASS" if len(there) else "WARN"
        yield Reason(level, "local", text, advice)


def _unpromised(e: Estimate) -> NDArray[np.bool_]:
    """(K,) test poses of which hidden errors break what is said of them, by more than a measurement's noise."""
    assert e.hidden is not None
    predicted = e.predicted_accuracy_per_test_pose
    total = np.hypot(predicted, e.hidden.at_test_poses)
    if np.isfinite(e.required_accuracy):
        return np.asarray((predicted <= e.required_accuracy) & (total > e.required_accuracy))
    visible = e.hidden.at_test_poses > np.sqrt(3.0) * e.noise.measurement
    return np.asarray(visible & (total > APART[0] * predicted))


def _parameters(e: Estimate) -> Iterator[Reason]:
    if e.held:
        text = f"{counted(len(e.held), 'parameter')} held, not to be told from others: {listed(e.held)}"
        yield Reason("PASS", "unidentifiable", text, "no measured point depends on the choice")
    if e.nearly_dependent:
        number = counted(len(e.nearly_dependent), "combination")
        text = f"{number} hardly seen by these data: {e.nearly_dependent[0]}"
        yield Reason(
            "PASS", "nearly_dependent", text, "do not read their values one by one; predictions are safe"
        )
    if e.correlations:
        a, b, c = e.correlations[0]
        text = f"strongly correlated: {counted(len(e.correlations), 'pair')}, most of all {a} and {b} ({c:+.3f})"
        yield Reason("PASS", "correlated", text, "do not read their values one by one; predictions are safe")


def _accuracy(e: Estimate) -> Iterator[Reason]:
    per = e.predicted_accuracy_per_test_pose
    if np.isinf(per).any():
        count = int(np.isinf(per).sum())
        text = f"the error at {count} of {len(per)} test poses rests on what the data cannot see"
        yield Reason("FAIL", "blind_test_pose", text, "measure configurations that move those parameters")
    required = e.required_accuracy
    if not np.isfinite(required):
        return
    worst = float(per.max()) if len(per) else 0.0
    if len(per) and not np.isnan(worst):
        level = "PASS" if worst <= required else "FAIL"
        text = f"predicted at the test poses: {mm(worst)} where {mm(required)} are required"
        advice = "" if level == "PASS" else _advice(e)
        yield Reason(level, "required_accuracy", text, advice)
    elif not len(per) and e.validation is None and e.cross_validation is None:
        text = f"{mm(required)} are required, but nothing says where"
        yield Reason("WARN", "required_accuracy", text, "give test poses, or data to validate with")


def _advice(e: Estimate) -> str:
    if e.discrepancy_per_test_pose.max() > e.required_accuracy:
        return (
            "what no geometric model holds is more than that: calibrate closer to the task, or compensate locally"
        )
    return "measure more configurations: calib-planner plan --measured … --accuracy …"


def _held_out(e: Estimate) -> Iterator[Reason]:
    if e.validation is None and e.cross_validation is None:
        yield Reason(
            "PASS", "not_validated", "nothing was held out", "--validate FILE, or --folds 5 on these data"
        )
    if e.validation is not None:
        yield from _validation(e.validation, "held-out points", e.required_accuracy)
    if e.cross_validation is not None:
        yield from _validation(e.cross_validation, "points left out in turn", e.required_accuracy)


def _validation(v: Validation, what: str, required: float) -> Iterator[Reason]:
    if v.mean >= v.before_mean:
        text = f"{what} are no better than before: {mm(v.mean)}, before {mm(v.before_mean)}"
        yield Reason("FAIL", "no_gain_held_out", text, "do not apply it: free fewer parameters or measure more")
    ratio = v.rms / v.predicted_rms
    if np.isfinite(ratio):
        level = "FAIL" if ratio > APART[1] else "WARN" if ratio > APART[0] else "PASS"
        text = f"{what}: {mm(v.rms)} achieved where {mm(v.predicted_rms)} were predicted"
        advice = "" if level == "PASS" else "they lie elsewhere than what was measured, or the robot changed"
        yield Reason(level, "predicted_and_achieved", text, advice)
    if v.count >= MANY and v.within_95 < INSIDE:
        text = f"{what}: only {100 * v.within_95:.0f} % lie in the regions where 95 % were expected"
        advice = (
            "something changed between the two sets: temperature, the tracker's place, the target's seat, load"
        )
        yield Reason("WARN", "region", text, advice)
    if np.isfinite(required):
        # What is required is the robot's; what was achieved holds the measurement's noise as well.
        level = "PASS" if v.robot_rms <= required else "FAIL"
        advice = "" if level == "PASS" else "free more parameters, measure more, or calibrate closer to the task"
        noise = (
            f"of it {mm(v.noise_rms)} the measurement's" if v.noise_rms > 0 else "the measurement's part included"
        )
        text = f"{what}: {mm(v.rms)} achieved, {noise}, where {mm(required)} are required"
        yield Reason(level, "required_accuracy", text, advice)


def mm(metres: float) -> str:
    """A length for people."""
    return f"{1e3 * metres:.3g} mm"


def counted(number: int, noun: str) -> str:
    """A number with its noun."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def listed(names: tuple[str, ...], most: int = 4) -> str:
    """The first few names."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
