# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Calibrated URDFs: what changed, what did not, and the kinematics after loading them again."""

from __future__ import annotations

import difflib
from pathlib import Path

import numpy as np
import pytest
from robots import MIXED_URDF, SHARED_DATA, mixed, random_configurations

from calib_planner import Robot
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError
from calib_planner.io import calibrated_urdf, parse_urdf, write_calibrated_urdf

TRICKY = """<?xml version='1.0' encoding="utf-8"?>
<!-- do not touch: <joint name="turn"><origin xyz="9 9 9"/></joint> -->
<robot  name = "trïcky" xmlns:xacro="http://ros.org/wiki/xacro" xmlns:x="urn:x">
  <link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="tip"/>
  <ros2_control name="c" type="system"><joint name="turn"><origin xyz="7 7 7"/></joint></ros2_control>
  <transmission name="t"><joint name="slide"><hardwareInterface>X</hardwareInterface></joint></transmission>
  <gazebo reference="turn"><origin xyz="8 8 8"/></gazebo>
  <x:joint name="turn"><origin xyz="4 4 4"/></x:joint>
  <joint name="turn" type="revolute">
\t\t<!-- no origin --> <parent link="base"/>
    <child link="a"/><axis xyz="0 3 4"/><limit lower="-2" upper="2.5" effort="1" velocity="1"/>
  </joint>
  <joint type='prismatic'   name='slide' ><parent link="a"/><child link="b"/>
    <origin
        rpy = '0.1   -1.57079632679489661923\t0.30'
        x:xyz="5 5 5"   /><axis xyz="-1 2 -2"/><limit lower="-0.3" upper="0.8" effort="1" velocity="1"/>
    <calibration rising="0.0"/><origin xyz="6 6 6"/></joint>
  <joint name="plate" type="fixed"><origin xyz="0.1 0.2 0.3" rpy="0.1 1.5707963267948966 0.3"/>
    <parent link="b"/><child link="c"/></joint>
  <joint name="spin" type="continuous"><origin xyz="&#48; 0.50 1e-1"
     ></origin><axis xyz="0 0 -1"/><parent link="c"/><child link="tip"/></joint>
</robot>
<!-- the end -->
"""


def deviated(robot: Robot, seed: int = 0, size: float = 2e-2) -> Robot:
    """Every parameter of every joint off."""
    names = [n for n in robot.available_parameters if n.split(".")[0] in robot.joint_names]
    drawn = size * np.random.default_rng(seed).standard_normal(len(names))
    return robot.with_deviations(dict(zip(names, drawn, strict=True)))


def assert_same_kinematics(a: Robot, b: Robot, seed: int = 0) -> None:
    q = random_configurations(a, 200, seed)
    one, two = a.posture(q), b.posture(q)
    for name in ("tip_origin", "tip_rotation", "joint_axes"):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), rtol=0, atol=1e-12)


def random_urdf(seed: int) -> str:
    """A chain of 7 joints of all kinds at random poses, axes oblique or not, pitches of ±90° among them."""
    rng = np.random.default_rng(seed)
    lines = ['<robot name="random">', *(f'<link name="l{i}"/>' for i in range(8))]
    kinds = ["revolute", "prismatic", "fixed", "fixed", "continuous", "revolute", "fixed"]
    for i, kind in enumerate(rng.permutation(kinds)):
        rpy = rng.uniform(-np.pi, np.pi, 3)
        if rng.random() < 0.4:
            rpy[1] = rng.choice([np.pi / 2, -np.pi / 2])
        axis = rng.standard_normal(3) if rng.random() < 0.6 else rng.permutation([0, 0, rng.choice([1, -1])])
        words = [" ".join(map(repr, v.tolist())) for v in (rng.uniform(-1, 1, 3), rpy, axis)]
        lines.append(
            f'<joint name="j{i}" type="{kind}"><origin xyz="{words[0]}" rpy="{words[1]}"/>'
            f'<axis xyz="{words[2]}"/>'
            f'<limit lower="-2" upper="2"/><parent link="l{i}"/><child link="l{i + 1}"/></joint>'
        )
    return "\n".join([*lines, "</robot>"])


