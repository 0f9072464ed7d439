# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What RViz gets, and what a controller gets: against the robot's own kinematics, bounded, never too fast."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Duration, Time
from rclpy.serialization import deserialize_message, serialize_message
from robots import mixed, plan_of, random_configurations
from visualization_msgs.msg import Marker, MarkerArray

from calib_planner import Robot
from calib_planner.acquisition import Standstill
from calib_planner.errors import InputError
from calib_planner.identification import IdentificationProblem, identify
from calib_planner.io import ACCEPTED, Record, config_folder
from calib_planner.measurements import Measurements
from calib_planner.planning import Plan
from calib_planner.ros.markers import (
    MOST_POINTS,
    MOST_SHOWN,
    magnification,
    plan_markers,
    residual_markers,
    skeletons,
)
from calib_planner.ros.messages import pace_of, trajectory_message
from calib_planner.ros.residuals import PointResiduals, residuals_message, residuals_of
from calib_planner.ros.settings import PlannerParameters

STAMP = 1_500_000_000


def by_name(message: MarkerArray) -> dict[str, Marker]:
    return {m.ns: m for m in message.markers}


def rows(marker: Marker) -> np.ndarray:
    return np.array([[p.x, p.y, p.z] for p in marker.points])


@pytest.fixture(params=["kuka_kr270", "mixed"])
def robot(request: pytest.FixtureRequest) -> Robot:
    return mixed() if request.param == "mixed" else Robot.load("kuka_kr270")


def planned(robot: Robot, count: int) -> Plan:
    return plan_of(robot, random_configurations(robot, count, 4), 2)


def test_targets_and_path_are_where_the_robot_has_them(robot: Robot) -> None:
    plan = planned(robot, 6)
    message = plan_markers(plan, robot, STAMP, "base")
    found, wanted = by_name(message), robot.positions(plan.configurations)
    np.testing.assert_allclose(rows(found["targets"]), wanted.reshape(-1, 3), atol=1e-12)
    np.testing.assert_allclose(rows(found["path"]), wanted.mean(axis=1), atol=1e-12)
    tests = robot.positions(plan.test_poses).reshape(-1, 3)
    np.testing.assert_allclose(rows(found["test_targets"]), tests, atol=1e-12)
    texts = [m for m in message.markers if m.ns == "order"]
    assert [m.text for m in texts] == ["1", "2", "3", "4", "5", "6"]
    assert len({(m.ns, m.id) for m in message.markers}) == len(message.markers)


def test_a_skeleton_is_connected_and_ends_at_the_targets(robot: Robot) -> None:
    q = random_configurations(robot, 3, 8)
    lines, nodes, targets = skeletons(robot, q)
    joints, count = len(robot.joint_names), len(robot.targets)
    assert lines.shape == (3, 2 * (joints + 1 + count), 3) and nodes.shape == (3, joints + 2, 3)
    np.testing.assert_array_equal(lines[:, 1 : 2 * joints : 2], lines[:, 2 : 2 * joints + 1 : 2])
    np.testing.assert_array_equal(lines[:, -2 * count + 1 :: 2], targets)
    np.testing.assert_allclose(targets, robot.positions(q), atol=1e-12)


def test_every_marker_can_be_drawn(robot: Robot) -> None:
    message = plan_markers(planned(robot, 5), robot, STAMP, "base")
    first, *others = message.markers
    assert first.action == Marker.DELETEALL
    for marker in others:
        assert marker.header.frame_id == "base" and marker.header.stamp.sec == 1
        assert marker.scale.x > 0 or marker.scale.z > 0
        assert marker.pose.orientation.w == 1.0 and marker.color.a > 0
        assert len(marker.colors) in (0, len(marker.points))
        if marker.type == Marker.LINE_LIST:
            assert len(marker.points) % 2 == 0
    sent = deserialize_message(serialize_message(message), MarkerArray)
    assert [m.points for m in sent.markers] == [m.points for m in message.markers]


