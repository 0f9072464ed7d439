"""The robots that come with the package, and ``load_robot`` for those and for files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from calib_planner.errors import UnknownNameError
from calib_planner.robot.chain import Robot
from calib_planner.robot.robot_yaml import read_robot_yaml
from calib_planner.robot.urdf import read_urdf

URDF_SUFFIXES = (".urdf", ".xml")
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
    if str(source) in shipped_robots():
        return read_robot_yaml(config_folder() / "robots" / f"{source}.yaml")
    path = Path(source).expanduser()
    if path.is_file():
        if path.suffix.lower() in YAML_SUFFIXES:
            return read_robot_yaml(path)
        if path.suffix.lower() in URDF_SUFFIXES:
            return read_urdf(path, base_link, tip_link)
    raise UnknownNameError("robot", str(source), [*shipped_robots(), "PATH.urdf", "PATH.yaml (an existing file)"])
