"""Is this calibration good? PASS, WARN or FAIL, with reasons that a person can act on.

Every reason has a level of its own; the verdict is the worst. A reason at PASS is worth knowing and needs nothing
to be done. The judge sees nothing but the estimate: what it says is said by the numbers there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc

from calib_planner.arrays import FloatArray, check_configurations, frozen, plain
from calib_planner.identification.checks import HARMFUL, SIGNIFICANT, Disturbance, HiddenErrors, Structure
from calib_planner.identification.noise_levels import FEWEST_SPARE, NoiseLevels
from calib_planner.identification.transmission import Transmission
from calib_planner.robot import Robot
from calib_planner.units import counted, length, listed, milliradians

LEVELS = ("PASS", "WARN", "FAIL")

LARGEST_RESIDUAL = 5e-3
"""No industrial robot is left with more than this after a calibration that was set up rightly [m]."""
REJECTED = (0.05, 0.20)
"""Shares of rejected points that deserve a warning, and distrust."""
MANY, INSIDE = 30, 0.8
"""Of as many held-out points at least this share must lie in their 95 % region."""
APART = (1.5, 3.0)
"""Achieved over predicted error that deserves a warning, and distrust."""
FAR = 4.0
"""Standard deviations from which nobody expects the truth; what moves a parameter as far is said."""


@dataclass(frozen=True)
class Reason:
    """One finding.

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
    """The answer.

    Attributes:
        level: The worst of the reasons' levels.
        reasons: Worst first.
    """

    level: str
    reasons: tuple[Reason, ...]


def judge(estimate: Estimate) -> Verdict:
    """Look at an estimate from every side."""
    checks = (
        _solution,
        _data,
        _rejections,
        _scatter,
        _order,
        _structure,
        _local,
        _parameters,
        _accuracy,
        _held_out,
    )
    reasons = [reason for check in checks for reason in check(estimate)]
    reasons.sort(key=lambda r: -LEVELS.index(r.level))
    return Verdict(reasons[0].level if reasons else "PASS", tuple(reasons))


def _solution(e: Estimate) -> Iterator[Reason]:
    if e.status == "not_converged":
        yield Reason("FAIL", "not_converged", "the iteration did not settle", e.message)
    if e.agreeing_starts < e.starts:
        text = f"{e.starts - e.agreeing_starts} of {e.starts} other starts ended elsewhere"
        yield Reason(
            "WARN", "other_minimum", text, "the best was taken: measure more configurations, or add a prior"
        )
    after = e.residual_after
    if after.rms > LARGEST_RESIDUAL:
        text = f"{length(after.rms)} are left after the fit: more than any robot's geometry explains"
        yield Reason("FAIL", "large_residuals", text, "check joint order, signs, units, and which point is whose")
    elif after.mean > 0.9 * e.residual_before.mean:
        text = f"the fit improved the points from {length(e.residual_before.mean)} to {length(after.mean)} only"
        yield Reason("WARN", "no_gain", text, "these parameters are not what ails the robot: free others")


def _data(e: Estimate) -> Iterator[Reason]:
    spare = 3 * e.used - e.rank
    if e.copies:
        text = f"{counted(e.copies, 'row')} repeated digit for digit"
        yield Reason("WARN", "copies", text, "a measurement given twice counts twice: leave the copies out")
    if spare < FEWEST_SPARE:
        text = f"{3 * e.used} coordinates for {counted(e.rank, 'parameter')}"
        advice = "too few to check noise and gross errors: measure more configurations or free fewer parameters"
        yield Reason("WARN", "too_few_measurements", text, advice)
    if not np.isfinite(e.sigma):
        text = "nothing is known of the noise: no standard deviations"
        yield Reason("FAIL", "no_uncertainty", text, "give sigma or an instrument, or measure more")


def _rejections(e: Estimate) -> Iterator[Reason]:
    share = len(e.rejected) / max(e.measurements, 1)
    if e.rejected:
        level = "FAIL" if share > REJECTED[1] else "WARN" if share > REJECTED[0] else "PASS"
        text = f"{len(e.rejected)} of {counted(e.measurements, 'point')} rejected"
        yield Reason(
            level, "rejected", text, "each is listed with its reason; measure those configurations again"
        )
    if e.suspects:
        rows = listed([s["row"] for s in e.suspects], 5)
        number = counted(len(e.suspects), "point")
        text = f"{number} beyond {e.gate:.3g} standard deviations (rows {rows}), used nevertheless"
        yield Reason("WARN", "suspects", text, "look at them, or use the robust loss (--loss robust)")


