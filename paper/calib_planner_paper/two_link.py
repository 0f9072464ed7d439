"""Section 5, the two-link arm. Its closed form (20), beside which the library's numbers stand, follows from

    ρ0²/σ² = 2 (m − cos q20 · S) / (m² − S²),   S = Σ cos q2i                       (18)

for Π = (Δl1, Δl2) or (Δq1, Δq2): the slope in S is zero at S* = m (1 − |sin q20|) / cos q20, eq. (19).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.planning import Plan, PlanProblem, Search, plan
from calib_planner.robot import Robot
from calib_planner_paper import printed
from calib_planner_paper.calibrations import Calibrations, Laboratory, calibrate, error_covariance

LENGTHS = "l1,l2"
ALL_FOUR = "lengths+offsets"


def two_link(parameters: str) -> Robot:
    """The arm of eq. (16), l1 = 1 m, l2 = 0.8 m, with these parameters active."""
    return Robot.load("planar_2r").with_parameters(parameters)


def bent(degrees: tuple[float, ...]) -> FloatArray:
    """(m, 2) configurations (0, q2i) [rad] for angles q2i [°]."""
    return np.radians([[0.0, angle] for angle in degrees])


def least_variance(m: int, q20: float) -> float:
    """ρ0²/σ² of eq. (20), the least that m measurements reach; q20 [rad]."""
    return float((1 + abs(np.sin(q20))) / m)


# ── Table 1: how much the test-pose criterion gains over D-optimality on the two-link arm, m = 2 ────────────
# Three sources stand beside each other: the print, the closed form (20), and the library — the planner's own plan
# with its proven lower bound, and the D-optimal plan put into eq. (14).

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
        planned=found.quality.predicted_accuracy**2,
        lower_bound=found.quality.lower_bound**2,
        bound=found.quality.bound,
        d_optimal=float(np.trace(error_covariance(two_link(LENGTHS), D_OPTIMAL, 1, pose, 1.0))),
    )


def _plan(q20: float, seed: int) -> Plan:
    """The paper's plain criterion with σ = 1."""
    problem = PlanProblem(
        two_link(LENGTHS),
        [0.0, q20],
        CONFIGURATIONS,
        noise=1.0,
        search=Search(general_weight=0.0, starts=16, seed=seed),
    )
    return plan(problem, prove=True)


# ── What Figs 2 and 3 are: three plans for the two-link arm and a hundred simulated calibrations with each ───
# The plans are the paper's; beside them stands what the planner finds for the same problem, and the bound that no
# plan of as many measurements can beat.

TEST_POSE = np.radians([-45.0, 20.0])
SIGMA = 1e-3


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


def _gain(best: Calibrations, other: Calibrations, printed: float) -> Gain:
    expected, simulated = best.expected / other.expected, best.simulated / other.simulated
    relative = np.hypot(best.standard_error / best.expected, other.standard_error / other.expected)
    return Gain(other.label, printed, 1 - expected, 1 - simulated, float(expected * relative))


@dataclass(frozen=True, eq=False)
class TwoLinkFigure:
    """The figure's numbers.

    Attributes:
        settings: What was asked.
        plans: Plans a, b and c.
        planned: ρ0 of the planner's plan for the same problem [m].
        planned_configurations: That plan, (m, 2) [rad].
        lower_bound: No plan of as many measurements is below [m].
        bound: ``"proven"`` or ``"numerical"``.
    """

    settings: FigureSettings
    plans: tuple[Calibrations, Calibrations, Calibrations]
    planned: float
    planned_configurations: FloatArray
    lower_bound: float
    bound: str

    def gains(self) -> tuple[Gain, Gain]:
        """What c gains over a and over b."""
        a, b = (
            _gain(self.plans[2], other, value)
            for other, value in zip(self.plans[:2], self.settings.printed_gains, strict=True)
        )
        return a, b

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
    first = 10 * settings.number
    a, b, c = (
        calibrate(laboratory, name, bent(angles), 1, first + k)
        for k, (name, angles) in enumerate(zip("abc", settings.angles, strict=True))
    )
    problem = PlanProblem(
        robot, TEST_POSE, len(settings.angles[0]), noise=SIGMA, search=Search(starts=16, seed=seed)
    )
    best = plan(problem, prove=True)
    accuracy, bound = best.quality.predicted_accuracy, best.quality.lower_bound
    return TwoLinkFigure(settings, (a, b, c), accuracy, best.configurations, bound, best.quality.bound)


# ── Fig. 2: the link lengths of the two-link arm from two measurements. Plan c is (19), plan b D-optimal ────

FIGURE_2 = FigureSettings(
    number=2,
    parameters=LENGTHS,
    angles=((-10.0, 10.0), (-90.0, 90.0), (-46.0, 46.0)),
    printed_gains=printed.FIGURE_2_GAINS,
)


# ── Fig. 3: lengths and joint offsets of the two-link arm from three measurements ───────────────────────────
# The paper's hypothesis is that (18)–(20) hold for all four parameters. They do, with twice the variance, for
# plans with Σ sin q2i = 0 such as its three. Among other plans there are better ones: m measurements at the test
# pose itself leave 2σ²/m there, and the bound says that nothing is below.

FIGURE_3 = FigureSettings(
    number=3,
    parameters=ALL_FOUR,
    angles=((-10.0, 0.0, 10.0), (-120.0, 0.0, 120.0), (-57.0, 0.0, 57.0)),
    printed_gains=printed.FIGURE_3_GAINS,
)
