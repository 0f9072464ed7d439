"""Before the fit: where unknown base and targets start, and whether there are enough points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_planner.errors import NotEnoughDataError
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.registration import register
from calib_planner.identification.robust import robust_registration
from calib_planner.measurements import Measurements
from calib_planner.robot import BASE_PARAMETERS, Robot, target_parameters


def start_robot(robot: Robot, data: Measurements, *, robust: bool = False) -> Robot:
    """``robot`` with its unknown base and targets, if any, at their closed-form values for these data."""
    active = set(robot.parameter_names)
    base, tool = active.issuperset(BASE_PARAMETERS), active.issuperset(target_parameters(len(robot.targets)))
    how = robust_registration if robust else register
    return how(robot, data, base=base, tool=tool)


def check_count(problem: IdentificationProblem, use: NDArray[np.bool_]) -> None:
    """More equations than parameters, and not more points rejected than used."""
    count, equations = len(problem.robot.parameter_names), 3 * int(use.sum())
    prior = 0 if problem.prior is None else len(problem.prior.names)
    if problem.error_model is not None and not problem.error_model.is_papers:
        prior = count  # every part of the chain has a tolerance
    measured = int(problem.data.seen.sum())
    if 2 * int(use.sum()) < measured:
        raise NotEnoughDataError(
            equations,
            count,
            f"only {int(use.sum())} of {measured} points agree with one another: check joint order, units and "
            "which point belongs to which row before calibrating",
        )
    if equations + prior < count:
        each = 3 * problem.data.p.shape[1]
        raise NotEnoughDataError(
            equations,
            count,
            f"{equations} equations for {count} parameters: measure at least {-(-(count - prior) // each)} "
            "configurations, or ask for fewer parameters",
        )
