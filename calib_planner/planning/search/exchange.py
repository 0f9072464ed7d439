# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The best plan from a finite number of candidates: greedy start, then exchange (Fedorov 1972), batched.

Row blocks R_j = W^½ J_j (k, p) of the candidates give the information I_j = R_jᵀ R_j. With M the information of
the chosen rows and G = ∂Ψ/∂M, tr(G I_j) is the gain per unit weight of candidate j: one matrix product ranks
all candidates. A pass takes every chosen row out in turn and tries the best candidates in its place; it ends
when no single exchange improves Ψ. Starts: the approximate design rounded, greedy from nothing, and some random
choices; the best end wins. All cost is linear in the number of candidates.

For determinants the trial of *all* candidates is exact at the price of one product. With K_j = R_j M⁻¹ R_jᵀ (k,
k) the matrix determinant lemma says what adding candidate j gives,

    log det(M + I_j) = log det M + log det(I + K_j).                                                      (1)

Taking out row i changes M⁻¹ by Woodbury's identity: with V = M⁻¹ R_iᵀ, S = I − K_i and X_j = R_j V,

    (M − I_i)⁻¹ = M⁻¹ + V S⁻¹ Vᵀ,      K_j ← K_j + X_j S⁻¹ X_jᵀ,                                          (2)

and adding does the same with S = I + K_i and a minus. So one trial exchange with all C candidates costs O(C k²
p), without a factorisation per candidate (Miller and Nguyen 1994 for k = 1). With nuisance parameters
eliminated, log det S = log det M − log det M_nn is two of them. Rows are scaled by the Cholesky factor of the
candidates' mean information, which changes log det M by a constant. Other criteria try a shortlist of
first-order best.

With a whole error model configurations share errors, V being their covariance, and what a candidate tells depends
on the others (see ``extended``). With P = V⁻¹, Z = P X of the m rows chosen and M = M_0 + XᵀZ, row i tells

    M − M_{-i} = Z_iᵀ P_ii⁻¹ Z_i ,     V_{-i}⁻¹ = P − P_{·i} P_ii⁻¹ P_{i·} ,                                  (3)

and candidate j adds UᵀU to that, U being the rows X_j − K_j V_{-i}⁻¹ X whitened by their own covariance, with K_j
what j and the chosen rows have in common. K_j of all candidates changes by one block with every exchange, so
that a trial costs a product with the p coefficients. Which candidates are tried is told by the sensitivity seen
from the choice, X̃_j = X_j − K_j Z, (2) of ``extended``, for the largest directions of the gradient. Other
sizes of the errors (``scaled``) change V and the columns by a factor only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.errors import InfeasibleError
from calib_planner.planning.criteria import Accuracy, Criterion, Determinant, Eliminating, log_values
from calib_planner.planning.extended import LinearisedExtension
from calib_planner.robot import analyse

RIDGE = 1e-9
"""Share of the candidates' mean information that is always added: M stays invertible while rows are out, and
log det M moves by about p·RIDGE."""


@dataclass(frozen=True, eq=False)
class ScaledRows:
    """Scaled rows of all candidates for one determinant.

    Attributes:
        rows: (C, k, p) R_j in coordinates in which the candidates' mean information plus prior is I.
        prior: (p, p) M_0 in the same coordinates, ridge included.
        offset: log det of the scaling, to be added to log det M.
    """

    rows: FloatArray
    prior: FloatArray
    offset: float


def scaled_rows(rows: FloatArray, prior: FloatArray, size: int) -> ScaledRows:
    """Scale ``rows`` (C, k, p) for plans of ``size`` rows; the candidates must identify all p parameters."""
    flat = rows.reshape(-1, rows.shape[2])
    mean = size * (flat.T @ flat) / len(rows) + prior
    units = np.sqrt(np.diag(mean))
    triangle = np.linalg.cholesky(mean / np.outer(units, units))
    scaled = np.linalg.solve(triangle, (flat / units).T).T
    inner = np.linalg.solve(triangle, prior / np.outer(units, units))
    ground = np.linalg.solve(triangle, inner.T) + RIDGE * np.eye(len(prior))
    offset = 2.0 * float(np.log(np.diag(triangle)).sum() + np.log(units).sum())
    return ScaledRows(np.ascontiguousarray(scaled).reshape(rows.shape), 0.5 * (ground + ground.T), offset)


