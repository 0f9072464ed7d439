# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The robot: a chain of elementary transforms with named parameters, its kinematics,
and which of its parameters data can identify.

docs/glossary.md explains the words.
"""

from calib_planner.robot.capsules import Capsules, segments
from calib_planner.robot.chain import Robot, register_file_reader, target_elements
from calib_planner.robot.coupling import Coupling, parse_coupling
from calib_planner.robot.elements import (
    KINDS,
    ROW_TYPES,
    DhRow,
    Element,
    dh_elements,
    dh_levels,
    pose_elements,
    re_placed,
    roll_pitch_yaw,
    rotation,
)
from calib_planner.robot.identifiability import NO_LEVER, Identifiability, analyse, describe
from calib_planner.robot.inverse import Goals, goals_of, residuals, solve
from calib_planner.robot.limits import believable_limits, check_reflectors, limit_remarks
from calib_planner.robot.linearisation import Layout, Linearisation, Posture
from calib_planner.robot.masses import LinkMass, lumped
from calib_planner.robot.origins import (
    JointOrigins,
    Origin,
    joint_origins,
    not_in_origins,
    pose_of,
    with_origins,
)
from calib_planner.robot.parameters import (
    BASE,
    BASE_PARAMETERS,
    TARGET,
    Parameter,
    check_joint_names,
    grouped,
    is_nuisance,
    role_of,
    target_parameters,
)
