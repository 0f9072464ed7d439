"""Do the residuals know where the robot stood? Then something is missing from the model.

After a good fit residuals are independent. Three questions, each with an answer that is normal if they are:

*Neighbours.* With each configuration's nearest other in joint space, S = Σ w_ij r_i·r_j; its variance is
Σ_{i<j} (w_ij + w_ji)² tr(C²), C the second moment of r (Moran 1950, for vectors).

*One configuration.* Its targets' residuals: S = Σ r_t·r_u over pairs, of variance (pairs) tr(C²).

*One joint.* The part of r_i along c_l = ∂p/∂q_l, in order of q_l: neighbours in one joint's angle that err alike
mean an error of that joint's transmission. S = Σ y_i y_{i+1}, of variance (n − 1) (Σ y²/n)².
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.special import chdtrc, chdtri, fdtrc, fdtri, ndtr

from calib_planner.arrays import FloatArray, IntArray, check_array, frozen
from calib_planner.errors import InputError
from calib_planner.identification.least_squares import Equations, Fit
from calib_planner.identification.noise_levels import (
    DOUBT,
    FEWEST_SPARE,
    DiscrepancyModel,
    NoiseLevels,
    improbable,
    joint_features,
)
from calib_planner.identification.transmission import (
    JointCorrections,
    model_columns,
    phases,
    prior_variances,
    spectrum,
)
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot

SIGNIFICANT = 1e-4
"""A structure less probable than this by chance is one."""
FEWEST = 10
"""Configurations below which nothing can be seen."""


@dataclass(frozen=True)
class Structure:
    """One answer.

    Attributes:
        kind: ``neighbours`` in joint space, ``configuration`` or ``joint``.
        joint: Name of the joint; empty for the other kinds.
        correlation: Of neighbours, 0 if independent.
        probability: Of a correlation as large, by chance.
        amplitude: Root mean square of the joint's apparent error [rad | m]; of the residuals [m] for other kinds.
        unit: Of ``amplitude``.
    """

    kind: str
    joint: str
    correlation: float
    probability: float
    amplitude: float
    unit: str


def residual_structure(
    robot: Robot, q: FloatArray, residuals: FloatArray, use: NDArray[np.bool_], labels: IntArray
) -> tuple[Structure, ...]:
    """Ask both questions.

    Args:
        robot: Gives the joints' levers.
        q: (N, joints).
        residuals: (N, targets, 3) measured − predicted [m].
        use: (N, targets) points that count.
        labels: (N,) configuration of each row; repetitions are averaged first.
    """
    rows = np.flatnonzero(use.any(axis=1))
    _, first, owner = np.unique(labels[rows], return_index=True, return_inverse=True)
    if len(first) < FEWEST:
        return ()
    q = q[rows[first]]
    weight = use[rows].astype(float)[:, :, None]
    total = np.zeros((len(first), *residuals.shape[1:]))
    count = np.zeros((len(first), use.shape[1], 1))
    np.add.at(total, owner, np.where(use[rows][:, :, None], residuals[rows], 0.0))
    np.add.at(count, owner, weight)
    mean = total / np.maximum(count, 1.0)
    levers = robot.joint_jacobian(q).reshape(*mean.shape, -1) * (count > 0)[..., None]
    joints = (_one_joint(robot, k, q[:, k], mean, levers[..., k]) for k in range(q.shape[1]))
    points = mean.sum(axis=1) / np.maximum((count > 0).sum(axis=1), 1)
    found = (_neighbours(robot, q, points), _configuration(mean, count[..., 0] > 0), *joints)
    return tuple(s for s in found if s is not None)


def _neighbours(robot: Robot, q: FloatArray, r: FloatArray) -> Structure:
    features = joint_features(robot, q)
    nearest = cKDTree(features).query(features, k=2)[1][:, 1]
    n = len(r)
    mutual = nearest[nearest] == np.arange(n)
    moment = r.T @ r / n
    statistic = float(np.sum(r * r[nearest]))
    # A mutual pair has weight 2 and is counted once, any other has weight 1.
    pairs = 4.0 * mutual.sum() / 2 + (~mutual).sum()
    deviation = float(np.sqrt(pairs * np.sum(moment**2)))
    z = statistic / deviation if deviation > 0 else 0.0
    size = float(np.trace(moment))
    correlation = statistic / (n * size) if size > 0 else 0.0
    return Structure("neighbours", "", correlation, float(ndtr(-z)), float(np.sqrt(size)), "m")


def _configuration(r: FloatArray, seen: NDArray[np.bool_]) -> Structure | None:
    pairs = int(np.sum(seen.sum(axis=1) * (seen.sum(axis=1) - 1)) // 2)
    moment = np.einsum("nta,ntb->ab", r, r) / seen.sum()
    size = float(np.trace(moment))
    if not pairs or size == 0.0:
        return None
    total = r.sum(axis=1)
    statistic = 0.5 * float(np.sum(total**2) - np.sum(r**2))
    z = statistic / np.sqrt(pairs * float(np.sum(moment**2)))
    return Structure("configuration", "", statistic / (pairs * size), float(ndtr(-z)), float(np.sqrt(size)), "m")


def _one_joint(robot: Robot, k: int, angle: FloatArray, r: FloatArray, lever: FloatArray) -> Structure | None:
    length = np.sqrt(np.sum(lever**2, axis=(1, 2)))
    if np.ptp(angle) < 1e-6 or length.max() < 1e-6:
        return None
    order = np.argsort(angle, kind="stable")
    along = np.sum(lever * r, axis=(1, 2))
    y = (along / np.maximum(length, 1e-3 * length.max()))[order]
    square = float(np.mean(y**2))
    if square == 0.0:
        return None
    correlation = float(np.sum(y[1:] * y[:-1])) / ((len(y) - 1) * square)
    probability = float(ndtr(-correlation * np.sqrt(len(y) - 1)))
    amplitude = float(np.sqrt(square / np.mean(length**2)))
    unit = "rad" if robot.joint_is_revolute[k] else "m"
    return Structure("joint", robot.joint_names[k], correlation, probability, amplitude, unit)


# ── Do the residuals know *when* they were measured? Then something moved during the campaign ───────────────
# After a good fit residuals do not depend on the order of measuring. Three things that happen on a shop floor
# make them; each adds columns C to the equations J ΔΠ = Δp, with unknown amounts β:
#
# *drift*   the station creeps: τ_i (v + ω × (p_i − c)), τ running from 0 to 1 over the rows, 6 columns;
# *bump*    the station was pushed before row k: [i ≥ k] (v + ω × (p_i − c)), 6 columns;
# *reseat*  a target was seated elsewhere before row k: [i ≥ k] ∂p_i/∂(target's offset), 3 columns.
#
# With whitened residuals r of the fit and C⊥ = C − QQᵀC, Q an orthonormal basis of the whitened Jacobian, the fit
# of C explains S = ‖P_{C⊥} r‖² with d = rank C⊥, and without a disturbance
#
#     F = (S/d) / ((‖r‖² − S)/(ν − d)) ~ F(d, ν − d),      ν degrees of freedom of the fit.
#
# F needs no noise level, so a noise stated too small is no drift, nor is a robot that no geometry describes, if
# the residuals are whitened by what the points of one configuration share. The scan
# over k and the kinds counts as so many questions (Bonferroni). Since r ⟂ Q, S is bᵀ G⁺ b with b = Cᵀr and
# G = CᵀC − (QᵀC)ᵀ(QᵀC), sums over rows: going back from the last row, every k costs one row.
#
# What a disturbance does to the residuals may pass for a *discrepancy*, and residuals whitened by that hardly
# know of it any more. So where there is one they are asked again, whitened by measurement noise alone. If the
# answer is no chance, and noise explains what the disturbance leaves, ‖r‖² − S being a probable χ², then it
# explains them no worse than a discrepancy, and only measuring again tells which. What no geometry describes errs
# everywhere.
#
# What the parameters would move if the disturbance were part of the model, in standard deviations, says what it
# does to the calibration. A test of order is blind where order and posture are one: if the configurations were
# visited along a path, what the model lacks there looks like a drift. Shuffling the visits tells them apart.

ORDER_SIGNIFICANT = 1e-3
"""A disturbance less probable than this by chance is one."""
SUSPICIOUS = 1e-2
"""The same where it would do much harm."""
HARMLESS, HARMFUL = 1.0, 3.0
"""Standard deviations that a parameter may move without harm (thousands of rows show the smallest warm-up), and
with much of it."""
MOST_CUTS = 500
"""Rows that are asked about at most, evenly spread."""
FEWEST_SPARE_PER_CUT = 6
"""Degrees of freedom that must be left beside a disturbance."""
ABSORBED = 1e-9
"""A combination of columns of which the Jacobian leaves less than this share of the square is a parameter's."""


