# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Tracker and targets on ``/tf_static``: chained through the robot, the transforms give the measured points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Bench
from geometry_msgs.msg import TransformStamped
from robots import random_configurations
from test_identifier_node import Shift, spread
from visualization_msgs.msg import Marker, MarkerArray

from calib_planner import Robot
from calib_planner.errors import InputError
from calib_planner.identification import Estimate, IdentificationProblem, identify
from calib_planner.io import config_folder
from calib_planner.measurements import Measurements
from calib_planner.ros.model import first_model, heard_model
from calib_planner.ros.parameters import LATCHED
from calib_planner.ros.settings import IdentifierParameters
from calib_planner.ros.transforms import OTHERS, placed_frames, transform_message

NAMES = ("base_link", "tool0", "laser", ("ball", "other"))
TURN = np.array([[0.0, -1.0, 0.0], [0.8, 0.0, -0.6], [0.6, 0.0, 0.8]])


def measured(robot: Robot, true: Robot, count: int = 30) -> tuple[Estimate, np.ndarray]:
    """An estimate from points of ``true``, and the configurations (count, joints) [rad]."""
    q = random_configurations(robot, count, 7)
    points = true.positions(q) + 1e-5 * np.random.default_rng(2).standard_normal((count, len(robot.targets), 3))
    return identify(IdentificationProblem(robot, Measurements(robot.joint_names, q, points))), q


