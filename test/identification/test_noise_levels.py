"""What the scatter is made of: found as it was simulated, and not found where there is none."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
import pytest
from cells import SIGMA, WrongRobot, bare, placed_cell, plain_cell
from robots import mixed, random_configurations
from scipy.linalg import block_diag
from scipy.stats import binom

from calib_planner import IdentificationProblem, Measurements, identify
from calib_planner.identification import DOUBT, NoiseLevels, configuration_labels, improbable
from calib_planner.identification.least_squares import (
    Equations,
    block_whitening,
    configuration_blocks,
    point_whitening,
)
from calib_planner.identification.noise_levels import DiscrepancyModel, estimate_variances, repeat_scatter
from calib_planner.tracker import LaserTracker

QUIET = {"starts": 0, "joint_corrections": "off"}


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def within(values, truth: float, errors: float = 4.0) -> bool:
    """Whether the mean square is the truth's, within its sampling error."""
    squares = np.square(values)
    return abs(squares.mean() - truth**2) < errors * squares.std(ddof=1) / np.sqrt(len(squares))


# ── found as simulated ───────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("turning", "white", "count", "repetitions"),
    [(3.5e-4, 0.0, 30, 1), (0.0, 1e-4, 30, 1), (3.5e-4, 1e-4, 30, 1), (3.5e-4, 1e-4, 15, 3)],
)
def test_amplitudes_are_those_simulated(turning, white, count, repetitions):
    """Restricted likelihood is unbiased where least squares residuals are too small: 9 parameters, 15–30 rows."""
    found, achieved, predicted = [], [], []
    for seed in range(25):
        robot = WrongRobot(seed, turning, 0.05, white)
        q, poses = (
            random_configurations(robot.asked, count, seed),
            random_configurations(robot.asked, 30, seed + 99),
        )
        data = robot.measure(q, repetitions)
        problem = IdentificationProblem(robot.asked, data, sigma=SIGMA, test_poses=poses, **QUIET)
        estimate = identify(problem)
        found.append(estimate.noise)
        error = estimate.calibrated.positions(poses) - robot.points(poses)
        achieved.append(np.mean(np.sum(error**2, axis=2)))
        predicted.append(estimate.accuracy.overall**2)
    assert all(noise.discrepancy > 0 for noise in found)
    assert all(noise.source == "sigma" and noise.scaled == 1 for noise in found)
    if turning and white:
        # The two are told apart less well than they are together.
        both = [noise.discrepancy for noise in found]
        lever = np.mean(np.sum(robot.asked.joint_jacobian(q) ** 2, axis=2))
        assert rms(both) == pytest.approx(np.sqrt(white**2 + turning**2 * lever), rel=0.1)
    if turning:
        assert within([noise.turning for noise in found], turning)
    if white:
        assert within([noise.point for noise in found], white)
    ratio = np.mean(achieved) / np.mean(predicted)
    assert ratio == pytest.approx(
        1.0, abs=4 * np.std(achieved) / np.mean(achieved) / np.sqrt(len(achieved)) + 0.05
    )


def test_repetitions_contradict_what_is_stated():
    """Stated half of what it is: raised to the truth. Stated rightly: left alone."""
    raised, same = [], 0
    for seed in range(25):
        cell, asked = plain_cell(seed)
        data = bare(cell.measure(random_configurations(asked, 15, seed), 2, seed))
        found = identify(IdentificationProblem(asked, data, sigma=SIGMA / 2, **QUIET)).noise
        raised.append(found.measurement)
        assert found.scaled > 1.0
        assert found.measurement == pytest.approx(found.scaled * SIGMA / 2)
        assert found.measurement == pytest.approx(found.repeatability)
        same += identify(IdentificationProblem(asked, data, sigma=SIGMA, **QUIET)).noise.scaled != 1.0
    assert within(raised, SIGMA)
    assert same <= binom.isf(1e-4, 25, DOUBT)


