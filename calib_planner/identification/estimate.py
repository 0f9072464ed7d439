"""The answer of the identification: parameters, how sure they are, and what the residuals say."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib_planner._arrays import FloatArray, frozen
from calib_planner.design.plan import plain
from calib_planner.robot.chain import Robot

STATUS = {
    "ok": "All requested parameters were identified.",
    "rank_deficient": "Some parameters cannot be told apart from others by these data and were held at their "
    "nominal values; see the combinations listed. Measure in other configurations or ask for fewer.",
    "not_converged": "The iteration did not settle: check units, joint order and signs, and the start.",
}
"""Every status an estimate can have, with advice."""


@dataclass(frozen=True)
class ResidualStatistics:
    """Distances between measured and predicted points [m]: mean, root mean square, largest."""

    mean: float
    rms: float
    max: float


def residual_statistics(distances: FloatArray) -> ResidualStatistics:
    """Statistics of a list of distances (count,) [m]."""
    if not distances.size:
        return ResidualStatistics(float("nan"), float("nan"), float("nan"))
    rms = float(np.sqrt(np.mean(distances**2)))
    return ResidualStatistics(float(distances.mean()), rms, float(distances.max()))


@dataclass(frozen=True)
class Validation:
    """Distances on data that took no part in the fit [m].

    Attributes:
        count: Number of points.
        mean, median, rms, max: After identification.
        before_mean: Mean with the nominal kinematics (only base and targets fitted).
    """

    count: int
    mean: float
    median: float
    rms: float
    max: float
    before_mean: float


@dataclass(frozen=True, eq=False)
class Estimate:
    """Identified parameters with their uncertainty.

    Attributes:
        robot: Name of the robot.
        joint_names: Order of joint arrays.
        parameters: P names, the order of all parameter arrays.
        units: ``m`` or ``rad``.
        nominal: (P,) values before; for base and targets the closed-form start.
        deviations: (P,) identified value − nominal; 0 where held.
        std: (P,) standard deviations; NaN where held.
        covariance: (P, P), eq. (11); zero rows and columns where held.
        rank: Number of parameters identified.
        unidentifiable: Combinations that the data cannot see.
        held: Names of the parameters held at nominal, one per combination.
        measurements: Points given.
        used: Points used.
        rejected: ``{row, target, reason}`` of every point not used.
        sigma: Standard deviation of one coordinate that the covariance rests on [m].
        sigma_estimate: The same from the residuals, NaN without redundancy [m].
        residual_before: With nominal kinematics (base and targets fitted if unknown).
        residual_after: With the identified parameters.
        residuals: (N, targets, 3) measured − predicted [m], NaN where not measured.
        test_poses: (K, joints) [rad | m].
        predicted_accuracy_per_test_pose: (K,) ρ0 of eq. (14) with the covariance found [m].
        iterations: Iterations done.
        status: A key of ``STATUS``.
        message: What it means and what to do.
        seconds: Time spent.
        calibrated: The robot with the identified parameters as its nominal ones.
        validation: Statistics on held-out data, if any was given.
    """

    robot: str
    joint_names: tuple[str, ...]
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    nominal: FloatArray
    deviations: FloatArray
    std: FloatArray
    covariance: FloatArray
    rank: int
    unidentifiable: tuple[str, ...]
    held: tuple[str, ...]
    measurements: int
    used: int
    rejected: tuple[dict[str, Any], ...]
    sigma: float
    sigma_estimate: float
    residual_before: ResidualStatistics
    residual_after: ResidualStatistics
    residuals: FloatArray
    test_poses: FloatArray
    predicted_accuracy_per_test_pose: FloatArray
    iterations: int
    status: str
    message: str
    seconds: float
    calibrated: Robot
    validation: Validation | None = None

    def __post_init__(self) -> None:
        for name in ("nominal", "deviations", "std", "covariance", "residuals", "test_poses"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name), float)))
        per = frozen(np.asarray(self.predicted_accuracy_per_test_pose, float))
        object.__setattr__(self, "predicted_accuracy_per_test_pose", per)

    @property
    def values(self) -> FloatArray:
        """(P,) nominal + deviation [m | rad]."""
        return self.nominal + self.deviations

    @property
    def predicted_accuracy(self) -> float:
        """ρ0: root mean square over the test poses [m]; NaN without test poses."""
        per = self.predicted_accuracy_per_test_pose
        return float(np.sqrt(np.mean(per**2))) if per.size else float("nan")

    def with_validation(self, validation: Validation) -> Estimate:
        """The same estimate with held-out statistics attached."""
        return replace(self, validation=validation)

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers, the keys of the contract; non-finite numbers become ``None``."""
        columns = zip(
            self.parameters,
            self.units,
            self.nominal,
            self.values,
            self.deviations,
            self.std,
            strict=True,
        )
        keys = ("name", "unit", "nominal", "value", "deviation", "std")
        result = {
            "robot": self.robot,
            "joint_names": self.joint_names,
            "parameters": [dict(zip(keys, row, strict=True)) for row in columns],
            "covariance": self.covariance,
            "rank": self.rank,
            "unidentifiable": [
                {"parameter": n, "combination": c} for n, c in zip(self.held, self.unidentifiable, strict=True)
            ],
            "measurements": self.measurements,
            "used": self.used,
            "rejected": list(self.rejected),
            "sigma": self.sigma,
            "sigma_estimate": self.sigma_estimate,
            "residual_before": vars(self.residual_before),
            "residual_after": vars(self.residual_after),
            "iterations": self.iterations,
            "status": self.status,
            "message": self.message,
            "seconds": self.seconds,
        }
        if len(self.test_poses):
            result["test_poses"] = self.test_poses
            result["predicted_accuracy"] = self.predicted_accuracy
            result["predicted_accuracy_per_test_pose"] = self.predicted_accuracy_per_test_pose
        if self.validation is not None:
            result["validation"] = vars(self.validation)
        plain_result: dict[str, Any] = plain(result)
        return plain_result
