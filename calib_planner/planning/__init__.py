# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Where to measure: a plan problem, the verb ``plan``, the plan, and how good it provably is.

docs/glossary.md explains the words.
"""

from calib_planner.planning.bound import candidate_design
from calib_planner.planning.budget import (
    Split,
    plan_for_accuracy,
    plan_for_accuracy_in_time,
    plan_for_time,
    split_budget,
)
from calib_planner.planning.certify.prove import PROOF_STATUS
from calib_planner.planning.constraints import (
    Custom,
    JointRange,
    LineOfSight,
    MinimumHeight,
    ReflectorAcceptance,
    TrackerElevation,
    TrackerRange,
    WorkspaceBox,
)
from calib_planner.planning.constraints.self_collision import SelfCollision
from calib_planner.planning.criteria import CRITERIA, POSE_CRITERIA, Determinant
from calib_planner.planning.extended import UNCERTAIN
from calib_planner.planning.feasibility import Constraint, Feasibility
from calib_planner.planning.information import (
    InformationModel,
    plan_space,
    smallest_size,
)
from calib_planner.planning.parallel import processes
from calib_planner.planning.planner import Callback, Progress, judged, plan
from calib_planner.planning.problem import (
    GENERAL_SHARE,
    PAPERS_SHARE,
    Candidates,
    PlanProblem,
    Search,
    usual_error_model,
    with_wide_placement,
)
from calib_planner.planning.random_plans import Comparison, compare, random_accuracies
from calib_planner.planning.result import KEYS, KINDS, STATUS, Plan, PlannedTerm, PlanQuality
from calib_planner.planning.search.exchange import ChoiceProblem, choose
from calib_planner.planning.sheet import NEVER, PlanSheet, person_factors, plan_sheet
from calib_planner.planning.tour import (
    BACK_OFF,
    DWELL,
    PEAK,
    SETTLE,
    Pace,
    Timetable,
    backed_off,
    near,
    timetable,
    usual_pace,
    visit_times,
    visiting_order,
)
from calib_planner.planning.trajectory import Trajectory, joined, smooth, smooth_trajectory