@pytest.mark.parametrize("text", [MIXED_URDF, TRICKY, *map(random_urdf, range(20))])
def test_same_kinematics_after_loading(text: str) -> None:
    robot = deviated(parse_urdf(text, "nominal"))
    out, changes = calibrated_urdf(text, robot)
    assert set(changes.joints) == set(robot.joint_names)
    assert changes.not_written == ()
    again = parse_urdf(out, "again")
    assert_same_kinematics(robot, again)
    assert np.abs(again.posture(np.zeros(len(robot.joint_names))).tip_origin - parse_urdf(text, "").posture(
        np.zeros(len(robot.joint_names))).tip_origin).max() > 1e-3  # fmt: skip
    np.testing.assert_array_equal(again.joint_limits, robot.joint_limits)
    assert calibrated_urdf(out, again) == (out, type(changes)((), ()))  # nothing left to change


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, np.pi / 2 + 1e-7])
def test_pitch_at_the_singularity(pitch: float) -> None:
    """The calibrated orientation itself has a pitch of (almost) 90°."""
    text = MIXED_URDF.replace('rpy="0.3 -0.4 0.5"', f'rpy="0.3 {pitch!r} 0.5"')
    robot = parse_urdf(text, "x").with_deviations({"turn.rx": 1e-3, "turn.rz": 1e-12, "nod.offset": 0.1})
    assert_same_kinematics(robot, parse_urdf(calibrated_urdf(text, robot)[0], "again"))


def test_only_the_numbers_that_changed() -> None:
    """The edit, as a difference of characters, of a file in which much looks like an origin."""
    changes = {"turn.z": 0.25, "slide.y": -0.5, "slide.offset": 0.3, "spin.z": 0.025}
    robot = parse_urdf(TRICKY, "x").with_deviations(changes)
    out, _ = calibrated_urdf(TRICKY, robot)
    blocks = difflib.SequenceMatcher(None, TRICKY, out, autojunk=False).get_opcodes()
    assert sum(tag != "equal" for tag, *_ in blocks) <= 6
    origin = '\t\t<!-- no origin --> <origin xyz="0.0 0.0 0.25"/> <parent link="base"/>\n'
    assert origin in out
    assert 'rpy = \'0.1   -1.57079632679489661923\t0.30\'\n        x:xyz="5 5 5" xyz="' in out
    assert '<origin xyz="0.0 0.5 0.125"\n     ></origin>' in out  # &#48; is a character reference
    removed = out.replace(' <origin xyz="0.0 0.0 0.25"/>', "").replace(
        'xyz="0.0 0.5 0.125"', 'xyz="&#48; 0.50 1e-1"'
    )
    start = removed.index('x:xyz="5 5 5"') + len('x:xyz="5 5 5"')
    assert removed[:start] + removed[removed.index("   />", start) :] == TRICKY


def test_numbers_that_stay_keep_their_text() -> None:
    text = MIXED_URDF.replace('xyz="0.1 -0.2 0.3"', 'xyz=" 0.100  -2e-1\n0.3 "')
    out, changes = calibrated_urdf(text, parse_urdf(text, "x").with_deviations({"turn.y": 0.1}))
    assert out == text.replace("-2e-1", "-0.1") and changes.joints == ("turn",)
    same, changes = calibrated_urdf(text, parse_urdf(text, "x"))
    assert same == text and changes.joints == ()


def test_offsets_turn_and_shift_origins() -> None:
    """By hand: an offset about z adds to the yaw, one along z to z; limits stay the controller's."""
    text = """<robot name="r"><link name="0"/><link name="1"/><link name="2"/>
<joint name="a" type="revolute"><parent link="0"/><child link="1"/><axis xyz="0 0 1"/>
 <limit lower="-1" upper="1"/><origin xyz="0 0 1" rpy="0 0 0.5"/></joint>
<joint name="b" type="prismatic"><parent link="1"/><child link="2"/><axis xyz="0 0 -1"/>
 <limit lower="0" upper="1"/></joint></robot>"""
    robot = parse_urdf(text, "x").with_deviations({"a.offset": 0.25, "b.offset": 0.125})
    out, _ = calibrated_urdf(text, robot)
    assert 'rpy="0.0 0.0 0.75"' in out or 'rpy="0 0 0.75"' in out
    assert '<origin xyz="0.0 0.0 -0.125"/><parent link="1"/>' in out
    np.testing.assert_array_equal(parse_urdf(out, "x").joint_limits, [[-1, 1], [0, 1]])


