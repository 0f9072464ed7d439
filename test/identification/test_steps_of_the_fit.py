# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The steps of a fit with the error model and of its update, each against its definition."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fits import problem_of, simulated, unknown, ur10e
from robots import random_configurations

from calib_planner import Measurements, Robot
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, JointFunctions, Payload, typical
from calib_planner.identification import estimation
from calib_planner.identification.estimation import (
    ModelEstimate,
    _common,
    _hidden,
    _placed,
    _some,
    _surprise,
    _with_payload,
    _without,
    _Work,
    fit_error_model,
    update_error_model,
)
from calib_planner.identification.left_out import left_out
from calib_planner.identification.likelihood import Solution, solve
from calib_planner.robot import rotation

SMALL = replace(typical(), joint_functions=JointFunctions(("smooth",), harmonics=4))
SIZES = {"gravity": 2e-3, "smooth.size": 3e-4, "repeatability": 5e-5, "shared": 3e-5}


@cache
def measured(count: int = 50, targets: int = 1) -> Measurements:
    """Of a UR10e that has all terms."""
    return simulated(ur10e(targets), SIZES, count, 3)[0]


def visits(*rows: int) -> Measurements:
    return measured().select(np.array(rows))


def changed(data: Measurements, change: FloatArray | float) -> Measurements:
    """Measured elsewhere by ``change`` [m]."""
    return Measurements(data.joint_names, data.q, data.p + change, data.std, data.payload)


@cache
def fit_of(count: int = 20) -> ModelEstimate:
    return fit_error_model(unknown(ur10e(1)), visits(*range(count)), SMALL)


# ── one step ─────────────────────────────────────────────────────────────────────────────────────────


def off_by(size: float, model: ErrorModel) -> _Work:
    """A robot whose zeros are off by so much [rad]."""
    robot = ur10e(1)
    zeros = [n for n in robot.parameter_names if n.endswith("joint.rz")]
    signs = np.random.default_rng(2).choice([-size, size], len(zeros))
    q = random_configurations(robot, 20, 2) / 3.0
    points = robot.with_deviations(dict(zip(zeros, signs, strict=True))).positions(q)
    return _Work(robot, Measurements(robot.joint_names, q, points), model)


def cost(work: _Work, solution: Solution, beta: FloatArray) -> float:
    """What least squares minimises: squares of the points under R, and of the coefficients under their priors."""
    poses = replace(work.state.model, joint_functions=None, gravity=None)
    assert poses.is_papers or not len(solution.problem.random) > len(work.robot.parameter_names)
    here = work.robot.with_deviations(dict(zip(work.robot.parameter_names, beta, strict=True)))
    apart = work.data.p - here.positions(work.data.q)
    squares = [
        a.ravel() @ np.linalg.solve(r, a.ravel()) for a, r in zip(apart, solution.problem.covariance, strict=True)
    ]
    variances = work.state.model.variances(work.robot)
    known = np.isfinite(variances)
    return float(np.sum(squares) + np.sum(beta[known] ** 2 / variances[known]))


PLACEMENT = replace(typical(), joint_functions=None, gravity=None)


@pytest.mark.parametrize("model", [PLACEMENT, ErrorModel.paper(1e-4)], ids=["tolerances", "paper"])
@pytest.mark.parametrize("size", [1e-6, 0.02, 0.9])
def test_a_step_is_as_long_as_the_robots_bend_allows(size: float, model: ErrorModel) -> None:
    """All of the way to the solution of the linear problem, or the first share of it that is no way up."""
    work, shares = off_by(size, model), []
    for _ in range(10):
        old = work.state.coefficients
        solution = solve(work.linearised())
        full = solution.coefficients.copy()
        full[solution.problem.random] -= old[solution.problem.random]
        rounds = work.rounds
        ended = work.accept(solution)
        step = work.state.coefficients - old
        share = float(step @ full / (full @ full))
        np.testing.assert_allclose(step, share * full, rtol=1e-9, atol=1e-15)
        shares.append(round(share, 6))
        before = cost(work, solution, old)
        for beta in (old, old + full):
            assert work._cost(solution.problem, beta) == pytest.approx(cost(work, solution, beta), rel=1e-9)
        moved = np.abs(solution.problem.columns @ full).max()
        if moved > 1e-4:
            tried = [1.0, 0.5, 0.25, 0.1, 0.03]
            good = [s for s in tried if cost(work, solution, old + s * full) <= before]
            assert shares[-1] == (good[0] if good else 0.0)
        else:
            assert shares[-1] == 1.0
        assert work.rounds == rounds + 1
        if ended:
            break
    assert (min(shares) < 1.0) == (size > 0.5)
    assert work.converged == ended == (size < 0.5)


