"""Starts calibration_campaign: measures until it is accurate enough, with the robot and identifier there are.

    ros2 launch calib_planner campaign.launch.py parameters:=/path/to/my.yaml
    ros2 service call /calibration_campaign/start std_srvs/srv/Trigger
    ros2 topic echo /calibration_campaign/status
    ros2 service call /calibration_campaign/pause std_srvs/srv/Trigger      # resume, skip

What has to be in the file (test poses, accuracy, store_folder) and what else there is, with units and ranges,
is in config/campaign.yaml. The identifier runs with keep_measurements: true and plan_topic:
calibration_campaign/plan.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    default = PathJoinSubstitution([FindPackageShare("calib_planner"), "config", "campaign.yaml"])
    truth = ["true", "false"]
    own = {
        name: ParameterValue(LaunchConfiguration(name), value_type=bool) for name in ("autostart", "use_sim_time")
    }
    return LaunchDescription(
        [
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
                executable="campaign_node",
                name="calibration_campaign",
                namespace=LaunchConfiguration("namespace"),
                parameters=[default, own, LaunchConfiguration("parameters")],
                output="screen",
            ),
        ]
    )
