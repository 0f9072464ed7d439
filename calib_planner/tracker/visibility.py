# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What a tracker sees from its station: distance, azimuth, elevation, incidence on the reflector, clear beams.

For a station s and a target p, the beam is b = p − s, d = |b|. With u the unit vector of the station's vertical
axis and n the unit normal of the reflector (the axis of its cone, pointing out of it),

    elevation   sin ε = (b·u) / d,        −π/2 … π/2, positive above the station
    azimuth     tan α = (b·u×e) / (b·e),  −π … π, counted about u from e, which is the x axis of the frame
                made perpendicular to u; where both are parallel, the y axis
    incidence   cos β = (n·(s − p)) / d,  0 when the reflector looks straight at the tracker.

The beam passes a capsule (all points within r of a segment) when the distance between the two segments, beam
and axis, is at least r. All points and directions of one call are in one frame, [m].
"""

from __future__ import annotations

import numpy as np

from calib_planner.arrays import FloatArray, check_array
from calib_planner.errors import InputError

TINY = 1e-300
"""Keeps quotients of squares finite: a direction of length zero then counts as perpendicular to all."""


PARALLEL = 1e-6
"""A vertical whose cosine with the x axis is nearer to 1 leaves no x direction to count from."""


def distances(station: FloatArray, points: FloatArray) -> FloatArray:
    """(…, 3) points → (…) distances from the station [m]."""
    return np.asarray(np.linalg.norm(points - station, axis=-1))


def elevations(station: FloatArray, up: FloatArray, points: FloatArray) -> FloatArray:
    """(…, 3) points → (…) elevation angles [rad]; ``up`` is a unit vector."""
    height = (points - station) @ up
    return np.asarray(np.arcsin(np.clip(height / np.maximum(distances(station, points), TINY), -1.0, 1.0)))


def azimuths(station: FloatArray, up: FloatArray, points: FloatArray) -> FloatArray:
    """(…, 3) points → (…) azimuth angles [rad]; ``up`` is a unit vector."""
    axis = np.eye(3)[int(abs(up[0]) > 1.0 - PARALLEL)]
    ahead = axis - (axis @ up) * up
    beam = points - station
    return np.asarray(np.arctan2(beam @ np.cross(up, ahead), beam @ ahead))


def incidence_cosines(station: FloatArray, points: FloatArray, normals: FloatArray) -> FloatArray:
    """(…, 3) points and their unit normals → (…) cos β."""
    along = np.einsum("...i,...i->...", station - points, normals)
    return np.asarray(along / np.maximum(distances(station, points), TINY))


def segment_distances(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """Shortest distances between segments a–b and c–d, all (…, 3) and broadcast → (…) [m].

    |a + s(b − a) − c − t(d − c)|² is convex in (s, t) ∈ [0, 1]². Its free minimiser in s, clipped, gives t;
    clipped again, t gives s: the three steps reach the minimum over the square (Ericson, Real-Time Collision
    Detection, 2005, section 5.1.9), parallel segments and points included.
    """
    first, second, gap = b - a, d - c, a - c
    aa, bb, ab = _dot(first, first), _dot(second, second), _dot(first, second)
    ag, bg = _dot(first, gap), _dot(second, gap)
    s = _share(ab * bg - ag * bb, aa * bb - ab * ab)
    t = _share(ab * s + bg, bb)
    s = _share(ab * t - ag, aa)
    between = gap + s[..., None] * first - t[..., None] * second
    return np.asarray(np.sqrt(_dot(between, between)))


def shortened(station: FloatArray, points: FloatArray, near: float) -> FloatArray:
    """(…, 3) points moved towards the station by ``near`` [m], at most as far as the station."""
    d = distances(station, points)
    share = np.minimum(near / np.maximum(d, TINY), 1.0)
    return points + share[..., None] * (station - points)


def check_direction(field: str, value: object, shape: tuple[int | None, ...] = (3,)) -> FloatArray:
    """Directions of the given shape (…, 3), scaled to length 1.

    Raises:
        InputError: Another shape, or a direction of length zero.
    """
    array = check_array(field, value, shape)  # type: ignore[arg-type]
    length = np.linalg.norm(array, axis=-1, keepdims=True)
    if not (length > 0).all():
        raise InputError(field, array.tolist(), "directions that are not zero")
    return check_array(field, array / length, shape)


def _dot(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("...i,...i->...", x, y))


def _share(x: FloatArray, y: FloatArray) -> FloatArray:
    """x / y within [0, 1], and 0 where y is 0: any s or t will do there."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        share = np.where(y > 0, x / y, 0.0)
    return np.minimum(np.maximum(share, 0.0), 1.0)