@pytest.mark.parametrize("model", [PLACEMENT, ErrorModel.paper(1e-4)], ids=["tolerances", "paper"])
def test_where_predictions_stand_still_another_step_moves_none(model: ErrorModel) -> None:
    """By less than a thousandth of a point's standard deviation; with the paper's model by a millionth."""
    work = off_by(0.02, model)
    for _ in range(9):
        began = solve(work.linearised())
        assert not work.converged
        if work.accept(began):
            break
    before = work._poses(work.state.coefficients).points
    work.accept(solve(work.linearised()))
    moved = np.abs(work._poses(work.state.coefficients).points - before)
    std = np.sqrt(np.diagonal(began.problem.covariance, axis1=1, axis2=2)).reshape(moved.shape)
    assert work.converged and (moved < (1e-6 if model.is_papers else 1e-3) * std + 1e-8).all()


def test_what_linearisation_leaves_out_is_seen_where_it_is_more_than_a_thirtieth_of_a_points_error() -> None:
    """Against the residuals of the linear problem, y − columns · β."""
    work = off_by(0.0, PLACEMENT)
    noise = 1e-4 * np.random.default_rng(0).standard_normal(work.data.p.shape)
    noise[5] = np.nan  # not seen: what is apart there is nothing
    work.data = changed(work.data, noise)
    solution = solve(work.linearised())
    straight = solution.problem.y - solution.problem.columns @ solution.coefficients
    assert not work.apart(solution.coefficients)[5].any() and work.apart(solution.coefficients)[4].all()
    std = float(np.sqrt(solution.problem.covariance[0, 0, 0]))
    name = "shoulder_lift_joint.rz"
    at = work.robot.parameter_names.index(name)
    for turn, seen in ((0.0, False), (1.0, True)):
        beta = solution.coefficients + turn * np.eye(len(solution.coefficients))[at]
        work.state = replace(work.state, coefficients=beta)
        difference = work.bent(solution)
        assert (difference is not None) == seen
        if difference is not None:
            there = work.robot.with_deviations(dict(zip(work.robot.parameter_names, beta, strict=True)))
            apart = np.where(work.data.seen[:, :, None], work.data.p - there.positions(work.data.q), 0.0)
            expected = apart.reshape(straight.shape) - straight
            np.testing.assert_allclose(difference, expected, rtol=1e-6, atol=1e-9)
    # Shares of a standard deviation below and above the limit, as an error of the points' own.
    beta = solution.coefficients
    for share, seen in ((0.02, False), (0.04, True)):
        work.state = replace(work.state, coefficients=beta)
        base, exact = work._poses(beta).points, work.data
        work.data = Measurements(exact.joint_names, exact.q, base + straight.reshape(base.shape))
        assert work.bent(solution) is None
        points = np.array(work.data.p)
        points[4, 0, 1] += share * std
        work.data = Measurements(exact.joint_names, exact.q, points)
        assert (work.bent(solution) is not None) == seen


def test_a_doubted_point_may_bend_no_more_than_another() -> None:
    """What is added for its doubt is no error that it is expected to have."""
    work = off_by(0.0, PLACEMENT)
    doubt = np.zeros(work.data.seen.shape)
    doubt[4, 0] = 1.0
    work.state = replace(work.state, doubt=doubt)
    solution = solve(work.linearised())
    points = np.array(work.data.p)
    points[4, 0, 1] += 1e-4
    work.data = Measurements(work.data.joint_names, work.data.q, points)
    assert work.bent(solution) is not None


def test_scales_are_swollen_if_what_is_new_at_visits_and_points_is_ten_times_as_large_as_usual() -> None:
    model = typical()
    median = {s.name: s.median for s in model.scales}
    work = _Work(unknown(ur10e(2)), measured(10, 2), model)
    for name, times, swollen in (
        ("floor", 9.9, False),
        ("floor", 10.1, True),
        ("repeatability", 10.1, True),
        ("shared", 10.1, True),
        ("gravity", 100.0, False),
        ("placement.angle", 100.0, False),
    ):
        work.state = replace(work.state, model=model.with_values({name: times * median[name]}))
        assert work.swollen() == swollen


