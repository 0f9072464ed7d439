# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The commands as a user runs them: the contract's JSON keys, files that feed the next command, status."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots import SHARED_DATA, repeats

from calib_planner import Robot, __version__
from calib_planner.cli import main
from calib_planner.io import read_estimate, read_plan

POSE = "0 -60 90 0 45 0"
PLAN = ["plan", "--robot", "kuka_kr270", "--degrees", "--test-pose", POSE, "--starts", "8"]
ARM = ["plan", "--robot", "planar_2r", "--test-pose", "0.2 0.9", "--starts", "8"]
"""Fifteen times faster, for what does not depend on the robot."""


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Any:
    """Run a command that works; its JSON (with --json) or its stdout."""

    def run(*argv: str) -> Any:
        assert main(argv) == 0, capsys.readouterr().err
        out = capsys.readouterr().out
        return json.loads(out) if "--json" in argv else out

    return run


def test_plan_simulate_identify(call: Any, tmp_path: Path) -> None:
    plan_file, data, estimate_file = (str(tmp_path / n) for n in ("plan.yaml", "data.csv", "estimate.yaml"))
    found = call(*PLAN, "--configurations", "4", "--repetitions", "3", "--json", "--output", plan_file)
    keys = "robot criterion parameters joint_names configurations repetitions predicted_accuracy"
    more = "predicted_accuracy_per_test_pose lower_bound efficiency bound status message seconds seed"
    assert found.keys() >= {*keys.split(), *more.split()}
    assert found["repetitions"] == [3] * 4 and np.shape(found["configurations"]) == (4, 6)
    assert 0 < found["lower_bound"] <= found["predicted_accuracy"] < 3e-5
    assert found["efficiency"] == found["lower_bound"] / found["predicted_accuracy"]
    np.testing.assert_array_equal(read_plan(plan_file).configurations, found["configurations"])

    arguments = ("--robot", "kuka_kr270", "--seed", "3", "--json")
    made = call("simulate", *arguments, "--plan", plan_file, "--error-model", "paper", "--output", data)
    assert made["measurements"] == 12
    result = call(
        "identify", *arguments, "--data", data, "--sigma", "3e-5", "--error-model", "paper",
        "--output", estimate_file, "--test-pose", " ".join(str(v) for v in np.radians([0, -60, 90, 0, 45, 0])),
    )  # fmt: skip
    keys = "parameters rank unidentifiable measurements used rejected sigma_estimate residual_before"
    assert result.keys() >= {*keys.split(), "residual_after", "predicted_accuracy", "status", "seconds"}
    true = {row["name"]: row["deviation"] for row in made["true"]}
    for row in result["parameters"]:
        assert row.keys() == {"name", "unit", "nominal", "value", "deviation", "std"}
        assert abs(row["deviation"] - true[row["name"]]) < 4 * row["std"]
    assert result["residual_after"].keys() == {"mean", "rms", "max"}
    assert result["predicted_accuracy"] == pytest.approx(found["predicted_accuracy"], rel=0.02)
    assert read_estimate(estimate_file).parameters == tuple(true)


def test_csv_plan_and_csv_on_stdout(call: Any, tmp_path: Path) -> None:
    path = str(tmp_path / "plan.csv")
    found = call(
        "plan", "--robot", "planar_2r", "--test-path", str(_poses(tmp_path)), "--weights", "1 2",
        "--configurations", "3", "--starts", "4", "--json", "--output", path,
    )  # fmt: skip
    assert len(found["predicted_accuracy_per_test_pose"]) == 2
    per, w = np.array(found["predicted_accuracy_per_test_pose"]), np.array([1, 2]) / 3
    assert found["predicted_accuracy"] == pytest.approx(np.sqrt(w @ per**2))
    words = ("--true", "l1=0.001", "--sigma", "0", "--error-model", "paper")
    lines = call("simulate", "--robot", "planar_2r", "--plan", path, *words)
    header, *rows = lines.splitlines()
    assert header == "q1,q2,x1,y1,z1" and len(rows) == 3
    q, p = np.split(np.array([[float(v) for v in row.split(",")] for row in rows]), [2], axis=1)
    truth = Robot.load("planar_2r").with_deviations({"l1": 1e-3})
    np.testing.assert_array_equal(truth.positions(q)[:, 0], p)


