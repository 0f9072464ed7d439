# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot drawn from the error model errs as the error model says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fits import NOTHING, ur10e
from robots import mixed, random_configurations, repeats

from calib_planner import Robot
from calib_planner.error_model import ErrorModel, Gravity, Payload, Placement, Poses, Prior, Truth, typical
from calib_planner.error_model.placement import joint_zeros
from calib_planner.error_model.poses import joint_units
from calib_planner.tracker import LaserTracker

TINY = NOTHING | {"placement.length": 1e-12, "placement.angle": 1e-12, "floor": 1e-5}
"""Scales with which nothing but a floor of 10 µm is seen."""
FAR = LaserTracker(station=np.array([15.0, 0.0, 1.0]))
DRAWS = repeats(400, 4000)


def tight(robot: Robot) -> Placement:
    """Zeros of the joints that are known to 20 µrad, which errs together, so that everything is linear."""
    zeros = [p for p, z in zip(robot.parameters, joint_zeros(robot), strict=True) if z]
    covariance = 4e-10 * (0.5 * np.eye(len(zeros)) + 0.5)
    return Placement(stated=Prior(tuple(p.name for p in zeros), [p.nominal + 3e-5 for p in zeros], covariance))


def model_of(robot: Robot, scales: dict[str, float]) -> ErrorModel:
    return replace(typical(), placement=tight(robot)).with_values(TINY | scales)


ALL = {
    "placement.length": 2e-5,
    "placement.angle": 2e-5,
    "gravity": 2e-5,
    "smooth.size": 3e-5,
    "short.size": 2e-5,
    "repeatability": 2e-5,
    "shared": 3e-5,
}
TERMS: dict[str, dict[str, float]] = {
    "placement": {"placement.length": 2e-5, "placement.angle": 2e-5},
    "gravity": {"gravity": 3e-5},
    "joint functions": {"smooth.size": 3e-5, "short.size": 2e-5},
    "visits": {"repeatability": 3e-5, "shared": 3e-5, "floor": 4e-5},
    "all": ALL,
}


def whitened(robot: Robot, model: ErrorModel, q: np.ndarray, seed: int) -> np.ndarray:
    """(DRAWS, 3·points) measured − nominal in standard deviations of what is reckoned with."""
    poses = Poses(robot, q)
    columns = model.columns(poses).reshape(3 * len(q) * len(robot.targets), -1)
    total = columns @ np.linalg.solve(model.precision(robot), columns.T)
    size = 3 * len(robot.targets)
    for i, covariance in enumerate(model.visit_covariance(poses)):
        total[i * size : (i + 1) * size, i * size : (i + 1) * size] += covariance
    rng = np.random.default_rng(seed)
    drawn = np.array([Truth.draw(robot, model, rng).measure(q, rng) for _ in range(DRAWS)])
    apart = (drawn - poses.points).reshape(DRAWS, -1) - columns @ model.means(robot)
    return np.linalg.solve(np.linalg.cholesky(total), apart.T).T


def assert_independent_of_variance_one(white: np.ndarray) -> None:
    """Second moments err by 1/√n, √2/√n on the diagonal: of some 200 none by 4.5 of these."""
    one = np.eye(white.shape[1])
    error = np.sqrt((1.0 + one) / len(white))
    assert np.abs((white.T @ white / len(white) - one) / error).max() < 4.5


@pytest.mark.parametrize("term", TERMS)
def test_draws_have_the_covariance_of_the_model(term: str) -> None:
    robot = mixed()
    q = random_configurations(robot, 2)[[0, 1, 1]]  # the second is visited twice
    white = whitened(robot, model_of(robot, TERMS[term]), q, 3)
    assert np.abs(white.mean(axis=0) * np.sqrt(DRAWS)).max() < 4.5
    assert_independent_of_variance_one(white)


def test_noise_of_the_instrument_goes_by_direction() -> None:
    robot, known = ur10e(), typical(FAR, estimate_scale=True)
    model = replace(known, placement=tight(robot), points=replace(known.points, floor=False))
    model = model.with_values({k: v for k, v in TINY.items() if k != "floor"} | {"instrument": 2.0})
    assert_independent_of_variance_one(whitened(robot, model, random_configurations(robot, 2), 4))


