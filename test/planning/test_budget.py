"""How many measurements, how they are split, and random plans as the baseline."""

from __future__ import annotations

import numpy as np
import pytest

from calib_planner import InfeasibleError, InputError, PlanProblem, Robot, plan
from calib_planner.error_model import Prior
from calib_planner.planning import (
    Search,
    compare,
    plan_for_accuracy,
    plan_space,
    random_accuracies,
    split_budget,
)
from calib_planner.planning.planner import value_of

POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])


def problem(**changes):
    return PlanProblem(
        Robot.load("kuka_kr270"), POSE, **{"configurations": 4, "search": Search(starts=8), **changes}
    )


def two_link(degrees=50.0, **changes):
    robot = Robot.load("planar_2r").with_parameters("l1,l2")
    q0 = np.radians([10.0, degrees])
    settings = {"configurations": 2, "search": Search(starts=8, general_weight=0.0), "noise": 1.0, **changes}
    return PlanProblem(robot, q0, **settings)


@pytest.fixture(scope="module")
def planned():
    return plan(problem())


@pytest.mark.parametrize("accuracy", [0.9, 0.55, 0.3])
def test_fewest_measurements_of_the_two_link_arm(accuracy):
    """Equation (20): n ≥ (1 + |sin q20|) / ρ²; the split found uses exactly that many."""
    found = plan_for_accuracy(two_link(), accuracy)
    least = max(int(np.ceil((1 + np.sin(np.radians(50.0))) / accuracy**2)), 1)
    assert found.plan.quality.value <= accuracy
    assert found.fewest <= least <= found.plan.measurements <= least + 1


def test_accuracy_with_an_error_that_repetition_does_not_average():
    """σ_c makes repetition worth less: more configurations, and still the accuracy asked for."""
    plain = plan_for_accuracy(two_link(), 0.4).plan
    rough = plan_for_accuracy(two_link(configuration_sigma=2 / 3), 0.4).plan
    assert plain.quality.value <= 0.4
    assert rough.quality.value <= 0.4
    assert rough.measurements > plain.measurements
    assert len(rough.configurations) >= len(plain.configurations)


def test_accuracy_out_of_reach_is_said():
    with pytest.raises(InfeasibleError, match="not reached"):
        plan_for_accuracy(two_link(), 1e-9)


def test_budget_prefers_few_configurations():
    """Table 2's lesson: 12 measurements are as good from 3 or 4 configurations as from 12."""
    found = split_budget(problem(search=Search(starts=24)), 12)
    assert {(len(p.configurations), int(p.repetitions[0])) for p in found.tried} == {
        (3, 4), (4, 3), (6, 2), (12, 1)
    }  # fmt: skip
    assert len(found.plan.configurations) <= 4
    assert found.plan.quality.value <= 1.01 * min(p.quality.value for p in found.tried)


def test_budget_with_repeatability_prefers_many_configurations():
    found = split_budget(problem(search=Search(starts=24), configuration_sigma=1e-4), 12)
    assert len(found.plan.configurations) >= 6


def test_too_small_a_budget():
    with pytest.raises(InfeasibleError, match="at least 3"):
        split_budget(problem(), 2)


def test_only_criteria_in_metres():
    with pytest.raises(InputError, match="test_pose"):
        split_budget(problem(criterion="d"), 12)


def test_value_of_given_configurations_is_the_plans(planned):
    assert value_of(problem(), planned.configurations) == pytest.approx(planned.quality.value, rel=1e-6)


def test_repetition_is_as_good_as_measuring_again(planned):
    """r repetitions with σ_c = 0 divide the variance by r; with σ_c they cannot go below it."""
    q = planned.configurations
    once = value_of(problem(), q)
    assert value_of(problem(repetitions=9), q) == pytest.approx(once / 3, rel=1e-9)
    rough = value_of(problem(configuration_sigma=3e-5, repetitions=10_000), q)
    assert rough == pytest.approx(once, rel=1e-3)


def test_random_plans_match_the_prototype():
    """20 000 random plans for this test pose: mean 29.7 µm for m = 12; m = 4: median 91 µm."""
    twelve = random_accuracies(plan_space(problem(configurations=12)), 4000, np.random.default_rng(0))
    assert 1e6 * twelve.mean() == pytest.approx(29.7, abs=0.5)
    four = random_accuracies(plan_space(problem(configurations=4)), 4000, np.random.default_rng(1))
    assert 1e6 * np.median(four) == pytest.approx(91.0, abs=4.0)


def test_comparison():
    columns = compare(problem(), [(3, 1), (4, 3)], 500)
    assert [c.label for c in columns] == ["3", "4x3"]
    for column in columns:
        told = column.to_dict()
        assert told["lower_bound"] <= told["proposed"] <= told["random"]["min"] <= told["random"]["mean"]
        assert told["random"]["count"] == 500


def test_idle_joints_rest(planned):
    """Joint 6 moves no target on its axis: it stays at the test pose's value."""
    assert (planned.configurations[:, 5] == POSE[5]).all()


def test_prior_and_measured_replace_measurements(planned):
    """What is known beforehand lets fewer configurations do, and never makes a plan worse."""
    from calib_planner.simulation import SimulatedCell

    robot = Robot.load("kuka_kr270")
    data = SimulatedCell(robot, {}, 3e-5).measure(planned.configurations, 1, 0)
    more = plan(problem(configurations=1, measured=data))
    assert more.quality.value < planned.quality.value
    assert more.quality.lower_bound <= more.quality.value
    rows = np.concatenate([planned.configurations, more.configurations])
    assert more.quality.value == pytest.approx(value_of(problem(configurations=5), rows), rel=1e-6)
    names = [n for n in robot.parameter_names if n != "q1"]
    known = plan(problem(prior=Prior(names, np.zeros(len(names)), np.full(len(names), 1e-9))))
    assert known.quality.value < planned.quality.value


def test_next_plan_needs_a_prior_for_what_it_cannot_identify_alone():
    with pytest.raises(InfeasibleError, match="at least 3"):
        plan(problem(configurations=1))
