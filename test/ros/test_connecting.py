"""The adapters of docs/connecting.md as they stand there: a tracker's driver, and a plan executor."""

from __future__ import annotations

import importlib.util
import itertools
import math
import re
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from bench import Bench
from calib_planner_msgs.action import ExecutePlan
from geometry_msgs.msg import PointStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from robots import plan_of
from sensor_msgs.msg import JointState

from calib_planner import Robot
from calib_planner.acquisition import NANO
from calib_planner.io import config_folder
from calib_planner.ros.messages import duration_message, nanoseconds, plan_to_message
from calib_planner.ros.parameters import STREAM_IN
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
    heard = bench.hear(PointStamped, "tracker/point", STREAM_IN)

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


class FollowJointTrajectory:
    """What the adapter uses of control_msgs, where that is not to be had."""

    class Goal(SimpleNamespace):
        """Fields as given."""

    class Result(SimpleNamespace):
        """Fields as given."""

        SUCCESSFUL = 0
        error_code, error_string = 0, ""


class Arm:
    """An action client's face, and behind it the controller's callback in a thread: no message, no server."""

    controller: Controller

    def __init__(self, *_: Any, **__: Any) -> None:
        self.moved, self._cancelled = Future(), threading.Event()

    def wait_for_server(self, timeout_sec: float) -> bool:
        return timeout_sec > 0

    def send_goal_async(self, goal: Any) -> Future:
        sent, move = Future(), Arm()
        move.request, move.accepted = goal, self.controller.refuse is False  # type: ignore[attr-defined]
        sent.set_result(move)
        if move.accepted:  # type: ignore[attr-defined]
            threading.Thread(target=move.run, daemon=True).start()
        return sent

    def run(self) -> None:
        self.moved.set_result(SimpleNamespace(result=self.controller._follow(self)))

    def get_result_async(self) -> Future:
        return self.moved

    def cancel_goal_async(self) -> None:
        self._cancelled.set()

    @property
    def is_cancel_requested(self) -> bool:
        return self._cancelled.is_set()

    def succeed(self) -> None:
        """Told by the result."""

    abort = canceled = succeed


