# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""package.xml, setup.py and the linters' configuration say what the code needs and offers."""

from __future__ import annotations

import ast
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "calib_planner"
ROS = {
    *("rclpy", "ament_index_python", "launch", "launch_ros", "action_msgs", "builtin_interfaces"),
    *(
        "calib_planner_msgs",
        "diagnostic_msgs",
        "geometry_msgs",
        "lifecycle_msgs",
        "rcl_interfaces",
        "sensor_msgs",
    ),
    *(
        "std_msgs",
        "std_srvs",
        "trajectory_msgs",
        "control_msgs",
        "unique_identifier_msgs",
        "visualization_msgs",
        "rviz2",
    ),
}
"""Packages of ROS 2 Jazzy: they are keys by their own names."""
KEYS = {
    "numpy": "python3-numpy",
    "scipy": "python3-scipy",
    "yaml": "python3-yaml",
    "matplotlib": "python3-matplotlib",
    "rich": "python3-rich",
    "jinja2": "python3-jinja2",
    "markupsafe": "python3-jinja2",  # which needs it
}
"""Modules and their keys in rosdep's python.yaml that apt has on Ubuntu 24.04."""
TEST_KEYS = {"ament_flake8", "python3-hypothesis", "python3-pytest", "python3-pytest-timeout"}
EXTRAS = {
    *("rosbags", "openpyxl", "xacro", "pinocchio", "dask", "distributed", "threadpoolctl", "shtab", "aiohttp"),
    "moveit_msgs",  # MoveIt's users have it
}
"""Nothing needs them: they are not in package.xml."""


def keys(kind: str) -> list[str]:
    return [e.text or "" for e in ET.parse(ROOT / "package.xml").getroot().iter(kind)]


def imported(folder: Path) -> set[str]:
    """Top-level names of the modules that are imported anywhere below a folder."""
    found: set[str] = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {name.name.split(".")[0] for name in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add((node.module or "").split(".")[0])
    return found - set(sys.stdlib_module_names) - {"calib_planner", "calib_planner_paper"}


def launched() -> set[str]:
    """Other packages whose nodes a launch file may start."""
    files = [*(ROOT / "launch").glob("*.py"), PACKAGE / "ros" / "launching.py"]
    keywords = [k for path in files for k in ast.walk(ast.parse(path.read_text())) if isinstance(k, ast.keyword)]
    found = {k.value.value for k in keywords if k.arg == "package" and isinstance(k.value, ast.Constant)}
    return {str(name) for name in found} - {"calib_planner"}


def setup_call() -> dict[str, Any]:
    """The keywords of ``setup(…)`` that are literals."""
    tree = ast.parse((ROOT / "setup.py").read_text())
    call = next(n for n in ast.walk(tree) if isinstance(n, ast.Call) and ast.unparse(n.func) == "setup")
    literal: dict[str, Any] = {}
    for keyword in call.keywords:
        try:
            literal[keyword.arg or ""] = ast.literal_eval(keyword.value)
        except ValueError:
            continue
    return literal


def test_package_xml_names_all_that_is_imported_or_launched_and_nothing_else() -> None:
    needed = imported(PACKAGE) | imported(ROOT / "paper") | imported(ROOT / "launch") | launched()
    assert needed <= ROS | set(KEYS) | EXTRAS, "unknown: find its rosdep key, or make it an extra"
    assert set(keys("exec_depend")) == {KEYS.get(name, name) for name in needed - EXTRAS}


def test_every_key_is_one_of_rosdep() -> None:
    every = [k for kind in ("depend", "build_depend", "exec_depend", "test_depend") for k in keys(kind)]
    assert len(set(every)) == len(every)
    assert set(every) <= ROS | set(KEYS.values()) | TEST_KEYS
    assert not any(key.endswith("-pip") for key in every)


def test_setup_py_and_package_xml_agree() -> None:
    call, root = setup_call(), ET.parse(ROOT / "package.xml").getroot()
    names = {"PyYAML": "yaml", "Jinja2": "jinja2"}
    required = [text.split(">")[0] for text in call["install_requires"]]
    assert {KEYS[names.get(n, n)] for n in required} == {
        k for k in keys("exec_depend") if k.startswith("python3-")
    }
    assert (call["version"], call["license"]) == (root.findtext("version"), root.findtext("license"))
    maintainer = root.find("maintainer")
    assert maintainer is not None and maintainer.get("email") == call["maintainer_email"]
    assert "pytest" in call["extras_require"]["test"], "by this colcon test runs pytest"


def test_authors_and_addresses_agree() -> None:
    call, stated = setup_call(), []
    for name in ("package.xml", "msg_defs/package.xml"):
        root = ET.parse(ROOT / name).getroot()
        stated += [(e.text, e.get("email")) for kind in ("author", "maintainer") for e in root.iter(kind)]
        assert {e.get("type"): e.text for e in root.iter("url")}["website"] == call["url"]
    assert stated == [(call["author"], call["author_email"])] * 4
    assert (call["maintainer"], call["maintainer_email"]) == (call["author"], call["author_email"])
    for name in ("CITATION.cff", "LICENSE", "docs/conf.py", "tools/headers.py"):
        assert call["author"] in (ROOT / name).read_text(encoding="utf-8"), name


def test_every_node_is_an_executable() -> None:
    scripts = dict(text.split(" = ") for text in setup_call()["entry_points"]["console_scripts"])
    parts = {p.stem for p in (PACKAGE / "ros" / "nodes").glob("*.py")} - {"__init__"}
    nodes = {f"{part}_node": f"calib_planner.ros.nodes.{part}:main" for part in parts}
    assert {k: v for k, v in scripts.items() if k.endswith("_node")} == nodes
    for target in scripts.values():
        module, _, function = target.partition(":")
        path = ROOT / module.replace(".", "/")
        text = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text()
        named = {n.name for n in ast.walk(ast.parse(text)) if isinstance(n, (ast.FunctionDef, ast.alias))}
        assert function in named, target


def test_ament_flake8() -> None:
    main = pytest.importorskip("ament_flake8.main", reason="comes with ROS from apt").main
    folders = [str(ROOT / name) for name in ("calib_planner", "launch", "test", "setup.py")]
    assert main(argv=["--config", str(ROOT / "setup.cfg"), *folders]) == 0
