"""The journal of a campaign: what was noted comes back to the bit, what is torn or foreign does no harm."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robots import plan_of

from calib_planner import FileFormatError, Robot
from calib_planner.campaign import (
    FIT,
    VALIDATION,
    CampaignProblem,
    CampaignState,
    NextStep,
    PlannedConfiguration,
    begin,
)
from calib_planner.errors import StoreError
from calib_planner.io import Journal, begin_journal, open_journal
from calib_planner.io.store import JOURNAL as FILE
from calib_planner.io.store import same_plan

ROBOT = Robot.load("planar_2r")
PROBLEM = CampaignProblem(ROBOT, [0.2, 0.9], 1e-5)
Q = np.random.default_rng(0).uniform(-1.5, 1.5, (6, 2))
POINTS = np.random.default_rng(1).normal(size=(6, 1, 3)) / 3.0


def noted(folder: Path) -> tuple[Journal, CampaignState]:
    """Four stops for the fit, two for validation; one undone, one given up."""
    journal = begin_journal(folder, "abc", ROBOT)
    stops = tuple(PlannedConfiguration(q, FIT if k < 4 else VALIDATION) for k, q in enumerate(Q))
    state = begin(PROBLEM).decided(NextStep(FIT, "", stops, (), (0, 1, 2, 3, 4, 5)))
    events = [
        lambda s: s.measured(0, Q[0], POINTS[0], 11),
        lambda s: s.measured(1, Q[1], POINTS[1], 12),
        lambda s: s.unreachable(2, "a wall"),
        lambda s: s.measured(3, Q[3], POINTS[3], 14),
        lambda s: s.withdrawn(12, "undone"),
        lambda s: s.measured(4, Q[4], POINTS[4], 15),
    ]
    for event in events:
        after = event(state)
        journal.note(state, after)
        state = after
    return journal, state


def test_it_comes_back_to_the_bit(tmp_path: Path) -> None:
    noted(tmp_path / "new")
    stored = open_journal(tmp_path / "new", ROBOT)
    assert stored is not None and stored.campaign_id == "abc" and not stored.finished
    state = stored.state(PROBLEM)
    assert [(r.number, state.configurations[r.index].role) for r in state.measurements] == [
        (11, FIT), (14, FIT), (15, VALIDATION)
    ]  # fmt: skip
    for row, k in zip(state.measurements, (0, 3, 4), strict=True):
        np.testing.assert_array_equal(row.q, Q[k])
        np.testing.assert_array_equal(row.points, POINTS[k])
    assert [(e.reason, e.requested) for e in state.exclusions] == [("a wall", False)]
    np.testing.assert_array_equal(state.exclusions[0].q, Q[2])


def test_a_validation_that_joined_the_fit_is_part_of_it(tmp_path: Path) -> None:
    journal, state = noted(tmp_path)
    journal.note(state, state.decided(NextStep(FIT, "", joins=True)))
    stored = open_journal(tmp_path, ROBOT)
    assert stored is not None
    again = stored.state(PROBLEM)
    assert len(again.measurements_of(FIT)) == 3 and again.data(VALIDATION) is None


def test_the_last_plan_of_the_fit_counts_until_a_validation_joins(tmp_path: Path) -> None:
    journal, state = noted(tmp_path)
    for name, count in (("abc-fit-1", 3), ("abc-fit-2", 4)):
        journal.note_plan(name, plan_of(ROBOT, Q[:count] / 3.0))
    stored = open_journal(tmp_path, ROBOT)
    assert stored is not None and stored.fit_plan is not None and stored.fit_plan[0] == "abc-fit-2"
    assert same_plan(stored.fit_plan[1], plan_of(ROBOT, Q[:4] / 3.0)) and len(stored.rows) == 3
    journal.note(state, state.decided(NextStep(FIT, "", joins=True)))
    stored = open_journal(tmp_path, ROBOT)
    assert stored is not None and stored.fit_plan is None


@pytest.mark.parametrize("torn", ['{"measured": 99, "role"', '{"measured": 99}', "\x00\x00", "{"])
def test_a_torn_last_line_is_cut_off(tmp_path: Path, torn: str) -> None:
    journal, state = noted(tmp_path)
    with journal.path.open("a") as file:
        file.write(torn)
    stored = open_journal(tmp_path, ROBOT)
    assert stored is not None and len(stored.rows) == 3
    after = state.measured(5, Q[5], POINTS[5], 16)
    stored.journal.note(state, after)
    again = open_journal(tmp_path, ROBOT)
    assert again is not None and len(again.rows) == 4


def test_a_new_campaign_leaves_the_old_journal_beside(tmp_path: Path) -> None:
    noted(tmp_path)
    begin_journal(tmp_path, "def", ROBOT)
    assert len(list(tmp_path.iterdir())) == 2
    stored = open_journal(tmp_path, ROBOT)
    assert stored is not None and stored.campaign_id == "def" and not stored.rows
    assert open_journal(tmp_path / "nowhere", ROBOT) is None


@pytest.mark.parametrize(
    "line",
    ["[]", "nonsense", '{"measured": 1, "role": "fit", "configuration": [1], "points": [[0,0,0]]}',
     '{"measured": "x"}', '{"excluded": [1, 2, 3], "radius": 1, "reason": "", "asked": false}',
     '{"measured": 1, "role": "fit", "configuration": [1e999, 0], "points": [[0,0,0]]}',
     '{"fit_plan": "x"}', '{"fit_plan": "x", "plan": {"robot": "planar_2r"}}', '{"fit_plan": "x", "plan": "{}"}'],
)  # fmt: skip
def test_damage_in_the_middle_is_refused_by_name(tmp_path: Path, line: str) -> None:
    journal, _ = noted(tmp_path)
    with journal.path.open("a") as file:
        file.write(line + "\n" + json.dumps({"withdrawn": 2}) + "\n")
    with pytest.raises(FileFormatError, match=FILE):
        open_journal(tmp_path, ROBOT)


def test_another_robots_journal_is_refused(tmp_path: Path) -> None:
    noted(tmp_path)
    with pytest.raises(FileFormatError, match="kuka_kr270"):
        open_journal(tmp_path, Robot.load("kuka_kr270"))
    with pytest.raises(FileFormatError, match="targets"):
        open_journal(tmp_path, replace(ROBOT.with_targets(np.zeros((2, 3)))))


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(StoreError, match="file"):
        begin_journal(file, "abc", ROBOT)
    journal, state = noted(tmp_path / "gone")
    journal.path.unlink()
    journal.path.parent.rmdir()
    with pytest.raises(StoreError):
        journal.note(state, state.measured(5, Q[5], POINTS[5], 16))
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / FILE).symlink_to(tmp_path / "file")
    with pytest.raises(StoreError, match="symbolic link"):
        begin_journal(tmp_path / "link", "abc", ROBOT)
