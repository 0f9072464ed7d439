# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages from before 1.0, as an old bag plays them: a node says what they are, takes none of them, and goes on.

The files in ``before_1_0`` are what the messages of that time were on the wire.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import CalibrationEstimate, Measurement, PlanRequest
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import PlanCalibration
from desk import NAME, Desk
from fake_cell import FakeCell
from rcl_interfaces.msg import Log
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from robots import plan_of

from calib_planner import Robot
from calib_planner.ros.messages import plan_to_message
from calib_planner.ros.model import shipped_model
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.parameters import EVENTS, LATCHED
from calib_planner.ros.planning import answer
from calib_planner.ros.settings import PlannerParameters


def old(name: str) -> bytes:
    return (Path(__file__).parent / "before_1_0" / f"{name}.cdr").read_bytes()


def test_an_old_plan_is_refused_and_a_new_one_taken(bench: Bench) -> None:
    node = bench.start(IdentifierNode, robot="planar_2r")
    logs = bench.hear(Log, "/rosout", QoSProfile(depth=1000))
    estimates = bench.hear(CalibrationEstimate, "calibration_identifier/estimate", LATCHED)
    plans = bench.client.create_publisher(PlanMessage, "calibration_planner/current_plan", LATCHED)
    bench.wait(plans.get_subscription_count)
    words = "another version of calib_planner_msgs/Plan", "before 1.0", "current_plan"
    bench.said(logs, node, lambda: plans.publish(old("Plan")), *words)
    new = plan_of(Robot.load("planar_2r"), np.array([[0.1, 0.2], [0.3, 0.4]]))
    plans.publish(plan_to_message(new, "new", 0, "base_link"))
    bench.wait(lambda: estimates and estimates[-1].plan_id == "new")
    assert {e.plan_id for e in estimates} <= {"", "new"}


@pytest.mark.parametrize("kind", [Measurement, CalibrationEstimate])
def test_a_campaign_refuses_them_too(bench: Bench, kind: type) -> None:
    bench.start(FakeCell)
    desk = Desk(bench)
    logs = bench.hear(Log, "/rosout", QoSProfile(depth=1000))
    topic, qos = ("estimate", LATCHED) if kind is CalibrationEstimate else ("measurements", EVENTS)
    peer = bench.client.create_publisher(kind, f"calibration_identifier/{topic}", qos)
    bench.wait(lambda: peer.get_subscription_count() >= 1)
    words = f"another version of calib_planner_msgs/{kind.__name__}", "before 1.0"
    bench.said(logs, desk.node, lambda: peer.publish(old(kind.__name__)), *words)
    assert not desk.call("pause")[0] and desk.node.get_name() == NAME


def test_an_old_request_is_none_that_is_planned_for() -> None:
    """Its bytes are a request without poses, however they are read."""
    try:
        request = deserialize_message(old("PlanCalibration_Request"), PlanCalibration.Request).request
    except Exception:
        request = PlanRequest()
    found = answer(request, PlannerParameters(robot="planar_2r"), shipped_model("planar_2r", "offsets", ""))
    assert (found.status, found.field) == ("INVALID_REQUEST", "test_poses")
