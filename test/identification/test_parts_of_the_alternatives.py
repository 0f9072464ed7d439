# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Parts of the search for alternatives, each against its definition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from fits import simulated, unknown, ur10e
from robots import mixed, random_configurations
from scipy.stats import f as f_distribution

from calib_planner import IdentificationProblem, Measurements, Robot, identify
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, JointFunctions, Placement, Poses, Prior, joint_units, typical
from calib_planner.identification import alternatives, fit_error_model
from calib_planner.identification.alternatives import (
    FULL_FIRST,
    _answer,
    _by_chance,
    _carried,
    _exchanged_rows,
    _exchanged_targets,
    _Fine,
    _Gross,
    _Left,
    _Misplaced,
    _Question,
    _ranges,
    _rows,
    _scan,
    _simplest,
    _spread,
    _statistics,
    _stretch,
    _usual,
    _widened,
    explain_gross,
    find_alternatives,
)
from calib_planner.identification.estimation import ModelEstimate, _Work
from calib_planner.identification.left_out import left_out
from calib_planner.identification.likelihood import LinearProblem, maximise, solve
from calib_planner.identification.registration import tip_poses
from calib_planner.robot import rotation

SMALL = replace(typical(), joint_functions=JointFunctions(("smooth",), harmonics=4))
PLACEMENT = replace(typical(), joint_functions=None, gravity=None)
SIZES = {"gravity": 2e-3, "smooth.size": 3e-4, "repeatability": 5e-5, "shared": 3e-5}
POSES = random_configurations(ur10e(), 5, 9) / 3.0


@cache
def measured(count: int = 18, targets: int = 2) -> Measurements:
    return simulated(ur10e(targets), SIZES, count, 3)[0]


@cache
def fitted() -> ModelEstimate:
    return fit_error_model(unknown(ur10e()), measured(), SMALL)


def fine(
    data: Measurements | None = None,
    fit: ModelEstimate | None = None,
    poses: FloatArray | None = POSES,
    frame: str = "world",
) -> _Fine:
    return _Fine(data or measured(), fit or fitted(), poses, frame)


def changed(data: Measurements, points: FloatArray) -> Measurements:
    return Measurements(data.joint_names, data.q, points)


# ── columns ──────────────────────────────────────────────────────────────────────────────────────────


def turned_by(axis: int, points: FloatArray, centre: FloatArray, angle: float) -> FloatArray:
    return (points - centre) @ rotation(axis, angle).T + centre


def moved_points(question: _Question, poses: Poses, amount: int, step: float, centre: FloatArray) -> FloatArray:
    """The points (N, targets, 3) with one amount of a fault that has been there from the first visit on."""
    points, robot = poses.points, poses.robot
    if question.code in ("push", "drift"):
        if amount < 3:
            return points + step * np.eye(3)[amount]
        return turned_by(amount - 3, points, centre, step)
    if question.code in ("reseat", "tool"):
        offsets = np.array(robot.target_offsets)
        which = slice(None) if question.target is None else slice(question.target, question.target + 1)
        if amount < 3:
            offsets[which] += step * np.eye(3)[amount]
        else:
            offsets[which] = offsets[which] @ rotation(amount - 3, step).T
        return replace(poses, robot=robot.with_targets(offsets)).points
    if question.code == "scale":
        return points * (1.0 + step)
    assert question.joint is not None
    turn = np.zeros(poses.q.shape)
    if question.code == "joint_step":
        turn[:, question.joint] = step * joint_units(robot)[question.joint]
    else:
        shown = question.joint if question.beside is None else question.beside
        turn[:, question.joint] = step * poses.q[:, shown]
    return replace(poses, deflection=poses.deflection + turn / joint_units(robot)).points


@cache
def sliding() -> tuple[Measurements, ModelEstimate]:
    robot = mixed().with_parameters("full")
    q = random_configurations(robot, 16, 2)
    points = robot.positions(q) + 1e-4 * np.random.default_rng(0).standard_normal((16, 2, 3))
    data = Measurements(robot.joint_names, q, points)
    return data, fit_error_model(robot, data, SMALL)


@pytest.mark.parametrize("kind", ["turning", "sliding"])
def test_columns_are_differences_of_the_points_with_the_fault_and_without(kind: str) -> None:
    """At the measured configurations and at the test poses, where whatever came late is there."""
    data, fit = (measured(), fitted()) if kind == "turning" else sliding()
    poses = POSES if kind == "turning" else random_configurations(mixed(), 4, 5)
    one = fine(data, fit, poses)
    centre = fit.knowledge.poses(data.q).points.reshape(-1, 3).mean(axis=0)
    seen, n, step = set(), len(data), 1e-6
    for question in one.questions(fit.solution):
        here, there = fit.knowledge.poses(data.q), fit.knowledge.poses(poses)
        columns = question.columns.reshape(n, 2, 3, -1)
        for amount in range(columns.shape[3]):
            for place, got in ((here, columns), (there, question.there)):
                ends = [moved_points(question, place, amount, s, centre) for s in (step, -step)]
                expected = (ends[0] - ends[1]) / (2.0 * step)
                if question.code == "drift" and place is here:
                    expected = expected * np.linspace(0.0, 1.0, n)[:, None, None]
                if question.code == "scale" and place is there:
                    expected = 0.0 * expected  # the robot itself is as large as it is
                np.testing.assert_allclose(got[..., amount], expected, atol=1e-7)
        seen.add((question.code, question.target, question.joint, question.beside, question.cut))
    turns = list(data.joint_names) if kind == "turning" else ["turn", "spin", "nod"]
    joints = range(len(data.joint_names))
    of_turning = [j for j in joints if data.joint_names[j] in turns]
    expected = {("push", None, None, None, True), ("tool", None, None, None, True)}
    expected |= {("drift", None, None, None, False), ("scale", None, None, None, False)}
    expected |= {("reseat", t, None, None, True) for t in range(2)}
    expected |= {("joint_step", None, j, None, True) for j in joints}
    expected |= {("ratio", None, j, None, False) for j in joints}
    expected |= {("couple", None, j, k, False) for j in of_turning for k in of_turning if j != k}
    assert seen == expected


def test_a_joint_that_stood_still_and_a_tool_of_one_target_are_not_suspected() -> None:
    data = measured()
    q = np.array(data.q)
    q[:, 2] = 0.4
    one = fine(Measurements(data.joint_names, q, data.p))
    told = {(x.code, x.joint, x.beside) for x in one.questions(fitted().solution)}
    assert all(2 not in (joint, beside) for _, joint, beside in told) and ("joint_step", 3, None) in told
    single = measured(18, 1)
    fit = fit_error_model(unknown(ur10e(1)), single, SMALL)
    assert "tool" not in {x.code for x in fine(single, fit).questions(fit.solution)}


def test_a_fault_that_began_late_moves_the_visits_from_then_on() -> None:
    question = next(x for x in fine().questions(fitted().solution) if x.code == "push")
    for row in (5, 11):
        late = question.at(3).at(row)
        assert late.row == row and not late.cut
        assert not late.columns[:row].any()
        np.testing.assert_array_equal(late.columns[row:], question.columns[row:])
        np.testing.assert_array_equal(late.there, question.there)


def test_without_test_poses_predictions_are_compared_at_some_measured_configurations() -> None:
    robot = ur10e()
    q = random_configurations(robot, 50, 1)
    one = fine(Measurements(robot.joint_names, q, robot.positions(q)), poses=None)
    rows = [int(np.flatnonzero((q == pose).all(axis=1))[0]) for pose in one.poses]
    assert len(rows) == 20 and rows[0] == 0 and rows[-1] == 49 and set(np.diff(rows)) <= {2, 3}
    np.testing.assert_array_equal(fine(poses=np.zeros((0, 6))).poses, measured().q)


