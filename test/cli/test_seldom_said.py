# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What commands say to people in cases that are seldom seen, and what they refuse."""

from __future__ import annotations

import argparse
import json
import sys
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from robots import MIXED_URDF, mixed, random_configurations

from calib_planner import CalibPlannerError, PlanProblem, Robot, plan
from calib_planner.campaign import CampaignProblem, CampaignResult
from calib_planner.cli import main, parser
from calib_planner.cli.arguments import column_names
from calib_planner.cli.campaign import _write as write_campaign
from calib_planner.cli.campaign import show_result
from calib_planner.error_model import typical
from calib_planner.identification import Reason, Verdict
from calib_planner.io import write_measurements, write_plan
from calib_planner.planning import Search
from calib_planner.simulation import SimulatedCell

PLANAR = ("plan", "--robot", "planar_2r", "--starts", "1")
POSE = ("--test-pose", "0.3 0.8")
PROBLEM = CampaignProblem(Robot.load("planar_2r"), [0.2, 0.9], 1e-5)


@pytest.fixture
def shown(capsys: pytest.CaptureFixture[str]):
    """What a command prints for people, in lines of any length; it has to succeed."""

    def call(*words: str) -> str:
        assert main([*words]) == 0, capsys.readouterr().err
        return " ".join(capsys.readouterr().out.split())

    return call


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]):
    """The error that a command tells, as JSON; 1 or 2 as it is of content or of words."""

    def call(*words: str) -> dict[str, str]:
        assert main([*words, "--json"]) in (1, 2)
        return json.loads(capsys.readouterr().out)["error"]

    return call


# ── plans ────────────────────────────────────────────────────────────────────────────────────────────


def test_the_sizes_that_were_tried_for_an_accuracy_are_shown(shown) -> None:
    text = shown(*PLANAR, *POSE, "--accuracy", "0.015mm")
    assert "sizes tried" in text and "No plan of fewer than" in text and "measurements can reach it." in text


def test_the_sizes_that_were_tried_for_a_time_have_times(shown) -> None:
    text = shown(*PLANAR, *POSE, "--time-budget", "3min")
    assert "sizes tried" in text and "time" in text.partition("sizes tried")[2]
    assert "can reach it" not in text


def test_a_plan_without_test_poses_promises_no_accuracy_there(shown) -> None:
    text = shown(*PLANAR, "--configurations", "4", "--criterion", "o2")
    assert "Criterion o2:" in text and "This criterion has no bound." in text
    assert "at the test pose" not in text and "per test pose" not in text


def test_every_test_pose_has_its_accuracy(shown) -> None:
    text = shown(*PLANAR, "--configurations", "4", *POSE, "--test-pose", "0.1 1.5")
    assert "at the test poses (rms)" in text and text.partition("ρ0 per test pose: ")[2].count(" µm") >= 2


def test_what_no_plan_tells_apart_is_named(shown) -> None:
    text = shown(*PLANAR, *POSE, "--configurations", "8", "--parameters", "full", "--unknown", "base")
    assert "No plan can tell apart:" in text
    text = shown(
        *PLANAR, "--configurations", "8", "--parameters", "full", "--unknown", "base", "--criterion", "d"
    )
    assert "The criterion holds for this choice of parameters." in text


def test_a_discrepancy_beside_another_error_model_is_refused(refused) -> None:
    error = refused(*PLANAR, *POSE, "--configurations", "4", "--discrepancy", "on", "--error-model", "paper")
    assert error["field"] == "--discrepancy" and error["expected"] == "--error-model paper alone"


@pytest.mark.parametrize(
    ("criterion", "words"), [("o2", ("o2.",)), ("test_pose", ("Expected accuracy", "efficiency"))]
)
def test_a_sheet_promises_what_its_plan_does(
    shown, tmp_path: Path, criterion: str, words: tuple[str, ...]
) -> None:
    robot = Robot.load("planar_2r")
    poses = [[0.3, 0.8]] if criterion == "test_pose" else None
    made = plan(PlanProblem(robot, poses, 4, criterion=criterion, search=Search(starts=1)))
    write_plan(tmp_path / "plan.yaml", made)
    text = shown("sheet", "--plan", str(tmp_path / "plan.yaml"), "--robot", "planar_2r")
    assert all(word in text for word in words)


# ── words that do not fit ────────────────────────────────────────────────────────────────────────────


def test_words_that_belong_to_nothing_are_refused(refused) -> None:
    error = refused("robots", "list", "planar_2r")
    assert "planar_2r" in error["got"] and error["expected"] == "options and their values only"


def test_an_option_without_its_value_is_refused(refused) -> None:
    error = refused("plan", "--robot")
    assert (error["field"], error["got"], error["expected"]) == ("--robot", "no value", "one value")


def test_options_behind_two_dashes_are_no_options(refused) -> None:
    assert "--unheard" in refused("robots", "show", "planar_2r", "--", "--unheard")["got"]
    assert refused("robots", "show", "planar_2r", "--unheard")["got"] == "an unknown option"


@pytest.mark.parametrize("text", ["…", "q1 …", "… q6", "q1 … p6", "a … q6"])
def test_names_that_stand_for_others_need_numbers_at_both_ends(text: str) -> None:
    assert column_names("q1 … q4, x") == ("q1", "q2", "q3", "q4", "x")
    with pytest.raises(argparse.ArgumentTypeError, match="numbered names around …, as in q1 … q6"):
        column_names(text)


