"""The answer of the identification: parameters, how sure they are, and what the residuals say."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from calib_planner._arrays import FloatArray, check_configurations, frozen
from calib_planner.design.plan import plain
from calib_planner.identification.hidden_errors import HiddenErrors
from calib_planner.identification.noise_levels import NoiseLevels
from calib_planner.identification.order_check import Disturbance
from calib_planner.identification.structure import Structure
from calib_planner.identification.transmission import Transmission
from calib_planner.identification.verdict import Verdict, judge
from calib_planner.robot.chain import Robot

STATUS = {
    "ok": "All requested parameters were identified.",
    "rank_deficient": "Some parameters cannot be told apart from others by these data and were held at their "
    "nominal values; see the combinations listed. Measure in other configurations or ask for fewer.",
    "not_converged": "The iteration did not settle: check units, joint order and signs, and the start.",
}
"""Every status an estimate can have, with advice."""
STRONG = 0.95
"""Correlations beyond this are named."""


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
        predicted_rms: What the covariance, the discrepancy and the measurement noise together predict for rms;
            NaN where it was not predicted.
        within_95: Share of the points inside their 95 % region; NaN where it was not predicted.
        geometry_mean, geometry_rms: With the geometric parameters alone, without joint corrections.
        folds: Parts of a cross-validation; 0: held-out data.
        noise_rms: What the measurement of these points alone adds to rms; NaN where it cannot be told from the
            robot, or was not predicted.
    """

    count: int
    mean: float
    median: float
    rms: float
    max: float
    before_mean: float
    predicted_rms: float = float("nan")
    within_95: float = float("nan")
    geometry_mean: float = float("nan")
    geometry_rms: float = float("nan")
    folds: int = 0
    noise_rms: float = float("nan")

    @property
    def robot_rms(self) -> float:
        """What the robot is off at least: rms less the measurement's part and two standard deviations of that
        (see ``adaptive.requirement``); all of rms where the measurement's part is not known [m].
        """
        if not np.isfinite(self.noise_rms):
            return self.rms
        noise = self.noise_rms**2 * (1.0 + 2.0 * np.sqrt(2.0 / (3.0 * self.count)))
        return float(np.sqrt(max(self.rms**2 - noise, 0.0)))


