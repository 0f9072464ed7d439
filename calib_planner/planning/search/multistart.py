# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The best plan over continuous configurations: many descents of −log Ψ from seeded starts.

Gradient. For a plan with M = M_0 + Σ I(q_i), the gradient G = ∂Ψ/∂M turns into ∂Ψ/∂q_i by
``LinearisedInformation.gradient``: the whole gradient costs about as much as the value.

Starts. A third draws configurations from the approximate design (see ``bound``) in proportion to its weights —
rounding it, which the descent then repairs; a third repeats a good small plan, because eq. (20) and the paper's
Table 2 show that good plans are a few good configurations repeated; the rest is random.

With a whole error model every start is a random draw from the approximate design after swaps with random
configurations, and with those that have angles in common with the test poses and with each other (see ``swaps``).

Feasibility. Every start is feasible, and with constraints the descents keep inside and follow the edges of the
allowed set (see ``interior``): what comes out is feasible by construction. An edge that a constraint does not
show, because it says no more than yes or no, is not followed; with such a constraint the best plan of each part
is then improved by random feasible steps (see ``wander``) and descents in turn.

Visits. With a whole error model all configurations of a plan keep apart (see ``apart``): what comes out are as
many different ones as were wanted.

Work is cut into independent ``parts`` with their own seeds, whatever executes them: same seed, same plan.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.planning.criteria import Criterion, ridged
from calib_planner.planning.extended import ExtendedModel
from calib_planner.planning.feasibility import Feasibility, PlanWalls
from calib_planner.planning.information import InformationModel, Model
from calib_planner.planning.problem import LARGE
from calib_planner.planning.search.apart import repelling
from calib_planner.planning.search.descent import Descent, Objective, descend, wander
from calib_planner.planning.search.interior import descend_inside
from calib_planner.planning.search.swaps import DRAWN, drawn_plan, mixed, swapped

CHUNKS, LARGEST = 4, 32
"""Fewest parts of the work, and most starts in one."""
FINALISTS = 3
"""Plans of each chunk that are polished to the end."""


@dataclass(frozen=True)
class Effort:
    """How far descents go: most iterations, tolerance of log Ψ; with constraints the first and last pressure."""

    iterations: int
    tolerance: float
    pressures: tuple[float, float] = (1e-2, 1e-3)


PLAIN = Effort(80, 1e-4), Effort(200, 1e-7)
"""Of all starts of a part, and of its finalists."""
INSIDE = Effort(16, 1e-3), Effort(60, 1e-5, (1e-4, 2e-6))
"""The same with constraints: the last pressure leaves 2e-6 of Ψ per active margin."""
EXTENDED = Effort(100, 1e-4, (3e-3, 1e-4))
"""With a whole error model: its promise is not known to 0.01 %, and an evaluation takes ten times as long."""
LIGHT = 1e-2
"""Share of the heaviest weight of the approximate design below which a configuration is spread, no choice."""
MIXES = 1
"""Rounds of swaps with configurations mixed from those of the plan and the test poses."""
BATCH = 4_000_000
"""Numbers in the inverse Hessians of descents side by side: beyond that, moving them through memory takes longer
than the work on them, and a large plan would not notice for seconds that it was cancelled."""
EDGE_ROUNDS = 4
"""Turns of random steps and descent that a constrained plan gets at most."""


