# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner identify`` as a user runs it: every option against an independent way to the same numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identify_runs import Run, fails, small_data
from robots import MIXED_URDF, SHARED_DATA, mixed, random_configurations, read_yaml

from calib_planner import Measurements, Robot
from calib_planner.cli import main
from calib_planner.io import read_estimate, write_measurements
from calib_planner.io.kinematics import read_kinematics
from calib_planner.simulation import SimulatedCell
from calib_planner.units import length

PLAIN = ("--error-model", "paper")
"""The paper's white noise alone, so that the results of two ways can be compared."""


def values(result: dict[str, Any], key: str = "value") -> np.ndarray:
    return np.array([np.nan if p[key] is None else p[key] for p in result["parameters"]])


@pytest.fixture
def arm(tmp_path: Path) -> tuple[Path, Path]:
    """A URDF and its measurements before a tracker that stands somewhere, with two reflectors."""
    urdf, data = tmp_path / "arm.urdf", tmp_path / "arm.csv"
    urdf.write_text(MIXED_URDF)
    cell = SimulatedCell(mixed(), {"turn.offset": 0.02, "slide.x": 1e-3, "base.x": 2.0, "base.rz": 2.5})
    write_measurements(data, cell.measure(random_configurations(mixed(), 25), 1, 2))
    return urdf, data


# ── what comes out ───────────────────────────────────────────────────────────────────────────────────


def test_keys_of_the_contract(run: Run, points: Path, tmp_path: Path) -> None:
    held_out = tmp_path / "test.csv"
    write_measurements(held_out, small_data(seed=5))
    result = run(
        "--robot", "planar_2r", "--data", points, "--validate", held_out,
        "--test-pose", "0.2 0.4", "--required-accuracy", 1e-3,
    )  # fmt: skip
    keys = (
        "parameters rank unidentifiable measurements used rejected sigma_estimate residual_before residual_after"
    )
    more = "validation left_out placement_alone error_model accuracy_frame predicted_accuracy status message "
    more += "seconds verdict noise base targets data"
    assert result.keys() >= {*keys.split(), *more.split()}
    keys = {
        "count",
        "mean",
        "median",
        "rms",
        "max",
        "before_mean",
        "predicted_rms",
        "placement_mean",
        "placement_rms",
    }
    assert result["validation"].keys() >= keys
    assert result["left_out"].keys() >= {"count", "mean", "rms", "max", "predicted_rms"}
    for key in ("validation", "left_out"):
        assert result[key]["count"] == 12 and result[key]["mean"] < 1e-4
    assert result["validation"]["before_mean"] > 1e-3 and result["residual_before"]["mean"] > 1e-3
    assert result["verdict"]["level"] == "PASS"
    codes = [r["code"] for r in result["verdict"]["reasons"]]
    assert codes.count("required_accuracy") == 2 and codes.count("left_out") == 1
    assert result["data"] == [{"file": str(points), "rows": 12}]
    assert result["targets"] == [[0, 0, 0]] and set(result["base"].values()) == {0}


def test_the_verdict_comes_first_and_fail_is_an_answer(run: Run, points: Path, tmp_path: Path) -> None:
    output = tmp_path / "estimate.yaml"
    words = ("--robot", "planar_2r", "--data", points, "--test-pose", "0.2 0.4", "--output", output)
    out, err = run(*words, shown=True)
    assert out.startswith("PASS") and "visits left out in turn" in out and str(output) in err
    out, _ = run(*words, "--required-accuracy", 1e-9, shown=True)
    assert out.startswith("FAIL") and "µm are required" in out and "required: 0.001" in out
    assert out.index("FAIL") < out.index("distance between measured") < out.index("Noise") < out.index("± std")
    saved = read_estimate(output)
    assert saved.verdict is not None and saved.verdict.level == "FAIL"
    assert saved.document["required_accuracy"] == 1e-9


