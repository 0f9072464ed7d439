# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Which chain is read from a URDF, with what numbers, and what is said when there is none."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import FileFormatError, InputError, Robot, UnknownNameError
from calib_planner.cli import main
from calib_planner.io import calibrated_urdf, parse_urdf

LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def joint(name, parent, child, kind="revolute", inside=LIMIT):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>{inside}</joint>'
    )


def robot_of(*joints, links="", more=""):
    names = links.split() or sorted(set(re.findall('link="(.*?)"', "".join(joints))))
    return f'<robot name="r">{"".join(f"<link name={n!r}/>" for n in names)}{"".join(joints)}{more}</robot>'


def read(text, **links):
    return parse_urdf(text, "r.urdf", **links)


# ── which chain ──────────────────────────────────────────────────────────────────────────────────────

ARM = (joint("j1", "base_link", "l1"), joint("j2", "l1", "l2"), joint("flange", "l2", "tool0", "fixed", ""))
GRIPPER = (
    joint("finger_1", "tool0", "f1", "prismatic"),
    joint("finger_2", "tool0", "f2", "prismatic", f'<mimic joint="finger_1"/>{LIMIT}'),
)


def test_a_frame_on_the_base_is_not_a_tip():
    """As in the descriptions of most industrial arms: leaves ``base`` and ``tool0``."""
    robot = read(robot_of(*ARM, joint("to_base", "base_link", "base", "fixed", "")))
    assert robot.joint_names == ("j1", "j2")
    np.testing.assert_allclose(robot.positions(np.zeros(2))[0, 0], [0, 0, 0.3], atol=1e-15)


def test_a_frame_on_the_way_is_no_tip_but_can_be_chosen():
    text = robot_of(*ARM, joint("camera", "l1", "eye", "fixed", ""))
    assert read(text).joint_names == ("j1", "j2") and not read(text).remarks
    assert read(text, tip_link="eye").joint_names == ("j1",)
    assert read(text, tip_link="tool0").joint_names == ("j1", "j2")
    assert read(text, base_link="l1").joint_names == ("j2",)  # seen from there, the camera does not move


def test_a_tip_within_the_tree_and_a_base_above_the_root():
    assert read(robot_of(*ARM), tip_link="l1").joint_names == ("j1",)
    text = robot_of(joint("mount", "world", "base_link", "fixed", ""), *ARM)
    from_world, from_base = read(text), read(text, base_link="base_link")
    q = random_configurations(from_world, 4)
    np.testing.assert_allclose(from_world.positions(q) - from_base.positions(q), [[[0, 0, 0.1]]] * 4, atol=1e-15)


@pytest.mark.parametrize("tool", ["tool0", "left_tool0", "arm/tool0"])
def test_of_several_ends_tool0_is_the_tip_and_is_named(tool):
    """A flange beside it, a balancer that a link carries, fingers behind it."""
    arm = tuple(part.replace("tool0", tool) for part in ARM)
    flange = joint("f", "l2", "flange", "fixed", "").replace("0 0 0.1", "0 0 0.2")
    beside = (flange, joint("cylinder", "l1", "balancer", "fixed", ""))
    fingers = tuple(part.replace("tool0", tool) for part in GRIPPER)
    for more, ends in ((beside, "flange"), (fingers, "f1, f2"), ((joint("rod", "base_link", "rod_1"),), "rod_1")):
        robot = read(robot_of(*arm, *more))
        assert robot.joint_names == ("j1", "j2")
        assert robot.remarks == (f"the chain ends at {tool}; further ends of the file are {ends} (--tip-link)",)


def test_ends_in_one_place_are_one_tip_and_others_are_asked_for():
    twin = joint("f", "l2", "flange", "fixed", "")
    arm = (*ARM[:2], joint("hand", "l2", "hand", "fixed", ""))
    assert read(robot_of(*arm, twin)).joint_names == ("j1", "j2")
    with pytest.raises(
        FileFormatError, match=r"2 possible tips: flange, hand; .*, or 'l2', from which they go on"
    ):
        read(robot_of(*arm, twin.replace('xyz="0 0 0.1"', 'xyz="0 0 0.2"')))


