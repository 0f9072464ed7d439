# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Starts all that a real cell needs for a campaign: planner, identifier, executor, campaign and page.

    ros2 launch calib_planner campaign.launch.py cell:=cell.yaml
    ros2 launch calib_planner campaign.launch.py cell:=cell.yaml simulate:=true   # to try it
    ros2 launch calib_planner campaign.launch.py cell:=left.yaml namespace:=left  # one of two cells

The file of the cell says which robot, tracker, controller and topics there are, where accuracy matters and how
much of it, and where results are stored: docs/reference/cell.md. Parameters that it does not have can be given
by params_file. The robot moves when the campaign is started, on the page, whose address is in the log, or by

    ros2 service call /calibration_campaign/start std_srvs/srv/Trigger      # pause, resume, skip
    ros2 topic echo /calibration_campaign/status
    ros2 service call /plan_executor/stop std_srvs/srv/Trigger              # no emergency stop

Without control_msgs there is no executor, without the page's library no page: that is said at the start.
"""

from launch import LaunchDescription

from calib_planner.ros.launching import describe_campaign


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    return describe_campaign()
