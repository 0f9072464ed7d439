# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The bound: no plan beats it, the proof is above everything that can be sampled, and it meets eq. (20)."""

from __future__ import annotations

import dataclasses
import itertools
import time

import numpy as np
import pytest
from robots import mixed, random_chain, random_configurations, repeats
from scipy.optimize import minimize

from calib_planner import InfeasibleError, PlanProblem, Robot, plan
from calib_planner.error_model import Prior
from calib_planner.planning import Candidates, MinimumHeight, Search, bound, plan_space, planner
from calib_planner.planning.bound import (
    DesignProblem,
    approximate_design,
    heights_of,
    maximise_sensitivity,
    maximised,
    raised,
)
from calib_planner.planning.certify import branch_and_bound
from calib_planner.planning.certify.bernstein import Axis, amplification, basis, first_boxes, halves
from calib_planner.planning.certify.branch_and_bound import maximise
from calib_planner.planning.certify.polynomial import polynomial, sensitivity, square_root
from calib_planner.planning.certify.prove import Proof, _scale, prove_bound, prove_maximum
from calib_planner.planning.criteria import Accuracy, Determinant, Eliminating, PowerMean
from calib_planner.planning.information import PlanSpace
from calib_planner.planning.search.descent import Descent
from calib_planner.planning.search.multistart import SearchProblem, search_chunk
from calib_planner.robot import Element
from calib_planner.tracker import LaserTracker

SLACK = 1e-9
TEST_POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])


# ── random problems ──────────────────────────────────────────────────────────────────────────────────


def random_problem(seed: int) -> PlanProblem:
    """A random chain with some test poses, a criterion and perhaps a prior."""
    robot, rng = random_chain(seed), np.random.default_rng(seed + 1)
    names = robot.parameter_names
    return PlanProblem(
        robot,
        random_configurations(robot, int(rng.integers(1, 4)), seed),
        len(names) + int(rng.integers(0, 3)),
        noise=float(rng.uniform(0.1, 1.0)),
        criterion=str(rng.choice(["test_pose", "test_pose", "worst_pose", "d", "a", "e", "d_star", "o5"])),
        configuration_sigma=float(rng.choice([0.0, 0.3])),
        repetitions=int(rng.integers(1, 3)),
        prior=Prior(names[:1], [0.0], [0.5]) if rng.random() < 0.3 else None,
        search=Search(general_weight=0.0, starts=4, seed=seed),
    )


def design_problem(space: PlanSpace) -> DesignProblem:
    criterion = space.criterion(space.problem.criterion)
    visits = space.problem.configurations
    return DesignProblem(space.model, criterion, space.prior, visits, space.feasibility)


def proven(problem: PlanProblem, rounds: int = 60):
    """The parts of a plan with a proven bound, not yet made into one."""
    space = plan_space(problem)
    asked = design_problem(space)
    rng = np.random.default_rng(problem.search.seed)
    design = approximate_design(asked, problem.test_pose_array, rng, rounds=rounds)
    return space, asked, design, *prove_bound(asked, design, rng)


def best_of_random_plans(space: PlanSpace, count: int, seed: int) -> float:
    """Largest Ψ among random plans, every one of them regular enough to be computed."""
    m = space.problem.configurations
    information = space.model.at(space.feasibility.sample(np.random.default_rng(seed), count * m))
    matrices = information.reshape(count, m, *information.shape[1:]).sum(axis=1) + space.prior
    regular = matrices[np.linalg.cond(matrices) < 1e12]
    criterion = space.criterion(space.problem.criterion)
    return max((criterion.exact(matrix) for matrix in regular), default=0.0)


def best_worth_of_search(space: PlanSpace, support: np.ndarray, weights: np.ndarray, seed: int) -> float:
    criterion, m = space.criterion(space.problem.criterion), space.problem.configurations
    search = SearchProblem(space.model, criterion, space.prior, m, space.feasibility, support, weights)
    found = search_chunk(search, 3, np.random.default_rng(seed))
    matrix = space.model.at(found.configurations).sum(axis=0) + space.prior
    return criterion.exact(matrix) if np.linalg.cond(matrix) < 1e12 else 0.0


# ── no plan beats its bound ──────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("block", repeats(range(2), range(10)))
def test_no_plan_of_a_random_chain_beats_its_bound(block):
    """Forty random problems, with ``make prove`` two hundred (chains, parameters, criteria, priors)."""
    done = 0
    for seed in range(20 * block, 20 * block + 20):
        try:
            space = plan_space(random_problem(seed))
        except InfeasibleError:  # nothing to identify in this draw
            continue
        asked, tests = design_problem(space), space.problem.test_pose_array
        design = approximate_design(asked, tests, np.random.default_rng(seed), rounds=4)
        proof = prove_maximum(space.model, asked.criterion, design.gradient, design.support)
        assert proof.status == "proven"
        assert proof.tolerance <= 1.1e-4
        ceiling = proof.ceiling(space.prior, asked.visits) * (1 + SLACK)
        assert design.value <= ceiling
        assert best_of_random_plans(space, 40, seed) <= ceiling
        assert best_worth_of_search(space, design.support, design.weights, seed) <= ceiling
        done += 1
    assert done >= 15


