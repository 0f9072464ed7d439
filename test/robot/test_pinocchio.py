# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Positions, joint Jacobian and the Jacobian of placement errors against Pinocchio."""

from __future__ import annotations

import numpy as np
import pytest
from robots import MIXED_URDF, SHARED_DATA, mixed, random_configurations

from calib_planner import Robot

pin = pytest.importorskip("pinocchio")

URDFS = {
    "mixed": (lambda: MIXED_URDF, "tip"),
    "irb120": (lambda: (SHARED_DATA / "irb120_tracker" / "irb120.urdf").read_text(), "link_6"),
    "ur10": (lambda: (SHARED_DATA / "ur10_tracker" / "ur10.urdf").read_text(), "flange"),
}
BRACKETS = {"spin": pin.utils.rpyToMatrix(np.pi / 2, 0.0, 0.0)}
"""Fixed joints between a joint's origin and the moving link above it."""
TARGETS = np.array([[0.1, 0.02, 0.3], [-0.05, 0.2, 0.1]])


@pytest.fixture(params=sorted(URDFS))
def pair(request, tmp_path):
    """(our robot with two targets, Pinocchio's model, id of the tip frame)."""
    text, tip = URDFS[request.param]
    try:
        path = tmp_path / "robot.urdf"
        path.write_text(text())
    except FileNotFoundError:
        pytest.skip("measured data not present")
    model = pin.buildModelFromUrdf(str(path))
    return Robot.load(path).with_targets(TARGETS), model, model.getFrameId(tip)


def pinocchio_q(model, q):
    """Continuous joints are (cos, sin) pairs there."""
    out = []
    for joint, value in zip(model.joints[1:], q, strict=True):
        out += [np.cos(value), np.sin(value)] if joint.nq == 2 else [value]
    return np.array(out)


def test_positions_and_joint_jacobian(pair):
    robot, model, tip = pair
    data = model.createData()
    for q in random_configurations(robot, 20):
        full = pinocchio_q(model, q)
        pin.computeJointJacobians(model, data, full)
        pin.updateFramePlacements(model, data)
        pose = data.oMf[tip]
        np.testing.assert_allclose(robot.positions(q)[0], [pose.act(t) for t in TARGETS], atol=1e-14)
        jacobian = pin.getFrameJacobian(model, data, tip, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        levers = [pin.skew(pose.rotation @ t) for t in TARGETS]
        expected = np.vstack([jacobian[:3] - lever @ jacobian[3:] for lever in levers])
        np.testing.assert_allclose(robot.joint_jacobian(q)[0], expected, atol=1e-13)


def test_placement_errors_against_the_kinematic_regressor(pair):
    robot, model, tip = pair
    robot = robot.with_parameters("full")
    data = model.createData()
    parent = model.frames[tip].parentJoint
    for q in random_configurations(robot, 5, seed=2):
        full = pinocchio_q(model, q)
        pin.forwardKinematics(model, data, full)
        pin.updateFramePlacements(model, data)
        ours = robot.jacobian(q)[0].reshape(len(TARGETS), 3, -1)
        for target, point in enumerate(TARGETS):
            placement = model.frames[tip].placement * pin.SE3(np.eye(3), point)
            regressor = pin.computeJointKinematicRegressor(
                model, data, parent, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, placement
            )[:3]
            for joint in range(1, model.njoints):
                name = model.names[joint]
                # Pinocchio moves joint frames behind the joint in their own axes; ours move the origin in
                # front of it: translations in the parent's axes, rotations in the placed frame's.
                above = data.oMi[model.parents[joint]]
                before = above * model.jointPlacements[joint]
                bracket = BRACKETS.get(name, np.eye(3))
                arm = data.oMf[tip].act(point) - before.translation
                turned = -pin.skew(arm) @ before.rotation
                expected = np.hstack([above.rotation @ bracket, turned])
                columns = [robot.parameter_names.index(f"{name}.{e}") for e in ["x", "y", "z", "rx", "ry", "rz"]]
                np.testing.assert_allclose(ours[target][:, columns], expected, atol=1e-13)
                # Either way the joint's errors move the point in the same six ways.
                block = regressor[:, 6 * (joint - 1) : 6 * joint]
                both = np.hstack([block, ours[target][:, columns]])
                assert np.linalg.matrix_rank(both, 1e-9) == np.linalg.matrix_rank(block, 1e-9)


def test_mixed_robot_is_the_one_tested():
    assert mixed().joint_names == ("turn", "slide", "spin", "nod")
