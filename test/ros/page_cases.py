# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A campaign as messages, without nodes: a KUKA KR-270 before a tracker, for tests and pictures of the page."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from calib_planner_msgs.action import ExecutePlan
from calib_planner_msgs.msg import (
    CalibrationEstimate,
    CampaignStatus,
    JointConfiguration,
    Measurement,
    Plan,
    Reason,
    Residuals,
    Verdict,
)
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Vector3

from calib_planner import Robot
from calib_planner.ros import page_state as ps
from calib_planner.ros.page_state import PageState

S = CampaignStatus
NAMES = {"campaign": "calibration_campaign", "identifier": "calibration_identifier", "executor": "plan_executor"}
BASE = {"base.x": 2.6, "base.y": -0.9, "base.z": -0.4, "base.rz": 2.2}
"""Pose of the robot's base in the tracker's frame [m, rad]."""
COUNT = 16


class Script:
    """The messages of a campaign of ``COUNT`` configurations, seeded."""

    def __init__(self, robot: str = "kuka_kr270") -> None:
        self.rng = np.random.default_rng(7)
        self.robot = Robot.load(robot)
        low, high = 0.7 * self.robot.joint_limits.T
        self.q = self.rng.uniform(low, high, (300, len(low)))
        self.q = self.q[self._above(self.q)][:COUNT]
        known = {n: d for n, d in BASE.items() if n in self.robot.available_parameters}
        self.true = self.robot.with_parameters("lengths+offsets", ["base"]).with_deviations(known)

    def _above(self, q: np.ndarray) -> np.ndarray:
        """Configurations whose target is over the floor."""
        return np.asarray(self.robot.positions(q)[:, 0, 2] > 0.3)

    def joints(self, i: int) -> JointConfiguration:
        return JointConfiguration(positions=self.q[i].tolist())

    def status(self, state: int, done: int, **others: object) -> CampaignStatus:
        """After ``done`` of the configurations."""
        ahead = list(range(done, min(COUNT, done + 6 if done else COUNT)))
        accuracy = self.accuracy(done)
        rounds = list(range(6, done + 1, 4))
        message = S(
            campaign_id="c0ffee12",
            robot=self.robot.name,
            state=state,
            round=1 + len(rounds),
            measured=min(done, COUNT - 4),
            left=max(COUNT - 4 - done, 0),
            budget=40,
            validated=max(done - COUNT + 4, 0),
            validation=4,
            predicted_accuracy=accuracy,
            required_accuracy=1e-4,
            sigma=2.2e-5,
            left_out_rms=math.nan,
            validation_rms=math.nan,
            validation_predicted_rms=math.nan,
            round_measured=rounds,
            round_accuracy=[self.accuracy(n) for n in rounds],
            joint_names=list(self.robot.joint_names),
            ahead=ahead,
            ahead_configurations=[self.joints(i) for i in ahead],
            reason="round 2: 6 configurations planned for the test poses",
        )
        if state in (S.MEASURING, S.VALIDATING):
            message.configuration_index, message.configuration = done, self.joints(done)
        for name, value in others.items():
            setattr(message, name, value)
        return message

    @staticmethod
    def accuracy(done: int) -> float:
        return 2.2e-3 * math.exp(-done / 3.6) + 6.0e-5 if done >= 5 else math.nan

    def measurement(self, i: int, **others: object) -> Measurement:
        x, y, z = self.true.positions(self.q[i : i + 1])[0, 0]
        message = Measurement(
            id=i + 1,
            campaign_id="c0ffee12",
            purpose=Plan.VALIDATION if i >= COUNT - 4 else Plan.FIT,
            configuration_index=i,
            joint_names=list(self.robot.joint_names),
            configuration=self.joints(i),
            points=[Point(x=x, y=y, z=z)],
            samples=[30],
            status=Measurement.ACCEPTED,
        )
        for name, value in others.items():
            setattr(message, name, value)
        return message

    def estimate(self, done: int) -> CalibrationEstimate:
        names = list(BASE)
        level = Verdict.WARN if done < 12 else Verdict.PASS
        finding = Reason(
            level=level,
            text="Visits left out are predicted to 0.0613 mm, as the error model says.",
            advice=""
            if level == Verdict.PASS
            else "Measure more configurations before you apply the calibration.",
        )
        return CalibrationEstimate(
            robot=self.robot.name,
            parameters=names,
            deviation=[BASE[n] for n in names],
            measurements=done,
            sigma_estimate=2.2e-5,
            residual_rms_before=7.3e-3,
            residual_rms_after=4.1e-5,
            left_out_rms=self.accuracy(done) * 1.1,
            left_out_predicted_rms=self.accuracy(done),
            left_out_max=math.nan,
            condition=math.nan,
            joint_names=list(self.robot.joint_names),
            test_poses=[JointConfiguration(positions=[0.0, -1.0, 1.5, 0.0, 0.8, 0.0])],
            predicted_accuracy=[self.accuracy(done)],
            verdict=Verdict(level=level, reasons=[finding]),
        )

    def residuals(self, done: int) -> Residuals:
        vectors = self.rng.normal(scale=3e-5, size=(done, 3))
        return Residuals(
            ids=list(range(1, done + 1)),
            targets=[0] * done,
            residuals=[Vector3(x=x, y=y, z=z) for x, y, z in vectors],
            used=[i != 3 for i in range(done)],
        )

    def diagnostics(self) -> DiagnosticArray:
        rows = (
            ("joint_states", b"\0", "100 Hz", "1.4"),
            ("tracker/point", b"\1", "no point for 3 s", "0.0"),
        )
        status = [
            DiagnosticStatus(
                name=f"calibration_identifier: stream {name}",
                level=level,
                message=text,
                values=[KeyValue(key="rate [Hz]", value="100.0"), KeyValue(key="standing still [s]", value=rest)],
            )
            for name, level, text, rest in rows
        ]
        return DiagnosticArray(status=status)

    def state(self, kind: str) -> PageState:
        """The page's state: ``before``, ``review``, ``running``, ``confirm``, ``done`` or ``gone``."""
        services = [f"{NAMES[b.part]}/{b.service}" for b in ps.BUTTONS.values()]
        state = PageState(names=NAMES, there=frozenset([*services, *NAMES.values()]), robot=self.robot)
        state = ps.on_diagnostics(replace(state, joints=tuple(self.q[0])), self.diagnostics())
        if kind == "before":
            return ps.on_status(state, S(state=S.IDLE, reason="call ~/start"))
        if kind == "review":
            return ps.on_status(
                state, self.status(S.PAUSED, 0, reason="look at the plan; ~/resume begins to measure")
            )
        done = COUNT if kind == "done" else 9
        for i in range(done):
            state = ps.on_measurement(state, self.measurement(i))
            if i > 4:
                state = ps.on_estimate(state, self.estimate(i + 1))
        state = ps.on_residuals(state, self.residuals(done))
        state = ps.on_measurement(
            state,
            self.measurement(
                3, status=Measurement.REJECTED_OUTLIER, reason="9.1 standard deviations off: check the seat"
            ),
        )
        state = replace(state, joints=tuple((self.q[done - 1] + self.q[min(done, COUNT - 1)]) / 2))
        for text in (
            "Start: campaign c0ffee12 of kuka_kr270 begun",
            "Resume: goes on",
            "Skip: configuration 4 is left out",
        ):
            state = ps.told(state, "good", text, 1.79e9 + len(text))
        if kind == "done":
            verdict = self.estimate(16).verdict
            verdict.reasons.append(
                Reason(
                    level=Verdict.PASS,
                    text="4 configurations for validation agree: 0.0582 mm rms, 0.0641 mm predicted.",
                )
            )
            return ps.on_status(
                replace(state, report="report_c0ffee12-fit.html"),
                self.status(
                    S.DONE,
                    done,
                    outcome=S.OUTCOME_REACHED,
                    verdict=verdict,
                    ahead=[],
                    ahead_configurations=[],
                    left_out_rms=6.6e-5,
                    validation_rms=5.82e-5,
                    validation_predicted_rms=6.41e-5,
                    reason="the results are in /data/campaign",
                ),
            )
        state = ps.on_status(state, self.status(S.MEASURING, done))
        feedback = ExecutePlan.Feedback()
        state = ps.on_feedback(state, feedback)
        if kind == "confirm":
            feedback.phase = feedback.CONFIRMING
            return ps.on_feedback(state, feedback)
        return replace(state, there=frozenset(), phase=None) if kind == "gone" else state