PLANAR = list(itertools.product(["l1,l2", "dq1,dq2"], [2, 3, 5], [3, 41, 77, 118, 150, 178]))


@pytest.mark.parametrize(("pair", "m", "degrees"), PLANAR)
def test_proven_bound_of_the_two_link_arm_is_equation_20(pair, m, degrees):
    robot = Robot.load("planar_2r").with_parameters(pair)
    q0 = np.radians([17.0 * m, degrees])
    problem = PlanProblem(robot, q0, m, noise=1.0, search=Search(general_weight=0.0, starts=8))
    _, _, design, bounded, proof = proven(problem)
    best = (1 + abs(np.sin(q0[1]))) / m  # (20)
    assert proof.active in ((1,), ())  # at the optimum d is constant: (B) is an equality for every plan
    assert bounded.bound * best >= 1.0
    assert bounded.bound <= max(bounded.value, design.value) * (1 + 3.5e-3)
    assert bounded.bound * best <= 1.0 + 3.5e-3


def test_equation_20_to_the_tolerance_of_the_proof():
    """With the slope of the exact optimum nothing is left but the tolerance."""
    robot = Robot.load("planar_2r").with_parameters("l1,l2")
    for degrees, m in itertools.product([20, 65, 130], [2, 4]):
        q0 = np.radians([0.0, degrees])
        problem = PlanProblem(robot, q0, m, noise=1.0, search=Search(general_weight=0.0))
        space = plan_space(problem)
        asked = design_problem(space)
        angle = np.arccos((1 - abs(np.sin(q0[1]))) / np.cos(q0[1]))  # (19)
        matrix = 0.5 * m * space.model.at(np.array([[0.0, angle], [0.0, -angle]])).sum(axis=0)
        slope = asked.criterion.supporting_gradient(matrix)
        proof = prove_maximum(space.model, asked.criterion, slope, np.array([[0.0, angle]]), tolerance=1e-8)
        ceiling = proof.ceiling(space.prior, m)
        assert 1.0 - 1e-12 <= ceiling * (1 + abs(np.sin(q0[1]))) / m <= 1.0 + 1e-7


@pytest.mark.parametrize("seed", repeats(range(4), range(8)))
def test_no_plan_of_the_kuka_beats_its_bound(seed):
    """Random test poses: the plan searched for, and random ones."""
    robot = Robot.load("kuka_kr270")
    q0 = random_configurations(robot, 1, seed)
    m = (3, 4, 6, 12)[seed % 4]
    found = plan(PlanProblem(robot, q0, m, search=Search(starts=4, general_weight=0.0, seed=seed)), prove=True)
    assert found.quality.bound == "proven"
    assert "proven to" in found.quality.message
    assert found.quality.efficiency <= 1.0 + SLACK
    assert found.quality.lower_bound <= found.quality.predicted_accuracy * (1 + SLACK)
    space = plan_space(PlanProblem(robot, q0, m))
    assert best_of_random_plans(space, 300, seed) <= found.quality.lower_bound**-2 * (1 + SLACK)


# ── the proof itself ─────────────────────────────────────────────────────────────────────────────────


def proofs():
    robot = Robot.load("kuka_kr270")
    yield PlanProblem(robot, TEST_POSE, 4)
    yield PlanProblem(robot, random_configurations(robot, 3, 9), 6, criterion="worst_pose")
    yield PlanProblem(mixed().with_parameters("offsets"), np.zeros(4), 6)
    yield PlanProblem(random_chain(3), None, 12, criterion="d")


@pytest.mark.parametrize("problem", list(proofs()), ids=lambda p: f"{p.robot.name} {p.criterion}")
def test_proven_maximum_is_above_every_sample_and_every_polished_maximum(problem):
    space, asked, _, bounded, proof = proven(problem, rounds=10)
    q = random_configurations(space.robot, 100_000, 7)
    jacobian = np.ascontiguousarray(space.robot.jacobian(q))
    height = np.sum((jacobian @ square_root(bounded.gradient)) ** 2, axis=(1, 2)) / problem.instrument.typical**2
    assert height.max() <= proof.maximum_upper
    peaks = maximise_sensitivity(asked, bounded.gradient, q[np.argsort(-height)[:40]])
    assert np.exp(-peaks.value.min()) <= proof.maximum_upper * (1 + SLACK)
    assert proof.maximum_upper <= proof.largest_seen * (1 + 1.1e-4)
    at_found = np.sum(space.single.at(proof.where[None])[0] * proof.gradient)
    assert at_found == pytest.approx(proof.largest_seen, rel=1e-6)
    low, high = space.robot.joint_limits.T
    assert ((low - 1e-9 <= proof.where) & (proof.where <= high + 1e-9)).all()


