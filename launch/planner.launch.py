"""Starts calibration_planner with config/planner.yaml, and RViz with rviz:=true.

    ros2 launch calib_planner planner.launch.py
    ros2 launch calib_planner planner.launch.py robot:=ur10e rviz:=true
    ros2 launch calib_planner planner.launch.py namespace:=cell_1 parameters:=/path/to/my.yaml
    ros2 launch calib_planner planner.launch.py autostart:=false    # a lifecycle manager drives it

A URDF heard on robot_description (robot_state_publisher) replaces robot. A file given as ``parameters`` needs
only what differs; what there is, with units and ranges, is in config/planner.yaml. Then:

    ros2 service call /calibration_planner/request_plan calib_planner_msgs/srv/PlanCalibration \
        "{test_poses: [0, -1.047, 1.571, 0, 0.785, 0], configurations: 12}"
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    config = PathJoinSubstitution([FindPackageShare("calib_planner"), "config"])
    default = PathJoinSubstitution([config, "planner.yaml"])
    truth = ["true", "false"]
    own = {
        "robot": ParameterValue(LaunchConfiguration("robot"), value_type=str),
        "autostart": ParameterValue(LaunchConfiguration("autostart"), value_type=bool),
        "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool),
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument("robot", default_value="kuka_kr270", description="shipped robot name"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            DeclareLaunchArgument("parameters", default_value=default, description="YAML of node parameters"),
            DeclareLaunchArgument(
                "autostart", default_value="true", choices=truth, description="go to active without a manager"
            ),
            DeclareLaunchArgument(
                "use_sim_time", default_value="false", choices=truth, description="stamps from /clock"
            ),
            DeclareLaunchArgument("rviz", default_value="false", choices=truth, description="show the plan"),
            Node(
                package="calib_planner",
                executable="planner_node",
                name="calibration_planner",
                namespace=LaunchConfiguration("namespace"),
                parameters=[default, own, LaunchConfiguration("parameters")],
                output="screen",
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=LaunchConfiguration("namespace"),
                arguments=["-d", PathJoinSubstitution([config, "rviz", "planner.rviz"])],
                remappings=[("/calibration_planner/markers", "calibration_planner/markers")],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
