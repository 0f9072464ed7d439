# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Kinematics YAML: the convention of Universal Robots, the hash, and the way back to a robot."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from robots import MIXED_URDF, SHARED_DATA, mixed, random_configurations

from calib_planner import Robot
from calib_planner.errors import FileFormatError, InputError
from calib_planner.io import calibrated_urdf, parse_urdf, write_kinematics
from calib_planner.io.kinematics import kinematics, read_kinematics

UR = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
UR_ENTRIES = ["shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"]
# The nominal origins of a UR30, from ur_description: z of the base, forearm and wrist.
UR_ORIGINS = ["0 0 0.2363", "0 0 0", "-0.637 0 0", "-0.5037 0 0.201", "0 -0.1593 0", "0 0.1543 0"]
UR_RPY = ["0 0 0", "1.570796327 0 0", "0 0 0", "0 0 0", "1.570796327 0 0", "1.570796327 3.1415927 3.1415927"]
LINKS = ["base_link", "inertia", *(f"l{i}" for i in range(6)), "tool0"]


def ur(prefix: str = "") -> str:
    """A URDF with the joints of a UR, a fixed joint before and after them."""
    lines = ['<robot name="ur30">', *(f'<link name="{link}"/>' for link in LINKS)]
    lines.append('<joint name="b" type="fixed"><origin rpy="0 0 3.141592653589793"/>')
    lines.append('<parent link="base_link"/><child link="inertia"/></joint>')
    for name, parent, child, xyz, rpy in zip(UR, LINKS[1:], LINKS[2:], UR_ORIGINS, UR_RPY, strict=False):
        lines.append(f'<joint name="{prefix}{name}_joint" type="revolute"><origin xyz="{xyz}" rpy="{rpy}"/>')
        lines.append(f'<parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/>')
        lines.append('<limit lower="-6.28" upper="6.28"/></joint>')
    lines.append('<joint name="t" type="fixed"><origin rpy="1.57 0 1.57"/><parent link="l5"/>')
    return "\n".join([*lines, '<child link="tool0"/></joint></robot>'])


def deviated(robot: Robot, seed: int = 0) -> Robot:
    """Every parameter of the chain off; base and target too, which belong to no origin."""
    drawn = 1e-2 * np.random.default_rng(seed).standard_normal(len(robot.available_parameters))
    return robot.with_deviations(dict(zip(robot.available_parameters, drawn, strict=True)))


def in_own_base(robot: Robot) -> Robot:
    return robot.with_base(np.eye(3), np.zeros(3))


def assert_same_kinematics(a: Robot, b: Robot) -> None:
    one, two = (in_own_base(r).posture(random_configurations(a, 200)) for r in (a, b))
    for name in ("tip_origin", "tip_rotation", "joint_axes"):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), rtol=0, atol=1e-12)


ROBOTS: dict[str, Callable[[], Robot]] = {
    "kuka_kr270": lambda: Robot.load("kuka_kr270"),
    "planar_2r": lambda: Robot.load("planar_2r"),
    "mixed": mixed,
    "ur": lambda: parse_urdf(ur(), "ur.urdf"),
}


@pytest.mark.parametrize("name", ROBOTS)
def test_there_and_back(tmp_path: Path, name: str) -> None:
    nominal, path = ROBOTS[name](), tmp_path / "kinematics.yaml"
    robot = deviated(nominal)
    write_kinematics(path, robot)
    again = read_kinematics(path, nominal)
    assert_same_kinematics(robot, again)
    assert again.joint_names == robot.joint_names
    np.testing.assert_array_equal(again.target_offsets, nominal.target_offsets)  # not part of the file
    write_kinematics(tmp_path / "again.yaml", again)
    one, two = (yaml.safe_load(p.read_text()) for p in (path, tmp_path / "again.yaml"))
    for key, pose in one["kinematics"].items():
        if key != "hash":
            assert list(pose) == ["x", "y", "z", "roll", "pitch", "yaw"]
            assert list(two["kinematics"][key].values()) == pytest.approx(list(pose.values()), abs=1e-12)
    # A file that is read again is of a robot in its standard form: it can be identified and written again.
    assert_same_kinematics(again.with_deviations({f"{again.joint_names[0]}.x": 0.1}), deviated_x(robot))


def deviated_x(robot: Robot) -> Robot:
    return robot.with_deviations({f"{robot.joint_names[0]}.x": 0.1})


@pytest.mark.parametrize("prefix", ["", "left_"])
def test_names_and_numbers_of_universal_robots(prefix: str) -> None:
    """Entries as in ur_description's default_kinematics.yaml; the nominal numbers are the URDF's own."""
    found = kinematics(parse_urdf(ur(prefix), "ur.urdf"))
    assert list(found["kinematics"]) == [*UR_ENTRIES, "hash"]
    assert list(found["joints"].values()) == [f"{prefix}{name}_joint" for name in UR]
    assert "tip" not in found
    for entry, xyz, rpy in zip(UR_ENTRIES, UR_ORIGINS, UR_RPY, strict=True):
        numbers = [*map(float, xyz.split()), *map(float, rpy.split())]
        assert list(found["kinematics"][entry].values()) == numbers
        assert found["axes"][entry] == [0, 0, 1]