class RunningDeterminant:
    """log det M of a growing and shrinking choice, and what every candidate would add.

    Attributes:
        log_det: log det M, in physical units.
        leverage: (k, k, C) K_j of every candidate.
        strained: Taking a row out left M nearly singular, which costs digits: ``reset`` soon.
    """

    def __init__(self, candidates: ScaledRows, chosen: IntArray) -> None:
        self.candidates = candidates
        count, k, p = candidates.rows.shape
        self._columns = np.ascontiguousarray(candidates.rows.transpose(2, 1, 0)).reshape(p, k * count)
        self.reset(chosen)

    def reset(self, chosen: IntArray) -> None:
        """Start afresh from ``chosen``, free of accumulated rounding."""
        own = self.candidates.rows[chosen].reshape(-1, self.candidates.rows.shape[2])
        matrix = self.candidates.prior + own.T @ own
        self.inverse = np.linalg.inv(matrix)
        self.inverse = 0.5 * (self.inverse + self.inverse.T)
        self.log_det = float(np.linalg.slogdet(matrix)[1]) + self.candidates.offset
        half = self.candidates.rows @ self.inverse
        blocks = half @ np.swapaxes(self.candidates.rows, 1, 2)
        self.leverage = np.ascontiguousarray(blocks.transpose(1, 2, 0))
        self.strained = False

    def gains(self) -> FloatArray:
        """(C,) log det(I + K_j), eq. (1)."""
        return log_det_plus_identity(self.leverage)

    def change(self, row: int, sign: int) -> None:
        """Add (``sign`` = 1) or take out (−1) one row, eq. (2)."""
        lever = self.inverse @ self.candidates.rows[row].T
        small = np.eye(lever.shape[1]) + sign * self.leverage[:, :, row]
        values, vectors = np.linalg.eigh(small)
        self.strained = self.strained or values[0] < 1e-6
        values = np.maximum(values, 1e-12)
        whitened = lever @ (vectors / np.sqrt(values))
        self.inverse -= sign * whitened @ whitened.T
        seen = (whitened.T @ self._columns).reshape(whitened.shape[1], *self.leverage.shape[1:])
        for one in seen:  # (k, C) at a time: long contiguous runs
            for block, part in zip(self.leverage, sign * one, strict=True):
                block -= part * one
        self.log_det += float(np.log(values).sum())


def log_det_plus_identity(blocks: FloatArray) -> FloatArray:
    """log det(I + K) of positive semi-definite blocks (k, k, C)."""
    k = len(blocks)
    if k != 3:
        return np.asarray(np.linalg.slogdet(np.eye(k) + blocks.transpose(2, 0, 1))[1], np.float64)
    a, b, c = blocks[0, 0] + 1.0, blocks[1, 1] + 1.0, blocks[2, 2] + 1.0
    d, e, f = blocks[0, 1], blocks[0, 2], blocks[1, 2]
    return np.log(np.maximum(a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e), 1e-300))


# ── the choice ───────────────────────────────────────────────────────────────────────────────────────

SHORTLIST = 24
"""Candidates tried exactly in place of each row, where all of them cannot be."""
RANDOM_STARTS = 4
"""Starts from random rows, besides the rounded and the greedy one."""
MOST_PASSES = 100
"""Passes over the chosen rows after which an exchange is called finished; 3 to 8 are usual."""


@dataclass(frozen=True, eq=False)
class ChoiceProblem:
    """Choose ``size`` of the candidates.

    Attributes:
        rows: (C, k, p) whitened Jacobians W^½ J of each candidate; RᵀR is its information.
        criterion: Its value is maximised.
        prior: (p, p) M_0.
        size: Number of rows.
        repeat: Whether a row may be chosen more than once.
        weights: (C,) weights of the approximate design, to start from, or empty.
        names: p names of the parameters, for messages.
        together: The candidates where they share errors, else ``None``; ``rows`` is then each of them alone.
        factor: f, by which the errors of the joints are larger than in ``together``.
        beside: The same problem for other sizes of the robot's errors, where candidates share errors: the choice
            is improved for the mean of log Ψ over all of them.
    """

    rows: FloatArray
    criterion: Criterion
    prior: FloatArray
    size: int
    repeat: bool = False
    weights: FloatArray = field(default_factory=lambda: np.empty(0))
    names: tuple[str, ...] = ()
    together: LinearisedExtension | None = None
    factor: float = 1.0
    beside: tuple[ChoiceProblem, ...] = ()


