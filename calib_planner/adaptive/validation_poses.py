"""Where to validate: at the test poses, near them, and anywhere else, apart from what was measured for the fit.

What the user wants to know is the error where the robot will work, so the test poses come first, as far as they
can be measured themselves; up to half of the configurations lie near them; the others are spread over all that
can be measured, which shows a model that holds near the test poses only. Each is as far as can be from all that
were measured and from the other validation configurations (farthest-point selection): next to a measured one any
model predicts well.
"""

from __future__ import annotations

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.adaptive.exclusion import distances
from calib_planner.design.feasibility import Feasibility

NEAR = 0.1
"""Half width of the neighbourhood of a test pose, as a share of each joint's range."""
APART = 0.02
"""Least distance from what was measured, as a share of the joints' ranges; a test pose keeps to it, too."""
DRAWN = 600
"""Configurations to choose from, near and anywhere."""


def validation_poses(
    allowed: Feasibility,
    test_poses: FloatArray,
    taken: FloatArray,
    scale: FloatArray,
    count: int,
    rng: np.random.Generator,
) -> FloatArray:
    """(count, joints) configurations, or fewer where there is no room for more.

    Args:
        allowed: What can be measured.
        test_poses: (K, joints) [rad | m].
        taken: (N, joints) measured before, for fit or validation.
        scale: (joints,) see ``exclusion.joint_scale``.
        count: How many.

    Raises:
        InfeasibleError: Nothing can be measured at all.
    """
    low, high = allowed.limits.T
    step = NEAR * (high - low)
    centre = test_poses[rng.integers(len(test_poses), size=DRAWN)]
    near = np.clip(centre + rng.uniform(-1.0, 1.0, centre.shape) * step, low, high)
    itself = test_poses[((low <= test_poses) & (test_poses <= high)).all(axis=1)]
    pools = [p[allowed.mask(p)] for p in (itself, near)]
    half = (count + 1) // 2
    chosen = _farthest(pools[0], taken, scale, half)
    chosen = np.vstack([chosen, _farthest(pools[1], np.vstack([taken, chosen]), scale, half - len(chosen))])
    anywhere = allowed.sample(rng, DRAWN)
    return np.vstack([chosen, _farthest(anywhere, np.vstack([taken, chosen]), scale, count - len(chosen))])


def _farthest(pool: FloatArray, taken: FloatArray, scale: FloatArray, count: int) -> FloatArray:
    """Up to ``count`` rows of ``pool``, each the farthest from ``taken`` and those before."""
    apart = np.full(len(pool), np.inf)
    for q in taken:
        apart = np.minimum(apart, distances(pool, q, scale))
    rows: list[int] = []
    while len(rows) < count and len(pool):
        best = int(np.argmax(apart))
        if apart[best] < APART:
            break
        rows.append(best)
        apart = np.minimum(apart, distances(pool, pool[best], scale))
    return pool[rows]