# ── not found where there is none ────────────────────────────────────────────────────────────────────

CLEAN = {
    "sigma": ([1] * 15, {"sigma": SIGMA}),
    "sigma, repeated": ([2] * 10, {"sigma": SIGMA}),
    "unknown, repeated": ([2] * 10, {}),
    "unknown, one repeated": ([3] + [1] * 18, {}),
}


@pytest.mark.parametrize("name", CLEAN)
def test_clean_sets_have_no_discrepancy(name):
    """Also where the noise level itself was told by a handful of repetitions."""
    repetitions, options = CLEAN[name]
    count, alarms, levels = 50, 0, []
    for seed in range(count):
        cell, asked = plain_cell(seed)
        q = random_configurations(asked, len(repetitions), seed)
        found = identify(
            IdentificationProblem(asked, bare(cell.measure(q, repetitions, seed)), **options, **QUIET)
        )
        alarms += found.noise.discrepancy > 0
        levels.append(found.noise.measurement)
    assert alarms <= binom.isf(1e-4, count, DOUBT)
    if not options:
        assert within(levels, SIGMA)


def test_clean_sets_with_unknown_placement_have_no_discrepancy():
    for seed in range(5):
        cell, asked = placed_cell(seed)
        data = bare(cell.measure(random_configurations(asked, 30, seed), 1, seed))
        assert identify(IdentificationProblem(asked, data, sigma=SIGMA, **QUIET)).noise.discrepancy == 0.0


@pytest.mark.parametrize("repeats", [0, 6, 30])
def test_improbable_is_as_rare_as_it_says(repeats):
    """χ² where the level is known, Fisher's F where ``repeats`` degrees of freedom told it."""
    rng, freedom, draws = np.random.default_rng(repeats), 60, 20_000
    square = rng.chisquare(freedom - repeats, draws)
    if repeats:
        own = rng.chisquare(repeats, draws)
        square = square / (own / repeats) + repeats
    # The first improbable one in their order tells how many are, for a hundredth of the work.
    alarms = draws - bisect_left(sorted(square.tolist()), True, key=lambda c: improbable(c, freedom, repeats))
    assert binom.isf(1 - 1e-4, draws, DOUBT) <= alarms <= binom.isf(1e-4, draws, DOUBT)
    assert not improbable(1e9, 9)


# ── the parts ────────────────────────────────────────────────────────────────────────────────────────


def test_scatter_of_repetitions_is_the_pooled_variance():
    rng = np.random.default_rng(3)
    labels = np.array([0, 1, 0, 2, 2, 2, 1, 3])
    residuals, use = rng.standard_normal((8, 2, 3)), rng.random((8, 2)) < 0.8
    total, freedom = 0.0, 0
    for label in range(4):
        for t in range(2):
            group = residuals[(labels == label) & use[:, t], t]
            if len(group):
                total += np.sum((group - group.mean(axis=0)) ** 2)
                freedom += 3 * (len(group) - 1)
    got = repeat_scatter(residuals, labels, use)
    assert got[1] == freedom
    assert got[0] == pytest.approx(total / freedom, rel=1e-12)
    assert np.isnan(repeat_scatter(residuals, np.arange(8), use)[0])


def test_rows_that_differ_less_than_a_joint_repeats_are_one_configuration():
    q = np.array([[0.0, 1.0], [1e-4, 1.0], [0.0, 1.1], [0.0, 1.0 - 1e-4], [5.0, 1.0]])
    labels = configuration_labels(q)
    assert labels[0] == labels[1] == labels[3]
    assert len(set(labels[[0, 2, 4]].tolist())) == 3


