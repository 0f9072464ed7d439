# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``campaign`` as a user runs it: in simulation, by hand round by round, and refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib_planner import Robot
from calib_planner.cli import main
from calib_planner.io import read_data, read_estimate, read_plan_csv, write_measurements
from calib_planner.measurements import Measurements
from calib_planner.simulation import SimulatedCell, random_deviations

POSE = ["--test-pose", "0.17453 0.87266"]
SEARCH = ["--starts", "2"]
BASE = ["campaign", "--robot", "planar_2r", *POSE, "--required-accuracy", "120e-6", *SEARCH]
KEYS = {"outcome", "message", "rounds", "verdict", "estimate", "measurements", "validation_measurements", "spent"}


def call(capsys: Any, *argv: str) -> tuple[int, str, str]:
    status = main(argv)
    return status, *capsys.readouterr()


def test_simulated(tmp_path: Path, capsys: Any) -> None:
    status, out, err = call(capsys, *BASE, "--simulate", "3", "--json", "--output", str(tmp_path / "new"))
    found = json.loads(out)
    assert status == 0 and "new" in err and set(found) >= KEYS
    assert found["outcome"] == "reached" and found["predicted_accuracy"] <= 120e-6
    assert found["repeatability"] < found["predicted_accuracy"]
    assert found["achieved_per_test_pose"][0] < 120e-6
    assert [r["number"] for r in found["rounds"]] == list(range(len(found["rounds"])))
    robot = Robot.load("planar_2r")
    fit = read_data(tmp_path / "new" / "measurements.csv", robot).data
    held_out = read_data(tmp_path / "new" / "validation.csv", robot).data
    assert len(fit) + len(held_out) == found["spent"] and len(held_out) == 6
    np.testing.assert_array_equal(fit.p, found["measurements"]["points"])
    values = [p["value"] for p in found["estimate"]["parameters"]]
    assert read_estimate(tmp_path / "new" / "estimate.yaml").values.tolist() == values
    again = json.loads(call(capsys, *BASE, "--simulate", "3", "--json")[1])
    assert (
        again["rounds"] == found["rounds"] and again["estimate"]["parameters"] == found["estimate"]["parameters"]
    )


def test_the_tables(capsys: Any) -> None:
    status, out, err = call(capsys, *BASE, "--simulate", "1")
    assert status == 0 and not err
    assert out.startswith(("PASS: reached", "WARN: reached")) and "rounds" in out and "repeatability" in out
    assert "True error at the test poses" in out and "Validation on 6 points" in out


def test_more_noise_than_stated_is_said(capsys: Any) -> None:
    options = ("--simulate", "1", "--simulate-sigma", "1.5e-4", "--budget", "30")
    status, out, _ = call(capsys, *BASE, *options, "--simulate-error-model", "paper", "--json")
    found = json.loads(out)
    assert status == 0 and found["rounds"][-1]["sigma"] > 7e-5


def test_a_robot_that_does_not_repeat_is_said_to_be_the_limit(capsys: Any) -> None:
    options = ("--required-accuracy", "5e-6", "--simulate", "1", "--simulate-error-model", "typical")
    status, out, _ = call(capsys, *BASE, *options)
    assert status == 0 and out.startswith("FAIL: limited\n") and "of repeatability at a test pose" in out
    assert out.count("of repeatability at a test pose") == 1  # the verdict does not say it once more


def test_the_accuracy_frame_is_said_or_refused(capsys: Any) -> None:
    status, _, err = call(capsys, *BASE, "--simulate", "1", "--accuracy-frame", "robot")
    assert status == 2 and "test_poses" in err and "world" in err


def test_by_hand_until_it_is_done(tmp_path: Path, capsys: Any) -> None:
    """The loop that a person goes through with files, against a simulated cell."""
    robot = Robot.load("planar_2r")
    cell = SimulatedCell(robot, random_deviations(robot, 8))
    files = {role: tmp_path / f"{role}.csv" for role in ("fit", "validation")}
    data: dict[str, Measurements] = {}
    options: list[str] = []
    for turn in range(20):
        status, out, _ = call(capsys, *BASE, "--json", "--next", str(tmp_path / "next.csv"), *options)
        found = json.loads(out)
        assert status == 0
        if "next" not in found:
            break
        q, times = read_plan_csv(tmp_path / "next.csv", robot)
        assert found["next"]["repetitions"] == times.tolist()
        new, role = cell.measure(q, times, seed=turn), found["next"]["role"]
        before = data.get(role)
        if before is not None:
            points = np.concatenate([before.p, new.p])
            new = Measurements(new.joint_names, np.concatenate([before.q, new.q]), points)
        data[role] = new
        write_measurements(files[role], data[role])
        options = ["--measured", str(files["fit"])]
        options += ["--held-out", str(files["validation"])] if "validation" in data else []
    assert found["outcome"] == "reached" and found["predicted_accuracy"] <= 120e-6
    assert len(data["validation"]) == 6 and found["verdict"]["level"] in ("PASS", "WARN")


def test_the_next_batch_as_a_table(capsys: Any) -> None:
    status, out, _ = call(capsys, *BASE)
    assert status == 0 and "measure next" in out and "2×" in out and "measurements planned" in out


@pytest.mark.parametrize(
    ("options", "status", "named"),
    [
        (["--simulate", "-1"], 2, "--simulate"),
        (["--simulate", "1", "--measured", "x.csv"], 2, "--measured"),
        (["--simulate", "1", "--budget", "5"], 2, "budget"),
        (["--simulate", "1", "--budget", "8"], 1, "budget"),
        (["--simulate-sigma", "1e-5"], 2, "--simulate-sigma"),
        (["--simulate", "1", "--simulate-sigma", "nan"], 2, "--simulate-sigma"),
        (["--simulate", "1", "--simulate-transmission", "1"], 2, "--simulate-transmission"),
        (["--held-out", "x.csv"], 2, "--held-out"),
        (["--next", "x.txt"], 2, "--next"),
        (["--measured", "/nowhere.csv"], 1, "/nowhere.csv"),
        (["--simulate", "1", "--required-accuracy", "-1"], 2, "required_accuracy"),
        (["--simulate", "1", "--output", "/proc/none"], 2, "--output"),
    ],
)
def test_refused(options: list[str], status: int, named: str, capsys: Any) -> None:
    found, out, err = call(capsys, *BASE, *options)
    assert found == status and named in err and out == "" and len(err.splitlines()) == 1


def test_a_test_pose_is_needed(capsys: Any) -> None:
    argv = ["campaign", "--robot", "planar_2r", "--required-accuracy", "1e-5", "--simulate", "1"]
    status, _, err = call(capsys, *argv)
    assert status == 2 and "--test-pose" in err
