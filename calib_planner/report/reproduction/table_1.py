"""Table 1: how much the test-pose criterion gains over D-optimality on the two-link arm, m = 2.

Three sources stand beside each other: the print, the closed form (20), and the library — the planner's own plan
with its proven lower bound, and the D-optimal plan put into eq. (14).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner.design.plan import Plan
from calib_planner.design.planner import plan
from calib_planner.design.problem import PlanProblem
from calib_planner.report.reproduction import printed
from calib_planner.report.reproduction.calibrations import error_covariance
from calib_planner.report.reproduction.two_link import LENGTHS, bent, least_variance, two_link

CONFIGURATIONS = 2
D_OPTIMAL = bent((-90.0, 90.0))
"""S = Σ cos q2i = 0."""
HALF_A_DIGIT = 0.005
"""A printed variance further from the closed form than this is not its rounding."""


@dataclass(frozen=True)
class Column:
    """One test pose; variances are ρ²/σ².

    Attributes:
        q20: Elbow angle of the test pose [rad].
        printed: What the paper prints.
        printed_gain: ρ_D/ρ0 − 1 that the paper prints.
        closed_form: By eq. (20).
        planned: Of the planner's plan, eq. (14).
        lower_bound: No plan of two measurements is below.
        bound: ``"proven"`` or ``"numerical"``.
        d_optimal: Of the D-optimal plan, eq. (14).
    """

    q20: float
    printed: float
    printed_gain: float
    closed_form: float
    planned: float
    lower_bound: float
    bound: str
    d_optimal: float

    @property
    def gain(self) -> float:
        """ρ_D/ρ0 − 1 of the plans computed here."""
        return float(np.sqrt(self.d_optimal / self.planned) - 1)

    @property
    def misprinted(self) -> bool:
        """Whether the printed variance is not the closed form's, rounded."""
        return abs(self.printed - self.closed_form) > HALF_A_DIGIT

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers; ``q20`` in rad, gains as shares."""
        return {**vars(self), "gain": self.gain, "misprinted": self.misprinted}


@dataclass(frozen=True)
class Table1:
    """The columns, in the paper's order."""

    columns: tuple[Column, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        return {"configurations": CONFIGURATIONS, "columns": [c.to_dict() for c in self.columns]}


def table_1(seed: int) -> Table1:
    """Plan for every test pose of the table."""
    rows = zip(printed.TABLE_1_ANGLES, printed.TABLE_1_VARIANCE, printed.TABLE_1_GAIN, strict=True)
    return Table1(tuple(_column(np.radians(angle), v, gain / 100, seed) for angle, v, gain in rows))


def _column(q20: float, variance: float, gain: float, seed: int) -> Column:
    found = _plan(q20, seed)
    pose = np.array([0.0, q20])
    return Column(
        q20=float(q20),
        printed=variance,
        printed_gain=gain,
        closed_form=least_variance(CONFIGURATIONS, q20),
        planned=found.predicted_accuracy**2,
        lower_bound=found.lower_bound**2,
        bound=found.bound,
        d_optimal=float(np.trace(error_covariance(two_link(LENGTHS), D_OPTIMAL, 1, pose, 1.0))),
    )


def _plan(q20: float, seed: int) -> Plan:
    """The paper's plain criterion with σ = 1."""
    problem = PlanProblem(
        two_link(LENGTHS), [0.0, q20], CONFIGURATIONS, sigma=1.0, general_weight=0.0, starts=16, seed=seed
    )
    return plan(problem, prove=True)
