# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How robots err: one file a term, ``ErrorModel`` that composes them, and ``Knowledge`` that predicts.

docs/glossary.md explains the words.
"""

from calib_planner.error_model.gravity import LINKS, Gravity, Mass, Payload, downwards, gravity_of
from calib_planner.error_model.joint_functions import JointFunctions
from calib_planner.error_model.knowledge import (
    ACCURACIES,
    FELT,
    Knowledge,
    accuracy_rows,
    covariance,
    error_variance,
    without_rigid_motion,
)
from calib_planner.error_model.model import MEANINGS, ErrorModel, Scale
from calib_planner.error_model.placement import ZERO, Placement
from calib_planner.error_model.points import Points
from calib_planner.error_model.poses import Poses, joint_units
from calib_planner.error_model.prior import Prior
from calib_planner.error_model.saved import from_mapping, to_mapping
from calib_planner.error_model.truth import Truth, VisitErrors
from calib_planner.error_model.typical import typical, typical_prior, with_tolerances
from calib_planner.error_model.visits import Visits
