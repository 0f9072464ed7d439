# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner identify`` with a bag: the same numbers as from its rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from identify_runs import Run, fails

from calib_planner import Robot
from calib_planner.acquisition import StandstillSettings
from calib_planner.io import BagTopics, read_bag, write_measurements
from calib_planner.simulation import SimulatedCell


@pytest.fixture
def bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """planar_2r at eight stops, on topics of its own."""
    pytest.importorskip("rosbags")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "io"))
    from bags import campaign, write_bag

    cell = SimulatedCell(Robot.load("planar_2r"), {"l1": 1e-3, "dq2": -2e-3})
    said = campaign(cell, np.random.default_rng(2).uniform(-1.5, 1.5, (8, 2)))
    return write_bag(tmp_path / "monday", said, topics=("/arm/joints", "/leica/point"))


def test_a_bag_is_measurements(run: Run, bag: Path, tmp_path: Path) -> None:
    """The same numbers as from its rows written as CSV; both kinds of files go together."""
    topics = ("--joint-topic", "arm/joints", "--point-topic", "leica/point")
    words = ("--robot", "planar_2r", "--repeatability", "2e-5", "--samples", "10", *topics)
    found = run(*words, "--data", bag)
    robot = Robot.load("planar_2r")
    settings = StandstillSettings(samples=10)
    rows = read_bag(bag, robot, BagTopics("arm/joints", ("leica/point",)), settings, repeatability=2e-5).data
    path = tmp_path / "rows.csv"
    write_measurements(path, rows)
    expected = run("--robot", "planar_2r", "--data", path)
    assert found["measurements"] == 8 and found["parameters"] == expected["parameters"]
    _, err = run(*words, "--data", path, "--data", bag, shown=True)
    assert f"{bag}: 8 standstills in frame tracker" in err and f"{bag}: /arm/joints: " in err
    validated = run(*words, "--data", path, "--validate", bag)
    assert validated["validation"]["count"] == 8


def test_options_of_bags_need_one(points: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--robot", "planar_2r", "--data")
    for more in (("--joint-topic", "x"), ("--settle", "0.1"), ("--accept-damaged",)):
        status, line = fails(capsys, *words, points, *more)
        assert status == 2 and more[0] in line and "a bag among --data or --validate" in line
    status, line = fails(capsys, *words, bag)
    assert status == 1 and "joint_states" in line and "/arm/joints" in line
    status, line = fails(capsys, *words, bag, "--duration", "-1")
    assert status == 2 and "duration" in line
