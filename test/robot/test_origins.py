# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A calibration as poses of joints: whoever multiplies them with SciPy's rotations is where the robot is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from robots import MIXED_URDF, mixed, random_chain, random_configurations
from scipy.spatial.transform import Rotation

from calib_planner import Robot
from calib_planner.io import parse_urdf
from calib_planner.robot import (
    Element,
    JointOrigins,
    Origin,
    joint_origins,
    not_in_origins,
    pose_elements,
    pose_of,
    with_origins,
)

BRACKET = {"spin": Origin(np.array([0.0, 0.3, 0.0]), np.array([np.pi / 2, 0.0, 0.0]))}
"""The fixed joint before ``spin`` in MIXED_URDF."""


def matrix(turn: Rotation, xyz: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), xyz
    return pose


def posed(origin: Origin) -> np.ndarray:
    return matrix(Rotation.from_euler("xyz", origin.rpy), origin.xyz)  # about fixed axes: Rz Ry Rx


def tip_of(robot: Robot, origins: JointOrigins, q: np.ndarray, fixed: dict[str, Origin]) -> np.ndarray:
    """(4, 4) pose of the tip as a program that reads the poses has it."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = robot.base_pose
    for name, turns, angle in zip(robot.joint_names, robot.joint_is_revolute, q, strict=True):
        axis = origins.axes[name]
        assert np.linalg.norm(axis) == pytest.approx(1.0, abs=1e-15)
        motion = matrix(Rotation.from_rotvec(axis * angle), np.zeros(3)) if turns else np.eye(4)
        if not turns:
            motion[:3, 3] = axis * angle
        pose = pose @ (posed(fixed[name]) if name in fixed else np.eye(4)) @ posed(origins.joints[name]) @ motion
    return pose if origins.tip is None else pose @ posed(origins.tip)


def calibrated(robot: Robot, seed: int, size: float = 0.05) -> Robot:
    """Every parameter of the chain and of the base is off."""
    names = [n for n in robot.available_parameters if not n.startswith("target")]
    drawn = size * np.random.default_rng(seed).normal(size=len(names))
    return robot.with_deviations(dict(zip(names, drawn, strict=True)))


def based(robot: Robot) -> Robot:
    """The chain behind a base, as every file has it."""
    return dataclasses.replace(
        robot, elements=(*pose_elements("base", np.zeros(3), np.zeros(3)), *robot.elements)
    )


ROBOTS = {
    "mixed": (mixed, BRACKET),
    "kuka": (lambda: Robot.load("kuka_kr270"), {}),
    "ur10e": (lambda: Robot.load("ur10e"), {}),
    **{f"chain {k}": (lambda k=k: based(random_chain(k)), {}) for k in range(6)},
}


@pytest.mark.parametrize("case", ROBOTS)
def test_the_product_of_the_poses_is_where_the_tip_is(case: str) -> None:
    make, fixed = ROBOTS[case]
    for robot in (make(), calibrated(make(), 1)):
        origins = joint_origins(robot)
        assert list(origins.joints) == list(robot.joint_names)
        q = random_configurations(robot, 4, 2)
        posture = robot.posture(q)
        for row, xyz, turn in zip(q, posture.tip_origin, posture.tip_rotation, strict=True):
            tip = tip_of(robot, origins, row, fixed)
            np.testing.assert_allclose(tip[:3, 3], xyz, atol=1e-13)
            np.testing.assert_allclose(tip[:3, :3], turn, atol=1e-13)


@pytest.mark.parametrize("case", ROBOTS)
def test_a_robot_with_other_origins_stands_there(case: str) -> None:
    """What was offset or misplaced before is forgotten; base, targets and what is fixed stay."""
    make, fixed = ROBOTS[case]
    robot, rng = calibrated(make(), 3), np.random.default_rng(4)
    said = joint_origins(robot)
    other = {n: Origin(o.xyz + rng.normal(0, 0.1, 3), rng.normal(0, 0.5, 3)) for n, o in said.joints.items()}
    tip = None if said.tip is None else Origin(rng.normal(0, 0.1, 3), rng.normal(0, 0.5, 3))
    moved = with_origins(robot, other, tip)
    q = random_configurations(robot, 4, 5)
    expected = JointOrigins(other, said.axes if said.tip is None else joint_origins(moved).axes, tip)
    posture = moved.posture(q)
    for n, row in enumerate(q):
        pose = tip_of(robot, expected, row, fixed)
        np.testing.assert_allclose(posture.tip_origin[n], pose[:3, 3], atol=1e-13)
        points = pose[:3, 3] + robot.target_offsets @ pose[:3, :3].T
        np.testing.assert_allclose(posture.targets[n], points, atol=1e-13)
    again = joint_origins(moved)
    for name, origin in other.items():
        np.testing.assert_allclose(posed(again.joints[name]), posed(origin), atol=1e-14)
    assert set(moved.parameter_names) <= set(moved.available_parameters)
    assert moved.base_pose[1].tolist() == robot.base_pose[1].tolist()


def test_the_numbers_of_a_urdf_stay_to_the_bit_and_so_does_what_no_error_touches() -> None:
    robot = mixed()
    said = {"turn": ([0.1, -0.2, 0.3], [0.3, -0.4, 0.5]), "slide": ([0.2, 0, 0.4], [0, 0.7, 0])}
    said |= {"spin": ([0, 0, 0.5], [0, 0, 0]), "nod": ([0.3, 0, 0], [0, 0, 1])}
    for name, origin in joint_origins(robot).joints.items():
        assert (origin.xyz.tolist(), origin.rpy.tolist()) == said[name]
    turned = joint_origins(robot.with_deviations({"turn.offset": 0.1, "slide.ry": 1e-3})).joints
    assert turned["turn"].xyz.tolist() == said["turn"][0] and turned["slide"].xyz.tolist() == said["slide"][0]
    assert turned["nod"].rpy.tolist() == said["nod"][1]
    slid = joint_origins(robot.with_deviations({"slide.offset": 0.01, "nod.x": 0.02})).joints
    assert slid["slide"].rpy.tolist() == said["slide"][1]
    np.testing.assert_allclose(
        slid["slide"].xyz, [0.2, -0.01, 0.4], atol=1e-15
    )  # along −y, which the pitch leaves
    assert slid["nod"].xyz.tolist() == [0.3 + 0.02, 0, 0]


def test_an_offset_turns_its_origin_about_the_joints_axis() -> None:
    """P' = P · exp(δ [axis]×), by SciPy."""
    robot = mixed()
    origins = joint_origins(robot)
    for name in ("turn", "spin", "nod"):
        moved = joint_origins(robot.with_deviations({f"{name}.offset": 0.2})).joints[name]
        expected = posed(origins.joints[name]) @ matrix(
            Rotation.from_rotvec(0.2 * origins.axes[name]), np.zeros(3)
        )
        np.testing.assert_allclose(posed(moved), expected, atol=1e-15)
    np.testing.assert_allclose(origins.axes["turn"], [0.6, -0.48, 0.64], atol=1e-15)
    assert [origins.axes[n].tolist() for n in ("slide", "spin", "nod")] == [[0, -1, 0], [0, 0, -1], [1, 0, 0]]


