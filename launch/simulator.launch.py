"""Starts tracker_simulator with config/simulator.yaml.

    ros2 launch calib_planner simulator.launch.py
    ros2 launch calib_planner simulator.launch.py robot:=ur10e seed:=3
    ros2 launch calib_planner simulator.launch.py namespace:=cell_1 parameters:=/path/to/my.yaml
    ros2 launch calib_planner simulator.launch.py autostart:=false    # a lifecycle manager drives it

A file given as ``parameters`` needs only what differs, such as the faults that are wanted; what there is, with
units and ranges, is in config/simulator.yaml. Arguments that are given win over files; those that are not leave
what the files say.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TRUTH = {"true": True, "false": False}
KINDS = {"robot": str, "seed": int, "autostart": TRUTH.get, "use_sim_time": TRUTH.get}


def node(context: LaunchContext, default: PathJoinSubstitution) -> list[Node]:
    """The node, with the arguments that were given."""
    texts = {name: LaunchConfiguration(name).perform(context) for name in KINDS}
    given = {name: kind(texts[name]) for name, kind in KINDS.items() if texts[name]}
    return [
        Node(
            package="calib_planner",
            executable="simulator_node",
            name="tracker_simulator",
            namespace=LaunchConfiguration("namespace"),
            parameters=[default, LaunchConfiguration("parameters"), *filter(None, [given])],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    default = PathJoinSubstitution([FindPackageShare("calib_planner"), "config", "simulator.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("robot", default_value="", description="shipped robot name"),
            DeclareLaunchArgument("seed", default_value="", description="of true errors, noise and faults"),
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
