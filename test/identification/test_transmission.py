"""Joint corrections, accepted by the truth they were drawn from and by poses that took no part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import SHARED_DATA, mixed, random_configurations, repeats

from calib_planner import IdentificationProblem, Measurements, Robot, identify, validate
from calib_planner.identification import JointCorrections, cross_validate, normalised, phases
from calib_planner.identification.transmission import TAIL, kernel, spectrum
from calib_planner.identification.validation import INSIDE
from calib_planner.io import read_measurements

SIGMA = 2e-5


def true_corrections(robot: Robot, seed: int, size: float = 4e-4, length: float = 0.3) -> JointCorrections:
    """Drawn from the process."""
    scale, shift = phases(robot)
    weights = size * np.sqrt(spectrum(length)) / scale[:, None]
    waves = weights * np.random.default_rng(seed).standard_normal((2, *weights.shape))
    return JointCorrections(robot.joint_names, scale, shift, *waves)


def measured(robot: Robot, corrections: JointCorrections, count: int, seed: int) -> Measurements:
    """What a tracker sees of the nominal geometry with erring joints."""
    q = random_configurations(robot, count, seed)
    points = robot.positions(corrections.actual(q))
    noise = SIGMA * np.random.default_rng(seed).standard_normal(points.shape)
    return Measurements(robot.joint_names, q, points + noise)


@pytest.mark.parametrize("length", [0.03, 0.07, 0.3, 1.2])
def test_the_series_is_the_kernel(length):
    """Σ λ_n cos nΔ against the closed form; the variances sum to one but for the tail."""
    difference = np.linspace(-7.0, 7.0, 301)
    share = spectrum(length)
    series = np.cos(np.outer(difference, np.arange(1, len(share) + 1))) @ share
    np.testing.assert_allclose(series, kernel(difference, length), atol=2 * TAIL)
    assert 1.0 - TAIL <= share.sum() <= 1.0 + 1e-12 and (share > 0).all()
    close = 0.3 * length
    without = kernel(np.array(close), length) - kernel(np.array(np.pi), length)
    assert without / (1 - kernel(np.array(np.pi), length)) == pytest.approx(
        np.exp(-(0.3**2) / 2), rel=0.1 if length > 1 else 0.01
    )


@pytest.mark.parametrize("make", [lambda: Robot.load("kuka_kr270"), mixed], ids=["kuka", "sliding joints"])
def test_columns_against_central_differences(make):
    robot = make().with_parameters("lengths+offsets")
    data = measured(robot, true_corrections(robot, 1, 2e-3), 60, 1)
    found = identify(IdentificationProblem(robot, data, sigma=SIGMA)).transmission
    assert found is not None
    q = random_configurations(robot, 5, 9)
    columns = found.columns(q)
    count, step = len(found.names), 1e-6
    for k, name in enumerate(found.names):
        there = [replace(found, robot=found.robot.with_deviations({name: s * step})) for s in (1, -1)]
        slope = (there[0].positions(q) - there[1].positions(q)) / (2 * step)
        np.testing.assert_allclose(columns[..., k], slope, atol=1e-8)
    waves = [np.asarray(found.corrections.cosines), np.asarray(found.corrections.sines)]
    shape = waves[0].shape
    rng = np.random.default_rng(3)
    for which, joint, n in rng.integers(0, (2, *shape), (12, 3)):
        moved = []
        for s in (1, -1):
            new = [w.copy() for w in waves]
            new[which][joint, n] += s * step
            corrections = replace(found.corrections, cosines=new[0], sines=new[1])
            moved.append(replace(found, corrections=corrections).positions(q))
        at = count + which * shape[0] * shape[1] + joint * shape[1] + n
        np.testing.assert_allclose(columns[..., at], (moved[0] - moved[1]) / (2 * step), atol=1e-8)


@pytest.mark.parametrize("seed", range(1))
@pytest.mark.parametrize("known", [True, False], ids=["sigma known", "sigma unknown"])
def test_erring_joints_are_learnt(seed, known):
    """Fresh poses: far better than geometry alone, and as far off as predicted."""
    targets = [[0.1, 0.0, 0.2], [0.0, 0.15, 0.1], [-0.1, 0.0, 0.1]]
    robot = Robot.load("kuka_kr270").with_targets(targets[: 1 if known else 3])
    robot = robot.with_parameters("lengths+offsets")
    true = true_corrections(robot, seed)
    data = measured(robot, true, 100 if known else 60, seed)
    fresh = random_configurations(robot, 300, seed + 70)
    problem = IdentificationProblem(robot, data, sigma=SIGMA if known else None, test_poses=fresh)
    found = identify(problem)
    assert found.transmission is not None
    assert {r.code for r in found.verdict.reasons} >= {"joint_corrections"}

    def rms(points):
        off = points - robot.positions(true.actual(fresh))
        return np.sqrt(np.mean(np.sum(off**2, axis=2)))

    achieved = rms(found.positions(fresh))
    assert achieved < 0.35 * rms(found.calibrated.positions(fresh))
    off = robot.positions(true.actual(fresh)) - found.positions(fresh)
    inside = normalised(off, found.transmission.error_covariance(fresh)) <= INSIDE
    assert 0.85 < inside.mean() <= 1.0
    assert found.transmission.amplitude == pytest.approx(4e-4, rel=0.4)
    assert found.transmission.length in (0.15, 0.3, 0.6)


@pytest.mark.parametrize("seed", range(10))
def test_nothing_is_learnt_where_nothing_is(seed):
    robot = Robot.load("kuka_kr270").with_targets([[0.1, 0.0, 0.2], [0.0, 0.15, 0.1]])
    data = measured(robot.with_parameters("lengths+offsets"), true_corrections(robot, 0, 0.0), 60, seed)
    for sigma in (SIGMA, None):
        assert (
            identify(IdentificationProblem(robot.with_parameters("full"), data, sigma=sigma)).transmission is None
        )


def test_off_is_off_and_few_configurations_are_too_few():
    robot = Robot.load("kuka_kr270").with_parameters("lengths+offsets")
    true = true_corrections(robot, 2)
    many, few = measured(robot, true, 80, 2), measured(robot, true, 11, 2)
    assert identify(IdentificationProblem(robot, many, sigma=SIGMA, joint_corrections="off")).transmission is None
    assert identify(IdentificationProblem(robot, few, sigma=SIGMA)).transmission is None


def test_cross_validation_tells_the_same_as_fresh_poses():
    robot = Robot.load("kuka_kr270").with_parameters("lengths+offsets")
    true = true_corrections(robot, 4)
    problem = IdentificationProblem(robot, measured(robot, true, 100, 4), sigma=SIGMA)
    fresh = measured(robot, true, 400, 77)
    found = cross_validate(problem, validate(problem, identify(problem), [fresh]), folds=3, seed=1)
    out, cross = found.validation, found.cross_validation
    assert out.rms < cross.rms < 2 * out.rms  # each fold was learnt from two thirds of the data
    assert out.rms < 0.5 * out.geometry_rms and cross.rms < 0.7 * cross.geometry_rms
    assert 0.85 < out.within_95 <= 1.0 and 0.6 < out.rms / out.predicted_rms < 1.5


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="no measured data")
def test_measured_ur10():
    """100 random rows fitted, the others predicted: 0.45 mm without, 0.13 mm with joint corrections."""
    folder = SHARED_DATA / "ur10_tracker"
    robot = Robot.load(folder / "ur10.urdf").with_parameters("full", ("base", "tool"))
    data = read_measurements(folder / "random_poses.csv", robot).data
    for seed in repeats([0], [0, 1]):
        rows = np.random.default_rng(seed).choice(len(data), 100, replace=False)
        rest = data.select(np.setdiff1d(np.arange(len(data)), rows))
        problem = IdentificationProblem(robot, data.select(rows))
        found = validate(problem, identify(problem), [rest]).validation
        assert found.mean < 0.16e-3 and found.geometry_mean < 0.475e-3
        assert 0.7 < found.rms / found.predicted_rms < 1.4


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="no measured data")
def test_measured_irb120():
    """Re-seated target from one row: 0.32 mm without, 0.21 mm with joint corrections."""
    folder = SHARED_DATA / "irb120_tracker"
    robot = Robot.load(folder / "irb120.urdf").with_targets(np.zeros((3, 3)))
    robot = robot.with_parameters("full", ("base", "tool"))
    data, *tests = (
        read_measurements(folder / f"{n}.csv", robot).data for n in ("calibration", "test_1", "test_2")
    )
    problem = IdentificationProblem(robot, data)
    found = validate(problem, identify(problem), tests, target_from=1).validation
    assert found.count == 40 and found.mean < 0.215e-3 and found.geometry_mean < 0.33e-3