def test_rejected_points_are_found_in_their_file(run: Run, points: Path, tmp_path: Path) -> None:
    """Rows from 0 over all files; the table names line and file, which has a comment and a blank line here."""
    other = tmp_path / "other.csv"
    write_measurements(other, small_data(30, 7))
    header, *rows = other.read_text().splitlines()
    cells = rows[4].split(",")
    cells[2] = repr(float(cells[2]) + 0.05)
    rows[4] = ",".join(cells)
    other.write_text("\n".join(["# Monday", header, "", *rows]) + "\n")
    words = ("--robot", "planar_2r", "--data", points, "--data", other, "--loss", "robust")
    result = run(*words)
    assert [(r["row"], r["target"]) for r in result["rejected"]] == [(16, 1)]
    assert result["measurements"] == 42 and result["used"] == 41
    assert result["data"] == [{"file": str(points), "rows": 12}, {"file": str(other), "rows": 30}]
    out, _ = run(*words, shown=True)
    off = result["rejected"][0]["residual"]
    assert off == pytest.approx(0.05, abs=1e-4) and f"{length(off)} off" in out
    assert "41 points of 42" in out


def test_long_lists_are_cut(run: Run, tmp_path: Path) -> None:
    data = small_data(60, 3)
    wrong = np.array(data.p)
    wrong[:14] += np.random.default_rng(1).normal(0, 0.05, (14, 1, 3))
    path = tmp_path / "points.csv"
    write_measurements(path, Measurements(data.joint_names, data.q, wrong, data.std))
    out, _ = run("--robot", "planar_2r", "--data", path, "--loss", "robust", shown=True)
    assert "Rejected: 14 points, farthest first" in out and out.count("standard deviations (gate") == 10
    assert "… and 4 more (all in --json)" in out


def test_what_is_held_and_what_is_correlated(run: Run, arm: tuple[Path, Path]) -> None:
    words = ("--robot", arm[0], "--data", arm[1], "--parameters", "full", "--unknown", "base,tool")
    result, (out, _) = run(*words, *PLAIN), run(*words, *PLAIN, shown=True)
    held = [u["parameter"] for u in result["unidentifiable"]]
    lines = {line.split("│")[1].strip(): line for line in out.splitlines() if line.startswith("│")}
    assert len(held) > 8 and all("fixed" in lines[name] for name in held)
    assert f"… and {len(held) - 8} more" in out and result["unidentifiable"][0]["combination"] in out
    assert "closed-form start" in out
    few = run(*words)
    out, _ = run(*words, shown=True)
    lines = {line.split("│")[1].strip(): line for line in out.splitlines() if line.startswith("│")}
    pairs = [c["pair"] for c in few["correlations"]]
    assert pairs and all("correlated" in lines[name] for pair in pairs for name in pair)


# ── what may be told ─────────────────────────────────────────────────────────────────────────────────


def test_a_prior_moves_what_the_data_do_not_see(run: Run, points: Path, tmp_path: Path) -> None:
    prior = tmp_path / "prior.yaml"
    prior.write_text("parameters: {q2.z: {deviation: 0.25, std: 0.001, unit: mm}, l1: {value: 1.5, std: 1}}")
    words = ("--robot", "planar_2r", "--data", points, "--parameters", "l1,l2,dq1,dq2,q1.z,q2.z", *PLAIN)
    without, with_prior = run(*words), run(*words, "--prior", prior)
    assert [u["parameter"] for u in without["unidentifiable"]] == ["q2.z"]
    assert with_prior["unidentifiable"] == [] and len(with_prior["resolved_by_prior"]) == 1
    at = [p["name"] for p in with_prior["parameters"]].index("q2.z")
    assert values(with_prior, "deviation")[at] == pytest.approx(0.25e-3, rel=1e-6)
    assert values(with_prior, "std")[at] == pytest.approx(1e-6, rel=1e-6)
    seen = np.array([p["name"] in ("l1", "l2", "dq1", "dq2") for p in with_prior["parameters"]])
    np.testing.assert_allclose(values(with_prior)[seen], values(without)[seen], rtol=0, atol=1e-8)
    assert with_prior["prior"].endswith("prior.yaml")
    out, _ = run(*words, "--prior", prior, shown=True)
    assert f"prior: {prior}" in out and "Decided by the prior" in out


