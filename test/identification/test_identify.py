# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification accepted by the truth it was given, and by fresh poses; never by its own residuals alone."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from robots import CASES, SHARED_DATA, mixed, random_configurations

from calib_planner import (
    IdentificationProblem,
    InputError,
    Measurements,
    NotEnoughDataError,
    Robot,
    UnknownNameError,
    identify,
    validate,
)
from calib_planner.error_model import ErrorModel
from calib_planner.identification.registration import register
from calib_planner.robot.elements import rotation
from calib_planner.simulation import SimulatedCell, random_deviations
from calib_planner.tracker import Isotropic

SIGMA = 3e-5


def simulate(robot, count, seed, sigma=SIGMA, length=1e-3, angle=1e-3):
    cell = SimulatedCell(robot, random_deviations(robot, seed, length, angle), sigma)
    return cell, cell.measure(random_configurations(robot, count, seed), 1, seed)


MODELS = {"paper": ErrorModel.paper(), "typical": None}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("name", ["planar_2r", "kuka_kr270", "mixed lengths+offsets"])
@pytest.mark.parametrize("seed", range(3))
def test_reaches_the_truth_within_its_own_uncertainty(name, seed, model):
    robot = CASES[name]()
    cell, data = simulate(robot, 20, seed)
    estimate = identify(IdentificationProblem(robot, data, sigma=SIGMA, error_model=MODELS[model]))
    free = ~np.isnan(estimate.fit.std)
    truth = np.array([cell.deviations[n] for n in estimate.fit.parameters])
    assert free.any() and estimate.verdict.level == "PASS"
    if free.all():
        assert (np.abs(estimate.fit.deviations - truth) < 4.5 * estimate.fit.std).all()
    fresh = random_configurations(robot, 200, seed + 50)
    assert np.sqrt(np.mean(cell.position_errors(estimate.calibrated, fresh) ** 2)) < 4 * SIGMA
    assert estimate.residuals.sigma == pytest.approx(SIGMA, rel=0.35)


POSES = {
    "beside": (rotation(2, 2.5), [2.0, -3.0, 0.4]),
    "upside down": (rotation(0, np.pi) @ rotation(2, 1.0), [0.0, 4.0, 3.0]),
    "gimbal": (rotation(2, 0.3) @ rotation(1, np.pi / 2), [-3.0, 1.0, 0.0]),
}


@pytest.mark.parametrize("where", POSES)
def test_tracker_anywhere_and_targets_anywhere_need_no_guess(where):
    """Closed form, then the fit: fresh points are predicted with nothing known about the placement."""
    matrix, xyz = POSES[where]
    truth = Robot.load("kuka_kr270").with_targets([[0.1, 0.05, 0.0], [0.0, -0.1, 0.08], [-0.05, 0, 0.2]])
    truth = truth.with_base(matrix, xyz)
    deviations = random_deviations(truth, 3)
    cell = SimulatedCell(truth, deviations, SIGMA)
    data = cell.measure(random_configurations(truth, 30, 1), 1, 1)
    asked = Robot.load("kuka_kr270").with_targets(np.zeros((3, 3)))
    asked = asked.with_parameters("lengths+offsets", ("base", "tool"))
    estimate = identify(IdentificationProblem(asked, data, sigma=SIGMA))
    assert estimate.observability.resolved_by_prior  # joint 1's offset is the base's turn, for one
    fresh = random_configurations(truth, 200, 9)
    assert np.sqrt(np.mean(cell.position_errors(estimate.calibrated, fresh) ** 2)) < 3 * SIGMA
    assert estimate.residuals.before.mean > 20 * estimate.residuals.after.mean


