# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How precise the tracker's coordinates are: the covariance of one measured point.

Isotropic (assumption A3 of the paper): σ² I. A laser tracker measures a range d and two angles from its
station; with u the unit vector along the beam, h horizontal and v = u × h completing them,

    Σ(p) = s_r² u uᵀ + s_a² h hᵀ + s_e² v vᵀ,
    s_r = range + range_per_metre·d,   s_a = azimuth·ρ,   s_e = elevation·d,

with ρ the distance from the station's vertical axis. Distance and direction thus decide how precise a point is.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_planner.arrays import FloatArray, check_array, check_number
from calib_planner.tracker.visibility import check_direction


class Noise(Protocol):
    """The covariance of measured points."""

    def covariance(self, points: NDArray[Any]) -> NDArray[Any]:
        """(…, 3) points in the tracker's frame [m] → (…, 3, 3) covariances [m²]; analytic in the points."""
        ...

    @property
    def typical(self) -> float:
        """A single number for tables: standard deviation of one coordinate [m]."""
        ...


@dataclass(frozen=True)
class Isotropic:
    """The same standard deviation ``sigma`` [m] for every coordinate of every point."""

    sigma: float = 3e-5

    def __post_init__(self) -> None:
        value = check_number("sigma", self.sigma, low=0, low_open=True, high=1.0, unit="m")
        object.__setattr__(self, "sigma", value)

    def covariance(self, points: NDArray[Any]) -> NDArray[Any]:
        return np.broadcast_to(self.sigma**2 * np.eye(3), (*points.shape, 3))

    @property
    def typical(self) -> float:
        return self.sigma


@dataclass(frozen=True, eq=False)
class LaserTracker:
    """Range, azimuth and elevation noise seen from a station.

    Attributes:
        range_sigma: Constant part of the range's standard deviation [m].
        range_per_metre: Part that grows with the range [m/m].
        azimuth: Standard deviation of the horizontal angle [rad].
        elevation: Standard deviation of the vertical angle [rad].
        station: (3,) position of the station in the frame of the points [m].
        up: (3,) direction of its vertical axis.
    """

    range_sigma: float = 1e-5
    range_per_metre: float = 5e-7
    azimuth: float = 5e-6
    elevation: float = 5e-6
    station: ArrayLike = field(default_factory=lambda: np.zeros(3))
    up: ArrayLike = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def __post_init__(self) -> None:
        put = object.__setattr__
        for name, unit in (("range_sigma", "m"), ("azimuth", "rad"), ("elevation", "rad")):
            put(self, name, check_number(name, getattr(self, name), low=0, low_open=True, unit=unit))
        put(self, "range_per_metre", check_number("range_per_metre", self.range_per_metre, low=0))
        put(self, "station", check_array("station", self.station, (3,)))
        put(self, "up", check_direction("up", self.up))

    def covariance(self, points: NDArray[Any]) -> NDArray[Any]:
        beam = points - np.asarray(self.station)
        up = np.asarray(self.up)
        # Sums of squares without conjugates: analytic, so that complex steps pass through.
        distance = np.sqrt((beam * beam).sum(axis=-1))
        height = beam @ up
        reach = np.sqrt(distance * distance - height * height)
        level = (beam - height[..., None] * up) / reach[..., None]
        u = beam / distance[..., None]
        h = np.cross(up, level)
        v = np.cross(u, h)
        s_range = self.range_sigma + self.range_per_metre * distance
        parts = ((u, s_range), (h, self.azimuth * reach), (v, self.elevation * distance))
        return sum((s * s)[..., None, None] * w[..., :, None] * w[..., None, :] for w, s in parts)

    @property
    def typical(self) -> float:
        """At 3 m, root mean square of the three directions."""
        parts = (self.range_sigma + 3 * self.range_per_metre, 3 * self.azimuth, 3 * self.elevation)
        return float(np.sqrt(np.mean(np.square(parts))))


def covariance_gradient(noise: Noise, points: FloatArray) -> FloatArray:
    """∂Σ/∂p, shape (…, 3, 3, 3) with the coordinate of p last, by complex steps: exact to rounding."""
    step = 1e-30
    moved = points[..., None, :] + 1j * step * np.eye(3)
    return np.ascontiguousarray(np.moveaxis(noise.covariance(moved).imag / step, -3, -1))