def _scatter(e: Estimate) -> Iterator[Reason]:
    noise = e.noise
    if noise.scaled > 1.0:
        text = f"repetitions scatter {noise.scaled:.2g} times as much as the {noise.source} says"
        yield Reason("WARN", "repeatability", text, "check the robot's standstill, the nest and the tracker")
    if noise.discrepancy > 0:
        text = (
            f"{length(noise.discrepancy)} per coordinate is left that measurement noise "
            f"({length(noise.measurement)}) does not explain: no geometric model holds it, and measuring more "
            "often does not reduce it"
        )
        yield Reason("PASS", "model_discrepancy", text, "it is part of every accuracy predicted here")
        return
    probability, stated = e.chi_square.probability, length(noise.measurement)
    if probability < 1e-3:
        text = f"measurement noise of {stated} explains such residuals in {probability:.1g} only"
        yield Reason("WARN", "poor_fit", text, "free more parameters, look for gross errors, check sigma")
    elif probability > 1.0 - 1e-6:
        text = f"the residuals scatter {length(e.sigma_estimate)}, far less than the {stated} stated"
        yield Reason("WARN", "noise_overstated", text, "the standard deviations are too large: check sigma")


def _order(e: Estimate) -> Iterator[Reason]:
    words = {
        "drift": "the tracker drifted",
        "bump": "the tracker was moved",
        "reseat": "was seated elsewhere",
        "distance": "the tracker's distances err",
    }
    for found in e.disturbances:
        sure = found.certain and not found.instead
        level = "FAIL" if sure and found.shift > HARMFUL else "WARN"
        who = f"target {found.target} " if found.target else ""
        when = "" if found.row is None else f" before row {found.row}"
        far = float(np.linalg.norm(found.translation))
        sign = f"by chance {found.probability:.1g}" if not found.instead else "noise explains the rest"
        text = (
            f"{who}{words[found.kind]}{when}, it seems, by {length(far)} ({sign}); "
            f"{found.parameter} may be off by {found.shift:.2g} standard deviations"
        )
        yield Reason(
            level, found.kind, text, "measure again, or identify the parts before and after on their own"
        )
    if e.moved_since is not None:
        text = f"every point from row {e.moved_since} on was rejected: something moved for good"
        yield Reason("WARN", "moved", text, "the fit is to the rows before; measure those after again")


def _structure(e: Estimate) -> Iterator[Reason]:
    if e.transmission is not None:
        size = f"{milliradians(e.transmission.amplitude)}, alike over {e.transmission.length:g} rad"
        text = f"the joints' transmissions err ({size}): corrections were learnt and are part of every prediction"
        advice = "a URDF cannot hold them: apply them to the joint targets (calib-planner compensate)"
        yield Reason("PASS", "joint_corrections", text, advice)
    for found in (s for s in e.structure if s.probability < SIGNIFICANT):
        level = "PASS" if e.noise.discrepancy > 0 or e.transmission is not None else "WARN"
        if found.joint:
            size = f"{1e3 * found.amplitude:.2g} {'mrad' if found.unit == 'rad' else 'mm'}"
            text = (
                f"errors of {found.joint} depend on where it stands, {size} (correlation {found.correlation:.2f})"
            )
            advice = "gear, encoder or compliance: no geometric parameter removes it"
        elif found.kind == "configuration":
            text = f"the targets of one configuration err alike (correlation {found.correlation:.2f})"
            advice = "what is left is the robot's, not the tracker's: measuring a point again does not reduce it"
        else:
            text = f"neighbouring configurations err alike (correlation {found.correlation:.2f})"
            advice = (
                "parameters are missing, or the robot bends: free more parameters; keep to the measured region"
            )
        yield Reason(level, "residual_structure", text, advice)


def _local(e: Estimate) -> Iterator[Reason]:
    if e.hidden is None:
        return
    shifts = e.hidden.shifts / np.where(np.isfinite(e.std) & (e.std > 0), e.std, np.inf)
    worst = int(np.argmax(shifts))
    if not shifts[worst] > FAR:
        return
    size = milliradians(e.hidden.amplitude)
    text = (
        f"joints that err by {size} would hardly show in these data, but move {e.parameters[worst]} by "
        f"{shifts[worst]:.2g} standard deviations: the values hold round the measured postures only"
    )
    there = _unpromised(e)
    if there.any():
        off = length(float(e.hidden.at_test_poses[there].max()))
        text = f"{text}; predictions at {there.sum()} of {len(there)} test poses may be off by {off} more"
        yield Reason("WARN", "local", text, "measure round the test poses too, or wherever the robot works")
    else:
        safe = "predictions at the test poses are safe: use the robot near them"
        advice = safe if len(there) else "give the test poses that matter, or measure wherever the robot works"
        level = "PASS" if len(there) else "WARN"
        yield Reason(level, "local", text, advice)


