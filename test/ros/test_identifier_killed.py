# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The identifier as a process, killed with -9 while it is fed: the campaign goes on, the estimate is the same."""

from __future__ import annotations

import os
import random
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from geometry_msgs.msg import PointStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from robots import plan_of, random_configurations, repeats
from sensor_msgs.msg import JointState
from warm_processes import Forked, Warm

from calib_planner import Robot
from calib_planner.acquisition import NANO
from calib_planner.io import ACCEPTED, open_store, stored_model
from calib_planner.io.store import FILE
from calib_planner.ros.messages import joints_message, plan_to_message, point_message
from calib_planner.ros.parameters import EVENTS, LATCHED
from calib_planner.simulation import random_deviations

NAME = "calibration_identifier"
ROBOT = Robot.load("planar_2r").with_parameters("lengths+offsets")
TRUE = ROBOT.with_deviations(random_deviations(ROBOT, 6))
PLAN = plan_of(ROBOT, random_configurations(ROBOT, 8, 5))
DEEP = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
AVERAGED = 40
"""Points that the identifier averages, 0.4 s of 100 Hz: its mean has the noise that it is taken for."""


class Feeder:
    """Publishes what is seen at rows of the plan, the same numbers at every attempt, each at a later time.

    On a domain with one identifier only: what is told there is told by that one.

    Args:
        stamp: The time before the first message [ns].
    """

    def __init__(self, bench: Bench, stamp: int) -> None:
        self.bench, self.stamp = bench, stamp
        create = bench.client.create_publisher
        self.joints = create(JointState, "joint_states", DEEP)
        self.points = create(PointStamped, "tracker/point", DEEP)
        self.plans = create(PlanMessage, "calibration_planner/current_plan", LATCHED)
        self.estimates = bench.hear(CalibrationEstimate, f"{NAME}/estimate", LATCHED)
        self.measurements = bench.hear(Measurement, f"{NAME}/measurements", EVENTS)
        self.plans.publish(plan_to_message(PLAN, "p", 0, "base"))

    @property
    def matched(self) -> bool:
        """Whether the identifier hears both streams."""
        return self.joints.get_subscription_count() == self.points.get_subscription_count() == 1

    def row(self, row: int, pause: float = 0.0005) -> None:
        """A standstill of 0.8 s and the way on, in a tenth of that time."""
        rng, q = np.random.default_rng(row), PLAN.configurations[row]
        point = TRUE.positions(q)[0, 0] + 3e-5 / np.sqrt(AVERAGED) * rng.standard_normal(3)
        for i in range(90):
            self.stamp += 10**7 if i < 80 else NANO // 5
            here = q if i < 80 else q + 0.01 * (i - 60)
            self.joints.publish(joints_message(ROBOT.joint_names, here, self.stamp))
            self.points.publish(point_message(point, self.stamp, "laser"))
            time.sleep(pause)

    def has(self, configurations: int) -> bool:
        """Whether the newest estimate is of the plan and of so many configurations."""
        newest = self.estimates[-1:]
        return [(e.plan_id, e.configurations) for e in newest] == [("p", configurations)]

    def accepted(self, row: int, after: int) -> bool:
        """Whether the row was told to be accepted, later than so many messages."""
        news = self.measurements[after:]
        told = any((m.configuration_index, m.status) == (row, Measurement.ACCEPTED) for m in news)
        # The event may have been sent before its reader was discovered; the estimate is latched.
        return told or self.has(row + 1)

    def measure(self, row: int) -> None:
        """Feed a row until it is told to be accepted."""
        for _ in range(5):
            count = len(self.measurements)
            self.row(row)
            try:
                self.bench.wait(partial(self.accepted, row, count), 10.0)
            except AssertionError:
                continue
            return
        raise AssertionError(f"row {row} was not accepted: {self.measurements[-1:]}")


def started(warm: Warm, folder: Path, log: Path, domain: int) -> Forked:
    command = [sys.executable, "-m", "calib_planner.ros.nodes.identifier", "--ros-args"]
    for topic in ("joint_states", "tracker/point"):
        command += ["-p", f"qos_overrides./{topic}.subscription.reliability:=reliable"]
    command += ["-p", "robot:=planar_2r", "-p", f"store_folder:={folder}"]
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
    with log.open("ab") as sink:
        return warm.popen(command, stdout=sink, stderr=sink, env=environment)


def stored(folder: Path) -> list[int | None]:
    """Rows of the plan that are in the store, in the order of measuring."""
    if not (folder / FILE).exists():
        return []
    model = stored_model(str(folder))
    if model is None:
        return []
    store = open_store(str(folder), model, {}, "")
    found = store.current()
    store.close()
    return [] if found is None else [d.index for d in found.records if d.status == ACCEPTED]


@pytest.mark.timeout(300)
def test_a_node_killed_while_it_is_fed_goes_on(warm: Warm, tmp_path: Path) -> None:
    rng, log, stamp = random.Random(2), tmp_path / "log", 1000 * NANO
    finals = []
    for name, kills in (("undisturbed", 0), ("killed", repeats(1, 3))):
        done = 0
        for k in range(kills + 1):
            rows = stored(tmp_path / name)
            assert rows == list(range(len(rows))) and len(rows) >= done, "told and lost"
            with Bench() as bench, started(warm, tmp_path / name, log, bench.domain) as process:
                feeder = Feeder(bench, stamp)
                try:
                    bench.wait(lambda f=feeder: f.matched, 60.0)  # type: ignore[misc]
                    bench.wait(partial(feeder.has, len(rows)), 60.0)
                    last = len(PLAN.configurations) if k == kills else len(rows) + rng.randrange(1, 3)
                    for row in range(len(rows), last):
                        feeder.measure(row)
                        done = row + 1
                    if k == kills:
                        bench.wait(lambda f=feeder: f.estimates[-1].complete, 60.0)  # type: ignore[misc]
                    else:
                        feeder.row(last, pause=rng.choice([0.0, 0.0002, 0.001]))
                        time.sleep(rng.random() * 0.2)
                finally:
                    process.kill()
                    stamp = feeder.stamp
        finals.append(feeder.estimates[-1])
    assert "Traceback" not in log.read_text()
    for e in finals:
        assert (e.measurements, e.configurations, e.status) == (8, 8, CalibrationEstimate.STATUS_OK)
        assert e.outliers == 0
    a, b = finals
    assert np.allclose(a.value, b.value, rtol=0, atol=1e-12)
    assert np.allclose(a.covariance, b.covariance, rtol=0, atol=1e-12)