def test_an_earlier_estimate_as_prior_is_as_good_as_its_data(run: Run, tmp_path: Path) -> None:
    """Bayes: what the first half says and then the second is what both say together."""
    first, second, saved = (tmp_path / n for n in ("first.csv", "second.csv", "saved.yaml"))
    write_measurements(first, small_data(10, 1, l1=1e-3, dq1=2e-3))
    write_measurements(second, small_data(10, 2, l1=1e-3, dq1=2e-3))
    words = ("--robot", "planar_2r", *PLAIN)
    together = run(*words, "--data", first, "--data", second)
    run(*words, "--data", first, "--output", saved)
    alone, after = run(*words, "--data", second), run(*words, "--data", second, "--prior", saved)
    std = values(together, "std")
    np.testing.assert_allclose(values(after), values(together), rtol=0, atol=1e-3 * std.min())
    np.testing.assert_allclose(values(after, "std"), std, rtol=1e-3)
    assert (values(alone, "std") > 1.2 * std).all()


def test_the_typical_prior_takes_all_parameters(run: Run, arm: tuple[Path, Path]) -> None:
    words = ("--robot", arm[0], "--data", arm[1], "--parameters", "full", "--unknown", "base,tool")
    result, paper = run(*words), run(*words, *PLAIN)
    assert result["rank"] == len(result["parameters"]) == 36 and result["status"] == "ok"
    assert "typical" in result["prior"] and paper["prior"] == "" and paper["rank"] < 36
    paper = run(*words, *PLAIN, "--prior", "typical")
    assert paper["rank"] == 36 and "tolerances" in paper["prior"]


def test_an_estimate_of_another_set_up_leaves_base_and_targets_out(
    run: Run, arm: tuple[Path, Path], tmp_path: Path
) -> None:
    saved = tmp_path / "saved.yaml"
    words = ("--robot", arm[0], "--data", arm[1], "--parameters", "offsets", "--unknown", "base,tool")
    run(*words, "--output", saved)
    _, err = run(*words, "--prior", saved, shown=True)
    assert f"{saved}: left out of the prior: base.*, target_1.*, target_2.*" in err
    _, err = run(*words, "--prior", saved, "--prior-includes", "tool", shown=True)
    assert f"{saved}: left out of the prior: base.*\n" in err


def test_an_instrument_alike_in_all_directions_is_a_sigma(run: Run, points: Path, tmp_path: Path) -> None:
    path = tmp_path / "instrument.yaml"
    path.write_text("type: isotropic\nsigma: 5.0e-5\n")
    words = ("--robot", "planar_2r", "--data", points, *PLAIN)
    given, told = run(*words, "--sigma", 5e-5), run(*words, "--instrument", path)
    np.testing.assert_allclose(values(told, "std"), values(given, "std"), rtol=1e-12)
    np.testing.assert_allclose(values(told), values(given), rtol=0, atol=1e-15)
    assert (given["noise"]["source"], told["noise"]["source"]) == ("sigma", "instrument")
    assert (values(given, "std") > values(run(*words), "std")).all()  # the file's own: 3e-5
    path.write_text("type: laser_tracker\nstation: [5, 0, 1]\n")
    out, err = run(*words, "--instrument", path, shown=True)
    assert "the tracker stands at 5, 0, 1 m in the frame of the points" in err and "by the instrument" in out


