# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a plan, each by itself: what it reports, by closed forms of the two-link arm and by hand."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from robots import changed, random_configurations

from calib_planner import PlanProblem, Robot, plan
from calib_planner.error_model import Prior, typical
from calib_planner.planning import Candidates, Custom, Search, plan_space
from calib_planner.planning.bound import ApproximateDesign
from calib_planner.planning.information import PlanSpace, spread_spaces
from calib_planner.planning.planner import (
    Progress,
    _agreed,
    _Bound,
    _bound,
    _checked,
    _Clock,
    _criterion_of,
    _good_enough,
    _rest_idle_joints,
    _Rounded,
    judged,
    psi_of,
)
from calib_planner.planning.result import STATUS
from calib_planner.planning.search.multistart import SearchResult
from calib_planner.robot import Element
from calib_planner.tracker import Isotropic

PLAIN = Search(general_weight=0.0, starts=4)


def two_link(degrees: float = 10.0, visits: int = 3, names: str = "l1,l2", **changes: Any) -> PlanProblem:
    """The two-link arm of 1 m and 0.8 m, σ = 1."""
    robot = Robot.load("planar_2r").with_parameters(names)
    values = {"noise": 1.0, "search": PLAIN, **changes}
    return PlanProblem(robot, np.radians([20.0, degrees]), visits, **values)


def equation_18(q: np.ndarray, degrees: float) -> float:
    """ρ0²/σ² of the lengths."""
    m, s = len(q), np.cos(q[:, 1]).sum()
    return float(2 * (m - np.cos(np.radians(degrees)) * s) / (m**2 - s**2))


def at(*degrees: float) -> np.ndarray:
    """Configurations with these angles of the second joint."""
    return np.radians([[10.0 * k, d] for k, d in enumerate(degrees)])


def design_of(bound: float, q: np.ndarray, weights: Any = None, **changes: Any) -> ApproximateDesign:
    w = np.full(len(q), 1.0 / len(q)) if weights is None else np.asarray(weights)
    return replace(ApproximateDesign(0.9 * bound, bound, w, np.eye(2), q), **changes)


# ── the bound as it is reported ──────────────────────────────────────────────────────────────────────


def test_what_no_measurement_changes_is_added_to_the_bound_on_the_error() -> None:
    """1/Ψ = ρ0²: 1/4 + 1/4 = 1/2, 5/2 + 3/2 = 4."""
    assert _Bound(4.0, "proven").above(0.25).psi == 2.0
    assert _Bound(0.4, "proven").above(1.5).psi == pytest.approx(0.25)
    assert _Bound(4.0, "proven").above(0.0).psi == 4.0
    assert _Bound(0.0, "proven").above(0.25).psi == 0.0
    assert not _Bound().above(0.25).known


def test_a_bound_that_a_plan_beats_by_more_than_rounding_is_none() -> None:
    bound = _Bound(2.0, "proven", 1e-4, 0.5, " It says so.")
    for psi in (0.3, 1.9, 2.0):
        assert _checked(bound, psi) == bound
    assert _checked(bound, 2.0 * (1 + 1e-10)) == replace(bound, psi=2.0 * (1 + 1e-10))
    assert not _checked(bound, 2.0 * (1 + 1e-8)).known and "must not be" in _checked(bound, 2.1).text
    none = _Bound()
    assert _checked(none, 1.0) is none