@dataclass(frozen=True, eq=False)
class Disturbance:
    """What may have happened, and how probable residuals as these are if it did not.

    Attributes:
        kind: ``drift``, ``bump``, ``reseat``, or ``distance`` (see ``distance_check``).
        row: First row measured afterwards, from 0, in the order of the data; ``None`` for a drift and distances.
        target: The target, from 1; ``None`` for the station.
        probability: Of as clear a sign by chance, all rows and kinds tried being counted.
        translation: (3,) of the station at the points' centre, from the first row to the last (drift) or at the
            row (bump), in the tracker's frame; of the target in the tip's frame; root mean square along the line
            of sight, 0, 0 (distance) [m].
        rotation: (3,) of the station in the same sense [rad]; zero for a target.
        shift: Largest change of a parameter, in its standard deviations, if this were part of the model.
        parameter: The parameter that changes so much.
        left: Sum of squares of the whitened residuals with this in the model.
        freedom: Its degrees of freedom.
        instead: Whether measurement noise explains what is left, so that no discrepancy is needed beside this;
            ``probability`` is then by measurement noise alone.
    """

    kind: str
    row: int | None
    target: int | None
    probability: float
    translation: FloatArray
    rotation: FloatArray
    shift: float
    parameter: str
    left: float = float("nan")
    freedom: int = 0
    instead: bool = False

    @property
    def certain(self) -> bool:
        """Whether it is no chance."""
        return self.probability < ORDER_SIGNIFICANT

    @property
    def matters(self) -> bool:
        """Whether it deserves a warning: the more it moves a parameter, the less certain it need be."""
        suspicious = self.probability < SUSPICIOUS and self.shift > HARMFUL
        return suspicious or (self.certain and self.shift > HARMLESS)