def test_millimetres(run: Run, points: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Points and std of every file; without the option they are recognised by their size, and it is said."""
    data = small_data()
    assert data.std is not None
    wide = Measurements(data.joint_names, data.q, 1e3 * data.p, 1e3 * np.asarray(data.std))
    path, test, again = (tmp_path / n for n in ("mm.csv", "test.csv", "again.csv"))
    write_measurements(path, wide)
    write_measurements(test, wide)
    again.write_text(points.read_text())
    words = ("--robot", "planar_2r", *PLAIN)
    expected = run(*words, "--data", points, "--validate", again)
    found = run(*words, "--data", path, "--validate", test, "--millimetres")
    np.testing.assert_allclose(values(found), values(expected), rtol=0, atol=1e-12)
    np.testing.assert_allclose(values(found, "std"), values(expected, "std"), rtol=1e-9)
    assert found["validation"]["rms"] == pytest.approx(expected["validation"]["rms"], rel=1e-9)
    for files in (("--data", path), ("--data", points, "--validate", test)):
        _, err = run(*words, *files, shown=True)
        assert f"{files[-1]}: text with comma, 12 rows;" in err and "lengths in mm (by their size)" in err
    status, line = fails(capsys, *words, "--data", points, "--millimetres")
    assert status == 1 and str(points) in line and "leave out --millimetres" in line


def test_several_files_are_one(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = small_data(20)
    parts = [tmp_path / f"{n}.csv" for n in "abc"]
    write_measurements(parts[0], data)
    write_measurements(parts[1], data.select(np.arange(8)))
    write_measurements(parts[2], data.select(np.arange(8, 20)))
    words = ("--robot", "planar_2r", "--parameters", "l1,dq1")
    one, two = run(*words, "--data", parts[0]), run(*words, "--data", parts[1], "--data", parts[2])
    assert two["parameters"] == one["parameters"] and two["residuals"] == one["residuals"]
    bare = data.select(np.arange(8, 20))
    write_measurements(parts[2], Measurements(bare.joint_names, bare.q, bare.p))
    status, line = fails(capsys, *words, "--data", parts[1], "--data", parts[2])
    assert status == 1 and "c.csv: header" in line and "--sigma or --instrument" in line
    assert run(*words, "--data", parts[1], "--data", parts[2], "--sigma", 3e-5)["measurements"] == 20
    twice = np.repeat(data.p, 2, axis=1)
    write_measurements(parts[2], Measurements(data.joint_names, data.q, twice))
    status, line = fails(capsys, *words, "--data", parts[1], "--data", parts[2])
    assert status == 1 and "2 targets" in line and "1, as in" in line


def test_what_the_joints_do_is_learnt_and_can_be_switched_off(run: Run, tmp_path: Path) -> None:
    robot = Robot.load("kuka_kr270")
    q = random_configurations(robot, 60)
    read = q.copy()
    q[:, :3] += 1e-3 * np.sin(2 * q[:, :3])  # what the joints do beyond what they say
    path = tmp_path / "points.csv"
    noise = np.random.default_rng(1).normal(0, 1e-5, (60, 1, 3))
    write_measurements(path, Measurements(robot.joint_names, read, robot.positions(q) + noise))
    words = ("--robot", "kuka_kr270", "--data", path)
    on, (shown, _), off = run(*words), run(*words, shown=True), run(*words, *PLAIN)
    kept = {t["name"] for t in on["error_model"]["terms"] if t["used"]}
    assert "smooth" in kept and [t["name"] for t in off["error_model"]["terms"]] == ["placement", "points"]
    assert on["left_out"]["rms"] < 0.3 * on["placement_alone"]["left_out"]["rms"]
    assert on["left_out"]["rms"] < 0.3 * off["left_out"]["rms"]
    assert "… placement alone" in shown and "errors of a few waves a turn" in shown


# ── what is written ──────────────────────────────────────────────────────────────────────────────────


def test_calibrated_urdf_and_kinematics(run: Run, arm: tuple[Path, Path], tmp_path: Path) -> None:
    """Reloaded, both are the calibrated robot in its own base frame."""
    estimate, urdf, kinematics = (tmp_path / n for n in ("e.yaml", "calibrated.urdf", "kinematics.yaml"))
    words = (
        "--robot", arm[0], "--data", arm[1], "--parameters", "full", "--unknown", "base,tool",
        "--output", estimate, "--urdf-output", urdf, "--kinematics-output", kinematics,
    )  # fmt: skip
    result = run(*words)
    paths = (result["output"], result["urdf_output"], result["kinematics_output"])
    assert paths == (str(estimate), str(urdf), str(kinematics))
    assert {"base.x", "target_1.x", "target_2.z"} <= set(result["not_written"])
    _, err = run(*words, shown=True)
    assert "Not written to" in err and "base.*, target_1.*, target_2.*" in err
    q = random_configurations(mixed(), 10, 9)
    real = read_estimate(estimate).calibrated(Robot.load(arm[0]))
    rotation, xyz = real.base_pose
    expected = (real.positions(q) - xyz) @ rotation
    for robot in (Robot.load(urdf), read_kinematics(kinematics, Robot.load(arm[0]))):
        found = robot.with_targets(real.target_offsets).positions(q)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    nominal = Robot.load(arm[0]).with_targets(real.target_offsets).positions(q)
    assert np.abs(nominal - expected).max() > 5e-4


@pytest.mark.parametrize(
    ("words", "needle"),
    [
        (("--urdf-output", "out.urdf"), "a robot from a URDF"),
        (("--output", "x.yaml", "--kinematics-output", "./x.yaml"), "another file than --output"),
        (("--kinematics-output", "nowhere/x.yaml"), "No such file or directory"),
    ],
)
def test_outputs_are_looked_at_before_the_work(
    words: tuple[str, ...],
    needle: str,
    points: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    status, line = fails(capsys, "--robot", "planar_2r", "--data", points, *words)
    assert status == 2 and words[-2] in line and needle in line
    assert [p.name for p in tmp_path.iterdir()] == ["points.csv"]


def test_the_source_is_not_overwritten(arm: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--robot", arm[0], "--data", arm[1], "--unknown", "base,tool", "--urdf-output", arm[0])
    status, line = fails(capsys, *words)
    assert status == 2 and "another file than the nominal URDF" in line
    assert arm[0].read_text() == MIXED_URDF


# ── real data ────────────────────────────────────────────────────────────────────────────────────────

IRB = SHARED_DATA / "irb120_tracker"


@pytest.mark.skipif(not IRB.is_dir(), reason="the measured data are not here")
def test_irb120_with_its_held_out_files(run: Run, tmp_path: Path) -> None:
    """Plain least squares leaves 0.256 mm on average; and the errors are as large as was expected of them."""
    output = tmp_path / "estimate.yaml"
    result = run(
        "--robot", IRB / "irb120.urdf", "--data", IRB / "calibration.csv", "--parameters", "full",
        "--unknown", "base,tool", "--validate", IRB / "test_1.csv",
        "--validate", IRB / "test_2.csv", "--validate-target-from", 1, "--output", output,
    )  # fmt: skip
    assert result["validation"]["count"] == 40 and result["validation"]["mean"] < 0.145e-3
    assert 100 <= result["left_out"]["count"] == result["used"]
    ratio = result["left_out"]["rms"] / result["left_out"]["predicted_rms"]
    assert 0.67 < ratio < 1.5
    assert result["verdict"]["level"] in ("PASS", "WARN")
    document = read_yaml(output)
    assert document["validation"] == result["validation"] and document["parameters"] == result["parameters"]
    robot = Robot.load(IRB / "irb120.urdf")
    again = read_estimate(output).calibrated(robot)
    assert len(again.targets) == 3 and again.parameter_names == tuple(p["name"] for p in result["parameters"])


# ── what nobody said: where robot and reflectors are ─────────────────────────────────────────────────


def test_base_and_tool_are_found_out_and_said(
    run: Run, arm: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """``identify --robot R --data D`` alone: the tracker stands anywhere, the file has two reflectors."""
    urdf, data = arm
    given = run("--robot", urdf, "--data", data, "--unknown", "base,tool")
    alone = run("--robot", urdf, "--data", data)
    assert main(["identify", "--robot", str(urdf), "--data", str(data)]) == 0
    said = capsys.readouterr().err
    assert "--unknown base,tool was taken" in said and "--unknown none" in said
    assert [p["name"] for p in alone["parameters"]] == [p["name"] for p in given["parameters"]]
    np.testing.assert_array_equal(values(alone), values(given))


def test_a_reversed_joint_is_named_where_nobody_said_what_is_unknown(
    run: Run, arm: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The tracker stands anywhere and joint 2 runs the other way: both are found out, with no option."""
    urdf, data = arm
    head, *rows = data.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    second = head.split(",")[1]
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("\n".join([head, *(",".join([r[0], str(-float(r[1])), *r[2:]]) for r in cells)]) + "\n")
    main(["identify", "--robot", str(urdf), "--data", str(wrong)])
    out, err = capsys.readouterr()
    assert "--unknown base,tool was taken to look for the cause" in err
    assert f"{second} runs the other way" in " ".join((out + err).split())


def test_places_that_are_known_are_left_alone(
    run: Run, points: Path, arm: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["identify", "--robot", "planar_2r", "--data", str(points)]) == 0
    assert "--unknown" not in capsys.readouterr().err
    alone = run("--robot", "planar_2r", "--data", points)
    known = run("--robot", "planar_2r", "--data", points, "--unknown", "none")
    np.testing.assert_array_equal(values(alone), values(known))
    assert not any(p["name"].startswith(("base.", "target_")) for p in alone["parameters"])
    urdf, data = arm
    status, line = fails(capsys, "--robot", urdf, "--data", data, "--unknown", "none")
    assert status == 1 and "--unknown tool" in line
