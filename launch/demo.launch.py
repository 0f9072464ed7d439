# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Starts planner, identifier and simulated tracker; then ask for a plan and have it executed.

    ros2 launch calib_planner demo.launch.py robot:=kuka_kr270 seed:=1 save_folder:=$HOME/calibration rviz:=true
    ros2 service call /calibration_planner/request_plan calib_planner_msgs/srv/PlanCalibration \
        "{request: {test_poses: [{positions: [0, -1.047, 1.571, 0, 0.785, 0]}], configurations: 12}}"
    ros2 service call /tracker_simulator/execute std_srvs/srv/Trigger   # executes the newest plan
    ros2 topic echo /calibration_identifier/estimate                # after every accepted configuration
    ros2 service call /calibration_identifier/save std_srvs/srv/Trigger

The whole in one command, with a table and a picture at the end: python3 -m calib_planner.ros.demo
"""

from launch import LaunchDescription

from calib_planner.ros.launching import describe


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    arguments = ["seed", "store_folder", "save_folder"]
    return describe("planner", "identifier", "simulator", arguments=arguments, rviz=True)
