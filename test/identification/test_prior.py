# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A prior is so many more equations: against scipy on the stacked problem, and against its own promises."""

from __future__ import annotations

import numpy as np
import pytest
from cells import ANGLE, LENGTH, SIGMA, bare, plain_cell
from robots import mixed, random_configurations, repeats
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.stats import chi2

from calib_planner import IdentificationProblem, InputError, Robot, UnknownNameError, identify
from calib_planner.error_model import ErrorModel, Prior, typical_prior
from calib_planner.error_model.placement import ZERO
from calib_planner.error_model.typical import SCALES
from calib_planner.robot import is_nuisance
from calib_planner.simulation import SimulatedCell, random_deviations
from calib_planner.tracker import LaserTracker

TRACKER = LaserTracker(station=np.array([6.0, -2.0, 1.0]), azimuth=1.5e-5, elevation=3e-5)


PAPER = ErrorModel.paper()


def nominal(robot: Robot) -> np.ndarray:
    return np.array([p.nominal for p in robot.parameters])


def usual(robot: Robot) -> np.ndarray:
    return np.array([LENGTH if p.unit == "m" else ANGLE for p in robot.parameters])


def correlated(robot: Robot, seed: int) -> Prior:
    """Expected values off nominal, every pair of parameters correlated."""
    rng, std = np.random.default_rng(seed), usual(robot)
    factor = rng.standard_normal((len(std), 2 * len(std)))
    unit = factor @ factor.T
    scale = np.sqrt(np.diag(unit))
    covariance = unit / np.outer(scale, scale) * np.outer(std, std)
    return Prior(robot.parameter_names, nominal(robot) + std * rng.standard_normal(len(std)), covariance)


ROBOTS = {"kuka": lambda: Robot.load("kuka_kr270"), "mixed": lambda: mixed().with_parameters("offsets")}


@pytest.mark.parametrize("instrument", [None, TRACKER], ids=["isotropic", "tracker"])
@pytest.mark.parametrize("name", ROBOTS)
def test_estimate_is_the_maximum_a_posteriori_of_scipy(name, instrument):
    """Stacked residuals, numeric derivatives, dense covariance of the points; values and covariance."""
    robot = ROBOTS[name]()
    cell = SimulatedCell(robot, random_deviations(robot, 3, LENGTH, ANGLE), SIGMA)
    data = bare(cell.measure(random_configurations(robot, 7, 3), [2, 1, 1, 3, 1, 1, 1], 3))
    points = SIGMA**2 * np.eye(data.p.size)
    if instrument is not None:
        true = robot.positions(data.q, [cell.deviations[n] for n in robot.parameter_names])
        blocks = instrument.covariance(true)
        unit = np.random.default_rng(8).standard_normal((*true.shape, 1))
        data = bare(data, true + (np.linalg.cholesky(blocks) @ unit)[..., 0])
    prior = correlated(robot, 5)
    noise = {"sigma": SIGMA} if instrument is None else {"instrument": instrument}
    estimate = identify(IdentificationProblem(robot, data, error_model=PAPER, prior=prior, **noise))
    if instrument is not None:  # as it is where the points are, not where they were measured
        points = block_diag(*instrument.covariance(estimate.positions(data.q)).reshape(-1, 3, 3))
    left = np.linalg.inv(np.linalg.cholesky(points))
    right = np.linalg.inv(np.linalg.cholesky(np.asarray(prior.covariance)))

    def residuals(scaled):
        deviations = scaled * usual(robot)
        measured = left @ (data.p - robot.positions(data.q, deviations)).ravel()
        return np.append(measured, right @ (np.asarray(prior.values) - nominal(robot) - deviations))

    oracle = least_squares(
        residuals, np.zeros(len(usual(robot))), jac="3-point", **dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
    )
    covariance = np.linalg.inv(oracle.jac.T @ oracle.jac)
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(estimate.fit.deviations / usual(robot), oracle.x, atol=2e-3 * std.min())
    np.testing.assert_allclose(estimate.fit.std / usual(robot), std, rtol=1e-4)
    scaled = estimate.fit.covariance / np.outer(estimate.fit.std, estimate.fit.std)
    np.testing.assert_allclose(scaled, covariance / np.outer(std, std), atol=1e-4)
    assert estimate.residuals.chi_square.value == pytest.approx(2 * oracle.cost, rel=1e-6)


def drawn(seed: int, level: str, count: int, targets=((0.1, 0.05, 0.1),)):
    """A robot whose true errors come from the prior."""
    robot = Robot.load("kuka_kr270").with_targets(targets).with_parameters(level)
    cell = SimulatedCell(robot, random_deviations(robot, seed, LENGTH, ANGLE), SIGMA)
    prior = Prior(robot.parameter_names, nominal(robot), usual(robot))
    return cell, prior, bare(cell.measure(random_configurations(robot, count, seed), 1, seed))


