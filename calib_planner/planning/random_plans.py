"""The paper's baseline: how do random plans fare beside the proposed one? (Table 2)"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray, check_count, plain
from calib_planner.errors import InputError
from calib_planner.planning.information import InformationModel, PlanSpace, plan_space
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


def compare(problem: PlanProblem, sizes: list[tuple[int, int]], count: int) -> list[Comparison]:
    """A column per (configurations, repetitions).

    Raises:
        InputError: Another criterion than ``test_pose``.
    """
    if problem.criterion != "test_pose" or problem.compound:
        raise InputError("criterion", problem.criterion, "test_pose")
    check_count("random", count)
    columns = []
    for k, r in sizes:
        request = replace(problem, configurations=k, repetitions=r)
        random = random_accuracies(plan_space(request), count, np.random.default_rng([problem.search.seed, k, r]))
        columns.append(Comparison(str(k) if r == 1 else f"{k}x{r}", plan(request), random))
    return columns


def random_accuracies(space: PlanSpace, count: int, rng: np.random.Generator) -> FloatArray:
    """(count,) ρ0 [m] of random feasible plans of the problem's size; huge where nearly singular."""
    size = space.problem.configurations
    criterion = space.criterion("test_pose")
    batch = max((BATCH if isinstance(space.model, InformationModel) else BATCH // 10) // size, 1)
    values = []
    for first in range(0, count, batch):
        plans = min(batch, count - first)
        matrices = space.model.totals(space.feasibility.sample(rng, plans * size), size) + space.prior
        psi = criterion.value_and_gradient(matrices)[0]
        values.append(np.where(psi > 0, np.maximum(psi, 1e-300) ** -0.5, np.inf))
    return np.concatenate(values)
