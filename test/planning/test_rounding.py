# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Whole-number plans from an approximate design, and starts: by brute force and by their definitions."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import PlanProblem, Robot
from calib_planner.error_model import typical
from calib_planner.planning import Custom, Feasibility, plan_space
from calib_planner.planning.criteria import Determinant, PowerMean, log_values, ridged
from calib_planner.planning.information import PlanSpace
from calib_planner.planning.search import multistart, rounding
from calib_planner.planning.search.apart import APART, nearest
from calib_planner.planning.search.enumeration import seconds
from calib_planner.planning.search.exchange import ChoiceProblem
from calib_planner.planning.search.multistart import (
    DRAWN,
    EDGE_ROUNDS,
    LIGHT,
    SearchProblem,
    _starts,
    _swapped,
    descend_from,
    efforts,
    mean_objective,
    plan_objective,
    search_chunk,
    shake,
)
from calib_planner.planning.search.rounding import improved, rounded_rows
from calib_planner.tracker import Isotropic

P = 4


def small(name: str = "planar_2r", size: int = 3, *, whole: bool = False, **changes: Any) -> PlanSpace:
    """The space of a small plan of a two-link arm."""
    robot = Robot.load(name).with_parameters("l1,l2,dq2")
    pose = random_configurations(robot, 1, 5)
    model = {"error_model": typical(Isotropic(3e-5))} if whole else {"noise": 3e-5}
    return plan_space(PlanProblem(robot, pose, size, **{**model, **changes}))


def search_of(space: PlanSpace, **changes: Any) -> SearchProblem:
    values = {
        "model": space.model,
        "criterion": space.search_criterion(),
        "prior": space.prior,
        "size": space.problem.configurations,
        "feasibility": space.feasibility,
        "support": np.empty((0, 2)),
        "weights": np.empty(0),
    }
    return SearchProblem(**{**values, **changes})


def log_value(problem: SearchProblem, q: np.ndarray) -> float:
    """log Ψ of a plan from its definition, the mean over the sizes of the errors."""
    parts = (problem, *problem.beside)
    every = [log_values(p.criterion, ridged(p.model.totals(q, len(q)) + p.prior))[0] for p in parts]
    return float(np.mean(every))


# ── whole-number splits ──────────────────────────────────────────────────────────────────────────────


def design(seed: int, count: int, size: int, k: int = 3) -> ChoiceProblem:
    rows = 1e-3 * np.random.default_rng(seed).standard_normal((count, k, P))
    return ChoiceProblem(rows, Determinant(), np.zeros((P, P)), size)


def best_split(problem: ChoiceProblem, places: list[int]) -> list[int]:
    """The best choice with repeats among ``places``, each valued by itself, 0 where something is unseen."""
    choices = list(combinations_with_replacement(places, problem.size))
    rows = problem.rows[np.array(choices)].reshape(len(choices), -1, P)
    values = np.linalg.slogdet(np.swapaxes(rows, 1, 2) @ rows)[1]
    values[np.linalg.matrix_rank(rows) < P] = -np.inf
    return sorted(choices[int(np.argmax(values))])


