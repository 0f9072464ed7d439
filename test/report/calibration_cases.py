# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Calibrations that the tests of the report share: clean, with gross errors, too few points, several targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from robots import mixed, random_configurations
from scipy.spatial.transform import Rotation

from calib_planner import Estimate, IdentificationProblem, Measurements, Robot, identify, validate
from calib_planner.report import Provenance
from calib_planner.simulation import SimulatedCell, random_deviations

BASE = Rotation.from_rotvec([0.1, -0.2, 2.0]).as_matrix(), np.array([2.5, -1.5, 0.4])
POSE = np.radians([0, -60, 90, 0, 45, 0])
Case = tuple[IdentificationProblem, Estimate]


def kuka(
    rows: int,
    *,
    gross: int = 0,
    repetitions: int = 1,
    unknown: tuple[str, ...] = (),
    share: float = 1.0,
    **options: Any,
) -> Case:
    """A simulated KUKA, in the tracker's frame if its base is unknown.

    ``gross`` points are 5 mm off; joints move over ``share`` of their range.
    """
    nominal = Robot.load("kuka_kr270")
    placed = nominal.with_base(*BASE) if unknown else nominal
    cell = SimulatedCell(placed, random_deviations(placed, 1), 3e-5)
    data = cell.measure(share * random_configurations(nominal, rows, 2), repetitions, 3)
    points = np.array(data.p)
    points[: 3 * gross : 3] += 5e-3 / np.sqrt(3)
    data = Measurements(data.joint_names, data.q, points, data.std)
    robot = nominal.with_parameters(nominal.parameter_names, unknown)
    problem = IdentificationProblem(robot, data, test_poses=[POSE], **options)
    return problem, identify(problem)


@cache
def clean() -> Case:
    problem, estimate = kuka(16, repetitions=2, required_accuracy=2e-4)
    return problem, validate(problem, estimate, [kuka(5)[0].data])


@cache
def outliers() -> Case:
    return kuka(60, gross=3, unknown=("base", "tool"), loss="robust")


@cache
def too_few() -> Case:
    problem, _ = kuka(3)
    data = replace(problem.data, std=None)
    problem = replace(problem, data=data)
    return problem, identify(problem)


@cache
def several_targets() -> Case:
    robot = mixed().with_parameters("lengths+offsets")
    data = SimulatedCell(robot, random_deviations(robot, 4), 3e-5).measure(
        random_configurations(robot, 25, 5), 1, 6
    )
    points = np.array(data.p)
    points[3, 1] = np.nan
    problem = IdentificationProblem(robot, Measurements(data.joint_names, data.q, points, data.std))
    return problem, identify(problem)


@cache
def hostile() -> tuple[Case, Provenance]:
    """Names that would run a script or end an element if they were taken as HTML."""
    evil = "</script><img src=x onerror=boom()>\"'&"
    nominal = Robot.load("planar_2r")
    names = tuple(f"{evil}{i}" for i in range(2))
    robot = replace(nominal, name=evil, joint_names=names)
    data = SimulatedCell(robot, random_deviations(robot, 1), 3e-5).measure(
        random_configurations(robot, 12, 1), 1, 1
    )
    problem = IdentificationProblem(robot, data)
    made = Provenance((), command=f"identify {evil} `$(x)`", estimate=evil)
    return (problem, identify(problem)), made


CASES: dict[str, Callable[[], Case]] = {
    "clean": clean,
    "outliers": outliers,
    "too few": too_few,
    "several targets": several_targets,
}
