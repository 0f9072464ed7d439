"""What the launch files share. They import it from the installed package, since their own folder is on no path.

An argument that is given on the command line wins over the files of parameters; one that is not given leaves what
the files say. That takes an ``OpaqueFunction``: only when a launch file runs is it known what was given.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TRUTH = {"true": True, "false": False}
COMMON: Mapping[str, Callable[[str], Any]] = {"autostart": TRUTH.get, "use_sim_time": TRUTH.get}
"""Arguments of every node: name → what makes the parameter of that name from the argument's text."""
DESCRIPTIONS = {
    "robot": "name of a shipped robot",
    "seed": "seed of true errors, noise and faults",
    "store_folder": "folder of the session; empty = what the file says, in memory only by default",
    "autostart": "whether the node goes to active without a lifecycle manager",
    "use_sim_time": "whether stamps are taken from /clock",
}


def describe(part: str, name: str, kinds: Mapping[str, Callable[[str], Any]], *, rviz: bool = False) -> Any:
    """The description of one node: its arguments, the node and, if wanted, RViz behind an argument.

    Args:
        part: ``NAME`` of the executable ``NAME_node`` and of ``config/NAME.yaml``.
        name: Name of the node.
        kinds: Arguments that are parameters of the node, as ``COMMON``.
        rviz: Whether there is an argument ``rviz``.
    """
    default = config(f"{part}.yaml")
    arguments = [
        namespace("namespace of the node"),
        DeclareLaunchArgument("parameters", default_value=default, description="YAML file of node parameters"),
    ]
    for argument in kinds:
        choices = {"choices": ["", *TRUTH]} if argument in COMMON else {}
        arguments.append(
            DeclareLaunchArgument(argument, default_value="", description=DESCRIPTIONS[argument], **choices)
        )

    def start(context: LaunchContext, default: PathJoinSubstitution) -> list[Node]:
        texts = {argument: LaunchConfiguration(argument).perform(context) for argument in kinds}
        given = {argument: kind(texts[argument]) for argument, kind in kinds.items() if texts[argument]}
        return [node(part, name, default, LaunchConfiguration("parameters"), *filter(None, [given]))]

    extra = show_in_rviz() if rviz else []
    return LaunchDescription([*arguments, OpaqueFunction(function=start, args=[default]), *extra])


def node(part: str, name: str, *parameters: Any) -> Node:
    """A node of this package, in the namespace of the argument ``namespace``."""
    return Node(
        package="calib_planner",
        executable=f"{part}_node",
        name=name,
        namespace=LaunchConfiguration("namespace"),
        parameters=list(parameters),
        output="screen",
    )


def namespace(description: str) -> DeclareLaunchArgument:
    """The argument ``namespace``."""
    return DeclareLaunchArgument("namespace", default_value="", description=description)


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
