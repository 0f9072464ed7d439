"""Starts tracker_simulator with config/simulator.yaml.

    ros2 launch calib_planner simulator.launch.py
    ros2 launch calib_planner simulator.launch.py namespace:=cell_1 parameters:=/path/to/my.yaml

A file given as ``parameters`` needs only what differs; what there is, with units and ranges, is in
config/simulator.yaml.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    default = PathJoinSubstitution([FindPackageShare("calib_planner"), "config", "simulator.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            DeclareLaunchArgument("parameters", default_value=default, description="YAML of node parameters"),
            Node(
                package="calib_planner",
                executable="simulator_node",
                name="tracker_simulator",
                namespace=LaunchConfiguration("namespace"),
                parameters=[default, LaunchConfiguration("parameters")],
                output="screen",
            ),
        ]
    )
