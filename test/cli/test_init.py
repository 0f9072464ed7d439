# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner init``: a cell from options or answers, and what a file of measurements says about it."""

from __future__ import annotations

import csv
import json
import math
import sys
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import Robot
from calib_planner.cli import main
from calib_planner.io import measurements_text, read_cell
from calib_planner.simulation import SimulatedCell, random_deviations


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with measurements of a UR10e that stands before a tracker, in metres and in millimetres."""
    monkeypatch.chdir(tmp_path)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    robot = Robot.load("ur10e").with_targets([[0.06, 0.02, 0.09]]).with_base(turn, [3.0, -1.0, 0.5])
    cell = SimulatedCell(robot, random_deviations(robot, 1), 1e-5, seed=2)
    text = measurements_text(cell.measure(random_configurations(robot, 20, 3), 1, 4))
    (tmp_path / "points.csv").write_text(text)
    header, *rows = csv.reader(StringIO(text))
    factors = [1e3 if name in ("x1", "y1", "z1") else 180 / math.pi for name in header]
    lines = [",".join(repr(float(v) * f) for v, f in zip(row, factors, strict=True)) for row in rows]
    (tmp_path / "mm_deg.csv").write_text("\n".join([",".join(header), *lines]))
    lines = [",".join([row[0], str(-float(row[1])), *row[2:]]) for row in rows]
    (tmp_path / "reversed.csv").write_text("\n".join([",".join(header), *lines]))
    (tmp_path / "low.yaml").write_text("minimum_height: {height: 0.2, links: false}\n")
    return tmp_path


def init(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    assert main(["init", *words, "--json"]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out)


def test_a_cell_from_options_is_what_identify_needs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "cells").mkdir()
    line = "--robot ur10e --data mm_deg.csv --sigma 20um --constraints low.yaml --output cells/cell.yaml"
    found = init(capsys, *line.split(), "--payload", "2kg 0 0 50mm", "--mounting", "0 0 -1")
    trial = found["data"]
    assert trial["agrees"] and trial["unknown"] == ["base", "tool"] and trial["units"] == ["mm", "deg"]
    assert (trial["visits"], trial["targets"], trial["points"]) == (20, 1, 20)
    assert trial["after"] < 0.01 < 0.1 < trial["before"]
    cell = read_cell("cells/cell.yaml")
    assert cell.unknown == ("base", "tool") and cell.units == ("mm", "deg") and cell.sigma == 2e-5
    assert (
        cell.constraints == "cells/../low.yaml"
        and cell.payload == (2.0, 0.0, 0.0, 0.05)
        and cell.mounting == (0, 0, -1)
    )
    assert main(["identify", "--cell", "cells/cell.yaml", "--data", "mm_deg.csv", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["noise"]["source"] == "sigma" and result["residual_after"]["rms"] < 1e-3


def test_what_is_stated_is_not_looked_for(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trial = init(capsys, "--robot", "ur10e", "--data", "points.csv", "--unknown", "base")["data"]
    free = init(capsys, "--robot", "ur10e", "--data", "points.csv", "--overwrite")["data"]
    assert trial["unknown"] == ["base"] and free["unknown"] == ["base", "tool"]
    assert free["after"] < trial["after"], "the reflector is not where the robot has it"
    assert trial["units"] == free["units"] == []


def test_data_that_do_not_agree(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A joint that runs the other way: no units make it right, and nothing is concluded from it."""
    assert main(["init", "--robot", "ur10e", "--data", "reversed.csv"]) == 0
    out = capsys.readouterr().out
    assert "does not agree with the points" in out and "signs of its joints" in out
    cell = read_cell("cell.yaml")
    assert cell.unknown is None and cell.units is None


class Keyboard(StringIO):
    """A person who types these lines."""

    def isatty(self) -> bool:
        return True


def test_it_asks_and_asks_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = ["", "ur10", "ur10e", "none.csv", "points.csv", "60mm 20", "60mm 20mm 90mm", "", "wall", "ceiling"]
    answers += ["20 ft", "20 um", "low.yaml", "0.1mm"]
    monkeypatch.setattr(sys, "stdin", Keyboard("\n".join(answers) + "\n"))
    assert main(["init"]) == 0
    out, err = capsys.readouterr()
    assert "did you mean 'ur10e'" in err and "no such file" in err and "3 numbers" in err and "m, cm, mm" in err
    assert "floor, ceiling" in err and "The robot agrees with the points" in out
    cell = read_cell("cell.yaml")
    assert cell.robot == "ur10e" and cell.targets == ((0.06, 0.02, 0.09),) and cell.mounting == "ceiling"
    assert cell.payload is None and cell.sigma == 2e-5 and cell.required_accuracy == 1e-4
    assert cell.constraints == "low.yaml" and cell.unknown == ("base",), "the reflector is known"


@pytest.mark.parametrize(
    ("line", "status", "word"),
    [
        ("init", 2, "--robot"),
        ("init --robot ur10e --output low.yaml", 2, "--overwrite"),
        ("init --robot ur10e --data none.csv", 1, "none.csv"),
        ("init --robot ur10e --constraints points.csv", 1, "points.csv"),
        ("init --robot ur10e --mounting wall", 2, "floor, ceiling"),
        ("init --robot ur10e --payload 1,2", 2, "4 finite numbers"),
        ("init --robot ur10e --instrument none.yaml", 1, "none.yaml"),
    ],
)
def test_what_is_refused(
    folder: Path, line: str, status: int, word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(line.split()) == status
    assert word in capsys.readouterr().err and not (folder / "cell.yaml").exists()
