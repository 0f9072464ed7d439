"""The request to the planner: a robot, where accuracy matters, and how much may be measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_array, check_configurations, check_count, check_number
from calib_planner.error_model import ACCURACIES
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.measurements import Measurements
from calib_planner.planning.criteria import CRITERIA, POSE_CRITERIA
from calib_planner.planning.discrepancy import ModelDiscrepancy
from calib_planner.planning.feasibility import Constraint
from calib_planner.robot import Robot
from calib_planner.tracker import Isotropic, Noise


@dataclass(frozen=True, eq=False)
class PlanPrior:
    """What is known of the parameters before the plan is measured.

    Attributes:
        std: Parameter name → standard deviation [m | rad].
        measured: Measurements already taken; the plan is for the *next* configurations.
    """

    std: Mapping[str, float] = field(default_factory=dict)
    measured: Measurements | None = None

    @property
    def empty(self) -> bool:
        """Whether nothing is known."""
        return not self.std and self.measured is None

    def checked(self, robot: Robot) -> PlanPrior:
        """The same in the robot's joint order.

        Raises:
            InputError: A parameter or joint that the robot does not have, or a number that is not usable.
        """
        for name in self.std:
            if name not in robot.parameter_names:
                raise UnknownNameError("prior.std", str(name), robot.parameter_names)
        std = {n: check_number(f"prior.std[{n}]", v, low=0, low_open=True) for n, v in self.std.items()}
        measured = self.measured
        if measured is not None:
            measured = measured.in_order_of(robot.joint_names)
            have, want = measured.p.shape[1], len(robot.targets)
            if have != want:
                raise InputError("prior.measured", f"{have} targets", f"{want}, as the robot has")
        return PlanPrior(std, measured)


@dataclass(frozen=True, eq=False)
class Candidates:
    """The only configurations that may be measured.

    Attributes:
        configurations: (C, joints) [rad | m].
        repeat: Whether a candidate may be chosen more than once.
    """

    configurations: ArrayLike
    repeat: bool = False


@dataclass(frozen=True)
class Search:
    """How the planner searches.

    Attributes:
        starts: Random starts.
        seed: The same seed gives the same plan.
        time_limit: Seconds after which the best plan so far is returned.
        general_weight: Share of the test-pose criterion given to the mean accuracy over all joint limits. It
            prevents that a plan leaves parameters unseen that matter only away from the test poses; 0 is the
            paper's plain criterion.
    """

    starts: int = 48
    seed: int = 0
    time_limit: float = float("inf")
    general_weight: float = 5e-5

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "starts", check_count("starts", self.starts, high=100_000))
        put(self, "seed", check_count("seed", self.seed, low=0, high=2**63 - 1))
        if not self.time_limit > 0:
            raise InputError("time_limit", self.time_limit, "a number of seconds > 0")
        put(self, "general_weight", check_number("general_weight", self.general_weight, low=0, high=1))


@dataclass(frozen=True, eq=False)
class PlanProblem:
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
        noise: The instrument; a number is the standard deviation of every coordinate of a point [m].
        repeatability: σ_c, error of one coordinate that repeating a measurement at the same configuration does
            not average away [m].
        discrepancy: What the real robot has beyond any geometric model (see ``discrepancy``). The plan is then
            chosen from ``candidates`` for the smallest expected error at the test poses on such a robot;
            value and bound stay those of the criterion. ``None`` is the paper's plain criterion.
        prior: What is known of the parameters beforehand.
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
    repeatability: float = 0.0
    discrepancy: ModelDiscrepancy | None = None
    prior: PlanPrior = PlanPrior()
    constraints: tuple[Constraint, ...] = ()
    candidates: Candidates | None = None
    search: Search = Search()
    accuracy_frame: str = "world"

    def __post_init__(self) -> None:
        put, robot = object.__setattr__, self.robot
        if not isinstance(robot, Robot):
            raise InputError("robot", type(robot).__name__, "a Robot", "use Robot.load(...)")
        if not robot.parameter_names:
            raise InputError("robot", "no active parameters", "at least one", "use robot.with_parameters(...)")
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
        common = check_number("repeatability", self.repeatability, low=0, high=1, unit="m")
        put(self, "repeatability", common)
        put(self, "prior", self.prior.checked(robot))
        put(self, "constraints", tuple(self.constraints))
        if self.candidates is not None:
            q = check_configurations("candidates", self.candidates.configurations, robot.joint_names)
            put(self, "candidates", replace(self.candidates, configurations=q))
            if not self.candidates.repeat and len(q) < self.configurations:
                raise InputError("candidates", f"{len(q)} rows", f"at least {self.configurations}, one each")
        if self.discrepancy is not None:
            self._check_discrepancy()

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

    def _check_discrepancy(self) -> None:
        if self.candidates is None:
            raise InputError("discrepancy", "no candidates", "candidates to choose from", "draw some hundred")
        if self.criterion != "test_pose" or self.compound:
            raise InputError("discrepancy", f"criterion {self.criterion}", "criterion test_pose, not compound")
        if self.candidates.repeat:
            raise InputError("discrepancy", "repeat_candidates", "candidates chosen once each")

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


def usual_discrepancy(
    robot: Robot, criterion: str, candidates: Candidates | None, compound: Mapping[str, float] | None = None
) -> ModelDiscrepancy | None:
    """What a plan problem expects of the robot beyond its geometric model if the user says nothing about it.

    A robot from a URDF is a real one, which errs systematically, and candidates show what it can be driven to.
    Other robots, other criteria and requests without candidates get the paper's plain criterion (``None``).
    """
    plain = criterion == "test_pose" and not compound
    applies = robot.from_urdf and plain and candidates is not None and not candidates.repeat
    return ModelDiscrepancy() if applies else None


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
