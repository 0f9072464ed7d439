# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner compensate`` as a user runs it: estimate and targets in, corrected targets out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots import MIXED_URDF, random_configurations

from calib_planner import Robot
from calib_planner.cli import main
from calib_planner.error_model import typical, without_rigid_motion
from calib_planner.io import (
    Reading,
    calibrated_robot,
    read_configurations,
    read_estimate,
    write_configurations,
    write_measurements,
)
from calib_planner.io.yaml import write_document
from calib_planner.simulation import SimulatedCell, random_deviations
from calib_planner.units import Units

OFFSETS = {"turn.offset": 1e-3, "slide.offset": -2e-3, "spin.offset": 5e-3, "nod.offset": -4e-3}
Q = [[0.1, 0.2, 0.3, 0.4], [-0.5, 0.0, 2.0, -0.6]]


def estimate(path: Path, robot: Robot, deviations: dict[str, float], **changes: Any) -> str:
    """An estimate file with these deviations; ``changes`` replace keys."""
    nominal = {p.name: p.nominal for p in robot.with_parameters(robot.available_parameters).parameters}
    rows = [
        {"name": n, "unit": "rad", "nominal": nominal.get(n, 0.0), "value": nominal.get(n, 0.0) + d,
         "deviation": d, "std": 1e-5}
        for n, d in deviations.items()
    ]  # fmt: skip
    content = {"robot": robot.name, "joint_names": list(robot.joint_names), "parameters": rows}
    content |= {"covariance": np.eye(len(rows)).tolist(), "sigma": 1e-5, "status": "ok"}
    write_document(path, "estimate", content | changes)
    return str(path)


@pytest.fixture
def cell(tmp_path: Path) -> dict[str, str]:
    """A URDF, an estimate of its joint offsets and a file of targets with the joints in another order."""
    urdf, targets = tmp_path / "mixed.urdf", tmp_path / "targets.csv"
    urdf.write_text(MIXED_URDF)
    lines = ["nod,spin,slide,turn,note", *(",".join([*map(repr, row[::-1]), "x"]) for row in Q)]
    targets.write_text("\n".join(lines) + "\n")
    found = OFFSETS | {"base.x": 3.0, "base.rx": 0.1, "target_2.y": 1e-2}
    saved = estimate(tmp_path / "estimate.yaml", Robot.load(urdf), found)
    return {"--robot": str(urdf), "--estimate": saved, "--targets": str(targets)}


def words(cell: dict[str, str], *more: str) -> list[str]:
    return ["compensate", *(word for pair in cell.items() for word in pair), *more]


