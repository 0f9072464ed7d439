# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Which points and runs of visits are impossible, and what a term brings: against their definitions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fits import of_visits, problem_of
from scipy.stats import chi2

from calib_planner.identification import term_gain
from calib_planner.identification.doubt import (
    gate_of,
    impossible,
    many_are_wrong,
    part_of,
    shifted_run,
    squares_of_points,
    student,
)
from calib_planner.identification.left_out import left_out
from calib_planner.identification.likelihood import LinearProblem, dense


def moved(problem: LinearProblem, change: np.ndarray) -> LinearProblem:
    """The same with points measured elsewhere by ``change`` (N, targets, 3) [m]."""
    return replace(problem, y=problem.y + change.reshape(problem.y.shape) * problem.seen)


@pytest.mark.parametrize("visits", [9, 60])
def test_a_points_square_is_its_left_out_residual_under_its_covariance_without_doubt(visits: int) -> None:
    """A thousandth of its own variance is added, and half of it is the least: rounding makes nothing negative."""
    plain, doubt = problem_of(visits, 2, missing=((3, 1),)), np.zeros((visits, 2))
    doubt[2, 0] = doubt[7, 1] = 1e-8
    problem = replace(plain, parts={**plain.parts, "doubt": part_of(doubt)})
    solution = dense(problem)
    squares, seen, own = squares_of_points(solution, doubt)
    left = left_out(solution)
    np.testing.assert_array_equal(seen, left.seen)
    for visit, target in np.argwhere(seen):
        at = slice(3 * target, 3 * target + 3)
        without = problem.covariance[visit, at, at] - doubt[visit, target] * np.eye(3)
        assert own[visit, target] == pytest.approx(np.trace(without) / 3.0, rel=1e-9, abs=0.0)
        total = left.covariance[visit, at, at] - doubt[visit, target] * np.eye(3)
        total += 1e-3 * own[visit, target] * np.eye(3)
        error = left.residuals[visit, target]
        values, vectors = np.linalg.eigh(total)
        expected = np.sum((vectors.T @ error) ** 2 / np.maximum(values, 0.5 * own[visit, target]))
        assert squares[visit, target] == pytest.approx(expected, rel=1e-6)
    expected = np.where(seen, own * np.maximum((squares - 3.0) / 5.0, 0.0), 0.0)
    np.testing.assert_allclose(student(solution, doubt), expected, rtol=1e-9)
    assert (expected > 0.0).any() and (expected[seen] == 0.0).any()


def test_a_doubt_is_taken_off_before_a_point_is_judged() -> None:
    """The square does not depend on how much the point is doubted already."""
    change = np.zeros((9, 2, 3))
    change[4, 1] = [3e-3, -2e-3, 1e-3]
    problem, squares = moved(problem_of(9, 2), change), []
    for size in (0.0, 1e-8, 1e-6):
        doubt = np.zeros((9, 2))
        doubt[4, 1] = size
        solution = dense(replace(problem, parts={**problem.parts, "doubt": part_of(doubt)}))
        squares.append(squares_of_points(solution, doubt)[0][4, 1])
    np.testing.assert_allclose(squares, squares[0], rtol=1e-4)


def test_an_impossible_point_loses_its_weight_and_no_other_does() -> None:
    problem, none = problem_of(9, 2, missing=((3, 1),)), np.zeros((9, 2))
    assert not impossible(dense(problem), none).any() and not many_are_wrong(dense(problem), none)
    for size, capped in ((1e-2, False), (3.0, True)):
        change = np.zeros((9, 2, 3))
        change[4, 1, 0] = size
        solution = dense(moved(problem, change))
        squares, seen, own = squares_of_points(solution, none)
        gate = gate_of(17)
        got = impossible(solution, none)
        assert squares[4, 1] > gate and got[4, 1] > 0.0
        np.testing.assert_array_equal(got > 0.0, seen & (squares > gate))
        length = np.sum(left_out(solution).residuals[4, 1] ** 2)
        expected = 1e7 * own[4, 1] if capped else 10.0 * length
        assert got[4, 1] == pytest.approx(expected, rel=1e-9)
        assert many_are_wrong(solution, none)  # one of seventeen is more than one of fifty
        assert student(solution, none)[4, 1] == pytest.approx(
            own[4, 1] * min((squares[4, 1] - 3.0) / 5.0, 1e7), rel=1e-9
        )


def test_the_gate_lets_one_of_all_points_pass_in_a_hundred_calibrations() -> None:
    for points in (1, 17, 1000):
        assert chi2.sf(gate_of(points), 3) == pytest.approx(0.01 / points)
    assert gate_of(0) == gate_of(1)


def test_scales_that_gross_errors_have_swollen_make_points_too_good() -> None:
    problem, none = problem_of(20, 1), np.zeros((20, 1))
    median = np.median(squares_of_points(dense(problem), none)[0])
    for share, wrong in ((0.7, False), (0.5, True)):  # of the median of χ² with three degrees of freedom
        y = problem.y * np.sqrt(share * chi2.median(3) / median)
        assert many_are_wrong(dense(replace(problem, y=y)), none) == wrong


