"""Errors of the joints that the data would not show: what they do, by simulation of such joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import LENGTH as LENGTH_ERROR
from cells import POSE, ROUND, WrongRobot, bare
from robots import random_configurations

from calib_planner import IdentificationProblem, Measurements, Robot, identify
from calib_planner.identification import DOUBT, UPDATE, JointCorrections, judged, phases
from calib_planner.identification.checks import LENGTH, TYPICAL
from calib_planner.identification.transmission import spectrum
from calib_planner.simulation import SimulatedCell, random_deviations

KUKA = Robot.load("kuka_kr270")
NOISE = 7e-6
POSES = np.stack([POSE, POSE + 0.3])


def measured(q: np.ndarray, seed: int, repetitions: int = 2, noise: float = NOISE) -> Measurements:
    """Of a robot with wrong parameters whose joints do not err."""
    cell = SimulatedCell(KUKA, random_deviations(KUKA, seed, LENGTH_ERROR, 1e-3), noise)
    return bare(cell.measure(q, repetitions, seed))


def found(data: Measurements, sigma: float | None = NOISE, **options):
    return identify(IdentificationProblem(KUKA, data, **({"sigma": sigma, "starts": 0} | options)))


def erring(seed: int) -> JointCorrections:
    """Joints as bad as is asked about."""
    scale, shift = phases(KUKA)
    weights = TYPICAL * np.sqrt(spectrum(LENGTH)) / scale[:, None]
    waves = weights * np.random.default_rng([seed, 9]).standard_normal((2, *weights.shape))
    return JointCorrections(KUKA.joint_names, scale, shift, *waves)


def test_what_such_joints_do():
    """150 robots whose only fault they are: what they put into parameters, prediction and residuals."""
    q, said = np.repeat(ROUND, 2, axis=0), found(measured(ROUND, 1), test_poses=POSES)
    shifts, errors, improbable = [], [], []
    for seed in range(150):
        joints = erring(seed)
        points = KUKA.positions(joints.actual(q))
        noise = NOISE * np.random.default_rng([seed, 8]).standard_normal(points.shape)
        data = Measurements(KUKA.joint_names, q, points + noise)
        one = found(data, discrepancy="off", joint_corrections="off", order_check="off")
        shifts.append(one.fit.deviations)
        errors.append(np.linalg.norm(KUKA.positions(joints.actual(POSES)) - one.positions(POSES), axis=2)[:, 0])
        improbable.append(one.residuals.chi_square.probability < DOUBT)
    shifts, errors = (np.sqrt(np.mean(np.square(x), axis=0)) for x in (shifts, errors))
    kept = np.isfinite(said.fit.std)
    wide = np.hypot(said.diagnostics.hidden.shifts, said.fit.std)[kept]
    # The root of a mean of 150 squares of one normal number is within 3 · 5.8 %.
    np.testing.assert_allclose(shifts[kept], wide, rtol=0.17)
    there = np.hypot(said.diagnostics.hidden.at_test_poses, said.accuracy.parameters)
    np.testing.assert_allclose(errors, there, rtol=0.17)
    # A share of 150 is within 3 · 3.3 %; the two moments that stand for a distribution add a few per cent.
    assert np.mean(improbable) == pytest.approx(said.diagnostics.hidden.probability, abs=0.10 + 0.05)
    assert 0.1 < np.mean(improbable) < 0.5


def test_not_where_the_data_would_show_them():
    """Spread configurations; or joints that err so much that corrections were learnt; or it is not asked."""
    assert found(measured(random_configurations(KUKA, 12, 1), 1)).diagnostics.hidden is None
    wrong = WrongRobot(2)
    learnt = identify(
        IdentificationProblem(
            wrong.asked, wrong.measure(random_configurations(KUKA, 60, 2)), sigma=3e-5, starts=0
        )
    )
    assert learnt.transmission is not None and learnt.diagnostics.hidden is None
    assert found(measured(ROUND, 1), joint_corrections="off").diagnostics.hidden is None
    quick = identify(IdentificationProblem(KUKA, measured(ROUND, 1), sigma=NOISE, **UPDATE))
    assert quick.diagnostics.hidden is None


def test_residuals_that_tell_their_own_scatter_rule_out_larger_ones():
    """Without any noise level there is no test, but what errors would leave is not there."""
    posture = found(measured(ROUND, 1, 1), None)
    assert posture.noise.source == "residuals" and posture.diagnostics.hidden is not None
    assert posture.diagnostics.hidden.probability == 0.0
    spread = found(measured(random_configurations(KUKA, 25, 1), 1, 1), None)
    assert spread.noise.source == "residuals" and spread.diagnostics.hidden is None


def test_larger_noise_hides_more_but_moves_less():
    """A spread plan measured with a poor instrument: errors of the joints drown, and do no harm to its std."""
    poor = found(measured(random_configurations(KUKA, 12, 1), 1, 2, 3e-4), 3e-4)
    assert poor.diagnostics.hidden is not None and poor.diagnostics.hidden.probability < 0.5
    assert (
        poor.diagnostics.hidden.shifts <= 4.0 * np.where(np.isfinite(poor.fit.std), poor.fit.std, np.inf)
    ).all()
    assert not [r for r in poor.verdict.reasons if r.code == "local"]


def requiring(estimate, required: float):
    """The same estimate, judged under another requirement [m]."""
    return judged(replace(estimate, accuracy=replace(estimate.accuracy, required=required)))


def local(estimate):
    (reason,) = (r for r in estimate.verdict.reasons if r.code == "local")
    return reason


def test_the_verdict_names_the_parameter_that_moves_most_and_how_far():
    estimate = found(measured(ROUND, 1), test_poses=POSE)
    moved = estimate.diagnostics.hidden.shifts / np.where(np.isfinite(estimate.fit.std), estimate.fit.std, np.inf)
    reason = local(estimate)
    assert reason.level == "PASS" and estimate.verdict.level == "PASS"
    assert f"{estimate.fit.parameters[int(np.argmax(moved))]} by {moved.max():.2g} standard" in reason.text


def test_the_verdict_warns_where_predictions_break():
    """Without test poses; at one 17° off; and where the errors alone exceed what is required."""
    data = measured(ROUND, 1)
    assert local(found(data)).level == "WARN"
    off = found(data, test_poses=POSES)
    assert local(off).level == "WARN" and "1 of 2 test poses" in local(off).text
    at = found(data, test_poses=POSE)
    predicted, hidden = at.accuracy.overall, float(at.diagnostics.hidden.at_test_poses[0])
    for required, level in ((1.05 * np.hypot(predicted, hidden), "PASS"), (1.05 * predicted, "WARN")):
        asked = requiring(at, required)
        assert local(asked).level == asked.verdict.level == level
    # What is broken anyway is said by another reason.
    assert local(requiring(at, 0.9 * predicted)).level == "PASS"


def test_what_a_measurement_would_not_show_does_not_warn():
    """Beyond 1.5 times the prediction, but within the noise of a point measured there."""
    estimate = found(measured(ROUND, 1), test_poses=POSE)
    hidden, predicted = float(estimate.diagnostics.hidden.at_test_poses[0]), estimate.accuracy.overall
    assert np.hypot(hidden, predicted) > 1.5 * predicted and hidden < np.sqrt(3.0) * NOISE
    assert local(estimate).level == "PASS"
    quiet = judged(replace(estimate, noise=replace(estimate.noise, measurement=0.9 * hidden / np.sqrt(3.0))))
    assert local(quiet).level == "WARN"


def test_it_comes_with_the_estimate_as_plain_numbers():
    said = found(measured(ROUND, 1), test_poses=POSE)
    plain = said.to_dict()["hidden_joint_errors"]
    assert plain["amplitude"] == TYPICAL and plain["length"] == LENGTH
    assert plain["shifts"] == said.diagnostics.hidden.shifts.tolist()
