# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Progress on a terminal: nothing for quick work, a bar with what is being done for the rest."""

from __future__ import annotations

import sys
import time
from io import StringIO

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import IdentificationProblem, Robot, identify
from calib_planner.cli import Terminal, terminal
from calib_planner.simulation import SimulatedCell


class Screen(StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("patience", "shown"), [(0.01, True), (60.0, False)])
def test_a_bar_after_a_while(patience: float, shown: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Screen()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(terminal, "PATIENCE", patience)
    with Terminal(json_wanted=False).progress("fitting the robot") as update:
        update(0.5, "half of it")
        deadline = time.monotonic() + 20.0  # the bar draws itself, in a thread of its own
        while shown and "half of it" not in screen.getvalue() and time.monotonic() < deadline:
            time.sleep(0.01)
    assert ("half of it" in screen.getvalue() and "fitting the robot" in screen.getvalue()) == shown


def test_a_fit_tells_how_far_it_is() -> None:
    """Shares grow from 0 towards 1; the estimate does not depend on who watches."""
    robot = Robot.load("planar_2r")
    data = SimulatedCell(robot, {"l1": 1e-3}, 1e-5).measure(random_configurations(robot, 12, 3), 1, 4)
    problem, told = IdentificationProblem(robot, data), []
    watched = identify(problem, watch=lambda share, text: told.append((share, text)))
    shares = [share for share, _ in told]
    assert shares == sorted(shares) and shares[0] == 0.0 and 0.9 <= shares[-1] < 1.0 and len(told) >= 5
    assert all(text for _, text in told)
    np.testing.assert_array_equal(watched.fit.values, identify(problem).fit.values)
