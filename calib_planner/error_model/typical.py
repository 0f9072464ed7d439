# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What is expected of a robot that nobody has measured: all terms, at sizes that measured robots have.

The sizes are those of measured industrial robots: of each scale the median, and the factor that one standard
deviation of its logarithm is. The data decide within these. ``config/error_models/typical.yaml`` holds the same
model as a file to begin from.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_planner.error_model.gravity import Gravity
from calib_planner.error_model.joint_functions import JointFunctions
from calib_planner.error_model.model import ErrorModel, Scale
from calib_planner.error_model.placement import Placement, is_placement
from calib_planner.error_model.points import Points
from calib_planner.error_model.prior import Prior
from calib_planner.error_model.visits import Visits
from calib_planner.robot import Robot
from calib_planner.tracker import Noise

SCALES = tuple(
    Scale(name, median, median, factor, unit)
    for name, median, factor, unit in (
        ("placement.length", 5.0e-4, 4.0, "m"),  # lengths of the chain from the data sheet
        ("placement.angle", 1.0e-3, 4.0, "rad"),  # angles between its axes
        ("gravity", 1.5e-3, 4.0, "rad/m"),  # joints under a unit weight
        ("smooth.size", 3.0e-4, 4.0, "rad"),  # joint functions of a few waves a turn
        ("smooth.length", 1.0, 1.5, "rad"),
        ("short.size", 2.0e-4, 4.0, "rad"),  # joint functions of some degrees
        ("short.length", 0.07, 1.5, "rad"),
        ("repeatability", 5.0e-5, 3.0, "rad"),  # of a joint, from visit to visit
        ("shared", 2.0e-5, 3.0, "m"),  # shift that the targets of a visit share
        ("instrument", 1.0, 1.5, "1"),  # factor on the stated noise of the instrument
        ("floor", 2.0e-5, 3.0, "m"),  # of a point, beside the instrument's noise
    )
)
"""Every scale at its median."""


def typical(
    noise: Noise | None = None,
    *,
    placement: Placement | None = None,
    gravity: Gravity | None = None,
    estimate_scale: bool = False,
) -> ErrorModel:
    """All terms with typical scales.

    Args:
        noise: The instrument, if it is known.
        placement: What is known of the chain; default: typical tolerances.
        gravity: What hangs on the joints and how the robot is mounted; default: unknown masses, on the floor.
        estimate_scale: Whether the data decide by which factor the instrument's statement is wrong.
    """
    placed = Placement() if placement is None else placement
    elastic = Gravity() if gravity is None else gravity
    points = Points(noise, estimate_scale)
    return ErrorModel(placed, elastic, JointFunctions(), Visits(), points, SCALES, "typical")


def with_tolerances(model: ErrorModel) -> ErrorModel:
    """The model with typical tolerances of the chain, which the data have no say in where it had none."""
    if model.placement.prior == "tolerance":
        return model
    known = tuple(replace(s, factor=1.0) for s in SCALES if s.name in Placement().scales)
    return replace(model, placement=replace(model.placement, prior="tolerance"), scales=(*model.scales, *known))


def typical_prior(robot: Robot) -> Prior | None:
    """Nominal values with typical tolerances for the active parameters of the chain; ``None``: there are none."""
    rows = np.flatnonzero(is_placement(robot.parameter_names))
    if not rows.size:
        return None
    values = {s.name: s.value for s in SCALES}
    std = np.sqrt(Placement().variances(robot, values)[rows])
    nominal = np.array([p.nominal for p in robot.parameters])[rows]
    text = f"typical: {1e3 * values['placement.length']:g} mm, {1e3 * values['placement.angle']:g} mrad"
    return Prior(tuple(robot.parameter_names[i] for i in rows), nominal, std, text)
