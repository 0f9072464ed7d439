# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Bad input: exit status, one line that names what is wrong and what is valid, nothing on stdout."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from calib_planner.cli import main, parser
from calib_planner.cli.usage import bind_negative, refuse_unquoted_numbers
from calib_planner.identification import solver

PLAN = "plan --robot planar_2r --starts 2 --configurations"
IDENTIFY = "identify --robot planar_2r --data"
SIMULATE = "simulate --robot planar_2r --plan"

FILES = {
    "good.csv": "q1,q2,x1,y1,z1\n0,0,1.8,0,0\n0.5,0.7,1.17,1.22,0\n1,-1,1.34,0.84,0\n",
    "two.csv": "q1,q2,x1,y1,z1,x2,y2,z2\n0,0,1.8,0,0,1.8,0,0\n0,1,1.4,0.7,0,1.4,0.7,0\n",
    "one_row.csv": "q1,q2,x1,y1,z1\n0,0,1.8,0,0\n",
    "unseen.csv": "q1,q2,x1,y1,z1\n0,0,,,\n",
    "word.csv": "q1,q2,x1,y1,z1\n0,zero,1.8,0,0\n",
    "nan.csv": "q1,q2,x1,y1,z1\n0,nan,1.8,0,0\n",
    "joints.csv": "q1,q3,x1,y1,z1\n0,0,1.8,0,0\n",
    "two_rows.csv": "q1,q2,x1,y1,z1\n0,0,1.8,0,0\n0.5,0.7,1.17,1.22,0\n",
    "alike.csv": "q1,q2,x1,y1,z1\n" + "0.5,0.7,1.17,1.22,0\n" * 9,
    "mm.csv": "q1,q2,x1,y1,z1\n0,0,1800,0,0\n0.5,0.7,1170,1220,0\n1,-1,1340,840,0\n",
    "cm.csv": "q1,q2,x1,y1,z1\n0,0,180,0,0\n0.5,0.7,117,122,0\n1,-1,134,84,0\n",
    "inch.csv": "q1,q2,x1 [in],y1 [in],z1 [in]\n0,0,70.8,0,0\n0.5,0.7,46,48,0\n",
    "inf.csv": "q1,q2,x1,y1,z1\n0,0,inf,0,0\n",
    "empty.csv": "",
    "header.csv": "q1,q2,x1,y1,z1\n",
    "good.db3": "q1,q2,x1,y1,z1\n0,0,1.8,0,0\n",
    "zero.yaml": "parameters: {l1: {std: 0}}\n",
    "other.yaml": "parameters: {l9: {std: 1.0e-3}}\n",
    "tags.yaml": "parameters: {l1: !!python/object/apply:os.getcwd []}\n",
    "bad.urdf": "<robot name='x'><link",
    "empty.urdf": "<robot name='x'/>",
    "other.xml.urdf": "<sdf/>",
    "bad.yaml": "joints: [",
    "keys.yaml": "joints: []\ncolour: red\n",
    "plan.yaml": "format: calib_planner/plan\nrobot: planar_2r\n",
}

