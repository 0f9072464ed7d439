"""Distances that err are told from robots that do, and from every other disturbance."""

from __future__ import annotations

import numpy as np
import pytest
from cells import ROUND, SIGMA, WrongRobot, bare, placed_cell, plain_cell
from robots import random_configurations

from calib_planner import IdentificationProblem, Measurements, Robot, identify
from calib_planner.identification.checks import Disturbance, check_distances, instead_of_discrepancy
from calib_planner.identification.least_squares import Equations, gauss_newton, point_whitening
from calib_planner.simulation import SimulatedCell, random_deviations

KUKA = Robot.load("kuka_kr270")


def clean(seed: int, place: str = "known", count: int = 30) -> tuple[Robot, Measurements]:
    cell, asked = plain_cell(seed) if place == "known" else placed_cell(seed, "offsets")
    return asked, bare(cell.measure(random_configurations(asked, count, seed), 1, seed))


def broken(data: Measurements, seed: int, size: float) -> Measurements:
    """A break before every third row or so: from there on distances differ by another number."""
    rng = np.random.default_rng([seed, 6])
    part = np.cumsum(rng.random(len(data)) < 0.35)
    off = size * rng.standard_normal(len(data))[part]
    sight = data.p / np.linalg.norm(data.p, axis=2, keepdims=True)
    return bare(data, data.p + off[:, None, None] * sight)


def asked(robot: Robot, data: Measurements) -> tuple[Disturbance | None, Equations, object]:
    """The answer with equations and fit; known place only."""
    whitening = point_whitening(np.broadcast_to(SIGMA**2 * np.eye(3), (*data.p.shape, 3)), data.seen)
    equations = Equations(robot, data, data.seen, whitening)
    kept = tuple(range(len(robot.parameter_names)))
    fit = gauss_newton(equations, np.zeros(len(kept)), kept, 50)
    return check_distances(equations, fit.deviations, kept, fit.covariance()), equations, fit


def test_probabilities_are_such_without_a_fault() -> None:
    found = np.array([asked(*clean(seed))[0].probability for seed in range(50)])
    # Uniform: of 50 the share below 0.2 is within 3 · 5.7 % of it.
    assert np.mean(found < 0.2) == pytest.approx(0.2, abs=0.17) and found.min() > 1e-4


def test_the_numbers_are_those_of_a_column_for_each_distance() -> None:
    """Oracle: every point's distance as an unknown beside the parameters, solved at once."""
    robot, data = clean(3)
    best, equations, fit = asked(robot, broken(data, 3, 2e-4))
    residuals, jacobian = equations.linearise(fit.deviations)
    points = robot.positions(data.q, fit.deviations)[:, 0]
    columns = np.zeros((len(data), 3, len(data)))
    for i, sight in enumerate(points / np.linalg.norm(points, axis=1)[:, None]):
        columns[i, :, i] = sight / SIGMA
    columns = columns.reshape(-1, len(data))
    both = np.hstack([jacobian, columns])
    solution = np.linalg.lstsq(both, residuals, rcond=None)[0]
    left = float(np.sum((residuals - both @ solution) ** 2))
    assert best.left == pytest.approx(left, rel=1e-6)
    assert best.freedom == len(residuals) - both.shape[1]
    # One of that size that lasts from the k-th point on: the harm is the largest that any k does.
    size = best.translation[0]
    moved = [
        np.abs(np.linalg.lstsq(jacobian, size * columns[:, k:].sum(axis=1), rcond=None)[0])
        / np.sqrt(np.diag(fit.covariance()))
        for k in range(len(data))
    ]
    assert best.shift == pytest.approx(np.max(moved), rel=1e-6)
    assert best.parameter == robot.parameter_names[int(np.argmax(np.max(moved, axis=0)))]


def test_the_size_is_that_of_the_errors() -> None:
    sizes = []
    for seed in range(12):
        robot, data = clean(seed)
        off = 2e-4 * np.random.default_rng([seed, 6]).standard_normal(len(data))
        sight = data.p / np.linalg.norm(data.p, axis=2, keepdims=True)
        sizes.append(asked(robot, bare(data, data.p + off[:, None, None] * sight))[0].translation[0])
    assert np.sqrt(np.mean(np.square(sizes))) == pytest.approx(2e-4, rel=0.2)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("place", ["known", "unknown"])
def test_breaks_are_found(place: str, seed: int) -> None:
    robot, data = clean(seed, place)
    found = identify(IdentificationProblem(robot, broken(data, seed, 2e-4), sigma=SIGMA, starts=0))
    assert [d.kind for d in found.diagnostics.disturbances] == ["distance"] and found.diagnostics.disturbances[
        0
    ].instead
    (reason,) = (r for r in found.verdict.reasons if r.code == "distance")
    assert reason.level == found.verdict.level == "WARN"


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_that_errs_is_none_of_it(seed: int) -> None:
    """Large errors leave more than noise across the beam; small ones do not keep to it."""
    for turning, white in ((3.5e-4, 1e-4), (3e-5, 1e-5)):
        wrong = WrongRobot(seed, turning, 0.07, white)
        data = wrong.measure(random_configurations(wrong.asked, 40, seed))
        found = identify(IdentificationProblem(wrong.asked, data, sigma=SIGMA, starts=0))
        assert found.noise.discrepancy > 0 and found.diagnostics.disturbances == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_target_seated_elsewhere_that_passes_for_a_discrepancy(seed: int) -> None:
    """Round one posture, repetitions one after the other: whitened by the discrepancy nobody sees it."""
    nominal = Robot.load("kuka_kr270")
    cell = SimulatedCell(nominal, random_deviations(nominal, seed), SIGMA / 4)
    data = bare(cell.measure(ROUND, 2, seed))
    raw = np.random.default_rng(seed).standard_normal(3)
    seat = cell.truth.robot.target_offsets + 3e-4 * raw / np.linalg.norm(raw)
    moved = np.where(
        np.arange(24)[:, None, None] < 12,
        0.0,
        cell.truth.with_targets(seat).positions(data.q) - cell.truth.positions(data.q),
    )
    found = identify(IdentificationProblem(nominal, bare(data, data.p + moved), sigma=SIGMA / 4, starts=0))
    (best,) = found.diagnostics.disturbances
    assert found.noise.discrepancy > 1e-5 and best.instead
    assert (best.kind, best.row) == ("reseat", 12)
    assert np.linalg.norm(best.translation) == pytest.approx(3e-4, rel=0.1)


def answer(left: float, probability: float = 1e-6, shift: float = 2.0, kind: str = "bump") -> Disturbance:
    return Disturbance(kind, 3, None, probability, np.zeros(3), np.zeros(3), shift, "d1", left, 60)


def test_which_one_is_said_instead_of_a_discrepancy() -> None:
    """It must be no chance, do harm, and leave what noise explains; then the one that leaves least improbably."""
    assert instead_of_discrepancy([answer(120.0)], 0) is None
    assert instead_of_discrepancy([answer(60.0, probability=0.01)], 0) is None
    assert instead_of_discrepancy([answer(60.0, shift=0.9)], 0) is None
    best = instead_of_discrepancy([answer(75.0), answer(58.0, kind="drift"), answer(40.0, shift=0.1)], 0)
    assert best is not None and (best.kind, best.instead) == ("drift", True)
    # A level that ten degrees of freedom told is less sure: twice of it is possible.
    assert instead_of_discrepancy([answer(120.0)], 10) is not None
