"""Do the residuals know *when* they were measured? Then something moved during the campaign.

After a good fit residuals do not depend on the order of measuring. Three things that happen on a shop floor make
them; each adds columns C to the equations J ΔΠ = Δp, with unknown amounts β:

*drift*   the station creeps: τ_i (v + ω × (p_i − c)), τ running from 0 to 1 over the rows, 6 columns;
*bump*    the station was pushed before row k: [i ≥ k] (v + ω × (p_i − c)), 6 columns;
*reseat*  a target was seated elsewhere before row k: [i ≥ k] ∂p_i/∂(target's offset), 3 columns.

With whitened residuals r of the fit and C⊥ = C − QQᵀC, Q an orthonormal basis of the whitened Jacobian, the fit
of C explains S = ‖P_{C⊥} r‖² with d = rank C⊥, and without a disturbance

    F = (S/d) / ((‖r‖² − S)/(ν − d)) ~ F(d, ν − d),      ν degrees of freedom of the fit.

F needs no noise level, so a noise stated too small is no drift, nor is a robot that no geometry describes, if the
residuals are whitened by what the points of one configuration share. The scan
over k and the kinds counts as so many questions (Bonferroni). Since r ⟂ Q, S is bᵀ G⁺ b with b = Cᵀr and
G = CᵀC − (QᵀC)ᵀ(QᵀC), sums over rows: going back from the last row, every k costs one row.

What a disturbance does to the residuals may pass for a *discrepancy*, and residuals whitened by that hardly know
of it any more. So where there is one they are asked again, whitened by measurement noise alone. If the answer is
no chance, and noise explains what the disturbance leaves, ‖r‖² − S being a probable χ², then it explains them no
worse than a discrepancy, and only measuring again tells which. What no geometry describes errs everywhere.

What the parameters would move if the disturbance were part of the model, in standard deviations, says what it
does to the calibration. A test of order is blind where order and posture are one: if the configurations were
visited along a path, what the model lacks there looks like a drift. Shuffling the visits tells them apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc
from scipy.stats import f as fisher_f

from calib_planner._arrays import FloatArray, IntArray, check_array, frozen
from calib_planner.identification.equations import Equations
from calib_planner.identification.noise_levels import DiscrepancyModel, NoiseLevels, improbable
from calib_planner.robot.chain import Robot

SIGNIFICANT = 1e-3
"""A disturbance less probable than this by chance is one."""
SUSPICIOUS = 1e-2
"""The same where it would do much harm."""
HARMLESS, HARMFUL = 1.0, 3.0
"""Standard deviations that a parameter may move without harm (thousands of rows show the smallest warm-up), and
with much of it."""
MOST_CUTS = 500
"""Rows that are asked about at most, evenly spread."""
FEWEST_SPARE = 6
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
        return self.probability < SIGNIFICANT

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
        ``None`` unless all rejected rows are the last ones and that is no chance (see ``SIGNIFICANT``).
    """
    rows = np.flatnonzero(seen.any(axis=1))
    if order is not None:
        rows = rows[np.argsort(np.asarray(order)[rows], kind="stable")]
    gone = np.asarray(~use[rows].any(axis=1))
    count = int(gone.sum())
    if not count or count == len(rows) or not gone[-count:].all() or comb(len(rows), count) * SIGNIFICANT < 1.0:
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
        known = (rank > 0) & (spare >= FEWEST_SPARE)
        rank, spare = np.where(known, rank, 1), np.where(known, spare, 1)
        return np.where(known, fisher_f.sf(explained / rank / (left / spare), rank, spare), np.nan)


def _explained(free: FloatArray, square: FloatArray, along: FloatArray) -> tuple[FloatArray, IntArray]:
    """(n,) S = bᵀ G⁺ b and rank of G = ``free`` (n, d, d); ``square`` gives lengths, b = ``along``."""
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", square), 1e-300))
    values, vectors = np.linalg.eigh(free / (scale[:, :, None] * scale[:, None, :]))
    seen = values > ABSORBED
    projected = np.einsum("nij,ni->nj", vectors, along / scale)
    shares = np.where(seen, projected**2 / np.where(seen, values, 1.0), 0.0)
    return shares.sum(axis=1), seen.sum(axis=1)
