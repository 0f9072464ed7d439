# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Requests to answers, without a node: every bad one names its field."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from calib_planner_msgs.action import PlanCalibration as PlanAction
from calib_planner_msgs.msg import PlanRequest
from calib_planner_msgs.srv import PlanCalibration
from poses import poses
from robots import random_configurations

from calib_planner import PlanProblem, Robot, plan
from calib_planner.errors import InputError
from calib_planner.planning import Search, timetable
from calib_planner.ros.messages import duration_message, rows_message, trajectory_message
from calib_planner.ros.model import NotReady, described_model, shipped_model
from calib_planner.ros.planning import answer, plan_pace
from calib_planner.ros.settings import PlannerParameters

SETTINGS = PlannerParameters(robot="planar_2r", starts=4, configurations=4, most_configurations=50)
OWN = shipped_model("planar_2r", "lengths+offsets", "")
POSE = poses([0.3, 0.5])

BAD: list[tuple[dict[str, Any], str, str]] = [
    ({"test_poses": []}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": poses([0.1])}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": poses([0.1, 0.2], [0.3])}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": poses([math.nan, 0.0])}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": poses([math.inf, 0.0])}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": poses([30.0, 0.0])}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": poses([0.0, 0.0]) * 2000}, "INVALID_REQUEST", "test_poses"),
    ({"test_poses": poses([0.0] * 100_000)}, "INVALID_REQUEST", "test_poses"),
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
    ({"sigma": 1e-300}, "INVALID_REQUEST", "sigma"),
    ({"time_budget": Duration(sec=-(2**31))}, "INVALID_REQUEST", "time_budget"),
    ({"error_model": "/etc/passwd"}, "INVALID_REQUEST", "error_model"),
    ({"accuracy_frame": "moon"}, "INVALID_REQUEST", "accuracy_frame"),
    ({"candidates": poses([0.1, 100.0]) * 9}, "INVALID_REQUEST", "candidates"),
    ({"time_limit": Duration(sec=-1)}, "INVALID_REQUEST", "time_limit"),
    ({"time_limit": duration_message(math.inf)}, "INVALID_REQUEST", "time_limit"),
    ({"candidates": poses([0.1, 0.2], [0.3])}, "INVALID_REQUEST", "candidates"),
    ({"candidates": poses([0.1, math.nan]) * 9}, "INVALID_REQUEST", "candidates"),
    ({"candidates": poses([0.1, 0.2])}, "INVALID_REQUEST", "candidates"),
    ({"candidates": poses([0.1, 0.2]) * 2001}, "INVALID_REQUEST", "candidates"),
    ({"candidates": poses([0.1] * 100_000)}, "INVALID_REQUEST", "candidates"),
    ({"configurations": 1}, "INFEASIBLE", "configurations"),
]


def identifier(case: Any) -> str:
    return str(case)[:40]


def test_a_long_chain_and_many_configurations_are_refused_before_memory_is() -> None:
    settings = replace(SETTINGS, most_configurations=10_000)
    request = PlanRequest(test_poses=poses([0.1] * 60), configurations=51)
    found = answer(request, settings, described_model(urdf(60)))
    assert (found.status, found.field) == ("INVALID_REQUEST", "configurations") and "at most 50" in found.message


@pytest.mark.parametrize(("change", "status", "field"), BAD, ids=identifier)
def test_bad_requests(change: dict[str, Any], status: str, field: str) -> None:
    request = PlanRequest(**({"test_poses": POSE} | change))
    found = answer(request, SETTINGS, OWN)
    assert (found.status, found.field) == (status, field), found.message
    assert found.plan is None and 10 < len(found.message) < 2000
    assert hasattr(PlanCalibration.Response, found.status)


def test_defaults_and_seed() -> None:
    request = PlanRequest(test_poses=POSE, seed=3)
    a, b = answer(request, SETTINGS, OWN), answer(request, SETTINGS, OWN)
    assert a.status == "SUCCESS" and a.plan is not None and b.plan is not None
    assert len(a.plan.configurations) == 4 and a.plan.sigma == SETTINGS.sigma
    assert (a.plan.configurations == b.plan.configurations).all()


def test_another_shipped_robot() -> None:
    pose = list(Robot.load("kuka_kr270").joint_limits.mean(axis=1))
    request = PlanRequest(robot="kuka_kr270", test_poses=poses(pose), configurations=3)
    found = answer(request, SETTINGS, OWN)
    assert found.plan is not None and found.plan.robot == "kuka_kr270"


def test_cancelling_returns_the_best_so_far() -> None:
    goal = PlanRequest(test_poses=POSE, configurations=20)
    found = answer(goal, SETTINGS, OWN, lambda state: state.starts_done > 0)
    assert found.status == "CANCELLED" and found.plan is not None
    assert hasattr(PlanAction.Result, found.status)


