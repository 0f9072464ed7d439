# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Masses of the links: what a robot's file says of them, when that is believed, and the moments that follow."""

from __future__ import annotations

import copy
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from robots import MIXED_URDF, mixed, random_configurations

from calib_planner import FileFormatError, Robot
from calib_planner.error_model import LINKS, Gravity, Mass, Payload, Poses, gravity_of
from calib_planner.io import parse_urdf
from calib_planner.robot import LinkMass

WEIGHTS = {
    "base": (30.0, (0.0, 0.0, 0.1)),
    "a": (7.5, (0.05, -0.02, 0.1)),
    "b": (6.0, (-0.1, 0.0, 0.2)),
    "c": (2.5, (0.0, 0.03, 0.15)),
    "d": (3.0, (0.1, -0.05, 0.0)),
    "tip": (1.5, (0.02, 0.01, 0.12)),
    "camera": (0.8, (0.0, 0.1, 0.05)),
}
"""Link → mass [kg] and centre of gravity [m]."""
BESIDE = """<link name="camera"/><joint name="mount" type="fixed"><origin xyz="0.1 0 -0.2" rpy="0.4 0.2 -1"/>
    <parent link="c"/><child link="camera"/></joint>
  <link name="finger"/><joint name="grip" type="prismatic"><parent link="tip"/><child link="finger"/>
    <limit lower="0" upper="0.1"/></joint></robot>"""


def weighed(weights: dict[str, tuple[object, object]], text: str = MIXED_URDF) -> str:
    """The URDF with ``<inertial>`` of these links."""
    for link, (mass, xyz) in weights.items():
        place = xyz if isinstance(xyz, str) else " ".join(map(str, xyz))  # type: ignore[call-overload]
        inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        inertial = f'<inertial><mass value="{mass}"/><origin xyz="{place}"/>{inertia}</inertial>'
        text = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{inertial}</link>')
    return text


def heavy() -> str:
    """Every link has a mass, a camera beside the chain too; a finger that moves counts for nothing."""
    return weighed({**WEIGHTS, "finger": (5.0, (0, 0, 0))}, MIXED_URDF.replace("</robot>", BESIDE))


def moments(robot: Robot, q: np.ndarray) -> np.ndarray:
    """(N, joints) of all links, for their whole weight over g [kg·m | kg]."""
    gravity = gravity_of(robot)
    assert not robot.mass_fault
    count = sum(mass == LINKS for mass, _ in gravity._pairs(robot))
    total = sum(part.mass for part in robot.link_masses)
    result = np.zeros((len(q), len(robot.joint_names)))
    result[:, :count] = gravity.moments(Poses(robot, q))[:, :count] * total
    return result


def test_moments_of_the_links_are_the_slope_of_their_potential_energy() -> None:
    """U = Σ m h, every height from a chain of its own that ends at the link: central differences."""
    robot = parse_urdf(heavy(), "r", tip_link="tip")
    q, step = random_configurations(robot, 6), 1e-6
    down = robot.base_pose[0] @ np.array([0.0, 0.0, -1.0])

    def energy(q: np.ndarray) -> np.ndarray:
        total = np.zeros(len(q))
        for link, (mass, xyz) in WEIGHTS.items():
            if link != "base":
                end = parse_urdf(heavy(), "r", tip_link=link).with_targets([xyz])
                total -= mass * end.positions(q[:, : len(end.joint_names)])[:, 0] @ down
        return total

    slopes = [(energy(q + d) - energy(q - d)) / (2.0 * step) for d in step * np.eye(4)]
    np.testing.assert_allclose(moments(robot, q), -np.transpose(slopes), atol=1e-7)


