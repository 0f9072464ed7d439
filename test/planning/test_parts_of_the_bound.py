# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The parts of the bound, each by itself: weights, measures and heights against closed forms and brute force."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, combinations_with_replacement

import numpy as np
import pytest
from robots import mixed, random_configurations
from scipy.optimize import brentq, minimize

from calib_planner import PlanProblem, Robot
from calib_planner.error_model import Prior, typical
from calib_planner.planning import Candidates, Search, bound, plan_space
from calib_planner.planning.bound import (
    ApproximateDesign,
    DesignProblem,
    approximate_design,
    candidate_design,
    continued,
    heights_of,
    maximise_sensitivity,
    maximised,
    raised,
)
from calib_planner.planning.criteria import Accuracy, Determinant
from calib_planner.planning.extended import ExtendedModel
from calib_planner.planning.information import PlanSpace
from calib_planner.planning.planner import _design_problem, psi_of
from calib_planner.planning.search.descent import Descent
from calib_planner.tracker import Isotropic, LaserTracker

PLAIN = Search(general_weight=0.0)


def two_link(degrees: float = 10.0, visits: int = 3, **changes: object) -> PlanSpace:
    """Lengths of the two-link arm, σ = 1: I(q) = [[1, c], [c, 1]] with c = cos q2."""
    robot = Robot.load("planar_2r").with_parameters("l1,l2")
    q0 = np.radians([20.0, degrees])
    return plan_space(PlanProblem(robot, q0, visits, noise=1.0, search=PLAIN, **changes))  # type: ignore[arg-type]


def request_of(space: PlanSpace) -> DesignProblem:
    return _design_problem(space, space.criterion(space.problem.criterion))


def made(value: float, bound: float, mark: float = 1.0) -> ApproximateDesign:
    """A design with numbers of its own."""
    return ApproximateDesign(value, bound, np.full(1, mark), mark * np.eye(2), np.full((1, 2), mark), ground=mark)


# ── weights ──────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("cap", [0.09, 0.12, 0.3, 1.0])
def test_weights_keep_their_ratios_below_a_cap(cap: float) -> None:
    """By bisection of the factor s in Σ min(s·w, cap) = 1."""
    for seed in range(3):
        w = np.random.default_rng(seed).exponential(size=12) ** 3
        factor = brentq(lambda s, w=w: np.minimum(s * w, cap).sum() - 1.0, 0.0, cap / w[w > 0].min(), xtol=1e-15)
        np.testing.assert_allclose(bound._capped(w, cap), np.minimum(factor * w, cap), rtol=1e-9, atol=1e-9)
        for none in (1.0 / 12, 0.05):  # no choice
            np.testing.assert_array_equal(bound._capped(w, none), np.full(12, 1.0 / 12))


@pytest.mark.parametrize("exponent", [1.0, 6.0])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_weights_improve_to_the_best_measure(scale: float, exponent: float) -> None:
    """Quadratic regression on [−1, 1]: a third at each of −1, 0 and 1, det M = 4/27; whatever the first step."""
    rows = np.linspace(-1.0, 1.0, 21)[:, None] ** np.arange(3)
    unit, equal = scale * rows[:, :, None] * rows[:, None], np.full(21, 1.0 / 21)
    ground = 1e-9 * scale * np.diag([1.0, 2.0, 3.0])
    w, matrix = bound._reweighted(Determinant(), unit, equal, ground, iterations=300, exponent=exponent)
    assert w.min() >= 0.0 and w.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(matrix, ground + np.einsum("k,kij->ij", w, unit), rtol=1e-12)
    assert Determinant().exact(matrix) == pytest.approx(scale * (4.0 / 27.0) ** (1.0 / 3.0), rel=1e-3)
    np.testing.assert_allclose(w[[0, 10, 20]], 1.0 / 3.0, atol=0.03)


