# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Base and targets in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import Measurements, Robot
from calib_planner.identification.registration import place, register, tip_poses
from calib_planner.robot.elements import rotation


@pytest.mark.parametrize("tool", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_robot_that_moves_in_a_plane_is_placed(seed: int, tool: bool) -> None:
    """The plane lies askew far from the origin, and the noise across it tells nothing."""
    rng = np.random.default_rng(seed)
    robot = Robot.load("planar_2r")
    place = rotation(2, 2.0) @ rotation(1, 0.04) @ rotation(0, -0.03)
    q = rng.uniform(-np.pi, np.pi, (20, 2))
    real = robot.with_base(place, rng.uniform(-3.0, 3.0, 3))
    points = real.positions(q) + 3e-4 * rng.standard_normal((20, 1, 3))
    put = register(robot, Measurements(robot.joint_names, q, points), base=True, tool=tool)
    assert np.abs(put.positions(q) - real.positions(q)).max() < 1e-3


def scattered(noise: float = 0.0) -> tuple[Robot, Robot, Measurements]:
    """A robot as given, the real one with base and two targets elsewhere, and 12 visits of it, some not seen."""
    rng = np.random.default_rng(5)
    robot = Robot.load("kuka_kr270").with_targets([[0.0, 0.1, 0.05], [0.2, -0.1, 0.1]])
    real = robot.with_base(rotation(2, 1.9) @ rotation(0, 0.4), [2.0, -1.0, 0.3])
    real = real.with_targets([[-0.1, 0.15, 0.2], [0.05, 0.02, 0.3]])
    q = random_configurations(robot, 12, 1)
    points = real.positions(q) + noise * rng.standard_normal((12, 2, 3))
    points[3, 0] = points[7, 1] = points[8, :] = np.nan
    return robot, real, Measurements(robot.joint_names, q, points)


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize(("base", "tool"), [(True, True), (True, False), (False, True)])
def test_what_was_unknown_comes_out_exactly_and_the_rest_stays(base: bool, tool: bool, robust: bool) -> None:
    robot, real, data = scattered()
    given = robot if base else robot.with_base(*real.base_pose)
    given = given if tool else given.with_targets(real.target_offsets)
    put = register(given, data, base=base, tool=tool, robust=robust)
    np.testing.assert_allclose(put.base_pose[0], real.base_pose[0], atol=1e-9)
    np.testing.assert_allclose(put.base_pose[1], real.base_pose[1], atol=1e-9)
    np.testing.assert_allclose(put.target_offsets, real.target_offsets, atol=1e-9)
    assert register(given, data, base=False, tool=False) is given


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize(("base", "tool"), [(True, True), (True, False), (False, True)])
def test_a_weight_is_as_good_as_so_many_measurements(base: bool, tool: bool, planar: bool) -> None:
    rng = np.random.default_rng(0)
    if planar:
        robot = Robot.load("planar_2r")
        q = rng.uniform(-np.pi, np.pi, (12, 2))
        real = robot.with_base(rotation(2, 2.0) @ rotation(1, 0.04), [1.0, -2.0, 0.5])
        data = Measurements(robot.joint_names, q, real.positions(q) + 3e-3 * rng.standard_normal((12, 1, 3)))
    else:
        robot, _, data = scattered(3e-3)
    weights = rng.integers(0, 4, data.seen.shape)
    poses = tip_poses(robot, data.q, at_base=base)
    got = place(robot, data, poses, base=base, tool=tool, weights=weights * 1.0)
    visits, targets = np.nonzero(weights)
    rows = np.repeat(np.arange(len(visits)), weights[visits, targets])
    points = np.full((len(rows), *data.p.shape[1:]), np.nan)
    points[np.arange(len(rows)), targets[rows]] = data.p[visits[rows], targets[rows]]
    many = Measurements(robot.joint_names, data.q[visits[rows]], points)
    want = place(robot, many, tip_poses(robot, many.q, at_base=base), base=base, tool=tool)
    for name in ("rotation", "origin", "offsets"):
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), atol=1e-8)


def test_points_that_fit_exactly_are_all_believed() -> None:
    """Nothing to weigh: the median distance is zero."""
    robot = Robot.load("planar_2r").with_targets([[0.0, 0.0, 0.0]])
    q = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    points = robot.positions(q)
    put = register(robot, Measurements(robot.joint_names, q, points), base=False, tool=True, robust=True)
    np.testing.assert_array_equal(put.positions(q), points)