# ── doubts and terms ─────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(("size", "there"), [(0.02, True), (7e-4, True), (4e-5, False)])
def test_a_run_of_visits_that_is_shifted_by_what_matters_has_no_weight(size: float, there: bool) -> None:
    """Together its visits count less than a quarter of the shift in one point does."""
    change = np.zeros((50, 1, 3))
    change[6:10] = size * np.array([0.8, -0.6, 0.0])
    data = changed(measured(), change).select(np.arange(20))
    found = fit_error_model(unknown(ur10e(1)), data, SMALL)
    doubted = found.origin.shifted[:, 0] > 0.0
    np.testing.assert_array_equal(doubted, there & (np.arange(20) >= 6) & (np.arange(20) < 10))
    assert found.converged
    if there:
        own = np.median(np.diagonal(found.solution.problem.parts["floor"], axis1=1, axis2=2))
        assert (found.origin.shifted[6:10] > min(4.0 * size**2, 1e5 * own)).all()
        np.testing.assert_array_equal(found.doubt, found.origin.shifted)
        clean = fit_of().knowledge.predict(measured().q[20:]).mean
        told = found.knowledge.predict(measured().q[20:])
        std = np.sqrt(np.trace(told.position, axis1=2, axis2=3).mean() / 3.0)
        assert np.sqrt(np.mean((told.mean - clean) ** 2)) < 1.5 * std


def test_a_terms_gain_is_what_the_left_out_score_falls_by_without_it() -> None:
    robot, data = unknown(ur10e(1)), visits(*range(25))
    found = fit_error_model(robot, data, SMALL)
    gains = {t.name: t.gain for t in found.terms}
    whole = fit_error_model(robot, data, SMALL, choose=False).left_out.score
    for term in ("gravity", "smooth"):
        without = fit_error_model(robot, data, SMALL.without(term), choose=False).left_out.score
        assert gains[term] == pytest.approx(whole - without, rel=0.1, abs=0.3)
    assert gains["gravity"] > 3.0


def test_shares_of_progress_rise_from_none_to_nearly_all() -> None:
    told: list[float] = []
    robot, q = Robot.load("planar_2r"), random_configurations(Robot.load("planar_2r"), 6, 1)
    data = Measurements(robot.joint_names, q, robot.positions(q))
    fit_error_model(robot, data, PLACEMENT, watch=lambda share, text: told.append(share))
    assert told[0] == 0.0 and told == sorted(set(told)) and 0.8 < told[-1] < 1.0 and len(told) == 6


def test_the_linear_problem_without_a_term_is_that_of_the_model_without_it() -> None:
    problem = problem_of(6)
    for term in ("gravity", "smooth", "short"):
        smaller = _without(problem, term)
        assert smaller.model == problem.model.without(term)
        names = smaller.model.names(problem.robot)
        every = list(problem.model.names(problem.robot))
        assert smaller.columns.shape[2] == len(names) <= len(every)
        for k, name in enumerate(names):
            np.testing.assert_array_equal(smaller.columns[:, :, k], problem.columns[:, :, every.index(name)])


# ── the start, and some of many visits ───────────────────────────────────────────────────────────────


def test_base_and_targets_start_where_most_points_put_them() -> None:
    """A twentieth of a millimetre of noise; one point 29 medians away, one 31, one by metres."""
    robot = unknown(ur10e(1))
    real = ur10e(1).with_base(rotation(2, 1.0) @ rotation(0, 0.2), [1.0, -2.0, 0.3])
    q = random_configurations(real, 30, 4) / 3.0
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((30, 1, 3))
    noise = 5e-5 * direction / np.linalg.norm(direction, axis=2, keepdims=True)
    points = real.positions(q) + noise
    points[7] += 3.0
    placed, far, squares = _placed(robot, Measurements(robot.joint_names, q, points))
    lengths = np.linalg.norm(points - placed.positions(q), axis=2)
    np.testing.assert_allclose(squares, lengths**2, rtol=1e-9)
    assert np.abs(placed.positions(q) - real.positions(q)).max() < 1e-4
    assert np.argwhere(far > 0.0).tolist() == [[7, 0]] and far[7, 0] == pytest.approx(10.0 * squares[7, 0])
    for times, doubted in ((28.0, False), (33.0, True)):
        points[7] = real.positions(q)[7] + times * np.array([5e-5, 0.0, 0.0])
        assert (_placed(robot, Measurements(robot.joint_names, q, points))[1] > 0.0)[7, 0] == doubted
    known = ur10e(1)
    same, far, squares = _placed(known, Measurements(robot.joint_names, q, known.positions(q) + noise))
    assert same is known and not far.any()
    np.testing.assert_allclose(np.sqrt(squares), 5e-5, rtol=1e-6)


