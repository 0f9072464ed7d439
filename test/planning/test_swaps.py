# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Swaps with random configurations: what each would give is what the plan with it is worth."""

from __future__ import annotations

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import PlanProblem, Robot, plan
from calib_planner.error_model import typical
from calib_planner.planning import Search, plan_space
from calib_planner.planning.criteria import Accuracy, log_values, ridged
from calib_planner.planning.extended import ExtendedModel
from calib_planner.planning.search import multistart
from calib_planner.planning.search.swaps import TRIED, Swaps, drawn_plan, improved, mixed, swapped
from calib_planner.tracker import Isotropic

POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])


@pytest.mark.parametrize("targets", [1, 2])
@pytest.mark.parametrize("name", ["test_pose", "d"])
def test_a_swap_is_worth_what_is_said(name: str, targets: int) -> None:
    robot = Robot.load("kuka_kr270").with_targets([[0.1, 0.0, 0.2], [0.0, 0.1, 0.1]][:targets])
    robot = robot.with_parameters("lengths+offsets")
    space = plan_space(PlanProblem(robot, POSE, 5, error_model=typical(Isotropic(3e-5)), criterion=name))
    assert isinstance(space.model, ExtendedModel)
    criterion, model = space.search_criterion(), space.model
    q = random_configurations(robot, 12, 3)
    swaps = Swaps.among(model.linearised(q), criterion, space.prior, 1.0)
    others = np.array([2, 5, 7, 11])
    got = swaps.values(others, 3)
    assert np.isneginf(got[others]).all() and np.isfinite(got[3])
    tried = np.flatnonzero(np.isfinite(got))
    assert len(tried) == 8 if name == "test_pose" else len(tried) >= min(TRIED, 8)
    for row in tried:
        matrix = model.totals(q[[*others, row]], 5) + space.prior
        assert got[row] == pytest.approx(log_values(criterion, ridged(matrix))[0], abs=1e-5)  # the ridge is M_S's
    chosen, _ = improved([swaps], np.arange(5), np.random.default_rng(0))
    assert len(set(chosen.tolist())) == 5
    for place in range(5):  # no single swap is better
        values = swaps.values(np.delete(chosen, place), int(chosen[place]))
        assert values.max() <= values[chosen[place]] + 1e-3
    support, weights, rng = q[:3], np.ones(3) / 3, np.random.default_rng
    begin, rest = drawn_plan(5, support, weights, q[3:], rng(0))
    np.testing.assert_array_equal(np.concatenate([begin, rest]), q)
    plans = [swapped([(model, criterion, space.prior)], begin, rest, rng(0))[0] for _ in range(2)]
    np.testing.assert_array_equal(*plans)


def test_candidates_that_are_tried_are_the_best_to_first_order() -> None:
    """tr(G ΔM_j) at the plan as it stands, ΔM_j being what candidate j adds; the present one too."""
    robot = Robot.load("kuka_kr270").with_parameters("lengths+offsets")
    space = plan_space(PlanProblem(robot, POSE, 5, error_model=typical(Isotropic(3e-5)), criterion="d"))
    assert isinstance(space.model, ExtendedModel)
    criterion, model, others = space.search_criterion(), space.model, np.array([2, 5, 7, 11])
    q = random_configurations(robot, 30, 3)
    swaps = Swaps.among(model.linearised(q), criterion, space.prior, 1.0)
    below = model.totals(q[others], 4)[0]
    for now in (0, 3, 20):
        whole = model.totals(q[[*others, now]], 5)[0] + space.prior
        gradient = criterion.value_and_gradient(whole[None])[1][0]
        free = np.setdiff1d(np.arange(30), others)
        plans = np.concatenate([q[[*others, j]] for j in free])
        gains = np.sum(gradient * (model.totals(plans, 5) - below), axis=(1, 2))
        best = set(free[np.argsort(gains)[-TRIED:]].tolist())
        assert set(np.flatnonzero(np.isfinite(swaps.values(others, now)))) == best | {now}


@pytest.mark.parametrize("scale", [1.0, 1e-30])
def test_swaps_end_where_none_helps_in_the_mean_over_the_sizes(scale: float) -> None:
    """Whatever the sign of log Ψ; the last round tries every candidate in every place, and a plan that cannot be
    better is left after one round."""
    robot = Robot.load("planar_2r").with_parameters("l1,l2,dq2")
    pose, size = random_configurations(robot, 1, 5), 3
    space = plan_space(PlanProblem(robot, pose, size, error_model=typical(Isotropic(3e-5))))
    assert isinstance(space.model, ExtendedModel)
    criterion = Accuracy(space.search_criterion().weight / scale)  # type: ignore[attr-defined]
    factors = (0.8, 0.1, 2.5)
    sizes = [(m, criterion, space.prior) for m in map(space.model.scaled, factors)]

    def values(plans: list[np.ndarray]) -> np.ndarray:
        each = [log_values(c, ridged(m.totals(np.concatenate(plans), size) + prior)) for m, c, prior in sizes]
        return np.asarray(np.mean(each, axis=0))

    for seed in range(4):
        q = random_configurations(robot, 9, seed)
        plan, tried = swapped(sizes, q[:size], q[size:], np.random.default_rng(seed))
        rest = [row for row in q if not (plan == row).all(axis=1).any()]
        assert len(rest) == 9 - size and tried % 9 == 0
        others = [np.where(np.arange(size)[:, None] == place, row, plan) for place in range(size) for row in rest]
        best, before, *each = values([plan, q[:size], *others])
        assert max(each) <= best + 1e-6 and (best > before or (plan == q[:size]).all())
        again, tried = swapped(sizes, plan, np.array(rest), np.random.default_rng(1))
        assert tried == 9 * size and (again == plan).all()
    assert swapped(sizes, q[:size], q[size:], np.random.default_rng(0), lambda: True)[1] == 0


def test_mixed_configurations_have_the_angles_of_two() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 200, 6))
    made = mixed(first, second, rng)
    share = (made == first).mean()
    assert ((made == first) != (made == second)).all()
    assert 0.4 < share < 0.7  # the mean of SHARES is 0.53, with 2 % from 200 draws


def test_plans_that_measure_at_the_angles_of_the_test_pose_promise_more(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot.load("kuka_kr270").with_parameters("full", ("base", "tool"))
    search = Search(starts=1)  # of three seeds one finds as much by descents alone
    problem = PlanProblem(robot, POSE, 14, error_model=typical(Isotropic(3e-5)), search=search)
    found = plan(problem)
    monkeypatch.setattr(multistart, "mixed", lambda first, second, rng: second)
    assert found.quality.predicted_accuracy < 0.9 * plan(problem).quality.predicted_accuracy
