"""Where a robot puts the measured points and how each parameter moves them, computed once for each place.

A fit, its covariance, its residuals and the questions asked of them are about few places in parameter space. To
compute positions and Jacobian at one costs more than anything that is done with them there, so the last ones are
remembered, and that of the nominal values, where every identification begins and comes back to.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.error_model import Prior
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot

MOST_PLACES = 2
"""Places that are remembered beside the nominal one."""


class Motion:
    """Positions and Jacobian of ``robot`` at configurations ``q`` (N, joints) [rad | m]."""

    def __init__(self, robot: Robot, q: FloatArray) -> None:
        self.robot, self.q = robot, q
        self._nominal = bytes(8 * len(robot.parameter_names))
        self._known: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def at(self, deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N, targets, 3) positions [m] and (N, targets, 3, P) Jacobian [m/m | m/rad]; read-only.

        Args:
            deviations: (P,) of the active parameters [m | rad].
        """
        key = _key(deviations)
        found = self._known.pop(key, None)
        if found is None:
            points, jacobian = self.robot.positions_and_jacobian(self.q, deviations)
            found = np.ascontiguousarray(points), np.ascontiguousarray(jacobian).reshape(*points.shape, -1)
        return self._remember(key, *found)

    def carry(self, before: FloatArray, after: FloatArray) -> None:
        """A step so small that the points move linearly and the Jacobian stays what it is; both (P,)."""
        points, jacobian = self.at(before)
        self._remember(_key(after), points + jacobian @ (after - before), jacobian)

    def _remember(self, key: bytes, *found: FloatArray) -> tuple[FloatArray, FloatArray]:
        points, jacobian = found
        for array in (points, jacobian):
            array.setflags(write=False)
        self._known[key] = points, jacobian
        others = [k for k in self._known if k != self._nominal]
        for old in others[:-MOST_PLACES]:
            del self._known[old]
        return points, jacobian


def _key(deviations: FloatArray) -> bytes:
    """Adding zero makes −0 the nominal 0."""
    return (deviations + 0.0).tobytes()


# ── The measured coordinates as equations of equal weight ───────────────────────────────────────────────────
# Target t at configuration q_i was measured at p_it = f_t(q_i, Π) + e_it, eq. (1). Linearised, eq. (3),
#
#     J ΔΠ = Δp − e,      cov(e) = Σ,
#
# is whitened: with Σ = L Lᵀ both sides are multiplied by L⁻¹, after which every equation has unit variance and
# least squares is eq. (6) with weights. Σ has two parts,
#
#     Σ = blockdiag(R_it) + Σ_k θ_k U_k U_kᵀ.
#
# R_it is the instrument's. The columns U_k spread what no geometric model holds (see ``noise_levels``) over all
# points measured at a configuration: it is the same for its repetitions, and averaging does not reduce it. So Σ
# is block-diagonal, a block per configuration. Blocks of equal size are kept in one array and treated at once.

SAME_JOINT = 2e-4
"""Configurations closer than this in every joint are repetitions of one [rad | m]."""


@dataclass(frozen=True, eq=False)
class Whitening:
    """L⁻¹ of a block-diagonal covariance.

    Attributes:
        index: Per block size s: (blocks, s) numbers of the equations.
        factor: Per block size: (blocks, s, s) L⁻¹, or (blocks, 1) where s = 1.
    """

    index: tuple[IntArray, ...]
    factor: tuple[FloatArray, ...]

    def apply(self, rows: FloatArray) -> FloatArray:
        """L⁻¹ times ``rows`` (equations,) or (equations, columns)."""
        flat = rows if rows.ndim == 2 else rows[:, None]
        if self.factor[0].ndim == 2:  # one by one, in their order
            return (self.factor[0] * flat).reshape(rows.shape)
        result = np.empty_like(flat)
        for index, factor in zip(self.index, self.factor, strict=True):
            if factor.ndim == 2:
                result[index[:, 0]] = factor * flat[index[:, 0]]
            else:
                result[index] = factor @ flat[index]
        return result.reshape(rows.shape)


