# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimator: the paper's case, simulated robots with known truth, gross errors, and a measured robot."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fits import simulated, unknown, ur10e
from numpy.typing import NDArray
from robots import SHARED_DATA, random_configurations, repeats

from calib_planner import Robot
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, Gravity, typical
from calib_planner.identification import ModelEstimate, fit_error_model
from calib_planner.identification.estimation import _Work, placement_alone
from calib_planner.identification.left_out import left_out
from calib_planner.measurements import Measurements
from calib_planner.tracker import Isotropic

ALL = {"gravity": 2e-3, "smooth.size": 3e-4, "repeatability": 5e-5, "shared": 3e-5}


def fresh_errors(found: ModelEstimate, truth: Measurements, first: int) -> tuple[FloatArray, float]:
    """(points,) distances at visits that took no part [m], and predicted over achieved rms."""
    rest = truth.select(np.arange(first, len(truth)))
    told = found.knowledge.predict(rest.q)
    distance = np.linalg.norm(rest.p - told.mean, axis=2)
    predicted = np.sqrt(np.trace(told.total, axis1=2, axis2=3).mean())
    return distance.ravel(), float(predicted / np.sqrt(np.mean(distance**2)))


# ── the paper ────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("sigma", [3e-5, None])
def test_the_papers_model_is_plain_least_squares(sigma: float | None) -> None:
    """Eqs. (6), (7) and (11), iterated by hand."""
    robot = Robot.load("kuka_kr270").with_targets([[0.0, 0.1, 0.05]])
    rng = np.random.default_rng(3)
    q, count = random_configurations(robot, 12, 1), len(robot.parameter_names)
    true = robot.with_deviations(dict(zip(robot.parameter_names, 1e-3 * rng.standard_normal(count), strict=True)))
    points = true.positions(q) + 3e-5 * rng.standard_normal((12, 1, 3))
    deviations = np.zeros(count)
    for _ in range(8):
        predicted, jacobian = robot.positions_and_jacobian(q, deviations)
        rows, right = jacobian.reshape(-1, count), (points - predicted).ravel()
        deviations = deviations + np.linalg.lstsq(rows, right, rcond=None)[0]
    variance = 9e-10 if sigma else float(right @ right) / (len(right) - count)
    covariance = variance * np.linalg.inv(rows.T @ rows)
    found = fit_error_model(robot, Measurements(robot.joint_names, q, points), ErrorModel.paper(sigma))
    np.testing.assert_allclose(found.knowledge.coefficients, deviations, atol=1e-9)
    np.testing.assert_allclose(found.knowledge.covariance, covariance, rtol=2e-3, atol=1e-6 * covariance.max())
    if sigma:
        np.testing.assert_allclose(
            found.knowledge.covariance, covariance, rtol=1e-4, atol=1e-9 * covariance.max()
        )


# ── simulated robots ─────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("scales", "heavy"),
    [({}, False), ({"gravity": 3e-3}, False), ({"shared": 1e-4}, False), (ALL, False), ({}, True)],
    ids=["noise", "gravity", "shared", "all", "t3"],
)
def test_what_is_predicted_is_achieved(scales: dict[str, float], heavy: bool) -> None:
    robot, ratios, inside = ur10e(2), [], []
    for seed in range(repeats(1, 3)):
        data, truth = simulated(robot, scales, 190, seed, heavy)
        found = fit_error_model(unknown(robot), data.select(np.arange(40)), typical())
        distance, ratio = fresh_errors(found, data, 40)
        told = found.knowledge.predict(data.q[40:])
        std = np.sqrt(np.diagonal(told.position, axis1=2, axis2=3))
        apart = told.mean - truth.poses(data.q[40:]).points
        inside.append(np.mean(np.abs(apart) < 1.96 * std))
        ratios.append(ratio)
        assert found.converged
        if not heavy:
            assert not found.doubt.any()
            assert found.left_out.rms == pytest.approx(float(np.sqrt(np.mean(distance**2))), rel=0.35)
    assert 0.8 < np.mean(ratios) < 1.25
    assert np.mean(inside) > 0.85


