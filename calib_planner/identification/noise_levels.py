"""Where the scatter comes from: the instrument, its repetitions, and what no geometric model holds.

*Measurement noise* is what repeated measurements of one configuration show; the instrument's data sheet or the
file's own standard deviations say how much of it to expect. *Model discrepancy* is what the residuals show beyond
it. It is the same each time a configuration is measured, so that repetition does not average it away:

    D(q) = s² I + s_c² 11ᵀ ⊗ I + Σ_l σ_l² c_l c_lᵀ,     c_l = ∂p/∂q_l,

a part of each point's own, one that all targets of a configuration share, and an error of each joint's
transmission (see ``design.discrepancy``). The amplitudes
θ = (s², s_c², σ_turning², σ_sliding²) maximise the restricted likelihood (REML; Patterson & Thompson 1971). With
Ũ_k = L⁻¹ U_k, whitened residuals r and Q an orthonormal basis of the whitened Jacobian, for each amplitude

    score_k = ½ (‖Ũ_kᵀ r‖² − ‖Ũ_k‖² + ‖Ũ_kᵀ Q‖²),     all norms within a configuration's block,

the last two terms being what r owes to having been fitted. θ follows by Fisher scoring, kept from going negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist
from scipy.special import chdtrc, fdtrc

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.identification.least_squares import (
    Equations,
    Whitening,
    block_whitening,
    configuration_blocks,
)
from calib_planner.planning import ModelDiscrepancy
from calib_planner.robot import Robot

FEWEST_REPEATS = 6
"""Degrees of freedom that repetitions must have to say how noisy the measurement is."""
DOUBT = 1e-3
"""A fit less probable than this under measurement noise alone has a discrepancy."""
FEWEST_SPARE = 10
"""Redundant equations below which no discrepancy is estimated."""
NEGLIGIBLE = 1e-3
"""A part of the discrepancy below this share of the variance is none."""


@dataclass(frozen=True)
class NoiseLevels:
    """The parts of the scatter; standard deviations.

    Attributes:
        measurement: Of one measured coordinate, root mean square over the points used [m].
        source: ``sigma``, ``data``, ``instrument``, ``repetitions`` or ``residuals``.
        scaled: Factor by which repetitions raised what the source says; 1 if they agree.
        repeatability: What repetitions scatter [m]; NaN without repetitions.
        repeat_freedom: Degrees of freedom of that.
        point: s, discrepancy of each point's own, per coordinate [m].
        shared: s_c, the same for all targets of a configuration, per coordinate [m]; 0 with a single target.
        turning: σ_l of turning joints [rad].
        sliding: σ_l of sliding joints [m].
        discrepancy: All of the discrepancy, per coordinate, root mean square over the points used [m].
    """

    measurement: float
    source: str
    scaled: float = 1.0
    repeatability: float = float("nan")
    repeat_freedom: int = 0
    point: float = 0.0
    shared: float = 0.0
    turning: float = 0.0
    sliding: float = 0.0
    discrepancy: float = 0.0

    @property
    def sigma(self) -> float:
        """Standard deviation of one coordinate that the covariance rests on, discrepancy included [m]."""
        return float(np.sqrt(self.measurement**2 + self.discrepancy**2))

    def discrepancy_covariance(self, robot: Robot, q: FloatArray) -> FloatArray:
        """D(q) of each target at configurations ``q``: (N, targets, 3, 3) [m²]."""
        sigma = np.where(robot.joint_is_revolute, self.turning, self.sliding)
        result = np.zeros((len(q), len(robot.targets), 3, 3))
        if sigma.any():
            columns = (robot.joint_jacobian(q) * sigma).reshape(len(q), len(robot.targets), 3, -1)
            result += columns @ np.swapaxes(columns, 2, 3)
        return result + (self.point**2 + self.shared**2) * np.eye(3)

    def for_planning(self) -> ModelDiscrepancy:
        """The same as the planner takes it."""
        return ModelDiscrepancy(
            joint_sigma=self.turning,
            slide_sigma=self.sliding,
            point_sigma=float(np.hypot(self.point, self.shared)),
        )


def repeat_scatter(residuals: FloatArray, labels: IntArray, use: NDArray[np.bool_]) -> tuple[float, int]:
    """Scatter of repetitions about their configuration's mean.

    Args:
        residuals: (N, targets, 3) of any model, divided by their standard deviations.
        labels: (N,) configuration of each row.
        use: (N, targets) points that count.

    Returns:
        Mean square and its degrees of freedom.
    """
    total, freedom = 0.0, 0
    for t in range(use.shape[1]):
        rows, owner = residuals[use[:, t], t], labels[use[:, t]]
        count = np.bincount(owner, minlength=1)
        sums = np.stack([np.bincount(owner, rows[:, a], minlength=len(count)) for a in range(3)], axis=1)
        apart = rows - (sums / np.maximum(count, 1)[:, None])[owner]
        total += float(np.sum(apart**2))
        freedom += 3 * int(np.sum(np.maximum(count - 1, 0)))
    return (total / freedom if freedom else float("nan")), freedom


@dataclass(frozen=True, eq=False)
class DiscrepancyModel:
    """The columns that spread each part of the discrepancy over the equations.

    Attributes:
        names: Parts among ``point``, ``shared``, ``turning``, ``sliding``.
        columns: Per part (equations, K) U.
        blocks: Per block size (blocks, s) numbers of the equations.
        instrument: (points, 3, 3) R of the points in use.
    """

    names: tuple[str, ...]
    columns: tuple[FloatArray, ...]
    blocks: tuple[IntArray, ...]
    instrument: FloatArray

    @staticmethod
    def of(equations: Equations, instrument: FloatArray, labels: IntArray) -> DiscrepancyModel:
        """For the points in use; ``instrument`` (N, targets, 3, 3) [m²]."""
        use, robot = equations.use, equations.robot
        n, targets = use.shape
        unit = np.broadcast_to(np.eye(3 * targets).reshape(targets, 3, -1), (n, targets, 3, 3 * targets))
        parts = {"point": unit}
        if targets > 1:
            parts["shared"] = np.broadcast_to(np.eye(3), (n, targets, 3, 3))
        levers = robot.joint_jacobian(equations.data.q).reshape(n, targets, 3, -1)
        turns = robot.joint_is_revolute
        if turns.any():
            parts["turning"] = levers[..., turns]
        if not turns.all():
            parts["sliding"] = levers[..., ~turns]
        columns = tuple(p[use].reshape(3 * int(use.sum()), -1) for p in parts.values())
        return DiscrepancyModel(tuple(parts), columns, configuration_blocks(labels, use), instrument[use])

    def whitening(self, variances: FloatArray) -> Whitening:
        """Of instrument and discrepancy, ``variances`` (parts,) being θ."""
        together = np.hstack([np.sqrt(v) * c for v, c in zip(variances, self.columns, strict=True)])
        return block_whitening(self.blocks, self.instrument, together)

    @cached_property
    def per_variance(self) -> FloatArray:
        """(parts,) mean variance of a coordinate [m²] for θ = 1."""
        return np.array([np.mean(np.sum(c**2, axis=1)) for c in self.columns])

    @cached_property
    def membership(self) -> FloatArray:
        """(parts, all columns) 1 where a column is one of a part's."""
        return np.repeat(np.eye(len(self.columns)), [c.shape[1] for c in self.columns], axis=1)

    def mean_square(self, variances: FloatArray) -> float:
        """Mean variance of a coordinate [m²]."""
        return float(variances @ self.per_variance)


