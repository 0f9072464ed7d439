"""What a joint really does: its reading plus a function of that reading.

Gears, couplings and encoders turn a joint by φ(q) more than it says, repeatably. φ has no constant part, which is
the joint's zero and a geometric parameter; what is left is a short Fourier series,

    φ_l(q) = Σ_n a_ln cos n x + b_ln sin n x,      x = q of turning joints, half a turn over the range if sliding.

With it the robot is where its geometry puts it at the joint values q + φ(q).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_factor, cho_solve
from scipy.special import ive

from calib_planner.arrays import FloatArray, IntArray, check_array, check_configurations
from calib_planner.errors import InputError
from calib_planner.identification.least_squares import Equations, Fit, block_covariance
from calib_planner.identification.noise_levels import DiscrepancyModel
from calib_planner.robot import Robot


@dataclass(frozen=True, eq=False)
class JointCorrections:
    """φ of every joint.

    Attributes:
        joint_names: Order of joint arrays.
        scale: (joints,) x = scale · (q − shift).
        shift: (joints,) [rad | m].
        cosines: (joints, harmonics) a, the first harmonic first [rad | m].
        sines: (joints, harmonics) b [rad | m].
    """

    joint_names: tuple[str, ...]
    scale: ArrayLike
    shift: ArrayLike
    cosines: ArrayLike
    sines: ArrayLike

    def __post_init__(self) -> None:
        put, joints = object.__setattr__, len(self.joint_names)
        put(self, "joint_names", tuple(self.joint_names))
        for name in ("scale", "shift"):
            put(self, name, check_array(name, getattr(self, name), (joints,)))
        for name in ("cosines", "sines"):
            put(self, name, check_array(name, getattr(self, name), (joints, None)))
        if np.shape(self.cosines) != np.shape(self.sines):
            raise InputError("sines", np.shape(self.sines), f"as many as cosines, {np.shape(self.cosines)}")

    def at(self, q: ArrayLike) -> FloatArray:
        """φ(q): (N, joints) readings → (N, joints) [rad | m]."""
        clean = check_configurations("configurations", q, self.joint_names)
        x = (clean - np.asarray(self.shift)) * np.asarray(self.scale)
        cosine, sine = harmonics(x, np.shape(self.cosines)[1])
        cosines, sines = np.asarray(self.cosines), np.asarray(self.sines)
        return np.einsum("njh,jh->nj", cosine, cosines) + np.einsum("njh,jh->nj", sine, sines)

    def actual(self, q: ArrayLike) -> FloatArray:
        """Where the joints are when they read ``q``: (N, joints)."""
        return check_configurations("configurations", q, self.joint_names) + self.at(q)

    def reading(self, actual: ArrayLike) -> FloatArray:
        """What the joints read when they are at ``actual``: (N, joints), the inverse of ``actual``."""
        wanted = check_configurations("configurations", actual, self.joint_names)
        q = np.array(wanted)
        for _ in range(50):  # φ is a few milliradians and flat: each round gains two digits or more
            error = wanted - q - self.at(q)
            q = q + error
            if np.abs(error).max(initial=0.0) < 1e-15:
                break
        return q


def phases(robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Scale and shift (joints,) of x: turning joints as they are, sliding ones over half a turn."""
    low, high = robot.joint_limits.T
    turns = robot.joint_is_revolute
    return np.where(turns, 1.0, np.pi / (high - low)), np.where(turns, 0.0, low)


