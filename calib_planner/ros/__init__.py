# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 nodes and what they share: the only room that imports rclpy and messages.

It offers no names, so that a node which starts imports only the files that it needs.
docs/glossary.md explains the words.
"""
