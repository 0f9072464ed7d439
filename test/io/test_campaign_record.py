# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The record of a campaign: what was noted comes back to the bit, what is torn or foreign does no harm."""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib_planner import FileFormatError, Robot
from calib_planner.campaign import (
    FIT,
    VALIDATION,
    CampaignProblem,
    CampaignState,
    NextStep,
    PlannedConfiguration,
    Round,
    begin,
)
from calib_planner.errors import InputError, StoreError
from calib_planner.io import CampaignStore, begin_campaign, open_campaign, stored_goals
from calib_planner.io.store import CAMPAIGN_FILE as FILE
from calib_planner.io.store import JOURNAL, StoredCampaign

ROBOT = Robot.load("planar_2r")
PROBLEM = CampaignProblem(ROBOT, [0.2, 0.9], 1e-5)
GOALS = {"required_accuracy": 1e-5, "test_poses": "0.2 0.9", "budget": 60, "constraints": ""}
Q = np.random.default_rng(0).uniform(-1.5, 1.5, (6, 2))
POINTS = np.random.default_rng(1).normal(size=(6, 1, 3)) / 3.0


def noted(folder: Path) -> tuple[CampaignStore, CampaignState]:
    """Four visits for the fit, two for validation; one undone, one given up."""
    store = begin_campaign(folder, "abc", ROBOT, GOALS, "1.2.3")
    stops = tuple(PlannedConfiguration(q, FIT if k < 4 else VALIDATION) for k, q in enumerate(Q))
    state = begin(PROBLEM).decided(NextStep(FIT, "", stops, queue=(0, 1, 2, 3, 4, 5)))
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
        store.note(state, after)
        state = after
    return store, state


@contextmanager
def reopened(folder: Path) -> Iterator[StoredCampaign]:
    """What a node that starts anew finds."""
    stored = open_campaign(folder, ROBOT)
    assert stored is not None
    yield stored
    stored.store.close()


def old_journal(folder: Path, more: str = "") -> Path:
    """A folder of an earlier version that ends with ``more``; it holds what ``noted`` writes."""
    written = (Path(__file__).parent / "written_before" / JOURNAL).read_text()
    folder.mkdir(exist_ok=True)
    (folder / JOURNAL).write_text(written + more)
    return folder / JOURNAL


@pytest.mark.parametrize("converted", [False, True])
def test_it_comes_back_to_the_bit(tmp_path: Path, converted: bool) -> None:
    if converted:
        old_journal(tmp_path)
    else:
        noted(tmp_path / "new")[0].close()
    with reopened(tmp_path if converted else tmp_path / "new") as stored:
        assert stored.campaign_id == "abc" and not stored.finished
        state = stored.state(PROBLEM)
    assert [(r.number, state.configurations[r.index].role) for r in state.measurements] == [
        (11, FIT), (14, FIT), (15, VALIDATION)
    ]  # fmt: skip
    for row, k in zip(state.measurements, (0, 3, 4), strict=True):
        np.testing.assert_array_equal(row.q, Q[k])
        np.testing.assert_array_equal(row.points, POINTS[k])
    assert [(e.reason, e.requested) for e in state.exclusions] == [("a wall", False)]
    np.testing.assert_array_equal(state.exclusions[0].q, Q[2])


def test_the_requirements_are_kept(tmp_path: Path) -> None:
    noted(tmp_path)[0].close()
    database = sqlite3.connect(tmp_path / FILE)
    assert database.execute("SELECT version FROM settings").fetchall() == [("1.2.3",)]
    database.close()
    assert stored_goals(tmp_path) == GOALS
    old_journal(tmp_path / "old")
    assert stored_goals(tmp_path / "old") == {} and stored_goals(tmp_path / "none") is None
    with reopened(tmp_path / "old"):
        pass
    assert stored_goals(tmp_path / "old") == {}


