# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Criteria and information: slopes and gradients against independent oracles, concavity, units, bounds."""

from __future__ import annotations

import numpy as np
import pytest
from robots import CASES, random_configurations

from calib_planner.planning import CRITERIA, Feasibility, InformationModel
from calib_planner.planning.criteria import (
    Compound,
    Eliminating,
    accuracy_weights,
    make_criterion,
    reported_value,
)
from calib_planner.planning.search.multistart import SearchProblem, plan_objective
from calib_planner.tracker import Isotropic, LaserTracker, covariance_gradient

SIZE = 5
TRACKER = LaserTracker(1e-5, 2e-6, 6e-6, 9e-6, station=[4.0, 1.0, 0.5], up=[0.1, 0.0, 1.0])


def random_matrices(count, seed=0, size=SIZE):
    root = np.random.default_rng(seed).normal(size=(count, size, size + 2))
    return root @ np.swapaxes(root, 1, 2)


def criterion(name, size=SIZE):
    tests = accuracy_weights(np.random.default_rng(3).normal(size=(3, 3, size)))
    return make_criterion(name, size, tests, [1.0, 2.0, 1.0])


def all_criteria():
    made = {name: criterion(name) for name in CRITERIA}
    made["compound"] = Compound((criterion("d"), criterion("test_pose")), (0.4, 0.6), (2.0, 0.5))
    made["eliminating d"] = Eliminating(criterion("d", 3), (0, 2, 4), (1, 3))
    made["eliminating test_pose"] = Eliminating(criterion("test_pose", 3), (0, 2, 4), (1, 3))
    return made


@pytest.fixture(params=sorted(all_criteria()))
def case(request):
    return all_criteria()[request.param]


def test_slope_against_central_differences(case):
    matrices, h = random_matrices(4), 1e-6
    worth, slope = case.value_and_gradient(matrices)
    direction = random_matrices(4, 9) - random_matrices(4, 8)
    up, down = (case.value_and_gradient(matrices + s * h * direction)[0] for s in (1, -1))
    np.testing.assert_allclose((slope * direction).sum(axis=(1, 2)), (up - down) / (2 * h), rtol=2e-6)
    assert (worth > 0).all()


def test_homogeneous(case):
    matrices = random_matrices(3)
    if not case.concave:
        pytest.skip("O2 and O4 are not information functions")
    np.testing.assert_allclose(
        case.value_and_gradient(7.0 * matrices)[0], 7.0 * case.value_and_gradient(matrices)[0], rtol=1e-10
    )


def test_more_information_is_never_worse(case):
    """Ψ(M + N) ≥ Ψ(M) for every N that is an information, and a mixture is worth at least the mean (concave)."""
    if not case.concave:
        pytest.skip("O2 and O4 are not information functions")
    some, more = random_matrices(40, 11), random_matrices(40, 12)
    one, other, both = (case.exact_values(m) for m in (some, more, some + more))
    assert (both >= (one + other) * (1 - 1e-12)).all()


def test_supporting_hyperplane_is_above_everywhere(case):
    """(B): Ψ(M*) ≤ tr(G M*), the inequality all bounds rest on, with the exact criterion."""
    if not case.concave:
        with pytest.raises(NotImplementedError):
            case.supporting_gradient(random_matrices(1)[0])
        return
    matrices = random_matrices(60, 5)
    for at in random_matrices(8, 6):
        slope = case.supporting_gradient(at)
        for matrix in matrices:
            assert case.exact(matrix) <= np.sum(slope * matrix) * (1 + 1e-9)


def test_known_values():
    matrix = np.diag([4.0, 1.0, 16.0, 9.0])
    values = {
        "d": (4 * 16 * 9) ** 0.25,
        "d_star": (4 * 16 * 9) ** 0.25,
        "a": 1 / 4 + 1 + 1 / 16 + 1 / 9,
        "e": 1.0,
        "o1": (2 * 1 * 4 * 3) ** 0.25 / np.sqrt(6),
        "o2": 1 / 4,
        "o3": 1.0,
        "o4": 1 / 4,
        "o5": 1 / (1 / 2 + 1 + 1 / 4 + 1 / 3),
    }
    for name, expected in values.items():
        got = reported_value(name, criterion(name, 4).exact(matrix), 4, 6)
        assert got == pytest.approx(expected), name


