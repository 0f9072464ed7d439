"""Every reason of the verdict can be provoked by data, has its level and advice, and is absent otherwise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cells import POSE, ROUND, SIGMA, WrongRobot, bare, placed_cell, plain_cell, spoil
from robots import random_configurations

from calib_planner import IdentificationProblem, Robot, identify, validate
from calib_planner.error_model import ErrorModel, typical
from calib_planner.identification import LEVELS, RULES, cross_validate, judged
from calib_planner.measurements import RejectedPoint
from calib_planner.simulation import SimulatedCell, random_deviations

KUKA = Robot.load("kuka_kr270")


def data_of(seed: int = 1, count: int = 25, repetitions: int = 1):
    cell, _ = plain_cell(seed)
    return bare(cell.measure(random_configurations(KUKA, count, seed), repetitions, seed))


def solved(data=None, robot: Robot = KUKA, **options):
    return identify(IdentificationProblem(robot, data or data_of(), **{"sigma": SIGMA} | options))


def validated(change=lambda points: points, required=None, seed: int = 1):
    """Fresh points, changed beforehand."""
    problem = IdentificationProblem(KUKA, data_of(seed), sigma=SIGMA, required_accuracy=required)
    cell, _ = plain_cell(seed)
    fresh = bare(cell.measure(random_configurations(KUKA, 40, 77), 1, 77))
    return validate(problem, identify(problem), [bare(fresh, change(np.array(fresh.p)))])


def shaken(points: np.ndarray, size: float) -> np.ndarray:
    return points + size * np.random.default_rng(5).standard_normal(points.shape)


def elbow():
    """Two minima that are equally deep."""
    robot = Robot.load("planar_2r").with_parameters("offsets")
    q = np.array([[turn, 0.006] for turn in np.linspace(-0.4, 0.9, 12)])
    cell = SimulatedCell(robot, dict(zip(robot.parameter_names, (0.001, -0.03), strict=True)), 1e-5)
    return solved(bare(cell.measure(q, 1, 1)), robot, sigma=1e-5, starts=20)


def one_joint(**options):
    q = np.repeat(random_configurations(KUKA, 1, 5), 15, axis=0)
    q[:, 0] = np.linspace(-1, 1, 15)
    cell, _ = plain_cell(1)
    poses = random_configurations(KUKA, 2, 6)
    return solved(bare(cell.measure(q, 1, 5)), test_poses=poses, **options)


def spoilt(share: float, loss: str = "robust"):
    data, _ = spoil(data_of(count=50), 1, share, exchange=False)
    return solved(data, loss=loss, starts=0, discrepancy="off", joint_corrections="off")


def wrong(count: int = 60, **options):
    robot = WrongRobot(2)
    poses = random_configurations(KUKA, 3, 6)
    return solved(robot.measure(random_configurations(KUKA, count, 2)), robot.asked, test_poses=poses, **options)


def stood_elsewhere(move: np.ndarray, **options):
    data = data_of(count=40)
    return solved(bare(data, data.p + move[:, None]), **options)


def bumped(**options):
    """By 0.11 mm; what a discrepancy may explain moves the parameters by fewer of their standard deviations."""
    return stood_elsewhere(np.where(np.arange(40)[:, None] < 22, 0.0, [8e-5, 8e-5, 0.0]), **options)


def reseated():
    cell, asked = placed_cell(1, "offsets")
    data = bare(cell.measure(random_configurations(asked, 40, 1), 1, 1))
    seat = cell.truth.robot.target_offsets + np.array([[0, 0, 0], [4e-4, 0, 0], [0, 0, 0]])
    moved = cell.truth.with_targets(seat).positions(data.q) - cell.truth.positions(data.q)
    points = data.p + np.where(np.arange(40)[:, None, None] < 20, 0.0, moved)
    return solved(bare(data, points), asked, starts=0)


def distances():
    """Of a tracker at the base, each wrong by a number of its own."""
    data, off = data_of(count=40), 2e-4 * np.random.default_rng(1).standard_normal((40, 1, 1))
    return solved(bare(data, data.p + off * data.p / np.linalg.norm(data.p, axis=2, keepdims=True)))


def moved_for_good():
    data = data_of(count=40)
    points = np.array(data.p)
    points[33:] += [0.03, 0.0, 0.01]
    return solved(bare(data, points), loss="robust")


def no_gain():
    """d2 is asked for; what ails the robot is q2."""
    asked = KUKA.with_parameters("d2")
    cell = SimulatedCell(KUKA.with_parameters("q2"), {"q2": 5e-4}, SIGMA)
    return solved(bare(cell.measure(random_configurations(KUKA, 20, 1), 1, 1)), asked, discrepancy="off")


def overfitted():
    """Nothing is wrong with the robot; four points, as noisy as a tape measure, say otherwise."""
    cell = SimulatedCell(KUKA, {}, 3e-3)
    problem = IdentificationProblem(KUKA, bare(cell.measure(random_configurations(KUKA, 4, 1), 1, 3)), sigma=3e-3)
    fresh = SimulatedCell(KUKA, {}, 1e-5).measure(random_configurations(KUKA, 30, 9), 1, 9)
    return validate(problem, identify(problem), [bare(fresh)])


def copied():
    data = data_of()
    return solved(data.select([*range(25), 3, 4]))


def joint_bend():
    """A structure in the residuals of a fit that may not be given a discrepancy."""
    return wrong(discrepancy="off", joint_corrections="off", starts=0)


def close_together():
    """Configurations within two degrees: combinations hardly seen, values correlated."""
    q = random_configurations(KUKA, 1, 5) + np.random.default_rng(1).uniform(-0.04, 0.04, (40, 6))
    cell, _ = plain_cell(1)
    return solved(bare(cell.measure(q, 1, 5)), sigma=None)


def round_one_posture(**options):
    """Joints that err are not seen there."""
    cell = SimulatedCell(KUKA, random_deviations(KUKA, 1), 7e-6)
    return solved(bare(cell.measure(ROUND, 2, 1)), sigma=7e-6, **options)


def modelled(model=None, **options):
    """With an error model; the paper's has nothing but noise."""
    return solved(error_model=model or ErrorModel.paper(), **options)


