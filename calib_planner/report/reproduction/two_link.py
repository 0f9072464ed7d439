"""Section 5, the two-link arm. Its closed form (20), beside which the library's numbers stand, follows from

    ρ0²/σ² = 2 (m − cos q20 · S) / (m² − S²),   S = Σ cos q2i                       (18)

for Π = (Δl1, Δl2) or (Δq1, Δq2): the slope in S is zero at S* = m (1 − |sin q20|) / cos q20, eq. (19).
"""

from __future__ import annotations

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.robot.chain import Robot

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
