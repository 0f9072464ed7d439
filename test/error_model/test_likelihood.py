# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Both forms of the linear problem against brute force, and every derivative against differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from fits import of_visits, problem_of, simulated, total_covariance, unknown, ur10e
from robots import random_configurations

from calib_planner.error_model import ErrorModel, Placement, typical
from calib_planner.identification import likelihood
from calib_planner.identification.doubt import part_of
from calib_planner.identification.estimation import _Work, fit_error_model
from calib_planner.identification.left_out import left_out
from calib_planner.identification.likelihood import (
    LinearProblem,
    Solution,
    _moved,
    by_coefficients,
    dense,
    derivatives,
    exchange,
    maximise,
    penalty,
    scale_covariance,
    unknown_scales,
    updatable,
    with_points_moved,
    with_uncertain_scales,
)

CASES: dict[str, Callable[[], LinearProblem]] = {
    "one target": lambda: problem_of(14, 1),
    "two targets, some not seen": lambda: problem_of(9, 2, missing=((2, 0), (5, 1), (5, 0))),
    "flat placement, redundant": lambda: problem_of(14, 3, "flat"),
}


@pytest.fixture(params=CASES)
def problem(request: pytest.FixtureRequest) -> LinearProblem:
    return CASES[request.param]()


def test_both_forms_agree(problem: LinearProblem) -> None:
    one, other = dense(problem), by_coefficients(problem)
    assert one.value == pytest.approx(other.value, rel=1e-8)
    rows = np.random.default_rng(0).standard_normal((problem.y.size, 3)) * problem.seen.reshape(-1, 1)
    pairs = [
        (one.coefficients, other.coefficients),
        (one.weighted, other.weighted),
        (one.blocks, other.blocks),
        (one.squares, other.squares),
        (one.pulls, other.pulls),
        (one.posterior(), other.posterior()),
        (one.project(rows), other.project(rows)),
        (one.coefficients_of(rows), other.coefficients_of(rows)),
    ]
    for a, b in pairs:
        np.testing.assert_allclose(a, b, atol=2e-6 * np.abs(a).max())