def test_a_measurement_told_again_replaces_the_former(tmp_path: Path) -> None:
    store, state = noted(tmp_path)
    store.note(state, state.measured(3, Q[3], POINTS[5], 14))
    store.close()
    with reopened(tmp_path) as stored:
        assert sorted((n, points) for n, _, _, points, _ in stored.rows if n == 14) == [(14, POINTS[5].tolist())]
        assert len(stored.rows) == 3


def test_standard_deviations_come_back_to_the_bit(tmp_path: Path) -> None:
    """Those of the samples of a standstill; of a campaign in which one measurement has none, none."""
    robot = ROBOT.with_targets(np.zeros((2, 3)))
    problem = CampaignProblem(robot, [0.2, 0.9], 1e-5)
    store = begin_campaign(tmp_path, "abc", robot, GOALS, "1.2.3")
    stops = tuple(PlannedConfiguration(q, FIT) for q in Q)
    state = begin(problem).decided(NextStep(FIT, "", stops, queue=tuple(range(6))))
    rng = np.random.default_rng(2)
    for k in range(3):
        points = np.repeat(POINTS[k], 2, axis=0)
        if k == 1:
            points[1] = np.nan
        std = np.repeat(rng.uniform(1e-6, 1e-4, (2, 1)), 3, axis=1)
        after = state.measured(k, Q[k], points, k + 1, std)
        store.note(state, after)
        state = after
    store.close()
    stored = open_campaign(tmp_path, robot)
    np.testing.assert_array_equal(stored.state(problem).data().std, state.data().std)
    assert np.isnan(state.data().std[1, 1]).all()
    after = state.measured(3, Q[3], np.repeat(POINTS[3], 2, axis=0), 4)
    stored.store.note(state, after)
    stored.store.close()
    again = open_campaign(tmp_path, robot)
    assert after.data().std is None and again.state(problem).data().std is None
    again.store.close()


def test_a_validation_that_joined_the_fit_is_part_of_it(tmp_path: Path) -> None:
    store, state = noted(tmp_path)
    store.note(state, state.decided(NextStep(FIT, "", joins=True)))
    store.close()
    with reopened(tmp_path) as stored:
        again = stored.state(PROBLEM)
    assert len(again.measurements_of(FIT)) == 3 and again.data(VALIDATION) is None


def test_what_failed_was_dropped_and_was_known_comes_back(tmp_path: Path) -> None:
    """A restart neither gets its failed attempts back into the budget nor forgets what was given up."""
    store, state = noted(tmp_path)
    nan, number = float("nan"), len(state.rounds)
    first = Round(number, 0, 0, float("inf"), nan, nan, nan, 4, "first")
    last = Round(number + 1, 2, 2, 3e-5, 1e-5, 2e-5, 7.0, 2, "second", 4e-5)
    events = [
        lambda s: s.decided(NextStep(VALIDATION, "", round=first)),
        lambda s: s.failed(5, "a beam break"),
        lambda s: s.failed(1, "moved"),
        lambda s: s.unreachable(3, "a cable"),
        lambda s: s.skipped(4),
        lambda s: s.decided(NextStep(VALIDATION, "", round=last)),
    ]
    for event in events:
        after = event(state)
        store.note(state, after)
        state = after
    store.close()
    with reopened(tmp_path) as stored:
        again = stored.state(PROBLEM)
    assert state.spent(FIT) == 4 and state.spent(VALIDATION) == 2 and state.given_up == 3
    for role in (FIT, VALIDATION, None):
        assert again.spent(role) == state.spent(role), role
    assert again.given_up == state.given_up and len(again.dropped) == 2 and len(again.spared) == 1
    assert again.configurations[again.dropped[0]].q.tolist() == Q[3].tolist()
    assert [reason for _, reason in again.failures] == ["undone", "a beam break", "moved"]
    assert again.rounds[1] == last and repr(again.rounds[0]) == repr(first)


