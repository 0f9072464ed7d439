# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The error model as a user of the commands meets it: keys, tables, files, what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identify_runs import Run, fails, small_data
from robots import MIXED_URDF, SHARED_DATA, mixed, random_configurations
from scipy.optimize import least_squares

from calib_planner import Robot
from calib_planner.cli import main
from calib_planner.error_model import MEANINGS, typical
from calib_planner.io import read_estimate, write_configurations, write_error_model, write_measurements
from calib_planner.io.yaml import read_document, write_document
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
    result = run(*arm, "--output", tmp_path / "e.yaml")
    assert result["accuracy_frame"] == "world"
    alone = result["placement_alone"]
    for part in (result["left_out"], alone["left_out"]):
        assert part.keys() >= {"count", "mean", "rms", "max", "predicted_rms"}
    assert alone["residual_after"].keys() == {"mean", "rms", "max"}
    assert list(alone["parameters"]) == [p["name"] for p in result["parameters"]]
    left = result["left_out"]
    assert left["count"] > 60 and left["mean"] <= left["rms"] <= left["max"]
    assert 0.7 < left["predicted_rms"] / left["rms"] < 1.4
    terms = {t["name"]: t for t in result["error_model"]["terms"]}
    assert list(terms) == ["placement", "gravity", "smooth", "short", "visits", "points"]
    assert all(t.keys() == {"name", "size", "std", "gain", "used"} for t in terms.values())
    assert not [n for n in ("gravity", "smooth", "short") if not terms[n]["used"] and terms[n]["size"]]
    assert result["error_model"]["model"] == read_estimate(tmp_path / "e.yaml").document["error_model"]["model"]
    paper = run(*arm, "--error-model", "paper")
    assert [t["name"] for t in paper["error_model"]["terms"]] == ["placement", "points"]
    assert paper["left_out"]["count"] == left["count"]
    assert run(*arm, "--error-model", "typical")["parameters"] == result["parameters"]


def test_the_irb120_within_what_was_promised(run: Run) -> None:
    """Reseated twice: 36 × 3 points, then 40 rows that decide nothing but the seats."""
    if not FOLDER.is_dir():
        pytest.skip("no measured data beside the repository")
    result = run(
        "--robot", FOLDER / "irb120.urdf", "--data", FOLDER / "calibration.csv", "--parameters", "full",
        "--unknown", "base,tool", "--validate", FOLDER / "test_1.csv",
        "--validate", FOLDER / "test_2.csv", "--validate-target-from", 1,
    )  # fmt: skip
    found = result["validation"]
    assert found["count"] == 40 and found["mean"] <= 1.45e-4
    assert 0.7 < found["predicted_rms"] / found["rms"] < 1.6
    assert found["placement_rms"] > 1.5 * found["rms"]
    assert result["verdict"]["level"] == "PASS" and result["status"] == "ok"


def test_a_table_says_what_each_term_means(
    arm: tuple[str, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    report = tmp_path / "r.html"
    assert main(["identify", *arm, "--error-model", "typical", "--report", str(report)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "left out, visit by visit" in out and "error model: what moves the measured points" in out
    for term, meaning in MEANINGS.items():
        assert term in out and meaning.split()[0] in out
    assert "gain: log score" in out
    assert report.stat().st_size > 10_000


def test_a_model_comes_from_a_file_or_an_estimate(run: Run, arm: tuple[str, ...], tmp_path: Path) -> None:
    write_error_model(tmp_path / "m.yaml", typical())
    named = run(*arm, "--error-model", "typical", "--output", tmp_path / "e.yaml")
    alone = run(*arm, "--error-model", tmp_path / "m.yaml")
    assert [p["value"] for p in alone["parameters"]] == [p["value"] for p in named["parameters"]]
    again = run(*arm, "--error-model", tmp_path / "e.yaml")
    kept = [t["name"] for t in named["error_model"]["terms"] if t["used"]]
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
    assert [r["error_model"] is None for r in results] == [False, True]
    assert results[0]["error_model"] == {
        "terms": read_estimate(tmp_path / "e.yaml").document["error_model"]["terms"]
    }
    nominal = mixed()
    known = read_estimate(tmp_path / "e.yaml").knowledge(nominal)
    (tool,) = known.placed.target_offsets[:1]
    wanted = nominal.with_base(np.eye(3), np.zeros(3)).with_targets([tool]).positions(q)[:, 0]
    points = known.poses(np.array(results[0]["corrected"])).points[:, 0]
    turn, place = known.poses(q).robot.base_pose
    np.testing.assert_allclose((points - place) @ turn, wanted, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("--accuracy-frame", "robot"), "test_poses"),
        (("--accuracy-frame", "robot", "--test-pose", "0 0 0 0"), "test_poses"),
        (("--error-model", "usual"), "usual"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_name(
    arm: tuple[str, ...], capsys: pytest.CaptureFixture[str], words: tuple[str, str], option: str
) -> None:
    status, line = fails(capsys, *arm, *words)
    assert status in (1, 2) and option in line


@pytest.mark.parametrize(
    "option", ["--discrepancy", "--joint-corrections", "--starts", "--iterations", "--folds"]
)
def test_options_of_the_engine_before_are_gone(
    arm: tuple[str, ...], capsys: pytest.CaptureFixture[str], option: str
) -> None:
    assert main(["identify", *arm, option, "5"]) == 2
    assert f"{option}: expected an option of calib-planner identify" in capsys.readouterr().err
    assert main(["identify", "--help"]) == 0
    assert option not in capsys.readouterr().out


def test_an_estimate_of_an_older_version_holds_no_model(
    run: Run, arm: tuple[str, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run(*arm, "--output", tmp_path / "e.yaml")
    document = dict(read_document(tmp_path / "e.yaml", "estimate").value)
    del document["error_model"]
    write_document(tmp_path / "older.yaml", "estimate", document)
    status, line = fails(capsys, *arm, "--error-model", tmp_path / "older.yaml")
    assert status == 1 and "error_model" in line and "older version: identify again" in line
    assert fails(capsys, *arm, "--error-model", tmp_path / "absent.yaml")[0] in (1, 2)


def test_paper_on_the_planar_robot(run: Run, tmp_path: Path) -> None:
    write_measurements(tmp_path / "p.csv", small_data())
    words = ("--robot", "planar_2r", "--data", tmp_path / "p.csv", "--sigma", 5e-5, "--test-pose", "0.2 0.4")
    paper = run(*words, "--error-model", "paper")
    robot = Robot.load("planar_2r")
    data = small_data()

    def residuals(deviations: np.ndarray) -> np.ndarray:
        moved = robot.with_deviations(dict(zip(robot.parameter_names, deviations, strict=True)))
        return np.asarray((moved.positions(data.q) - data.p).ravel())

    least = least_squares(residuals, np.zeros(len(robot.parameter_names)), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    covariance = 5e-5**2 * np.linalg.inv(least.jac.T @ least.jac)
    deviations, std = ([p[k] for p in paper["parameters"]] for k in ("deviation", "std"))
    np.testing.assert_allclose(deviations, least.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(std, np.sqrt(np.diag(covariance)), rtol=1e-4)
    calibrated = robot.with_deviations(dict(zip(robot.parameter_names, deviations, strict=True)))
    (there,) = calibrated.jacobian(np.array([[0.2, 0.4]]))
    expected = np.sqrt(np.trace(there @ covariance @ there.T))
    assert paper["predicted_accuracy"] == pytest.approx(expected, rel=1e-4)
