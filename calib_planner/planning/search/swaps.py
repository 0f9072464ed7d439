# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A good plan among many random configurations, for a robot that errs as a whole error model says.

Each configuration of a plan in turn is taken out and the best of a few hundred candidates is put in its place,
until none changes: the plan leaves valleys in which descents end. With S the other configurations of the plan,
V_SS = L Lᵀ, B = L⁻¹V_Sj and Y = L⁻¹X_S (see ``extended``), candidate j finds and adds

    M_S = M₀ + YᵀY ,        M = M_S + X̃ᵀ Ṽ⁻¹ X̃ ,    X̃ = X_j − BᵀY ,   Ṽ = V_jj − BᵀB ,                       (1)

so that by Woodbury's identity an accuracy, Ψ = 1/tr(A M⁻¹), is

    tr(A M⁻¹) = tr(A M_S⁻¹) − tr((Ṽ + X̃ M_S⁻¹ X̃ᵀ)⁻¹ X̃ M_S⁻¹ A M_S⁻¹ X̃ᵀ) .                                  (2)

One step is some products of matrices for all candidates together, without a factorisation for each. Other
criteria try the candidates that are best to first order. X and V of all candidates are computed once.

*Equal angles.* A joint's error repeats where its angle does, so that a plan gains much by measuring at the
angles of a test pose, or twice at one angle while the other joints move. Random configurations have none in
common, and a descent finds them slowly, one after the other. So candidates are ``mixed`` too: some joints stand
as in one configuration, the others as in another. First the test poses are mixed with random configurations, then
those of the plan with each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.planning.criteria import Accuracy, Criterion, log_values, ridged
from calib_planner.planning.extended import ExtendedModel, LinearisedExtension

DRAWN = 450
"""Equations of the other candidates: 150 configurations with one target; 200 gain 0.00 to 0.02 of log Ψ."""
SWEEPS = 3
"""Most rounds through the configurations of the plan; the third changes a tenth of what the first does."""
TRIED = 8
"""Candidates that a criterion other than an accuracy tries: the best to first order."""
SHARES = 0.3, 0.5, 0.8
"""Of ``mixed``: how many of the joints stand as in the first configuration; the test pose with one joint turned
is as useful as a configuration that has one angle in common with it."""


