# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""From streams of joint states and tracker points to standstills: stamps, clocks and intake.

docs/glossary.md explains the words.
"""

from calib_planner.acquisition.clocks import Offset
from calib_planner.acquisition.intake import (
    DROPPED,
    OTHER_FRAME,
    UNFIT,
    UNREADABLE,
    UNSTAMPED,
    Intake,
    StreamCount,
)
from calib_planner.acquisition.messages import (
    JOINT_STATE,
    POINT,
    POINTS,
    STATE,
    TRANSFORMS,
    JointReader,
    PointLike,
    pick_joints,
    points_in,
    stamp_of,
)
from calib_planner.acquisition.standstill import (
    IN_A_ROW,
    NANO,
    REJECTIONS,
    Rejection,
    RejectionReason,
    Standstill,
    StandstillDetector,
    StandstillSettings,
    mean_std,
)
