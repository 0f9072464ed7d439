# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Base and targets in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from calib_planner import Measurements, Robot
from calib_planner.identification.registration import register
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
