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
    """Part (``planner`` …) → the parameters that the nodes of a cell are started with.

    Args:
        path: The cell's file.
        simulate: Whether ``tracker_simulator`` stands in for robot, controller and tracker.
        executor: Whether ``plan_executor`` moves the robot; without it the simulator does.

    Raises:
        FileFormatError: The file, or one that it names, cannot be used.
        InputError: What it says does not fit the robot.
    """
    cell = read_cell(path)
    robot = cell.load_robot()
    noise = cell.load_noise()
    cell.load_constraints(robot)
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

    own: Parameters = {"cell": str(Path(path).resolve())}
    wanted = {
        "parameters": ",".join(cell.parameters or chain),
        "unknown": ",".join(u for u in cell.unknown or () if u != EVERYTHING_KNOWN),
    }
    sigma = {} if noise is None else {"sigma": noise.typical}
    frame = given(frame_id=cell.base_frame)
    accuracy = given(accuracy_frame=cell.accuracy_frame)
    store = given(store_folder=cell.store_folder)
    pace = given(speed_share=cell.speed_share, settle=cell.settle, dwell=cell.dwell)
    pace |= given(joint_speed=cell.speed, slide_speed=cell.speed)
    locked, controller = given(locked_topics=cell.tracker_locked), given(controller_action=cell.controller)
    parts: dict[str, Parameters] = {
        "planner": own | wanted | sigma | frame | pace,
        "identifier": own
        | wanted
        | sigma
        | frame
        | accuracy
        | store
        | given(
            joint_topics=cell.joint_topics,
            tracker_topics=topics,
            tracker_child_frames=cell.tracker_frames,
            tracker_state_topics=cell.tracker_locked,
        )
        | {"plan_topic": "calibration_campaign/plan", "keep_measurements": True},
        "campaign": own
        | wanted
        | sigma
        | frame
        | accuracy
        | store
        | given(budget=cell.budget, validation=cell.validation, required_accuracy=cell.required_accuracy)
        | {
            "test_poses": "; ".join(" ".join(f"{x:.12g}" for x in row) for row in poses),
            "execute_action": f"{'plan_executor' if executor else 'tracker_simulator'}/execute_plan",
        },
    }
    if executor:
        parts["executor"] = own | pace | locked | controller | given(moveit_group=cell.moveit_group)
    if simulate:
        parts["simulator"] = own | sigma | locked | controller | {"tracker_topics": topics}
    return parts


def tracker_topics(targets: int) -> tuple[str, ...]:
    """The usual topics of the points of so many targets."""
    return ("tracker/point",) if targets == 1 else tuple(f"tracker/point_{k + 1}" for k in range(targets))


def given(**values: Any) -> Parameters:
    """Those that are said."""
    return {name: value for name, value in values.items() if value is not None}