def test_moments_of_the_links_against_pinocchio(tmp_path: Path) -> None:
    pin = pytest.importorskip("pinocchio")
    weights = {k: v for k, v in WEIGHTS.items() if k != "camera"}
    (tmp_path / "r.urdf").write_text(weighed(weights))
    robot, model = Robot.load(tmp_path / "r.urdf"), pin.buildModelFromUrdf(str(tmp_path / "r.urdf"))
    data, q = model.createData(), random_configurations(robot, 5, 3)
    for row, ours in zip(q, moments(robot, q), strict=True):
        full = [row[0], row[1], np.cos(row[2]), np.sin(row[2]), row[3]]
        expected = -pin.computeGeneralizedGravity(model, data, np.array(full)) / 9.81
        np.testing.assert_allclose(ours, expected, atol=1e-12)


def test_links_are_one_mass_of_weight_one_and_the_tip_another_until_a_payload_is_stated() -> None:
    robot = parse_urdf(heavy(), "r", tip_link="tip")
    gravity = gravity_of(robot)
    links = [m for m in gravity.masses if m.name == LINKS]
    assert [m.joint for m in links] == [0, 1, 2, 3] and sum(m.weight for m in links) == pytest.approx(1.0)
    assert links[1].weight == pytest.approx((6.0 + 2.5 + 0.8) / 21.3)
    assert gravity.masses[len(links) :] == (Mass("tip"),)
    loaded = gravity.with_payload(Payload(2.0))
    assert [m.name for m in loaded.masses_of(robot)][len(links) :] == ["payload"]
    assert loaded.with_payload(None) == gravity
    unknown = Gravity().with_payload(Payload(2.0))
    assert [m.name for m in unknown.masses_of(robot)] == ["elbow", "wrist", "tip", "payload"]


def test_masses_stay_with_the_robot() -> None:
    robot = parse_urdf(heavy(), "r", tip_link="tip")
    moved = robot.with_parameters("full", ("base", "tool")).with_deviations({"turn.x": 1e-3})
    moved = moved.with_base(np.eye(3), [1.0, 2.0, 3.0]).with_targets([[0.0, 0.0, 0.1]])
    for other in (moved, copy.deepcopy(robot), pickle.loads(pickle.dumps(robot))):
        assert other.link_masses == robot.link_masses and len(robot.link_masses) == 6
        assert gravity_of(other) == gravity_of(robot) and hash(gravity_of(other)) == hash(gravity_of(robot))


ALIKE = dict.fromkeys("abcd", (1.0, (0, 0, 0)))


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ({}, "states no masses"),
        ({"base": (30.0, (0, 0, 0))}, "states no masses"),
        ({**WEIGHTS, "b": (-1.0, (0, 0, 0))}, "behind slide has a mass of -1 kg"),
        ({**WEIGHTS, "d": ("inf", (0, 0, 0))}, "behind spin has a mass of nan kg"),
        ({**WEIGHTS, "d": ("two", (0, 0, 0))}, "behind spin has a mass of nan kg"),
        ({**WEIGHTS, "a": (7.5, (50, -20, 100))}, "centre of gravity of the link behind turn is 114 m away"),
        ({**WEIGHTS, "a": (7.5, "0 0")}, "centre of gravity of the link behind turn is nan m away"),
        ({"a": (7.5, (0, 0, 0.1))}, "1 of 4 joints carry a link with a mass"),
        (
            {**WEIGHTS, "a": (0.0, (0, 0, 0)), "b": (0, (0, 0, 0)), "c": (0, (0, 0, 0)), "d": (0, (0, 0, 0))},
            "1 of 4",
        ),
        (ALIKE, "all masses are alike"),
    ],
)
def test_masses_that_cannot_be_are_not_used(weights: dict[str, tuple[object, object]], words: str) -> None:
    robot = parse_urdf(weighed(weights), "r")
    assert words in robot.mass_fault
    assert gravity_of(robot) == Gravity()
    assert [m.name for m in Gravity().masses_of(robot)] == ["elbow", "wrist", "tip"]


def test_a_link_without_a_mass_among_others_is_a_frame() -> None:
    few = {k: v for k, v in WEIGHTS.items() if k not in ("d", "camera")}
    robot = parse_urdf(weighed(few), "r")
    assert not robot.mass_fault
    assert [m.joint for m in gravity_of(robot).masses] == [0, 1, 3, None]