def _poses(folder: Path) -> Path:
    path = folder / "path.csv"
    path.write_text("q2,q1\n0.5,0.1\n-0.4,0.2\n")
    return path


def test_same_seed_same_result(call: Any, tmp_path: Path) -> None:
    plans = [call(*ARM, "--configurations", "4", "--seed", s, "--json") for s in ("5", "5", "6")]
    assert plans[0]["configurations"] == plans[1]["configurations"] != plans[2]["configurations"]
    path = str(tmp_path / "plan.csv")
    call(*ARM, "--configurations", "4", "--output", path)
    data = [call("simulate", "--robot", "planar_2r", "--plan", path, "--seed", s) for s in ("5", "5", "6")]
    assert data[0] == data[1] != data[2]


def test_negative_numbers_may_be_joined_by_commas(call: Any) -> None:
    words = ("--robot", "planar_2r", "--configurations", "2", "--starts", "2", "--json")
    poses = [
        call("plan", *words, *pose)["test_poses"]
        for pose in (("--test-pose", "-0.5,0.2"), ("--test-pose", "-0.5 0.2"), ("--test-pose=-.5 .2",))
    ]
    assert poses == [[[-0.5, 0.2]]] * 3


def test_tables_for_people(call: Any, tmp_path: Path) -> None:
    path = str(tmp_path / "plan.csv")
    shown = call(*PLAN, "--configurations", "4", "--output", path)
    assert all(word in shown for word in ("ok:", "ρ0", "µm", "efficiency", "joint_a1", "[°]", "1×"))
    data = str(tmp_path / "m.csv")
    assert "mrad" in call("simulate", "--robot", "kuka_kr270", "--plan", path, "--output", data)
    shown = call("identify", "--robot", "kuka_kr270", "--data", data)
    assert all(word in shown for word in ("ok:", "before", "± std", "mm", "mrad", "d1", "q5"))
    shown = call("robots", "show", "kuka_kr270")
    assert all(word in shown for word in ("joint_a6", "185.00", "lengths+offsets", "target_1.x"))


def test_robots(call: Any) -> None:
    assert [r["name"] for r in call("robots", "--json")["robots"]] == ["kuka_kr270", "planar_2r", "ur10e"]
    assert call("robots", "list", "--json") == call("robots", "--json")
    shown = call("robots", "show", "planar_2r", "--json")
    assert shown["joint_names"] == ["q1", "q2"] and shown["levels"]["lengths"] == ["l1", "l2"]
    assert {"name": "l1", "unit": "m", "nominal": 1.0} in shown["available_parameters"]


def test_demo(call: Any, tmp_path: Path) -> None:
    folder = tmp_path / "report"
    result = call("demo", "--json", "--configurations", "20", "--output", str(folder))
    keys = "before after predicted_accuracy random_after random_predicted_accuracy parameters report"
    assert result.keys() >= set(keys.split())
    assert result["parameters"][0].keys() >= {"name", "unit", "true", "value", "std"}
    assert result["before"] > 10 * result["after"] and result["after"] < 4 * result["predicted_accuracy"]
    for row in result["parameters"]:
        assert abs(row["value"] - row["true"]) < 4 * row["std"]
    names = ["calibration.html", "demo.json", "demo.png", "estimate.yaml", "measurements.csv", "plan.yaml"]
    assert sorted(p.name for p in folder.iterdir()) == names
    assert json.loads((folder / "demo.json").read_text()) == result