# ── evidence ─────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(("first", "last"), [(0, 5), (12, 18), (7, 12)])
def test_a_run_that_is_shifted_is_a_push_at_one_of_its_ends_or_a_block(first: int, last: int) -> None:
    """A push that turned nothing, before the visit that follows the run or before its first."""
    inside = (np.arange(18) >= first) & (np.arange(18) < last)
    data = changed(measured(), measured().p + 3e-3 * inside[:, None, None])
    one, solution = fine(data), solve(_Work(unknown(ur10e()), data, SMALL).linearised())
    (question,) = one._runs(solution)
    columns = np.tile(np.eye(3), (18, 2, 1))
    there = np.zeros((5, 2, 3, 3)) if question.code == "block" else np.tile(np.eye(3), (5, 2, 1, 1))
    if question.code == "block":
        assert (first, last) == (7, 12) and question.rows == tuple(range(7, 12)) and question.row == 7
        columns = columns * inside[:, None, None]
    else:
        assert question.code == "push" and question.rows == () and question.row == (last if first == 0 else first)
        columns = columns * (np.arange(18) >= question.row)[:, None, None]
    np.testing.assert_array_equal(question.columns, columns)
    np.testing.assert_array_equal(question.there, there)
    assert not question.cut and list(one._runs(fitted().solution)) == []


@cache
def plain() -> LinearProblem:
    """The paper's model: ordinary least squares with 1e-4 m of noise; two points were not seen."""
    robot, data = ur10e(), measured()
    points = np.array(data.p)
    points[3, 1] = points[7, 0] = np.nan
    return _Work(robot, changed(data, points), ErrorModel.paper(1e-4)).linearised()


def test_the_f_ratio_is_that_of_nested_least_squares() -> None:
    """By the residuals of two fits of NumPy; columns that are a combination of others do not count."""
    problem = plain()
    solution, rng = solve(problem), np.random.default_rng(0)
    use = problem.seen.ravel() > 0
    rows, y = problem.columns.reshape(problem.y.size, -1)[use], problem.y.ravel()[use]
    base, _, rank, _ = np.linalg.lstsq(rows, y, rcond=1e-9)
    before = np.sum((y - rows @ base) ** 2)
    for count, twice in ((1, False), (3, False), (2, True)):
        columns = rng.standard_normal((*problem.y.shape, count))
        if twice:
            columns[..., 1] = 2.0 * columns[..., 0] + problem.columns[..., 3]
        both = np.hstack([rows, columns.reshape(-1, count)[use]])
        more, _, whole, _ = np.linalg.lstsq(both, y, rcond=1e-9)
        after = np.sum((y - both @ more) ** 2)
        d, spare = whole - rank, len(y) - whole
        ratio = (before - after) / d / (after / spare)
        question = _Question("drift", columns, np.zeros((1, 2, 3, count)))
        answer = _answer(solution, question, _statistics(solution, [columns])[0], 7.0)
        assert answer.freedom == d == (1 if twice else count)
        assert answer.statistic == pytest.approx(ratio, rel=1e-5)
        assert answer.probability == pytest.approx(f_distribution.sf(ratio, d, spare), rel=1e-4)
        assert answer.counted == pytest.approx(min(1.0, 7.0 * answer.probability))


def test_columns_and_doubts_leave_alone_what_was_not_seen() -> None:
    problem = plain()
    blind = problem.seen == 0.0
    columns = np.random.default_rng(0).standard_normal((*problem.y.shape, 2))
    wide = _widened(problem, columns)
    np.testing.assert_array_equal(wide.columns[..., :-2], problem.columns)
    np.testing.assert_array_equal(wide.columns[~blind, -2:], columns[~blind])
    assert blind.sum() == 6 and not wide.columns[blind, -2:].any()
    assert wide.flat.tolist() == [*problem.flat, problem.columns.shape[2], problem.columns.shape[2] + 1]
    doubt = np.random.default_rng(1).uniform(0.0, 1.0, (18, 2))
    doubtful = _Fine._with(problem, doubt)
    for n in range(18):
        expected = problem.covariance[n] + np.diag(np.repeat(doubt[n], 3) * problem.seen[n])
        np.testing.assert_allclose(doubtful.covariance[n], expected, rtol=1e-12)
    for without in (_Fine._with(doubtful, 0.0 * doubt), _Fine._with(problem, 0.0 * doubt)):
        np.testing.assert_array_equal(without.covariance, problem.covariance)


def test_no_evidence_without_columns_of_its_own_or_with_few_coordinates_to_spare() -> None:
    problem = plain()
    solution = solve(problem)
    columns = problem.columns[..., [2]]
    question = _Question("drift", columns, np.zeros((1, 2, 3, 1)))
    answer = _answer(solution, question, _statistics(solution, [columns])[0], 1.0)
    assert (answer.statistic, answer.freedom, answer.probability) == (0.0, 0, 1.0)
    spare = int(problem.seen.sum()) - problem.basis.shape[1]
    value = float(np.sum(problem.y * solution.weighted))
    for rank, told in ((spare - 6, True), (spare - 5, False)):
        answer = _answer(solution, question, (0.999 * value, rank), 1.0)
        assert (answer.probability < 1.0 and answer.statistic > 0.0) == told
    # Columns that explain everything leave nothing to divide by.
    assert _answer(solution, question, (value, 3), 1.0).probability == 0.0


def test_every_question_and_every_visit_it_may_begin_at_is_counted() -> None:
    """Drift, scale, 6 ratios, 30 couplings; push, two targets, tool, 6 joints at each of 13 visits."""
    answers = list(fine()._answers(fitted().solution))
    assert len(answers) == 48 and {a.count for a in answers} == {38.0 + 13 * 10}
    assert all(
        (a.question.row is not None) == (a.question.code in ("push", "reseat", "tool", "joint_step"))
        for a in answers
    )


@pytest.mark.parametrize("began", [3, 23, 37])
def test_the_visit_at_which_it_began_is_that_of_the_largest_statistic(began: int) -> None:
    """Also where not every visit is tried at once, and at the first and last that may be."""
    data = measured(40)
    shifted = changed(data, data.p + 2e-3 * (np.arange(40) >= began)[:, None, None])
    work = _Work(unknown(ur10e()), shifted, SMALL)
    solution, one = solve(work.linearised()), fine(shifted)
    question = next(x for x in one.questions(solution) if x.code == "push")
    cuts = np.arange(3, 38)
    values, ranks = _scan(solution, question.columns, cuts)
    best = int(np.argmax(values))
    assert cuts[best] == began
    for some in (cuts, np.linspace(3, 37, 8).astype(int), cuts[[0, 10, 34]]):
        row, (value, rank) = _Fine._best_cut(solution, question, some)
        assert (row, rank) == (cuts[best], ranks[best]) and value == pytest.approx(values[best], rel=1e-6)