@dataclass(frozen=True, eq=False)
class Swaps:
    """Candidates that share their errors.

    Attributes:
        criterion: What is maximised.
        prior: (p, p) M₀.
        columns: (C, k, p) X of each candidate.
        covariance: (C·k, C·k) V of all of them together.
    """

    criterion: Criterion
    prior: FloatArray
    columns: FloatArray
    covariance: FloatArray

    @staticmethod
    def among(candidates: LinearisedExtension, criterion: Criterion, prior: FloatArray, factor: float) -> Swaps:
        """All configurations of ``candidates``, in the model ``scaled`` by ``factor``."""
        count, columns = len(candidates.poses), candidates.jacobian * candidates.model.column_scales(factor)
        return Swaps(criterion, prior, columns, candidates.covariance(count, factor=factor)[0])

    @cached_property
    def alone(self) -> FloatArray:
        """(C, k, k) V_jj of each candidate."""
        count, k, _ = self.columns.shape
        every = np.arange(count)
        return self.covariance.reshape(count, k, count, k)[every, :, every, :]

    def added(self, others: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """What (1) has for every candidate beside ``others`` (m,): M_S (p, p), X̃ (C, k, p) and Ṽ (C, k, k)."""
        count, k, p = self.columns.shape
        rows = (others[:, None] * k + np.arange(k)).ravel()
        flat, beside = self.columns.reshape(-1, p), self.covariance[rows]
        root = np.linalg.inv(np.linalg.cholesky(beside[:, rows]))
        shared, own = root @ beside, root @ flat[rows]
        left = (flat - shared.T @ own).reshape(count, k, p)
        blocks = shared.T.reshape(count, k, -1)
        alone = self.alone - blocks @ np.swapaxes(blocks, 1, 2)
        alone[others] = np.eye(k)  # what is there already adds nothing, and nothing new comes with it
        return self.prior + own.T @ own, left, alone

    def values(self, others: IntArray, now: int) -> FloatArray:
        """(C,) log Ψ of ``others`` (m,) with each further candidate beside them; −∞ where it is not tried.

        ``now`` is the candidate that stands beside them: it is always tried. The others themselves are not.
        """
        matrix, left, alone = self.added(others)
        if isinstance(self.criterion, Accuracy):
            inverse = np.linalg.inv(ridged(matrix[None])[0])
            flat = left.reshape(-1, left.shape[2]) @ inverse  # a large product takes a third of many small ones
            seen, turned = (rows.reshape(left.shape) for rows in (flat, flat @ self.criterion.weight))
            gain = turned @ np.swapaxes(seen, 1, 2)
            whole = alone + seen @ np.swapaxes(left, 1, 2)
            falls = np.einsum("nij,nji->n", np.linalg.inv(whole), gain)
            variance = float(np.sum(self.criterion.weight * inverse)) - falls
            result = np.asarray(-np.log(np.maximum(variance, 1e-300)))
            result[others] = -np.inf
            return result
        half = np.linalg.solve(np.linalg.cholesky(alone), left)
        whole = ridged((matrix + half[now].T @ half[now])[None])
        by_matrix = self.criterion.value_and_gradient(whole)[1][0]
        first = np.sum((half @ by_matrix) * half, axis=(1, 2))
        first[others] = -np.inf
        order = np.argsort(-first, kind="stable")
        tried = np.unique(np.append(order[:TRIED], now))
        result = np.full(len(left), -np.inf)
        result[tried] = log_values(self.criterion, ridged(matrix + np.swapaxes(half[tried], 1, 2) @ half[tried]))
        return result


def improved(
    sizes: Sequence[Swaps], plan: IntArray, rng: np.random.Generator, cancel: Callable[[], bool] = lambda: False
) -> tuple[IntArray, int]:
    """``plan`` (m,) candidates after the swaps, in no order, and the number of swaps tried.

    What counts is the mean of log Ψ over ``sizes`` of the robot's errors.
    """
    plan, tried = plan.copy(), 0
    for _ in range(SWEEPS):
        changed = False
        for place in rng.permutation(len(plan)):
            if cancel():
                return plan, tried
            others, now = np.delete(plan, place), int(plan[place])
            values = np.mean([size.values(others, now) for size in sizes], axis=0)
            tried += len(values)
            best = int(np.argmax(values))
            # A gain below rounding would swap copies of one configuration to and fro.
            if values[best] > values[now] + 1e-9:
                plan[place], changed = best, True
        if not changed:
            break
    return plan, tried


def mixed(first: FloatArray, second: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(N, joints) each joint as in that row of ``first`` or of ``second``, both (N, joints) [rad | m]."""
    share = rng.choice(SHARES, (len(first), 1))
    return np.where(rng.random(first.shape) < share, first, second)


def swapped(
    sizes: Sequence[tuple[ExtendedModel, Criterion, FloatArray]],
    plan: FloatArray,
    others: FloatArray,
    rng: np.random.Generator,
    cancel: Callable[[], bool] = lambda: False,
) -> tuple[FloatArray, int]:
    """A plan after swaps with other configurations.

    Args:
        sizes: Model, criterion and M₀ (p, p) for every size of the robot's errors; the models are the first,
            ``scaled``.
        plan: (m, joints) the plan to begin with [rad | m].
        others: (D, joints) what may take the place of its configurations [rad | m].
        rng: Of the order of the swaps.
        cancel: ``True`` ends the work with what there is.

    Returns:
        (m, joints) the plan [rad | m], and the number of swaps tried.
    """
    candidates, first = np.concatenate([plan, others]), sizes[0][0]
    info = first.linearised(candidates)
    every = [Swaps.among(info, criterion, prior, m.factor / first.factor) for m, criterion, prior in sizes]
    chosen, tried = improved(every, np.arange(len(plan)), rng, cancel)
    return candidates[chosen], tried


def drawn_plan(
    count: int, support: FloatArray, weights: FloatArray, others: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """``count`` of the configurations of an approximate design, and the rest of all.

    Args:
        count: m.
        support: (K, joints) configurations of the design, each once [rad | m].
        weights: (K,) their weights, positive.
        others: (D, joints) further ones, K + D ≥ m; where the design has too few, the first of them complete it.
        rng: Of the draw.

    Returns:
        (m, joints) and (K + D − m, joints) [rad | m].
    """
    every = np.concatenate([support, others])
    begin: IntArray = np.arange(count)
    if len(support) >= count:
        begin = rng.choice(len(support), count, replace=False, p=weights / weights.sum())
    return every[begin], np.delete(every, begin, axis=0)
