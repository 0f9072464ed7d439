# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Node parameters: declared once, the YAML files say the same, what is out of range is refused."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import yaml
from bench import Bench
from rclpy.exceptions import ParameterException
from rclpy.parameter import Parameter

from calib_planner.errors import InputError, UnknownNameError
from calib_planner.io import config_folder
from calib_planner.ros import settings as parameter_yaml
from calib_planner.ros.model import load_shipped
from calib_planner.ros.nodes.campaign import CampaignNode
from calib_planner.ros.nodes.executor import ExecutorNode
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.nodes.planner import PlannerNode
from calib_planner.ros.nodes.simulator import SimulatorNode
from calib_planner.ros.parameters import descriptor
from calib_planner.ros.settings import (
    CampaignParameters,
    ExecutorParameters,
    IdentifierParameters,
    PlannerParameters,
    SimulatorParameters,
)

NODES = [
    ("planner", PlannerParameters, PlannerNode),
    ("identifier", IdentifierParameters, IdentifierNode),
    ("simulator", SimulatorParameters, SimulatorNode),
    ("campaign", CampaignParameters, CampaignNode),
    ("executor", ExecutorParameters, ExecutorNode),
]


@pytest.mark.parametrize("name", parameter_yaml.NODES)
def test_the_yaml_is_what_the_dataclass_says(name: str) -> None:
    text = (config_folder() / f"{name}.yaml").read_text()
    assert text == parameter_yaml.yaml_text(name), "run: python -m calib_planner.ros.settings"


@pytest.mark.parametrize(("name", "kind", "_node"), NODES)
def test_yaml_holds_every_parameter_at_its_default(name: str, kind: Any, _node: Any) -> None:
    assert parameter_yaml.NODES[name][0] is kind
    path = config_folder() / f"{name}.yaml"
    values = yaml.safe_load(path.read_text())["/**"]["ros__parameters"]
    wanted = {f.name: getattr(kind(), f.name) for f in fields(kind)}
    wanted = {k: list(v) if isinstance(v, tuple) else v for k, v in wanted.items()}
    assert values == wanted
    assert {k: type(v) for k, v in values.items()} == {k: type(v) for k, v in wanted.items()}
    lines = path.read_text().splitlines()
    for f in fields(kind):
        at = next(i for i, line in enumerate(lines) if line.startswith(f"    {f.name}:"))
        assert lines[at - 1].strip().startswith("# "), f"{f.name} has no comment"


@pytest.mark.parametrize(("_name", "kind", "_node"), NODES)
def test_every_parameter_is_described(_name: str, kind: Any, _node: Any) -> None:
    for f in fields(kind):
        found = descriptor(f)
        assert found.description
        number = isinstance(f.default, (int, float)) and not isinstance(f.default, bool)
        assert bool(found.floating_point_range or found.integer_range) == number, f.name


@pytest.mark.parametrize(("name", "kind", "node"), NODES)
def test_nodes_take_the_yaml(bench: Bench, name: str, kind: Any, node: Any) -> None:
    values = yaml.safe_load((config_folder() / f"{name}.yaml").read_text())["/**"]["ros__parameters"]
    made = bench.start(node, **values)
    assert made.settings.value == kind()
    assert {f.name for f in fields(kind)} <= set(made.get_parameters_by_prefix(""))


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("sigma", -1.0, "range"),
        ("sigma", float("nan"), "range|finite"),
        ("configurations", 0, "range"),
        ("robot", "kuka_kr270", "deactivate and cleanup"),
        ("autostart", False, "read-only"),
        ("unknown", "everything", "base, tool"),
        ("criterion", "none", "test_pose"),
        ("criterion", "x" * 100_000, "at most|one of"),
        ("sigma", "a", "[Ww]rong parameter type|type"),
    ],
)
def test_bad_values_are_refused_with_a_reason(bench: Bench, name: str, value: Any, reason: str) -> None:
    node = bench.start(PlannerNode, robot="planar_2r")
    before = node.settings.value
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert re.search(reason, result.reason), result.reason
    assert node.settings.value == before


