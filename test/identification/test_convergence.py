# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The iteration reaches the minimum from where robots really are, and says where it cannot."""

from __future__ import annotations

import numpy as np
import pytest
from cells import SIGMA, bare, placed_cell
from robots import SHARED_DATA, mixed, random_configurations, repeats

from calib_planner import IdentificationProblem, Measurements, NotEnoughDataError, Robot, identify
from calib_planner.error_model import ErrorModel
from calib_planner.identification import estimation
from calib_planner.io import read_data
from calib_planner.simulation import SimulatedCell, random_deviations

ROBOTS = {
    "planar": lambda: Robot.load("planar_2r"),
    "kuka": lambda: Robot.load("kuka_kr270"),
    "ur10e": lambda: Robot.load("ur10e").with_targets([[0.1, 0.05, 0.1]]).with_parameters("lengths+offsets"),
    "mixed": mixed,
}
MODELS = {"paper": ErrorModel.paper(), "typical": None}


def reached(robot: Robot, seed: int, model: str, length: float, angle: float) -> float:
    """Root mean square error at fresh configurations [m] of a robot whose errors are of this size."""
    cell = SimulatedCell(robot, random_deviations(robot, seed, length, angle), SIGMA)
    data = bare(cell.measure(random_configurations(robot, 25, seed), 1, seed))
    estimate = identify(IdentificationProblem(robot, data, SIGMA, MODELS[model]))
    assert estimate.fit.status != "not_converged"
    q = random_configurations(robot, 50, seed + 50)
    return float(np.sqrt(np.mean(np.sum((estimate.positions(q) - cell.truth.positions(q)) ** 2, axis=2))))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("name", ROBOTS)
def test_robots_far_from_nominal_are_reached(name: str, model: str) -> None:
    """Lengths 10 mm and zeros 3° off, ten times what is usual, twenty times what the error model expects."""
    for seed in range(repeats(2, 13)):
        assert reached(ROBOTS[name](), seed, model, 1e-2, 5e-2) < 4 * SIGMA


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("name", ["kuka", "mixed"])
def test_big_starts_end_in_the_same_minimum(name: str, model: str) -> None:
    """Zeros 15° and lengths 50 mm off."""
    for seed in range(repeats(2, 50)):
        assert reached(ROBOTS[name](), seed, model, 5e-2, 0.26) < 5 * SIGMA


@pytest.mark.parametrize("model", MODELS)
def test_cells_anywhere_are_reached(model: str) -> None:
    for seed in range(repeats(1, 8)):
        cell, robot = placed_cell(seed)
        data = bare(cell.measure(random_configurations(robot, 40, seed), 1, seed))
        estimate = identify(IdentificationProblem(robot, data, SIGMA, MODELS[model]))
        assert estimate.fit.status == ("rank_deficient" if model == "paper" else "ok")
        q = random_configurations(robot, 50, seed + 50)
        error = np.linalg.norm(estimate.positions(q) - cell.truth.positions(q), axis=2)
        assert np.sqrt(np.mean(error**2)) < 4 * SIGMA


def test_the_order_of_the_rows_does_not_matter() -> None:
    cell, robot = placed_cell(11)
    data = bare(cell.measure(random_configurations(robot, 20, 2), 1, 2))
    order = np.random.default_rng(2).permutation(20)
    one, other = (identify(IdentificationProblem(robot, d, SIGMA)) for d in (data, data.select(order)))
    np.testing.assert_allclose(other.residuals.vectors, one.residuals.vectors[order], rtol=0, atol=1e-2 * SIGMA)
    q = random_configurations(robot, 30, 77)
    np.testing.assert_allclose(other.positions(q), one.positions(q), rtol=0, atol=1e-2 * SIGMA)
    assert other.verdict.level == one.verdict.level


def test_another_place_of_the_base_changes_numbers_only() -> None:
    """The tracker's frame is turned and moved: the same predictions, turned and moved."""
    cell, robot = placed_cell(12)
    data = bare(cell.measure(random_configurations(robot, 30, 3), 1, 3))
    turn, move = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([3.0, -2.0, 0.5])
    moved = Measurements(data.joint_names, data.q, data.p @ turn.T + move)
    paper = ErrorModel.paper()
    one, other = (identify(IdentificationProblem(robot, d, SIGMA, paper)) for d in (data, moved))
    q = random_configurations(robot, 30, 77)
    np.testing.assert_allclose(other.positions(q), one.positions(q) @ turn.T + move, rtol=0, atol=1e-2 * SIGMA)


def test_too_few_iterations_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimation, "MOST_STARTS", 1)
    monkeypatch.setattr(estimation, "MOST_ROUNDS", 1)
    robot = Robot.load("kuka_kr270")
    cell = SimulatedCell(robot, random_deviations(robot, 1, 1e-2, 5e-2), SIGMA)
    data = bare(cell.measure(random_configurations(robot, 20, 1), 1, 1))
    estimate = identify(IdentificationProblem(robot, data, SIGMA, ErrorModel.paper()))
    assert estimate.fit.status == "not_converged" and estimate.verdict.level == "FAIL"
    assert estimate.verdict.reasons[0].code == "not_converged"


def test_subsets_of_a_measured_robot_are_never_refused() -> None:
    """15, 40 and 60 random rows of a UR10 whose errors no geometry explains."""
    folder = SHARED_DATA / "ur10_tracker"
    if not folder.is_dir():
        pytest.skip("no measured data beside the repository")
    robot = Robot.load(folder / "ur10.urdf").with_targets(np.zeros((1, 3)))
    robot = robot.with_parameters("full", ("base", "tool"))
    data = read_data(folder / "random_poses.csv", robot).data
    for seed in range(repeats(3, 40)):
        rows = np.random.default_rng(seed).choice(len(data), (15, 40, 60)[seed % 3], replace=False)
        try:
            estimate = identify(IdentificationProblem(robot, data.select(np.sort(rows))))
        except NotEnoughDataError as error:
            pytest.fail(f"seed {seed}: {error}")
        assert estimate.fit.status != "not_converged"
        assert estimate.left_out.count > 0.8 * len(rows) or len(rows) == 15
