# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Starts calibration_planner with config/planner.yaml, and RViz with rviz:=true.

    ros2 launch calib_planner planner.launch.py
    ros2 launch calib_planner planner.launch.py robot:=ur10e rviz:=true
    ros2 launch calib_planner planner.launch.py namespace:=cell_1 params_file:=/path/to/my.yaml
    ros2 launch calib_planner planner.launch.py autostart:=false    # a lifecycle manager drives it

A URDF heard on robot_description (robot_state_publisher) replaces robot. The file given as ``params_file`` needs
to hold only what differs from config/planner.yaml, where all parameters are with their units and ranges.
Arguments that are given win over files; those that are not leave what the files say. Then:

    ros2 service call /calibration_planner/request_plan calib_planner_msgs/srv/PlanCalibration \
        "{request: {test_poses: [{positions: [0, -1.047, 1.571, 0, 0.785, 0]}], configurations: 12}}"
"""

from launch import LaunchDescription

from calib_planner.ros.launching import describe


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    return describe("planner", rviz=True)
