# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""(M2), (M3) and predictions: against the paper's formulas, brute force, and what they must be invariant to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import mixed, random_configurations

from calib_planner import Robot
from calib_planner.arrays import FloatArray
from calib_planner.error_model import (
    ErrorModel,
    Gravity,
    JointFunctions,
    Mass,
    Payload,
    Placement,
    Points,
    Prior,
    typical,
)
from calib_planner.error_model.knowledge import Knowledge, error_variance, prior_information
from calib_planner.error_model.knowledge import information as information_of
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.tracker import Isotropic, LaserTracker

SIGMA = 3e-5
TEST = np.array([0.0, -1.1, 1.5, 0.0, 0.8, 0.0])


def kr270(parameters: str = "lengths+offsets", unknown: tuple[str, ...] = ()) -> Robot:
    robot = Robot.load("kuka_kr270").with_targets([[0.0, 0.1, 0.05]])
    return robot.with_parameters(parameters, unknown)


def slim(prior: str = "tolerance") -> ErrorModel:
    """All terms, few harmonics: fast."""
    model = typical(Isotropic(SIGMA))
    return replace(model, placement=Placement(prior), joint_functions=JointFunctions(("smooth",), 5))


def poses_of(robot: Robot, count: int, seed: int) -> FloatArray:
    return random_configurations(robot, count, seed)


def test_the_papers_preset_is_eq_14() -> None:
    robot = kr270()
    q, model = poses_of(robot, 6, 1), ErrorModel.paper(SIGMA)
    j0 = robot.jacobian(TEST)[0]
    normal = sum(j.T @ j for j in robot.jacobian(q))
    expected = SIGMA * np.sqrt(np.trace(j0 @ np.linalg.inv(normal) @ j0.T))
    assert Knowledge.of_plan(robot, model, q).accuracy(TEST).value == pytest.approx(expected, rel=1e-9)
    four = Knowledge.of_plan(robot, model, q, repetitions=4).accuracy(TEST).value
    assert four == pytest.approx(expected / 2.0, rel=1e-9)


@pytest.mark.parametrize("kind", ["world", "robot"])
def test_equivalent_parameters_give_the_same_accuracy(kind: str) -> None:
    """The turn of the base about the first axis is the first joint's zero; both at once are one too many."""
    test, q = poses_of(kr270(), 5, 9), poses_of(kr270(), 14, 2)
    base = "base.x,base.y,base.z,base.rx,base.ry"
    values = []
    for names in (f"{base},base.rz,d1,d2,q2,q3", f"{base},q1,d1,d2,q2,q3", f"{base},q1,base.rz,d1,d2,q2,q3"):
        robot = kr270(names, ("tool",))
        values.append(Knowledge.of_plan(robot, slim("flat"), q).accuracy(test, kind).value)
    np.testing.assert_allclose(values, values[0], rtol=1e-6)


