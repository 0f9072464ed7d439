"""The world we test in: a robot with hidden true parameters, a tracker with noise, and what goes wrong."""

from calib_planner.simulation.cell import ANGLE_ERROR, LENGTH_ERROR, SimulatedCell, random_deviations

__all__ = ["ANGLE_ERROR", "LENGTH_ERROR", "SimulatedCell", "random_deviations"]
