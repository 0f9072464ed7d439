# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The laser tracker: the covariance of a point that it measures, and what it can see from its station.

docs/glossary.md explains the words.
"""

from calib_planner.tracker.noise import Isotropic, LaserTracker, Noise, covariance_gradient
from calib_planner.tracker.visibility import (
    azimuths,
    check_direction,
    distances,
    elevations,
    incidence_cosines,
    segment_distances,
    shortened,
)
