# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Campaigns on simulated cells, and what came true of them.

Unless a test says otherwise, robots err in their parameters alone and campaigns know that (the paper's model).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib_planner import Robot
from calib_planner.campaign import CampaignProblem, CampaignResult, run_campaign
from calib_planner.error_model import ErrorModel, typical
from calib_planner.simulation import Faults, SimulatedCell, Stand, World, random_deviations, simulated

POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])
SIGMA = 3e-5


PAPER = {"error_model": ErrorModel.paper()}
TYPICAL = {"error_model": typical()}


def world_of(
    robot: Robot, seed: int, sigma: float = SIGMA, transmission: float = 0.0, model: ErrorModel | None = None
) -> World:
    cell = SimulatedCell(robot, random_deviations(robot, seed), sigma, error_model=model, seed=seed)
    return World(cell, Faults(transmission_error=transmission), seed)


def kuka(required: float = 15e-6, seed: int = 0, **changes: object) -> CampaignProblem:
    values = {"robot": Robot.load("kuka_kr270"), "test_poses": POSE, "starts": 2, "seed": seed}
    values |= {"identification": PAPER, **changes}
    return CampaignProblem(required_accuracy=required, sigma=SIGMA, **values)  # type: ignore[arg-type]


def planar(required: float = 12e-6, seed: int = 0, **changes: object) -> CampaignProblem:
    values = {"robot": Robot.load("planar_2r"), "test_poses": np.radians([10.0, 50.0]), "starts": 2, "seed": seed}
    values |= {"identification": PAPER, **changes}
    return CampaignProblem(required_accuracy=required, sigma=SIGMA, **values)  # type: ignore[arg-type]


def campaign(
    problem: CampaignProblem, world: World, reaches: Callable[[np.ndarray], bool] = lambda q: True
) -> CampaignResult:
    return run_campaign(problem, simulated(world, problem.seed, reaches))


def achieved(result: CampaignResult, world: World, poses: np.ndarray) -> float:
    """Largest true error at the test poses [m], with all that was learnt."""
    assert result.estimate is not None
    poses = np.atleast_2d(poses)
    stand = Stand(poses, np.arange(len(poses)), np.full(len(poses), np.inf))
    off = result.estimate.positions(poses) - world.targets(stand)
    return float(np.linalg.norm(off, axis=2).max())
