# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""All terms of the error model: what is predicted is what is achieved, and it survives a file."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cells import bare, plain_cell
from robots import random_configurations

from calib_planner import Estimate, IdentificationProblem, Measurements, Robot, identify, validate
from calib_planner.compensation import compensate
from calib_planner.error_model import Knowledge, typical
from calib_planner.errors import InputError
from calib_planner.io import read_error_model, read_estimate, write_estimate
from calib_planner.io.yaml import read_document, write_document

KUKA = Robot.load("kuka_kr270")
POSES = np.array(
    [
        [0.2, -1.0, 1.2, 0.4, 0.6, 0.0],
        [0.4, -1.3, 1.0, -0.5, 0.9, 0.3],
        [-0.3, -0.8, 1.5, 0.1, -0.7, 0.0],
        [0.0, -1.1, 0.7, 0.2, 1.1, -0.4],
    ]
)
TARGETS = [[0.05, 0.0, 0.1], [0.0, -0.06, 0.05]]


def points_of(known: Knowledge, q: np.ndarray, seed: int) -> Measurements:
    """What a robot of which all is known shows, with 20 µm of noise."""
    rng, points = np.random.default_rng(seed), known.poses(q).points
    return Measurements(known.robot.joint_names, q, points + 2e-5 * rng.standard_normal(points.shape))


@cache
def bending() -> tuple[Robot, Knowledge, Measurements, Measurements]:
    """A UR10e that bends under its weight: nominal, the truth, 40 visits, and 60 others."""
    robot = Robot.load("ur10e").with_targets(TARGETS).with_parameters("full")
    model = typical().without("joint_functions")
    rng = np.random.default_rng(3)
    true = model.with_values({"placement.length": 3e-4, "placement.angle": 6e-4, "gravity": 3e-3})
    beta = np.sqrt(true.variances(robot)) * rng.standard_normal(len(true.variances(robot)))
    known = Knowledge(robot, true, beta, np.zeros((len(beta),) * 2), np.zeros((len(beta), 0)))
    asked = robot.with_parameters("full", ("base", "tool"))
    q = random_configurations(robot, 100, 3) / 3.0
    return asked, known, points_of(known, q[:40], 1), points_of(known, q[40:], 2)


@cache
def bent(**more: str) -> tuple[IdentificationProblem, Estimate]:
    robot, _, data, _ = bending()
    problem = IdentificationProblem(robot, data, error_model=typical(), test_poses=POSES / 2.0, **more)
    return problem, identify(problem)


# ── all terms ────────────────────────────────────────────────────────────────────────────────────────


def test_a_robot_that_bends_is_predicted_as_well_as_promised() -> None:
    problem, estimate = bent()
    _, _, _, others = bending()
    assert estimate.fit.status == "ok" and estimate.verdict.level == "PASS"
    gravity = next(t for t in estimate.terms if t.name == "gravity")
    assert gravity.used and gravity.gain > 10.0 and gravity.size > 2e-4 and 0.0 < gravity.std < gravity.size
    left = estimate.left_out
    assert left.count == 80 and 0.8 < left.predicted_rms / left.rms < 1.25
    judged = validate(problem, estimate, [others])
    assert judged.validation is not None
    achieved = judged.validation
    assert achieved.count == 120 and achieved.rms < 0.5 * achieved.placement_rms
    assert 0.8 < achieved.predicted_rms / achieved.rms < 1.25 and achieved.within_95 > 0.9
    np.testing.assert_allclose(
        np.sqrt(np.mean(np.sum((others.p - estimate.positions(others.q)) ** 2, axis=2))), achieved.rms
    )


def test_the_accuracy_of_the_robot_alone_needs_no_registration() -> None:
    _, world = bent()
    _, robot = bent(accuracy_frame="robot")
    assert robot.to_dict()["accuracy_frame"] == "robot"
    assert 0.0 < robot.accuracy.overall < world.accuracy.overall
    np.testing.assert_array_equal(robot.fit.deviations, world.fit.deviations)


def test_points_that_are_impossible_are_rejected_with_their_rows() -> None:
    robot, _, data, _ = bending()
    points = np.array(data.p)
    points[7, 1] += [0.0, 4e-3, 0.0]
    points[20, 0] = np.nan
    found = identify(IdentificationProblem(robot, bare(data, points), error_model=typical()))
    point = next(p for p in found.points.rejected if (p.row, p.target) == (7, 2))
    assert point.residual == pytest.approx(4e-3, abs=2e-4) and point.normalised_residual > found.residuals.gate
    assert found.points.measured == 79 and len(found.points.rejected) == 1 and found.points.used == 78
    assert np.isnan(found.residuals.normalised[20, 0])