def test_a_visit_moves_all_joints_and_targets_at_once() -> None:
    robot = mixed()
    truth = Truth.draw(robot, model_of(robot, ALL), np.random.default_rng(1))
    q, rng = random_configurations(robot, 4), np.random.default_rng(2)
    visits = truth.draw_visits(4, rng)
    moved = truth.positions(q, visits) - visits.points
    np.testing.assert_array_equal(truth.actual(q, visits), truth.actual(q) + visits.joints * joint_units(robot))
    np.testing.assert_array_equal(moved, truth.robot.positions(truth.actual(q, visits)))
    # Without visits only the floor is left, and its draws are the same.
    still = replace(truth, model=truth.model.without("visits")).draw_visits(4, np.random.default_rng(2))
    assert not still.joints.any()
    shift = visits.points - still.points
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :1], shift.shape), atol=1e-18)
    assert np.abs(shift).min() > 0.0


def test_the_same_seed_is_the_same_robot() -> None:
    robot = ur10e()
    one, same, other = (Truth.draw(robot, typical(), np.random.default_rng(seed)) for seed in (1, 1, 2))
    q = random_configurations(robot, 3)
    np.testing.assert_array_equal(one.positions(q), same.positions(q))
    assert np.abs(one.positions(q) - other.positions(q)).min() > 0.0


def test_deviations_are_stated_or_drawn_and_flat_ones_stay_nominal() -> None:
    robot = ur10e().with_parameters("full", ("base", "tool"))
    names = robot.parameter_names
    drawn = Truth.draw(robot, typical(), np.random.default_rng(1))
    off = dict(zip(names, drawn.coefficients.tolist(), strict=False))
    assert all((off[n] == 0.0) == n.startswith(("base.", "target_")) for n in names)
    for p, q in zip(robot.parameters, drawn.robot.parameters, strict=True):
        assert q.nominal - p.nominal == pytest.approx(off[p.name], abs=1e-15)
    some = robot.with_parameters([names[8], names[9]])
    stated = {names[8]: 1e-3, names[3]: 2e-3}
    truth = Truth.draw(some, typical(), np.random.default_rng(1), stated)
    assert truth.robot.parameter_names == (names[8], names[9], names[3])
    np.testing.assert_array_equal(truth.coefficients[:3], [1e-3, 0.0, 2e-3])
    q = random_configurations(robot, 3)
    np.testing.assert_array_equal(truth.robot.positions(q), some.with_deviations(stated).positions(q))
    assert np.abs(truth.actual(q) - q).max() > 1e-5


def test_drawn_scales_have_their_spread() -> None:
    model = typical(estimate_scale=True)
    rng = np.random.default_rng(5)
    drawn = [model.with_drawn_scales(rng).values for _ in range(2000)]
    for scale in model.scales:
        logs = np.log([d[scale.name] for d in drawn]) - np.log(scale.median)
        wide = np.log(scale.factor)
        assert abs(logs.mean()) < 4.0 * wide / np.sqrt(2000)
        assert logs.std() == pytest.approx(wide, rel=4.0 / np.sqrt(4000))
    # What is known stays, and so does what nothing is known of.
    fixed = replace(model, scales=tuple(replace(s, factor=1.0, value=2.0 * s.median) for s in model.scales))
    assert fixed.with_drawn_scales(rng).values == fixed.values
    assert ErrorModel.paper().with_drawn_scales(rng) == ErrorModel.paper()
    more = replace(fixed, scales=tuple(replace(s, factor=1e305) for s in fixed.scales))
    assert more.with_drawn_scales(rng).values == fixed.values


def test_the_papers_robot_is_its_geometry_and_noise() -> None:
    robot = Robot.load("kuka_kr270")
    truth = Truth.draw(robot, ErrorModel.paper(3e-5), np.random.default_rng(1), {"d1": 1e-3})
    q = random_configurations(robot, 5)
    true = robot.with_deviations({"d1": 1e-3}).positions(q)
    np.testing.assert_array_equal(truth.positions(q), true)
    visits = truth.draw_visits(5, np.random.default_rng(1))
    assert not visits.joints.any() and not visits.points.any()
    standard = np.random.default_rng(2).standard_normal(true.shape)
    np.testing.assert_array_equal(truth.noise(true, standard), 3e-5 * standard)


