# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The robot as a value: catalogue, parameters, immutability, what it refuses."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from robots import mixed, random_configurations

from calib_planner import FileFormatError, InputError, Robot, UnknownNameError
from calib_planner.io import shipped_robots
from calib_planner.robot import Element, LinkMass, joint_origins, with_origins
from calib_planner.robot.chain import MOST_PROGRAMS
from calib_planner.robot.elements import rotation


def test_shipped_robots():
    assert list(shipped_robots()) == ["kuka_kr270", "planar_2r", "ur10e"]


def test_kuka_reach_and_home():
    """Upper arm vertical, forearm level: straightforward to check by hand."""
    robot = Robot.load("kuka_kr270")
    q = np.radians([0.0, -90.0, 90.0, 0.0, 0.0, 0.0])
    by_hand = [0.350 + 1.100 + 0.230, 0.0, 0.750 + 1.250 + 0.055]
    np.testing.assert_allclose(robot.positions(q)[0, 0], by_hand, atol=1e-15)
    assert robot.parameter_names == ("d1", "d2", "d3", "d4", "q1", "q2", "q3", "q4", "q5")


def test_planar_is_equation_16():
    robot = Robot.load("planar_2r")
    q = random_configurations(robot, 50)
    x = np.cos(q[:, 0]) + 0.8 * np.cos(q.sum(axis=1))
    y = np.sin(q[:, 0]) + 0.8 * np.sin(q.sum(axis=1))
    np.testing.assert_allclose(robot.positions(q)[:, 0], np.stack([x, y, 0 * x], axis=1), atol=1e-15)


@pytest.mark.parametrize("length", [np.pi / 2, np.pi, -np.pi / 2, 2 * np.pi])
def test_a_length_is_no_quarter_turn(length):
    """Turns by quarters cost nothing; a link whose length is that number of metres is still that long."""
    links = (Element("Rz", joint=0), Element("Tx", length), Element("Ry", length), Element("Tz", 1.0))
    robot = Robot("arm", links, (), ("a",), np.array([[-1.0, 1.0]])).with_targets([[0.0, 0.0, 0.0]])
    by_hand = [length + np.sin(length), 0.0, np.cos(length)]
    np.testing.assert_allclose(robot.positions([0.0])[0, 0], by_hand, atol=1e-15)


def test_deviations_as_argument_or_as_robot_agree():
    robot = mixed().with_parameters("full", ("base", "tool"))
    values = np.random.default_rng(0).normal(0, 0.02, len(robot.parameter_names))
    moved = robot.with_deviations(dict(zip(robot.parameter_names, values, strict=True)))
    q = random_configurations(robot, 9)
    np.testing.assert_allclose(moved.positions(q), robot.positions(q, values), atol=1e-15)


@pytest.mark.parametrize("pitch", [0.3, np.pi / 2, -np.pi / 2, np.pi - 0.1])
def test_base_pose_round_trips_also_at_the_singularity(pitch):
    matrix = rotation(2, 0.7) @ rotation(1, pitch) @ rotation(0, -1.1)
    robot = Robot.load("kuka_kr270").with_base(matrix, [1.0, -2.0, 0.5])
    got, xyz = robot.base_pose
    np.testing.assert_allclose(got, matrix, atol=1e-15)
    np.testing.assert_array_equal(xyz, [1.0, -2.0, 0.5])
    q = random_configurations(robot, 3)
    plain = Robot.load("kuka_kr270").positions(q)
    np.testing.assert_allclose(robot.positions(q), plain @ matrix.T + xyz, atol=1e-14)


@pytest.mark.parametrize("kind", [np.float32, np.longdouble, np.int64])
def test_numbers_of_any_kind_are_taken_as_doubles(kind):
    robot, q = mixed(), np.array([[0, 1, -2, 1], [1, 0, 3, -1]], kind)
    for found in (robot.positions(q), robot.jacobian(q), robot.posture(q).tip_rotation):
        assert found.dtype == np.float64
    np.testing.assert_array_equal(robot.positions(q), robot.positions(q.astype(np.float64)))


def test_a_robot_never_changes():
    robot = Robot.load("kuka_kr270")
    with pytest.raises(dataclasses.FrozenInstanceError):
        robot.name = "other"
    with pytest.raises(ValueError, match="read-only"):
        robot.joint_limits[0, 0] = 0.0