@pytest.mark.parametrize(("criterion", "power"), [("test_pose", 0.5), ("d", 1.0)])
def test_whole_numbers_are_spoken_of_below_an_efficiency_of_99_percent(criterion: str, power: float) -> None:
    """Efficiency of ρ0 is the root of that of Ψ; of the plans at the design's configurations the best counts."""
    problem = two_link(criterion=criterion)
    space = plan_space(problem)
    target = space.criterion(criterion)
    q, others = at(80.0, -80.0, 60.0), [at(90.0, 90.0, 20.0), at(90.0, 75.0, 40.0)]
    s = np.cos(q[:, 1]).sum()
    psi = 1.0 / equation_18(q, 10.0) if criterion == "test_pose" else float(np.sqrt(9.0 - s**2))
    best = max(psi_of(space, target, other) for other in others)
    for efficiency in (0.5, 0.985, 0.9893, 0.9907, 0.995):
        bound = psi / efficiency ** (1.0 / power)
        told = _bound(space, target, design_of(bound, q, missed=1e-4), None, q, SimpleNamespace(plans=others))  # type: ignore[arg-type]
        assert (told.psi, told.kind, told.tolerance) == (bound, "numerical", 1e-4)
        assert "wrong" not in told.text and "less than 0.01 %" in told.text
        share = (best / bound) ** power
        assert ("any number of configurations" in told.text) == (efficiency < 0.99)
        assert (f"efficiency {share:.3f}" in told.text) == (efficiency < 0.99)
        assert told.rounded == pytest.approx(share if efficiency < 0.99 else np.nan, nan_ok=True)
    low = design_of(
        0.5 * psi, q, seen=space.model, gradient=target.supporting_gradient(space.model.totals(q, 3)[0])
    )
    told = _bound(space, target, low, None, q, SimpleNamespace(plans=others))  # type: ignore[arg-type]
    assert "wrong and is now raised" in told.text and told.kind == "numerical" and told.psi >= psi * (1 - 1e-9)
    none = _bound(space, target, design_of(2 * psi, q), None, q, SimpleNamespace(plans=[]))  # type: ignore[arg-type]
    assert np.isnan(none.rounded) and none.text.endswith("which no plan can.")


def test_nothing_is_said_of_whole_numbers_where_the_plan_is_blind() -> None:
    """Straight arms tell of the sum of the lengths only: det M = 0."""
    told = judged(two_link(criterion="d"), at(0.0, 0.0, 0.0), 1).quality
    assert (told.value, told.efficiency, told.status) == (0.0, 0.0, "singular")
    assert told.value_bound == pytest.approx(3.0, rel=1e-2)
    assert told.bound == "proven" and 0.0 < told.bound_tolerance <= 1.1e-4
    assert "any number of configurations" not in told.message


# ── what given configurations promise ────────────────────────────────────────────────────────────────


def test_a_straight_arm_promises_what_it_sees() -> None:
    """Of l1, l2 and the first offset it sees l1 + l2 and the offset, whose lever is 1.8 m: σ/√m for each."""
    for m in (3, 7):
        problem = two_link(0.0, m, "l1,l2,dq1")
        told = judged(problem, at(*[0.0] * m), 1, bounded=False).quality
        np.testing.assert_allclose(told.parameter_std, [np.inf, np.inf, 1.0 / (1.8 * np.sqrt(m))], rtol=1e-9)
        assert told.predicted_accuracy == pytest.approx(np.sqrt(2.0 / m), rel=1e-9)
        assert told.status == "singular" and STATUS["singular"] in told.message
        assert np.isinf(told.general_accuracy)


def test_a_plan_that_was_searched_for_keeps_its_work_and_how_it_ended() -> None:
    problem, q = two_link(), at(80.0, -80.0, 60.0)
    began = time.perf_counter()
    alone = judged(problem, q, 1, bounded=False).quality
    assert 0.0 < alone.seconds <= time.perf_counter() - began
    assert (alone.starts, alone.evaluations, alone.status, alone.bound) == (0, 0, "ok", "none")
    assert alone.predicted_accuracy == pytest.approx(np.sqrt(equation_18(q, 10.0)))
    assert "choice of parameters" not in alone.message and "errs by" not in alone.message
    searched = changed(judged(problem, q, 1, bounded=False), seconds=100.0, starts=5, evaluations=77)
    for status in ("ok", "time_limit", "cancelled", "singular"):
        told = judged(problem, q, [2, 1, 1], changed(searched, status=status), bounded=False).quality
        assert (told.starts, told.evaluations) == (5, 77)
        assert told.seconds > 100.0
        assert told.status == ("ok" if status == "singular" else status)
        assert told.message.startswith(STATUS[told.status])
    late = changed(searched, status="time_limit")
    blind = judged(two_link(criterion="d"), at(0.0, 0.0, 0.0), 1, late, bounded=False).quality
    assert blind.status == "singular" and blind.message.startswith(STATUS["singular"])