def test_good_values_are_followed(bench: Bench) -> None:
    node = bench.start(PlannerNode, robot="planar_2r")
    (result,) = node.set_parameters([Parameter("sigma", value=1e-4)])
    assert result.successful and node.settings.value.sigma == 1e-4


@pytest.mark.parametrize(
    ("node", "values"),
    [
        (PlannerNode, {"sigma": 7.0}),
        (PlannerNode, {"sigma": 1}),
        (PlannerNode, {"sigma": math.nan}),
        (PlannerNode, {"unknown": "everything"}),
        (PlannerNode, {"sigma": "a"}),
        (IdentifierNode, {"minimum_samples": 30}),
        (SimulatorNode, {"dropout_probability": 1.5}),
        (SimulatorNode, {"outlier_smallest": 0.2}),
        (SimulatorNode, {"instrument": "../laser_tracker"}),
    ],
)
def test_a_bad_start_is_refused(bench: Bench, node: Any, values: dict[str, Any]) -> None:
    with pytest.raises((InputError, ParameterException)) as caught:
        bench.start(node, **values)
    assert str(caught.value)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("robt", "planar_2r", ["robt", "did you mean 'robot'"]),
        ("Sigma", 1e-5, ["Sigma", "did you mean 'sigma'"]),
        ("sigma", 1, ["sigma", "a number with a decimal point", "write 1.0"]),
        ("sigma", 7.0, ["sigma", "7.0", "1e-09 to 1 m"]),
        ("configurations", 0, ["configurations", "0", "1 to 10000"]),
        ("criterion", "dd", ["criterion", "did you mean 'd'"]),
        ("qos_override./a.publisher.depth", 3, ["qos_override", "valid names"]),
        ("use_sim_tim", True, ["did you mean 'use_sim_time'"]),
    ],
)
def test_a_bad_start_says_what_is_wrong(bench: Bench, name: str, value: Any, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        bench.start(PlannerNode, **{name: value})
    assert all(word in str(caught.value) for word in words), caught.value


def test_what_ros_declares_itself_is_allowed(bench: Bench) -> None:
    others = {
        "use_sim_time": True,
        "start_type_description_service": False,
        "qos_overrides./x.publisher.depth": 3,
    }
    node = bench.start(PlannerNode, robot="planar_2r", **others)
    assert node.is_active and node.get_parameter("use_sim_time").value


def test_two_topics_need_an_unknown_tool_in_the_node_too(bench: Bench) -> None:
    node = bench.start(IdentifierNode, tracker_topics=["a", "b"])
    assert node.state == "unconfigured" and "set unknown to tool" in node.failure


@pytest.mark.parametrize("values", [{"robot": "none"}, {"robot": "/etc/passwd"}, {"parameters": "none"}])
def test_what_cannot_be_configured_is_said(bench: Bench, values: dict[str, Any]) -> None:
    node = bench.start(PlannerNode, **values)
    assert node.state == "unconfigured" and next(iter(values)) in node.failure


def test_a_file_with_an_unknown_name_ends_the_process(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("/**:\n  ros__parameters:\n    sigm: 0.001\n")
    command = [sys.executable, "-m", "calib_planner.ros.nodes.planner", "--ros-args", "--params-file", str(path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert ended.returncode == 1 and "did you mean 'sigma'" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_given_deviations() -> None:
    settings = SimulatorParameters(true_deviations="d1=0.0005, q2=-0.001")
    assert settings.deviations(["d1", "q2"]) == {"d1": 5e-4, "q2": -1e-3}


def test_two_targets_need_an_unknown_tool() -> None:
    robot = load_shipped("kuka_kr270", "offsets", "base,tool", 2)
    assert len(robot.targets) == 2 and "target_2.x" in robot.parameter_names
    with pytest.raises(UnknownNameError):
        load_shipped("~/robot.yaml", "offsets")