def test_two_arms_need_both_links():
    left = [j.replace("l1", "a1").replace("l2", "a2").replace("tool0", "a3").replace('"j', '"a') for j in ARM]
    text = robot_of(joint("torso", "root", "base_link"), *ARM, *(j.replace('"flange', '"a_flange') for j in left))
    with pytest.raises(FileFormatError, match="2 possible tips: a3, tool0"):
        read(text)
    assert read(text, base_link="base_link", tip_link="a3").joint_names == ("a1", "a2")
    with pytest.raises(FileFormatError, match="a link above 'a3': root, base_link, a1, a2, got 'l1'"):
        read(text, base_link="l1", tip_link="a3")


@pytest.mark.parametrize(
    ("links", "needle"),
    [
        ({"base_link": "nowhere"}, "base_link: expected one of: base_link, l1, l2, tool0, got 'nowhere'"),
        ({"tip_link": "nowhere"}, "tip_link: expected one of: base_link, l1, l2, tool0, got 'nowhere'"),
        ({"base_link": "l2", "tip_link": "l1"}, "a link above 'l1': base_link"),
        ({"base_link": "l2"}, "no moving joint"),
        ({"base_link": "tool0"}, "no moving joint"),
        ({"base_link": "l1", "tip_link": "l1"}, "no moving joint"),
        ({"base_link": "l2", "tip_link": "tool0"}, "chain from 'l2' to 'tool0'"),
    ],
)
def test_links_that_give_no_chain(links, needle):
    with pytest.raises(FileFormatError) as caught:
        read(robot_of(*ARM), **links)
    assert needle in str(caught.value)


def test_a_mimic_joint_is_refused_in_the_chain_only():
    text = robot_of(*ARM, *GRIPPER)
    assert read(text, tip_link="tool0").joint_names == ("j1", "j2")
    assert read(text, tip_link="f1").joint_names == ("j1", "j2", "finger_1")
    with pytest.raises(FileFormatError, match=r"'finger_2'.*a mimic joint.*follows 'finger_1'.*--tip-link"):
        read(text, tip_link="f2")


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_free_joints_are_refused_in_the_chain_only(kind):
    text = robot_of(joint("free", "world", "base_link", kind, ""), *ARM)
    with pytest.raises(FileFormatError, match=f"'free'.*a {kind} joint in the chain.*--base-link"):
        read(text)
    assert read(text, base_link="base_link").joint_names == ("j1", "j2")


@pytest.mark.parametrize(
    "oddity",
    [
        joint("g", "tool0", "g1", inside='<limit lower="0" upper="0"/>'),
        joint("g", "tool0", "g1").replace('axis xyz="0 1 0"', 'axis xyz="0 0 0"'),
        joint("g", "tool0", "g1").replace('origin xyz="0 0 0.1"', 'origin xyz="a b c"'),
    ],
)
def test_an_oddity_elsewhere_does_not_stop_the_arm(oddity):
    text = robot_of(*ARM, oddity)
    assert read(text, tip_link="tool0").joint_names == ("j1", "j2")
    with pytest.raises(FileFormatError, match="joint 'g'"):
        read(text)


BESIDE = {
    "a blank first line": lambda text: f'\n  <?xml version="1.0"?>\n{text}',
    "a default namespace": lambda text: text.replace("<robot ", '<robot xmlns="http://example.org/urdf" '),
    "an undeclared prefix": lambda text: text.replace("</robot>", "<gazebo:plugin/></robot>"),
    "an unknown encoding": lambda text: f'<?xml version="1.0" encoding="nonsense"?>{text}',
    "a macro in a picture": lambda text: text.replace(
        "<link name='l1'/>", "<link name='l1'><visual><xacro:grey/></visual></link>"
    ),
    "a macro of a transmission": lambda text: text.replace("</robot>", '<xacro:drive j="j1"/></robot>'),
    "an expression of a plugin": lambda text: text.replace("</robot>", '<gazebo v="${prefix}c"/></robot>'),
    "a joint to nowhere": lambda text: text.replace("</robot>", joint("x", "l2", "nothing") + "</robot>"),
    "a joint from nowhere": lambda text: text.replace("</robot>", joint("x", "nothing", "l9") + "</robot>"),
    "a joint without a child": lambda text: text.replace("</robot>", '<joint name="x"/></robot>'),
    "a kind of joint of another program": lambda text: text.replace(
        "</robot>", "<link name='s'/>" + joint("x", "base_link", "s", "screw") + "</robot>"
    ),
    "a loop of other links": lambda text: text.replace(
        "</robot>", "<link name='u'/><link name='v'/>" + joint("x", "u", "v") + joint("y", "v", "u") + "</robot>"
    ),
    "a rod that closes a loop": lambda text: text.replace(
        "</robot>", "<link name='u'/>" + joint("x", "l1", "u") + joint("y", "base_link", "u") + "</robot>"
    ),
}  # fmt: skip


@pytest.mark.parametrize("oddity", BESIDE)
def test_what_stands_beside_the_chain_does_not_matter(oddity):
    """Neither when the robot is read nor when its calibrated URDF is written."""
    plain = robot_of(*ARM)
    text = BESIDE[oddity](plain)
    assert text != plain
    robot, q = read(text), random_configurations(read(plain), 5)
    np.testing.assert_array_equal(robot.positions(q), read(plain).positions(q))
    calibrated = robot.with_deviations({"j1.x": 1e-3, "j2.offset": 2e-3})
    written, changes = calibrated_urdf(text, calibrated)
    assert changes.joints == ("j1", "j2")
    np.testing.assert_allclose(read(written).positions(q), calibrated.positions(q), atol=1e-15)


@pytest.mark.parametrize(
    ("low", "high", "limits", "word"),
    [
        (
            "-1e16",
            "1e16",
            (-180, 180),
            "limits of j1 are -1e+16 and 1e+16 rad: treated as continuous, from -180 to 180 degrees",
        ),
        ("-999999", "999999", (-180, 180), "treated as continuous"),
        ("-180", "180", (-180, 180), "they are read as degrees"),
        ("-120", "60", (-120, 60), "limits of j1 are -120 and 60 rad: they are read as degrees"),
        ("-62.83185", "62.83185", (-3600, 3600), ""),  # ten turns, in radians
        ("-7.854", "7.854", (-450.00105, 450.00105), ""),
    ],
)
def test_absurd_limits_are_named(low, high, limits, word):
    robot = read(limited(f'<limit lower="{low}" upper="{high}"/>'))
    np.testing.assert_allclose(np.rad2deg(robot.joint_limits[0]), limits, atol=1e-3)
    assert [word in remark for remark in robot.remarks] == [True] * bool(word)


def test_joints_with_the_same_absurd_limits_are_named_together():
    wide = LIMIT.replace("-1", "-1e9").replace('"1"', '"1e9"', 1)
    arm = (joint("j1", "a", "b", inside=wide), joint("j2", "b", "c"), joint("j3", "c", "d", inside=wide))
    (remark,) = read(robot_of(*arm)).remarks
    assert remark.startswith("limits of j1, j3 are -1e+09 and 1e+09 rad: treated as continuous")


# ── with what numbers ────────────────────────────────────────────────────────────────────────────────


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


@pytest.mark.parametrize(
    "axis",
    [
        "1 0 0",
        "0 1 0",
        "0 0 1",
        "-1 0 0",
        "0 -1 0",
        "0 0 -1",
        "0 0 -3",
        "1 2 3",
        "-1 1e-9 0",
        "1 1 -1e-200",
        "1e-170 0 2e-170",
    ],
)
@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
def test_axes_by_rodrigues_formula(axis, kind):
    text = robot_of(joint("j", "a", "b", kind).replace("0 1 0", axis))
    robot = read(text).with_targets([[0.3, -0.2, 0.5]])
    direction = np.array([float(w) for w in axis.split()])
    direction = direction / np.abs(direction).max()
    direction /= np.linalg.norm(direction)
    for q in (-0.7, 0.0, 0.9):
        turn = np.eye(3) + np.sin(q) * skew(direction) + (1 - np.cos(q)) * skew(direction) @ skew(direction)
        point = np.array([0.3, -0.2, 0.5])
        moved = q * direction + point if kind == "prismatic" else turn @ point
        expected = moved + np.array([0, 0, 0.1])
        np.testing.assert_allclose(robot.positions([q])[0, 0], expected, atol=1e-14)
    assert list(robot.joint_is_revolute) == [kind != "prismatic"]
    assert robot.with_parameters("offsets").parameters[0].unit == ("m" if kind == "prismatic" else "rad")


