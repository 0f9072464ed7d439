# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The problem and the result of a campaign: which accuracy, how much may be measured, and how it ended.

Where the robot could not be measured, a neighbourhood of the configuration is given up with it. Around a
configuration q_e that failed all q with

    max_l |q_l − q_el| / range_l < r

are excluded from plans, l running over the joints that move a target: turning another joint would repeat the same
failure. One failure does not tell how far away the robot can be measured, so r begins small; a failure next to an
earlier one shows that r was too small, and its own r is twice the earlier one's. No neighbourhood reaches a
configuration that was measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_planner.arrays import FloatArray, check_count, check_number, frozen, plain
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.identification import Estimate, IdentificationProblem, Verdict
from calib_planner.measurements import Measurements
from calib_planner.planning import Constraint, PlanProblem, Search
from calib_planner.robot import Robot
from calib_planner.tracker import Isotropic, Noise

OPTIONS = ("loss", "prior", "error_model")
"""Fields of ``IdentificationProblem`` that a campaign may set; it sets the others itself."""
COUNTS = {
    "budget": (1, 10_000),
    "batch": (1, 200),
    "validation": (0, 1000),
    "minimum": (1, 1000),
    "attempts": (1, 100),
    "most_failures": (0, 10_000),
    "seed": (0, 2**31 - 1),
}
"""Whole numbers of a ``CampaignProblem``: smallest and largest."""


@dataclass(frozen=True, eq=False)
class CampaignProblem:
    """Measure until the error predicted of a visit to every test pose is at most ``required_accuracy``.

    Attributes:
        robot: The nominal robot, its active parameters being those to be identified.
        test_poses: (K, joints) where accuracy matters, at least one [rad | m].
        required_accuracy: Largest acceptable root mean square error of a visit to a test pose [m]: what is not
            known of the robot, and its repeatability.
        budget: Measurements allowed in all, those of the validation and those that failed included.
        batch: Configurations planned at a time; after each batch the rest is planned anew.
        sigma: Standard deviation of one coordinate of one measurement [m]: what to expect until the
            measurements tell; see ``noise``. The paper's error model takes it for granted.
        noise: The instrument; default isotropic with ``sigma``.
        constraints: Conditions on configurations besides the joint limits.
        validation: Measurements at the end that take no part in the fit; 0: none.
        minimum: Fewest different configurations, however accurate they look.
        attempts: How often a measurement is tried at one configuration before it is given up.
        most_failures: Configurations given up before the campaign ends.
        exclusion: Half width of the neighbourhood that is given up with a configuration, as a share of each
            joint's range.
        accuracy_frame: Of what is not known at the test poses, (M3): ``world`` or ``robot``.
        identification: Further settings of ``IdentificationProblem``, see ``OPTIONS``.
        starts, time_limit: Of each plan's search, see ``Search``; no starts: as many as usual.
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
    accuracy_frame: str = "world"
    identification: Mapping[str, Any] = field(default_factory=dict)
    starts: int = 0
    time_limit: float = 60.0
    seed: int = 0

    def __post_init__(self) -> None:
        put = object.__setattr__
        for name in ("required_accuracy", "sigma"):
            length = check_number(name, getattr(self, name), low=0, low_open=True, high=1.0, unit="m")
            put(self, name, length)
        put(self, "noise", Isotropic(self.sigma) if self.noise is None else self.noise)
        for name, (low, high) in COUNTS.items():
            put(self, name, check_count(name, getattr(self, name), low=low, high=high))
        put(self, "exclusion", check_number("exclusion", self.exclusion, low=0, low_open=True, high=0.5))
        for name in self.identification:
            if name not in OPTIONS:
                raise UnknownNameError("identification", str(name), OPTIONS)
        put(self, "identification", dict(self.identification))
        # The planner checks the fields that it shares with us, which have the same names.
        checked = PlanProblem(
            self.robot,
            self.test_poses,
            1,
            noise=self.instrument,
            accuracy_frame=self.accuracy_frame,
            constraints=self.constraints,
            search=Search(starts=self.starts or None, seed=self.seed, time_limit=self.time_limit),
        )
        put(self, "test_poses", checked.test_pose_array)
        put(self, "constraints", checked.constraints)
        if self.budget <= self.validation:
            expected = f"more than validation, which is {self.validation}"
            raise InputError("budget", self.budget, expected, "raise budget or lower validation")
        middle = self.robot.joint_limits.mean(axis=1)[None]
        made_up = Measurements(self.robot.joint_names, middle, self.robot.positions(middle))
        frame = self.accuracy_frame
        IdentificationProblem(
            self.robot, made_up, test_poses=self.test_poses, accuracy_frame=frame, **self.identification
        )

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


# ── configurations given up ─────────────────────────────────────────────────────────────────────────

WIDEST = 0.4
"""Largest half width, as a share of each joint's range."""
NARROWEST = 0.005
"""Smallest, where something was measured close by."""
NEXT_TO = 1.5
"""Failures whose neighbourhoods would be this much wider and touch are next to each other."""
IDLE = 1e-9
"""A joint that moves no target by more than this per radian or metre is idle [m]."""


@dataclass(frozen=True, eq=False)
class Exclusion:
    """A configuration given up.

    Attributes:
        index: Number of the configuration in the campaign.
        q: (joints,) [rad | m].
        radius: r, a share of each joint's range.
        reason: Why, in words.
        requested: Whether a person wanted it.
    """

    index: int
    q: FloatArray
    radius: float
    reason: str
    requested: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", frozen(np.asarray(self.q, float)))


