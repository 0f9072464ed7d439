# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The trajectory's YAML is a JointTrajectory: set field by field and read back, it is the same.

``rosidl_runtime_py`` is what ``ros2 topic pub`` uses. Where that is not installed, its rules are applied here:
every key is a field, a nested mapping a nested message, and a value has the field's type.
"""

from __future__ import annotations

import array
from typing import Any

import numpy as np
import pytest
import yaml
from robots import mixed, plan_of, random_configurations
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from calib_planner import Robot
from calib_planner.io.plan import trajectory_text
from calib_planner.planning import plan_sheet

pytestmark = pytest.mark.ros


def fill(message: Any, values: dict[str, Any]) -> None:
    """Set the message's fields."""
    assert list(values) == list(message.get_fields_and_field_types())
    for name, value in values.items():
        field, kind = getattr(message, name), message.get_fields_and_field_types()[name]
        if isinstance(field, array.array):
            value = array.array(field.typecode, value)
        elif hasattr(field, "get_fields_and_field_types"):
            value, inner = type(field)(), value
            fill(value, inner)
        elif kind == "sequence<trajectory_msgs/JointTrajectoryPoint>":
            points = [JointTrajectoryPoint() for _ in value]
            for point, inner in zip(points, value, strict=True):
                fill(point, inner)
            value = points
        else:
            assert type(value) is type(field)
        setattr(message, name, value)


def told(message: Any) -> Any:
    """The message as plain values."""
    if hasattr(message, "get_fields_and_field_types"):
        return {name: told(getattr(message, name)) for name in message.get_fields_and_field_types()}
    if isinstance(message, (list, array.array)):
        return [told(item) for item in message]
    return message


@pytest.mark.parametrize("make", [lambda: Robot.load("kuka_kr270"), mixed], ids=["kuka", "mixed"])
def test_the_yaml_is_the_message(make: Any) -> None:
    robot = make()
    q = random_configurations(robot, 6, 4)
    values = yaml.safe_load(trajectory_text(plan_sheet(plan_of(robot, q, 2), robot)))
    message = JointTrajectory()
    fill(message, values)
    assert told(message) == values
    assert message.joint_names == list(robot.joint_names)
    np.testing.assert_array_equal([p.positions for p in message.points[::5]], q)


def test_ros2_topic_pub_takes_it() -> None:
    pytest.importorskip("rosidl_runtime_py")
    from rosidl_runtime_py import message_to_ordereddict, set_message_fields

    robot = Robot.load("kuka_kr270")
    values = yaml.safe_load(trajectory_text(plan_sheet(plan_of(robot, random_configurations(robot, 4)), robot)))
    message = JointTrajectory()
    set_message_fields(message, values)
    assert told(message) == values
    assert message_to_ordereddict(message) == values
