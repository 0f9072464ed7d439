# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""cell.yaml: what is read, what is refused, and the pieces of problems that come of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib_planner import Robot
from calib_planner.cli import parser
from calib_planner.errors import FileFormatError
from calib_planner.io import CELL_KEYS, ROS_KEYS, Cell, read_cell, write_cell
from calib_planner.planning import MinimumHeight
from calib_planner.tracker import Isotropic, LaserTracker


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the files that a cell names, and one for cells beside them."""
    config = Path(__file__).resolve().parents[2] / "config"
    (tmp_path / "arm.yaml").write_text((config / "robots" / "planar_2r.yaml").read_text())
    (tmp_path / "low.yaml").write_text("minimum_height: {height: 0.2, links: false}\n")
    (tmp_path / "tracker.yaml").write_text("type: laser_tracker\nstation: [4, 0, 1]\nup: [0, 0, 1]\n")
    (tmp_path / "cells").mkdir()
    return tmp_path


def cell_of(folder: Path, text: str) -> Cell:
    path = folder / "cells" / "cell.yaml"
    path.write_text(text)
    return read_cell(path)


def test_every_key_is_read_and_paths_are_from_the_file(folder: Path) -> None:
    cell = cell_of(
        folder,
        "robot: ../arm.yaml\nbase-link: base\ntip-link: tool0\ntargets: [[60mm, 0, -0.09], [0, 1cm, 0]]\n"
        "parameters: full\nunknown: base,tool\npayload: [3kg, 0, 0, 50mm]\nmounting: [1, 0, 0]\n"
        "instrument: ../tracker.yaml\nconstraints: ../low.yaml\nerror-model: paper\naccuracy-frame: robot\n"
        "required-accuracy: 0.1mm\ntest-pose: [[0, 90], [10, 20]]\nunits: mm,deg\n"
        "speed-share: 0.3\nsettle: 500ms\ndwell: 2\nbudget: 40\nvalidation: 5\nstore-folder: ../store\n"
        "joint-topics: rail/joint_states, arm/joint_states\ntracker-topics: [tracker/one]\n"
        "tracker-frames: ball\ntracker-state-topics: tracker/locked\ncontroller: arm/follow_joint_trajectory\n"
        "moveit-group: arm\nbase-frame: base\n",
    )
    at = str(folder / "cells" / "..")
    assert cell == Cell(
        path=str(folder / "cells" / "cell.yaml"),
        robot=f"{at}/arm.yaml",
        base_link="base",
        tip_link="tool0",
        targets=((0.06, 0.0, -0.09), (0.0, 0.01, 0.0)),
        parameters=("full",),
        unknown=("base", "tool"),
        payload=(3.0, 0.0, 0.0, 0.05),
        mounting=(1.0, 0.0, 0.0),
        instrument=f"{at}/tracker.yaml",
        constraints=f"{at}/low.yaml",
        error_model="paper",
        accuracy_frame="robot",
        required_accuracy=1e-4,
        test_pose=((0.0, 90.0), (10.0, 20.0)),
        units=("mm", "deg"),
        speed_share=0.3,
        settle=0.5,
        dwell=2.0,
        budget=40,
        validation=5,
        store_folder=f"{at}/store",
        joint_topics=("rail/joint_states", "arm/joint_states"),
        tracker_topics=("tracker/one",),
        tracker_frames=("ball",),
        tracker_state_topics=("tracker/locked",),
        controller="arm/follow_joint_trajectory",
        moveit_group="arm",
        base_frame="base",
    )
    assert np.allclose(cell.load_test_poses(Robot.load("planar_2r")), np.radians([[0, 90], [10, 20]]))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "field", "value"),
    [
        ("targets: [0.1, 0, 0]", "targets", ((0.1, 0.0, 0.0),)),
        ("targets: 60mm 0 0.1", "targets", ((0.06, 0.0, 0.1),)),
        ("targets: ['60mm 0 0', '0, 1, 2']", "targets", ((0.06, 0.0, 0.0), (0.0, 1.0, 2.0))),
        ("targets: [60mm, 0, 0.1]", "targets", ((0.06, 0.0, 0.1),)),
        ("sigma: 20 µm", "sigma", 2e-5),
        ("sigma: 2e-5", "sigma", 2e-5),
        ("payload: 12", "payload", (12.0,)),
        ("payload: 500g", "payload", (0.5,)),
        ("mounting: ceiling", "mounting", "ceiling"),
        ("mounting: 0 1 0", "mounting", (0.0, 1.0, 0.0)),
        ("unknown: [base, tool]", "unknown", ("base", "tool")),
        ("couple: j3 += j2", "couple", ("j3+=j2",)),
        ("couple: [j3-=j2, j6+=0.1*j5]", "couple", ("j3-=j2", "j6+=0.1*j5")),
        ("unknown: none", "unknown", ("none",)),
        ("robot: kuka_kr270", "robot", "kuka_kr270"),
        ("test-pose: 0 -1.5 2", "test_pose", ((0.0, -1.5, 2.0),)),
    ],
)
def test_forms_of_values(folder: Path, text: str, field: str, value: object) -> None:
    assert getattr(cell_of(folder, text), field) == value


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("robt: planar_2r", ["robt", "did you mean 'robot'"]),
        ("tip_link: tool0", ["did you mean 'tip-link'"]),
        ("robot: arm.yaml", ["robot", "'arm.yaml'", "planar_2r", "from the folder of the file"]),
        ("instrument: none.yaml", ["instrument", "a file that is there"]),
        ("sigma: 3ft", ["sigma", "'3ft'", "m, cm, mm, um"]),
        ("sigma: true", ["sigma", "a finite number"]),
        ("targets: [1, 2]", ["targets", "3 numbers"]),
        ("targets: [[1, 2, 3], [1, 2]]", ["targets[1]", "3 numbers"]),
        ("payload: [1, 2]", ["payload", "1 or 4 numbers"]),
        ("mounting: wall", ["mounting", "floor, ceiling or a direction"]),
        ("mounting: [0, 0, 0]", ["mounting", "not zero"]),
        ("couple: [j3=j2]", ["couple[0]", "JOINT+=JOINT"]),
        ("unknown: flange", ["unknown", "base, tool"]),
        ("unknown: [base, 3]", ["unknown", "names with commas between, or a list of names"]),
        ("unknown: 'base,,tool'", ["unknown", "names with commas between, or a list of names"]),
        ("units: inch", ["units", "mm, deg"]),
        ("accuracy-frame: tool", ["accuracy-frame", "world, robot"]),
        ("mounting: floor\nvertical: [0, 0, 1]", ["vertical", "one of the two"]),
        ("speed: 1\nspeed-share: 0.5", ["speed-share", "one of the two"]),
        ("speed-share: 2", ["speed-share", "at most 1"]),
        ("speed: 0", ["speed", "above 0", "rad/s or m/s"]),
        ("settle: 2h", ["settle", "0 to 3600 s"]),
        ("budget: 1", ["budget", "at least 2"]),
        ("budget: 2.5", ["budget", "a whole number"]),
        ("sigma: 1mm\ninstrument: ../tracker.yaml", ["sigma", "one of the two"]),
        ("- robot", ["document", "a YAML file of a cell"]),
    ],
)
def test_what_is_refused(folder: Path, text: str, words: list[str]) -> None:
    with pytest.raises(FileFormatError) as caught:
        cell_of(folder, text)
    assert all(word in str(caught.value) for word in words), caught.value


def test_the_pieces_of_problems(folder: Path) -> None:
    cell = cell_of(
        folder,
        "robot: ../arm.yaml\ntargets: [[0.1, 0, 0.2], [0, 0, 0.1]]\nparameters: offsets\nunknown: base\n"
        "payload: [2, 0, 0, 0.1]\ninstrument: ../tracker.yaml\nconstraints: ../low.yaml\n",
    )
    robot = cell.load_robot()
    np.testing.assert_array_equal(robot.target_offsets, [[0.1, 0, 0.2], [0, 0, 0.1]])
    assert robot.parameter_names == Robot.load("planar_2r").with_parameters("offsets", ["base"]).parameter_names
    noise = cell.load_noise()
    assert isinstance(noise, LaserTracker) and list(noise.station) == [4.0, 0.0, 1.0]
    (low,) = cell.load_constraints(robot)
    assert isinstance(low, MinimumHeight)
    gravity = cell.load_error_model(robot).gravity
    assert gravity is not None and gravity.payload is not None and gravity.payload.mass == 2.0
    assert gravity.vertical == (0.0, 0.0, 1.0), "the instrument's file says which way is up"


def test_a_cell_that_says_little(folder: Path) -> None:
    cell = cell_of(folder, "robot: planar_2r\nsigma: 20um\nmounting: ceiling\n")
    assert cell.load_noise() == Isotropic(2e-5) and cell.load_constraints(cell.load_robot()) == ()
    gravity = cell.load_error_model(cell.load_robot()).gravity
    assert gravity is not None and gravity.mounting == "ceiling" and gravity.payload is None
    with pytest.raises(FileFormatError, match="robot: expected this key"):
        cell_of(folder, "sigma: 20um").load_robot()
    with pytest.raises(FileFormatError, match="mounting: expected an error model with gravity"):
        cell_of(folder, "error-model: paper\nmounting: ceiling").load_error_model(cell.load_robot())


def test_couplings_and_a_vertical_are_of_the_robot_and_its_gravity(folder: Path) -> None:
    cell = cell_of(folder, "robot: planar_2r\ncouple: q2+=q1\nvertical: 0 -1 0\n")
    robot = cell.load_robot()
    np.testing.assert_allclose(robot.motions(np.array([[0.3, 0.5]])), [[0.3, 0.2]])
    gravity = cell.load_error_model(robot).gravity
    assert gravity is not None and gravity.vertical == (0.0, -1.0, 0.0)
    plain = cell_of(folder, "robot: planar_2r\nerror-model: paper\n")
    assert plain.load_error_model(robot).gravity is None


def test_test_poses_of_a_cell_and_of_the_file_that_it_names_are_one_list(folder: Path) -> None:
    (folder / "path.csv").write_text("q1,q2\n30,40\n50,60\n")
    cell = cell_of(folder, "robot: planar_2r\nunits: deg\ntest-pose: 10 20\ntest-path: ../path.csv\n")
    poses = cell.load_test_poses(cell.load_robot())
    np.testing.assert_allclose(np.degrees(np.asarray(poses)), [[10, 20], [30, 40], [50, 60]])
    assert cell_of(folder, "robot: planar_2r").load_test_poses(cell.load_robot()) is None
    cell = cell_of(folder, "robot: planar_2r\ntest-pose: 0 1 2\n")
    with pytest.raises(FileFormatError, match="test-pose: expected 2 numbers a pose: q1, q2, got 3 numbers"):
        cell.load_test_poses(cell.load_robot())


def test_what_is_written_is_read(folder: Path) -> None:
    path = folder / "cells" / "cell.yaml"
    values = {"sigma": 2e-5, "robot": "../arm.yaml", "targets": [[0.1, 0.0, 1 / 3]], "unknown": "base,tool"}
    cell = write_cell(path, values)
    assert cell == read_cell(path) and cell.targets == ((0.1, 0.0, 1 / 3),) and cell.sigma == 2e-5
    text = path.read_text()
    assert text.index("robot:") < text.index("targets:") < text.index("sigma:"), "in the order of the schema"
    assert text.count("\n# ") == len(values)


def test_every_key_is_an_option_of_a_command() -> None:
    """A key that neither a command nor a node takes would be read and forgotten."""
    top = parser()
    commands = next(a.choices for a in top._actions if a.dest == "command")
    flags = {flag for command in commands.values() for flag in command._option_string_actions}
    assert {f"--{key}" for key in CELL_KEYS} - flags == {f"--{key}" for key in ROS_KEYS}
