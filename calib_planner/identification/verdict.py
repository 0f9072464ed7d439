# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Is this calibration good? PASS, WARN or FAIL, with reasons that a person can act on.

Every reason has a level of its own; the verdict is the worst of them. A reason at level PASS is information and
needs no action. The verdict follows from the numbers of the estimate alone.

``RULES`` is the table of everything that ``judge`` can say: code, text, and what to do at each level that the
reason can have. Its order is the order of importance: of two reasons of one level the earlier one comes first.

*Achieved and predicted.* Visits left out and held-out points say what is achieved. A ratio of what is achieved
to what was predicted counts as far as chance does not explain it: it is divided by the factor that chance makes
of it once in a hundred (``chance_of``), so that few points accuse nobody.

*The requirement* is judged at the test poses where there are any: by what is predicted there, times the ratio of
achieved to predicted at the visits left out where that counts. Without test poses the visits left out are judged
themselves, and held-out points always are. Of what is measured the instrument's own part is taken off. FAIL needs
that chance is excluded; in between is WARN.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import bdtr

from calib_planner.identification.alternatives import TABLE
from calib_planner.identification.estimate import (
    CHANCE,
    LEVELS,
    Estimate,
    LeftOutError,
    Reason,
    Validation,
    Verdict,
    chance_of,
)
from calib_planner.units import counted, length, lengths, listed

LARGEST_RESIDUAL = 5e-3
"""No industrial robot is left with more than this after a calibration that was set up rightly [m]."""
LARGE_RESIDUAL = 1e-3
"""Measured robots are left with 0.1 to 0.45 mm: less than twice the largest of these is not looked into [m]."""
LITTLE = 0.5
"""Share of the error before that is left after a fit that explains little."""
INSIDE = 0.8
"""Share of the held-out points below which too few of them lie in their 95 % region."""
HARMFUL = 3.0
"""Predicted standard deviations by which predictions may move because of a fault: a normal error hardly does."""
APART = 1.5
"""Achieved over predicted error beyond which a prediction does not hold; measurements are too few where chance
makes as much of nothing (``chance_of``)."""
SYSTEMATIC = ("gravity", "smooth", "short")
"""Terms of an error model that move the robot the same each time, beside its geometry."""
IMPROBABLE_FIT, TOO_GOOD_FIT = 1e-3, 1.0 - 1e-6
"""χ² probabilities of the residuals below and above which the stated noise is doubted."""


@dataclass(frozen=True)
class Rule:
    """One kind of reason.

    Attributes:
        code: A stable word for programs.
        text: What is the case; names in braces stand for what the estimate says.
        advice: Level → what to do, for each level that the reason can have.
    """

    code: str
    text: str
    advice: Mapping[str, str]

    def reason(self, level: str = "", **values: object) -> Reason:
        """The reason with ``values`` in its text; ``level`` may be left out where there is only one."""
        if not level:
            (level,) = self.advice
        return Reason(level, self.code, self.text.format(**values), self.advice[level].format(**values))


def _each(advice: str, *levels: str) -> dict[str, str]:
    """The same advice at each level."""
    return dict.fromkeys(levels, advice)


_TOGETHER = {"PASS": "do not read their values one by one; predictions are safe"}
_MORE = "measure more configurations: calib-planner plan --measured … --accuracy …"
_CLOSER = "free more parameters, measure more, or calibrate closer to the task"

