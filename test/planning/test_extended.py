# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Information under a whole error model: gradient, elimination, bound, and the plans that follow from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import mixed, random_configurations

from calib_planner import InfeasibleError, PlanProblem, Robot, plan
from calib_planner.error_model import (
    ErrorModel,
    Gravity,
    JointFunctions,
    Knowledge,
    Placement,
    Poses,
    Prior,
    covariance,
    error_variance,
    typical,
)
from calib_planner.error_model.knowledge import information, prior_information
from calib_planner.measurements import Measurements
from calib_planner.planning import (
    Candidates,
    Search,
    extended,
    plan_for_accuracy,
    plan_space,
    smallest_size,
    with_wide_placement,
)
from calib_planner.planning.bound import approximate_design
from calib_planner.planning.extended import UNCERTAIN, ExtendedModel
from calib_planner.planning.information import spread_spaces
from calib_planner.planning.planner import _design_problem, value_of
from calib_planner.planning.search.apart import APART, nearest, repelling
from calib_planner.planning.search.exchange import ChoiceProblem, _Chosen, _information, _Shared, choose
from calib_planner.robot import Coupling
from calib_planner.tracker import Isotropic, LaserTracker

POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])
TRACKER = LaserTracker(station=[3.0, 1.0, 0.0])
FEW = Search(starts=4)


def kuka(unknown: tuple[str, ...] = ()) -> Robot:
    return Robot.load("kuka_kr270").with_parameters("lengths+offsets", unknown)


def of(robot: Robot, model: ErrorModel, felt: int = 2) -> tuple[ExtendedModel, np.ndarray]:
    """A model, and eight configurations of which some are close to each other."""
    q = random_configurations(robot, 8, 1) / 2
    q[1], q[5] = q[0] + 0.05, q[4] - 0.03
    low, high = robot.joint_limits.T
    tests = random_configurations(robot, felt, 3) / 3
    return ExtendedModel.of(robot, model, tests, 2, 1e-5), np.clip(q, low + 0.01, high - 0.01)


CASES = {
    "kuka": (kuka(), typical(Isotropic(3e-5))),
    "slides, two targets, tracker": (mixed().with_parameters("full", ("base", "tool")), typical(TRACKER)),
    "coupled": (
        mixed()
        .with_parameters("full")
        .with_couplings((Coupling("nod", "turn", 0.25), Coupling("spin", "nod", -0.5))),
        typical(Isotropic(3e-5)),
    ),
    "no joint functions": (kuka(), replace(typical(TRACKER), joint_functions=None)),
    "gravity alone": (kuka(), replace(typical(TRACKER), joint_functions=None, visits=None)),
    "smooth": (
        kuka(),
        replace(typical(Isotropic(3e-5)), gravity=None, joint_functions=JointFunctions(("smooth",))),
    ),
}


@pytest.fixture(params=CASES, ids=str)
def case(request: pytest.FixtureRequest) -> tuple[Robot, ErrorModel]:
    return CASES[request.param]