def test_the_order_of_the_parameters_changes_nothing() -> None:
    robot = mixed().with_parameters("full", ("base",))
    q, test = poses_of(robot, 20, 1), poses_of(robot, 6, 2)
    model = replace(slim("flat"), gravity=None)
    order = replace(robot, parameter_names=robot.parameter_names[::-1])
    for kind in ("world", "robot"):
        a, b = (Knowledge.of_plan(r, model, q).accuracy(test, kind) for r in (robot, order))
        np.testing.assert_allclose(a.per_pose, b.per_pose, rtol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_more_knowledge_never_raises_an_accuracy(seed: int) -> None:
    robot = kr270("full", ("base", "tool"))
    q, test, model = poses_of(robot, 16, seed), poses_of(robot, 6, 50 + seed), slim()
    stated = Placement(stated=Prior((robot.parameter_names[9],), [0.0], [1e-6]))
    more = {
        "start": Knowledge.of_plan(robot, model, q[:12]),
        "visits": Knowledge.of_plan(robot, model, q),
        "prior": Knowledge.of_plan(robot, replace(model, placement=stated), q[:12]),
        "repetitions": Knowledge.of_plan(robot, model, q[:12], repetitions=3),
        "smaller terms": Knowledge.of_plan(
            robot, model.with_values({"gravity": 1e-5, "smooth.size": 1e-6}), q[:12]
        ),
    }
    for kind in ("world", "robot"):
        values = {name: known.accuracy(test, kind).value for name, known in more.items()}
        assert all(v <= values["start"] * (1 + 1e-9) for v in values.values()), values
    assert more["start"].accuracy(test, "robot").value < more["start"].accuracy(test).value


@pytest.mark.parametrize("kind", ["world", "robot"])
def test_accuracy_is_what_draws_of_the_coefficients_do(kind: str) -> None:
    """Brute force through the kinematics; for ``robot`` each draw is moved back rigidly (Kabsch)."""
    robot = kr270("full", ("base", "tool"))
    q, test = poses_of(robot, 20, 3), poses_of(robot, 8, 4)
    known = Knowledge.of_plan(robot, slim(), q)
    values, vectors = np.linalg.eigh(known.covariance)
    half, rng = vectors * np.sqrt(np.maximum(values, 0.0)), np.random.default_rng(0)
    nominal, squares = known.poses(test).points.reshape(-1, 3), []
    for _ in range(300):
        drawn = replace(known, coefficients=0.05 * half @ rng.standard_normal(len(half)))  # small: linear
        points = drawn.poses(test).points.reshape(-1, 3)
        if kind == "robot":
            a, b = points - points.mean(axis=0), nominal - nominal.mean(axis=0)
            u, _, vt = np.linalg.svd(a.T @ b)
            turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
            points = a @ turn + nominal.mean(axis=0)
        squares.append(np.mean(np.sum((points - nominal) ** 2, axis=1)))
    assert 20.0 * np.sqrt(np.mean(squares)) == pytest.approx(known.accuracy(test, kind).value, rel=0.08)


def test_robot_accuracy_needs_test_poses_in_space() -> None:
    robot = kr270()
    known = Knowledge.of_plan(robot, slim(), poses_of(robot, 12, 0))
    with pytest.raises(InputError, match="at least 4"):
        known.accuracy(poses_of(robot, 3, 1), "robot")
    flat = np.tile(TEST, (6, 1))
    flat[:, 1] += np.linspace(0, 0.5, 6)  # the arm swings in one plane
    with pytest.raises(InputError, match="plane"):
        known.accuracy(flat, "robot")
    with pytest.raises(UnknownNameError, match="accuracy"):
        known.accuracy(TEST, "flange")


def test_what_nothing_shows_is_infinite_where_it_is_felt_and_nothing_elsewhere() -> None:
    robot = kr270("d2,q2", ("base",))
    model = ErrorModel.paper(SIGMA)
    one = Knowledge.of_plan(robot, model, np.tile(TEST, (2, 1)))
    assert one.hidden.shape[1] == 5
    assert np.isinf(one.accuracy(TEST + 0.3).value)
    assert one.accuracy(TEST).value == pytest.approx(SIGMA * np.sqrt(3 / 2), rel=1e-6)


def test_information_is_additive_and_weighted_by_the_visits_covariance() -> None:
    robot = Robot.load("ur10e").with_targets([[0.0, 0.05, 0.1], [0.08, -0.03, 0.05]])
    robot = robot.with_parameters("full", ("base",))
    model, q = (
        replace(slim(), points=Points(LaserTracker(station=np.array([3.0, 0.0, 1.0])))),
        poses_of(robot, 3, 0),
    )
    each = information_of(robot, model, q)
    known = Knowledge.of_plan(robot, model, q)
    poses = known.poses(q)
    columns, covariance = model.columns(poses), model.visit_covariance(poses)
    for i in range(3):
        expected = columns[i].T @ np.linalg.inv(covariance[i]) @ columns[i]
        np.testing.assert_allclose(each[i], expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    total = prior_information(robot, model) + each.sum(axis=0)
    assert np.abs(total @ known.covariance - np.eye(len(total)))[~np.isinf(model.variances(robot))].max() < 1e-3


def test_a_prediction_is_split_into_four_that_add_up() -> None:
    robot = Robot.load("ur10e").with_targets([[0.0, 0.05, 0.1], [0.08, -0.03, 0.05]])
    robot = robot.with_parameters("full", ("base", "tool"))
    model = slim().with_values({"repeatability": 1e-4, "shared": 2e-4})
    known, q = Knowledge.of_plan(robot, model, poses_of(robot, 25, 0)), poses_of(robot, 4, 1)
    told = known.predict(q)
    for part in (told.parameters, told.systematic, told.repeatability, told.noise):
        values = np.linalg.eigvalsh(part)
        assert values.min() > -1e-6 * values.max()
    poses = known.poses(q)
    columns = model.columns(poses)
    whole = columns @ known.covariance @ columns.transpose(0, 2, 1) + model.visit_covariance(poses)
    for t in range(2):
        block = whole[:, 3 * t : 3 * t + 3, 3 * t : 3 * t + 3]
        np.testing.assert_allclose(told.total[:, t], block, atol=1e-12)
    alone = replace(known, model=replace(model, gravity=None, joint_functions=None))
    exact = Knowledge.from_information(robot, alone.model, np.linalg.inv(known._parameters_alone))
    np.testing.assert_allclose(exact.predict(q).position, told.parameters, rtol=1e-5, atol=1e-14)


def test_a_few_more_points_are_as_good_as_if_they_had_been_there() -> None:
    robot = Robot.load("ur10e").with_targets([[0.0, 0.05, 0.1]]).with_parameters("full", ("base", "tool"))
    model, q = slim(), poses_of(robot, 20, 0)
    fewer, all_of_them = (Knowledge.of_plan(robot, model, q[:n]) for n in (17, 20))
    updated = fewer.updated(q[17:], robot.positions(q[17:]))
    np.testing.assert_allclose(updated.coefficients, 0.0, atol=1e-12)
    scale = np.sqrt(np.diag(all_of_them.covariance))
    apart = (updated.covariance - all_of_them.covariance) / np.outer(scale, scale)
    assert np.abs(apart).max() < 1e-4


def test_a_target_put_on_anew_is_found_from_one_point() -> None:
    robot = Robot.load("ur10e").with_targets([[0.0, 0.05, 0.1]]).with_parameters("full", ("base", "tool"))
    model, q = slim(), poses_of(robot, 30, 0)
    known = Knowledge.of_plan(robot, model, q)
    true = robot.with_targets([[0.12, -0.07, 0.2]])
    assert known.with_new_targets([[0.0, 0.0, 0.0]]).accuracy(q[:1]).value > 0.5
    found = known.with_new_targets([[0.0, 0.0, 0.0]]).updated(q[:1], true.positions(q[:1]))
    np.testing.assert_allclose(found.predict(q[1:9]).mean, true.positions(q[1:9]), atol=1e-5)
    assert found.accuracy(q[1:9]).value < 6 * known.accuracy(q[1:9]).value + 1e-4


def test_gravity_where_it_was_not_learnt_is_uncertain() -> None:
    robot = kr270("full", ("base", "tool"))
    heavy = replace(slim(), gravity=Gravity((Mass("arm"),), payload=Payload(5.0)))
    q = poses_of(robot, 20, 5)
    empty, full = np.zeros(len(q)), np.full(len(q), 5.0)
    unloaded = Knowledge.of_plan(robot, heavy, q, payload=empty)
    mixed_loads = Knowledge.of_plan(robot, heavy, q, payload=np.where(np.arange(len(q)) % 2, full, empty))
    test = poses_of(robot, 5, 6)
    loaded = [k.accuracy(test, payload=5.0).value for k in (unloaded, mixed_loads)]
    assert loaded[1] < 0.5 * loaded[0]
    assert unloaded.accuracy(test, payload=0.0).value < loaded[0]


def test_what_the_joints_read_is_the_inverse_of_where_they_stand() -> None:
    robot = kr270("full", ("base", "tool"))
    known = Knowledge.of_plan(robot, slim(), poses_of(robot, 20, 5))
    own = len(robot.parameter_names)
    drawn = np.random.default_rng(0).normal(0.0, 1e-3, len(known.coefficients))
    bent = replace(known, coefficients=np.where(np.arange(len(drawn)) < own, 0.0, drawn))
    wanted = poses_of(robot, 5, 6)
    q = bent.reading(wanted)
    assert np.abs(q - wanted).max() > 1e-4
    np.testing.assert_allclose(bent.actual(q), wanted, rtol=0.0, atol=2e-15)
    assert bent.reading(wanted[:0]).shape == (0, 6)


def test_a_payload_of_thrice_the_mass_bends_thrice_as_much_and_as_uncertainly() -> None:
    robot = kr270("d1,q2")
    model = replace(slim(), gravity=Gravity((Mass("arm"),), payload=Payload(5.0)))
    names, rng = model.names(robot), np.random.default_rng(0)
    half, hidden = rng.standard_normal((len(names), len(names))), rng.standard_normal((len(names), 2))
    known = Knowledge(robot, model, rng.standard_normal(len(names)), half @ half.T, hidden)
    heavy = known.carrying(Payload(15.0))
    factor = np.array([3.0 if name.startswith("gravity.payload.") else 1.0 for name in names])
    assert 1 < np.sum(factor > 1.0) < len(names) and heavy.model.names(robot) == names
    np.testing.assert_allclose(heavy.coefficients, factor * known.coefficients, rtol=1e-12)
    np.testing.assert_allclose(heavy.covariance, np.outer(factor, factor) * known.covariance, rtol=1e-12)
    np.testing.assert_allclose(heavy.hidden, factor[:, None] * hidden, rtol=1e-12)
    none = known.carrying(None)
    stays = [names.index(name) for name in none.model.names(robot)]
    assert len(stays) == np.sum(factor == 1.0)
    np.testing.assert_array_equal(none.coefficients, known.coefficients[stays])
    np.testing.assert_array_equal(none.hidden, hidden[stays])
    assert none.carrying(None) is none


def test_of_new_targets_nothing_is_known_and_of_the_rest_all_that_was() -> None:
    robot = kr270("d1,q2", ("base", "tool"))
    model = slim()
    names, rng = model.names(robot), np.random.default_rng(0)
    half, hidden = rng.standard_normal((len(names), len(names))), rng.standard_normal((len(names), 2))
    known = Knowledge(robot, model, rng.standard_normal(len(names)), half @ half.T, hidden)
    two = known.with_new_targets([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]])
    there = [names.index(name) for name in names if not name.startswith("target_")]
    after = list(two.model.names(two.robot))
    new = [f"target_{t}.{axis}" for t in (1, 2) for axis in "xyz"]
    assert sorted(after) == sorted([names[i] for i in there] + new)
    at, fresh = [after.index(names[i]) for i in there], [after.index(name) for name in new]
    np.testing.assert_array_equal(two.coefficients[at], known.coefficients[there])
    np.testing.assert_array_equal(two.covariance[np.ix_(at, at)], known.covariance[np.ix_(there, there)])
    np.testing.assert_array_equal(two.hidden[at], hidden[there])
    np.testing.assert_array_equal(two.covariance[fresh][:, at], 0.0)
    np.testing.assert_array_equal(two.covariance[np.ix_(fresh, fresh)], np.eye(6))  # a metre each way
    assert not two.coefficients[fresh].any() and not two.hidden[fresh].any()


def test_a_hidden_direction_is_felt_by_its_share_of_what_moves_most_in_any_unit() -> None:
    hidden, inverse = np.array([[0.0], [1.0]]), np.diag([4.0, 0.0])
    for unit in (1e-3, 1.0, 1e3):
        for share, felt in ((0.5e-6, False), (2e-6, True)):
            rows = unit * np.array([[1.0, 0.0], [0.5, share], [0.0, -share], [0.0, 0.0], [0.25, 0.0], [0.0, 0.0]])
            expected = np.inf if felt else unit**2 * 4.0 * (1.0 + 0.25 + 0.0625) / 2
            assert error_variance(rows, inverse, hidden) == pytest.approx(expected)


def test_a_test_pose_without_weight_does_not_count_even_if_nothing_is_known_there() -> None:
    robot = kr270("d2,q2", ("base",))
    one = Knowledge.of_plan(robot, ErrorModel.paper(SIGMA), np.tile(TEST, (2, 1)))
    both = one.accuracy([TEST, TEST + 0.3], weights=[2.0, 0.0])
    assert np.isinf(both.per_pose[1])
    assert both.value == pytest.approx(both.per_pose[0])


@pytest.mark.parametrize("excess", [0.0, 3e-13])
def test_parameters_alone_if_the_others_cannot_be_told_apart(excess: float) -> None:
    """Three coefficients of one value: they tell what one does, also if rounding makes them more than alike."""
    robot = kr270("d2")
    names = slim().names(robot)
    covariance = np.zeros((len(names), len(names)))
    covariance[0, 0], covariance[1:4, 1:4] = 1.0, 4.0
    covariance[1:4, 1:4] += 4.0 * excess * (1.0 - np.eye(3))
    covariance[0, 1:4] = covariance[1:4, 0] = 1.2 + np.array([1e-7, -1e-7, 0.0]) * (excess > 0.0)
    known = Knowledge(robot, slim(), np.zeros(len(names)), covariance, np.zeros((len(names), 0)))
    assert known._parameters_alone == pytest.approx(np.array([[1.0 - 1.2**2 / 4.0]]), rel=1e-6)


def test_points_that_were_not_seen_tell_nothing() -> None:
    """As if those coordinates had not been measured; the mean comes from the conditional normal distribution."""
    robot = Robot.load("ur10e").with_targets([[0.0, 0.05, 0.1], [0.08, -0.03, 0.05]])
    model, q = slim().with_values({"shared": 2e-5}), poses_of(robot, 15, 0)
    known = Knowledge.of_plan(robot, model, q[:13])
    seen, points = np.array([[True, False], [True, True]]), robot.positions(q[13:]).copy()
    points += 1e-5 * np.random.default_rng(0).standard_normal(points.shape)
    points[~seen] = np.nan
    told = known.updated(q[13:], points, seen, rounds=1)
    poses, use = known.poses(q[13:]), np.repeat(seen, 3, axis=1).ravel()
    rows = model.columns(poses).reshape(12, -1)[use]
    noise, each = np.zeros((12, 12)), model.visit_covariance(poses)
    noise[:6, :6], noise[6:, 6:] = each
    gain = known.covariance @ rows.T @ np.linalg.inv(rows @ known.covariance @ rows.T + noise[np.ix_(use, use)])
    expected = gain @ (points - poses.points).ravel()[use]
    scale = np.sqrt(np.maximum(np.diag(known.covariance), 0.0)) + 1e-300
    np.testing.assert_allclose(told.coefficients / scale, expected / scale, atol=1e-6)
    fewer = (known.covariance - gain @ rows @ known.covariance) / np.outer(scale, scale)
    np.testing.assert_allclose(told.covariance / np.outer(scale, scale), fewer, atol=1e-6)