def improbable(cost: float, freedom: int, repeats: int = 0) -> bool:
    """Whether whitened residuals are larger than measurement noise explains.

    Args:
        cost: Their sum of squares.
        freedom: Its degrees of freedom.
        repeats: Those of the repetitions among them that told the noise level (the test is then Fisher's, for
            lack of fit); 0: the level is known.
    """
    if not repeats:
        return freedom >= FEWEST_SPARE and float(chdtrc(freedom, cost)) < DOUBT
    rest = freedom - repeats
    return rest >= FEWEST_SPARE and float(fdtrc(rest, repeats, max((cost - repeats) / rest, 0.0))) < DOUBT


def estimate_variances(
    model: DiscrepancyModel,
    residuals: FloatArray,
    jacobian: FloatArray,
    prior: tuple[FloatArray, FloatArray],
    start: FloatArray | None = None,
    rounds: int = 60,
) -> FloatArray:
    """θ by restricted maximum likelihood.

    Args:
        model: Of the equations.
        residuals: (equations,) measured − predicted [m], not whitened.
        jacobian: (equations, P) of the parameters solved for, not whitened.
        prior: (K, P) whitened rows and (K,) right-hand sides; K may be 0.
        start: (parts,) variances to begin from, such as those of nearly the same points.

    Returns:
        (parts,) variances, zero where negligible.
    """
    count = len(model.columns)
    noise = float(np.mean(np.einsum("kii->k", model.instrument))) / 3.0
    excess = max(float(np.mean(residuals**2)) - noise, 0.01 * noise)
    variances = excess / count / model.per_variance
    if start is not None:
        variances = np.where(start > 0.0, start, NEGLIGIBLE * variances)
    for _ in range(rounds):
        score, fisher = _score(model, residuals, jacobian, prior, variances)
        # Unknowns θ_k/θ_k,old: no part can leave its scale in one step, nor become negative.
        scaled = fisher * np.outer(variances, variances)
        step = np.linalg.solve(scaled + 1e-9 * np.trace(scaled) * np.eye(count), score * variances)
        factor = np.clip(1.0 + step, 0.2, 5.0)
        variances = variances * factor
        share = variances * model.per_variance
        gone = share < 0.1 * NEGLIGIBLE * (share.sum() + noise)
        if (np.abs(factor - 1.0)[~gone] < 1e-3).all():
            break
    return np.where(share < NEGLIGIBLE * (share.sum() + noise), 0.0, variances)


