# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot and a tracker that are not there: standstills for an identifier in this process, over real topics."""

from __future__ import annotations

from typing import Any

import numpy as np
from bench import Bench
from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from geometry_msgs.msg import PointStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from calib_planner import Plan, Robot
from calib_planner.acquisition import NANO
from calib_planner.ros.messages import plan_to_message, point_message, stamp_message
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.parameters import EVENTS, LATCHED, SENSOR_OUT
from calib_planner.simulation import random_deviations

NAME = "calibration_identifier"
RELIABLE = {
    f"qos_overrides./{topic}.subscription.reliability": "reliable" for topic in ("joint_states", "tracker/point")
}
"""So that a test that counts does not lose messages on a busy machine."""
Estimate = CalibrationEstimate


class Shift:
    """Publishes standstills, faster than real time: only stamps count."""

    def __init__(self, bench: Bench, robot: Robot, /, estimates: int = 1, **parameters: Any) -> None:
        self.bench, self.robot, self.stamp = bench, robot, 1_000 * NANO
        self.truth = random_deviations(robot, 4)
        self.true_robot = robot.with_deviations(self.truth)
        self.rng = np.random.default_rng(4)
        create = bench.client.create_publisher
        self.joints = create(JointState, "joint_states", SENSOR_OUT)
        self.points = create(PointStamped, "tracker/point", SENSOR_OUT)
        self.plans = create(PlanMessage, "calibration_planner/current_plan", LATCHED)
        self.estimates = bench.hear(Estimate, f"{NAME}/estimate", LATCHED)
        self.measurements = bench.hear(Measurement, f"{NAME}/measurements", EVENTS)
        self.node = bench.start(IdentifierNode, **({"robot": "planar_2r"} | RELIABLE | parameters))
        self.sent, self.frame = 0, "laser"
        bench.wait(lambda: self.joints.get_subscription_count() and self.points.get_subscription_count())
        bench.wait(lambda: len(self.estimates) >= estimates)

    def announce(self, planned: Plan, plan_id: str = "p") -> None:
        self.plans.publish(plan_to_message(planned, plan_id, 0, "base"))
        self.bench.wait(lambda: self.estimates[-1].plan_id == plan_id)

    def rest(
        self, q: Any, seconds: float = 0.8, shake: float = 0.0, error: float = 0.0, offset: float = 0.0
    ) -> Measurement:
        """Stand still at ``q`` with ``shake`` and ``error`` [m] on the point and its stamp ``offset`` [s] ahead.

        Returns what becomes of it; others may be seen otherwise after that.
        """
        count = len(self.measurements)
        self.stamp += NANO  # the way there: a gap, which ends a standstill
        for i in range(int(seconds * 100)):
            stamp = self.stamp + i * 10**7
            state = JointState(name=["gripper", "q2", "q1"], position=[7.0, float(q[1]), float(q[0])])
            state.header.stamp = stamp_message(stamp)
            self.send(self.joints, state)
            if i % 2:
                xyz = self.true_robot.positions(q)[0, 0] + 3e-5 * self.rng.standard_normal(3)
                xyz[0] += shake * np.sin(i) + error
                self.send(self.points, point_message(xyz, stamp + round(offset * NANO), self.frame))
        self.stamp += int(seconds * NANO)
        self.bench.wait(lambda: self.sent == self.fed)
        self.tick(q, offset)
        self.bench.wait(lambda: len(self.measurements) > count)
        return self.measurements[count]

    @property
    def fed(self) -> int:
        """Messages that the node took."""
        return sum(w.messages for w in self.node._intake.streams)

    def send(self, publisher: Any, message: Any, ahead: int = 100) -> None:
        """Publish, and wait until all but the last ``ahead`` messages were taken."""
        publisher.publish(message)
        self.sent += 1
        self.bench.wait(lambda: self.sent - self.fed <= ahead)

    def tick(self, q: Any, offset: float = 0.0) -> None:
        """Let time go on: one message of each stream after a gap, elsewhere."""
        for k in (1, 2):
            stamp = self.stamp + k * NANO // 2
            state = JointState(name=["q1", "q2"], position=[float(q[0]) + 0.5, float(q[1])])
            state.header.stamp = stamp_message(stamp)
            self.send(self.joints, state, 0)
            self.send(self.points, point_message(np.zeros(3), stamp + round(offset * NANO), self.frame), 0)
        self.stamp += NANO

    def service(self, name: str) -> Trigger.Response:
        return self.bench.call(Trigger, f"{NAME}/{name}", Trigger.Request())


def change(bench: Bench, transition: str) -> None:
    """Have the only node make a transition, in its own thread."""
    request = ChangeState.Request(transition=Transition(label=transition))
    assert bench.call(ChangeState, f"{NAME}/change_state", request, 30.0, 1).success
