# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The answer of the identification: parameters, what else was learnt, how sure, and what the residuals say.

An ``Estimate`` is made by ``identify`` and completed by ``validate``. Its parts are frozen values of their own:
the *fit*, what the data can see (*observability*), the *points* used and rejected, their *residuals*, the *noise*
of a point, the *accuracy* predicted at the test poses, the *left-out* error, the *terms* of the error model, the
*alternatives* that explain the data better, the validation, and the *verdict*, which ``verdict.judge`` reaches
from all the others.

Two models are in it. ``knowledge`` predicts: parameters, gravity, joint functions, everything. ``calibrated`` is
what a URDF can hold: the parameters of a fit of placement alone, with its own left-out error.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import cached_property
from html import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri

from calib_planner.arrays import FloatArray, check_configurations, frozen, plain
from calib_planner.error_model import Knowledge, to_mapping
from calib_planner.identification.alternatives import Alternative
from calib_planner.identification.estimation import ModelEstimate, PlacementAlone
from calib_planner.identification.term_gain import TermGain
from calib_planner.measurements import RejectedPoint
from calib_planner.robot import Robot
from calib_planner.units import Told, length

STATUS = {
    "ok": "All requested parameters were identified.",
    "rank_deficient": "These data cannot tell some parameters from others, so they stay fixed at their nominal "
    "values; see the combinations listed. Measure in other configurations or ask for fewer.",
    "not_converged": "The iteration did not converge: check units, joint order and signs, and the start.",
}
"""Every status an estimate can have, with advice."""
LEVELS = ("PASS", "WARN", "FAIL")
"""Levels of a verdict and of its reasons, the best first."""
FOREMOST = 3
"""Reasons of a verdict that people read at once."""
STRONG = 0.95
"""Correlations beyond this are named."""
CHANCE = 0.01
"""What happens by chance less often than this is taken for no chance."""


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
        suspects: Points that were used although they are impossible beside the others.
        copies: Number of rows that repeat another one digit for digit.
        moved_since: First row of those at the end that were all rejected, or ``None``.
    """

    measured: int
    used: int
    rejected: tuple[RejectedPoint, ...]
    suspects: tuple[RejectedPoint, ...]
    copies: int
    moved_since: int | None


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
        vectors: (N, targets, 3) with all that was identified [m], NaN where not measured.
        normalised: (N, targets) their lengths in standard deviations of what they should be.
        gate: Largest believable normalised residual.
        before: Of the points used, with nominal kinematics (base and targets fitted where they are unknown).
        after: Of the points used, with all that was identified.
        placement_alone: Of the points used, from where ``Estimate.calibrated`` has them.
        sigma: Scatter of one coordinate about the fit [m], NaN without redundancy.
        spare: Coordinates of the points at different configurations, less the parameters that the data
            determine: what is left to judge the fit by.
        chi_square: Whether measurement noise alone explains them.
    """

    vectors: FloatArray
    normalised: FloatArray
    gate: float
    before: ResidualStatistics
    after: ResidualStatistics
    placement_alone: ResidualStatistics
    sigma: float
    spare: float
    chi_square: ChiSquare

    def __post_init__(self) -> None:
        _freeze(self, "vectors", "normalised")


NOISE_SOURCES = {
    "sigma": "as given",
    "instrument": "by the instrument's description",
    "data": "by the standard deviations in the data",
    "residuals": "from the residuals",
}
"""Who says how large the noise of a point is, in words."""


@dataclass(frozen=True)
class PointNoise:
    """Noise of a measured point: the instrument and the floor below it.

    Attributes:
        sigma: Standard deviation of one coordinate, root mean square over the points used [m].
        source: Who says so, a key of ``NOISE_SOURCES``.
    """

    sigma: float
    source: str


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Root mean square position errors expected at the test poses, (M3) [m].

    Attributes:
        test_poses: (K, joints) [rad | m].
        predicted: (K,) error of ``Estimate.positions`` [m]; infinite where it rests on what the data cannot see.
        placement: (K,) error of ``Estimate.calibrated`` [m]: what it lacks of the mean, and the uncertainty.
        knowledge: What the prediction rests on.
        frame: ``world`` or ``robot``.
        required: Largest error at a pose that the user can live with [m]; NaN: not stated.
    """

    test_poses: FloatArray
    predicted: FloatArray
    placement: FloatArray
    knowledge: Knowledge = field(repr=False)
    frame: str = "world"
    required: float = float("nan")

    def __post_init__(self) -> None:
        _freeze(self, "test_poses", "predicted", "placement")

    @cached_property
    def parameters(self) -> FloatArray:
        """(K,) what the uncertainty of the parameters has of ``predicted`` [m]."""
        if not len(self.test_poses):
            return np.empty(0)
        told = np.trace(self.knowledge.predict(self.test_poses).parameters, axis1=2, axis2=3).mean(axis=1)
        own = np.sqrt(np.maximum(told, 0.0))  # rounding
        return frozen(np.where(np.isinf(self.predicted), np.inf, own))

    @property
    def overall(self) -> float:
        """Root mean square of ``predicted`` over the test poses [m]; NaN without test poses."""
        return float(np.sqrt(np.mean(self.predicted**2))) if len(self.test_poses) else float("nan")

    @property
    def worst(self) -> float:
        """Largest of ``predicted`` [m]; NaN without test poses."""
        return float(np.max(self.predicted)) if len(self.test_poses) else float("nan")


class _RobotsPart:
    """What of measured distances is the robot's own, from ``rms``, ``noise_rms`` [m] and ``freedom``."""

    rms: float
    noise_rms: float
    freedom: float

    @property
    def robot_rms(self) -> float:
        """The robot's own part of rms [m], see ``without_noise``; all of it where the noise is not stated."""
        return without_noise(self.rms**2, np.nan_to_num(self.noise_rms) ** 2)

    @property
    def robot_least(self) -> float:
        """What the robot's own part is at least, if chance made rms large [m]."""
        return without_noise(self.rms**2, np.nan_to_num(self.noise_rms) ** 2, self.freedom)


