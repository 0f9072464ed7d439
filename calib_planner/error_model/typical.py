"""What is expected of a robot that nobody has measured: ``config/error_models/typical.yaml``."""

from __future__ import annotations

from functools import cache
from typing import Any

import yaml

from calib_planner.error_model.gravity import Gravity
from calib_planner.error_model.joint_functions import JointFunctions
from calib_planner.error_model.model import ErrorModel, Scale
from calib_planner.error_model.placement import Placement
from calib_planner.error_model.points import Points
from calib_planner.error_model.visits import Visits
from calib_planner.instrument.noise import Noise
from calib_planner.robot.catalogue import config_folder


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
    scales = typical_scales()
    return ErrorModel(placed, elastic, JointFunctions(), Visits(), points, scales, "typical")


@cache
def typical_scales() -> tuple[Scale, ...]:
    """The scales of the shipped file, each at its median."""
    path = config_folder() / "error_models" / "typical.yaml"
    rows: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))["scales"]
    return tuple(Scale(name, r["median"], r["median"], r["factor"], r["unit"]) for name, r in rows.items())