@dataclass(frozen=True, eq=False)
class Choice:
    """Chosen rows (size,), the log of their value, exchanges tried, starts done."""

    rows: IntArray
    log_value: float
    evaluations: int
    starts: int = 1


def choose(
    problem: ChoiceProblem, rng: np.random.Generator, cancel: Callable[[], bool] = lambda: False
) -> Choice:
    """Choose rows; every start is exchanged to the end, the best wins.

    Raises:
        InfeasibleError: The candidates cannot identify the parameters, whichever rows are chosen; names the
            combinations of parameters that no candidate shows. Or there are fewer candidates than rows.
    """
    check_choice(problem)
    search: _Exact | _Shortlisted | _Together
    if problem.together is not None:
        search = _Together(problem, problem.together)
    else:
        search = _Exact(problem) if _is_determinant(problem.criterion) else _Shortlisted(problem)
    best: Choice | None = None
    count = evaluations = 0
    for start in _starts(problem, rng):
        count += 1
        rows, tried = search.run(start, cancel)
        log_value = _mean_log_value(problem, rows)
        evaluations += tried
        if best is None or log_value > best.log_value:
            best = Choice(rows, log_value, 0)
        if cancel():
            break
    assert best is not None
    return Choice(best.rows, best.log_value, evaluations, count)


def check_choice(problem: ChoiceProblem) -> None:
    """Refuse candidates that are too few, or that cannot identify the parameters; see ``choose``."""
    candidates, _, p = problem.rows.shape
    if not candidates or (candidates < problem.size and not problem.repeat):
        raise InfeasibleError(
            "candidates", f"{candidates} feasible rows, {problem.size} different ones are needed"
        )
    values, vectors = np.linalg.eigh(problem.prior)
    known = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    stacked = np.concatenate([problem.rows.reshape(-1, p), known])
    largest = float(np.linalg.norm(stacked, axis=0).max()) or 1.0
    identifiable = analyse(stacked / largest, problem.names or [f"parameter_{i}" for i in range(p)])
    if identifiable.fixed:
        raise InfeasibleError(
            "candidates",
            f"all {candidates} rows together do not identify {len(identifiable.fixed)} of {p} parameters; no "
            f"candidate shows {'; '.join(identifiable.combinations)}. Add other candidates, ask for fewer "
            "parameters or give prior standard deviations",
        )


def _starts(problem: ChoiceProblem, rng: np.random.Generator) -> list[IntArray]:
    """Rows to begin from, to be filled up greedily where they are fewer than ``size``."""
    starts = [_rounded(problem)] if len(problem.weights) else []
    starts.append(np.empty(0, np.int64))
    for _ in range(RANDOM_STARTS if problem.together is None else 1):
        starts.append(rng.choice(len(problem.rows), problem.size, replace=problem.repeat))
    return starts


def _rounded(problem: ChoiceProblem) -> IntArray:
    """Rows whose weight in the approximate design is at least half a measurement, heaviest first."""
    shares = problem.weights * problem.size
    counts = np.floor(shares + 0.5).astype(np.int64)
    if not problem.repeat:
        counts = np.minimum(counts, 1)
    order = np.argsort(-shares, kind="stable")
    return np.repeat(order, counts[order])[: problem.size]


def information_of(problem: ChoiceProblem, choices: IntArray) -> FloatArray:
    """M (S, p, p) of choices (S, size)."""
    if problem.together is not None and choices.size:
        return problem.prior + problem.together.rows(choices.ravel()).sums(choices.shape[1], problem.factor)
    own = problem.rows[choices].reshape(len(choices), -1, problem.rows.shape[2])
    return problem.prior + np.swapaxes(own, 1, 2) @ own


def _information(problem: ChoiceProblem, rows: IntArray) -> FloatArray:
    return information_of(problem, rows[None])[0]


def _mean_log_value(problem: ChoiceProblem, rows: IntArray) -> float:
    """log Ψ of a choice, the mean over the problem and those beside it."""
    every = (problem, *problem.beside)
    return float(np.mean([log_values_of(p, _information(p, rows)[None])[0] for p in every]))


