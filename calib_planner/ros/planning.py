"""From a request on the wire to a plan or a refusal with its field: no node, no executor.

The request is the service's or the action's (same fields). It comes from anyone, so the robot must be the
node's own or a shipped one (never a path), and sizes are bounded.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from calib_planner.design.plan import Plan
from calib_planner.design.planner import Progress, plan
from calib_planner.design.problem import PlanProblem
from calib_planner.errors import InfeasibleError, InputError
from calib_planner.robot.chain import Robot
from calib_planner.ros.conversions import check_rows
from calib_planner.ros.settings import PlannerParameters, load_shipped

MOST_PARAMETERS = 1000
FIELD_OF = {"weights": "test_pose_weights"}
"""The request's word for a field of ``PlanProblem``, where they differ."""


@dataclass(frozen=True)
class Answer:
    """What became of a request.

    Attributes:
        status: Name of a status constant of PlanCalibration.
        field: Request field at fault; empty if none.
        message: The outcome and what to do.
        plan: The plan, if there is a usable one.
    """

    status: str
    field: str
    message: str
    plan: Plan | None = None


def answer(
    request: Any,
    settings: PlannerParameters,
    own: Robot,
    callback: Callable[[Progress], bool | None] | None = None,
) -> Answer:
    """Plan what is asked; every fault of the request becomes an ``Answer``."""
    try:
        found = plan(problem_of(request, settings, own), callback)
    except InputError as error:
        field = re.match(r"\w*", error.field)
        name = field[0] if field else ""
        return Answer("INVALID_REQUEST", FIELD_OF.get(name, name), _shortened(str(error)))
    except InfeasibleError as error:
        return Answer("INFEASIBLE", error.constraint, _shortened(str(error)))
    if found.status == "singular":
        return Answer("INFEASIBLE", "configurations", found.message)
    if found.status == "cancelled":
        return Answer("CANCELLED", "", found.message, found)
    return Answer("SUCCESS", "", found.message, found)


def problem_of(request: Any, settings: PlannerParameters, own: Robot) -> PlanProblem:
    """The library's problem for a request; zero and empty fields take the node's defaults.

    Raises:
        InputError: A field is not usable.
        InfeasibleError: No plan can satisfy the request.
    """
    robot = _robot(request, settings, own)
    poses = check_rows("test_poses", request.test_poses, robot.joint_names, least=0)
    if len(poses) > settings.most_test_poses:
        raise InputError("test_poses", f"{len(poses)} poses", f"at most {settings.most_test_poses}")
    size = int(request.configurations) or settings.configurations
    if size > settings.most_configurations:
        advice = "raise the node's parameter most_configurations if you mean it"
        raise InputError("configurations", size, f"at most {settings.most_configurations}", advice)
    limit = float(request.time_limit)
    if not 0 <= limit <= 86400.0:
        raise InputError("time_limit", limit, "0 (the node's default) to 86400 s")
    sigma = float(request.sigma)
    if not 0 <= sigma <= 1.0:
        raise InputError("sigma", sigma, "0 (the node's default) to 1 m")
    return PlanProblem(
        robot,
        poses,
        size,
        repetitions=int(request.repetitions) or settings.repetitions,
        weights=list(request.test_pose_weights) or None,
        sigma=sigma or settings.sigma,
        criterion=request.criterion or settings.criterion,
        starts=settings.starts,
        seed=int(request.seed),
        time_limit=limit or settings.time_limit,
    )


def _robot(request: Any, settings: PlannerParameters, own: Robot) -> Robot:
    names = list(request.parameters)
    if len(names) > MOST_PARAMETERS:
        raise InputError("parameters", f"{len(names)} names", f"at most {MOST_PARAMETERS}")
    wanted = names or settings.parameters
    if request.robot in ("", own.name):
        unknown = [w.strip() for w in settings.unknown.split(",") if w.strip()]
        return own.with_parameters(wanted, unknown)
    return load_shipped(request.robot, wanted, settings.unknown)


def _shortened(text: str) -> str:
    """``text`` without the middle, if what came over the wire made it very long."""
    return text if len(text) <= 1000 else f"{text[:480]} … {text[-480:]}"
