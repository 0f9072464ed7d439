# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Section 5: the two-link arm of Table 1 and of Figs 2 and 3.

Its closed form, beside which the library's numbers stand, follows from

    ρ0²/σ² = 2 (m − cos q20 · S) / (m² − S²),   S = Σ cos q2i                       (18)

for Π = (Δl1, Δl2) or (Δq1, Δq2). The derivative in S is zero at S* = m (1 − |sin q20|) / cos q20, eq. (19), which
leaves ρ0²/σ² = (1 + |sin q20|) / m, eq. (20).

*Table 1* says how much the test-pose criterion gains over D-optimality with m = 2. Three sources stand beside
each other: the print, the closed form (20), and the library: the planner's own plan with its proven lower bound,
and the D-optimal plan put into eq. (14).

*Figs 2 and 3* show a hundred simulated calibrations with each of three plans, which are the paper's. Beside them
stand the plan that the planner makes for the same problem and the bound that no plan of as many measurements can
beat. Fig. 2 identifies the link lengths from two measurements; its plan c is (19), its plan b D-optimal. Fig. 3
identifies lengths and joint offsets from three measurements. Its hypothesis is that (18)–(20) hold for all four
parameters. They do, with twice the variance, for plans with Σ sin q2i = 0 such as its three. Among other plans
there are better ones: m measurements at the test pose itself leave 2σ²/m there, and by the bound no plan leaves
less.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.planning import PlanProblem, Search, plan
from calib_planner.robot import Robot
from calib_planner_paper import printed
from calib_planner_paper.calibrations import Calibrations, Laboratory, calibrate, error_covariance


def two_link(parameters: str) -> Robot:
    """The arm of eq. (16), l1 = 1 m, l2 = 0.8 m, with these parameters active."""
    return Robot.load("planar_2r").with_parameters(parameters)


def bent(degrees: tuple[float, ...]) -> FloatArray:
    """(m, 2) configurations (0, q2i) [rad] for angles q2i [°]."""
    return np.radians([[0.0, angle] for angle in degrees])


LENGTHS = "l1,l2"
CONFIGURATIONS = 2
"""m of Table 1."""
D_OPTIMAL = bent((-90.0, 90.0))
"""S = Σ cos q2i = 0."""
HALF_A_DIGIT = 0.005
"""A printed variance further from the closed form than this is not its rounding."""
TEST_POSE = np.radians([-45.0, 20.0])
SIGMA = 1e-3
"""Of Figs 2 and 3: (2,) [rad] and standard deviation of one coordinate [m]."""


# ── Table 1 ──────────────────────────────────────────────────────────────────────────────────────────


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
    def angle(self) -> str:
        """``q20`` as the table's heading."""
        return f"{np.degrees(self.q20):.0f}°"

    @property
    def gain(self) -> float:
        """ρ_D/ρ0 − 1 of the plans computed here."""
        return float(np.sqrt(self.d_optimal / self.planned) - 1)

    @property
    def misprinted(self) -> bool:
        """Whether the printed variance is not the closed form's, rounded."""
        return abs(self.printed - self.closed_form) > HALF_A_DIGIT