def untrue():
    """As ``overfitted``, judged by the visits themselves."""
    cell = SimulatedCell(KUKA, {}, 3e-3)
    return modelled(data=bare(cell.measure(random_configurations(KUKA, 4, 1), 1, 3)), sigma=3e-3)


PROVOKED = {
    # code: (level, how)…
    "not_converged": [("FAIL", lambda: solved(iterations=1))],
    "other_minimum": [("WARN", elbow)],
    "large_residuals": [("FAIL", lambda: solved(bare(data_of(), shaken(data_of().p, 0.05))))],
    "no_gain": [("WARN", no_gain)],
    "too_few_measurements": [("WARN", lambda: solved(data_of(count=4)))],
    "no_uncertainty": [("FAIL", lambda: solved(data_of(count=3), sigma=None))],
    "copies": [("WARN", copied)],
    "rejected": [
        ("PASS", lambda: spoilt(0.02)),
        ("WARN", lambda: spoilt(0.10)),
        ("FAIL", lambda: spoilt(0.30)),
    ],
    "suspects": [("WARN", lambda: spoilt(0.02, "linear"))],
    "repeatability": [("WARN", lambda: solved(data_of(repetitions=3), sigma=SIGMA / 3))],
    "model_discrepancy": [("PASS", wrong)],
    "poor_fit": [("WARN", lambda: solved(sigma=SIGMA / 2, discrepancy="off"))],
    "noise_overstated": [("WARN", lambda: solved(sigma=SIGMA * 3))],
    "drift": [("WARN", lambda: stood_elsewhere(np.linspace([0, 0, 0], [1e-4, 1e-4, 0], 40)))],
    "bump": [("WARN", bumped), ("FAIL", lambda: bumped(discrepancy="off"))],
    "reseat": [("FAIL", reseated)],
    "distance": [("WARN", distances)],
    "moved": [("WARN", moved_for_good)],
    "joint_corrections": [("PASS", wrong)],
    "residual_structure": [("WARN", joint_bend), ("PASS", wrong)],
    "local": [("WARN", round_one_posture), ("PASS", lambda: round_one_posture(test_poses=POSE))],
    "unidentifiable": [("PASS", one_joint)],
    "nearly_dependent": [("PASS", close_together)],
    "correlated": [("PASS", close_together)],
    "blind_test_pose": [("FAIL", one_joint)],
    "required_accuracy": [
        ("PASS", lambda: solved(test_poses=random_configurations(KUKA, 2, 6), required_accuracy=1e-3)),
        ("FAIL", lambda: solved(test_poses=random_configurations(KUKA, 2, 6), required_accuracy=1e-6)),
        ("FAIL", lambda: wrong(required_accuracy=1e-4)),
        ("WARN", lambda: solved(required_accuracy=1e-3)),
        ("PASS", lambda: validated(required=1e-3)),
        ("FAIL", lambda: validated(lambda p: shaken(p, 10 * SIGMA), required=1e-4)),
        ("PASS", lambda: modelled(required_accuracy=1e-3)),
        ("FAIL", lambda: modelled(sigma=None, required_accuracy=1e-6)),
    ],
    "unproven": [("WARN", lambda: modelled(data=data_of(count=3)))],
    "left_out": [
        ("PASS", modelled),
        ("WARN", lambda: modelled(sigma=SIGMA / 2)),
        ("FAIL", lambda: modelled(sigma=SIGMA / 5)),
    ],
    "no_gain_left_out": [("FAIL", untrue)],
    "error_model": [("PASS", lambda: wrong(error_model=typical()))],
    "not_validated": [("PASS", solved)],
    "no_gain_held_out": [("FAIL", overfitted)],
    "predicted_and_achieved": [
        ("PASS", validated),
        ("WARN", lambda: validated(lambda p: shaken(p, 2 * SIGMA))),
        ("FAIL", lambda: validated(lambda p: shaken(p, 10 * SIGMA))),
    ],
    "region": [("WARN", lambda: validated(lambda p: shaken(p, 2 * SIGMA)))],
}
CASES = [(code, level, how) for code, ways in PROVOKED.items() for level, how in ways]
USUAL = {"not_validated", "predicted_and_achieved", "correlated", "nearly_dependent", "left_out"}
"""Reasons that a clean calibration may have, all of them at PASS."""


