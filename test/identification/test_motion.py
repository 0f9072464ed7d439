"""What is remembered of a place is what the robot says of it."""

from __future__ import annotations

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import Robot
from calib_planner.identification.least_squares import MOST_PLACES, Motion

ROUNDING = 1e-14
TARGETS = [[0.1, 0.0, 0.2], [0.0, 0.15, 0.1]]


@pytest.fixture
def motion(monkeypatch) -> Motion:
    """Counts how often the robot is asked, in ``motion.asked``."""
    robot = Robot.load("kuka_kr270").with_targets(TARGETS).with_parameters("full")
    made, ask = Motion(robot, random_configurations(robot, 5)), Robot.positions_and_jacobian
    made.asked = []
    monkeypatch.setattr(Robot, "positions_and_jacobian", lambda *a: made.asked.append(a[2].copy()) or ask(*a))
    return made


def places(motion: Motion, count: int) -> np.ndarray:
    return 1e-3 * np.random.default_rng(0).standard_normal((count, len(motion.robot.parameter_names)))


def assert_known(motion: Motion, deviations: np.ndarray, tolerance: float = 0.0) -> None:
    points, jacobian = motion.at(deviations)
    expected = motion.robot.jacobian(motion.q, deviations).reshape(*points.shape, -1)
    np.testing.assert_allclose(points, motion.robot.positions(motion.q, deviations), rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(jacobian, expected, rtol=0, atol=tolerance)
    assert not points.flags.writeable and not jacobian.flags.writeable


def test_the_last_places_and_the_nominal_one_cost_nothing(motion):
    several = places(motion, MOST_PLACES + 2)
    nominal = np.zeros(several.shape[1])
    for there in (nominal, *several):
        assert_known(motion, there)
    motion.asked.clear()
    for there in (-nominal, *several[-MOST_PLACES:], nominal):
        motion.at(there)
    assert motion.asked == []
    motion.at(several[0])
    assert len(motion.asked) == 1
    motion.at(several[-MOST_PLACES])  # the one that made room
    assert len(motion.asked) == 2


def test_values_changed_in_place_are_another_place(motion):
    there = places(motion, 1)[0]
    motion.at(there)
    there[0] += 1e-4
    assert_known(motion, there)


def test_carried_by_a_small_step(motion):
    before, step = places(motion, 2)
    motion.at(before)
    after = before + 1e-6 * step
    motion.carry(before, after)
    motion.asked.clear()
    motion.at(after)
    assert motion.asked == []
    assert_known(motion, after, tolerance=1e-7)
