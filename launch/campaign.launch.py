"""Starts calibration_campaign: measures until it is accurate enough, with the robot and identifier there are.

    ros2 launch calib_planner campaign.launch.py parameters:=/path/to/my.yaml
    ros2 service call /calibration_campaign/start std_srvs/srv/Trigger
    ros2 topic echo /calibration_campaign/status
    ros2 service call /calibration_campaign/pause std_srvs/srv/Trigger      # resume, skip

What has to be in the file (test poses, accuracy, store_folder) and what else there is, with units and ranges,
is in config/campaign.yaml; arguments that are given win over files, those that are not leave what the files say.
The identifier runs with keep_measurements: true and plan_topic:
calibration_campaign/plan.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TRUTH = {"true": True, "false": False}
KINDS = {"autostart": TRUTH.get, "use_sim_time": TRUTH.get}


def node(context: LaunchContext, default: PathJoinSubstitution) -> list[Node]:
    """The node, with the arguments that were given."""
    texts = {name: LaunchConfiguration(name).perform(context) for name in KINDS}
    given = {name: kind(texts[name]) for name, kind in KINDS.items() if texts[name]}
    return [
        Node(
            package="calib_planner",
            executable="campaign_node",
            name="calibration_campaign",
            namespace=LaunchConfiguration("namespace"),
            parameters=[default, LaunchConfiguration("parameters"), *filter(None, [given])],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    default = PathJoinSubstitution([FindPackageShare("calib_planner"), "config", "campaign.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            DeclareLaunchArgument("parameters", default_value=default, description="YAML of node parameters"),
            DeclareLaunchArgument(
                "autostart", default_value="", choices=["", *TRUTH], description="go to active without a manager"
            ),
            DeclareLaunchArgument(
                "use_sim_time", default_value="", choices=["", *TRUTH], description="stamps from /clock"
            ),
            OpaqueFunction(function=node, args=[default]),
        ]
    )