def test_products_of_levers_and_waves_are_the_columns(
    problem: LinearProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """(5) against the columns written out."""
    monkeypatch.setattr(likelihood, "MANY", 1)
    assert problem.products is not None and problem.plain_columns.shape[1] < len(problem.random)
    scaled, size = problem.scaled_columns, problem.y.size
    rng = np.random.default_rng(3)
    root, standard, rows = (rng.standard_normal((size, n)) for n in (size, len(problem.random), 2))
    pairs = [
        (problem.systematic_covariance(), scaled @ scaled.T),
        (problem.squares(root @ root.T), np.sum((root.T @ scaled) ** 2, axis=0)),
        (problem.scaled_times(standard.T), scaled @ standard.T),
        (problem.pulled(rows), scaled.T @ rows),
    ]
    for a, b in pairs:
        np.testing.assert_allclose(a, b, atol=1e-12 * np.abs(b).max())
    written_out = replace(problem, poses=None)
    assert written_out.products is None
    assert dense(problem).value == pytest.approx(dense(written_out).value, rel=1e-8)


@pytest.mark.parametrize("form", [dense, by_coefficients])
def test_it_is_generalised_least_squares(
    problem: LinearProblem, form: Callable[[LinearProblem], Solution]
) -> None:
    """Against the textbook, with V written out and the flat columns by the pseudo-inverse."""
    solution = form(problem)
    rows = problem.seen.ravel() > 0
    inverse = np.linalg.inv(total_covariance(problem)[np.ix_(rows, rows)])
    flat = problem.columns.reshape(len(rows), -1)[rows][:, problem.flat]
    y = problem.y.ravel()[rows]
    scale = np.linalg.norm(flat, axis=0)
    unit = flat / np.where(scale > 0, scale, 1.0)
    fitted = unit @ np.linalg.pinv(unit.T @ inverse @ unit, rcond=1e-11) @ unit.T @ inverse @ y
    expected = inverse @ (y - fitted)
    np.testing.assert_allclose(solution.weighted.ravel()[rows], expected, atol=1e-5 * np.abs(expected).max())
    variances = problem.model.variances(problem.robot)[problem.random]
    random = problem.random_columns[rows]
    np.testing.assert_allclose(
        solution.coefficients[problem.random],
        variances * (random.T @ expected),
        atol=1e-5 * np.sqrt(variances.max()),
    )
    np.testing.assert_allclose(
        flat @ solution.coefficients[problem.flat], fitted, atol=1e-5 * np.abs(fitted).max()
    )


@pytest.mark.parametrize("form", [dense, by_coefficients])
def test_the_gradient_is_the_derivative(
    problem: LinearProblem, form: Callable[[LinearProblem], Solution]
) -> None:
    names = unknown_scales(problem.model, problem.parts, problem.robot)
    gradient, _ = derivatives(form(problem), names)
    for name, derivative in zip(names, gradient, strict=True):
        value, step = problem.model.values[name], 1e-4
        sides = [
            form(problem.at(problem.model.with_values({name: value * np.exp(s)}))).value for s in (step, -step)
        ]
        assert derivative == pytest.approx((sides[0] - sides[1]) / (2 * step), rel=1e-4, abs=1e-3)
    _, gradients, _ = penalty(problem.model.with_values({names[0]: 1e-3}), names)
    sides = [penalty(problem.model.with_values({names[0]: 1e-3 * np.exp(s)}), names)[0] for s in (1e-5, -1e-5)]
    assert gradients[0] == pytest.approx((sides[0] - sides[1]) / 2e-5, rel=1e-6)


def test_the_value_is_the_restricted_likelihood(problem: LinearProblem) -> None:
    """Its differences between scales are those of y's contrasts, free of the flat columns."""
    rows = problem.seen.ravel() > 0
    flat = problem.flat_columns[rows]
    basis = np.linalg.qr(np.hstack([flat, np.eye(len(flat))]))[0][:, flat.shape[1] :]
    contrast = basis.T @ problem.y.ravel()[rows]

    def direct(p: LinearProblem) -> float:
        covariance = basis.T @ total_covariance(p)[np.ix_(rows, rows)] @ basis
        return float(np.linalg.slogdet(covariance)[1] + contrast @ np.linalg.solve(covariance, contrast))

    other = problem.at(problem.model.with_values({"gravity": 4e-3, "floor": 6e-5, "smooth.length": 0.7}))
    expected = direct(other) - direct(problem)
    assert dense(other).value - dense(problem).value == pytest.approx(expected, rel=1e-6)


def test_the_maximum_is_one(problem: LinearProblem) -> None:
    best = maximise(problem, 200, 1e-9)
    names = unknown_scales(best.problem.model, problem.parts, problem.robot)
    gradient, _ = derivatives(best, names)
    assert np.abs(gradient + penalty(best.problem.model, names)[1]).max() < 1e-2
    for name in names:
        for factor in (0.5, 2.0):
            model = best.problem.model.with_values({name: best.problem.model.values[name] * factor})
            moved = dense(problem.at(model)).value + penalty(model, names)[0]
            assert moved > best.value + penalty(best.problem.model, names)[0]


@pytest.mark.parametrize("form", [dense, by_coefficients])
def test_what_uncertain_scales_add_is_the_slope_of_the_estimate(
    form: Callable[[LinearProblem], Solution],
) -> None:
    problem = problem_of(10, 2)
    names, covariance = scale_covariance(form(problem))
    gradients = []
    for name in names:
        value, step = problem.model.values[name], 1e-4
        sides = [
            form(problem.at(problem.model.with_values({name: value * np.exp(s)}))).coefficients
            for s in (step, -step)
        ]
        gradients.append((sides[0] - sides[1]) / (2 * step))
    gradient = np.transpose(gradients)
    solution = form(problem)
    added = with_uncertain_scales(solution, (names, covariance)) - solution.posterior()
    expected = gradient @ covariance @ gradient.T
    np.testing.assert_allclose(added, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("form", [dense, by_coefficients])
def test_the_covariance_of_the_scales_is_twice_the_inverse_of_the_average_information(
    form: Callable[[LinearProblem], Solution],
) -> None:
    """f_aᵀ P f_b of Gilmour, Thompson & Cullis with P of all contrasts, f_a by differences of the whole V."""
    problem = problem_of(10, 2)
    names, covariance = scale_covariance(form(problem))
    flat, y = problem.flat_columns, problem.y.ravel()
    basis = np.linalg.qr(np.hstack([flat, np.eye(len(flat))]))[0][:, flat.shape[1] :]
    projection = basis @ np.linalg.inv(basis.T @ total_covariance(problem) @ basis) @ basis.T
    pushes = []
    for name in names:
        model, step = problem.model, 1e-4
        sides = [
            total_covariance(problem.at(model.with_values({name: model.values[name] * np.exp(s)})))
            for s in (step, -step)
        ]
        pushes.append((sides[0] - sides[1]) @ projection @ y / (2 * step))
    factors = np.array([s.factor for s in problem.model.scales if s.name in names])
    information = np.array(pushes) @ projection @ np.transpose(pushes) + np.diag(2.0 / np.log(factors) ** 2)
    np.testing.assert_allclose(np.linalg.inv(covariance), 0.5 * information, atol=1e-5 * information.max())


def test_flat_columns_that_no_point_shows_have_no_part_in_the_basis() -> None:
    problem = problem_of(9, 2, missing=tuple((visit, 1) for visit in range(9)))
    rows = problem.columns[:, :, problem.flat].reshape(problem.y.size, -1)
    unseen = ~rows.any(axis=0)
    assert unseen.sum() == 3 and not problem.basis[unseen].any()
    np.testing.assert_allclose(
        problem.flat_columns.T @ problem.flat_columns, np.eye(rows.shape[1] - 3), atol=1e-7
    )


def test_a_scale_stays_within_its_bounds() -> None:
    """Between 0.005 and 300 times its median; a thousand million times where nothing is known of it."""
    model = replace(ErrorModel.paper(), scales=(replace(ErrorModel.paper().scales[0], value=2e-5, median=1e-4),))
    for step, share in ((np.log(3.0), 0.6), (-60.0, 1e-9), (60.0, 1e9)):
        assert _moved(model, ("floor",), np.array([step])).values["floor"] == pytest.approx(
            1e-4 * share, rel=1e-9, abs=0.0
        )
    known = typical()
    median = {s.name: s.median for s in known.scales}["gravity"]
    for step, share in ((-60.0, 5e-3), (60.0, 300.0)):
        assert _moved(known, ("gravity",), np.array([step])).values["gravity"] == pytest.approx(share * median)


@pytest.mark.parametrize("targets", [1, 2])
def test_visits_that_come_go_and_lose_weight_are_the_same_as_solving_anew(targets: int) -> None:
    whole = problem_of(20, targets, missing=((4, 0),))
    some, doubt = np.arange(14), np.zeros((17, targets))
    doubt[5] = 1e-6
    chosen = np.array([*range(8), 10, *range(12, 20)])

    def part(rows: np.ndarray, doubt: np.ndarray | None) -> LinearProblem:
        some = of_visits(whole, rows)
        return some if doubt is None else replace(some, parts={**some.parts, "doubt": part_of(doubt)})

    start = updatable(dense(part(some, None)))
    changed = exchange(start, part(chosen, doubt), np.where(chosen < 14, chosen, -1))
    fresh = part(chosen, doubt)
    fresh.__dict__["basis"] = start.problem.basis  # log|S| depends on it
    anew = by_coefficients(fresh)
    assert changed.value == pytest.approx(anew.value, rel=1e-7)
    rows = np.random.default_rng(0).standard_normal((fresh.y.size, 2)) * fresh.seen.reshape(-1, 1)
    pairs = [
        (changed.coefficients, anew.coefficients),
        (changed.weighted, anew.weighted),
        (changed.blocks, anew.blocks),
        (changed.squares, anew.squares),
        (changed.pulls, anew.pulls),
        (changed.posterior(), anew.posterior()),
        (changed.project(rows), anew.project(rows)),
        (changed.coefficients_of(rows), anew.coefficients_of(rows)),
    ]
    for a, b in pairs:
        np.testing.assert_allclose(a, b, atol=2e-6 * np.abs(b).max())


def test_points_that_moved_are_the_same_as_solving_anew() -> None:
    problem = problem_of(12, 2, missing=((4, 0),))
    change = 1e-4 * np.random.default_rng(1).standard_normal(problem.y.shape) * problem.seen
    moved = with_points_moved(updatable(dense(problem)), change)
    anew = by_coefficients(replace(problem, y=problem.y + change))
    for a, b in ((moved.coefficients, anew.coefficients), (moved.weighted, anew.weighted)):
        np.testing.assert_allclose(a, b, atol=2e-6 * np.abs(b).max())


def test_a_visit_that_alone_tells_a_direction_cannot_be_taken_away() -> None:
    start = updatable(dense(problem_of(3, 1, "flat")))
    problem = start.problem
    rows = np.arange(2)
    with pytest.raises(np.linalg.LinAlgError):
        exchange(start, of_visits(problem, rows), rows)


# ── left out ─────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("form", [dense, by_coefficients, lambda problem: updatable(dense(problem))])
def test_left_out_residuals_are_those_of_a_refit_without_the_group(
    form: Callable[[LinearProblem], Solution],
) -> None:
    problem, groups = problem_of(10, 2, missing=((3, 1),)), np.array([0, 1, 1, 2, 3, 4, 5, 2, 6, 2])
    found = left_out(form(problem), groups)
    single = left_out(form(problem))
    np.testing.assert_allclose(found.residuals[[0, 4]], single.residuals[[0, 4]], rtol=1e-9)
    for group in (0, 1, 2, 5):
        visits = np.flatnonzero(groups == group)
        rest = np.flatnonzero(groups != group)
        without = form(of_visits(problem, rest))
        columns = problem.columns[visits].reshape(-1, problem.columns.shape[2])
        residual = problem.y[visits].ravel() - columns @ without.coefficients
        np.testing.assert_allclose(found.residuals[visits].ravel(), residual, atol=1e-4 * np.abs(residual).max())
        covariance = columns @ without.posterior() @ columns.T
        m = problem.y.shape[1]
        for k, visit in enumerate(visits):
            own = slice(k * m, k * m + m)
            covariance[own, own] += problem.covariance[visit]
            expected = covariance[own, own]
            np.testing.assert_allclose(found.covariance[visit], expected, atol=1e-4 * np.abs(expected).max())
        seen = problem.seen[visits].ravel() > 0
        flat, own_covariance = residual[seen], covariance[np.ix_(seen, seen)]
        square = flat @ np.linalg.solve(own_covariance, flat)
        assert found.squares[group] == pytest.approx(square, rel=1e-4)
        assert found.freedom[group] == seen.sum()
        score = -0.5 * (square + np.linalg.slogdet(2.0 * np.pi * own_covariance)[1])
        assert found.scores[group] == pytest.approx(score, rel=1e-6)
    assert found.usable.sum() == 19


def test_what_left_out_residuals_tell_is_what_their_covariances_say() -> None:
    """Every number of a group from the dense P; points that are doubted or not seen do not count."""
    plain, doubt = problem_of(9, 2, missing=((3, 1), (6, 0), (6, 1))), np.zeros((9, 2))
    doubt[2, 0] = doubt[7, 1] = 1e-8
    problem = replace(plain, parts={**plain.parts, "doubt": part_of(doubt)})
    groups = np.array([1, 0, 0, 2, 3, 4, 5, 3, 7])  # none of number 6
    solution = dense(problem)
    found = left_out(solution, groups)
    seen = np.ones((9, 2), bool)
    seen[3, 1] = seen[6] = False
    np.testing.assert_array_equal(found.seen, seen)
    np.testing.assert_array_equal(found.doubted, doubt > 0)
    np.testing.assert_array_equal(found.usable, seen & (doubt == 0))
    whole = np.zeros((54, 54))
    for visit in range(9):
        whole[6 * visit : 6 * visit + 6, 6 * visit : 6 * visit + 6] = problem.covariance[visit]
    squares, variances, spread = [], [], 0.0
    for group in range(8):
        rows = np.flatnonzero(np.repeat(groups == group, 6))
        measured, counts = (np.repeat(mask.ravel(), 3)[rows] for mask in (seen, found.usable))
        if not measured.any():
            assert found.freedom[group] == found.squares[group] == found.scores[group] == 0.0
            continue
        precision, own = (m[np.ix_(rows[measured], rows[measured])] for m in (solution.projection, whole))
        covariance = np.linalg.inv(precision)
        residual = covariance @ solution.weighted.ravel()[rows[measured]]
        at, counted = found.residuals.reshape(-1)[rows[measured]], counts[measured]
        np.testing.assert_allclose(at, residual, atol=1e-6 * np.abs(residual).max())
        squares += list(np.sum(residual[counted].reshape(-1, 3) ** 2, axis=1))
        variances += list(np.diag(covariance)[counted].reshape(-1, 3).sum(axis=1))
        left = np.trace(own @ precision) / measured.sum()
        expected = 2.0 * np.sum(covariance[np.ix_(counted, counted)] ** 2) * (2.0 - left)
        assert found.spread[group] == pytest.approx(expected, rel=1e-5, abs=0.0)
        spread += expected
        square = residual @ precision @ residual
        assert found.squares[group] == pytest.approx(square, rel=1e-6)
        density = np.linalg.slogdet(precision)[1] - square - measured.sum() * np.log(2.0 * np.pi)
        assert found.scores[group] == pytest.approx(0.5 * density, rel=1e-6)
    assert found.score == pytest.approx(found.scores.sum())
    np.testing.assert_allclose(np.sort(found.distances**2), np.sort(squares), rtol=1e-5)
    assert found.rms == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-6)
    assert found.predicted_rms == pytest.approx(np.sqrt(np.mean(variances)), rel=1e-6)
    expected = (found.rms / found.predicted_rms, np.sqrt(spread) / (2.0 * np.sum(variances)))
    assert found.excess == pytest.approx(expected, rel=1e-5)


def test_groups_of_one_visit_each_may_have_any_numbers() -> None:
    """Asked for again in another order, the groups' numbers go with their visits."""
    problem, order = problem_of(6, 1), np.array([4, 2, 0, 5, 1, 3])
    solution = dense(problem)
    first, again, fresh = left_out(solution), left_out(solution, order), left_out(dense(problem), order)
    assert left_out(solution) is first
    for name in ("squares", "freedom", "scores", "spread"):
        np.testing.assert_allclose(getattr(again, name)[order], getattr(first, name), rtol=1e-12)
        np.testing.assert_allclose(getattr(again, name), getattr(fresh, name), rtol=1e-9)
    some = np.array([0, 1, 1, 2, 3, 4])
    np.testing.assert_allclose(
        left_out(solution, some).squares, left_out(dense(problem), some).squares, rtol=1e-9
    )


@pytest.mark.parametrize(("visits", "targets"), [(12, 1), (15, 3), (40, 1), (30, 2)])
def test_how_far_the_left_out_rms_is_from_its_prediction_by_chance(visits: int, targets: int) -> None:
    """Against the trace over all residuals, and against measurements drawn from the model."""
    problem = problem_of(visits, targets)
    solution = dense(problem)
    found, m = left_out(solution), problem.y.shape[1]
    whole = np.zeros((visits * m, visits * m))
    for i in range(visits):
        whole[i * m : i * m + m, i * m : i * m + m] = found.covariance[i]
    apart = whole @ solution.projection @ whole
    assert np.sqrt(found.spread.sum()) == pytest.approx(np.sqrt(2.0 * np.sum(apart**2)), rel=0.2)
    rng = np.random.default_rng(0)
    draws = np.linalg.cholesky(total_covariance(problem)) @ rng.standard_normal((visits * m, 2000))
    sums = np.sum((whole @ (solution.projection @ draws)) ** 2, axis=0)
    expected = found.usable.sum() * found.predicted_rms**2
    assert np.mean(sums) == pytest.approx(expected, rel=0.1)
    ratio, std = found.excess
    assert ratio == pytest.approx(found.rms / found.predicted_rms)
    assert std == pytest.approx(0.5 * np.std(sums) / expected, rel=0.25)


def test_a_visit_that_alone_tells_a_direction_has_no_left_out_residual() -> None:
    robot = ur10e(1)
    q = np.tile(random_configurations(robot, 1), (6, 1)) / 3.0
    q[5] += [0.1, 0.5, -0.4, 0.3, 0.5, 0.0]  # five visits at one configuration tell three of four zeros
    data, _ = simulated(robot, {}, 6, 0)
    points = robot.positions(q) + 3e-5 * np.random.default_rng(0).standard_normal((6, 1, 3))
    model = replace(ErrorModel.paper(3e-5), placement=Placement("flat"))
    zeros = [f"{name}_joint.rz" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_2")]
    some = robot.with_parameters(",".join(zeros))
    work = _Work(some, type(data)(robot.joint_names, q, points), model)
    solution = dense(work.linearised())
    found = left_out(solution)
    assert np.isfinite(found.scores).all() and found.usable[:5].all()
    # In the two directions that it has one in, the eigenvectors of R^½ P R^½, all is as for other visits.
    assert found.freedom.tolist() == [3, 3, 3, 3, 3, 2]
    assert found.spread[5] == 0.0 and not found.usable[5].any() and (found.spread[:5] > 0.0).all()
    root = np.linalg.cholesky(solution.problem.covariance[5])
    values, vectors = np.linalg.eigh(root.T @ solution.blocks[5] @ root)
    assert values[0] < 1e-10 and values[1] > 1e-6
    turned = vectors[:, 1:].T @ root.T @ solution.weighted[5]
    residual = root @ vectors[:, 1:] @ (turned / values[1:])
    np.testing.assert_allclose(found.residuals[5, 0], residual, atol=1e-6 * np.abs(residual).max())
    assert found.squares[5] == pytest.approx(np.sum(turned**2 / values[1:]), rel=1e-6)
    density = np.log(values[1:]).sum() - 2.0 * np.log(np.diag(root)).sum() - 3.0 * np.log(2.0 * np.pi)
    assert found.scores[5] == pytest.approx(0.5 * (density - found.squares[5]), rel=1e-6)


def test_thousands_of_points_are_the_same_problem() -> None:
    """The estimate from many visits (by coefficients) is the dense one of the same linear problem."""
    robot = ur10e(2)
    data, _ = simulated(robot, {"gravity": 2e-3}, 120, 1)
    found = fit_error_model(unknown(robot), data, typical())
    other = dense(found.solution.problem)
    np.testing.assert_allclose(
        other.coefficients, found.solution.coefficients, atol=1e-6 * np.abs(other.coefficients).max()
    )
    assert found.converged and not found.doubt.any()
