"""``calib-planner identify --error-model`` as a user runs it: keys, tables, files, refused combinations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identify_runs import Run, fails, small_data
from robots import MIXED_URDF, SHARED_DATA, mixed, random_configurations

from calib_planner.cli import main
from calib_planner.error_model import typical
from calib_planner.io import read_estimate, write_configurations, write_error_model, write_measurements
from calib_planner.simulation import SimulatedCell

FOLDER = SHARED_DATA / "irb120_tracker"


@pytest.fixture
def arm(tmp_path: Path) -> tuple[str, ...]:
    """A URDF and its measurements before a tracker that stands somewhere, with two reflectors."""
    (tmp_path / "arm.urdf").write_text(MIXED_URDF)
    cell = SimulatedCell(mixed(), {"turn.offset": 0.02, "slide.x": 1e-3, "base.x": 2.0, "base.rz": 2.5})
    write_measurements(tmp_path / "arm.csv", cell.measure(random_configurations(mixed(), 40), 1, 2))
    words = ("--robot", tmp_path / "arm.urdf", "--data", tmp_path / "arm.csv", "--unknown", "base,tool")
    return (*map(str, words), "--parameters", "full")


def test_keys_of_the_contract(run: Run, arm: tuple[str, ...], tmp_path: Path) -> None:
    result = run(*arm, "--error-model", "typical", "--output", tmp_path / "e.yaml")
    assert result["accuracy_frame"] == "world"
    assert result["left_out"].keys() == {"count", "mean", "rms", "max", "predicted_rms"}
    left = result["left_out"]
    assert left["count"] > 60 and left["mean"] <= left["rms"] <= left["max"]
    assert 0.7 < left["predicted_rms"] / left["rms"] < 1.4
    terms = {t["name"]: t for t in result["error_model"]["terms"]}
    assert list(terms) == ["placement", "gravity", "smooth", "short", "visits", "points"]
    assert all(t.keys() == {"name", "size", "std", "gain", "kept"} for t in terms.values())
    assert not [n for n in ("gravity", "smooth", "short") if not terms[n]["kept"] and terms[n]["size"]]
    assert result["error_model"]["model"] == read_estimate(tmp_path / "e.yaml").document["error_model"]["model"]
    plain = run(*arm)
    assert not {"accuracy_frame", "left_out", "error_model"} & plain.keys()


def test_the_irb120_within_what_was_promised(run: Run) -> None:
    """Reseated twice: 36 × 3 points, then 40 rows that decide nothing but the seats."""
    if not FOLDER.is_dir():
        pytest.skip("no measured data beside the repository")
    result = run(
        "--robot", FOLDER / "irb120.urdf", "--data", FOLDER / "calibration.csv", "--parameters", "full",
        "--unknown", "base,tool", "--error-model", "typical", "--validate", FOLDER / "test_1.csv",
        "--validate", FOLDER / "test_2.csv", "--validate-target-from", 1,
    )  # fmt: skip
    found = result["validation"]
    assert found["count"] == 40 and found["mean"] <= 1.45e-4
    assert 0.7 < found["predicted_rms"] / found["rms"] < 1.6
    assert result["verdict"]["level"] == "PASS" and result["status"] == "ok"


def test_a_table_says_what_each_term_means(
    arm: tuple[str, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    report = tmp_path / "r.html"
    assert main(["identify", *arm, "--error-model", "typical", "--report", str(report)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "left out, visit by visit" in out and "error model: what moves the measured points" in out
    for words in ("joints that give way", "gears and encoders", "repeatability of the robot"):
        assert words in out
    assert report.stat().st_size > 10_000


def test_a_model_comes_from_a_file_or_an_estimate(run: Run, arm: tuple[str, ...], tmp_path: Path) -> None:
    write_error_model(tmp_path / "m.yaml", typical())
    named = run(*arm, "--error-model", "typical", "--output", tmp_path / "e.yaml")
    alone = run(*arm, "--error-model", tmp_path / "m.yaml")
    assert [p["value"] for p in alone["parameters"]] == [p["value"] for p in named["parameters"]]
    again = run(*arm, "--error-model", tmp_path / "e.yaml")
    kept = [t["name"] for t in named["error_model"]["terms"] if t["kept"]]
    assert [t["name"] for t in again["error_model"]["terms"]] == kept


def test_compensate_uses_the_mean(run: Run, arm: tuple[str, ...], tmp_path: Path, capsys: Any) -> None:
    run(*arm, "--error-model", "typical", "--output", tmp_path / "e.yaml")
    q = random_configurations(mixed(), 5) / 3.0
    write_configurations(tmp_path / "q.csv", mixed().joint_names, q)
    words = ["compensate", *arm[:2], "--estimate", str(tmp_path / "e.yaml"), "--targets", str(tmp_path / "q.csv")]
    results = []
    for more in ((), ("--geometry-only",)):
        assert main([*words, "--position-only", "--json", *more]) == 0
        results.append(json.loads(capsys.readouterr().out))
    assert [r["error_model"] for r in results] == [True, False]
    assert not any(r["joint_corrections"] for r in results)
    nominal = mixed()
    known = read_estimate(tmp_path / "e.yaml").knowledge(nominal)
    (tool,) = np.array(read_estimate(tmp_path / "e.yaml").targets)[:1]
    wanted = nominal.with_base(np.eye(3), np.zeros(3)).with_targets([tool]).positions(q)[:, 0]
    points = known.poses(np.array(results[0]["corrected"])).points[:, 0]
    turn, place = known.poses(q).robot.base_pose
    np.testing.assert_allclose((points - place) @ turn, wanted, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("--discrepancy", "off"), "--discrepancy"),
        (("--joint-corrections", "off"), "--joint-corrections"),
        (("--loss", "robust"), "--loss"),
        (("--prior", "typical"), "--prior"),
        (("--starts", "5"), "--starts"),
        (("--iterations", "9"), "--iterations"),
        (("--folds", "5"), "--folds"),
        (("--accuracy-frame", "robot"), "test_poses"),
    ],
)
def test_refused_beside_an_error_model(
    arm: tuple[str, ...], capsys: pytest.CaptureFixture[str], words: tuple[str, str], option: str
) -> None:
    status, line = fails(capsys, *arm, "--error-model", "typical", *words)
    assert status == 2 and option in line


def test_a_frame_needs_an_error_model(arm: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    status, line = fails(capsys, *arm, "--accuracy-frame", "robot")
    assert status == 2 and "--error-model" in line


def test_an_estimate_without_a_model_is_none(
    run: Run, arm: tuple[str, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run(*arm, "--output", tmp_path / "plain.yaml")
    status, line = fails(capsys, *arm, "--error-model", tmp_path / "plain.yaml")
    assert status in (1, 2) and "error_model" in line and "identify --error-model" in line
    assert fails(capsys, *arm, "--error-model", tmp_path / "absent.yaml")[0] in (1, 2)


def test_paper_on_the_planar_robot(run: Run, tmp_path: Path) -> None:
    write_measurements(tmp_path / "p.csv", small_data())
    words = ("--robot", "planar_2r", "--data", tmp_path / "p.csv", "--sigma", 5e-5, "--test-pose", "0.2 0.4")
    paper = run(*words, "--error-model", "paper")
    plain = run(*words, "--discrepancy", "off", "--joint-corrections", "off", "--starts", 0)
    for a, b in zip(paper["parameters"], plain["parameters"], strict=True):
        assert a["value"] == pytest.approx(b["value"], abs=1e-9) and a["std"] == pytest.approx(b["std"], rel=1e-6)
    assert paper["predicted_accuracy"] == pytest.approx(plain["predicted_accuracy"], rel=1e-6)
