"""Starts planner, identifier and simulated tracker; then ask for a plan and have it executed.

    ros2 launch calib_planner demo.launch.py robot:=kuka_kr270 seed:=1 save_folder:=$HOME/calibration rviz:=true
    ros2 service call /calibration_planner/request_plan calib_planner_msgs/srv/PlanCalibration \
        "{request: {test_poses: [{positions: [0, -1.047, 1.571, 0, 0.785, 0]}], configurations: 12}}"
    ros2 topic echo --once /calibration_planner/current_plan        # the plan, for the action's goal
    ros2 action send_goal /tracker_simulator/execute_plan calib_planner_msgs/action/ExecutePlan "{plan: …}"
    ros2 topic echo /calibration_identifier/estimate                # after every accepted configuration
    ros2 service call /calibration_identifier/save std_srvs/srv/Trigger

The whole in one command, with a table and a picture at the end: python3 -m calib_planner.ros.demo
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from calib_planner.ros.launching import config, namespace, node, show_in_rviz

NODES = {
    "planner": ("calibration_planner", {}),
    "identifier": ("calibration_identifier", {"save_folder": str}),
    "simulator": ("tracker_simulator", {"seed": int}),
}
"""Executable and file in config → name of the node and its own arguments."""


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    arguments = [
        DeclareLaunchArgument("robot", default_value="kuka_kr270", description="name of a shipped robot"),
        DeclareLaunchArgument("seed", default_value="0", description="seed of the hidden true errors"),
        DeclareLaunchArgument("save_folder", default_value="", description="folder for ~/save; empty = off"),
        namespace("namespace of all nodes"),
    ]
    robot = {"robot": LaunchConfiguration("robot")}
    nodes = []
    for part, (name, kinds) in NODES.items():
        own = {key: ParameterValue(LaunchConfiguration(key), value_type=kind) for key, kind in kinds.items()}
        nodes.append(node(part, name, config(f"{part}.yaml"), robot, own))
    return LaunchDescription([*arguments, *nodes, *show_in_rviz()])
