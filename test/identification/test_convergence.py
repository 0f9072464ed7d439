"""The iteration reaches the minimum from where robots really are, and notices that there is another one."""

from __future__ import annotations

import numpy as np
import pytest
from cells import SIGMA, bare, placed_cell
from robots import mixed, random_configurations

from calib_planner import IdentificationProblem, Robot, identify
from calib_planner.simulation import SimulatedCell, random_deviations

ROBOTS = {
    "planar": lambda: Robot.load("planar_2r"),
    "kuka": lambda: Robot.load("kuka_kr270"),
    "ur10e": lambda: Robot.load("ur10e").with_targets([[0.1, 0.05, 0.1]]).with_parameters("lengths+offsets"),
    "mixed": mixed,
}


@pytest.mark.parametrize("loss", ["linear", "robust"])
@pytest.mark.parametrize("name", ROBOTS)
def test_robots_far_from_nominal_are_found(name, loss):
    """Lengths 10 mm and zeros 3° off, ten times what is usual; 104 robots: the truth is reached every time."""
    for seed in range(13):
        robot = ROBOTS[name]()
        cell = SimulatedCell(robot, random_deviations(robot, seed, 1e-2, 5e-2), SIGMA)
        data = bare(cell.measure(random_configurations(robot, 25, seed), 1, seed))
        found = identify(IdentificationProblem(robot, data, sigma=SIGMA, loss=loss, joint_corrections="off"))
        assert found.fit.status != "not_converged"
        assert found.diagnostics.agreeing_starts == found.diagnostics.starts == 2
        assert found.residuals.chi_square.probability > 1e-7
        assert found.fit.iterations <= 15
        errors = cell.position_errors(found.calibrated, random_configurations(robot, 50, seed + 50))
        assert np.sqrt(np.mean(errors**2)) < 4 * SIGMA


@pytest.mark.parametrize("loss", ["linear", "robust"])
def test_cells_anywhere_are_found(loss):
    for seed in range(8):
        cell, asked = placed_cell(seed)
        data = bare(cell.measure(random_configurations(asked, 40, seed), 1, seed))
        found = identify(IdentificationProblem(asked, data, sigma=SIGMA, loss=loss))
        assert found.fit.status == "rank_deficient"
        assert found.diagnostics.agreeing_starts == found.diagnostics.starts == 2
        errors = cell.position_errors(found.calibrated, random_configurations(asked, 50, seed + 50))
        assert np.sqrt(np.mean(errors**2)) < 4 * SIGMA


@pytest.mark.parametrize("loss", ["linear", "robust"])
def test_starts_disagree_where_there_is_a_second_minimum(loss):
    """An elbow that stood still: bent one way or the other, the two links reach the same points equally well."""
    robot = Robot.load("planar_2r").with_parameters("offsets")
    q = np.array([[turn, 0.006] for turn in np.linspace(-0.4, 0.9, 12)])
    truth = np.array([0.001, -0.03])
    cell = SimulatedCell(robot, dict(zip(robot.parameter_names, truth, strict=True)), 1e-5)
    problem = IdentificationProblem(robot, bare(cell.measure(q, 1, 1)), sigma=1e-5, loss=loss, starts=20)
    found = identify(problem)
    assert found.residuals.chi_square.probability > 1e-4
    bent = 0.006 + np.array([truth[1], found.fit.deviations[1]])
    assert abs(bent[0]) == pytest.approx(abs(bent[1]), rel=0.1)  # whichever it is, it fits
    assert 0 < found.diagnostics.agreeing_starts < found.diagnostics.starts
    assert "other_minimum" in {r.code for r in found.verdict.reasons}
    moving = q + np.linspace([0.0, 0.0], [0.0, 0.05], 12)
    clear = IdentificationProblem(robot, bare(cell.measure(moving, 1, 1)), sigma=1e-5, loss=loss, starts=20)
    assert "other_minimum" not in {r.code for r in identify(clear).verdict.reasons}


def test_best_minimum_is_taken():
    """The start is in a worse one: another start that ends lower replaces it."""
    robot = Robot.load("planar_2r").with_parameters("offsets")
    q = np.array([[a, b] for a in (-0.4, 0.1, 0.5, 0.9) for b in (-0.004, 0.0, 0.004)])
    names = robot.parameter_names
    cell = SimulatedCell(robot, dict(zip(names, (0.03, -0.05), strict=True)), 1e-6)
    data = bare(cell.measure(q, 1, 2))
    ends = []
    for starts in (0, 40):
        problem = IdentificationProblem(robot, data, sigma=1e-6, starts=starts, discrepancy="off")
        ends.append(identify(problem))
    assert ends[1].residuals.chi_square.value <= ends[0].residuals.chi_square.value * (1 + 1e-9)
    np.testing.assert_allclose(ends[1].fit.deviations, [cell.deviations[n] for n in names], atol=1e-4)


def test_start_elsewhere_ends_in_the_same_place():
    """An earlier estimate to begin from changes the way, not the answer."""
    for seed in range(4):
        cell, asked = placed_cell(seed)
        data = bare(cell.measure(random_configurations(asked, 40, seed), 1, seed))
        problem = IdentificationProblem(asked, data, sigma=SIGMA)
        cold = identify(problem)
        first = identify(IdentificationProblem(asked, data.select(np.arange(25)), sigma=SIGMA))
        warm = identify(problem, start=first)
        assert warm.observability.fixed == cold.observability.fixed
        q = random_configurations(asked, 30, 77)
        apart = warm.calibrated.positions(q) - cold.calibrated.positions(q)
        assert np.abs(apart).max() < 1e-3 * SIGMA


def test_too_few_iterations_are_said():
    robot = Robot.load("kuka_kr270")
    cell = SimulatedCell(robot, random_deviations(robot, 1, 1e-2, 5e-2), SIGMA)
    data = bare(cell.measure(random_configurations(robot, 20, 1), 1, 1))
    found = identify(IdentificationProblem(robot, data, sigma=SIGMA, iterations=1))
    assert found.fit.status == "not_converged" and found.verdict.level == "FAIL"