@dataclass(frozen=True, eq=False)
class AwayFrom:
    """The constraint that plans get.

    Attributes:
        exclusions: What to stay away from.
        scale: (joints,) see ``joint_scale``.
    """

    exclusions: tuple[Exclusion, ...]
    scale: FloatArray
    name: str = "away from what could not be measured"

    def allowed(self, robot: Robot, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) → (N,)."""
        ok = np.ones(len(q), bool)
        for out in self.exclusions:
            ok &= distances(q, out.q, self.scale) >= out.radius
        return ok


def joint_scale(robot: Robot) -> FloatArray:
    """(joints,) 1/range of each joint; 0 for one that moves no target."""
    low, high = robot.joint_limits.T
    sample = np.random.default_rng(0).uniform(low, high, (32, len(low)))
    moves = np.abs(np.ascontiguousarray(robot.joint_jacobian(sample))).max(axis=(0, 1)) > IDLE
    return np.where(moves, 1.0 / (high - low), 0.0)


def distances(q: FloatArray, other: FloatArray, scale: FloatArray) -> FloatArray:
    """(N, joints), (joints,) → (N,) largest difference of a joint as a share of its range."""
    return np.asarray((np.abs(q - other) * scale).max(axis=1))


def radius_of(
    q: FloatArray, earlier: Sequence[Exclusion], measured: FloatArray, scale: FloatArray, least: float
) -> float:
    """r for a new failure at ``q`` (joints,), ``measured`` (N, joints) being where it did work."""
    near = [e.radius for e in earlier if distances(e.q[None], q, scale)[0] < NEXT_TO * (e.radius + least)]
    radius = min(2.0 * max(near), WIDEST) if near else least
    if len(measured):
        radius = min(radius, 0.9 * float(distances(measured, q, scale).min()))
    return max(radius, NARROWEST)


# ── the result ──────────────────────────────────────────────────────────────────────────────────────

OUTCOMES = {
    "reached": "a visit to a test pose errs by no more than was required",
    "budget_spent": "the budget was spent before the accuracy was reached and confirmed: raise it",
    "limited": "more measurements cannot help, because the robot itself repeats no better: require less, or "
    "measure and correct each visit",
    "unreachable": "too little is left that can be measured: widen limits and constraints, or move the tracker",
    "failed": "the measurements cannot be identified",
}
"""Every way to end, with advice."""


@dataclass(frozen=True)
class Round:
    """What was known after a batch, and what was planned then.

    Attributes:
        number: From 0; round 0 has nothing measured.
        measured: Measurements used.
        configurations: Different ones among them.
        accuracy: Error predicted of a visit to the worst test pose [m].
        floor: What more measurements leave of it, the robot's repeatability [m].
        sigma: Noise of one coordinate of one measurement, as estimated [m].
        left: Forecast of measurements still needed; infinite: it cannot be reached.
        planned: Measurements planned next.
        note: What was decided, in words.
        left_out: Root mean square distance of a point from where all other configurations predict it [m]; NaN
            where nothing was identified.
    """

    number: int
    measured: int
    configurations: int
    accuracy: float
    floor: float
    sigma: float
    left: float
    planned: int
    note: str
    left_out: float = float("nan")


@dataclass(frozen=True, eq=False)
class CampaignResult:
    """The end of a campaign.

    Attributes:
        outcome: A key of ``OUTCOMES``.
        message: What it means here.
        required_accuracy: As in the problem [m].
        rounds: How it went.
        estimate: What was identified, with its validation; ``None`` if nothing could be.
        verdict: PASS, WARN or FAIL with reasons.
        fit: Measurements of the fit, or ``None``.
        validation: Measurements that took no part in it, or ``None``.
        exclusions: Configurations given up.
        spent: Measurements made, those that failed included.
        budget: Measurements allowed.
        accuracy: Error predicted of a visit to the worst test pose [m]; infinite without an estimate.
        floor: Of it the robot's repeatability [m]; NaN without an estimate.
    """

    outcome: str
    message: str
    required_accuracy: float
    rounds: tuple[Round, ...]
    estimate: Estimate | None
    verdict: Verdict
    fit: Measurements | None
    validation: Measurements | None
    exclusions: tuple[Exclusion, ...]
    spent: int
    budget: int
    accuracy: float = float("inf")
    floor: float = float("nan")

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers; non-finite numbers become ``None``."""
        keys = ("outcome", "message", "required_accuracy", "spent", "budget")
        result = {name: getattr(self, name) for name in keys}
        result |= {
            "predicted_accuracy": self.accuracy,
            "repeatability": self.floor,
            "rounds": [asdict(r) for r in self.rounds],
            "verdict": asdict(self.verdict),
            "measurements": _rows(self.fit),
            "validation_measurements": _rows(self.validation),
            "excluded": [
                {"configuration": e.q, "reason": e.reason, "asked": e.requested} for e in self.exclusions
            ],
            "estimate": None if self.estimate is None else self.estimate.to_dict(),
        }
        values: dict[str, Any] = plain(result)
        return values


def _rows(data: Measurements | None) -> dict[str, Any] | None:
    if data is None:
        return None
    return {"joint_names": data.joint_names, "configurations": data.q, "points": data.p}