def _score(
    model: DiscrepancyModel,
    residuals: FloatArray,
    jacobian: FloatArray,
    prior: tuple[FloatArray, FloatArray],
    variances: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """∂(restricted log likelihood)/∂θ and its approximate Fisher information."""
    whitening = model.whitening(variances)
    white = whitening.apply(np.hstack(model.columns))
    rows = np.vstack([whitening.apply(jacobian), prior[0]])
    basis = np.linalg.qr(rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300))[0]
    right = np.append(whitening.apply(residuals), prior[1])
    right = right - basis @ (basis.T @ right)
    n = len(residuals)
    known = np.column_stack([right[:n], basis[:n]])
    # Of every column: ‖ũᵀr‖² − ‖ũ‖² + ‖ũᵀQ‖², and of every two (ũᵀũ')², all within blocks.
    score, fisher = -np.sum(white**2, axis=0), np.zeros((white.shape[1],) * 2)
    for index in model.blocks:
        part = white[index]
        turned = np.swapaxes(part, 1, 2)
        score += np.sum((turned @ known[index]) ** 2, axis=(0, 2))
        fisher += np.sum((turned @ part) ** 2, axis=0)
    member = model.membership
    return 0.5 * member @ score, 0.5 * member @ fisher @ member.T


# ── What no geometric model holds: the systematic error left over joint space ───────────────────────────────
# After a fit, a real robot's residuals are far above the tracker's noise and depend smoothly on the
# configuration (elasticity, gearing). They are modelled as a Gaussian process over joint space, the same for
# x, y, z and independent between them:
#
#     cov(e(q), e(q')) = s² (exp(−‖f(q) − f(q')‖² / 2ℓ²) + ν² [q = q'])
#
# with f(q) = (cos q, sin q) of the revolute joints, so that full turns coincide, and q over its range for
# prismatic ones. Joints with a short lever on the targets, as the last wrist joint often has, are left out:
# their errors cannot move the targets much, and every needless dimension thins the data. Length ℓ and nugget ν
# maximise the marginal likelihood over a grid, s² in closed form
# (Rasmussen & Williams, Gaussian Processes for Machine Learning, eqs. 2.25 and 5.8).

LENGTHS = (0.7, 1.0, 1.4, 2.0, 2.8)
NUGGETS = (0.1, 0.2, 0.4, 0.7, 1.0, 2.0, 5.0)


SHORT_LEVER = 0.1
"""Joints whose lever on the targets is below this share of the longest are left out.

No optimum with a margin: on the one robot with re-seated targets that it was tried on, the held-out error with
joint offsets is 0.47 mm at 0.1, 0.51 with every joint, 0.58 at 0.2, and 0.59 without the process.
"""


def joint_features(robot: Robot, q: FloatArray) -> FloatArray:
    """f(q): (N, joints) → (N, features)."""
    rotates = robot.joint_is_revolute
    low, high = robot.joint_limits.T
    sample = np.random.default_rng(0).uniform(low, high, (64, len(low)))
    lever = np.abs(robot.joint_jacobian(sample)).max(axis=1).mean(axis=0)
    counts = lever >= SHORT_LEVER * lever.max()
    turning, sliding = q[:, rotates & counts], ((q - low) / (high - low))[:, ~rotates & counts]
    return np.hstack([np.cos(turning), np.sin(turning), sliding])


@dataclass(frozen=True)
class Discrepancy:
    """A fitted process.

    Attributes:
        robot: Whose joints the features are of.
        features: (N, features) of the configurations it was fitted to.
        coefficients: (N, 3) so that the prediction is kernel · coefficients [m].
        length: ℓ.
        amplitude: s, standard deviation of one coordinate of the systematic part [m].
        nugget: ν, the part that configurations do not share, relative to s.
    """

    robot: Robot
    features: FloatArray
    coefficients: FloatArray
    length: float
    amplitude: float
    nugget: float

    def predict(self, q: FloatArray) -> FloatArray:
        """Expected error (N, 3) at configurations ``q`` (N, joints), in the frame of the residuals [m]."""
        squares = cdist(joint_features(self.robot, q), self.features, "sqeuclidean")
        return np.exp(-squares / (2 * self.length**2)) @ self.coefficients


def fit_discrepancy(robot: Robot, q: FloatArray, residuals: FloatArray) -> Discrepancy:
    """Fit the process to residual vectors.

    Args:
        q: (N, joints) configurations.
        residuals: (N, 3) measured − predicted [m], finite.
    """
    features = joint_features(robot, q)
    squares = cdist(features, features, "sqeuclidean")
    best: tuple[float, float, float, float, FloatArray] | None = None
    for length in LENGTHS:
        kernel = np.exp(-squares / (2 * length**2))
        for nugget in NUGGETS:
            factor = cho_factor(kernel + nugget**2 * np.eye(len(q)), lower=True)
            coefficients = cho_solve(factor, residuals)
            variance = float(np.sum(residuals * coefficients)) / residuals.size
            log_determinant = 2.0 * float(np.log(np.diag(factor[0])).sum())
            score = residuals.size * np.log(max(variance, 1e-300)) + 3 * log_determinant
            if best is None or score < best[0]:
                best = (score, length, nugget, variance, coefficients)
    assert best is not None
    _, length, nugget, variance, coefficients = best
    return Discrepancy(robot, features, coefficients, length, float(np.sqrt(variance)), nugget)
