# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The planner node over real topics, services and actions, in this process."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from bench import Bench, Client
from builtin_interfaces.msg import Duration
from calib_planner_msgs.action import PlanCalibration as PlanAction
from calib_planner_msgs.msg import JointConfiguration, PlanRequest
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import PlanCalibration
from lifecycle_msgs.msg import Transition
from poses import poses
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import Parameter
from std_msgs.msg import String
from test_planning import urdf
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from calib_planner.errors import InputError
from calib_planner.ros.messages import duration_message
from calib_planner.ros.model import Model
from calib_planner.ros.nodes.planner import PlannerNode
from calib_planner.ros.parameters import EVENTS, LATCHED

SERVICE, ACTION = "calibration_planner/request_plan", "calibration_planner/plan"
POSE = poses([0.3, 0.5])
Response = PlanCalibration.Response
KUKA_POSE = poses([0.0, -1.0, 1.5, 0.0, 0.8, 0.0])


def request(**changes: Any) -> PlanCalibration.Request:
    wanted = PlanRequest(**({"test_poses": POSE, "configurations": 4} | changes))
    return PlanCalibration.Request(request=wanted)


def long_goal() -> PlanAction.Goal:
    wanted = PlanRequest(robot="kuka_kr270", test_poses=KUKA_POSE, configurations=20)
    return PlanAction.Goal(request=wanted)


def test_a_plan_by_service_reaches_late_joiners(bench: Bench) -> None:
    bench.start(PlannerNode, robot="planar_2r", starts=4)
    answer = bench.call(PlanCalibration, SERVICE, request(seed=5))
    assert answer.status == Response.SUCCESS and answer.plan.status == PlanMessage.STATUS_OK
    assert len(answer.plan.configurations) == 4 and answer.plan.seed == 5 and answer.plan.plan_id
    assert 0 < answer.plan.lower_bound <= answer.plan.predicted_accuracy * (1 + 1e-9)
    plans = bench.hear(PlanMessage, "calibration_planner/current_plan", LATCHED)
    paths = bench.hear(JointTrajectory, "calibration_planner/trajectory", LATCHED)
    bench.wait(lambda: plans and paths)
    assert repr(plans[0]) == repr(answer.plan)  # NaN is not equal to itself
    positions = np.array([c.positions for c in answer.plan.configurations])
    assert np.allclose([p.positions for p in paths[0].points[::2]], positions)
    pictures = bench.hear(MarkerArray, "calibration_planner/markers", LATCHED)
    bench.wait(lambda: pictures)
    assert {"robot", "targets", "path", "order"} <= {m.ns for m in pictures[0].markers}


POSES = ([], poses([1.0]), poses([math.nan, 0.0]), poses([9.0, 0.0]), poses([0.0] * 50_000))
CANDIDATES = (poses([1.0]), poses([math.nan] * 2) * 4, poses([0.1, 0.2]), poses([0.0] * 500_000))


def test_bad_requests_one_after_the_other(bench: Bench) -> None:
    bench.start(PlannerNode, robot="planar_2r", starts=4)
    bad = {
        "test_poses": [{"test_poses": x} for x in POSES],
        "robot": [{"robot": x} for x in ("none", "/etc/passwd", "x" * 10_000, "planar_2r.yaml")],
        "parameters": [{"parameters": x} for x in (["none"], ["l1", "l1"], [""], ["a"] * 5000)],
        "criterion": [{"criterion": "none"}],
        "test_pose_weights": [{"test_pose_weights": x} for x in ([1.0, 2.0], [-1.0], [math.inf])],
        "sigma": [{"sigma": x} for x in (-1.0, math.nan)],
        "time_limit": [{"time_limit": Duration(sec=-1)}],
        "configurations": [{"configurations": 4_000_000_000}],
        "candidates": [{"candidates": x} for x in CANDIDATES],
    }
    for field, changes in bad.items():
        for change in changes:
            answer = bench.call(PlanCalibration, SERVICE, request(**change))
            assert answer.status == Response.INVALID_REQUEST, change
            assert answer.field == field and answer.message
            assert answer.plan.status == PlanMessage.STATUS_EMPTY
    answer = bench.call(PlanCalibration, SERVICE, request(configurations=1))
    assert (answer.status, answer.field) == (Response.INFEASIBLE, "configurations")
    assert bench.call(PlanCalibration, SERVICE, request()).status == Response.SUCCESS


