# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Starts tracker_simulator with config/simulator.yaml.

    ros2 launch calib_planner simulator.launch.py
    ros2 launch calib_planner simulator.launch.py robot:=ur10e seed:=3
    ros2 launch calib_planner simulator.launch.py namespace:=cell_1 params_file:=/path/to/my.yaml
    ros2 launch calib_planner simulator.launch.py autostart:=false    # a lifecycle manager drives it

The file given as ``params_file`` needs to hold only what differs from config/simulator.yaml, such as the faults
that are wanted; all parameters are there with their units and ranges. Arguments that are given win over files;
those that are not leave what the files say.
"""

from launch import LaunchDescription

from calib_planner.ros.launching import describe


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    return describe("simulator", arguments=["seed"])