@dataclass(frozen=True)
class Validation(_RobotsPart):
    """Distances on data that took no part in the fit [m].

    Attributes:
        count: Number of points.
        mean, median, rms, max: After identification.
        before_mean: Mean with the nominal kinematics (only base and targets fitted).
        predicted_rms: What the error model predicts for rms.
        within_95: Share of the points inside their 95 % region.
        placement_mean, placement_rms: With placement alone, as a URDF holds it.
        noise_rms: What the measurement of these points alone adds to rms; NaN where nobody states it.
        freedom: Degrees of freedom of rms², as a χ², see ``chance_of``.
    """

    count: int
    mean: float
    median: float
    rms: float
    max: float
    before_mean: float
    predicted_rms: float
    within_95: float
    placement_mean: float
    placement_rms: float
    noise_rms: float
    freedom: float


def without_noise(square: float, noise: float, freedom: float = np.inf) -> float:
    """The robot's part of measured distances [m]: e² = mean ‖r‖² − 3σ².

    Args:
        square: Mean square distance of the points, mean ‖r‖² [m²].
        noise: What the measurement alone adds to it, 3σ² [m²].
        freedom: Degrees of freedom of the mean square, three a point where points err independently. With them
            the result is a lower limit: what chance may have added is taken off first, see ``chance_of``.
    """
    return float(np.sqrt(max(square / chance_of(freedom) ** 2 - noise, 0.0)))


def chance_of(freedom: float) -> float:
    """Factor by which a root mean square exceeds its expectation by chance once in a hundred (``CHANCE``).

    Args:
        freedom: Degrees of freedom of the mean square, as a χ²; infinite: it is what is expected. With less than
            one chance explains everything.
    """
    if not np.isfinite(freedom):
        return 1.0
    return float(np.sqrt(chdtri(freedom, CHANCE) / freedom)) if freedom >= 1.0 else float("inf")


@dataclass(frozen=True)
class LeftOutError(_RobotsPart):
    """Distances of visits from where all other visits predict them, (M4) [m].

    Attributes:
        count: Number of points.
        mean, rms, max: Distances; NaN where no visit can be predicted from the others.
        predicted_rms: What rms should be by the error model.
        noise_rms: What the measurement of these points alone adds to rms; NaN where nobody states it.
        freedom: Degrees of freedom of rms², as a χ², see ``chance_of``; 0 without points.
    """

    count: int
    mean: float
    rms: float
    max: float
    predicted_rms: float
    noise_rms: float
    freedom: float


