"""How uncertain the mean points of standstills are.

A mean of n samples has σ/√n, with one σ for all standstills: given, or pooled over their scatter, since that of a
single standstill of twenty samples is known to 10 % only. What averaging does not reduce (the robot's
repeatability, how the reflector sits) is added in squares.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.instrument.standstill import Standstill


def mean_std(found: Sequence[Standstill], sigma: float = 0.0, repeatability: float = 0.0) -> FloatArray | None:
    """(N, T, 3) standard deviation of each coordinate of the mean points [m], NaN where a target was not seen.

    Args:
        found: N standstills of T targets, at least one.
        sigma: Standard deviation of one coordinate of one sample [m]; 0: from the samples' scatter.
        repeatability: Standard deviation that averaging does not reduce [m].

    Returns:
        ``None`` where it is not known: no scatter, or a single sample each.
    """
    samples = np.array([f.samples for f in found])
    sigma = sigma or scatter(found)
    with np.errstate(divide="ignore"):
        std = np.sqrt(sigma**2 / samples + repeatability**2)
    std = np.repeat(np.where(samples > 0, std, np.nan)[:, :, None], 3, axis=2)
    return std if bool((std[samples > 0] > 0).all()) else None


def scatter(found: Sequence[Standstill]) -> float:
    """Standard deviation of one coordinate of one sample [m], pooled; NaN free, 0 if unknown."""
    freedom = np.array([np.maximum(f.samples - 1, 0) for f in found])
    variance = np.array([f.std**2 * f.samples for f in found])
    total = float(freedom.sum())
    return float(np.sqrt(np.nansum(freedom * variance) / total)) if total else 0.0