@pytest.mark.parametrize("harmonics", [3, 90])
@pytest.mark.parametrize("paper", [True, False])
def test_a_series_comes_on_top_of_what_the_joints_do(paper: bool, harmonics: int) -> None:
    robot = mixed()
    model = ErrorModel.paper(3e-5) if paper else typical().with_noise(3e-5)
    truth = Truth.draw(robot, model, np.random.default_rng(1), {})
    series = 1e-4 * np.random.default_rng(2).standard_normal((4, 2, harmonics))
    more = truth.with_joint_functions(series, 1e-4)
    q = random_configurations(robot, 6)
    low, high = robot.joint_limits.T
    x = np.where(robot.joint_is_revolute, q, np.pi * (q - low) / (high - low))
    orders = np.arange(1, harmonics + 1)
    wanted = np.zeros(q.shape)
    for j in range(4):
        for n, (a, b) in enumerate(series[j].T):
            wanted[:, j] += a * np.cos(orders[n] * x[:, j]) + b * np.sin(orders[n] * x[:, j])
    off = more.actual(q) - truth.actual(q)
    np.testing.assert_allclose(off, wanted, atol=1e-14)
    assert more.model.gravity == truth.model.gravity and more.model.values.get("smooth.length") == 1.0
    if paper:  # what is true is known
        assert [(s.name, s.value, s.median, s.known) for s in more.model.scales] == [
            ("smooth.size", 1e-4, 1e-4, True),
            ("smooth.length", 1.0, 1.0, True),
        ]
    else:
        assert more.model.scales == truth.model.scales


def test_other_targets_keep_the_rest() -> None:
    robot = mixed().with_parameters("full", ("tool",))
    truth = Truth.draw(robot, typical(), np.random.default_rng(1))
    q = random_configurations(robot, 3)
    one = truth.with_targets(truth.robot.target_offsets[:1])
    np.testing.assert_allclose(one.positions(q), truth.positions(q)[:, :1], atol=1e-15)
    assert len(one.coefficients) == len(truth.coefficients) - 3


def test_the_payload_of_a_visit() -> None:
    robot = ur10e()
    gravity = Gravity(payload=Payload(4.0))
    model = replace(typical(), gravity=gravity, joint_functions=None)
    truth = Truth.draw(robot, model, np.random.default_rng(1), {})
    q = random_configurations(robot, 3)
    off = [truth.actual(q, payload=np.full(3, mass)) - truth.actual(q, payload=0.0) for mass in (2.0, 4.0)]
    assert off[0].any()
    np.testing.assert_allclose(off[0], 0.5 * off[1], atol=1e-15)
    np.testing.assert_array_equal(truth.actual(q), truth.actual(q, payload=4.0))


def test_sizes_are_what_the_terms_move_the_targets_by() -> None:
    robot = mixed()
    model = model_of(robot, ALL)
    truth = Truth.draw(robot, model, np.random.default_rng(1))
    q = random_configurations(robot, 40)
    told, points = truth.sizes(q), truth.positions(q)

    def rms(change: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.sum(change**2, axis=2))))

    assert set(told) == {"placement", "gravity", "smooth", "short", "visits", "points"}
    still = replace(truth, model=model.without("visits")).sizes(q)
    assert still == {name: size for name, size in told.items() if name != "visits"}
    placed = replace(truth, robot=robot).positions(q)
    assert told["placement"] == pytest.approx(rms(points - placed), rel=1e-3)
    moved = Truth.draw(robot, model, np.random.default_rng(1), {robot.parameter_names[0]: 1e-3, "base.x": 2.0})
    assert moved.sizes(q)["placement"] < 5e-3
    where = model.slices(robot)
    rigid = truth.coefficients.copy()
    rigid[where["gravity"]] = 0.0
    assert told["gravity"] == pytest.approx(
        rms(points - replace(truth, coefficients=rigid).positions(q)), rel=1e-3
    )
    # Smooth and short together are the joint functions: what they move is a sum.
    plain = truth.coefficients.copy()
    plain[where["joint_functions"]] = 0.0
    both = rms(points - replace(truth, coefficients=plain).positions(q))
    assert abs(told["smooth"] - told["short"]) < both * 1.001 and both < (told["smooth"] + told["short"]) * 1.001
    rng = np.random.default_rng(3)
    many = [truth.positions(q, truth.draw_visits(40, rng)) - points for _ in range(200)]
    scatter = np.hypot(told["visits"], told["points"])
    assert np.sqrt(np.mean([rms(m) ** 2 for m in many])) == pytest.approx(scatter, rel=0.03)
