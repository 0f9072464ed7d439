# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Runs of ``calib-planner identify`` for tests, and measurements for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from robots import random_configurations

from calib_planner import Measurements, Robot
from calib_planner.cli import main
from calib_planner.simulation import SimulatedCell

Run = Callable[..., Any]


def fails(capsys: pytest.CaptureFixture[str], *argv: object) -> tuple[int, str]:
    """Exit status and the one line of a run that does not work."""
    status = main(["identify", *map(str, argv)])
    out, err = capsys.readouterr()
    line = err.splitlines()[-1]
    assert out == "" and "Traceback" not in err and line.startswith("calib-planner identify: ")
    return status, line


def small_data(count: int = 12, seed: int = 1, **deviations: float) -> Measurements:
    """planar_2r with hidden errors, in three dimensions thanks to a tracker's noise."""
    robot = Robot.load("planar_2r")
    cell = SimulatedCell(robot, deviations or {"l1": 1e-3, "dq2": -2e-3})
    return cell.measure(random_configurations(robot, count, seed), 1, seed)