def test_a_plan_for_a_time_keeps_it_unless_the_request_says_how_many() -> None:
    settings = replace(SETTINGS, time_budget=200.0, joint_speed=0.2)
    request = PlanRequest(test_poses=POSE)
    own = answer(request, settings, OWN)
    assert own.plan is not None and own.plan.measurements > len(own.plan.configurations)
    pace = plan_pace(settings, OWN)
    assert 180.0 < timetable(own.plan, OWN.robot, pace).seconds <= 200.0
    points = trajectory_message(own.plan, OWN.robot, pace, "base").points
    assert points[-1].time_from_start.sec <= 200
    asked = PlanRequest(test_poses=POSE, time_budget=duration_message(200.0))
    same = answer(asked, replace(settings, time_budget=0.0), OWN).plan
    assert same is not None and (same.configurations == own.plan.configurations).all()
    counted = answer(PlanRequest(test_poses=POSE, configurations=3), settings, OWN).plan
    assert counted is not None and counted.measurements == 3
    told = answer(request, replace(settings, time_budget=5.0), OWN)
    assert told.status == "INFEASIBLE" and "too short" in told.message
    stopped = answer(request, settings, OWN, lambda state: state.starts_done > 0)
    assert stopped.status == "CANCELLED" and stopped.plan is not None


def test_it_is_the_library_s_plan() -> None:
    request = PlanRequest(test_poses=POSE, seed=9)
    found = answer(request, SETTINGS, OWN)
    wanted = plan(PlanProblem(OWN.robot, [[0.3, 0.5]], 4, noise=SETTINGS.sigma, search=Search(starts=4, seed=9)))
    assert found.plan is not None
    np.testing.assert_array_equal(found.plan.configurations, wanted.configurations)
    assert found.plan.quality.predicted_accuracy == wanted.quality.predicted_accuracy


def test_candidates_are_chosen_among() -> None:
    pool = random_configurations(OWN.robot, 40, 3)
    request = PlanRequest(test_poses=POSE, candidates=rows_message(pool))
    found = answer(request, SETTINGS, OWN).plan
    assert found is not None
    assert all((pool == q).all(axis=1).any() for q in found.configurations)
    assert len(np.unique(found.configurations, axis=0)) == 4


@pytest.mark.parametrize("scale", [1e-300, 1.0, 1e308])
def test_only_relative_weights_matter(scale: float) -> None:
    request = PlanRequest(test_poses=[*POSE, *poses([-0.4, 1.0])], test_pose_weights=[scale, 0.5 * scale])
    found = answer(request, SETTINGS, OWN).plan
    assert found is not None
    np.testing.assert_allclose(found.weights, [2 / 3, 1 / 3], rtol=1e-12)


def test_without_a_robot_only_shipped_ones() -> None:
    nobody = NotReady("no robot yet: publish one")
    found = answer(PlanRequest(test_poses=POSE), SETTINGS, nobody)
    assert (found.status, found.field) == ("NOT_READY", "robot") and "publish one" in found.message
    found = answer(PlanRequest(test_poses=POSE, robot="planar_2r"), SETTINGS, nobody)
    assert found.status == "SUCCESS"


# ── constraints ──────────────────────────────────────────────────────────────────────────────────────


def with_constraints(folder: Path, name: str) -> PlannerParameters:
    return replace(SETTINGS, constraints_folder=str(folder), constraints=name)


def test_constraints_are_kept(tmp_path: Path) -> None:
    joint = OWN.robot.joint_names[1]
    (tmp_path / "cell.yaml").write_text(f"joint_range: {{{joint}: [0.2, 0.4]}}\n")
    found = answer(PlanRequest(test_poses=POSE), with_constraints(tmp_path, "cell.yaml"), OWN).plan
    assert found is not None
    assert (found.configurations[:, 1] >= 0.2).all() and (found.configurations[:, 1] <= 0.4).all()


@pytest.mark.parametrize(
    "name",
    ["../secret.yaml", "/etc/passwd", "sub/../cell.yaml", "..", ".", "link.yaml", "none.yaml", "a\0b", "sub"],
)
def test_no_name_leads_out_of_the_folder(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "folder"
    (folder / "sub").mkdir(parents=True)
    (tmp_path / "secret.yaml").write_text("password: 1\n")
    (folder / "cell.yaml").write_text("workspace: {low: [-9, -9, -9], high: [9, 9, 9]}\n")
    (folder / "link.yaml").symlink_to(tmp_path / "secret.yaml")
    found = answer(PlanRequest(test_poses=POSE), with_constraints(folder, name), OWN)
    assert (found.status, found.field) == ("INVALID_REQUEST", "constraints")
    assert "password" not in found.message and "root:" not in found.message


def test_a_file_with_tags_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text("workspace: !!python/object/apply:os.system ['touch /tmp/never']\n")
    found = answer(PlanRequest(test_poses=POSE), with_constraints(tmp_path, "cell.yaml"), OWN)
    assert found.status == "INVALID_REQUEST" and "cell.yaml" in found.message


# ── robots from the wire ─────────────────────────────────────────────────────────────────────────────


def urdf(joints: int, *, inside: str = "", limit: str = 'velocity="2.0"') -> str:
    """A chain of turning joints."""
    links = "".join(f'<link name="l{i}"/>' for i in range(joints + 1))
    axes = ("0 0 1", "0 1 0", "1 0 0")
    parts = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<origin xyz="0.1 0 0.4"/><axis xyz="{axes[i % 3]}"/><limit lower="-2" upper="2" {limit}/></joint>'
        for i in range(joints)
    )
    return f'<robot name="wire">{links}{parts}{inside}</robot>'