def test_an_unforeseen_fault_is_answered(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("made for this test")

    bench.start(PlannerNode, robot="planar_2r", starts=4)
    with monkeypatch.context() as patch:
        patch.setattr("calib_planner.ros.nodes.planner.answer", broken)
        answer = bench.call(PlanCalibration, SERVICE, request())
    assert answer.status == Response.INTERNAL_ERROR and "made for this test" in answer.message
    assert bench.call(PlanCalibration, SERVICE, request()).status == Response.SUCCESS


def test_while_it_plans_it_answers_and_can_be_cancelled(bench: Bench) -> None:
    bench.start(PlannerNode, robot="planar_2r", starts=20_000)
    client = bench.action(PlanAction, ACTION)
    feedback: list[Any] = []
    handle = bench.goal(client, long_goal(), feedback_callback=feedback.append)
    bench.wait(lambda: feedback)
    busy = bench.call(PlanCalibration, SERVICE, request())
    assert busy.status == Response.BUSY and "again later" in busy.message
    planned = handle.get_result_async()
    name = "calibration_planner/get_parameters"
    assert bench.call(GetParameters, name, GetParameters.Request(names=["sigma"])).values
    assert not planned.done()  # how fast it is, the benchmark says
    cancelled = bench.future(handle.cancel_goal_async())
    assert len(cancelled.goals_canceling) == 1
    result = bench.future(planned)
    assert result.status == GoalStatus.STATUS_CANCELED
    assert result.result.status == PlanAction.Result.CANCELLED
    assert len(result.result.plan.configurations) == 20
    assert result.result.plan.status == PlanMessage.STATUS_CANCELLED
    assert feedback[0].feedback.starts_total == 20_000
    assert (
        bench.call(PlanCalibration, SERVICE, request(time_limit=duration_message(0.5))).status == Response.SUCCESS
    )


def test_every_one_of_a_burst_is_answered(bench: Bench) -> None:
    """Forty at once, goals and calls, and all goals cancelled in one go."""
    bench.start(PlannerNode, robot="planar_2r", starts=20_000)
    kinds = ("goal", "result", "cancel")
    client = Client(bench.client, PlanAction, ACTION, **{f"{k}_service_qos_profile": EVENTS for k in kinds})
    bench.actions.append(client)
    caller = bench.client.create_client(PlanCalibration, SERVICE, qos_profile=EVENTS)
    canceller = bench.client.create_client(CancelGoal, f"{ACTION}/_action/cancel_goal")
    bench.wait(lambda: all(c.service_is_ready() for c in (caller, canceller)) and client.server_is_ready())
    feedback: list[Any] = []
    sent = [client.send_goal_async(long_goal(), feedback.append) for _ in range(40)]
    handles = [bench.future(one) for one in sent]
    assert all(handle.accepted for handle in handles)
    results = [handle.get_result_async() for handle in handles]
    bench.wait(lambda: feedback and sum(r.done() for r in results) == 39)
    calls = [caller.call_async(request()) for _ in range(40)]
    assert {bench.future(one).status for one in calls} == {Response.BUSY}
    assert len(bench.future(canceller.call_async(CancelGoal.Request())).goals_canceling) == 1
    ends = sorted(bench.future(one).result.status for one in results)
    assert ends == [PlanAction.Result.BUSY] * 39 + [PlanAction.Result.CANCELLED]


def change(bench: Bench, which: int) -> bool:
    return bench.change_state("calibration_planner", which)


def test_inactive_it_says_so_and_activated_it_plans(bench: Bench) -> None:
    node = bench.start(PlannerNode, robot="planar_2r", starts=4, autostart=False)
    assert change(bench, Transition.TRANSITION_CONFIGURE)
    answer = bench.call(PlanCalibration, SERVICE, request())
    assert answer.status == Response.NOT_READY and "inactive" in answer.message
    handle = bench.goal(bench.action(PlanAction, ACTION), PlanAction.Goal(request=PlanRequest(test_poses=POSE)))
    result = bench.future(handle.get_result_async())
    assert result.status == GoalStatus.STATUS_ABORTED and result.result.status == PlanAction.Result.NOT_READY
    assert change(bench, Transition.TRANSITION_ACTIVATE)
    assert bench.call(PlanCalibration, SERVICE, request()).status == Response.SUCCESS
    assert change(bench, Transition.TRANSITION_DEACTIVATE) and change(bench, Transition.TRANSITION_CLEANUP)
    assert not list(node.get_parameters_by_prefix("none")) and node.state == "unconfigured"
    assert node.set_parameters([Parameter("robot", value="kuka_kr270")])[0].successful
    assert change(bench, Transition.TRANSITION_CONFIGURE) and change(bench, Transition.TRANSITION_ACTIVATE)
    answer = bench.call(PlanCalibration, SERVICE, request(test_poses=KUKA_POSE), 120.0)
    assert answer.plan.robot == "kuka_kr270"


def test_deactivating_ends_the_search(bench: Bench) -> None:
    bench.start(PlannerNode, robot="planar_2r", starts=20_000)
    feedback: list[Any] = []
    handle = bench.goal(bench.action(PlanAction, ACTION), long_goal(), feedback_callback=feedback.append)
    bench.wait(lambda: feedback)
    assert change(bench, Transition.TRANSITION_DEACTIVATE)
    result = bench.future(handle.get_result_async()).result
    assert result.status == PlanAction.Result.CANCELLED and len(result.plan.configurations) == 20


def publish(bench: Bench, text: str, until: Callable[[], Any]) -> None:
    """A robot description, from a latched publisher."""
    publisher = bench.client.create_publisher(String, "robot_description", LATCHED)
    publisher.publish(String(data=text))
    bench.wait(until)
    bench.client.destroy_publisher(publisher)


def test_the_robot_comes_over_the_wire(bench: Bench) -> None:
    node = bench.start(PlannerNode, robot="", starts=4)
    answer = bench.call(PlanCalibration, SERVICE, request())
    assert answer.status == Response.NOT_READY and "robot_description" in answer.message
    publish(bench, "<robot>" + "<a>" * 50_000, lambda: "refused" in str(node._source.model))
    answer = bench.call(PlanCalibration, SERVICE, request())
    assert answer.status == Response.NOT_READY and "well-formed" in answer.message
    publish(bench, urdf(3), lambda: isinstance(node._source.model, Model))
    answer = bench.call(PlanCalibration, SERVICE, request(test_poses=poses([0.1, 0.2, 0.3])))
    assert answer.status == Response.SUCCESS and answer.plan.robot == "wire"
    assert list(answer.plan.joint_names) == ["j0", "j1", "j2"]
    paths = bench.hear(JointTrajectory, "calibration_planner/trajectory", LATCHED)
    bench.wait(lambda: paths)
    assert paths[0].joint_names == ["j0", "j1", "j2"]
    answer = bench.call(PlanCalibration, SERVICE, request(robot="planar_2r"))
    assert answer.plan.robot == "planar_2r"


def test_a_bad_description_changes_nothing_after_a_good_one(bench: Bench) -> None:
    node = bench.start(PlannerNode, robot="planar_2r", starts=4)
    publish(bench, urdf(3), lambda: isinstance(node._source.model, Model) and node._source.model.robot.from_urdf)
    source, refused = node._source, []
    take = source.take

    def taking(text: str) -> Any:
        try:
            return take(text)
        except InputError as error:
            refused.append(error)
            raise

    source.take = taking
    publish(bench, urdf(10_000), lambda: refused)
    assert bench.call(PlanCalibration, SERVICE, request(test_poses=poses([0.1] * 3))).plan.robot == "wire"


def test_a_robot_by_name_stays_when_a_description_is_refused(bench: Bench) -> None:
    """Whoever sends rubbish does not take the planner out of service; every plan says what was refused."""
    node = bench.start(PlannerNode, robot="planar_2r", starts=4)
    publish(bench, "<robot", lambda: node._source.refusal)
    answer = bench.call(PlanCalibration, SERVICE, request())
    assert answer.status == Response.SUCCESS and answer.plan.robot == "planar_2r"
    assert "well-formed" in answer.message and "planar_2r stays the robot" in answer.message
    named = bench.call(PlanCalibration, SERVICE, request(robot="planar_2r"))
    assert named.status == Response.SUCCESS and "refused" not in named.message
    publish(bench, urdf(3), lambda: not node._source.refusal)
    answer = bench.call(PlanCalibration, SERVICE, request(test_poses=poses([0.1] * 3)))
    assert answer.plan.robot == "wire" and "refused" not in answer.message


def test_a_description_can_be_ignored(bench: Bench) -> None:
    bench.start(PlannerNode, robot="planar_2r", use_robot_description=False)
    assert not bench.client.get_subscriptions_info_by_topic("/robot_description")


@pytest.mark.parametrize(("pose", "status"), [(POSE, "SUCCESS"), (poses([math.nan, 0.0]), "INVALID_REQUEST")])
def test_the_action_answers_like_the_service(bench: Bench, pose: list[JointConfiguration], status: str) -> None:
    bench.start(PlannerNode, robot="planar_2r", starts=4)
    handle = bench.goal(bench.action(PlanAction, ACTION), PlanAction.Goal(request=PlanRequest(test_poses=pose)))
    result = bench.future(handle.get_result_async())
    good = status == "SUCCESS"
    assert result.status == (GoalStatus.STATUS_SUCCEEDED if good else GoalStatus.STATUS_ABORTED)
    assert result.result.status == getattr(PlanAction.Result, status)
    assert bool(result.result.plan.configurations) == good