def test_defaults_are_urdfs():
    """No origin: none; no axis: x. What is not kinematics is not read; a continuous joint turns once."""
    bare = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/>{}</joint>'
    clutter = '<inertial><mass value="?"/></inertial><visual><geometry><mesh filename="package://gone/x.stl"/></geometry></visual>'
    text = f'<robot name="r"><link name="a">{clutter}</link><link name="b"/>{bare.format("")}<gazebo/></robot>'
    robot = read(text).with_targets([[0.0, 1.0, 0.0]])
    np.testing.assert_allclose(robot.positions([np.pi / 2])[0, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_array_equal(robot.joint_limits, [[-np.pi, np.pi]])
    extra = '<safety_controller soft_lower_limit="0"/><calibration rising="1"/><limit lower="-9" upper="9"/>'
    again = read(text.replace(bare.format(""), bare.format(extra)))
    np.testing.assert_array_equal(again.joint_limits, [[-np.pi, np.pi]])


def test_nested_joint_tags_are_not_joints():
    more = (
        '<transmission name="t"><joint name="j1"/></transmission><ros2_control><joint name="j1"/></ros2_control>'
    )
    assert read(robot_of(*ARM, more=more)).joint_names == ("j1", "j2")


def test_fixed_joints_are_constants_wherever_they_stand():
    """A chain cut by fixed joints is the chain whose origins were multiplied out."""
    split = robot_of(
        joint("j1", "a", "b"),
        joint("f", "b", "c", "fixed", "").replace('xyz="0 0 0.1"', 'xyz="0.2 0 0" rpy="0 0 1.2"'),
        joint("j2", "c", "d"),
        links="a b c d",
    )
    whole = robot_of(
        joint("j1", "a", "b"),
        joint("j2", "b", "d").replace('xyz="0 0 0.1"', 'xyz="0.2 0 0.1" rpy="0 0 1.2"'),
    )
    one, two = (read(t).with_targets([[0.1, 0.2, 0.3]]) for t in (split, whole))
    q = random_configurations(one, 8)
    np.testing.assert_allclose(one.positions(q), two.positions(q), atol=1e-15)
    assert "f.x" not in one.available_parameters


# ── what is no such file ─────────────────────────────────────────────────────────────────────────────

XACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="r"><xacro:property name="l" value="1"/></robot>'
J1 = joint("j1", "a", "b")


def changed(old, new, links=""):
    """One joint with some of its text replaced."""
    assert old in J1
    return robot_of(J1.replace(old, new), links=links)


def limited(limit):
    return changed(LIMIT, limit)


REFUSED = {
    "xacro": (XACRO, "a xacro file; pip install 'calib_planner[xacro]', or expand it first: xacro"),
    "xacro without its namespace": ('<robot name="r"><xacro:arm prefix=""/></robot>', "xacro FILE"),
    "xacro by its expressions": (changed("0 0 0.1", "0 0 ${h}"), "xacro FILE"),
    "sdf": ('<?xml version="1.0"?><sdf version="1.9"><model name="m"/></sdf>', "an SDF model; export the robot"),
    "mujoco": ("<mujoco/>", "a MuJoCo model"),
    "not XML": ("name: kuka\njoints: []", "well-formed XML"),
    "empty": ("", "well-formed XML"),
    "two joints above a link": (robot_of(J1, joint("j2", "c", "b")), "joints 'j1' and 'j2' above it"),
    "a loop": (robot_of(J1, joint("j2", "b", "a")), "a loop of joints"),
    "a link that is not there": (robot_of(J1, links="a"), "joint 'j1': expected one of the links: a"),
    "one joint name twice": (robot_of(J1, joint("j1", "b", "c")), "joint 'j1': expected each name once"),
    "a joint without a child": (changed('<child link="b"/>', "", "a b"), "no name, parent or child"),
    "a joint named base": (changed('"j1"', '"base"'), "joint 'base': expected a name other than"),
    "a joint named as a target": (changed('"j1"', '"target_1"'), "joint 'target_1'"),
    "a name that no list can hold": (changed('"j1"', '"j,1"'), "without commas"),
    "no limit": (limited(""), "joint 'j1': expected <limit lower= upper=>"),
    "no lower and upper": (limited('<limit effort="1"/>'), "lower < upper, got [0.0, 0.0]"),
    "a locked joint": (limited('<limit lower="1" upper="1"/>'), "or make the joint fixed"),
    "a zero axis": (changed('axis xyz="0 1 0"', 'axis xyz="0 0 0"'), "joint 'j1' axis: expected a direction"),
    "an infinite limit": (changed('upper="1"', 'upper="inf"'), "joint 'j1' limit: expected 1 finite"),
    "a decimal comma": (changed("0 0 0.1", "0 0 0,1"), "joint 'j1' origin xyz: expected 3 finite"),
    "screws": (changed("revolute", "screw"), "revolute, continuous, prismatic or fixed"),
    "a slide in millimetres": (
        changed("revolute", "prismatic").replace('upper="1"', 'upper="500"'),
        "joint 'j1' limit: expected within 100 m, got [-1, 500]; limits of a sliding joint are metres",
    ),
    "macros around a chain that breaks": (
        robot_of(joint("j1", "nowhere", "b"), links="b", more="<xacro:arm/>"),
        "expand it first: xacro FILE.urdf.xacro > robot.urdf (as it stands, joint 'j1'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_name_the_place_and_what_to_do(tmp_path, monkeypatch, case):
    monkeypatch.setitem(sys.modules, "xacro", None)  # as if it were not installed
    text, needle = REFUSED[case]
    path = tmp_path / f"robot{'.urdf.xacro' if 'xacro' in case else '.sdf' if case == 'sdf' else '.urdf'}"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        Robot.load(path)
    assert str(path) in str(caught.value) and needle in str(caught.value)


def test_a_loop_that_hangs_above_a_tip_ends():
    text = robot_of(J1, joint("j2", "b", "c"), joint("j3", "c", "a"), joint("j4", "c", "tip"))
    with pytest.raises(FileFormatError, match="a tree of links"):
        read(text)


def test_a_plain_urdf_may_be_called_xacro_and_have_a_byte_order_mark(tmp_path):
    path = tmp_path / "robot.urdf.xacro"
    path.write_text(
        "\ufeff" + robot_of(*ARM).replace("<robot ", '<robot xmlns:xacro="http://wiki.ros.org/xacro" ')
    )
    assert Robot.load(path).joint_names == ("j1", "j2")


def test_other_files_and_links_beside_a_yaml():
    with pytest.raises(UnknownNameError, match=r"PATH\.urdf"):
        Robot.load("nowhere.urdf")
    with pytest.raises(InputError, match=r"ends in one of \.urdf"):
        Robot.load(__file__)
    for links in ({"base_link": "base"}, {"tip_link": "tool0"}):
        with pytest.raises(InputError, match="only beside a URDF") as caught:
            Robot.load("kuka_kr270", **links)
        assert caught.value.field == next(iter(links))


# ── reachable from the commands ──────────────────────────────────────────────────────────────────────


def test_commands_take_the_links(tmp_path, capsys):
    """plan, simulate and identify on one branch of a tree; without the links each says what to give."""
    path, plan, data = (str(tmp_path / n) for n in ("r.urdf", "plan.csv", "data.csv"))
    planar = (joint("j1", "base_link", "l1"), joint("j2", "l1", "l2"), joint("hand", "l2", "tool0", "fixed", ""))
    (tmp_path / "r.urdf").write_text(robot_of(*planar, joint("camera", "l1", "eye")))
    robot = ("--robot", path, "--targets", "0.1 0.2 0.3", "--parameters", "offsets")
    planned = (
        "plan",
        *robot,
        "--test-pose",
        "0.1 0.2",
        "--configurations",
        "3",
        "--starts",
        "2",
        "--output",
        plan,
    )
    links = ("--base-link", "base_link", "--tip-link", "tool0")
    assert main(planned) in (1, 2)
    assert "2 possible tips: eye, tool0" in capsys.readouterr().err
    assert main([*planned, *links]) == 0
    assert main(["simulate", *robot, *links, "--plan", plan, "--output", data]) == 0
    capsys.readouterr()
    assert main(["identify", *robot, *links, "--data", data]) == 0
    out = capsys.readouterr().out
    assert "j1.offset" in out and "j2.offset" in out
    assert main(["robots", "show", path, "--tip-link", "eye"]) == 0
    assert (
        "Levels for --parameters: offsets (2), lengths (2), lengths+offsets (4), full (12)"
        in capsys.readouterr().out
    )
