# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A campaign store and a plan for it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from stores import opened

from calib_planner import Plan, PlanProblem, Robot, plan
from calib_planner.io import SessionStore
from calib_planner.planning import Search


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SessionStore]:
    made = opened(tmp_path)
    yield made
    made.close()


@pytest.fixture(scope="module")
def planned() -> Plan:
    robot = Robot.load("planar_2r").with_parameters("lengths+offsets")
    return plan(PlanProblem(robot, [0.3, 0.5], 4, search=Search(starts=4)))
