"""The answer of the planner: configurations, what they promise, how far from the best possible that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray, IntArray, frozen, plain

STATUS = {
    "ok": "The plan is complete.",
    "singular": "The plan predicts the test poses but leaves parameter combinations unseen: raise the number "
    "of configurations, the general weight or add test poses.",
    "time_limit": "The time limit ended the search; this is the best plan found so far.",
    "cancelled": "The search was cancelled; this is the best plan found so far.",
}
"""Every status a plan can have, with advice."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A measurement plan that carries its own proof.

    Attributes:
        robot: Name of the robot.
        criterion: What was minimised.
        parameters: Names of the parameters to be identified.
        joint_names: Order of the columns of ``configurations`` and ``test_poses``.
        configurations: (m, joints) in the order of measuring [rad | m].
        repetitions: (m,) measurements at each.
        test_poses: (K, joints) [rad | m].
        weights: (K,) weights of the test poses.
        sigma: Standard deviation of one coordinate [m]; for a laser tracker a typical one.
        predicted_accuracy: ρ0 of eq. (14), root mean square over the test poses [m].
        predicted_accuracy_per_test_pose: (K,) [m].
        parameter_std: (P,) predicted standard deviation of each parameter [m | rad]; infinite if this plan
            does not see it, NaN if no plan can tell it from others.
        unidentifiable: Combinations of parameters that no configuration within the limits can tell apart.
        general_accuracy: Root mean square error over random configurations within the limits [m].
        value: Value of the criterion, see ``criteria``; for ``test_pose`` the predicted accuracy.
        value_bound: No plan with as many measurements has a better value; NaN where the criterion has no bound.
        lower_bound: The same in metres for criteria that are accuracies, NaN for others.
        efficiency: Value over bound in the criterion's own convention, at most 1: for accuracies
            lower_bound / value, for D (det M / det M*)^(1/p).
        bound: ``"numerical"`` (the sensitivity was maximised by search), ``"proven"``, or ``"none"``.
        status: A key of ``STATUS``.
        message: What it means and what to do.
        seconds: Time spent.
        seed: The seed that reproduces it.
        starts: Starts done.
        evaluations: Plans evaluated.
    """

    robot: str
    criterion: str
    parameters: tuple[str, ...]
    joint_names: tuple[str, ...]
    configurations: FloatArray
    repetitions: IntArray
    test_poses: FloatArray
    weights: FloatArray
    sigma: float
    predicted_accuracy: float
    predicted_accuracy_per_test_pose: FloatArray
    parameter_std: FloatArray
    unidentifiable: tuple[str, ...]
    general_accuracy: float
    value: float
    value_bound: float
    lower_bound: float
    efficiency: float
    bound: str
    status: str
    message: str
    seconds: float
    seed: int
    starts: int
    evaluations: int

    def __post_init__(self) -> None:
        for name in ("configurations", "test_poses", "weights", "parameter_std"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name), float)))
        per = frozen(np.asarray(self.predicted_accuracy_per_test_pose, float))
        object.__setattr__(self, "predicted_accuracy_per_test_pose", per)
        object.__setattr__(self, "repetitions", frozen(np.asarray(self.repetitions, np.int64)))

    @property
    def measurements(self) -> int:
        """Number of measurements in all."""
        return int(self.repetitions.sum())

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers, the keys of the contract; non-finite numbers become ``None``."""
        return plain({name: getattr(self, name) for name in self.__dataclass_fields__})
