"""Starts tracker_simulator with config/simulator.yaml.

    ros2 launch calib_planner simulator.launch.py
    ros2 launch calib_planner simulator.launch.py robot:=ur10e seed:=3
    ros2 launch calib_planner simulator.launch.py namespace:=cell_1 parameters:=/path/to/my.yaml
    ros2 launch calib_planner simulator.launch.py autostart:=false    # a lifecycle manager drives it

A file given as ``parameters`` needs only what differs, such as the faults that are wanted; what there is, with
units and ranges, is in config/simulator.yaml.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    default = PathJoinSubstitution([FindPackageShare("calib_planner"), "config", "simulator.yaml"])
    truth = ["true", "false"]
    own = {
        "robot": ParameterValue(LaunchConfiguration("robot"), value_type=str),
        "seed": ParameterValue(LaunchConfiguration("seed"), value_type=int),
        "autostart": ParameterValue(LaunchConfiguration("autostart"), value_type=bool),
        "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool),
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument("robot", default_value="kuka_kr270", description="shipped robot name"),
            DeclareLaunchArgument("seed", default_value="0", description="of true errors, noise and faults"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            DeclareLaunchArgument("parameters", default_value=default, description="YAML of node parameters"),
            DeclareLaunchArgument(
                "autostart", default_value="true", choices=truth, description="go to active without a manager"
            ),
            DeclareLaunchArgument(
                "use_sim_time", default_value="false", choices=truth, description="stamps from /clock"
            ),
            Node(
                package="calib_planner",
                executable="simulator_node",
                name="tracker_simulator",
                namespace=LaunchConfiguration("namespace"),
                parameters=[default, own, LaunchConfiguration("parameters")],
                output="screen",
            ),
        ]
    )
