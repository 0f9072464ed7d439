# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulated robot and tracker over real topics and its action, in this process."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from bench import Bench
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import Plan as PlanMessage
from geometry_msgs.msg import PointStamped
from poses import poses
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from calib_planner import Plan, PlanProblem, Robot, plan
from calib_planner.acquisition import NANO
from calib_planner.error_model import typical
from calib_planner.io import write_error_model
from calib_planner.planning import Search
from calib_planner.ros.messages import duration_message, nanoseconds, plan_to_message, rows_message
from calib_planner.ros.nodes import simulator as simulator_node
from calib_planner.ros.nodes.simulator import SimulatorNode
from calib_planner.ros.parameters import STREAM_IN
from calib_planner.simulation import Tour, make_tour, random_deviations
from calib_planner.tracker import Isotropic

ACTION = "tracker_simulator/execute_plan"
Result = ExecutePlan.Result


@pytest.fixture(scope="module")
def planned() -> Plan:
    robot = Robot.load("planar_2r").with_parameters("lengths+offsets")
    return plan(PlanProblem(robot, [0.3, 0.5], 3, search=Search(starts=2)))


def goal_of(planned: Plan, **changes: Any) -> ExecutePlan.Goal:
    message = plan_to_message(planned, "p", 0, "base")
    for name, value in changes.items():
        setattr(message, name, value)
    return ExecutePlan.Goal(plan=message, dwell=duration_message(0.3))


def test_it_visits_every_configuration(bench: Bench, planned: Plan) -> None:
    states = bench.hear(JointState, "joint_states", STREAM_IN)
    points = bench.hear(PointStamped, "tracker/point", STREAM_IN)
    exact = {"error_model": "paper", "sigma": 1e-5}
    bench.start(SimulatorNode, robot="planar_2r", true_deviations="l1=0.002", joint_speed=50.0, **exact)
    bench.wait(lambda: states and points)
    feedback: list[Any] = []
    client = bench.action(ExecutePlan, ACTION)
    handle = bench.goal(client, goal_of(planned), feedback_callback=feedback.append)
    result = bench.future(handle.get_result_async())
    assert result.status == GoalStatus.STATUS_SUCCEEDED
    assert (result.result.status, result.result.executed) == (Result.SUCCESS, 3)
    assert {f.feedback.phase for f in feedback} <= {ExecutePlan.Feedback.MOVING, ExecutePlan.Feedback.MEASURING}
    assert {f.feedback.index for f in feedback} == {0, 1, 2}

    def seen(wanted: np.ndarray) -> bool:
        q = np.array([s.position for s in states])
        return (np.abs(q - wanted).max(axis=1) < 1e-9).sum() >= 5

    for wanted in planned.configurations:
        bench.wait(lambda q=wanted: seen(q))  # type: ignore[misc]
    truth = Robot.load("planar_2r").with_deviations({"l1": 0.002})
    end = truth.positions(planned.configurations[-1])[0, 0]

    def there() -> bool:
        last = points[-1].point
        return np.allclose((last.x, last.y, last.z), end, atol=1e-4)

    bench.wait(there)
    # A busy machine delays messages, and skips none: 100 Hz and 50 Hz.
    for heard, period in ((states, 0.01), (points, 0.02)):
        stamps = np.sort([nanoseconds(m.header.stamp) for m in heard]) / NANO
        assert np.isclose(np.median(np.diff(stamps)), period, atol=1e-6)
        assert np.isclose(np.diff(stamps), period, atol=1e-6).mean() > 0.9


