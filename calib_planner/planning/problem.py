"""What is asked of the planner: a robot, where accuracy matters, and how much may be measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import (
    FloatArray,
    check_array,
    check_configurations,
    check_count,
    check_number,
)
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.measurements import Measurements
from calib_planner.planning.criteria import CRITERIA
from calib_planner.planning.discrepancy import ModelDiscrepancy
from calib_planner.planning.feasibility import Constraint
from calib_planner.robot import Robot
from calib_planner.tracker import Isotropic, Noise

POSE_CRITERIA = ("test_pose", "worst_pose")
"""Criteria that need test poses."""


@dataclass(frozen=True, eq=False)
class PlanProblem:
    """Choose ``configurations`` joint configurations that are worth most by ``criterion``.

    Attributes:
        robot: The robot, its active parameters being those to be identified. Base and target parameters
            (``base.*``, ``target_*``) are nuisance: estimated with the rest, eliminated from the criterion.
        test_poses: (K, joints) configurations where accuracy matters [rad | m]; a path is many of them.
        configurations: m, number of different configurations.
        repetitions: Measurements at each configuration.
        weights: (K,) weights of the test poses; default equal.
        sigma: Standard deviation of one coordinate of one measured point [m]; see ``noise``.
        criterion: One of ``criteria.CRITERIA``.
        compound: Other criteria with their shares, e.g. ``{"d": 0.3}``: the plan then maximises the weighted
            geometric mean of efficiencies, ``criterion`` keeping the rest of the weight.
        general_weight: Share of the test-pose criterion given to the mean accuracy over all joint limits. It
            keeps a plan from going blind away from the test pose; 0 is the paper's plain criterion.
        noise: The instrument; default isotropic with ``sigma``.
        configuration_sigma: σ_c, error of one coordinate that repeating a configuration does not average
            away (robot repeatability) [m].
        prior_std: What is known of parameters before: name → standard deviation [m | rad].
        measured: Measurements already taken; the plan is for the *next* configurations.
        constraints: Conditions on configurations besides the joint limits.
        candidates: (C, joints) configurations to choose from, instead of all within the limits.
        repeat_candidates: Whether one candidate may be chosen more than once.
        discrepancy: What the real robot has beyond any geometric model (see ``discrepancy``). The plan is then
            chosen from ``candidates`` for the smallest expected error at the test poses on such a robot;
            value and bound stay those of the criterion. ``None``: the paper's plain criterion.
        starts: Random starts of the search.
        seed: Same seed, same plan.
        time_limit: Seconds after which the best plan so far is returned.
    """

    robot: Robot
    test_poses: ArrayLike | None
    configurations: int
    repetitions: int = 1
    weights: ArrayLike | None = None
    sigma: float = 3e-5
    criterion: str = "test_pose"
    compound: Mapping[str, float] = field(default_factory=dict)
    general_weight: float = 5e-5
    noise: Noise | None = None
    configuration_sigma: float = 0.0
    prior_std: Mapping[str, float] = field(default_factory=dict)
    measured: Measurements | None = None
    constraints: tuple[Constraint, ...] = ()
    candidates: ArrayLike | None = None
    repeat_candidates: bool = False
    discrepancy: ModelDiscrepancy | None = None
    starts: int = 48
    seed: int = 0
    time_limit: float = float("inf")

    def __post_init__(self) -> None:
        put, robot = object.__setattr__, self.robot
        if not isinstance(robot, Robot):
            raise InputError("robot", type(robot).__name__, "a Robot", "use Robot.load(...)")
        if not robot.parameter_names:
            raise InputError("robot", "no active parameters", "at least one", "use robot.with_parameters(...)")
        if self.criterion not in CRITERIA:
            raise UnknownNameError("criterion", str(self.criterion), CRITERIA)
        put(self, "compound", _check_compound(self.compound))
        self._check_poses()
        put(self, "configurations", check_count("configurations", self.configurations, high=10_000))
        put(self, "repetitions", check_count("repetitions", self.repetitions, high=100_000))
        put(self, "sigma", check_number("sigma", self.sigma, low=0, low_open=True, high=1.0, unit="m"))
        put(self, "noise", Isotropic(self.sigma) if self.noise is None else self.noise)
        share = check_number("general_weight", self.general_weight, low=0, high=1)
        put(self, "general_weight", share)
        common = check_number("configuration_sigma", self.configuration_sigma, low=0, high=1, unit="m")
        put(self, "configuration_sigma", common)
        put(self, "prior_std", _check_prior(self.prior_std, robot))
        if self.measured is not None:
            put(self, "measured", _check_measured(self.measured, robot))
        put(self, "constraints", tuple(self.constraints))
        if self.candidates is not None:
            pool = check_configurations("candidates", self.candidates, robot.joint_names)
            put(self, "candidates", pool)
            if not self.repeat_candidates and len(pool) < self.configurations:
                raise InputError("candidates", f"{len(pool)} rows", f"at least {self.configurations}, one each")
        if self.discrepancy is not None:
            self._check_discrepancy()
        put(self, "starts", check_count("starts", self.starts, high=100_000))
        put(self, "seed", check_count("seed", self.seed, low=0, high=2**63 - 1))
        if not self.time_limit > 0:
            raise InputError("time_limit", self.time_limit, "a number of seconds > 0")

    def _check_poses(self) -> None:
        put, robot = object.__setattr__, self.robot
        if self.test_poses is None or np.size(self.test_poses) == 0:
            wanting = [c for c in (self.criterion, *self.compound) if c in POSE_CRITERIA]
            if wanting:
                raise InputError("test_poses", "none", f"at least one, criterion {wanting[0]} needs it")
            put(self, "test_poses", np.empty((0, len(robot.joint_names))))
        else:
            poses = check_configurations("test_poses", self.test_poses, robot.joint_names)
            _check_within_limits(robot, poses)
            put(self, "test_poses", poses)
        count = len(self.test_pose_array)
        weights = check_array("weights", np.ones(count) if self.weights is None else self.weights, (count,))
        if count and ((weights < 0).any() or not weights.any()):
            raise InputError("weights", weights.tolist(), "numbers >= 0, not all zero")
        put(self, "weights", weights)

    def _check_discrepancy(self) -> None:
        if self.candidates is None:
            raise InputError("discrepancy", "no candidates", "candidates to choose from", "draw some hundred")
        if self.criterion != "test_pose" or self.compound:
            raise InputError("discrepancy", f"criterion {self.criterion}", "criterion test_pose, not compound")
        if self.repeat_candidates:
            raise InputError("discrepancy", "repeat_candidates", "candidates chosen once each")

    @property
    def test_pose_array(self) -> FloatArray:
        """``test_poses`` as the array that the constructor made of it."""
        return np.asarray(self.test_poses)

    @property
    def weight_array(self) -> FloatArray:
        """``weights`` as the array that the constructor made of it."""
        return np.asarray(self.weights)

    @property
    def instrument(self) -> Noise:
        """``noise``, never ``None`` once constructed."""
        assert self.noise is not None
        return self.noise

    @property
    def measurements(self) -> int:
        """Number of measurements the plan will hold."""
        return self.configurations * self.repetitions


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


def _check_compound(shares: Mapping[str, float]) -> dict[str, float]:
    checked = {}
    for name, share in dict(shares).items():
        if name not in CRITERIA:
            raise UnknownNameError("compound", str(name), CRITERIA)
        if name in ("o2", "o4"):
            raise InputError("compound", name, "a concave criterion (all but o2 and o4)")
        checked[name] = check_number(f"compound[{name}]", share, low=0, low_open=True, high=1)
    if sum(checked.values()) >= 1:
        raise InputError("compound", checked, "shares that leave some weight to the criterion itself")
    return checked


def _check_prior(prior: Mapping[str, float], robot: Robot) -> dict[str, float]:
    for name in prior:
        if name not in robot.parameter_names:
            raise UnknownNameError("prior_std", str(name), robot.parameter_names)
    return {n: check_number(f"prior_std[{n}]", v, low=0, low_open=True) for n, v in prior.items()}


def _check_measured(measured: Measurements, robot: Robot) -> Measurements:
    ordered = measured.in_order_of(robot.joint_names)
    if ordered.p.shape[1] != len(robot.targets):
        raise InputError("measured", f"{ordered.p.shape[1]} targets", f"{len(robot.targets)}, as the robot has")
    return ordered
