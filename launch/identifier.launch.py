"""Starts calibration_identifier with config/identifier.yaml.

    ros2 launch calib_planner identifier.launch.py store_folder:=$HOME/calibration
    ros2 launch calib_planner identifier.launch.py robot:=ur10e store_folder:=$HOME/calibration
    ros2 launch calib_planner identifier.launch.py namespace:=cell_1 parameters:=/path/to/my.yaml
    ros2 launch calib_planner identifier.launch.py autostart:=false    # a lifecycle manager drives it

What is accepted is in store_folder before it is acknowledged, and a restart with the same folder goes on there. A
URDF heard on robot_description (robot_state_publisher) replaces robot. A file given as ``parameters`` needs only
what differs; what there is, with units and ranges, is in config/identifier.yaml. Then:

    ros2 topic echo /calibration_identifier/measurements                    # accepted or rejected, and why
    ros2 topic echo --once /calibration_identifier/estimate
    ros2 service call /calibration_identifier/undo std_srvs/srv/Trigger    # the newest; by id: ~/undo_measurement
    ros2 service call /calibration_identifier/report std_srvs/srv/Trigger
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    default = PathJoinSubstitution([FindPackageShare("calib_planner"), "config", "identifier.yaml"])
    truth = ["true", "false"]
    own = {
        "robot": ParameterValue(LaunchConfiguration("robot"), value_type=str),
        "store_folder": ParameterValue(LaunchConfiguration("store_folder"), value_type=str),
        "autostart": ParameterValue(LaunchConfiguration("autostart"), value_type=bool),
        "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool),
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument("robot", default_value="kuka_kr270", description="shipped robot name"),
            DeclareLaunchArgument(
                "store_folder", default_value="", description="folder of the campaign; empty = in memory only"
            ),
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
                executable="identifier_node",
                name="calibration_identifier",
                namespace=LaunchConfiguration("namespace"),
                parameters=[default, own, LaunchConfiguration("parameters")],
                output="screen",
            ),
        ]
    )
