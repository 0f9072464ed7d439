# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""One robot written in four ways: every level, and lists of names, identified from simulated data.

Accepted by poses that took no part: what a level frees, the data must give back, whatever the file's kind.
"""

from __future__ import annotations

import numpy as np
import pytest
from robots import random_configurations, repeats

from calib_planner import IdentificationProblem, Robot, identify
from calib_planner.simulation import SimulatedCell, random_deviations

SIGMA = 3e-5
TARGETS = [[0.08, 0.02, 0.05], [-0.06, 0.09, 0.02], [0.01, -0.07, 0.11]]

JOINTS = """
name: rprr
joints:
  - {name: turn, lower: -170, upper: 170, unit: deg}
  - {name: lift, lower: -200, upper: 300, unit: mm}
  - {name: bend, lower: -2.0, upper: 2.0}
  - {name: roll, lower: -180, upper: 180, unit: deg}
"""

DH = """
dh:
  length_unit: mm
  angle_unit: deg
  rows:
    - {joint: turn, d: 400, a: 100, alpha: -90}
    - {joint: lift, type: prismatic, theta: 90, d: 300, a: 50, alpha: 90}
    - {joint: bend, a: 500, alpha: 90, sign: -1}
    - {joint: roll, d: 200}
"""

MODIFIED = """
modified_dh:
  rows:
    - {joint: turn, d: 0.4}
    - {joint: lift, type: prismatic, a: 0.1, alpha: -1.5707963267948966, theta: 1.5707963267948966, d: 0.3}
    - {joint: bend, a: 0.05, alpha: 1.5707963267948966, sign: -1}
    - {joint: roll, a: 0.5, alpha: 1.5707963267948966, d: 0.2}
"""

ELEMENTS = """
elements:
  - {type: Rz, joint: turn, parameter: q1}
  - {type: Tz, value: 0.4, parameter: d1}
  - {type: Tx, value: 0.1, parameter: a1}
  - {type: Rx, value: -1.5707963267948966}
  - {type: Rz, value: 1.5707963267948966}
  - {type: Tz, value: 0.3, joint: lift, parameter: q2}
  - {type: Tx, value: 0.05, parameter: a2}
  - {type: Rx, value: 1.5707963267948966}
  - {type: Rz, joint: bend, sign: -1, parameter: q3}
  - {type: Tx, value: 0.5, parameter: a3}
  - {type: Rx, value: 1.5707963267948966}
  - {type: Rz, joint: roll, parameter: q4}
  - {type: Tz, value: 0.2, parameter: d4}
lengths: [d1, a1, a2, a3, d4]
offsets: [q1, q2, q3, q4]
levels: {arm: [a3, q3, bend.rx]}
"""

URDF = """<robot name="rprr">
  <link name="base_link"/><link name="l1"/><link name="m"/><link name="l2"/><link name="l3"/><link name="l4"/>
  <joint name="turn" type="revolute"><parent link="base_link"/><child link="l1"/><origin xyz="0 0 0.4"/>
    <axis xyz="0 0 1"/><limit lower="-2.9670597283903604" upper="2.9670597283903604"/></joint>
  <joint name="mount" type="fixed"><parent link="l1"/><child link="m"/>
    <origin xyz="0.1 0 0" rpy="-1.5707963267948966 0 0"/></joint>
  <joint name="lift" type="prismatic"><parent link="m"/><child link="l2"/>
    <origin xyz="0 0 0.3" rpy="0 0 1.5707963267948966"/>
    <axis xyz="0 0 1"/><limit lower="-0.2" upper="0.3"/></joint>
  <joint name="bend" type="revolute"><parent link="l2"/><child link="l3"/>
    <origin xyz="0.05 0 0" rpy="1.5707963267948966 0 0"/><axis xyz="0 0 -1"/><limit lower="-2" upper="2"/></joint>
  <joint name="roll" type="continuous"><parent link="l3"/><child link="l4"/>
    <origin xyz="0.5 -0.2 0" rpy="1.5707963267948966 0 0"/><axis xyz="0 0 1"/></joint>
</robot>"""

FILES = {
    "elements.yaml": JOINTS + ELEMENTS,
    "dh.yaml": JOINTS + DH,
    "modified_dh.yaml": JOINTS + MODIFIED,
    "robot.urdf": URDF,
}
LISTS = {
    "elements.yaml": "q3,d4,lift.rx",
    "dh.yaml": "bend.theta,roll.d,turn.alpha",
    "modified_dh.yaml": "bend.theta,roll.d,lift.alpha",
    "robot.urdf": "bend.offset,roll.y,lift.rx",
}


def load(folder, file, targets=1):
    path = folder / file
    path.write_text(FILES[file])
    return Robot.load(path).with_targets(TARGETS[:targets])


def test_the_four_files_are_one_robot(tmp_path):
    robots = [load(tmp_path, file, 3) for file in FILES]
    q = random_configurations(robots[0], 50)
    for robot in robots:
        assert robot.joint_names == ("turn", "lift", "bend", "roll")
        np.testing.assert_allclose(robot.joint_limits, robots[0].joint_limits, atol=1e-15)
        np.testing.assert_allclose(robot.positions(q), robots[0].positions(q), atol=1e-14)
        np.testing.assert_allclose(robot.joint_jacobian(q), robots[0].joint_jacobian(q), atol=1e-14)
        assert len(robot.levels["offsets"]) == 4 and len(robot.levels["full"]) == 24


CASES = [
    (file, request, unknown, targets)
    for file in FILES
    for request, unknown, targets in [
        ("offsets", (), 1),
        ("offsets", ("base", "tool"), 1),
        ("lengths+offsets", (), 1),
        ("lengths+offsets", ("base", "tool"), 3),
        ("full", (), 2),
        ("full", ("base", "tool"), 3),
        ("list", (), 1),
        ("dh", ("tool",), 2),
        ("arm", ("base",), 2),
    ]
    if not (request == "dh" and "dh" not in file) and not (request == "arm" and file != "elements.yaml")
]

SAMPLE = [case for k, case in enumerate(CASES) if case[1] == "arm" or (k + list(FILES).index(case[0])) % 2]
"""Every file with half of the requests, every request with half of the files."""


@pytest.mark.parametrize(
    ("file", "request_", "unknown", "targets"),
    repeats(SAMPLE, CASES),
)
def test_what_a_level_frees_is_found(tmp_path, file, request_, unknown, targets):
    robot = load(tmp_path, file, targets)
    robot = robot.with_parameters(LISTS[file] if request_ == "list" else request_, unknown)
    cell = SimulatedCell(robot, random_deviations(robot, seed=4), SIGMA)
    data = cell.measure(random_configurations(robot, 40, 1), 1, seed=2)
    found = identify(IdentificationProblem(robot, data, sigma=SIGMA))
    assert found.fit.parameters == robot.parameter_names
    fresh = random_configurations(robot, 300, 3)
    before, after = (np.sqrt(np.mean(cell.position_errors(r, fresh) ** 2)) for r in (robot, found.calibrated))
    # p parameters from 120 equations per target leave σ √(3p / (120 targets)) at poses like the measured ones.
    assert after < 1.5 * SIGMA * np.sqrt(3 * len(robot.parameter_names) / (120 * targets)) < before / 10