def test_joints_without_effect_are_dropped_and_the_others_kept():
    space, _, _, bounded, proof = proven(PlanProblem(Robot.load("kuka_kr270"), TEST_POSE, 4))
    assert proof.active == (1, 2, 3, 4)
    d = polynomial(space.single, square_root(bounded.gradient))
    assert d.allowance < 1e-6 * proof.maximum_upper
    based = Robot.load("kuka_kr270").with_parameters("lengths", ("base",))
    assert 0 in proven(PlanProblem(based, TEST_POSE, 6), rounds=2)[4].active


def test_polynomial_is_the_sensitivity():
    space, _, _, bounded, _ = proven(PlanProblem(mixed(), np.zeros(4), 8), rounds=2)
    d = polynomial(space.single, square_root(bounded.gradient))
    q = random_configurations(space.robot, 50, 1)
    expected = np.einsum("nab,ab->n", space.single.at(q), bounded.gradient)
    for row, value in zip(q, expected, strict=True):
        got = d.tensor
        for k, axis in zip(d.active, d.axes, strict=True):
            got = np.tensordot(axis.harmonics(row[k : k + 1])[0], got, 1)
        assert got == pytest.approx(value, rel=1e-9)


EPS = np.finfo(float).eps


def test_the_allowance_is_for_every_operation_and_for_what_is_dropped():
    """Its parts from below: an eps for each factor and term, by as much as coefficients of boxes enlarge it."""
    for robot in (Robot.load("planar_2r"), mixed().with_parameters("offsets")):
        space = plan_space(PlanProblem(robot, np.zeros(len(robot.joint_names)), 8))
        root = np.random.default_rng(0).normal(size=(space.prior.shape[0], 3))
        root *= 30.0 / np.linalg.norm(root)
        q = random_configurations(robot, 10_000, 2)  # more than a block
        d, error = sensitivity(space.single, root, q)
        rows = space.single.whitened(q)
        np.testing.assert_allclose(d, np.sum((rows @ root) ** 2, axis=(1, 2)), rtol=1e-12)
        size = np.sqrt(np.sum(rows**2, axis=(1, 2)).max()) * 30.0
        steps = len(robot.elements) + 2 * len(root)
        assert 2 * np.sqrt(d.max()) * EPS * steps * size <= error <= 20 * np.sqrt(d.max()) * EPS * steps * size
        found = polynomial(space.single, root)
        axes = [
            Axis.of(*row, bool(t)) for row, t in zip(robot.joint_limits, robot.joint_is_revolute, strict=True)
        ]
        nodes = np.stack(np.meshgrid(*[a.nodes for a in axes], indexing="ij"), axis=-1).reshape(-1, len(axes))
        values, at_nodes = sensitivity(space.single, root, nodes)
        terms = np.abs(found.tensor).sum()
        # Five products and five sums for the harmonics along every axis, and for each of forty halvings of one.
        at_nodes += 10 * EPS * len(axes) * values.max()
        least = amplification(found.axes) * at_nodes + 10 * 40 * len(found.axes) * EPS * terms
        assert least <= found.allowance <= 1e-7 * d.max()


def test_a_joint_that_hardly_matters_is_dropped_and_allowed_for():
    """A third link of 2e-11 m: its joint does less than 1e-10 of the sensitivity, and more than rounding."""
    links = [
        e
        for k, x in enumerate((1.0, 0.8, 2e-11))
        for e in (Element("Rz", 0.0, k, 1.0, f"q{k}"), Element("Tx", x))
    ]
    robot = Robot("arm", tuple(links), (), ("a", "b", "c"), np.array([[-3.0, 3.0]] * 3))
    robot = robot.with_targets([[0.0, 0.0, 0.0]]).with_parameters("q0,q1")
    space = plan_space(PlanProblem(robot, [0.1, 0.2, 0.3], 4, noise=1.0))
    root = np.array([[1.0], [2.0]])
    found = polynomial(space.single, root)
    assert found.active == (1,)
    q = random_configurations(robot, 500, 4)
    away = np.abs(sensitivity(space.single, root, q)[0] - values_of(found.axes, found.tensor, q[:, [1]]))
    assert 1e-11 < away.max() <= found.allowance < 1e-8


@pytest.mark.parametrize("turns", [True, False])
@pytest.mark.parametrize("half", [0.01, 0.4, np.pi / 3, 1.5])
def test_bernstein_basis_is_a_weighting_and_halves_agree(turns, half):
    s = np.linspace(-half, half, 41)
    weights = basis(half, s, turns)
    assert (weights >= -1e-15).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-13)
    coefficients = np.random.default_rng(0).normal(size=weights.shape[1])
    for side, matrix in zip((-0.5, 0.5), halves(half, turns), strict=True):
        inner = np.linspace(-half / 2, half / 2, 11)
        expected = basis(half, inner + side * half, turns) @ coefficients
        np.testing.assert_allclose(basis(half / 2, inner, turns) @ matrix @ coefficients, expected, atol=1e-12)


