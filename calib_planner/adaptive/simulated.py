"""A simulated robot and tracker, measured one configuration at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.adaptive.campaign import Measure
from calib_planner.adaptive.run import Instrument, Unreachable
from calib_planner.simulation import Stand, World


def simulated(world: World, seed: int, reaches: Callable[[FloatArray], bool] = lambda q: True) -> Instrument:
    """Measures in ``world``.

    Args:
        seed: Of the tracker's noise.
        reaches: Whether the robot gets to a configuration (joints,).
    """
    rng = np.random.default_rng([seed, 2])  # a stream of its own: the true errors may have the same seed
    arrivals = 0

    def measure(action: Measure) -> FloatArray:
        nonlocal arrivals
        if not reaches(action.q):
            raise Unreachable("the robot does not get there")
        stand = Stand(action.q[None], np.array([arrivals]), np.array([np.inf]))
        arrivals += 1
        points = world.targets(stand)
        return np.asarray((points + world.cell.noise(points, rng))[0])

    return measure