_TABLE: tuple[tuple[str, str, Mapping[str, str]], ...] = (
    ("not_converged", "the iteration did not converge", {"FAIL": "{message}"}),
    (
        "large_residuals",
        "{after} are left after the fit: more than any robot's geometry explains",
        {"FAIL": "check joint order, signs, units, and which point is whose"},
    ),
    (
        "blind_test_pose",
        "the error at {count} of {poses} test poses depends on what the data cannot see",
        {"FAIL": "measure configurations that move those parameters"},
    ),
    (
        "required_accuracy: held out",
        "{points}: {achieved} achieved, {noise}, where {required} are required",
        {"PASS": ""} | _each(_CLOSER, "WARN", "FAIL"),
    ),
    (
        "required_accuracy",
        "expected at the worst test pose: {worst} where {required} are required",
        {"PASS": ""} | _each(_MORE, "WARN", "FAIL"),
    ),
    (
        "required_accuracy: left out",
        "visits left out in turn: {achieved} achieved, {noise}, where {required} are required",
        {"PASS": ""} | _each(_CLOSER, "WARN", "FAIL"),
    ),
    (
        "no_gain_held_out",
        "{points} are no better than before: {after}, before {before}",
        {"FAIL": "do not apply it: free fewer parameters or measure more"},
    ),
    (
        "no_gain_left_out",
        "visits left out in turn are no better than before: {after}, before {before}",
        _each("do not apply it: free fewer parameters or measure more", "WARN", "FAIL"),
    ),
    (
        "predicted_and_achieved",
        "{points}: {achieved} achieved where {predicted} were predicted",
        {"PASS": ""} | _each("they lie elsewhere than the measured points, or the robot changed", "WARN", "FAIL"),
    ),
    (
        "left_out",
        "visits left out in turn: {achieved} achieved where {predicted} were predicted",
        {"PASS": ""}
        | _each("the visits contradict the error model: look at the rejected points first", "WARN", "FAIL"),
    ),
    (
        "moved",
        "every point from row {row} on was rejected: something moved for good",
        {"WARN": "the fit is to the rows before; measure those after again"},
    ),
    (
        "rejected",
        "{rejected} of {points} rejected",
        _each("each is listed with its reason; measure those configurations again", "PASS", "WARN", "FAIL"),
    ),
    (
        "unproven",
        "no visit can be predicted from the others: there is no left-out error",
        {"WARN": "measure more configurations than the parameters need"},
    ),
    (
        "too_few_measurements",
        "too few configurations: the fit leaves {spare} of the coordinates measured there to judge it by",
        {"WARN": "measure more configurations than the parameters need, or ask for fewer parameters"},
    ),
    (
        "explained_little",
        "{after} are left of {before}: the fit explains little",
        {"WARN": "free more parameters (--parameters full), and check joint order, signs and zeros"},
    ),
    (
        "no_gain",
        "the fit changed the mean error of the points from {before} to {after} only",
        {
            "PASS": "the measurement's noise explains both: there is nothing to correct",
            "WARN": "the robot's errors lie in other parameters: free those",
        },
    ),
    (
        "copies",
        "{rows} repeated digit for digit",
        {"WARN": "a measurement given twice counts twice: leave the copies out"},
    ),
    (
        "suspects",
        "{points} beyond {gate} standard deviations (rows {rows}), used nevertheless",
        {"WARN": "look at them, or use the robust loss (--loss robust)"},
    ),
    (
        "poor_fit",
        "measurement noise of {noise} does not explain the residuals (p {probability})",
        {"WARN": "free more parameters, look for gross errors, check sigma"},
    ),
    (
        "region",
        "{points}: only {share} % lie in the regions where 95 % were expected",
        {"WARN": "compare the two sets: temperature, the tracker's place, the target's seat, load"},
    ),
    (
        "noise_overstated",
        "the residuals scatter {scatter}, far less than the {noise} stated",
        {"WARN": "the standard deviations are too large: check sigma"},
    ),
    (
        "error_model",
        "the robot errs beyond its geometry ({terms} at the measured points): this is part of every prediction, "
        "but a URDF holds placement alone, with which visits left out in turn err by {alone} and not {complete}",
        {
            "PASS": "where that is too much, correct the joint targets: calib-planner compensate",
            "WARN": "a URDF alone does not reach what is required: correct the joint targets (calib-planner "
            "compensate)",
        },
    ),
    (
        "unidentifiable",
        "{parameters} fixed, because the data cannot tell them from others: {names}",
        {"PASS": "no measured point depends on the choice"},
    ),
    ("nearly_dependent", "{combinations} hardly seen by these data: {weakest}", _TOGETHER),
    ("correlated", "strongly correlated: {pairs}, most of all {one} and {other} ({correlation})", _TOGETHER),
)
LIMITS = {"rejected": (0.05, 0.20), "predicted_and_achieved": (APART, 3.0), "left_out": (APART, 3.0)}
"""Reason → share of the points, and achieved over predicted error as far as chance does not explain it, beyond
which its level is WARN and FAIL."""
RULES = {key: Rule(key.partition(":")[0], text, advice) for key, text, advice in _TABLE[:1]}
RULES |= {f"alternative: {a.code}": Rule(a.code, a.text, _each(a.advice, *LEVELS)) for a in TABLE.values()}
RULES |= {key: Rule(key.partition(":")[0], text, advice) for key, text, advice in _TABLE[1:]}
"""Everything that a verdict on an estimate can say, the most important first. A key is the code, with a word
behind it where one code has several texts."""
_IMPORTANCE = {code: rank for rank, code in reversed(list(enumerate(rule.code for rule in RULES.values())))}