@pytest.mark.parametrize("model", [PAPER, None], ids=["paper", "typical"])
@pytest.mark.parametrize(("level", "count"), [("lengths+offsets", 6), ("full", 12)])
def test_uncertainty_is_right_where_the_truth_comes_from_the_prior(level, count, model):
    """Errors measured by the whole covariance are χ², also in directions that no point sees.

    With more terms than the truth has the uncertainty may be larger than it is, and no smaller.
    """
    total, freedom = 0.0, 0
    for seed in range(repeats(10, 20)):
        cell, prior, data = drawn(seed, level, count)
        estimate = identify(IdentificationProblem(cell.nominal, data, SIGMA, model, prior=prior))
        assert estimate.fit.status == "ok"
        error = estimate.fit.deviations - np.array([cell.deviations[n] for n in estimate.fit.parameters])
        scale = np.sqrt(np.diag(estimate.fit.covariance))
        total += (error / scale) @ np.linalg.solve(
            estimate.fit.covariance / np.outer(scale, scale), error / scale
        )
        freedom += len(error)
    assert total < chi2.isf(1e-4, freedom)
    assert total > (chi2.ppf(1e-4, freedom) if model is PAPER else 0.5 * freedom)


@pytest.mark.parametrize(("level", "count"), [("lengths+offsets", 6), ("full", 15)])
def test_unknown_noise_beside_a_prior_is_neither_over_nor_underestimated(level, count):
    """What the prior decides costs no degrees of freedom, what the data decide does."""
    squares = []
    for seed in range(repeats(10, 30)):
        cell, prior, data = drawn(seed, level, count)
        estimate = identify(IdentificationProblem(cell.nominal, data, error_model=PAPER, prior=prior))
        assert estimate.fit.status == "ok"
        squares.append((estimate.noise.sigma / SIGMA) ** 2)
    assert np.mean(squares) == pytest.approx(1.0, abs=4 * np.std(squares) / np.sqrt(len(squares)))


@pytest.mark.parametrize("model", [PAPER, None], ids=["paper", "typical"])
@pytest.mark.parametrize("sigma", [SIGMA, None])
@pytest.mark.parametrize("count", [1, 2])
def test_fewer_equations_than_parameters(count, sigma, model):
    """It is an estimate no less certain than the prior; that next to nothing proves it is said."""
    cell, prior, data = drawn(1, "lengths+offsets", count)
    estimate = identify(IdentificationProblem(cell.nominal, data, sigma, model, prior=prior))
    assert estimate.fit.status == "ok"
    assert (estimate.fit.std <= usual(cell.nominal) * (1 + 1e-6)).all()
    assert estimate.verdict.level != "PASS"
    assert {"too_few_measurements", "unproven"} & {r.code for r in estimate.verdict.reasons}


def test_no_prior_and_flat_prior_are_the_same_and_a_sharp_one_wins():
    cell, robot = plain_cell(2)
    data = bare(cell.measure(random_configurations(robot, 15, 2), 1, 2))

    def told(prior=None):
        return identify(IdentificationProblem(robot, data, SIGMA, PAPER, prior=prior))

    without = told()
    count = len(without.fit.parameters)
    flat = told(Prior(without.fit.parameters, nominal(robot), np.full(count, 1e3)))
    np.testing.assert_allclose(flat.fit.deviations, without.fit.deviations, atol=1e-3 * without.fit.std.min())
    np.testing.assert_allclose(flat.fit.std, without.fit.std, rtol=1e-6)
    sharp = told(Prior(without.fit.parameters, nominal(robot) + 1e-3, np.full(count, 1e-9)))
    np.testing.assert_allclose(sharp.fit.values, nominal(robot) + 1e-3, atol=1e-7)


def test_prior_decides_what_the_data_cannot_see():
    """q6 turns the reflector about itself, q1 is the base's turn: named as resolved, at the prior's values."""
    robot = Robot.load("kuka_kr270").with_targets(np.zeros((1, 3))).with_parameters("d2,q6,q1", ("base",))
    cell = SimulatedCell(robot.with_parameters("d2"), {"d2": 1e-3}, SIGMA)
    data = bare(cell.measure(random_configurations(robot, 12, 1), 1, 1))
    without = identify(IdentificationProblem(robot, data, SIGMA, PAPER))
    assert set(without.observability.fixed) == {"q6", "q1"}
    prior = Prior(("q1", "q6"), [0.002, 0.3], [1e-4, 1e-3])
    told = identify(IdentificationProblem(robot, data, SIGMA, PAPER, prior=prior))
    assert told.fit.status == "ok"
    assert told.observability.fixed == told.observability.unidentifiable == ()
    assert len(told.observability.resolved_by_prior) == 2
    got = dict(zip(told.fit.parameters, zip(told.fit.values, told.fit.std, strict=True), strict=True))
    assert got["q6"] == pytest.approx((0.3, 1e-3), rel=1e-6)
    assert got["q1"] == pytest.approx((0.002, 1e-4), rel=1e-6)
    q = random_configurations(robot, 50, 2)
    np.testing.assert_allclose(told.calibrated.positions(q), without.calibrated.positions(q), atol=1e-7)