@dataclass(frozen=True)
class Table1:
    """The columns, in the paper's order."""

    columns: tuple[Column, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers; ``q20`` in rad, gains as shares."""
        columns = [{**vars(c), "gain": c.gain, "misprinted": c.misprinted} for c in self.columns]
        return {"configurations": CONFIGURATIONS, "columns": columns}


def table_1(seed: int) -> Table1:
    """Plan for every test pose of the table by the paper's plain criterion, with σ = 1."""
    robot, columns = two_link(LENGTHS), []
    rows = zip(printed.TABLE_1_ANGLES, printed.TABLE_1_VARIANCE, printed.TABLE_1_GAIN, strict=True)
    for angle, variance, gain in rows:
        pose = np.array([0.0, np.radians(angle)])
        search = Search(general_weight=0.0, starts=16, seed=seed)
        problem = PlanProblem(robot, pose, CONFIGURATIONS, noise=1.0, search=search)
        best = plan(problem, prove=True)
        columns.append(
            Column(
                q20=float(pose[1]),
                printed=variance,
                printed_gain=gain / 100,
                closed_form=float((1 + abs(np.sin(pose[1]))) / CONFIGURATIONS),  # (20)
                planned=best.quality.predicted_accuracy**2,
                lower_bound=best.quality.lower_bound**2,
                bound=best.quality.bound,
                d_optimal=float(np.trace(error_covariance(robot, D_OPTIMAL, 1, pose, 1.0))),
            )
        )
    return Table1(tuple(columns))


# ── Figs 2 and 3 ─────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class FigureSettings:
    """One of the two figures, as the paper describes it.

    Attributes:
        number: The paper's.
        parameters: What is identified.
        angles: q2 of each configuration of plans a, b (D-optimal) and c (19) [°]; q1 = 0.
        printed_gains: What the paper says c gains over a and over b.
    """

    number: int
    parameters: str
    angles: tuple[tuple[float, ...], ...]
    printed_gains: tuple[float, float]


FIGURE_2 = FigureSettings(2, LENGTHS, ((-10.0, 10.0), (-90.0, 90.0), (-46.0, 46.0)), printed.FIGURE_2_GAINS)
FIGURE_3 = FigureSettings(
    3,
    "lengths+offsets",
    ((-10.0, 0.0, 10.0), (-120.0, 0.0, 120.0), (-57.0, 0.0, 57.0)),
    printed.FIGURE_3_GAINS,
)


@dataclass(frozen=True)
class Gain:
    """What plan c gains over another, 1 − ρ_c/ρ.

    Attributes:
        over: The other plan.
        printed: What the paper says.
        expected: By eq. (14).
        simulated: From the simulated calibrations.
        standard_error: Of ``simulated``.
    """

    over: str
    printed: float
    expected: float
    simulated: float
    standard_error: float


@dataclass(frozen=True, eq=False)
class TwoLinkFigure:
    """The figure's numbers.

    Attributes:
        settings: Which figure it is.
        plans: Plans a, b and c.
        planned: ρ0 of the planner's plan for the same problem [m].
        planned_configurations: That plan, (m, 2) [rad].
        lower_bound: No plan of as many measurements is below [m].
        bound: ``"proven"`` or ``"numerical"``.
    """

    settings: FigureSettings
    plans: tuple[Calibrations, ...]
    planned: float
    planned_configurations: FloatArray
    lower_bound: float
    bound: str

    def gains(self) -> list[Gain]:
        """What c gains over a and over b."""
        *others, c = self.plans
        gains = []
        for other, value in zip(others, self.settings.printed_gains, strict=True):
            expected, simulated = c.expected / other.expected, c.simulated / other.simulated
            relative = np.hypot(c.standard_error / c.expected, other.standard_error / other.expected)
            gains.append(Gain(other.label, value, 1 - expected, 1 - simulated, float(expected * relative)))
        return gains

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers [m, rad]."""
        return {
            "parameters": list(two_link(self.settings.parameters).parameter_names),
            "test_pose": TEST_POSE.tolist(),
            "sigma": SIGMA,
            "plans": [p.to_dict() for p in self.plans],
            "gains": [vars(gain) for gain in self.gains()],
            "planned": {
                "expected": self.planned,
                "lower_bound": self.lower_bound,
                "bound": self.bound,
                "configurations": self.planned_configurations.tolist(),
            },
        }


def two_link_figure(settings: FigureSettings, count: int, seed: int) -> TwoLinkFigure:
    """Simulate ``count`` calibrations with each plan, and plan for the same problem."""
    robot = two_link(settings.parameters)
    laboratory = Laboratory(robot, TEST_POSE, SIGMA, count, seed)
    plans = [
        calibrate(laboratory, name, bent(angles), 1, 10 * settings.number + k)
        for k, (name, angles) in enumerate(zip("abc", settings.angles, strict=True))
    ]
    search = Search(starts=16, seed=seed)
    best = plan(PlanProblem(robot, TEST_POSE, len(settings.angles[0]), noise=SIGMA, search=search), prove=True)
    accuracy, bound = best.quality.predicted_accuracy, best.quality.lower_bound
    return TwoLinkFigure(settings, tuple(plans), accuracy, best.configurations, bound, best.quality.bound)