CASES = {
    # wrong usage: 2
    "no command": ("", 2, ["COMMAND", "identify", "plan"]),
    "unknown command": ("calibrate", 2, ["calibrate", "identify"]),
    "mistyped command": ("identfy --data good.csv", 2, ["'identfy'", "did you mean identify?"]),
    "mistyped option": (f"{PLAN} 2 --tset-pose 0,0", 2, ["--tset-pose", "did you mean --test-pose?"]),
    "mistyped choice": (f"{IDENTIFY} good.csv --loss robost", 2, ["--loss", "did you mean robust?"]),
    "mistyped action": ("robots shwo planar_2r", 2, ["'shwo'", "did you mean show?"]),
    "pose without quotes": (f"{PLAN} 2 --test-pose -0.5 0.2", 2, ['quote it: --test-pose "-0.5 0.2"']),
    "negative number inside": (f"{PLAN} 2 --test-pose 0 -60", 2, ['quote it: --test-pose "0 -60"']),
    "unknown unit": (f"{PLAN} 2 --test-pose 0,0 --sigma 3ft", 2, ["--sigma", "m, cm, mm, um", "'3ft'"]),
    "decimal comma": (f"{PLAN} 2 --test-pose 0,0 --sigma 0,3mm", 2, ["--sigma", "use a decimal point"]),
    "two sizes": (f"{PLAN} 2 --accuracy 1mm", 2, ["--accuracy", "one of the two", "--configurations"]),
    "unknown flag": (f"{PLAN} 2 --test-pose 0,0 --colour 3", 2, ["--colour"]),
    "reflector in millimetres": (
        f"{PLAN} 2 --test-pose 0,0 --targets 60,20,90",
        2,
        ["--targets", "110 m", "millimetres?"],
    ),
    "jobs for sizes": (
        f"{PLAN[:-17]} --test-pose 0,0 --measurements 6 --jobs 2",
        2,
        ["--jobs", "--configurations"],
    ),
    "no jobs": (f"{PLAN} 2 --test-pose 0,0 --jobs 0", 2, ["--jobs", "from 1 to"]),
    "abbreviated flag": (f"{PLAN} 2 --test-po 0,0", 2, ["--test-po"]),
    "no robot": ("plan --configurations 2", 2, ["--robot"]),
    "no test pose": (f"{PLAN} 2", 2, ["--test-pose", "q1, q2", "--test-path"]),
    "robot name": (
        "plan --robot planar_2 --configurations 2 --test-pose 0,0",
        2,
        ["robot", "'planar_2'", "kuka_kr270", "did you mean 'planar_2r'"],
    ),
    "parameter name": (f"{PLAN} 2 --test-pose 0,0 --parameters l1,l3", 2, ["parameters", "'l3'", "dq1"]),
    "parameter twice": (f"{PLAN} 2 --test-pose 0,0 --parameters l1,l1", 2, ["l1", "at most once"]),
    "unknown unknown": (f"{PLAN} 2 --test-pose 0,0 --unknown flange", 2, ["'flange'", "base, tool"]),
    "pose of words": (f"{PLAN} 2 --test-pose zero", 2, ["--test-pose", "expected numbers", "zero"]),
    "pose too long": (f"{PLAN} 2 --test-pose 0,0,0", 2, ["--test-pose", "3 numbers", "2 numbers: q1, q2"]),
    "pose is NaN": (f"{PLAN} 2 --test-pose 0,nan", 2, ["--test-pose", "finite"]),
    "pose in degrees": (f"{PLAN} 2 --test-pose 0,90", 2, ["joint q2", "limits", "degrees"]),
    "weights": (f"{PLAN} 2 --test-pose 0,0 --weights 1,2", 2, ["weights", "(2,)", "shape (1)"]),
    "weights below zero": (f"{PLAN} 2 --test-pose 0,0 --weights -1", 2, ["weights", ">= 0"]),
    "no configurations": (f"{PLAN} 0 --test-pose 0,0", 2, ["configurations", "0", "from 1"]),
    "half a configuration": (f"{PLAN} 1.5 --test-pose 0,0", 2, ["--configurations", "1.5"]),
    "sigma": (f"{PLAN} 2 --test-pose 0,0 --sigma -1", 2, ["sigma", "-1", " m"]),
    "sigma is NaN": (f"{PLAN} 2 --test-pose 0,0 --sigma nan", 2, ["sigma", "nan"]),
    "time limit": (f"{PLAN} 2 --test-pose 0,0 --time-limit 0", 2, ["time_limit", "seconds > 0"]),
    "seed": (f"{PLAN} 2 --test-pose 0,0 --seed -1", 2, ["seed", "whole number from 0"]),
    "criterion": (f"{PLAN} 2 --test-pose 0,0 --criterion z", 2, ["--criterion", "test_pose"]),
    "targets": (f"{PLAN} 2 --test-pose 0,0 --targets 1,2", 2, ["--targets", "3 numbers: x, y, z"]),
    "plan's ending": (f"{PLAN} 2 --test-pose 0,0 --output p.txt", 2, ["--output", ".yaml or .csv"]),
    "output folder": (f"{PLAN} 2 --test-pose 0,0 --output no/p.csv", 2, ["--output", "No such file"]),
    "loss": (f"{IDENTIFY} good.csv --loss square", 2, ["--loss", "linear"]),
    "sigma and instrument": (
        f"{IDENTIFY} good.csv --sigma 1 --instrument x",
        2,
        ["--instrument", "one of the two", "--sigma"],
    ),
    "sigma of data": (f"{IDENTIFY} good.csv --sigma 0", 2, ["sigma", "(0, inf] m"]),
    "required accuracy": (f"{IDENTIFY} good.csv --required-accuracy nan", 2, ["required_accuracy", "nan"]),
    "file twice": (f"{IDENTIFY} good.csv --data ./good.csv", 2, ["--data", "good.csv again", "no measurement"]),
    "fitted and held out": (f"{IDENTIFY} good.csv --validate good.csv", 2, ["--validate", "proves nothing"]),
    "prior includes": (f"{IDENTIFY} good.csv --prior-includes tool", 2, ["--prior-includes", "an estimate"]),
    "topic without bag": (f"{IDENTIFY} good.csv --point-topic x", 2, ["--point-topic", "a bag"]),
    "no URDF": (f"{IDENTIFY} good.csv --urdf-output x.urdf", 2, ["--urdf-output", "from a URDF"]),
    "target from": (f"{IDENTIFY} good.csv --validate-target-from 1", 2, ["--validate FILE"]),
    "true name": (f"{SIMULATE} good.csv --true l9=1", 2, ["deviations", "'l9'", "l1"]),
    "true text": (f"{SIMULATE} good.csv --true l1", 2, ["NAME=VALUE"]),
    "true NaN": (f"{SIMULATE} good.csv --true l1=nan", 2, ["--true l1", "finite"]),
    "length error": (f"{SIMULATE} good.csv --length-error -1", 2, ["--length-error"]),
    "demo folder": ("demo --output good.csv/x", 2, ["output", "choose another"]),
    # the work could not be done: 1
    "too few configurations": (f"{PLAN} 1 --test-pose 0,0", 1, ["1 configurations", "at least 2"]),
    "no such file": (f"{IDENTIFY} none.csv", 1, ["none.csv", "No such file", "check the path"]),
    "no such plan": (f"{SIMULATE} none.yaml", 1, ["none.yaml", "No such file"]),
    "cell": (f"{IDENTIFY} word.csv", 1, ["word.csv", "line 2, column q2", "'zero'", "finite number"]),
    "NaN in a cell": (f"{IDENTIFY} nan.csv", 1, ["nan.csv", "line 2, column q2", "'nan'"]),
    "joint name": (f"{IDENTIFY} joints.csv", 1, ["no column q2", "q1, q3", "rename or add them"]),
    "options of old": (f"{IDENTIFY} good.csv --folds 4", 2, ["an unknown option", "--folds"]),
    "error model": (f"{IDENTIFY} good.csv --error-model nowhere.yaml", 1, ["nowhere.yaml"]),
    "accuracy frame": (f"{IDENTIFY} good.csv --accuracy-frame tool", 2, ["--accuracy-frame", "world", "robot"]),
    "too few points": (
        f"{IDENTIFY} one_row.csv --error-model paper",
        1,
        ["3 equations for 4 parameters", "at least 2"],
    ),
    "nothing measured": (f"{IDENTIFY} unseen.csv", 1, ["no measured points"]),
    "targets of the data": (
        f"{IDENTIFY} two.csv --unknown none",
        1,
        ["2 targets", "--targets", "--unknown tool"],
    ),
    "validation of other targets": (
        f"{IDENTIFY} good.csv --validate two.csv",
        1,
        ["two.csv", "2 targets", "at most 1"],
    ),
    "all alike": (
        f"{IDENTIFY} alike.csv --unknown base,tool",
        1,
        ["at least 4 configurations", "several joints"],
    ),
    "centimetres": (
        f"{IDENTIFY} cm.csv",
        1,
        ["cm.csv", "metres and radians", "in centimetres", "add --units cm"],
    ),
    "units that are none": (f"{IDENTIFY} good.csv --units furlong", 2, ["--units", "furlong", "mm,deg"]),
    "separator that is none": (f"{IDENTIFY} good.csv --separator x", 2, ["--separator", "semicolon"]),
    "columns too few": (f"{IDENTIFY} good.csv --columns 'q1'", 1, ["--columns", "5 names", "'-'"]),
    "units against the file": (
        f"{IDENTIFY} inch.csv --units mm",
        1,
        ["inch.csv", "--units mm", "in, as the file"],
    ),
    "points for two files": (f"{IDENTIFY} good.csv --data two.csv --points mm.csv", 2, ["--points", "2 files"]),
    "match without points": (f"{IDENTIFY} good.csv --match name", 2, ["--match", "--points FILE"]),
    "metres as millimetres": (
        f"{IDENTIFY} good.csv --millimetres",
        1,
        ["good.csv", "too close together", "leave out --millimetres"],
    ),
    "infinity in a cell": (f"{IDENTIFY} inf.csv", 1, ["inf.csv", "line 2, column x1", "'inf'"]),
    "empty file": (f"{IDENTIFY} empty.csv", 1, ["empty.csv", "an empty file", "column names"]),
    "header only": (f"{IDENTIFY} header.csv", 1, ["header.csv", "a header only"]),
    "folder that is no bag": (f"{IDENTIFY} .", 1, ["rosbag"]),
    "no bag": (f"{IDENTIFY} good.db3", 1, ["bag"]),
    "no such prior": (f"{IDENTIFY} good.csv --prior none.yaml", 1, ["none.yaml", "No such file"]),
    "prior without std": (
        f"{IDENTIFY} good.csv --prior zero.yaml",
        1,
        ["zero.yaml", "l1.std", "standard deviation"],
    ),
    "prior of another": (f"{IDENTIFY} good.csv --prior other.yaml", 1, ["l9", "one of: l1, l2, dq1, dq2"]),
    "prior with tags": (f"{IDENTIFY} good.csv --prior tags.yaml", 1, ["tags.yaml", "YAML", "prior knowledge"]),
    "prior that is a plan": (f"{IDENTIFY} good.csv --prior plan.yaml", 1, ["plan.yaml", "format"]),
    "no such instrument": (f"{IDENTIFY} good.csv --instrument none.yaml", 1, ["none.yaml"]),
    "validation too short": (
        f"{IDENTIFY} good.csv --validate one_row.csv --validate-target-from 1",
        1,
        ["1 validation rows", "nothing is left"],
    ),
    "URDF syntax": ("robots show bad.urdf", 1, ["bad.urdf", "XML", "well-formed"]),
    "URDF without joints": ("robots show empty.urdf", 1, ["empty.urdf"]),
    "not a URDF": ("robots show other.xml.urdf", 1, ["<sdf>", "<robot>"]),
    "YAML syntax": ("robots show bad.yaml", 1, ["bad.yaml", "readable YAML"]),
    "YAML keys": ("robots show keys.yaml", 1, ["keys.yaml", "'colour'", "joints"]),
    "plan without keys": (f"{SIMULATE} plan.yaml", 1, ["plan.yaml", "no key 'criterion'"]),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command, status, words = CASES[case]
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    assert main(command.split()) == status
    out, err = capsys.readouterr()
    assert out == "" and "Traceback" not in err
    assert all(word in err for word in words), err
    if status == 1:
        assert err.count("\n") == 1 and err.startswith(f"calib-planner {command.split()[0]}: ")


def test_an_estimate_that_does_not_settle_is_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, output = tmp_path / "good.csv", tmp_path / "estimate.yaml"
    path.write_text(FILES["good.csv"])
    settled = solver._fit
    monkeypatch.setattr(solver, "_fit", lambda *a: replace(settled(*a), converged=False))
    words = f"{IDENTIFY} {path} --output {output}"
    assert main(words.split()) == 1
    out, err = capsys.readouterr()
    assert (
        out.startswith("FAIL") and "not_converged" in out and "Nothing was written" in err and not output.exists()
    )


@pytest.mark.parametrize(
    ("line", "status", "wanted"),
    [
        (f"{IDENTIFY} good.csv --loss robost", 2, {"field": "--loss", "got": "'robost'"}),
        (f"{IDENTIFY} good.csv --los robust", 2, {"field": "--los", "advice": "did you mean --loss?"}),
        (f"{IDENTIFY} none.csv", 1, {"field": "none.csv: file", "advice": "check the path"}),
        ("robots show planar", 2, {"field": "robot", "advice": "did you mean 'planar_2r'?"}),
        ("identfy", 2, {"field": "command", "got": "'identfy'"}),
        (f"{PLAN} 1 --test-pose 0,0", 1, {"field": None}),
    ],
)
def test_errors_as_json(
    line: str,
    status: int,
    wanted: dict[str, str | None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One object on stdout; the same line on stderr and the same status as without --json."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.csv").write_text(FILES["good.csv"])
    assert main([*line.split(), "--json"]) == status
    out, err = capsys.readouterr()
    error = json.loads(out)["error"]
    assert error.keys() == {"field", "got", "expected", "advice", "message"}
    assert {key: error[key] for key in wanted} == wanted
    assert err.count("\n") == 1 and err.rstrip().endswith(error["message"])
    assert main(line.split()) == status
    assert capsys.readouterr() == ("", err)


def test_an_answer_is_the_only_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An identification that does not settle is answered with what there is, and its status says so."""
    (tmp_path / "good.csv").write_text(FILES["good.csv"])
    settled = solver._fit
    monkeypatch.setattr(solver, "_fit", lambda *a: replace(settled(*a), converged=False))
    assert main([*f"{IDENTIFY} {tmp_path / 'good.csv'}".split(), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["status"] == "not_converged"


def test_numbers_that_need_no_quotes(capsys: pytest.CaptureFixture[str]) -> None:
    """A single number, numbers with commas, and several values of an option that takes several."""
    top = parser("compare")
    for line in ("--weights -1", "--test-pose -1,2", "--configurations 3 4 --test-pose=1,-2"):
        refuse_unquoted_numbers(top, ["compare", *line.split()])


def test_bind_negative() -> None:
    assert bind_negative(["--a", "-1", "--b", "-.5,2", "-3"]) == ["--a=-1", "--b=-.5,2", "-3"]
    assert bind_negative(["--a=1", "-2", "-h"]) == ["--a=1", "-2", "-h"]


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (f"{PLAN} 2 --test-pose 0,0 --output nowhere/plan.yaml", "--output"),
        (f"{PLAN} 2 --test-pose 0,0 --output folder.yaml", "--output"),
        (f"{PLAN} 2 --test-pose 0,0 --sheet good.csv/sheet", "--sheet"),
        (f"{SIMULATE} joints_only.csv --output nowhere/measured.csv", "--output"),
        ("compensate --estimate good.csv --targets good.csv --output nowhere/x.csv", "--output"),
        ("campaign --robot planar_2r --test-pose 0,0 --required-accuracy 1mm --next nowhere/next.csv", "--next"),
        (
            "campaign --robot planar_2r --test-pose 0,0 --required-accuracy 1mm --simulate 1 --output good.csv/x",
            "--output",
        ),
    ],
)
def test_output_paths_are_looked_at_before_the_work(words, option, tmp_path, monkeypatch, capsys):
    """The work itself is out of order, and nothing is left behind by looking."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.csv").write_text("kept")
    (tmp_path / "joints_only.csv").write_text("q1,q2\n0,0\n1,1\n")
    (tmp_path / "folder.yaml").mkdir()
    before = sorted(p.name for p in tmp_path.iterdir())
    for place in ("plan.find_plan", "simulate.SimulatedCell", "compensate.corrected", "campaign._problem"):
        monkeypatch.setattr(f"calib_planner.cli.{place}", None, raising=False)
    assert main(words.split()) == 2
    assert option in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == before
    assert (tmp_path / "good.csv").read_text() == "kept"


def test_an_instrument_in_millimetres_is_told(capsys):
    assert main(f"{PLAN} 2 --test-pose 0,0 --sigma 0.03 --json".split()) == 0
    assert "--sigma: 30 mm" in capsys.readouterr().err
    assert main(f"{PLAN} 2 --test-pose 0,0 --sigma 0.001 --json".split()) == 0
    assert "millimetres?" not in capsys.readouterr().err
