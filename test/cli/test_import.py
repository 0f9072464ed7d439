# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner import``, and the other commands with tables that are not this package's own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from calib_planner import Measurements, Robot
from calib_planner.cli import main
from calib_planner.io import read_data, read_joints, write_configurations, write_measurements

sys.path.append(str(Path(__file__).parents[1] / "io"))
from layouts import DATA, LAYOUTS, ROBOT, URDF, Layout, write


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF + "</robot>")
    return path


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    status = main([*map(str, words)])
    return status, *capsys.readouterr()


@pytest.mark.parametrize("name", ["plain", "German Excel, old", "MAT"])
def test_any_layout_becomes_the_packages_own(
    arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    path, out = write(tmp_path, DATA, LAYOUTS[name]), tmp_path / "out.csv"
    status, stdout, stderr = run(capsys, "import", path, "--robot", arm, "--output", out)
    assert status == 0 and f"24 rows of 2 reflectors written to {out}" in stdout
    assert (stdout + stderr).count(f"{path}: ") == 1, "what the file is like is said once"
    source = read_data(out, ROBOT)
    assert source.understanding.plain
    np.testing.assert_allclose(source.data.q, DATA.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(source.data.p, DATA.p, rtol=0, atol=1e-12)
    if name == "plain":
        status, stdout, _ = run(capsys, "import", path, "--robot", arm)
        assert status == 0 and stdout == out.read_text()
    status, stdout, _ = run(capsys, "import", path, "--robot", arm, "--json")
    answer = json.loads(stdout)
    layout = LAYOUTS[name]
    assert answer["rows"] == 24 and answer["targets"] == 2
    assert answer["files"][0]["units"] == {"length": layout.length, "angle": layout.angle}


def test_points_beside_joints_and_several_files(
    arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joints, points, out = tmp_path / "joints.csv", tmp_path / "points.txt", tmp_path / "out.csv"
    write_configurations(joints, ROBOT.joint_names, np.rad2deg(DATA.q))
    points.write_text(
        "\n".join(f"P{i}; {x!r}; {y!r}; {z!r}" for i, (x, y, z) in enumerate(DATA.p[:, 0].tolist()))
    )
    words = ("import", joints, "--robot", arm, "--units", "m,deg", "--points", points)
    status, stdout, stderr = run(capsys, *words, "--match", "order", "--output", out)
    assert status == 0 and "24 rows of 1 reflector" in stdout and "by order: 24 of 24 rows" in stderr
    np.testing.assert_allclose(read_data(out, ROBOT).data.p[:, 0], DATA.p[:, 0], rtol=0, atol=1e-12)
    half = tmp_path / "half.csv"
    write_measurements(half, Measurements(ROBOT.joint_names, DATA.q[:9], DATA.p[:9, :1]))
    status, stdout, _ = run(capsys, "import", out, half, "--robot", arm, "--json")
    assert status == 0 and json.loads(stdout)["rows"] == 33
    status, _, stderr = run(capsys, "import", out, half, "--robot", arm, "--points", points)
    assert status == 2 and "one table of joints" in stderr


def test_what_the_fit_knows_is_not_imported_wrongly(
    arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, DATA, Layout(length="cm"))
    status, _, stderr = run(capsys, "import", path, "--robot", arm)
    assert status == 1 and "in centimetres" in stderr and "--units cm" in stderr
    assert run(capsys, "import", path, "--robot", arm, "--units", "cm")[0] == 0
    status, _, stderr = run(capsys, "import", arm, "--robot", arm)
    assert status == 1 and "a robot description (URDF)" in stderr


def test_plans_read_the_same_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Candidates, test poses and earlier measurements, plain or as a German spreadsheet writes them."""
    robot = Robot.load("planar_2r")
    q = np.random.default_rng(4).uniform(-1.5, 1.5, (9, 2))
    measured = Measurements(robot.joint_names, q[:4], robot.positions(q[:4]))
    answers = []
    for layout in (Layout(), Layout(separator=";", decimal=",", angle="deg", length="mm", written="square")):
        files = []
        for number, data in enumerate((Measurements(robot.joint_names, q, robot.positions(q)), measured)):
            (tmp_path / str(number)).mkdir(exist_ok=True)
            files.append(write(tmp_path / str(number), data, layout))
        words = ("--candidates", files[0], "--test-path", files[1], "--measured", files[1], "--json")
        status, stdout, stderr = run(
            capsys, "plan", "--robot", "planar_2r", "--configurations", 2, "--starts", 2, *words
        )
        assert status == 0, stderr
        assert ("decimal comma" in stderr) == (layout.decimal == ",")
        answers.append(json.loads(stdout))
    np.testing.assert_allclose(answers[0]["configurations"], answers[1]["configurations"], atol=1e-12)
    assert answers[0]["predicted_accuracy"] == pytest.approx(answers[1]["predicted_accuracy"], rel=1e-9)


def test_units_that_are_stated_are_those_of_the_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, words = tmp_path / "plan.csv", ["--configurations", "2", "--starts", "2", "--units", "mm,deg", "--json"]
    status, stdout, _ = run(
        capsys, "plan", "--robot", "planar_2r", "--test-pose", "20 30", *words, "--output", out
    )
    assert status == 0 and out.read_text().startswith("q1 [deg],q2 [deg],repetitions\n")
    table = read_joints(out, Robot.load("planar_2r"))
    np.testing.assert_allclose(table.configurations, json.loads(stdout)["configurations"], rtol=0, atol=1e-12)
    assert table.understanding.angle_from == "written"