def test_the_heaviest_payload_of_the_data_bends_a_robot_of_which_none_is_known() -> None:
    data = visits(*range(6))
    loaded = replace(data, payload=np.array([0.0, 5.0, 2.0, 0.0, 0.0, 1.0]))
    assert SMALL.gravity is not None
    made = _with_payload(SMALL, loaded)
    assert made.gravity is not None and made.gravity.payload == Payload(5.0)
    assert _with_payload(SMALL, data) is SMALL
    assert _with_payload(SMALL, replace(data, payload=np.zeros(6))) is SMALL
    assert _with_payload(made, replace(data, payload=np.full(6, 7.0))) is made
    assert _with_payload(PLACEMENT, loaded) is PLACEMENT


def test_so_many_visits_as_hold_450_coordinates_decide_scales_and_terms() -> None:
    q = random_configurations(ur10e(2), 200, 1)
    points = ur10e(2).positions(q).copy()
    points[::3, 1] = np.nan
    points[5] = np.nan
    data = Measurements(ur10e(2).joint_names, q, points)
    some = _some(data)
    assert some is not None and (np.diff(some) > 0).all() and some[-1] > 150 and some[0] < 50
    size = 3 * data.seen[some].sum()
    assert 450 - 6 < size <= 450
    np.testing.assert_array_equal(some, _some(data))
    whole = Measurements(ur10e(2).joint_names, q, ur10e(2).positions(q))
    assert _some(whole.select(np.arange(75))) is None
    assert _some(whole.select(np.arange(76))) is not None


def test_visits_that_did_not_decide_the_scales_count_and_are_doubted_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(estimation, "ENOUGH", 60)
    robot, q = unknown(ur10e(1)), measured().q[40:]
    data = visits(*range(40))
    some = _some(data)
    assert some is not None and len(some) == 20
    inside, outside = int(some[4]), int(np.setdiff1d(np.arange(40), some)[5])
    change = np.zeros((40, 1, 3))
    change[[inside, outside], 0, 0] = 0.02
    part = fit_error_model(robot, data.select(some), SMALL)
    found = fit_error_model(robot, changed(data, change), SMALL)
    assert found.converged and found.left_out.residuals.shape == (40, 1, 3) and found.rounds > part.rounds
    assert sorted(np.flatnonzero(found.doubt[:, 0])) == sorted([inside, outside])
    assert found.origin.visits == 40 and not found.origin.shifted.any()
    clean = fit_error_model(robot, data, SMALL)
    told = clean.knowledge.predict(q)
    std = np.sqrt(np.trace(told.position, axis1=2, axis2=3).mean() / 3.0)
    assert np.sqrt(np.mean((found.knowledge.predict(q).mean - told.mean) ** 2)) < std
    assert std < 0.95 * np.sqrt(np.trace(part.knowledge.predict(q).position, axis1=2, axis2=3).mean() / 3.0)
    # A run that is shifted is so for those of its visits that did not take part, too.
    lost = int(np.setdiff1d(np.arange(30, 40), some)[-1])
    blind = np.full((40, 1, 3), 0.02 * (np.arange(40) >= 30)[:, None, None])
    blind[lost] = np.nan
    assert _some(changed(data, blind)).tolist() == some.tolist()  # type: ignore[union-attr]
    moved = fit_error_model(robot, changed(data, blind), SMALL)
    shifted = moved.origin.shifted[:, 0] > 0.0
    last, first = some[some < 30][-1], some[some >= 30][0]
    assert not shifted[: last + 1].any() and np.flatnonzero(~shifted[first:]).tolist() == [lost - first]
    np.testing.assert_array_equal(moved.doubt[first:, 0], moved.origin.shifted[first:, 0])
    assert not moved.doubt[: last + 1].any()
    plain = fit_error_model(robot, changed(data, change), SMALL, robust=False)
    assert not plain.doubt.any()