BROKEN = {
    "twice": (("a", "a"), [0, 0], [1, 1], "each once"),
    "none": ((), [], [], "each once"),
    "shape": (("a", "b"), [0], [1, 1], "prior.values"),
    "zero": (("a", "b"), [0, 0], [1, 0], "prior.std of b"),
    "negative": (("a", "b"), [0, 0], [1, -1], "prior.std of b"),
    "NaN": (("a", "b"), [0, np.nan], [1, 1], "prior.values"),
    "NaN std": (("a", "b"), [0, 0], [1, np.nan], "prior.std"),
    "not symmetric": (("a", "b"), [0, 0], [[1, 0.5], [0.1, 1]], "positive definite"),
    "not positive": (("a", "b"), [0, 0], [[1, 2], [2, 1]], "positive definite"),
    "singular": (("a", "b"), [0, 0], [[1, 1], [1, 1]], "positive definite"),
    "number": (("a",), [0], 1.0, "prior.covariance"),
    "negative in covariance": (("a", "b"), [0, 0], [[-0.5, 0], [0, 1]], "positive definite"),
    "zero in covariance": (("a", "b"), [0, 0], [[0, 0], [0, 1]], "positive definite"),
    "not symmetric and small": (("a", "b"), [0, 0], [[1e-8, 4e-9], [3e-9, 1e-8]], "positive definite"),
    "singular and small": (("a", "b"), [0, 0], [[1e-10, 1e-10], [1e-10, 1e-10]], "positive definite"),
    "covariance shape": (("a", "b"), [0, 0], np.eye(3), "prior.covariance"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_refusals(name):
    names, values, covariance, needle = BROKEN[name]
    with pytest.raises(InputError, match=needle):
        Prior(names, values, covariance)


def test_prior_of_another_robot_is_refused_with_the_names_there_are():
    cell, asked = plain_cell(0)
    data = cell.measure(random_configurations(asked, 6), 1, 0)
    with pytest.raises(UnknownNameError, match=r"d0.*elbow"):
        IdentificationProblem(asked.with_parameters("d0,d2"), data, prior=Prior(("elbow",), [0], [1]))


def test_units_of_very_different_size_are_no_singular_covariance():
    prior = Prior(("a", "b"), [0, 0], [[1e-24, 0], [0, 1e6]])
    np.testing.assert_allclose(prior.rows(("b", "c", "a")), [[0, 0, 1e12], [1e-3, 0, 0]], rtol=1e-12)


def test_rows_of_a_prior_are_its_normal_distribution():
    """Equations of variance one, whose normal matrix tells the variance of one parameter given the other."""
    covariance = np.array([[4e-6, 1.2e-7], [1.2e-7, 1e-8]])  # correlation 0.6
    rows = Prior(("d1", "q2"), [0.5, 0.1], covariance).rows(("q2", "d3", "d1"))
    np.testing.assert_allclose(rows[:, [2, 0]] @ covariance @ rows[:, [2, 0]].T, np.eye(2), atol=1e-12)
    normal = rows.T @ rows
    assert not normal[1].any() and not normal[:, 1].any()
    assert 1.0 / normal[2, 2] == pytest.approx(4e-6 * (1.0 - 0.6**2))
    assert 1.0 / normal[0, 0] == pytest.approx(1e-8 * (1.0 - 0.6**2))
    assert normal[0, 2] < 0.0


def test_typical_prior():
    """Lengths and angles by unit; whatever acts as a joint's zero nearly free; base and targets not at all."""
    robot = Robot.load("kuka_kr270").with_targets(np.zeros((1, 3))).with_parameters("full", ("base", "tool"))
    prior = typical_prior(robot)
    kinematic = [p for p in robot.parameters if not is_nuisance(p.name)]
    assert prior.names == tuple(p.name for p in kinematic)
    np.testing.assert_array_equal(prior.values, [p.nominal for p in kinematic])
    std = dict(zip(prior.names, np.sqrt(np.diag(prior.covariance)), strict=True))
    zeros = {name for name, s in std.items() if s == pytest.approx(ZERO)}
    assert len(zeros) >= 6
    assert all(name.split(".")[1].startswith("r") for name in zeros)
    sizes = {s.unit: s.value for s in SCALES if s.name.startswith("placement.")}
    for p in kinematic:
        if p.name not in zeros:
            assert std[p.name] == pytest.approx(sizes[p.unit])
    assert typical_prior(robot.with_parameters([], ("base",))) is None