def check_order(
    equations: Equations,
    deviations: FloatArray,
    kept: Iterable[int],
    covariance: FloatArray,
    order: ArrayLike | None = None,
) -> tuple[Disturbance, ...]:
    """Ask for all three, the most probable disturbance first.

    Args:
        equations: Of the finished fit, whitened by all of their scatter (see ``wholly_whitened``); says which
            points count.
        deviations: (P,) where the fit ended.
        kept: Parameters that were solved for.
        covariance: (P, P) cov(Π̂), for ``shift``.
        order: (N,) when each row was measured, any unit; ``None``: in the order of the rows.

    Returns:
        The best of each kind, and for ``reseat`` of each target; empty where too little is redundant to tell.

    Raises:
        InputError: ``order`` has another length or a value that is not finite.
    """
    kept = tuple(kept)
    if not kept:
        return ()
    std = np.sqrt(np.maximum(np.diag(covariance)[list(kept)], 1e-300))
    fit = _Fit.of(equations, deviations, kept, std, order)
    found = [d for d in (fit.drift(), fit.bump(), *fit.reseats()) if d is not None]
    # The kinds are asked together: as many questions more.
    counted = [replace(d, probability=min(1.0, d.probability * len(found))) for d in found]
    return tuple(sorted(counted, key=lambda d: d.probability))


def instead_of_discrepancy(asked: Iterable[Disturbance], repeats: int) -> Disturbance | None:
    """The disturbance that explains best what a discrepancy stands for, if one does and matters.

    Args:
        asked: Answers of residuals whitened by measurement noise alone.
        repeats: Degrees of freedom of the repetitions that told the noise level; 0: it is known.
    """
    enough = [d for d in asked if d.certain and d.matters and not improbable(d.left, d.freedom, repeats)]
    if not enough:
        return None
    return replace(max(enough, key=lambda d: float(chdtrc(d.freedom, d.left))), instead=True)


def wholly_whitened(
    equations: Equations, instrument: FloatArray, levels: NoiseLevels, labels: IntArray
) -> Equations:
    """The same points, whitened by the instrument's noise and by the discrepancy that a configuration shares.

    A fit may weigh its points otherwise; the F test needs residuals that are independent if nothing moved.

    Args:
        equations: Of the fit.
        instrument: (N, targets, 3, 3) covariance of the measurement that ``levels.scaled`` refers to [m²].
        levels: The parts of the scatter.
        labels: (N,) configuration of each row.
    """
    if not levels.discrepancy:
        return equations
    if levels.source in ("residuals", "repetitions"):
        instrument = np.broadcast_to(levels.measurement**2 * np.eye(3), instrument.shape)
    else:
        instrument = levels.scaled**2 * instrument
    model = DiscrepancyModel.of(equations, instrument, labels)
    amplitudes = np.array([getattr(levels, name) for name in model.names])
    return replace(equations, whitening=model.whitening(amplitudes**2))


