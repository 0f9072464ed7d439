"""How many measurements, and how to split them: configurations k times repetitions r.

With σ_c = 0 the accuracy of k configurations measured r times is ρ_k/√r, and the bound of n measurements is
c/√n: no plan of fewer than (c/ρ)² measurements reaches ρ. Good small plans repeated are nearly as good as large
ones (the paper's Table 2), so few k need to be tried. With σ_c > 0 repetition helps less, and (with a prior) the
bound is no longer a square root; both are then simply computed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from calib_planner.arrays import check_count, check_number
from calib_planner.errors import InfeasibleError, InputError
from calib_planner.planning.criteria import POSE_CRITERIA
from calib_planner.planning.information import plan_space, smallest_size
from calib_planner.planning.planner import plan, value_of
from calib_planner.planning.problem import PlanProblem
from calib_planner.planning.result import Plan

MOST_MEASUREMENTS = 10_000
TRIED = 6
"""Numbers of configurations tried one by one from the smallest; beyond them only if none of these is enough."""
MOST_CONFIGURATIONS = 60
"""A plan of more is no answer for an afternoon."""

Watch = Callable[[int, int], None]
"""Told how many plans are done, of how many at most."""


@dataclass(frozen=True, eq=False)
class Split:
    """Measurements divided into configurations and repetitions.

    Attributes:
        plan: The recommended plan.
        tried: All plans computed, smallest number of configurations first.
        fewest: No plan of fewer measurements can reach the wanted accuracy (0 where that is not known).
    """

    plan: Plan
    tried: tuple[Plan, ...]
    fewest: int


def plan_for_accuracy(problem: PlanProblem, accuracy: float, watch: Watch = lambda done, total: None) -> Split:
    """The smallest number of measurements k·r that reaches ``accuracy`` [m]; of equals the smallest k.

    ``configurations`` and ``repetitions`` of the problem are not looked at.

    Raises:
        InfeasibleError: Not reached with ``MOST_MEASUREMENTS``; says what is.
    """
    _check_metric(problem)
    accuracy = check_number("accuracy", accuracy, low=0, low_open=True, unit="m")
    smallest = smallest_size(problem)
    best: Plan | None = None
    tried: list[Plan] = []
    nothing_known = problem.measured is None and problem.model.placement.stated is None
    scales_with_measurements = nothing_known and problem.configuration_sigma == 0 and problem.whole_model is None
    fewest = 0
    for k in _sizes(smallest):
        if k >= smallest + TRIED and best is not None:
            break
        # The least multiple of k not below ``fewest`` may be no fewer than the best number of measurements.
        beaten = best is not None and fewest > 0 and k * -(-fewest // k) >= best.measurements
        candidate = None if beaten else _smallest_repetition(problem, k, accuracy)
        watch(min(k - smallest + 1, TRIED), TRIED)
        if candidate is None:
            continue
        tried.append(candidate)
        if not fewest and scales_with_measurements:
            needed = candidate.measurements * (candidate.quality.value_bound / accuracy) ** 2
            fewest = int(np.ceil(needed * (1 - 1e-9)))
        if best is None or candidate.measurements < best.measurements:
            best = candidate
        if best.measurements <= max(fewest, k):
            break
    if best is None:
        raise InfeasibleError(
            "accuracy",
            f"{accuracy:g} m is not reached by {smallest} to {MOST_CONFIGURATIONS} configurations, each repeated "
            f"up to {MOST_MEASUREMENTS} measurements in all; ask for less, or lower the noise",
        )
    return Split(best, tuple(tried), fewest)


def _sizes(smallest: int) -> Iterator[int]:
    """Numbers of configurations to try: every one at first, then ever larger ones."""
    yield from range(smallest, smallest + TRIED)
    k = smallest + TRIED
    while k <= MOST_CONFIGURATIONS:
        yield k
        k = int(np.ceil(1.25 * k))


def _smallest_repetition(problem: PlanProblem, k: int, accuracy: float) -> Plan | None:
    """The plan of k configurations with the fewest repetitions that reaches ``accuracy``."""
    once = plan(replace(problem, configurations=k, repetitions=1))
    if once.quality.value <= accuracy:
        return once

    def value(r: int) -> float:
        return value_of(replace(problem, configurations=k, repetitions=r), once.configurations)

    low, high = 1, MOST_MEASUREMENTS // k
    if not value(high) <= accuracy:
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if value(middle) <= accuracy else (middle, high)
    # Configurations chosen for that many repetitions may do with fewer, where σ_c or a prior matters.
    candidate = plan(replace(problem, configurations=k, repetitions=high))
    return candidate if candidate.quality.value <= accuracy else None


def split_budget(
    problem: PlanProblem,
    measurements: int,
    tolerance: float = 0.01,
    watch: Watch = lambda done, total: None,
) -> Split:
    """Divide ``measurements`` = k·r: the smallest k within ``tolerance`` of the best value.

    Fewer configurations mean less moving for nearly the same accuracy.
    """
    _check_metric(problem)
    check_count("measurements", measurements, high=MOST_MEASUREMENTS)
    smallest = smallest_size(problem)
    sizes = [k for k in range(smallest, measurements + 1) if measurements % k == 0]
    if not sizes:
        raise InfeasibleError(
            "measurements", f"{measurements} are too few: at least {smallest} configurations are needed"
        )
    tried = []
    for k in sizes:
        tried.append(plan(replace(problem, configurations=k, repetitions=measurements // k)))
        watch(len(tried), len(sizes))
    best = min(p.quality.value for p in tried)
    chosen = next(p for p in tried if p.quality.value <= best * (1.0 + tolerance))
    return Split(chosen, tuple(tried), 0)


def _check_metric(problem: PlanProblem) -> None:
    if problem.criterion not in POSE_CRITERIA or problem.compound:
        raise InputError("criterion", problem.criterion, "test_pose or worst_pose, the criteria in metres")
    plan_space(replace(problem, configurations=max(problem.configurations, smallest_size(problem))))