def test_a_criterion_without_a_bound_has_none() -> None:
    told = judged(two_link(criterion="o2"), at(80.0, -80.0, 60.0), 1).quality
    s = np.cos(np.radians([80.0, 80.0, 60.0])).sum()
    assert told.bound == "none" and told.value == pytest.approx(np.sqrt((3 - s) / (3 + s)))


def test_a_compound_value_is_the_mean_of_efficiencies() -> None:
    """By (18), (20) and det M = m² − S² ≤ m²; the best designs are known to 0.3 %."""
    problem = two_link(compound={"d": 0.4})
    for q in (at(90.0, -90.0, 90.0), at(30.0, -60.0, 40.0)):
        told = judged(problem, q, 1, bounded=False).quality
        accuracy = (1 + np.sin(np.radians(10.0))) / 3 / equation_18(q, 10.0)
        determinant = np.sqrt(9.0 - np.cos(q[:, 1]).sum() ** 2) / 3
        assert told.value == pytest.approx(accuracy**0.6 * determinant**0.4, rel=4e-3)
        assert told.criterion == "compound"


def test_terms_are_root_mean_squares_over_test_poses_and_targets() -> None:
    """Two lengths known to 0.5 move a target by 0.5 √2; a point has three coordinates."""
    robot = Robot.load("planar_2r").with_parameters("l1,l2")
    problem = two_link()
    poses = np.radians([[0.0, 20.0], [30.0, 100.0]])
    for prior, size in ((None, np.nan), (Prior(("l1", "l2"), [0.0, 0.0], [0.5, 0.5]), 0.5 * np.sqrt(2.0))):
        wanted = replace(problem, robot=robot, test_poses=poses, weights=None, prior=prior)
        told = judged(wanted, at(80.0, -80.0, 60.0), 1, bounded=False).quality
        terms = {term.name: term for term in told.terms}
        assert terms["placement"].size == pytest.approx(size, nan_ok=True)
        assert terms["placement"].std == pytest.approx(told.predicted_accuracy)
        assert terms["points"].size == pytest.approx(np.sqrt(3.0))
    nowhere = replace(problem, criterion="d", test_poses=None, weights=None)
    assert judged(nowhere, at(80.0, 9.0, 60.0), 1, bounded=False).quality.terms == ()


# ── the search ───────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("whole", [False, True])
def test_progress_tells_what_the_plan_reaches(whole: bool) -> None:
    """Also where Ψ is less than one, and where the search is for the mean over several sizes of errors."""
    told: list[Progress] = []
    changes: dict[str, Any] = {"error_model": typical(Isotropic(3e-5))} if whole else {"configuration_sigma": 1.0}
    problem = two_link(90.0, 2, search=replace(PLAIN, starts=2), **changes)
    quality = plan(problem, lambda progress: told.append(progress)).quality
    assert whole or quality.predicted_accuracy == pytest.approx(np.sqrt(2.0), rel=1e-3)
    assert told[-1].best_accuracy == pytest.approx(quality.predicted_accuracy, rel=1e-6 if whole else 1e-3)
    assert told[-1].lower_bound == pytest.approx(quality.lower_bound, rel=1e-9)
    assert told[-1].starts_done == quality.starts
    assert ("Planned for a robot that errs by the error model 'typical'" in quality.message) == whole


