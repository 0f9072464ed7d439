# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Choosing from a pool: against brute force, with and without repeats, and what cannot be chosen."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, combinations_with_replacement
from math import comb
from typing import Any

import numpy as np
import pytest
from robots import SHARED_DATA, random_configurations

from calib_planner import Robot
from calib_planner.error_model import typical
from calib_planner.errors import InfeasibleError
from calib_planner.planning import Candidates, PlanProblem, Search, plan, plan_space
from calib_planner.planning.bound import candidate_design
from calib_planner.planning.criteria import Accuracy, Determinant, DiagonalDeterminant, Eliminating, PowerMean
from calib_planner.planning.planner import value_of
from calib_planner.planning.search import enumeration, exchange
from calib_planner.planning.search.enumeration import best_of_all, choices_of, seconds
from calib_planner.planning.search.exchange import ChoiceProblem, RunningDeterminant, choose, scaled_rows
from calib_planner.tracker import Isotropic

P = 4
CRITERIA = {
    "d": Determinant(),
    "d nuisance": Eliminating(Determinant(), (0, 1, 2), (3,)),
    "a": Accuracy(np.eye(P) / P),
    "a nuisance": Eliminating(Accuracy(np.eye(2)), (0, 1), (2, 3)),
    "d_star": DiagonalDeterminant(),
    "e": PowerMean(8.0, smallest=True),
}


