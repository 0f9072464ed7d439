"""One stream of random numbers per purpose: switching a fault on changes no other draw."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from calib_planner._arrays import FloatArray


class Purpose(IntEnum):
    """What is drawn; part of the seed, so the numbers stay as they are."""

    NOISE = 101
    TRANSMISSION = 102
    UNSETTLED = 103
    RESEAT = 104
    DRIFT = 105
    BUMP = 106
    OUTLIER = 107
    OUTLIER_SIZE = 108
    OUTLIER_STANDSTILL = 109
    BEAM_BREAK = 110
    DROPOUT = 111
    DELAY = 112
    DUPLICATE = 113
    DUPLICATE_DELAY = 114
    REORDER = 115
    REORDER_DELAY = 116


def draws(seed: int, purpose: Purpose, *which: int) -> np.random.Generator:
    """The generator of a purpose, and of the arrival or stream ``which``."""
    return np.random.default_rng([seed, int(purpose), *which])


def directions(rng: np.random.Generator, count: int) -> FloatArray:
    """(count, 3) unit vectors, uniform on the sphere."""
    raw = rng.standard_normal((count, 3))
    return np.asarray(raw / np.linalg.norm(raw, axis=1)[:, None])