@dataclass(frozen=True, eq=False)
class Equations:
    """Whitened residuals and Jacobian as functions of the deviations.

    Attributes:
        robot: At its start; its active parameters are the unknowns.
        data: Rows in the robot's joint order.
        use: (N, targets) which points take part.
        whitening: L⁻¹ of their covariance; equations are ordered row, target, axis.
        prior: What is known beforehand, or ``None``.
        known: Positions and Jacobians of the robot at the data's configurations, if some are known already.
    """

    robot: Robot
    data: Measurements
    use: NDArray[np.bool_]
    whitening: Whitening
    prior: Prior | None = None
    known: Motion | None = None

    @cached_property
    def motion(self) -> Motion:
        """Where the points are and how they move."""
        return self.known or Motion(self.robot, self.data.q)

    def residuals(self, deviations: FloatArray) -> FloatArray:
        """(equations + prior rows,) whitened measured − predicted."""
        predicted = self.robot.positions(self.data.q, deviations)
        own = self.whitening.apply((self.data.p - predicted)[self.use].ravel())
        return np.append(own, self.prior_rows(deviations)[1])

    def linearise(self, deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals as above and whitened Jacobian (equations + prior rows, P)."""
        predicted, blocks = self.motion.at(deviations)
        used = blocks if self.use.all() else blocks[self.use]
        rows = self.whitening.apply(used.reshape(-1, blocks.shape[-1]))
        residuals = self.whitening.apply((self.data.p - predicted)[self.use].ravel())
        if self.prior is None:
            return residuals, rows
        extra, right = self.prior_rows(deviations)
        return np.append(residuals, right), np.vstack([rows, extra])

    def prior_rows(self, deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(K, P) whitened rows and (K,) residuals of the prior; K = 0 without one."""
        if self.prior is None:
            return np.empty((0, len(deviations))), np.empty(0)
        nominal = np.array([p.nominal for p in self.robot.parameters])
        return self.prior.rows(self.robot.parameter_names, nominal + deviations)


def configuration_labels(q: FloatArray) -> IntArray:
    """(N,) number of the configuration of each row of ``q`` (N, joints); repetitions share it."""
    pairs = cKDTree(q).query_pairs(SAME_JOINT, p=np.inf, output_type="ndarray")
    if not len(pairs):
        return np.arange(len(q))
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(q), len(q)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


def point_whitening(covariance: FloatArray, use: NDArray[np.bool_]) -> Whitening:
    """Whitening with every point by itself: ``covariance`` (N, targets, 3, 3) [m²]."""
    blocks = covariance[use]
    index = np.arange(3 * len(blocks)).reshape(-1, 3)
    variance = np.einsum("kii->ki", blocks)
    if not np.count_nonzero(blocks - variance[:, :, None] * np.eye(3)):
        return Whitening((index.reshape(-1, 1),), (1.0 / np.sqrt(variance.reshape(-1, 1)),))
    return Whitening((index,), (np.linalg.inv(np.linalg.cholesky(blocks)),))


def configuration_blocks(labels: IntArray, use: NDArray[np.bool_]) -> tuple[IntArray, ...]:
    """Per block size: (blocks, s) numbers of the equations that share a configuration."""
    owner = np.repeat(labels[:, None], use.shape[1], axis=1)[use]
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner)
    starts = np.cumsum(counts) - counts
    result = []
    for size in np.unique(counts[counts > 0]):
        first = starts[counts == size]
        points = order[first[:, None] + np.arange(size)]
        result.append((3 * points[:, :, None] + np.arange(3)).reshape(len(first), -1))
    return tuple(result)


