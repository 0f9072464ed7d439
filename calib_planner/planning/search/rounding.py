# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Plans from the approximate design, and plans for criteria that are not smooth.

*Rounding.* The configurations of the approximate design are candidates, each of which may be repeated: exchange
finds a good whole-number plan among all of them, and of the heaviest places every whole-number split is
evaluated. Descents then move the configurations to where they are best for whole numbers.

*Sharp criteria.* The smallest eigenvalue, or the worst of several accuracies, has no gradient where two of them
are equal, which is where its maximum is. The search maximises a power mean with exponent s, which is larger by up
to p^(1/s) and has its maximum elsewhere. From there the descents go on with ever larger s: each maximum is near
the one before, and the last is that of the exact criterion to a thousandth. The exact value, not the power
mean's, says which plan is the best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.planning.criteria import is_sharp, log_values, ridged, sharpened
from calib_planner.planning.extended import ExtendedModel
from calib_planner.planning.search.apart import APART, nearest
from calib_planner.planning.search.enumeration import best_of_all, seconds
from calib_planner.planning.search.exchange import ChoiceProblem, choose
from calib_planner.planning.search.multistart import (
    SearchProblem,
    SearchResult,
    descend_from,
    efforts,
    mean_objective,
    shake,
)

STEPS = (1.0, 4.0, 16.0, 64.0)
"""Factors of the exponent of sharp criteria, one descent after the other."""
NEAR = 0.03
"""Distance of two configurations of the design that count as one place, as a share of the joint ranges."""
QUICK = 0.05
"""Seconds that all splits among the heaviest places may take: so many places are looked at."""


def rounded_rows(problem: ChoiceProblem, places: IntArray, rng: np.random.Generator) -> list[IntArray]:
    """Row numbers (size,) of whole-number plans: by exchange, and the best split among the first of ``places``.

    Args:
        problem: The configurations of the approximate design as candidates.
        places: (K,) some of them, the heaviest first.
        rng: Of the exchange.
    """
    shared = problem.together is not None  # equal configurations repeat their error
    sharp = replace(problem, criterion=sharpened(problem.criterion, STEPS[-1]), repeat=not shared)
    plans = [choose(sharp, rng).rows]
    if shared:
        return plans
    for count in range(min(len(places), 12), 0, -1):
        few = replace(sharp, rows=problem.rows[places[:count]])
        if seconds(few) <= QUICK:
            best = best_of_all(few, problem.criterion, lambda matrix: 0.0)
            return plans if best is None else [*plans, places[best.top_rows]]
    return plans


def heaviest_places(support: FloatArray, weights: FloatArray, ranges: FloatArray) -> IntArray:
    """(K,) rows of ``support`` (N, joints), one a place, heaviest first; joint ranges (joints,) [rad | m]."""
    left, total = np.ones(len(support), bool), []
    for row in np.argsort(-weights, kind="stable"):
        if left[row]:
            mine = left & (np.abs((support - support[row]) / ranges).max(axis=1) < NEAR)
            total.append((float(weights[mine].sum()), int(row)))
            left[mine] = False
    return np.array([row for _, row in sorted(total, key=lambda pair: -pair[0])], np.int64)


def improved(
    problem: SearchProblem, plans: FloatArray, cancel: Callable[[], bool] = lambda: False
) -> SearchResult:
    """The best of ``plans`` (S, size, joints), as they are or after descents, by the exact criterion.

    ``log_value`` is that of the criterion of ``problem``, as ``search_chunk`` has it: with problems beside it,
    the mean over all of them.
    """
    steps = STEPS if is_sharp(problem.criterion) else STEPS[:1]
    if isinstance(problem.model, ExtendedModel):
        crowded = nearest(problem.model.robot, plans) < APART
        plans = np.where(crowded[:, None, None], shake(problem, plans, np.random.default_rng(0)), plans)
    rows: FloatArray = plans.reshape(len(plans), -1)
    work = 0
    every = [rows]
    for factor in steps:
        sharp = replace(problem, criterion=sharpened(problem.criterion, factor))
        mean = mean_objective(problem, problem.size) if problem.beside else None
        descent = descend_from(sharp, problem.size, rows, cancel, efforts(problem)[1], objective=mean)
        rows, work = descent.x, work + descent.evaluations
        every.append(rows)
    flat = _apart(problem, np.concatenate(every))
    q = flat.reshape(len(flat) * problem.size, -1)
    logs, exact = [], []
    for part in (problem, *problem.beside):
        matrices = ridged(part.model.totals(q, problem.size) + part.prior)
        logs.append(log_values(part.criterion, matrices))
        with np.errstate(divide="ignore"):
            exact.append(np.log(part.criterion.exact_values(matrices)))
    best = int(np.argmax(np.mean(exact, axis=0)))
    log_value = float(np.mean(logs, axis=0)[best])
    return SearchResult(flat[best].reshape(problem.size, -1), log_value, len(plans), work)


def _apart(problem: SearchProblem, rows: FloatArray) -> FloatArray:
    """Those of the plans ``rows`` whose visits are different where they have to be; else the nearest to that."""
    if not isinstance(problem.model, ExtendedModel):
        return rows
    least = nearest(problem.model.robot, rows.reshape(len(rows), problem.size, -1))
    return rows[least >= min(APART, least.max())]
