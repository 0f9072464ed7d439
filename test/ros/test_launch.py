"""Launch files: they name what exists, explain every argument and start our nodes only.

launch is not among the PyPI wheels: ``Recorded`` stands in for everything of it, and keeps what it was made with.
"""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from dataclasses import fields
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.node import Node

from calib_planner.io import config_folder
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.nodes.planner import PlannerNode
from calib_planner.ros.nodes.simulator import SimulatorNode
from calib_planner.ros.settings import (
    CampaignParameters,
    IdentifierParameters,
    PlannerParameters,
    SimulatorParameters,
)

FOLDER = config_folder().parent / "launch"
FILES = sorted(FOLDER.glob("*.launch.py"))
NODES: dict[str, tuple[str, type]] = {
    "campaign": ("calibration_campaign", CampaignParameters),
    "planner": ("calibration_planner", PlannerParameters),
    "identifier": ("calibration_identifier", IdentifierParameters),
    "simulator": ("tracker_simulator", SimulatorParameters),
}
NAMES = {name for name, _ in NODES.values()}


def test_all_are_there() -> None:
    assert [p.name.split(".")[0] for p in FILES] == ["campaign", "demo", "identifier", "planner", "simulator"]
    assert all((PlannerNode, IdentifierNode, SimulatorNode))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_it_compiles_and_names_what_exists(path: Path) -> None:
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree)
    texts = [n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    assert NAMES & set(texts)
    for text in texts:
        if re.fullmatch(r"\w+\.yaml", text):
            assert (config_folder() / text).is_file()
        if re.fullmatch(r"\w+_node", text):
            assert importlib.util.find_spec(f"calib_planner.ros.nodes.{text.removesuffix('_node')}")


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_it_describes_nodes(path: Path) -> None:
    pytest.importorskip("launch_ros", reason="launch is not among the PyPI wheels")
    assert load(path).generate_launch_description().entities


class Recorded:
    """Stands for any class of launch."""

    def __init__(self, *args: Any, **named: Any) -> None:
        self.args, self.named = args, named


class Argument(Recorded):
    """A declared argument."""

    @property
    def name(self) -> str:
        return str(self.args[0])


class Started(Recorded):
    """A node."""


class Value(Recorded):
    """A LaunchConfiguration."""

    def perform(self, context: Any) -> str:
        return str(context.values[self.args[0]])


def load(path: Path) -> Any:
    sys.modules.pop("calib_planner.ros.launching", None)  # it is made of launch, or of what stands in for it
    spec = importlib.util.spec_from_file_location("launched", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    special = {"DeclareLaunchArgument": Argument, "Node": Started, "LaunchConfiguration": Value}
    for name in ("actions", "conditions", "substitutions", "parameter_descriptions"):
        for package in ("launch", "launch_ros"):
            module: Any = ModuleType(f"{package}.{name}")
            module.__getattr__ = lambda attribute: special.get(attribute, Recorded)
            monkeypatch.setitem(sys.modules, f"{package}.{name}", module)
    root: Any = ModuleType("launch")
    root.__getattr__ = lambda attribute: Recorded
    monkeypatch.setitem(sys.modules, "launch", root)
    monkeypatch.setitem(sys.modules, "launch_ros", ModuleType("launch_ros"))


def described(path: Path, **given: str) -> tuple[dict[str, Argument], list[Started]]:
    """Arguments by name and nodes, those of opaque functions with what is given, else the arguments' defaults."""
    entities = load(path).generate_launch_description().args[0]
    arguments = {e.name: e for e in entities if isinstance(e, Argument)}
    defaults = {n: a.named["default_value"] for n, a in arguments.items()}
    context = SimpleNamespace(values=defaults | given)
    nodes = [e for e in entities if isinstance(e, Started)]
    for entity in entities:
        if "function" in getattr(entity, "named", {}):
            nodes += entity.named["function"](context, *entity.named["args"])
    return arguments, nodes


def used(thing: Any) -> set[str]:
    """Names of the arguments that something is made of."""
    if isinstance(thing, Value):
        return {str(thing.args[0])}
    if isinstance(thing, Recorded):
        return used([*thing.args, *thing.named.values()])
    parts = thing.values() if isinstance(thing, dict) else thing if isinstance(thing, (list, tuple)) else ()
    return {name for part in parts for name in used(part)}


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_arguments_are_explained_and_used(path: Path, stand_ins: None) -> None:
    arguments, nodes = described(path)
    assert {"namespace"} <= set(arguments)
    for name, argument in arguments.items():
        assert len(argument.named["description"]) > 8, name
        choices = argument.named.get("choices")
        assert choices is None or argument.named["default_value"] in choices, name
        assert (choices == ["", "true", "false"]) == (name in ("autostart", "use_sim_time")), name
    mentioned = used(nodes)
    assert mentioned <= set(arguments)
    opaque = set(getattr(load(path), "KINDS", ()))
    assert set(arguments) - mentioned <= opaque


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_nodes_are_ours_with_parameters_they_have(path: Path, stand_ins: None) -> None:
    _, nodes = described(path)
    ours = {n.named["executable"]: n for n in nodes if n.named["package"] == "calib_planner"}
    assert ours
    for executable, node in ours.items():
        part = executable.removesuffix("_node")
        assert node.named["name"] == NODES[part][0]
        assert importlib.util.find_spec(f"calib_planner.ros.nodes.{part}")
        known = {f.name for f in fields(NODES[part][1])} | {"use_sim_time"}
        assert (config_folder() / f"{part}.yaml").is_file()
        for parameters in node.named["parameters"]:
            assert not isinstance(parameters, dict) or set(parameters) <= known


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_rviz_is_asked_for(path: Path, stand_ins: None) -> None:
    arguments, nodes = described(path)
    for node in (n for n in nodes if n.named["package"] != "calib_planner"):
        assert node.named["package"] == "rviz2" and used(node.named["condition"]) == {"rviz"}
        assert arguments["rviz"].named["default_value"] == "false"


GIVEN = {"robot": "ur10e", "seed": "7", "store_folder": "/given", "autostart": "true", "use_sim_time": "false"}
WRITTEN = {"robot": "planar_2r", "seed": 3, "store_folder": "/file", "autostart": False, "use_sim_time": True}


def in_force(folder: Path, node: Started, written: dict[str, Any]) -> dict[str, Any]:
    """Parameters that a node has when it is started so: files as launch_ros passes them, merged by ROS itself."""
    words, name = ["--ros-args"], node.named["name"]
    for k, entry in enumerate(node.named["parameters"]):
        path = folder / f"{k}.yaml"
        if isinstance(entry, dict):
            path.write_text(yaml.safe_dump({f"/{name}": {"ros__parameters": entry}}))
        elif isinstance(entry, Value):
            path.write_text(yaml.safe_dump({"/**": {"ros__parameters": written}}))
        else:
            path = config_folder() / entry.args[0][-1]
        words += ["--params-file", str(path)]
    context = Context()
    rclpy.init(args=words, context=context)
    made = Node(name, context=context, automatically_declare_parameters_from_overrides=True)
    try:
        return {k: p.value for k, p in made.get_parameters_by_prefix("").items() if k in written}
    finally:
        made.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("path", [p for p in FILES if "demo" not in p.name], ids=lambda p: p.name)
def test_arguments_win_if_given_else_the_file_of_the_user(path: Path, stand_ins: None, tmp_path: Path) -> None:
    kinds = load(path).KINDS
    written = {name: WRITTEN[name] for name in kinds}
    for given in ({}, *({name: GIVEN[name]} for name in kinds), {name: GIVEN[name] for name in kinds}):
        (node,) = (n for n in described(path, **given)[1] if n.named["package"] == "calib_planner")
        expected = written | {name: yaml.safe_load(text) for name, text in given.items()}
        assert in_force(tmp_path, node, written) == expected
