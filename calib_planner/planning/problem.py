# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The request to the planner: a robot, where accuracy matters, and how much may be measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_array, check_configurations, check_count, check_number
from calib_planner.error_model import ACCURACIES, ErrorModel, Prior, gravity_of, typical
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.measurements import Measurements
from calib_planner.planning.criteria import CRITERIA, POSE_CRITERIA
from calib_planner.planning.feasibility import Constraint
from calib_planner.robot import Robot, check_reflectors
from calib_planner.tracker import Isotropic, Noise
from calib_planner.units import Told


@dataclass(frozen=True, eq=False)
class Candidates:
    """The only configurations that may be measured.

    Attributes:
        configurations: (C, joints) [rad | m].
        repeat: Whether a candidate may be chosen more than once.
    """

    configurations: ArrayLike
    repeat: bool = False


PAPERS_SHARE = 5e-5
"""Share of the accuracy everywhere without an error model: it costs the test pose 0.2 % of efficiency."""
GENERAL_SHARE = 0.05
"""The same with one. A plan for one pose alone measures that pose again and again, which takes out what the
joints err there, and tells nothing of the robot. docs/planning-real-robots.md shows what it costs and gives."""


LARGE = 20
"""Configurations from which on one start is enough with a whole error model, and its swaps look at one size of
the errors: a second start would gain 1 % in ρ0, in another half of the time."""


@dataclass(frozen=True)
class Search:
    """How the planner searches.

    Attributes:
        starts: Random starts; ``None``: 48; with a whole error model 2, and 1 from ``LARGE`` configurations on.
        seed: The same seed gives the same plan.
        time_limit: Seconds after which the best plan so far is returned.
        general_weight: Share of the test-pose criterion given to the mean accuracy over all joint limits. It
            prevents that a plan leaves parameters unseen that matter only away from the test poses; 0 is the
            paper's plain criterion. ``None``: ``PAPERS_SHARE``, and ``GENERAL_SHARE`` with a whole error model.
    """

    starts: int | None = None
    seed: int = 0
    time_limit: float = float("inf")
    general_weight: float | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        if self.starts is not None:
            put(self, "starts", check_count("starts", self.starts, high=100_000))
        put(self, "seed", check_count("seed", self.seed, low=0, high=2**63 - 1))
        if not self.time_limit > 0:
            raise InputError("time_limit", self.time_limit, "a number of seconds > 0")
        if self.general_weight is not None:
            put(self, "general_weight", check_number("general_weight", self.general_weight, low=0, high=1))

    def chosen(self, whole: bool, configurations: int) -> Search:
        """The same with the values that stand for ``None``; ``whole``: with a whole error model."""
        starts, share = (2 if configurations < LARGE else 1, GENERAL_SHARE) if whole else (48, PAPERS_SHARE)
        return replace(
            self,
            starts=starts if self.starts is None else self.starts,
            general_weight=share if self.general_weight is None else self.general_weight,
        )