def log_values_of(problem: ChoiceProblem, matrices: FloatArray) -> FloatArray:
    """log Ψ (S,) of (S, p, p), with a ridge relative to each diagonal element, since rows may be in any units."""
    return log_values(problem.criterion, slightly_ridged(matrices))


def slightly_ridged(matrices: FloatArray) -> FloatArray:
    """(S, p, p) with 1e-13 more on the diagonal, relative to each element of it, or to the largest where it is 0.

    It is 0 where no row shows a parameter at all, as in plans that stay at the home configuration.
    """
    diagonal = np.einsum("sii->si", matrices)
    largest = diagonal.max(axis=1, keepdims=True)
    scale = np.where(diagonal > 0.0, diagonal, np.where(largest > 0.0, largest, 1.0))
    return np.asarray(matrices + 1e-13 * scale[:, :, None] * np.eye(matrices.shape[-1]))


# ── determinants: all candidates, exactly ────────────────────────────────────────────────────────────


def _is_determinant(criterion: Criterion) -> bool:
    inner = criterion.inner if isinstance(criterion, Eliminating) else criterion
    return isinstance(inner, Determinant)


class _Exact:
    """``run`` exchanges one start to the end; it returns the chosen rows and the number of exchanges tried."""

    def __init__(self, problem: ChoiceProblem) -> None:
        self.problem = problem
        self.parts = [(1, scaled_rows(problem.rows, problem.prior, problem.size))]
        if isinstance(problem.criterion, Eliminating):
            n = np.array(problem.criterion.nuisance)
            rows, prior = np.ascontiguousarray(problem.rows[:, :, n]), problem.prior[np.ix_(n, n)]
            self.parts.append((-1, scaled_rows(rows, prior, problem.size)))

    def run(self, start: IntArray, cancel: Callable[[], bool]) -> tuple[IntArray, int]:
        problem, chosen = self.problem, [int(i) for i in start]
        state = [(sign, RunningDeterminant(candidates, start)) for sign, candidates in self.parts]
        tried = 0
        while len(chosen) < problem.size:
            chosen.append(int(np.argmax(self._gains(state, chosen))))
            self._change(state, chosen[-1], 1)
        for _ in range(MOST_PASSES):
            changed = 0
            self._refresh(state, chosen, strained=False)
            for position, old in enumerate(chosen):
                if cancel():
                    return np.array(chosen), tried
                self._change(state, old, -1)
                gains = self._gains(state, chosen[:position] + chosen[position + 1 :])
                new, tried = int(np.argmax(gains)), tried + len(gains)
                if gains[new] <= gains[old] + 1e-9:
                    new = old
                changed += new != old
                chosen[position] = new
                self._change(state, new, 1)
                self._refresh(state, chosen, strained=True)
            if not changed:
                break
        return np.array(chosen), tried

    def _gains(self, state: list[tuple[int, RunningDeterminant]], taken: list[int]) -> FloatArray:
        gains: FloatArray = np.sum([sign * part.gains() for sign, part in state], axis=0)
        if not self.problem.repeat:
            gains[taken] = -np.inf
        return gains

    def _change(self, state: list[tuple[int, RunningDeterminant]], row: int, sign: int) -> None:
        for _, part in state:
            part.change(row, sign)

    def _refresh(self, state: list[tuple[int, RunningDeterminant]], chosen: list[int], *, strained: bool) -> None:
        for _, part in state:
            if part.strained or not strained:
                part.reset(np.array(chosen))


# ── any other criterion: first-order shortlist ───────────────────────────────────────────────────────