def test_a_described_robot_is_planned_for() -> None:
    model = described_model(urdf(3))
    assert model.robot.from_urdf and model.speeds.tolist() == [2.0] * 3
    found = answer(PlanRequest(test_poses=poses([0.1, 0.2, 0.3])), SETTINGS, model)
    assert found.status == "SUCCESS" and found.plan is not None and found.plan.joint_names == ("j0", "j1", "j2")
    assert np.isinf(described_model(urdf(3, limit="")).speeds).all()


def test_the_chain_is_chosen() -> None:
    assert described_model(urdf(5), "l1", "l4").robot.joint_names == ("j1", "j2", "j3")
    with pytest.raises(InputError, match="tip_link"):
        described_model(urdf(5), "l1", "none")


BOMB = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 10))
HOSTILE = {
    "empty": "",
    "no XML": "hello",
    "NUL": urdf(2).replace("wire", "wi\0re"),
    "bomb": f'<!DOCTYPE r [<!ENTITY a0 "x">{BOMB}]>' + urdf(2).replace("wire", "&a9;"),
    "external": '<!DOCTYPE r [<!ENTITY e SYSTEM "file:///etc/passwd">]>' + urdf(2).replace("wire", "&e;"),
    "hidden": '<?xml version="1.0" encoding="utf-7"?>+ADwAIQ-DOCTYPE r>' + urdf(2),
    "joints": urdf(10_000),
    "chain": urdf(200),
    "size": urdf(2, inside="<!-- " + "x" * 5_000_000 + " -->"),
    "depth": "<robot>" + "<a>" * 200_000 + "</a>" * 200_000 + "</robot>",
    "open": "<robot>" + "<a>" * 200_000,
    "numbers": urdf(2).replace('xyz="0.1 0 0.4"', 'xyz="nan 0 1e999"'),
    "limits": urdf(2).replace('lower="-2"', 'lower="3"'),
    "name": urdf(2).replace('name="wire"', f'name="{"x" * 5000}"'),
    "control": urdf(2).replace('name="wire"', 'name="a&#10;b"'),
    "doubled": urdf(2).replace('name="j1"', 'name="j0"'),
    "xacro": '<robot name="x"><xacro:include filename="/etc/passwd"/><xacro:arm name="a"/></robot>',
    "expression": urdf(2).replace('xyz="0.1 0 0.4"', 'xyz="${a} 0 0.4"'),
    "infinite limits": urdf(2).replace('lower="-2" upper="2"', 'lower="-inf" upper="inf"'),
    "mimic": urdf(2).replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><mimic joint="j0" multiplier="1e300"/>'),
    "loop": urdf(2, inside='<joint name="x" type="fixed"><parent link="l2"/><child link="l0"/></joint>'),
    "velocity": urdf(2, limit='velocity="fast"'),
}


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_description_is_refused_with_a_reason(text: str) -> None:
    with pytest.raises(InputError) as caught:
        described_model(text)
    assert "robot_description" in str(caught.value) and "root:" not in str(caught.value)


def test_leftovers_of_xacro_beside_a_chain_are_never_followed(tmp_path: Path) -> None:
    """As the reader of files does, where the chain is sound as it stands; nothing is opened or evaluated."""
    (tmp_path / "more.xacro").write_text('<robot><link name="extra"/></robot>')
    inside = f'<xacro:include filename="{tmp_path}/more.xacro"/><xacro:property name="a" value="${{1/0}}"/>'
    model, plain = described_model(urdf(2, inside=inside)), described_model(urdf(2))
    assert model.robot.joint_names == plain.robot.joint_names
    np.testing.assert_array_equal(model.robot.positions([0.1, 0.2]), plain.robot.positions([0.1, 0.2]))


@pytest.mark.parametrize("limit", ["1e9", "1e300"])
def test_absurd_limits_of_a_turning_joint_are_a_turn(limit: str) -> None:
    text = urdf(2).replace('lower="-2" upper="2"', f'lower="-{limit}" upper="{limit}"')
    np.testing.assert_array_equal(described_model(text).robot.joint_limits, [[-np.pi, np.pi]] * 2)
