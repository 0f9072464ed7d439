# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""--cell: options for every command from one file, which flags override."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest

from calib_planner.cli import main
from calib_planner.cli.main import parse

CELL = """robot: planar_2r
targets: [[0.1, 0, 0], [0, 0.1, 0]]
unknown: base,tool
sigma: 20um
mounting: ceiling
units: mm,deg
test-pose: [[10, 40], [-20, 60]]
required-accuracy: 0.2mm
"""


@pytest.fixture
def cell(tmp_path: Path) -> str:
    path = tmp_path / "cell.yaml"
    path.write_text(CELL)
    return str(path)


def arguments(*words: str) -> argparse.Namespace:
    return parse(words, words[0])


def test_a_command_takes_the_options_that_it_has(cell: str) -> None:
    args = arguments("plan", "--cell", cell, "--configurations", "3")
    assert args.robot == "planar_2r" and args.unknown == "base,tool" and args.sigma == 2e-5
    assert args.targets == [[0.1, 0, 0], [0, 0.1, 0]] and args.test_pose == [[10, 40], [-20, 60]]
    assert args.degrees and args.mounting == "ceiling" and not hasattr(args, "required_accuracy")
    args = arguments("identify", f"--cell={cell}", "--data", "x.csv")
    assert args.millimetres and args.degrees and args.required_accuracy == 2e-4
    args = arguments("compensate", "--cell", cell, "--estimate", "e", "--targets", "t.csv")
    assert args.joint_targets == "t.csv" and args.targets is None and args.robot == "planar_2r"
    assert arguments("robots", "show", "--cell", cell).robot == "planar_2r"
    assert arguments("compare", "--cell", cell, "--configurations", "3", "4").configurations == [3, 4]


def test_flags_win(cell: str, tmp_path: Path) -> None:
    words = ("identify", "--cell", cell, "--data", "x.csv")
    args = arguments(*words, "--sigma", "1e-3", "--targets=1 2 3", "--unknown", "none", "--robot", "kuka_kr270")
    assert args.sigma == 1e-3 and args.targets == [[1, 2, 3]] and args.unknown == "none"
    assert args.robot == "kuka_kr270"
    assert arguments(*words, "--instrument", "i.yaml").sigma is None, "which is stated in place of the noise"
    assert arguments(*words, "--vertical", "0 0 1").mounting is None
    args = arguments(*words, "--units", "m,rad")
    assert not args.degrees and not args.millimetres
    assert arguments("robots", "show", "ur10e", "--cell", cell).robot == "ur10e"
    (tmp_path / "urdf.yaml").write_text("robot: cell.yaml\ntip-link: tool0\n")
    args = arguments("plan", "--cell", str(tmp_path / "urdf.yaml"), "--configurations", "2", "--robot", "ur10e")
    assert args.robot == "ur10e" and args.tip_link is None, "the link is of the cell's robot"
    (tmp_path / "coupled.yaml").write_text("robot: planar_2r\ncouple: [q2+=q1]\n")
    args = arguments("simulate", "--cell", str(tmp_path / "coupled.yaml"), "--plan", "p.csv")
    assert list(map(str, args.couple)) == ["q2+=q1"]


def test_the_same_answer_as_with_the_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(CELL.replace("mounting: ceiling\n", ""))
    words = ("--configurations", "8", "--starts", "1", "--json")
    assert main(["plan", "--cell", str(path), *words]) == 0
    one = json.loads(capsys.readouterr().out)
    options = ["--robot", "planar_2r", "--unknown", "base,tool", "--sigma", "2e-5", "--degrees"]
    more = ("--targets", "0.1 0 0", "--targets", "0 0.1 0", "--test-pose", "10 40", "--test-pose", "-20 60")
    assert main(["plan", *options, *more, *words]) == 0
    other = json.loads(capsys.readouterr().out)
    assert one | {"seconds": 0} == other | {"seconds": 0}


def test_a_cell_in_which_all_places_are_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What identify takes as "do not look for places" is nothing unknown for the others."""
    (tmp_path / "cell.yaml").write_text("robot: planar_2r\nunknown: none\ntest-pose: [0.2, 0.9]\n")
    assert (
        main(["plan", "--cell", str(tmp_path / "cell.yaml"), "--configurations", "3", "--starts", "1", "--json"])
        == 0
    )
    assert json.loads(capsys.readouterr().out)["parameters"] == ["l1", "l2", "dq1", "dq2"]


def test_a_cell_that_cannot_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cell.yaml").write_text("robbot: planar_2r\n")
    for path, word in (("cell.yaml", "did you mean 'robot'"), ("none.yaml", "No such file")):
        assert main(["plan", "--cell", str(tmp_path / path), "--configurations", "2", "--json"]) == 1
        out, err = capsys.readouterr()
        assert word in err and json.loads(out)["error"]["field"].startswith(str(tmp_path / path))
