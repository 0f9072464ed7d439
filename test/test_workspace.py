# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A workspace with this checkout below ``src``: the ordinary command builds the package and its interfaces.

The interfaces of the copies here are one small service, since a build of all takes a minute.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from robots import PROVE

pytest.importorskip("rclpy", reason="needs a ROS 2 environment (source env.sh)")
packages = pytest.importorskip("catkin_pkg.packages")
ROOT = Path(__file__).parents[1]
PARTS = ("calib_planner", "paper", "msg_defs", "config", "launch", "resource")
FILES = ("package.xml", "setup.py", "setup.cfg", "pyproject.toml", "README.md")
SERVICE = "srv/UndoMeasurement.srv"
INTERFACES = f"""cmake_minimum_required(VERSION 3.16)
project(calib_planner_msgs)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(${{PROJECT_NAME}} "{SERVICE}")
ament_export_dependencies(rosidl_default_runtime)
ament_package()
"""
USE = "import calib_planner, calib_planner_msgs.srv as s; print(calib_planner.__file__, s.__file__)"


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    checkout = tmp_path / "src" / "calib_planner"
    checkout.mkdir(parents=True)
    for name in PARTS:
        shutil.copytree(ROOT / name, checkout / name, ignore=shutil.ignore_patterns("__pycache__", "*.so", "*.c"))
    for name in FILES:
        shutil.copy(ROOT / name, checkout)
    (checkout / "msg_defs" / "CMakeLists.txt").write_text(INTERFACES)
    return tmp_path


def environment() -> dict[str, str]:
    """That of a shell in which ROS is sourced, and not this checkout."""
    own = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    for name in ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH"):
        paths = [p for p in own.get(name, "").split(os.pathsep) if "calib_planner" not in p]
        own[name] = os.pathsep.join(paths)
    return own


def colcon(workspace: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = ["colcon", "build", "--event-handlers", "console_cohesion+", *words]
    return subprocess.run(command, cwd=workspace, env=environment(), capture_output=True, text=True)


def used(workspace: Path) -> list[str]:
    """Where the package and its interfaces come from in a shell that sources the workspace."""
    done = subprocess.run(
        ["bash", "-c", f"source install/setup.bash && cd / && python -c '{USE}'"],
        cwd=workspace,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.skipif(not PROVE, reason="make prove: builds interfaces")
@pytest.mark.parametrize(
    "options", [(), ("--symlink-install",), ("--merge-install",), ("--merge-install", "--symlink-install")]
)
def test_the_ordinary_command_builds_the_interfaces_too(workspace: Path, options: tuple[str, ...]) -> None:
    done = colcon(workspace, *options)
    assert done.returncode == 0, done.stdout + done.stderr
    package, interfaces = used(workspace)
    assert str(workspace) in package and str(workspace / "install") in interfaces
    again = colcon(workspace, *options)
    assert again.returncode == 0, again.stdout + again.stderr


@pytest.mark.skipif(not PROVE, reason="make prove: colcon is started twice")
def test_interfaces_that_do_not_build_end_it_with_the_line_to_type(workspace: Path) -> None:
    (workspace / "src" / "calib_planner" / "msg_defs" / SERVICE).write_text("unknown_type x\n---\n")
    done = colcon(workspace)
    assert done.returncode
    assert f"colcon build --base-paths {workspace}/src/calib_planner " in done.stdout + done.stderr


def test_with_a_link_all_tools_see_both_and_nothing_is_built_twice(workspace: Path) -> None:
    (workspace / "src" / "calib_planner_msgs").symlink_to("calib_planner/msg_defs")
    seen = packages.find_packages(str(workspace / "src"))  # so do rosdep and bloom
    assert {p.name for p in seen.values()} == {"calib_planner", "calib_planner_msgs"}
    packages.verify_equal_package_versions(seen.values())
    done = subprocess.run(
        ["colcon", "graph"], cwd=workspace, env=environment(), capture_output=True, text=True, check=True
    )
    first, second = done.stdout.splitlines()[:2]
    assert first.split()[0] == "calib_planner_msgs" and second.split()[0] == "calib_planner"


@pytest.mark.skipif(not PROVE, reason="make prove: builds interfaces")
def test_both_by_their_paths_are_built_once(workspace: Path) -> None:
    checkout = workspace / "src" / "calib_planner"
    done = colcon(workspace, "--base-paths", str(checkout), str(checkout / "msg_defs"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "which colcon does not look for" not in done.stdout
    used(workspace)
