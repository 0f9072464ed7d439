# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the measurements say: a problem, the verb ``identify``, the estimate, its validation and verdict.

docs/glossary.md explains the words.
"""

from calib_planner.identification.alternatives import Alternative
from calib_planner.identification.doubt import gate_of
from calib_planner.identification.estimate import (
    FOREMOST,
    LEVELS,
    STATUS,
    STRONG,
    Accuracy,
    ChiSquare,
    Estimate,
    LeftOutError,
    Observability,
    ParameterFit,
    PointNoise,
    Points,
    Reason,
    Residuals,
    ResidualStatistics,
    Validation,
    Verdict,
    chance_of,
    without_noise,
)
from calib_planner.identification.estimation import (
    ModelEstimate,
    PlacementAlone,
    fit_error_model,
    placement_alone,
)
from calib_planner.identification.problem import LOSSES, IdentificationProblem
from calib_planner.identification.registration import Misplacement, find_misplacement
from calib_planner.identification.solver import check_units, identify, place_nominal, start_robot
from calib_planner.identification.term_gain import TermGain
from calib_planner.identification.validation import normalised, validate
from calib_planner.identification.verdict import RULES, Rule, judge, judged