def test_csv_and_json(cell: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Offsets alone: the controller is to be told the opposite; base and targets do not matter."""
    path = tmp_path / "corrected.csv"
    assert main(words(cell, "--output", str(path), "--json")) == 0
    result = json.loads(capsys.readouterr().out)
    expected = np.array(Q) - list(OFFSETS.values())
    np.testing.assert_allclose(result["corrected"], expected, rtol=0, atol=1e-9)
    assert result["targets"] == Q and result["status"] == ["reached"] * 2 and result["reached"] == 2
    assert max(result["position_error"]) < 1e-9 < 1e-3 < min(result["position_error_before"])
    robot = Robot.load(cell["--robot"])
    np.testing.assert_array_equal(read_configurations(path, robot), result["corrected"])
    header, *rows = path.read_text().splitlines()
    assert header == "turn,slide,spin,nod,expected_error,reached"
    assert [row.split(",")[-1] for row in rows] == ["1", "1"]
    assert main(words(cell)) == 0
    out, err = capsys.readouterr()
    assert out == path.read_text() and "joint correction [°]" in err and "joint correction [mm]" in err


def test_degrees_and_a_point_of_the_tool(
    cell: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scale = np.where(Robot.load(cell["--robot"]).joint_is_revolute, 180 / np.pi, 1.0)
    path = tmp_path / "degrees.csv"
    rows = [",".join(map(repr, row)) for row in (np.array(Q) * scale).tolist()]
    path.write_text("\n".join(["turn,slide,spin,nod", *rows]))
    tool = [0.1, -0.2, 0.3]
    more = ("--degrees", "--position-only", "--tool", "0.1 -0.2 0.3", "--json")
    assert main(words(cell | {"--targets": str(path)}, *more)) == 0
    result = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(result["targets"], Q, rtol=0, atol=1e-15)
    assert result["rotation_error"] == [None, None] and result["position_only"]
    nominal = Robot.load(cell["--robot"]).with_targets([tool])
    true = nominal.with_deviations(OFFSETS)
    gap = nominal.positions(Q) - true.positions(result["corrected"])
    assert np.abs(gap).max() < 1e-9
    written = str(tmp_path / "corrected.csv")
    assert main(words(cell | {"--targets": str(path)}, *more, "--output", written)) == 0
    again = read_configurations(written, nominal, Reading(otherwise=Units(angle="deg")))
    np.testing.assert_allclose(again, result["corrected"], rtol=0, atol=1e-15)  # in the units of the input


def test_units_in_the_header_come_back(
    cell: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Degrees and millimetres that the file names, with its decimal points, are those of the output."""
    robot, path = Robot.load(cell["--robot"]), tmp_path / "units.csv"
    scale = np.where(robot.joint_is_revolute, 180 / np.pi, 1e3)
    rows = [",".join(map(repr, row)) for row in (np.array(Q) * scale).tolist()]
    path.write_text("\n".join(["turn [deg],slide [mm],spin [deg],nod [deg]", *rows]))
    assert main(words(cell | {"--targets": str(path)}, "--units", "mm")) == 0
    header, *lines = capsys.readouterr().out.splitlines()
    assert header == "turn [deg],slide [mm],spin [deg],nod [deg],expected_error [mm],reached"
    corrected = np.array([[float(v) for v in line.split(",")[:4]] for line in lines])
    np.testing.assert_allclose(corrected / scale, np.array(Q) - list(OFFSETS.values()), rtol=0, atol=1e-9)


def test_rows_that_cannot_be_reached_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = Robot.load("planar_2r")
    saved = estimate(tmp_path / "e.yaml", robot, {"l1": -1e-3})
    (tmp_path / "t.csv").write_text("q1,q2\n0.5,0.0\n0.5,1.0\n")
    cell = {"--robot": "planar_2r", "--estimate": saved, "--targets": str(tmp_path / "t.csv")}
    assert main(words(cell, "--position-only")) == 0
    out, err = capsys.readouterr()
    assert out.splitlines()[1].endswith(",,0")  # nobody knows what is to be expected; not reached
    assert out.splitlines()[2].endswith(",1")
    assert "1 of 2 targets closest" in err


@pytest.mark.parametrize(
    ("changes", "more", "status", "needle"),
    [
        ({}, ("--tool", "0 0 1"), 2, "--position-only beside it"),
        ({}, ("--position-only", "--tool", "0 0"), 2, "3 finite numbers"),
        ({}, ("--position-only", "--tool", "0 0 inf"), 2, "3 finite numbers"),
        ({"--robot": "planar_2r"}, (), 2, "joints turn, slide"),
        ({"--targets": "nowhere.csv"}, (), 1, "nowhere.csv"),
        ({"--estimate": "nowhere.yaml"}, (), 1, "nowhere.yaml"),
        ({}, ("--output", "/nowhere/x.csv"), 2, "--output"),
    ],
)
def test_wrong_usage(
    cell: dict[str, str],
    changes: dict[str, str],
    more: tuple[str, ...],
    status: int,
    needle: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(words(cell | changes, *more)) == status
    out, err = capsys.readouterr()
    assert out == "" and needle in err and len(err.splitlines()) == 1


def test_estimates_of_other_robots(
    cell: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A parameter that the robot does not have, and another nominal value: both are named."""
    robot = Robot.load(cell["--robot"])
    saved = estimate(tmp_path / "e.yaml", robot, {"elbow.x": 1e-3})
    assert main(words(cell | {"--estimate": saved})) == 2
    assert "elbow.x" in capsys.readouterr().err
    other = robot.with_deviations({"turn.x": 0.01})
    saved = estimate(tmp_path / "e.yaml", other, {"turn.x": 1e-3})
    assert main(words(cell | {"--estimate": saved})) == 2
    assert "turn.x: expected 0.1, the robot's, got nominal 0.11" in capsys.readouterr().err


def test_an_older_estimate_without_an_error_model_is_said(
    cell: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Placement alone is corrected all the same; nobody who asked for just that is told."""
    robot = Robot.load(cell["--robot"])
    older = {
        "noise": {"measurement": 1e-5, "source": "sigma", "discrepancy": 0.0},
        "joint_corrections": {"size": 1e-3},
    }
    for changes, word in (
        ({}, "placement alone is corrected"),
        (older, "joint corrections are of an older version"),
    ):
        saved = estimate(tmp_path / "e.yaml", robot, OFFSETS, **changes)
        assert main(words(cell | {"--estimate": saved}, "--json")) == 0
        out, err = capsys.readouterr()
        assert f"{saved}: it holds no error model" in err and word in err and "identify again" in err
        result = json.loads(out)
        assert result["error_model"] is None and result["reached"] == 2
        np.testing.assert_allclose(result["corrected"], np.array(Q) - list(OFFSETS.values()), rtol=0, atol=1e-9)
        assert main(words(cell | {"--estimate": saved}, "--geometry-only")) == 0
        assert "no error model" not in capsys.readouterr().err


def test_the_true_robot_is_the_judge(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A robot with gravity and joint functions is identified: corrected targets bring it where it should be.

    Its points are in the frame of its own base, so that nothing but the robot is between the two.
    """
    nominal = Robot.load("kuka_kr270")
    model = typical().with_values({"gravity": 1e-3, "smooth.size": 3e-4})
    truth = SimulatedCell(nominal, random_deviations(nominal, 1), 1e-5, error_model=model, seed=2)
    data, saved, targets = (str(tmp_path / n) for n in ("p.csv", "e.yaml", "q.csv"))
    write_measurements(data, truth.measure(random_configurations(nominal, 50, 3), 1, 4))
    assert main(["identify", "--robot", "kuka_kr270", "--data", data, "--output", saved]) == 0
    q = random_configurations(nominal, 60, 5) / 2.0
    write_configurations(targets, nominal.joint_names, q)
    cell = {"--robot": "kuka_kr270", "--estimate": saved, "--targets": targets}
    wanted, off = nominal.positions(q), {}
    for name, more in (("all", ()), ("placement", ("--geometry-only",))):
        capsys.readouterr()
        assert main(words(cell, "--position-only", "--tool", "0 0 0", "--json", *more)) == 0
        result = json.loads(capsys.readouterr().out)
        reached = truth.truth.positions(result["corrected"])
        off[name] = float(np.sqrt(np.mean(np.sum((reached - wanted) ** 2, axis=2))))
        apart = without_rigid_motion(wanted, (reached - wanted).reshape(-1, 1))
        true = float(np.sqrt(np.mean(np.sum(apart.reshape(-1, 3) ** 2, axis=1))))
        # Expected and true differed by −2 … +13 % with other seeds, with the base known or unknown.
        assert result["accuracy_frame"] == "robot"
        assert np.sqrt(np.mean(np.square(result["expected_error"]))) == pytest.approx(true, rel=0.2)
        terms = result["error_model"]
        assert (
            terms is None
            if more
            else [t["name"] for t in terms["terms"] if t["used"]][:2] == ["placement", "gravity"]
        )
    before = float(np.sqrt(np.mean(np.sum((truth.truth.positions(q) - wanted) ** 2, axis=2))))
    assert before > 1e-3 and off["placement"] < 0.8 * before and off["all"] < 0.2 * off["placement"], off


def test_a_saved_estimate_as_a_robot(cell: dict[str, str]) -> None:
    """Chain and targets as identified, more targets than the robot had; not the base."""
    robot = Robot.load(cell["--robot"])
    found = calibrated_robot(robot, read_estimate(cell["--estimate"]))
    np.testing.assert_array_equal(found.target_offsets, [[0, 0, 0], [0, 1e-2, 0]])
    np.testing.assert_array_equal(found.base_pose[0], np.eye(3))
    expected = robot.with_deviations(OFFSETS)
    np.testing.assert_array_equal(found.positions(Q)[:, 0], expected.positions(Q)[:, 0])