def parts(starts: int) -> tuple[int, ...]:
    """Starts in each independent part of the work."""
    count = max(CHUNKS, -(-starts // LARGEST))
    return tuple(starts // count + (k < starts % count) for k in range(count))


@dataclass(frozen=True, eq=False)
class SearchProblem:
    """Choose ``size`` configurations.

    Attributes:
        model: Information of one configuration.
        criterion: Its value is maximised.
        prior: (p, p) M_0.
        size: Number of configurations.
        feasibility: What they have to obey besides the joint limits.
        support: (K, joints) configurations of the approximate design; K may be 0.
        weights: (K,) their weights.
        beside: The same problem for other sizes of the robot's errors, its model ``scaled``: the best plan of
            every part is improved for the mean of log Ψ over all of them.
        tests: (K, joints) test poses, at whose joints' angles starts measure too; K may be 0.
    """

    model: Model
    criterion: Criterion
    prior: FloatArray
    size: int
    feasibility: Feasibility
    support: FloatArray
    weights: FloatArray
    beside: tuple[SearchProblem, ...] = ()
    tests: FloatArray = field(default_factory=lambda: np.empty((0, 0)))


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Best configurations (size, joints), the log of their value, and the work it took."""

    configurations: FloatArray
    log_value: float
    starts: int
    evaluations: int


def plan_objective(problem: SearchProblem, size: int) -> Objective:
    """−log Ψ and gradient of plans given as rows of ``size``·joints coordinates."""

    def objective(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        q = rows.reshape(len(rows) * size, -1)
        info = problem.model.linearised(q)
        matrix = ridged(info.sums(size) + problem.prior)
        psi, by_matrix = problem.criterion.value_and_gradient(matrix)
        usable = psi > 0
        safe = np.where(usable, psi, 1.0)
        gradient = info.gradient(-by_matrix / safe[:, None, None])
        return np.where(usable, -np.log(safe), np.inf), gradient.reshape(len(rows), -1)

    return objective


def mean_objective(problem: SearchProblem, size: int) -> Objective:
    """The mean of ``plan_objective`` over the problem and those beside it, of one model ``scaled``."""
    every = (problem, *problem.beside)

    def objective(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        assert isinstance(problem.model, ExtendedModel)
        info = problem.model.linearised(rows.reshape(len(rows) * size, -1))
        value, parts = np.zeros(len(rows)), []
        for part in every:
            assert isinstance(part.model, ExtendedModel)
            factor = part.model.factor / problem.model.factor
            psi, by_matrix = part.criterion.value_and_gradient(ridged(info.sums(size, factor) + part.prior))
            safe = np.where(psi > 0, psi, 1.0)
            value += np.where(psi > 0, -np.log(safe), np.inf) / len(every)
            parts.append((factor, by_matrix / (-len(every) * safe)[:, None, None]))
        return value, info.gradient_of_sum(parts).reshape(len(rows), -1)

    return objective


def search_chunk(
    problem: SearchProblem,
    starts: int,
    rng: np.random.Generator,
    cancel: Callable[[], bool] = lambda: False,
) -> SearchResult:
    """One part of the work: ``starts`` descents, the best of them."""
    size = problem.size
    if isinstance(problem.model, ExtendedModel):
        plans, used = _swapped(problem, problem.model, starts, rng, cancel)
        mean = mean_objective(problem, size)
        final = descend_from(problem, size, plans, cancel, EXTENDED, objective=mean)
        work = used + final.evaluations
    else:
        rows, used = _starts(problem, starts, rng, cancel)
        first, last = efforts(problem)
        rough = descend_from(problem, size, rows, cancel, first)
        final = descend_from(problem, size, rough.x[np.argsort(rough.value)[:FINALISTS]], cancel, last)
        work = used + rough.evaluations + final.evaluations
    if problem.feasibility.masks and isinstance(problem.model, InformationModel):
        final, more = _along_the_edge(problem, problem.model, final, rng, cancel)
        work += more
    best = int(np.argmin(final.value))
    configurations = final.x[best].reshape(size, -1)
    return SearchResult(configurations, -float(final.value[best]), starts, work)


def efforts(problem: SearchProblem) -> tuple[Effort, Effort]:
    """Of all starts of a part, and of its finalists."""
    if isinstance(problem.model, ExtendedModel):
        return EXTENDED, EXTENDED
    return INSIDE if problem.feasibility.constraints else PLAIN


def _along_the_edge(
    problem: SearchProblem,
    model: InformationModel,
    final: Descent,
    rng: np.random.Generator,
    cancel: Callable[[], bool],
) -> tuple[Descent, int]:
    """Improve the best plan by random feasible steps and descents in turn, while that pays."""
    size, best = problem.size, int(np.argmin(final.value))
    row, value, work = final.x[best], float(final.value[best]), 0
    for _ in range(EDGE_ROUNDS):
        plan = row.reshape(size, -1)
        moved, tried = wander(model, problem.criterion, problem.prior, problem.feasibility, plan, rng, cancel)
        descended = descend_from(problem, size, moved[None], cancel, INSIDE[1])
        work += tried + descended.evaluations
        gained = value - float(descended.value[0])
        if gained > 0:
            row, value = descended.x[0], float(descended.value[0])
        if gained < 1e-3 or cancel():
            break
    return Descent(row[None], np.array([value]), work), work


def _starts(
    problem: SearchProblem, starts: int, rng: np.random.Generator, cancel: Callable[[], bool]
) -> tuple[FloatArray, int]:
    """(rows, size, joints) starting plans, and plans evaluated on the way."""
    size, draw = problem.size, problem.feasibility.sample
    parts, evaluations = [], 0
    rounded = -(-starts // 3) if len(problem.support) else 0
    if rounded:
        picks = rng.choice(len(problem.support), (rounded, size), p=problem.weights)
        parts.append(shake(problem, problem.support[picks], rng))
    # So many configurations are needed to identify everything without a prior.
    robot = problem.model.robot
    kernel_size = max(-(-len(robot.parameter_names) // (3 * len(robot.targets))), 1)
    tiled = -(-starts // 3) if kernel_size < size else 0
    if tiled:
        first = draw(rng, tiled * kernel_size).reshape(tiled, -1)
        kernel = descend_from(problem, kernel_size, first, cancel, efforts(problem)[0])
        evaluations += kernel.evaluations
        best = np.argsort(kernel.value)[: max(2, tiled // 4)]
        rows = np.resize(np.arange(kernel_size), size)
        parts.append(shake(problem, kernel.x[best].reshape(len(best), kernel_size, -1)[:, rows], rng))
    random = max(starts - rounded - tiled, 1)
    parts.append(draw(rng, random * size).reshape(random, size, -1))
    return np.concatenate(parts), evaluations


def _swapped(
    problem: SearchProblem,
    model: ExtendedModel,
    starts: int,
    rng: np.random.Generator,
    cancel: Callable[[], bool],
) -> tuple[FloatArray, int]:
    """(starts, size, joints) plans from the approximate design after swaps, and swaps tried."""
    draw, size, tests = problem.feasibility.sample, problem.size, problem.tests
    heavy, plans, tried = problem.weights > LIGHT * problem.weights.max(initial=0.0), [], 0
    support, weights = problem.support[heavy], problem.weights[heavy]
    # A large plan differs less from one size of the errors to the next, and each size costs as much as the first.
    every = (problem, *problem.beside) if size < LARGE else (problem,)
    sizes = [(p.model, p.criterion, p.prior) for p in every if isinstance(p.model, ExtendedModel)]
    count = DRAWN // (3 * len(model.robot.targets))
    for _ in range(starts):
        drawn = draw(rng, max(count, size))
        if len(tests):
            of_tests = tests[rng.integers(len(tests), size=len(drawn))]
            known = mixed(of_tests, drawn, rng)
            use = problem.feasibility.mask(known) & (np.arange(len(drawn)) % 2 == 1)
            drawn[use] = known[use]
        plan, others = drawn_plan(size, support, weights, drawn, rng)
        plan, more = swapped(sizes, plan, others, rng, cancel)
        tried += more
        for _ in range(MIXES):
            stock = np.concatenate([plan, tests]) if len(tests) else plan
            first, second = rng.integers(len(stock), size=(2, count))
            known = mixed(stock[first], stock[second], rng)
            plan, more = swapped(sizes, plan, known[problem.feasibility.mask(known)], rng, cancel)
            tried += more
        plans.append(plan)
    return shake(problem, np.stack(plans), rng), tried


def shake(problem: SearchProblem, plans: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Move copies apart a little, where that is feasible."""
    low, high = problem.feasibility.limits.T
    moved = np.clip(plans + rng.normal(0.0, 0.02, plans.shape), low, high)
    ok = problem.feasibility.mask(moved.reshape(-1, len(low))).reshape(plans.shape[:2])
    return np.where(ok[:, :, None], moved, plans)


def descend_from(
    problem: SearchProblem,
    size: int,
    rows: FloatArray,
    cancel: Callable[[], bool],
    effort: Effort,
    objective: Objective | None = None,
) -> Descent:
    low, high = (np.tile(side, size) for side in problem.feasibility.limits.T)
    flat = rows.reshape(len(rows), -1)
    objective = plan_objective(problem, size) if objective is None else objective
    if isinstance(problem.model, ExtendedModel):
        objective = repelling(objective, problem.model.robot, size)
    beside = max(BATCH // flat.shape[1] ** 2, 1)

    def improved(part: FloatArray) -> Descent:
        if not problem.feasibility.constraints:
            return descend(
                objective, part, low, high,
                iterations=effort.iterations, tolerance=effort.tolerance, cancel=cancel,
            )  # fmt: skip
        return descend_inside(
            objective, PlanWalls(problem.feasibility, size), part, low, high,
            iterations=effort.iterations, tolerance=effort.tolerance, pressures=effort.pressures, cancel=cancel,
        )  # fmt: skip

    ended = [improved(flat[first : first + beside]) for first in range(0, len(flat), beside)]
    return Descent(
        np.concatenate([part.x for part in ended]),
        np.concatenate([part.value for part in ended]),
        sum(part.evaluations for part in ended),
    )
