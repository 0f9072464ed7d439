# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint configurations as messages hold them."""

from __future__ import annotations

from collections.abc import Iterable

from calib_planner_msgs.msg import JointConfiguration


def poses(*rows: Iterable[float]) -> list[JointConfiguration]:
    """A message for each row of joint coordinates [rad | m]."""
    return [JointConfiguration(positions=list(row)) for row in rows]