@dataclass(frozen=True)
class Reason:
    """One finding of a verdict.

    Attributes:
        level: ``PASS``, ``WARN`` or ``FAIL``.
        code: A stable word for programs.
        text: What is the case.
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

    @property
    def foremost(self) -> tuple[Reason, ...]:
        """The reasons for a first screen; ``further`` has the rest."""
        return self.reasons[:FOREMOST]

    @property
    def further(self) -> tuple[Reason, ...]:
        """The reasons behind the ``foremost``."""
        return self.reasons[FOREMOST:]

    @staticmethod
    def of(reasons: list[Reason]) -> Verdict:
        """The verdict that follows from ``reasons``; reasons of one level keep their order."""
        worst_first = sorted(reasons, key=lambda r: -LEVELS.index(r.level))
        return Verdict(worst_first[0].level if reasons else "PASS", tuple(worst_first))


UNJUDGED = Verdict("FAIL", ())
"""Nobody has judged the estimate yet."""


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(Told):
    """Identified parameters with their uncertainty, and what is known of the fit.

    Attributes:
        calibrated: The robot with the parameters of a fit of placement alone as its nominal ones: what a URDF or
            a kinematics file can hold.
        knowledge: Parameters and all other coefficients with their covariance: it predicts.
        fit: The parameters of ``knowledge``, standard deviations, covariance.
        observability: What the data can see of the parameters.
        points: Which points were used, and which were rejected.
        residuals: Measured − predicted.
        noise: Of a point.
        accuracy: Errors predicted at the test poses.
        left_out: Error of visits that all others predict, beside its prediction.
        placement_alone: The same of ``calibrated``.
        terms: Every term of the error problem's model, with size and gain.
        alternatives: Single changes of what was assumed that explain the data better, the best first.
        seconds: Time spent.
        validation: Statistics on held-out data, if any was given.
        verdict: PASS, WARN or FAIL with reasons, see ``verdict``.
        model_fit: The fit behind it, from which an update begins; ``None`` for an estimate that was read.
        placement_fit: The same behind ``calibrated``.
    """

    calibrated: Robot
    knowledge: Knowledge
    fit: ParameterFit
    observability: Observability
    points: Points
    residuals: Residuals
    noise: PointNoise
    accuracy: Accuracy
    left_out: LeftOutError
    placement_alone: LeftOutError
    terms: tuple[TermGain, ...]
    alternatives: tuple[Alternative, ...]
    seconds: float
    validation: Validation | None = None
    verdict: Verdict = UNJUDGED
    model_fit: ModelEstimate | None = field(default=None, repr=False)
    placement_fit: PlacementAlone | None = field(default=None, repr=False)

    def _facts(self) -> list[tuple[str, object]]:
        fit, points, left = self.fit, self.points, self.left_out
        tested = self.validation
        return [
            ("verdict", self.verdict.level),
            ("robot", self.calibrated.name),
            ("parameters", f"{self.observability.rank} of {len(fit.parameters)} identified"),
            ("points", f"{points.used} of {points.measured} used"),
            ("before", f"{length(self.residuals.before.rms)} rms"),
            ("after", f"{length(self.residuals.after.rms)} rms"),
            *([("left out", f"{length(left.rms)} rms")] if left.count else []),
            *([("held out", f"{length(tested.rms)} rms")] if tested is not None else []),
            *([("at test poses", length(self.accuracy.overall))] if len(self.accuracy.test_poses) else []),
        ]

    def _repr_html_(self) -> str:
        """The same with the reasons of the verdict."""
        reasons = "".join(f"<li>{escape(r.text)} {escape(r.advice)}</li>" for r in self.verdict.foremost)
        return f"{super()._repr_html_()}<ul>{reasons}</ul>"

    @property
    def scale_spread(self) -> dict[str, float]:
        """Scale of the error model that the data decide → standard deviation of its logarithm."""
        if self.model_fit is None:
            return {}
        names, covariance = self.model_fit.origin.scales
        return dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))

    def positions(self, q: ArrayLike) -> FloatArray:
        """Where the targets are on average, by all terms: (N, joints) → (N, targets, 3) [m]."""
        clean = check_configurations("configurations", q, self.calibrated.joint_names)
        return self.knowledge.poses(clean).points

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers, the keys of the contract; non-finite numbers become ``None``."""
        fit, sight, points, residuals = self.fit, self.observability, self.points, self.residuals
        accuracy = self.accuracy
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
            "moved_since": points.moved_since,
            "gate": residuals.gate,
            "sigma": self.noise.sigma,
            "sigma_estimate": residuals.sigma,
            "noise": asdict(self.noise),
            "chi_square": {**asdict(residuals.chi_square), "probability": residuals.chi_square.probability},
            "residual_before": vars(residuals.before),
            "residual_after": vars(residuals.after),
            "residuals": residuals.vectors,
            "normalised_residuals": residuals.normalised,
            "left_out": asdict(self.left_out),
            "placement_alone": {
                "parameters": dict(zip(fit.parameters, self.placement_values, strict=True)),
                "residual_after": vars(residuals.placement_alone),
                "left_out": asdict(self.placement_alone),
            },
            "error_model": {
                "terms": [asdict(t) for t in self.terms],
                "model": to_mapping(self.knowledge.model),
            },
            "alternatives": [asdict(a) for a in self.alternatives],
            "iterations": fit.iterations,
            "status": fit.status,
            "message": fit.message,
            "verdict": asdict(self.verdict),
            "required_accuracy": accuracy.required,
            "accuracy_frame": accuracy.frame,
            "seconds": self.seconds,
        }
        if len(accuracy.test_poses):
            result["test_poses"] = accuracy.test_poses
            result["predicted_accuracy"] = accuracy.overall
            result["predicted_accuracy_per_test_pose"] = accuracy.predicted
            result["parameter_accuracy_per_test_pose"] = accuracy.parameters
            result["placement_accuracy_per_test_pose"] = accuracy.placement
        if self.validation is not None:
            result["validation"] = asdict(self.validation)
        plain_result: dict[str, Any] = plain(result)
        return plain_result

    @property
    def noise_source(self) -> str:
        """Who says how large the noise of a point is, in words: the residuals may add to what was stated."""
        words = NOISE_SOURCES[self.noise.source]
        if self.noise.source == "residuals" or self.knowledge.model.is_papers:
            return words
        return f"{words}, with what the residuals show beyond it"

    @property
    def placement_values(self) -> FloatArray:
        """(P,) values of the parameters in ``calibrated`` [m | rad]."""
        by_name = {p.name: p.nominal for p in self.calibrated.parameters}
        return np.array([by_name[name] for name in self.fit.parameters])
