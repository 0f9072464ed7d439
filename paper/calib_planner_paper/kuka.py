# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The KUKA KR 270 of section 6: Table 2, random and proposed plans with their bound, and Fig. 5, calibrations.

The paper gives neither test pose nor link lengths nor workspace, so three test poses and a workspace are chosen
here; the first test pose is the table's, the others show what depends on that choice.

Three computations make five columns: repeating every measurement r times divides ρ0 of any plan by √r, eq. (14),
and so it divides the best plan's, the bound, and every statistic of the same random plans.

With three configurations there are just nine equations for nine parameters. det J changes sign within the
workspace, and near where it does ρ0 grows like 1/|det J|: the share of random plans worse than t falls only like
1/t, which has no mean. Maximum and mean of that column depend on chance; its median can be compared.

Every plan of Fig. 5 has 12 measurements: 12 random configurations, three proposed ones measured four times, four
measured three times, and twelve. The random plan is the one with the median ρ0 of a hundred and one, so that
chance did not favour it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray, frozen, plain
from calib_planner.planning import Plan, PlanProblem, Search, WorkspaceBox, plan, plan_space, random_accuracies
from calib_planner.robot import Robot
from calib_planner_paper import printed
from calib_planner_paper.calibrations import Calibrations, Laboratory, calibrate, error_covariance

ROBOT = "kuka_kr270"
SIGMA = 3e-5
"""FARO laser tracker, section 6 [m]."""
WORKSPACE = WorkspaceBox([0.6, -1.5, 0.2], [2.6, 1.5, 2.4])
"""In front of the robot, in its base frame [m]; the reflector is at the flange."""
SEPARATE = tuple(m for m, r in printed.SIZES if r == 1)
"""Numbers of configurations that have to be computed."""

SUMMARY = (
    "configurations",
    "predicted_accuracy",
    "lower_bound",
    "efficiency",
    "bound",
    "general_accuracy",
    "status",
)
"""What ``tables.json`` holds of a plan."""

Rows = Mapping[str, tuple[float, ...]]
"""Row of the table → values by column of ``printed.SIZES``."""


@dataclass(frozen=True)
class ChosenPose:
    """A test pose that was chosen here, and why.

    Attributes:
        name: A letter.
        degrees: Joint coordinates [°].
        why: What it stands for.
        starts: Random starts of the search for it.
    """

    name: str
    degrees: tuple[float, ...]
    why: str
    starts: int = 48

    @property
    def configuration(self) -> FloatArray:
        """(joints,) [rad]."""
        return np.radians(self.degrees)


TEST_POSES = (
    ChosenPose("A", (0, -60, 90, 0, 45, 0), "arm leaning forward, forearm level, wrist bent, in mid-workspace"),
    ChosenPose("B", (30, -45, 100, 0, -55, 0), "off to the side and lower, wrist bent the other way"),
    ChosenPose("C", (10, -100, 60, 90, 90, 0), "above the workspace: it cannot be measured itself", 8),
)


