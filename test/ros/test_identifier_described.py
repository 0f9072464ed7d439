# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The identifier of a robot that is described: on ``robot_description``, by URDF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import Measurement
from robots import plan_of, random_configurations
from sensor_msgs.msg import JointState
from shift import NAME, Shift, change
from std_msgs.msg import String

from calib_planner import Plan, PlanProblem, Robot, plan
from calib_planner.acquisition import NANO
from calib_planner.io import parse_urdf
from calib_planner.planning import Search
from calib_planner.ros.messages import point_message, stamp_message
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.parameters import LATCHED


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.load("planar_2r").with_parameters("lengths+offsets")


@pytest.fixture(scope="module")
def planned(robot: Robot) -> Plan:
    return plan(PlanProblem(robot, [0.3, 0.5], 4, noise=3e-5 / 20**0.5, search=Search(starts=4)))


ARM = """<robot name="arm"><link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="tip"/>
<joint name="j1" type="revolute"><origin xyz="0 0 0.3"/><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="j2" type="revolute"><origin xyz="0.1 0 0.2"/><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="j3" type="revolute"><origin xyz="0.5 0 0"/><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="flange" type="fixed"><origin xyz="0.4 0 0.1"/><parent link="c"/><child link="tip"/></joint></robot>
"""


class ArmShift(Shift):
    """The same with a robot out of a URDF, in its own joints."""

    def rest(self, q: Any, **others: Any) -> Measurement:  # type: ignore[override]
        count = len(self.measurements)
        self.stamp += NANO
        names = list(self.robot.joint_names)
        point = self.true_robot.positions(q)[0, 0] + 1e-5 * self.rng.standard_normal(3)
        for away in (0.0, 0.5):
            for i in range(80 if not away else 2):
                stamp = self.stamp + i * (10**7 if not away else NANO // 2)
                state = JointState(name=names, position=(np.asarray(q) + away).tolist())
                state.header.stamp = stamp_message(stamp)
                self.send(self.joints, state)
                self.send(self.points, point_message(point, stamp, "laser"))
            self.stamp += 2 * NANO
        self.bench.wait(lambda: len(self.measurements) > count)
        return self.measurements[count]


def test_a_robot_that_is_described(bench: Bench, tmp_path: Path) -> None:
    robot = parse_urdf(ARM, "arm").with_parameters("lengths+offsets")
    descriptions = bench.client.create_publisher(String, "robot_description", LATCHED)
    calibrated = bench.hear(String, f"{NAME}/robot_description", LATCHED)
    shift = ArmShift(bench, robot, robot="", store_folder=str(tmp_path), estimates=0)
    assert "robot_description" in shift.node._waiting
    assert "robot_description" in shift.service("undo").message
    descriptions.publish(String(data=ARM))
    bench.wait(lambda: calibrated and shift.estimates)
    assert calibrated[0].data == ARM
    planned = plan_of(robot, random_configurations(robot, 12))
    shift.announce(planned)
    for q in planned.configurations:
        assert shift.rest(q).status == Measurement.ACCEPTED
    bench.wait(lambda: shift.estimates[-1].complete)
    q = random_configurations(robot, 5, 1)
    wanted = shift.node._session.newest.calibrated.positions(q)

    def published() -> bool:
        """The description comes after the estimate."""
        return np.allclose(parse_urdf(calibrated[-1].data, "calibrated").positions(q), wanted, atol=1e-12)

    bench.wait(published)
    assert calibrated[-1].data != ARM
    assert shift.service("save").success
    assert (tmp_path / "calibrated_p.urdf").read_text() == calibrated[-1].data

    descriptions.publish(String(data=ARM.replace("0.5 0 0", "0.6 0 0")))
    bench.wait(lambda: "refused" in shift.node._waiting)
    assert shift.node._session.nominal.name == "arm" and len(shift.node._session.records) == 12
    change(bench, "deactivate")
    change(bench, "cleanup")
    again = bench.start(IdentifierNode, robot="", store_folder=str(tmp_path))
    assert again._session.nominal.joint_names == robot.joint_names and len(again._session.records) == 12


@pytest.mark.parametrize("text", ["", "<robot", "<!DOCTYPE a [<!ENTITY b 'c'>]><robot/>", "x" * 5_000_000])
def test_a_bad_description_changes_nothing(bench: Bench, robot: Robot, planned: Plan, text: str) -> None:
    shift = Shift(bench, robot)
    descriptions = bench.client.create_publisher(String, "robot_description", LATCHED)
    descriptions.publish(String(data=text))
    bench.wait(lambda: "refused" in shift.node._waiting)
    shift.announce(planned)
    assert shift.rest(planned.configurations[0]).status == Measurement.ACCEPTED
