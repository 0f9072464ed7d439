"""Launch files: they compile and name what exists; with launch installed they also describe it."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path

import pytest

from calib_planner.robot.catalogue import config_folder
from calib_planner.ros.identifier_node import IdentifierNode
from calib_planner.ros.planner_node import PlannerNode
from calib_planner.ros.simulator_node import SimulatorNode

FOLDER = config_folder().parent / "launch"
FILES = sorted(FOLDER.glob("*.launch.py"))
NAMES = {"calibration_planner", "calibration_identifier", "tracker_simulator"}


def test_all_are_there() -> None:
    assert [p.name.split(".")[0] for p in FILES] == ["demo", "identifier", "planner", "simulator"]
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
            assert importlib.util.find_spec(f"calib_planner.ros.{text}")


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_it_describes_nodes(path: Path) -> None:
    pytest.importorskip("launch_ros", reason="launch is not among the PyPI wheels")
    spec = importlib.util.spec_from_file_location("launched", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.generate_launch_description().entities