def test_time_and_cancellation_each_end_the_work() -> None:
    late = two_link(search=replace(PLAIN, time_limit=1e-9))
    assert _Clock(late, 2, None).over() and _Clock(two_link(), 2, lambda progress: True).over()
    assert not _Clock(two_link(), 2, None).over() and not _Clock(two_link(), 2, lambda progress: False).over()


def test_two_parts_of_the_search_agree_where_their_best_values_do() -> None:
    assert not _agreed([]) and not _agreed([20.0])
    assert _agreed([20.0, 20.0001]) and _agreed([0.0, 21.0001, 7.0, 21.0])
    assert not _agreed([20.0, 20.001]) and not _agreed([20.0, 20.0, 21.0]) and not _agreed([1e-3, -1e-3])


def test_a_plan_is_good_enough_within_its_share_of_the_bound() -> None:
    space, q = plan_space(two_link()), at(80.0, -80.0, 60.0)
    best, psi = SearchResult(q, 0.0, 1, 1), 1.0 / equation_18(q, 10.0)
    for efficiency, enough in ((0.9, False), (0.987, False), (0.989, True), (1.0, True)):
        assert _good_enough(space, design_of(psi / efficiency, q), best) is enough
    near = design_of(psi, q)
    assert not _good_enough(space, None, best) and not _good_enough(space, near, None)
    assert not _good_enough(plan_space(two_link(compound={"d": 0.5})), near, best)


@pytest.mark.parametrize(("criterion", "share"), [("test_pose", 0.5), ("test_pose", 0.0), ("d", 0.5)])
def test_of_few_choices_the_plan_is_the_best_with_its_share_and_the_bound_is_without(
    criterion: str, share: float
) -> None:
    """Every choice of two of eight, ρ0 by (18) and det M = m² − S²."""
    q, search = at(10.0, 30.0, 50.0, 70.0, 100.0, 130.0, 150.0, 170.0), Search(general_weight=share)
    problem = two_link(40.0, 2, criterion=criterion, candidates=Candidates(q), search=search)
    found = plan(problem)
    space, choices = plan_space(problem), [q[list(rows)] for rows in combinations(range(8), 2)]

    def both(rows: np.ndarray) -> float:
        covariance = np.linalg.inv(space.model.totals(rows, 2)[0])
        return (1 - share) * equation_18(rows, 40.0) + share * float(np.trace(space.general @ covariance))

    if criterion == "d":
        wanted = max(choices, key=lambda rows: 4.0 - np.cos(rows[:, 1]).sum() ** 2)
        value = np.sqrt(4.0 - np.cos(wanted[:, 1]).sum() ** 2)
    else:
        wanted, value = min(choices, key=both), min(equation_18(rows, 40.0) for rows in choices) ** 0.5
    assert sorted(map(tuple, found.configurations)) == sorted(map(tuple, wanted))
    assert found.quality.value_bound == pytest.approx(value)
    assert (found.quality.efficiency < 0.999) == (criterion == "test_pose" and share > 0)
    assert (found.quality.bound, found.quality.bound_tolerance) == ("proven", 0.0)
    assert ("a share for accuracy everywhere" in found.quality.message) == (
        criterion == "test_pose" and share > 0
    )
    assert "choice of parameters" not in found.quality.message


def test_the_search_for_other_sizes_of_the_errors_is_for_the_accuracies_of_those() -> None:
    """One robot, whose joints err four times as much; a compound criterion is the same for all sizes."""
    problem = two_link(
        40.0, 3, "l1,l2,dq2", error_model=typical(Isotropic(3e-5)), search=Search(general_weight=0.3)
    )
    space, q = plan_space(problem), at(80.0, -80.0, 60.0)
    other = spread_spaces(space)[1]
    matrix = other.model.totals(q, 3)[0] + other.prior
    inverse = np.linalg.inv(matrix)
    tests = other.test_jacobians[0]
    expected = 0.7 * np.trace(tests @ inverse @ tests.T) + 0.3 * np.trace(other.general @ inverse)
    assert _criterion_of(other, space.search_criterion()).exact(matrix) == pytest.approx(1.0 / expected, rel=1e-9)
    compound = plan_space(replace(problem, compound={"d": 0.5}))
    marked = compound.criterion("d")
    assert _criterion_of(compound, marked) is marked


