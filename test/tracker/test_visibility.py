# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Geometry of the beam: by hand, against brute force over the segments, and properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from calib_planner import InputError
from calib_planner.tracker import (
    azimuths,
    check_direction,
    distances,
    elevations,
    incidence_cosines,
    segment_distances,
    shortened,
)

coordinate = st.integers(-4, 4).map(float)
points = st.lists(coordinate, min_size=3, max_size=3).map(np.array)


def exact_distance(a, b, c, d):
    """The same minimum as a bounded linear least-squares problem."""
    system = np.stack([b - a, c - d], axis=1)
    return np.sqrt(2 * lsq_linear(system, c - a, (0, 1), tol=1e-14).cost)


@settings(max_examples=200, deadline=None)
@given(points, points, points, points)
def test_segment_distance_is_the_minimum(a, b, c, d):
    """Integer corners: parallel, crossing, touching and degenerate segments are common."""
    found = float(segment_distances(a, b, c, d))
    s, t = np.meshgrid(np.linspace(0, 1, 41), np.linspace(0, 1, 41))
    gaps = (a + s[..., None] * (b - a)) - (c + t[..., None] * (d - c))
    assert found <= np.linalg.norm(gaps, axis=-1).min() + 1e-12
    # An interior-point solver ends a little above the minimum.
    assert found == pytest.approx(exact_distance(a, b, c, d), abs=2e-5)
    assert float(segment_distances(c, d, a, b)) == pytest.approx(found, abs=1e-12)
    assert float(segment_distances(b, a, c, d)) == pytest.approx(found, abs=1e-12)


@given(st.floats(0.0, 1e-7), st.floats(-1.0, 1.0))
def test_nearly_parallel_segments(tilt, shift):
    a, b = np.zeros(3), np.array([1.0, 0.0, 0.0])
    c = np.array([shift, 0.5, 0.0])
    assert float(segment_distances(a, b, c, c + np.array([1.0, tilt, 0.0]))) == pytest.approx(0.5, abs=1e-6)


def test_segment_distance_broadcasts():
    rng = np.random.default_rng(0)
    beams, links = rng.normal(size=(2, 5, 2, 1, 3)), rng.normal(size=(2, 5, 1, 4, 3))
    found = segment_distances(*beams, *links)
    assert found.shape == (5, 2, 4)
    one = segment_distances(beams[0, 3, 1, 0], beams[1, 3, 1, 0], links[0, 3, 0, 2], links[1, 3, 0, 2])
    assert found[3, 1, 2] == one


def test_by_hand():
    station, up = np.array([1.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])
    p = np.array([[4.0, 0.0, 5.0], [1.0, 0.0, -1.0], [1.0, 2.0, 1.0]])
    np.testing.assert_allclose(distances(station, p), [5, 2, 2])
    np.testing.assert_allclose(elevations(station, up, p), [np.arctan2(4, 3), -np.pi / 2, 0], atol=1e-15)
    np.testing.assert_allclose(azimuths(station, up, p)[[0, 2]], [0.0, np.pi / 2], atol=1e-15)
    tilted = np.array([1.0, 0.0, 0.0])  # a tracker on its side: angles count from y towards z
    np.testing.assert_allclose(azimuths(station, tilted, p), [np.pi / 2, -np.pi / 2, 0.0], atol=1e-15)
    normals = np.array([[-1.0, 0, 0], [0, 0, 1.0], [1.0, 0, 0]])
    np.testing.assert_allclose(incidence_cosines(station, p, normals), [0.6, 1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(shortened(station, p, 1.0)[0], [3.4, 0.0, 4.2])
    np.testing.assert_allclose(shortened(station, p, 3.0)[1], station)


def test_a_target_at_the_station_gives_numbers():
    here = np.zeros((1, 3))
    assert distances(here[0], here) == 0.0
    assert elevations(here[0], np.array([0.0, 0.0, 1.0]), here) == 0.0
    assert incidence_cosines(here[0], here, np.array([1.0, 0.0, 0.0])) == 0.0
    np.testing.assert_array_equal(shortened(here[0], here, 0.1), here)


def test_directions_are_scaled_and_checked():
    np.testing.assert_allclose(check_direction("up", [0, 3, 4]), [0, 0.6, 0.8])
    with pytest.raises(InputError, match=r"up: .*not zero"):
        check_direction("up", [0, 0, 0])
    with pytest.raises(InputError, match="normal"):
        check_direction("normal", [[1, 0]], (None, 3))