def test_a_robot_has_to_be_named(refused) -> None:
    error = refused("robots", "show")
    assert (error["field"], error["expected"]) == ("R", "a robot") and "--cell" in error["advice"]


def test_a_plan_of_another_robots_joints_is_not_simulated(refused, tmp_path: Path) -> None:
    made = plan(PlanProblem(Robot.load("kuka_kr270"), None, 4, criterion="d", search=Search(starts=1)))
    write_plan(tmp_path / "plan.yaml", made)
    error = refused("simulate", "--robot", "planar_2r", "--plan", str(tmp_path / "plan.yaml"))
    assert error["field"].endswith("joint_names") and "joint_a1" in error["got"] and "q1, q2" in error["expected"]


# ── identify ─────────────────────────────────────────────────────────────────────────────────────────


def test_more_reflectors_than_the_robot_has_are_placed_or_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Two reflectors at the tip of a robot with one; stated places that are too few are an error of theirs."""
    robot = Robot.load("planar_2r").with_targets(np.zeros((2, 3)))
    data = SimulatedCell(robot, {}, 3e-5).measure(random_configurations(robot, 12, 1), 1, 1)
    write_measurements(tmp_path / "points.csv", data)
    words = ["identify", "--robot", "planar_2r", "--data", str(tmp_path / "points.csv"), "--error-model", "paper"]
    assert main([*words, "--json"]) == 0
    assert "The robot has no place for 2 reflectors: --unknown tool was taken." in capsys.readouterr().err
    assert main([*words, "--targets", "0 0 0", "--json"]) == 1
    assert "2 targets" in json.loads(capsys.readouterr().out)["error"]["message"]


def test_the_frame_of_an_accuracy_and_the_share_of_placement_are_shown(shown, tmp_path: Path) -> None:
    """With all terms of the error model every set of points has a row of placement alone beside it."""
    robot = mixed()
    cell = SimulatedCell(robot, {"turn.x": 1e-3}, 2e-5, error_model=typical(), seed=1)
    urdf, points, held_out = (tmp_path / name for name in ("mixed.urdf", "points.csv", "test.csv"))
    urdf.write_text(MIXED_URDF)
    write_measurements(points, cell.measure(random_configurations(robot, 25, 1), 1, 1))
    write_measurements(held_out, cell.measure(random_configurations(robot, 5, 2), 1, 2))
    poses = [" ".join(map(repr, q.tolist())) for q in random_configurations(robot, 4, 3)]
    words = ["identify", "--robot", str(urdf), "--targets", "0.1 0.02 0.3", "--targets", "-0.05 0.2 0.1"]
    words += ["--data", str(points), "--validate", str(held_out), "--accuracy-frame", "robot"]
    words += ["--parameters", "offsets"]
    text = shown(*words, *(word for pose in poses for word in ("--test-pose", pose)))
    assert "up to a new registration of the robot" in text and "with placement alone:" in text
    assert text.count("… placement alone") == 3 and "held out" in text


# ── campaigns ────────────────────────────────────────────────────────────────────────────────────────


def test_a_campaign_that_identified_nothing_says_so(tmp_path: Path) -> None:
    reason = Reason("FAIL", "no_estimate", "nothing was identified", "measure more")
    ended = ("failed", "Nothing to be seen", 1e-4, (), None, Verdict("FAIL", (reason,)), None, None, (), 3, 40)
    result = CampaignResult(*ended)
    console = Console(file=StringIO(), width=300)
    show_result(result, np.array([2e-3]), console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert text.startswith("FAIL: failed") and "nothing was identified → measure more" in text
    assert "True error at the test poses: 2.00 mm on average over visits; nothing predicted, unlimited" in text
    assert "3 of 40 measurements spent, 0 configurations given up." in text and "Validation" not in text
    show_result(result, None, console)
    assert console.file.getvalue().count("True error") == 1  # type: ignore[attr-defined]
    write_campaign(tmp_path, PROBLEM, result)
    assert list(tmp_path.iterdir()) == []


# ── errors that are nobody's ─────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("error", [OSError("no space left"), MemoryError(), np.linalg.LinAlgError("singular")])
def test_what_the_machine_refuses_is_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("calib_planner.cli.robots.run_list", fail)
    assert main(["robots", "list"]) == 1
    told = capsys.readouterr().err
    assert (str(error) or type(error).__name__) in told and told.count("\n") == 1


def test_a_package_that_is_missing_is_named_unless_it_is_the_papers(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(module: str) -> None:
        raise ModuleNotFoundError(f"No module named {missing!r}", name=missing)

    monkeypatch.setattr(sys.modules["calib_planner.cli.main"], "import_module", fail)
    missing = "scipy"
    with pytest.raises(ModuleNotFoundError, match="scipy"):
        parser("plan")
    missing = "calib_planner_paper"
    with pytest.raises(CalibPlannerError, match="paper"):
        parser("reproduce")


def test_a_mistake_of_the_program_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("calib_planner.cli.robots.run_list", fail)
    with pytest.raises(ZeroDivisionError):
        main(["robots", "list"])