def test_an_oddity_beside_the_chain_does_not_stop_it() -> None:
    text = heavy().replace('xyz="0.1 0 -0.2" rpy="0.4 0.2 -1"', 'xyz="0.1 0"')
    assert len(parse_urdf(text, "r", tip_link="tip").link_masses) == 5
    assert parse_urdf(MIXED_URDF, "r").link_masses == () == mixed().link_masses


# ── robot YAML ───────────────────────────────────────────────────────────────────────────────────────

CHAIN = """joints: [{name: q1, lower: -3, upper: 3}, {name: q2, lower: -1, upper: 1}]
elements:
  - {type: Rz, joint: q1, value: 0.3}
  - {type: Tx, value: 0.7}
  - {type: Ty, joint: q2}
"""
TABLE = """joints: [{name: q1, lower: -3, upper: 3}, {name: q2, lower: -1, upper: 1}]
%s:
  rows:
    - {joint: q1, theta: 0.4, d: 0.3, a: 0.5, alpha: 0.7}
    - {joint: q2, type: prismatic, sign: -1, theta: 0.2, d: 0.1, a: 0.4, alpha: -0.6}
"""
MASSES = "masses: [{joint: q1, mass: 4, xyz: [0.1, 0.2, 0.3]}, {joint: q2, mass: 2, xyz: [-0.1, 0, 0.2]}]\n"


def put(folder: Path, text: str) -> Robot:
    path = folder / "r.yaml"
    path.write_text(text)
    return Robot.load(path)


def test_a_robot_yaml_states_masses_behind_the_motion(tmp_path: Path) -> None:
    robot = put(tmp_path, CHAIN + MASSES)
    assert robot.link_masses == (LinkMass(0, 4.0, (0.1, 0.2, 0.3)), LinkMass(1, 2.0, (-0.1, 0.0, 0.2)))


@pytest.mark.parametrize("kind", ["dh", "modified_dh"])
def test_masses_beside_a_table_are_in_the_frames_of_its_rows(tmp_path: Path, kind: str) -> None:
    """The potential energy from a table that ends at the row, with the centre of gravity as target."""
    robot = put(tmp_path, TABLE % kind + MASSES)
    q, step = random_configurations(robot, 4), 1e-6
    first = re.sub(", {name: q2.*?}", "", TABLE % kind).splitlines()[:-1]
    robots = [put(tmp_path, "\n".join(first) + "\n"), put(tmp_path, TABLE % kind)]
    ends = [r.with_targets([xyz]) for r, xyz in zip(robots, ([0.1, 0.2, 0.3], [-0.1, 0, 0.2]), strict=True)]

    def energy(q: np.ndarray) -> np.ndarray:
        heights = [end.positions(q[:, : k + 1])[:, 0, 2] for k, end in enumerate(ends)]
        return np.asarray(4.0 * heights[0] + 2.0 * heights[1])

    slopes = [(energy(q + d) - energy(q - d)) / (2.0 * step) for d in step * np.eye(2)]
    np.testing.assert_allclose(moments(robot, q), -np.transpose(slopes), atol=1e-8)


@pytest.mark.parametrize(
    ("row", "where"),
    [
        ("{joint: q9, mass: 1}", r"masses\[0\].joint"),
        ("{joint: q1, mass: 0}", r"masses\[0\].mass"),
        ("{joint: q1, mass: -2}", r"masses\[0\].mass"),
        ("{joint: q1}", r"mass"),
        ("{joint: q1, mass: 1, xyz: [1, 2]}", r"masses\[0\].xyz"),
        ("{joint: q1, mass: 1, cog: [1, 2, 3]}", r"cog"),
    ],
)
def test_what_is_wrong_in_masses_is_named(tmp_path: Path, row: str, where: str) -> None:
    with pytest.raises(FileFormatError, match=where):
        put(tmp_path, f"{CHAIN}masses: [{row}]\n")