@pytest.mark.parametrize("exponent", [0.5, 1.0])
def test_an_update_takes_each_weight_times_a_power_of_its_height(exponent: float) -> None:
    """w_k ← w_k (d_k / mean)^e with d_k = tr(M⁻¹ I_k) for the determinant, which it raises for e ≤ 1."""
    rows = np.linspace(-1.0, 1.0, 7)[:, None] ** np.arange(3)
    unit, w = rows[:, :, None] * rows[:, None], np.array([1.0, 2.0, 1.0, 3.0, 1.0, 2.0, 4.0]) / 14
    heights = np.einsum("ka,ab,kb->k", rows, np.linalg.inv(np.einsum("k,kij->ij", w, unit)), rows)
    expected = w * heights**exponent
    got, _ = bound._reweighted(Determinant(), unit, w, np.zeros((3, 3)), iterations=1, exponent=exponent)
    np.testing.assert_allclose(got, expected / expected.sum(), rtol=1e-9)


# ── measures ─────────────────────────────────────────────────────────────────────────────────────────


def test_the_first_measure_is_good_and_its_spread_is_the_mean_everywhere() -> None:
    """Of the determinant, by (1): a measure of equal weights is far from its bound, this one is near."""
    robot = Robot.load("kuka_kr270")
    space = plan_space(PlanProblem(robot, None, 4, criterion="d", search=PLAIN))
    request, q = request_of(space), random_configurations(robot, 400, 1)
    support, weights, everywhere = bound._first_measure(request, q[:0], np.random.default_rng(0))
    assert weights.min() > 0.0 and weights.sum() == pytest.approx(1.0) and len(weights) == len(support)
    shares = []
    for places, w in ((support, weights), (q, np.full(400, 1.0 / 400))):
        matrix = 4.0 * np.einsum("k,kij->ij", w, space.model.at(places))
        heights = np.einsum("nab,ab->n", space.model.at(np.concatenate([q, support])), np.linalg.inv(matrix))
        shares.append(9.0 / (4.0 * heights.max()))
    assert shares[0] > 0.85 > shares[1] + 0.2
    np.testing.assert_allclose(everywhere, space.model.at(q).mean(axis=0), atol=0.15 * np.abs(everywhere).max())


def test_a_design_goes_on_from_whatever_support_there_is() -> None:
    """From straight arms, which tell of the sum of the lengths only, to equation (20)."""
    request, straight = request_of(two_link(40.0)), np.array([[0.0, 0.0], [1.0, 0.0]])
    start = ApproximateDesign(0.0, np.inf, np.ones(1), np.eye(2), straight[:1])
    design = continued(request, start, straight[1:], np.random.default_rng(0))
    best = 3.0 / (1.0 + np.sin(np.radians(40.0)))
    assert design.value <= best <= design.bound * (1 + 1e-9)
    assert design.value >= (1.0 - bound.GAP) * design.bound
    assert design.weights.sum() == pytest.approx(1.0)


def test_of_near_maxima_the_highest_counts_and_low_ones_do_not() -> None:
    request = request_of(two_link())
    low, high = request.model.robot.joint_limits.T
    shares = np.array([[0.5, 0.5], [0.504, 0.496], [0.5, 0.506], [0.1, 0.9], [0.8, 0.8], [0.9, 0.1]])
    heights = np.array([1.0, 0.9, 0.7, 0.55, 0.49, 1e-5])
    x = low + shares * (high - low)
    for order in (np.arange(6), np.array([5, 1, 3, 0, 4, 2])):
        peaks = bound._apart(request, Descent(x[order], -np.log(7.0 * heights[order]), 0))
        np.testing.assert_array_equal(peaks, x[[0, 2, 3]])


def test_the_best_measure_and_the_best_bound_need_not_come_together() -> None:
    loose, poor = made(3.0, 6.0, 1.0), made(2.0, 5.0, 2.0)
    assert bound._better(None, poor) is poor
    for first, second in ((loose, poor), (poor, loose)):
        both = bound._better(first, second)
        assert (both.value, both.bound, both.weights[0]) == (3.0, 5.0, 1.0)
        assert (both.gradient[0, 0], both.ground) == (2.0, 2.0)
    worse = bound._better(loose, made(2.5, 7.0, 3.0))
    assert (worse.value, worse.bound, worse.weights[0], worse.ground) == (3.0, 6.0, 1.0, 1.0)
    # A bound below a value that is there is wrong by rounding only.
    assert bound._better(loose, made(1.0, 2.5, 4.0)).bound == 3.0