def pool(seed: int, count: int = 11, k: int = 3) -> np.ndarray:
    """(count, k, P) rows of very different sizes and units."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal((count, k, P)) * [1.0, 1e3, 1e-2, 5.0] * rng.uniform(0.2, 2, (count, 1, 1))


def worths(problem: ChoiceProblem, choices: list[tuple[int, ...]]) -> np.ndarray:
    """(N,) Ψ of every choice from its definition."""
    single = np.swapaxes(problem.rows, 1, 2) @ problem.rows
    matrices = problem.prior + single[np.array(choices)].sum(axis=1)
    scale = np.sqrt(np.einsum("npp->np", matrices))
    singular = np.linalg.cond(matrices / (scale[:, :, None] * scale[:, None, :])) > 1e12
    matrices[singular] = np.eye(P)
    return np.where(singular, 0.0, problem.criterion.value_and_gradient(matrices)[0])


def brute_force(problem: ChoiceProblem) -> float:
    """The best worth of all choices there are, in the form that the search maximises."""
    every = combinations_with_replacement if problem.repeat else combinations
    return float(worths(problem, list(every(range(len(problem.rows)), problem.size))).max())


@pytest.mark.parametrize("name", CRITERIA)
@pytest.mark.parametrize("repeat", [False, True])
def test_small_pools_against_every_subset(name: str, repeat: bool) -> None:
    for seed in range(6):
        problem = ChoiceProblem(pool(seed), CRITERIA[name], np.zeros((P, P)), 4, repeat)
        found = choose(problem, np.random.default_rng(0))
        best = brute_force(problem)
        assert np.exp(found.log_value) == pytest.approx(worths(problem, [tuple(found.rows)])[0], rel=1e-6)
        assert np.exp(found.log_value) <= best * (1 + 1e-6)
        assert np.exp(found.log_value) >= best * (1 - 1e-9 if name.startswith("d ") or name == "d" else 0.97)
        if not repeat:
            assert len(set(found.rows.tolist())) == 4


@pytest.mark.parametrize("name", CRITERIA)
@pytest.mark.parametrize("repeat", [False, True])
def test_no_choice_beats_the_bound(name: str, repeat: bool) -> None:
    for seed in range(10):
        problem = ChoiceProblem(pool(seed), CRITERIA[name], np.diag([1.0, 1.0, 1e-4, 1.0]), 3, repeat)
        relaxed = candidate_design(problem.rows, problem.criterion, problem.prior, 3, None if repeat else 3)
        found = choose(problem, np.random.default_rng(0))
        rows = problem.rows[found.rows].reshape(-1, P)
        assert problem.criterion.exact(problem.prior + rows.T @ rows) <= relaxed.bound * (1 + 1e-9)
        if name != "e":  # which is searched through a smooth, larger one
            assert brute_force(problem) <= relaxed.bound * (1 + 1e-9)
        assert relaxed.weights.sum() == pytest.approx(1.0)


def test_bound_of_distinct_rows_is_the_tighter_one() -> None:
    rows = pool(1, 12)
    rows[0] *= 30.0  # one outstanding candidate, which may be taken once
    free = candidate_design(rows, Determinant(), np.zeros((P, P)), 6, None)
    once = candidate_design(rows, Determinant(), np.zeros((P, P)), 6, 6)
    assert once.bound < 0.9 * free.bound


@pytest.mark.parametrize("k", [2, 3, 6])
def test_running_determinant_is_the_determinant(k: int) -> None:
    rows = pool(3, 20, k)
    prior = np.diag([1.0, 2.0, 1e-4, 0.5])
    state = RunningDeterminant(scaled_rows(rows, prior, 5), np.array([1, 4, 6]))
    chosen = [1, 4, 6]
    for row, sign in [(3, 1), (4, -1), (9, 1), (9, 1), (1, -1)]:
        state.change(row, sign)
        chosen = [*chosen, row] if sign > 0 else [c for c in chosen if c != row]
    matrix = prior + sum(rows[i].T @ rows[i] for i in chosen)
    exact = np.linalg.slogdet(matrix)[1]
    assert state.log_det == pytest.approx(exact, abs=1e-6)
    gains = [np.linalg.slogdet(matrix + r.T @ r)[1] - exact for r in rows]
    np.testing.assert_allclose(state.gains(), gains, atol=1e-6)


def test_exactly_determined_choice() -> None:
    rows = np.random.default_rng(5).standard_normal((12, 2, P))
    problem = ChoiceProblem(rows, Determinant(), np.zeros((P, P)), 2)
    assert np.exp(choose(problem, np.random.default_rng(0)).log_value) == pytest.approx(brute_force(problem))


@pytest.mark.parametrize("criterion", [Determinant(), Accuracy(np.eye(P))])
def test_rank_deficient_pool_names_the_combination(criterion: Determinant | Accuracy) -> None:
    rows = pool(0)
    rows[:, :, 2] = 2.0 * rows[:, :, 1]
    problem = ChoiceProblem(rows, criterion, np.zeros((P, P)), 4, names=("a", "b", "c", "d"))
    with pytest.raises(InfeasibleError, match=r"1·c - 2·b") as caught:
        choose(problem, np.random.default_rng(0))
    assert caught.value.constraint == "candidates"
    informed = ChoiceProblem(rows, criterion, np.diag([0.0, 0.0, 1.0, 0.0]), 4)
    assert np.isfinite(choose(informed, np.random.default_rng(0)).log_value)


def test_too_few_candidates() -> None:
    with pytest.raises(InfeasibleError, match="3 feasible rows"):
        choose(ChoiceProblem(pool(0, 3), Determinant(), np.zeros((P, P)), 4), np.random.default_rng(0))


@pytest.mark.parametrize("criterion", ["test_pose", "worst_pose", "d", "d_star", "a", "e", "o5", "o2", "o4"])
def test_plans_from_candidates(criterion: str) -> None:
    robot = Robot.load("kuka_kr270")
    candidates = random_configurations(robot, 150, 3)
    test_poses = random_configurations(robot, 2, 4)
    problem = PlanProblem(
        robot,
        test_poses,
        6,
        criterion=criterion,
        search=Search(seed=2),
        candidates=Candidates(candidates),
    )
    found, again = plan(problem), plan(problem)
    np.testing.assert_array_equal(found.configurations, again.configurations)
    rows = [int(np.flatnonzero((candidates == q).all(axis=1))[0]) for q in found.configurations]
    assert len(set(rows)) == 6
    if criterion in ("o2", "o4"):
        assert found.quality.bound == "none"
    else:
        assert 0.5 < found.quality.efficiency <= 1.0


def choice(robot: Robot, m: int, criterion: str, candidates: np.ndarray, repeat: bool) -> PlanProblem:
    """``m`` of the candidates, for two test poses, by the criterion alone."""
    poses, search = random_configurations(robot, 2, 8), Search(general_weight=0.0)
    chosen = Candidates(candidates, repeat)
    return PlanProblem(robot, poses, m, criterion=criterion, search=search, candidates=chosen)


SMALL = [(c, m) for c in ("test_pose", "worst_pose", "d", "a", "e", "o4") for m in (3, 4)]


@pytest.mark.parametrize(("criterion", "m"), SMALL)
@pytest.mark.parametrize("repeat", [False, True])
def test_of_few_choices_the_plan_is_the_best(criterion: str, m: int, repeat: bool) -> None:
    """Every choice of a short list, each valued by itself: the plan is the best of them, and says so."""
    robot, rng = Robot.load("kuka_kr270"), np.random.default_rng(m)
    candidates = random_configurations(robot, 7, int(rng.integers(1000)))
    candidates[5] = candidates[2]  # some choices leave parameters unseen
    problem = choice(robot, m, criterion, candidates, repeat)
    found = plan(problem).quality
    every = combinations_with_replacement if repeat else combinations
    values = [value_of(problem, candidates[list(rows)]) for rows in every(range(7), m)]
    best = min(values) if criterion in ("test_pose", "worst_pose", "a") else max(values)
    assert found.value == pytest.approx(best, rel=1e-7)
    assert found.bound == "proven"
    assert found.efficiency == pytest.approx(1.0, abs=1e-7)
    assert f"each of the {len(values)} choices" in found.message


@pytest.mark.parametrize("count", [7, 60])
@pytest.mark.parametrize("criterion", ["d", "test_pose"])
def test_the_home_configuration_may_be_among_candidates(criterion: str, count: int) -> None:
    """There joint 4 turns about the target: plans that repeat it alone know nothing at all of that joint."""
    robot = Robot.load("kuka_kr270").with_parameters("d1,q2,q4,d2")
    candidates = np.zeros((count, 6))
    candidates[-4:] = random_configurations(robot, 4, 2)
    assert (robot.jacobian(candidates[0])[0, :, 2] == 0.0).all()
    for repeat in (False, True):
        asked = choice(robot, 3, criterion, candidates, repeat)
        found = plan(asked)
        assert found.quality.status == "ok" and np.isfinite(found.quality.value)
        best = [value_of(asked, candidates[list(rows)]) for rows in combinations(range(count - 5, count), 3)]
        if criterion == "d":
            assert found.quality.value >= max(best) * (1 - 1e-9)
        else:
            assert found.quality.value <= min(best) * (1 + 1e-9)


def test_few_choices_with_a_whole_error_model() -> None:
    robot = Robot.load("kuka_kr270")
    candidates, model = random_configurations(robot, 8, 3), replace(typical(Isotropic(3e-5)), name="mine")
    problem = PlanProblem(
        robot,
        random_configurations(robot, 2, 8),
        3,
        error_model=model,
        search=Search(general_weight=0.0),
        candidates=Candidates(candidates),
    )
    found = plan(problem)
    values = [value_of(problem, candidates[list(rows)]) for rows in combinations(range(8), 3)]
    assert found.quality.bound == "proven"
    assert found.quality.value == pytest.approx(min(values), rel=1e-9)
    assert found.quality.efficiency == pytest.approx(1.0, rel=1e-9)
    # With a share for accuracy everywhere the plan may differ, the bound may not.
    shared = plan(replace(problem, search=Search(general_weight=0.3))).quality
    assert shared.value_bound == pytest.approx(min(values), rel=1e-9)
    assert shared.efficiency <= 1.0
    assert "share for accuracy everywhere" in shared.message


def test_many_choices_are_not_enumerated() -> None:
    problem = ChoiceProblem(pool(0, 60), Determinant(), np.zeros((P, P)), 8)
    assert choices_of(problem) == comb(60, 8)
    assert best_of_all(problem, problem.criterion, lambda matrix: 0.0) is None
    few = ChoiceProblem(pool(0, 6), Determinant(), np.zeros((P, P)), 4)
    assert best_of_all(few, few.criterion, lambda matrix: 0.0, lambda: True) is None


@pytest.mark.parametrize("repeat", [False, True])
@pytest.mark.parametrize("beside", [0, 1, 2])
def test_of_all_choices_in_small_batches(beside: int, repeat: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The best in the mean of log Ψ over the sizes of the errors, and the best by the target."""
    monkeypatch.setattr(enumeration, "BATCH", 7 * P * P * 3)
    size, prior = 3, 1e-12 * np.eye(P)
    draw = combinations_with_replacement if repeat else combinations
    choices = list(draw(range(7), size))
    for seed in range(4):
        sizes = [
            ChoiceProblem(1e-3 * pool(10 * seed + i, 7), CRITERIA["a"], prior, size, repeat)
            for i in range(beside + 1)
        ]
        problem = replace(sizes[0], beside=tuple(sizes[1:]))
        wanted = np.mean([np.log(worths(s, choices)) for s in sizes], axis=0)
        for target in (problem.criterion, Determinant()):
            found = best_of_all(problem, target, lambda matrix: 0.0)
            assert found is not None and found.choices == len(choices)
            assert tuple(found.rows) == choices[int(np.argmax(wanted))]
            assert found.log_value == pytest.approx(wanted.max(), abs=1e-6) and wanted.max() < 0.0
            top = worths(replace(problem, criterion=target), choices)
            assert tuple(found.top_rows) == choices[int(np.argmax(top))]


