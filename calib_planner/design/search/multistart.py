"""The best plan over continuous configurations: many descents of log ρ0² from seeded starts.

Gradient. For a plan with Jacobians J_i and M = Σ J_iᵀJ_i, the slope Φ = ∂φ/∂M gives ∂φ/∂J_i = 2 J_i Φ, which
``Linearisation.pull_back`` turns into ∂φ/∂q_i: the whole gradient costs about as much as the value.

Starts. Random configurations within the limits; and, because eq. (20) and the paper's Table 2 show that good
plans are made of a few good configurations repeated, the best small plans found first are tiled to the
size asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.design.criteria import LinearCriterion
from calib_planner.design.search.descent import Objective, descend
from calib_planner.robot.chain import Robot

RIDGE = 1e-12
"""Added to the scaled information of a plan, relative to its trace, so that singular plans stay finite."""


@dataclass(frozen=True)
class SearchResult:
    """Best configurations found, (m, joints), their criterion value, and the work it took."""

    configurations: FloatArray
    value: float
    starts: int
    evaluations: int


def plan_objective(robot: Robot, criterion: LinearCriterion, size: int) -> Objective:
    """log criterion and gradient of plans given as rows of ``size``·joints coordinates."""
    parameters = len(robot.parameter_names)
    targets = len(robot.targets)
    zero = np.zeros(parameters)

    def objective(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        plans = len(rows)
        lin = robot._linearise(rows.reshape(plans * size, -1), zero)
        jacobian = lin.jacobian().reshape(plans, size * 3 * targets, parameters)
        matrix = jacobian.transpose(0, 2, 1) @ jacobian
        diagonal = np.einsum("spp->sp", matrix)
        diagonal += RIDGE * diagonal.mean(axis=1, keepdims=True)
        value, slope = criterion.value_and_slope(matrix)
        value = np.where(value > 0, value, np.inf)
        pull = 2.0 * (jacobian @ (slope / value[:, None, None]))
        weights = pull.reshape(plans * size, 3 * targets, parameters).transpose(2, 1, 0)
        gradient = lin.pull_back(weights.reshape(parameters, targets, 3, plans * size))
        return np.log(value), gradient.reshape(plans, -1)

    return objective


def search(
    robot: Robot,
    criterion: LinearCriterion,
    size: int,
    starts: int,
    rng: np.random.Generator,
    stop: Callable[[], bool],
    progress: Callable[[int, int, float], None] = lambda done, total, best: None,
) -> SearchResult:
    """Find a plan of ``size`` configurations that minimises the criterion.

    Args:
        stop: Asked between iterations; ``True`` returns the best so far.
        progress: Called with starts done, starts in all and the best log value so far.
    """
    low, high = robot.joint_limits.T
    parameters = len(robot.parameter_names)
    smallest = max(-(-parameters // (3 * len(robot.targets))), 1)
    kernel_sizes = [k for k in (smallest, smallest + 1) if k < size]
    shares = len(kernel_sizes) + 1
    evaluations, done = 0, 0
    seeds: list[FloatArray] = []
    for k in kernel_sizes:
        count = max(starts // shares, 1)
        kernel = _descend_from(robot, criterion, k, _random(rng, low, high, count, k), stop, 100)
        evaluations += kernel.evaluations
        done += count
        order = np.argsort(kernel.value)[: max(4, count // 8)]
        seeds += [_tile(kernel.x[i].reshape(k, -1), size, rng, low, high) for i in order]
        progress(done, starts, float(kernel.value[order[0]] - np.log(size / k)))
    count = max(starts - done, 1)
    fresh = _random(rng, low, high, count, size)
    rows = np.concatenate([np.reshape(seeds, (-1, size, len(low))), fresh])
    final = _descend_from(robot, criterion, size, rows, stop, 150)
    best = int(np.argmin(final.value))
    progress(starts, starts, float(final.value[best]))
    return SearchResult(
        final.x[best].reshape(size, -1),
        float(np.exp(final.value[best])),
        done + count,
        evaluations + final.evaluations,
    )


def _descend_from(robot, criterion, size, rows, stop, iterations):  # type: ignore[no-untyped-def]
    low, high = robot.joint_limits.T
    return descend(
        plan_objective(robot, criterion, size),
        rows.reshape(len(rows), -1),
        np.tile(low, size),
        np.tile(high, size),
        iterations=iterations,
        tolerance=1e-6,
        stop=stop,
    )


def _random(rng: np.random.Generator, low: FloatArray, high: FloatArray, count: int, size: int) -> FloatArray:
    return rng.uniform(low, high, (count, size, len(low)))


def _tile(
    kernel: FloatArray, size: int, rng: np.random.Generator, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Repeat a small plan to ``size`` rows, moved a little so that copies can drift apart."""
    rows = np.resize(np.arange(len(kernel)), size)
    return np.clip(kernel[rows] + rng.normal(0.0, 0.02, (size, kernel.shape[1])), low, high)