def test_first_boxes_cover_the_axes_and_hold_the_polynomial():
    axes = (Axis.of(-4.0, 3.9, True), Axis.of(-0.2, 0.9, False), Axis.of(0.1, 0.8, True))
    assert (axes[0].low, axes[0].high) == (-np.pi, np.pi)
    tensor = np.random.default_rng(2).normal(size=(5, 3, 5))
    volume = 0.0
    for centre, form in first_boxes(axes, tensor):
        half = np.array([a.pieces[1] for a in axes])
        volume += np.prod(2 * half)
        for t in np.random.default_rng(3).uniform(centre - half, centre + half, (20, 3)):
            value, bern = tensor, form
            for k, axis in enumerate(axes):
                value = np.tensordot(axis.harmonics(t[k : k + 1])[0], value, 1)
                bern = np.tensordot(basis(half[k], t[k : k + 1] - centre[k], axis.turns)[0], bern, 1)
            assert bern == pytest.approx(value, abs=1e-11)
            assert form.min() - 1e-12 <= value <= form.max() + 1e-12
    assert volume == pytest.approx(np.prod([a.high - a.low for a in axes]))
    assert amplification(axes) >= 1.0


def test_what_is_proven_when_time_is_up_still_holds():
    rng = np.random.default_rng(4)
    axes = tuple(Axis.of(-np.pi, np.pi, True) for _ in range(3))
    wave = rng.normal(size=(5, 5, 5))
    wave[0, 0, 0] = 2.0 * np.abs(wave).sum()
    exact = maximise(axes, wave, 0.0, tolerance=1e-7)
    asked = itertools.count()
    early = maximise(axes, wave, 0.0, tolerance=1e-7, cancel=lambda: next(asked) > 2)
    assert early.late and not exact.late
    assert early.upper >= exact.largest
    assert exact.upper <= exact.largest * (1 + 1e-6)
    value = wave
    assert exact.where is not None
    for t, axis in zip(exact.where, axes, strict=True):
        value = np.tensordot(axis.harmonics(np.array([t]))[0], value, 1)
    assert value == pytest.approx(exact.largest, rel=1e-10)


@pytest.mark.skipif(branch_and_bound._bend is None, reason="the kernel is not built here")
@pytest.mark.parametrize("shape", [(1, 3), (4, 5, 3, 5), (2, 5, 5, 5, 3)], ids=str)
def test_compiled_bends_are_numpys(shape):
    """To the last digit; by hand, a form that is c x² along one axis has the second difference 2c there alone."""
    forms = np.random.default_rng(0).normal(size=shape)
    np.testing.assert_array_equal(branch_and_bound.bends(forms), branch_and_bound.bends_numpy(forms))
    squares = 3.0 * np.arange(shape[-1]) ** 2 * np.ones(shape)
    by_hand = np.broadcast_to([0.0] * (len(shape) - 2) + [6.0], (shape[0], len(shape) - 1))
    np.testing.assert_allclose(branch_and_bound.bends(squares), by_hand, atol=1e-12)
    for wrong in ((forms,), (forms, np.empty(shape[0])), (forms, np.empty((shape[0], 9)))):
        with pytest.raises(ValueError, match="fit"):
            branch_and_bound._bend(*wrong)


def values_of(axes, tensor, t):
    """(N,) of the polynomial at t (N, k), harmonic by harmonic."""
    values = np.broadcast_to(tensor, (len(t), *tensor.shape))
    for k, axis in enumerate(axes):
        values = np.einsum("na,na...->n...", axis.harmonics(t[:, k]), values)
    return values


SHAPES = {
    "turn": [(-3.0, 3.1, True)],
    "slide": [(-0.5, 0.9, False)],
    "narrow": [(0.2, 0.5, True), (2.0, 2.1, True)],
    "both": [(-2.5, 2.0, True), (0.3, 1.1, False)],
    "three": [(-1.0, 0.5, True), (-0.2, 0.2, False), (0.4, 3.0, True)],
}