@pytest.mark.parametrize(
    ("request_", "unknown", "names"),
    [
        ("offsets", (), "q1 q2 q3 q4 q5"),
        ("lengths", (), "d1 d2 d3 d4"),
        ("q6,d1", (), "q6 d1"),
        (["d5"], ("tool",), "d5 target_1.x target_1.y target_1.z"),
        ("q2", ("base",), "base.x base.y base.z base.rx base.ry base.rz q2"),
    ],
)
def test_parameter_requests(request_, unknown, names):
    robot = Robot.load("kuka_kr270").with_parameters(request_, unknown)
    assert robot.parameter_names == tuple(names.split())
    assert robot.jacobian(np.zeros(6)).shape == (1, 3, len(names.split()))


@pytest.mark.parametrize(
    ("call", "field", "needle"),
    [
        (lambda r: r.with_parameters("ofsets"), "parameters", "did you mean 'offsets'"),
        (lambda r: r.with_parameters("q1,q1"), "parameters", "at most once"),
        (lambda r: r.with_parameters("q1", ("tracker",)), "unknown", "base, tool"),
        (lambda r: r.positions(np.zeros(5)), "configurations", "joint_a1"),
        (lambda r: r.positions(np.zeros((2, 7))), "configurations", "joint_a1"),
        (lambda r: r.positions(np.full(6, np.nan)), "configurations", "finite"),
        (lambda r: r.positions(np.zeros((2, 3, 6))), "configurations", "shape (2, 3, 6)"),
        (lambda r: r.positions([["a"] * 6]), "configurations", "rad or m"),
        (lambda r: r.jacobian(np.zeros(6), np.zeros(3)), "deviations", "(9)"),
        (lambda r: r.with_deviations({"nope": 1.0}), "deviations", "one of"),
        (lambda r: r.with_targets([[0.0, 1.0]]), "targets", "(any, 3)"),
        (lambda r: r.with_parameters([]), "parameters", "at least one parameter, got nothing; levels: offsets"),
        (lambda r: replace(r, parameter_names=("q7",)), "parameters", "one of"),
        (lambda r: replace(r, elements=(*r.elements, r.elements[-1])), "elements", "each parameter name once"),
        (lambda r: replace(r, link_masses=(LinkMass(6, 1.0),)), "link_masses", "joint number 6"),
        (lambda r: with_origins(r, {}), "origins", "joint_a1"),
        (lambda r: Element("Sx"), "element", "Tx"),
        (lambda r: Element("Rx", np.inf), "element Rx", "finite"),
        (lambda r: Element("Tz", 0.1, sign=0.5), "element Tz: sign", "+1 or -1"),
    ],
)
def test_refusals_name_the_field_and_what_is_valid(call, field, needle):
    with pytest.raises(InputError) as caught:
        call(Robot.load("kuka_kr270"))
    assert caught.value.field == field
    assert needle in str(caught.value)


def test_fixed_joints_place_the_tip_of_a_urdf_and_no_other_pose():
    robot = mixed()
    origins = joint_origins(robot)
    assert origins.tip is None
    with pytest.raises(InputError, match="fixed joints place the tip"):
        with_origins(robot, origins.joints, origins.joints["nod"])
    q = random_configurations(robot, 3)
    np.testing.assert_allclose(with_origins(robot, origins.joints).positions(q), robot.positions(q), atol=1e-14)


def test_a_robot_remembers_few_programs_and_is_right_all_the_same():
    """Every set of parameters that deviate is a program of its own."""
    robot = Robot.load("planar_2r").with_parameters("full")
    count = min(len(robot.parameter_names), 7)
    q, nominal = random_configurations(robot, 2), robot.positions(random_configurations(robot, 2))
    for mask in range(2**count - 1, -1, -1):
        wrong = np.zeros(len(robot.parameter_names))
        wrong[:count] = [1e-3 * bool(mask >> k & 1) for k in range(count)]
        moved = robot.with_deviations(dict(zip(robot.parameter_names, wrong, strict=True)))
        if mask % 16 == 0:
            np.testing.assert_allclose(robot.positions(q, wrong), moved.positions(q), atol=1e-15)
        else:
            robot.positions(q, wrong)
    assert 1 < len(robot._programs) <= MOST_PROGRAMS
    np.testing.assert_array_equal(robot.positions(q), nominal)


