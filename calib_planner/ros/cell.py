# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A cell's file (``cell.yaml``) in the nodes.

A node whose parameter ``cell`` names the file takes the pieces of its problems from there that are more than a
number or a name: the robot with its couplings and targets, the instrument, the constraints, the error model with
payload and mounting. Everything else that the file says becomes parameters (``node_parameters``), which the
launch file passes, so that they can be looked at and overridden.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, TypeAlias

from calib_planner.error_model import ErrorModel
from calib_planner.errors import FileFormatError
from calib_planner.io import EVERYTHING_KNOWN, Cell, planned_error_model, read_cell, read_error_model
from calib_planner.planning import with_wide_placement
from calib_planner.robot import BASE, TARGET, Robot, role_of
from calib_planner.ros.settings import (
    CampaignParameters,
    IdentifierParameters,
    PlannerParameters,
    RobotParameters,
    SimulatorParameters,
)
from calib_planner.tracker import Noise

Parameters: TypeAlias = dict[str, Any]


# ── the pieces of problems ───────────────────────────────────────────────────────────────────────────


def cell_of(settings: RobotParameters | SimulatorParameters) -> Cell | None:
    """The cell of a node; ``None`` if its parameters name none.

    Raises:
        FileFormatError: The file cannot be used.
    """
    if not settings.cell:
        return None
    path = Path(settings.cell).expanduser()
    return _read(path, path.stat().st_mtime_ns if path.is_file() else 0)


@functools.lru_cache(maxsize=4)
def _read(path: Path, changed: int) -> Cell:
    return read_cell(path)


def instrument_of(settings: PlannerParameters | CampaignParameters | SimulatorParameters) -> Noise | None:
    """The instrument of the cell; ``None`` where it names none: the node's ``sigma`` counts."""
    cell = cell_of(settings)
    return None if cell is None else cell.load_noise()


def error_model_of(
    settings: IdentifierParameters | CampaignParameters | SimulatorParameters, robot: Robot | None = None
) -> ErrorModel:
    """How the robot (by default the cell's) errs: as the cell says, or by the node's ``error_model``."""
    cell = cell_of(settings)
    if cell is None:
        return read_error_model(settings.error_model)
    return cell.load_error_model(robot or cell.load_robot())


def planned_model_of(settings: PlannerParameters, wanted: str, robot: Robot, noise: Noise | float) -> ErrorModel:
    """The same for plans, which trust typical values less; ``wanted``: what a request names, or empty."""
    cell = cell_of(settings)
    if cell is None or wanted:
        return planned_error_model(wanted or settings.error_model, robot, noise)
    model = cell.load_error_model(robot)
    return with_wide_placement(model) if (cell.error_model or "typical") == "typical" else model


# ── the parameters of every node ─────────────────────────────────────────────────────────────────────


def node_parameters(path: str | Path, *, simulate: bool, executor: bool) -> dict[str, Parameters]:
    """Part (``planner`` …) → the parameters that the nodes of a campaign are started with.

    Args:
        path: The cell's file; empty for a robot that is chosen otherwise.
        simulate: Whether ``tracker_simulator`` stands in for robot, controller and tracker.
        executor: Whether there is a ``plan_executor``.

    Raises:
        FileFormatError: The file, or one that it names, cannot be used, or does not fit the robot.
    """
    robot = "tracker_simulator" if simulate and not executor else "plan_executor"
    parts: dict[str, Parameters] = {
        "planner": {},
        "identifier": {"plan_topic": "calibration_campaign/plan"},
        "campaign": {"execute_action": f"{robot}/execute_plan"},
        "executor": {},
        "page": {"executor": robot},
        "simulator": {},
    }
    if not executor:
        del parts["executor"]
    if not simulate:
        del parts["simulator"]
    said = _said(read_cell(path), str(Path(path).resolve())) if path else {}
    return {part: said.get(part, {}) | wiring for part, wiring in parts.items()}


def _said(cell: Cell, path: str) -> dict[str, Parameters]:
    """Part → what a cell says about its parameters."""
    robot, noise = cell.load_robot(), cell.load_noise()
    cell.load_constraints(robot)  # what cannot be used is better said before five nodes say it
    cell.load_error_model(robot)
    topics = cell.tracker_topics or tracker_topics(len(robot.targets))
    if len(topics) != len(robot.targets):
        expected = f"{len(robot.targets)} topics, as the robot has targets"
        raise FileFormatError(cell.path, "tracker-topics", f"{len(topics)} topics", expected)
    poses = cell.load_test_poses(robot)
    if poses is None:
        expected = "test-pose or test-path: where accuracy matters"
        raise FileFormatError(cell.path, "test-pose", "no such key", expected)

    chain = tuple(name for name in robot.parameter_names if role_of(name) not in (BASE, TARGET))
    own: Parameters = {"cell": path}
    measured = own | _known(
        parameters=",".join(cell.parameters or chain),
        unknown=",".join(u for u in cell.unknown or () if u != EVERYTHING_KNOWN),
        sigma=None if noise is None else noise.typical,
        frame_id=cell.base_frame,
    )
    results = measured | _known(accuracy_frame=cell.accuracy_frame, store_folder=cell.store_folder)
    pace = _known(
        joint_speed=cell.speed,
        slide_speed=cell.speed,
        speed_share=cell.speed_share,
        settle=cell.settle,
        dwell=cell.dwell,
    )
    controlled = own | _known(tracker_state_topics=cell.tracker_state_topics, controller_action=cell.controller)
    return {
        "planner": measured | pace | _known(accuracy_frame=cell.accuracy_frame),
        "identifier": results
        | _known(
            joint_topics=cell.joint_topics,
            tracker_topics=topics,
            tracker_child_frames=cell.tracker_frames,
            tracker_state_topics=cell.tracker_state_topics,
        ),
        "campaign": results
        | _known(
            test_poses="; ".join(" ".join(f"{x:.12g}" for x in row) for row in poses),
            required_accuracy=cell.required_accuracy,
            budget=cell.budget,
            validation=cell.validation,
        ),
        "executor": controlled | pace | _known(moveit_group=cell.moveit_group, joint_topics=cell.joint_topics),
        "page": own | _known(joint_topics=cell.joint_topics, report_folder=cell.store_folder),
        "simulator": controlled | _known(tracker_topics=topics, sigma=None if noise is None else noise.typical),
    }


def tracker_topics(targets: int) -> tuple[str, ...]:
    """The usual topics of the points of so many targets."""
    return ("tracker/point",) if targets == 1 else tuple(f"tracker/point_{k + 1}" for k in range(targets))


def _known(**values: Any) -> Parameters:
    """Those that the cell says."""
    return {name: value for name, value in values.items() if value is not None}