def test_hidden_directions_are_the_flat_ones_that_move_no_point() -> None:
    problem = problem_of(2, 1)
    hidden = _hidden(problem)
    rows = problem.columns.reshape(problem.y.size, -1)
    flat = problem.flat
    rank = np.linalg.matrix_rank(rows[:, flat] / np.linalg.norm(rows[:, flat], axis=0), tol=1e-7)
    assert hidden.shape == (rows.shape[1], len(flat) - rank) and rank == 6
    assert not np.delete(hidden, flat, axis=0).any()
    assert np.linalg.matrix_rank(hidden) == len(flat) - rank
    assert np.abs(rows @ hidden).max() < 1e-9 * np.abs(rows).max() * np.abs(hidden).max()
    assert _hidden(problem_of(8, 1)).shape[1] == 0


def test_the_surprise_is_what_visits_left_out_err_by_over_what_is_expected_of_them() -> None:
    """Squares under their covariance, visit by visit; configurations with a doubted point do not count."""
    problem = problem_of(9, 2)
    solution = solve(problem)
    left = left_out(solution)
    squares = [
        e.ravel() @ np.linalg.solve(c, e.ravel()) for e, c in zip(left.residuals, left.covariance, strict=True)
    ]
    assert _surprise(left) == pytest.approx(np.sum(squares) / 54.0, rel=1e-6)
    doubted = np.zeros_like(left.doubted)
    doubted[4, 1] = True
    assert _surprise(replace(left, doubted=doubted)) == pytest.approx(
        np.sum(np.delete(squares, 4)) / 48.0, rel=1e-6
    )
    assert _surprise(replace(left, doubted=np.ones_like(doubted))) == 1.0


# ── updates ──────────────────────────────────────────────────────────────────────────────────────────


def test_a_visit_is_known_by_all_that_was_measured_at_it() -> None:
    q, p = np.arange(10.0).reshape(5, 2), np.arange(15.0).reshape(5, 1, 3)
    p[2] = np.nan

    def of(rows: list[int], **more: FloatArray) -> Measurements:
        return Measurements(("a", "b"), q[rows], p[rows], **more)

    assert _common(of([0, 1, 2, 3]), of([3, 4, 2, 0])).tolist() == [3, -1, 2, 0]
    assert _common(of([1, 0, 1]), of([1, 1, 1, 0])).tolist() == [0, 2, -1, 1]  # each stands for one
    assert _common(of([0, 1]), changed(of([0, 1]), 1e-9)).tolist() == [-1, -1]
    std = np.full((2, 1, 3), 1e-4)
    assert _common(of([0, 1], std=std), of([1, 0], std=std)).tolist() == [1, 0]
    assert _common(of([0, 1], std=std), of([1, 0], std=2.0 * std)).tolist() == [-1, -1]
    assert _common(
        of([0, 1], payload=np.array([1.0, 2.0])), of([1, 0], payload=np.array([2.0, 2.0]))
    ).tolist() == [1, -1]


def brought_up(data: Measurements, **start: object) -> ModelEstimate | None:
    return update_error_model(unknown(ur10e(1)), data, SMALL, replace(fit_of(), **start))


def test_an_update_of_the_same_data_says_the_same() -> None:
    again = brought_up(visits(*range(20)))
    assert again is not None and again.converged and again.rounds >= 1
    np.testing.assert_allclose(again.knowledge.coefficients, fit_of().knowledge.coefficients, atol=1e-8)
    np.testing.assert_allclose(again.left_out.score, fit_of().left_out.score, rtol=1e-6)
    # Its columns are those of the fit: what nobody sees does not wander.
    np.testing.assert_array_equal(again.origin.linearised, fit_of().origin.linearised)
    more = brought_up(visits(*range(1, 23)))
    assert more is not None
    np.testing.assert_array_equal(more.origin.linearised, fit_of().origin.linearised)
    assert np.abs(more.origin.coefficients - fit_of().origin.coefficients).max() > 1e-9


