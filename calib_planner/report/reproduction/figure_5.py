"""Fig. 5: simulated calibrations of the KUKA KR 270 with a random plan and with three proposed ones.

Every plan has 12 measurements: 12 random configurations, three proposed ones measured four times, four measured
three times, and twelve. The random plan is the median one of a hundred and one, so that its luck is ordinary.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.design.space import plan_space
from calib_planner.report.reproduction import printed
from calib_planner.report.reproduction.calibrations import Calibrations, Laboratory, calibrate, error_covariance
from calib_planner.report.reproduction.table_2 import SIGMA, Table2, kuka_problem

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
    for m, r in printed.SIZES:
        if m * r == MEASUREMENTS:
            work.append((str(m) if r == 1 else f"{m}×{r}", table.plans[m].configurations, r))
    return Figure5(
        tuple(calibrate(laboratory, label, q, r, 50 + k) for k, (label, q, r) in enumerate(work)),
    )


def ordinary_plan(table: Table2, seed: int) -> FloatArray:
    """(12, joints) the random plan with the median ρ0 of ``DRAWN`` [rad]."""
    problem = kuka_problem(table.pose, MEASUREMENTS, seed=seed)
    rng = np.random.default_rng([seed, 5])
    drawn = plan_space(problem).feasibility.sample(rng, DRAWN * MEASUREMENTS).reshape(DRAWN, MEASUREMENTS, -1)
    pose = table.pose.configuration
    worth = [np.trace(error_covariance(problem.robot, q, 1, pose, SIGMA)) for q in drawn]
    return np.asarray(drawn[int(np.argsort(worth)[DRAWN // 2])])