def _graded(code: str, value: float, **values: object) -> Reason:
    """The reason at the level that ``LIMITS`` give ``value``."""
    warn, fail = LIMITS[code]
    return RULES[code].reason("FAIL" if value > fail else "WARN" if value > warn else "PASS", **values)


def judged(estimate: Estimate) -> Estimate:
    """``estimate`` with its verdict."""
    return replace(estimate, verdict=judge(estimate))


def judge(estimate: Estimate) -> Verdict:
    """The verdict on everything else that the estimate says; of one level the most important reason first."""
    checks = (_solution, _alternatives, _data, _rejections, _scatter, _left_out, _parameters, _accuracy)
    reasons = [reason for check in (*checks, _held_out) for reason in check(estimate)]
    return Verdict.of(sorted(reasons, key=lambda r: _IMPORTANCE[r.code]))


def _solution(e: Estimate) -> Iterator[Reason]:
    if e.fit.status == "not_converged":
        yield RULES["not_converged"].reason(message=e.fit.message)
    before, after = e.residuals.before, e.residuals.after
    if after.rms > LARGEST_RESIDUAL:
        yield RULES["large_residuals"].reason(after=length(after.rms))
    elif after.rms > max(LARGE_RESIDUAL, LITTLE * before.rms):
        was, left = lengths(before.rms, after.rms)
        yield RULES["explained_little"].reason(before=was, after=left)
    elif after.mean > 0.9 * before.mean:
        level = "PASS" if _is_noise(e, before.rms) else "WARN"
        was, left = lengths(before.mean, after.mean)
        yield RULES["no_gain"].reason(level, before=was, after=left)


def _alternatives(e: Estimate) -> Iterator[Reason]:
    """What explains the data better counts as far as it moves predictions at the test poses."""
    for a in e.alternatives:
        harmful = a.material and (a.deviations > HARMFUL or TABLE[a.code].kind == "gross")
        yield Reason("FAIL" if harmful else "WARN" if a.material else "PASS", a.code, a.text, a.advice)


def _is_noise(e: Estimate, rms: float) -> bool:
    """Whether the noise that is stated explains distances of ``rms`` [m] at the points used."""
    stated = e.noise.source != "residuals"
    return stated and rms <= np.sqrt(3.0) * e.noise.sigma * chance_of(3.0 * e.points.used)


def _data(e: Estimate) -> Iterator[Reason]:
    if e.points.copies:
        yield RULES["copies"].reason(rows=counted(e.points.copies, "row"))


def _rejections(e: Estimate) -> Iterator[Reason]:
    rejected, suspects = len(e.points.rejected), e.points.suspects
    if rejected:
        points = counted(e.points.measured, "point")
        yield _graded("rejected", rejected / e.points.measured, rejected=rejected, points=points)
    if suspects:
        rows = listed([s.row for s in suspects], 5)
        points, gate = counted(len(suspects), "point"), f"{e.residuals.gate:.3g}"
        yield RULES["suspects"].reason(points=points, gate=gate, rows=rows)
    if e.points.moved_since is not None:
        yield RULES["moved"].reason(row=e.points.moved_since)


def _scatter(e: Estimate) -> Iterator[Reason]:
    if not e.knowledge.model.is_papers:
        return  # its scales are those of the residuals
    noise, probability = length(e.noise.sigma), e.residuals.chi_square.probability
    if e.noise.source == "residuals":
        return  # so is the noise
    if probability < IMPROBABLE_FIT:
        yield RULES["poor_fit"].reason(noise=noise, probability=f"< {IMPROBABLE_FIT:g}")
    elif probability > TOO_GOOD_FIT:
        yield RULES["noise_overstated"].reason(scatter=length(e.residuals.sigma), noise=noise)


def _left_out(e: Estimate) -> Iterator[Reason]:
    left, before, required = e.left_out, e.residuals.before.mean, e.accuracy.required
    used = [t for t in e.terms if t.used and t.name in SYSTEMATIC]
    terms = [f"{t.name} {size}" for t, size in zip(used, lengths(*(t.size for t in used)), strict=True)]
    if terms:
        alone, complete = lengths(e.placement_alone.rms, left.rms)
        level = "WARN" if _needs_all_terms(e) else "PASS"
        yield RULES["error_model"].reason(level, terms=", ".join(terms), alone=alone, complete=complete)
    if not left.count:
        yield RULES["unproven"].reason()
        return
    few = chance_of(e.residuals.spare) > APART
    if few:
        yield RULES["too_few_measurements"].reason(spare=f"{e.residuals.spare:.1f}")
    if left.mean >= before and not e.accuracy.overall < before:
        level = "WARN" if few else "FAIL"
        now, was = lengths(left.mean, before)
        yield RULES["no_gain_left_out"].reason(level, after=now, before=was)
    achieved, predicted = lengths(left.rms, left.predicted_rms)
    yield _graded("left_out", _exceeded(left), achieved=achieved, predicted=predicted)
    if np.isfinite(required) and not len(e.accuracy.predicted):
        yield _achieved("required_accuracy: left out", left, required)


