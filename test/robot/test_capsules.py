# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of joints and tip: by hand for two links, against Pinocchio, and in agreement with positions."""

from __future__ import annotations

import numpy as np
import pytest
from robots import CASES, MIXED_URDF, mixed, random_configurations
from scipy.spatial.transform import Rotation

from calib_planner import InputError, Robot
from calib_planner.robot import Capsules, segments
from calib_planner.robot.capsules import SLENDERNESS


def test_two_links_by_hand():
    robot = Robot.load("planar_2r")
    posture = robot.posture([[np.pi / 2, -np.pi / 2]])
    lengths = {p.name: p.nominal for p in robot.parameters}
    elbow = np.array([0, lengths["l1"], 0])
    np.testing.assert_allclose(posture.joint_origins[0], [np.zeros(3), elbow], atol=1e-15)
    np.testing.assert_allclose(posture.joint_axes[0], [[0, 0, 1]] * 2, atol=1e-15)
    np.testing.assert_allclose(posture.tip_origin[0], elbow + np.array([lengths["l2"], 0, 0]), atol=1e-15)
    np.testing.assert_allclose(posture.tip_rotation[0], np.eye(3), atol=1e-15)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("placed", [False, True])
def test_tip_and_axes_agree_with_positions(case, placed):
    """Targets are where tip pose and offsets say; joint columns are axis × lever, or the axis itself."""
    robot = CASES[case]()
    if placed:
        robot = robot.with_base(Rotation.from_euler("xyz", [0.3, -0.2, 2.0]).as_matrix(), [1.0, 2.0, -0.5])
    q = random_configurations(robot, 1500, 3)  # more than a block
    posture = robot.posture(q)
    np.testing.assert_allclose(posture.targets, robot.positions(q), atol=1e-14)
    expected = posture.tip_origin[:, None] + robot.target_offsets @ posture.tip_rotation.transpose(0, 2, 1)
    np.testing.assert_allclose(posture.targets, expected, atol=1e-13)
    columns = robot.joint_jacobian(q).reshape(len(q), len(robot.targets), 3, -1)
    arms = posture.targets[:, :, None] - posture.joint_origins[:, None]
    turned = np.cross(posture.joint_axes[:, None], arms)
    slid = np.broadcast_to(posture.joint_axes[:, None], arms.shape)
    expected = np.where(robot.joint_is_revolute[:, None], turned, slid)
    np.testing.assert_allclose(columns.transpose(0, 1, 3, 2), expected, atol=1e-12)


def test_against_pinocchio(tmp_path):
    pin = pytest.importorskip("pinocchio")
    (tmp_path / "mixed.urdf").write_text(MIXED_URDF)
    model = pin.buildModelFromUrdf(str(tmp_path / "mixed.urdf"))
    data = model.createData()
    local = [[0.6, -0.48, 0.64], [0, -1, 0], [0, 0, -1], [1, 0, 0]]
    robot = mixed()
    tip = model.getFrameId("tip")
    for q in random_configurations(robot, 20):
        full = np.array([q[0], q[1], np.cos(q[2]), np.sin(q[2]), q[3]])
        pin.framesForwardKinematics(model, data, full)
        posture = robot.posture(q)
        poses = [data.oMi[i] for i in range(1, model.njoints)]
        np.testing.assert_allclose(posture.joint_origins[0], [p.translation for p in poses], atol=1e-14)
        axes = [p.rotation @ a for p, a in zip(poses, local, strict=True)]
        np.testing.assert_allclose(posture.joint_axes[0], axes, atol=1e-14)
        np.testing.assert_allclose(posture.tip_origin[0], data.oMf[tip].translation, atol=1e-14)
        np.testing.assert_allclose(posture.tip_rotation[0], data.oMf[tip].rotation, atol=1e-14)


def test_segments_join_base_joints_and_tip():
    robot = mixed().with_base(np.eye(3), [1.0, 2.0, 3.0])
    posture = robot.posture(random_configurations(robot, 7))
    start, end = segments(robot, posture)
    assert start.shape == end.shape == (7, 5, 3)
    np.testing.assert_allclose(start[:, 0], np.tile([1.0, 2.0, 3.0], (7, 1)), atol=1e-14)
    np.testing.assert_allclose(start[:, 1:], end[:, :-1], atol=1e-14)
    np.testing.assert_allclose(end[:, -1], posture.tip_origin, atol=1e-14)


def test_radii():
    robot = Robot.load("planar_2r")
    length = sum(p.nominal for p in robot.parameters if p.name.startswith("l"))
    np.testing.assert_allclose(Capsules().of(robot), [SLENDERNESS * length] * 3)
    np.testing.assert_allclose(Capsules(0.2).of(robot), [0.2] * 3, atol=1e-14)
    np.testing.assert_allclose(Capsules([0.3, 0.2, 0.1]).of(robot), [0.3, 0.2, 0.1], atol=1e-14)
    with pytest.raises(InputError, match="base column, then behind q1, q2"):
        Capsules([0.1, 0.2]).of(robot)
    for bad in (-0.1, [0.1, np.nan], []):
        with pytest.raises(InputError, match="radii"):
            Capsules(bad)
