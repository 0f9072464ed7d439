# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""From a request for a plan to a plan, or to a refusal that names the field: no node, no executor.

The request is the same for service and action. It comes from anyone, so the robot must
be the node's own or a shipped one (never a path), and sizes are bounded.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from builtin_interfaces.msg import Duration
from calib_planner_msgs.msg import PlanRequest

from calib_planner.arrays import FloatArray
from calib_planner.error_model import ACCURACIES
from calib_planner.errors import InfeasibleError, InputError
from calib_planner.io import NAMED_MODELS, config_folder, read_constraints
from calib_planner.planning import (
    Callback,
    Candidates,
    Constraint,
    Pace,
    Plan,
    PlanProblem,
    Search,
    plan,
    plan_for_time,
)
from calib_planner.robot import Robot
from calib_planner.ros.cell import cell_of, instrument_of, planned_model_of
from calib_planner.ros.messages import check_rows, pace_of, seconds_of
from calib_planner.ros.model import Model, NotReady, shipped_model
from calib_planner.ros.settings import PaceParameters, PlannerParameters, PlanParameters, unknown_words
from calib_planner.units import brief, cut

MOST_PARAMETERS = 1000
RANGES = {item.name: item.metadata for item in fields(PlannerParameters)}
MOST_COORDINATES = 3000
"""Configurations times joints: the search holds a square matrix of that size (100 MB with its copies)."""
FIELD_OF = {"weights": "test_pose_weights"}
"""Field of ``PlanProblem`` → field of the request, where the names differ."""


@dataclass(frozen=True)
class Answer:
    """The answer to a request.

    Attributes:
        status: Name of a status constant of PlanCalibration.
        field: Field of the request at fault; empty if none.
        message: The outcome and what to do.
        plan: The plan, if there is a usable one.
        model: The robot that the plan is for.
    """

    status: str
    field: str
    message: str
    plan: Plan | None = None
    model: Model | None = None


def answer(
    request: PlanRequest,
    settings: PlannerParameters,
    own: Model | NotReady,
    callback: Callback | None = None,
) -> Answer:
    """Make the plan of a request; every fault of the request becomes an ``Answer``."""
    try:
        model = _model(request, settings, own)
        made = _planned(problem_of(request, settings, model), request, settings, model, callback)
    except NotReady as error:
        return Answer("NOT_READY", "robot", cut(error))
    except InputError as error:
        name = error.field[: re.match(r"\w*", error.field).end()]  # type: ignore[union-attr]
        return Answer("INVALID_REQUEST", FIELD_OF.get(name, name), cut(error))
    except InfeasibleError as error:
        return Answer("INFEASIBLE", cut(error.constraint), cut(error))
    if made.quality.status == "singular":
        return Answer("INFEASIBLE", "configurations", made.quality.message)
    status = "CANCELLED" if made.quality.status == "cancelled" else "SUCCESS"
    return Answer(status, "", made.quality.message, made, model)


def _planned(
    problem: PlanProblem,
    request: PlanRequest,
    settings: PlannerParameters,
    model: Model,
    callback: Callback | None,
) -> Plan:
    """The plan of as many configurations as the request wants, or for the time of the node's parameters."""
    budget = _number(request, settings, "time_budget")
    if budget == 0 or int(request.configurations):
        return plan(problem, callback)
    return plan_for_time(problem, plan_pace(settings, model), budget, callback=callback).plan


def plan_pace(settings: PaceParameters, model: Model) -> Pace:
    """How fast the robot moves and is measured, by the node's parameters and the robot description."""
    share = settings.speed_share
    speeds = (share * settings.joint_speed, share * settings.slide_speed, share * model.speeds)
    return pace_of(model.robot, *speeds, settings.dwell, settings.settle)


