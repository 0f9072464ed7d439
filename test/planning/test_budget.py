# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How many measurements, how they are split, and random plans as the baseline."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from robots import random_configurations, repeats

from calib_planner import InfeasibleError, InputError, PlanProblem, Robot, plan
from calib_planner.error_model import Prior, typical
from calib_planner.planning import (
    Candidates,
    Pace,
    Search,
    budget,
    compare,
    judged,
    plan_for_accuracy,
    plan_for_accuracy_in_time,
    plan_for_time,
    plan_space,
    random_accuracies,
    split_budget,
    visit_times,
    visiting_order,
)
from calib_planner.planning.budget import _Tour
from calib_planner.planning.planner import value_of
from calib_planner.tracker import Isotropic

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
    told = []
    found = plan_for_accuracy(two_link(), accuracy, lambda *done: told.append(done))
    assert told == [(k + 1, 6) for k in range(len(told))] and told
    least = max(int(np.ceil((1 + np.sin(np.radians(50.0))) / accuracy**2)), 1)
    assert found.plan.quality.value <= accuracy
    assert found.fewest <= least <= found.plan.measurements <= least + 1


def test_accuracy_with_an_error_that_repetition_does_not_average():
    """σ_c makes repetition worth less: more configurations, and still the accuracy asked for."""
    plain = plan_for_accuracy(two_link(), 0.4).plan
    split = plan_for_accuracy(two_link(configuration_sigma=2 / 3), 0.4)
    rough = split.plan
    assert split.fewest == 0  # not known
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


# ── time ─────────────────────────────────────────────────────────────────────────────────────────────

SLOW = Pace(np.full(6, 0.2))
WHOLE = replace(typical(Isotropic(3e-5)), name="taught")


def test_a_time_is_kept_and_nearly_used_up():
    request = problem(search=Search(starts=2))
    before = np.inf
    for seconds in (120.0, 200.0):
        split = plan_for_time(request, SLOW, seconds)
        times, plan = split.timetable, split.plan
        again = visit_times(request.robot, plan.configurations, plan.repetitions, SLOW)
        assert times.seconds == again.seconds <= seconds
        assert seconds - times.seconds < 2 * SLOW.standstill + 4  # no further visit fits
        assert plan.quality.lower_bound <= plan.quality.value < before
        assert plan.measurements > len(plan.configurations)  # coming back costs less than moving on
        assert max(split.seconds) <= seconds and split.seconds[split.tried.index(plan)] == times.seconds
        before = plan.quality.value


def test_visits_go_where_they_tell_most():
    """Any single visit that is taken elsewhere makes the criterion worse, or hardly better."""
    request = problem(search=Search(starts=2, general_weight=0.0))
    q = plan(replace(request, configurations=7)).configurations
    tour = _Tour((plan_space(replace(request, configurations=7)),), q, SLOW, None)
    counts = tour.filled(tour.seconds(tour.once) + 400.0)
    assert counts.sum() > 30
    best = tour.log_value(counts)
    for i, j in itertools.permutations(range(7), 2):
        if counts[i] > 1:
            moved = counts.copy()
            moved[i] -= 1
            moved[j] += 1
            assert tour.log_value(moved) < best + 2e-3


@pytest.mark.parametrize("model", [None, WHOLE], ids=["paper", "whole"])
def test_the_gain_of_a_visit_is_that_of_the_criterion(model):
    """The slope by central differences; of ΔM = R/r − R/(r+1) to first order it is the gain times (r+1)/r."""
    request = problem(configurations=9, error_model=model, search=Search(starts=2, general_weight=0.0))
    space, q = plan_space(request), random_configurations(request.robot, 9, 2)
    tour, counts = _Tour((space,), q, SLOW, None), np.array([20, 30, 25, 15, 18, 22, 40, 12, 10])
    gains = tour._gains(counts) * (1.0 if model is None else (counts + 1) / counts)
    for i in range(9):
        one = (np.arange(9) == i).astype(int)
        slope = (tour.log_value(counts + one) - tour.log_value(counts - one)) / 2
        assert gains[i] == pytest.approx(slope, rel=1e-2)


def tours():
    """Tours of paper and whole models with the same seven configurations, and one of eleven."""
    request = problem(search=Search(starts=2, general_weight=0.0))
    for model, count in ((None, 7), (WHOLE, 7), (None, 11)):
        sized = replace(request, configurations=count, error_model=model)
        q = random_configurations(request.robot, count, 3)
        yield _Tour((plan_space(sized),), q, SLOW, None)


