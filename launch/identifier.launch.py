# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Starts calibration_identifier with config/identifier.yaml.

    ros2 launch calib_planner identifier.launch.py store_folder:=$HOME/calibration
    ros2 launch calib_planner identifier.launch.py robot:=ur10e store_folder:=$HOME/calibration
    ros2 launch calib_planner identifier.launch.py namespace:=cell_1 params_file:=/path/to/my.yaml
    ros2 launch calib_planner identifier.launch.py autostart:=false    # a lifecycle manager drives it

A measurement is in store_folder before it is acknowledged, and a restart with the same folder goes on with what
is there. A URDF heard on robot_description (robot_state_publisher) replaces robot. The file given as
``params_file`` needs to hold only what differs from config/identifier.yaml, where all parameters are with their
units and ranges. Arguments that are given win over files; those that are not leave what the files say. Then:

    ros2 topic echo /calibration_identifier/measurements                    # accepted or rejected, and why
    ros2 topic echo --once /calibration_identifier/estimate
    ros2 service call /calibration_identifier/undo std_srvs/srv/Trigger    # the newest; by id: ~/undo_measurement
    ros2 service call /calibration_identifier/report std_srvs/srv/Trigger
"""

from launch import LaunchDescription

from calib_planner.ros.launching import describe


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    return describe("identifier", arguments=["store_folder"])
