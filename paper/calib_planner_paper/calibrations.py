# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Many simulated calibrations with one plan: what Figs 2, 3 and 5 show as points.

A point is the error ε = g(q0, Π̂) − g(q0, Π) that one calibration leaves at the test pose, eq. (4). Its components
are normal with covariance C = J0 cov(Π̂) J0ᵀ, so ‖ε‖² has mean ρ0² = tr C, eq. (14), and variance 2 tr C². Over n
calibrations the root mean square of ‖ε‖ therefore estimates ρ0 with the relative standard error

    s = ½ √(2 tr C² / n) / tr C,

which says how near the simulated value has to come.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray, frozen, plain
from calib_planner.error_model import ErrorModel, covariance
from calib_planner.identification import fit_error_model
from calib_planner.planning import InformationModel
from calib_planner.robot import Robot
from calib_planner.simulation import SimulatedCell, random_deviations
from calib_planner.tracker import Isotropic


@dataclass(frozen=True, eq=False)
class Laboratory:
    """What all calibrations of one figure have in common.

    Attributes:
        robot: The nominal robot; its active parameters are identified.
        test_pose: (joints,) where the error counts [rad | m].
        sigma: Standard deviation of one measured coordinate [m].
        count: Calibrations per plan.
        seed: Of the robot's true errors (1 mm, 1 mrad) and of the noise.
    """

    robot: Robot
    test_pose: FloatArray
    sigma: float
    count: int
    seed: int


@dataclass(frozen=True, eq=False)
class Calibrations:
    """The calibrations with one plan.

    Attributes:
        label: How tables and figures call the plan.
        configurations: (m, joints) [rad | m].
        repetitions: Measurements at each.
        errors: (count, 3) what each calibration left at the test pose, eq. (4) [m].
        expected: ρ0 of eq. (14) [m].
        standard_error: Standard deviation of ``simulated`` around ``expected``, s·ρ0 above [m].
    """

    label: str
    configurations: FloatArray
    repetitions: int
    errors: FloatArray
    expected: float
    standard_error: float

    @property
    def distances(self) -> FloatArray:
        """(count,) ‖ε‖ [m]."""
        return np.asarray(np.linalg.norm(self.errors, axis=1))

    @property
    def simulated(self) -> float:
        """Root mean square of ``distances`` [m]."""
        return float(np.sqrt(np.mean(self.distances**2)))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers [m, rad]."""
        values: dict[str, Any] = plain(
            {
                "plan": self.label,
                "configurations": self.configurations,
                "repetitions": self.repetitions,
                "expected": self.expected,
                "simulated": self.simulated,
                "standard_error": self.standard_error,
                "errors": self.errors,
            }
        )
        return values


def calibrate(
    laboratory: Laboratory, label: str, configurations: FloatArray, repetitions: int, stream: int
) -> Calibrations:
    """Measure, identify and look at the test pose ``laboratory.count`` times.

    Args:
        stream: Tells the noise of this plan from that of others with the same seed.
    """
    robot, pose, sigma = laboratory.robot, laboratory.test_pose, laboratory.sigma
    cell = SimulatedCell(robot, random_deviations(robot, laboratory.seed), sigma)
    truth = cell.truth.positions(pose)[0, 0]
    seeds = np.random.SeedSequence([laboratory.seed, stream]).generate_state(laboratory.count)
    errors = np.empty((laboratory.count, 3))
    for row, seed in enumerate(seeds):
        data = cell.measure(configurations, repetitions, int(seed))
        estimate = fit_error_model(robot, data, ErrorModel.paper(sigma))
        errors[row] = estimate.knowledge.placed.positions(pose)[0, 0] - truth
    spread = error_covariance(robot, configurations, repetitions, pose, sigma)
    mean = float(np.trace(spread))
    relative = 0.5 * np.sqrt(2 * np.trace(spread @ spread) / laboratory.count) / mean
    return Calibrations(
        label, frozen(configurations), repetitions, frozen(errors), mean**0.5, float(relative * mean**0.5)
    )


def error_covariance(
    robot: Robot, configurations: FloatArray, repetitions: int, test_pose: FloatArray, sigma: float
) -> FloatArray:
    """C = J0 (Σ JᵢᵀJᵢ)⁻¹ J0ᵀ σ², (3, 3) [m²]; its trace is ρ0² of eq. (14)."""
    model = InformationModel(robot, Isotropic(sigma), repetitions=repetitions)
    inverse, _ = covariance(model.at(configurations).sum(axis=0))
    jacobian = np.asarray(robot.jacobian(test_pose))[0]
    return np.asarray(jacobian @ inverse @ jacobian.T)
