"""The laser tracker: the covariance of a point that it measures, and what it can see from its station."""

from calib_planner.tracker.noise import Isotropic, LaserTracker, Noise, covariance_gradient
from calib_planner.tracker.visibility import (
    check_direction,
    distances,
    elevations,
    incidence_cosines,
    segment_distances,
    shortened,
)