def rejected_since(seen: NDArray[np.bool_], use: NDArray[np.bool_], order: ArrayLike | None = None) -> int | None:
    """First row of those at the end of which no point was believed: something moved for good before it.

    A robust fit to the larger part rejects what was measured after a bump instead of showing it in its residuals.

    Args:
        seen: (N, targets) which points were measured.
        use: (N, targets) which were believed.
        order: (N,) when each row was measured; ``None``: in the order of the rows.

    Returns:
        ``None`` unless all rejected rows are the last ones and that is no chance (see ``ORDER_SIGNIFICANT``).
    """
    rows = np.flatnonzero(seen.any(axis=1))
    if order is not None:
        rows = rows[np.argsort(np.asarray(order)[rows], kind="stable")]
    gone = np.asarray(~use[rows].any(axis=1))
    count = int(gone.sum())
    if (
        not count
        or count == len(rows)
        or not gone[-count:].all()
        or comb(len(rows), count) * ORDER_SIGNIFICANT < 1.0
    ):
        return None
    return int(rows[-count])


@dataclass(frozen=True, eq=False)
class _Fit:
    """The finished fit, whitened.

    Attributes:
        robot: Where the fit ended.
        std: (kept,) standard deviations of the parameters.
        residuals, basis: (equations + prior rows,) and (…, kept): r and Q.
        triangle: (kept, kept), JΔ = Q triangle.
        ranks: (N,) place of each row in the order of measuring.
    """

    equations: Equations
    robot: Robot
    kept: tuple[int, ...]
    std: FloatArray
    residuals: FloatArray
    basis: FloatArray
    triangle: FloatArray
    times: FloatArray
    ranks: IntArray

    @staticmethod
    def of(
        equations: Equations,
        deviations: FloatArray,
        kept: tuple[int, ...],
        std: FloatArray,
        order: ArrayLike | None,
    ) -> _Fit:
        count = len(equations.data)
        times = np.arange(count, dtype=float) if order is None else check_array("order", order, (count,))
        residuals, jacobian = equations.linearise(deviations)
        basis, triangle = np.linalg.qr(jacobian[:, list(kept)])
        names = equations.robot.parameter_names
        here = equations.robot.with_deviations(dict(zip(names, deviations, strict=True)))
        # What a parameter can take up of the residuals is none of ours: a fit may have stopped a little early.
        residuals = residuals - basis @ (basis.T @ residuals)
        ranks = np.argsort(np.argsort(times, kind="stable"), kind="stable")
        return _Fit(equations, here, kept, std, residuals, basis, triangle, times, ranks)

    # ── the three kinds ──────────────────────────────────────────────────────────────────────────────

    def drift(self) -> Disturbance | None:
        """One question."""
        rows = self.equations.use.any(axis=1)
        span = float(np.ptp(self.times[rows])) if rows.any() else 0.0
        if span == 0.0:
            return None
        # It starts right: a station that is known was measured then, one that is not takes up any constant.
        running = (self.times - self.times[rows].min()) / span
        return self._ask("drift", self._station() * running[:, None, None, None])

    def bump(self) -> Disturbance | None:
        """A question per row."""
        return self._scan("bump", self._station())

    def reseats(self) -> Iterator[Disturbance | None]:
        """A question per row and target."""
        shape = (*self.equations.data.p.shape, 3)
        for t in range(shape[1]):
            here = self.robot.with_parameters([f"target_{t + 1}.{a}" for a in "xyz"])
            columns = here.jacobian(self.equations.data.q).reshape(shape)
            found = self._scan("reseat", columns)
            yield None if found is None else replace(found, target=t + 1)

    def _station(self) -> FloatArray:
        """(N, targets, 3, 6) columns of a station's motion: translation, then rotation about the centre."""
        points = self.robot.positions(self.equations.data.q)
        beside = points - points[self.equations.use].mean(axis=0)
        turn = np.stack([np.cross(unit, beside) for unit in np.eye(3)], axis=-1)
        move = np.broadcast_to(np.eye(3), turn.shape)
        return np.concatenate([move, turn], axis=-1)

    # ── asking ───────────────────────────────────────────────────────────────────────────────────────

    def _white(self, columns: FloatArray) -> FloatArray:
        """(N, targets, 3, d) as equations (equations + prior rows, d)."""
        flat = columns[self.equations.use].reshape(-1, columns.shape[-1])
        white = np.zeros((len(self.residuals), flat.shape[1]))
        white[: len(flat)] = self.equations.whitening.apply(flat)
        return white

    def _scan(self, kind: str, columns: FloatArray) -> Disturbance | None:
        """The row before which it happened most probably, of those whose points know of it."""
        white, use = self._white(columns), self.equations.use
        owner = np.full(len(white), -1)
        owner[: 3 * int(use.sum())] = np.repeat(np.repeat(self.ranks[:, None], use.shape[1], axis=1)[use], 3)
        involved = np.unique(owner[np.any(white != 0.0, axis=1)])[1:]
        if not len(involved):
            return None
        involved = involved[np.unique(np.linspace(0, len(involved) - 1, MOST_CUTS).astype(int))]
        by_row = np.argsort(owner, kind="stable")
        starts = np.append(np.searchsorted(owner[by_row], involved), len(owner))
        d, count = white.shape[1], len(involved)
        square, along = np.zeros((count + 1, d, d)), np.zeros((count + 1, d))
        absorbed = np.zeros((count + 1, self.basis.shape[1], d))
        for k in range(count - 1, -1, -1):
            rows = by_row[starts[k] : starts[k + 1]]
            part = white[rows]
            square[k] = square[k + 1] + part.T @ part
            along[k] = along[k + 1] + part.T @ self.residuals[rows]
            absorbed[k] = absorbed[k + 1] + self.basis[rows].T @ part
        free = square - np.swapaxes(absorbed, 1, 2) @ absorbed
        explained, rank = _explained(free[:-1], square[:-1], along[:-1])
        probability = self._probability(explained, rank)
        if not np.isfinite(probability).any():
            return None
        best = int(np.nanargmin(probability))
        # Repetitions share a block of the covariance: whitened after the cut, the step is exact.
        found = self._ask(kind, columns * (self.ranks >= involved[best])[:, None, None, None])
        if found is None:
            return None
        row = int(np.flatnonzero(self.ranks == involved[best])[0])
        return replace(found, row=row, probability=min(1.0, len(involved) * found.probability))

    def _ask(self, kind: str, columns: FloatArray) -> Disturbance | None:
        """``columns`` (N, targets, 3, d) beside the parameters."""
        white = self._white(columns)
        square, absorbed, along = white.T @ white, self.basis.T @ white, white.T @ self.residuals
        explained, rank = _explained((square - absorbed.T @ absorbed)[None], square[None], along[None])
        probability = float(self._probability(explained, rank)[0])
        left = float(self.residuals @ self.residuals) - float(explained[0])
        if not np.isfinite(probability):
            return None
        scale = np.sqrt(np.maximum(np.diag(square), 1e-300))
        free = (square - absorbed.T @ absorbed) / np.outer(scale, scale)
        amounts = np.linalg.pinv(free, rcond=ABSORBED, hermitian=True) @ (along / scale) / scale
        moved = np.abs(np.linalg.lstsq(self.triangle, absorbed @ amounts, rcond=1e-12)[0]) / self.std
        k = int(np.argmax(moved))
        return Disturbance(
            kind=kind,
            row=None,
            target=None,
            probability=probability,
            translation=frozen(amounts[:3]),
            rotation=frozen(amounts[3:] if len(amounts) > 3 else np.zeros(3)),
            shift=float(moved[k]),
            parameter=self.equations.robot.parameter_names[self.kept[k]],
            left=max(left, 0.0),
            freedom=len(self.residuals) - len(self.kept) - int(rank[0]),
        )

    def _probability(self, explained: FloatArray, rank: IntArray) -> FloatArray:
        """Of F as large by chance; NaN where nothing can be told."""
        spare = len(self.residuals) - len(self.kept) - rank
        left = np.maximum(float(self.residuals @ self.residuals) - explained, 1e-300)
        known = (rank > 0) & (spare >= FEWEST_SPARE_PER_CUT)
        rank, spare = np.where(known, rank, 1), np.where(known, spare, 1)
        return np.where(known, fdtrc(rank, spare, np.maximum(explained / rank / (left / spare), 0.0)), np.nan)


