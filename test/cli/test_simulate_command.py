# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``simulate`` draws a robot from an error model and says what it drew."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots import random_configurations

from calib_planner import Robot
from calib_planner.cli import main
from calib_planner.error_model import from_mapping, typical
from calib_planner.io import read_error_model, write_configurations, write_error_model

ROBOT = Robot.load("ur10e").with_parameters("full")
Q = random_configurations(ROBOT, 60, 3)


@pytest.fixture
def simulate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """The answer of ``simulate`` with these words."""
    write_configurations(tmp_path / "plan.csv", ROBOT.joint_names, Q)
    first = ["simulate", "--robot", "ur10e", "--parameters", "full", "--plan", str(tmp_path / "plan.csv")]

    def answer(*words: object) -> dict[str, Any]:
        assert main([*first, "--json", *map(str, words)]) == 0
        return dict(json.loads(capsys.readouterr().out))

    return answer


def true_positions(answer: dict[str, Any]) -> np.ndarray:
    return ROBOT.with_deviations({row["name"]: row["deviation"] for row in answer["true"]}).positions(Q)


def rms(change: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(change**2, axis=-1))))


def test_a_simulated_robot_errs_as_measured_ones_do(simulate: Any) -> None:
    found, paper = simulate("--seed", 4), simulate("--seed", 4, "--error-model", "paper")
    terms = {t["name"]: t["size"] for t in found["error_model"]["terms"]}
    assert list(terms) == ["placement", "gravity", "smooth", "short", "visits", "points"]
    assert from_mapping(found["error_model"]["model"]).values == {
        k: v for k, v in typical().values.items() if k != "instrument"
    }
    # The same parameters; the rest is as large as its terms say, which are independent.
    assert found["true"] == paper["true"]
    points = np.array(found["points"])
    rest = rms(points - true_positions(found))
    assert terms["gravity"] > 3e-4 and terms["smooth"] > 1e-4 and terms["visits"] > 5e-5
    told = np.sqrt(sum(size**2 for name, size in terms.items() if name != "placement"))
    assert rest == pytest.approx(told, rel=0.25)
    assert terms["placement"] == pytest.approx(rms(true_positions(found) - ROBOT.positions(Q)), rel=0.02)


def test_the_papers_robot_errs_by_its_parameters_and_noise_alone(simulate: Any) -> None:
    found = simulate("--error-model", "paper", "--sigma", "2e-5")
    terms = {t["name"]: t["size"] for t in found["error_model"]["terms"]}
    assert list(terms) == ["placement", "points"]
    assert terms["points"] == pytest.approx(2e-5 * np.sqrt(3.0))
    assert rms(np.array(found["points"]) - true_positions(found)) == pytest.approx(terms["points"], rel=0.15)


def test_a_model_of_a_file(simulate: Any, tmp_path: Path) -> None:
    write_error_model(tmp_path / "m.yaml", typical().without("gravity").with_values({"repeatability": 1e-3}))
    found = simulate("--error-model", tmp_path / "m.yaml")
    terms = {t["name"]: t["size"] for t in found["error_model"]["terms"]}
    assert "gravity" not in terms and terms["visits"] > 5e-4
    assert found["error_model"]["model"]["points"]["noise"] == {"kind": "isotropic", "sigma": 3e-5}
    assert read_error_model(tmp_path / "m.yaml").points.noise is None


def test_the_same_seed_the_same_points(simulate: Any) -> None:
    one, same, other = (simulate("--seed", seed) for seed in (4, 4, 5))
    assert one == same and one["points"] != other["points"]


def test_another_set_of_the_same_robot(simulate: Any) -> None:
    """As for a validation: nothing changes but what is new at each measurement."""
    one, two = (simulate("--seed", 4, "--noise-seed", seed) for seed in (1, 2))
    keys = ("true", "error_model")
    assert [one[k] for k in keys] == [two[k] for k in keys] == [simulate("--seed", 4)[k] for k in keys]
    apart = rms(np.array(one["points"]) - np.array(two["points"]))
    terms = {t["name"]: t["size"] for t in one["error_model"]["terms"]}
    assert apart == pytest.approx(np.sqrt(2.0) * np.hypot(terms["visits"], terms["points"]), rel=0.2)
    # A robot does not depend on what else is unknown of its cell.
    more = simulate("--seed", 4, "--noise-seed", 1, "--unknown", "base,tool")
    assert {t["name"]: t["size"] for t in more["error_model"]["terms"]}["gravity"] == pytest.approx(
        terms["gravity"], rel=1e-2
    )


def test_the_tables(tmp_path: Path, simulate: Any, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "simulate",
        "--robot",
        "ur10e",
        "--plan",
        str(tmp_path / "plan.csv"),
        "--output",
        str(tmp_path / "m.csv"),
    ]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "error model typical" in out and all(name in out for name in ("gravity", "short", "visits"))


@pytest.mark.parametrize(("model", "status"), [("typcal", 1), ("/nowhere.yaml", 1)])
def test_refused(
    model: str, status: int, tmp_path: Path, simulate: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["simulate", "--robot", "ur10e", "--plan", str(tmp_path / "plan.csv"), "--error-model", model]
    assert main(words) == status
    out, err = capsys.readouterr()
    assert not out and len(err.splitlines()) == 1 and model in err
