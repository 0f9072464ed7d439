# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Work-arounds of rclpy, the only place that touches its private attributes or overrides its private methods.

Each file opens with what rclpy (7.1, ROS 2 Jazzy) does, why that does not serve, the issue upstream, and what
would make the file superfluous; ``test/ros/test_rclpy_ext.py`` shows rclpy's own behaviour to be as described and
fails as soon as it is not. Nothing here knows the nodes of this package.
"""