class Controller(Node):
    """A joint_trajectory_controller as far as the adapter sees one; it refuses, fails and hangs on demand."""

    def __init__(self, kind: Any, **options: Any) -> None:
        super().__init__("controller", **options)
        self.kind, self.q, self.visited, self.fail = kind, np.zeros(2), [], ""
        self.refuse = self.hang = False
        self._publisher = self.create_publisher(JointState, "joint_states", 10)
        self.create_timer(0.01, self._publish)
        if kind is FollowJointTrajectory:
            Arm.controller = self
            return
        self._server = ActionServer(
            self,
            kind,
            "joint_trajectory_controller/follow_joint_trajectory",
            self._follow,
            callback_group=ReentrantCallbackGroup(),
            goal_callback=lambda _: GoalResponse.REJECT if self.refuse else GoalResponse.ACCEPT,
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
        while self.hang and not goal.is_cancel_requested:
            threading.Event().wait(0.02)
        self.visited.append(end)
        if self.fail:
            goal.abort()
            return self.kind.Result(error_code=-4, error_string=self.fail)
        goal.succeed()
        return self.kind.Result(error_code=0)


@pytest.fixture(params=["control_msgs", "stand-in"])
def executor(
    bench: Bench, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> tuple[Controller, Any, Any]:
    """Controller, adapter and the adapter's module; with the real messages where they are installed."""
    if request.param == "control_msgs":
        kind = pytest.importorskip(
            "control_msgs.action", reason="not among the PyPI wheels"
        ).FollowJointTrajectory
        adapter = module_of("plan_executor.py", tmp_path)
    else:
        kind = FollowJointTrajectory
        stand_in(monkeypatch, kind)
        adapter = module_of("plan_executor.py", tmp_path)
        monkeypatch.setattr(adapter, "ActionClient", Arm)
    controller = Controller(kind, context=bench.context)
    overrides = [("robot", "planar_2r"), ("joint_speed", 5.0), ("dwell", 0.2)]
    values = [adapter.rclpy.parameter.Parameter(k, value=v) for k, v in overrides]
    node = adapter.PlanExecutor(context=bench.context, parameter_overrides=values)
    for made in (controller, node):
        bench.nodes.append(made)
        bench._spin(made, 4)
    bench.wait(lambda: node._here is not None)
    return controller, node, adapter


def stand_in(monkeypatch: pytest.MonkeyPatch, kind: Any) -> None:
    action = type(sys)("control_msgs.action")
    action.FollowJointTrajectory = kind
    monkeypatch.setitem(sys.modules, "control_msgs", type(sys)("control_msgs"))
    monkeypatch.setitem(sys.modules, "control_msgs.action", action)


def test_the_executor_drives_a_controller(
    bench: Bench, executor: tuple[Controller, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    controller, _, adapter = executor
    client = bench.action(ExecutePlan, "plan_executor/execute_plan")
    feedback: list[Any] = []

    def run(goal: ExecutePlan.Goal) -> Any:
        handle = bench.goal(client, goal, feedback_callback=feedback.append)
        return bench.future(handle.get_result_async()).result

    goal = ExecutePlan.Goal(plan=plan_to_message(plan_of(ROBOT, Q, 2), "p", 0, "base"))
    result = run(goal)
    assert (result.status, result.executed) == (result.SUCCESS, 4), result.message
    # Twice at each, and away in between.
    assert [bool(np.allclose(v, Q[0])) for v in controller.visited[:3]] == [True, False, True]
    assert {f.feedback.phase for f in feedback} == {ExecutePlan.Feedback.MOVING, ExecutePlan.Feedback.MEASURING}
    assert len(feedback) > 8, "signs of life within a phase"
    controller.fail = "path tolerance"
    result = run(goal)
    assert result.status == result.ABORTED and "path tolerance" in result.message
    controller.fail, controller.refuse = "", True
    result = run(goal)
    assert result.status == result.ABORTED and "refused configuration 0" in result.message
    controller.refuse, controller.hang = False, True
    with monkeypatch.context() as patch:
        ticks = itertools.count(step=100.0)
        patch.setattr(adapter, "time", SimpleNamespace(monotonic=lambda: next(ticks)))
        result = run(goal)
    assert result.status == result.ABORTED and "no end of the move" in result.message
    controller.hang = False
    goal.plan.robot = "another"
    assert run(goal).status == result.INVALID_PLAN


def test_the_executor_does_one_plan_at_a_time_and_can_be_stopped(
    bench: Bench, executor: tuple[Controller, Any, Any]
) -> None:
    client = bench.action(ExecutePlan, "plan_executor/execute_plan")
    goal = ExecutePlan.Goal(
        plan=plan_to_message(plan_of(ROBOT, Q, 2), "p", 0, "base"), dwell=duration_message(60.0)
    )
    feedback: list[Any] = []
    handle = bench.goal(client, goal, feedback_callback=feedback.append)
    bench.wait(lambda: feedback and feedback[-1].feedback.phase == ExecutePlan.Feedback.MEASURING)
    second = bench.future(bench.goal(client, goal).get_result_async()).result
    assert second.status == second.BUSY and second.executed == 0
    bench.future(handle.cancel_goal_async())
    assert bench.future(handle.get_result_async()).result.status == second.CANCELLED
    controller = executor[0]
    controller.hang = True
    handle = bench.goal(client, goal)
    bench.future(handle.cancel_goal_async())  # while it moves
    assert bench.future(handle.get_result_async()).result.status == second.CANCELLED


def test_without_control_msgs_the_executor_still_imports_all_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything it takes from us and from rclpy exists."""
    if importlib.util.find_spec("control_msgs") is None:
        stand_in(monkeypatch, object)
    assert issubclass(module_of("plan_executor.py", tmp_path).PlanExecutor, Node)
