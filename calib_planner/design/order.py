"""The order of visit: the same configurations with little joint travel between them."""

from __future__ import annotations

import numpy as np

from calib_planner._arrays import FloatArray, IntArray
from calib_planner.robot.chain import Robot

LARGE = 200
"""Above this many configurations the tour is not improved after its construction."""


def visiting_order(configurations: FloatArray, robot: Robot) -> IntArray:
    """Row numbers in an order with little travel: nearest neighbour from mid-range, then 2-opt.

    Travel between two configurations is the slowest joint's, as a share of its range.
    """
    scale = np.diff(robot.joint_limits, axis=1)[:, 0]
    home = robot.joint_limits.mean(axis=1)
    points = np.vstack([home, configurations]) / scale
    distance = np.abs(points[:, None] - points[None]).max(axis=2)
    tour, left = [0], set(range(1, len(points)))
    while left:
        row = distance[tour[-1]]
        tour.append(min(left, key=lambda i: (row[i], i)))
        left.remove(tour[-1])
    if len(tour) <= LARGE:
        _two_opt(tour, distance)
    return np.array(tour[1:]) - 1


def _two_opt(tour: list[int], distance: FloatArray) -> None:
    """Turn round stretches of the tour, in place, while that shortens it; its start stays."""
    improved = True
    while improved:
        improved = False
        for i in range(1, len(tour) - 1):
            for j in range(i + 1, len(tour)):
                change = distance[tour[i - 1], tour[j]] - distance[tour[i - 1], tour[i]]
                if j + 1 < len(tour):
                    change += distance[tour[i], tour[j + 1]] - distance[tour[j], tour[j + 1]]
                if change < -1e-12:
                    tour[i : j + 1] = tour[i : j + 1][::-1]
                    improved = True
