# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The intake before a robot is known, when the frame of the points changes, and names in messages."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from calib_planner import InputError, UnknownNameError
from calib_planner.acquisition import (
    Intake,
    JointReader,
    Rejection,
    RejectionReason,
    Standstill,
    StandstillSettings,
)
from calib_planner.acquisition.intake import LOST, NOT_FINITE, OTHER_FRAME, UNFIT, UNSTAMPED
from calib_planner.acquisition.messages import MOST_LAYOUTS, pick_joints

NAMES = ("a", "b")
SETTINGS = StandstillSettings()


def header(seconds: float, frame: str = "") -> SimpleNamespace:
    whole = int(seconds)
    stamp = SimpleNamespace(sec=whole, nanosec=round(1e9 * (seconds - whole)))
    return SimpleNamespace(stamp=stamp, frame_id=frame)


def joints(seconds: float, q: tuple[float, ...] = (0.1, 0.2), names: tuple[str, ...] = NAMES) -> SimpleNamespace:
    return SimpleNamespace(header=header(seconds), name=list(names), position=list(q))


def point(seconds: float, frame: str = "tracker", x: float = 1.0) -> SimpleNamespace:
    return SimpleNamespace(header=header(seconds, frame), point=SimpleNamespace(x=x, y=2.0, z=3.0))


def visit(intake: Intake, begin: float, at: float, frame: str) -> list[Standstill | Rejection]:
    """Three seconds of rest at ``at``, then a motion that ends the standstill."""
    made = []
    for t in np.arange(begin, begin + 3.0, 0.05):
        made += intake.joints(joints(t, (at, 0.2)))
        made += intake.point(0, point(t + 0.001, frame))
    for t in np.arange(begin + 3.0, begin + 4.0, 0.05):
        made += intake.joints(joints(t, (at + t - begin - 3.0, 0.2)))
        made += intake.point(0, point(t + 0.001, frame, 1.0 + t - begin))
    return made


def test_without_a_robot_messages_are_counted_only() -> None:
    intake = Intake(None, ["joint_states"], ["p"], SETTINGS)
    assert intake.joints(joints(1.0)) == [] and intake.point(0, point(1.0)) == []
    assert intake.joints(joints(0.0)) == []
    assert [s.messages for s in intake.streams] == [2, 1]
    assert intake.streams[0].left_out == {UNSTAMPED: 1}
    assert intake.rest(0) is None and intake.rest(1) is None
    assert intake.dropped(0) == 0 and intake.dropped(1) == 0
    assert intake.offset_text(0.1) == "" and intake.misdated(0.1) == []
    intake.tracker_state(0, False)
    intake.use(NAMES)  # what the tracker said before still holds
    intake.point(0, point(2.0))
    assert intake.streams[1].left_out == {LOST: 1}
    assert intake.unheard == NAMES


def test_what_is_not_finite_is_counted() -> None:
    intake = Intake(NAMES, ["joint_states"], ["p"], SETTINGS)
    intake.joints(joints(1.0, (np.nan, 0.2)))
    intake.point(0, point(1.0, x=np.inf))
    assert [s.left_out[NOT_FINITE] for s in intake.streams] == [1, 1]


def test_joints_of_another_robot_are_refused_and_the_first_example_is_kept() -> None:
    intake = Intake(NAMES, ["joint_states"], ["p"], SETTINGS)
    for name in ("x", "y"):
        with pytest.raises(UnknownNameError):
            intake.joints(joints(1.0, (0.0,), (name,)))
    with pytest.raises(InputError, match="one position per name"):
        intake.joints(joints(1.0, (0.0,), NAMES))
    assert intake.streams[0].left_out == {UNFIT: 3} and intake.streams[0].example == "it names x"


def test_a_frame_that_nothing_is_kept_in_gives_way_to_one_that_stays() -> None:
    intake = Intake(NAMES, ["joint_states"], ["p"], SETTINGS)
    intake.point(0, point(1.0, "old"))
    assert intake.frame == "old"
    made = visit(intake, 2.0, 0.5, "new")
    assert intake.frame == "new"
    assert [type(one) for one in made] == [Standstill]


def test_a_frame_that_points_are_kept_in_stays_and_the_rejection_says_so() -> None:
    intake = Intake(NAMES, ["joint_states"], ["p"], SETTINGS)
    assert [type(one) for one in visit(intake, 1.0, 0.5, "old")] == [Standstill]
    intake.bound = True
    made = visit(intake, 6.0, 0.7, "new")
    assert intake.frame == "old"
    assert [one.reason for one in made] == [RejectionReason.OTHER_FRAME]
    assert "frame_id 'new'" in made[0].message and "call ~/reset" in made[0].message
    assert intake.streams[1].left_out[OTHER_FRAME] == 80


def test_names_that_stand_twice_matter_if_they_are_the_robots() -> None:
    np.testing.assert_array_equal(pick_joints(["b", "x", "x", "a"], [1, 2, 3, 4], NAMES), [4.0, 1.0])
    with pytest.raises(InputError, match="b more than once"):
        pick_joints(["b", "a", "b"], [1, 2, 3], NAMES)


def test_any_number_of_lists_of_names_is_read_and_few_are_remembered() -> None:
    reader = JointReader(NAMES)
    for k in range(2 * MOST_LAYOUTS + 5):
        columns, values = reader.read(joints(1.0, (k, 7.0, 8.0), (f"gripper{k}", "b", "a")))
        assert columns is None and values.tolist() == [8.0, 7.0]
    assert len(reader._layouts) <= MOST_LAYOUTS
