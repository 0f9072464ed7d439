# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""--constraints and --instrument: plans obey the files, and what is wrong with them is said in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from calib_planner import Robot
from calib_planner.cli import main
from calib_planner.io import read_constraints
from calib_planner.planning import Feasibility

CONFIG = Path(__file__).resolve().parents[2] / "config"
PLAN = ["plan", "--robot", "kuka_kr270", "--degrees", "--test-pose", "0 -60 90 0 45 0", "--starts", "1"]


def test_a_plan_obeys_the_file_and_uses_the_instrument(capsys):
    constraints, instrument = CONFIG / "constraints.yaml", CONFIG / "instruments" / "laser_tracker.yaml"
    options = ["--configurations", "5", "--constraints", str(constraints), "--instrument", str(instrument)]
    assert main([*PLAN, *options, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    robot = Robot.load("kuka_kr270")
    feasible = Feasibility(robot, read_constraints(constraints, robot))
    assert feasible.mask(np.array(found["configurations"])).all()
    assert 0 < found["lower_bound"] <= found["predicted_accuracy"]
    assert 1e-5 < found["sigma"] < 2e-5


def test_an_empty_set_is_status_1_and_names_the_constraint(tmp_path, capsys):
    path = tmp_path / "c.yaml"
    path.write_text("workspace: {low: [8, 8, 8], high: [9, 9, 9]}\nminimum_height: {height: 0}")
    assert main([*PLAN, "--configurations", "4", "--constraints", str(path)]) == 1
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1
    assert "workspace box" in err and "allows 0 %" in err


def test_wrong_files_are_named(tmp_path, capsys):
    path = tmp_path / "c.yaml"
    path.write_text("workspace: {low: [8, 8, 8]}")
    for option in ("--constraints", "--instrument"):
        assert main([*PLAN, "--configurations", "4", option, str(path)]) == 1
        assert str(path) in capsys.readouterr().err