def random_polynomial(shape, seed):
    axes = tuple(Axis.of(*limits) for limits in SHAPES[shape])
    tensor = np.random.default_rng(seed).normal(size=[5 if a.turns else 3 for a in axes])
    tensor.flat[0] = 1.1 * np.abs(tensor).sum()  # no harmonic is larger than one: nowhere negative
    return axes, tensor


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seed", range(2))
def test_the_maximum_of_a_polynomial_is_enclosed(shape, seed, monkeypatch):
    """By a fine grid, polished; also when boxes come singly or are too many for the memory."""
    axes, tensor = random_polynomial(shape, seed)
    low, high = (np.array([getattr(a, k) for a in axes]) for k in ("low", "high"))
    count = {1: 2001, 2: 101, 3: 31}[len(axes)]
    grid = np.meshgrid(*[np.linspace(a.low, a.high, count) for a in axes], indexing="ij")
    t = np.stack([g.ravel() for g in grid], axis=-1)
    values = values_of(axes, tensor, t)
    starts = t[np.argsort(-values)[:3]]
    bounds = list(zip(low, high, strict=True))
    ends = [
        minimize(lambda x: -values_of(axes, tensor, x[None])[0], x, bounds=bounds, options={"ftol": 1e-15}).x
        for x in starts
    ]
    top = max(values.max(), values_of(axes, tensor, np.clip(ends, low, high)).max())
    for tolerance in (1e-2, 1e-6):
        found = maximise(axes, tensor, 0.0, tolerance=tolerance)
        assert not found.late and found.boxes >= np.prod([len(a.pieces[0]) for a in axes])
        assert found.upper >= top * (1 - 1e-13)
        assert found.largest <= found.upper <= found.largest * (1 + tolerance) * (1 + 1e-13)
        assert found.largest <= top * (1 + 1e-9)
        assert ((low - 1e-12 <= found.where) & (found.where <= high + 1e-12)).all()
        assert values_of(axes, tensor, found.where[None])[0] == pytest.approx(found.largest, rel=1e-12)
    tiny = maximise(axes, 2.0**-40 * tensor, 0.0, tolerance=1e-6)  # a power of two: the same digits
    assert (tiny.upper, tiny.largest) == (2.0**-40 * found.upper, 2.0**-40 * found.largest)
    assert tiny.boxes == found.boxes and tiny.where.tolist() == found.where.tolist()
    known = maximise(axes, tensor, top, tolerance=1e-2)
    assert known.largest == top or known.largest == pytest.approx(top, rel=1e-9)
    assert known.boxes <= maximise(axes, tensor, 0.0, tolerance=1e-2).boxes
    with monkeypatch.context() as patched:
        patched.setattr(branch_and_bound, "CHUNK", 1)
        singly = maximise(axes, tensor, 0.0, tolerance=1e-6)
        assert singly.upper >= top * (1 - 1e-13) and singly.upper <= singly.largest * (1 + 1e-6) * (1 + 1e-13)
        patched.setattr(branch_and_bound, "MEMORY", 3 * tensor.size)
        crowded = maximise(axes, tensor, 0.0, tolerance=1e-6)
        assert crowded.upper >= top * (1 - 1e-13) and crowded.upper <= crowded.largest * (1 + 1e-6) * (1 + 1e-13)


def test_work_is_counted_in_coefficients_and_what_is_found_by_then_holds():
    axes, tensor = random_polynomial("three", 1)
    whole = maximise(axes, tensor, 0.0, tolerance=1e-6)
    first = int(np.prod([len(a.pieces[0]) for a in axes]))
    enough = maximise(axes, tensor, 0.0, tolerance=1e-6, most_work=whole.boxes * tensor.size)
    assert not enough.late and enough.boxes == whole.boxes
    for share in (0.0, 0.1, 0.5):
        most = share * whole.boxes * tensor.size
        early = maximise(axes, tensor, 0.0, tolerance=1e-6, most_work=most)
        assert early.late and early.upper >= whole.largest and first <= early.boxes <= whole.boxes
        assert share == 0.0 or early.boxes * tensor.size > most
        assert early.upper <= maximise(axes, tensor, 0.0, tolerance=1e-6, most_work=0).upper
    assert maximise(axes, tensor, 0.0, tolerance=1e-6, time_limit=0.0).late


def test_a_polynomial_without_joints_is_its_own_maximum_and_no_tolerance_ends_at_rounding():
    found = maximise((), np.array(2.5), 1.0, tolerance=1e-6)
    assert (found.upper, found.largest, found.boxes, found.late) == (2.5, 2.5, 1, False)
    known = maximise((), np.array(2.5), 3.0, tolerance=1e-6)
    assert (known.upper, known.largest, known.where) == (3.0, 3.0, None)
    axes, tensor = random_polynomial("turn", 0)
    exact = maximise(axes, tensor, 0.0, tolerance=0.0)
    assert not exact.late and exact.largest <= exact.upper <= exact.largest * (1 + 1e-14)


@pytest.mark.parametrize("seed", range(20))
def test_any_positive_slope_gives_a_bound(seed):
    """The closed forms of c: c Ψ(M) ≤ tr(G M), with equality at the M that G is the slope of."""
    rng = np.random.default_rng(seed)
    size = 5

    def positive():
        a = rng.normal(size=(size, size + 1))
        return a @ a.T

    weight = positive()
    padded = np.zeros((size, size))
    padded[:3, :3] = weight[:3, :3]
    criteria = [
        Accuracy(weight),
        Determinant(),
        PowerMean(8.0, smallest=True),
        Eliminating(Accuracy(weight[:3, :3]), (0, 1, 2), (3, 4)),
    ]
    for criterion in criteria:
        root = square_root(positive())
        scale = _scale(criterion, root)
        for _ in range(20):
            matrix = positive()
            assert scale * criterion.exact(matrix) <= np.sum(root @ root.T * matrix) * (1 + SLACK)
        matrix = positive()
        own = square_root(criterion.supporting_gradient(matrix))
        assert _scale(criterion, own) == pytest.approx(1.0, rel=1e-6)


