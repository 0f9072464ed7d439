"""Node parameters: declared once, the YAML files say the same, what is out of range is refused."""

from __future__ import annotations

import re
from dataclasses import fields
from typing import Any

import pytest
import yaml
from bench import Bench
from rclpy.exceptions import ParameterException
from rclpy.parameter import Parameter

from calib_planner.errors import InputError, UnknownNameError
from calib_planner.robot.catalogue import config_folder
from calib_planner.ros.identifier_node import IdentifierNode
from calib_planner.ros.parameters import descriptor
from calib_planner.ros.planner_node import PlannerNode
from calib_planner.ros.settings import (
    IdentifierParameters,
    PlannerParameters,
    SimulatorParameters,
    load_shipped,
)
from calib_planner.ros.simulator_node import SimulatorNode

NODES = [
    ("planner", PlannerParameters, PlannerNode),
    ("identifier", IdentifierParameters, IdentifierNode),
    ("simulator", SimulatorParameters, SimulatorNode),
]


@pytest.mark.parametrize(("name", "kind", "_node"), NODES)
def test_yaml_holds_every_parameter_at_its_default(name: str, kind: Any, _node: Any) -> None:
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
        ("robot", "kuka_kr270", "read-only"),
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
        (PlannerNode, {"robot": "none"}),
        (PlannerNode, {"robot": "/etc/passwd"}),
        (PlannerNode, {"parameters": "none"}),
        (PlannerNode, {"sigma": "a"}),
        (IdentifierNode, {"minimum_samples": 30}),
        (IdentifierNode, {"tracker_topics": ["a", "b"]}),
        (SimulatorNode, {"true_deviations": "none=1"}),
        (SimulatorNode, {"true_deviations": "d1=nan"}),
        (SimulatorNode, {"true_deviations": "d1"}),
    ],
)
def test_a_bad_start_is_refused(bench: Bench, node: Any, values: dict[str, Any]) -> None:
    with pytest.raises((InputError, ParameterException)) as caught:
        bench.start(node, **values)
    assert str(caught.value)


def test_given_deviations() -> None:
    settings = SimulatorParameters(true_deviations="d1=0.0005, q2=-0.001")
    assert settings.deviations(["d1", "q2"]) == {"d1": 5e-4, "q2": -1e-3}


def test_two_targets_need_an_unknown_tool() -> None:
    robot = load_shipped("kuka_kr270", "offsets", "base,tool", 2)
    assert len(robot.targets) == 2 and "target_2.x" in robot.parameter_names
    with pytest.raises(UnknownNameError):
        load_shipped("~/robot.yaml", "offsets")
