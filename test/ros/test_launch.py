# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Launch files: they name what exists, explain every argument and start our nodes only.

launch is not among the PyPI wheels: ``Recorded`` stands in for everything of it, and keeps what it was made with.
"""

from __future__ import annotations

import ast
import importlib.util
import sys
from dataclasses import fields
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.node import Node

from calib_planner.errors import InputError
from calib_planner.io import config_folder
from calib_planner.ros.settings import NODES, CampaignParameters

FOLDER = config_folder().parent / "launch"
FILES = sorted(FOLDER.glob("*.launch.py"))
COMMON = {"namespace", "params_file", "robot", "autostart", "use_sim_time"}
"""Arguments of every launch file."""


def test_all_are_there() -> None:
    names = [p.name.split(".")[0] for p in FILES]
    assert names == ["campaign", "demo", "executor", "identifier", "planner", "simulator"]


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_it_compiles_and_names_what_exists(path: Path) -> None:
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree)
    texts = [n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    for text in texts:
        if text in NODES:
            assert (config_folder() / f"{text}.yaml").is_file()
            assert importlib.util.find_spec(f"calib_planner.ros.nodes.{text}")


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
    for name in ("actions", "conditions", "substitutions"):
        for package in ("launch", "launch_ros"):
            module: Any = ModuleType(f"{package}.{name}")
            module.__getattr__ = lambda attribute: special.get(attribute, Recorded)
            monkeypatch.setitem(sys.modules, f"{package}.{name}", module)
    root: Any = ModuleType("launch")
    root.__getattr__ = lambda attribute: Recorded
    monkeypatch.setitem(sys.modules, "launch", root)
    silent: Any = ModuleType("launch.logging")
    silent.get_logger = lambda name: SimpleNamespace(warning=lambda text: None)
    monkeypatch.setitem(sys.modules, "launch.logging", silent)
    monkeypatch.setitem(sys.modules, "launch_ros", ModuleType("launch_ros"))


def described(path: Path, **given: str) -> tuple[dict[str, Argument], list[Started]]:
    """Arguments by name and nodes, those of opaque functions with what is given, else the arguments' defaults."""
    entities = load(path).generate_launch_description().args[0]
    arguments = {e.name: e for e in entities if isinstance(e, Argument)}
    defaults = {n: a.named["default_value"] for n, a in arguments.items()}
    context = SimpleNamespace(values=defaults | given, launch_configurations=defaults | given)
    nodes = [e for e in entities if isinstance(e, Started)]
    for entity in entities:
        if "function" in getattr(entity, "named", {}):
            nodes += entity.named["function"](context)
    return arguments, nodes


def used(thing: Any) -> set[str]:
    """Names of the arguments that something is made of."""
    if isinstance(thing, Value):
        return {str(thing.args[0])}
    if isinstance(thing, Recorded):
        return used([*thing.args, *thing.named.values()])
    parts = thing.values() if isinstance(thing, dict) else thing if isinstance(thing, (list, tuple)) else ()
    return {name for part in parts for name in used(part)}


def ours(nodes: list[Started]) -> dict[str, Started]:
    """Part → node, of those of this package."""
    mine = [n for n in nodes if n.named["package"] == "calib_planner"]
    return {n.named["executable"].removesuffix("_node"): n for n in mine}


def parameters_of(node: Started) -> set[str]:
    """Names of the parameters that are given to a node beside its files."""
    return {name for entry in node.named["parameters"] if isinstance(entry, dict) for name in entry}


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_arguments_are_explained_and_alike(path: Path, stand_ins: None) -> None:
    arguments, _ = described(path)
    assert set(arguments) >= COMMON
    for name, argument in arguments.items():
        assert len(argument.named["description"]) > 8, name
        choices = argument.named.get("choices")
        assert choices is None or argument.named["default_value"] in choices, name
        assert (choices == ["", "true", "false"]) == (name in ("autostart", "use_sim_time")), name


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_nodes_are_ours_with_parameters_they_have(path: Path, stand_ins: None, tmp_path: Path) -> None:
    arguments, _ = described(path)
    given = {name: value for name, value in GIVEN.items() if name in arguments}
    nodes = ours(described(path, **given)[1])
    assert nodes
    for part, node in nodes.items():
        kind, name = NODES[part]
        assert node.named["name"] == name and used(node.named["namespace"]) == {"namespace"}
        known = {f.name for f in fields(kind)} | {"use_sim_time"}
        assert parameters_of(node) <= known
        assert given.keys() & known <= parameters_of(node), "an argument goes to all nodes that know it"
    assert given.keys() <= set().union(*map(parameters_of, nodes.values())), "an argument is for somebody"


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_rviz_is_started_on_request(path: Path, stand_ins: None) -> None:
    arguments, nodes = described(path)
    for node in (n for n in nodes if n.named["package"] != "calib_planner"):
        assert node.named["package"] == "rviz2" and used(node.named["condition"]) == {"rviz"}
        assert arguments["rviz"].named["default_value"] == "false"