def test_closed_forms_are_rounded_to_the_safe_side():
    """By hand, with numbers that binary digits hold: c no larger than exact, the ceiling no smaller."""
    root = np.diag([2.0, 2.0, 0.5, 0.5])
    exact = [
        (Determinant(), 4.0),  # det G = 2⁴ · 0.5⁴ = 1
        (PowerMean(8.0, smallest=True), 8.5),
        (Accuracy(np.diag([1.0, 4.0, 16.0, 64.0])), (2.0 + 4.0 + 2.0 + 4.0) ** 2),
    ]
    for criterion, value in exact:
        assert value * (1 - 1e-11) < _scale(criterion, root) < value
    assert _scale(Determinant(), root[:, :3]) == 1.0  # of a singular G: there is no closed form
    proof = Proof(0.25, 0.25, np.zeros(4), root @ root.T, 8.0, 1, (), 0.0, "proven")
    prior = np.diag([1.0, 2.0, 4.0, 8.0])  # tr G M₀ = 15
    for visits in (0, 4):
        value = (15.0 + 0.25 * visits) / 8.0
        assert value <= proof.ceiling(prior, visits) < value * (1 + 1e-11)
        assert proof.ceiling(np.zeros((4, 4)), visits) == 0.25 * visits / 8.0
    assert proof.tolerance == 0.0 and dataclasses.replace(proof, maximum_upper=0.275).tolerance == pytest.approx(
        0.1
    )
    assert dataclasses.replace(proof, largest_seen=0.0).tolerance == np.inf


def test_work_time_and_cancellation_end_a_proof_that_holds():
    problem = PlanProblem(Robot.load("kuka_kr270"), TEST_POSE, 4)
    space = plan_space(problem)
    asked, rng = design_problem(space), np.random.default_rng(0)
    design = approximate_design(asked, problem.test_pose_array, rng, rounds=2)
    began = time.perf_counter()
    whole = prove_maximum(space.model, asked.criterion, design.gradient, design.support, tolerance=1e-7)
    assert 0.0 < whole.seconds <= time.perf_counter() - began
    assert whole.status == "proven" and whole.holds
    assert whole.work == whole.boxes * 5 ** len(whole.active)  # five coefficients for every joint that turns
    for status, settings in [
        ("time_limit", {"time_limit": 0.0}),
        ("time_limit", {"cancel": lambda: True}),
        ("work", {"most_work": 1.0}),
    ]:
        early = prove_maximum(
            space.model, asked.criterion, design.gradient, design.support, tolerance=1e-7, **settings
        )
        assert early.status == status
        assert early.maximum_upper >= whole.largest_seen and early.boxes < whole.boxes
        assert early.largest_seen <= whole.maximum_upper
    timed, late = prove_bound(asked, design, rng, tolerance=1e-12, time_limit=0.0)
    assert late.status == "time_limit" and timed.bound >= whole.ceiling(space.prior, 4) * (1 - 1e-6)
    # Work that suffices by one coefficient, and that does not.
    just = prove_maximum(
        space.model, asked.criterion, design.gradient, design.support, tolerance=1e-7, most_work=whole.work
    )
    assert (just.status, just.work, just.maximum_upper) == ("proven", whole.work, whole.maximum_upper)


def test_a_proof_that_work_has_ended_is_taken_if_it_is_close():
    problem = PlanProblem(Robot.load("kuka_kr270"), TEST_POSE, 4)
    asked, rng = design_problem(plan_space(problem)), np.random.default_rng(0)
    design = approximate_design(asked, problem.test_pose_array, rng)
    _, whole = prove_bound(asked, design, np.random.default_rng(1))
    found, proof = prove_bound(asked, design, np.random.default_rng(1), tolerance=1e-9, most_work=whole.work)
    assert proof.status == "work" and proof.holds and proof.tolerance > 1e-9
    assert found.bound == proof.ceiling(asked.prior, asked.visits) <= 1.002 * max(design.bound, design.value)


@pytest.mark.parametrize(
    ("slides", "turns", "usual", "required"),
    [
        (0, 2, "proven", "proven"),
        (2, 4, "proven", "proven"),  # 5⁴ · 3² nodes
        (2, 5, "work", "time_limit"),  # 5⁵ · 3² are more than 5⁶
        (0, 7, "work", "time_limit"),
        (0, 9, "joints", "joints"),
    ],
)
def test_how_many_joints_a_proof_takes(slides, turns, usual, required):
    """Where none is required, as many nodes as six turning joints have; else as many as eight."""
    kinds = ["Tx", "Ty"][:slides] + ["Rz", "Ry", "Rx"] * 3
    links = [
        e
        for k in range(slides + turns)
        for e in (Element(kinds[k], 0.1, k), Element("Tz", 0.2, parameter=f"l{k}"))
    ]
    names = tuple(f"j{k}" for k in range(slides + turns))
    robot = Robot("arm", tuple(links), (), names, np.array([[-0.3, 0.3]] * len(names)))
    robot = robot.with_targets([[0.1, 0.0, 0.0]]).with_parameters("l1")
    space = plan_space(PlanProblem(robot, np.zeros(len(names)), 4, noise=1.0, search=Search(general_weight=0.0)))
    criterion, known = space.criterion("d"), np.zeros((1, len(names)))
    some = prove_maximum(space.model, criterion, np.eye(1), known, most_work=1e9)
    assert (some.status, some.holds) == (usual, usual == "proven")
    # A proof that is required begins; here it is called off.
    whole = prove_maximum(space.model, criterion, np.eye(1), known, cancel=lambda: required == "time_limit")
    assert (whole.status, whole.holds) == (required, required != "joints")