def _explained(free: FloatArray, square: FloatArray, along: FloatArray) -> tuple[FloatArray, IntArray]:
    """(n,) S = bᵀ G⁺ b and rank of G = ``free`` (n, d, d); ``square`` gives lengths, b = ``along``."""
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", square), 1e-300))
    values, vectors = np.linalg.eigh(free / (scale[:, :, None] * scale[:, None, :]))
    seen = values > ABSORBED
    projected = np.einsum("nij,ni->nj", vectors, along / scale)
    shares = np.where(seen, projected**2 / np.where(seen, values, 1.0), 0.0)
    return shares.sum(axis=1), seen.sum(axis=1)


# ── Do the tracker's distances err, and nothing else? Then its beam was broken, and caught again at a wrong o
# A laser tracker counts distance along its beam. Caught again after a break, it is off by the same amount until
# the next break; its angles stay right. The residuals show scatter that noise does not explain, just as of a
# robot that no geometry describes — but only along the line of sight p/‖p‖, p in the tracker's frame.
#
# With the distance of every point free, a point has two equations instead of three: those across. Of residuals
# whitened by measurement noise let a fit to these leave L, with ν₂ degrees of freedom, and a fit to all L + S,
# with ν more. Distances err if
#
#     F = (S/ν)/(L/ν₂) ~ F(ν, ν₂)
#
# is improbable, and they suffice if L is a probable χ². A robot's own errors do not keep to the line of sight.
# That is the one to the prediction: without distances nobody knows the size of a robot in an unknown place, and
# across its own direction a prediction of any size is nothing.
#
# A wrong distance lasts, from one break to the next. What one of that size does to the parameters if it lasted
# from any point to the last says what harm to expect.