def harmonics(x: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """cos n x and sin n x, n = 1 … count: (N, joints) → two of (N, joints, count)."""
    turned = np.exp(1j * x)[..., None] ** np.arange(1, count + 1)
    return turned.real, turned.imag


# ── Errors of the joints' transmissions, learnt together with the geometry ──────────────────────────────────
# Each φ_l (see ``robot.joint_corrections``) is a Gaussian process in that joint's own angle. With c_l = ∂p/∂q_l,
#
#     p = f(q, Π) + Σ_l c_l(q) φ_l(q_l) + e,     cov φ_l = σ_φ² k(q_l − q_l'),
#     k(Δ) ∝ exp((cos Δ − 1)/ℓ²) = e^{−κ} Σ_n I_n(κ) cos nΔ,     κ = 1/ℓ²,
#
# I_n being modified Bessel functions, less its constant part: near zero a squared exponential of length ℓ, and
# exactly a Fourier series with independent coefficients, of variance ∝ I_n(κ). So the model is linear in geometry
# and coefficients alike, with Gaussian priors, and one least squares gives both.
#
# σ_φ, and the white parts of the discrepancy beside it (``noise_levels``), maximise the restricted likelihood for
# each ℓ of a grid, by the average-information method (Gilmour, Thompson & Cullis 1995),
#
#     score_k = ½ (yᵀPV_kPy − tr PV_k),     information_kl = ½ yᵀPV_kPV_lPy,
#
# on at most ``MOST`` equations; ℓ is the one of the largest likelihood. The functions are used only if they are
# worth ``GAIN`` in log likelihood: joints without transmission errors get none.

LENGTHS = (0.03, 0.07, 0.15, 0.3, 0.6, 1.2)
"""ℓ tried [rad]."""
MOST = 450
"""Equations that the amplitudes are estimated from."""
FEWEST = 12
"""Configurations below which transmission errors are not looked for."""
GAIN = 8.0
"""Log likelihood that the functions must be worth."""
TAIL = 1e-4
"""Share of the variance that the series may leave out."""


@dataclass(frozen=True, eq=False)
class Transmission:
    """The complete model: geometry and joint corrections that belong together.

    Attributes:
        robot: Geometry of the complete model, as its nominal values.
        corrections: φ of every joint.
        length: ℓ [rad].
        amplitude: σ_φ, standard deviation of a turning joint's error [rad].
        point: White part of one coordinate that is left [m].
        turning: White part of each turning joint that is left [rad].
        gain: Log likelihood over the model without the functions.
        names: Parameters that were solved for.
        covariance: Of those and then of all coefficients of the series.
    """

    robot: Robot
    corrections: JointCorrections
    length: float
    amplitude: float
    point: float
    turning: float
    gain: float
    names: tuple[str, ...]
    covariance: FloatArray

    def positions(self, q: FloatArray) -> FloatArray:
        """(N, targets, 3) of the complete model [m]."""
        return self.robot.positions(self.corrections.actual(q))

    def error_covariance(self, q: FloatArray) -> FloatArray:
        """Covariance of ``positions``, what is uncertain and what is left: (N, targets, 3, 3) [m²]."""
        columns = self.columns(q)
        return columns @ self.covariance @ np.swapaxes(columns, 2, 3) + self.remainder(q)

    def to_dict(self) -> dict[str, Any]:
        """What rebuilds it: arrays and numbers; the parameters are values, not deviations."""
        corrections = self.corrections
        return {
            "parameters": {p.name: p.nominal for p in self.robot.parameters},
            "length": self.length,
            "amplitude": self.amplitude,
            "point": self.point,
            "turning": self.turning,
            "gain": self.gain,
            "scale": corrections.scale,
            "shift": corrections.shift,
            "cosines": corrections.cosines,
            "sines": corrections.sines,
        }

    def columns(self, q: FloatArray) -> FloatArray:
        """∂positions/∂(``names``, coefficients) in the order of ``covariance``: (N, targets, 3, …)."""
        kept = [self.robot.parameter_names.index(n) for n in self.names]
        return model_columns(self.robot, self.corrections, q, kept)

    def remainder(self, q: FloatArray) -> FloatArray:
        """Covariance of what even this model does not hold: (N, targets, 3, 3) [m²]."""
        levers = _levers(self.robot, q) * np.where(self.robot.joint_is_revolute, self.turning, 0.0)
        return levers @ np.swapaxes(levers, 2, 3) + self.point**2 * np.eye(3)

    def with_targets(self, xyz: FloatArray) -> Transmission:
        """The same with targets at ``xyz`` (targets, 3) in the tip's frame [m]."""
        robot = self.robot.with_targets(xyz)
        stay = [i for i, n in enumerate(self.names) if n in robot.parameter_names]
        rest = range(len(self.names), len(self.covariance))
        return replace(
            self,
            robot=robot,
            names=tuple(self.names[i] for i in stay),
            covariance=self.covariance[np.ix_([*stay, *rest], [*stay, *rest])],
        )


def fit_transmission(
    equations: Equations,
    deviations: FloatArray,
    kept: tuple[int, ...],
    instrument: FloatArray,
    labels: IntArray,
) -> Transmission | None:
    """Look for transmission errors.

    Args:
        equations: Of the geometric fit; says which points count.
        deviations: (P,) where that fit ended.
        kept: Parameters that were solved for.
        instrument: (N, targets, 3, 3) covariance of the measurement; tiny where it is unknown [m²].
        labels: (N,) configuration of each row.

    Returns:
        ``None`` if the data do not show any.
    """
    if len(np.unique(labels[equations.use.any(axis=1)])) < FEWEST:
        return None
    hyper = _hyperparameters(equations, deviations, kept, instrument, labels)
    if hyper is None:
        return None
    return _fit(equations, deviations, kept, instrument, labels, hyper)


def geometry_covariance(
    transmission: Transmission, equations: Equations, fit: Fit, instrument: FloatArray, labels: IntArray
) -> FloatArray:
    """Covariance of the geometric estimate beside the complete model: (P, P).

    Its weights W know nothing of the errors that configurations share. With J Jacobian, C = (Jᵀ W J + P)⁻¹, P the
    prior's, and the covariance V of the points that the complete model tells, it is C (Jᵀ W V W J + P) C.

    Args:
        transmission: Of the same points.
        equations: Of the geometric fit.
        fit: Where it ended.
        instrument: (N, targets, 3, 3) covariance of the measurement; tiny where it is unknown [m²].
        labels: (N,) configuration of each row.
    """
    data, use = equations.data, equations.use
    whitened = equations.linearise(fit.deviations)[1]
    count = 3 * int(use.sum())
    weighted, prior = np.empty_like(whitened[:count]), whitened[count:]
    for index, factor in zip(equations.whitening.index, equations.whitening.factor, strict=True):
        if factor.ndim == 2:
            weighted[index[:, 0]] = factor * whitened[index[:, 0]]
        else:
            weighted[index] = np.swapaxes(factor, 1, 2) @ whitened[index]
    waves = model_columns(transmission.robot, transmission.corrections, data.q, [])[use].reshape(count, -1)
    scale = np.asarray(transmission.corrections.scale)
    spread = np.sqrt(np.ravel(prior_variances(transmission.length, transmission.amplitude, scale)))
    shared = weighted.T @ (waves * np.tile(spread, 2))
    middle = prior.T @ prior + shared @ shared.T
    model = DiscrepancyModel.of(equations, instrument, labels)
    white = {"point": transmission.point, "turning": transmission.turning, "sliding": 0.0}
    together = np.hstack([white.get(n, 0.0) * c for n, c in zip(model.names, model.columns, strict=True)])
    for index in model.blocks:
        rows = weighted[index]
        middle += np.einsum(
            "bip,bij,bjq->pq", rows, block_covariance(index, model.instrument, together), rows, optimize=True
        )
    covariance = fit.covariance()
    return np.asarray(covariance @ middle @ covariance)


def prior_variances(length: float, amplitude: float, scale: FloatArray) -> FloatArray:
    """(joints, harmonics) prior variances of the coefficients."""
    return np.asarray(amplitude**2 * spectrum(length) / scale[:, None] ** 2)


def kernel(difference: FloatArray, length: float) -> FloatArray:
    """k(Δ) without its constant part, one at zero."""
    kappa = 1.0 / length**2
    constant = float(ive(0, kappa))
    return (np.exp(kappa * (np.cos(difference) - 1.0)) - constant) / (1.0 - constant)


def spectrum(length: float) -> FloatArray:
    """(harmonics,) variances of the coefficients, of sum one but for ``TAIL``."""
    kappa = 1.0 / length**2
    orders = np.arange(1, int(12.0 / length) + 12)
    share = 2.0 * ive(orders, kappa) / (1.0 - float(ive(0, kappa)))
    return np.asarray(share[: int(np.searchsorted(np.cumsum(share), 1.0 - TAIL)) + 1])


# ── how large, how smooth ────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class _Hyper:
    """ℓ, θ = (white parts…, σ_φ²) and what the functions are worth."""

    length: float
    variances: FloatArray
    gain: float


def _hyperparameters(
    equations: Equations,
    deviations: FloatArray,
    kept: tuple[int, ...],
    instrument: FloatArray,
    labels: IntArray,
) -> _Hyper | None:
    part = _some(equations, labels)
    data, robot = part.data, part.robot
    predicted, jacobian = robot.positions_and_jacobian(data.q, deviations)
    residuals = (data.p - predicted)[part.use].ravel()
    rows = jacobian.reshape(*data.p.shape, -1)[part.use].reshape(len(residuals), -1)[:, list(kept)]
    extra, right = equations.prior_rows(deviations)
    model = DiscrepancyModel.of(part, instrument, labels)
    fixed = _block_diagonal(instrument[part.use])
    same = np.repeat(np.repeat(labels[:, None], part.use.shape[1], axis=1)[part.use], 3)
    together = same[:, None] == same[None, :]
    white = [(c @ c.T) * together for c in model.columns]
    problem = _Reml(
        rows, residuals, extra[:, list(kept)].T @ extra[:, list(kept)], extra[:, list(kept)].T @ right
    )
    start = np.full(len(white), float(np.mean(residuals**2)))
    start /= [len(white) * max(float(np.mean(np.diag(v))), 1e-300) for v in white]
    without, base = problem.solve(fixed, white, start)
    best: _Hyper | None = None
    levers = _levers(robot, data.q)[part.use].reshape(len(residuals), -1)
    scale, shift = phases(robot)
    x = np.repeat(np.repeat(((data.q - shift) * scale)[:, None], part.use.shape[1], axis=1)[part.use], 3, axis=0)
    first = np.append(
        0.5 * without, 0.5 * float(np.mean(residuals**2)) / float(np.mean(np.sum(levers**2, axis=1)))
    )
    for length in LENGTHS:
        smooth = sum(
            np.outer(levers[:, j], levers[:, j]) * kernel(x[:, j, None] - x[None, :, j], length)
            for j in range(levers.shape[1])
        )
        variances, likelihood = problem.solve(fixed, [*white, np.asarray(smooth)], first)
        if best is None or likelihood - base > best.gain:
            best = _Hyper(length, variances, likelihood - base)
    return best if best is not None and best.gain > GAIN else None


@dataclass(frozen=True, eq=False)
class _Reml:
    """Restricted likelihood of amplitudes; ``information`` and ``right`` are the prior's."""

    rows: FloatArray
    residuals: FloatArray
    information: FloatArray
    right: FloatArray

    def solve(self, fixed: FloatArray, parts: list[FloatArray], start: FloatArray) -> tuple[FloatArray, float]:
        """θ (parts,) and the log likelihood there."""
        size = np.array([max(float(np.mean(np.diag(v))), 1e-300) for v in parts])
        floor = 1e-8 * float(np.mean(self.residuals**2)) / size
        variances, best = np.maximum(start, floor), -np.inf
        kept = variances
        for _ in range(25):
            likelihood, score, information = self._look(fixed, parts, variances)
            if likelihood > best:
                gained, best, kept = likelihood - best, likelihood, variances
                if gained < 0.02:
                    break
            scaled = information * np.outer(variances, variances)
            damped = scaled + 1e-6 * np.trace(scaled) * np.eye(len(parts))
            step = np.linalg.solve(damped, score * variances)
            variances = np.maximum(variances * np.exp(np.clip(step, -1.5, 1.5)), floor)
        return kept, best

    def _look(
        self, fixed: FloatArray, parts: list[FloatArray], variances: FloatArray
    ) -> tuple[float, FloatArray, FloatArray]:
        total = fixed + sum(v * p for v, p in zip(variances, parts, strict=True))
        total[np.diag_indices(len(total))] *= 1.0 + 1e-9
        factor = cho_factor(total, lower=True)
        inverse = cho_solve(factor, np.eye(len(total)))
        weighted = inverse @ self.rows
        normal = self.rows.T @ weighted + self.information
        inner = cho_factor(normal, lower=True)
        projection = inverse - weighted @ cho_solve(inner, weighted.T)
        solution = cho_solve(inner, weighted.T @ self.residuals + self.right)
        left = inverse @ (self.residuals - self.rows @ solution)
        square = float(self.residuals @ left) - float(self.right @ solution)
        determinants = np.log(np.diag(factor[0])).sum() + np.log(np.diag(inner[0])).sum()
        pulled = np.array([p @ left for p in parts])
        score = 0.5 * np.array([left @ v - np.sum(projection * p) for v, p in zip(pulled, parts, strict=True)])
        return -0.5 * square - determinants, score, 0.5 * pulled @ projection @ pulled.T


def _some(equations: Equations, labels: IntArray) -> Equations:
    """At most ``MOST`` equations, whole configurations, the same ones every time."""
    use = equations.use
    order = np.random.default_rng(0).permutation(labels.max() + 1)
    size = 3 * np.bincount(labels, use.sum(axis=1), minlength=len(order))[order]
    chosen = order[np.cumsum(size) <= max(MOST, size[0])]
    part = use & np.isin(labels, chosen)[:, None]
    return Equations(equations.robot, equations.data, part, equations.whitening)


# ── the complete model ───────────────────────────────────────────────────────────────────────────────


def _fit(
    equations: Equations,
    deviations: FloatArray,
    kept: tuple[int, ...],
    instrument: FloatArray,
    labels: IntArray,
    hyper: _Hyper,
) -> Transmission:
    data, robot, use = equations.data, equations.robot, equations.use
    model = DiscrepancyModel.of(equations, instrument, labels)
    whitening = model.whitening(hyper.variances[:-1])
    amplitudes = spectrum(hyper.length)
    scale, shift = phases(robot)
    weights = hyper.variances[-1] * amplitudes / scale[:, None] ** 2
    joints = len(scale)
    total, coefficients = deviations.copy(), np.zeros((2, joints, len(amplitudes)))
    columns = list(kept)
    for _ in range(2):
        corrections = JointCorrections(robot.joint_names, scale, shift, *coefficients)
        here = robot.with_deviations(dict(zip(robot.parameter_names, total, strict=True)))
        rows = model_columns(here, corrections, data.q, columns)
        residuals = (data.p - here.positions(corrections.actual(data.q)))[use].ravel()
        extra, right = equations.prior_rows(total)
        design = whitening.apply(rows[use].reshape(len(residuals), -1))
        precision = np.concatenate([np.zeros(len(columns)), *(2 * [1.0 / weights.ravel()])])
        normal = design.T @ design + np.diag(precision)
        normal[: len(columns), : len(columns)] += extra[:, columns].T @ extra[:, columns]
        pull = design.T @ whitening.apply(residuals) - precision * np.append(
            np.zeros(len(columns)), coefficients.ravel()
        )
        pull[: len(columns)] += extra[:, columns].T @ right
        unit = 1.0 / np.sqrt(np.diag(normal))
        factor = cho_factor(normal * np.outer(unit, unit), lower=True)
        step = unit * cho_solve(factor, unit * pull)
        total[columns] += step[: len(columns)]
        coefficients = coefficients + step[len(columns) :].reshape(coefficients.shape)
    covariance = np.outer(unit, unit) * cho_solve(factor, np.eye(len(unit)))
    amplitude = dict(zip(model.names, np.sqrt(hyper.variances[:-1]), strict=True))
    return Transmission(
        robot=robot.with_deviations(dict(zip(robot.parameter_names, total, strict=True))),
        corrections=JointCorrections(robot.joint_names, scale, shift, *coefficients),
        length=hyper.length,
        amplitude=float(np.sqrt(hyper.variances[-1])),
        point=float(np.hypot(amplitude["point"], amplitude.get("shared", 0.0))),
        turning=float(amplitude.get("turning", 0.0)),
        gain=hyper.gain,
        names=tuple(robot.parameter_names[i] for i in kept),
        covariance=covariance,
    )


def model_columns(robot: Robot, corrections: JointCorrections, q: FloatArray, kept: list[int]) -> FloatArray:
    """∂p/∂(parameters kept, cosines, sines): (N, targets, 3, …)."""
    actual = corrections.actual(q)
    x = (q - np.asarray(corrections.shift)) * np.asarray(corrections.scale)
    levers = np.ascontiguousarray(robot.joint_jacobian(actual))
    waves = harmonics(x, np.shape(corrections.cosines)[1])
    parts = [(levers[..., None] * w[:, None]).reshape(*levers.shape[:2], -1) for w in waves]
    columns = np.concatenate([robot.jacobian(actual)[:, :, kept], *parts], axis=2)
    return columns.reshape(len(q), len(robot.targets), 3, columns.shape[2])


def _levers(robot: Robot, q: FloatArray) -> FloatArray:
    """c_l in units of x: (N, targets, 3, joints)."""
    levers = np.ascontiguousarray(robot.joint_jacobian(q)) / phases(robot)[0]
    return levers.reshape(len(q), len(robot.targets), 3, -1)


def _block_diagonal(blocks: FloatArray) -> FloatArray:
    """(points, 3, 3) → (3·points, 3·points)."""
    count = len(blocks)
    result = np.zeros((count, 3, count, 3))
    result[np.arange(count), :, np.arange(count), :] = blocks
    return result.reshape(3 * count, 3 * count)