def test_entries_are_the_origins_of_the_calibrated_urdf() -> None:
    """What goes into ``<origin>`` of the UR's xacro macro is what the calibrated URDF says."""
    robot = deviated(parse_urdf(MIXED_URDF, "mixed.urdf"))
    text, _ = calibrated_urdf(MIXED_URDF, robot)
    entries = kinematics(robot)["kinematics"]
    for joint in ElementTree.fromstring(text).findall("joint"):
        if joint.get("type") != "fixed":
            origin = joint.find("origin")
            assert origin is not None
            words = f"{origin.get('xyz')} {origin.get('rpy')}".split()
            assert list(map(float, words)) == list(entries[joint.get("name")].values())


def test_hash_as_documented(tmp_path: Path) -> None:
    path = tmp_path / "kinematics.yaml"
    write_kinematics(path, deviated(Robot.load("planar_2r")))
    found = yaml.safe_load(path.read_text())
    lines = []
    for key in ("q1", "q2"):
        lines.append(" ".join([key, *map(repr, [*found["kinematics"][key].values(), *found["axes"][key]])]))
    lines.append(" ".join(["tip", *map(repr, found["tip"].values())]))
    digest = hashlib.sha256("\n".join(lines).encode()).hexdigest()
    assert found["kinematics"]["hash"] == f"calib_{digest}"
    same = kinematics(deviated(Robot.load("planar_2r")))["kinematics"]["hash"]
    assert same == f"calib_{digest}"
    assert kinematics(deviated(Robot.load("planar_2r"), seed=1))["kinematics"]["hash"] != same


@pytest.mark.parametrize(
    ("change", "needle"),
    [
        (lambda d: d["kinematics"]["turn"].update(x=1.0), "kinematics.hash"),
        (lambda d: d["kinematics"]["nod"].update(yaw=d["kinematics"]["nod"]["yaw"] + 1e-15), "kinematics.hash"),
        (lambda d: d["axes"].update(spin=[0.0, 0.0, 1.0]), "kinematics.hash"),
        (lambda d: d["kinematics"].pop("hash"), "hash"),
        (lambda d: d["kinematics"].pop("slide"), "slide"),
        (lambda d: d["kinematics"]["slide"].update(x="nan"), "kinematics.slide"),
        (lambda d: d["kinematics"]["slide"].update(x=float("inf")), "kinematics.slide"),
        (lambda d: d["kinematics"]["slide"].pop("roll"), "roll"),
        (lambda d: d.update(joints=[1]), "joints"),
        (lambda d: d.update(kinematics=None), "kinematics"),
        (lambda d: d.update(format="other"), "format"),
        (lambda d: d["joints"].update(nod="bow"), "the robot's"),
    ],
)  # fmt: skip
def test_changed_files_are_refused(tmp_path: Path, change: Callable[[dict], object], needle: str) -> None:
    path = tmp_path / "kinematics.yaml"
    write_kinematics(path, deviated(mixed()))
    document = yaml.safe_load(path.read_text())
    change(document)
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    with pytest.raises(FileFormatError) as caught:
        read_kinematics(path, mixed())
    assert needle in str(caught.value) and str(path) in str(caught.value)


def test_other_robots_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "kinematics.yaml"
    write_kinematics(path, mixed())
    with pytest.raises(FileFormatError, match="joints: expected q1, q2"):
        read_kinematics(path, Robot.load("planar_2r"))
    turned = parse_urdf(MIXED_URDF.replace('axis xyz="0 -1 0"', 'axis xyz="0 1 0"'), "mixed.urdf")
    with pytest.raises(FileFormatError, match="axes of slide"):
        read_kinematics(path, turned)
    hashed = parse_urdf(MIXED_URDF.replace('name="nod"', 'name="hash"'), "mixed.urdf")
    with pytest.raises(InputError, match="hash"):
        write_kinematics(path, hashed)
    with pytest.raises(InputError, match="--kinematics-output"):
        write_kinematics(tmp_path / "no" / "k.yaml", mixed())


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the measured data are not here")
def test_a_real_ur10(tmp_path: Path) -> None:
    nominal, path = Robot.load(SHARED_DATA / "ur10_tracker" / "ur10.urdf"), tmp_path / "k.yaml"
    robot = deviated(nominal)
    write_kinematics(path, robot)
    assert list(yaml.safe_load(path.read_text())["kinematics"]) == [*UR_ENTRIES, "hash"]
    assert_same_kinematics(robot, read_kinematics(path, nominal))
