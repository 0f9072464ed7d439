"""What the measurements say: a problem, the verb ``identify``, the estimate, its validation and verdict.

docs/glossary.md explains the words.
"""

from calib_planner.identification.checks import FEWEST, SIGNIFICANT, check_units
from calib_planner.identification.estimate import (
    LEVELS,
    STATUS,
    STRONG,
    Accuracy,
    ChiSquare,
    Diagnostics,
    Estimate,
    Learnt,
    LeftOutError,
    Observability,
    ParameterFit,
    Points,
    Reason,
    Residuals,
    Validation,
    Verdict,
    without_noise,
)
from calib_planner.identification.estimation import ModelEstimate, fit_error_model
from calib_planner.identification.evidence import fit_placement
from calib_planner.identification.least_squares import SAME_JOINT, configuration_labels
from calib_planner.identification.noise_levels import DOUBT, FEWEST_SPARE, NoiseLevels, improbable
from calib_planner.identification.problem import (
    ACCURACIES,
    AUTOMATIC,
    LOSSES,
    UPDATE,
    WITHOUT_MODEL,
    IdentificationProblem,
    Prior,
    typical_prior,
)
from calib_planner.identification.robust import normalised
from calib_planner.identification.solver import identify
from calib_planner.identification.start import start_robot
from calib_planner.identification.transmission import JointCorrections, phases
from calib_planner.identification.validation import cross_validate, validate
from calib_planner.identification.verdict import RULES, Rule, judge, judged
