"""Mistakes that data show by themselves: wrong units, exchanged rows, exchanged targets.

Least squares would turn them into parameters without a word. What is certain enough is an error before the fit
(units); what is only likely is the reason given for a rejected point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_planner._arrays import FloatArray
from calib_planner.errors import InputError
from calib_planner.identification.measurements import Measurements
from calib_planner.robot.chain import Robot

WRONG_UNIT = (200.0, 5000.0)
"""Measured points spread this much wider than the model's: millimetres where metres are wanted."""


def check_units(robot: Robot, data: Measurements) -> None:
    """Refuse points in millimetres, and a robot model in millimetres.

    Raises:
        InputError: The points spread about a thousand times more, or less, than the robot can move them.
    """
    seen = data.seen
    if seen.sum() < 3:
        return
    measured = _spread(data.p[seen])
    expected = _spread(robot.positions(data.q)[seen])
    if measured == 0.0 or expected == 0.0:
        return
    ratio = measured / expected
    got = f"points {measured:.3g} apart where the robot model moves them by {expected:.3g}"
    if WRONG_UNIT[0] < ratio < WRONG_UNIT[1]:
        advice = "they look like millimetres: divide by 1000 (command line: --millimetres)"
        raise InputError("points", got, "coordinates in metres", advice)
    if WRONG_UNIT[0] < 1.0 / ratio < WRONG_UNIT[1]:
        advice = "the model's lengths look like millimetres: give them in metres"
        raise InputError("robot", got, "lengths in metres", advice)


def copied_rows(data: Measurements) -> int:
    """Rows that repeat another one digit for digit: no two measurements are so alike."""
    rows = np.hstack([data.q, np.nan_to_num(data.p, nan=np.inf).reshape(len(data), -1)])
    return len(rows) - len(np.unique(rows, axis=0))


def _spread(points: FloatArray) -> float:
    """Median distance from the median point [m]: blind to a few gross errors."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


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
    found: dict[tuple[int, int], str] = {}
    for i in np.flatnonzero(rejected.any(axis=1)):
        targets = np.flatnonzero(rejected[i])
        if len(targets) > 1:
            apart = np.linalg.norm(predicted[i][None, targets] - data.p[i, targets][:, None], axis=2)
            nearest = apart.argmin(axis=1)
            if (apart.min(axis=1) < reach).all() and (nearest != np.arange(len(targets))).all():
                for t, k in zip(targets, nearest, strict=True):
                    found[int(i), int(t)] = f"fits target {targets[k] + 1}: targets exchanged?"
                continue
        apart = np.linalg.norm(predicted[:, targets] - data.p[i, targets], axis=2)
        # One of the points may be wrong besides.
        apart = np.median(apart, axis=1) if len(targets) > 1 else apart[:, 0]
        apart[i] = np.inf
        k = int(apart.argmin())
        if apart[k] < reach:
            for t in targets:
                found[int(i), int(t)] = f"fits the configuration of row {k}: rows exchanged?"
    return found
