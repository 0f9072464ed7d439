# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Self-collision by Pinocchio and Coal, on an arm of boxes, balls and cylinders whose collisions are known."""

from __future__ import annotations

import pickle
import sys

import numpy as np
import pytest
from robots import cylinder_urdf

from calib_planner import FileFormatError, InputError, PlanProblem, Robot, plan
from calib_planner.planning import Search, SelfCollision
from calib_planner.planning.constraints.self_collision import MissingExtraError

pin = pytest.importorskip("pinocchio")


def shape(geometry, xyz="0 0 0", rpy="0 0 0"):
    return f'<collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{geometry}</geometry></collision>'


BALL = '<sphere radius="0.1"/>'
ARM = f"""<robot name="arm">
  <link name="base">{shape('<box size="0.2 0.2 0.2"/>')}</link>
  <link name="upper">{shape('<cylinder radius="0.05" length="0.8"/>', "0.5 0 0", "0 1.5707963 0")}</link>
  <link name="lower">{shape('<cylinder radius="0.05" length="0.7"/>', "0.45 0 0", "0 1.5707963 0")}</link>
  <link name="tip">{shape(BALL)}</link><link name="finger">{shape('<sphere radius="0.02"/>', "0.15 0 0")}</link>
  <joint name="q1" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="q2" type="continuous"><origin xyz="1 0 0"/><parent link="upper"/><child link="lower"/>
    <axis xyz="0 0 1"/></joint>
  <joint name="flange" type="fixed"><origin xyz="1 0 0"/><parent link="lower"/><child link="tip"/></joint>
  <joint name="grip" type="prismatic"><parent link="tip"/><child link="finger"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.fixture
def arm(tmp_path):
    """(robot up to the link tip, constraint)."""
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return Robot.load(path, tip_link="tip"), SelfCollision(path)


def test_against_the_plane_by_hand(arm):
    """Everything is widest at z = 0, so that bodies touch exactly where their sections there do: a square, a
    rectangle (the lower arm), two circles. What can touch: base with lower arm, ball and finger; upper arm
    with finger. Other pairs are neighbours."""
    robot, free = arm
    q = np.random.default_rng(0).uniform([-3, 2.4], [3, 2 * np.pi - 2.4], (600, 2))
    q[:, 1] -= 2 * np.pi * (q[:, 1] > np.pi)
    elbow = np.stack([np.cos(q[:, 0]), np.sin(q[:, 0])], axis=1)
    along = np.stack([np.cos(q.sum(axis=1)), np.sin(q.sum(axis=1))], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    ball, finger = elbow + along, elbow + 1.15 * along
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0.1, 0.8, 141), np.linspace(-0.05, 0.05, 21)))
    arm_points = elbow[:, None] + u[:, None] * along[:, None] + v[:, None] * across[:, None]
    turned = np.stack([(finger * elbow).sum(axis=1), elbow[:, 0] * finger[:, 1] - elbow[:, 1] * finger[:, 0]], 1)
    gaps = [
        outside(arm_points, [-0.1, -0.1], [0.1, 0.1]).min(axis=1),
        outside(ball, [-0.1, -0.1], [0.1, 0.1]) - 0.1,
        outside(finger, [-0.1, -0.1], [0.1, 0.1]) - 0.02,
        outside(turned, [0.1, -0.05], [0.9, 0.05]) - 0.02,
    ]
    gap = np.min(gaps, axis=0)
    sure = (gap > 0.006) | (gap <= 0)  # the grid of the rectangle is 5 mm wide
    np.testing.assert_array_equal(free.allowed(robot, q)[sure], gap[sure] > 0)
    assert sure.mean() > 0.9 and 0.1 < (gap > 0).mean() < 0.9


def outside(points, low, high):
    """Distance of points (…, 2) from a rectangle, 0 inside."""
    return np.linalg.norm(np.maximum(0, np.maximum(low - points, points - high)), axis=-1)


def test_neighbours_and_stretched_arm(arm):
    robot, free = arm
    assert free.allowed(robot, np.array([[0, 0], [0, 0.3], [0, np.pi], [1.0, -np.pi]])).tolist() == [
        True,
        True,
        False,
        False,
    ]


@pytest.mark.parametrize(
    ("xyz", "expected"),
    [
        ("0 0 0", [True, True]),  # within the ball, which is a neighbour
        # Its place in the tip's frame is that of the base for the second configuration.
        (f"{-1 - np.cos(2.636)} {np.sin(2.636)} 0", [True, False]),
        ("0.15 0 0", [False, False]),  # at the finger, which is no neighbour although both hang at the tip
    ],
)
def test_a_wheel_that_the_robot_does_not_know_stands_at_zero(arm, tmp_path, xyz, expected):
    robot, free = arm
    path = tmp_path / "wheel.urdf"
    ball = shape('<sphere radius="0.03"/>', xyz)
    wheel = f'<link name="wheel">{ball}</link>'
    turns = '<joint name="turn" type="continuous"><parent link="tip"/><child link="wheel"/></joint></robot>'
    path.write_text(ARM.replace("</robot>", wheel + turns))
    q = np.array([[0.3, 0.4], [0.0, 2.636]])
    assert free.allowed(robot, q).all()
    assert SelfCollision(path).allowed(robot, q).tolist() == expected


def test_a_wheel_on_the_base_is_in_the_way_of_the_arm(arm, tmp_path):
    """Whatever number its joint has: a name before all others makes it Pinocchio's first."""
    robot, free = arm
    ball = shape('<sphere radius="0.03"/>', "0 0.9 0")
    turns = '<joint name="a" type="continuous"><parent link="base"/><child link="a"/></joint></robot>'
    path = tmp_path / "wheel.urdf"
    path.write_text(ARM.replace("</robot>", f'<link name="a">{ball}</link>{turns}'))
    # The upper arm moves about the same axis and is no neighbour: both hang at the base, which is one.
    q = np.array([[0.0, 0.0], [np.pi / 2, 0.0], [0.0, 2.0]])
    assert free.allowed(robot, q).all()
    assert SelfCollision(path).allowed(robot, q).tolist() == [True, False, True]


