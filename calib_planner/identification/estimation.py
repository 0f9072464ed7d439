"""Identification with one error model: from measurements to parameters, coefficients and scales.

    1. Base and targets, where they are unknown, start in closed form (``registration``).
    2. Linearise at the current values, (M1); the scales maximise the restricted likelihood times their priors;
       generalised least squares gives the parameters and the coefficients of gravity and joint functions
       (``likelihood``). Repeat until the predictions stand still.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.error_model.model import ErrorModel
from calib_planner.error_model.poses import Poses
from calib_planner.identification.likelihood import LinearProblem, Solution, maximise, solve
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.registration import register
from calib_planner.robot.chain import Robot

ROUNDS = 5
"""Most relinearisations."""


@dataclass(frozen=True, eq=False)
class State:
    """Where it is linearised.

    Attributes:
        robot: With the parameters in force.
        coefficients: (coefficients,) β: deviations from nominal, then those of the other terms.
        model: With the scales in force.
    """

    robot: Robot
    coefficients: FloatArray
    model: ErrorModel


def start_robot(robot: Robot, data: Measurements) -> Robot:
    active = robot.parameter_names
    base = all(f"base.{a}" in active for a in ("x", "y", "z", "rx", "ry", "rz"))
    tool = all(f"target_{t + 1}.{a}" in active for t in range(len(robot.targets)) for a in "xyz")
    return register(robot, data, base=base, tool=tool)


def linear_problem(nominal: Robot, data: Measurements, coefficients: FloatArray, model: ErrorModel) -> LinearProblem:
    count = len(nominal.parameter_names)
    robot = nominal.with_deviations(dict(zip(nominal.parameter_names, coefficients[:count], strict=True)))
    readings = Poses(robot, data.q)
    poses = Poses(robot, data.q, None, model.deflection(readings, coefficients))
    seen = model.seen(data.seen)
    columns = model.columns(poses) * seen[:, :, None]
    stated = None
    if data.std is not None:
        std = np.where(data.seen[:, :, None], np.asarray(data.std), 1.0)
        stated = std[..., None] ** 2 * np.eye(3)
    both = seen[:, :, None] * seen[:, None, :]
    parts = {n: p * both for n, p in model.visit_parts(poses, stated).items()}
    y = np.where(data.seen[:, :, None], data.p - poses.points, 0.0).reshape(len(data), -1)
    random = np.isfinite(model.variances(nominal))
    y = y + columns[:, :, random] @ coefficients[random]
    return LinearProblem(nominal, model, y, columns, parts, seen)


def estimate(robot: Robot, data: Measurements, model: ErrorModel) -> tuple[Robot, FloatArray, Solution]:
    data = data.in_order_of(robot.joint_names)
    robot = start_robot(robot, data)
    coefficients = np.zeros(len(model.names(robot)))
    for _ in range(ROUNDS):
        problem = linear_problem(robot, data, coefficients, model)
        solution = maximise(problem)
        model = solution.problem.model
        new = solution.coefficients.copy()
        new[problem.flat] += coefficients[problem.flat]
        change = problem.columns @ (new - coefficients)
        coefficients = new
        if np.abs(change).max() < 1e-7:
            break
    return robot, coefficients, solution