def test_the_bound_is_what_is_known_and_each_visit_at_most_the_largest_height() -> None:
    """tr(G M₀) + m max d, (1); with M₀ and G of the two-link arm by hand: d = G₁₁ + G₂₂ + 2 G₁₂ cos q2."""
    space = two_link(visits=5, prior=Prior(("l1",), [0.0], [0.5]))
    request, gradient = request_of(space), np.array([[0.9, -0.2], [-0.2, 0.4]])
    ground, top = 0.9 / 0.25, 0.9 + 0.4 + 2 * 0.2
    design = replace(
        made(0.1, 0.0), gradient=gradient, seen=request.model, ground=float(np.sum(gradient * space.prior))
    )
    q = random_configurations(space.robot, 40, 1)
    np.testing.assert_allclose(heights_of(design, q), 1.3 - 0.4 * np.cos(q[:, 1]), rtol=1e-9)
    assert design.ground == pytest.approx(ground)
    assert bound._with_top(request, design, top).bound == pytest.approx(ground + 5 * top)
    assert bound._with_top(request, replace(design, value=99.0), top).bound == 99.0
    assert raised(request, design, q[:3], np.random.default_rng(0)).bound == pytest.approx(
        ground + 5 * top, rel=1e-6
    )
    assert raised(request, replace(design, bound=99.0), q[:3], np.random.default_rng(0)).bound == 99.0


def test_a_thorough_maximisation_ends_when_two_batches_raise_nothing() -> None:
    """From far too low a bound; what ends it earlier leaves the rise that was met last."""
    space, gradient = two_link(visits=5), np.array([[0.9, -0.2], [-0.2, 0.4]])
    request, q = request_of(space), random_configurations(space.robot, 3, 1)
    low = replace(made(0.1, 1.0), gradient=gradient, seen=request.model, ground=0.0, support=q)
    for most, missed in ((9, bound.MAY_MISS), (1, 5 * 1.7 - 1.0)):
        calls: list[int] = []
        design = maximised(
            request,
            low,
            np.random.default_rng(0),
            lambda calls=calls, most=most: calls.append(1) or len(calls) >= most,
        )
        assert design.bound == pytest.approx(5 * 1.7, rel=1e-6)
        assert design.missed == pytest.approx(missed, rel=1e-6)
        assert len(calls) == (most if most == 1 else 2)
    assert maximised(replace(request, candidates=q), low, np.random.default_rng(0), lambda: False) is low


