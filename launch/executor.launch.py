# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Starts plan_executor with config/executor.yaml: it moves a real robot by a FollowJointTrajectory controller.

    ros2 launch calib_planner executor.launch.py robot:=ur10e
    ros2 launch calib_planner executor.launch.py namespace:=cell_1 params_file:=/path/to/my.yaml
    ros2 launch calib_planner executor.launch.py autostart:=false    # a lifecycle manager drives it

A URDF heard on robot_description (robot_state_publisher) replaces robot. The file given as ``params_file`` needs
to hold only what differs from config/executor.yaml, where all parameters are with their units and ranges.
Arguments that are given win over files; those that are not leave what the files say. Then:

    ros2 service call /plan_executor/execute std_srvs/srv/Trigger      # the planner's newest plan
    ros2 service call /plan_executor/stop std_srvs/srv/Trigger         # no emergency stop
"""

from launch import LaunchDescription

from calib_planner.ros.launching import describe


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    return describe("executor")