def test_unknown_robot():
    with pytest.raises(UnknownNameError, match="kuka_kr270"):
        Robot.load("kuka_kr27")


def test_a_file_of_another_kind_is_no_unknown_name(tmp_path):
    (tmp_path / "points.csv").write_text("j1,x1,y1,z1\n")
    with pytest.raises(InputError, match=r"ends in one of \.urdf.*\.yaml.*points\.csv"):
        Robot.load(tmp_path / "points.csv")


YAML_HEAD = "joints: [{name: q1, lower: -1, upper: 1}]\nelements: [{type: Rz, joint: q1}]\n"


@pytest.mark.parametrize(
    ("text", "needle"),
    [
        ("joints: [", "readable YAML"),
        ("3", "document: expected readable YAML of a robot"),
        ("joints: []\nelements: []", "at least one entry"),
        ("elements: [{type: Rz}]", "no key 'joints'"),
        (YAML_HEAD + "lenghts: [a]", "unknown key 'lenghts'"),
        (YAML_HEAD.replace("Rz", "Rq"), "Tx, Ty, Tz"),
        (YAML_HEAD.replace("joint: q1", "joint: q2"), "one of: q1"),
        (YAML_HEAD.replace("upper: 1", "upper: -2"), "lower < upper"),
        (YAML_HEAD.replace("upper: 1", "upper: .nan"), "a finite number"),
        (YAML_HEAD.replace("upper: 1", "upper: 1, unit: turn"), "rad, deg"),
        (YAML_HEAD + "targets: [[1, 2]]", "a list of 3 numbers"),
        (YAML_HEAD + "lengths: [l9]", "only: "),
        (YAML_HEAD + "lengths: l1", "a list of parameter names"),
        (YAML_HEAD + "name: [arm]", "a name"),
        (YAML_HEAD.replace("name: q1", "name: true"), "a name"),
        (YAML_HEAD.replace("elements: [", "elements: [{type: Rx, joint: q1}, "), "exactly one element"),
        ("!!python/object/apply:os.system ['true']", "readable YAML"),
    ],
)
def test_robot_yaml_refusals(tmp_path, text, needle):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        Robot.load(path)
    assert str(path) in str(caught.value)
    assert needle in str(caught.value)


URDF = '<robot name="r"><link name="a"/><link name="b"/>{}</robot>'
JOINT = (
    '<joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
    '<axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint>'
)


@pytest.mark.parametrize(
    ("text", "needle"),
    [
        ("<robot", "well-formed XML"),
        ("<model/>", "<robot>"),
        ('<!DOCTYPE r [<!ENTITY a "b">]>' + URDF.format(JOINT), "document type"),
        (URDF.format(""), "0 possible tips"),
        (URDF.format(JOINT.replace('xyz="0 0 1"', 'xyz="0 0 0"')), "a direction"),
        (URDF.format(JOINT.replace('xyz="0 0 1"', 'xyz="0 1"')), "3 finite numbers"),
        (URDF.format(JOINT.replace('upper="1"', 'upper="nan"')), "finite numbers"),
        (URDF.format(JOINT.replace("revolute", "elastic")), "prismatic or fixed"),
        (URDF.format(JOINT.replace("revolute", "floating")), "a floating joint in the chain"),
        (URDF.format(JOINT.replace("<axis", '<mimic joint="k"/><axis')), "a mimic joint in the chain"),
        (URDF.format(JOINT.replace("revolute", "fixed")), "no moving joint"),
        (URDF.format(JOINT.replace('<limit lower="-1" upper="1"/>', "")), "<limit"),
    ],
)
def test_urdf_refusals(tmp_path, text, needle):
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        Robot.load(path)
    assert needle in str(caught.value)


def test_urdf_links_can_be_chosen(tmp_path):
    from robots import MIXED_URDF

    path = tmp_path / "mixed.urdf"
    path.write_text(MIXED_URDF)
    part = Robot.load(path, base_link="a", tip_link="d")
    assert part.joint_names == ("slide", "spin")
    with pytest.raises(FileFormatError, match="one of: base, a"):
        Robot.load(path, tip_link="hand")