def test_base_and_targets_are_not_written_but_named() -> None:
    robot = parse_urdf(MIXED_URDF, "x").with_deviations({"target_1.y": 1e-3, "base.x": 2.0})
    turned = robot.with_base([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, 3])
    out, changes = calibrated_urdf(MIXED_URDF, turned)
    assert out == MIXED_URDF
    assert changes.not_written == ("base.z", "base.rx", "base.ry", "base.rz", "target_1.y")
    assert calibrated_urdf(MIXED_URDF, robot)[1].not_written == ("base.x", "target_1.y")


@pytest.mark.parametrize("prefix", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("newline", [b"\n", b"\r\n"])
def test_files_keep_their_bytes(tmp_path: Path, prefix: bytes, newline: bytes) -> None:
    source, target = tmp_path / "nominal.urdf", tmp_path / "calibrated.urdf"
    data = prefix + TRICKY.encode().replace(b"\n", newline)
    source.write_bytes(data)
    robot = Robot.load(source)
    write_calibrated_urdf(target, robot)
    assert target.read_bytes() == data
    calibrated = robot.with_deviations({"spin.z": 0.025})
    assert write_calibrated_urdf(target, calibrated).joints == ("spin",)
    assert target.read_bytes() == data.replace(b"&#48; 0.50 1e-1", b"0.0 0.5 0.125")
    assert_same_kinematics(calibrated, Robot.load(target))
    assert source.read_bytes() == data


@pytest.mark.parametrize(
    ("text", "needle"),
    [
        (TRICKY.replace("<robot ", "<!DOCTYPE robot [<!ENTITY a 'b'>]><robot ", 1), "document type"),
        (TRICKY[:-60], "well-formed"),
        (TRICKY.replace('<joint name="spin"', '<joint name="spun"'), "joint 'spin'"),
        (TRICKY.replace('xyz="0 3 4"', 'xyz="0 3 -4"'), "joint 'turn' axis"),
        (TRICKY.replace('<joint name="plate"', '<joint name="turn"'), "twice"),
    ],
)
def test_other_files_are_refused(text: str, needle: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        calibrated_urdf(text, deviated(parse_urdf(TRICKY, "x")), "other.urdf")
    assert needle in str(caught.value) and "other.urdf" in str(caught.value)


def test_paths_and_robots_that_cannot_be(tmp_path: Path) -> None:
    source = tmp_path / "nominal.urdf"
    source.write_text(MIXED_URDF)
    robot = Robot.load(source)
    with pytest.raises(InputError, match="another file than the nominal"):
        write_calibrated_urdf(tmp_path / "." / "nominal.urdf", robot)
    with pytest.raises(InputError, match="a robot from a URDF"):
        write_calibrated_urdf(tmp_path / "x.urdf", Robot.load("kuka_kr270"))
    with pytest.raises(InputError, match="--urdf-output"):
        write_calibrated_urdf(tmp_path / "no" / "x.urdf", robot)
    with pytest.raises(CalibPlannerError, match="No such file"):
        write_calibrated_urdf(tmp_path / "x.urdf", mixed())
    assert [p.name for p in tmp_path.iterdir()] == ["nominal.urdf"]


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the measured data are not here")
@pytest.mark.parametrize("name", ["irb120_tracker/irb120.urdf", "ur10_tracker/ur10.urdf"])
def test_real_robots(tmp_path: Path, name: str) -> None:
    robot = deviated(Robot.load(SHARED_DATA / name), size=1e-3)
    target = tmp_path / "calibrated.urdf"
    write_calibrated_urdf(target, robot)
    assert_same_kinematics(robot, Robot.load(target))
    old, new = (p.read_text().splitlines() for p in (SHARED_DATA / name, target))
    touched = [line for line in difflib.ndiff(old, new) if line.startswith("- ")]
    assert 0 < len(touched) <= 2 * len(robot.joint_names)