def problem_of(request: PlanRequest, settings: PlannerParameters, model: Model) -> PlanProblem:
    """The library's problem of a request; zero and empty fields take the node's defaults.

    Raises:
        InputError: A field is not usable.
        InfeasibleError: No plan can satisfy the request.
    """
    robot = model.robot
    poses = check_rows("test_poses", request.test_poses, robot.joint_names, least=0)
    if len(poses) > settings.most_test_poses:
        raise InputError("test_poses", f"{len(poses)} poses", f"at most {settings.most_test_poses}")
    size = int(request.configurations) or settings.configurations
    if size > settings.most_configurations:
        advice = "raise the node's parameter most_configurations if you mean it"
        raise InputError("configurations", size, f"at most {settings.most_configurations}", advice)
    if size * len(robot.joint_names) > MOST_COORDINATES:
        most = f"at most {MOST_COORDINATES // len(robot.joint_names)} for {len(robot.joint_names)} joints"
        raise InputError("configurations", size, most)
    criterion = request.criterion or settings.criterion
    candidates = _candidates(request, settings, robot)
    noise = (None if request.sigma else instrument_of(settings)) or _number(request, settings, "sigma")
    _word(request, settings, "error_model", NAMED_MODELS)
    return PlanProblem(
        robot,
        poses,
        size,
        repetitions=int(request.repetitions) or settings.repetitions,
        weights=_weights(request),
        noise=noise,
        criterion=criterion,
        constraints=constraints_of(settings, robot),
        error_model=planned_model_of(settings, request.error_model, robot, noise),
        accuracy_frame=_word(request, settings, "accuracy_frame", ACCURACIES),
        search=Search(
            starts=settings.starts or None,
            seed=int(request.seed),
            time_limit=_number(request, settings, "time_limit"),
        ),
        candidates=candidates,
    )


def _number(request: PlanRequest, settings: PlannerParameters, name: str) -> float:
    """A number of the request, in the range of the node's parameter of that name; for 0 the parameter's value."""
    given = getattr(request, name)
    value = seconds_of(given) if isinstance(given, Duration) else float(given)
    if value == 0:
        return float(getattr(settings, name))
    low, high, unit = (RANGES[name][key] for key in ("low", "high", "unit"))
    if not low <= value <= high:
        raise InputError(name, value, f"0 (the node's default), or {low:g} to {high:.15g} {unit}")
    return value


def _word(request: PlanRequest, settings: PlannerParameters, name: str, valid: Sequence[str]) -> str:
    """A word of the request, one of ``valid``; for an empty one the value of the parameter of that name."""
    word = str(getattr(request, name))
    if word and word not in valid:
        raise InputError(name, brief(word, 100), f"empty (the node's default), or one of: {', '.join(valid)}")
    return word or str(getattr(settings, name))


def constraints_of(settings: PlanParameters, robot: Robot) -> tuple[Constraint, ...]:
    """The constraints of the cell, or of the file that the node's parameters name.

    Raises:
        InputError: The name leaves the folder, or the file does not fit the robot.
    """
    cell = cell_of(settings)
    if cell is not None:
        return cell.load_constraints(robot)
    if not settings.constraints:
        return ()
    folder = settings.constraints_folder
    path = file_in(Path(folder).expanduser() if folder else config_folder(), settings.constraints, "constraints")
    return read_constraints(path, robot)


def file_in(folder: Path, name: str, field: str) -> Path:
    """The file ``name`` in ``folder`` itself; anyone may set parameters, and no path leads out of the folder.

    Raises:
        InputError: Not the plain name of an existing file there.
    """
    path = folder / Path(name).name
    plain = bool(name) and path.name == name and name not in (".", "..") and "\0" not in name
    if not plain or path.resolve().parent != folder.resolve() or not path.is_file():
        raise InputError(field, brief(name, 100), f"the name of a file in {folder}")
    return path


def _candidates(request: PlanRequest, settings: PlannerParameters, robot: Robot) -> Candidates | None:
    if not request.candidates:
        return None
    rows = check_rows("candidates", request.candidates, robot.joint_names)
    if len(rows) > settings.most_candidates:
        advice = "raise the node's parameter most_candidates if you mean it"
        raise InputError("candidates", f"{len(rows)} rows", f"at most {settings.most_candidates}", advice)
    robot.check_within_limits("candidates", rows)  # a robot may be sent there
    return Candidates(rows)


def _weights(request: PlanRequest) -> FloatArray | None:
    """(t,) weights, divided by the largest, since only ratios matter and sums of huge weights overflow."""
    given = np.asarray(request.test_pose_weights, float)
    if not given.size:
        return None
    largest = float(given.max())
    return given / largest if 0 < largest < np.inf else given


def _model(request: PlanRequest, settings: PlannerParameters, own: Model | NotReady) -> Model:
    """The robot of a request: the node's own, or the shipped one that it names."""
    names = list(request.parameters)
    if len(names) > MOST_PARAMETERS:
        raise InputError("parameters", f"{len(names)} names", f"at most {MOST_PARAMETERS}")
    wanted = names or settings.parameters
    if isinstance(own, Model) and request.robot in ("", own.robot.name):
        robot = own.robot.with_parameters(wanted, unknown_words(settings.unknown))
        return Model(robot, own.speeds)
    if not request.robot and isinstance(own, NotReady):
        raise own
    return shipped_model(request.robot, wanted, settings.unknown)