def small_model(seed: int = 0):
    """A mixed robot's equations with repetitions, missing points and noise by direction."""
    robot, rng = mixed(), np.random.default_rng(seed)
    q = np.repeat(random_configurations(robot, 9, seed), [1, 3, 2, 1, 1, 2, 1, 1, 2], axis=0)
    points = robot.positions(q) + 1e-4 * rng.standard_normal((len(q), 2, 3))
    points[3, 1] = points[6, 0] = np.nan
    data = Measurements(robot.joint_names, q, points)
    instrument = LaserTracker().covariance(np.nan_to_num(data.p, nan=1.0) + np.array([3.0, 0.0, 0.0]))
    equations = Equations(robot, data, data.seen, point_whitening(instrument, data.seen))
    labels = configuration_labels(q)
    return equations, instrument, labels, DiscrepancyModel.of(equations, instrument, labels)


def dense(equations, instrument, labels, model, variances) -> np.ndarray:
    """Σ in the order of the equations, block by block from the definition."""
    owner = np.repeat(np.repeat(labels[:, None], 2, axis=1)[equations.use], 3)
    together = owner[:, None] == owner[None, :]
    shared = sum(v * (c @ c.T) for v, c in zip(variances, model.columns, strict=True))
    return block_diag(*instrument[equations.use]) + together * shared


def test_whitening_is_the_dense_inverse():
    """Blocks of several sizes, repetitions, missing points, a covariance that is not isotropic."""
    equations, instrument, labels, model = small_model()
    assert {"point", "turning", "sliding"} <= set(model.names)
    variances = np.linspace(1e-8, 9e-8, len(model.names))
    sigma = dense(equations, instrument, labels, model, variances)
    whitening = model.whitening(variances)
    applied = whitening.apply(np.eye(len(sigma)))
    np.testing.assert_allclose(applied.T @ applied @ sigma, np.eye(len(sigma)), atol=1e-7)
    blocks = configuration_blocks(labels, equations.use)
    same = block_whitening(blocks, instrument[equations.use], np.zeros((len(sigma), 1)))
    alone = point_whitening(instrument, equations.use)
    vector = np.arange(float(len(sigma)))
    assert np.sum(same.apply(vector) ** 2) == pytest.approx(np.sum(alone.apply(vector) ** 2))


def test_variances_maximise_the_dense_restricted_likelihood():
    """Against the likelihood written out with dense matrices; the optimum is on no bound here."""
    equations, instrument, labels, model = small_model(1)
    robot, data = equations.robot, equations.data
    rng = np.random.default_rng(7)
    truth = np.array([{"turning": 1e-7, "sliding": 1e-7}.get(name, 1e-8) for name in model.names])
    sigma = dense(equations, instrument, labels, model, truth)
    residuals = np.linalg.cholesky(sigma) @ rng.standard_normal(len(sigma))
    jacobian = robot.jacobian(data.q).reshape(*data.p.shape, -1)[data.seen].reshape(len(sigma), -1)
    jacobian = jacobian[:, np.linalg.norm(jacobian, axis=0) > 0.1][:, :5]

    def likelihood(variances):
        cov = dense(equations, instrument, labels, model, variances)
        inverse = np.linalg.inv(cov)
        normal = jacobian.T @ inverse @ jacobian
        projection = inverse - inverse @ jacobian @ np.linalg.solve(normal, jacobian.T @ inverse)
        logs = np.linalg.slogdet(cov)[1] + np.linalg.slogdet(normal)[1]
        return -0.5 * (logs + residuals @ projection @ residuals)

    none = np.empty((0, jacobian.shape[1])), np.empty(0)
    found = estimate_variances(model, residuals, jacobian, none)
    best = likelihood(found)
    assert best > likelihood(truth)
    for k in range(len(found)):
        for factor in (0.8, 1.25):
            other = found.copy()
            other[k] = max(other[k], 1e-12) * factor
            assert likelihood(other) < best + 1e-3