NOTHING = 1e-9
"""A combination of unit columns shorter than this is not seen."""


def check_distances(
    equations: Equations, deviations: FloatArray, kept: tuple[int, ...], covariance: FloatArray
) -> Disturbance | None:
    """Ask.

    Args:
        equations: Of the finished fit, each point whitened on its own by measurement noise.
        deviations: (P,) where the fit ended.
        kept: Parameters that were solved for.
        covariance: (P, P) cov(Π̂), for ``shift``.

    Returns:
        The answer; ``None`` where too little is redundant to tell.
    """
    if not kept:
        return None
    residuals, jacobian = equations.linearise(deviations)
    rows = jacobian[:, list(kept)]
    points = equations.robot.positions(equations.data.q, deviations)[equations.use]
    count, spare = len(points), len(rows) - len(kept)
    sight = points / np.linalg.norm(points, axis=1)[:, None]
    white = equations.whitening.apply(sight.ravel()).reshape(count, 3)
    length = np.linalg.norm(white, axis=1)
    along = white / length[:, None]
    system = np.column_stack([rows, residuals])
    own = system[: 3 * count].reshape(count, 3, -1)
    beam = np.einsum("ki,kij->kj", along, own)
    rest = np.vstack([(_across(along) @ own).reshape(2 * count, -1), system[3 * count :]])
    (best, total, _), (_, left, rank) = _solved(system), _solved(rest)
    freedom = len(rest) - rank
    freed = spare - freedom
    if freedom < FEWEST_SPARE_PER_CUT or freed < 1:
        return None
    off = beam[:, -1] - beam[:, :-1] @ best
    size = max(float(np.mean((off**2 * (len(rows) / spare) - 1.0) / length**2)), 0.0)
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    basis, triangle = np.linalg.qr(rows / scale)
    pull = np.einsum("kip,ki->kp", basis[: 3 * count].reshape(count, 3, -1), np.sqrt(size) * white)
    lasting = np.cumsum(pull[::-1], axis=0)
    moved = np.abs(np.linalg.lstsq(triangle, lasting.T, rcond=NOTHING)[0]).max(axis=1) / scale
    moved /= np.sqrt(np.maximum(np.diag(covariance)[list(kept)], 1e-300))
    worst = int(np.argmax(moved))
    ratio = max(total - left, 0.0) / freed / max(left / freedom, 1e-300)
    return Disturbance(
        kind="distance",
        row=None,
        target=None,
        probability=float(fdtrc(freed, freedom, max(ratio, 0.0))),
        translation=frozen(np.array([np.sqrt(size), 0.0, 0.0])),
        rotation=frozen(np.zeros(3)),
        shift=float(moved[worst]),
        parameter=equations.robot.parameter_names[kept[worst]],
        left=left,
        freedom=freedom,
    )


def _solved(system: FloatArray) -> tuple[FloatArray, float, int]:
    """Least squares of rows (m, p + 1), right-hand side last: solution (p,), sum of squares left, rank."""
    rows, right = system[:, :-1], system[:, -1]
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    solution, _, rank, _ = np.linalg.lstsq(rows / scale, right, rcond=NOTHING)
    return solution / scale, float(np.sum((right - rows @ (solution / scale)) ** 2)), int(rank)


def _across(along: FloatArray) -> FloatArray:
    """(n, 2, 3) two unit vectors that are square to each other and to ``along`` (n, 3)."""
    other = np.eye(3)[np.argmin(np.abs(along), axis=1)]
    first = np.cross(along, other)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(along, first)], axis=1)


