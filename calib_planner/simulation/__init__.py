# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The world we test in: a robot with hidden true parameters, a tracker with noise, and what goes wrong.

docs/glossary.md explains the words.
"""

from calib_planner.simulation.cell import (
    ANGLE_ERROR,
    LENGTH_ERROR,
    Faults,
    SimulatedCell,
    independent_seeds,
    random_deviations,
)
from calib_planner.simulation.motion import NANO, Followed, Itinerary, Stand, Tour, make_tour
from calib_planner.simulation.streams import Message, Rates, Streams, play
from calib_planner.simulation.world import World, simulate_campaign, simulated
