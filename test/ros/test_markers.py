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
from calib_planner.errors import InputError
from calib_planner.io import config_folder
from calib_planner.planning import Plan
from calib_planner.ros.markers import MOST_SHOWN, plan_markers, skeletons
from calib_planner.ros.messages import pace_of, trajectory_message
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
    (display,) = [d for d in config["Displays"] if d["Class"] == "rviz_default_plugins/MarkerArray"]
    topic = display["Topic"]
    assert topic["Value"] == "/calibration_planner/markers" and display["Enabled"]
    # A volatile reader would not get the latched markers of a plan made before RViz was started.
    assert (topic["Durability Policy"], topic["Reliability Policy"]) == ("Transient Local", "Reliable")
    assert config["Global Options"]["Fixed Frame"] == PlannerParameters().frame_id


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
