# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Constraints and instruments as YAML: what is shipped, what each key gives, every bad key named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from robots import mixed, random_configurations

from calib_planner import FileFormatError, InfeasibleError, Robot
from calib_planner.io import read_constraints, read_instrument
from calib_planner.planning import (
    Feasibility,
    JointRange,
    LineOfSight,
    MinimumHeight,
    ReflectorAcceptance,
    SelfCollision,
    TrackerElevation,
    TrackerRange,
    WorkspaceBox,
)
from calib_planner.tracker import Isotropic, LaserTracker

CONFIG = Path(__file__).resolve().parents[2] / "config"


def kuka():
    return Robot.load("kuka_kr270")


def read(folder, text, robot=None):
    path = folder / "constraints.yaml"
    path.write_text(text)
    return read_constraints(path, robot or kuka())


def test_the_shipped_constraints_leave_enough_for_the_shipped_robot():
    found = read_constraints(CONFIG / "constraints.yaml", kuka())
    kinds = [
        JointRange,
        WorkspaceBox,
        MinimumHeight,
        TrackerRange,
        TrackerElevation,
        ReflectorAcceptance,
        LineOfSight,
    ]
    assert [type(c) for c in found] == kinds
    feasible = Feasibility(kuka(), found)
    q = np.random.default_rng(0).uniform(*feasible.limits.T, (20_000, 6))
    assert feasible.mask(q).mean() > 1e-3


def test_the_shipped_constraints_file_documents_every_key():
    text = (CONFIG / "constraints.yaml").read_text()
    keys = (
        "joint_range_deg joint_range workspace minimum_height capsules radii tracker station up range elevation "
    )
    keys += "elevation_deg acceptance normal half_angle half_angle_deg line_of_sight near self_collision "
    keys += "urdf packages"
    assert [k for k in keys.split() if k not in text] == []


def test_the_shipped_instruments():
    assert read_instrument(CONFIG / "instruments" / "isotropic.yaml") == Isotropic(3e-5)
    tracker = read_instrument(CONFIG / "instruments" / "laser_tracker.yaml")
    assert isinstance(tracker, LaserTracker)
    assert 1e-6 < tracker.range_sigma < tracker.typical < 3e-5
    np.testing.assert_array_equal(tracker.station, [4.0, 1.5, 1.2])


def test_radians_degrees_and_defaults(tmp_path):
    degrees = read(
        tmp_path,
        "joint_range_deg: {joint_a1: [-90, 45]}\n"
        "tracker: {station: [4, 0, 1], elevation_deg: [-45, 60],\n"
        "  acceptance: {normal: [2, 0, 0], half_angle_deg: 30}}",
    )
    radians = read(
        tmp_path,
        f"joint_range: {{joint_a1: [{-np.pi / 2}, {np.pi / 4}]}}\n"
        f"tracker: {{station: [4, 0, 1], elevation: [{-np.pi / 4}, {np.pi / 3}],\n"
        f"  acceptance: {{normal: [1, 0, 0], half_angle: {np.pi / 6}}}}}",
    )
    q = random_configurations(kuka(), 3000)
    for a, b in zip(degrees, radians, strict=True):
        np.testing.assert_array_equal(a.allowed(kuka(), q), b.allowed(kuka(), q))
    assert read(tmp_path, "{}") == ()
    assert read(tmp_path, "tracker: {station: [4, 0, 1], line_of_sight: false}") == ()
    (sight,) = read(tmp_path, "tracker: {station: [4, 0, 1], line_of_sight: true}\ncapsules: {radii: 0.3}")
    assert sight.near is None
    np.testing.assert_array_equal(sight.capsules.of(kuka()), [0.3] * 7)
    (floor,) = read(tmp_path, "minimum_height: {height: 1e-1, links: false}")
    assert floor.height == 0.1 and floor.capsules is None
    (cone,) = read(
        tmp_path,
        "tracker: {station: [4, 0, 1], acceptance: {normal: [[0, 0, 1], [0, 1, 0]], half_angle: 0.5}}",
        mixed(),
    )
    np.testing.assert_array_equal(cone.normal, [[0, 0, 1], [0, 1, 0]])


def test_self_collision_is_found_beside_the_file(tmp_path):
    (found,) = read(tmp_path, "self_collision: {urdf: arm/robot.urdf, packages: meshes}")
    assert isinstance(found, SelfCollision)
    assert found.urdf_path == tmp_path / "arm" / "robot.urdf"
    assert found.package_folder == tmp_path / "meshes"


TRACKER = "tracker: {station: [4, 0, 1], "


