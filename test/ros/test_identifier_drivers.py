# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The identifier and what real drivers publish: joints in parts, poses, transforms, restamped points, a state."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from bench import Bench
from calib_planner_msgs.msg import Measurement
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped, TransformStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String
from test_identifier_node import Shift, spread

from calib_planner import Plan, Robot
from calib_planner.acquisition import NANO, TRANSFORMS
from calib_planner.errors import CalibPlannerError
from calib_planner.io import BagTopics
from calib_planner.ros.lifecycle import LifecycleParameters, ManagedNode
from calib_planner.ros.messages import point_message
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.parameters import EVENTS, SENSOR_OUT
from calib_planner.ros.streams import DriverStreams, Listener

POSE = "geometry_msgs/msg/PoseStamped"
BEST_EFFORT = QoSProfile(depth=500, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def robot() -> Robot:
    return Robot.load("planar_2r").with_parameters("lengths+offsets")


@pytest.fixture
def planned(robot: Robot) -> Plan:
    return spread(8)


def posed(message: PointStamped) -> PoseStamped:
    pose = PoseStamped(header=message.header)
    pose.pose.position = message.point
    return pose


def transformed(message: PointStamped, child: str = "ball") -> TransformStamped:
    transform = TransformStamped(header=message.header, child_frame_id=child)
    at = transform.transform.translation
    at.x, at.y, at.z = message.point.x, message.point.y, message.point.z
    return transform


class Drivers(Shift):
    """As ``Shift``; ``change`` says what is published in place of a message: (publisher, message) pairs."""

    def send(self, publisher: Any, message: Any, ahead: int = 100) -> None:
        for other, changed in self.change(publisher, message):
            super().send(other, changed, ahead)

    def change(self, publisher: Any, message: Any) -> list[tuple[Any, Any]]:
        return [(publisher, message)]


class InParts(Drivers):
    """Joint 1 on a topic of its own, at a tenth of the rate; on the other one, joint 2 beside a gripper."""

    def change(self, publisher: Any, message: Any) -> list[tuple[Any, Any]]:
        if isinstance(message, PointStamped):
            return [(publisher, message)]
        if not hasattr(self, "rail"):
            self.rail = self.bench.client.create_publisher(JointState, "rail/joint_states", SENSOR_OUT)
            self.bench.wait(self.rail.get_subscription_count)
            self.count = 0
        place = dict(zip(message.name, message.position, strict=True))
        one = JointState(header=message.header, name=["q1"], position=[place["q1"]])
        two = JointState(header=message.header, name=["hand", "q2"], position=[0.0, place["q2"]])
        self.count += 1
        alone = self.count % 10 and len(message.name) == 3  # not what ``tick`` sends
        return [(publisher, two)] if alone else [(self.rail, one), (publisher, two)]


def test_a_rail_and_an_arm_on_topics_and_at_rates_of_their_own(bench: Bench, robot: Robot, planned: Plan) -> None:
    shift = InParts(bench, robot, joint_topics=["joint_states", "rail/joint_states"], window=0.0)
    shift.announce(planned)
    for q in planned.configurations[:4]:
        found = shift.rest(q, 1.0)
        assert found.status == Measurement.ACCEPTED, found.reason
        np.testing.assert_allclose(list(found.configuration.positions), q, atol=1e-9)
    assert [w.left_out.total() for w in shift.node._intake.streams] == [0, 0, 0]


@pytest.fixture
def driver(bench: Bench) -> Iterator[Node]:
    """A node in a process of its own: in one process, the middleware allows a topic one type only."""
    context = Context()
    rclpy.init(args=[], context=context, domain_id=bench.domain)
    node = Node("driver", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


class Typed(Drivers):
    """Publishes points as another type, by the publisher ``others``."""

    others: Publisher

    def change(self, publisher: Any, message: Any) -> list[tuple[Any, Any]]:
        if isinstance(message, JointState):
            return [(publisher, message)]
        if self.points is not None:
            self.bench.client.destroy_publisher(self.points)
            self.points = None
            self.bench.wait(self.others.get_subscription_count)
        return [(self.others, posed(message) if self.others.msg_type is PoseStamped else transformed(message))]


@pytest.mark.parametrize("qos", [SENSOR_OUT, BEST_EFFORT], ids=["reliable", "best-effort"])
@pytest.mark.parametrize("kind", [PoseStamped, TransformStamped])
def test_the_type_of_the_points_is_that_of_their_publisher(
    bench: Bench, driver: Node, robot: Robot, planned: Plan, kind: type, qos: QoSProfile
) -> None:
    reliability = "best_effort" if qos is BEST_EFFORT else "reliable"
    shift = Typed(bench, robot, **{"qos_overrides./tracker/point.subscription.reliability": reliability})
    shift.others = driver.create_publisher(kind, "tracker/point", qos)
    shift.announce(planned)
    found = shift.rest(planned.configurations[0])
    assert found.status == Measurement.ACCEPTED, found.reason
    assert found.header.frame_id == "laser"
    wanted = shift.true_robot.positions(planned.configurations[0])[0, 0]
    np.testing.assert_allclose([found.points[0].x, found.points[0].y, found.points[0].z], wanted, atol=2e-4)
    shift.frame = "elsewhere"
    assert shift.rest(planned.configurations[1], 3.2).status == Measurement.REJECTED_OTHER_FRAME
    shift.node.trigger_deactivate()
    assert shift.node.count_subscribers("tracker/point") == 1  # what was heard late lasts as long


def test_a_type_that_is_stated_is_listened_to_whatever_is_published(bench: Bench, driver: Node) -> None:
    node = bench.start(IdentifierNode, robot="planar_2r", tracker_type=POSE)
    poses = driver.create_publisher(PoseStamped, "tracker/point", SENSOR_OUT)
    bench.wait(poses.get_subscription_count)
    driver.destroy_publisher(poses)
    driver.create_publisher(TransformStamped, "tracker/point", SENSOR_OUT)
    bench.wait(lambda: types_of(node) == [POSE, "geometry_msgs/msg/TransformStamped"])
    bench.wait(lambda: "tracker_type: expected the type of" in node._streams.trouble[0])
    assert node._streams.kinds == [POSE]


class Ears(ManagedNode[LifecycleParameters]):
    """Listens to the transforms to the frame ``ball`` on the topic tf."""

    def __init__(self, **options: Any) -> None:
        self.heard: list[Any] = []
        super().__init__("ears", LifecycleParameters(), **options)

    def configure(self) -> None:
        def nothing(*_: Any) -> None:
            return

        listener = Listener(nothing, lambda target, point: self.heard.append((target, point)), nothing, nothing)
        DriverStreams(self, BagTopics(points=("tf",), children=("ball",)), TRANSFORMS, listener)


def test_a_target_is_found_among_all_transforms(bench: Bench, driver: Node) -> None:
    tf2 = pytest.importorskip("tf2_msgs.msg")
    ears = bench.start(Ears)
    tf = driver.create_publisher(tf2.TFMessage, "tf", SENSOR_OUT)
    bench.wait(tf.get_subscription_count)
    for k in range(3):
        point = point_message(np.full(3, float(k)), (1 + k) * NANO, "laser")
        tf.publish(tf2.TFMessage(transforms=[transformed(point, child) for child in ("link_1", "ball", "head")]))
        tf.publish(tf2.TFMessage())
    bench.wait(lambda: len(ears.heard) == 3)
    assert [(target, p.child_frame_id, p.point.y) for target, p in ears.heard] == [
        (0, "ball", k) for k in range(3)
    ]


def test_transforms_without_the_name_of_the_target_are_refused(bench: Bench) -> None:
    pytest.importorskip("tf2_msgs.msg")
    node = bench.start(IdentifierNode, tracker_topics=["tf"], tracker_type="tf2_msgs/msg/TFMessage")
    assert "tracker_child_frames" in node.failure


def types_of(node: Node) -> list[str]:
    return next((types for topic, types in node.get_topic_names_and_types() if topic == "/tracker/point"), [])


def stream_status(heard: list[DiagnosticArray], topic: str) -> DiagnosticStatus:
    return next(s for s in heard[-1].status if s.name.endswith(f"stream {topic}"))


def test_a_type_that_holds_no_point_is_told(bench: Bench, driver: Node, robot: Robot) -> None:
    heard = bench.hear(DiagnosticArray, "/diagnostics", EVENTS)
    shift = Shift(bench, robot, diagnostics_period=0.1)
    bench.client.destroy_publisher(shift.points)
    driver.create_publisher(String, "tracker/point", SENSOR_OUT)
    bench.wait(lambda: heard and "std_msgs/msg/String" in stream_status(heard, "tracker/point").message)
    found = stream_status(heard, "tracker/point")
    assert found.level == DiagnosticStatus.WARN and "geometry_msgs/msg/PoseStamped" in found.message


class Restamped(Drivers):
    """Every point twice, some in another order, one in five with the stamp of the one before."""

    def change(self, publisher: Any, message: Any) -> list[tuple[Any, Any]]:
        if isinstance(message, JointState):
            return [(publisher, message)]
        held, self.held = getattr(self, "held", []), []
        self.turn = getattr(self, "turn", 0) + 1
        if self.turn % 5 == 1 and not held:
            self.held = [(publisher, message)]
            return []
        if self.turn % 5 == 3:
            message.header.stamp = self.before
        self.before = message.header.stamp
        return [(publisher, message), *held, (publisher, message)]


def test_points_twice_out_of_order_or_with_one_stamp_do_no_harm(
    bench: Bench, robot: Robot, planned: Plan
) -> None:
    shift = Restamped(bench, robot)
    shift.announce(planned)
    for q in planned.configurations[:3]:
        found = shift.rest(q, 1.0)
        assert found.status == Measurement.ACCEPTED, found.reason
        assert found.samples[0] >= 20
    assert shift.node._intake.dropped(1) > 100


LATCHING = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.mark.parametrize("qos", [LATCHING, BEST_EFFORT], ids=["latched", "best-effort"])
def test_points_while_the_tracker_has_lost_the_target_do_not_count(
    bench: Bench, robot: Robot, planned: Plan, qos: QoSProfile
) -> None:
    heard = bench.hear(DiagnosticArray, "/diagnostics", EVENTS)
    state = bench.client.create_publisher(Bool, "tracker/locked", qos)
    if qos is LATCHING:
        state.publish(Bool(data=True))
    shift = Shift(bench, robot, tracker_state_topics=["tracker/locked"], diagnostics_period=0.1)
    bench.wait(state.get_subscription_count)
    shift.announce(planned)
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED
    state.publish(Bool(data=False))
    bench.wait(lambda: shift.node._intake._lost == [True])
    refused = shift.rest(planned.configurations[1], 3.2)
    assert refused.status == Measurement.REJECTED_TARGET_LOST and "lost target 1" in refused.reason
    bench.wait(lambda: "lost the target" in stream_status(heard, "tracker/point").message)
    state.publish(Bool(data=True))
    bench.wait(lambda: shift.node._intake._lost == [False])
    assert shift.rest(planned.configurations[1]).status == Measurement.ACCEPTED


def test_a_state_that_was_latched_before_the_start_counts(bench: Bench, robot: Robot, planned: Plan) -> None:
    state = bench.client.create_publisher(Bool, "tracker/locked", LATCHING)
    state.publish(Bool(data=False))
    shift = Shift(bench, robot, tracker_state_topics=["tracker/locked"])
    bench.wait(lambda: shift.node._intake._lost == [True])
    shift.announce(planned)
    assert "lost target 1" in shift.rest(planned.configurations[0], 3.2).reason


def test_a_pose_of_nan_is_a_target_that_was_not_seen(
    bench: Bench, driver: Node, robot: Robot, planned: Plan
) -> None:
    shift = Typed(bench, robot)
    shift.others = driver.create_publisher(PoseStamped, "tracker/point", SENSOR_OUT)
    shift.announce(planned)
    found = shift.rest(planned.configurations[0], 3.2, error=float("nan"))
    assert found.status == Measurement.REJECTED_NOT_FINITE
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED


@pytest.mark.parametrize(
    "wrong",
    [
        {"joint_topics": ["a", "a"]},
        {"joint_topics": ["tracker/point"]},
        {"tracker_state_topics": ["a", "b"]},
        {"tracker_type": "std_msgs/msg/String"},
    ],
)
def test_topics_that_do_not_fit_are_refused(bench: Bench, wrong: dict[str, Any]) -> None:
    with pytest.raises(CalibPlannerError):
        bench.start(IdentifierNode, robot="planar_2r", **wrong)
