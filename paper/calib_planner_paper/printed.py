# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the paper prints, so that it can be shown beside what is computed. Nothing here enters a computation.

A. Klimchik, A. Pashkevich, Y. Wu, B. Furet, S. Caro: Optimization of measurement configurations for geometrical
calibration of industrial robot. Lengths are in metres; the paper prints Table 2 and Fig. 5 in µm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

TABLE_1_ANGLES = (0, 30, 60, 90, 120, 150, 180)
"""q20 [°] of the columns."""
TABLE_1_VARIANCE = (0.5, 0.75, 0.83, 1.0, 0.83, 0.75, 0.5)
"""ρ0²/σ² for m = 2."""
TABLE_1_GAIN = (41, 15, 10, 0, 10, 15, 41)
"""ρ_D/ρ0 − 1 [%]."""

FIGURE_2_GAINS = (0.48, 0.18)
"""1 − ρ_c/ρ_a and 1 − ρ_c/ρ_b."""
FIGURE_3_GAINS = (0.56, 0.18)
"""The same for Fig. 3."""

SIZES = ((3, 1), (4, 1), (3, 4), (4, 3), (12, 1))
"""(configurations, measurements at each) of the columns of Table 2."""
LABELS = tuple(str(m) if r == 1 else f"{m}×{r}" for m, r in SIZES)
"""The headings of these columns."""

TABLE_2 = {
    "random, max": (47.1, 8078e-6, 23.6, 2693e-6, 144e-6),
    "random, min": (101e-6, 76.2e-6, 50.0e-6, 44.0e-6, 44.3e-6),
    "random, mean": (0.49, 375e-6, 0.24, 217e-6, 67.2e-6),
    "proposed": (63.7e-6, 52.1e-6, 31.9e-6, 30.1e-6, 30.0e-6),
}
"""ρ0 [m] by column of ``SIZES``; Table 2 gives the first column's 47.1·10⁶ µm and 0.49·10⁶ µm as such."""

FIGURE_5 = {"random": 52.7e-6, "3×4": 32.7e-6, "4×3": 30.3e-6, "12": 29.8e-6}
"""Expected ρ0 [m] of each plan."""


@dataclass(frozen=True)
class Doubtful:
    """A printed value that contradicts the rest of the same table.

    Attributes:
        row, column: Where it stands.
        printed: What is printed [m].
        implied: What the unrepeated column gives when divided by √repetitions, eq. (14) [m].
    """

    row: str
    column: str
    printed: float
    implied: float


def contradictions(rows: Mapping[str, tuple[float, ...]] = TABLE_2, tolerance: float = 0.03) -> list[Doubtful]:
    """Values of Table 2 for repeated plans that are off 1/√r of the unrepeated column by over ``tolerance``.

    Repeating every measurement r times multiplies the information matrix by r, so ρ0 of any plan, and with it
    every statistic over the same plans, is divided by √r. The tolerance leaves room for rounding.
    """
    doubtful = []
    for row, values in rows.items():
        single = {m: value for (m, r), value in zip(SIZES, values, strict=True) if r == 1}
        for (m, r), label, value in zip(SIZES, LABELS, values, strict=True):
            implied = single[m] / r**0.5
            if abs(value / implied - 1) > tolerance:
                doubtful.append(Doubtful(row, label, value, implied))
    return doubtful