def test_the_table_is_complete():
    """Every code that the verdict can give is provoked below, at every level that it can have there."""
    assert {rule.code for rule in RULES.values()} == set(PROVOKED)
    assert all(key.partition(": ")[0] == rule.code for key, rule in RULES.items())
    levels = {code: {rule_level for rule in RULES.values() if rule.code == code for rule_level in rule.advice}
              for code in PROVOKED}  # fmt: skip
    for code, ways in PROVOKED.items():
        assert {level for level, _ in ways} <= levels[code], code


def problem() -> IdentificationProblem:
    return IdentificationProblem(KUKA, data_of(), sigma=SIGMA)


@cache
def clean(how: str):
    cell, asked = placed_cell(3)
    placed = bare(cell.measure(random_configurations(asked, 40, 3), 1, 3))
    poses = random_configurations(KUKA, 2, 6)
    return {
        "plain": lambda: solved(test_poses=poses),
        "error model": lambda: modelled(typical(), test_poses=poses),
        "sigma unknown": lambda: solved(sigma=None, test_poses=poses),
        "repeated": lambda: solved(data_of(repetitions=2), test_poses=poses),
        "robust": lambda: solved(loss="robust", test_poses=poses),
        "validated": validated,
        "cross-validated": lambda: cross_validate(p := problem(), identify(p)),
        "placed": lambda: solved(placed, asked, test_poses=poses),
    }[how]()  # fmt: skip


@pytest.mark.parametrize(
    "how",
    ["plain", "error model", "sigma unknown", "repeated", "robust", "validated", "cross-validated", "placed"],
)
def test_a_clean_calibration_passes_and_says_little(how):
    found = clean(how).verdict
    assert found.level == "PASS"
    assert {r.code for r in found.reasons} <= USUAL | ({"unidentifiable"} if how == "placed" else set())


