"""What Figs 2 and 3 are: three plans for the two-link arm and a hundred simulated calibrations with each.

The plans are the paper's; beside them stands what the planner finds for the same problem, and the bound that no
plan of as many measurements can beat.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.design.planner import plan
from calib_planner.design.problem import PlanProblem
from calib_planner.report.reproduction.calibrations import Calibrations, Laboratory, calibrate
from calib_planner.report.reproduction.two_link import bent, two_link

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
    problem = PlanProblem(robot, TEST_POSE, len(settings.angles[0]), sigma=SIGMA, starts=16, seed=seed)
    found = plan(problem, prove=True)
    return TwoLinkFigure(
        settings, (a, b, c), found.predicted_accuracy, found.configurations, found.lower_bound, found.bound
    )