# ── What could turning joints do that these data would not show? Then the values hold only where it was measu
# A joint's transmission errs by φ_l(q_l) (see ``transmission``). Where all configurations stand round one
# posture, φ_l is hardly more than a constant there and its joint's zero takes it up: the fit is as good as ever,
# and so is a prediction nearby, but the zero is not the robot's. Spread configurations show the same error in
# their residuals.
#
# Take coefficients c of smooth errors, c ~ N(0, S), S the kernel's variances at ``LENGTH`` (shorter waves show
# earlier) and amplitude ``TYPICAL``, B = ∂p/∂c. With the weights of the fit, J Jacobian, C = (Jᵀ J + prior)⁻¹,
#
#     parameters move by D c,  D = C Jᵀ B;     a prediction at * errs by (B* − J* D) c;
#
# and with the residuals whitened by all of their scatter, P⊥ what a fit leaves of them, ν their degrees of
# freedom,
#
#     ‖r‖² = Σ (1 + λ_i) χ²₁ + χ²_rest,     λ eigenvalues of S^½ Bᵀ P⊥ B S^½.
#
# They are *hidden* if the test of ``noise_levels.improbable`` finds ‖r‖² too large in no more than every other
# case (a χ² with the same two moments, Satterthwaite 1946). Where the residuals themselves told how much they
# scatter there is no such test; but errors that leave more than all of it, Σ λ > ν, are not there.

TYPICAL = 1e-4
"""Amplitude of a good robot's transmission errors: the two measured ones have four times that or more [rad]."""
LENGTH = 1.2
"""Angle over which they are alike: a wave or two per turn, those that a small region shows least [rad]."""
SEEN = 0.5
"""Probability of being found from which errors are not hidden."""


@dataclass(frozen=True, eq=False)
class HiddenErrors:
    """Errors of the joints' transmissions that these data would hardly have shown, and what they would do.

    Attributes:
        amplitude: Their standard deviation [rad].
        length: Angle over which they are alike [rad].
        probability: Of having been found.
        shifts: (P,) root mean square of what they move each parameter by; 0 where held [m | rad].
        at_test_poses: (K,) root mean square distance that they put a prediction off by [m].
    """

    amplitude: float
    length: float
    probability: float
    shifts: FloatArray
    at_test_poses: FloatArray


def hidden_errors(
    equations: Equations, whole: Equations, fit: Fit, levels: NoiseLevels, poses: FloatArray
) -> HiddenErrors | None:
    """Ask.

    Args:
        equations: Of the finished fit; says which points count.
        whole: The same whitened by all of their scatter (see ``order_check.wholly_whitened``).
        fit: Where it ended.
        levels: The parts of the scatter.
        poses: (K, joints) test poses.

    Returns:
        ``None`` if the data would have shown them.
    """
    robot, use, kept = equations.robot, equations.use, list(fit.kept)
    here = robot.with_deviations(dict(zip(robot.parameter_names, fit.deviations, strict=True)))
    scale, shift = phases(robot)
    none = np.zeros((len(scale), len(spectrum(LENGTH))))
    straight = JointCorrections(robot.joint_names, scale, shift, none, none)
    turning = np.where(robot.joint_is_revolute[:, None], prior_variances(LENGTH, TYPICAL, scale), 0.0)
    size = np.sqrt(np.tile(np.ravel(turning), 2))
    waves = model_columns(here, straight, equations.data.q, [])[use].reshape(-1, len(size)) * size
    rows, columns = _whitened(equations, fit, waves)
    moved = np.zeros((len(robot.parameter_names), len(size)))
    moved[kept] = fit.covariance()[np.ix_(kept, kept)] @ (rows.T @ columns)
    if whole is not equations:
        rows, columns = _whitened(whole, fit, waves)
    basis = np.linalg.qr(rows)[0]
    absorbed = basis.T @ columns
    left = np.maximum(np.linalg.eigvalsh(columns.T @ columns - absorbed.T @ absorbed), 0.0)
    probability = _found(left, len(rows) - len(kept), levels)
    if probability > SEEN:
        return None
    there = np.zeros((len(poses), 3 * len(robot.targets), len(size)))
    if len(poses):
        there += model_columns(here, straight, poses, []).reshape(there.shape) * size
        there -= here.jacobian(poses) @ moved
    return HiddenErrors(
        amplitude=TYPICAL,
        length=LENGTH,
        probability=probability,
        shifts=frozen(np.sqrt(np.sum(moved**2, axis=1))),
        at_test_poses=frozen(np.sqrt(np.sum(there**2, axis=(1, 2)) / len(robot.targets))),
    )