def _needs_all_terms(e: Estimate) -> bool:
    """Whether all terms reach what is required, and placement alone does not."""
    accuracy = e.accuracy
    if len(accuracy.predicted):
        return bool(accuracy.worst <= accuracy.required < np.max(accuracy.placement))
    return e.left_out.robot_rms <= accuracy.required < e.placement_alone.robot_least


def _exceeded(achieved: LeftOutError | Validation) -> float:
    """Achieved over predicted error, as far as chance does not explain it; 0 without points."""
    ratio = achieved.rms / achieved.predicted_rms / chance_of(achieved.freedom)
    return float(np.nan_to_num(ratio))


def _achieved(key: str, achieved: LeftOutError | Validation, required: float, **values: object) -> Reason:
    """Whether the robot's own part of what is achieved is what is required."""
    level = "PASS" if achieved.robot_rms <= required else "WARN" if achieved.robot_least <= required else "FAIL"
    reached, noise, wanted = lengths(achieved.rms, achieved.noise_rms, required)
    of_it = f"of it {noise} the measurement's"
    return RULES[key].reason(
        level,
        achieved=reached,
        noise=of_it if achieved.noise_rms > 0 else "the measurement's part included",
        required=wanted,
        **values,
    )


def _parameters(e: Estimate) -> Iterator[Reason]:
    fixed, weak, pairs = e.observability.fixed, e.observability.nearly_dependent, e.fit.correlations
    if fixed:
        yield RULES["unidentifiable"].reason(parameters=counted(len(fixed), "parameter"), names=listed(fixed, 4))
    if weak:
        yield RULES["nearly_dependent"].reason(combinations=counted(len(weak), "combination"), weakest=weak[0])
    if pairs:
        one, other, correlation = pairs[0]
        yield RULES["correlated"].reason(
            pairs=counted(len(pairs), "pair"), one=one, other=other, correlation=f"{correlation:+.3f}"
        )


def _accuracy(e: Estimate) -> Iterator[Reason]:
    predicted, required = e.accuracy.predicted, e.accuracy.required
    if np.isinf(predicted).any():
        yield RULES["blind_test_pose"].reason(count=int(np.isinf(predicted).sum()), poses=len(predicted))
    if np.isfinite(required) and len(predicted):
        worst = e.accuracy.worst * max(1.0, _exceeded(e.left_out))
        # Where nobody states the noise, the scatter of the residuals is what the prediction rests on.
        least = worst / (chance_of(e.left_out.freedom) if e.noise.source == "residuals" else 1.0)
        level = "PASS" if worst <= required else "WARN" if least <= required else "FAIL"
        reached, wanted = lengths(worst, required)
        yield RULES["required_accuracy"].reason(level, worst=reached, required=wanted)


def _held_out(e: Estimate) -> Iterator[Reason]:
    if e.validation is not None:
        yield from _validation(e.validation, "held-out points", e.accuracy.required)


def _by_chance(v: Validation) -> float:
    """Probability that no more held-out points lie in their 95 % region; three degrees of freedom are a point."""
    count = max(round(v.freedom / 3.0), 1)
    return float(bdtr(round(v.within_95 * count), count, 0.95))


def _validation(v: Validation, points: str, required: float) -> Iterator[Reason]:
    if v.mean >= v.before_mean:
        now, was = lengths(v.mean, v.before_mean)
        yield RULES["no_gain_held_out"].reason(points=points, after=now, before=was)
    if np.isfinite(v.predicted_rms):
        achieved, predicted = lengths(v.rms, v.predicted_rms)
        yield _graded(
            "predicted_and_achieved", _exceeded(v), points=points, achieved=achieved, predicted=predicted
        )
    if v.within_95 < INSIDE and _by_chance(v) < CHANCE:
        yield RULES["region"].reason(points=points, share=f"{100 * v.within_95:.0f}")
    if np.isfinite(required):
        yield _achieved("required_accuracy: held out", v, required, points=points)
