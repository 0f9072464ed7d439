"""Swaps with random configurations: what each would give is what the plan with it is worth."""

from __future__ import annotations

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import PlanProblem, Robot
from calib_planner.error_model import typical
from calib_planner.planning import plan_space
from calib_planner.planning.criteria import log_values, ridged
from calib_planner.planning.extended import ExtendedModel
from calib_planner.planning.search.swaps import TRIED, Swaps, improved, swapped
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
    swaps = Swaps.among(model.linearised(q), criterion, space.prior)
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
    plans = [swapped([(model, criterion, space.prior)], 5, support, weights, q[3:], rng(0))[0] for _ in range(2)]
    np.testing.assert_array_equal(*plans)