def test_units_of_parameters():
    """Test-pose accuracy does not depend on them; D changes by a constant, so the best plan does not."""
    matrices, scale = random_matrices(5), np.array([1.0, 1e3, 1.0, 57.3, 1e-2])
    scaled = matrices / np.outer(scale, scale)
    jacobians = np.random.default_rng(3).normal(size=(2, 3, SIZE))
    for name in ("test_pose", "worst_pose"):
        plain = make_criterion(name, SIZE, accuracy_weights(jacobians), [1, 1])
        other = make_criterion(name, SIZE, accuracy_weights(jacobians / scale), [1, 1])
        np.testing.assert_allclose(
            plain.value_and_gradient(matrices)[0], other.value_and_gradient(scaled)[0], rtol=1e-8
        )
    for name in ("d", "d_star", "o1"):
        ratio = criterion(name).value_and_gradient(scaled)[0] / criterion(name).value_and_gradient(matrices)[0]
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-8)


def test_elimination_is_the_block_of_the_covariance():
    matrix = random_matrices(1)[0]
    keep = [0, 2, 4]
    got = Eliminating(criterion("a", 3), (0, 2, 4), (1, 3)).exact(matrix)
    assert got == pytest.approx(3.0 / np.trace(np.linalg.inv(matrix)[np.ix_(keep, keep)]))


@pytest.mark.parametrize("noise", [Isotropic(2e-5), TRACKER], ids=["isotropic", "tracker"])
@pytest.mark.parametrize("name", ["planar_2r", "kuka_kr270", "mixed offsets"])
@pytest.mark.parametrize("kind", ["test_pose", "d", "o4"])
def test_gradient_in_the_joints(noise, name, kind):
    """−log Ψ of whole plans, with repetitions, σ_c and a prior, against central differences."""
    robot, size = CASES[name](), 5
    p = len(robot.parameter_names)
    tests = accuracy_weights(robot.jacobian(random_configurations(robot, 2, 5)))
    problem = SearchProblem(
        model=InformationModel(robot, noise, configuration_sigma=1e-5, repetitions=3),
        criterion=make_criterion(kind, p, tests, [1.0, 1.0]),
        prior=1e6 * np.eye(p),
        size=size,
        feasibility=Feasibility(robot),
        support=np.empty((0, len(robot.joint_names))),
        weights=np.empty(0),
    )
    objective = plan_objective(problem, size)
    rows = random_configurations(robot, 3 * size, 1).reshape(3, -1)
    gradient, h = objective(rows)[1], 1e-6
    for k in range(rows.shape[1]):
        step = h * np.eye(rows.shape[1])[k]
        expected = (objective(rows + step)[0] - objective(rows - step)[0]) / (2 * h)
        np.testing.assert_allclose(gradient[:, k], expected, rtol=1e-4, atol=1e-4)


def test_tracker_noise():
    """At 5 m along a level beam: range along the beam, angles across it."""
    tracker = LaserTracker(1e-5, 1e-6, 2e-6, 4e-6, station=[1.0, 0.0, 0.0])
    got = tracker.covariance(np.array([1.0, 5.0, 0.0]))
    np.testing.assert_allclose(got, np.diag([(1e-5) ** 2, (1.5e-5) ** 2, (2e-5) ** 2]), atol=1e-22)


def test_tracker_noise_is_what_its_angles_and_range_say():
    """Against sampling: perturb range, azimuth and elevation, look at the points."""
    rng = np.random.default_rng(0)
    point = np.array([2.0, -3.0, 1.5])
    d, az, el = np.linalg.norm(point), np.arctan2(-3.0, 2.0), np.arcsin(1.5 / np.linalg.norm(point))
    noise = LaserTracker(2e-4, 1e-5, 1e-4, 3e-4)
    r = d + rng.normal(0, 2e-4 + 1e-5 * d, 200_000)
    a, e = az + rng.normal(0, 1e-4, 200_000), el + rng.normal(0, 3e-4, 200_000)
    points = np.stack([r * np.cos(e) * np.cos(a), r * np.cos(e) * np.sin(a), r * np.sin(e)], axis=1)
    np.testing.assert_allclose(np.cov(points.T), noise.covariance(point), atol=0.02 * (3e-4 * d) ** 2)


def test_tracker_noise_gradient():
    points, h = np.random.default_rng(1).normal(size=(6, 3)) * 3, 1e-6
    got = covariance_gradient(TRACKER, points)
    for k in range(3):
        step = h * np.eye(3)[k]
        expected = (TRACKER.covariance(points + step) - TRACKER.covariance(points - step)) / (2 * h)
        np.testing.assert_allclose(got[..., k], expected, rtol=1e-4, atol=1e-16)
