"""The command line ``calib-planner``: arguments in, one library call, result out. No ROS."""

from calib_planner.cli.main import main

__all__ = ["main"]
