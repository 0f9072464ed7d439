"""The verb: ``plan(problem)`` → ``Plan``. Search, polish, order, bound."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.design.bound import relaxed_design
from calib_planner.design.criteria import LinearCriterion, accuracy_weight
from calib_planner.design.identifiability import Identifiability, analyse
from calib_planner.design.information import covariance, error_variance, information
from calib_planner.design.plan import STATUS, Plan
from calib_planner.design.problem import SAMPLE, PlanProblem, reachable_sample
from calib_planner.design.search.multistart import SearchResult, search
from calib_planner.robot.chain import Robot


@dataclass(frozen=True)
class Progress:
    """What a callback is told while the planner works.

    Attributes:
        starts_done, starts_total: Descents finished and asked for.
        best_accuracy: Best ρ0 so far [m]; infinite before the first.
        lower_bound: Bound so far [m]; 0 before it is known.
        seconds: Time spent.
    """

    starts_done: int
    starts_total: int
    best_accuracy: float
    lower_bound: float
    seconds: float


def plan(problem: PlanProblem, callback: Callable[[Progress], bool | None] | None = None) -> Plan:
    """Find the best configurations, and a bound on how good any could be.

    Args:
        problem: What is asked.
        callback: Told of progress; returning ``True`` cancels, the best plan so far being returned.
    """
    clock = _Clock(problem, callback)
    rng = np.random.default_rng(problem.seed)
    space = _space(problem)
    share = problem.general_weight
    criterion = LinearCriterion((1.0 - share) * space.weight + share * space.general)
    robot, size = space.robot, problem.configurations
    found = search(robot, criterion, size, problem.starts, rng, clock.stop, clock.starts)
    bound = _bound(problem, space, found, rng, clock)
    return _assemble(problem, space, found, bound, clock)


@dataclass(frozen=True)
class _Space:
    """The problem in parameters that some plan can tell apart.

    Attributes:
        robot: The robot, active in those parameters only.
        identifiability: Which of the problem's parameters those are.
        test_jacobians: (K, 3·targets, r) at the test poses.
        weight: (r, r) matrix A of eq. (14).
        general: (r, r) the same for the whole workspace.
    """

    robot: Robot
    identifiability: Identifiability
    test_jacobians: FloatArray
    weight: FloatArray
    general: FloatArray


def _space(problem: PlanProblem) -> _Space:
    names = problem.robot.parameter_names
    sample = reachable_sample(problem.robot, SAMPLE)
    found = analyse(sample.reshape(-1, len(names)), names)
    kept = sorted(found.kept)
    robot = problem.robot.with_parameters([names[i] for i in kept])
    tests = robot.jacobian(problem.test_pose_array)
    return _Space(
        robot=robot,
        identifiability=found,
        test_jacobians=tests,
        weight=accuracy_weight(tests, problem.weight_array),
        general=accuracy_weight(sample[:, :, kept], np.ones(len(sample))),
    )


class _Clock:
    """Time limit, cancellation and progress in one place."""

    def __init__(self, problem: PlanProblem, callback: Callable[[Progress], bool | None] | None) -> None:
        self.began = time.perf_counter()
        self.deadline = self.began + problem.time_limit
        self.callback = callback
        self.cancelled = False
        self.late = False
        self.scale = problem.sigma / np.sqrt(problem.repetitions)
        self.last = Progress(0, problem.starts, float("inf"), 0.0, 0.0)

    def stop(self) -> bool:
        self.late = self.late or time.perf_counter() > self.deadline
        self.report(self.last)
        return self.late or self.cancelled

    def starts(self, done: int, total: int, log_value: float) -> None:
        accuracy = self.scale * float(np.exp(0.5 * log_value))
        self.report(Progress(done, total, accuracy, self.last.lower_bound, 0.0))

    def report(self, progress: Progress) -> None:
        self.last = Progress(
            progress.starts_done,
            progress.starts_total,
            progress.best_accuracy,
            progress.lower_bound,
            time.perf_counter() - self.began,
        )
        if self.callback is not None and self.callback(self.last):
            self.cancelled = True

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.began


def _bound(
    problem: PlanProblem, space: _Space, found: SearchResult, rng: np.random.Generator, clock: _Clock
) -> float:
    """Lower bound on ρ0 [m] for the plan's number of measurements."""
    start = np.concatenate([found.configurations, problem.test_pose_array])
    relaxed = relaxed_design(space.robot, space.weight, start, rng, clock.stop)
    total = problem.configurations * problem.repetitions
    return problem.sigma * float(np.sqrt(relaxed.bound / total))


