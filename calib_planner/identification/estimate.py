"""The answer of the identification: parameters, how sure they are, and what the residuals say.

An ``Estimate`` is made by ``identify`` and completed by ``validate`` and ``cross_validate``. Its parts are frozen
values of their own: the *fit*, what the data can see (*observability*), the *points* used and rejected, their
*residuals*, the *noise*, the *accuracy* predicted at the test poses, *diagnostics*, the validations, and the
*verdict*, which ``verdict.judge`` reaches from all the others.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from calib_planner.arrays import FloatArray, check_configurations, frozen, plain
from calib_planner.error_model import Knowledge, to_mapping
from calib_planner.identification.checks import Disturbance, HiddenErrors, Structure
from calib_planner.identification.noise_levels import NoiseLevels
from calib_planner.identification.term_gain import TermGain
from calib_planner.identification.transmission import Transmission
from calib_planner.measurements import RejectedPoint
from calib_planner.robot import Robot

STATUS = {
    "ok": "All requested parameters were identified.",
    "rank_deficient": "These data cannot tell some parameters from others, so they stay fixed at their nominal "
    "values; see the combinations listed. Measure in other configurations or ask for fewer.",
    "not_converged": "The iteration did not converge: check units, joint order and signs, and the start.",
}
"""Every status an estimate can have, with advice."""
LEVELS = ("PASS", "WARN", "FAIL")
"""Levels of a verdict and of its reasons, the best first."""
STRONG = 0.95
"""Correlations beyond this are named."""


def _freeze(value: object, *names: str) -> None:
    for name in names:
        object.__setattr__(value, name, frozen(np.asarray(getattr(value, name), float)))


@dataclass(frozen=True, eq=False)
class ParameterFit:
    """The parameters and how sure they are.

    Attributes:
        parameters: P names, the order of all parameter arrays.
        units: ``m`` or ``rad``.
        nominal: (P,) values before [m | rad]; for base and targets the closed-form start.
        deviations: (P,) identified value − nominal [m | rad]; 0 where fixed.
        std: (P,) standard deviations [m | rad]; NaN where fixed.
        covariance: (P, P), eq. (11) [products of the units]; zero rows and columns where fixed.
        iterations: Iterations of the last fit.
        status: A key of ``STATUS``.
    """

    parameters: tuple[str, ...]
    units: tuple[str, ...]
    nominal: FloatArray
    deviations: FloatArray
    std: FloatArray
    covariance: FloatArray
    iterations: int
    status: str

    def __post_init__(self) -> None:
        _freeze(self, "nominal", "deviations", "std", "covariance")

    @property
    def values(self) -> FloatArray:
        """(P,) nominal + deviation [m | rad]."""
        return self.nominal + self.deviations

    @property
    def message(self) -> str:
        """What the status means and what to do."""
        return STATUS[self.status]

    @cached_property
    def correlations(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of parameters correlated beyond ``STRONG``, strongest first."""
        std = np.sqrt(np.diag(self.covariance))
        scale = np.where(std > 0, std, np.inf)
        matrix = self.covariance / np.outer(scale, scale)
        strong = np.argwhere(np.triu(np.abs(matrix) > STRONG, 1))
        pairs = sorted(strong.tolist(), key=lambda ij: -abs(matrix[ij[0], ij[1]]))
        return tuple((self.parameters[i], self.parameters[j], float(matrix[i, j])) for i, j in pairs)


@dataclass(frozen=True)
class Observability:
    """What the data can see of the parameters.

    Attributes:
        rank: Number of parameters identified.
        fixed: Names of the parameters that stay at their nominal values, one per unidentifiable combination.
        unidentifiable: Combinations that neither data nor prior can see, in the order of ``fixed``.
        resolved_by_prior: Combinations that the data cannot see and the prior decides.
        nearly_dependent: Combinations that the data hardly see, weakest first.
        prior: Where the prior came from; empty without one.
    """

    rank: int
    fixed: tuple[str, ...]
    unidentifiable: tuple[str, ...]
    resolved_by_prior: tuple[str, ...]
    nearly_dependent: tuple[str, ...]
    prior: str


