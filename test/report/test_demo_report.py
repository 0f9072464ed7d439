# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The demo's report: numbers, keys, table and picture."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from calib_planner import IdentificationProblem, PlanProblem, Robot, identify, plan
from calib_planner.demo import DemoResult, demo_report, draw, print_files, print_table
from calib_planner.error_model import ErrorModel
from calib_planner.errors import InputError
from calib_planner.planning import Search
from calib_planner.simulation import SimulatedCell, random_deviations


@pytest.fixture(scope="module")
def result() -> DemoResult:
    robot = Robot.load("planar_2r").with_parameters("lengths+offsets")
    problem = PlanProblem(robot, [0.3, 0.5], 4, search=Search(starts=4))
    made = plan(problem)
    cell = SimulatedCell(robot, random_deviations(robot, 2), problem.instrument.typical)
    data = cell.measure(made.configurations, 1, 2)
    estimate = identify(IdentificationProblem(robot, data, problem.instrument.typical, ErrorModel.paper()))
    with pytest.raises(InputError, match="estimate"):
        demo_report(
            PlanProblem(robot.with_parameters("full"), [0.3, 0.5], 6),
            made,
            estimate.knowledge,
            estimate.calibrated,
            cell,
        )
    return demo_report(problem, made, estimate.knowledge, estimate.calibrated, cell, report="here")


def test_numbers(result: DemoResult) -> None:
    assert result.after < result.before
    assert result.random_predicted_accuracy > result.predicted_accuracy
    assert result.random_after == pytest.approx(result.random_predicted_accuracy, rel=0.5)
    assert all(abs(p.value - p.true) < 4 * p.std for p in result.parameters)


def test_keys(result: DemoResult) -> None:
    keys = {
        "before",
        "after",
        "placement_alone",
        "predicted_accuracy",
        "random_after",
        "random_predicted_accuracy",
    }
    found = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert keys | {"parameters", "report"} <= set(found)
    assert {"name", "unit", "true", "value", "std"} <= set(found["parameters"][0])


def test_table_and_picture(result: DemoResult, tmp_path: Path) -> None:
    text = io.StringIO()
    print_table(result, Console(file=text, width=120))
    assert all(p.name in text.getvalue() for p in result.parameters) and "mrad" in text.getvalue()
    assert draw(result, tmp_path / "a.png").stat().st_size > 10_000


def test_unidentified_parameters_do_not_break_it(result: DemoResult, tmp_path: Path) -> None:
    from dataclasses import replace

    blind = replace(result, parameters=tuple(replace(p, std=np.nan) for p in result.parameters))
    print_table(blind, Console(file=io.StringIO()))
    draw(blind, tmp_path / "a.png")
    assert blind.to_dict()["parameters"][0]["std"] is None


def test_the_table_keeps_its_units_and_the_last_line_is_the_page(result: DemoResult, tmp_path: Path) -> None:
    console = Console(file=io.StringIO(), width=100)  # with markup, which takes [mm] for a style
    print_table(result, console)
    (tmp_path / "calibration.html").write_text("")
    print_files(tmp_path, console)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert "achieved [mm]" in shown and "predicted [mm]" in shown and "test pose [mm]" in shown
    assert shown.splitlines()[-1] == str(tmp_path / "calibration.html")
    (tmp_path / "calibration.html").unlink()
    print_files(tmp_path, console)
    assert console.file.getvalue().splitlines()[-1] == str(tmp_path / "demo.png")  # type: ignore[attr-defined]