def test_gravity_is_found_and_a_term_that_is_not_there_goes() -> None:
    robot = ur10e(2)
    data, _ = simulated(robot, {"gravity": 3e-3}, 40, 5)
    found = fit_error_model(unknown(robot), data, typical())
    worth = {t.name: t for t in found.terms}
    assert worth["gravity"].used and worth["gravity"].gain > 10.0 and worth["gravity"].size > 1e-4
    assert not worth["short"].used and worth["short"].gain <= 0.0 and worth["short"].size == 0.0
    assert set(worth) == {"placement", "gravity", "smooth", "short", "visits", "points"}


def test_a_mounting_that_is_not_the_robots_predicts_worse() -> None:
    robot = ur10e(2)
    data, _ = simulated(robot, {"gravity": 4e-3}, 40, 6)
    scores = [
        fit_error_model(unknown(robot), data, typical(gravity=Gravity(mounting=m)), choose=False).left_out.score
        for m in ("floor", (1.0, 0.0, 0.0))
    ]
    assert scores[0] > scores[1] + 10.0


@pytest.mark.parametrize("targets", [1, 3])
def test_errors_that_targets_share_are_no_trouble_without_sigma(targets: int) -> None:
    """Noise far below what the targets of a visit share: the covariance of a visit is nearly singular."""
    robot = ur10e(targets)
    data, _ = simulated(robot, {"shared": 2e-4, "floor": 1e-7}, 60, 2)
    found = fit_error_model(unknown(robot), data.select(np.arange(30)), typical())
    assert found.converged
    distance, ratio = fresh_errors(found, data, 30)
    assert 0.75 < ratio < 1.35 and np.sqrt(np.mean(distance**2)) < 6e-4


def test_points_that_were_not_seen_are_as_if_they_had_not_been_asked_for() -> None:
    robot = ur10e(2)
    data, _ = simulated(robot, {}, 80, 4)
    points = np.array(data.p)
    points[3, 1], points[10] = np.nan, np.nan
    some = Measurements(robot.joint_names, data.q, points).select(np.arange(40))
    found = fit_error_model(unknown(robot), some, typical())
    assert found.left_out.residuals[10].max() == 0.0 and found.left_out.scores[10] == pytest.approx(0.0, abs=1e-9)
    distance, _ = fresh_errors(found, data, 40)
    assert np.sqrt(np.mean(distance**2)) < 9e-5


def test_a_stated_instrument_is_believed_and_its_scale_is_found_if_asked() -> None:
    robot = ur10e(2)
    data, _ = simulated(robot, {"floor": 1e-4}, 80, 1)
    believed = fit_error_model(unknown(robot), data, typical(Isotropic(1e-4)))
    assert believed.knowledge.model.values["floor"] < 5e-5
    scaled = fit_error_model(unknown(robot), data, typical(Isotropic(5e-5), estimate_scale=True))
    values = scaled.knowledge.model.values
    assert np.hypot(5e-5 * values["instrument"], values["floor"]) == pytest.approx(1e-4, rel=0.15)


def test_standard_deviations_that_came_with_the_points_weigh_them_and_are_expected_of_others() -> None:
    robot = ur10e(1)
    data, truth = simulated(robot, {"floor": 1e-6}, 60, 3)
    rng = np.random.default_rng(0)
    std = np.where(np.arange(60)[:, None, None] % 2, 1e-3, 2e-5) * np.ones((60, 1, 3))
    noisy = Measurements(robot.joint_names, data.q, data.p + std * rng.standard_normal(std.shape), std)
    found = fit_error_model(unknown(robot), noisy, typical())
    apart = found.knowledge.predict(data.q).mean - truth.poses(data.q).points
    assert np.sqrt(np.mean(apart**2)) < 1e-4  # the noisy half alone would leave far more
    noise = np.sqrt(np.trace(found.knowledge.predict(data.q[:1]).noise[0, 0]) / 3.0)
    assert noise == pytest.approx(np.sqrt(np.mean(std**2)), rel=0.05)
    again = pickle.loads(pickle.dumps(found.knowledge))
    np.testing.assert_array_equal(again.predict(data.q).mean, found.knowledge.predict(data.q).mean)


# ── big starts ───────────────────────────────────────────────────────────────────────────────────────