class _Shortlisted:
    """As ``_Exact``."""

    def __init__(self, problem: ChoiceProblem) -> None:
        self.problem = problem
        self.flat = problem.rows.reshape(-1, problem.rows.shape[2])
        self.average = self.flat.T @ self.flat / len(problem.rows)

    def run(self, start: IntArray, cancel: Callable[[], bool]) -> tuple[IntArray, int]:
        problem, rows = self.problem, self._greedy(start)
        matrix = _information(problem, rows)
        log_value = float(log_values_of(problem, matrix[None])[0])
        tried = 1
        for _ in range(MOST_PASSES):
            improved = False
            for position in range(problem.size):
                if cancel():
                    return rows, tried
                without = matrix - self._unit(rows[position : position + 1])[0]
                candidates = self._shortlist(matrix, rows)
                if not candidates.size:
                    continue
                trial = log_values_of(problem, without + self._unit(candidates))
                tried += len(candidates)
                best = int(np.argmax(trial))
                if trial[best] > log_value + 1e-9:
                    rows[position], log_value, improved = candidates[best], float(trial[best]), True
                    matrix = _information(problem, rows)
            if not improved:
                break
        return rows, tried

    def _unit(self, rows: IntArray) -> FloatArray:
        own = self.problem.rows[rows]
        return np.swapaxes(own, 1, 2) @ own

    def _gains(self, matrix: FloatArray) -> FloatArray:
        """(C,) tr(G I_j)."""
        gradient = self.problem.criterion.value_and_gradient(matrix[None])[1][0]
        gains = ((self.flat @ gradient) * self.flat).sum(axis=1).reshape(len(self.problem.rows), -1).sum(axis=1)
        return np.where(np.isfinite(gains), gains, 0.0)

    def _greedy(self, start: IntArray) -> IntArray:
        """Fill up with the candidate of largest first-order gain, from a little of the candidates' mean."""
        chosen, ground = list(start), 1e-3 * self.problem.size * self.average
        while len(chosen) < self.problem.size:
            gains = self._gains(ground + _information(self.problem, np.array(chosen, np.int64)))
            if not self.problem.repeat:
                gains[chosen] = -np.inf
            chosen.append(int(np.argmax(gains)))
        return np.array(chosen, np.int64)

    def _shortlist(self, matrix: FloatArray, rows: IntArray) -> IntArray:
        """Best first-order candidates; the matrix gets a small multiple of the candidates' mean to rank by."""
        gains = self._gains(matrix + 1e-6 * self.problem.size * self.average)
        if not self.problem.repeat:
            gains[rows] = -np.inf
        count = min(SHORTLIST, int(np.isfinite(gains).sum()))
        return np.argpartition(-gains, count - 1)[:count] if count else np.empty(0, np.int64)


# ── candidates that share errors ─────────────────────────────────────────────────────────────────────


DIRECTIONS = 0.999
"""Share of the trace of an accuracy's weight that the directions have by which candidates are ranked."""


class _Chosen:
    """The rows chosen, for one size of the errors: (3)."""

    def __init__(self, problem: ChoiceProblem, shared: _Shared, rows: IntArray) -> None:
        self.problem, factor = problem, problem.factor
        r, m = shared.r, len(rows)
        self.columns = shared.columns[rows].reshape(m * r, shared.columns.shape[2]) * shared.scales(factor)
        self.covariance = np.zeros((m, r, m, r))
        every = np.arange(m)
        self.covariance += factor**2 * shared.cross[rows][:, :, :m]
        self.covariance[every, :, every, :] += shared.points[rows] + factor**2 * shared.visits[rows]
        self.inverse = np.linalg.inv(self.covariance.reshape(m * r, m * r))
        self.solved = self.inverse @ self.columns
        self.matrix = problem.prior + self.columns.T @ self.solved
        self.shared, self.r, self.size = shared, r, m

    @cached_property
    def hidden(self) -> FloatArray:
        """(p, p) M⁻¹, M with a ridge."""
        return np.asarray(np.linalg.inv(slightly_ridged(self.matrix[None])[0]))

    def added(self, new: IntArray, position: int) -> FloatArray:
        """(K, r, p) rows U of what each of ``new`` (K,) adds to the choice without the row at ``position``."""
        shared, factor, r = self.shared, self.problem.factor, self.r
        inverse, place = self.inverse, slice(position * r, (position + 1) * r)
        inverse = inverse - inverse[:, place] @ np.linalg.solve(inverse[place, place], inverse[place])
        cross = factor**2 * shared.cross[new][:, :, : self.size].reshape(len(new) * r, -1)
        weights = cross @ inverse
        left = shared.columns[new] * shared.scales(factor) - (weights @ self.columns).reshape(len(new), r, -1)
        met = weights.reshape(len(new), r, -1) @ np.swapaxes(cross.reshape(len(new), r, -1), 1, 2)
        alone = shared.points[new] + factor**2 * (shared.visits[new] + shared.own[new]) - met
        return np.linalg.inv(np.linalg.cholesky(alone)) @ left

    def with_one_more(self, new: IntArray, position: int) -> FloatArray:
        """log Ψ (K,) with each of ``new`` (K,) in the place of the row at ``position``.

        For accuracies 1/tr(A M⁻¹) by Woodbury's identity, C being the inverse without the row:
        tr A (C⁻¹ + UᵀU)⁻¹ = tr A C − tr (I + U C Uᵀ)⁻¹ U C A C Uᵀ.
        """
        added = self.added(new, position)
        place = slice(position * self.r, (position + 1) * self.r)
        own, gone = self.inverse[place, place], self.solved[place]
        criterion = self.problem.criterion
        if not isinstance(criterion, Accuracy):
            left = self.matrix - gone.T @ np.linalg.solve(own, gone)
            return log_values_of(self.problem, left + np.swapaxes(added, 1, 2) @ added)
        seen = gone @ self.hidden
        inverse = self.hidden + seen.T @ np.linalg.solve(own - seen @ gone.T, seen)
        half = (added.reshape(-1, len(inverse)) @ inverse).reshape(added.shape)
        inner = np.eye(self.r) + half @ np.swapaxes(added, 1, 2)
        turned = (half.reshape(-1, len(inverse)) @ criterion.weight).reshape(added.shape)
        gained = np.linalg.solve(inner, turned @ np.swapaxes(half, 1, 2))
        rest = np.sum(criterion.weight * inverse) - np.einsum("kii->k", gained)
        return np.where(rest > 0.0, -np.log(np.maximum(rest, 1e-300)), -np.inf)


