# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""--payload, --mounting and --vertical as a user gives them: what is used is said, saved and compensated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from identify_runs import Run, fails
from robots import random_configurations

from calib_planner import Robot
from calib_planner.cli import main
from calib_planner.cli.gravity import gravity_note
from calib_planner.error_model import Gravity, Payload, Truth, typical
from calib_planner.io import read_estimate, write_configurations, write_error_model, write_measurements
from calib_planner.measurements import Measurements
from calib_planner.robot import rotation

SCALES = {
    "gravity": 3e-3,
    "smooth.size": 1e-9,
    "short.size": 1e-9,
    "repeatability": 1e-9,
    "shared": 1e-9,
    "placement.length": 1e-6,
    "placement.angle": 1e-6,
    "floor": 2e-5,
}
TURN = rotation(2, 0.4) @ rotation(0, np.pi / 2)
DOWN = (0.0, -1.0, 0.0)
"""Of the robot on the wall, in the frame of its base."""
CARRIED = Payload(6.0, (0.05, 0.0, 0.15))
MASSES = np.array([0.0, 2.0, 6.0])


def true_robot() -> Truth:
    """A UR10e on a wall, before a tracker that stands upright."""
    robot = Robot.load("ur10e").with_parameters("full").with_base(TURN, [1.0, 2.0, 3.0])
    model = typical(gravity=Gravity(mounting=DOWN, payload=CARRIED)).with_values(SCALES)
    return Truth.draw(robot, model, np.random.default_rng(3))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files: what was measured with several payloads, and fresh points with 4 kg."""
    place, truth = tmp_path_factory.mktemp("gravity"), true_robot()
    some = random_configurations(truth.robot, 20, 1) / 3.0
    write_configurations(place / "candidates.csv", truth.robot.joint_names, some)
    for name, count, masses in (("fit", 45, MASSES[np.arange(45) % 3]), ("fresh", 30, np.full(30, 4.0))):
        q = random_configurations(truth.robot, count, count) / 3.0
        points = truth.measure(q, np.random.default_rng(count), masses)
        data = Measurements(truth.robot.joint_names, q, points, payload=masses)
        write_measurements(place / f"{name}.csv", data)
    return place


@pytest.fixture
def words(folder: Path) -> tuple[str, ...]:
    files = ("--robot", "ur10e", "--data", str(folder / "fit.csv"))
    return (*files, "--unknown", "base,tool", "--parameters", "offsets", "--error-model", "typical")


def gravity_of(result: dict[str, Any]) -> Any:
    return result["error_model"]["model"]["gravity"]


PAYLOAD = ("--payload", "6 0.05 0 0.15")


def test_the_vertical_of_the_points_says_how_the_robot_is_mounted(run: Run, words: tuple[str, ...]) -> None:
    upright = run(*words, *PAYLOAD, "--vertical", "0 0 1")
    # About the axis of the first joint, z, base and zero of that joint cannot be told apart.
    np.testing.assert_allclose(gravity_of(upright)["mounting"], DOWN, atol=0.1)
    assert abs(gravity_of(upright)["mounting"][2]) < 2e-3
    assert gravity_of(upright)["vertical"] is None
    assert gravity_of(upright)["payload"] == {"mass": 6.0, "xyz": [0.05, 0.0, 0.15]}
    stated = run(*words, *PAYLOAD, "--mounting", "0 -1 0")
    assert gravity_of(stated)["mounting"] == list(DOWN)
    assert upright["left_out"]["rms"] < 6e-5
    assert 0.7 < upright["left_out"]["predicted_rms"] / upright["left_out"]["rms"] < 1.4
    assert upright["left_out"]["rms"] <= stated["left_out"]["rms"] < 1e-4
    floor = run(*words, *PAYLOAD)
    assert floor["left_out"]["rms"] > 5.0 * stated["left_out"]["rms"]


def test_what_was_used_is_said(run: Run, words: tuple[str, ...], folder: Path) -> None:
    def told(*more: str) -> str:
        return " ".join(run(*words, *more, shown=True)[1].split())

    note = told(*PAYLOAD, "--mounting", "0 -1 0")
    assert "unit masses at elbow, wrist and tip (the robot's file states no masses of its links)" in note
    assert "a payload of 6 kg; mounted on a wall: down is 0 -1 0 in the frame of its base" in note
    instrument = folder / "tracker.yaml"
    instrument.write_text("type: laser_tracker\nstation: [4, 0, 1]\nup: [0, 0, 1]\n")
    assert "mounted on a wall" in told("--instrument", str(instrument))
    instrument.write_text("type: laser_tracker\nstation: [4, 0, 1]\n")
    assert "mounted on the floor" in told("--instrument", str(instrument))
    assert "mounted under a ceiling" in told("--mounting", "ceiling")
    nothing = gravity_note(None, Gravity(mounting=DOWN), Robot.load("ur10e"))
    assert "none of a robot that is mounted on a wall; if that is not so, give --mounting" in nothing


@pytest.mark.parametrize(
    ("more", "option", "said"),
    [
        (("--mounting", "wall"), "--mounting", "which way is down"),
        (("--mounting", "0 0 0"), "--mounting", "direction"),
        (("--mounting", "1 0"), "--mounting", "direction"),
        (("--mounting", "floor", "--vertical", "0 0 1"), "--vertical", "no --mounting"),
        (("--vertical", "0 0 0"), "--vertical", "a direction"),
        (("--vertical", "0 1"), "--vertical", "2 numbers"),
        (("--payload", "1 2"), "--payload", "MASS X Y Z"),
        (("--payload", "nan"), "--payload", "MASS X Y Z"),
        (("--payload", "-1"), "--payload", "0 kg or more"),
        (("--payload", "3", "--error-model", "paper"), "--payload", "an error model with gravity"),
    ],
)
def test_what_cannot_be_is_refused(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str], more: tuple[str, ...], option: str, said: str
) -> None:
    status, line = fails(capsys, *words, *more)
    assert status == 2 and option in line and said in line


def test_a_model_from_a_file_keeps_its_own_gravity(run: Run, words: tuple[str, ...], tmp_path: Path) -> None:
    write_error_model(tmp_path / "m.yaml", typical(gravity=Gravity(mounting=DOWN, payload=CARRIED)))
    own = run(*words, "--error-model", tmp_path / "m.yaml")
    assert gravity_of(own)["mounting"] == list(DOWN) and gravity_of(own)["payload"]["mass"] == 6.0
    other = run(*words, "--error-model", tmp_path / "m.yaml", "--payload", "3")
    assert gravity_of(other)["mounting"] == list(DOWN)
    assert gravity_of(other)["payload"] == {"mass": 3.0, "xyz": [0.0, 0.0, 0.0]}


def test_a_mass_of_zero_gives_the_place_to_what_the_column_says(run: Run, words: tuple[str, ...]) -> None:
    result = run(*words, "--payload", "0 0.05 0 0.15", "--mounting", "0 -1 0")
    assert gravity_of(result)["payload"] == {"mass": 6.0, "xyz": [0.05, 0.0, 0.15]}


def test_links_of_the_robots_file_are_used_and_said(run: Run, words: tuple[str, ...], folder: Path) -> None:
    from calib_planner.io import config_folder

    text = (config_folder() / "robots" / "ur10e.yaml").read_text()
    names = Robot.load("ur10e").joint_names
    pairs = zip(names, (7, 13, 4, 2, 2, 0.4), strict=True)
    rows = [{"joint": name, "mass": mass, "xyz": [0.0, 0.0, 0.02]} for name, mass in pairs]
    (folder / "heavy.yaml").write_text(text + "\n" + yaml.safe_dump({"masses": rows}))
    more = ("--robot", folder / "heavy.yaml", *PAYLOAD, "--mounting", "0 -1 0")
    _, err = run(*words, *more, shown=True)
    assert "the links weigh what the robot's file says, a payload of 6 kg" in " ".join(err.split())


def test_compensate_for_the_payload_that_is_carried(
    run: Run, words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Without joint functions the file is short, and quickly read.
    model = typical(gravity=Gravity(mounting=DOWN, payload=CARRIED)).without("joint_functions")
    write_error_model(tmp_path / "m.yaml", model)
    run(*words, "--error-model", tmp_path / "m.yaml", "--output", tmp_path / "e.yaml")
    robot = Robot.load("ur10e")
    q = random_configurations(robot, 6, 5) / 3.0
    write_configurations(tmp_path / "q.csv", robot.joint_names, q)
    files = ("--estimate", str(tmp_path / "e.yaml"), "--targets", str(tmp_path / "q.csv"))
    known = read_estimate(tmp_path / "e.yaml").knowledge(robot)

    def corrected(*more: str) -> np.ndarray:
        assert main(["compensate", "--robot", "ur10e", *files, "--json", *more]) == 0
        return np.array(json.loads(capsys.readouterr().out)["corrected"])

    stated, lighter = corrected(), corrected("--payload", "2")
    shifted, empty = corrected("--payload", "2 0.3 0 0.15"), corrected("--payload", "0")
    wanted = known.actual(stated, 6.0)
    np.testing.assert_allclose(known.actual(lighter, 2.0), wanted, atol=1e-9)
    np.testing.assert_allclose(known.actual(empty, 0.0), wanted, atol=1e-9)
    np.testing.assert_allclose(known.carrying(Payload(2.0, (0.3, 0.0, 0.15))).actual(shifted), wanted, atol=1e-9)
    for one, other in ((stated, lighter), (lighter, empty), (lighter, shifted)):
        assert np.abs(one - other).max() > 1e-5
    status = main(["compensate", "--robot", "ur10e", *files, "--json", "--geometry-only", "--payload", "2"])
    assert status == 2 and "--payload" in capsys.readouterr().err


def test_compensate_knows_no_payload_that_was_not_measured(
    run: Run, words: tuple[str, ...], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [line.rsplit(",", 1)[0] for line in (folder / "fit.csv").read_text().splitlines()]
    (tmp_path / "bare.csv").write_text("\n".join(rows) + "\n")
    others = [str(tmp_path / "bare.csv") if w.endswith("fit.csv") else w for w in words]
    result = run(*others, "--mounting", "0 -1 0", "--output", tmp_path / "e.yaml")
    assert gravity_of(result)["payload"] is None
    write_configurations(tmp_path / "q.csv", Robot.load("ur10e").joint_names, np.zeros((1, 6)))
    files = ("--estimate", str(tmp_path / "e.yaml"), "--targets", str(tmp_path / "q.csv"))
    assert main(["compensate", "--robot", "ur10e", *files, "--json", "--payload", "2"]) == 2
    assert "identify with --payload" in capsys.readouterr().err


def test_plan_and_simulate_take_payload_and_mounting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], folder: Path
) -> None:
    more = ("--payload", "5 0 0 0.1", "--mounting", "1 0 0")
    write_configurations(tmp_path / "q.csv", Robot.load("ur10e").joint_names, np.full((3, 6), 0.4))
    simulate = ("simulate", "--robot", "ur10e", "--plan", str(tmp_path / "q.csv"), "--json", "--sigma", "0")
    results = []
    for words in (more, more[:2], ()):
        assert main([*simulate, *words]) == 0
        results.append(json.loads(capsys.readouterr().out))
    gravity = gravity_of(results[0])
    assert gravity["mounting"] == [1.0, 0.0, 0.0] and gravity["payload"]["mass"] == 5.0
    assert len({json.dumps(r["points"]) for r in results}) == 3
    plan = (
        "plan",
        "--robot",
        "ur10e",
        "--parameters",
        "offsets",
        "--configurations",
        "8",
        "--starts",
        "1",
        "--json",
    )
    plan = (*plan, "--test-pose", "0.4 -1 1 0.5 0.5 0", "--unknown", "base,tool")
    promised = []
    for words in (more, ()):
        assert main([*plan, *words, "--candidates", str(folder / "candidates.csv")]) == 0
        promised.append(json.loads(capsys.readouterr().out)["predicted_accuracy"])
    assert promised[0] != promised[1]
    assert main([*plan, "--error-model", "paper", *more]) == 2
    assert "--error-model typical" in capsys.readouterr().err
