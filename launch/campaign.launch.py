"""Starts calibration_campaign, which measures with robot and identifier until the estimate is accurate enough.

    ros2 launch calib_planner campaign.launch.py parameters:=/path/to/my.yaml
    ros2 service call /calibration_campaign/start std_srvs/srv/Trigger
    ros2 topic echo /calibration_campaign/status
    ros2 service call /calibration_campaign/pause std_srvs/srv/Trigger      # resume, skip

The file has to give test_poses, required_accuracy and store_folder. All parameters with their units and ranges
are in config/campaign.yaml. Arguments that are given win over files; those that are not leave what the files say.
The identifier runs with keep_measurements: true and plan_topic: calibration_campaign/plan.
"""

from launch import LaunchDescription

from calib_planner.ros.launching import COMMON, describe

KINDS = {**COMMON}


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` runs."""
    return describe("campaign", "calibration_campaign", KINDS)