@pytest.mark.parametrize(
    ("first", "last", "told"),
    [(4, 8, range(4, 8)), (0, 4, range(4)), (3, 12, range(3)), (6, 12, range(6, 12)), (9, 12, range(9, 12))],
)
def test_a_run_of_shifted_visits_is_found_and_the_smaller_part_is_doubted(
    first: int, last: int, told: range
) -> None:
    """Of two halves the first is believed."""
    problem, change = problem_of(12, 2, missing=((5, 0), (8, 1))), np.zeros((12, 2, 3))
    change[first:last] = [0.02, -0.01, 0.015]
    answer = shifted_run(dense(moved(problem, change)))
    assert answer is not None and answer.tolist() == list(told)
    assert shifted_run(dense(problem)) is None
    assert shifted_run(dense(problem_of(5, 2))) is None


def test_the_run_is_that_of_the_largest_score_statistic() -> None:
    """(GᵀPy)ᵀ (GᵀPG)⁻¹ GᵀPy of each run of three visits or more, with G written out."""
    problem, rng = problem_of(10, 2, missing=((5, 0),)), np.random.default_rng(3)
    change = 3e-4 * rng.standard_normal((10, 1, 3)).cumsum(axis=0)
    solution = dense(moved(problem, np.broadcast_to(change, (10, 2, 3))))
    best, run = 0.0, range(0)
    for first in range(8):
        for last in range(first + 3, 11):
            if last - first <= 7:
                columns = np.zeros((10, 6, 3))
                columns[first:last] = np.tile(np.eye(3), (2, 1))
                columns = (columns * problem.seen[:, :, None]).reshape(60, 3)
                pull = columns.T @ solution.weighted.ravel()
                statistic = pull @ np.linalg.solve(columns.T @ solution.projection @ columns, pull)
                if statistic > best:
                    best, run = statistic, range(first, last)
    inside = list(run)
    expected = inside if len(inside) < 5 else [k for k in range(10) if k not in inside]
    answer = shifted_run(solution)
    assert best > chi2.isf(0.01 / 52, 3) and answer is not None and answer.tolist() == expected


def test_a_terms_size_and_doubt_are_what_it_moves_the_measured_points(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of(6, 2, missing=((3, 1),))
    rng, size = np.random.default_rng(0), problem.columns.shape[2]
    coefficients, half = rng.standard_normal(size), rng.standard_normal((size, size))
    model, robot = problem.model, problem.robot
    gains = {"gravity": 3.0, "visits": -1.0}
    terms = {t.name: t for t in term_gain.term_gains(model, problem, coefficients, half @ half.T, gains)}
    assert list(terms) == ["placement", "gravity", "smooth", "short", "visits", "points"]
    slices = model.slices(robot)
    assert model.joint_functions is not None
    shares = model.joint_functions.shares(robot, model.values)
    parts = [("placement", "placement", 1.0), ("gravity", "gravity", 1.0)]
    parts += [(name, "joint_functions", share) for name, share in shares.items()]
    for name, term, share in parts:
        columns = problem.columns[:, :, slices[term]] * share
        pushed = columns @ coefficients[slices[term]]
        spread = columns @ half[slices[term]]
        for got, squares in ((terms[name].size, pushed**2), (terms[name].std, spread**2)):
            assert got == pytest.approx(np.sqrt(np.sum(squares) / 11.0), rel=1e-9)
    for name, scales in (("visits", ("repeatability", "shared")), ("points", ("floor", "instrument"))):
        traces = [np.trace(problem.parts[s], axis1=1, axis2=2).sum() for s in scales if s in problem.parts]
        assert traces and terms[name].size == pytest.approx(np.sqrt(np.sum(traces) / 11.0), rel=1e-9)
        assert np.isnan(terms[name].std)
    assert terms["gravity"].gain == 3.0 and terms["visits"].gain == -1.0 and np.isnan(terms["smooth"].gain)
    assert all(t.used for t in terms.values())
    # Of many visits each so many-th stands for the others: of pairs that are alike the first for both.
    many = of_visits(problem, np.repeat(np.arange(6), 2))
    monkeypatch.setattr(term_gain, "ENOUGH", 6)
    for term in term_gain.term_gains(model, many, coefficients, half @ half.T, gains):
        assert (term.size, term.std) == pytest.approx((terms[term.name].size, terms[term.name].std), nan_ok=True)
    # Where visits are not alike, their number of points says for how many the few stand.
    monkeypatch.setattr(term_gain, "ENOUGH", 3)
    few = problem.columns[::2, :, slices["gravity"]] @ half[slices["gravity"]]
    share = 11.0 / (problem.seen[::2].sum() / 3.0)
    assert share % 1.0 > 0.1
    terms = {t.name: t for t in term_gain.term_gains(model, problem, coefficients, half @ half.T, gains)}
    assert terms["gravity"].std == pytest.approx(np.sqrt(share * np.sum(few**2) / 11.0), rel=1e-9)
