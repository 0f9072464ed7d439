# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Bounds among a few candidates, where every plan can be computed: none is better, and how bounds change with m.

Let B(m) be the bound on Ψ of m visits without prior. The best measure of m visits may be scaled: with repetition
B(m)/m is the same for every m; without, every further visit has to be to a worse candidate, so that B grows and
B/m falls. B is computed to the relative gap at which its rounds end (``GAP``), so are the comparisons.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from robots import random_chain, random_configurations, repeats

from calib_planner import InfeasibleError, PlanProblem
from calib_planner.arrays import FloatArray
from calib_planner.planning import Search, plan_space
from calib_planner.planning.bound import candidate_design
from calib_planner.planning.criteria import Criterion

GAP = 1e-3
"""Relative, of Ψ: how near to its value every bound is computed here."""
COUNT = 8
"""Few enough for every plan of up to four visits."""
QUICK = settings(max_examples=repeats(6, 60), deadline=None, derandomize=True)
seeds = st.integers(0, 100_000)
names = st.sampled_from(["test_pose", "worst_pose", "d", "a", "d_star", "o5"])


def pool(seed: int, name: str, count: int = COUNT) -> tuple[FloatArray, Criterion]:
    """(count, k, p) rows W^½ J of a random chain's candidates, all parameters being seen, and a criterion."""
    robot = random_chain(seed)
    problem = PlanProblem(
        robot,
        random_configurations(robot, 2, seed),
        len(robot.parameter_names),
        criterion=name,
        noise=1.0,
        search=Search(general_weight=0.0),
    )
    try:
        space = plan_space(problem)
    except InfeasibleError:  # nothing to identify in this draw
        assume(False)
    rows = space.model.whitened(random_configurations(robot, count, seed + 1))
    flat = rows[:COUNT].reshape(-1, rows.shape[2])
    assume(np.linalg.cond(flat / np.linalg.norm(flat, axis=0)) < 1e3)
    return rows, space.criterion(name)


def bound_of(
    rows: FloatArray,
    criterion: Criterion,
    visits: int,
    repeat: bool,
    prior: FloatArray | None = None,
    near: bool = True,
) -> float:
    """B; ``near``: only those that are near to their value, nine in ten. The others need more rounds."""
    known = np.zeros((rows.shape[2],) * 2) if prior is None else prior
    made = candidate_design(rows, criterion, known, visits, None if repeat else visits, gap=GAP, rounds=60)
    assume(not near or made.value >= (1 - GAP) * made.bound)
    return made.bound


@QUICK
@given(seeds, names, st.booleans(), st.booleans())
def test_no_plan_of_these_candidates_is_better_than_the_bound(seed, name, repeat, known):
    """All plans of two to four visits, from their definition."""
    rows, criterion = pool(seed, name)
    single = np.swapaxes(rows, 1, 2) @ rows
    prior = (1.0 if known else 1e-6) * np.diag(np.diag(single.mean(axis=0)))
    every = itertools.combinations_with_replacement if repeat else itertools.combinations
    for visits in (2, 3, 4):
        choices = np.array(list(every(range(COUNT), visits)))
        best = criterion.exact_values(prior + single[choices].sum(axis=1)).max()
        bound = bound_of(rows, criterion, visits, repeat, prior, near=False)
        assert best <= bound * (1 + 1e-9)


@QUICK
@given(seeds, names, st.booleans())
def test_how_a_bound_grows_with_the_number_of_visits(seed, name, repeat):
    rows, criterion = pool(seed, name)
    sizes = np.arange(4, COUNT + 1, 2)
    bounds = np.array([bound_of(rows, criterion, int(m), repeat) for m in sizes])
    each = bounds / sizes
    if repeat:
        np.testing.assert_allclose(each, each[0], rtol=2 * GAP)
    else:
        assert (np.diff(bounds) >= -2 * GAP * bounds[1:]).all()
        assert (np.diff(each) <= 2 * GAP * each[1:]).all()
        whole = criterion.exact(np.einsum("nkp,nkq->pq", rows, rows))  # all of them: the only plan there is
        assert bounds[-1] == pytest.approx(whole, rel=2 * GAP)


@QUICK
@given(seeds, names, st.booleans(), st.floats(1.0, 50.0))
def test_more_to_choose_from_and_more_knowledge_only_raise_a_bound(seed, name, repeat, factor):
    """And the same visits with less noise raise it by the ratio of the variances (Ψ is homogeneous)."""
    rows, criterion = pool(seed, name, 2 * COUNT)
    few = rows[:COUNT]
    prior = np.diag(np.diag(np.einsum("nkp,nkq->pq", few, few)))
    bound = bound_of(few, criterion, 5, repeat)
    assert bound_of(rows, criterion, 5, repeat) >= bound * (1 - 2 * GAP)
    assert bound_of(few, criterion, 5, repeat, prior) >= bound * (1 - 2 * GAP)
    assert bound_of(np.sqrt(factor) * few, criterion, 5, repeat) == pytest.approx(factor * bound, rel=2 * GAP)