def test_discrepancy_of_a_pose_is_what_joint_errors_do_there():
    """Against a sample of joint errors on a robot that turns and slides."""
    robot, rng = mixed(), np.random.default_rng(4)
    levels = NoiseLevels(3e-5, "sigma", point=5e-5, turning=3e-4, sliding=2e-4)
    q = random_configurations(robot, 2, 4)
    size = np.where(robot.joint_is_revolute, 3e-4, 2e-4)
    errors = size * rng.standard_normal((40_000, 1, 4))
    sample = np.stack([robot.positions(row + errors[:, 0]) for row in q]) - robot.positions(q)[:, None]
    sample += 5e-5 * rng.standard_normal(sample.shape)
    expected = np.einsum("nkta,nktb->ntab", sample, sample) / sample.shape[1]
    got = levels.discrepancy_covariance(robot, q)
    scale = np.sqrt(np.einsum("ntaa,ntbb->ntab", got, got))
    np.testing.assert_allclose(got / scale, expected / scale, atol=0.03)
    planned = levels.for_planning()
    assert (planned.joint_sigma, planned.slide_sigma, planned.point_sigma) == (3e-4, 2e-4, 5e-5)


def test_covariance_with_a_discrepancy_is_the_dense_sandwich():
    """N⁻¹ JᵀWΣWJ N⁻¹ with Σ from the levels found, repetitions sharing the discrepancy of their configuration."""
    robot = WrongRobot(3)
    q = random_configurations(robot.asked, 15, 3)
    data = robot.measure(q, 2)
    found = identify(IdentificationProblem(robot.asked, data, sigma=SIGMA, **QUIET))
    assert found.noise.discrepancy > 0
    jacobian = robot.asked.jacobian(data.q, found.fit.deviations).reshape(90, -1)
    shared = found.noise.discrepancy_covariance(robot.asked, q)[:, 0]
    blocks = [np.kron(np.ones((2, 2)), block) + found.noise.measurement**2 * np.eye(6) for block in shared]
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    expected = inverse @ jacobian.T @ block_diag(*blocks) @ jacobian @ inverse
    std = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found.fit.covariance / np.outer(std, std), expected / np.outer(std, std), atol=1e-3
    )


@pytest.mark.parametrize("length", [0.3, 1.0])
def test_std_is_right_though_configurations_share_the_errors_of_joints(length):
    """A transmission error that is smooth in a joint's angle moves the parameters by more than a white one."""
    squares = []
    for seed in range(10):
        robot = WrongRobot(seed, 3.5e-4, length, 1e-4)
        data = robot.measure(random_configurations(robot.asked, 50, seed))
        found = identify(IdentificationProblem(robot.asked, data, sigma=SIGMA, starts=0))
        assert found.transmission is not None
        truth = np.array([robot.cell.deviations[name] for name in found.fit.parameters])
        squares.append(np.mean(((found.fit.deviations - truth) / found.fit.std) ** 2))
    error = max(np.std(squares), 0.5) / np.sqrt(len(squares))
    assert np.mean(squares) == pytest.approx(1.0, abs=4 * error)
    assert np.mean(squares) < 2.0


def test_noise_told_by_repetitions_is_that_of_the_joint_corrections():
    """Given by sigma or told by as many repetitions as need be, the complete model is nearly the same."""
    robot = WrongRobot(4, 5e-4, 0.5, 2e-5)
    data = robot.measure(random_configurations(robot.asked, 40, 4), 3)
    given = identify(IdentificationProblem(robot.asked, data, sigma=SIGMA, starts=0))
    told = identify(IdentificationProblem(robot.asked, data, starts=0))
    assert told.noise.source == "repetitions"
    assert told.noise.measurement == pytest.approx(SIGMA, rel=0.15)
    assert told.transmission is not None and given.transmission is not None
    assert told.transmission.gain == pytest.approx(given.transmission.gain, rel=0.1)
    assert told.transmission.amplitude == pytest.approx(given.transmission.amplitude, rel=0.05)
    q = random_configurations(robot.asked, 50, 5)
    np.testing.assert_allclose(told.positions(q), given.positions(q), atol=1e-5)