# ── what the planner makes of it ─────────────────────────────────────────────────────────────────────


def test_a_maximum_that_search_missed_is_found_and_repaired():
    """Handed a slope whose largest sensitivity is hidden from it, the proof is loose, then close again."""
    problem = PlanProblem(Robot.load("kuka_kr270"), TEST_POSE, 4)
    space = plan_space(problem)
    asked = design_problem(space)
    rng = np.random.default_rng(0)
    good = approximate_design(asked, problem.test_pose_array, rng)
    matrix = 4.0 * space.single.at(random_configurations(space.robot, 64, 3)).mean(axis=0)
    wrong = dataclasses.replace(good, gradient=asked.criterion.supporting_gradient(matrix))
    bounded, proof = prove_bound(asked, wrong, rng)
    assert proof.status == "proven"
    assert bounded.bound == pytest.approx(good.bound, rel=5e-3)
    # From a rough design, too, which grows to a good one on the way; constraints only add to what is proven.
    rough = approximate_design(asked, problem.test_pose_array, rng, rounds=1)
    rough = dataclasses.replace(rough, gradient=wrong.gradient)
    grown, _ = prove_bound(asked, rough, rng)
    assert 1.002 * rough.value < grown.value <= grown.bound == pytest.approx(good.bound, rel=5e-3)
    walls = dataclasses.replace(asked.feasibility, constraints=(MinimumHeight(-9.0),))
    walled, _ = prove_bound(dataclasses.replace(asked, feasibility=walls), rough, rng)
    assert walled.value == rough.value and walled.bound == pytest.approx(good.bound, rel=5e-3)


def test_noise_without_a_polynomial_stays_numerical_and_says_so():
    robot = Robot.load("planar_2r")
    noise = LaserTracker(station=[4.0, 0.0, 1.0])
    found = plan(PlanProblem(robot, [0.3, 0.5], 4, noise=noise, search=Search(starts=4)), prove=True)
    assert found.quality.bound == "numerical"
    assert "isotropic" in found.quality.message


def test_candidates_are_proven_by_looking_at_every_candidate():
    robot = Robot.load("kuka_kr270")
    pool = random_configurations(robot, 60, 2)
    found = plan(PlanProblem(robot, TEST_POSE, 5, candidates=Candidates(pool)), prove=True)
    assert found.quality.bound == "proven"
    assert "candidate" in found.quality.message
    assert found.quality.lower_bound <= found.quality.predicted_accuracy * (1 + SLACK)


def test_the_proof_over_candidates_is_the_largest_sensitivity_of_any():
    robot = Robot.load("kuka_kr270")
    pool = random_configurations(robot, 40, 2)
    prior = Prior(("d1",), [0.0], [1e-4])
    space = plan_space(PlanProblem(robot, TEST_POSE, 5, candidates=Candidates(pool), prior=prior))
    asked = dataclasses.replace(design_problem(space), candidates=pool)
    design = approximate_design(asked, pool, np.random.default_rng(0))
    same, proof = prove_bound(asked, design, np.random.default_rng(0))
    assert same is design and (proof.status, proof.boxes, proof.seconds) == ("candidates", 40, 0.0)
    heights = np.einsum("nab,ab->n", space.single.at(pool), design.gradient)
    assert proof.maximum_upper == proof.largest_seen == pytest.approx(heights.max(), rel=1e-9)
    assert proof.ceiling(asked.prior, 5) >= design.value
    assert any((proof.where == q).all() for q in pool)


def test_every_plan_tries_a_proof_and_says_what_it_is_worth():
    robot = Robot.load("kuka_kr270")
    found = plan(PlanProblem(robot, TEST_POSE, 12, search=Search(starts=4)))
    assert found.quality.bound == "proven"
    assert found.quality.bound_tolerance <= 1.1e-4
    assert "proven" in found.quality.message
    # A robot whose proof takes longer has a numerical bound, unless the proof is asked for.
    whole = PlanProblem(robot.with_parameters("lengths", ("base",)), TEST_POSE, 6, search=Search(starts=4))
    space = plan_space(whole)
    asked, rng = design_problem(space), np.random.default_rng(0)
    design = approximate_design(asked, whole.test_pose_array, rng)
    few, early = prove_bound(asked, design, rng, most_work=1e5)
    assert early.status == "work" and not early.holds
    assert few.bound == design.bound
    twice = [prove_bound(asked, design, np.random.default_rng(1), most_work=4e6) for _ in range(2)]
    assert twice[0][0].bound == twice[1][0].bound
    assert twice[0][1].boxes == twice[1][1].boxes


