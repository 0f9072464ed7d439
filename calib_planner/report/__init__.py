# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Pages for people: the calibration report, the plan sheet, and where a result comes from.

``render`` is the one template engine, also for other packages. docs/glossary.md explains the words.
"""

from calib_planner.report.calibration import InputFile, Provenance, provenance
from calib_planner.report.page import write_report
from calib_planner.report.plan_sheet import posture_drawings, write_sheet, write_sheet_page
from calib_planner.report.render import TEMPLATES, Drawing, embedded, render
from calib_planner.report.robot_drawing import draw_robot
from calib_planner.report.scene import (
    REJECTED,
    USED,
    MeasuredPoints,
    Scene,
    bodies,
    origin_of_points,
    visits_scene,
)
