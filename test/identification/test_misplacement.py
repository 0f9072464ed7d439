# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Base and targets that stand elsewhere than the robot says are found out before the fit."""

from __future__ import annotations

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import Measurements, Robot
from calib_planner.identification import find_misplacement
from calib_planner.robot import rotation

TOOL = [[0.05, 0.02, 0.12]]
ELSEWHERE = rotation(2, 1.1) @ rotation(1, 0.2)


def measured(base: bool, tool: bool, seed: int, gross: int = 0) -> tuple[Robot, Measurements]:
    """30 visits of a KR-270 that errs by some millimetres, with base or tool elsewhere."""
    rng = np.random.default_rng(seed)
    robot = Robot.load("kuka_kr270").with_targets(TOOL)
    real = robot.with_parameters("full").with_deviations(
        {name: 2e-3 * rng.standard_normal() for name in ("joint_a2.x", "joint_a3.z", "joint_a4.y")}
    )
    real = real.with_base(ELSEWHERE, rng.uniform(-3.0, 3.0, 3)) if base else real
    real = real.with_targets([[-0.1, 0.15, 0.2]]) if tool else real
    q = random_configurations(robot, 30, seed)
    points = real.positions(q) + 3e-5 * rng.standard_normal((30, 1, 3))
    points[:gross] += 0.5
    return robot, Measurements(robot.joint_names, q, points)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("gross", [0, 6])
@pytest.mark.parametrize("base", [False, True])
@pytest.mark.parametrize("tool", [False, True])
def test_what_stands_elsewhere_is_named(base: bool, tool: bool, gross: int, seed: int) -> None:
    robot, data = measured(base, tool, seed, gross)
    answer = find_misplacement(robot, data)
    assert answer.unknown == ("base",) * base + ("tool",) * tool
    assert answer.after < 0.01 and (answer.before > 0.02) == (base or tool)


def test_a_reversed_joint_is_no_matter_of_places() -> None:
    robot, data = measured(True, True, 0)
    q = data.q * [1, -1, 1, 1, 1, 1]
    answer = find_misplacement(robot, Measurements(robot.joint_names, q, data.p))
    assert answer.unknown == () and answer.unexplained
    assert not find_misplacement(robot, data).unexplained


def test_too_few_points_say_nothing() -> None:
    robot, data = measured(True, True, 0)
    few = data.select(np.arange(3))
    assert find_misplacement(robot, few).unknown == ()


@pytest.mark.filterwarnings("error")
def test_no_points_say_nothing() -> None:
    robot, data = measured(True, True, 0)
    none = Measurements(robot.joint_names, data.q, np.full(data.p.shape, np.nan))
    assert find_misplacement(robot, none).unknown == () and not find_misplacement(robot, none).unexplained


@pytest.mark.parametrize(("visits", "unknown"), [(4, ()), (5, ("base",))])
def test_more_points_than_base_and_targets_need_say_something(visits: int, unknown: tuple[str, ...]) -> None:
    """Six unknowns of the base and three of each of two targets: four points are just enough, five tell."""
    robot = Robot.load("kuka_kr270").with_targets([[0.05, 0.02, 0.12], [-0.1, 0.1, 0.05]])
    q = random_configurations(robot, visits, 3)
    points = robot.with_base(ELSEWHERE, [1.0, -2.0, 0.5]).positions(q).copy()
    points[::2, 0] = points[1::2, 1] = np.nan
    answer = find_misplacement(robot, Measurements(robot.joint_names, q, points))
    assert answer.unknown == unknown and not answer.unexplained