def test_visits_are_given_away_to_the_last_and_the_time_is_kept():
    for tour in tours():
        for extra in (0, 1, 2, 7, 61):
            counts = tour._given_away(tour.once, extra)
            assert counts.sum() == len(tour.once) + extra and counts.min() >= 1
        for spare in (0.0, 3.0, 40.0, 333.0):
            whole = tour.seconds(tour.once) + spare
            counts = tour.filled(whole)
            assert tour.seconds(counts) <= whole and counts.min() >= 1
            assert whole - tour.seconds(counts) < 2 * (SLOW.standstill + 4)


def test_few_visits_reach_an_accuracy_and_one_fewer_does_not(monkeypatch):
    monkeypatch.setattr(budget, "MOST_MEASUREMENTS", 100)
    for tour in list(tours())[:2]:
        once = tour._accuracy(tour.once)
        np.testing.assert_array_equal(tour.enough(once), tour.once)
        for share in (0.9, 0.5):
            counts = tour.enough(share * once)
            if counts is None:
                assert tour.spaces[0].problem.error_model is not None  # what repeats is not averaged
                continue
            assert tour._accuracy(counts) <= share * once
            fewer = tour._given_away(tour.once, int(counts.sum()) - len(counts) - 1)
            assert tour._accuracy(fewer) > share * once
        assert tour.enough(1e-4 * once) is None


def test_numbers_of_configurations_that_are_tried():
    """One by one, then a quarter more each time; for a time half as many again, up or down to the end."""
    assert list(budget._sizes(3)) == [3, 4, 5, 6, 7, 8, 9, 12, 15, 19, 24, 30, 38, 48, 60]
    assert list(budget._sizes(50)) == [50, 51, 52, 53, 54, 55, 56]
    assert budget._steps(4, 30) == [4, 6, 9, 14, 21, 30] and budget._steps(1, 4) == [1, 2, 3, 4]
    assert budget._steps(30, 4) == [30, 20, 13, 9, 6, 4] and budget._steps(3, 1) == [3, 2, 1]
    assert budget._steps(5, 5) == [5]


@pytest.mark.parametrize("start", [4, 20, 60])
@pytest.mark.parametrize("peak", [4, 7, 13, 22, 41, 60])
def test_the_best_number_is_found_of_what_rises_and_then_falls(peak, start):
    """As all numbers together say, but for those too close to tell apart; and few of them are tried."""
    for steepness in (0.3, 3.0):
        told = []
        worth = {m: -steepness * np.log(m / peak) ** 2 for m in range(4, 61)}
        tried = []

        def attempt(m, worth=worth, tried=tried):
            tried.append(m)
            return SimpleNamespace(merit=worth[m], counts=np.full(m, 5), size=m)

        ways = (budget._steps(start, 4), budget._steps(start, 60))
        best, every = budget._best_size(attempt, ways, lambda *done, told=told: told.append(done))
        assert len(set(tried)) == len(tried) == len(every) <= 14
        assert [one.size for one in every] == sorted(tried) and best.merit == max(one.merit for one in every)
        assert max(best.size / peak, peak / best.size) <= budget.CLOSE + 0.5 / min(peak, best.size)
        assert [done for done, _ in told] == list(range(1, len(tried) + 1))
        assert all(total >= max(done, 6) for done, total in told)


@pytest.mark.parametrize("ways", [[[20, 30, 45]], [[20, 13, 9]], [[20, 13, 9], [20, 30, 45]]])
def test_an_irregularity_does_not_end_the_search_for_a_number_and_a_clear_fall_does(ways):
    """With 100 visits log Ψ may fall by 0.05, and by what two of them are worth, without saying anything."""
    for fall, goes_on in ((0.065, True), (0.075, False)):
        worth = {m: -fall for way in ways for m in way[1:2]} | {way[2]: 1.0 for way in ways} | {20: 0.0}
        attempt = lambda m, worth=worth: SimpleNamespace(  # noqa: E731
            merit=worth.get(m, -9.0), counts=np.full(20, 5), size=m
        )
        best, _ = budget._best_size(attempt, ways, lambda *done: None)
        assert best.size == (ways[0][2] if goes_on else 20)


def test_of_no_number_that_comes_to_something_there_is_none():
    """And where only the smaller ones do, they are found from a larger one."""
    ways = (budget._steps(20, 4), budget._steps(20, 60))
    assert budget._best_size(lambda m: None, ways, lambda *done: None) == (None, [])
    some = lambda m: SimpleNamespace(merit=float(m), counts=np.full(m, 5), size=m) if m <= 13 else None  # noqa: E731
    best, every = budget._best_size(some, ways, lambda *done: None)
    assert 13 / budget.CLOSE <= best.size <= 13 and best in every