GIVEN = {
    "robot": "ur10e",
    "seed": "7",
    "store_folder": "/given",
    "save_folder": "/saved",
    "port": "8471",
    "autostart": "true",
    "use_sim_time": "false",
}
WRITTEN = {
    "robot": "planar_2r",
    "seed": 3,
    "store_folder": "/file",
    "save_folder": "/there",
    "port": 8472,
    "autostart": False,
    "use_sim_time": True,
}


def in_force(folder: Path, node: Started) -> dict[str, Any]:
    """Parameters that a node has when it is started so: files as launch_ros passes them, merged by ROS itself."""
    words, name = ["--ros-args"], node.named["name"]
    for k, entry in enumerate(node.named["parameters"]):
        path = folder / f"{k}.yaml"
        if isinstance(entry, dict):
            path.write_text(yaml.safe_dump({f"/{name}": {"ros__parameters": entry}}))
        elif isinstance(entry, str):
            path = Path(entry)
        else:
            path = config_folder() / entry.args[0][-1]
        words += ["--params-file", str(path)]
    context = Context()
    rclpy.init(args=words, context=context)
    made = Node(name, context=context, automatically_declare_parameters_from_overrides=True)
    try:
        return {k: p.value for k, p in made.get_parameters_by_prefix("").items()}
    finally:
        made.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("path", [p for p in FILES if p.name[0] in "eips"], ids=lambda p: p.name)
def test_arguments_win_if_given_else_the_file_of_the_user(path: Path, stand_ins: None, tmp_path: Path) -> None:
    file = tmp_path / "user.yaml"
    names = (set(described(path)[0]) & set(WRITTEN)) - {"rviz"}
    written = {name: WRITTEN[name] for name in names}
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": written}}))
    for given in ({}, {name: GIVEN[name] for name in names}):
        (node,) = ours(described(path, params_file=str(file), **given)[1]).values()
        expected = written | {name: yaml.safe_load(text) for name, text in given.items()}
        assert in_force(tmp_path, node).items() >= expected.items()


# ── a campaign ───────────────────────────────────────────────────────────────────────────────────────

CAMPAIGN = FOLDER / "campaign.launch.py"
CELL = """robot: planar_2r
targets: [[0, 0, 0], [50mm, 0, 0]]
sigma: 20um
required-accuracy: 0.2mm
test-pose: [[30, 60], [45, 90]]
units: deg
speed: 1.5
dwell: 1
budget: 30
validation: 4
store-folder: store
tracker-state-topics: one/locked, two/locked
controller: arm/follow_joint_trajectory
"""


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(CELL)
    return path


def everything(monkeypatch: pytest.MonkeyPatch, *installed: str) -> list[str]:
    """Have these optional modules found and no others; the list gets the warnings of the launch file."""
    told: list[str] = []
    found = {name: object() for name in installed}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: found.get(name))
    module: Any = ModuleType("launch.logging")
    module.get_logger = lambda name: SimpleNamespace(warning=told.append)
    monkeypatch.setitem(sys.modules, "launch.logging", module)
    return told