@dataclass(frozen=True, eq=False, repr=False)
class PlanProblem(Told):
    """Choose ``configurations`` joint configurations that are best by ``criterion``.

    Attributes:
        robot: The robot, its active parameters being those to be identified. Parameters of the base and of the
            targets are estimated with the rest. Accuracies contain their errors; criteria of the parameters
            themselves are about the others.
        test_poses: (K, joints) configurations where accuracy matters [rad | m]; a path is many of them.
        configurations: m, number of different configurations.
        repetitions: Measurements at each configuration.
        weights: (K,) weights of the test poses; equal if ``None``.
        criterion: One of ``criteria.CRITERIA``.
        accuracy_frame: What an accuracy is, (M3): ``world``, the error in the frame of the points, or ``robot``,
            the same up to a rigid motion of the base.
        compound: Other criteria with their shares, e.g. ``{"d": 0.3}``: the plan then maximises the weighted
            geometric mean of efficiencies, in which ``criterion`` has the rest of the weight.
        error_model: How the robot errs, (M1): all its terms are in the information, in the prior and in the
            accuracy. ``None``: as the paper has it, by ``noise`` alone.
        noise: The instrument; a number is the standard deviation of every coordinate of a point [m]. With an
            error model it is that of the model.
        configuration_sigma: σ_c, error of one coordinate that repeating a measurement at the same configuration
            does not average away, beside what the error model has of it [m].
        prior: What is known of parameters beforehand, in place of what the error model has of them.
        measured: Measurements already taken; the plan is for the *next* configurations.
        constraints: Conditions on configurations besides the joint limits.
        candidates: Configurations to choose from; ``None`` means all that are feasible.
        search: Settings of the search.
    """

    robot: Robot
    test_poses: ArrayLike | None
    configurations: int
    repetitions: int = 1
    weights: ArrayLike | None = None
    criterion: str = "test_pose"
    compound: Mapping[str, float] = field(default_factory=dict)
    noise: Noise | float = 3e-5
    configuration_sigma: float = 0.0
    prior: Prior | None = None
    measured: Measurements | None = None
    constraints: tuple[Constraint, ...] = ()
    candidates: Candidates | None = None
    search: Search = Search()
    accuracy_frame: str = "world"
    error_model: ErrorModel | None = None

    def _facts(self) -> list[tuple[str, object]]:
        poses = 0 if self.test_poses is None else len(np.asarray(self.test_poses))
        size = f"{self.configurations} configurations"
        size += f" × {self.repetitions}" if self.repetitions > 1 else ""
        return [
            ("robot", self.robot.name),
            ("to measure", size),
            ("parameters", len(self.robot.parameter_names)),
            ("test poses", poses),
            ("criterion", self.criterion),
            ("error model", self.model.name),
            ("constraints", len(self.constraints)),
        ]

    def __post_init__(self) -> None:
        put, robot = object.__setattr__, self.robot
        if not isinstance(robot, Robot):
            raise InputError("robot", type(robot).__name__, "a Robot", "use Robot.load(...)")
        if not robot.parameter_names:
            raise InputError("robot", "no active parameters", "at least one", "use robot.with_parameters(...)")
        check_reflectors(robot)
        if self.criterion not in CRITERIA:
            raise UnknownNameError("criterion", str(self.criterion), CRITERIA)
        if self.accuracy_frame not in ACCURACIES:
            raise UnknownNameError("accuracy_frame", str(self.accuracy_frame), ACCURACIES)
        put(self, "compound", _check_compound(self.compound))
        self._check_poses()
        put(self, "configurations", check_count("configurations", self.configurations, high=10_000))
        put(self, "repetitions", check_count("repetitions", self.repetitions, high=100_000))
        if not hasattr(self.noise, "covariance"):
            put(self, "noise", Isotropic(self.noise))
        points, floor = self.model.points, self.model.values.get("floor", 0.0)
        put(self, "noise", Isotropic(floor) if points.noise is None else points.noise)
        common = check_number("configuration_sigma", self.configuration_sigma, low=0, high=1, unit="m")
        put(self, "configuration_sigma", common)
        put(self, "measured", self._measured())
        put(self, "search", self.search.chosen(self.whole_model is not None, self.configurations))
        put(self, "constraints", tuple(self.constraints))
        if self.candidates is not None:
            q = check_configurations("candidates", self.candidates.configurations, robot.joint_names)
            put(self, "candidates", replace(self.candidates, configurations=q))
            if not self.candidates.repeat and len(q) < self.configurations:
                raise InputError("candidates", f"{len(q)} rows", f"at least {self.configurations}, one each")

    def _check_poses(self) -> None:
        put, robot = object.__setattr__, self.robot
        if self.test_poses is None or np.size(self.test_poses) == 0:
            needing = [c for c in (self.criterion, *self.compound) if c in POSE_CRITERIA]
            if needing:
                raise InputError("test_poses", "none", f"at least one, criterion {needing[0]} needs it")
            put(self, "test_poses", np.empty((0, len(robot.joint_names))))
        else:
            poses = check_configurations("test_poses", self.test_poses, robot.joint_names)
            robot.check_within_limits("test_poses", poses)
            put(self, "test_poses", poses)
        count = len(self.test_pose_array)
        weights = check_array("weights", np.ones(count) if self.weights is None else self.weights, (count,))
        if count and ((weights < 0).any() or not weights.any()):
            raise InputError("weights", weights.tolist(), "numbers >= 0, not all zero")
        put(self, "weights", weights)

    def _measured(self) -> Measurements | None:
        if self.measured is None:
            return None
        measured = self.measured.in_order_of(self.robot.joint_names)
        have, want = measured.p.shape[1], len(self.robot.targets)
        if have != want:
            raise InputError("measured", f"{have} targets", f"{want}, as the robot has")
        return measured

    @cached_property
    def model(self) -> ErrorModel:
        """The error model that is planned with: the one given or the paper's, with the prior."""
        model = ErrorModel.paper(self.noise) if self.error_model is None else self.error_model
        if self.prior is None:
            return model
        self.prior.places(self.robot.parameter_names)
        return replace(model, placement=replace(model.placement, stated=self.prior))

    @property
    def whole_model(self) -> ErrorModel | None:
        """The error model, or ``None`` where it is the paper's: nothing but parameters and noise."""
        return None if self.model.is_papers else self.model

    @property
    def starts(self) -> int:
        """Starts of the search, with the value that stands for ``None``."""
        assert self.search.starts is not None
        return self.search.starts

    @property
    def general_weight(self) -> float:
        """Share of the accuracy everywhere, with the value that stands for ``None``."""
        assert self.search.general_weight is not None
        return self.search.general_weight

    @property
    def test_pose_array(self) -> FloatArray:
        """(K, joints) ``test_poses`` as the array that the constructor made of it [rad | m]."""
        return np.asarray(self.test_poses)

    @property
    def weight_array(self) -> FloatArray:
        """(K,) ``weights`` as the array that the constructor made of it."""
        return np.asarray(self.weights)

    @property
    def candidate_array(self) -> FloatArray | None:
        """(C, joints) the candidates [rad | m], or ``None``."""
        return None if self.candidates is None else np.asarray(self.candidates.configurations)

    @property
    def once_each(self) -> bool:
        """Whether there are candidates, each of which may be chosen once only."""
        return self.candidates is not None and not self.candidates.repeat

    @property
    def instrument(self) -> Noise:
        """``noise`` as the constructor made it, never a number."""
        assert not isinstance(self.noise, (float, int))
        return self.noise

    @property
    def measurements(self) -> int:
        """Number of measurements in the plan."""
        return self.configurations * self.repetitions


PAPERS_ROBOTS = ("planar_2r", "kuka_kr270")
"""Robots of the paper: planned for as the paper has it unless somebody asks for more."""


def usual_error_model(robot: Robot, noise: Noise | float) -> ErrorModel:
    """How a robot is expected to err if the user says nothing about it.

    A real robot errs by all terms, of typical size. What is known of its chain is taken as wide as the spread of
    its scales allows, a factor of one standard deviation: plans that trust tight tolerances lose on robots that
    do not keep them. The robots of the paper get the paper's model.
    """
    instrument = Isotropic(noise) if isinstance(noise, (float, int)) else noise
    if robot.name in PAPERS_ROBOTS:
        return ErrorModel.paper(instrument)
    return with_wide_placement(typical(instrument, gravity=gravity_of(robot)))


def with_wide_placement(model: ErrorModel) -> ErrorModel:
    """The model with the tolerances of the chain at their median times their factor."""
    wide = {s.name: s.median * s.factor for s in model.scales if s.name.startswith("placement.")}
    return model.with_values(wide)


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
