# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The best of all choices among few candidates: every one of them is evaluated, batch by batch.

Exchange ends where no single exchange helps, and of a handful of candidates that is often not the best choice:
among eight there are few exchanges, and plans that are hardly determined differ by factors. So few choices can
all be looked at. Whether they are few enough is told from their number and the size of the matrices, not from a
clock: the same request gives the same plan on any machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement, islice
from math import comb

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.planning.criteria import Criterion
from calib_planner.planning.search.exchange import (
    ChoiceProblem,
    information_of,
    log_values_of,
    slightly_ridged,
)

LONGEST = 1.0
"""Seconds, as ``seconds`` estimates them, that all choices may take: about as long as exchange among a thousand
candidates takes."""
BATCH = 2**21
"""Numbers of the information matrices that are handled at once: 16 MB."""
REGULAR = 1e-10
"""Least eigenvalue of a scaled information matrix, in relation to the largest, that leaves Ψ six digits."""
MOST_SINGULAR = 2_000
"""Choices that may be evaluated one by one since they leave something unseen; 0.2 s."""


@dataclass(frozen=True, eq=False)
class BestOfAll:
    """The best choice by the criterion of the search, and the best value by the criterion of the plan.

    Attributes:
        rows: (size,) the choice.
        log_value: Of the choice, by the criterion of the search.
        top_rows: (size,) the choice of the largest Ψ.
        choices: Number of choices there are, all of them evaluated.
    """

    rows: IntArray
    log_value: float
    top_rows: IntArray
    choices: int


def choices_of(problem: ChoiceProblem) -> int:
    """Number of choices there are."""
    count, size = len(problem.rows), problem.size
    return comb(count + size - 1, size) if problem.repeat else comb(count, size)


def seconds(problem: ChoiceProblem) -> float:
    """Estimate of the time that all choices take on one core: calls of linear algebra, and multiplications."""
    _, k, p = problem.rows.shape
    rows = k * problem.size
    work, call = 6.0 * p**3 + rows * p**2, 1e-5
    if problem.together is not None:
        work, call = work + rows**3 + rows**2 * (p + rows), 1.5e-4
    return choices_of(problem) * (1 + len(problem.beside)) * (call + 1.5e-10 * work)


def best_of_all(
    problem: ChoiceProblem,
    target: Criterion,
    exactly: Callable[[FloatArray], float],
    cancel: Callable[[], bool] = lambda: False,
) -> BestOfAll | None:
    """Evaluate every choice; ``None`` if they are too many, or the work was cancelled.

    Args:
        problem: The choice, whose criterion (and those of the problems beside it) says which is taken.
        target: Says which has the largest Ψ. Where it is the criterion of ``problem``, its exact form says both.
        exactly: Ψ by ``target`` of one matrix (p, p) that may be singular.
        cancel: Called after every batch.
    """
    if seconds(problem) > LONGEST:
        return None
    own = target is problem.criterion and not problem.beside
    best = top = -np.inf
    rows = top_rows = np.empty(0, np.int64)
    singular = 0
    for batch in _batches(problem):
        matrices = information_of(problem, batch)
        values = target.exact_values(slightly_ridged(matrices))
        few = np.flatnonzero(_singular(matrices))
        singular += len(few)
        if cancel() or singular > MOST_SINGULAR:
            return None
        values[few] = [exactly(matrices[i]) for i in few]
        place = int(np.argmax(values))
        if values[place] > top:
            top, top_rows = float(values[place]), batch[place]
        if own:
            with np.errstate(divide="ignore"):
                wanted = np.log(values)
        else:
            others = (log_values_of(p, information_of(p, batch)) for p in problem.beside)
            wanted = np.mean([log_values_of(problem, matrices), *others], axis=0)
        place = int(np.argmax(wanted))
        if wanted[place] > best:
            best, rows = float(wanted[place]), batch[place]
    return BestOfAll(rows, best, top_rows, choices_of(problem))


def _batches(problem: ChoiceProblem) -> Iterator[IntArray]:
    """(S, size) row numbers of all choices, in lexicographic order."""
    _, k, p = problem.rows.shape
    numbers = p * p * problem.size if problem.together is None else (p + k * problem.size) ** 2 * problem.size
    draw = combinations_with_replacement if problem.repeat else combinations
    every = draw(range(len(problem.rows)), problem.size)
    while batch := list(islice(every, max(BATCH // numbers, 1))):
        yield np.array(batch, np.int64)


def _singular(matrices: FloatArray) -> FloatArray:
    """(S,) whether a matrix leaves something unseen, or nearly so, in units in which its diagonal is one."""
    scale = np.sqrt(np.maximum(np.einsum("sii->si", matrices), 1e-300))
    values = np.linalg.eigvalsh(matrices / (scale[:, :, None] * scale[:, None, :]))
    return np.asarray(values[:, 0] < REGULAR * values[:, -1])
