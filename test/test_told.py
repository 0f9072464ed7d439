# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What problems, results, robots and measurements say of themselves: one line, and a table in a notebook."""

from __future__ import annotations

from html.parser import HTMLParser

import numpy as np
import pytest
from robots import plan_of, random_configurations

from calib_planner import IdentificationProblem, PlanProblem, Robot, identify
from calib_planner.io import read_estimate, write_estimate
from calib_planner.simulation import SimulatedCell
from calib_planner.units import Told


class Cells(HTMLParser):
    """Tags in balance, and the texts between them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@pytest.fixture(scope="module")
def things(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Told]:
    robot = Robot.load("planar_2r")
    data = SimulatedCell(robot, {"l1": 1e-3}, 1e-5).measure(random_configurations(robot, 12, 3), 1, 4)
    problem = IdentificationProblem(robot, data, test_poses=[[0.1, 0.2]])
    estimate = identify(problem)
    path = tmp_path_factory.mktemp("told") / "estimate.yaml"
    write_estimate(path, estimate, problem=problem)
    values = (robot, data, problem, estimate, read_estimate(path), PlanProblem(robot, [[0.1, 0.2]], 3))
    return {type(v).__name__: v for v in (*values, plan_of(robot, data.q[:4], 2))}


WANTED = {
    "Robot": ["planar_2r", "2 (q1, q2)", "4 of"],
    "Measurements": ["12", "12 of 1 target", "mm"],
    "IdentificationProblem": ["planar_2r", "12", "typical"],
    "Estimate": ["planar_2r", "12 of 12 used", "4 of 4 identified", "rms"],
    "SavedEstimate": ["planar_2r", "estimate.yaml", "ok"],
    "PlanProblem": ["planar_2r", "3 configurations", "test_pose", "paper"],
    "Plan": ["planar_2r", "8 at 4 configurations", "20 µm"],
}


@pytest.mark.parametrize("name", WANTED)
def test_one_line_and_a_table(name: str, things: dict[str, Told]) -> None:
    value, line = things[name], repr(things[name])
    assert line.startswith(f"{name}(") and line.endswith(")") and "\n" not in line and len(line) < 330
    cells = Cells(value._repr_html_()).texts
    assert cells[0] == name
    for word in WANTED[name]:
        assert word in line and any(word in cell for cell in cells), word


def test_names_are_no_markup() -> None:
    class Odd(Told):
        def _facts(self) -> list[tuple[str, object]]:
            return [("name", "<script>alert(1)</script>")]

    assert "<script>" not in Odd()._repr_html_()


def test_without_points() -> None:
    """Nothing was seen: still a line."""
    robot = Robot.load("planar_2r")
    data = SimulatedCell(robot, {}, 0.0).measure(np.zeros((2, 2)), 1, 1)
    nothing = type(data)(data.joint_names, data.q, np.full_like(data.p, np.nan))
    assert "points 0 of 1 target" in repr(nothing)