def test_registration_alone_is_exact_without_noise():
    matrix, xyz = POSES["upside down"]
    robot = mixed().with_base(matrix, xyz)
    data = Measurements(robot.joint_names, q := random_configurations(robot, 12), robot.positions(q))
    blank = mixed().with_targets(np.zeros((2, 3)))
    got = register(blank, data, base=True, tool=True)
    np.testing.assert_allclose(got.base_pose[0], matrix, atol=1e-10)
    np.testing.assert_allclose(got.base_pose[1], xyz, atol=1e-10)
    np.testing.assert_allclose(got.target_offsets, robot.target_offsets, atol=1e-10)
    np.testing.assert_allclose(register(mixed(), data, base=True, tool=False).base_pose[0], matrix, atol=1e-10)
    np.testing.assert_allclose(
        register(blank.with_base(matrix, xyz), data, base=False, tool=True).target_offsets,
        robot.target_offsets,
        atol=1e-10,
    )


def test_unidentifiable_combinations_are_named_and_fixed():
    """A target on the last axis: q6 cannot be seen; d0 is the height of an unknown base."""
    robot = Robot.load("kuka_kr270").with_parameters("d0,d2,q6,q1", ("base",))
    _, data = simulate(robot.with_parameters("d2"), 12, 0)
    problem = IdentificationProblem(robot, data, sigma=SIGMA, error_model=ErrorModel.paper())
    estimate = identify(problem)
    assert estimate.fit.status == "rank_deficient"
    assert set(estimate.observability.fixed) == {"d0", "q6", "q1"}
    assert estimate.observability.rank == len(estimate.fit.parameters) - 3 == 7
    combinations = dict(zip(estimate.observability.fixed, estimate.observability.unidentifiable, strict=True))
    assert combinations["q6"] == "q6"
    assert combinations["d0"] == "1·d0 - 1·base.z"
    assert combinations["q1"] == "1·q1 - 1·base.rz"
    assert np.isnan(
        estimate.fit.std[[estimate.fit.parameters.index(n) for n in estimate.observability.fixed]]
    ).all()
    assert (
        estimate.fit.deviations[[estimate.fit.parameters.index(n) for n in estimate.observability.fixed]] == 0
    ).all()
    told = identify(IdentificationProblem(robot, data, sigma=SIGMA))
    assert told.fit.status == "ok" and told.observability.fixed == ()
    assert set(told.observability.resolved_by_prior) == set(estimate.observability.unidentifiable)


def test_missing_points_are_left_out():
    robot = Robot.load("kuka_kr270").with_targets([[0.1, 0, 0], [0, 0.1, 0]])
    cell, data = simulate(robot, 20, 4)
    points = np.array(data.p)
    points[3, 0] = points[7, 1] = points[9] = np.nan
    gappy = dataclasses.replace(data, points=points, std=None)
    estimate = identify(IdentificationProblem(robot, gappy, sigma=SIGMA))
    assert estimate.points.measured == estimate.points.used == 36
    assert np.isnan(estimate.residuals.vectors[9]).all()
    fresh = random_configurations(robot, 100, 5)
    assert np.sqrt(np.mean(cell.position_errors(estimate.calibrated, fresh) ** 2)) < 3 * SIGMA


def test_joint_columns_may_come_in_any_order():
    robot = Robot.load("kuka_kr270")
    _, data = simulate(robot, 10, 2)
    shuffled = data.in_order_of(robot.joint_names[::-1])
    a = identify(IdentificationProblem(robot, data))
    b = identify(IdentificationProblem(robot, shuffled))
    np.testing.assert_array_equal(a.fit.deviations, b.fit.deviations)


def test_estimate_is_immutable_and_plain():
    robot = Robot.load("kuka_kr270")
    _, data = simulate(robot, 6, 2)
    estimate = identify(IdentificationProblem(robot, data, test_poses=np.radians([0, -60, 90, 0, 45, 0])))
    with pytest.raises(dataclasses.FrozenInstanceError):
        estimate.verdict = None
    with pytest.raises(ValueError, match="read-only"):
        estimate.fit.deviations[0] = 1.0
    document = json.loads(json.dumps(estimate.to_dict(), allow_nan=False))
    assert set(document["parameters"][0]) == {"name", "unit", "nominal", "value", "deviation", "std"}
    assert {
        "rank", "unidentifiable", "measurements", "used", "rejected", "sigma_estimate", "residual_before",
        "residual_after", "predicted_accuracy", "status", "message", "seconds",
    } <= set(document)  # fmt: skip