def test_meshes_are_beside_the_file_or_in_a_folder_that_is_named(arm, tmp_path):
    robot, _ = arm
    corners = 0.15 * np.array([[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])
    faces = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
    text = "".join(
        "facet normal 0 0 0 outer loop "
        + " ".join(f"vertex {x} {y} {z}" for x, y, z in corners[face])
        + " endloop endfacet\n"
        for face in faces
    )
    for place in (tmp_path / "beside", tmp_path / "away"):
        (place / "arm").mkdir(parents=True)
        (place / "arm" / "base.stl").write_text(f"solid base\n{text}endsolid base\n")
    mesh = ARM.replace('<box size="0.2 0.2 0.2"/>', '<mesh filename="package://arm/base.stl"/>')
    q = np.array([[0.0, 0.0], [0.0, np.pi]])
    for folder, package in (("beside", None), ("elsewhere", tmp_path / "away")):
        path = tmp_path / folder / "arm.urdf"
        path.parent.mkdir(exist_ok=True)
        path.write_text(mesh)
        assert SelfCollision(path, package).allowed(robot, q).tolist() == [True, False]


def test_joints_in_another_order_are_matched_by_name(arm, tmp_path):
    robot, free = arm
    q = np.array([[0.4, np.pi], [np.pi - 0.2, 0.4]])
    assert free.allowed(robot, q).tolist() == [False, True]
    other = tmp_path / "other.urdf"
    other.write_text(ARM.replace('"q2"', '"elbow"'))
    with pytest.raises(InputError, match=r"joint q2.*q1, elbow"):
        SelfCollision(other).allowed(robot, q)


def test_plans_avoid_collisions(arm):
    robot, free = arm
    found = plan(
        PlanProblem(robot.with_parameters("offsets"), [0.3, 0.5], 3, constraints=(free,), search=Search(starts=4))
    )
    assert SelfCollision(free.urdf_path).allowed(robot, found.configurations).all()


def test_no_collision_is_missed_after_a_deep_one(tmp_path):
    """Coal begins where it ended for the last configuration, unless told not to: the 342nd of these was missed.
    Distances, which do not remember, are the oracle."""
    robot = Robot.load("kuka_kr270")
    path = tmp_path / "cylinders.urdf"
    path.write_text(cylinder_urdf(robot, [0.30, 0.25, 0.18, 0.15, 0.12, 0.12, 0.10]))
    q = np.random.default_rng(5).uniform(*robot.joint_limits.T, (400, 6))
    free = SelfCollision(path)
    model, shapes = free._models
    data, distances = model.createData(), shapes.createData()
    deep = []
    for row in q:
        pin.computeDistances(model, data, shapes, distances, row)
        deep.append(min(r.min_distance for r in distances.distanceResults) < -1e-4)
    assert 20 < sum(deep) < 100 and deep[341]
    assert not free.allowed(robot, q)[deep].any()


def test_it_travels_to_other_processes(arm):
    robot, free = arm
    q = np.array([[0, np.pi], [0, 0.0]])
    before = free.allowed(robot, q)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(free)).allowed(robot, q), before)


def test_files_that_cannot_be_used(arm, tmp_path):
    robot, _ = arm
    q = np.zeros((1, 2))
    with pytest.raises(FileFormatError, match="no such file"):
        SelfCollision(tmp_path / "none.urdf").allowed(robot, q)
    bare = tmp_path / "bare.urdf"
    bare.write_text(ARM.replace("collision>", "visual>"))
    with pytest.raises(FileFormatError, match="not neighbours"):
        SelfCollision(bare).allowed(robot, q)
    mesh = tmp_path / "mesh.urdf"
    mesh.write_text(ARM.replace(BALL, '<mesh filename="package://no/where.stl"/>'))
    with pytest.raises(FileFormatError, match=r"mesh\.urdf"):
        SelfCollision(mesh).allowed(robot, q)


def test_without_pinocchio_the_extra_is_named(arm, monkeypatch):
    robot, free = arm
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'calib_planner\[collision\]'") as caught:
        free.allowed(robot, np.zeros((1, 2)))
    assert caught.value.extra == "collision"
