"""How robots err: one file a term, ``ErrorModel`` that composes them, typical values, and the saved form."""

from calib_planner.error_model.gravity import Gravity, Mass
from calib_planner.error_model.joint_functions import JointFunctions
from calib_planner.error_model.model import ErrorModel, Scale
from calib_planner.error_model.placement import Placement
from calib_planner.error_model.points import Points
from calib_planner.error_model.poses import Poses
from calib_planner.error_model.typical import typical
from calib_planner.error_model.visits import Visits

__all__ = [
    "ErrorModel",
    "Gravity",
    "JointFunctions",
    "Mass",
    "Placement",
    "Points",
    "Poses",
    "Scale",
    "Visits",
    "typical",
]