def test_of_many_visits_some_are_tried_first_and_then_those_about_the_best(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slipped, fit = slipping()

    def told() -> dict[tuple[Any, ...], tuple[int | None, float]]:
        answers = fine(slipped, fit)._answers(fit.solution)
        return {
            (a.question.code, a.question.target, a.question.joint, a.question.beside): (
                a.question.row,
                a.statistic,
            )
            for a in answers
        }

    every = told()
    monkeypatch.setattr(alternatives, "MOST_CUTS", 7)
    some = told()
    for key in (("joint_step", None, 3, None), ("push", None, None, None)):
        assert some[key] == (every[key][0], pytest.approx(every[key][1])) and some[key][0] not in (None, 3)


def test_scales_that_have_swollen_are_tried_at_their_usual_upper_end() -> None:
    model = typical()
    usual = {s.name: s.median * np.sqrt(s.factor) for s in model.scales}
    work = _Work(unknown(ur10e()), measured(), model)
    assert _usual(work.linearised()).model.values == model.values
    grown = model.with_values({"floor": 1.51 * usual["floor"], "shared": 1.49 * usual["shared"], "gravity": 9.0})
    work = _Work(unknown(ur10e()), measured(), grown)
    problem = work.linearised()
    values = _usual(problem).model.values
    assert values == pytest.approx(grown.values | {"floor": usual["floor"], "gravity": usual["gravity"]})
    np.testing.assert_allclose(_usual(problem).parts["floor"] * 1.51**2, problem.parts["floor"], rtol=1e-9)


def test_the_doubt_of_a_run_is_lifted_and_that_of_single_points_stays() -> None:
    """At least three of five neighbours in time; rows where the point was not seen are no neighbours."""
    data = measured(20)
    points = np.array(data.p)
    points[[6, 8], 0] = np.nan
    doubt = np.zeros((20, 2))
    doubt[[4, 5, 7, 15], 0] = 1.0  # neighbours: 6 and 8 were not seen
    doubt[[0, 1, 2, 10, 11, 13, 19], 1] = 2.0
    lifted = fine(changed(data, points))._lifted(doubt)
    assert np.flatnonzero(lifted[:, 0]).tolist() == [15]
    assert np.flatnonzero(lifted[:, 1]).tolist() == [10, 13, 19]
    few = np.zeros((20, 2))
    few[[3, 4], 0] = 1.0
    np.testing.assert_array_equal(fine(data)._lifted(few), few)


def test_predictions_are_compared_with_what_was_promised_of_them() -> None:
    known = fitted().knowledge
    rng = np.random.default_rng(0)
    change = 1e-4 * rng.standard_normal((5, 6))
    for frame in ("world", "robot"):
        one = fine(frame=frame)
        np.testing.assert_allclose(one._promised, known.accuracy(POSES, frame).per_pose, rtol=1e-6)
        points = known.poses(POSES).points
        common = turned_by(1, points, np.ones(3), 1e-6) - points + 1e-4
        for add in (0.0 * common, common):
            moved, deviations = one._moved(change + add.reshape(5, 6))
            if frame == "world" or not add.any():
                first = (moved, deviations)
            else:
                assert (moved, deviations) == pytest.approx(first, rel=1e-5)
        if frame == "world":
            lengths = np.sqrt(
                np.mean(np.sum((change + common.reshape(5, 6)).reshape(5, 2, 3) ** 2, axis=2), axis=1)
            )
            assert first == pytest.approx((lengths.max(), (lengths / one._promised).max()), rel=1e-9)


# ── an alternative in full ───────────────────────────────────────────────────────────────────────────


@cache
def slipping() -> tuple[Measurements, ModelEstimate]:
    """Joint 4 slips by 3 mrad before visit 10."""
    robot, data = ur10e(), measured()
    q = np.array(data.q)
    q[10:, 3] += 3e-3
    data = changed(data, data.p + (robot.positions(q) - robot.positions(data.q)))
    return data, fit_error_model(unknown(robot), data, SMALL)


def test_gain_and_movement_of_an_alternative_are_those_of_the_fit_with_its_columns() -> None:
    slipped, fit = slipping()
    told = find_alternatives(unknown(ur10e()), slipped, fit, POSES)
    best = told[0]
    assert (best.code, best.joint, best.row, best.unit) == ("joint_step", "wrist_1_joint", 10, "rad")
    assert best.size == pytest.approx(3e-3, rel=0.15) and best.freedom == 1
    assert "changed by 3" in best.text and "mrad before row 10" in best.text
    question = next(
        x for x in fine(slipped, fit).questions(fit.solution) if (x.code, x.joint) == ("joint_step", 3)
    ).at(10)
    wide = maximise(_widened(fit.solution.problem, question.columns), 30)
    assert best.gain == pytest.approx(left_out(wide).score - fit.left_out.score, rel=0.03)
    count = fit.solution.problem.columns.shape[2]
    there = np.concatenate(
        [fit.knowledge.model.columns(fit.knowledge.poses(POSES)), question.there.reshape(5, 6, 1)], axis=2
    )
    change = there @ (wide.coefficients - np.append(fit.solution.coefficients, 0.0))
    lengths = np.sqrt(np.mean(np.sum(change.reshape(5, 2, 3) ** 2, axis=2), axis=1))
    assert best.moved == pytest.approx(lengths.max(), rel=0.05) and len(wide.coefficients) == count + 1
    promised = fit.knowledge.accuracy(POSES).per_pose
    assert best.deviations == pytest.approx((lengths / promised).max(), rel=0.05)
    assert best.material == (best.deviations > 1.0)


def test_identify_looks_for_alternatives_unless_an_estimate_is_brought_up_to_date() -> None:
    robot = Robot.load("planar_2r")
    q = random_configurations(robot, 16, 1) / 2.0
    late = column(q, 1, q[:, 1] + 0.02 * (np.arange(16) >= 9))
    points = robot.positions(late) + 2e-5 * np.random.default_rng(0).standard_normal((16, 1, 3))
    problem = IdentificationProblem(robot, Measurements(robot.joint_names, q, points), error_model=PLACEMENT)
    estimate = identify(problem)
    (told,) = estimate.alternatives
    assert told.row == 9 and told.code in ("joint_step", "reseat")  # of the last joint that is the same
    again = identify(problem, estimate)
    assert again.alternatives == () and again.fit.iterations <= 2 < estimate.fit.iterations
    paper = identify(IdentificationProblem(robot, problem.data, 2e-5, ErrorModel.paper()))
    assert paper.alternatives == ()


def test_a_visit_on_the_wrong_side_of_a_step_is_no_witness_of_its_doubt() -> None:
    """Doubted because the step was put behind it or before it, it is heard again where the step is looked for."""
    slipped, fit = slipping()
    one = fine(slipped, fit)
    question = next(x for x in one.questions(fit.solution) if (x.code, x.joint) == ("joint_step", 3))
    for row, doubted in ((11, [10]), (12, [10, 11]), (9, [8, 9]), (10, [9])):
        doubt = np.zeros((18, 2))
        doubt[doubted] = 1.0
        null = solve(one._with(fit.solution.problem, doubt))
        assert one._row_again(question.at(row), null, doubt) == 10


def test_of_many_visits_one_alternative_is_named_at_the_scales_of_the_estimate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No run of visits is looked for, and what is told follows from the linear problem as it is."""
    slipped, fit = slipping()
    monkeypatch.setattr(alternatives, "ENOUGH", 53)  # of 108 coordinates
    (told,) = find_alternatives(unknown(ur10e()), slipped, fit, POSES)
    assert (told.code, told.joint, told.row) == ("joint_step", "wrist_1_joint", 10)
    one = fine(slipped, fit)
    question = next(x for x in one.questions(fit.solution) if (x.code, x.joint) == ("joint_step", 3)).at(10)
    wide = solve(_widened(fit.solution.problem, question.columns))
    assert told.gain == pytest.approx(left_out(wide).score - fit.left_out.score, rel=1e-6)
    assert told.size == pytest.approx(float(wide.coefficients[-1]), rel=1e-6)
    statistic = _answer(fit.solution, question, _statistics(fit.solution, [question.columns])[0], 1.0)
    assert told.statistic == pytest.approx(statistic.statistic, rel=1e-6) and told.freedom == 1
    assert told.probability == pytest.approx(statistic.probability * 168.0, rel=1e-6, abs=0.0)


def test_points_that_are_put_back_gain_what_the_fit_to_the_right_points_has() -> None:
    data = measured()
    points = np.array(data.p)
    points[[4, 12]] = points[[12, 4]]
    spoilt = changed(data, points)
    fit = fit_error_model(unknown(ur10e()), spoilt, SMALL)
    (told,) = find_alternatives(unknown(ur10e()), spoilt, fit, POSES)
    assert told.code == "rows" and told.rows == (4, 12) and told.row == 4 and told.size == 2.0
    assert told.gain == pytest.approx(fitted().left_out.score - fit.left_out.score, rel=0.1)
    own = fit.knowledge.predict(POSES).mean - fitted().knowledge.predict(POSES).mean
    lengths = np.sqrt(np.mean(np.sum(own**2, axis=2), axis=1))
    assert told.moved == pytest.approx(lengths.max(), rel=0.05)
    shares = lengths / fit.knowledge.accuracy(POSES).per_pose
    assert told.deviations == pytest.approx(shares.max(), rel=0.05) and told.material == (told.deviations > 1.0)


def test_parameters_three_prior_standard_deviations_away_are_freed_one_and_all() -> None:
    robot, data = ur10e(), measured()
    names = robot.parameter_names
    stated = Prior(names, np.array([p.nominal for p in robot.parameters]), np.full(len(names), 1e-4))
    true = robot.with_deviations({"elbow_joint.rz": 8e-4, "wrist_1_joint.y": 1.2e-3})
    points = true.positions(data.q) + 3e-5 * np.random.default_rng(0).standard_normal(data.p.shape)
    model = replace(
        typical(), placement=Placement(stated=stated), joint_functions=None, gravity=None, visits=None
    )
    fit = fit_error_model(robot, changed(data, points), model)
    one = fine(changed(data, points), fit)
    far = np.flatnonzero(np.abs(fit.solution.coefficients[: len(names)]) > 3e-4)
    far = far[np.argsort(-np.abs(fit.solution.coefficients[far]))]
    asked = [x for x in one.questions(fit.solution) if x.code == "prior"]
    assert len(far) > 1 and names[far[0]] == "wrist_1_joint.y"
    assert [x.rows for x in asked] == [(far[0],), tuple(far.tolist())]
    for question in asked:
        assert question.parameter == "wrist_1_joint.y"
        columns = robot.jacobian(data.q)[:, :, list(question.rows)]
        np.testing.assert_allclose(question.columns, columns, atol=5e-3)
        there = robot.jacobian(POSES)[:, :, list(question.rows)]
        np.testing.assert_allclose(question.there.reshape(there.shape), there, atol=5e-3)


@pytest.mark.parametrize(
    ("code", "fields", "amounts", "size", "unit", "text"),
    [
        ("push", {"row": 7}, [3e-4, 4e-4, 0.0, 0.0, 2e-3, 0.0], 5e-4, "m", "by 500 µm and 2 mrad before row 7"),
        ("push", {"row": 7}, [3e-4, 4e-4, 0.0], 5e-4, "m", "moved by 500 µm before row 7"),
        ("drift", {}, [0.0, 0.0, 2e-3, 0.0, 0.0, 0.0], 2e-3, "m", "crept by 2 mm and 0 mrad"),
        ("reseat", {"row": 7, "target": 1}, [1e-4, 0.0, 0.0], 1e-4, "m", "target 2 sits 100 µm elsewhere"),
        ("joint_step", {"row": 7, "joint": 2}, [-2.5e-3], -2.5e-3, "rad", "elbow_joint changed by -2.5 mrad"),
        ("scale", {}, [-2e-4], -2e-4, "1", "all distances are 0.9998 times"),
        ("ratio", {"joint": 1}, [0.01], 0.01, "1", "shoulder_lift_joint turns 1.01 times"),
        ("couple", {"joint": 4, "beside": 3}, [-0.0125], -0.0125, "1", "wrist_2_joint − 0.0125 × wrist_1_joint"),
        ("couple", {"joint": 4, "beside": 3}, [0.0125], 0.0125, "1", "wrist_2_joint + 0.0125 × wrist_1_joint"),
        ("block", {"row": 3, "rows": (3, 4, 5, 9)}, [0.0, 3e-4, 4e-4], 5e-4, "m", "rows 3–5, 9 are all shifted"),
        ("prior", {"parameter": "elbow_joint.x", "rows": (4,)}, [1.0], 1.0, "1", "1 parameter lies three"),
        ("prior", {"parameter": "elbow_joint.x", "rows": (4, 6)}, [1.0, 2.0], 2.0, "1", "2 parameters lie three"),
    ],
)  # fmt: skip
def test_an_alternative_in_words(
    code: str, fields: dict[str, Any], amounts: list[float], size: float, unit: str, text: str
) -> None:
    nothing = np.zeros((18, 6, len(amounts)))
    question = _Question(code, nothing, np.zeros((5, 2, 3, len(amounts))), **fields)
    told = fine()._told(question, np.array(amounts))
    assert told.code == code and told.size == pytest.approx(size) and told.unit == unit and text in told.text
    assert told.row == fields.get("row") and told.rows == (fields.get("rows", ()) if code == "block" else ())
    assert told.target == (2 if "target" in fields else None)
    names = measured().joint_names
    assert told.joint == (names[fields["joint"]] if "joint" in fields else None)
    assert told.beside == (names[fields["beside"]] if "beside" in fields else None)
    if code == "couple":
        sign, word = ("+", "−") if amounts[0] < 0.0 else ("-", "+")
        assert told.advice == (
            f"add --couple wrist_2_joint{sign}=0.0125*wrist_1_joint if the controller shows it so; otherwise "
            f"replace the column wrist_2_joint of the data by wrist_2_joint {word} 0.0125 × wrist_1_joint"
        )


def test_a_coupling_is_believed_when_all_parameters_are_free() -> None:
    data, robot = measured(), ur10e().with_parameters("lengths+offsets")
    fit = fit_error_model(robot, data, SMALL)
    question = _Question("couple", np.zeros((18, 6, 1)), np.zeros((5, 2, 3, 1)), joint=4, beside=3)
    assert fine(data, fit)._told(question, np.array([0.1])).advice.startswith(FULL_FIRST)


def test_a_sliding_joints_step_is_a_length() -> None:
    data, fit = sliding()
    at = data.joint_names.index("slide")
    question = _Question("joint_step", np.zeros((16, 6, 1)), np.zeros((4, 2, 3, 1)), row=5, joint=at)
    told = fine(data, fit, random_configurations(mixed(), 4, 5))._told(question, np.array([0.02]))
    # As many metres as a turn moves a point 0.15 m from the axis.
    assert told.unit == "m" and told.size == pytest.approx(3e-3) and "changed by 3 mm" in told.text


# ── points that belong elsewhere ─────────────────────────────────────────────────────────────────────


def scattered(count: int, targets: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, targets, 3))


def test_targets_that_were_exchanged_are_put_back() -> None:
    predicted = scattered(6, 3)
    p = predicted + 1e-4
    p[1, [0, 2]] = p[1, [2, 0]]
    p[3] = p[3, [1, 2, 0]]
    p[4, 1] += 0.5  # one alone is exchanged with none
    p[5, :2] += 0.5
    wrong = np.linalg.norm(p - predicted, axis=2) > 0.01
    told = _exchanged_targets(p, predicted, wrong, 1e-3)
    assert told is not None and told.code == "targets" and told.rows == (1, 3)
    expected = np.zeros((6, 3), bool)
    expected[1, [0, 2]] = expected[3] = True
    np.testing.assert_array_equal(told.moved, expected)
    np.testing.assert_allclose(told.points[expected], predicted[expected] + 1e-4)
    np.testing.assert_array_equal(told.points[~expected], p[~expected])
    assert told.words == {"size": "1, 2, 3", "where": " in rows 1, 3"}
    assert _exchanged_targets(p, predicted, wrong, 1e-5) is None
    assert _exchanged_targets(p, predicted, np.zeros((6, 3), bool), 1e-3) is None
    p[3] = predicted[3, [0, 0, 2]] + 1e-4  # two that fit one place
    told = _exchanged_targets(p, predicted, wrong, 1e-3)
    assert told is not None and told.rows == (1,) and told.words == {"size": "1, 3", "where": " in row 1"}


def test_rows_that_were_exchanged_are_put_back() -> None:
    predicted = scattered(8, 2)
    p = predicted + 1e-4
    p[[2, 5]] = p[[5, 2]]
    p[7, 0] += 0.5
    p[1, 1] = np.nan
    wrong = np.nan_to_num(np.linalg.norm(p - predicted, axis=2)) > 0.01
    told = _exchanged_rows(p, predicted, wrong, 1e-3)
    assert told is not None and told.code == "rows" and told.rows == (2, 5)
    expected = np.zeros((8, 2), bool)
    expected[[2, 5]] = True
    np.testing.assert_array_equal(told.moved, expected)
    np.testing.assert_allclose(told.points[expected], predicted[expected] + 1e-4)
    assert told.words == {"size": "the points of rows 2 and 5 are exchanged"}
    assert _exchanged_rows(p, predicted, wrong, 1e-5) is None
    # A point that is where another row's is right is told of, and stays where it is.
    p = predicted + 1e-4
    p[3] = p[6]
    wrong = np.linalg.norm(p - predicted, axis=2) > 0.01
    told = _exchanged_rows(p, predicted, wrong, 1e-3)
    assert told is not None and told.rows == (3,) and not told.moved.any()
    assert told.words == {"size": "the points of row 3 fit the joint values of others"}
    np.testing.assert_array_equal(told.points, p)
    # Where another target was seen the points are not moved either.
    p = predicted + 1e-4
    p[[2, 5]] = p[[5, 2]]
    p[2, 1] = np.nan
    wrong = np.nan_to_num(np.linalg.norm(p - predicted, axis=2)) > 0.01
    told = _exchanged_rows(p, predicted, wrong, 1e-3)
    assert told is not None and told.rows == (2, 5) and not told.moved.any()


@pytest.mark.parametrize(("way", "word"), [(1, "up"), (-1, "down"), (2, "up"), (-2, "down")])
def test_a_run_of_rows_that_slipped_is_told_by_how_far(way: int, word: str) -> None:
    """From row 3 to row 8 on each has the points of the one before, or of the one behind."""
    predicted = scattered(14, 1)
    p = np.array(predicted)
    p[3:9] = predicted[3 - way : 9 - way]
    wrong = (np.arange(14) >= 3) & (np.arange(14) < 9)
    told = _exchanged_rows(p, predicted, wrong[:, None], 1e-3)
    rows = "1 row" if abs(way) == 1 else "2 rows"
    assert told is not None and told.rows == tuple(range(3, 9))
    assert told.words["size"] == f"the points of rows 3–8 belong to the joint values {rows} further {word}"
    # Two that slipped otherwise are a minority; three are no run any more.
    for others, same in (((3, 4), True), ((3, 4, 5), False)):
        p[list(others)] = predicted[[13, 12, 11][: len(others)]]
        told = _exchanged_rows(p, predicted, wrong[:, None], 1e-3)
        assert told is not None and ("further" in told.words["size"]) == same


def test_what_chance_would_put_near_another_place() -> None:
    """Points a metre from their middle, a reach of 0.1 m: one of a thousand places; ten rows, three targets."""
    directions = scattered(10, 3)
    predicted = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    predicted -= np.median(predicted.reshape(-1, 3), axis=0)
    reach = 0.1 * _spread(predicted)
    nothing = np.zeros((10, 3), bool)
    for code, rows, expected in (
        ("rows", (1,), 10 * 1e-2),
        ("rows", (1, 4), 10 * 1e-4),
        ("targets", (1,), 10 * 3e-3),
        ("targets", (1, 4, 5), 10 * 27e-9),
    ):
        assert _by_chance(_Misplaced(code, predicted, nothing, rows, {}), predicted, reach) == pytest.approx(
            expected
        )
    assert _by_chance(_Misplaced("rows", predicted, nothing, (1,), {}), predicted, 1e3) == 1.0


def test_numbers_of_rows_in_words() -> None:
    assert _ranges((3, 4, 5, 12)) == "3–5, 12" and _ranges((7,)) == "7" and _ranges((1, 3, 4)) == "1, 3–4"
    assert _rows((3,)) == "row 3" and _rows((3, 4, 9)) == "rows 3–4, 9"


# ── gross ────────────────────────────────────────────────────────────────────────────────────────────


@cache
def planar(count: int = 20, targets: int = 1) -> tuple[Robot, FloatArray, FloatArray]:
    """A planar arm with two links, base and target unknown; configurations and exact points."""
    robot = Robot.load("planar_2r").with_targets([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]][:targets])
    robot = robot.with_parameters("lengths+offsets")
    q = random_configurations(robot, count, 5) / 2.0
    return robot, q, robot.positions(q)


def arm(targets: int = 1, unknowns: tuple[str, ...] = ("base", "tool")) -> Robot:
    return ur10e(targets).with_parameters("full", unknowns)


def gross(robot: Robot, q: FloatArray, p: FloatArray) -> _Gross:
    return _Gross(robot, Measurements(robot.joint_names, q, p))


def column(q: FloatArray, joint: int, values: FloatArray) -> FloatArray:
    result = np.array(q)
    result[:, joint] = values
    return result


Mistake = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
MISTAKES: dict[str, tuple[Mistake, dict[str, Any]]] = {
    "sign": (lambda q, p: (column(q, 2, -q[:, 2]), p), {"joint": "elbow_joint"}),
    "signs": (lambda q, p: (-q, p), {}),
    "mirror": (lambda q, p: (q, p * [1.0, -1.0, 1.0]), {}),
    "zero +90": (lambda q, p: (column(q, 1, q[:, 1] - np.pi / 2), p), {"size": 90, "unit": "deg"}),
    "zero −90": (lambda q, p: (column(q, 1, q[:, 1] + np.pi / 2), p), {"size": -90, "unit": "deg"}),
    "zero +180": (lambda q, p: (column(q, 1, q[:, 1] - np.pi), p), {"size": 180, "unit": "deg"}),
    "couple +": (
        lambda q, p: (column(q, 2, q[:, 2] - q[:, 1]), p),
        {"joint": "elbow_joint", "beside": "shoulder_lift_joint", "size": 1.0},
    ),
    "couple −": (
        lambda q, p: (column(q, 2, q[:, 2] + q[:, 1]), p),
        {"joint": "elbow_joint", "beside": "shoulder_lift_joint", "size": -1.0},
    ),
    "columns": (
        lambda q, p: (q[:, [0, 1, 4, 3, 2, 5]], p),
        {"joint": "elbow_joint", "beside": "wrist_2_joint"},
    ),
    "targets": (lambda q, p: (q, p[:, [2, 0, 1]]), {}),
    "rows": (lambda q, p: (q, p[::-1]), {}),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_among_the_changes_is_the_one_that_undoes_a_mistake(mistake: str) -> None:
    robot = arm(3, ("base",))
    q = random_configurations(robot, 12, 1)
    p = robot.positions(q)
    change, expected = MISTAKES[mistake]
    one = gross(robot, *change(q, p))
    start = one._change("", one.q, one.p)
    code = mistake.split()[0]
    undone = [
        c
        for c in one._changes(start)
        if c.code == code and np.allclose(c.q, q, atol=1e-12) and np.allclose(c.p, p, atol=1e-12)
    ]
    (found,) = undone
    assert {k: found.more.get(k) for k in expected} == expected
    assert (found.base, found.tool, found.scale, found.ratio, found.metre) == (True, False, False, None, 1.0)
    left = one._left(found, fit=True)
    assert left.level < 1e-9 < one._left(start, fit=True).level
    told = one._told([found], one._left(start), left)
    if code == "zero":
        assert f"{found.words['size']} degrees" in told.text and found.words["size"] == mistake.split()[1]
    if code == "couple":
        sign = {"+": "-", "−": "+"}[mistake.split()[1]]
        assert f"--couple elbow_joint{sign}=shoulder_lift_joint" in told.advice
        assert f"elbow_joint {mistake.split()[1]} shoulder_lift_joint" in told.text
    if code == "targets":
        assert "1, 2, 3 are exchanged in every row" in told.text


@pytest.mark.parametrize("targets", [1, 2, 3, 4, 5])
def test_every_order_of_up_to_four_targets_is_tried(targets: int) -> None:
    robot = ur10e(1).with_targets(0.1 * scattered(1, targets)[0]).with_parameters("full", ("base",))
    q = random_configurations(robot, 6, 1)
    one = gross(robot, q, robot.positions(q))
    changes = [c for c in one._changes(one._change("", one.q, one.p)) if c.code == "targets"]
    orders = list(permutations(range(targets)))[1:] if targets < 5 else []
    assert len(changes) == len(orders)
    for order, change in zip(orders, changes, strict=True):
        np.testing.assert_array_equal(change.p, one.p[:, order])


@pytest.mark.parametrize("shift", [1, -1, 2, -2])
def test_points_that_stand_some_rows_off_are_moved_back(shift: int) -> None:
    robot, q, p = planar()
    one = gross(robot, q, np.roll(p, shift, axis=0))
    start = one._change("", one.q, one.p)
    (found,) = (c for c in one._changes(start) if c.code == "rows" and c.more["size"] == shift)
    there = ~np.isnan(found.p[:, 0, 0])
    assert there.sum() == 20 - abs(shift)
    np.testing.assert_array_equal(found.p[there], p[there])
    side, rows = ("below" if shift > 0 else "above"), ("1 row" if abs(shift) == 1 else "2 rows")
    assert f"stands {rows} {side} the joint values" in found.words["size"]
    few = gross(robot, q[:4], p[:4])
    shifts = {c.more["size"] for c in few._changes(few._change("", few.q, few.p)) if c.code == "rows"}
    assert shifts == {1, -1, 0.0}


def test_only_what_may_be_otherwise_is_changed() -> None:
    """A joint that stood still, joints that slide and turn, places of targets that nobody knows."""
    robot = mixed().with_parameters("full", ("base", "tool"))
    q = random_configurations(robot, 10, 1)
    q[:, 3] = 0.2
    one = gross(robot, q, robot.positions(q))
    changes = list(one._changes(one._change("", one.q, one.p)))
    names = list(robot.joint_names)
    turning = {n for n, t in zip(names, robot.joint_is_revolute, strict=True) if t}

    def joints(code: str) -> list[tuple[str, ...]]:
        return [tuple(c.more[k] for k in ("joint", "beside") if k in c.more) for c in changes if c.code == code]

    moving = [n for n in names if n != names[3]]
    assert joints("sign") == [(n,) for n in moving]
    assert sorted(joints("zero")) == sorted((n,) for n in turning for _ in range(3))
    free = [n for n in moving if n in turning]
    assert sorted(joints("couple")) == sorted((a, b) for a in free for b in free if a != b for _ in range(2))
    assert {frozenset(pair) for pair in joints("columns")} == {
        frozenset((a, b)) for a in turning for b in turning if a != b
    }
    assert not joints("targets") and len(joints("signs")) == 1
    q[:, 1:] = 0.1
    one = gross(robot, q, robot.positions(q))
    assert "signs" not in {c.code for c in one._changes(one._change("", one.q, one.p))}


def test_places_that_are_known_may_be_wrong() -> None:
    told = {}
    for unknowns in ((), ("base",), ("tool",), ("base", "tool")):
        robot = arm(1, unknowns)
        one = gross(robot, *(lambda q, r=robot: (q, r.positions(q)))(random_configurations(robot, 8, 1)))
        changes = [c for c in one._fitted_changes(one._change("", one.q, one.p)) if c.code == "setup"]
        told[unknowns] = {(c.base, c.tool, c.words["size"], c.words["them"], c.words["option"]) for c in changes}
    both = (True, True, "base and the targets are", "them", "base,tool")
    assert told == {
        (): {(True, False, "base is", "it", "base"), (False, True, "targets are", "them", "tool"), both},
        ("base",): {(True, True, "targets are", "them", "base,tool")},
        ("tool",): {(True, True, "base is", "it", "base,tool")},
        ("base", "tool"): set(),
    }


def test_what_is_left_is_the_median_distance_with_what_is_unknown_fitted() -> None:
    """Exact points of an arm elsewhere, zeros off, a gear ratio or the scale of the points wrong, one gross."""
    robot = arm(2)
    q = random_configurations(robot, 16, 3) / 2.0
    zeros = 0.01 * np.array([0.0, 1.0, -1.0, 0.5, -0.5, 0.0])
    real = robot.with_base(rotation(2, 0.7) @ rotation(0, 0.1), [1.0, 2.0, -0.5])
    for code, amount in (("", 1.0), ("ratio", 1.04), ("scale", 0.97)):
        turned = q + zeros
        if code == "ratio":
            turned = column(turned, 2, turned[:, 2] + (amount - 1.0) * q[:, 2])
        p = real.positions(turned) * (amount if code == "scale" else 1.0)
        p[3, 0] += 0.4
        p[5, 1] = np.nan
        one = gross(robot, q, p)
        change = one._change(code, one.q, one.p, scale=code == "scale", ratio=2 if code == "ratio" else None)
        left = one._left(change, fit=True)
        assert left.level < 1e-4
        assert (left.ratio, left.scale) == pytest.approx(
            (amount if code == "ratio" else 1.0, amount if code == "scale" else 1.0), abs=1e-3
        )
        assert left.spare == 3 * 31 - 6 - 2 * 3 - 6 - (code != "")
        assert left.points is not None and np.abs(left.points - real.positions(turned))[:3].max() < 1e-3 + 5.0 * (
            code == "scale"
        )
        rough = one._left(change)
        assert rough.level > left.level and rough.spare == left.spare + 6


@pytest.mark.parametrize("kind", ["", "scale", "ratio"])
@pytest.mark.parametrize("unknowns", [(), ("base",), ("tool",), ("base", "tool")])
def test_a_step_of_the_zeros_is_weighted_least_squares(unknowns: tuple[str, ...], kind: str) -> None:
    """By differences of the points; zeros are known to 20 mrad in all, base and targets not at all."""
    robot = arm(2, unknowns).with_base(rotation(2, 0.7) @ rotation(0, 0.1), [1.0, 2.0, -0.5])
    rng = np.random.default_rng(4)
    q = random_configurations(robot, 9, 3)
    moved = q + 0.01 * rng.standard_normal(6)
    points = robot.positions(moved)
    apart, weights, level = 0.01 * rng.standard_normal(points.shape), rng.uniform(0.1, 1.0, (9, 2)), 0.3
    one = gross(robot, q, points + apart)
    change = one._change(kind, q, points + apart, scale=kind == "scale", ratio=2 if kind == "ratio" else None)
    placed = (robot.base_pose[0], robot.target_offsets, points)
    got = one._step(change, moved, q, placed, apart, (weights, level))

    def there(x: FloatArray) -> FloatArray:
        """Points after a change of zeros, amount, base (translation, rotation about its origin) and offsets."""
        turned = moved + x[:6]
        if kind == "ratio":
            turned = column(turned, 2, turned[:, 2] + x[6] * q[:, 2])
        result = robot.with_targets(robot.target_offsets + x[13:].reshape(2, 3)).positions(turned)
        result = result * (1.0 + x[6]) if kind == "scale" else result
        return result + x[7:10] + np.cross(x[10:13], result)

    free = [*range(6), *([6] if kind else [])]
    free += [*range(7, 13)] * ("base" in unknowns) + [*range(13, 19)] * ("tool" in unknowns)
    steps = 1e-6 * np.eye(19)
    columns = np.stack([(there(s) - there(-s)).ravel() / 2e-6 for s in steps[free]], axis=1)
    root = np.sqrt(np.repeat(weights.ravel(), 3)) / level
    prior = np.eye(len(free))[:6] / 0.02
    off = -(moved - q)[0] / 0.02
    if kind == "ratio":
        off[2] = 0.0  # what it is off already is told by the ratio
    rows, right = np.vstack([root[:, None] * columns, prior]), np.append(root * apart.ravel(), off)
    expected = np.linalg.lstsq(rows, right, rcond=1e-9)[0]
    np.testing.assert_allclose(got[:6], expected[:6], atol=1e-7)
    assert got[6] == pytest.approx(expected[6] if kind else 0.0, abs=1e-7) and len(got) == 7


@pytest.mark.parametrize("unknowns", [(), ("base",), ("tool",), ("base", "tool")])
def test_places_are_fitted_as_far_as_they_are_unknown(unknowns: tuple[str, ...]) -> None:
    robot = arm(1, unknowns).with_base(rotation(2, -0.4), [0.3, 0.0, 0.8])
    q = random_configurations(robot, 12, 3)
    real = robot
    if "base" in unknowns:
        real = real.with_base(rotation(2, 0.7) @ rotation(0, 0.1), [1.0, 2.0, -0.5])
    if "tool" in unknowns:
        real = real.with_targets([[0.1, -0.2, 0.3]])
    one = gross(robot, q, real.positions(q))
    left = one._left(one._change("", one.q, one.p))
    assert left.level < 1e-9 and left.spare == 36 - 6 * ("base" in unknowns) - 3 * ("tool" in unknowns)
    assert explain_gross(robot, Measurements(robot.joint_names, q, real.positions(q))) is None


def test_what_is_left_grows_with_what_was_fitted() -> None:
    """As a scatter does: by the root of the coordinates over those to spare; none to spare: unlimited."""
    robot, q, p = planar(6)
    noisy = p + 1e-3 * np.random.default_rng(0).standard_normal(p.shape)
    one = gross(robot, q, noisy)
    left = one._left(one._change("", one.q, one.p))
    lengths = np.linalg.norm(noisy - p, axis=2)
    assert left.spare == 18 and left.level == pytest.approx(np.median(lengths), rel=1e-9)
    fitted = one._left(one._change("", one.q, one.p, ratio=1), fit=True)
    assert fitted.spare == 18 - 2 - 1 and fitted.points is not None
    rest = np.median(np.linalg.norm(noisy - fitted.points, axis=2))
    assert fitted.level == pytest.approx(rest * np.sqrt(18.0 / 15.0), rel=0.05)
    one = gross(robot, q[:1], noisy[:1])
    assert one._left(one._change("", one.q, one.p, ratio=1), fit=True).level == np.inf


@pytest.mark.parametrize(
    ("angle", "scale", "size", "text", "advice"),
    [
        ("radians", 1e3, 1e3, "the points are in millimetres", "add --millimetres"),
        ("radians", 1e2, 1e2, "the points are in centimetres", "add --units cm"),
        ("radians", 1.0 / 0.0254, 1.0 / 0.0254, "the points are in inches", "add --units in"),
        ("degrees", 1.0, 180.0 / np.pi, "the joint angles are in degrees", "add --degrees"),
        ("too small", 1.0, 180.0 / np.pi, "the joint angles are 57.3 times too small", "leave out --degrees"),
        ("radians", 1e-3, 1e-3, "the points are a thousand times too close together", "leave out --millimetres"),
    ],
)
def test_units_in_words(angle: str, scale: float, size: float, text: str, advice: str) -> None:
    robot, q, p = planar()
    one = gross(robot, q, scale * p)
    change = one._in_units(angle, scale, q)
    assert change is not None and change.code == "units" and change.metre == scale
    assert change.more["size"] == pytest.approx(size) and change.more["unit"] == "1"
    assert change.words["size"].startswith(text) and change.words["advice"].startswith(advice)
    np.testing.assert_allclose(change.p, p)
    assert one._in_units("radians", 1.0, q) is None
    both = one._in_units("degrees", 1e3, q)
    assert both is not None and both.words["advice"] == "add --millimetres, and add --degrees"
    assert both.words["size"] == "the points are in millimetres and the joint angles are in degrees"


def test_the_units_next_to_the_estimates_and_metres_are_tried() -> None:
    inch = 1.0 / 0.0254
    assert _Gross._scales(900.0) == [1e3, 1.0] and _Gross._scales(1.2, 0.9) == [1.0]
    assert sorted(_Gross._scales(35.0, 80.0)) == [1.0, inch, 1e2] and _Gross._scales(2e-3) == [1e-3, 1.0]
    assert sorted(_Gross._scales(3.0, 0.0)) == [1e-3, 1.0, 1.0 / 0.3048]


@pytest.mark.parametrize(("points", "angles"), [(1e-3, 1.0), (1.0, np.pi / 180.0), (1e3, 180.0 / np.pi)])
def test_units_are_found_for_a_planar_arm(points: float, angles: float) -> None:
    robot, q, p = planar()
    told = explain_gross(robot, Measurements(robot.joint_names, angles * q, points * p))
    assert told is not None and told.code == "units" and told.material and told.row is None
    assert ("points" in told.text, "angles" in told.text) == (points != 1.0, angles != 1.0)


def test_two_mistakes_at_once_are_told_if_one_of_them_is_the_units() -> None:
    robot, q, p = planar()
    wrong = column(q, 1, -q[:, 1])
    for points, angles, text in (
        (1e3, 1.0, "the points are in millimetres"),
        (1.0, 57.29577951308232, "in degrees"),
    ):
        told = explain_gross(robot, Measurements(robot.joint_names, angles * wrong, points * p))
        assert told is not None and told.code == "sign" and told.joint == robot.joint_names[1]
        units, _, rest = told.text.partition(", and ")
        assert text in units and rest == f"{robot.joint_names[1]} runs the other way than in the robot model"
        # What is left before is told in metres, and is no more than the points spread.
        assert 0.05 < told.moved <= 1.001 * _spread(p) and told.statistic > 1e3


def test_every_change_that_was_tried_counts_against_the_one_that_is_named() -> None:
    """Each may leave as little by chance: e to the minus gain, times their number."""
    robot, q, p = planar()
    noisy = p + 1e-3 * np.random.default_rng(0).standard_normal(p.shape)
    one = gross(robot, column(q, 1, -q[:, 1]), noisy)
    told = one.explanation()
    start = one._change("", one.q, one.p)
    number = len(list(one._changes(start))) + len(list(one._fitted_changes(start)))
    assert told is not None and told.code == "sign" and 20.0 < told.gain < 600.0 and number > 15
    assert told.probability == pytest.approx(number * np.exp(-told.gain), rel=1e-9, abs=0.0)


def test_rows_that_slipped_beside_sound_ones_in_numbers() -> None:
    """Ten of forty rows have the points of the row behind; the fit to the others leaves 0.1 mm."""
    robot, q, p = planar(40)
    rng = np.random.default_rng(0)
    noisy = p + 1e-4 * rng.standard_normal(p.shape)
    points = np.array(noisy)
    points[10:20] = noisy[11:21]
    told = explain_gross(robot, Measurements(robot.joint_names, q, points))
    assert told is not None and told.code == "rows" and told.rows == tuple(range(10, 20)) and told.row == 10
    far = np.median(np.linalg.norm(points[10:20] - p[10:20], axis=2))
    assert told.moved == pytest.approx(far, rel=0.01) and told.size == told.freedom == 10
    assert told.statistic == told.deviations == pytest.approx(far / 1.6e-4, rel=0.3)
    assert told.gain == pytest.approx(-np.log(told.probability)) and not told.material
    assert explain_gross(robot, Measurements(robot.joint_names, q, noisy)) is None
    exact = np.array(p)
    exact[10:20] = p[11:21]
    told = explain_gross(robot, Measurements(robot.joint_names, q, exact))
    assert told is not None and told.statistic == told.deviations == told.moved / 1e-12  # for want of noise
    assert told.probability == 0.0 and told.gain == pytest.approx(-np.log(1e-300))
    # With less than a tenth of the rows a robust fit copes by itself; and as few as two are no run.
    for count, order, named in ((40, [11, 12, 10], False), (20, [11, 12, 10], True), (15, [11, 10, 12], False)):
        few = np.array(noisy)
        few[[10, 11, 12]] = noisy[order]
        told = explain_gross(robot, Measurements(robot.joint_names, q[:count], few[:count]))
        assert (told is not None) == named


def test_too_few_visits_or_coordinates_to_spare_explain_nothing() -> None:
    robot, q, p = planar()
    for rows, some in ((1, False), (2, False), (3, True)):  # two zeros: seven coordinates of nine to spare
        told = explain_gross(robot, Measurements(robot.joint_names, q[:rows], 1e3 * p[:rows]))
        assert (told is not None) == some


def test_a_gross_alternative_in_numbers() -> None:
    """Three nats a coordinate: the residuals fall by the factor e³."""
    robot, q, p = planar()
    one = gross(robot, q, p)
    one.count = 40
    changes = list(one._changes(one._change("", one.q, one.p)))
    sign = next(c for c in changes if c.code == "sign")
    zero = next(c for c in changes if c.code == "zero")
    before, after = _Left(np.exp(3.0) * 1e-4, spare=9), _Left(1e-4, spare=5)
    told = one._told([sign], before, after)
    assert told.gain == pytest.approx(15.0) and told.statistic == pytest.approx(np.exp(3.0))
    assert told.probability == pytest.approx(40.0 * np.exp(-15.0)) and told.freedom == 1
    assert told.moved == pytest.approx(np.exp(3.0) * 1e-4) and told.deviations == told.statistic
    assert told.material and (told.size, told.unit, told.joint) == (
        -1.0,
        "1",
        "joint_1" if "joint_1" in robot.joint_names else robot.joint_names[0],
    )
    several = one._told([sign, zero, zero, zero], before, after)
    assert several.text.count(", or ") == 2 and several.text.startswith(f"{told.text}, or the zero of")
    assert several.advice.startswith(f"{told.advice}; or add +90 degrees")
    units = one._in_units("degrees", 1.0, q)
    assert units is not None
    both = one._told([sign], before, after, units)
    assert both.text == f"the joint angles are in degrees, and {told.text}"
    assert both.advice == f"add --degrees, and {told.advice}"
    for code, left in (("ratio", _Left(1e-4, ratio=1.25, spare=5)), ("scale", _Left(1e-4, scale=0.8, spare=5))):
        change = next(c for c in one._fitted_changes(one._change("", one.q, one.p)) if c.code == code)
        told = one._told([change], before, left)
        assert told.size == pytest.approx({"ratio": 0.25, "scale": -0.2}[code])
        assert ("turns 1.25 times" if code == "ratio" else "distances are 0.8 times") in told.text


def test_of_changes_that_explain_the_same_the_simplest_is_named_first() -> None:
    robot, q, p = planar()
    one = gross(robot, q, p)
    start = one._change("", one.q, one.p)

    def order(code: str, level: float, **more: Any) -> tuple[float, ...]:
        return _simplest(one._change(code, q, p, **more), level)

    ranked = ["sign", "signs", "mirror", "columns", "targets", "rows", "couple", "zero"]
    places = [order(code, 1.0) for code in ranked]
    assert places == sorted(places)
    assert order("sign", 1.0) < order("sign", 2.0) < order("zero", 0.1)
    fitted = [("ratio", 1.0, {}), ("ratio", 2.0, {}), ("setup", 0.1, {"base": True, "tool": False})]
    fitted.append(("setup", 0.05, {"base": True, "tool": True}))
    places = [order(code, level, **more) for code, level, more in fitted]
    assert places == sorted(places) and start.code == ""


def test_spread_stretch_and_carried_points() -> None:
    points = np.array(
        [[[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [[0.0, 4.0, 0.0], [np.nan] * 3], [[0.0, 0.0, 90.0]] * 2]
    )
    # The median point is (0, 0, 0); distances 0, 3, 4, 90, 90.
    assert _spread(points) == 4.0
    rng = np.random.default_rng(0)
    predicted = rng.normal(size=(9, 2, 3)) + 2.0
    weights = rng.uniform(0.5, 1.0, (9, 2))
    measured = 1.3 * predicted
    weights[4, 1] = 0.0
    measured[4, 1] = 100.0
    assert _stretch(measured, predicted, weights, free=False) == pytest.approx(1.3)
    assert _stretch(measured + np.array([5.0, 6.0, 7.0]), predicted, weights, free=True) == pytest.approx(1.3)
    noisy = measured + 0.1 * rng.normal(size=measured.shape)
    use = weights > 0.0
    root = np.sqrt(weights[use])[:, None]
    fit = np.linalg.lstsq((root * predicted[use]).reshape(-1, 1), (root * noisy[use]).ravel(), rcond=None)[0][0]
    assert _stretch(noisy, predicted, weights, free=False) == pytest.approx(fit)
    robot = ur10e(1).with_base(rotation(2, 0.7) @ rotation(0, 0.1), [1.0, 2.0, -0.5])
    q = random_configurations(robot, 4, 1)
    inside, outside = tip_poses(robot, q, at_base=True), tip_poses(robot, q, at_base=False)
    for got, expected in zip(_carried(inside, robot.base_pose), outside, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-12)
