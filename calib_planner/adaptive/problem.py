"""What is asked of a campaign: an accuracy at the test poses, and how much may be measured for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calib_planner._arrays import FloatArray, check_count, check_number
from calib_planner.design.feasibility import Constraint
from calib_planner.design.problem import PlanProblem
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.instrument.noise import Isotropic, Noise
from calib_planner.robot.chain import Robot

OPTIONS = ("loss", "prior", "discrepancy", "joint_corrections", "iterations", "starts")
"""Fields of ``IdentificationProblem`` that a campaign may set; it sets the others itself."""


@dataclass(frozen=True, eq=False)
class CampaignProblem:
    """Measure until the error predicted at every test pose is at most ``required_accuracy``.

    Attributes:
        robot: The nominal robot, its active parameters being those to be identified.
        test_poses: (K, joints) where accuracy matters, at least one [rad | m].
        required_accuracy: Largest root mean square error at a test pose that will do [m].
        budget: Measurements allowed in all, those of the validation and those that failed included.
        batch: Configurations planned at a time; after each batch the rest is planned anew.
        sigma: Standard deviation of one coordinate of one measurement [m]: what to expect until the
            measurements tell; see ``noise``.
        noise: The instrument; default isotropic with ``sigma``.
        constraints: Conditions on configurations besides the joint limits.
        validation: Measurements at the end that take no part in the fit; 0: none.
        minimum: Fewest different configurations, however accurate they look.
        attempts: How often a measurement is tried at one configuration before it is given up.
        most_failures: Configurations given up before the campaign ends.
        exclusion: Half width of the neighbourhood that is given up with a configuration, as a share of each
            joint's range.
        identification: Further settings of ``IdentificationProblem``, see ``OPTIONS``; the loss is robust
            unless they say otherwise.
        starts, time_limit: Of each plan's search, see ``PlanProblem``.
        seed: Same seed and same measurements, same campaign.
    """

    robot: Robot
    test_poses: ArrayLike
    required_accuracy: float
    budget: int = 60
    batch: int = 6
    sigma: float = 3e-5
    noise: Noise | None = None
    constraints: tuple[Constraint, ...] = ()
    validation: int = 6
    minimum: int = 4
    attempts: int = 2
    most_failures: int = 20
    exclusion: float = 0.05
    identification: Mapping[str, Any] = field(default_factory=dict)
    starts: int = 16
    time_limit: float = 60.0
    seed: int = 0

    def __post_init__(self) -> None:
        put = object.__setattr__
        for name in ("required_accuracy", "sigma"):
            length = check_number(name, getattr(self, name), low=0, low_open=True, high=1.0, unit="m")
            put(self, name, length)
        put(self, "noise", Isotropic(self.sigma) if self.noise is None else self.noise)
        put(self, "budget", check_count("budget", self.budget, high=10_000))
        put(self, "batch", check_count("batch", self.batch, high=200))
        put(self, "validation", check_count("validation", self.validation, low=0, high=1000))
        put(self, "minimum", check_count("minimum", self.minimum, high=1000))
        put(self, "attempts", check_count("attempts", self.attempts, high=100))
        put(self, "most_failures", check_count("most_failures", self.most_failures, low=0, high=10_000))
        share = check_number("exclusion", self.exclusion, low=0, low_open=True, high=0.5)
        put(self, "exclusion", share)
        put(self, "identification", self._checked_options())
        # The planner refuses what it cannot use, under the names that are its own and ours.
        checked = PlanProblem(
            self.robot,
            self.test_poses,
            1,
            noise=self.noise,
            constraints=self.constraints,
            starts=self.starts,
            seed=check_count("seed", self.seed, low=0, high=2**31 - 1),
            time_limit=self.time_limit,
        )
        put(self, "test_poses", checked.test_pose_array)
        put(self, "constraints", checked.constraints)
        if self.budget <= self.validation:
            expected = f"more than validation, which is {self.validation}"
            raise InputError("budget", self.budget, expected, "raise budget or lower validation")
        middle = self.robot.joint_limits.mean(axis=1)[None]
        made_up = Measurements(self.robot.joint_names, middle, self.robot.positions(middle))
        IdentificationProblem(self.robot, made_up, **self.identification)

    def _checked_options(self) -> Mapping[str, Any]:
        for name in self.identification:
            if name not in OPTIONS:
                raise UnknownNameError("identification", str(name), OPTIONS)
        return {"loss": "robust", **self.identification}

    @property
    def test_pose_array(self) -> FloatArray:
        """``test_poses`` as the array that the constructor made of it."""
        return np.asarray(self.test_poses)

    @property
    def instrument(self) -> Noise:
        """``noise``, never ``None`` once constructed."""
        assert self.noise is not None
        return self.noise

    @property
    def fit_budget(self) -> int:
        """Measurements allowed for the fit."""
        return self.budget - self.validation