# ── repetitions, and bounds that a plan has beaten ───────────────────────────────────────────────────────


@pytest.mark.parametrize("model", ["paper", "tracker"])
def test_the_bound_is_for_the_repetitions_that_are_asked_for(model):
    """4 × 3 with an error of the configuration is a plan of four visits, as one with smaller noise is."""
    robot = Robot.load("kuka_kr270")
    sigma, own, r = 3e-5, 3e-5, 3
    noise = sigma if model == "paper" else LaserTracker(station=[6.0, 0.0, 1.0])
    fast = Search(starts=6)
    repeated = plan(
        PlanProblem(robot, TEST_POSE, 4, r, noise=noise, configuration_sigma=own, search=fast)
    ).quality
    assert repeated.efficiency > 0.97
    if model == "paper":
        alike = plan(PlanProblem(robot, TEST_POSE, 4, noise=np.sqrt(sigma**2 / r + own**2), search=fast)).quality
        assert repeated.value_bound == pytest.approx(alike.value_bound, rel=2e-3)
        assert repeated.predicted_accuracy == pytest.approx(alike.predicted_accuracy, rel=2e-3)


def test_repeated_configurations_never_tell_more_than_their_visits():
    """Two visits to one place whose error is that of the place tell less than the bound counts."""
    robot = Robot.load("kuka_kr270")
    model = plan_space(PlanProblem(robot, TEST_POSE, 4, 3, configuration_sigma=2e-5)).model
    together = dataclasses.replace(model, repetitions=2 * model.repetitions)
    q = random_configurations(robot, 20, 3)
    assert np.linalg.eigvalsh(2.0 * model.at(q) - together.at(q)).min() > -1e-6 * model.at(q).max()


def lazy(objective, start, low, high, **settings):
    """A descent that does not descend."""
    value, _ = objective(start)
    return Descent(start, value, len(start))


def tracker_problem(seed=0):
    noise = LaserTracker(station=[4.0, 0.0, 1.0])
    return PlanProblem(Robot.load("planar_2r"), [0.3, 0.5], 4, noise=noise, search=Search(starts=6, seed=seed))


def test_a_bound_that_a_plan_has_beaten_is_raised_from_that_plan(monkeypatch):
    """With a maximiser that fails, the numerical bound is too low; nobody hides it."""
    problem = tracker_problem()
    space = plan_space(problem)
    good = plan(problem).quality
    psi = good.predicted_accuracy**-2

    def too_low(asked, design, *rest):
        return dataclasses.replace(design, bound=0.9 * psi, missed=1e-4)

    monkeypatch.setattr(planner, "maximised", too_low)
    mended = plan(problem).quality
    assert "which was wrong and is now raised" in mended.message
    assert mended.bound == "numerical"
    assert mended.efficiency <= 1.0
    # What it is raised to is a maximum of d near the plan, not the plan's own value.
    assert mended.lower_bound == pytest.approx(good.lower_bound, rel=2e-3)
    # Even with a maximiser that does nothing, the heights at the plan's configurations are enough.
    monkeypatch.setattr(bound, "descend", lazy)
    asked, rng = design_problem(space), np.random.default_rng(0)
    design = dataclasses.replace(approximate_design(asked, problem.test_pose_array, rng, rounds=2), bound=0.0)
    q = plan(problem).configurations
    value = asked.criterion.exact(space.model.totals(q, 4)[0] + space.prior)
    assert raised(asked, design, q, rng).bound >= value * (1 - SLACK)


def test_a_proof_that_a_plan_has_beaten_is_no_bound(monkeypatch):
    """This cannot happen; if it does nevertheless, nothing is claimed."""

    def wrong(asked, design, *rest, **settings):
        proved, proof = prove_bound(asked, design, *rest, **settings)
        return dataclasses.replace(proved, bound=0.5 * proved.bound), proof

    monkeypatch.setattr(planner, "prove_bound", wrong)
    found = plan(PlanProblem(Robot.load("planar_2r"), [0.3, 0.5], 4, search=Search(starts=4))).quality
    assert found.bound == "none" and np.isnan(found.efficiency)
    assert "must not be" in found.message


def test_a_numerical_bound_is_maximised_until_more_starts_do_not_raise_it(monkeypatch):
    problem = tracker_problem()
    asked, rng = design_problem(plan_space(problem)), np.random.default_rng(0)
    with monkeypatch.context() as patched:
        patched.setattr(bound, "descend", lazy)
        rough = approximate_design(asked, problem.test_pose_array, rng, rounds=1)
        low = dataclasses.replace(rough, bound=0.5 * rough.bound)
    better = maximised(asked, low, rng, lambda: False)
    assert better.missed == bound.MAY_MISS
    q = random_configurations(problem.robot, 20_000, 5)
    top = heights_of(better, q).max()
    assert better.bound >= (better.ground + asked.visits * top) * (1 - SLACK)
    assert "raised the bound by less than 0.01 %" in plan(problem).quality.message
