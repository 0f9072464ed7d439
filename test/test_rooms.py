"""Only calib_planner/ros may know ROS: no other module imports it, and the library works without."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import calib_planner

PACKAGE = Path(calib_planner.__file__).resolve().parent
OUTSIDE = [p for p in sorted(PACKAGE.rglob("*.py")) if "ros" not in p.relative_to(PACKAGE).parts]


def is_ros(module: str) -> bool:
    root = module.split(".")[0]
    return (
        root.startswith(("rclpy", "rcl_", "rosidl", "ament_", "launch", "tf2"))
        or root.endswith(("_msgs", "_srvs", "_interfaces", "_interfaces_py"))
        or module.startswith("calib_planner.ros")
    )


def imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module":
            yield from (a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str))


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_ros_outside_the_ros_room(path: Path) -> None:
    assert not [m for m in imports(path) if is_ros(m)]


def test_the_walk_sees_modules_and_knows_ros() -> None:
    assert len(OUTSIDE) > 30
    assert is_ros("rclpy.node") and is_ros("sensor_msgs.msg") and is_ros("calib_planner_msgs.srv")
    assert is_ros("calib_planner.ros.demo") and not is_ros("calib_planner.robot") and not is_ros("rosbags")
    found = {m for name in ("nodes/planner.py", "rclpy_ext/run.py") for m in imports(PACKAGE / "ros" / name)}
    assert "rclpy" in found and "calib_planner_msgs.srv" in found


@pytest.mark.parametrize("name", ["session.py"])
def test_pure_parts_of_the_ros_room_are_pure(name: str) -> None:
    found = [m for m in imports(PACKAGE / "ros" / name) if not m.startswith("calib_planner.ros") and is_ros(m)]
    assert not found


def test_everything_outside_imports_with_ros_blocked() -> None:
    names = [
        ".".join(("calib_planner", *p.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")
        for p in OUTSIDE
    ]
    names = [n for n in names if not n.endswith("__main__")]
    script = f"""
import importlib, sys
class Block:
    def find_spec(self, name, path=None, target=None):
        root = name.split(".")[0]
        if root == "rclpy" or root.endswith(("_msgs", "_srvs", "_interfaces")):
            raise ImportError(f"{{name}} is blocked")
sys.meta_path.insert(0, Block())
for name in {names!r}:
    importlib.import_module(name)
assert "rclpy" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_campaigns_use_only_the_rooms_above_them() -> None:
    above = {"robot", "instrument", "design", "identification", "simulation", "adaptive", "errors", "_arrays"}
    for path in sorted(PACKAGE.rglob("*.py")):
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        used = {m.split(".")[1] for m in imports(path) if m.startswith("calib_planner.")}
        assert room != "adaptive" or used <= above, path
        assert room not in above - {"adaptive"} or "adaptive" not in used, path