def test_choices_that_see_too_little_are_few_or_there_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three candidates show two parameters, two the others: a pair of one kind is worth what ``exactly`` says."""
    rows = np.full((5, 2, P), 1e-12)
    rows[:3, [0, 1], [0, 1]] = np.array([1.0, 2.0, 3.0])[:, None]
    rows[3:, [0, 1], [2, 3]] = np.array([1.0, 0.5])[:, None]
    problem = ChoiceProblem(rows, Determinant(), np.zeros((P, P)), 2)
    seen: list[np.ndarray] = []
    found = best_of_all(problem, problem.criterion, lambda matrix: float(seen.append(matrix) or 0.0))
    assert found is not None and found.rows.tolist() == [2, 3]
    assert len(seen) == 4  # three pairs of the first three, and the last two
    whole = ChoiceProblem(rows[:3], Determinant(), np.zeros((P, P)), 2)
    nothing = best_of_all(whole, whole.criterion, lambda matrix: 0.0)
    assert nothing is not None and nothing.log_value == -np.inf
    monkeypatch.setattr(enumeration, "MOST_SINGULAR", 4)
    assert best_of_all(problem, problem.criterion, lambda matrix: 0.0) is not None
    for most in (1, 3):
        monkeypatch.setattr(enumeration, "MOST_SINGULAR", most)
        assert best_of_all(problem, problem.criterion, lambda matrix: 0.0) is None


@pytest.mark.parametrize("share", [0.7, 1.5])
def test_a_matrix_is_singular_by_its_correlations_whatever_the_units(share: float) -> None:
    """[[1, c, 0], [c, 1, 0], [0, 0, 1]] has the eigenvalues 1 − c, 1 and 1 + c."""
    ratio = share * enumeration.REGULAR
    c = (1.0 - ratio) / (1.0 + ratio)
    units = np.array([[1e-3, 1e3, 1.0], [1.0, 1.0, 1.0], [1e4, 7.0, 1e-2]])
    matrices = np.array([[1.0, c, 0.0], [c, 1.0, 0.0], [0.0, 0.0, 1.0]]) * units[:, :, None] * units[:, None, :]
    assert enumeration._singular(matrices).tolist() == [share < 1.0] * 3


def test_the_time_that_all_choices_take_is_told_from_their_multiplications() -> None:
    """By hand, for p = 100 and ten configurations of three rows among twelve candidates."""
    problem = ChoiceProblem(np.broadcast_to(0.0, (12, 3, 100)), Determinant(), np.eye(100), 10)
    alone = 66 * (1e-5 + 1.5e-10 * (6e6 + 3e5))
    shared = 66 * (1.5e-4 + 1.5e-10 * (6e6 + 3e5 + 2.7e4 + 900 * 130))
    assert seconds(problem) == pytest.approx(alone, rel=1e-12)
    together = replace(problem, together=object())  # type: ignore[arg-type]
    assert seconds(together) == pytest.approx(shared, rel=1e-12)
    assert seconds(replace(together, beside=(together, together))) == pytest.approx(3 * shared, rel=1e-12)
    assert seconds(replace(problem, repeat=True)) == pytest.approx(alone * comb(21, 10) / 66, rel=1e-12)


@pytest.mark.parametrize("name", ["d", "a", "d, whole error model", "a, whole error model"])
def test_a_choice_that_is_cancelled_is_whole_and_no_better(name: str) -> None:
    """Cancelled at its n-th question, the exchange gives as many rows as were wanted, no candidate twice."""
    criterion, size = CRITERIA[name[0]], 4
    if "whole" in name:
        robot = Robot.load("planar_2r")
        q = random_configurations(robot, 14, 1)
        asked = PlanProblem(robot, q[:1], size, criterion=name[0], error_model=typical(Isotropic(3e-5)))
        space = plan_space(asked)
        info = space.model.linearised(q)
        problem = ChoiceProblem(info.whitened, space.criterion(name[0]), space.prior, size, together=info)
    else:
        problem = ChoiceProblem(pool(3, 14), criterion, np.zeros((P, P)), size)
    whole = choose(problem, np.random.default_rng(0))
    starts = []
    for most in (0, 1, size + 1):
        left = iter(range(most))
        early = choose(problem, np.random.default_rng(0), lambda left=left: next(left, None) is None)  # type: ignore[misc]
        assert len(set(early.rows.tolist())) == size
        assert early.log_value <= whole.log_value + 1e-9
        assert early.evaluations < whole.evaluations
        starts.append(early.starts)
    assert starts[0] == 1 and starts == sorted(starts)


def test_repeats_only_when_allowed() -> None:
    robot = Robot.load("planar_2r")
    candidates = np.array([[0.0, 0.8], [0.5, 0.1], [-0.4, 0.2], [1.0, -0.8], [1.5, 0.0], [0.1, 0.05]])
    once = plan(PlanProblem(robot, [[0.0, 0.8]], 6, candidates=Candidates(candidates)))
    again = plan(PlanProblem(robot, [[0.0, 0.8]], 6, candidates=Candidates(candidates, repeat=True)))
    assert len(np.unique(once.configurations, axis=0)) == 6
    assert len(np.unique(again.configurations, axis=0)) < 6
    assert again.quality.predicted_accuracy < once.quality.predicted_accuracy


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="no measured data here")
def test_pool_that_sees_less_than_the_robot_could() -> None:
    robot = Robot.load(SHARED_DATA / "ur10_tracker" / "ur10.urdf").with_targets([[0.05, 0.02, 0.1]])
    robot = robot.with_parameters("full", ("base", "tool"))
    candidates = random_configurations(robot, 200)
    candidates[:, 2:] = candidates[0, 2:]  # only two joints move
    found = plan(PlanProblem(robot, None, 12, criterion="d", candidates=Candidates(candidates)))
    assert found.quality.status == "ok"
    assert len(found.quality.unidentifiable) > 24  # a robot that moves has 24 combinations, this pool sees fewer
    assert "fixed at nominal" in found.quality.message


@pytest.mark.parametrize(("name", "factor"), [("test_pose", 1.0), ("test_pose", 0.4), ("d", 1.0)])
def test_an_exchange_of_what_shares_errors_is_worth_what_is_said(name: str, factor: float) -> None:
    """log Ψ of the choice with another row in each place, and to first order what a further one adds."""
    robot = Robot.load("kuka_kr270").with_targets([[0.1, 0.0, 0.2], [0.0, 0.1, 0.1]])
    robot = robot.with_parameters("lengths+offsets")
    q = random_configurations(robot, 9, 3)
    asked = PlanProblem(robot, q[:1], 4, criterion=name, error_model=typical(Isotropic(3e-5)))
    space = plan_space(asked)
    info: Any = space.model.linearised(q)
    prior = space.prior + 1e5 * np.eye(len(space.prior))
    problem = ChoiceProblem(info.whitened, space.search_criterion(), prior, 4, together=info, factor=factor)
    search, rows, new = exchange._Together(problem, info), np.array([1, 7, 4, 2]), np.array([0, 3, 5, 8])
    for position, row in enumerate(rows):
        search.shared.put(position, row)
    chosen = exchange._Chosen(problem, search.shared, rows)
    np.testing.assert_allclose(
        chosen.matrix, exchange.information_of(problem, rows[None])[0], rtol=1e-9, atol=1e-3
    )
    for position in range(4):
        others = np.array([np.where(np.arange(4) == position, row, rows) for row in new])
        expected = exchange.log_values_of(problem, exchange.information_of(problem, others))
        np.testing.assert_allclose(chosen.with_one_more(new, position), expected, rtol=1e-9)
    if factor == 1.0:
        more = exchange.information_of(problem, np.array([[*rows, row] for row in range(9) if row not in rows]))
        gradient = problem.criterion.value_and_gradient(chosen.matrix[None])[1][0]
        wanted = np.sum(gradient * (more - chosen.matrix), axis=(1, 2))
        gains = search._gains(chosen, chosen.matrix, given=True)[[0, 3, 5, 6, 8]]
        share = gains / wanted  # of an accuracy up to a factor, and without the smallest directions of its weight
        np.testing.assert_allclose(share / share.mean(), 1.0, rtol=1e-6 if name == "d" else 5e-3)


@pytest.mark.parametrize("repeat", [False, True])
@pytest.mark.parametrize("name", ["a", "e"])
def test_candidates_are_ranked_by_what_they_add_to_first_order(name: str, repeat: bool) -> None:
    """Row by row: tr(G R_jᵀR_j). What is chosen is not tried again unless it may be."""
    problem = ChoiceProblem(pool(4, 40), CRITERIA[name], np.zeros((P, P)), 4, repeat)
    search, rows = exchange._Shortlisted(problem), np.array([3, 11, 5, 20])
    matrix = exchange.information_of(problem, rows[None])[0]
    gradient = problem.criterion.value_and_gradient(matrix[None])[1][0]
    wanted = np.array([np.trace(gradient @ r.T @ r) for r in problem.rows])
    np.testing.assert_allclose(search._gains(matrix), wanted, rtol=1e-9)
    if not repeat:
        wanted[rows] = -np.inf
    best = np.argsort(-wanted)[: exchange.SHORTLIST]
    assert len(set(best.tolist()) ^ set(search._shortlist(matrix, rows).tolist())) <= 2  # ranked by a little more


@pytest.mark.parametrize("k", [2, 3, 4])
def test_many_determinants_at_once_are_those_of_each(k: int) -> None:
    half = np.random.default_rng(k).normal(size=(20, k, k))
    blocks = half @ np.swapaxes(half, 1, 2)
    expected = [np.log(np.prod(1.0 + np.linalg.eigvalsh(block))) for block in blocks]
    np.testing.assert_allclose(exchange.log_det_plus_identity(blocks.transpose(1, 2, 0)), expected, rtol=1e-12)