def block_covariance(index: IntArray, instrument: FloatArray, columns: FloatArray) -> FloatArray:
    """Σ of the blocks of one size: (blocks, s, s) [m²].

    Args:
        index: (blocks, s) numbers of the equations.
        instrument: (points, 3, 3) R of the points in use.
        columns: (equations, K) U with √θ folded in.
    """
    part = columns[index]
    result = part @ np.swapaxes(part, 1, 2)
    points = index[:, ::3] // 3
    for k in range(points.shape[1]):
        result[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += instrument[points[:, k]]
    return result


def block_whitening(blocks: tuple[IntArray, ...], instrument: FloatArray, columns: FloatArray) -> Whitening:
    """Whitening of the whole; arguments as for ``block_covariance``, per block size."""
    factors = tuple(
        np.linalg.inv(np.linalg.cholesky(block_covariance(index, instrument, columns))) for index in blocks
    )
    return Whitening(blocks, factors)


# ── Gauss–Newton with Levenberg–Marquardt damping: the paper's iteration, eqs. (6) and (7) ──────────────────
# Linearise at the current parameters, eq. (3); solve min ‖J ΔΠ − Δp‖² for the whitened Jacobian of an irreducible
# set of parameters, its columns scaled to unit length; add ΔΠ; repeat. A step that does not lower the sum of
# squares is damped: the plain iteration is what happens when nothing goes wrong. Only the triangle of
# [J Δp] = Q R is formed, which holds the step, the new sum of squares and the covariance, eq. (11), and keeps the
# digits that normal equations would lose.

STEP_TOLERANCE = 1e-9
"""A step that moves the predictions by less than this share of the residuals ends the iteration."""
STEP_FLOOR = 1e-9
"""The same without residuals, in standard deviations."""
ROUNDING = 1e-9
"""A sum of squares that is larger by this share at most is not larger: near the minimum rounding decides."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Where the iteration ended.

    Attributes:
        deviations: (P,) of all active parameters [m | rad]; 0 where held.
        kept: Indices of the parameters solved for, the order of ``triangle``.
        triangle: (kept, kept) R of the scaled whitened Jacobian, prior rows included.
        scale: (kept,) column lengths that were divided out.
        residuals: (equations + prior rows,) whitened.
        iterations: Linear problems solved.
        converged: Whether the last step was negligible, or the next one not worth making.
    """

    deviations: FloatArray
    kept: tuple[int, ...]
    triangle: FloatArray
    scale: FloatArray
    residuals: FloatArray
    iterations: int
    converged: bool

    @property
    def cost(self) -> float:
        """Sum of squares of the whitened residuals, prior rows included."""
        return float(self.residuals @ self.residuals)

    def covariance(self) -> FloatArray:
        """(P, P) eq. (11) for equations of unit variance; zero rows and columns where held."""
        result = np.zeros((len(self.deviations),) * 2)
        if self.kept:
            half = solve_triangular(self.triangle, np.eye(len(self.kept))) / self.scale[:, None]
            result[np.ix_(self.kept, self.kept)] = half @ half.T
        return result


def gauss_newton(
    equations: Equations,
    start: FloatArray,
    kept: tuple[int, ...],
    most: int,
    enough: float = 0.0,
    gain: float = 0.0,
) -> Fit:
    """Minimise the sum of squares over the parameters ``kept``.

    Args:
        equations: What is to be fitted.
        start: (P,) deviations to begin from; those not kept stay as they are.
        kept: Indices of an irreducible set of parameters.
        most: Most iterations.
        enough: Sum of squares below which it need not go on.
        gain: Share of the sum of squares that a step must promise to take off to be worth making.
    """
    columns = list(kept)
    deviations = start
    residuals, jacobian = equations.linearise(deviations)
    triangle, scale, right = _triangle(jacobian[:, columns], residuals)
    damping, done, converged = 0.0, 0, not columns
    while done < most and not converged:
        if not damping and right @ right < gain * (residuals @ residuals):
            converged = True
            break
        done += 1
        step = _step(triangle, right, damping)
        trial = deviations.copy()
        trial[columns] += step / scale
        size = float(np.linalg.norm(triangle @ step))
        converged = bool(size <= STEP_FLOOR + STEP_TOLERANCE * np.linalg.norm(residuals))
        if converged and not damping:
            # Nothing changes by so small a step but the parameters that hardly anything depends on.
            equations.motion.carry(deviations, trial)
            deviations, residuals = trial, residuals - jacobian[:, columns] @ (step / scale)
            break
        cost, new_cost = float(residuals @ residuals), np.inf
        if np.isfinite(trial).all():
            # With its Jacobian at once: hardly any step is refused.
            new, new_jacobian = equations.linearise(trial)
            new_cost = float(new @ new)
        if new_cost <= (1.0 + ROUNDING) * cost:
            deviations, residuals, jacobian = trial, new, new_jacobian
            triangle, scale, right = _triangle(jacobian[:, columns], residuals)
            damping = 0.0 if damping < 1e-6 else damping / 10
        else:
            damping = max(10 * damping, 1e-6)
        converged = converged or new_cost <= enough
    return Fit(deviations, tuple(kept), triangle, scale, residuals, done, converged)


def _triangle(jacobian: FloatArray, residuals: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """R (p, p), column lengths (p,) and Qᵀ Δp (p,)."""
    p = jacobian.shape[1]
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    augmented = np.asarray(np.linalg.qr(np.column_stack([jacobian / scale, residuals]), mode="r"))
    return np.ascontiguousarray(augmented[:p, :p]), scale, augmented[:p, p].copy()


def _step(triangle: FloatArray, right: FloatArray, damping: float) -> FloatArray:
    """The scaled step; where the triangle has lost rank on the way, the shortest one."""
    p = len(right)
    if damping:
        padded = np.vstack([triangle, np.sqrt(damping) * np.eye(p)])
        return np.asarray(np.linalg.lstsq(padded, np.append(right, np.zeros(p)), rcond=None)[0])
    diagonal = np.abs(np.diag(triangle))
    if diagonal.min() > 1e-13 * diagonal.max():
        return np.asarray(solve_triangular(triangle, right))
    return np.asarray(np.linalg.lstsq(triangle, right, rcond=1e-13)[0])