def test_about_as_many_fit_as_of_random_ones():
    request = problem()
    for seconds in (500.0, 1200.0):
        got = budget._most_that_fit(request, SLOW, seconds, None, (3, 60))
        q = random_configurations(request.robot, 60, 9)

        def time(m, q=q):
            return visit_times(
                request.robot, q[:m][visiting_order(q[:m], request.robot, SLOW, None)], 1, SLOW
            ).seconds

        assert time(int(0.75 * got)) < seconds < time(int(1.3 * got) + 1)
    assert budget._most_that_fit(request, SLOW, 1e5, None, (3, 60)) == 60
    assert budget._most_that_fit(request, SLOW, 1.0, None, (3, 60)) == 3
    near = replace(request, candidates=Candidates(POSE + 1e-3 * random_configurations(request.robot, 20, 3)))
    assert budget._most_that_fit(near, SLOW, 500.0, None, (3, 20)) > 1.3 * budget._most_that_fit(
        request, SLOW, 500.0, None, (3, 20)
    )


def test_unequal_visits_promise_what_their_rows_promise():
    """r_i visits to a configuration are r_i rows of it: value, bound and accuracy elsewhere."""
    request = problem(search=Search(starts=2))
    q, counts = plan(request).configurations, np.array([3, 1, 4, 2])
    told = judged(request, q, counts)
    rows = judged(request, np.repeat(q, counts, axis=0), 1)
    for name in ("value", "lower_bound", "general_accuracy"):
        assert getattr(told.quality, name) == pytest.approx(getattr(rows.quality, name), rel=1e-6), name
    np.testing.assert_array_equal(told.repetitions, counts)
    np.testing.assert_array_equal(told.configurations, q)
    for wrong in ([1, 2], [1, 2, 3, 0], [1.0, 2.0, 3.0, 4.0]):
        with pytest.raises(InputError, match="repetitions"):
            judged(request, q, wrong)


def test_the_least_time_for_an_accuracy_is_found_again_by_that_time(monkeypatch):
    request, wanted = problem(search=Search(starts=2)), repeats(3e-5, 2e-5)
    split = plan_for_accuracy_in_time(request, wanted, SLOW)
    assert split.plan.quality.value <= wanted
    assert split.timetable.seconds == min(split.seconds)
    assert plan_for_time(request, SLOW, split.timetable.seconds).plan.quality.value < wanted * 1.02
    monkeypatch.setattr(budget, "MOST_CONFIGURATIONS", 3)
    with pytest.raises(InfeasibleError, match="not reached"):
        plan_for_accuracy_in_time(two_link(), 1e-9, Pace([1.0, 1.0]))


def test_with_errors_of_its_own_a_configuration_is_not_repeated():
    """σ_c as large as the noise: going on tells more than coming back, wherever the robot is quick."""
    request = problem(search=Search(starts=2), configuration_sigma=1e-4)
    split = plan_for_time(request, Pace(np.full(6, 3.0)), 80.0)
    assert split.plan.measurements - len(split.plan.configurations) <= 2


def test_a_time_that_is_too_short_says_what_is_needed():
    with pytest.raises(InfeasibleError, match="3 configurations are needed, which take about"):
        plan_for_time(problem(search=Search(starts=2)), SLOW, 20.0)
    with pytest.raises(InputError, match="compound"):
        plan_for_time(problem(compound={"d": 0.3}), SLOW, 200.0)
    with pytest.raises(InputError, match="time_budget"):
        plan_for_time(problem(), SLOW, -1.0)


def test_random_plans_are_of_accuracies_only():
    with pytest.raises(InputError, match="criterion: expected test_pose, got d"):
        compare(problem(criterion="d"), [(4, 1)], 10)
    with pytest.raises(InputError, match="criterion"):
        compare(problem(compound={"d": 0.3}), [(4, 1)], 10)


def test_a_time_is_not_filled_with_candidates_twice():
    """Six candidates that may be measured once each: no plan has more, however much time there is."""
    candidates = Candidates(random_configurations(Robot.load("planar_2r"), 6, 3))
    assert budget._largest_size(two_link(candidates=candidates), 3) == 6
    again = Candidates(candidates.configurations, True)
    assert budget._largest_size(two_link(candidates=again), 3) == budget.MOST_CONFIGURATIONS
    found = plan_for_time(two_link(candidates=candidates), Pace(np.full(2, 1.0)), 3600.0)
    assert max(len(p.configurations) for p in found.tried) <= 6
    rows = {tuple(q) for q in np.asarray(candidates.configurations)}
    assert {tuple(q) for q in found.plan.configurations} <= rows


def test_a_cancelled_search_for_a_time_gives_the_best_plan_so_far():
    asked = []

    def cancel(progress):
        asked.append(progress)
        return True

    found = plan_for_time(two_link(), Pace(np.full(2, 1.0)), 600.0, callback=cancel)
    assert len(found.tried) == 1 and found.plan.quality.status == "cancelled"
    assert sum(found.plan.repetitions) > 0 and asked
