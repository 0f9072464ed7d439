# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Conditions on configurations: the robot's room, the tracker's view, the user's own.

Every number is in the frame of ``Robot.positions``: the robot's base frame, or the tracker's once the robot's
base pose is set. A configuration is measured with all its targets at once, so a condition on targets holds
for every one of them.
"""

from calib_planner.planning.constraints.room import Custom, JointRange, MinimumHeight, WorkspaceBox
from calib_planner.planning.constraints.tracker import (
    LineOfSight,
    ReflectorAcceptance,
    TrackerElevation,
    TrackerRange,
)