def test_maxima_are_looked_for_from_the_highest_of_many_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a descent that stays where it starts: of thousands the highest is near the top."""
    monkeypatch.setattr(bound, "descend", lambda f, start, *_, **__: Descent(start, f(start)[0], len(start)))
    space, gradient = two_link(visits=5), np.array([[0.9, -0.2], [-0.2, 0.4]])
    low = replace(made(0.1, 1.0), gradient=gradient, seen=space.model, ground=0.0, support=np.zeros((1, 2)))
    design = maximised(request_of(space), low, np.random.default_rng(0), lambda: False)
    assert 5 * 1.7 * (1 - 1e-4) <= design.bound <= 5 * 1.7 * (1 + 1e-9)


def test_starts_are_the_heavy_places_and_high_random_ones() -> None:
    space = two_link()
    request, gradient = request_of(space), np.array([[0.9, -0.2], [-0.2, 0.4]])
    support, weights = random_configurations(space.robot, 30, 3), np.random.default_rng(0).permutation(30) + 1.0
    starts = bound._probes(request, gradient, support, weights / weights.sum(), np.random.default_rng(1))
    rows = set(map(tuple, starts))
    assert rows >= set(map(tuple, support[weights > 25.0])) and not rows & set(
        map(tuple, support[weights <= 15.0])
    )
    others = np.array([row for row in starts if not (row == support).all(axis=1).any()])
    heights = np.einsum("nab,ab->n", space.model.at(others), gradient)
    assert len(others) and heights.min() > 0.98 * 1.7


def test_a_start_of_no_height_spoils_no_other() -> None:
    """With G = (1, −1)ᵀ(1, −1): d = 2 − 2 cos q2, nothing for a straight arm and four for a folded one."""
    request, gradient = request_of(two_link()), np.array([[1.0, -1.0], [-1.0, 1.0]])
    starts = np.array([[0.0, 0.0], [0.3, 1.0]])
    peaks = maximise_sensitivity(request, gradient, starts)
    assert np.isfinite(peaks.value).all() and (peaks.x[0] == starts[0]).all()
    assert np.exp(-peaks.value[1]) == pytest.approx(4.0, rel=1e-4)


@pytest.mark.parametrize("whole", [False, True])
def test_the_height_is_the_trace_with_what_a_visit_tells(whole: bool) -> None:
    robot, noise = mixed(), LaserTracker(station=[3.0, 1.0, 0.0])
    changes = {"error_model": typical(noise)} if whole else {"noise": noise, "configuration_sigma": 1e-5}
    space = plan_space(PlanProblem(robot, np.zeros(4), 8, 2, **changes))  # type: ignore[arg-type]
    q = random_configurations(space.robot, 6, 2)
    half = np.random.default_rng(0).standard_normal((len(space.prior), 3))
    design = replace(made(0.0, 0.0), gradient=half @ half.T, seen=space.model)
    expected = np.trace(space.model.at(q) @ design.gradient, axis1=1, axis2=2)
    np.testing.assert_allclose(heights_of(design, q), expected, rtol=1e-9)


# ── among candidates ─────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("distinct", [None, 6])
def test_rounds_end_where_the_bound_is_close(distinct: int | None) -> None:
    """Quadratic regression at 21 places, six visits: every choice of six, and the closed form with repetition."""
    rows, criterion = (np.linspace(-1.0, 1.0, 21)[:, None] ** np.arange(3))[:, None], Determinant()
    calls = []

    def cancel() -> bool:
        calls.append(1)
        return False

    design = candidate_design(rows, criterion, np.zeros((3, 3)), 6, distinct, cancel, gap=2e-3)
    assert len(calls) < 39
    assert (1.0 - 2e-3) * design.bound <= design.value <= design.bound
    assert design.weights.sum() == pytest.approx(1.0)
    assert design.weights.max() <= (1.0 / 6 if distinct else 1.0) * (1 + 1e-9)
    if distinct:
        single = np.swapaxes(rows, 1, 2) @ rows
        choices = np.array(list(combinations(range(21), 6)))[::7]
        best = criterion.exact_values(single[choices].sum(axis=1)).max()
        assert best <= design.bound * (1 + 1e-9)
    else:
        best = 6 * (4.0 / 27.0) ** (1.0 / 3.0)
        assert design.value <= best * (1 + 1e-9) and best <= design.bound * (1 + 1e-9)


@pytest.mark.parametrize(("visits", "distinct"), [(4, None), (2, None), (2, 2)])
def test_a_candidate_that_looked_useless_at_first_comes_back(visits: int, distinct: int | None) -> None:
    """With M₀ = δ I the variance of x₁ + x₂ is least, 2 / (δ + m/2), with half at each of (1, 0) and (0, 1).

    Copies of (u, v) let (1, 0) tell nothing of it by the first measure: u is such that (1, 0) M⁻¹ (1, 1) = 0.
    """
    copies, v, delta = 30, 0.2, 0.01
    u = v + (1.0 + delta * (copies + 2) / visits) / (copies * v)
    assert u + v < 1.0  # the copies are no better than the two
    rows = np.array([[1.0, 0.0], [0.0, 1.0], *[[u, v]] * copies])[:, None]
    prior = delta * np.eye(2)
    first = prior + visits * np.einsum("nkp,nkq->pq", rows, rows) / len(rows)
    assert abs(np.linalg.solve(first, np.ones(2))[0]) < 1e-9
    design = candidate_design(rows, Accuracy(np.ones((2, 2))), prior, visits, distinct)
    best = (delta + visits / 2) / 2
    assert design.value <= best * (1 + 1e-9) and best <= design.bound * (1 + 1e-9)
    assert design.value >= (1.0 - 2e-3) * design.bound


# ── with a whole error model ─────────────────────────────────────────────────────────────────────────────


def whole(visits: int = 3, **changes: object) -> PlanSpace:
    """A two-link arm whose joints err as a typical robot's do."""
    robot = Robot.load("planar_2r").with_parameters("l1,l2,dq2")
    model = replace(typical(Isotropic(3e-5)), name="stated")
    q0 = np.array([[0.3, 0.8], [1.0, -0.5]])
    return plan_space(
        PlanProblem(robot, q0, visits, error_model=model, search=PLAIN, **changes)  # type: ignore[arg-type]
    )