def whole_space(visits: int = 3) -> PlanSpace:
    model = replace(typical(Isotropic(3e-5)), name="stated")
    return plan_space(two_link(40.0, visits, "l1,l2,dq2", error_model=model))


def test_a_measure_with_shared_errors_is_rounded_to_different_places_of_it() -> None:
    space = whole_space()
    criterion, support = space.criterion("test_pose"), random_configurations(space.robot, 5, 2)
    for weights in ([0.2, 0.0, 0.5, 0.3, 0.0], [0.2, 0.1, 0.4, 0.3, 0.0]):
        design = design_of(1.0, support, weights)
        (rounded,) = _Rounded(space, criterion, design).plans
        rows = [int(np.flatnonzero((support == row).all(axis=1))[0]) for row in rounded]
        assert len(set(rows)) == 3 and all(weights[row] > 0 for row in rows)
    assert _Rounded(space, criterion, design_of(1.0, support, [0.5, 0.0, 0.5, 0.0, 0.0])).plans == []
    assert _Rounded(space, criterion, None).plans == []


def test_a_measure_is_rounded_at_its_places() -> None:
    """Of (20) for q20 = 10°: S* = m (1 − sin) / cos, so that all angles are ± the same one."""
    problem = two_link(visits=4)
    space, angle = (
        plan_space(problem),
        np.degrees(np.arccos((1 - np.sin(np.radians(10.0))) / np.cos(np.radians(10.0)))),
    )
    support = np.concatenate([at(angle, -angle, 90.0), at(angle, 170.0) + 1e-4])
    design = design_of(4.0, support, [0.4, 0.35, 0.05, 0.15, 0.05])
    plans = _Rounded(space, space.criterion("test_pose"), design).plans
    assert plans and all(q.shape == (4, 2) for q in plans)
    best = max(psi_of(space, space.criterion("test_pose"), q) for q in plans)
    assert best == pytest.approx(4.0 / (1 + np.sin(np.radians(10.0))), rel=1e-6)


# ── joints at rest ───────────────────────────────────────────────────────────────────────────────────


def test_a_joint_that_moves_no_target_rests_where_the_test_pose_or_the_middle_is() -> None:
    links = [
        Element("Rz", 0.0, 0, 1.0, "q0"), Element("Tx", 1.0, parameter="l0"),
        Element("Rz", 0.0, 1, 1.0, "q1"), Element("Tx", 0.8, parameter="l1"), Element("Rx", 0.0, 2),
    ]  # fmt: skip
    limits = np.array([[-3.0, 3.0], [-2.0, 1.0], [-1.0, 2.0]])
    robot = Robot("arm", tuple(links), (), ("a", "b", "c"), limits)
    robot = robot.with_targets([[0.0, 0.0, 0.0]]).with_parameters("l0,l1")
    q = random_configurations(robot, 4, 1)
    middle = PlanProblem(robot, None, 4, criterion="d", noise=1.0, search=PLAIN)
    posed = replace(middle, test_poses=[[0.1, 0.2, -0.7]], weights=None)
    away = replace(middle, constraints=(Custom("away", lambda q: q[:, 2] > 0.6),))
    expected = {0.5: middle, -0.7: posed}
    for value, problem in expected.items():
        rested = _rest_idle_joints(plan_space(problem), q)
        np.testing.assert_array_equal(rested, np.column_stack([q[:, :2], np.full(4, value)]))
    for problem in (away, replace(middle, candidates=Candidates(q))):
        np.testing.assert_array_equal(_rest_idle_joints(plan_space(problem), q), q)