def test_a_target_that_was_put_on_anew_is_told_by_a_few_rows() -> None:
    problem, estimate = bent()
    _, known, _, others = bending()
    moved = replace(known, robot=known.robot.with_targets([[0.0, 0.1, 0.12]]).with_parameters("full"))
    fresh = points_of(moved, np.asarray(others.q), 5)
    found = validate(problem, estimate, [fresh], 2).validation
    assert found is not None and found.count == 58
    assert found.rms < 2.0 * found.predicted_rms < 4e-4 and found.placement_rms > 2.0 * found.rms


# ── files ────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    write_estimate(tmp_path / "e.yaml", bent()[1])
    return tmp_path / "e.yaml"


def test_what_was_saved_predicts_the_same(saved: Path) -> None:
    estimate, robot = bent()[1], Robot.load("ur10e")
    known, again = estimate.knowledge, read_estimate(saved).knowledge(robot)
    before, after = known.predict(POSES), again.predict(POSES)
    np.testing.assert_allclose(after.mean, before.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.total, before.total, rtol=1e-12, atol=0)
    for frame in ("world", "robot"):
        assert again.accuracy(POSES, frame).value == pytest.approx(known.accuracy(POSES, frame).value, rel=1e-12)
    assert again.model == known.model == read_error_model(saved)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda e: e.update(covariance="no base64"), "error_model.covariance"),
        (lambda e: e.update(covariance=e["covariance"][:64]), "finite ones"),
        (lambda e: e["coefficients"].pop(), "error_model.coefficients"),
        (lambda e: e.pop("start"), "start"),
        (lambda e: e["model"].pop("visits"), "visits"),
    ],
)
def test_a_damaged_file_is_refused_by_its_key(saved: Path, change, text: str) -> None:  # type: ignore[no-untyped-def]
    document = dict(read_document(saved, "estimate").value)
    change(document["error_model"])
    write_document(saved, "estimate", document)
    with pytest.raises(InputError, match=text):
        read_estimate(saved)


def test_another_robot_is_refused(saved: Path) -> None:
    with pytest.raises(InputError):
        read_estimate(saved).knowledge(KUKA)


def test_compensated_targets_put_the_bent_robot_where_it_should_be(saved: Path) -> None:
    """The true robot is the judge, and what a registration of its base explains is no error."""
    nominal, (_, truth, _, _) = Robot.load("ur10e").with_targets(TARGETS[:1]), bending()
    estimate = read_estimate(saved)
    q = random_configurations(nominal, 20, 9) / 4.0
    made = compensate(
        nominal, estimate.calibrated(nominal), q, position_only=True, corrections=estimate.knowledge(nominal)
    )
    assert (made.position_error < 1e-8).all()
    known = estimate.knowledge(nominal)
    np.testing.assert_allclose(known.actual(known.reading(q)), q, rtol=0, atol=1e-14)
    point = np.array(estimate.targets)[:1]
    deflected = replace(truth, robot=truth.robot.with_targets(point))
    reached = deflected.poses(made.corrected).points[:, 0]
    wanted = nominal.with_targets(point).positions(q)[:, 0]
    uncorrected = deflected.poses(q).points[:, 0]

    def apart(points: np.ndarray) -> float:
        """Rms after a registration of the robot anew: a rigid motion is no error of its own."""
        a, b = points - points.mean(axis=0), wanted - wanted.mean(axis=0)
        u, _, vt = np.linalg.svd(a.T @ b)
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        return float(np.sqrt(np.mean(np.sum((a @ turn - b) ** 2, axis=1))))

    assert apart(reached) < 0.3 * apart(uncorrected)


# ── what makes no sense together ─────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("field", "options"),
    [
        ("accuracy_frame", {"accuracy_frame": "tool"}),
        ("test_poses", {"accuracy_frame": "robot", "test_poses": POSES[:3]}),
        ("test_poses", {"accuracy_frame": "robot"}),
        ("test_poses", {"accuracy_frame": "robot", "test_poses": np.zeros((5, 6))}),
    ],
)
def test_accuracy_frames_that_cannot_be_had_are_refused(field: str, options: dict[str, object]) -> None:
    robot, _, data, _ = bending()
    with pytest.raises(InputError) as error:
        IdentificationProblem(robot, data, **{"error_model": typical()} | options)
    assert error.value.field == field