@dataclass(frozen=True, eq=False)
class Table2:
    """The table for one test pose.

    Attributes:
        pose: The test pose.
        inside: Whether it is in the workspace, so that it can be measured itself.
        plans: m → the planner's plan of m configurations, measured once.
        random: m → (count,) ρ0 of random plans of m configurations [m], ascending.
    """

    pose: ChosenPose
    inside: bool
    plans: dict[int, Plan]
    random: dict[int, FloatArray]

    def rows(self) -> Rows:
        """Row → ρ0 [m] by column of ``printed.SIZES``."""
        statistics: dict[str, Callable[[int], float]] = {
            "random, max": lambda m: float(self.random[m][-1]),
            "random, min": lambda m: float(self.random[m][0]),
            "random, mean": lambda m: float(self.random[m].mean()),
            "random, median": lambda m: float(np.median(self.random[m])),
            "proposed": lambda m: self.plans[m].quality.predicted_accuracy,
            "lower bound": lambda m: self.plans[m].quality.lower_bound,
        }
        return {row: tuple(of(m) / r**0.5 for m, r in printed.SIZES) for row, of in statistics.items()}

    def scaled(self) -> Rows:
        """``rows`` over the proposed plan of 12 configurations: what can be compared with the paper."""
        return scaled(self.rows())

    def tail(self, m: int) -> float:
        """Ratio of the quantiles that 0.1 % and 1 % of the random plans exceed: 10 where ρ0 has no mean."""
        rare, frequent = np.quantile(self.random[m], [0.999, 0.99])
        return float(rare / frequent)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers [m, rad]; what is not finite becomes ``None``."""
        values: dict[str, Any] = plain(
            {
                "test_pose": self.pose.configuration,
                "why": self.pose.why,
                "measurable": self.inside,
                "rows": self.rows(),
                "scaled": self.scaled(),
                "tail": {str(m): self.tail(m) for m in SEPARATE},
                "plans": {str(m): {key: one.values()[key] for key in SUMMARY} for m, one in self.plans.items()},
            }
        )
        return values


def scaled(rows: Rows) -> Rows:
    """Rows over their own proposed plan of 12 configurations."""
    unit = rows["proposed"][printed.SIZES.index((12, 1))]
    return {row: tuple(value / unit for value in values) for row, values in rows.items()}


def table_2(pose: ChosenPose, random_plans: int, seed: int) -> Table2:
    """Plan and draw for every number of configurations."""
    plans, random = {}, {}
    for m in SEPARATE:
        problem = kuka_problem(pose, m, seed=seed)
        plans[m] = plan(problem, prove=True)
        drawn = random_accuracies(plan_space(problem), random_plans, np.random.default_rng([seed, m]))
        random[m] = frozen(np.sort(drawn))
    inside = bool(WORKSPACE.allowed(Robot.load(ROBOT), pose.configuration[None])[0])
    return Table2(pose, inside, plans, random)


def kuka_problem(pose: ChosenPose, configurations: int, repetitions: int = 1, *, seed: int) -> PlanProblem:
    """The planner's problem for one column."""
    return PlanProblem(
        Robot.load(ROBOT),
        pose.configuration,
        configurations,
        repetitions,
        noise=SIGMA,
        constraints=(WORKSPACE,),
        search=Search(starts=pose.starts, seed=seed),
    )


# ── Fig. 5 ───────────────────────────────────────────────────────────────────────────────────────────

MEASUREMENTS = 12
DRAWN = 101
"""Random plans of which the median one is simulated."""


@dataclass(frozen=True, eq=False)
class Figure5:
    """The figure's numbers.

    Attributes:
        plans: Random, 3×4, 4×3 and 12.
    """

    plans: tuple[Calibrations, ...]

    @property
    def gain(self) -> float:
        """ρ_random/ρ_proposed − 1 by eq. (14), mean over the proposed plans; the paper says about 75 %."""
        random, *proposed = (p.expected for p in self.plans)
        return float(np.mean([random / p - 1 for p in proposed]))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers [m, rad]."""
        plans = [{**p.to_dict(), "printed": printed.FIGURE_5[p.label]} for p in self.plans]
        return {"plans": plans, "gain": self.gain}


def figure_5(table: Table2, count: int, seed: int) -> Figure5:
    """Simulate ``count`` calibrations with a random plan and with those of ``table``."""
    problem = kuka_problem(table.pose, MEASUREMENTS, seed=seed)
    laboratory = Laboratory(problem.robot, table.pose.configuration, SIGMA, count, seed)
    work = [("random", ordinary_plan(table, seed), 1)]
    for (m, r), label in zip(printed.SIZES, printed.LABELS, strict=True):
        if m * r == MEASUREMENTS:
            work.append((label, table.plans[m].configurations, r))
    return Figure5(tuple(calibrate(laboratory, label, q, r, 50 + k) for k, (label, q, r) in enumerate(work)))


def ordinary_plan(table: Table2, seed: int) -> FloatArray:
    """(12, joints) the random plan with the median ρ0 of ``DRAWN`` [rad]."""
    problem = kuka_problem(table.pose, MEASUREMENTS, seed=seed)
    rng = np.random.default_rng([seed, 5])
    drawn = plan_space(problem).feasibility.sample(rng, DRAWN * MEASUREMENTS).reshape(DRAWN, MEASUREMENTS, -1)
    pose = table.pose.configuration
    variances = [np.trace(error_covariance(problem.robot, q, 1, pose, SIGMA)) for q in drawn]
    return np.asarray(drawn[int(np.argsort(variances)[DRAWN // 2])])
