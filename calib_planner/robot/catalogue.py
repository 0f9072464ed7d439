"""The robots that come with the package, and ``load_robot`` for those and for files."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from calib_planner.errors import InputError, UnknownNameError
from calib_planner.robot.chain import Robot
from calib_planner.robot.robot_yaml import read_robot_yaml
from calib_planner.robot.urdf import read_urdf

URDF_SUFFIXES = (".urdf", ".xml", ".xacro", ".sdf")
"""Files that are read as URDF; what is another format after all is told so by its content."""
YAML_SUFFIXES = (".yaml", ".yml")


def config_folder() -> Path:
    """The folder ``config/``: beside the package in a checkout, below ``share/`` once installed."""
    for parent in Path(__file__).resolve().parents:
        for folder in (parent / "config", parent / "share" / "calib_planner" / "config"):
            if (folder / "robots").is_dir():
                return folder
    raise FileNotFoundError("calib_planner's config/ folder is neither beside nor above the package")


def shipped_robots() -> Sequence[str]:
    """Names of the shipped robots, sorted."""
    return sorted(p.stem for p in (config_folder() / "robots").glob("*.yaml"))


def load_robot(source: str | Path, *, base_link: str | None = None, tip_link: str | None = None) -> Robot:
    """See ``Robot.load``."""
    path = Path(source).expanduser()
    shipped = str(source) in shipped_robots()
    if shipped:
        path = config_folder() / "robots" / f"{source}.yaml"
    suffix = path.suffix.lower()
    if not path.is_file() or suffix not in (*YAML_SUFFIXES, *URDF_SUFFIXES):
        raise UnknownNameError(
            "robot", str(source), [*shipped_robots(), "PATH.urdf", "PATH.yaml (an existing file)"]
        )
    if suffix in URDF_SUFFIXES:
        return read_urdf(path, base_link, tip_link)
    for field, link in (("base_link", base_link), ("tip_link", tip_link)):
        if link is not None:
            advice = f"leave it out: {path.name} is one chain"
            raise InputError(field, repr(link), "no link beside a robot YAML, only beside a URDF", advice)
    return _shipped_robot(path) if shipped else read_robot_yaml(path)


@cache
def _shipped_robot(path: Path) -> Robot:
    """The robot of a file of the package, read and compiled once: robots are immutable."""
    return read_robot_yaml(path)
