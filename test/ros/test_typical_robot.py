# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot that errs in every way, through the nodes: its plan by service and by action, and a whole campaign."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from bench import Bench
from builtin_interfaces.msg import Time
from calib_planner_msgs.action import PlanCalibration as PlanAction
from calib_planner_msgs.msg import CalibrationEstimate, PlanRequest, Verdict
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import PlanCalibration
from desk import NAME, Desk, S
from fake_cell import FakeCell
from poses import poses
from trajectory_msgs.msg import JointTrajectory

from calib_planner import Robot, plan
from calib_planner.error_model import typical
from calib_planner.planning import plan_sheet
from calib_planner.ros.model import shipped_model
from calib_planner.ros.nodes.planner import PlannerNode
from calib_planner.ros.parameters import LATCHED
from calib_planner.ros.planning import plan_pace, problem_of
from calib_planner.ros.settings import PlannerParameters
from calib_planner.simulation import SimulatedCell, random_deviations

POSE = [0.1, -1.2, 1.4, -0.3, 0.8, 0.2]


def test_a_plan_with_constraints_is_the_library_s_by_service_and_action(bench: Bench, tmp_path: Path) -> None:
    robot = Robot.load("ur10e")
    (tmp_path / "cell.yaml").write_text(f"joint_range: {{{robot.joint_names[0]}: [-1.0, 1.0]}}\n")
    chosen = {"robot": "ur10e", "constraints": "cell.yaml", "constraints_folder": str(tmp_path), "settle": 1.0}
    bench.start(PlannerNode, **chosen)
    request = PlanRequest(test_poses=poses(POSE), configurations=7, seed=2)
    asking = PlanCalibration.Request(request=request)
    # Seconds of search; asked again meanwhile, the node would be busy.
    answer = bench.call(PlanCalibration, "calibration_planner/request_plan", asking, 120.0)
    assert answer.status == PlanCalibration.Response.SUCCESS, answer.message
    model = shipped_model("ur10e", "lengths+offsets", "")
    settings = replace(PlannerParameters(), **chosen)
    made = plan(problem_of(request, settings, model))
    np.testing.assert_array_equal([c.positions for c in answer.plan.configurations], made.configurations)
    assert answer.plan.predicted_accuracy == made.quality.predicted_accuracy
    assert np.abs(made.configurations[:, 0]).max() <= 1.0 + 1e-9
    paths = bench.hear(JointTrajectory, "calibration_planner/trajectory", LATCHED)
    bench.wait(lambda: paths)
    times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in paths[0].points]
    sheet = plan_sheet(made, model.robot, pace=plan_pace(settings, model))
    np.testing.assert_allclose(times[::2], [row["arrive"] for row in sheet.timetable.rows()], atol=2e-9)
    np.testing.assert_allclose(times[1::2], np.add(times[::2], settings.settle + settings.dwell), atol=2e-9)
    assert paths[0].header.stamp == Time() and paths[0].header.frame_id == "base_link"
    handle = bench.goal(bench.action(PlanAction, "calibration_planner/plan"), PlanAction.Goal(request=request))
    result = bench.future(handle.get_result_async(), 120.0).result
    assert result.status == PlanAction.Result.SUCCESS
    assert result.plan.configurations == answer.plan.configurations


class TypicalCell(FakeCell):
    """A UR10e with parameters, gravity, joint functions and repeatability that err."""

    def __init__(self, *args: object, **named: object) -> None:
        super().__init__(*args, **named)
        self.robot = Robot.load("ur10e")
        errors = random_deviations(self.robot.with_parameters("lengths+offsets"), 4)
        self.cell = SimulatedCell(self.robot, errors, 1e-5, error_model=typical(), seed=4)

    def point_at(self, q: np.ndarray) -> np.ndarray:
        return self.cell.measure(q[None], 1, self.number).points[0, 0]


def test_a_campaign_with_a_robot_that_errs_in_every_way(bench: Bench) -> None:
    bench.start(TypicalCell)
    estimates = bench.hear(CalibrationEstimate, f"{NAME}/estimate", LATCHED)
    plans = bench.hear(PlanMessage, f"{NAME}/plan", LATCHED)
    pose = " ".join(map(str, POSE))
    asked = {"robot": "ur10e", "error_model": "typical", "test_poses": pose, "required_accuracy": 2.5e-4}
    desk = Desk(bench, **asked, batch=10, budget=30, validation=3, starts=1, sigma=1e-5)
    assert desk.call("start")[0]
    done = desk.until(S.DONE, 90.0)
    assert done.outcome == S.OUTCOME_REACHED and done.predicted_accuracy <= 2.5e-4, done
    assert done.verdict.level in (Verdict.PASS, Verdict.WARN) and done.validated == 3
    said = [text for m in desk.heard for text in (m.reason, *(r.text + r.advice for r in m.verdict.reasons))]
    assert not any("--" in text for text in said)
    assert np.isfinite(done.round_accuracy[-1]) and done.validation_rms < 4 * done.validation_predicted_rms
    bench.wait(lambda: estimates)
    found = estimates[-1]
    terms = {t.name for t in found.terms if t.used}
    assert {"placement", "gravity"} <= terms and {"smooth", "short"} & terms
    assert found.header.frame_id == "base_link"
    assert 4 <= found.configurations <= done.measured and found.left_out_rms < 4 * found.left_out_predicted_rms
    assert all(p.header.frame_id == "base_link" for p in plans)
