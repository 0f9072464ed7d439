"""Section 5, the two-link arm: the paper's closed forms, eqs. (18)–(20).

For Π = (Δl1, Δl2) or (Δq1, Δq2), with S = Σ cos q2i over m configurations,

    ρ0²/σ² = 2 (m − cos q20 · S) / (m² − S²)                                        (18)
    S*     = m (1 − |sin q20|) / cos q20,  0 where cos q20 = 0                      (19)
    ρ0²/σ² = (1 + |sin q20|) / m  at S*;  2/m  at S = 0, the D-optimal plans        (20)
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


def variance(q2: FloatArray, q20: float) -> float:
    """ρ0²/σ² of eq. (18) for angles q2 (m,) and the test pose's q20 [rad]."""
    m, s = len(q2), float(np.cos(q2).sum())
    return float(2 * (m - np.cos(q20) * s) / (m**2 - s**2))


def least_variance(m: int, q20: float) -> float:
    """ρ0²/σ² of eq. (20), the least that m measurements reach; q20 [rad]."""
    return float((1 + abs(np.sin(q20))) / m)


def d_optimal_variance(m: int) -> float:
    """ρ0²/σ² of D-optimal plans, S = 0 in eq. (18)."""
    return 2 / m
