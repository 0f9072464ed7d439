# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``sheet`` and ``plan --sheet`` as a user runs them: files, JSON, what is refused and how."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from robots import MIXED_URDF, mixed, plan_of, random_configurations

from calib_planner import Robot
from calib_planner.cli import main
from calib_planner.io import SHEET_FILES as FILES
from calib_planner.io import read_plan, read_plan_csv, write_plan
from calib_planner.planning.sheet import plan_identity

CONFIG = Path(__file__).resolve().parents[2] / "config"


@pytest.fixture
def plan_file(tmp_path: Path) -> str:
    robot = Robot.load("kuka_kr270")
    path = tmp_path / "plan.yaml"
    write_plan(path, plan_of(robot, random_configurations(robot, 4, 3), 2))
    return str(path)


def call(capsys: Any, *argv: str) -> tuple[int, str, str]:
    status = main(argv)
    return status, *capsys.readouterr()


def test_all_files_and_the_json_of_a_shipped_robot(plan_file, tmp_path, capsys):
    folder = tmp_path / "new" / "sheet"
    status, out, err = call(capsys, "sheet", "--plan", plan_file, "--output", str(folder), "--json")
    assert status == 0 and "plan_sheet.html" in err
    found, plan = json.loads(out), read_plan(plan_file)
    assert (
        found["files"]
        == list(FILES)
        == ["plan_sheet.html", "plan_sheet.csv", "plan_sheet.yaml", "trajectory.yaml"]
    )
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES)
    assert found["id"] == plan_identity(plan) and found["visible"] is None and found["reachable"] is True
    assert [list(s["joints"].values()) for s in found["stops"]] == plan.configurations.tolist()
    assert found["stops"][0]["travel"]["joint_a1"] is None
    assert found["predicted_accuracy"] == plan.quality.predicted_accuracy
    q, repetitions = read_plan_csv(folder / "plan_sheet.csv", Robot.load("kuka_kr270"))
    np.testing.assert_array_equal(q, plan.configurations)
    np.testing.assert_array_equal(repetitions, 2)
    assert len(yaml.safe_load((folder / "trajectory.yaml").read_text())["points"]) == 4 * 5
    assert found["id"] in (folder / "plan_sheet.html").read_text()
    status, out, _ = call(capsys, "simulate", "--robot", "kuka_kr270", "--plan", str(folder / "plan_sheet.csv"))
    assert status == 0 and len(out.splitlines()) == 1 + 8


def test_the_table_and_the_start_in_degrees(plan_file, capsys):
    status, out, err = call(capsys, "sheet", "--plan", plan_file, "--start", "0 -90 90 0 0 0", "--degrees")
    plan = read_plan(plan_file)
    assert status == 0 and not err
    way = np.abs(np.degrees(plan.configurations[0]) - [0, -90, 90, 0, 0, 0]).max()
    assert f"{way:.1f}°" in out and "Not checked: tracker range" in out and f"Plan {plan_identity(plan)}" in out
    assert f"{np.degrees(plan.configurations[0, 0]):.3f}".replace("-", "−") in out


def test_no_trajectory_to_what_breaks_a_constraint(plan_file, tmp_path, capsys):
    folder, limits = tmp_path / "sheet", tmp_path / "c.yaml"
    folder.mkdir()
    (folder / "trajectory.yaml").write_text("of an earlier plan")
    limits.write_text("joint_range: {joint_a1: [-0.001, 0.001]}")
    options = ("--constraints", str(limits), "--output", str(folder))
    status, out, err = call(capsys, "sheet", "--plan", plan_file, *options)
    assert status == 0 and "No trajectory" in err and "Visit 1 breaks: joint range" in out
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES[:3])


def test_the_instrument_says_where_the_tracker_stands(plan_file, capsys):
    tracker = CONFIG / "instruments" / "laser_tracker.yaml"
    status, out, _ = call(capsys, "sheet", "--plan", plan_file, "--instrument", str(tracker), "--json")
    found = json.loads(out)
    assert status == 0 and found["station"] == [4.0, 1.5, 1.2] and found["visible"] is None
    robot = Robot.load("kuka_kr270")
    points = robot.positions(read_plan(plan_file).configurations)[:, 0]
    ranges = [s["ranges"][0] for s in found["stops"]]
    np.testing.assert_allclose(ranges, np.linalg.norm(points - found["station"], axis=1))