def test_a_short_motion_is_seen_however_long_it_takes_to_think_of_it(
    bench: Bench, planned: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Backing off takes milliseconds here: begun before what was sampled already, nobody would see it."""

    def slow(*args: Any, **named: Any) -> Tour:
        time.sleep(0.2)
        return make_tour(*args, **named)

    monkeypatch.setattr(simulator_node, "make_tour", slow)
    states = bench.hear(JointState, "joint_states", STREAM_IN)
    bench.start(SimulatorNode, robot="planar_2r", joint_speed=12.0)
    client = bench.action(ExecutePlan, ACTION)
    one = {"configurations": poses(planned.configurations[0]), "repetitions": [1]}

    def off() -> np.ndarray:
        return np.abs(np.array([s.position for s in states]) - planned.configurations[0]).max(axis=1)

    bench.future(bench.goal(client, goal_of(planned, **one)).get_result_async())
    bench.wait(lambda: states and (off()[-20:] < 1e-9).all())
    count = len(states)
    bench.future(bench.goal(client, goal_of(planned, **one)).get_result_async())
    bench.wait(lambda: (off()[count:] > 1e-3).any())


@pytest.mark.parametrize(
    "changes",
    [
        {"robot": "kuka_kr270"},
        {"joint_names": ["q2", "q1"]},
        {"configurations": poses([0.0] * 5) * 3},
        {"configurations": poses([math.nan] * 2) * 3},
        {"configurations": poses([100.0] * 2) * 3},
        {"repetitions": [1]},
        {"status": PlanMessage.STATUS_EMPTY},
    ],
    ids=str,
)
def test_bad_plans_are_refused_and_it_stays_up(bench: Bench, planned: Plan, changes: dict[str, Any]) -> None:
    bench.start(SimulatorNode, robot="planar_2r", joint_speed=100.0)
    client = bench.action(ExecutePlan, ACTION)
    handle = bench.goal(client, goal_of(planned, **changes))
    result = bench.future(handle.get_result_async())
    assert result.status == GoalStatus.STATUS_ABORTED
    assert result.result.status == Result.INVALID_PLAN and next(iter(changes)) in result.result.message
    handle = bench.goal(client, goal_of(planned))
    bench.future(handle.cancel_goal_async())
    assert bench.future(handle.get_result_async()).result.status == Result.CANCELLED


def test_one_execution_at_a_time_and_cancel(bench: Bench, planned: Plan) -> None:
    bench.start(SimulatorNode, robot="planar_2r", joint_speed=0.1)
    client = bench.action(ExecutePlan, ACTION)
    feedback: list[Any] = []
    first = bench.goal(client, goal_of(planned), feedback_callback=feedback.append)
    bench.wait(lambda: feedback)
    second = bench.goal(client, goal_of(planned))
    refused = bench.future(second.get_result_async()).result
    assert refused.status == Result.BUSY and "another plan" in refused.message
    bench.future(first.cancel_goal_async())
    result = bench.future(first.get_result_async())
    assert result.status == GoalStatus.STATUS_CANCELED
    assert (result.result.status, result.result.executed) == (Result.CANCELLED, 0)


def test_a_plan_without_end_is_refused(bench: Bench, planned: Plan) -> None:
    bench.start(SimulatorNode, robot="planar_2r")
    client = bench.action(ExecutePlan, ACTION)
    handle = bench.goal(client, goal_of(planned, repetitions=[10_000] * 3))
    bench.future(handle.cancel_goal_async())
    assert bench.future(handle.get_result_async()).result.status == Result.CANCELLED
    many = np.tile(planned.configurations, (34, 1))
    flat = {"configurations": rows_message(many), "repetitions": [1000] * len(many)}
    handle = bench.goal(client, goal_of(planned, **flat))
    result = bench.future(handle.get_result_async()).result
    assert result.status == Result.INVALID_PLAN and "repetitions" in result.message


def test_faults_by_parameter(bench: Bench) -> None:
    points = bench.hear(PointStamped, "tracker/point", STREAM_IN)
    states = bench.hear(JointState, "joint_states", STREAM_IN)
    faults = {"dropout_probability": 0.5, "tracker_clock_offset": 1000.0, "encoder_resolution": 0.1}
    node = bench.start(SimulatorNode, robot="planar_2r", outlier_probability=0.3, **faults)
    bench.wait(lambda: len(points) > 100 and len(states) > 100)
    assert node.world.faults.outlier_probability == 0.3
    ahead = nanoseconds(points[-1].header.stamp) - nanoseconds(states[-1].header.stamp)
    assert 900 * NANO < ahead < 1100 * NANO
    stamps = np.array([nanoseconds(m.header.stamp) for m in points]) / NANO
    assert np.diff(np.unique(stamps)).max() > 0.035  # some are missing
    xyz = np.array([[m.point.x, m.point.y, m.point.z] for m in points])
    off = np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)
    assert 0 < (off > 5e-3).sum() < len(off) and off.max() < 0.051
    q = np.array([m.position for m in states])
    assert np.allclose(q / 0.1, np.rint(q / 0.1), atol=1e-6)


def test_an_instrument(bench: Bench) -> None:
    points = bench.hear(PointStamped, "tracker/point", STREAM_IN)
    bench.start(SimulatorNode, robot="planar_2r", instrument="laser_tracker", sigma=0.9)
    bench.wait(lambda: len(points) > 100)
    xyz = np.array([[m.point.x, m.point.y, m.point.z] for m in points])
    assert 1e-6 < xyz.std(axis=0).max() < 1e-4


@pytest.mark.parametrize("source", ["typical", "paper", "file"])
def test_an_error_model(bench: Bench, tmp_path: Path, source: str) -> None:
    write_error_model(tmp_path / "m.yaml", typical().without("gravity"))
    words = {"typical": {}, "paper": {"error_model": "paper"}, "file": {"error_model": str(tmp_path / "m.yaml")}}
    node = bench.start(SimulatorNode, robot="ur10e", parameters="full", seed=5, **words[source])
    terms = {"typical": 5, "paper": 2, "file": 4}[source]
    truth = node.world.truth
    assert len(truth.model.terms) == terms and truth.model.points.noise == Isotropic(3e-5)
    # The same placement, whatever else is wrong.
    wanted = random_deviations(node.world.robot, 5)
    assert dict(zip(truth.robot.parameter_names, truth.coefficients.tolist(), strict=False)) == wanted
    at_rest = node.world.robot.joint_limits.mean(axis=1)[None]
    assert np.array_equal(truth.actual(at_rest), at_rest) == (source == "paper")


def test_the_truth_is_nowhere_on_the_graph(bench: Bench) -> None:
    bench.start(SimulatorNode, robot="planar_2r")
    mine = {
        "/diagnostics",
        "/rosout",
        "/parameter_events",
        "/joint_states",
        "/tracker/point",
        "/tracker/locked",
        "/tracker_simulator/transition_event",
    }

    def published() -> set[str]:
        found = bench.client.get_publisher_names_and_types_by_node("tracker_simulator", "/")
        return {name for name, _ in found if "/_action/" not in name}

    bench.wait(lambda: published() >= mine)
    assert published() == mine


def test_new_faults_from_a_new_configure(bench: Bench) -> None:
    node = bench.start(SimulatorNode, robot="planar_2r")
    change = Parameter("dropout_probability", value=1.0)
    (refused,) = node.set_parameters([change])
    assert not refused.successful and "configure" in refused.reason
    node.trigger_deactivate()
    node.trigger_cleanup()
    (taken,) = node.set_parameters([change])
    assert taken.successful
    node.trigger_configure()
    node.trigger_activate()
    assert node.is_active and node.world.faults.dropout_probability == 1.0
    states = bench.hear(JointState, "joint_states", STREAM_IN)
    points = bench.hear(PointStamped, "tracker/point", STREAM_IN)
    bench.wait(lambda: len(states) > 50)
    assert not points


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"robot": "none"}, "robot"),
        ({"parameters": "none"}, "none"),
        ({"true_deviations": "none=1"}, "true_deviations"),
        ({"true_deviations": "d1=nan"}, "true_deviations"),
        ({"true_deviations": "d1"}, "true_deviations"),
        ({"tracker_topics": ["a", "b"]}, "tracker_topics"),
        ({"error_model": "typcal"}, "typcal"),
    ],
)
def test_what_cannot_be_is_said(bench: Bench, values: dict[str, Any], words: str) -> None:
    node = bench.start(SimulatorNode, **values)
    assert not node.is_active and words in node.failure
