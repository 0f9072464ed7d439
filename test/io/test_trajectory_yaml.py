# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The trajectory: the message's fields in their order, exact positions, the timetable's times, no way out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from robots import mixed, plan_of, random_configurations

from calib_planner import Robot
from calib_planner.errors import InfeasibleError
from calib_planner.io import write_trajectory
from calib_planner.io.plan import NANO, trajectory_text
from calib_planner.planning import Pace, backed_off, plan_sheet

POINT = ["positions", "velocities", "accelerations", "effort", "time_from_start"]


@pytest.mark.parametrize("dwell", [0.0, 2.5])
@pytest.mark.parametrize("make", [lambda: Robot.load("kuka_kr270"), mixed], ids=["kuka", "mixed"])
def test_points_are_the_stops(make, dwell, tmp_path: Path) -> None:
    robot = make()
    q = random_configurations(robot, 5, 3)
    sheet = plan_sheet(plan_of(robot, q, 2), robot, pace=Pace(np.full(q.shape[1], 0.3), dwell, settle=0.0))
    path = tmp_path / "trajectory.yaml"
    write_trajectory(path, sheet)
    read = yaml.safe_load(path.read_text())
    assert list(read) == ["header", "joint_names", "points"] and read["joint_names"] == list(robot.joint_names)
    assert read["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    each = 2 if dwell else 1
    assert all(list(p) == POINT for p in read["points"])
    positions = np.array([p["positions"] for p in read["points"]])
    between = backed_off(q, robot.joint_limits)
    expected = [row for a, b in zip(q, between, strict=True) for row in (*[a] * each, b, *[a] * each)]
    assert positions.tobytes() == np.array(expected).tobytes()
    assert all(p["velocities"] == [0.0] * q.shape[1] for p in read["points"])
    after = [p["time_from_start"]["sec"] * NANO + p["time_from_start"]["nanosec"] for p in read["points"]]
    assert all(0 <= p["time_from_start"]["nanosec"] < NANO for p in read["points"])
    assert (np.diff(after) > 0).all()
    shown = np.array(after).reshape(5, -1)[:, [0, -1]] / NANO
    wanted = np.stack([sheet.timetable.arrive, sheet.timetable.leave], axis=1)
    np.testing.assert_allclose(shown, wanted, rtol=0, atol=1e-9)


def test_no_trajectory_leads_beyond_a_joint_limit(tmp_path: Path) -> None:
    robot = Robot.load("planar_2r")
    sheet = plan_sheet(plan_of(robot, np.array([[0.0, 0.1], [3.2, 0.1]])), robot)
    with pytest.raises(InfeasibleError, match="visit 2"):
        write_trajectory(tmp_path / "t.yaml", sheet)
    assert not (tmp_path / "t.yaml").exists()


def test_the_text_says_what_was_not_checked() -> None:
    robot = Robot.load("planar_2r")
    text = trajectory_text(plan_sheet(plan_of(robot, np.zeros((1, 2))), robot))
    comments = [line for line in text.splitlines() if line.startswith("#")]
    assert "Not checked" in " ".join(comments) and "0.5 rad/s" in " ".join(comments)
