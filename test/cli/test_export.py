# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner export``: all that can be made of an estimate file, from the file alone."""

from __future__ import annotations

import base64
import json
import re
import shutil
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots import MIXED_URDF, random_configurations

from calib_planner import FileFormatError, Robot
from calib_planner.cli import main
from calib_planner.io import (
    Reading,
    SavedEstimate,
    measurements_text,
    read_configurations,
    read_estimate,
    read_kinematics,
    write_configurations,
    write_measurements,
)
from calib_planner.io.problem import packed
from calib_planner.io.yaml import write_document
from calib_planner.simulation import SimulatedCell, random_deviations
from calib_planner.units import Units


def run(words: str, capsys: pytest.CaptureFixture[str]) -> Any:
    assert main([*words.split(), "--json"]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What identify writes for a URDF with two reflectors whose base is unknown; the inputs are gone then."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "mixed.urdf").write_text(MIXED_URDF)
    robot = Robot.load(folder / "mixed.urdf").with_targets([[0.1, 0.02, 0.3], [-0.05, 0.2, 0.1]])
    cell = SimulatedCell(robot.with_base(np.eye(3), [2.0, 1.0, 0.5]), random_deviations(robot, 1), 1e-5, seed=2)
    data = cell.measure(random_configurations(robot, 20, 3), 1, 4)
    points = np.array(data.p)
    points[3, 1] = np.nan  # a reflector that was not seen
    text = measurements_text(type(data)(data.joint_names, data.q, points, data.std))
    (folder / "points.csv").write_text(text)
    write_measurements(folder / "test.csv", cell.measure(random_configurations(robot, 5, 6), 1, 7))
    words = f"identify --robot {folder}/mixed.urdf --data {folder}/points.csv --validate {folder}/test.csv"
    words += " --unknown base,tool --parameters lengths --sigma 2e-5 --error-model paper"
    words += f" --output {folder}/estimate.yaml"
    words += f" --report {folder}/report.html --urdf-output {folder}/c.urdf --kinematics-output {folder}/k.yaml"
    words += " --test-pose 0.1,0.2,0.3,0.4 --required-accuracy 0.2mm"
    assert main(words.split()) == 0
    for name in ("mixed.urdf", "points.csv", "test.csv"):
        (folder / name).rename(folder / f"was_{name}")
    return folder


def report_data(path: Path) -> dict[str, Any]:
    """What a report holds as JSON, without where it comes from."""
    script = re.search(r'<script[^>]*id="report-data"[^>]*>(.*?)</script>', path.read_text(), re.DOTALL)
    assert script
    data: dict[str, Any] = json.loads(script[1])
    return data | {"provenance": None}


def test_everything_comes_from_the_file_alone(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On another computer, without robot and data: the same files to the bit."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(made / "estimate.yaml", "e.yaml")
    found = run("export e.yaml --urdf u.urdf --kinematics k.yaml --report r.html", capsys)
    assert found["written"] == {"urdf": "u.urdf", "kinematics": "k.yaml", "report": "r.html"}
    assert "base.x" in found["not_written"]
    assert Path("u.urdf").read_text() == (made / "c.urdf").read_text()
    assert Path("k.yaml").read_text() == (made / "k.yaml").read_text()
    assert report_data(Path("r.html")) == report_data(made / "report.html")
    assert main(["export", "e.yaml", "--report", "folder"]) == 0
    assert report_data(Path("folder/calibration.html")) == report_data(made / "report.html")


def test_a_robot_without_urdf_and_all_terms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A shipped robot, gravity and joint functions: the report is that of identify."""
    monkeypatch.chdir(tmp_path)
    robot = Robot.load("planar_2r")
    cell = SimulatedCell(robot, random_deviations(robot, 1), 1e-5, seed=2)
    write_measurements("p.csv", cell.measure(random_configurations(robot, 24, 3), 1, 4))
    first = run("identify --robot planar_2r --data p.csv --output e.yaml --report r.html", capsys)
    again = run("export e.yaml --report again.html --kinematics k.yaml", capsys)
    assert report_data(Path("again.html")) == report_data(Path("r.html"))
    saved = read_estimate("e.yaml")
    q = random_configurations(robot, 5, 9)
    back = read_kinematics("k.yaml", robot.with_targets(saved.calibrated(robot).target_offsets))
    np.testing.assert_allclose(back.positions(q), saved.calibrated(robot).positions(q), atol=1e-12)
    own = {"written", "not_written", "report", "output", "data", "base", "targets"}
    assert {k: v for k, v in again.items() if k not in own} == {k: v for k, v in first.items() if k not in own}
    assert main(["export", "e.yaml", "--urdf", "u.urdf"]) == 2
    assert "from a URDF" in capsys.readouterr().err


@pytest.fixture(scope="module")
def saved(made: Path) -> SavedEstimate:
    return read_estimate(made / "estimate.yaml")


def test_the_estimate_comes_back_whole(saved: SavedEstimate) -> None:
    robot = saved.nominal_robot()
    estimate, problem = saved.estimate(robot), saved.problem(robot)
    assert problem.data.seen.sum() == 39 and problem.required_accuracy == 2e-4
    said = estimate.to_dict()
    learnt = saved.document["error_model"]
    assert said == {k: saved.document[k] for k in said} | {
        "error_model": {k: learnt[k] for k in said["error_model"]}
    }
    assert estimate.validation is not None and estimate.validation.count == 10
    assert np.isfinite(estimate.residuals.spare)


def test_a_campaign_leaves_an_estimate_that_can_be_exported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = "campaign --robot planar_2r --test-pose 0.3,0.8 --required-accuracy 2mm --budget 16 --validation 4"
    found = run(f"{words} --simulate 1 --starts 1 --output {tmp_path}", capsys)
    assert found["verdict"]["level"] in ("PASS", "WARN", "FAIL")
    run(f"export {tmp_path}/estimate.yaml --report {tmp_path}/r.html", capsys)
    told = report_data(tmp_path / "r.html")["estimate"]
    assert told["validation"]["count"] == 4 and told["used"] > 4


def test_coupled_joints_come_back(saved: SavedEstimate) -> None:
    robot = replace(saved, couple=("nod+=spin",)).nominal_robot()
    assert [str(one) for one in robot.couplings] == ["nod+=spin"] and not saved.nominal_robot().couplings


def test_targets_are_corrected_as_compensate_does(
    made: Path, saved: SavedEstimate, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, robot = f"{made}/estimate.yaml", saved.nominal_robot()
    path, one, other = (str(tmp_path / n) for n in ("q.csv", "one.csv", "other.csv"))
    q = random_configurations(robot, 6, 1) / 2.0 * np.where(robot.joint_is_revolute, 180 / np.pi, 1.0)
    write_configurations(path, robot.joint_names, q)
    more = "--degrees --position-only"
    found = run(f"export {file} --targets {path} {one} {more}", capsys)
    again = run(f"compensate --estimate {file} --targets {path} --output {other} {more}", capsys)
    assert Path(one).read_text() == Path(other).read_text()
    assert found["compensation"]["corrected"] == again["corrected"]
    np.testing.assert_allclose(
        read_configurations(one, robot, Reading(otherwise=Units(angle="deg"))),
        again["corrected"],
        rtol=0,
        atol=1e-14,
    )


def test_what_was_corrected_is_shown_to_people(
    made: Path, saved: SavedEstimate, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = saved.nominal_robot()
    write_configurations(tmp_path / "q.csv", robot.joint_names, random_configurations(robot, 3, 1) / 2.0)
    assert main(["export", f"{made}/estimate.yaml", "--targets", f"{tmp_path}/q.csv", f"{tmp_path}/c.csv"]) == 0
    out, err = capsys.readouterr()
    assert f"targets written to {tmp_path}/c.csv" in out
    assert "3 targets, 0 reached" in err  # four joints cannot keep the orientation, too


def test_shown_without_options(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(made / "estimate.yaml")]) == 0
    out = capsys.readouterr().out
    assert "verdict" not in out and "left out, visit by visit" in out and "parameters" in out


@pytest.fixture
def older(saved: SavedEstimate, tmp_path: Path) -> str:
    """A file of a version that did not keep the problem."""
    document = {key: value for key, value in saved.document.items() if key != "problem"}
    write_document(tmp_path / "older.yaml", "estimate", document)
    return str(tmp_path / "older.yaml")


def test_older_files_need_the_robot(older: str, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = f"{older}.urdf"
    assert main(["export", older, "--urdf", out]) == 1
    assert "--robot" in capsys.readouterr().err
    assert main(["export", older, "--robot", str(made / "was_mixed.urdf"), "--urdf", out]) == 0
    assert Path(out).read_text() == (made / "c.urdf").read_text()
    capsys.readouterr()
    assert main(["export", older, "--robot", str(made / "was_mixed.urdf"), "--report", "r.html"]) == 2
    assert "without its measurements" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "status", "word"),
    [
        ("{e} --urdf {e}", 2, "another file than what is read"),
        ("{e} --urdf u --kinematics u", 2, "another file than --urdf"),
        ("{e} --urdf no/folder/u.urdf", 2, "--urdf"),
        ("none.yaml", 1, "none.yaml"),
        ("{e} --targets none.csv out.csv", 1, "none.csv"),
        ("{e} --robot planar_2r --urdf u.urdf", 2, "from a URDF"),
        ("{e} --robot planar_2r --kinematics k.yaml", 2, "joints turn, slide"),
    ],
)
def test_what_is_refused(
    line: str,
    status: int,
    word: str,
    made: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", *line.format(e=made / "estimate.yaml").split()]) == status
    assert word in capsys.readouterr().err and not list(tmp_path.iterdir())


ROBOT = {"source": "x.urdf", "links": ["base", "tip"]}
CUT_SHORT = base64.b64encode(zlib.compress(MIXED_URDF.encode())[:-20]).decode()
DATA = {"visits": 2, "targets": 2, "configurations": packed(np.zeros((2, 4))), "points": packed(np.zeros(12))}


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"measurements": DATA | {"points": packed(np.zeros(11))}}, "points: expected 2 × 2 × 3 of them, got 11"),
        ({"measurements": DATA | {"points": "AAAA"}}, "points: expected base64 of doubles"),
        ({"measurements": DATA | {"configurations": packed(np.full(8, np.nan))}}, "configurations"),
        ({"measurements": DATA}, "residuals"),
        ({"robot": ROBOT | {"text": "AAAA"}}, "compressed text"),
        ({"robot": ROBOT | {"text": CUT_SHORT}}, "compressed text"),
        ({"robot": ROBOT}, "--robot"),
        ({"test_poses": "north"}, "problem"),
        ({"loss": "square"}, "loss"),
    ],
)
def test_a_damaged_problem_is_named(change: dict[str, Any], word: str, saved: SavedEstimate) -> None:
    broken = replace(saved, document=saved.document | {"problem": saved.document["problem"] | change})
    with pytest.raises(FileFormatError) as caught:
        broken.estimate(broken.nominal_robot())
    assert word in str(caught.value) and str(caught.value).startswith(saved.path)