@pytest.mark.parametrize(
    ("code", "level", "how"), CASES, ids=[f"{c}-{lv}-{k}" for k, (c, lv, _) in enumerate(CASES)]
)
def test_reason(code, level, how):
    estimate = how()
    found = estimate.verdict
    those = [r for r in found.reasons if r.code == code]
    assert those, [r.code for r in found.reasons]
    assert max((r.level for r in those), key=LEVELS.index) == level
    ranks = [LEVELS.index(r.level) for r in found.reasons]
    assert ranks == sorted(ranks, reverse=True)
    assert found.level == found.reasons[0].level
    for reason in found.reasons:
        assert reason.text and "nan" not in reason.text.lower()
        assert reason.level == "PASS" or reason.advice
    assert estimate.to_dict()["verdict"]["level"] == found.level


def required_reason(estimate):
    (reason,) = (r for r in estimate.verdict.reasons if r.code == "required_accuracy")
    return reason


def test_what_is_required_is_the_robots_not_the_trackers():
    """A robot calibrated to 0.02 mm, measured with noise of 0.05 mm, reaches 0.035 mm; 0.3 mm are seen."""
    good = validated(required=3.5e-5).validation
    assert good.rms > 3.5e-5 and good.noise_rms == pytest.approx(np.sqrt(3) * SIGMA)
    assert required_reason(validated(required=3.5e-5)).level == "PASS"
    off = validated(lambda p: p + np.array([3e-4, 0.0, 0.0]), required=2e-4)
    assert required_reason(off).level == "FAIL"
    # Noise twice as large as it is said to be is the robot's until somebody says otherwise.
    assert required_reason(validated(lambda p: shaken(p, 2 * SIGMA), required=3.5e-5)).level == "FAIL"


def test_noise_that_nobody_knows_is_not_taken_off():
    """Its level came from the residuals, where the robot's own scatter may be part of it."""
    problem = IdentificationProblem(KUKA, data_of(), required_accuracy=3.5e-5)
    cell, _ = plain_cell(1)
    fresh = bare(cell.measure(random_configurations(KUKA, 40, 77), 1, 77))
    found = validate(problem, identify(problem), [fresh])
    assert found.noise.source == "residuals" and np.isnan(found.validation.noise_rms)
    assert found.validation.robot_rms == found.validation.rms > 3.5e-5
    assert required_reason(found).level == "FAIL" and "included" in required_reason(found).text


def test_of_no_noise_as_much_as_of_much_is_exceeded_by_chance_once_in_forty():
    """A perfect robot, 2000 validations of 30 points: more than the noise's part is left in 2.3 %."""
    rng = np.random.default_rng(3)
    square = np.mean(np.sum(rng.standard_normal((2000, 30, 3)) ** 2, axis=2), axis=1)
    one = validated().validation
    made = [replace(one, rms=float(np.sqrt(s)), count=30, noise_rms=np.sqrt(3.0)) for s in square]
    assert np.mean([v.robot_rms > 0 for v in made]) == pytest.approx(0.023, abs=0.015)


def test_levels_of_shares_and_ratios_are_where_they_are_said_to_be():
    """On a made-up estimate: 5 and 20 % rejected, 1.5 and 3 times what was predicted."""
    base = validated()
    point = RejectedPoint(0, 1, "", 9.0, 0.1)
    for rejected, measurements, level in (
        (1, 20, "PASS"),
        (6, 100, "WARN"),
        (20, 100, "WARN"),
        (21, 100, "FAIL"),
    ):
        made = judged(
            replace(base, points=replace(base.points, rejected=(point,) * rejected, measured=measurements))
        )
        assert next(r for r in made.verdict.reasons if r.code == "rejected").level == level
    for ratio, level in ((1.49, "PASS"), (1.51, "WARN"), (2.99, "WARN"), (3.01, "FAIL")):
        own = replace(base.validation, rms=ratio * 1e-4, predicted_rms=1e-4)
        made = judged(replace(base, validation=own))
        assert next(r for r in made.verdict.reasons if r.code == "predicted_and_achieved").level == level