def test_a_large_plan_is_a_bounded_picture() -> None:
    robot = Robot.load("kuka_kr270")
    plan = planned(robot, 1000)
    message = plan_markers(plan, robot, STAMP, "base")
    texts = [m.text for m in message.markers if m.ns == "order"]
    assert len(texts) == MOST_SHOWN and (texts[0], texts[-1]) == ("1", "1000")
    assert len(message.markers) <= MOST_SHOWN + 7
    assert sum(len(m.points) for m in message.markers) < 3000


def test_one_configuration_has_no_path(robot: Robot) -> None:
    found = by_name(plan_markers(planned(robot, 1), robot, STAMP, "base"))
    assert "path" not in found and {"robot", "targets", "order"} <= set(found)


def test_rviz_shows_what_the_node_publishes() -> None:
    config = yaml.safe_load((config_folder() / "rviz" / "planner.rviz").read_text())["Visualization Manager"]
    displays = [d for d in config["Displays"] if d["Class"] == "rviz_default_plugins/MarkerArray"]
    topics = [d["Topic"] for d in displays if d["Enabled"]]
    assert [t["Value"] for t in topics] == ["/calibration_planner/markers", "/calibration_identifier/markers"]
    for topic in topics:
        # A volatile reader would not get the latched markers of a plan made before RViz was started.
        assert (topic["Durability Policy"], topic["Reliability Policy"]) == ("Transient Local", "Reliable")
    assert config["Global Options"]["Fixed Frame"] == PlannerParameters().frame_id


# ── residuals ────────────────────────────────────────────────────────────────────────────────────────


def some_residuals(count: int, used: int, length: float = 1e-5) -> PointResiduals:
    """In a box of 2 m, residuals of up to ``length`` [m]; those beyond ``used`` are not used and far longer."""
    rng = np.random.default_rng(3)
    points, vectors = rng.uniform(-1.0, 1.0, (count, 3)), rng.uniform(-1.0, 1.0, (count, 3))
    vectors *= length / np.linalg.norm(vectors[:used], axis=1).max()
    vectors[used:] *= 1e4
    numbers = np.arange(count)
    return PointResiduals(numbers + 1, numbers * 0, points, vectors, numbers < used)


def test_residuals_are_magnified_as_the_text_says_and_outliers_are_cut_and_red() -> None:
    residuals = some_residuals(30, 27)
    message = residual_markers(residuals, STAMP, "laser")
    found = by_name(message)
    np.testing.assert_allclose(rows(found["used_points"]), residuals.points[:27])
    np.testing.assert_allclose(rows(found["rejected_points"]), residuals.points[27:])
    word, factor = found["magnification"].text.rsplit(" ", 1)
    assert word == "residuals x" and float(factor) == 1e4  # the longest is 0.01 mm, a tenth of 2 m is 0.2 m
    lines = rows(found["used_residuals"]).reshape(-1, 2, 3)
    np.testing.assert_allclose(lines[:, 0], residuals.points[:27])
    np.testing.assert_allclose(lines[:, 1] - lines[:, 0], 1e4 * residuals.vectors[:27], atol=1e-12)
    cut = np.linalg.norm(np.diff(rows(found["rejected_residuals"]).reshape(-1, 2, 3), axis=1), axis=2)
    assert (cut < 0.61).all() and (cut > 0.5).all()  # 0.3 of 2 m
    red, blue = found["rejected_points"].color, found["used_points"].color
    assert red.r > red.b and blue.b > blue.r
    assert {m.header.frame_id for m in message.markers} == {"laser"}
    assert message.markers[0].action == Marker.DELETEALL
    assert all(m.scale.x > 0 or m.scale.z > 0 for m in message.markers[1:])


@pytest.mark.parametrize(
    ("length", "factor"), [(0.1, 2.0), (0.03, 5.0), (0.02, 10.0), (3e-7, 5e5), (5.0, 0.02), (0.0, 1.0)]
)
def test_magnification_is_a_round_number(length: float, factor: float) -> None:
    assert magnification(length, 0.2) == pytest.approx(factor)


def test_without_an_estimate_the_markers_are_deleted() -> None:
    (only,) = residual_markers(residuals_of(None, []), STAMP, "laser").markers
    assert only.action == Marker.DELETEALL


