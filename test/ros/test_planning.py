"""Requests to answers, without a node: every bad one names its field."""

from __future__ import annotations

import math
from typing import Any

import pytest
from calib_planner_msgs.action import PlanCalibration as PlanAction
from calib_planner_msgs.srv import PlanCalibration

from calib_planner import Robot
from calib_planner.ros.planning import answer
from calib_planner.ros.settings import PlannerParameters, load_shipped

SETTINGS = PlannerParameters(robot="planar_2r", starts=4, configurations=4, most_configurations=50)
OWN = load_shipped("planar_2r", "lengths+offsets")
POSE = [0.3, 0.5]

BAD: list[tuple[dict[str, Any], str, str]] = [
    ({"test_poses": []}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": [0.1]}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": [0.1, 0.2, 0.3]}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": [math.nan, 0.0]}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": [math.inf, 0.0]}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": [30.0, 0.0]}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": [0.0] * 4000}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": [0.0] * 100_000}, "INVALID_REQUEST", "test_poses"),
    ({"test_pose_weights": [1.0, 1.0]}, "INVALID_REQUEST", "test_pose_weights"),
    ({"test_pose_weights": [-1.0]}, "INVALID_REQUEST", "test_pose_weights"),
    ({"test_pose_weights": [0.0]}, "INVALID_REQUEST", "test_pose_weights"),
    ({"test_pose_weights": [math.nan]}, "INVALID_REQUEST", "test_pose_weights"),
    ({"robot": "no_such_robot"}, "INVALID_REQUEST", "robot"),
    ({"robot": "/etc/passwd"}, "INVALID_REQUEST", "robot"),
    ({"robot": "../config/robots/planar_2r.yaml"}, "INVALID_REQUEST", "robot"),
    ({"parameters": ["no_such"]}, "INVALID_REQUEST", "parameters"),
    ({"parameters": ["l1", "l1"]}, "INVALID_REQUEST", "parameters"),
    ({"parameters": ["l1"] * 2000}, "INVALID_REQUEST", "parameters"),
    ({"criterion": "no_such"}, "INVALID_REQUEST", "criterion"),
    ({"configurations": 51}, "INVALID_REQUEST", "configurations"),
    ({"configurations": 2**32 - 1}, "INVALID_REQUEST", "configurations"),
    ({"repetitions": 2**32 - 1}, "INVALID_REQUEST", "repetitions"),
    ({"sigma": -1.0}, "INVALID_REQUEST", "sigma"),
    ({"sigma": math.nan}, "INVALID_REQUEST", "sigma"),
    ({"sigma": 5.0}, "INVALID_REQUEST", "sigma"),
    ({"time_limit": -1.0}, "INVALID_REQUEST", "time_limit"),
    ({"time_limit": math.inf}, "INVALID_REQUEST", "time_limit"),
    ({"configurations": 1}, "INFEASIBLE", "configurations"),
]


def identifier(case: Any) -> str:
    return str(case)[:40]


@pytest.mark.parametrize(("change", "status", "field"), BAD, ids=identifier)
def test_bad_requests(change: dict[str, Any], status: str, field: str) -> None:
    request = PlanCalibration.Request(**({"test_poses": POSE} | change))
    found = answer(request, SETTINGS, OWN)
    assert (found.status, found.field) == (status, field), found.message
    assert found.plan is None and 10 < len(found.message) < 2000
    assert hasattr(PlanCalibration.Response, found.status)


def test_defaults_and_seed() -> None:
    request = PlanCalibration.Request(test_poses=POSE, seed=3)
    a, b = answer(request, SETTINGS, OWN), answer(request, SETTINGS, OWN)
    assert a.status == "SUCCESS" and a.plan is not None and b.plan is not None
    assert len(a.plan.configurations) == 4 and a.plan.sigma == SETTINGS.sigma
    assert (a.plan.configurations == b.plan.configurations).all()


def test_another_shipped_robot() -> None:
    pose = list(Robot.load("kuka_kr270").joint_limits.mean(axis=1))
    request = PlanCalibration.Request(robot="kuka_kr270", test_poses=pose, configurations=3)
    found = answer(request, SETTINGS, OWN)
    assert found.plan is not None and found.plan.robot == "kuka_kr270"


def test_cancelling_returns_the_best_so_far() -> None:
    goal = PlanAction.Goal(test_poses=POSE, configurations=20)
    found = answer(goal, SETTINGS, OWN, lambda state: state.starts_done > 0)
    assert found.status == "CANCELLED" and found.plan is not None
    assert hasattr(PlanAction.Result, found.status)