def _whitened(equations: Equations, fit: Fit, waves: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(equations + prior rows, kept) Jacobian and (…, coefficients) of the errors, none in the prior."""
    rows = equations.linearise(fit.deviations)[1][:, list(fit.kept)]
    columns = np.zeros((len(rows), waves.shape[1]))
    columns[: len(waves)] = equations.whitening.apply(waves)
    return rows, columns


def _found(left: FloatArray, freedom: int, levels: NoiseLevels) -> float:
    """Probability that the residuals show errors that leave ``left`` (λ) in them."""
    more = float(left.sum())
    if levels.source == "residuals" or levels.discrepancy > 0:
        return float(more > freedom)
    repeats = levels.repeat_freedom if levels.source == "repetitions" else 0
    rest = freedom - repeats
    if rest < FEWEST_SPARE:
        return 0.0
    limit = rest * fdtri(rest, repeats, 1.0 - DOUBT) if repeats else chdtri(rest, DOUBT)
    mean, variance = rest + more, 2.0 * (rest + 2.0 * more + float(np.sum(left**2)))
    return float(chdtrc(2.0 * mean**2 / variance, limit * 2.0 * mean / variance))


# ── Mistakes that data show by themselves: wrong units, exchanged rows, exchanged targets ───────────────────
# Least squares would turn them into parameters without a word. What is certain enough is an error before the fit
# (units); what is only likely is the reason given for a rejected point.

WRONG_UNIT = (200.0, 5000.0)
"""Measured points spread this much wider than the model's: millimetres where metres are wanted."""


def check_units(robot: Robot, data: Measurements) -> None:
    """Refuse points in millimetres, and a robot model in millimetres.

    Raises:
        InputError: The points spread about a thousand times more, or less, than the robot can move them.
    """
    seen = data.seen
    if seen.sum() < 3:
        return
    measured = _spread(data.p[seen])
    expected = _spread(robot.positions(data.q)[seen])
    if measured == 0.0 or expected == 0.0:
        return
    ratio = measured / expected
    got = f"points {measured:.3g} apart where the robot model moves them by {expected:.3g}"
    if WRONG_UNIT[0] < ratio < WRONG_UNIT[1]:
        advice = "they look like millimetres: divide by 1000 (command line: --millimetres)"
        raise InputError("points", got, "coordinates in metres", advice)
    if WRONG_UNIT[0] < 1.0 / ratio < WRONG_UNIT[1]:
        advice = "the model's lengths look like millimetres: give them in metres"
        raise InputError("robot", got, "lengths in metres", advice)


def copied_rows(data: Measurements) -> int:
    """Rows that repeat another one digit for digit: no two measurements are so alike."""
    rows = np.hstack([data.q, np.nan_to_num(data.p, nan=np.inf).reshape(len(data), -1)])
    return len(rows) - len(np.unique(rows, axis=0))


def _spread(points: FloatArray) -> float:
    """Median distance from the median point [m]: blind to a few gross errors."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def explain(
    predicted: FloatArray, data: Measurements, rejected: NDArray[np.bool_], reach: float
) -> dict[tuple[int, int], str]:
    """What probably happened to rejected points.

    Args:
        predicted: (N, targets, 3) by the fit to the others [m].
        data: What was measured.
        rejected: (N, targets).
        reach: A point this close to another prediction belongs there [m].

    Returns:
        (row, target) → words, for the points that fit elsewhere. Rows and targets from 0.
    """
    found: dict[tuple[int, int], str] = {}
    for i in np.flatnonzero(rejected.any(axis=1)):
        targets = np.flatnonzero(rejected[i])
        if len(targets) > 1:
            apart = np.linalg.norm(predicted[i][None, targets] - data.p[i, targets][:, None], axis=2)
            nearest = apart.argmin(axis=1)
            if (apart.min(axis=1) < reach).all() and (nearest != np.arange(len(targets))).all():
                for t, k in zip(targets, nearest, strict=True):
                    found[int(i), int(t)] = f"fits target {targets[k] + 1}: targets exchanged?"
                continue
        apart = np.linalg.norm(predicted[:, targets] - data.p[i, targets], axis=2)
        # One of the points may be wrong besides.
        apart = np.median(apart, axis=1) if len(targets) > 1 else apart[:, 0]
        apart[i] = np.inf
        k = int(apart.argmin())
        if apart[k] < reach:
            for t in targets:
                found[int(i), int(t)] = f"fits the configuration of row {k}: rows exchanged?"
    return found
