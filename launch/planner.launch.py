"""Starts calibration_planner with config/planner.yaml, and RViz with rviz:=true.

    ros2 launch calib_planner planner.launch.py
    ros2 launch calib_planner planner.launch.py robot:=ur10e rviz:=true
    ros2 launch calib_planner planner.launch.py namespace:=cell_1 parameters:=/path/to/my.yaml
    ros2 launch calib_planner planner.launch.py autostart:=false    # a lifecycle manager drives it

A URDF heard on robot_description (robot_state_publisher) replaces robot. A file given as ``parameters`` needs
only what differs; what there is, with units and ranges, is in config/planner.yaml. Arguments that are given win
over files; those that are not leave what the files say. Then:

    ros2 service call /calibration_planner/request_plan calib_planner_msgs/srv/PlanCalibration \
        "{test_poses: [0, -1.047, 1.571, 0, 0.785, 0], configurations: 12}"
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TRUTH = {"true": True, "false": False}
KINDS = {"robot": str, "autostart": TRUTH.get, "use_sim_time": TRUTH.get}


def node(context: LaunchContext, default: PathJoinSubstitution) -> list[Node]:
    """The node, with the arguments that were given."""
    texts = {name: LaunchConfiguration(name).perform(context) for name in KINDS}
    given = {name: kind(texts[name]) for name, kind in KINDS.items() if texts[name]}
    return [
        Node(
            package="calib_planner",
            executable="planner_node",
            name="calibration_planner",
            namespace=LaunchConfiguration("namespace"),
            parameters=[default, LaunchConfiguration("parameters"), *filter(None, [given])],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    config = PathJoinSubstitution([FindPackageShare("calib_planner"), "config"])
    default = PathJoinSubstitution([config, "planner.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("robot", default_value="", description="shipped robot name"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            DeclareLaunchArgument("parameters", default_value=default, description="YAML of node parameters"),
            DeclareLaunchArgument(
                "autostart", default_value="", choices=["", *TRUTH], description="go to active without a manager"
            ),
            DeclareLaunchArgument(
                "use_sim_time", default_value="", choices=["", *TRUTH], description="stamps from /clock"
            ),
            DeclareLaunchArgument("rviz", default_value="false", choices=[*TRUTH], description="show the plan"),
            OpaqueFunction(function=node, args=[default]),
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