def _assemble(problem: PlanProblem, space: _Space, found: SearchResult, bound: float, clock: _Clock) -> Plan:
    robot, sigma = space.robot, problem.sigma
    configurations = visiting_order(found.configurations, robot)
    repetitions = np.full(len(configurations), problem.repetitions)
    matrix = information(robot.jacobian(configurations), repetitions)
    per = sigma * np.sqrt([error_variance(j, matrix) for j in space.test_jacobians])
    weights = problem.weight_array / problem.weight_array.sum()
    accuracy = float(np.sqrt(weights @ per**2)) if np.isfinite(per).all() else float("inf")
    inverse, hidden = covariance(matrix)
    general = float("inf") if hidden.size else float(np.trace(space.general @ inverse))
    status = "cancelled" if clock.cancelled else "time_limit" if clock.late else "ok"
    status = "singular" if hidden.size and status == "ok" else status
    combinations = space.identifiability.combinations
    note = f" Not identifiable by any plan, held at nominal: {', '.join(combinations)}."
    return Plan(
        robot=robot.name,
        criterion=problem.criterion,
        parameters=problem.robot.parameter_names,
        joint_names=robot.joint_names,
        configurations=configurations,
        repetitions=repetitions,
        test_poses=problem.test_pose_array,
        weights=weights,
        sigma=sigma,
        predicted_accuracy=accuracy,
        predicted_accuracy_per_test_pose=per,
        parameter_std=sigma * _parameter_deviations(space, inverse, hidden),
        unidentifiable=combinations,
        general_accuracy=sigma * float(np.sqrt(general)),
        lower_bound=bound,
        efficiency=bound / accuracy if np.isfinite(accuracy) else 0.0,
        bound="numerical",
        status=status,
        message=STATUS[status] + (note if combinations else ""),
        seconds=clock.seconds,
        seed=problem.seed,
        starts=found.starts,
        evaluations=found.evaluations,
    )


def _parameter_deviations(space: _Space, inverse: FloatArray, hidden: FloatArray) -> FloatArray:
    """(P,) standard deviations for σ = 1: infinite where this plan is blind, NaN where every plan is."""
    kept = sorted(space.identifiability.kept)
    unseen = (np.abs(hidden) > 1e-6).any(axis=1) if hidden.size else np.zeros(len(kept), bool)
    std = np.full(len(kept) + len(space.identifiability.held), np.nan)
    std[kept] = np.where(unseen, np.inf, np.sqrt(np.diag(inverse)))
    return std


def visiting_order(configurations: FloatArray, robot: Robot) -> FloatArray:
    """The same rows in an order with little joint travel: nearest neighbour, then 2-opt, from mid-range."""
    scale = np.diff(robot.joint_limits, axis=1)[:, 0]
    scaled = configurations / scale
    home = robot.joint_limits.mean(axis=1) / scale
    points = np.vstack([home, scaled])
    distance = np.abs(points[:, None] - points[None]).max(axis=2)
    left = set(range(1, len(points)))
    tour = [0]
    while left:
        last = tour[-1]
        tour.append(min(left, key=lambda i: (distance[last, i], i)))
        left.remove(tour[-1])
    improved = len(tour) <= 200
    while improved:
        improved = False
        for i in range(1, len(tour) - 1):
            for j in range(i + 1, len(tour)):
                tail = (
                    distance[tour[i], tour[j + 1]] - distance[tour[j], tour[j + 1]]
                    if j + 1 < len(tour)
                    else 0
                )
                gain = distance[tour[i - 1], tour[j]] - distance[tour[i - 1], tour[i]] + tail
                if gain < -1e-12:
                    tour[i : j + 1] = tour[i : j + 1][::-1]
                    improved = True
    return configurations[np.array(tour[1:]) - 1]