@pytest.mark.parametrize("seed", range(3))
def test_every_split_among_the_heaviest_places_is_looked_at(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Among as many of them as there is time for, one only if there is time for no more; twelve at most."""
    problem, places = design(seed, 8, 3), np.array([6, 1, 4, 3, 0, 2])
    for count in (1, 2, 3, 5):
        time = seconds(replace(problem, rows=problem.rows[:count], repeat=True))
        for quick in (time, 1.0001 * time):
            monkeypatch.setattr(rounding, "QUICK", quick)
            plans = rounded_rows(problem, places, np.random.default_rng(0))
            assert len(plans) == 2
            if count > 1:  # one place alone leaves something unseen
                assert sorted(plans[1].tolist()) == best_split(problem, places[:count].tolist())
    monkeypatch.setattr(rounding, "QUICK", 0.0)
    assert len(rounded_rows(problem, places, np.random.default_rng(0))) == 1
    monkeypatch.undo()
    many = design(seed, 14, 2)
    many.rows[11:] *= 10.0
    plans = rounded_rows(many, np.arange(13), np.random.default_rng(0))
    assert sorted(plans[1].tolist()) == best_split(many, list(range(12))) and 11 in plans[1]


def test_exchange_may_repeat_configurations_unless_they_share_errors() -> None:
    """One candidate tells a thousand times as much as the others: the best plan is that one, again and again."""
    problem = design(1, 6, 4, k=4)
    problem.rows[2] *= 1e3
    assert rounded_rows(problem, np.empty(0, int), np.random.default_rng(0))[0].tolist() == [2] * 4
    space = small(whole=True)
    q = random_configurations(space.robot, 6, 1)
    info: Any = space.model.linearised(q)
    together = ChoiceProblem(info.whitened, space.search_criterion(), space.prior, 3, together=info)
    plans = rounded_rows(together, np.arange(6), np.random.default_rng(0))
    assert len(plans) == 1 and len(set(plans[0].tolist())) == 3


def test_a_sharp_criterion_is_rounded_in_a_form_close_to_it() -> None:
    """The smallest eigenvalue by a power mean of exponent 64 · ¼, which is larger by 4^(1/16) at most; with a
    smaller exponent the choice is worse at least once."""
    rng = np.random.default_rng(0)
    for _ in range(12):
        rows = rng.standard_normal((9, 2, P))
        problem = ChoiceProblem(rows, PowerMean(0.25, smallest=True), np.zeros((P, P)), 4)
        found = rounded_rows(problem, np.empty(0, int), np.random.default_rng(0))[0]
        choices = np.array(list(combinations_with_replacement(range(9), 4)))
        blocks = rows[choices].reshape(len(choices), -1, P)
        least = np.linalg.eigvalsh(np.swapaxes(blocks, 1, 2) @ blocks)[:, 0]
        own = rows[found].reshape(-1, P)
        assert np.linalg.eigvalsh(own.T @ own)[0] >= 4.0 ** (-1 / 16) * least.max()


# ── descents from rounded plans ──────────────────────────────────────────────────────────────────────


def test_the_better_plan_is_told_by_its_own_value() -> None:
    """With a prior that matters; a smooth criterion takes one descent of every plan."""
    space = small()
    prior = 1e9 * np.diag([1.0, 3.0, 0.5])
    problem = search_of(space, prior=prior, criterion=Determinant())
    plans = np.stack([random_configurations(space.robot, 3, seed) for seed in range(3)])
    found = improved(problem, plans)
    assert found.log_value == pytest.approx(log_value(problem, found.configurations), rel=1e-12)
    assert found.log_value > max(log_value(problem, q) for q in plans) + 1e-3
    once = descend_from(problem, 3, plans, lambda: False, efforts(problem)[1])
    assert (found.starts, found.evaluations) == (3, once.evaluations)
    assert found.log_value == pytest.approx(-once.value.min(), rel=1e-9)


def test_plans_stay_as_they_are_where_there_is_no_time_and_copies_are_no_visits_apart() -> None:
    """Without errors of the robot a configuration may come twice; with them all of a plan keep apart."""
    good = np.array([[0.3, 1.4], [0.3, 1.4], [1.8, -1.5]])
    poor = np.array([[0.3, 0.6], [0.5, 0.9], [0.9, 1.0]])
    paper = search_of(small())
    assert log_value(paper, good) > log_value(paper, poor)
    found = improved(paper, np.stack([poor, good]), lambda: True)
    np.testing.assert_array_equal(found.configurations, good)
    space = small(whole=True)
    real = search_of(space)
    found = improved(real, np.stack([good, poor]), lambda: True)
    np.testing.assert_array_equal(found.configurations, poor)
    alone = improved(
        real, good[None], lambda: True
    ).configurations  # shaken, since copies do not know where to go
    assert 0.0 < nearest(space.robot, alone) < APART and np.abs(alone - good).max() < 0.2
    assert nearest(space.robot, improved(real, good[None]).configurations) >= APART


# ── objectives and starts ────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("whole", [False, True])
def test_the_objective_is_minus_log_psi_and_has_its_gradient(whole: bool) -> None:
    """Over three sizes of the errors with a whole error model: by the definition, and by central differences."""
    space = small(whole=whole)
    problem = search_of(space, prior=space.prior + 1e7 * np.eye(len(space.prior)))
    if whole:
        model: Any = space.model
        beside = tuple(
            replace(problem, model=model.scaled(f), prior=(1.0 + f) * problem.prior, criterion=Determinant())
            for f in (0.4, 2.5)
        )
        problem = replace(problem, beside=beside)
    objective = (mean_objective if whole else plan_objective)(problem, 3)
    rows = np.stack([random_configurations(space.robot, 3, seed).ravel() for seed in (1, 2)])
    value, gradient = objective(rows)
    np.testing.assert_allclose(value, [-log_value(problem, row.reshape(3, 2)) for row in rows], rtol=1e-10)
    steps = 1e-5 * np.eye(6)
    differences = [(objective(rows + s)[0] - objective(rows - s)[0]) / 2e-5 for s in steps]
    np.testing.assert_allclose(gradient, np.transpose(differences), rtol=1e-5, atol=1e-6)


class Never(Determinant):
    """A criterion by which the second plan is worth less than nothing, as rounding has it of singular ones, and
    the third just nothing."""

    def value_and_gradient(self, matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        psi, gradient = super().value_and_gradient(matrices)
        none = np.isin(np.arange(len(matrices)), [1, 2])
        psi = np.where(none, [0.0, -1e-9, 0.0, 0.0], psi)
        return psi, np.where(none[:, None, None], 0.0, gradient)


@pytest.mark.parametrize("whole", [False, True])
def test_a_plan_that_is_worth_nothing_is_infinitely_bad(whole: bool) -> None:
    problem = search_of(small(whole=whole), criterion=Never())
    rows = np.stack([random_configurations(problem.model.robot, 3, seed).ravel() for seed in range(4)])
    with np.errstate(all="raise", under="ignore"):
        value, gradient = (mean_objective if whole else plan_objective)(problem, 3)(rows)
    assert np.isfinite(value).tolist() == [True, False, False, True] and (value[1:3] == np.inf).all()
    assert np.isfinite(gradient).all() and not gradient[1:3].any()


def test_copies_are_shaken_apart_where_that_is_feasible() -> None:
    """By 0.02 rad, to both sides, within the limits; what would leave the allowed set stays."""
    space = small()
    low, high = space.robot.joint_limits.T
    free = Feasibility(space.robot, (Custom("above", lambda q: q[:, 0] >= 0.5),))
    plans = np.tile([[0.5, 1.0], [1.0, high[1]]], (2000, 1, 1))
    got = shake(search_of(space, feasibility=free), plans, np.random.default_rng(0))
    assert got.shape == plans.shape and (got[..., 0] >= 0.5).all() and (got <= high).all() and (got >= low).all()
    stays = (got == plans).all(axis=2)
    assert stays[:, 0].mean() == pytest.approx(0.5, abs=0.05) and not stays[:, 1].any()
    assert got[:, 0, 0].max() > 0.5 + 0.04
    apart = got[:, 1] - plans[:, 1]
    assert apart[:, 0].std() == pytest.approx(0.02, rel=0.1) and (apart[:, 1] == 0.0).mean() == pytest.approx(
        0.5, abs=0.05
    )


@pytest.mark.parametrize("whole", [False, True])
def test_near_visits_cost_only_where_errors_repeat(whole: bool) -> None:
    problem = search_of(small(whole=whole))
    near = np.array([[0.3, 1.4], [0.33, 1.4], [1.8, -1.5]])
    value = descend_from(problem, 3, near[None], lambda: True, efforts(problem)[0]).value[0]
    assert (value > -log_value(problem, near) + 1.0) == whole
    assert whole or value == pytest.approx(-log_value(problem, near), rel=1e-9)


def test_large_descents_go_side_by_side_while_there_is_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their inverse Hessians have 6² numbers each; what comes out does not depend on it."""
    problem = search_of(small())
    rows = np.stack([random_configurations(problem.model.robot, 3, seed) for seed in range(5)])
    most: list[int] = []

    def counted(problem: SearchProblem, size: int) -> Any:
        inner = plan_objective(problem, size)
        return lambda x: (most.append(len(x)), inner(x))[1]

    monkeypatch.setattr(multistart, "plan_objective", counted)
    every = descend_from(problem, 3, rows, lambda: False, efforts(problem)[0])
    assert most[0] == 5
    most.clear()
    monkeypatch.setattr(multistart, "BATCH", 2 * 36 + 35)
    parts = descend_from(problem, 3, rows, lambda: False, efforts(problem)[0])
    assert max(most) == most[0] == 2 and parts.evaluations == sum(most) == every.evaluations
    np.testing.assert_allclose(parts.x, every.x, rtol=1e-9)
    np.testing.assert_allclose(parts.value, every.value, rtol=1e-12)


@pytest.mark.parametrize(("starts", "kernels"), [(12, 2), (30, 2), (36, 3), (48, 4)])
def test_a_third_of_the_starts_is_of_each_kind(starts: int, kernels: int) -> None:
    """From the design, from the best quarter (two at least) of small plans repeated, and at random. Three rows of
    one target and four parameters: two configurations are the smallest plan."""
    robot = Robot.load("planar_2r").with_parameters("l1,l2,dq1,dq2")
    space = plan_space(PlanProblem(robot, [[0.2, 0.9]], 5, noise=3e-5))
    third, support = starts // 3, np.array([[0.5, 0.5]])
    problem = search_of(space, support=support, weights=np.ones(1))
    plans, evaluations = _starts(problem, starts, np.random.default_rng(0), lambda: False)
    assert len(plans) == third + kernels + third and evaluations > 0
    near = np.abs(plans - support).max(axis=(1, 2)) < 0.12  # six times what shakes them
    assert near.tolist() == [True] * third + [False] * (len(plans) - third)
    repeated = np.abs(plans[:, 2:] - plans[:, :-2]).max(axis=(1, 2)) < 0.2
    assert repeated[third:].tolist() == [True] * kernels + [False] * third
    small_plan = replace(problem, size=2)
    random = [log_value(small_plan, random_configurations(robot, 2, seed)) for seed in range(40)]
    for plan in plans[third : third + kernels]:
        assert log_value(small_plan, plan[:2]) > max(random) - 0.1
    alone = replace(problem, support=np.empty((0, 2)), weights=np.empty(0), size=2)
    plans, evaluations = _starts(alone, starts, np.random.default_rng(0), lambda: False)
    assert len(plans) == starts and evaluations == 0


@pytest.mark.parametrize("targets", [1, 2])
def test_starts_with_shared_errors_are_drawn_from_the_heavy_places(
    targets: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not from those with a hundredth of the largest weight; every other configuration that they may be swapped
    with has angles of a test pose."""
    space = small(whole=True)
    robot = space.robot.with_targets([[0.1, 0.0, 0.2], [0.0, 0.1, 0.1]][:targets])
    space = plan_space(replace(space.problem, robot=robot))
    tests, support = np.array([[0.123, 0.456]]), random_configurations(robot, 6, 3)
    weights = np.array([0.1, 0.3, 1.5 * LIGHT * 0.3, 0.9 * LIGHT * 0.3, 0.0, 1e-5])
    problem = search_of(space, support=support, weights=weights, tests=tests)
    seen: list[np.ndarray] = []

    def watched(sizes: Any, plan: np.ndarray, others: np.ndarray, *rest: Any) -> Any:
        seen.append(others)
        return swapped(sizes, plan, others, *rest)

    swapped = multistart.swapped
    monkeypatch.setattr(multistart, "swapped", watched)
    model: Any = space.model
    plans, tried = _swapped(problem, model, 4, np.random.default_rng(0), lambda: True)
    assert plans.shape == (4, 3, 2) and tried == 0
    for plan in plans:
        apart = np.abs(plan[:, None] - support[None]).max(axis=2)
        assert sorted(apart.argmin(axis=1).tolist()) == [0, 1, 2] and (apart.min(axis=1) < 0.12).all()
    count = DRAWN // 3 // targets
    assert len(seen) == 8 and all(len(others) == count for others in seen[::2])
    for drawn, mixtures in zip(seen[::2], seen[1::2], strict=True):
        same = (drawn == tests).any(axis=1)
        assert not same[::2].any() and 0.5 < same[1::2].mean() < 1.0
        both = np.concatenate([support[:3], tests])
        assert len(mixtures) == count and np.isin(mixtures, both).all()
    once = iter([False])
    assert _swapped(problem, model, 1, np.random.default_rng(0), lambda: next(once, True))[1] == 3 + count


@pytest.mark.parametrize("kind", ["paper", "whole", "mask"])
def test_a_part_of_the_search_tells_what_it_found_and_did(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The best of all descents to the end, its own log Ψ, and every evaluation and trial once. Along an edge that
    says no more than yes or no, random steps and descents take turns, as long as a turn gains a thousandth."""
    space = small(whole=kind == "whole")
    if kind == "mask":
        fence = Custom("fence", lambda q: np.sin(3 * q[:, 0]) * np.cos(2 * q[:, 1]) > 0.3)
        space = plan_space(replace(space.problem, constraints=(fence,)))
    problem = search_of(space)
    work, ends, turns = [], [-np.inf], 0

    def counting(function: Any) -> Any:
        def counted(*args: Any, **settings: Any) -> Any:
            nonlocal turns
            turns += function is wander
            made = function(*args, **settings)
            work.append(made[1] if isinstance(made, tuple) else made.evaluations)
            if not isinstance(made, tuple):
                ends.append(-float(made.value.min()) if args[1] == 3 else -np.inf)
            return made

        return counted

    wander = multistart.wander
    for name in ("wander", "swapped", "descend_from"):
        monkeypatch.setattr(multistart, name, counting(getattr(multistart, name)))
    found = search_chunk(problem, 2 if kind == "whole" else 5, np.random.default_rng(0))
    assert found.log_value == pytest.approx(log_value(problem, found.configurations), rel=1e-7)
    assert found.log_value == max(ends)
    assert found.evaluations == sum(work) > 0
    assert space.feasibility.mask(found.configurations).all()
    assert (turns > 0) == (kind == "mask")
    if turns:
        gains = np.diff(np.maximum.accumulate(ends[-1 - turns :]))
        assert (gains[:-1] >= 1e-3).all() and (turns == EDGE_ROUNDS or gains[-1] < 1e-3)
