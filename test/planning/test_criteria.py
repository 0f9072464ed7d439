# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Criteria and information: slopes and gradients against independent oracles, concavity, units, bounds."""

from __future__ import annotations

import numpy as np
import pytest
from robots import CASES, random_configurations

from calib_planner import PlanProblem
from calib_planner.error_model import Prior
from calib_planner.measurements import Measurements
from calib_planner.planning import CRITERIA, Feasibility, InformationModel, Search, plan_space
from calib_planner.planning.criteria import (
    Compound,
    Eliminating,
    WorstAccuracy,
    accuracy_weights,
    is_sharp,
    make_criterion,
    reported_value,
    sharpened,
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
    np.testing.assert_allclose(case.values(matrices), worth, rtol=1e-12)
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


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("name", [name for name in CRITERIA if name not in ("o2", "o4")])
def test_the_supporting_hyperplane_touches_at_its_matrix(name, unit):
    """tr(G M) = Ψ(M); where Ψ is a largest or smallest of several, the sharper its smooth form the closer."""
    made = criterion(name)
    for matrix in unit * random_matrices(4, 7):
        gradient = sharpened(made, 200.0).supporting_gradient(matrix)
        assert np.sum(gradient * matrix) == pytest.approx(made.exact(matrix), rel=1e-6)
        np.testing.assert_array_less(-1e-9 * np.abs(gradient).max(), np.linalg.eigvalsh(gradient))


def test_a_sharper_form_is_closer_to_the_exact_criterion():
    """By the factor of its exponent: the power mean of n values is off by log n / exponent at most, twice in O2,
    thrice in O4. Criteria that are smooth, and the worst of one pose, have no other form."""
    one = WorstAccuracy(accuracy_weights(np.random.default_rng(3).normal(size=(1, 3, SIZE))))
    assert not is_sharp(one) and sharpened(one, 4.0) is one
    within = Eliminating(criterion("e", 3), (0, 2, 4), (1, 3))
    matrices, exponents = random_matrices(6, 3), {"worst_pose": 64.0, "o2": 16.0, "o4": 32.0 / 3.0}
    for name, made in {**all_criteria(), "eliminating e": within}.items():
        assert is_sharp(made) == (name in ("worst_pose", "e", "o2", "o3", "o4", "eliminating e")), name
        near, exact = sharpened(made, 4.0), made.exact_values(matrices)
        if not is_sharp(made):
            np.testing.assert_allclose(near.value_and_gradient(matrices)[0], exact, rtol=1e-12)
            continue
        apart, less = (np.abs(np.log(m.value_and_gradient(matrices)[0] / exact)) for m in (made, near))
        assert (less < apart).all() and (less <= np.log(SIZE) / exponents.get(name, 32.0) + 1e-12).all(), name
        part = near.inner if name == "eliminating e" else near
        assert (part.sharpness == 64.0) if name == "worst_pose" else (part.power == 32.0)
        np.testing.assert_allclose(near.exact_values(matrices), exact, rtol=1e-12)


@pytest.mark.parametrize("noise", [Isotropic(2e-5), TRACKER], ids=["isotropic", "tracker"])
def test_information_is_the_jacobian_weighted_by_what_a_measurement_errs(noise):
    """Jᵀ (Σ/r + σ_c²)⁻¹ J with the whole matrix written out; r the same for all, or one of each configuration."""
    robot = CASES["mixed offsets"]()
    q = random_configurations(robot, 3, 2)
    for repetitions in (1, 4, np.array([1, 2, 5])):
        model = InformationModel(robot, noise, configuration_sigma=3e-5, repetitions=repetitions)
        expected = []
        for row, times in zip(q, np.broadcast_to(repetitions, 3), strict=True):
            whole = np.zeros((6, 6))
            for target, point in enumerate(robot.positions(row)[0]):
                own = slice(3 * target, 3 * target + 3)
                whole[own, own] = noise.covariance(point) / times + 9e-10 * np.eye(3)
            jacobian = robot.jacobian(row)[0]
            expected.append(jacobian.T @ np.linalg.inv(whole) @ jacobian)
        scale = np.abs(expected).max()
        rows = model.whitened(q)
        np.testing.assert_allclose(model.at(q), expected, rtol=0, atol=1e-10 * scale)
        np.testing.assert_allclose(np.swapaxes(rows, 1, 2) @ rows, expected, rtol=0, atol=1e-10 * scale)
        np.testing.assert_allclose(model.linearised(q).sums(1), expected, rtol=0, atol=1e-10 * scale)
        np.testing.assert_allclose(model.totals(q, 3)[0], np.sum(expected, axis=0), rtol=0, atol=1e-9 * scale)


def test_measurements_and_statements_beforehand_are_the_prior():
    """M_0 of the paper's model: what is stated, and Jᵀ (Σ + σ_c²)⁻¹ J of every point that was seen."""
    robot = CASES["kuka_kr270"]().with_targets([[0.0, 0.1, 0.05], [0.1, 0.0, 0.1]])
    q = random_configurations(robot, 6, 2)
    points = robot.positions(q).copy()
    points[2, 0] = points[4, 1] = np.nan
    problem = PlanProblem(
        robot,
        q[:1] / 3,
        8,
        noise=TRACKER,
        configuration_sigma=3e-5,
        prior=Prior(("q1", "d2"), [0.0, 0.0], [1e-4, 2e-4]),
        measured=Measurements(robot.joint_names, q, points),
    )
    space = plan_space(problem)
    names = space.robot.parameter_names
    expected = np.zeros((len(names), len(names)))
    for name, std in (("q1", 1e-4), ("d2", 2e-4)):
        expected[names.index(name), names.index(name)] = std**-2
    np.testing.assert_allclose(space.stated, expected, rtol=0, atol=1e-9 * expected.max())
    jacobian = space.robot.jacobian(q).reshape(6, 2, 3, -1)
    for visit, target in np.ndindex(6, 2):
        if not np.isnan(points[visit, target]).any():
            noise = TRACKER.covariance(points[visit, target]) + 9e-10 * np.eye(3)
            own = jacobian[visit, target]
            expected += own.T @ np.linalg.inv(noise) @ own
    np.testing.assert_allclose(space.prior, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_the_search_gives_accuracy_elsewhere_its_share():
    robot, matrix = CASES["kuka_kr270"](), None
    tests = random_configurations(robot, 2, 5) / 2
    for kind, share in (("test_pose", 0.3), ("test_pose", 0.0), ("worst_pose", 0.3), ("d", 0.3)):
        space = plan_space(PlanProblem(robot, tests, 8, criterion=kind, search=Search(general_weight=share)))
        size = len(space.prior)
        matrix = random_matrices(1, 4, size)[0] if matrix is None else matrix
        plain = space.criterion(kind).exact(matrix)
        if kind == "test_pose":
            general = np.trace(space.general @ np.linalg.inv(matrix))
            plain = 1.0 / ((1.0 - share) / plain + share * general)
        assert space.search_criterion().exact(matrix) == pytest.approx(plain, rel=1e-9)
