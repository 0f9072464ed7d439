"""What is asked of the planner: a robot, where accuracy matters, and how much may be measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib_planner._arrays import (
    FloatArray,
    check_array,
    check_configurations,
    check_count,
    check_number,
)
from calib_planner.design.identifiability import analyse
from calib_planner.errors import InfeasibleError, InputError, UnknownNameError
from calib_planner.robot.chain import Robot

CRITERIA = ("test_pose",)
SAMPLE = 512
"""Random configurations that stand for the whole workspace."""


@dataclass(frozen=True, eq=False)
class PlanProblem:
    """Choose ``configurations`` joint configurations that minimise eq. (14).

    Attributes:
        robot: The robot, its active parameters being those to be identified.
        test_poses: (K, joints) configurations where accuracy matters [rad | m].
        configurations: m, number of different configurations.
        repetitions: Measurements at each configuration.
        weights: (K,) weights of the test poses; default equal.
        sigma: Standard deviation of one coordinate of one measured point [m].
        criterion: One of ``CRITERIA``.
        general_weight: Share of the criterion given to the mean accuracy over all joint limits. It keeps a
            plan from going blind away from the test pose; 0 is the paper's plain criterion.
        starts: Random starts of the search.
        seed: Same seed, same plan.
        time_limit: Seconds after which the best plan so far is returned.
    """

    robot: Robot
    test_poses: ArrayLike
    configurations: int
    repetitions: int = 1
    weights: ArrayLike | None = None
    sigma: float = 3e-5
    criterion: str = "test_pose"
    general_weight: float = 1e-4
    starts: int = 64
    seed: int = 0
    time_limit: float = float("inf")

    def __post_init__(self) -> None:
        put = object.__setattr__
        robot = self.robot
        if not isinstance(robot, Robot):
            raise InputError("robot", type(robot).__name__, "a Robot", "use Robot.load(...)")
        if self.criterion not in CRITERIA:
            raise UnknownNameError("criterion", str(self.criterion), CRITERIA)
        put(
            self,
            "test_poses",
            check_configurations("test_poses", self.test_poses, robot.joint_names),
        )
        _check_within_limits(robot, self.test_pose_array)
        put(self, "configurations", check_count("configurations", self.configurations, high=10_000))
        put(self, "repetitions", check_count("repetitions", self.repetitions, high=100_000))
        count = len(self.test_pose_array)
        weights = check_array("weights", np.ones(count) if self.weights is None else self.weights, (count,))
        if (weights < 0).any() or not weights.any():
            raise InputError("weights", weights.tolist(), "numbers >= 0, not all zero")
        put(self, "weights", weights)
        put(
            self,
            "sigma",
            check_number("sigma", self.sigma, low=0, low_open=True, high=1.0, unit="m"),
        )
        put(
            self,
            "general_weight",
            check_number("general_weight", self.general_weight, low=0, high=1),
        )
        put(self, "starts", check_count("starts", self.starts, high=100_000))
        put(self, "seed", check_count("seed", self.seed, low=0, high=2**63 - 1))
        if not self.time_limit > 0:
            raise InputError("time_limit", self.time_limit, "a number of seconds > 0")
        _check_enough(robot, self.configurations)

    @property
    def test_pose_array(self) -> FloatArray:
        """``test_poses`` as the array that the constructor made of it."""
        return np.asarray(self.test_poses)

    @property
    def weight_array(self) -> FloatArray:
        """``weights`` as the array that the constructor made of it."""
        return np.asarray(self.weights)


def _check_within_limits(robot: Robot, poses: FloatArray) -> None:
    low, high = robot.joint_limits.T
    outside = (poses < low - 1e-9) | (poses > high + 1e-9)
    if outside.any():
        k, j = (int(i) for i in np.argwhere(outside)[0])
        raise InputError(
            f"test_poses[{k}], joint {robot.joint_names[j]}",
            f"{poses[k, j]:.6g}",
            f"a value within the joint limits [{low[j]:.6g}, {high[j]:.6g}] rad or m",
            "check units (degrees?) and joint order",
        )


def reachable_sample(robot: Robot, count: int) -> FloatArray:
    """(count, 3·targets, P) Jacobians at fixed random configurations within the joint limits."""
    low, high = robot.joint_limits.T
    return robot.jacobian(np.random.default_rng(0).uniform(low, high, (count, len(low))))


def _check_enough(robot: Robot, configurations: int) -> None:
    """Refuse what so few configurations cannot identify, whichever they are."""
    jacobians = reachable_sample(robot, SAMPLE)
    names = robot.parameter_names
    if not names:
        raise InputError("robot", "a robot without active parameters", "use robot.with_parameters(...)")
    rank = analyse(jacobians.reshape(-1, len(names)), names).rank
    if rank == 0:
        raise InfeasibleError(
            "parameters",
            f"no measurement of these targets depends on {', '.join(names)}; choose other parameters, or "
            "give the tool a target off the last axis",
        )
    per_row = max(int(np.linalg.matrix_rank(j)) for j in jacobians[:8])
    needed = -(-rank // per_row)
    if configurations < needed:
        raise InfeasibleError(
            "configurations",
            f"{configurations} configurations give at most {configurations * per_row} equations for "
            f"{rank} identifiable parameters; ask for at least {needed}, or for fewer parameters",
        )