def test_a_campaign_in_simulation(
    stand_ins: None, cell: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = everything(monkeypatch, "control_msgs", "aiohttp")
    nodes = ours(described(CAMPAIGN, cell=str(cell), simulate="true")[1])
    assert set(nodes) == set(NODES) and told == []
    forced = {part: in_force(tmp_path, node) for part, node in nodes.items()}
    for part in NODES:
        assert forced[part]["cell"] == str(cell)
    points = ["tracker/point_1", "tracker/point_2"]
    assert forced["simulator"]["tracker_topics"] == forced["identifier"]["tracker_topics"] == points
    locked = ["one/locked", "two/locked"]
    assert forced["simulator"]["tracker_state_topics"] == forced["executor"]["tracker_state_topics"] == locked
    assert forced["identifier"]["tracker_state_topics"] == locked
    for part in ("simulator", "executor"):
        assert forced[part]["controller_action"] == "arm/follow_joint_trajectory"
    assert forced["identifier"]["plan_topic"] == "calibration_campaign/plan"
    campaign = forced["campaign"]
    assert campaign["execute_action"] == "plan_executor/execute_plan"
    assert campaign["store_folder"] == forced["page"]["report_folder"] == str(tmp_path / "store")
    settings = CampaignParameters(test_poses=campaign["test_poses"])
    assert np.allclose(settings.test_pose_rows, np.radians([[30, 60], [45, 90]]))
    assert (campaign["budget"], campaign["validation"], campaign["required_accuracy"]) == (30, 4, 2e-4)
    assert forced["executor"]["joint_speed"] == 1.5 and forced["executor"]["dwell"] == 1.0
    assert forced["planner"]["sigma"] == campaign["sigma"] == forced["identifier"]["sigma"] == 2e-5


@pytest.mark.parametrize(("simulate", "robot"), [("true", "tracker_simulator"), ("false", "plan_executor")])
def test_what_is_not_installed_is_not_started_and_said(
    stand_ins: None, cell: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, simulate: str, robot: str
) -> None:
    told = everything(monkeypatch)
    nodes = ours(described(CAMPAIGN, cell=str(cell), simulate=simulate)[1])
    assert set(NODES) - set(nodes) == {"executor", "page"} | ({"simulator"} if simulate == "false" else set())
    assert in_force(tmp_path, nodes["campaign"])["execute_action"] == f"{robot}/execute_plan"
    executor, page = told
    assert "plan_executor" in executor and "sudo apt install ros-$ROS_DISTRO-control-msgs" in executor
    assert "page" in page and "python3-aiohttp" in page


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_an_argument_that_is_none_is_said(path: Path, stand_ins: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """``ros2 launch`` takes any; a misspelt ``simulate`` would move a robot."""
    told = everything(monkeypatch, "control_msgs", "aiohttp")
    described(path)
    assert told == []
    described(path, simulated="true", parameters="old.yaml")
    first, second = told
    assert first.startswith("parameters: no argument") and second.startswith("simulated: no argument")
    assert "params_file" in first


def test_a_campaign_without_a_cell_is_that_of_the_parameters(
    stand_ins: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    everything(monkeypatch, "control_msgs", "aiohttp")
    nodes = ours(described(CAMPAIGN, robot="ur10e")[1])
    assert set(nodes) == set(NODES) - {"simulator"}
    assert all(in_force(tmp_path, node)["robot"] == "ur10e" for node in nodes.values())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"cell": "none.yaml"}, ["cell", "none.yaml", "a file that is there"]),
        ({"params_file": "none.yaml"}, ["params_file", "a file that is there"]),
        ({"seed": "many", "robot": ""}, ["seed", "many", "a whole number"]),
        ({"robot": "ur10e"}, ["robot", "ur10e beside cell", "one of the two"]),
        ({"text": "robot: planar_2r\n"}, ["test-pose", "no such key"]),
        ({"text": CELL + "tracker-topics: one\n"}, ["tracker-topics", "1 topics", "2 topics"]),
        ({"text": CELL.replace("[30, 60]", "[30, 60, 90]")}, ["test-pose", "3 numbers", "2 numbers a pose"]),
        ({"text": CELL + "constraints: none.yaml\n"}, ["constraints", "a file that is there"]),
    ],
)
def test_what_cannot_be_used_is_said_before_nodes_are_started(
    stand_ins: None, cell: Path, monkeypatch: pytest.MonkeyPatch, given: dict[str, str], words: list[str]
) -> None:
    everything(monkeypatch, "control_msgs", "aiohttp")
    cell.write_text(given.pop("text", CELL))
    with pytest.raises(InputError) as refused:
        described(CAMPAIGN, **({"cell": str(cell)} | given))
    for word in words:
        assert word in str(refused.value)


def test_two_cells_in_two_namespaces_share_no_name(stand_ins: None, cell: Path, tmp_path: Path) -> None:
    """Everything that a cell says of topics and nodes is relative; ``namespace`` does the rest."""
    _, nodes = described(CAMPAIGN, cell=str(cell), simulate="true")
    texts = [text for node in ours(nodes).values() for text in in_force(tmp_path, node).values()]
    flat = [t for text in texts for t in (text if isinstance(text, list) else [text]) if isinstance(t, str)]
    assert not [t for t in flat if t.startswith("/") and str(tmp_path) not in t]
