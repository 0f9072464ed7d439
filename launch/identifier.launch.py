"""Starts calibration_identifier with config/identifier.yaml.

    ros2 launch calib_planner identifier.launch.py store_folder:=$HOME/calibration
    ros2 launch calib_planner identifier.launch.py robot:=ur10e store_folder:=$HOME/calibration
    ros2 launch calib_planner identifier.launch.py namespace:=cell_1 parameters:=/path/to/my.yaml
    ros2 launch calib_planner identifier.launch.py autostart:=false    # a lifecycle manager drives it

What is accepted is in store_folder before it is acknowledged, and a restart with the same folder goes on there. A
URDF heard on robot_description (robot_state_publisher) replaces robot. A file given as ``parameters`` needs only
what differs; what there is, with units and ranges, is in config/identifier.yaml. Arguments that are given win
over files; those that are not leave what the files say. Then:

    ros2 topic echo /calibration_identifier/measurements                    # accepted or rejected, and why
    ros2 topic echo --once /calibration_identifier/estimate
    ros2 service call /calibration_identifier/undo std_srvs/srv/Trigger    # the newest; by id: ~/undo_measurement
    ros2 service call /calibration_identifier/report std_srvs/srv/Trigger
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TRUTH = {"true": True, "false": False}
KINDS = {"robot": str, "store_folder": str, "autostart": TRUTH.get, "use_sim_time": TRUTH.get}


def node(context: LaunchContext, default: PathJoinSubstitution) -> list[Node]:
    """The node, with the arguments that were given."""
    texts = {name: LaunchConfiguration(name).perform(context) for name in KINDS}
    given = {name: kind(texts[name]) for name, kind in KINDS.items() if texts[name]}
    return [
        Node(
            package="calib_planner",
            executable="identifier_node",
            name="calibration_identifier",
            namespace=LaunchConfiguration("namespace"),
            parameters=[default, LaunchConfiguration("parameters"), *filter(None, [given])],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    default = PathJoinSubstitution([FindPackageShare("calib_planner"), "config", "identifier.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("robot", default_value="", description="shipped robot name"),
            DeclareLaunchArgument(
                "store_folder", default_value="", description="folder of the campaign; empty = in memory only"
            ),
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
