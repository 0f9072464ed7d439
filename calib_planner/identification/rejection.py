# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What probably happened to points that were rejected, and rows that cannot be measurements.

A rejected point that fits the prediction of another row or of another target was exchanged with it. If all points
from a row on were rejected, something moved for good before it. A row that repeats another one digit for digit is
a copy.
"""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray
from calib_planner.measurements import Measurements

CHANCE = 1e-3
"""Rejected rows that would be the last ones by chance less often than this are the last ones for a reason."""


def copied_rows(data: Measurements) -> int:
    """Rows that repeat another one digit for digit: no two measurements are so alike."""
    rows = np.hstack([data.q, np.nan_to_num(data.p, nan=np.inf).reshape(len(data), -1)])
    return len(rows) - len(np.unique(rows, axis=0))


def rejected_since(seen: NDArray[np.bool_], use: NDArray[np.bool_]) -> int | None:
    """First row of those at the end of which no point was believed: something moved for good before it.

    A robust fit to the larger part rejects what was measured after a bump instead of showing it in its residuals.

    Args:
        seen: (N, targets) which points were measured.
        use: (N, targets) which were believed.

    Returns:
        ``None`` unless all rejected rows are the last ones and that is no chance (see ``CHANCE``).
    """
    rows = np.flatnonzero(seen.any(axis=1))
    gone = np.asarray(~use[rows].any(axis=1))
    count = int(gone.sum())
    # To reject none or all there is one choice only, which is no sign.
    if not gone[-count:].all() or comb(len(rows), count) * CHANCE <= 1.0:
        return None
    return int(rows[-count])


def explain(
    predicted: FloatArray, data: Measurements, rejected: NDArray[np.bool_], reach: float
) -> dict[tuple[int, int], str]:
    """What probably happened to rejected points.

    Args:
        predicted: (N, targets, 3) by the fit to the others [m].
        data: What was measured.
        rejected: (N, targets).
        reach: A point this close to another prediction belongs there [m].

    Returns:
        (row, target) → words, for the points that fit elsewhere. Rows and targets from 0.
    """
    words: dict[tuple[int, int], str] = {}
    for i in np.flatnonzero(rejected.any(axis=1)):
        targets = np.flatnonzero(rejected[i])
        if len(targets) > 1:
            apart = np.linalg.norm(predicted[i][None, targets] - data.p[i, targets][:, None], axis=2)
            nearest = apart.argmin(axis=1)
            if (apart.min(axis=1) < reach).all() and (nearest != np.arange(len(targets))).all():
                for t, k in zip(targets, nearest, strict=True):
                    words[int(i), int(t)] = f"fits target {targets[k] + 1}: targets exchanged?"
                continue
        apart = np.linalg.norm(predicted[:, targets] - data.p[i, targets], axis=2)
        apart = np.median(apart, axis=1)  # one of the points may be wrong besides
        apart[i] = np.inf
        k = int(apart.argmin())
        if apart[k] < reach:
            for t in targets:
                words[int(i), int(t)] = f"fits the configuration of row {k}: rows exchanged?"
    return words
