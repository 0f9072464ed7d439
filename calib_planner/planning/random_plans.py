# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The paper's baseline: how do random plans fare beside the proposed one? (Table 2)"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray, check_count, plain
from calib_planner.errors import InputError
from calib_planner.planning.information import InformationModel, PlanSpace, plan_space
from calib_planner.planning.parallel import results_of
from calib_planner.planning.planner import plan
from calib_planner.planning.problem import PlanProblem
from calib_planner.planning.result import Plan

BATCH = 20_000
"""Configurations evaluated at once; a tenth with a whole error model, which has more columns."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """One column of Table 2.

    Attributes:
        label: ``"12"`` or ``"3x4"``.
        proposed: The plan of the planner.
        random: (count,) ρ0 of random plans of the same size [m].
    """

    label: str
    proposed: Plan
    random: FloatArray

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers: label, sizes, proposed, lower bound, random {max, min, mean, median} [m]."""
        quality, random = self.proposed.quality, self.random
        return plain(
            {
                "label": self.label,
                "configurations": len(self.proposed.configurations),
                "repetitions": int(self.proposed.repetitions[0]),
                "proposed": quality.predicted_accuracy,
                "lower_bound": quality.lower_bound,
                "efficiency": quality.efficiency,
                "random": {"count": len(random)}
                | {name: getattr(np, name)(random) for name in ("max", "min", "mean", "median")},
            }
        )


def compare(
    problem: PlanProblem, sizes: list[tuple[int, int]], count: int, executor: Executor | None = None
) -> list[Comparison]:
    """A column per (configurations, repetitions).

    Args:
        problem: The request; its sizes are not looked at.
        sizes: Configurations and repetitions of each column.
        count: Number of random plans.
        executor: Any ``concurrent.futures`` executor; the figures are the same whichever, or without one.

    Raises:
        InputError: Another criterion than ``test_pose``.
    """
    if problem.criterion != "test_pose" or problem.compound:
        raise InputError("criterion", problem.criterion, "test_pose")
    check_count("random", count)
    columns = []
    for k, r in sizes:
        request = replace(problem, configurations=k, repetitions=r)
        rng = np.random.default_rng([problem.search.seed, k, r])
        random = random_accuracies(plan_space(request), count, rng, executor)
        columns.append(Comparison(str(k) if r == 1 else f"{k}x{r}", plan(request, executor=executor), random))
    return columns


def random_accuracies(
    space: PlanSpace, count: int, rng: np.random.Generator, executor: Executor | None = None
) -> FloatArray:
    """(count,) ρ0 [m] of random feasible plans of the problem's size; huge where nearly singular.

    The batches have seeds of their own, drawn from ``rng``, and any ``concurrent.futures`` executor may do them.
    """
    size = space.problem.configurations
    batch = max((BATCH if isinstance(space.model, InformationModel) else BATCH // 10) // size, 1)
    plans = [min(batch, count - first) for first in range(0, count, batch)]
    seeds = rng.integers(0, 2**63, len(plans)).tolist()
    jobs = ((space, many, seed) for many, seed in zip(plans, seeds, strict=True))
    return np.concatenate(results_of(executor, _accuracies, jobs))


def _accuracies(space: PlanSpace, count: int, seed: int) -> FloatArray:
    """(count,) ρ0 [m] of one batch."""
    size = space.problem.configurations
    q = space.feasibility.sample(np.random.default_rng(seed), count * size)
    psi = space.criterion("test_pose").values(space.model.totals(q, size) + space.prior)
    return np.where(psi > 0, np.maximum(psi, 1e-300) ** -0.5, np.inf)