def test_zeros_off_by_15_degrees_and_lengths_by_50_mm_are_found() -> None:
    """The tolerances expect a hundredth of that; with them alone the way to the minimum is too crooked."""
    robot = ur10e(1)
    rng = np.random.default_rng(83)
    true = {n: float(rng.uniform(-0.26, 0.26)) for n in robot.parameter_names if n.endswith("joint.rz")}
    true |= {"shoulder_lift_joint.x": 0.05, "wrist_3_joint.z": -0.05}
    q = random_configurations(robot, 90, 83)
    points = robot.with_deviations(true).positions(q) + rng.normal(0.0, 3e-5, (90, 1, 3))
    data = Measurements(robot.joint_names, q, points)
    found = fit_error_model(unknown(robot), data.select(np.arange(30)), typical())
    distance, ratio = fresh_errors(found, data, 30)
    assert found.converged and not found.doubt.any()
    assert distance.max() < 3e-4 and 0.7 < ratio < 1.4


# ── gross errors ─────────────────────────────────────────────────────────────────────────────────────


def spoil(how: str, points: FloatArray, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Puts gross errors into ``points``, 40 visits × 2 targets; returns which are wrong (40, 2)."""
    bad = np.zeros((40, 2), bool)
    if how == "random":
        bad.ravel()[rng.choice(80, 24, replace=False)] = True
        points[:40][bad] += rng.uniform(-0.05, 0.05, (24, 3))
    elif how == "alike":
        bad.ravel()[rng.choice(80, 24, replace=False)] = True
        points[:40][bad] += np.array([0.01, 0.004, -0.006]) + rng.normal(0.0, 1e-3, (24, 3))
    elif how == "block":
        bad[10:22] = True
        points[10:22] += [0.01, -0.005, 0.008]
    else:
        visits = rng.choice(40, 8, replace=False)
        bad[visits] = True
        points[visits] = points[visits][:, ::-1]
    return bad


WAYS = ("random", "alike", "block", "swapped targets")


@pytest.mark.parametrize(
    ("how", "scales"),
    repeats([("block", {}), ("swapped targets", ALL)], [(h, s) for h in WAYS for s in ({}, ALL)]),
    ids=lambda v: v if isinstance(v, str) else "all" if v else "noise",
)
def test_gross_errors_lose_their_weight(how: str, scales: dict[str, float]) -> None:
    robot = ur10e(2)
    data, _ = simulated(robot, scales, 160, 7)
    points = np.array(data.p)
    bad = spoil(how, points, np.random.default_rng(0))
    clean = fit_error_model(unknown(robot), data.select(np.arange(40)), typical())
    found = fit_error_model(unknown(robot), Measurements(robot.joint_names, data.q[:40], points[:40]), typical())
    assert ((found.doubt > 0) == bad).all()
    (good, _), (distance, ratio) = fresh_errors(clean, data, 40), fresh_errors(found, data, 40)
    assert distance.mean() < 1.2 * good.mean()
    assert 0.75 < ratio < 1.4


# ── placement alone, repetitions ─────────────────────────────────────────────────────────────────────


def test_placement_alone_is_what_predicts_best_without_the_other_terms() -> None:
    """Its left-out error is what it achieves, and less than the parameters of the whole model achieve."""
    robot = ur10e(2)
    data, _ = simulated(robot, {"gravity": 1e-3, "smooth.size": 3e-4}, 340, 2)
    found = fit_error_model(unknown(robot), data.select(np.arange(40)), typical())
    alone = placement_alone(found)
    assert alone.converged and alone.knowledge.model.gravity is None
    assert alone.knowledge.model.joint_functions is None

    def achieved(deviations: FloatArray) -> float:
        placed = alone.knowledge.robot
        positions = placed.positions(data.q[40:], deviations)
        return float(np.sqrt(np.mean(np.sum((positions - data.p[40:]) ** 2, axis=2))))

    count = len(alone.knowledge.robot.parameter_names)
    own = achieved(alone.knowledge.coefficients)
    assert own < 0.9 * achieved(found.knowledge.coefficients[:count])
    assert alone.left_out.rms == pytest.approx(own, rel=0.2)
    assert alone.left_out.predicted_rms == pytest.approx(own, rel=0.3)
    assert found.left_out.rms < 0.7 * alone.left_out.rms


def test_placement_alone_is_the_fit_itself_where_there_is_nothing_else() -> None:
    robot = ur10e(2)
    data, _ = simulated(robot, {}, 20, 2)
    found = fit_error_model(unknown(robot), data, ErrorModel.paper())
    alone = placement_alone(found)
    np.testing.assert_array_equal(alone.knowledge.coefficients, found.knowledge.coefficients)
    assert alone.left_out is found.left_out


def test_repetitions_do_not_make_the_left_out_error_kind() -> None:
    """Three visits at each of few configurations of a robot with short joint functions."""
    robot = ur10e(1)
    data, _ = simulated(robot, {"short.size": 4e-4}, 160, 4)
    rows = np.repeat(np.arange(25), 3)
    points = data.p[rows] + np.random.default_rng(0).normal(0.0, 1e-5, (75, 1, 3))
    found = fit_error_model(unknown(robot), Measurements(robot.joint_names, data.q[rows], points), typical())
    distance, _ = fresh_errors(found, data, 25)
    assert found.left_out.rms == pytest.approx(np.sqrt(np.mean(distance**2)), rel=0.25)
    assert left_out(found.solution).rms < 0.3 * found.left_out.rms  # visit by visit
    assert {t.name: t.used for t in found.terms}["short"]


# ── updates ──────────────────────────────────────────────────────────────────────────────────────────


def test_an_update_says_what_a_fit_at_the_same_scales_says() -> None:
    """Visits one by one, one with a gross error, one withdrawn; the oracle relinearises and solves anew."""
    robot = ur10e(2)
    data, _ = simulated(robot, ALL, 50, 3)
    points = np.array(data.p)
    points[33, 1] += [0.02, 0.0, -0.01]
    data = Measurements(robot.joint_names, data.q, points)
    found = first = fit_error_model(unknown(robot), data.select(np.arange(30)), typical())
    for count in range(31, 41):
        found = fit_error_model(unknown(robot), data.select(np.arange(count)), typical(), start=found)
    rows = np.delete(np.arange(40), 7)
    found = fit_error_model(unknown(robot), data.select(rows), typical(), start=found)
    assert found.origin.visits == 30 and found.converged
    assert found.knowledge.model.values == first.knowledge.model.values
    assert np.argwhere(found.doubt > 0.0).tolist() == [[32, 1]]
    work = _Work(found.solution.problem.robot, data.select(rows), found.solution.problem.model)
    work.state = replace(work.state, coefficients=found.origin.coefficients, doubt=found.doubt)
    solution = work.settle(5, 0)
    left = left_out(solution)
    told = found.knowledge.predict(data.q)
    std = np.sqrt(np.trace(told.position, axis1=2, axis2=3).min() / 3.0)
    anew = replace(found.knowledge, coefficients=work.state.coefficients)
    assert np.abs(told.mean - anew.predict(data.q).mean).max() < 0.02 * std
    assert found.left_out.score == pytest.approx(left.score, rel=1e-3)
    np.testing.assert_allclose(found.left_out.residuals, left.residuals, atol=0.02 * std)
    before = placement_alone(first)
    alone = placement_alone(found, before)
    model = alone.knowledge.model
    assert alone.converged and model.values == before.knowledge.model.values
    cold = _Work(alone.knowledge.robot, data.select(rows), model)
    cold.state = replace(cold.state, doubt=found.doubt)
    expected = left_out(cold.settle(10, 0))
    parameters = zip(alone.knowledge.robot.parameter_names, cold.state.coefficients, strict=True)
    placed = alone.knowledge.robot.with_deviations(dict(parameters))
    off = alone.knowledge.placed.positions(data.q) - placed.positions(data.q)
    assert np.abs(off).max() < 0.02 * std
    assert np.abs(before.knowledge.placed.positions(data.q) - placed.positions(data.q)).max() > 0.1 * std
    np.testing.assert_allclose(alone.left_out.residuals, expected.residuals, atol=0.02 * std)
    whole = fit_error_model(unknown(robot), data.select(rows), typical())
    apart = whole.knowledge.predict(data.q[40:]).mean - told.mean[40:]
    assert np.sqrt(np.mean(apart**2) / np.mean(np.trace(told.position[40:], axis1=2, axis2=3) / 3.0)) < 0.5


def test_updates_tell_nothing_that_no_visit_sees() -> None:
    """Base and first joint, tip and target cannot be told apart: four combinations are what the prior says."""
    robot, sizes = ur10e(2), {"gravity": 3e-5, "smooth.size": 2e-4, "short.size": 5e-5}
    data, _ = simulated(robot, sizes | {"repeatability": 1e-5, "shared": 1e-5}, 46, 3)
    found = first = fit_error_model(unknown(robot), data.select(np.arange(24)), typical())
    for count in range(25, 47):
        found = fit_error_model(unknown(robot), data.select(np.arange(count)), typical(), start=found)
    assert found.origin.visits == 24
    count = len(found.knowledge.robot.parameter_names)
    before, after = (f.knowledge.covariance[:count, :count] for f in (first, found))
    variances, directions = np.linalg.eigh(before)
    std, widest = np.sqrt(variances[-4:]), directions[:, -4:]
    assert std.min() > 0.019  # rad: the tolerance of a joint's zero
    moved = widest.T @ (found.knowledge.coefficients - first.knowledge.coefficients)[:count]
    assert np.abs(moved / std).max() < 0.02
    # What 22 visits tell by the curvature of their positions is far less than a percent.
    np.testing.assert_allclose(np.sqrt(np.diag(widest.T @ after @ widest)), std, rtol=1e-3)


def test_what_an_update_cannot_do_is_a_full_fit() -> None:
    robot = ur10e(2)
    data, _ = simulated(robot, {}, 45, 5)
    start = fit_error_model(unknown(robot), data.select(np.arange(20)), typical())

    def visits(robot: Robot, data: Measurements, model: ErrorModel) -> int:
        return fit_error_model(robot, data, model, start=start).origin.visits

    assert visits(unknown(robot), data.select(np.arange(26)), typical()) == 20
    assert visits(unknown(robot), data, typical()) == 45  # more than twice as many
    assert visits(robot, data.select(np.arange(21)), typical()) == 21  # base and tool known
    assert visits(unknown(robot), data.select(np.arange(21)), typical(Isotropic(1e-4))) == 21
    assert visits(unknown(robot), data.select(np.arange(21, 45)), typical()) == 24  # other visits
    noisy = np.array(data.p)
    noisy[20:] += np.random.default_rng(0).normal(0.0, 1.2e-4, noisy[20:].shape)  # four times the noise
    noisy_data = Measurements(robot.joint_names, data.q, noisy).select(np.arange(40))
    found = fit_error_model(unknown(robot), noisy_data, typical(), start=start)
    assert found.origin.visits == 40
    again = fit_error_model(unknown(robot), noisy_data, typical())
    np.testing.assert_array_equal(found.knowledge.coefficients, again.knowledge.coefficients)


# ── measured robots ──────────────────────────────────────────────────────────────────────────────────


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the measured data are not here")
def test_a_measured_irb120() -> None:
    folder: Path = SHARED_DATA / "irb120_tracker"
    rows = np.loadtxt(folder / "calibration.csv", delimiter=",", skiprows=1)
    robot = (
        Robot.load(folder / "irb120.urdf")
        .with_targets(np.zeros((3, 3)))
        .with_parameters("full", ("base", "tool"))
    )
    data = Measurements(robot.joint_names, rows[:, :6], rows[:, 6:].reshape(-1, 3, 3))
    found = fit_error_model(robot, data, typical())
    test = np.loadtxt(folder / "test_2.csv", delimiter=",", skiprows=1)
    known = found.knowledge.with_new_targets(found.knowledge.robot.target_offsets[:1])
    known = known.updated(test[:1, :6], test[:1, None, 6:])
    distance = np.linalg.norm(known.predict(test[1:, :6]).mean[:, 0] - test[1:, 6:], axis=1)
    assert distance.mean() < 1.6e-4
    assert {t.name: t.used for t in found.terms}["gravity"]
    assert found.left_out.rms < 2e-4
