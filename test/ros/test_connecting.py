"""The adapters of docs/connecting.md as they stand there: a tracker's driver, and a plan executor."""

from __future__ import annotations

import importlib.util
import math
import re
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bench import Bench
from calib_planner_msgs.action import ExecutePlan
from geometry_msgs.msg import PointStamped
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from robots import plan_of
from sensor_msgs.msg import JointState

from calib_planner import Robot
from calib_planner.instrument.standstill import NANO
from calib_planner.robot.catalogue import config_folder
from calib_planner.ros.conversions import nanoseconds, plan_to_message
from calib_planner.ros.qos import SENSOR_IN
from calib_planner.ros.settings import SimulatorParameters

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "connecting.md").read_text()
FILES = dict(re.findall(r"<!-- file: (\w+\.py) -->\n```python\n(.*?)```", PAGE, re.DOTALL))
ROBOT = Robot.load("planar_2r")
Q = np.array([[0.5, -0.3], [-0.4, 0.6]])


def module_of(name: str, folder: Path) -> Any:
    path = folder / name
    path.write_text(FILES[name])
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_both_are_there_and_compile() -> None:
    assert sorted(FILES) == ["plan_executor.py", "tracker_driver.py"]
    for name, text in FILES.items():
        compile(text, name, "exec")


def test_the_rehearsal_uses_parameters_that_exist() -> None:
    blocks = [yaml.safe_load(b) for b in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)]
    (values,) = [b["/**"]["ros__parameters"] for b in blocks]
    assert SimulatorParameters(**values).outlier_probability == 0.001
    known = yaml.safe_load((config_folder() / "simulator.yaml").read_text())["/**"]["ros__parameters"]
    assert {k: type(v) for k, v in values.items()} == {k: type(known[k]) for k in values}


# ── the tracker ──────────────────────────────────────────────────────────────────────────────────────


def test_stamps_of_a_clock_of_its_own(tmp_path: Path) -> None:
    keep = module_of("tracker_driver.py", tmp_path).StampFilter(remembered=10.0)
    rng = np.random.default_rng(0)
    errors = []
    for k in range(4000):
        true = 1000.0 + 0.02 * k
        own = 5.0 + true * (1 + 2e-5)  # its zero and its rate
        late = 0.003 + rng.exponential(0.01)
        errors.append(keep.stamp(own, true + late) - true)
    # Never earlier than measured, late by the shortest way, whatever the delay of the sample.
    settled = np.array(errors[500:])
    assert settled.min() > 0.0029 and settled.max() < 0.005


def test_the_driver_publishes_metres_and_stamps(bench: Bench, tmp_path: Path) -> None:
    driver = module_of("tracker_driver.py", tmp_path)
    waiting = [(100.0, 1000.0, -2000.0, 500.0), (100.02, math.nan, math.nan, math.nan)]
    heard = bench.hear(PointStamped, "tracker/point", SENSOR_IN)

    def read() -> list[tuple[float, ...]]:
        if not bench.client.count_publishers("tracker/point"):
            return []
        time.sleep(0.02)
        return [waiting.pop(0)] if waiting else [(101.0, 0.0, 0.0, 0.0)]

    before = time.time()
    node = driver.TrackerDriver(read, context=bench.context)
    bench.nodes.append(node)
    bench._spin(node, 1)
    bench.wait(lambda: len(heard) > 3)
    first = next((m for m in heard if m.point.x == 1.0), None)
    if first is not None:  # a message before discovery is lost
        assert (first.point.y, first.point.z, first.header.frame_id) == (-2.0, 0.5, "tracker")
    assert all(before - 5 < nanoseconds(m.header.stamp) / NANO < time.time() + 5 for m in heard)
    assert heard[-1].point.x == 0.0


# ── the robot ────────────────────────────────────────────────────────────────────────────────────────


class Controller(Node):
    """A joint_trajectory_controller as far as the adapter sees one; it refuses and fails on demand."""

    def __init__(self, kind: Any, **options: Any) -> None:
        super().__init__("controller", **options)
        self.kind, self.q, self.visited, self.fail = kind, np.zeros(2), [], ""
        self._publisher = self.create_publisher(JointState, "joint_states", 10)
        self.create_timer(0.01, self._publish)
        self._server = ActionServer(
            self,
            kind,
            "joint_trajectory_controller/follow_joint_trajectory",
            self._follow,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def _publish(self) -> None:
        message = JointState(name=["q2", "other", "q1"], position=[self.q[1], 9.0, self.q[0]])
        message.header.stamp = self.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _follow(self, goal: Any) -> Any:
        (point,) = goal.request.trajectory.points
        start, end = self.q.copy(), np.array(point.positions)
        seconds = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
        for x in np.linspace(0, 1, 20):
            threading.Event().wait(seconds / 20)
            if goal.is_cancel_requested:
                goal.canceled()
                return self.kind.Result()
            self.q = start + x * (end - start)
        self.visited.append(end)
        if self.fail:
            goal.abort()
            return self.kind.Result(error_code=-4, error_string=self.fail)
        goal.succeed()
        return self.kind.Result(error_code=0)


def test_the_executor_drives_a_controller(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    control = pytest.importorskip("control_msgs.action", reason="control_msgs is not among the PyPI wheels")
    adapter = module_of("plan_executor.py", tmp_path)
    controller = Controller(control.FollowJointTrajectory, context=bench.context)
    overrides = [("robot", "planar_2r"), ("joint_speed", 5.0), ("dwell", 0.2)]
    values = [adapter.rclpy.parameter.Parameter(k, value=v) for k, v in overrides]
    node = adapter.PlanExecutor(context=bench.context, parameter_overrides=values)
    for made in (controller, node):
        bench.nodes.append(made)
        bench._spin(made, 4)
    client = bench.action(ExecutePlan, "plan_executor/execute_plan")
    bench.wait(lambda: node._here is not None)
    feedback: list[Any] = []

    def run(goal: ExecutePlan.Goal) -> Any:
        handle = bench.goal(client, goal, feedback_callback=feedback.append)
        return bench.future(handle.get_result_async(), 30.0).result

    goal = ExecutePlan.Goal(plan=plan_to_message(plan_of(ROBOT, Q, 2), "p", 0, "base"))
    result = run(goal)
    assert (result.status, result.executed) == (result.SUCCESS, 4), result.message
    # Twice at each, and away in between.
    assert [bool(np.allclose(v, Q[0])) for v in controller.visited[:3]] == [True, False, True]
    assert {f.feedback.phase for f in feedback} == {"moving", "measuring"}
    controller.fail = "path tolerance"
    result = run(goal)
    assert result.status == result.ABORTED and "path tolerance" in result.message
    controller.fail = ""
    goal.plan.robot = "another"
    assert run(goal).status == result.INVALID_PLAN
    goal.plan.robot, goal.dwell = "planar_2r", 60.0
    handle = bench.goal(client, goal)
    bench.future(handle.cancel_goal_async())
    assert bench.future(handle.get_result_async(), 10.0).result.status == result.CANCELLED


def test_without_control_msgs_the_executor_still_imports_all_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything it takes from us and from rclpy exists."""
    if importlib.util.find_spec("control_msgs") is None:
        action = type(sys)("control_msgs.action")
        action.FollowJointTrajectory = object
        monkeypatch.setitem(sys.modules, "control_msgs", type(sys)("control_msgs"))
        monkeypatch.setitem(sys.modules, "control_msgs.action", action)
    assert issubclass(module_of("plan_executor.py", tmp_path).PlanExecutor, Node)
