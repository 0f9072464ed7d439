"""Do residuals know where the robot stood? Seldom when they do not, and surely when they do."""

from __future__ import annotations

import numpy as np
import pytest
from cells import TARGETS, transmission
from robots import mixed, random_configurations
from scipy.stats import binom

from calib_planner import Robot
from calib_planner.identification import FEWEST, configuration_labels
from calib_planner.identification.checks import residual_structure

ROBOTS = {
    "kuka": lambda: Robot.load("kuka_kr270").with_targets(TARGETS),
    "planar": lambda: Robot.load("planar_2r"),
    "mixed": mixed,
}


def ask(robot: Robot, q: np.ndarray, residuals: np.ndarray):
    use = np.isfinite(residuals[:, :, 0])
    return residual_structure(robot, q, residuals, use, configuration_labels(q))


@pytest.mark.parametrize("count", [12, 60])
@pytest.mark.parametrize("name", ROBOTS)
def test_white_residuals_raise_few_alarms(name, count):
    """Thousands of draws: at most twice the nominal rate, also with heavy tails and unequal axes."""
    robot, rng = ROBOTS[name](), np.random.default_rng(1)
    alarms: dict[str, list[float]] = {}
    for k in range(250):
        q = random_configurations(robot, count, k)
        residuals = rng.standard_normal((count, len(robot.targets), 3)) * [1e-5, 3e-5, 5e-5]
        if k % 2:
            residuals *= np.sqrt(5 / rng.chisquare(5, residuals.shape))
        residuals[rng.random(residuals.shape[:2]) < 0.1] = np.nan
        for found in ask(robot, q, residuals):
            alarms.setdefault(found.kind, []).append(found.probability)
    assert set(alarms) == {"neighbours", "joint"} | ({"configuration"} if len(robot.targets) > 1 else set())
    for values in alarms.values():
        assert np.sum(np.array(values) < 0.01) <= binom.isf(1e-4, len(values), 0.02)
        assert np.sum(np.array(values) < 1e-4) <= binom.isf(1e-4, len(values), 1e-3)


def test_an_erring_transmission_is_found_in_its_joint_and_measured():
    """0.3 mrad in joint 2 alone, under 0.1 mm of noise."""
    robot, sizes = Robot.load("kuka_kr270"), []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        q = random_configurations(robot, 80, seed)
        error = transmission(6, seed, 3e-4, 0.3)(q) * [0, 1, 0, 0, 0, 0]
        residuals = robot.positions(q + error) - robot.positions(q)
        found = ask(robot, q, residuals + 1e-4 * rng.standard_normal(residuals.shape))
        joints = {s.joint: s for s in found if s.kind == "joint"}
        best = min(joints.values(), key=lambda s: s.probability)
        assert best.joint == "joint_a2" and best.probability < 1e-4 and best.unit == "rad"
        assert best.correlation > 0.4
        sizes.append(best.amplitude / np.sqrt(np.mean(error[:, 1] ** 2)))
    assert np.median(sizes) == pytest.approx(1.0, abs=0.25)


def test_a_bending_robot_is_found_among_neighbours_and_targets():
    """An error that is smooth in joint space, and the same for all targets."""
    robot = ROBOTS["kuka"]()
    q = random_configurations(robot, 150, 3)
    q[:, 3:] *= 0.05
    bend = 2e-4 * np.stack([np.cos(q[:, 1]), np.sin(q[:, 2]), np.cos(q[:, 1] + q[:, 2])], axis=1)
    residuals = bend[:, None] + 1e-4 * np.random.default_rng(3).standard_normal((150, 3, 3))
    kinds = {s.kind: s for s in ask(robot, q, residuals - residuals.mean(axis=(0, 1))) if s.kind != "joint"}
    assert kinds["neighbours"].probability < 1e-4 and kinds["neighbours"].unit == "m"
    assert kinds["configuration"].probability < 1e-10
    size = np.sqrt(np.mean(np.sum(bend**2, axis=1)))
    assert kinds["configuration"].amplitude == pytest.approx(size, rel=0.5)


def test_repetitions_count_once_and_little_data_say_nothing():
    robot, rng = Robot.load("kuka_kr270"), np.random.default_rng(5)
    q = np.repeat(random_configurations(robot, 30, 5), 3, axis=0)
    residuals = 1e-4 * np.repeat(rng.standard_normal((30, 1, 3)), 3, axis=0)
    assert all(s.probability > 1e-4 for s in ask(robot, q, residuals))
    once, thrice = ask(robot, q[::3], residuals[::3]), ask(robot, q, residuals)
    np.testing.assert_allclose([s.probability for s in once], [s.probability for s in thrice], rtol=1e-9)
    assert ask(robot, q[: 3 * FEWEST - 3], residuals[: 3 * FEWEST - 3]) == ()


@pytest.mark.parametrize("name", ROBOTS)
def test_nothing_left_and_joints_at_rest_are_no_structure(name):
    robot = ROBOTS[name]()
    q = np.repeat(random_configurations(robot, 1), 20, axis=0)
    q[:, 0] = np.linspace(-0.2, 0.2, 20)
    for found in ask(robot, q, np.zeros((20, len(robot.targets), 3))):
        assert found.probability >= 0.01 and np.isfinite(found.correlation)