def test_the_gradient_is_that_of_the_information(case: tuple[Robot, ErrorModel]) -> None:
    model, q = of(*case)
    draw = np.random.default_rng(0).standard_normal((2, model.size, model.size))
    weights = draw @ np.swapaxes(draw, 1, 2)
    seen = model.linearised(q[:4]).seen_from(np.array([1.0, 2.0, 1.0, 0.5]))[0].model
    seen = replace(seen, repetitions=np.arange(1, 9))
    for asked, size in ((model, 4), (seen, 1)):
        each = np.repeat(weights, 4 // size, axis=0)
        got, step, expected = asked.linearised(q).gradient(each), 1e-6, np.zeros(q.shape)
        for place in np.ndindex(*q.shape):
            moved = np.zeros(q.shape)
            moved[place] = step
            rise = asked.totals(q + moved, size) - asked.totals(q - moved, size)
            expected[place] = np.sum(rise * each) / (2 * step)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_errors_of_another_size_need_no_columns_of_their_own(case: tuple[Robot, ErrorModel]) -> None:
    """``scaled`` is the model with the scales multiplied; its sums and gradients come from those of the first."""
    model, q = of(*case)
    info, rng = model.linearised(q), np.random.default_rng(0)
    values = {n: 4 * v for n, v in case[1].values.items() if n in UNCERTAIN}
    apart = ExtendedModel.of(
        case[0], case[1].with_values(values), random_configurations(case[0], 2, 3) / 3, 2, 1e-5
    )
    large = replace(apart, basis=model.basis, maps=model.maps)  # the same U_l, whatever the sign of its columns
    np.testing.assert_allclose(abs(apart.basis), abs(model.basis), atol=1e-9)
    got, want = info.sums(4, 4.0), large.totals(q, 4)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 * np.abs(want).max())
    np.testing.assert_allclose(model.scaled(4.0).totals(q, 4), want, rtol=0, atol=1e-12 * np.abs(want).max())
    weights = np.repeat(random_weights(rng, model.size), 2, axis=0)
    both = info.gradient_of_sum([(1.0, weights), (4.0, 3 * weights)])
    expected = info.gradient(weights) + 3 * large.linearised(q).gradient(weights)
    np.testing.assert_allclose(both, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def random_weights(rng: np.random.Generator, size: int) -> np.ndarray:
    """(1, size, size) positive semi-definite."""
    draw = rng.standard_normal((1, size, size))
    return draw @ np.swapaxes(draw, 1, 2)


@pytest.mark.skipif(extended._kernel is None, reason="the kernel is not built here")
@pytest.mark.parametrize("shape", [(1, 1, 3, 6), (5, 1, 6, 2), (1, 7, 3, 6), (3, 4, 9, 7)], ids=str)
def test_the_compiled_coupling_is_numpys(shape: tuple[int, int, int, int]) -> None:
    runs, size, rows, joints = shape
    rng = np.random.default_rng(0)
    levers, half = rng.standard_normal((runs * size, rows, joints)), rng.standard_normal((joints, runs, size, 5))
    kernels, changes = half @ np.swapaxes(half, 2, 3), rng.standard_normal((joints, runs, size, size))
    whole = extended.couple(levers, kernels)
    expected = extended.couple_numpy(levers, kernels)
    np.testing.assert_allclose(whole, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    got = [np.ones(levers.shape), np.ones(levers.shape[::2])]
    want = [array.copy() for array in got]
    extended.couple_back(levers, kernels, changes, whole, *got)
    extended.couple_back_numpy(levers, kernels, changes, whole, *want)
    for one, other in zip(got, want, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * np.abs(other).max())
    for wrong in ((levers[:, :1], kernels, whole), (levers, kernels, whole[:, :1].copy()), (levers, kernels)):
        with pytest.raises((ValueError, BufferError)):
            extended._kernel.couple(*wrong)
    with pytest.raises(ValueError, match="fit"):
        extended._kernel.couple_back(levers, kernels, changes, whole, *got[::-1])


def test_visits_may_be_of_unequal_number(case: tuple[Robot, ErrorModel]) -> None:
    """r_i visits tell as much as r_i rows of the same configuration; σ_c alone is not averaged."""
    model, q = of(*case)
    model, counts = replace(model, configuration_sigma=0.0), np.array([3, 1, 2, 5, 1])
    unequal = replace(model, repetitions=counts).totals(q[:5], 5)
    rows = replace(model, repetitions=1).totals(np.repeat(q[:5], counts, axis=0), 12)
    np.testing.assert_allclose(unequal, rows, rtol=0, atol=1e-7 * np.abs(rows).max())


def test_what_is_eliminated_is_the_schur_complement(case: tuple[Robot, ErrorModel]) -> None:
    """The accuracy at the test poses is that of all coefficients together."""
    robot, error_model = case
    q, tests = of(robot, error_model)[1], random_configurations(robot, 2, 3) / 3
    problem = PlanProblem(robot, tests, len(q), repetitions=2, error_model=error_model)
    matrix = prior_information(robot, error_model) + 2 * information(robot, error_model, q).sum(axis=0)
    expected = Knowledge.from_information(robot, error_model, matrix).accuracy(tests).value
    assert value_of(problem, q) == pytest.approx(expected, rel=1e-6)
    space = plan_space(problem)
    inverse = covariance(space.model.totals(q, len(q))[0] + space.prior)
    per_pose = [np.sqrt(error_variance(rows, *inverse)) for rows in space.test_jacobians]
    np.testing.assert_allclose(
        per_pose, Knowledge.of_plan(robot, error_model, q, repetitions=2).accuracy(tests).per_pose
    )


def test_one_more_configuration_adds_what_is_said(case: tuple[Robot, ErrorModel]) -> None:
    model, q = of(*case)
    others, new = model.linearised(q[:5]), model.linearised(q[5:])
    before = model.totals(q[:5], 5)[0]
    for row, added in zip(q[5:], new.given(others), strict=True):
        after = model.totals(np.vstack([q[:5], row]), 6)[0]
        np.testing.assert_allclose(before + added.T @ added, after, rtol=0, atol=1e-9 * np.abs(after).max())


def test_the_model_seen_from_a_design_has_the_same_information(case: tuple[Robot, ErrorModel]) -> None:
    model, q = of(*case)
    seen, extra = model.linearised(q).seen_from(np.ones(len(q)))
    total, whole = extra + seen.model.at(q).sum(axis=0), model.totals(q, len(q))[0]
    np.testing.assert_allclose(total, whole, rtol=0, atol=1e-9 * np.abs(whole).max())


def test_moments_change_with_the_joints_as_said() -> None:
    for robot in (Robot.load("ur10e"), mixed()):
        q, gravity, step = random_configurations(robot, 5), Gravity(), 1e-6
        got = gravity.moment_gradients(Poses(robot, q))
        moved = [(Poses(robot, q + step * e), Poses(robot, q - step * e)) for e in np.eye(q.shape[1])]
        expected = [(gravity.moments(a) - gravity.moments(b)) / (2 * step) for a, b in moved]
        np.testing.assert_allclose(got, np.stack(expected, axis=-1), atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_information_is_concave_in_the_design(seed: int) -> None:
    """(B) at any design bounds the criterion of any plan, clusters and repetitions among them."""
    problem = PlanProblem(kuka(), POSE, 6, error_model=typical(Isotropic(3e-5)))
    space, rng = plan_space(problem), np.random.default_rng(seed)
    criterion, model = space.search_criterion(), space.single
    assert isinstance(model, ExtendedModel)
    at = random_configurations(kuka(), 7, seed)
    seen, extra = model.linearised(at).seen_from(rng.uniform(0.2, 2.0, len(at)))
    counts = rng.uniform(0.2, 2.0, len(at))
    seen, extra = model.linearised(at).seen_from(counts)
    matrix = space.prior + extra + np.einsum("k,kij->ij", counts, seen.sums(1))
    gradient = criterion.supporting_gradient(matrix)
    assert np.sum(gradient * matrix) == pytest.approx(criterion.exact(matrix), rel=1e-9)
    for spread in (0.0, 0.02, 0.3, 3.0):
        q = POSE + spread * rng.standard_normal((6, 6))
        reached = criterion.exact(model.totals(q, 6)[0] + space.prior)
        bound = np.sum(gradient * (space.prior + extra)) + np.sum(seen.model.at(q) * gradient)
        assert reached <= bound * (1 + 1e-9)


def test_the_bound_of_a_design_is_not_beaten() -> None:
    problem = PlanProblem(kuka(), POSE, 5, error_model=typical(Isotropic(3e-5)), search=FEW)
    space = plan_space(problem)
    design = approximate_design(
        _design_problem(space, space.criterion("test_pose")), POSE[None], np.random.default_rng(0)
    )
    for spread in (0.0, 0.01, 0.1):
        q = POSE + spread * np.random.default_rng(1).standard_normal((5, 6))
        assert value_of(problem, q) ** -2 <= design.bound * (1 + 1e-6)
    # The design that is best for one pose alone measures there: the gap is what its spread of 1e-4 costs, and the
    # gap at which its rounds end.
    assert value_of(problem, np.tile(POSE, (5, 1))) ** -2 == pytest.approx(design.bound, rel=0.05)


def test_stops_spread_by_themselves() -> None:
    """No two stops within the length of the joints' short functions; at the test pose itself there is one."""
    model = with_wide_placement(typical(Isotropic(3e-5)))
    found = plan(PlanProblem(kuka(("base", "tool")), POSE, 12, error_model=model, search=FEW))
    q = found.configurations
    apart = np.abs(q[:, None] - q[None]).max(axis=2) + 9.0 * np.eye(len(q))
    assert apart.min() > 2 * model.values["short.length"]
    assert nearest(kuka(), q) >= APART
    assert found.quality.status == "ok"
    assert found.quality.lower_bound <= found.quality.predicted_accuracy
    told = Knowledge.of_plan(kuka(("base", "tool")), model, q).accuracy(POSE[None]).value
    assert found.quality.predicted_accuracy == pytest.approx(told, rel=1e-6)
    assert {t.name for t in found.quality.terms} == {
        "placement",
        "gravity",
        "joint_functions",
        "visits",
        "points",
    }
    assert all(t.std < t.size for t in found.quality.terms if t.name in ("gravity", "joint_functions"))


def test_visits_that_are_near_push_each_other_away() -> None:
    """The cost of near pairs by central differences; copies that a turn parts count as near."""
    robot, rng = kuka(), np.random.default_rng(4)
    q = 0.03 * rng.standard_normal((2, 4, 6))
    q[0, 1] += 2 * np.pi * np.eye(6)[3]
    rows = q.reshape(2, -1)
    nothing = lambda x: (np.zeros(len(x)), np.zeros(x.shape))  # noqa: E731
    assert repelling(nothing, robot, 1) is nothing  # one visit is near no other
    cost = repelling(nothing, robot, 4)
    value, gradient = cost(rows)
    assert (value > 0).all()
    steps = 1e-6 * np.eye(24)
    differences = [(cost(rows + s)[0] - cost(rows - s)[0]) / 2e-6 for s in steps]
    np.testing.assert_allclose(gradient, np.transpose(differences), rtol=1e-6, atol=1e-6)
    far = np.concatenate([q, q + 1.0])[:, :1].reshape(1, 4, 6) + np.arange(4)[:, None]
    assert cost(far.reshape(1, -1))[0] == 0.0 and nearest(robot, far)[0] > APART


@pytest.mark.parametrize("criterion", ["test_pose", "d"])
@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_a_trial_exchange_has_the_value_that_the_whole_choice_has(factor: float, criterion: str) -> None:
    """Downdates of the inverse, (3) of ``exchange``, against the information of each choice by definition."""
    robot = kuka()
    q = random_configurations(robot, 12, 5)
    model = typical(Isotropic(3e-5))
    space = plan_space(PlanProblem(robot, POSE, 5, criterion=criterion, error_model=model, search=FEW))
    assert isinstance(space.model, ExtendedModel)
    info = space.model.linearised(q)
    request = ChoiceProblem(info.whitened, space.search_criterion(), space.prior, 5, together=info, factor=factor)
    rows, new = np.array([1, 4, 7, 8, 10]), np.array([0, 3, 11])
    shared = _Shared(info, 5)
    for position, row in enumerate(rows):
        shared.put(position, row)
    got = _Chosen(request, shared, rows).with_one_more(new, 2)
    for value, row in zip(got, new, strict=True):
        changed = np.where(np.arange(5) == 2, row, rows)
        matrix = space.model.scaled(factor).totals(q[changed], 5)[0]
        assert value == pytest.approx(np.log(request.criterion.exact(matrix + space.prior)), abs=1e-7)


@pytest.mark.parametrize("criterion", ["test_pose", "d"])
def test_candidates_are_exchanged_until_no_other_is_better(criterion: str) -> None:
    """Two thirds of the candidates are copies of the others but for 0.5°: they are not taken beside them."""
    robot, rng = kuka(), np.random.default_rng(0)
    first = random_configurations(robot, 10, 5)
    q = np.concatenate([first, first + 0.01, first - 0.01])
    low, high = robot.joint_limits.T
    q = np.clip(q, low, high)
    model = replace(typical(Isotropic(3e-5)), visits=None)
    problem = PlanProblem(
        robot, POSE, 5, criterion=criterion, error_model=model, candidates=Candidates(q), search=FEW
    )
    space = plan_space(problem)
    assert isinstance(space.model, ExtendedModel)
    request = ChoiceProblem(
        space.model.whitened(q), space.search_criterion(), space.prior, 5, together=space.model.linearised(q)
    )
    chosen = choose(request, rng)
    assert len({row % 10 for row in chosen.rows.tolist()}) == 5
    best = space.search_criterion().exact(_information(request, chosen.rows))
    for position in range(5):
        for other in range(len(q)):
            rows = chosen.rows.copy()
            rows[position] = other
            if len(set(rows.tolist())) == 5:
                assert space.search_criterion().exact(_information(request, rows)) <= best * (1 + 1e-3)
    found = plan(problem)
    assert found.quality.bound == "proven"  # the sensitivity of every candidate is known
    assert found.quality.efficiency <= 1.0


@pytest.mark.parametrize("robot", [kuka(), mixed()], ids=lambda robot: robot.name)
def test_waves_of_a_joint_change_with_it_as_said(robot: Robot) -> None:
    """A turn has cos nq and sin nq; a slide the same of its share of half a turn between its limits."""
    model, q = (
        ExtendedModel.of(robot, typical(), np.zeros((0, len(robot.joint_names)))),
        random_configurations(robot, 3),
    )
    values, rates = extended.joint_features(model, Poses(robot, q))
    sides = [extended.joint_features(model, Poses(robot, q + s))[0] for s in (1e-6, -1e-6)]
    expected = (sides[0] - sides[1]) / 2e-6
    np.testing.assert_allclose(rates, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    half = values.shape[2] // 2
    scales = model.wave_scales[:half]
    np.testing.assert_allclose(
        values[..., :half] ** 2 + values[..., half:] ** 2, np.broadcast_to(scales**2, values[..., :half].shape)
    )


def test_slow_waves_and_what_test_poses_feel_stay() -> None:
    """Three waves a turn, and a function for each of up to twelve test poses, as far as there are functions."""
    robot = kuka()
    poses = random_configurations(robot, 20, 3) / 3
    for harmonics, felt, stay in ((30, 0, 6), (30, 2, 8), (30, 20, 18), (4, 20, 8), (4, 1, 7), (2, 20, 4)):
        model = replace(typical(), joint_functions=JointFunctions(harmonics=harmonics))
        basis = ExtendedModel.of(robot, model, poses[:felt]).basis
        assert basis.shape == (6, 2 * harmonics, stay)
        unit = np.swapaxes(basis, 1, 2) @ basis
        np.testing.assert_allclose(unit, np.broadcast_to(np.eye(stay), unit.shape), atol=1e-9)
        slow = [k for k in range(2 * harmonics) if k % harmonics < 3]
        inside = basis @ np.swapaxes(basis, 1, 2)
        np.testing.assert_allclose(
            inside[:, slow], np.broadcast_to(np.eye(2 * harmonics)[slow], inside[:, slow].shape), atol=1e-9
        )


def test_the_floor_is_what_the_eliminated_functions_move_the_targets() -> None:
    """By the coefficients' own covariance σ² (I − U Uᵀ) σ; nothing at up to twelve test poses."""
    robot = mixed()
    model = replace(typical(), joint_functions=JointFunctions(harmonics=8))
    q = random_configurations(robot, 4, 2)
    extension = ExtendedModel.of(robot, model, q[:2])
    floor = extension.floor(q)
    np.testing.assert_allclose(floor[:2], 0.0, atol=1e-9 * floor.max())
    functions, expected = model.joint_functions, np.zeros(4)
    assert functions is not None
    columns = functions.columns(Poses(robot, q)).reshape(4, 6, 4, 16)
    std = np.sqrt(functions.variances(robot, model.values)).reshape(4, 16)
    for joint, basis in enumerate(extension.basis):
        rest = std[joint][:, None] * (np.eye(16) - basis @ basis.T) * std[joint]
        expected += np.einsum("nrf,fg,nrg->n", columns[:, :, joint], rest, columns[:, :, joint]) / 2.0
    np.testing.assert_allclose(floor, expected, atol=1e-9 * floor.max())


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_a_robot_that_errs_more_or_less_is_another_problem(factor: float) -> None:
    """Every part of the space of its sizes, with measurements beforehand, from those of the first."""
    robot, given = kuka(), typical(Isotropic(3e-5))
    q = random_configurations(robot, 6, 5) / 2
    points = robot.positions(q).copy()
    points[2] = np.nan
    problem = PlanProblem(
        robot, POSE, 6, error_model=given, measured=Measurements(robot.joint_names, q, points), repetitions=2
    )
    spread = dict(zip((0.25, 4.0), spread_spaces(plan_space(problem)), strict=True))[factor]
    values = {name: value * factor for name, value in given.values.items() if name in UNCERTAIN}
    whole = plan_space(replace(problem, error_model=given.with_values(values, name="stated")))
    assert spread_spaces(whole) == ()
    signs = np.sign(np.einsum("jfb,jfb->jb", spread.model.basis, whole.model.basis)).ravel()
    turn = np.concatenate([np.ones(len(whole.prior) - len(signs)), signs])  # of the columns of U_l

    def same(got: np.ndarray, want: np.ndarray) -> None:
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-6 * np.abs(want).max())

    same(spread.test_jacobians * turn, whole.test_jacobians)
    same(spread.test_floor, whole.test_floor)
    same(spread.general * np.outer(turn, turn), whole.general)
    same(spread.prior * np.outer(turn, turn), whole.prior)
    assert spread.general_floor == pytest.approx(whole.general_floor, rel=1e-6, abs=0.0)
    for one, other in ((spread.model, whole.model), (spread.single, whole.single)):
        same(one.totals(q, 6)[0] * np.outer(turn, turn), other.totals(q, 6)[0])


def test_measurements_beforehand_tell_what_all_visits_and_the_errors_of_their_joints_do() -> None:
    """Xᵀ V⁻¹ X with V of all points that were seen, run by run beyond sixty visits."""
    robot = kuka().with_targets([[0.0, 0.1, 0.05], [0.1, 0.0, 0.1]])
    q = random_configurations(robot, 62, 5) / 2
    points, seen = robot.positions(q).copy(), np.ones((62, 2), bool)
    seen[1, 0] = seen[3] = seen[61, 1] = False
    points[~seen] = np.nan
    problem = PlanProblem(
        robot, POSE, 6, error_model=typical(TRACKER), measured=Measurements(robot.joint_names, q, points)
    )
    space = plan_space(problem)
    assert isinstance(space.single, ExtendedModel)
    expected = np.eye(len(space.prior))
    expected[: len(space.stated), : len(space.stated)] = space.stated
    for part in (np.arange(60), np.arange(60, 62)):
        info = space.single.linearised(q[part])
        use = np.flatnonzero(np.repeat(seen[part].ravel(), 3))
        rows = info.jacobian.reshape(6 * len(part), -1)[use]
        whole = info.covariance(len(part))[0][use][:, use]
        expected += rows.T @ np.linalg.inv(whole) @ rows
    np.testing.assert_allclose(space.prior, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_prior_and_measurements_only_help() -> None:
    robot, model = kuka(("base", "tool")), typical(Isotropic(3e-5))
    q = random_configurations(robot, 12, 3)
    problem = PlanProblem(robot, POSE, 8, error_model=model)
    alone = value_of(problem, q[:8])
    stated = replace(problem, prior=Prior(("q1",), [0.0], [1e-5]))
    assert value_of(stated, q[:8]) <= alone * (1 + 1e-9)
    data = Measurements(robot.joint_names, q[8:], robot.positions(q[8:]))
    assert value_of(replace(problem, measured=data), q[:8]) < alone


def test_flat_parameters_need_as_many_configurations_as_before() -> None:
    model = replace(typical(Isotropic(3e-5)), placement=Placement("flat"))
    scales = tuple(s for s in model.scales if not s.name.startswith("placement."))
    with pytest.raises(InfeasibleError, match="at least 3"):
        plan(PlanProblem(kuka(), POSE, 2, error_model=replace(model, scales=scales)))


def test_a_plan_for_a_typical_robot_does_not_trust_one_size_of_its_errors() -> None:
    """It is better in the mean over smaller and larger errors than the plan that trusts the median alone."""
    given = typical(Isotropic(3e-5))
    worth = {}
    for name in ("typical", "taught"):
        problem = PlanProblem(kuka(), POSE, 6, error_model=replace(given, name=name), search=FEW)
        space, q = plan_space(problem), plan(problem).configurations
        spaces = (space, *spread_spaces(plan_space(replace(problem, error_model=given))))
        assert len(spaces) == 3 and len(spread_spaces(space)) == (2 if name == "typical" else 0)
        matrices = [s.model.totals(q, len(q))[0] + s.prior for s in spaces]
        worth[name] = np.mean(
            [np.log(s.search_criterion().exact(m)) for s, m in zip(spaces, matrices, strict=True)]
        )
    assert worth["typical"] > worth["taught"] - 1e-4


def test_an_accuracy_is_reached_by_as_many_configurations_as_there_is_to_identify() -> None:
    """One visit to the test pose would do, and would tell nothing of the robot."""
    problem = PlanProblem(
        kuka(), POSE, 1, error_model=replace(typical(Isotropic(3e-5)), name="taught"), search=FEW
    )
    assert smallest_size(problem) == smallest_size(replace(problem, error_model=None)) == 3
    split = plan_for_accuracy(problem, 4e-4)
    assert len(split.plan.configurations) == 3 and split.fewest == 0