def test_the_information_of_a_measure_is_that_of_its_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before any update twelve measurements are two at each of six configurations; after them V has n w_j."""
    space = whole()
    model, criterion = space.model, space.criterion("test_pose")
    assert isinstance(model, ExtendedModel)
    q, equal = random_configurations(space.robot, 6, 4), np.full(6, 1.0 / 6)
    info, ground = model.linearised(q), space.prior + 0.1 * model.at(q).mean(axis=0)
    with monkeypatch.context() as patched:
        patched.setattr(bound, "UPDATES", 0)
        w, matrix, _, _ = bound._reweighted_together(criterion, info, equal, 12.0, ground)
    np.testing.assert_array_equal(w, equal)
    expected = ground + replace(model, repetitions=2).totals(q, 6)[0]
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=1e-9 * np.abs(expected).max())

    def at(w: np.ndarray) -> np.ndarray:
        columns = info.stacked(6)[0]
        return ground + columns.T @ np.linalg.solve(info.covariance(6, 12.0 * np.maximum(w, 1e-9))[0], columns)

    start = np.array([0.55, 0.05, 0.1, 0.1, 0.1, 0.1])
    w, matrix, seen, extra = bound._reweighted_together(criterion, info, start, 12.0, ground)
    assert w.min() >= 0.0 and w.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(matrix, at(w), rtol=0, atol=1e-9 * np.abs(expected).max())
    total = ground + extra + np.einsum("k,kij->ij", 12.0 * w, seen.model.at(q))
    np.testing.assert_allclose(total, matrix, rtol=0, atol=1e-9 * np.abs(expected).max())

    def cost(z: np.ndarray) -> float:
        return -float(np.log(criterion.exact(at(np.exp(z) / np.exp(z).sum()))))

    best = -minimize(cost, np.zeros(6), options={"maxiter": 60}).fun
    before, after = (float(np.log(criterion.exact(m))) for m in (at(start), matrix))
    assert before + 0.02 < best and after > best - 1e-3


@pytest.mark.parametrize("repeat", [False, True])
def test_no_choice_with_shared_errors_beats_its_bound(repeat: bool) -> None:
    """Every choice of three of eight candidates, and the measure by its own definition."""
    q = random_configurations(Robot.load("planar_2r"), 8, 3)
    space = whole(candidates=Candidates(q, repeat))
    request = request_of(space)
    design = approximate_design(request, q[:0], np.random.default_rng(0))
    every = combinations_with_replacement if repeat else combinations
    values = [psi_of(space, request.criterion, q[list(rows)]) for rows in every(range(8), 3)]
    assert max(values) <= design.bound * (1 + 1e-9)
    assert (1.0 - bound.CLOSE_ENOUGH) * design.bound <= design.value <= design.bound
    np.testing.assert_array_equal(design.support, q)
    assert design.weights.sum() == pytest.approx(1.0)
    info = space.model.linearised(q)
    assert isinstance(space.model, ExtendedModel)
    columns, shares = info.stacked(8)[0], 3.0 * np.maximum(design.weights, 1e-9)  # type: ignore[union-attr]
    matrix = space.prior + columns.T @ np.linalg.solve(info.covariance(8, shares)[0], columns)  # type: ignore[union-attr]
    assert request.criterion.exact(matrix) == pytest.approx(design.value, rel=0.03)


def test_a_measure_with_shared_errors_is_close_to_its_bound() -> None:
    space = whole()
    request = request_of(space)
    design = approximate_design(request, space.problem.test_pose_array, np.random.default_rng(0))
    assert (1.0 - bound.CLOSE_ENOUGH) * design.bound <= design.value <= design.bound
    assert design.weights.sum() == pytest.approx(1.0)
    q = np.concatenate([random_configurations(space.robot, 2000, 1), design.support])
    assert design.ground + 3 * heights_of(design, q).max() <= design.bound * (1 + 1e-3)
