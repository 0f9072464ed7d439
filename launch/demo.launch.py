"""Starts planner, identifier and simulated tracker; then ask for a plan and have it executed.

    ros2 launch calib_planner demo.launch.py robot:=kuka_kr270 seed:=3 save_folder:=$HOME/calibration rviz:=true
    ros2 service call /calibration_planner/request_plan calib_planner_msgs/srv/PlanCalibration \
        "{test_poses: [0, -1.047, 1.571, 0, 0.785, 0], configurations: 12}"
    ros2 topic echo --once /calibration_planner/current_plan        # the plan, for the action's goal
    ros2 action send_goal /tracker_simulator/execute_plan calib_planner_msgs/action/ExecutePlan "{plan: …}"
    ros2 topic echo /calibration_identifier/estimate                # after every accepted configuration
    ros2 service call /calibration_identifier/save std_srvs/srv/Trigger

The whole in one command, with a table and a picture at the end: python3 -m calib_planner.ros.demo
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

NAMES = {
    "planner": "calibration_planner",
    "identifier": "calibration_identifier",
    "simulator": "tracker_simulator",
}


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    own = {
        "planner": {},
        "identifier": {"save_folder": ParameterValue(LaunchConfiguration("save_folder"), value_type=str)},
        "simulator": {"seed": ParameterValue(LaunchConfiguration("seed"), value_type=int)},
    }
    arguments = [
        DeclareLaunchArgument("robot", default_value="kuka_kr270", description="shipped robot name"),
        DeclareLaunchArgument("seed", default_value="0", description="seed of the hidden true errors"),
        DeclareLaunchArgument("save_folder", default_value="", description="folder for ~/save; empty = off"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of all nodes"),
        DeclareLaunchArgument(
            "rviz", default_value="false", choices=["true", "false"], description="show the plan"
        ),
    ]
    nodes = [
        Node(
            package="calib_planner",
            executable=f"{part}_node",
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                PathJoinSubstitution([FindPackageShare("calib_planner"), "config", f"{part}.yaml"]),
                {"robot": LaunchConfiguration("robot")},
                own[part],
            ],
            output="screen",
        )
        for part, name in NAMES.items()
    ]
    config = PathJoinSubstitution([FindPackageShare("calib_planner"), "config"])
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=LaunchConfiguration("namespace"),
        arguments=["-d", PathJoinSubstitution([config, "rviz", "planner.rviz"])],
        remappings=[("/calibration_planner/markers", "calibration_planner/markers")],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*arguments, *nodes, rviz])