@dataclass(frozen=True)
class Points:
    """Which measured points were used.

    Attributes:
        measured: Number of points given.
        used: Number of points used.
        rejected: Every point that was not used, in the order of the rows.
        suspects: Points that were used although their residuals lie beyond the gate.
        copies: Number of rows that repeat another one digit for digit.
    """

    measured: int
    used: int
    rejected: tuple[RejectedPoint, ...]
    suspects: tuple[RejectedPoint, ...]
    copies: int


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
        return float(chdtrc(self.freedom, self.value))


@dataclass(frozen=True, eq=False)
class Residuals:
    """Measured − predicted points.

    Attributes:
        vectors: (N, targets, 3) with the identified parameters [m], NaN where not measured.
        normalised: (N, targets) their lengths in standard deviations of what they should be.
        gate: Largest believable normalised residual.
        before: Of the points used, with nominal kinematics (base and targets fitted where they are unknown).
        after: Of the points used, with the identified parameters.
        sigma: Scatter of one coordinate about the fit [m], NaN without redundancy.
        chi_square: Whether measurement noise alone explains them.
    """

    vectors: FloatArray
    normalised: FloatArray
    gate: float
    before: ResidualStatistics
    after: ResidualStatistics
    sigma: float
    chi_square: ChiSquare

    def __post_init__(self) -> None:
        _freeze(self, "vectors", "normalised")


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Root mean square position errors expected at the test poses [m].

    Attributes:
        test_poses: (K, joints) [rad | m].
        parameters: (K,) ρ0 of eq. (14) with the covariance of the fit [m]; infinite where it depends on what the
            data cannot see.
        discrepancy: (K,) what no geometric model holds there [m].
        complete: (K,) error with joint corrections, or of the error model [m]; ``None`` without either.
        required: Largest error at a pose that the user can live with [m]; NaN: not stated.
    """

    test_poses: FloatArray
    parameters: FloatArray
    discrepancy: FloatArray
    complete: FloatArray | None = None
    required: float = float("nan")

    def __post_init__(self) -> None:
        _freeze(self, "test_poses", "parameters", "discrepancy")
        if self.complete is not None:
            _freeze(self, "complete")

    @property
    def geometry(self) -> FloatArray:
        """(K,) error of ``Estimate.calibrated`` [m]: uncertainty, eq. (14), and discrepancy."""
        return np.hypot(self.parameters, self.discrepancy)

    @property
    def predicted(self) -> FloatArray:
        """(K,) error of ``Estimate.positions`` [m]."""
        if self.complete is None:
            return self.geometry
        return np.where(np.isinf(self.parameters), np.inf, self.complete)

    @property
    def overall(self) -> float:
        """Root mean square of ``predicted`` over the test poses [m]; NaN without test poses."""
        return float(np.sqrt(np.mean(self.predicted**2))) if len(self.test_poses) else float("nan")

    @property
    def worst(self) -> float:
        """Largest of ``predicted`` [m]."""
        return float(np.max(self.predicted))


@dataclass(frozen=True, eq=False)
class Diagnostics:
    """What was checked beside the fit.

    Attributes:
        structure: Whether the residuals depend on where the robot stood; see ``checks``.
        disturbances: What seems to have moved while the points were measured; see ``checks``.
        moved_since: First row of those at the end that were all rejected, or ``None``.
        hidden: Errors of the joints that the data would not show, and what they would do; ``None`` where they
            were not looked for or errors were learnt.
        starts: Number of other starts made.
        agreeing_starts: Number of those that ended in the same minimum.
        seconds: Time spent.
    """

    structure: tuple[Structure, ...]
    disturbances: tuple[Disturbance, ...]
    moved_since: int | None
    hidden: HiddenErrors | None
    starts: int
    agreeing_starts: int
    seconds: float


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
        """Lower limit of the robot's own error [m], see ``without_noise``; all of rms where the measurement's
        part is not known.
        """
        if not np.isfinite(self.noise_rms):
            return self.rms
        return without_noise(self.rms**2, self.noise_rms**2, self.count)


def without_noise(square: float, noise: float, count: int) -> float:
    """The robot's part of measured distances [m]: the measurement's part and two standard deviations of that
    are taken off, e² = mean ‖r‖² − 3σ² (1 + 2 √(2/(3n))).

    Args:
        square: Mean square distance of the points, mean ‖r‖² [m²].
        noise: What the measurement alone adds to it, 3σ² [m²].
        count: Number of points, n.
    """
    return float(np.sqrt(max(square - noise * (1.0 + 2.0 * np.sqrt(2.0 / (3.0 * count))), 0.0)))


@dataclass(frozen=True)
class LeftOutError:
    """Distances of visits from where all other visits predict them, (M4) [m].

    Attributes:
        count: Number of points.
        mean, rms, max: Distances; NaN where no visit can be predicted from the others.
        predicted_rms: What rms should be by the error model.
        noise_rms: What the measurement of these points alone adds to rms; NaN where nobody states it.
    """

    count: int
    mean: float
    rms: float
    max: float
    predicted_rms: float
    noise_rms: float = float("nan")

    @property
    def robot_rms(self) -> float:
        """As ``Validation.robot_rms`` [m]."""
        if not np.isfinite(self.noise_rms):
            return self.rms
        return without_noise(self.rms**2, self.noise_rms**2, self.count)


@dataclass(frozen=True, eq=False)
class Learnt:
    """What an estimate with an error model has beside the parameters.

    Attributes:
        knowledge: Parameters and all other coefficients with their covariance: it predicts.
        terms: Every term of the model asked for, with size and gain.
        left_out: Left-out error beside its prediction.
        frame: Of the accuracy at the test poses, ``world`` or ``robot``.
    """

    knowledge: Knowledge
    terms: tuple[TermGain, ...]
    left_out: LeftOutError
    frame: str = "world"

    def positions(self, q: FloatArray) -> FloatArray:
        """(N, targets, 3) the mean of what would be measured at ``q`` (N, joints) [m]."""
        return self.knowledge.poses(q).points

    def to_dict(self) -> dict[str, Any]:
        """The keys of the contract."""
        left = asdict(self.left_out)
        return {
            "accuracy_frame": self.frame,
            "left_out": {key: left[key] for key in ("count", "mean", "rms", "max", "predicted_rms")},
            "error_model": {"terms": [asdict(t) for t in self.terms], "model": to_mapping(self.knowledge.model)},
        }


@dataclass(frozen=True)
class Reason:
    """One finding of a verdict.

    Attributes:
        level: ``PASS``, ``WARN`` or ``FAIL``.
        code: A stable word for programs.
        text: What was found.
        advice: What to do; may be empty.
    """

    level: str
    code: str
    text: str
    advice: str = ""


@dataclass(frozen=True)
class Verdict:
    """Whether a calibration is good.

    Attributes:
        level: The worst of the reasons' levels.
        reasons: Worst first.
    """

    level: str
    reasons: tuple[Reason, ...]

    @staticmethod
    def of(reasons: list[Reason]) -> Verdict:
        """The verdict that follows from ``reasons``; reasons of one level keep their order."""
        worst_first = sorted(reasons, key=lambda r: -LEVELS.index(r.level))
        return Verdict(worst_first[0].level if reasons else "PASS", tuple(worst_first))


UNJUDGED = Verdict("FAIL", ())
"""Nobody has judged the estimate yet."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Identified parameters with their uncertainty, and what is known of the fit.

    Attributes:
        calibrated: The robot with the identified parameters as its nominal ones.
        transmission: The complete model with the joints' own errors if the data show them; else ``None``.
        fit: Parameters, standard deviations, covariance.
        observability: What the data can see of the parameters.
        points: Which points were used, and which were rejected.
        residuals: Measured − predicted.
        noise: The parts of the scatter.
        accuracy: Errors predicted at the test poses.
        diagnostics: What was checked beside the fit.
        validation: Statistics on held-out data, if any was given.
        cross_validation: The same by leaving out parts of the data in turn, if it was requested.
        verdict: PASS, WARN or FAIL with reasons, see ``verdict``.
        error_model: What else was learnt, and the left-out error; ``None`` without an error model.
    """

    calibrated: Robot
    transmission: Transmission | None
    fit: ParameterFit
    observability: Observability
    points: Points
    residuals: Residuals
    noise: NoiseLevels
    accuracy: Accuracy
    diagnostics: Diagnostics
    validation: Validation | None = None
    cross_validation: Validation | None = None
    verdict: Verdict = UNJUDGED
    error_model: Learnt | None = None

    def positions(self, q: ArrayLike) -> FloatArray:
        """Where the targets are according to the complete model: (N, joints) → (N, targets, 3) [m]."""
        clean = check_configurations("configurations", q, self.calibrated.joint_names)
        return (self.error_model or self.transmission or self.calibrated).positions(clean)

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers, the keys of the contract; non-finite numbers become ``None``."""
        fit, sight, points, residuals = self.fit, self.observability, self.points, self.residuals
        accuracy, checks = self.accuracy, self.diagnostics
        columns = zip(fit.parameters, fit.units, fit.nominal, fit.values, fit.deviations, fit.std, strict=True)
        keys = ("name", "unit", "nominal", "value", "deviation", "std")
        result = {
            "robot": self.calibrated.name,
            "joint_names": self.calibrated.joint_names,
            "parameters": [dict(zip(keys, row, strict=True)) for row in columns],
            "covariance": fit.covariance,
            "rank": sight.rank,
            "unidentifiable": [
                {"parameter": n, "combination": c} for n, c in zip(sight.fixed, sight.unidentifiable, strict=True)
            ],
            "resolved_by_prior": sight.resolved_by_prior,
            "nearly_dependent": sight.nearly_dependent,
            "correlations": [{"pair": [a, b], "correlation": c} for a, b, c in fit.correlations],
            "prior": sight.prior,
            "measurements": points.measured,
            "used": points.used,
            "rejected": [asdict(p) for p in points.rejected],
            "suspects": [asdict(p) for p in points.suspects],
            "copies": points.copies,
            "gate": residuals.gate,
            "sigma": self.noise.sigma,
            "sigma_estimate": residuals.sigma,
            "noise": asdict(self.noise),
            "chi_square": {**asdict(residuals.chi_square), "probability": residuals.chi_square.probability},
            "residual_before": vars(residuals.before),
            "residual_after": vars(residuals.after),
            "residuals": residuals.vectors,
            "normalised_residuals": residuals.normalised,
            "structure": [asdict(s) for s in checks.structure],
            "disturbances": [asdict(d) for d in checks.disturbances],
            "moved_since": checks.moved_since,
            "joint_corrections": None if self.transmission is None else self.transmission.to_dict(),
            "hidden_joint_errors": None if checks.hidden is None else vars(checks.hidden),
            "starts": checks.starts,
            "agreeing_starts": checks.agreeing_starts,
            "iterations": fit.iterations,
            "status": fit.status,
            "message": fit.message,
            "verdict": asdict(self.verdict),
            "required_accuracy": accuracy.required,
            "seconds": checks.seconds,
        }
        if len(accuracy.test_poses):
            result["test_poses"] = accuracy.test_poses
            result["predicted_accuracy"] = accuracy.overall
            result["predicted_accuracy_per_test_pose"] = accuracy.predicted
            result["geometry_accuracy_per_test_pose"] = accuracy.geometry
            result["parameter_accuracy_per_test_pose"] = accuracy.parameters
            result["discrepancy_per_test_pose"] = accuracy.discrepancy
        for name in ("validation", "cross_validation"):
            if getattr(self, name) is not None:
                result[name] = asdict(getattr(self, name))
        if self.error_model is not None:
            result |= self.error_model.to_dict()
        plain_result: dict[str, Any] = plain(result)
        return plain_result