def test_levels_and_parameters_that_are_gone_are_no_longer_there() -> None:
    """Of a chain that is not from a URDF; levels without any parameter left are gone as well."""
    robot = Robot.load("kuka_kr270").with_parameters("offsets", ("base", "tool"))
    moved = with_origins(robot, (origins := joint_origins(robot)).joints, origins.tip)
    assert "d1" in robot.available_parameters and "d1" not in moved.available_parameters
    assert moved.parameter_names == tuple(n for n in robot.parameter_names if n[0] not in "d")
    for name, names in moved.levels.items():
        assert names and names == tuple(n for n in robot.levels[name] if n in moved.available_parameters)
    assert set(robot.levels) - set(moved.levels) == {"lengths"}
    urdf = mixed().with_parameters("full", ("base", "tool"))
    same = with_origins(urdf, joint_origins(urdf).joints)
    assert same.parameter_names == urdf.parameter_names and same.levels == urdf.levels


def test_what_no_origin_holds_is_named() -> None:
    robot = mixed().with_targets([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert not_in_origins(robot) == ()
    assert not_in_origins(robot.with_deviations({"turn.x": 0.1, "nod.offset": 0.1})) == ()
    for name in ("base.x", "base.y", "base.z", "target_1.y", "target_2.z"):
        assert not_in_origins(robot.with_deviations({name: 0.1})) == (name,)
    turned = ("base.rx", "base.ry", "base.rz")
    for name in turned:
        assert not_in_origins(robot.with_deviations({name: 0.1})) == turned
    placed = robot.with_base(Rotation.from_euler("z", 0.1).as_matrix(), [0.0, 1.0, 0.0])
    assert not_in_origins(placed.with_deviations({"target_1.x": 1.0})) == ("base.y", *turned, "target_1.x")


def test_a_parameter_after_the_last_joint_or_in_a_fixed_part_makes_it_a_general_chain() -> None:
    """Poses of a URDF have no place for such: all between two motions is one pose then, and the tip another."""
    robot = parse_urdf(MIXED_URDF, "mixed.urdf")
    elements = list(robot.elements)
    motions = [i for i, e in enumerate(elements) if e.joint is not None]
    for at in (len(elements), motions[1] + 1):
        changed = (*elements[:at], Element("Ty", 0.1, parameter="extra"), *elements[at:])
        general = dataclasses.replace(robot, elements=changed)
        origins = joint_origins(general)
        assert origins.tip is not None
        for q in random_configurations(robot, 3):
            tip = tip_of(general, origins, q, {})
            np.testing.assert_allclose(tip[:3, 3], general.posture(q).tip_origin[0], atol=1e-13)


def test_a_pose_by_hand() -> None:
    turn, xyz = pose_of((Element("Tx", 1.0), Element("Rz", np.pi / 2, sign=-1.0), Element("Ty", 2.0, sign=-1.0)))
    np.testing.assert_allclose(xyz, [-1.0, 0.0, 0.0], atol=1e-15)  # y looks along +x after the quarter turn
    np.testing.assert_allclose(turn, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize("kind", ["Rx", "Tz"])
def test_a_chain_that_names_its_parameters_as_a_urdf_does_is_none(kind: str) -> None:
    """Nine elements before the joint, the first of them called j.x, that are no pose of a URDF."""
    before = (Element(kind, 0.1, parameter="j.x"), *(Element(kind, 0.01 * k) for k in range(8)))
    links = (*before, Element("Rz", joint=0), Element("Tx", 0.5))
    robot = based(Robot("r", links, (), ("j",), np.array([[-1.0, 1.0]])).with_targets([[0.0, 0.0, 0.0]]))
    origins = joint_origins(robot)
    assert origins.tip is not None and origins.tip.xyz.tolist() == [0.5, 0.0, 0.0]
    tip = tip_of(robot, origins, np.array([0.3]), {})
    np.testing.assert_allclose(tip[:3, 3], robot.posture([0.3]).tip_origin[0], atol=1e-15)


def test_no_number_is_minus_zero() -> None:
    origin = Origin(np.array([-0.0, 1.0, -2.0]), np.array([0.0, -0.0, 0.5]))
    assert np.signbit(origin.xyz).tolist() == [False, False, True] and not np.signbit(origin.rpy).any()
    assert not any(np.signbit(axis[axis == 0.0]).any() for axis in joint_origins(mixed()).axes.values())