def test_speeds_are_the_urdf_s_or_as_asked_for(tmp_path, capsys):
    text = MIXED_URDF.replace('type="continuous"', 'type="revolute"').replace(
        '<axis xyz="0 0 -1"/>', '<axis xyz="0 0 -1"/><limit lower="-3" upper="3" effort="1" velocity="4"/>'
    )
    urdf, path = tmp_path / "mixed.urdf", tmp_path / "plan.yaml"
    urdf.write_text(text)
    write_plan(path, plan_of(mixed(), np.array([[0.1, 0.2, 0.3, 0.4], [0.2, 0.2, 0.3, 0.4]])))
    base = ("sheet", "--plan", str(path), "--robot", str(urdf), "--json")
    for options, speeds, seconds in (
        ((), [0.25, 0.25, 1.0, 0.25], np.sqrt(10 / np.sqrt(3) * 0.1 / 0.5)),
        (("--acceleration", "9"), [0.25, 0.25, 1.0, 0.25], 1.0),
        (("--speed-share", "0.05"), [0.05, 0.05, 0.2, 0.05], 1.875 * 0.1 / 0.05),
        (("--speed", "0.01", "--dwell", "0", "--settle", "0"), [0.01] * 4, 1.875 * 0.1 / 0.01),
    ):
        status, out, _ = call(capsys, *base, *options)
        found = json.loads(out)
        assert status == 0 and [j["speed"] for j in found["joints"]] == pytest.approx(speeds)
        assert found["stops"][1]["arrive"] - found["stops"][0]["leave"] == pytest.approx(seconds)
        assert [j["unit"] for j in found["joints"]] == ["rad", "m", "rad", "rad"]
        assert found["minutes"] == found["stops"][-1]["leave"] / 60


def test_a_plan_of_another_robot_says_so(tmp_path, capsys):
    robot = Robot.load("planar_2r")
    path = tmp_path / "plan.yaml"
    write_plan(path, replace(plan_of(robot, np.zeros((2, 2))), robot="my_arm"))
    status, out, _ = call(capsys, "sheet", "--plan", str(path), "--robot", "planar_2r")
    assert status == 0 and "made for my_arm" in out
    status, out, err = call(capsys, "sheet", "--plan", str(path))
    assert status == 2 and "the file of my_arm" in err and "--cell FILE" in err and not out


def test_plan_writes_its_sheet(tmp_path, capsys):
    folder = tmp_path / "sheet"
    limits = tmp_path / "c.yaml"
    limits.write_text("tracker: {station: [3, 0, 0], range: [1, 4]}")
    status, out, err = call(
        capsys, "plan", "--robot", "planar_2r", "--test-pose", "0.2 0.4", "--configurations", "3",
        "--starts", "4", "--constraints", str(limits), "--sheet", str(folder), "--json",
    )  # fmt: skip
    found = json.loads(out)
    assert status == 0 and found["sheet"] == str(folder) and str(folder) in err
    sheet = yaml.safe_load((folder / "plan_sheet.yaml").read_text())
    assert [list(s["joints"].values()) for s in sheet["stops"]] == found["configurations"]
    assert sheet["visible"] is True and "tracker range" in sheet["checked"]
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES)


def test_plan_refuses_a_sheet_that_cannot_be_before_it_searches(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    arguments = ("--robot", "planar_2r", "--test-pose", "0 0", "--configurations", "3")
    output = tmp_path / "plan.yaml"
    more = ("--sheet", str(tmp_path / "file" / "x"), "--output", str(output))
    status, out, err = call(capsys, "plan", *arguments, *more)
    assert status == 2 and not out and "--sheet" in err and not output.exists()


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        (("--plan", "plan.csv"), 1, ["plan.csv", "plan .yaml"]),
        (("--plan", "none.yaml"), 1, ["none.yaml", "No such file"]),
        (("--robot", "planar_2r"), 2, ["joint_a1", "q1, q2", "name the robot planned for"]),
        (("--robot", "nothing"), 2, ["nothing", "kuka_kr270"]),
        (("--start", "1 2"), 2, ["--start", "2 numbers", "joint_a6"]),
        (("--start", "1 2 3 4 5 nan"), 2, ["--start", "finite"]),
        (("--start", "a"), 2, ["expected numbers"]),
        (("--dwell", "-1"), 2, ["--dwell", "[0, 86400]"]),
        (("--dwell", "inf"), 2, ["--dwell"]),
        (("--speed", "0"), 2, ["--speed", "rad/s"]),
        (("--speed-share", "1.5"), 2, ["--speed-share", "(0, 1]"]),
        (("--speed", "1", "--speed-share", "1"), 2, ["--speed-share", "one of the two"]),
        (("--speed", "1e-12", "--dwell", "0"), 2, ["timetable", "raise the speed"]),
        (("--constraints", "bad.yaml"), 1, ["bad.yaml", "colour"]),
        (("--instrument", "bad.yaml"), 1, ["bad.yaml", "type"]),
        (("--output", "bad.yaml"), 2, ["--output", "bad.yaml", "folder"]),
        (("--output", "bad.yaml/sub"), 2, ["--output", "choose another"]),
    ],
)
def test_bad_input_is_one_line(options, status, words, plan_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.yaml").write_text("colour: red")
    given = options if "--plan" in options else ("--plan", plan_file, *options)
    found, out, err = call(capsys, "sheet", *given)
    assert found == status and not out and "Traceback" not in err
    assert all(word in err for word in words), err