def _kuka_data(count=6):
    robot = Robot.load("kuka_kr270")
    return robot, simulate(robot, count, 0)[1]


@pytest.mark.parametrize(
    ("make", "error", "needle"),
    [
        (lambda r, d: IdentificationProblem(r.with_targets(np.zeros((2, 3))), d), InputError, "1 targets"),
        (lambda r, d: IdentificationProblem(r, d, sigma=-1.0), InputError, "sigma"),
        (
            lambda r, d: IdentificationProblem(dataclasses.replace(r, parameter_names=()), d),
            InputError,
            "at least one",
        ),
        (
            lambda r, d: IdentificationProblem(r, d, sigma=1e-5, instrument=Isotropic(1e-5)),
            InputError,
            "sigma: expected one of the two",
        ),
        (lambda r, d: IdentificationProblem(r, d, loss="huge"), UnknownNameError, "linear"),
        (lambda r, d: IdentificationProblem(r, d, test_poses=np.zeros(3)), InputError, "joint_a1"),
        (lambda r, d: Measurements(("a",) * 6, d.q, d.p).in_order_of(r.joint_names), InputError, "joint_a1"),
        (lambda r, d: Measurements(r.joint_names, d.q, d.p[:-1]), InputError, "points"),
        (lambda r, d: Measurements(r.joint_names, d.q, np.inf * d.p), InputError, "infinite"),
        (lambda r, d: Measurements(r.joint_names, d.q, d.p, 0 * d.p), InputError, "std"),
        (
            lambda r, d: Measurements(r.joint_names, d.q, np.where([1, 1, 0], d.p, np.nan)),
            InputError,
            "all three coordinates or none",
        ),
        (
            lambda r, d: IdentificationProblem(r, Measurements(r.joint_names, d.q, np.nan * d.p)),
            NotEnoughDataError,
            "no measured points",
        ),
        (
            lambda r, d: identify(IdentificationProblem(r, d.select([0, 1]), error_model=ErrorModel.paper())),
            NotEnoughDataError,
            "at least 3 configurations",
        ),
        (
            lambda r, d: identify(
                IdentificationProblem(r.with_parameters("offsets", ("base", "tool")), d.select([0] * 6))
            ),
            NotEnoughDataError,
            "differ in several joints",
        ),
    ],
)
def test_refusals(make, error, needle):
    with pytest.raises(error) as caught:
        make(*_kuka_data())
    assert needle in str(caught.value)


def read_irb120(name, targets):
    path = SHARED_DATA / "irb120_tracker" / name
    if not path.exists():
        pytest.skip("measured data not present")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    names = [f"joint_{i}" for i in range(1, 7)]
    return Measurements(tuple(names), table[:, :6], table[:, 6:].reshape(-1, targets, 3))


@pytest.mark.parametrize(
    ("level", "model", "rank", "mean"),
    [("offsets", "paper", 19, 0.60e-3), ("full", "paper", 33, 0.33e-3), ("full", "typical", 51, 0.145e-3)],
)
def test_real_robot_held_out_error(level, model, rank, mean):
    """ABB IRB 120: 36 configurations × 3 points fitted, 40 others of a re-seated target predicted."""
    data = read_irb120("calibration.csv", 3)
    robot = Robot.load(SHARED_DATA / "irb120_tracker" / "irb120.urdf").with_targets(np.zeros((3, 3)))
    robot = robot.with_parameters(level, ("base", "tool"))
    problem = IdentificationProblem(robot, data, error_model=MODELS[model])
    estimate = validate(problem, identify(problem), [read_irb120(f"test_{k}.csv", 1) for k in (1, 2)], 1)
    assert estimate.observability.rank == rank
    assert estimate.validation.count == 40
    assert estimate.validation.before_mean == pytest.approx(4.9e-3, rel=0.05)
    assert estimate.validation.mean <= mean
    if model == "typical":
        assert 0.7 < estimate.validation.predicted_rms / estimate.validation.rms < 1.6