def test_thousands_of_residuals_are_a_bounded_picture() -> None:
    found = by_name(residual_markers(some_residuals(9000, 6000), STAMP, "laser"))
    assert len(found["used_points"].points) == len(found["rejected_points"].points) == MOST_POINTS


def test_points_and_residuals_of_an_estimate_belong_together() -> None:
    """Two targets, one of them not seen at one standstill, and a point that is not used."""
    nominal = mixed().with_parameters("offsets")
    q = random_configurations(nominal, 24, 5)
    points = nominal.positions(q) + 2e-5 * np.random.default_rng(1).standard_normal((24, 2, 3))
    points[3, 1], points[5, 0, 2] = np.nan, points[5, 0, 2] + 0.02
    estimate = identify(IdentificationProblem(nominal, Measurements(nominal.joint_names, q, points)))
    records = [Record(standing(q[k], points[k]), ACCEPTED, "", k, 0, number=10 + k) for k in range(24)]
    found = residuals_of(estimate, records)
    assert len(found.ids) == 47 and (found.ids[:3].tolist(), found.targets[:3].tolist()) == (
        [10, 10, 11],
        [0, 1, 0],
    )
    assert (13, 1) not in zip(found.ids.tolist(), found.targets.tolist(), strict=True)
    (odd,) = np.flatnonzero(~found.used)
    assert (found.ids[odd], found.targets[odd]) == (15, 0) and found.vectors[odd, 2] == pytest.approx(
        0.02, abs=1e-3
    )
    np.testing.assert_array_equal(found.points[odd], points[5, 0])
    message = residuals_message(found, "p", STAMP, "laser")
    assert (list(message.ids), list(message.used)) == (found.ids.tolist(), found.used.tolist())
    assert message.residuals[odd].z == found.vectors[odd, 2] and message.header.frame_id == "laser"


def standing(q: np.ndarray, points: np.ndarray) -> Standstill:
    seen = np.isfinite(points).all(axis=1)
    return Standstill(1, 2, q, points, np.where(seen, 2e-5, np.nan), seen.astype(np.int64))


# ── trajectory ───────────────────────────────────────────────────────────────────────────────────────


def seconds(duration: Duration) -> float:
    return float(duration.sec) + 1e-9 * float(duration.nanosec)


@pytest.mark.parametrize("dwell", [0.0, 2.5])
def test_no_joint_is_ever_too_fast(robot: Robot, dwell: float) -> None:
    plan = planned(robot, 7)
    count = len(robot.joint_names)
    limits = np.where(np.arange(count) == 1, 0.05, np.inf)
    message = trajectory_message(plan, robot, pace_of(robot, 0.5, 0.1, limits, dwell), "base")
    each = 2 if dwell else 1
    q = np.array([p.positions for p in message.points])
    times = np.array([seconds(p.time_from_start) for p in message.points])
    # Two visits to each: there, aside, and there again.
    np.testing.assert_array_equal(q[:: 2 * each + 1], plan.configurations)
    assert message.joint_names == list(robot.joint_names) and message.header.frame_id == "base"
    assert message.header.stamp == Time()  # another one would be a time to start at
    speeds = np.minimum(np.where(robot.joint_is_revolute, 0.5, 0.1), limits)
    moved, took = np.abs(np.diff(q, axis=0)), np.diff(times)
    assert (moved <= speeds * took[:, None] + 1e-9).all()
    farthest = np.abs(robot.joint_limits.T[:, None] - q[0]).max(axis=0)
    assert (farthest <= speeds * times[0] + 1e-9).all()
    if dwell:
        still = moved.max(axis=1) == 0
        assert still.sum() == 2 * 7
        np.testing.assert_allclose(took[still], dwell)
    assert all(not any(p.velocities) for p in message.points)


def test_a_tour_of_a_century_is_refused() -> None:
    robot = Robot.load("kuka_kr270")
    pace = pace_of(robot, 1e-3, 1e-4, np.full(6, 1e-9), 3600.0)
    with pytest.raises(InputError, match="timetable"):
        trajectory_message(planned(robot, 3), robot, pace, "base")