def test_a_write_torn_at_any_byte_leaves_whole_events(tmp_path: Path) -> None:
    """A crash leaves the log of SQLite cut anywhere: what is read are the first events, each of them whole."""
    store, state = noted(tmp_path / "whole")
    possible = [(11,), (11, 12), (11, 12, 14), (11, 14), (11, 14, 15)]
    for k in range(6):
        after = state.measured(5, Q[5], POINTS[5] + k, 16 + k)
        store.note(state, after)
        state = after
        possible.append((*possible[-1], 16 + k))
    log = (tmp_path / "whole" / f"{FILE}-wal").read_bytes()
    file = (tmp_path / "whole" / FILE).read_bytes()
    store.close()
    rng, seen = random.Random(3), set()
    for cut in [len(log), *(rng.randrange(len(log) // 2, len(log)) for _ in range(20))]:
        folder = tmp_path / str(cut)
        folder.mkdir()
        (folder / FILE).write_bytes(file)
        (folder / f"{FILE}-wal").write_bytes(log[:cut] + rng.randbytes(100))
        with reopened(folder) as stored:
            numbers = tuple(number for number, *_ in stored.rows)
            assert numbers in possible and (cut < len(log) or numbers == possible[-1])
            for number, _, q, points, _ in stored.rows:
                if number >= 16:
                    assert q == Q[5].tolist() and points == (POINTS[5] + (number - 16)).tolist()
            stored.store.note(state, state.measured(5, Q[5], POINTS[5], 99))
        seen.add(numbers)
        with reopened(folder) as stored:
            assert tuple(number for number, *_ in stored.rows) == (*numbers, 99)
    assert len(seen) > 3


# ── the journal of earlier versions ──────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("torn", ['{"measured": 99, "role"', '{"measured": 99}', "\x00\x00", "{"])
def test_a_torn_last_line_of_a_journal_is_left_out(tmp_path: Path, torn: str) -> None:
    state = noted(tmp_path / "other")[1]
    journal = old_journal(tmp_path, torn).read_bytes()
    with reopened(tmp_path) as stored:
        assert len(stored.rows) == 3
        after = state.measured(5, Q[5], POINTS[5], 16)
        stored.store.note(state, after)
    with reopened(tmp_path) as again:
        assert len(again.rows) == 4
    assert not (tmp_path / JOURNAL).exists()
    assert (tmp_path / "campaign_journal_converted_1.jsonl").read_bytes() == journal


def test_a_journal_that_was_converted_before_a_crash_is_not_converted_twice(tmp_path: Path) -> None:
    old_journal(tmp_path)
    with reopened(tmp_path) as stored:
        rows = stored.rows
    (tmp_path / "campaign_journal_converted_1.jsonl").rename(tmp_path / JOURNAL)
    with reopened(tmp_path) as stored:
        assert stored.rows == rows
    assert not (tmp_path / JOURNAL).exists()


def test_what_ended_and_joined_in_a_journal_is_read(tmp_path: Path) -> None:
    text = json.dumps({"fit_plan": "abc-fit-1", "plan": None})  # of an earlier version; nobody needs it
    old_journal(tmp_path, f'{{"joined": true}}\n{text}\n{{"finished": "reached"}}\n')
    with reopened(tmp_path) as stored:
        assert stored.finished == "reached"
        assert [role for _, role, *_ in stored.rows] == [FIT] * 3


@pytest.mark.parametrize(
    "line",
    ["[]", "nonsense", '{"measured": 1, "role": "fit", "configuration": [1], "points": [[0,0,0]]}',
     '{"measured": "x"}', '{"excluded": [1, 2, 3], "radius": 1, "reason": "", "asked": false}',
     '{"measured": 1, "role": "fit", "configuration": [1e999, 0], "points": [[0,0,0]]}',
     '{"failed": [1, 2], "role": "play", "reason": ""}', '{"failed": [1], "role": "fit", "reason": ""}',
     '{"dropped": null}', '{"round": {"accuracy": 1.0}}', '{"round": {"colour": 1}}'],
)  # fmt: skip
def test_damage_in_the_middle_is_refused_by_name(tmp_path: Path, line: str) -> None:
    journal = old_journal(tmp_path, line + "\n" + json.dumps({"withdrawn": 2}) + "\n")
    before = journal.read_bytes()
    with pytest.raises(FileFormatError, match=JOURNAL):
        open_campaign(tmp_path, ROBOT)
    assert [f.name for f in tmp_path.iterdir()] == [JOURNAL] and journal.read_bytes() == before


# ── whose file ───────────────────────────────────────────────────────────────────────────────────────


def test_a_new_campaign_leaves_the_old_one_beside(tmp_path: Path) -> None:
    noted(tmp_path)[0].close()
    begin_campaign(tmp_path, "def", ROBOT, GOALS, "").close()
    assert len(list(tmp_path.iterdir())) == 2
    with reopened(tmp_path) as stored:
        assert stored.campaign_id == "def" and not stored.rows
    assert open_campaign(tmp_path / "nowhere", ROBOT) is None
    (tmp_path / f"before_def_{FILE}").rename(tmp_path / FILE)
    with reopened(tmp_path) as stored:
        assert stored.campaign_id == "abc" and len(stored.rows) == 3


@pytest.mark.parametrize("name", [FILE, JOURNAL])
def test_a_new_campaign_leaves_what_is_damaged_beside(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"not a database at all " * 100)
    with pytest.raises(FileFormatError):
        open_campaign(tmp_path, ROBOT)
    begin_campaign(tmp_path, "def", ROBOT, GOALS, "").close()
    with reopened(tmp_path) as stored:
        assert stored.campaign_id == "def"
    assert (tmp_path / f"before_def_{name}").read_bytes() == b"not a database at all " * 100


@pytest.mark.parametrize("converted", [False, True])
def test_another_robots_record_is_refused(tmp_path: Path, converted: bool) -> None:
    if converted:
        old_journal(tmp_path)
    else:
        noted(tmp_path)[0].close()
    before = {f: f.read_bytes() for f in tmp_path.iterdir()}
    with pytest.raises(FileFormatError, match="kuka_kr270"):
        open_campaign(tmp_path, Robot.load("kuka_kr270"))
    with pytest.raises(FileFormatError, match="targets"):
        open_campaign(tmp_path, replace(ROBOT.with_targets(np.zeros((2, 3)))))
    assert {f: f.read_bytes() for f in tmp_path.iterdir()} == before


def test_a_record_in_use_is_left_alone(tmp_path: Path) -> None:
    store, state = noted(tmp_path)
    for attempt in (
        lambda: begin_campaign(tmp_path, "def", ROBOT, GOALS, ""),
        lambda: open_campaign(tmp_path, ROBOT),
    ):
        with pytest.raises(InputError, match="another process uses"):
            attempt()
    store.note(state, state.measured(5, Q[5], POINTS[5], 16))
    store.close()
    with reopened(tmp_path) as stored:
        assert stored.campaign_id == "abc" and len(stored.rows) == 4


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(StoreError, match="file"):
        begin_campaign(file, "abc", ROBOT, GOALS, "")
    store, state = noted(tmp_path / "gone")
    shutil.rmtree(tmp_path / "gone")
    with pytest.raises(StoreError):
        store.note(state, state.measured(5, Q[5], POINTS[5], 16))
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / FILE).symlink_to(tmp_path / "file")
    with pytest.raises(FileFormatError, match="symbolic link"):
        begin_campaign(tmp_path / "link", "abc", ROBOT, GOALS, "")


def test_a_full_database_changes_nothing_and_recovers(tmp_path: Path) -> None:
    store, state = noted(tmp_path)
    pages = store._database.execute("PRAGMA page_count").fetchone()[0]
    store._database.execute(f"PRAGMA max_page_count = {pages}")
    kept = 3
    with pytest.raises(StoreError, match="full"):
        for k in range(1000):
            after = state.measured(5, Q[5], POINTS[5], 16 + k)
            store.note(state, after)
            state, kept = after, kept + 1
    store._database.execute("PRAGMA max_page_count = 100000")
    store.note(state, state.measured(5, Q[5], POINTS[5], 5000))
    store.close()
    with reopened(tmp_path) as stored:
        assert len(stored.rows) == kept + 1 and stored.rows[-1][0] == 5000