@dataclass(frozen=True)
class ChiSquare:
    """Whether measurement noise alone explains the residuals.

    Attributes:
        value: Sum of squares of the residuals in units of the measurement noise; NaN where that is unknown.
        freedom: Equations less parameters.
    """

    value: float
    freedom: int

    @property
    def probability(self) -> float:
        """Of a sum of squares as large or larger; NaN where it is unknown."""
        if not np.isfinite(self.value) or self.freedom < 1:
            return float("nan")
        return float(chi2.sf(self.value, self.freedom))


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
        unidentifiable: Combinations that neither data nor prior can see.
        held: Names of the parameters held at nominal, one per combination.
        measurements: Points given.
        used: Points used.
        rejected: ``{row, target, reason, normalised_residual, residual}`` of every point not used; rows from 0,
            targets from 1 as in the column names.
        suspects: The same of points used although they lie beyond the gate.
        copies: Rows that repeat another one digit for digit.
        resolved_by_prior: Combinations that the data cannot see and the prior decides.
        nearly_dependent: Combinations that the data hardly see, weakest first.
        prior: Where the prior came from; empty without one.
        noise: The parts of the scatter.
        sigma: Standard deviation of one coordinate that the covariance rests on, discrepancy included [m].
        sigma_estimate: Scatter of one coordinate about the fit, NaN without redundancy [m].
        chi_square: Whether measurement noise alone explains the residuals.
        residual_before: With nominal kinematics (base and targets fitted if unknown), points used.
        residual_after: With the identified parameters, points used.
        residuals: (N, targets, 3) measured − predicted [m], NaN where not measured.
        normalised_residuals: (N, targets) their lengths in standard deviations of what they should be.
        gate: Largest believable normalised residual.
        test_poses: (K, joints) [rad | m].
        parameter_accuracy_per_test_pose: (K,) ρ0 of eq. (14) with the covariance found [m].
        discrepancy_per_test_pose: (K,) what no geometric model holds there, root mean square distance [m].
        structure: Whether the residuals know where the robot stood; see ``structure``.
        disturbances: What seems to have moved during the campaign; see ``order_check``.
        moved_since: First row of those at the end that were all rejected, or ``None``.
        transmission: The complete model with the joints' own errors, if the data show them; else ``None``.
        hidden: Errors of the joints that the data would not show, and what they would do; ``None`` where it was
            not asked or errors were learnt.
        starts, agreeing_starts: Other starts made, and those that ended in the same minimum.
        iterations: Iterations of the last fit.
        status: A key of ``STATUS``.
        message: What it means and what to do.
        seconds: Time spent.
        calibrated: The robot with the identified parameters as its nominal ones.
        validation: Statistics on held-out data, if any was given.
        cross_validation: The same by leaving out parts of the data, if asked for.
        required_accuracy: Largest error at a pose that the user can live with [m]; NaN: not stated.
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
    resolved_by_prior: tuple[str, ...]
    nearly_dependent: tuple[str, ...]
    prior: str
    measurements: int
    used: int
    rejected: tuple[dict[str, Any], ...]
    suspects: tuple[dict[str, Any], ...]
    copies: int
    sigma: float
    sigma_estimate: float
    noise: NoiseLevels
    chi_square: ChiSquare
    residual_before: ResidualStatistics
    residual_after: ResidualStatistics
    residuals: FloatArray
    normalised_residuals: FloatArray
    gate: float
    test_poses: FloatArray
    parameter_accuracy_per_test_pose: FloatArray
    discrepancy_per_test_pose: FloatArray
    structure: tuple[Structure, ...]
    disturbances: tuple[Disturbance, ...]
    moved_since: int | None
    transmission: Transmission | None
    hidden: HiddenErrors | None
    starts: int
    agreeing_starts: int
    iterations: int
    status: str
    message: str
    seconds: float
    calibrated: Robot
    validation: Validation | None = None
    cross_validation: Validation | None = None
    required_accuracy: float = float("nan")

    def __post_init__(self) -> None:
        arrays = ("nominal", "deviations", "std", "covariance", "residuals", "normalised_residuals", "test_poses")
        for name in (*arrays, "parameter_accuracy_per_test_pose", "discrepancy_per_test_pose"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name), float)))

    @property
    def values(self) -> FloatArray:
        """(P,) nominal + deviation [m | rad]."""
        return self.nominal + self.deviations

    def positions(self, q: ArrayLike) -> FloatArray:
        """Where the targets are, with all that was learnt: (N, joints) → (N, targets, 3) [m]."""
        clean = check_configurations("configurations", q, self.joint_names)
        return (self.transmission or self.calibrated).positions(clean)

    @property
    def geometry_accuracy_per_test_pose(self) -> FloatArray:
        """(K,) root mean square error expected of ``calibrated``: uncertainty, eq. (14), and discrepancy [m]."""
        return np.hypot(self.parameter_accuracy_per_test_pose, self.discrepancy_per_test_pose)

    @cached_property
    def predicted_accuracy_per_test_pose(self) -> FloatArray:
        """(K,) root mean square error expected of ``positions`` [m]."""
        if self.transmission is None or not len(self.test_poses):
            return self.geometry_accuracy_per_test_pose
        blind = np.isinf(self.parameter_accuracy_per_test_pose)
        squares = np.einsum("ktii->kt", self.transmission.error_covariance(self.test_poses)).mean(axis=1)
        return np.where(blind, np.inf, np.sqrt(squares))

    @property
    def predicted_accuracy(self) -> float:
        """The same over all test poses: their root mean square [m]; NaN without test poses."""
        per = self.predicted_accuracy_per_test_pose
        return float(np.sqrt(np.mean(per**2))) if per.size else float("nan")

    @cached_property
    def correlations(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of parameters correlated beyond ``STRONG``, strongest first."""
        std = np.sqrt(np.diag(self.covariance))
        scale = np.where(std > 0, std, np.inf)
        matrix = self.covariance / np.outer(scale, scale)
        found = np.argwhere(np.triu(np.abs(matrix) > STRONG, 1))
        pairs = sorted(found.tolist(), key=lambda ij: -abs(matrix[ij[0], ij[1]]))
        return tuple((self.parameters[i], self.parameters[j], float(matrix[i, j])) for i, j in pairs)

    @cached_property
    def verdict(self) -> Verdict:
        """PASS, WARN or FAIL with reasons; see ``verdict``."""
        return judge(self)

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
            "resolved_by_prior": self.resolved_by_prior,
            "nearly_dependent": self.nearly_dependent,
            "correlations": [{"pair": [a, b], "correlation": c} for a, b, c in self.correlations],
            "prior": self.prior,
            "measurements": self.measurements,
            "used": self.used,
            "rejected": list(self.rejected),
            "suspects": list(self.suspects),
            "copies": self.copies,
            "gate": self.gate,
            "sigma": self.sigma,
            "sigma_estimate": self.sigma_estimate,
            "noise": asdict(self.noise),
            "chi_square": {**asdict(self.chi_square), "probability": self.chi_square.probability},
            "residual_before": vars(self.residual_before),
            "residual_after": vars(self.residual_after),
            "residuals": self.residuals,
            "normalised_residuals": self.normalised_residuals,
            "structure": [asdict(s) for s in self.structure],
            "disturbances": [asdict(d) for d in self.disturbances],
            "moved_since": self.moved_since,
            "joint_corrections": None if self.transmission is None else self.transmission.to_dict(),
            "hidden_joint_errors": None if self.hidden is None else vars(self.hidden),
            "starts": self.starts,
            "agreeing_starts": self.agreeing_starts,
            "iterations": self.iterations,
            "status": self.status,
            "message": self.message,
            "verdict": asdict(self.verdict),
            "required_accuracy": self.required_accuracy,
            "seconds": self.seconds,
        }
        if len(self.test_poses):
            result["test_poses"] = self.test_poses
            result["predicted_accuracy"] = self.predicted_accuracy
            result["predicted_accuracy_per_test_pose"] = self.predicted_accuracy_per_test_pose
            result["geometry_accuracy_per_test_pose"] = self.geometry_accuracy_per_test_pose
            result["parameter_accuracy_per_test_pose"] = self.parameter_accuracy_per_test_pose
            result["discrepancy_per_test_pose"] = self.discrepancy_per_test_pose
        for name in ("validation", "cross_validation"):
            if getattr(self, name) is not None:
                result[name] = asdict(getattr(self, name))
        plain_result: dict[str, Any] = plain(result)
        return plain_result