class _Shared:
    """What all candidates have in common with the rows chosen, and each alone.

    Attributes:
        columns: (C, r, p) X.
        points: (C, r, r) what is new at each visit and point, without the joints' part [m²].
        visits: (C, r, r) what the joints err anew at each visit [m²].
        own: (C, r, r) what the eliminated functions move it by [m²].
        cross: (C, r, m, r) what these have in common with each row chosen [m²].
    """

    def __init__(self, info: LinearisedExtension, size: int) -> None:
        self.info, self.levers, self.rest = info, info.levers, info.rest
        self.columns, self.points = info.jacobian, info.points
        self.count, self.r, _ = self.columns.shape
        turned = np.swapaxes(self.levers, 1, 2)
        self.visits = info.model.visit_variance * (self.levers @ turned)
        self.own = (self.levers * np.sum(self.rest**2, axis=2)[:, None]) @ turned
        self.cross = np.zeros((self.count, self.r, size, self.r))
        self.whitener = np.linalg.inv(np.linalg.cholesky(self.points + self.visits))
        self._scales: dict[float, FloatArray] = {}

    def scales(self, factor: float) -> FloatArray:
        """(p,) what another size of the errors makes of the columns."""
        if factor not in self._scales:
            self._scales[factor] = self.info.model.column_scales(factor)
        return self._scales[factor]

    def put(self, position: int, row: int) -> None:
        """Candidate ``row`` is chosen at ``position``."""
        kernel = np.einsum("clf,lf->cl", self.rest, self.rest[row], optimize=True)
        self.cross[:, :, position] = (self.levers * kernel[:, None]) @ self.levers[row].T