@pytest.mark.parametrize(
    ("robot", "same"),
    [
        (lambda r: r.with_base(rotation(2, 0.5), [1.0, 2.0, 3.0]), True),  # it is unknown
        (lambda r: r.with_targets([[0.3, 0.2, 0.1]]), True),
        (
            lambda r: r.with_targets([[0.3, 0.2, 0.1], [0.0, 0.0, 0.1]]).with_parameters(
                "full", ("base", "tool")
            ),
            False,
        ),
        (lambda r: r.with_parameters("full"), False),
        (lambda r: r.with_parameters("lengths+offsets", ("base", "tool")), False),
        (lambda r: replace(r, joint_names=tuple(f"{n}_" for n in r.joint_names)), False),
        (lambda r: r.with_deviations({"elbow_joint.x": 1e-6}), False),
    ],
)
def test_an_update_is_of_the_same_robot(robot, same: bool) -> None:  # type: ignore[no-untyped-def]
    assert estimation._same_robot(robot(unknown(ur10e(1))), fit_of().solution.problem.robot) == same


def test_a_known_base_or_target_is_part_of_the_robot() -> None:
    robot = ur10e(1)
    for unknowns, base, tool in (((), False, False), (("base",), True, False), (("tool",), False, True)):
        one = robot.with_parameters("full", unknowns)
        assert estimation._same_robot(one, one)
        assert estimation._same_robot(one.with_base(rotation(2, 0.5), [1.0, 2.0, 3.0]), one) == base
        assert estimation._same_robot(one.with_targets([[0.3, 0.2, 0.1]]), one) == tool
        for axis in np.eye(3):
            assert estimation._same_robot(one.with_base(np.eye(3), 1e-3 * axis), one) == base


def test_an_update_is_made_of_an_estimate_that_stands_and_for_data_that_are_much_the_same() -> None:
    start, twenty = fit_of(), visits(*range(20))
    assert brought_up(twenty, converged=False) is None
    assert update_error_model(unknown(ur10e(1)), twenty, SMALL, start, robust=False) is None
    assert update_error_model(unknown(ur10e(1)), twenty, typical(), start) is None
    loaded = replace(twenty, payload=np.full(20, 3.0))
    assert brought_up(loaded) is None
    papers = fit_error_model(unknown(ur10e(1)), visits(*range(30)), ErrorModel.paper(1e-4))
    assert papers.converged
    assert update_error_model(unknown(ur10e(1)), visits(*range(30)), ErrorModel.paper(1e-4), papers) is None
    for data, quick in (
        (visits(*range(40)), True),  # twice as many
        (visits(*range(41)), False),
        (visits(*range(10), *range(20, 30)), True),  # half of them went
        (visits(*range(9), *range(20, 31)), False),
    ):
        assert (brought_up(data) is not None) == quick
    for factor, quick in ((1.24, True), (1.26, False), (1.0 / 1.24, True), (1.0 / 1.26, False)):
        origin = replace(start.origin, surprise=factor * _surprise(start.left_out))
        assert (brought_up(twenty, origin=origin) is not None) == quick


def test_a_visit_that_comes_behind_a_shifted_run_belongs_to_it() -> None:
    """Visits 14 … 19 are shifted; of three new ones one comes first, one before the run and one within it."""
    run = np.arange(50) >= 14
    data = changed(measured(), 0.02 * run[:, None, None])
    start = fit_error_model(unknown(ur10e(1)), data.select(np.arange(20)), SMALL)
    np.testing.assert_array_equal(start.origin.shifted[:, 0] > 0.0, run[:20])
    rows = np.r_[44, :5, 45, 5:18, 20, 18:20]
    points, q = np.array(data.p[rows]), data.q[rows]
    points[[0, 6]] = measured().p[[44, 45]]
    start = replace(start, origin=replace(start.origin, surprise=1.5))  # as if others had been as large
    now = update_error_model(unknown(ur10e(1)), Measurements(data.joint_names, q, points), SMALL, start)
    assert now is not None
    expected = np.arange(23) >= 16
    np.testing.assert_array_equal(now.origin.shifted[:, 0] > 0.0, expected)
    np.testing.assert_array_equal(now.doubt[:, 0] > 0.0, expected)
