"""Improving by feasible random steps: what gradients cannot do along the edge of what is allowed.

A descent that may not leave the allowed set stops where its direction points outside, although it could slide
along the edge. Here every configuration gets trial steps of many lengths, in all joints or in one or two; the
infeasible ones are dropped, the best of the others is taken if it improves the worth. Inside, that is slower
than gradients, but it asks nothing of the constraints except yes or no.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray, IntArray
from calib_planner.design.criteria import Criterion
from calib_planner.design.feasibility import Feasibility
from calib_planner.design.information import InformationModel

TRIALS = 48
"""Trial steps of every configuration in a sweep."""
LONGEST, SHORTEST = 0.5, 5e-4
"""Lengths of steps, drawn evenly in the logarithm, as shares of the joint ranges."""


@dataclass(frozen=True, eq=False)
class Wandered:
    """Configurations (size, joints) after the steps, the log of their worth, worths computed."""

    configurations: FloatArray
    log_worth: float
    evaluations: int


def feasible_steps(
    feasibility: Feasibility, q: FloatArray, rng: np.random.Generator, trials: int = TRIALS
) -> tuple[FloatArray, IntArray]:
    """Random feasible steps from every row of ``q`` (N, joints).

    Returns:
        (K, joints) configurations, K ≤ N·trials, and (K,) the row of ``q`` each one started from.
    """
    low, high = feasibility.limits.T
    n, joints = q.shape
    length = np.exp(rng.uniform(np.log(SHORTEST), np.log(LONGEST), (n, trials, 1)))
    step = length * rng.normal(size=(n, trials, joints))
    few = rng.random((n, trials, joints)) < 1.5 / joints
    step[:, ::2] *= few[:, ::2]
    moved = np.clip(q[:, None] + step * (high - low), low, high).reshape(-1, joints)
    good = np.flatnonzero(feasibility.mask(moved))
    return moved[good], np.asarray(good // trials, np.int64)


def wander(
    model: InformationModel,
    criterion: Criterion,
    prior: FloatArray,
    feasibility: Feasibility,
    start: FloatArray,
    rng: np.random.Generator,
    stop: Callable[[], bool] = lambda: False,
    *,
    sweeps: int = 40,
    gain: float = 2e-4,
) -> Wandered:
    """Improve the plan ``start`` (size, joints); ends when five sweeps gain less than ``gain`` in log worth."""
    q = start.copy()
    unit = model.at(q)
    matrix = unit.sum(axis=0) + prior
    log_worth = _log_worths(criterion, matrix[None])[0]
    marks, evaluations = [log_worth], 0
    for _ in range(sweeps):
        if stop() or (len(marks) > 5 and marks[-1] - marks[-6] < gain):
            break
        trial, origin = feasible_steps(feasibility, q, rng)
        trial_unit = model.at(trial)
        for row in range(len(q)):
            mine = np.flatnonzero(origin == row)
            if not mine.size:
                continue
            worths = _log_worths(criterion, matrix - unit[row] + trial_unit[mine])
            evaluations += len(mine)
            best = int(np.argmax(worths))
            if worths[best] > log_worth:
                log_worth, chosen = worths[best], mine[best]
                matrix = matrix - unit[row] + trial_unit[chosen]
                q[row], unit[row] = trial[chosen], trial_unit[chosen]
        matrix = unit.sum(axis=0) + prior
        marks.append(log_worth)
    return Wandered(q, float(log_worth), evaluations)


def climb(
    feasibility: Feasibility,
    height: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    rng: np.random.Generator,
    *,
    rounds: int = 30,
) -> tuple[FloatArray, FloatArray]:
    """Raise ``height`` (N, joints) → (N,) from every row of ``start`` by feasible steps; rows and heights."""
    q, best = start.copy(), height(start)
    for _ in range(rounds):
        trial, origin = feasible_steps(feasibility, q, rng, 24)
        if not len(trial):
            continue
        values = height(trial)
        order = np.argsort(values)  # the last write to a row is its highest
        higher = order[values[order] > best[origin[order]]]
        q[origin[higher]], best[origin[higher]] = trial[higher], values[higher]
    return q, best


def _log_worths(criterion: Criterion, matrices: FloatArray) -> FloatArray:
    diagonal = np.einsum("spp->sp", matrices)
    floor = 1e-12 * diagonal.mean(axis=1)[:, None, None] * np.eye(matrices.shape[-1])
    worth = criterion.worth_and_slope(matrices + floor)[0]
    usable = np.isfinite(worth) & (worth > 0)
    return np.where(usable, np.log(np.where(usable, worth, 1.0)), -np.inf)
