"""What has been measured of a plan, and the estimate it gives: the identifier without ROS.

A campaign belongs to one plan (or to none); a plan with another name begins a new one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.design.plan import Plan
from calib_planner.errors import InputError, NotEnoughDataError, UnknownNameError
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.solver import identify
from calib_planner.instrument.standstill import Standstill
from calib_planner.instrument.standstill_noise import mean_std
from calib_planner.robot.chain import Robot


@dataclass(frozen=True)
class Matching:
    """How standstills are matched and weighted.

    Attributes:
        tolerance: Largest joint difference to a planned configuration [rad | m].
        accept_unplanned: Use standstills in no plan.
        sigma: Standard deviation of one coordinate of one sample [m]; 0: from the samples' scatter.
        repeatability: Standard deviation that averaging does not reduce [m].
        most: Measurements kept at most.
    """

    tolerance: float = 0.01
    accept_unplanned: bool = False
    sigma: float = 3e-5
    repeatability: float = 0.0
    most: int = 5000


@dataclass(frozen=True, eq=False)
class Decision:
    """What becomes of a standstill.

    Attributes:
        found: The standstill.
        status: ``accepted``, ``not_in_plan`` or ``undone``.
        reason: In words; empty when accepted.
        index: Row of the plan, or ``None``.
        repetition: Number of this measurement at its configuration, from 0.
    """

    found: Standstill
    status: str
    reason: str
    index: int | None
    repetition: int


@dataclass(frozen=True)
class TooFew:
    """No estimate yet: ``missing`` is how many configurations at least are still needed."""

    missing: int
    message: str


@dataclass
class Campaign:
    """Measurements of one plan by one robot.

    Attributes:
        nominal: The robot, its active parameters being the identifier's own choice.
        follow: Chooses the robot's active parameters for a plan.
        plan_id, plan: The plan, if any.
        robot: The robot whose parameters are identified now.
        accepted: What is used, in the order of measuring.
        rejected: Number of standstills that were not used.
    """

    nominal: Robot
    follow: Callable[[Plan], Robot]
    plan_id: str = ""
    plan: Plan | None = None
    accepted: list[Decision] = field(default_factory=list)
    rejected: int = 0

    def __post_init__(self) -> None:
        self.robot = self.nominal

    def begin(self, plan_id: str, plan: Plan) -> bool:
        """Take a plan; ``False`` if it is the current one. Measurements of another plan are dropped.

        Raises:
            InputError: The plan is for another robot.
        """
        if self.plan is not None and plan_id == self.plan_id:
            return False
        if plan.robot != self.nominal.name:
            raise UnknownNameError("plan.robot", plan.robot, [self.nominal.name])
        if plan.joint_names != self.nominal.joint_names:
            raise InputError("plan.joint_names", plan.joint_names, ", ".join(self.nominal.joint_names))
        robot = self.follow(plan)
        self.robot, self.plan_id, self.plan = robot, plan_id, plan
        self.reset()
        return True

    def reset(self) -> int:
        """Forget all measurements; returns how many."""
        count = len(self.accepted)
        self.accepted, self.rejected = [], 0
        return count

    def undo(self) -> Decision | None:
        """Withdraw the newest measurement."""
        if not self.accepted:
            return None
        last = self.accepted.pop()
        self.rejected += 1
        return Decision(last.found, "undone", "withdrawn on request", last.index, last.repetition)

    def take(self, found: Standstill, how: Matching) -> Decision:
        """Decide on a standstill, and keep it if it is accepted."""
        index, reason = self._match(found.joints, how)
        if reason and not how.accept_unplanned:
            self.rejected += 1
            return Decision(found, "not_in_plan", reason, None, 0)
        if len(self.accepted) >= how.most:
            self.rejected += 1
            reason = f"{how.most} measurements are kept at most: raise most_measurements or call ~/reset"
            return Decision(found, "not_in_plan", reason, index, 0)
        decision = Decision(found, "accepted", "", index, self.done()[index])
        self.accepted.append(decision)
        return decision

    def done(self) -> Counter[int | None]:
        """Measurements per row of the plan."""
        return Counter(d.index for d in self.accepted)

    @property
    def complete(self) -> bool:
        """Whether every planned configuration was measured as often as planned."""
        if self.plan is None:
            return False
        done = self.done()
        return all(done[i] >= r for i, r in enumerate(self.plan.repetitions))

    def _match(self, joints: FloatArray, how: Matching) -> tuple[int | None, str]:
        """Row of the plan and, if there is none, why. Unfinished rows come first, then the nearest."""
        plan = self.plan
        if plan is None:
            return None, "there is no plan: request one, or set accept_unplanned"
        distance = np.abs(plan.configurations - joints).max(axis=1)
        near = np.flatnonzero(distance <= how.tolerance)
        if not len(near):
            i = int(np.argmin(distance))
            text = f"the nearest planned configuration, {i}, is {distance[i]:.4f} rad away"
            return None, f"{text}, plan_tolerance is {how.tolerance:g}: check the pose"
        done = self.done()
        best = min(near, key=lambda i: (done[int(i)] >= plan.repetitions[i], distance[i]))
        return int(best), ""

    # ── the estimate ─────────────────────────────────────────────────────────────────────────────────

    def measurements(self, how: Matching) -> Measurements | None:
        """What is used, as the library's value; ``None`` if there is nothing."""
        if not self.accepted:
            return None
        found = [d.found for d in self.accepted]
        points = np.array([f.points for f in found])
        std = mean_std(found, how.sigma, how.repeatability)
        q = np.array([f.joints for f in found])
        return Measurements(self.robot.joint_names, q, points, std)

    def estimate(self, how: Matching) -> Estimate | TooFew:
        """Identify with what there is."""
        data = self.measurements(how)
        poses = self.plan.test_poses if self.plan is not None and len(self.plan.test_poses) else None
        try:
            if data is None:
                raise NotEnoughDataError(0, len(self.robot.parameter_names), "nothing was measured yet")
            # At every standstill: what takes seconds is left to the analysis of the finished campaign.
            problem = IdentificationProblem(self.robot, data, test_poses=poses, joint_corrections="off", starts=0)
            return identify(problem)
        except NotEnoughDataError as error:
            each = 3 * len(self.robot.targets)
            missing = max(-(-(error.need - error.have) // each), 1)
            return TooFew(missing, f"{missing} more configurations needed at least: {error}")