@pytest.mark.parametrize("command", ["plan", "identify", "simulate", "robots", "demo"])
def test_help_has_units_and_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    out = capsys.readouterr().out
    assert f"calib-planner {command}" in out.split("Example:")[1]
    assert "--json" in out and "--seed" in out
    if command not in ("robots",):
        assert "[m]" in out


def test_help_as_a_word(capsys: pytest.CaptureFixture[str]) -> None:
    for words, like in ((["help"], ["--help"]), (["help", "robots", "show"], ["robots", "show", "--help"])):
        assert main(words) == 0
        shown = capsys.readouterr().out
        assert main(like) == 0 and capsys.readouterr().out == shown != ""


def test_version_and_module_with_closed_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0 and __version__ in capsys.readouterr().out
    run = [sys.executable, "-m", "calib_planner", "robots", "list"]
    process = subprocess.Popen(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout and process.stderr
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 141


def test_interrupt(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module("calib_planner.cli.plan"), "find_plan", interrupted)
    assert main([*PLAN, "--configurations", "4"]) == 130
    assert capsys.readouterr().err == "calib-planner plan: interrupted\n"


def test_ctrl_c_while_modules_are_imported_is_one_line_and_130(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module("calib_planner.cli.main"), "import_module", interrupted)
    assert main(["demo", "--json"]) == 130
    printed = capsys.readouterr()
    assert printed.err == "calib-planner demo: interrupted\n"
    assert json.loads(printed.out)["error"]["message"] == "interrupted"


# ── real data ────────────────────────────────────────────────────────────────────────────────────────

IRB = SHARED_DATA / "irb120_tracker"


@pytest.mark.skipif(not IRB.is_dir(), reason="the measured data are not here")
@pytest.mark.parametrize(
    ("level", "rank", "most"),
    repeats([("full", 51, 0.145e-3)], [("offsets", 21, 0.57e-3), ("full", 51, 0.145e-3)]),
)
def test_irb120(call: Any, level: str, rank: int, most: float) -> None:
    """ABB IRB 120 before a tracker: 40 poses that took no part in the fit, better than by plain least squares.

    The re-seated target is told by one row, and what the model does not say at that row is in all others.
    """
    words = (
        "identify", "--robot", str(IRB / "irb120.urdf"), "--data", str(IRB / "calibration.csv"),
        "--parameters", level, "--unknown", "base,tool", "--validate", str(IRB / "test_1.csv"),
        "--validate", str(IRB / "test_2.csv"), "--validate-target-from", "1", "--json",
    )  # fmt: skip
    result, plain = call(*words), call(*words, "--error-model", "paper")
    assert result["rank"] == rank
    assert result["validation"]["rms"] < plain["validation"]["rms"]
    assert result["validation"]["count"] == 40
    assert result["validation"]["before_mean"] == pytest.approx(4.9e-3, abs=0.1e-3)
    assert result["validation"]["mean"] <= most


UR10 = SHARED_DATA / "ur10_tracker"


@pytest.mark.skipif(not UR10.is_dir(), reason="the measured data are not here")
def test_ur10(call: Any, tmp_path: Path) -> None:
    """UR10 before a tracker: 100 rows fitted, 800 others predicted; std and temperature columns."""
    header, *rows = (UR10 / "random_poses.csv").read_text().splitlines()
    picked = np.random.default_rng(0).permutation(len(rows))
    for name, some in (("fit.csv", picked[:100]), ("test.csv", picked[100:900])):
        (tmp_path / name).write_text("\n".join([header, *(rows[i] for i in some)]))
    result = call(
        "identify", "--robot", str(UR10 / "ur10.urdf"), "--data", str(tmp_path / "fit.csv"), "--json",
        "--parameters", "offsets", "--unknown", "base,tool", "--sigma", "1e-4",
        "--validate", str(tmp_path / "test.csv"),
    )  # fmt: skip
    assert result["validation"]["count"] == 800
    assert result["validation"]["before_mean"] == pytest.approx(0.91e-3, rel=0.1)
    assert result["validation"]["placement_mean"] == pytest.approx(0.50e-3, rel=0.1)
    assert result["validation"]["mean"] <= 0.30e-3  # with gravity and joint functions


# ── sizes, criteria and the baseline ─────────────────────────────────────────────────────────────────

POSED = ["--robot", "kuka_kr270", "--degrees", "--test-pose", POSE, "--starts", "12"]
RADIANS = ["--robot", "kuka_kr270", "--test-pose", "0 -1 1.5 0 0.8 0", "--starts", "12"]


def test_accuracy_and_measurements(call: Any) -> None:
    found = call(*ARM, "--accuracy", "0.02e-3", "--json")
    assert found["predicted_accuracy"] <= 0.02e-3
    assert found["fewest_measurements"] <= sum(found["repetitions"])
    split = call(*ARM, "--measurements", "12", "--json")
    assert sum(split["repetitions"]) == 12
    assert len(split["tried"]) == 5  # 2, 3, 4, 6 and 12 configurations


def test_criterion_and_compound(call: Any) -> None:
    found = call("plan", "--robot", "planar_2r", "--criterion", "d", "--configurations", "5", "--json")
    assert found["value"] <= found["value_bound"]
    assert found["lower_bound"] is None
    assert found["efficiency"] == pytest.approx(found["value"] / found["value_bound"])
    mixed = call(*ARM, "--compound", "d=0.3", "--configurations", "5", "--json")
    assert mixed["criterion"] == "compound"
    assert 0.5 < mixed["efficiency"] <= 1


def test_next_configurations_after_measured_ones(call: Any, tmp_path: Path) -> None:
    plan, points, prior = (str(tmp_path / n) for n in ("plan.yaml", "points.csv", "prior.yaml"))
    first = call("plan", *RADIANS, "--configurations", "4", "--output", plan, "--json")
    call("simulate", "--robot", "kuka_kr270", "--plan", plan, "--output", points, "--json")
    Path(prior).write_text("q1: 1.0e-4\n")
    more = call("plan", *RADIANS, "--configurations", "1", "--measured", points, "--prior", prior, "--json")
    assert more["predicted_accuracy"] < first["predicted_accuracy"]


def test_a_plan_takes_the_priors_of_identify(call: Any, tmp_path: Path) -> None:
    short, long = str(tmp_path / "short.yaml"), str(tmp_path / "long.yaml")
    Path(short).write_text("dq1: 1.0e-4\nl2: 1.0e-5\n")
    Path(long).write_text(
        "parameters:\n  dq1: {std: 0.1, unit: mrad, deviation: 1}\n  l2: {std: 0.01, unit: mm}\n"
    )
    sized = (*ARM, "--configurations", "4", "--json")
    plain, a, b, usual = (
        call(*sized, *(() if p is None else ("--prior", p))) for p in (None, short, long, "typical")
    )
    assert a["predicted_accuracy"] == pytest.approx(b["predicted_accuracy"], rel=1e-12)
    assert a["predicted_accuracy"] < plain["predicted_accuracy"]
    assert usual["predicted_accuracy"] < plain["predicted_accuracy"]


def test_an_estimate_is_the_prior_of_the_next_plan(call: Any, tmp_path: Path) -> None:
    """It tells as much as the measurements that it comes from."""
    plan, points, estimate = (str(tmp_path / n) for n in ("plan.yaml", "points.csv", "estimate.yaml"))
    call("plan", *RADIANS, "--configurations", "5", "--output", plan, "--json")
    call("simulate", "--robot", "kuka_kr270", "--plan", plan, "--output", points, "--json")
    model = ("--error-model", "paper", "--sigma", "3e-5")
    call("identify", "--robot", "kuka_kr270", "--data", points, *model, "--output", estimate, "--json")
    after = call("plan", *RADIANS, "--configurations", "2", "--prior", estimate, "--json")
    beside = call("plan", *RADIANS, "--configurations", "2", "--measured", points, "--json")
    assert after["predicted_accuracy"] == pytest.approx(beside["predicted_accuracy"], rel=0.02)


def test_candidates(call: Any, tmp_path: Path) -> None:
    path = tmp_path / "pool.csv"
    robot = Robot.load("kuka_kr270")
    low, high = robot.joint_limits.T
    pool = np.random.default_rng(0).uniform(low, high, (60, 6))
    rows = [",".join(robot.joint_names), *(",".join(map(repr, row)) for row in pool.tolist())]
    path.write_text("\n".join(rows) + "\n")
    found = call("plan", *RADIANS, "--candidates", str(path), "--configurations", "6", "--json")
    chosen = {tuple(row) for row in found["configurations"]}
    assert len(chosen) == 6
    assert chosen <= {tuple(row) for row in pool.tolist()}


def test_compare(call: Any) -> None:
    found = call("compare", *ARM[1:], "--configurations", "3", "--replicate", "3x4", "--random", "200", "--json")
    assert [c["label"] for c in found["columns"]] == ["3", "3x4"]
    for column in found["columns"]:
        assert column["lower_bound"] <= column["proposed"] <= column["random"]["min"]


@pytest.mark.parametrize(
    ("words", "needle"),
    [
        (["plan", *POSED], "one of the arguments"),
        (["plan", *POSED, "--configurations", "4", "--accuracy", "1e-3"], "one of the two"),
        (["plan", *POSED, "--measurements", "12", "--repetitions", "2"], "--configurations"),
        (["plan", *POSED, "--configurations", "4", "--compound", "d"], "NAME=SHARE"),
        (["plan", *POSED, "--configurations", "4", "--compound", "x=0.2"], "one of"),
        (["compare", *POSED], "--replicate"),
        (["compare", *POSED, "--replicate", "3by4"], "KxR"),
    ],
)
def test_wrong_sizes(words: list[str], needle: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    assert needle in capsys.readouterr().err


UR10 = SHARED_DATA / "ur10_tracker"


@pytest.mark.skipif(not UR10.is_dir(), reason="the measured data are not here")
def test_real_robots_are_planned_with_their_systematic_errors(call: Any, tmp_path: Path) -> None:
    """A robot from a URDF is expected to err by all terms unless that is switched off."""
    pool = tmp_path / "pool.csv"
    pool.write_text("".join((UR10 / "random_poses.csv").read_text().splitlines(keepends=True)[:151]))
    words = [
        "plan", "--robot", str(UR10 / "ur10.urdf"), "--parameters", "full", "--unknown", "base,tool",
        "--candidates", str(pool), "--test-pose", "0 -1.5 1.5 0 1 0", "--configurations", "12", "--json",
    ]  # fmt: skip
    real, paper = call(*words), call(*words, "--error-model", "paper")
    assert real["error_model"]["name"] == "typical" and "typical" in real["message"]
    assert paper["error_model"]["name"] == "paper" and paper == call(*words, "--discrepancy", "off") | {
        "seconds": paper["seconds"]
    }
    assert real["configurations"] != paper["configurations"]
    assert paper["predicted_accuracy"] <= real["predicted_accuracy"]


NEVER = ("scipy.stats", "matplotlib", "sqlite3", "jinja2", "rosbags")
SHORT = (*NEVER, "scipy.spatial", "scipy.linalg")
"""Packages of a tenth of a second or more each: no --help waits for the first, no short command for any."""


@pytest.mark.parametrize(
    ("line", "heavy"),
    [
        ("--help", SHORT),
        ("robots list", SHORT),
        ("robots show ur10e", SHORT),
        *((f"{command} --help", NEVER) for command in ("plan", "identify", "campaign", "sheet", "simulate")),
    ],
)
def test_commands_import_what_they_use(line: str, heavy: tuple[str, ...]) -> None:
    script = f"""
import sys
from calib_planner.cli import main
assert main({line.split()!r}) == 0
print([name for name in {heavy!r} if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr
