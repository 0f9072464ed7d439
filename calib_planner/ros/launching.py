# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the launch files share. They import it from the installed package, since their own folder is on no path.

Every launch file has the arguments of ``COMMON`` beside ``namespace`` and ``params_file``; an argument goes to
all nodes that have a parameter of that name. What is given on the command line wins over ``params_file``, that
over the cell's file, that over the nodes' defaults; an argument that is not given says nothing. That takes an
``OpaqueFunction``: only when a launch file runs is it known what was given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import Field, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.logging import get_logger
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from calib_planner.errors import InputError
from calib_planner.ros.cell import node_parameters
from calib_planner.ros.settings import NODES
from calib_planner.units import listed

TRUTH = {"true": True, "false": False}
COMMON = ("robot", "autostart", "use_sim_time")
"""Arguments of every launch file that are parameters of the nodes."""
DESCRIPTIONS = {
    "namespace": "namespace of all nodes",
    "params_file": "YAML file of node parameters, of which it needs to hold only those that differ",
    "robot": "name of a shipped robot",
    "seed": "seed of true errors, noise and faults",
    "store_folder": "folder of what is measured, with which a restart goes on; in memory only by default",
    "save_folder": "folder for ~/save and ~/report; by default the store folder",
    "autostart": "whether the nodes go to active without a lifecycle manager",
    "use_sim_time": "whether stamps are taken from /clock",
    "port": "port of the page (8470); two cells on one machine need two",
    "cell": "cell.yaml, which says what robot, tracker and goals are",
    "simulate": "whether a simulated robot and tracker stand in for the real ones",
}
OPTIONAL = {
    "executor": ("control_msgs", "sudo apt install ros-$ROS_DISTRO-control-msgs"),
    "page": ("aiohttp", "sudo apt install python3-aiohttp"),
}
"""Part → the module without which it is not started, and what installs it."""


def describe(*parts: str, arguments: Sequence[str] = (), rviz: bool = False) -> LaunchDescription:
    """The description of some nodes, each with ``config/PART.yaml`` and what is given.

    Args:
        parts: ``NAME`` of the executables ``NAME_node``.
        arguments: Names of arguments besides ``COMMON`` that are parameters of these nodes.
        rviz: Whether there is an argument ``rviz``.
    """
    names = (*COMMON, *arguments)

    def start(context: LaunchContext) -> list[Node]:
        return started({part: {} for part in parts}, names, ["rviz"] if rviz else [], context)

    window = show_in_rviz() if rviz else []
    return LaunchDescription([*declared(names), OpaqueFunction(function=start), *window])


def describe_campaign() -> LaunchDescription:
    """The description of all that a campaign needs: planner, identifier, executor, campaign and page."""
    names = (*COMMON, "store_folder", "seed", "port")

    def start(context: LaunchContext) -> list[Node]:
        simulate, cell = _text("simulate", context) == "true", _text("cell", context)
        missing = [part for part, (module, _) in OPTIONAL.items() if find_spec(module) is None]
        for part in missing:
            module, how = OPTIONAL[part]
            get_logger("launch.user").warning(f"{_without(part, simulate)}: {module} is not installed ({how})")
        known = cell and str(_file("cell", cell))
        parameters = node_parameters(known, simulate=simulate, executor="executor" not in missing)
        there = {part: own for part, own in parameters.items() if part not in missing}
        return started(there, names, ("cell", "simulate", "rviz"), context)

    simulate = DeclareLaunchArgument(
        "simulate", default_value="false", choices=[*TRUTH], description=DESCRIPTIONS["simulate"]
    )
    return LaunchDescription(
        [*declared(("cell", *names)), simulate, OpaqueFunction(function=start), *show_in_rviz()]
    )


def _without(part: str, simulate: bool) -> str:
    """What it means that a part is not started."""
    if part == "page":
        return "there is no page to watch and steer the campaign; ros2 service call does it"
    if simulate:
        return "the simulated robot executes plans by itself, without plan_executor"
    return "no node moves the robot unless one of yours offers the action plan_executor/execute_plan"


def declared(names: Sequence[str]) -> list[DeclareLaunchArgument]:
    """The arguments ``namespace``, ``params_file`` and those that are parameters; empty means not given."""
    made = []
    for name in ("namespace", "params_file", *names):
        choices = {"choices": ["", *TRUTH]} if name in ("autostart", "use_sim_time") else {}
        made.append(DeclareLaunchArgument(name, default_value="", description=DESCRIPTIONS[name], **choices))
    return made


def started(
    parts: Mapping[str, Mapping[str, Any]], names: Sequence[str], others: Sequence[str], context: LaunchContext
) -> list[Node]:
    """The nodes, with their own parameters, those of ``params_file`` and the arguments that are given.

    Args:
        parts: Part → its own parameters.
        names: Arguments that are parameters.
        others: Further arguments of the launch file.
        context: What was given.

    Raises:
        InputError: ``params_file`` is no file, or an argument has no usable value.
    """
    known = {"namespace", "params_file", *names, *others}
    for name in sorted(set(context.launch_configurations) - known):
        # No error: a launch file that includes this one has its own arguments in the same place.
        text = f"{name}: no argument of this launch file, left aside; its arguments are {listed(sorted(known))}"
        get_logger("launch.user").warning(text)
    path = _text("params_file", context)
    files = [str(_file("params_file", path))] if path else []
    texts = {name: text for name in names if (text := _text(name, context))}
    nodes = []
    for part, own in parts.items():
        items = {item.name: item for item in fields(NODES[part][0])}
        own_texts = {name: text for name, text in texts.items() if name in (*items, "use_sim_time")}
        given = {name: _value(name, text, items) for name, text in own_texts.items()}
        if "cell" in own and "robot" in given:
            raise InputError("robot", f"{given['robot']} beside cell", "one of the two")
        lists = {name: list(value) if isinstance(value, tuple) else value for name, value in own.items()}
        nodes.append(node(part, config(f"{part}.yaml"), *filter(None, (lists, *files, given))))
    return nodes


def _text(name: str, context: LaunchContext) -> str:
    return str(LaunchConfiguration(name).perform(context))


def _file(argument: str, path: str) -> Path:
    full = Path(path).expanduser().resolve()
    if not full.is_file():
        raise InputError(argument, path, "a file that is there", f"looked for {full}")
    return full


def _value(name: str, text: str, items: Mapping[str, Field[Any]]) -> Any:
    """The parameter's value that an argument states."""
    if name == "use_sim_time" or isinstance(items[name].default, bool):
        return TRUTH[text]
    if isinstance(items[name].default, int):
        try:
            return int(text)
        except ValueError:
            raise InputError(name, text, "a whole number") from None
    return text


def node(part: str, *parameters: Any) -> Node:
    """A node of this package, in the namespace of the argument ``namespace``."""
    return Node(
        package="calib_planner",
        executable=f"{part}_node",
        name=NODES[part][1],
        namespace=LaunchConfiguration("namespace"),
        parameters=list(parameters),
        output="screen",
    )


def config(*names: str) -> PathJoinSubstitution:
    """A file below the package's ``config``."""
    return PathJoinSubstitution([FindPackageShare("calib_planner"), "config", *names])


def show_in_rviz() -> list[Any]:
    """The argument ``rviz``, and RViz with the planner's markers if it is true."""
    argument = DeclareLaunchArgument(
        "rviz", default_value="false", choices=[*TRUTH], description="whether RViz shows the plan"
    )
    window = Node(
        package="rviz2",
        executable="rviz2",
        namespace=LaunchConfiguration("namespace"),
        arguments=["-d", config("rviz", "planner.rviz")],
        remappings=[("/calibration_planner/markers", "calibration_planner/markers")],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return [argument, window]
