"""From a request on the wire to a plan or a refusal with its field: no node, no executor.

The request is the service's or the action's (same fields). It comes from anyone, so the robot must be the
node's own or a shipped one (never a path), and sizes are bounded.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.errors import InfeasibleError, InputError
from calib_planner.io import config_folder, read_constraints
from calib_planner.planning import (
    Candidates,
    Constraint,
    ModelDiscrepancy,
    Plan,
    PlanProblem,
    Progress,
    Search,
    plan,
)
from calib_planner.robot import Robot
from calib_planner.ros.messages import check_rows
from calib_planner.ros.model import Model, NotReady, shipped_model
from calib_planner.ros.settings import PlannerParameters, unknown_words
from calib_planner.units import brief, cut

MOST_PARAMETERS = 1000
SMALLEST_SIGMA = 1e-9
"""As the node's parameter: far below any instrument, far above what overflows when squared."""
MOST_COORDINATES = 3000
"""Configurations times joints: the search keeps a square matrix of them (100 MB with its copies)."""
FIELD_OF = {"weights": "test_pose_weights"}
"""The request's word for a field of ``PlanProblem``, where they differ."""

Callback = Callable[[Progress], bool | None]


@dataclass(frozen=True)
class Answer:
    """What became of a request.

    Attributes:
        status: Name of a status constant of PlanCalibration.
        field: Request field at fault; empty if none.
        message: The outcome and what to do.
        plan: The plan, if there is a usable one.
        model: The robot it is for.
    """

    status: str
    field: str
    message: str
    plan: Plan | None = None
    model: Model | None = None


def answer(
    request: Any,
    settings: PlannerParameters,
    own: Model | NotReady,
    callback: Callback | None = None,
) -> Answer:
    """Plan what is asked; every fault of the request becomes an ``Answer``."""
    try:
        model = _model(request, settings, own)
        found = plan(problem_of(request, settings, model), callback)
    except NotReady as error:
        return Answer("NOT_READY", "robot", cut(error))
    except InputError as error:
        field = re.match(r"\w*", error.field)
        name = field[0] if field else ""
        return Answer("INVALID_REQUEST", FIELD_OF.get(name, name), cut(error))
    except InfeasibleError as error:
        return Answer("INFEASIBLE", cut(error.constraint), cut(error))
    if found.quality.status == "singular":
        return Answer("INFEASIBLE", "configurations", found.quality.message)
    status = "CANCELLED" if found.quality.status == "cancelled" else "SUCCESS"
    return Answer(status, "", found.quality.message, found, model)


def problem_of(request: Any, settings: PlannerParameters, model: Model) -> PlanProblem:
    """The library's problem for a request; zero and empty fields take the node's defaults.

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
    limit = float(request.time_limit)
    if not 0 <= limit <= 86400.0:
        raise InputError("time_limit", limit, "0 (the node's default) to 86400 s")
    sigma = float(request.sigma)
    if not (sigma == 0 or SMALLEST_SIGMA <= sigma <= 1.0):
        raise InputError("sigma", sigma, f"0 (the node's default), or {SMALLEST_SIGMA:g} to 1 m")
    criterion = request.criterion or settings.criterion
    candidates = _candidates(request, settings, robot)
    real = model.described and candidates is not None and criterion == "test_pose"
    return PlanProblem(
        robot,
        poses,
        size,
        repetitions=int(request.repetitions) or settings.repetitions,
        weights=_weights(request),
        noise=sigma or settings.sigma,
        criterion=criterion,
        constraints=constraints_of(settings, robot),
        discrepancy=ModelDiscrepancy() if real else None,
        search=Search(starts=settings.starts, seed=int(request.seed), time_limit=limit or settings.time_limit),
        candidates=None if candidates is None else Candidates(candidates),
    )


def constraints_of(settings: PlannerParameters, robot: Robot) -> tuple[Constraint, ...]:
    """Those of the file that the node's parameters name.

    Raises:
        InputError: The name leaves the folder, or the file does not fit the robot.
    """
    if not settings.constraints:
        return ()
    folder = settings.constraints_folder
    path = file_in(Path(folder).expanduser() if folder else config_folder(), settings.constraints, "constraints")
    return read_constraints(path, robot)


def file_in(folder: Path, name: str, field: str) -> Path:
    """The file ``name`` directly in ``folder``; parameters may be set by anyone, and no path leads out of it.

    Raises:
        InputError: Not the plain name of an existing file there.
    """
    path = folder / Path(name).name
    plain = bool(name) and path.name == name and name not in (".", "..") and "\0" not in name
    if not plain or path.resolve().parent != folder.resolve() or not path.is_file():
        raise InputError(field, brief(name, 100), f"the name of a file in {folder}")
    return path


def _candidates(request: Any, settings: PlannerParameters, robot: Robot) -> FloatArray | None:
    if not len(request.candidates):
        return None
    rows = check_rows("candidates", request.candidates, robot.joint_names)
    if len(rows) > settings.most_candidates:
        advice = "raise the node's parameter most_candidates if you mean it"
        raise InputError("candidates", f"{len(rows)} rows", f"at most {settings.most_candidates}", advice)
    low, high = robot.joint_limits.T
    outside = (rows < low - 1e-6) | (rows > high + 1e-6)
    if outside.any():  # a robot may be sent there
        i, j = (int(k) for k in np.argwhere(outside)[0])
        expected = f"within the limits [{low[j]:.4f}, {high[j]:.4f}] of {robot.joint_names[j]}"
        raise InputError(f"candidates[{i}]", f"{rows[i, j]:g}", expected)
    return rows


def _weights(request: Any) -> FloatArray | None:
    """Relative to the largest, since only that matters and sums of huge ones overflow."""
    given = np.asarray(request.test_pose_weights, float)
    if not given.size:
        return None
    largest = float(given.max())
    return given / largest if 0 < largest < np.inf else given


def _model(request: Any, settings: PlannerParameters, own: Model | NotReady) -> Model:
    names = list(request.parameters)
    if len(names) > MOST_PARAMETERS:
        raise InputError("parameters", f"{len(names)} names", f"at most {MOST_PARAMETERS}")
    wanted = names or settings.parameters
    if isinstance(own, Model) and request.robot in ("", own.robot.name):
        robot = own.robot.with_parameters(wanted, unknown_words(settings.unknown))
        return Model(robot, own.speeds, own.described)
    if not request.robot and isinstance(own, NotReady):
        raise own
    return shipped_model(request.robot, wanted, settings.unknown)