def matrix(transform: TransformStamped) -> np.ndarray:
    """(4, 4) of a message, the quaternion multiplied out by hand."""
    t, r = transform.transform.translation, transform.transform.rotation
    x, y, z, w = r.x, r.y, r.z, r.w
    result = np.eye(4)
    result[:3, 3] = t.x, t.y, t.z
    result[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return result


def test_tracker_to_base_to_tip_to_target_is_where_the_point_was_measured() -> None:
    robot = Robot.load("kuka_kr270").with_targets([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    robot = robot.with_parameters("offsets", ["base", "tool"])
    offsets = [[0.1, 0.0, 0.2], [-0.1, 0.05, 0.15]]
    true = robot.with_base(TURN, [3.0, -1.0, 0.5]).with_targets(offsets)
    estimate, q = measured(robot, true)
    frames = {f.child: f for f in placed_frames(estimate, *NAMES)}
    assert {c: f.parent for c, f in frames.items()} == {"laser": "base_link", "ball": "tool0", "other": "tool0"}
    base_to_tracker = matrix(transform_message(frames["laser"], 1))
    at_base = estimate.calibrated.with_base(np.eye(3), np.zeros(3))  # what robot_state_publisher publishes
    posture = at_base.posture(q)
    for k, child in enumerate(("ball", "other")):
        to_target = matrix(transform_message(frames[child], 1))
        for n in range(len(q)):
            base_to_tip = np.eye(4)
            base_to_tip[:3, :3], base_to_tip[:3, 3] = posture.tip_rotation[n], posture.tip_origin[n]
            there = np.linalg.inv(base_to_tracker) @ base_to_tip @ to_target
            np.testing.assert_allclose(there[:3, 3], true.positions(q)[n, k], atol=3e-4)


def test_what_the_measurements_do_not_determine_is_left_out() -> None:
    robot = Robot.load("planar_2r").with_targets([[0.0, 0.0, 0.1], [0.0, 0.1, 0.0]]).with_parameters("lengths")
    estimate = measured(robot, robot)[0]

    def placed(*fixed: str, status: str = "ok") -> list[str]:
        seen = replace(estimate.observability, fixed=fixed)
        found = replace(estimate, observability=seen, fit=replace(estimate.fit, status=status))
        return [f.child for f in placed_frames(found, *NAMES)]

    assert placed() == placed("l1") == ["laser", "ball", "other"]
    assert placed("base.rz", "l1") == ["ball", "other"]
    assert placed("target_1.z") == ["laser", "other"]
    assert placed("target_1.z", "target_2.x", "base.x") == placed(status="not_converged") == []


def test_points_in_the_frame_of_the_base_have_no_transform() -> None:
    robot = Robot.load("planar_2r").with_parameters("lengths")
    frames = placed_frames(measured(robot, robot)[0], "base_link", "tool0", "base_link", ("ball",))
    assert [(f.parent, f.child) for f in frames] == [("tool0", "ball")]


@pytest.mark.parametrize(
    "wrong",
    [
        {"target_frames": ("a", "b")},
        {"target_frames": ("ball",), "tracker_child_frames": ("ball",)},
        {"target_frames": ("a", "a"), "tracker_topics": ("x", "y")},
    ],
)
def test_names_that_give_a_frame_two_parents_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="target_frames"):
        IdentifierParameters(**wrong)


def test_frames_are_the_links_of_the_description(tmp_path: Path) -> None:
    links = "".join(f'<link name="{name}"/>' for name in ("world", "arm", "flange"))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="{a}"/><child link="{b}"/><axis xyz="0 0 1"/>'
        '<origin xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for k, (a, b) in enumerate((("world", "arm"), ("arm", "flange")))
    )
    text = f'<robot name="r">{links}{joints}</robot>'
    assert heard_model(text, IdentifierParameters()).ends == ("world", "flange")
    assert heard_model(text, IdentifierParameters(tip_frame="probe")).ends == ("world", "probe")
    assert heard_model(text, IdentifierParameters(base_link="arm")).ends == ("arm", "flange")
    (tmp_path / "r.urdf").write_text(text)
    (tmp_path / "cell.yaml").write_text("robot: r.urdf\nbase-link: arm\n")
    model = first_model(IdentifierParameters(cell=str(tmp_path / "cell.yaml"), unknown="tool"))
    assert model is not None and model.ends == ("arm", "flange")
    shipped = first_model(IdentifierParameters(frame_id="foot", use_robot_description=False))
    assert shipped is not None and shipped.ends == ("foot", "tool0")


# ── the node ─────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def robot() -> Robot:
    return Robot.load("planar_2r").with_parameters("lengths+offsets")


def measure(shift: Shift, count: int) -> None:
    planned = spread(count)
    shift.announce(planned)
    for q in planned.configurations:
        shift.rest(q)
    shift.bench.wait(lambda: shift.estimates[-1].configurations == count)


def test_tracker_and_targets_are_on_tf_static(bench: Bench, robot: Robot) -> None:
    tf2 = pytest.importorskip("tf2_msgs.msg")
    heard = bench.hear(tf2.TFMessage, "/tf_static", OTHERS)
    shift = Shift(bench, robot, target_frames=["ball"])
    measure(shift, 6)
    bench.wait(lambda: heard and len(heard[-1].transforms) == 2)
    pairs = [(t.header.frame_id, t.child_frame_id) for t in heard[-1].transforms]
    assert pairs == [("base_link", "laser"), ("tool0", "ball")]
    assert heard[-1].transforms[0].header.stamp == shift.estimates[-1].header.stamp
    count = len(heard)
    late = bench.hear(tf2.TFMessage, "/tf_static", OTHERS)
    bench.wait(lambda: late)  # latched
    assert shift.service("reset").success
    bench.wait(lambda: len(heard) > count and not heard[-1].transforms)


def test_a_frame_that_has_another_parent_is_left_out(bench: Bench, robot: Robot) -> None:
    tf2 = pytest.importorskip("tf2_msgs.msg")
    heard = bench.hear(tf2.TFMessage, "/tf_static", OTHERS)
    mine = bench.client.create_publisher(tf2.TFMessage, "/tf_static", LATCHED)
    cell = TransformStamped(child_frame_id="laser")
    cell.header.frame_id = "cell"
    mine.publish(tf2.TFMessage(transforms=[cell]))
    shift = Shift(bench, robot)
    bench.wait(lambda: shift.node._output._frames._others == {"laser": "cell"})
    measure(shift, 6)
    bench.wait(lambda: any(t.child_frame_id == "target_1" for m in heard for t in m.transforms))
    parents = {t.header.frame_id for m in heard for t in m.transforms if t.child_frame_id == "laser"}
    assert parents == {"cell"}


def test_residuals_and_markers_follow_the_estimate(bench: Bench, robot: Robot) -> None:
    from calib_planner_msgs.msg import Residuals

    residuals = bench.hear(Residuals, "calibration_identifier/residuals", LATCHED)
    markers = bench.hear(MarkerArray, "calibration_identifier/markers", LATCHED)
    shift = Shift(bench, robot, publish_transforms=False)
    measure(shift, 7)
    bench.wait(lambda: residuals and len(residuals[-1].ids) == 7)
    newest = residuals[-1]
    assert list(newest.ids) == [m.id for m in shift.measurements if m.id] and newest.plan_id == "p"
    assert newest.header.frame_id == "laser" and newest.header.stamp == shift.estimates[-1].header.stamp
    lengths = [np.linalg.norm([v.x, v.y, v.z]) for v in newest.residuals]
    assert np.sqrt(np.mean(np.square(lengths))) == pytest.approx(shift.estimates[-1].residual_rms_after)
    bench.wait(lambda: any(m.ns == "used_points" and len(m.points) == 7 for m in markers[-1].markers))
    assert shift.service("reset").success
    bench.wait(lambda: not residuals[-1].ids and [m.action for m in markers[-1].markers] == [Marker.DELETEALL])


def test_rviz_names_what_there_is() -> None:
    assert "/tf_static" in (config_folder() / "rviz" / "planner.rviz").read_text()
