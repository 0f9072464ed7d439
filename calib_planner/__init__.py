"""Robot calibration with a laser tracker: where to measure, and what the measurements say.

``Robot`` → ``PlanProblem`` → ``plan`` → ``Plan``;
``Measurements`` → ``IdentificationProblem`` → ``identify`` → ``Estimate``.

Nothing here needs ROS; the nodes live in ``calib_planner.ros``.
"""

from calib_planner.design.plan import Plan
from calib_planner.design.planner import Progress, plan
from calib_planner.design.problem import PlanProblem
from calib_planner.errors import (
    CalibPlannerError,
    FileFormatError,
    InfeasibleError,
    InputError,
    NotEnoughDataError,
    UnknownNameError,
)
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.solver import identify
from calib_planner.identification.validation import validate
from calib_planner.robot.chain import Robot

__version__ = "0.1.0"

__all__ = [
    "CalibPlannerError",
    "Estimate",
    "FileFormatError",
    "IdentificationProblem",
    "InfeasibleError",
    "InputError",
    "Measurements",
    "NotEnoughDataError",
    "Plan",
    "PlanProblem",
    "Progress",
    "Robot",
    "UnknownNameError",
    "identify",
    "plan",
    "validate",
]