class _Together:
    """As ``_Exact``."""

    def __init__(self, problem: ChoiceProblem, info: LinearisedExtension) -> None:
        self.problem, self.shared = problem, _Shared(info, problem.size)
        flat = problem.rows.reshape(-1, problem.rows.shape[2])
        self.average = flat.T @ flat / len(problem.rows)
        self.root = self._directions()

    def _directions(self) -> FloatArray | None:
        """(p, k) the largest directions of an accuracy's weight, in units in which M is of the order of one."""
        if not isinstance(self.problem.criterion, Accuracy):
            return None
        matrix = self.problem.prior + self.problem.size * self.average
        units = np.sqrt(np.diag(matrix))
        values, vectors = np.linalg.eigh(self.problem.criterion.weight / np.outer(units, units))
        largest = np.argsort(-values)
        share = np.cumsum(values[largest]) / values.sum()
        used = largest[: int(np.searchsorted(share, DIRECTIONS)) + 1]
        return np.asarray(units[:, None] * vectors[:, used] * np.sqrt(np.maximum(values[used], 0.0)))

    def run(self, start: IntArray, cancel: Callable[[], bool]) -> tuple[IntArray, int]:
        rows = self._greedy(start)
        tried = self._exchange(rows, [self.problem], cancel)
        if self.problem.beside:
            tried += self._exchange(rows, [self.problem, *self.problem.beside], cancel)
        return rows, tried

    def _exchange(self, rows: IntArray, every: list[ChoiceProblem], cancel: Callable[[], bool]) -> int:
        """Exchange ``rows`` in place until that pays no more; returns the number of exchanges tried."""
        chosen = [_Chosen(p, self.shared, rows) for p in every]
        log_value, tried = float(np.mean([log_values_of(c.problem, c.matrix[None])[0] for c in chosen])), 1
        for _ in range(MOST_PASSES):
            improved, order = False, self._order(self._seen(chosen[0]))
            for position in range(self.problem.size):
                if cancel():
                    return tried
                shortlist = order if self.problem.repeat else order[~np.isin(order, rows)]
                shortlist = shortlist[:SHORTLIST]
                if not len(shortlist):
                    continue
                trial = np.mean([c.with_one_more(shortlist, position) for c in chosen], axis=0)
                tried += len(shortlist)
                best = int(np.argmax(trial))
                if trial[best] > log_value + 1e-6:
                    rows[position], log_value, improved = shortlist[best], float(trial[best]), True
                    self.shared.put(position, rows[position])
                    chosen = [_Chosen(p, self.shared, rows) for p in every]
            if not improved:
                break
        return tried

    def _greedy(self, start: IntArray) -> IntArray:
        """Fill up with the candidate of largest first-order gain, from a little of the candidates' mean."""
        rows, ground = np.array(start, np.int64), 1e-3 * self.problem.size * self.average
        for position, row in enumerate(rows):
            self.shared.put(position, row)
        while len(rows) < self.problem.size:
            chosen = _Chosen(self.problem, self.shared, rows)
            order = self._order(self._gains(chosen, chosen.matrix + ground, given=True))
            row = int((order if self.problem.repeat else order[~np.isin(order, rows)])[0])
            self.shared.put(len(rows), row)
            rows = np.append(rows, row)
        return rows

    def _seen(self, chosen: _Chosen) -> FloatArray:
        """(C,) the sensitivity of every candidate seen from the rows chosen."""
        return self._gains(chosen, chosen.matrix + 1e-6 * self.problem.size * self.average, given=False)

    def _gains(self, chosen: _Chosen, matrix: FloatArray, *, given: bool) -> FloatArray:
        """(C,) tr(G I_j): of what j adds to the rows chosen (``given``), or of the sensitivity seen from them."""
        shared, m = self.shared, chosen.size
        root = self._root(matrix)
        cross = shared.cross[:, :, :m].reshape(shared.count * shared.r, -1)
        flat = shared.columns.reshape(shared.count * shared.r, -1)
        left = (flat @ root - cross @ (chosen.solved @ root)).reshape(shared.count, shared.r, -1)
        if not given:
            return np.asarray(np.sum((shared.whitener @ left) ** 2, axis=(1, 2)))
        blocks = cross.reshape(shared.count, shared.r, -1)
        met = (cross @ chosen.inverse).reshape(blocks.shape) @ np.swapaxes(blocks, 1, 2)
        alone = shared.points + shared.visits + shared.own - met
        return np.asarray(np.sum(left * (np.linalg.inv(alone) @ left), axis=(1, 2)))

    def _root(self, matrix: FloatArray) -> FloatArray:
        """(p, k) B with B Bᵀ the gradient at ``matrix`` (p, p), or its largest directions."""
        if self.root is not None:
            return np.asarray(np.linalg.solve(matrix, self.root))
        gradient = self.problem.criterion.value_and_gradient(matrix[None])[1][0]
        values, vectors = np.linalg.eigh(gradient)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    def _order(self, gains: FloatArray) -> IntArray:
        """The candidates of largest gain, largest first, with as many more as may be taken already."""
        count = min(SHORTLIST + self.problem.size, len(gains))
        gains = np.where(np.isfinite(gains), gains, 0.0)
        largest = np.argpartition(-gains, count - 1)[:count]
        return largest[np.argsort(-gains[largest], kind="stable")]