def _unpromised(e: Estimate) -> NDArray[np.bool_]:
    """(K,) test poses of which hidden errors break what is said of them, by more than a measurement's noise."""
    assert e.hidden is not None
    predicted = e.predicted_accuracy_per_test_pose
    total = np.hypot(predicted, e.hidden.at_test_poses)
    if np.isfinite(e.required_accuracy):
        return np.asarray((predicted <= e.required_accuracy) & (total > e.required_accuracy))
    visible = e.hidden.at_test_poses > np.sqrt(3.0) * e.noise.measurement
    return np.asarray(visible & (total > APART[0] * predicted))


def _parameters(e: Estimate) -> Iterator[Reason]:
    if e.held:
        text = f"{counted(len(e.held), 'parameter')} held, not to be told from others: {listed(e.held, 4)}"
        yield Reason("PASS", "unidentifiable", text, "no measured point depends on the choice")
    if e.nearly_dependent:
        number = counted(len(e.nearly_dependent), "combination")
        text = f"{number} hardly seen by these data: {e.nearly_dependent[0]}"
        yield Reason(
            "PASS", "nearly_dependent", text, "do not read their values one by one; predictions are safe"
        )
    if e.correlations:
        a, b, c = e.correlations[0]
        text = f"strongly correlated: {counted(len(e.correlations), 'pair')}, most of all {a} and {b} ({c:+.3f})"
        yield Reason("PASS", "correlated", text, "do not read their values one by one; predictions are safe")


def _accuracy(e: Estimate) -> Iterator[Reason]:
    per = e.predicted_accuracy_per_test_pose
    if np.isinf(per).any():
        count = int(np.isinf(per).sum())
        text = f"the error at {count} of {len(per)} test poses rests on what the data cannot see"
        yield Reason("FAIL", "blind_test_pose", text, "measure configurations that move those parameters")
    required = e.required_accuracy
    if not np.isfinite(required):
        return
    worst = float(per.max()) if len(per) else 0.0
    if len(per) and not np.isnan(worst):
        level = "PASS" if worst <= required else "FAIL"
        text = f"predicted at the test poses: {length(worst)} where {length(required)} are required"
        advice = "" if level == "PASS" else _advice(e)
        yield Reason(level, "required_accuracy", text, advice)
    elif not len(per) and e.validation is None and e.cross_validation is None:
        text = f"{length(required)} are required, but nothing says where"
        yield Reason("WARN", "required_accuracy", text, "give test poses, or data to validate with")


def _advice(e: Estimate) -> str:
    if e.discrepancy_per_test_pose.max() > e.required_accuracy:
        return (
            "what no geometric model holds is more than that: calibrate closer to the task, or compensate locally"
        )
    return "measure more configurations: calib-planner plan --measured … --accuracy …"


def _held_out(e: Estimate) -> Iterator[Reason]:
    if e.validation is None and e.cross_validation is None:
        yield Reason(
            "PASS", "not_validated", "nothing was held out", "--validate FILE, or --folds 5 on these data"
        )
    if e.validation is not None:
        yield from _validation(e.validation, "held-out points", e.required_accuracy)
    if e.cross_validation is not None:
        yield from _validation(e.cross_validation, "points left out in turn", e.required_accuracy)


def _validation(v: Validation, what: str, required: float) -> Iterator[Reason]:
    if v.mean >= v.before_mean:
        text = f"{what} are no better than before: {length(v.mean)}, before {length(v.before_mean)}"
        yield Reason("FAIL", "no_gain_held_out", text, "do not apply it: free fewer parameters or measure more")
    ratio = v.rms / v.predicted_rms
    if np.isfinite(ratio):
        level = "FAIL" if ratio > APART[1] else "WARN" if ratio > APART[0] else "PASS"
        text = f"{what}: {length(v.rms)} achieved where {length(v.predicted_rms)} were predicted"
        advice = "" if level == "PASS" else "they lie elsewhere than what was measured, or the robot changed"
        yield Reason(level, "predicted_and_achieved", text, advice)
    if v.count >= MANY and v.within_95 < INSIDE:
        text = f"{what}: only {100 * v.within_95:.0f} % lie in the regions where 95 % were expected"
        advice = (
            "something changed between the two sets: temperature, the tracker's place, the target's seat, load"
        )
        yield Reason("WARN", "region", text, advice)
    if np.isfinite(required):
        # What is required is the robot's; what was achieved holds the measurement's noise as well.
        level = "PASS" if v.robot_rms <= required else "FAIL"
        advice = "" if level == "PASS" else "free more parameters, measure more, or calibrate closer to the task"
        known = v.noise_rms > 0
        noise = f"of it {length(v.noise_rms)} the measurement's" if known else "the measurement's part included"
        text = f"{what}: {length(v.rms)} achieved, {noise}, where {length(required)} are required"
        yield Reason(level, "required_accuracy", text, advice)


# ── The answer of the identification: parameters, how sure they are, and what the residuals say ─────────────

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
        return float(chdtrc(self.freedom, self.value))


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