@pytest.mark.parametrize(
    ("text", "needles"),
    [
        ("[1, 2]", ["document", "list"]),
        ("workspace: [", ["YAML"]),
        ("a: &x 1\nb: *x", ["alias"]),
        ("work_space: {}", ["work_space", "workspace"]),
        ("workspace: 3", ["workspace", "mapping"]),
        ("workspace: {low: [0, 0, 0]}", ["workspace.high", "no key"]),
        ("workspace: {low: [0, 0], high: [1, 1, 1]}", ["workspace.low", "3 numbers"]),
        ("workspace: {low: [0, 0, 2], high: [1, 1, 1]}", ["workspace", "low < high"]),
        ("workspace: {low: [0, 0, x], high: [1, 1, 1]}", ["workspace.low[2]", "'x'"]),
        ("workspace: {low: [0, 0, 0], high: [1, 1, .nan]}", ["workspace.high[2]", "finite"]),
        ("workspace: {low: [0, 0, 0], high: [1, 1, 1], tip: 1}", ["workspace.tip", "true or false"]),
        ("minimum_height: {}", ["minimum_height.height"]),
        ("minimum_height: {height: true}", ["minimum_height.height", "a finite number"]),
        ("minimum_height: {height: 0, up: [0, 0, 0]}", ["minimum_height.up", "not zero"]),
        ("capsules: {radii: [1, 2]}", ["capsules.radii", "2 radii", "joint_a6"]),
        ("capsules: {radii: -1}", ["capsules.radii", ">= 0"]),
        ("joint_range: {joint_a7: [0, 1]}", ["joint_range.joint_a7", "joint_a1"]),
        ("joint_range: {joint_a1: [1, 0]}", ["joint_range", "joint_a1", "low < high"]),
        ("tracker: {range: [1, 2]}", ["tracker.station"]),
        (TRACKER + "range: [2, 1]}", ["tracker", "minimum < maximum"]),
        (TRACKER + "elevation: [-45, 45]}", ["tracker.low", "rad"]),
        (TRACKER + "elevation: [0, 1], elevation_deg: [0, 50]}", ["tracker.elevation", "both", "either"]),
        (TRACKER + "acceptance: {half_angle: 0.5}}", ["tracker.acceptance.normal"]),
        (TRACKER + "acceptance: {normal: [1, 0, 0]}}", ["tracker.acceptance.half_angle", "neither"]),
        (TRACKER + "acceptance: {normal: [1, 0, 0], half_angle: 30}}", ["tracker.acceptance.half_angle", "rad"]),
        (TRACKER + "acceptance: {normal: [[1, 0, 0], [0, 1, 0]], half_angle: 1}}", ["normal", "one per target"]),
        (TRACKER + "line_of_sight: 0.2}", ["tracker.line_of_sight", "mapping"]),
        (TRACKER + "line_of_sight: {near: -1}}", ["tracker.line_of_sight.near"]),
        ("self_collision: {}", ["self_collision.urdf"]),
    ],
)
def test_bad_constraints(tmp_path, text, needles):
    with pytest.raises(FileFormatError) as caught:
        read(tmp_path, text)
    assert all(n in str(caught.value) for n in ["constraints.yaml", *needles]), str(caught.value)


def test_ranges_that_cannot_be(tmp_path):
    with pytest.raises(InfeasibleError, match="degrees"):
        read(tmp_path, "joint_range: {joint_a1: [45, 90]}")
    with pytest.raises(FileFormatError, match=r"slide.*in m"):
        read(tmp_path, "joint_range_deg: {slide: [0, 1]}", mixed())
    with pytest.raises(FileFormatError, match="check the path"):
        read_constraints(tmp_path / "none.yaml", kuka())


@pytest.mark.parametrize(
    ("text", "needles"),
    [
        ("sigma: 1e-5", ["type", "text"]),
        ("type: camera", ["type", "'camera'", "isotropic, laser_tracker"]),
        ("type: isotropic", ["sigma"]),
        ("type: isotropic\nsigma: 0", ["sigma", "(0, 1]"]),
        ("type: isotropic\nsigma: 1e-5\nstation: [0, 0, 0]", ["station", "unknown key"]),
        ("type: laser_tracker", ["station", "no key"]),
        ("type: laser_tracker\nstation: [0, 0]", ["station", "3 numbers"]),
        ("type: laser_tracker\nstation: [0, 0, 0]\nazimuth: -1", ["azimuth"]),
        ("type: laser_tracker\nstation: [0, 0, 0]\nup: [0, 0, 0]", ["up"]),
    ],
)
def test_bad_instruments(tmp_path, text, needles):
    path = tmp_path / "instrument.yaml"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        read_instrument(path)
    assert all(n in str(caught.value) for n in ["instrument.yaml", *needles]), str(caught.value)


def test_numbers_that_yaml_takes_for_text(tmp_path):
    path = tmp_path / "instrument.yaml"
    path.write_text("type: laser_tracker\nstation: [0, 0, 0]\nrange_sigma: 1e-5\nup: [0, 0, 2]")
    found = read_instrument(path)
    assert isinstance(found, LaserTracker)
    assert found.range_sigma == 1e-5 and found.azimuth == LaserTracker().azimuth
    np.testing.assert_array_equal(found.up, [0, 0, 1])
