# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Files in and out: robots, measurements, plans, estimates, priors, constraints, bags and stored campaigns.

Importing this room teaches ``Robot.load`` to read files; every other file is imported when it is first used.

docs/glossary.md explains the words.
"""

from typing import TYPE_CHECKING

from calib_planner.doors import lazy_door
from calib_planner.io.robots import URDF_SUFFIXES, Robot, config_folder, shipped_robots

if TYPE_CHECKING:
    from calib_planner.io.bag import read_bag
    from calib_planner.io.cell import (
        CELL_KEYS,
        EITHER,
        EVERYTHING_KNOWN,
        NAMED_MODELS,
        ROS_KEYS,
        Cell,
        read_cell,
        write_cell,
    )
    from calib_planner.io.conditions import planned_error_model, read_constraints, read_instrument, read_vertical
    from calib_planner.io.csv import format_table, measurements_text, write_configurations, write_measurements
    from calib_planner.io.data import (
        in_units,
        is_bag,
        read_configurations,
        read_data,
        read_joints,
        read_plan_csv,
        with_units,
    )
    from calib_planner.io.error_model import read_error_model, write_error_model
    from calib_planner.io.estimate import (
        SavedEstimate,
        calibrated_robot,
        placement,
        read_estimate,
        write_estimate,
    )
    from calib_planner.io.kinematics import read_kinematics, write_kinematics
    from calib_planner.io.plan import (
        SHARE,
        SHEET_FILES,
        WORDS,
        read_plan,
        robot_pace,
        write_plan,
        write_sheet_csv,
        write_sheet_yaml,
        write_trajectory,
    )
    from calib_planner.io.prior import read_prior
    from calib_planner.io.programs import (
        HANDSHAKES,
        SETTLE,
        SPEED_SHARE,
        ProgramFormat,
        ProgramSettings,
        controller_axes,
        program_formats,
        program_name,
        program_text,
        read_program_format,
        write_program,
    )
    from calib_planner.io.sizes import angle_factors
    from calib_planner.io.sources import Sources, read_source, read_sources
    from calib_planner.io.store import (
        ACCEPTED,
        CLOCK_OFFSET,
        DECISIONS,
        KEPT,
        LONGEST,
        NOT_IN_PLAN,
        NOT_STORED,
        OUTLIER,
        UNDONE,
        CampaignStore,
        NamedPlan,
        Record,
        SessionStore,
        StoredModel,
        StoredSession,
        UnavailableStore,
        begin_campaign,
        open_campaign,
        open_store,
        stored_goals,
        stored_model,
    )
    from calib_planner.io.text import check_writable, fresh_folder, make_folder, read_text, user_path, write_text
    from calib_planner.io.understanding import BagTopics, JointTable, Reading, Source, Understanding
    from calib_planner.io.urdf import (
        calibrated_urdf,
        parse_chain,
        parse_speed_limits,
        parse_urdf,
        read_chain,
        read_speed_limits,
        require_urdf,
        write_calibrated_urdf,
    )
    from calib_planner.io.urdf_tree import UrdfChain
    from calib_planner.io.xacro import read_urdf_text, split_arguments
else:
    __getattr__, __dir__, __all__ = lazy_door(
        __name__,
        {
            "bag": "read_bag",
            "cell": "CELL_KEYS EITHER EVERYTHING_KNOWN NAMED_MODELS ROS_KEYS Cell read_cell write_cell",
            "conditions": "planned_error_model read_constraints read_instrument read_vertical",
            "csv": "format_table measurements_text write_configurations write_measurements",
            "data": "in_units is_bag read_configurations read_data read_joints read_plan_csv with_units",
            "error_model": "read_error_model write_error_model",
            "estimate": "SavedEstimate calibrated_robot placement read_estimate write_estimate",
            "kinematics": "read_kinematics write_kinematics",
            "plan": "SHARE SHEET_FILES WORDS read_plan robot_pace write_plan write_sheet_csv write_sheet_yaml "
            "write_trajectory",
            "prior": "read_prior",
            "programs": "HANDSHAKES SETTLE SPEED_SHARE ProgramFormat ProgramSettings controller_axes "
            "program_formats program_name program_text read_program_format write_program",
            "sizes": "angle_factors",
            "sources": "Sources read_source read_sources",
            "store": "ACCEPTED CLOCK_OFFSET DECISIONS KEPT LONGEST NOT_IN_PLAN NOT_STORED OUTLIER UNDONE "
            "SessionStore CampaignStore NamedPlan Record StoredSession StoredModel UnavailableStore "
            "begin_campaign open_campaign open_store stored_goals stored_model",
            "text": "check_writable fresh_folder make_folder read_text user_path write_text",
            "understanding": "BagTopics JointTable Reading Source Understanding",
            "urdf": "calibrated_urdf parse_chain parse_speed_limits parse_urdf read_chain read_speed_limits "
            "require_urdf write_calibrated_urdf",
            "urdf_tree": "UrdfChain",
            "xacro": "read_urdf_text split_arguments",
        },
        "Robot",
        "URDF_SUFFIXES",
        "config_folder",
        "shipped_robots",
    )