# ── an update ────────────────────────────────────────────────────────────────────────────────────────


def test_an_estimate_brought_up_to_date_is_that_of_all_measurements_at_once() -> None:
    """Two visits come, one goes; scales and terms are those of before, so that a little may differ."""
    robot, _, data, _ = bending()
    first = identify(IdentificationProblem(robot, data.select(np.arange(38))))
    now = IdentificationProblem(robot, data.select(np.r_[1:40]), test_poses=POSES / 2.0)
    quick, full = identify(now, first), identify(now)
    assert quick.fit.iterations <= 2 < full.fit.iterations
    assert quick.points == full.points and quick.verdict.level == full.verdict.level
    q = random_configurations(robot, 30, 4) / 3.0
    apart = np.linalg.norm(quick.positions(q) - full.positions(q), axis=2)
    assert np.sqrt(np.mean(apart**2)) < 0.2 * full.accuracy.overall
    np.testing.assert_allclose(quick.accuracy.predicted, full.accuracy.predicted, rtol=0.2)
    np.testing.assert_allclose(quick.accuracy.parameters, full.accuracy.parameters, rtol=0.2)
    assert quick.left_out.rms == pytest.approx(full.left_out.rms, rel=0.1)


def test_placement_alone_is_brought_up_to_date_and_what_hardly_changes_is_kept() -> None:
    robot, _, data, _ = bending()
    first = identify(IdentificationProblem(robot, data.select(np.arange(38))))
    now = IdentificationProblem(robot, data, test_poses=POSES / 2.0)
    quick, full = identify(now, first), identify(now)
    assert quick.fit.iterations <= 2 < full.fit.iterations
    q = random_configurations(robot, 30, 4) / 3.0
    moved = np.linalg.norm(first.calibrated.positions(q) - full.calibrated.positions(q), axis=2)
    apart = np.linalg.norm(quick.calibrated.positions(q) - full.calibrated.positions(q), axis=2)
    assert np.sqrt(np.mean(apart**2)) < 0.5 * np.sqrt(np.mean(moved**2))
    np.testing.assert_allclose(quick.accuracy.placement, full.accuracy.placement, rtol=0.1)
    assert quick.placement_alone.count == full.placement_alone.count > first.placement_alone.count
    assert quick.placement_alone.rms == pytest.approx(full.placement_alone.rms, rel=0.05)
    assert quick.residuals.before == first.residuals.before != full.residuals.before
    assert quick.observability == first.observability
    many = IdentificationProblem(robot, data.select(np.arange(15)))
    anew = identify(now, identify(many))  # more than twice as many
    assert anew.residuals.before == full.residuals.before and anew.observability == full.observability
    np.testing.assert_array_equal(anew.placement_values, full.placement_values)


def test_a_wrong_measurement_undone_leaves_no_trace() -> None:
    """Scales may have been estimated beside it; predictions are the same within a fifth of their error."""
    robot, _, data, _ = bending()
    before = identify(IdentificationProblem(robot, data))
    points = np.array(data.p)
    points[39] += 0.4
    wrong = identify(IdentificationProblem(robot, bare(data, points)), before)
    assert {p.row for p in wrong.points.rejected} == {39}
    after = identify(IdentificationProblem(robot, data), wrong)
    assert not after.points.rejected
    q = random_configurations(robot, 30, 4) / 3.0
    apart = np.linalg.norm(after.positions(q) - before.positions(q), axis=2)
    assert np.sqrt(np.mean(apart**2)) < 0.2 * before.knowledge.accuracy(q).value


def test_a_start_of_another_robot_is_no_start() -> None:
    """It cannot be brought up to date: a full fit is made, and says the same as without it."""
    robot, _, data, _ = bending()
    cell, kuka = plain_cell(2)
    other = identify(IdentificationProblem(kuka, bare(cell.measure(random_configurations(kuka, 12, 2), 1, 2))))
    problem = IdentificationProblem(robot, data)
    np.testing.assert_array_equal(identify(problem, other).fit.deviations, identify(problem).fit.deviations)
