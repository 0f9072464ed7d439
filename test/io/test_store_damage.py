# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Sound databases that hold what this package would not have written, and writing when nothing is new."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from stores import begun, decision, opened, standstill
from test_campaign_record import GOALS, PROBLEM, ROBOT, noted, old_journal, reopened

from calib_planner import FileFormatError, Plan, PlanProblem, plan
from calib_planner.acquisition import Rejection, RejectionReason
from calib_planner.campaign import CampaignResult, NextStep, begin
from calib_planner.errors import StoreError
from calib_planner.identification import Verdict
from calib_planner.io import SessionStore, begin_campaign, open_campaign
from calib_planner.io import store as store_file
from calib_planner.io.store import CAMPAIGN_FILE, FILE, JOURNAL, MIGRATIONS, plan_of, plan_text, record_of
from calib_planner.planning import Search


def changed(path: Path, sql: str, *values: object) -> None:
    """The file after another program has changed it."""
    database = sqlite3.connect(path)
    with database:
        assert database.execute(sql, values).rowcount == 1
    database.close()


@pytest.mark.parametrize(
    ("column", "value", "needle"),
    [
        ("samples", "[1, 2, 3]", "standstill 1, samples: expected 2 targets, got 3 targets"),
        ("samples", "[1, 2", "standstill 1"),
        ("joints", "[0.0]", "standstill 1, joints"),
        ("points", "[[0, 0], [0, 0]]", "standstill 1, points"),
        ("rejected", "lazy", "standstill 1: expected what this package wrote"),
    ],
)
def test_a_standstill_that_was_changed_is_named(tmp_path: Path, column: str, value: str, needle: str) -> None:
    store = opened(tmp_path)
    store.record(begun(store), decision(standstill(1)))
    store.close()
    changed(tmp_path / FILE, f"UPDATE standstills SET {column} = ?", value)
    store = opened(tmp_path)
    with pytest.raises(FileFormatError, match="standstill 1") as caught:
        store.current()
    store.close()
    assert needle in str(caught.value) and str(tmp_path) in caught.value.path


def test_a_role_or_a_plan_that_nobody_knows_is_named(tmp_path: Path, planned: Plan) -> None:
    store = opened(tmp_path)
    store.record(begun(store, "p", planned), decision(standstill(1)))
    store.close()
    for sql, back, needle in (
        (
            "UPDATE decisions SET role = 'play'",
            "UPDATE decisions SET role = 'fit'",
            "expected fit or validation",
        ),
        ("UPDATE plans SET purpose = 'play'", "UPDATE plans SET purpose = 'fit'", "a plan for fit or validation"),
        ("UPDATE plans SET plan = 'x'", "UPDATE plans SET plan = NULL", "a plan as JSON"),
    ):
        changed(tmp_path / FILE, sql)
        store = opened(tmp_path)
        with pytest.raises(FileFormatError) as caught:
            store.current()
        store.close()
        assert needle in str(caught.value)
        changed(tmp_path / FILE, back)


def test_only_an_accepted_standstill_has_points() -> None:
    moved = Rejection(3, 4, RejectionReason.MOVED, "moved by 2 mm", np.full(2, np.nan), np.array([3, 0]))
    assert decision(standstill(1)).standstill is not None
    with pytest.raises(TypeError, match="moved by 2 mm"):
        decision(moved, "moved", number=7).standstill


def test_a_plan_without_test_poses_and_no_plan_come_back(tmp_path: Path) -> None:
    assert plan_text(None) is None and plan_of("memory", None) is None
    made = plan(PlanProblem(ROBOT, None, 4, criterion="d", search=Search(starts=1)))
    store = opened(tmp_path)
    begun(store, "p", made)
    store.close()
    again = opened(tmp_path)
    found = again.current()
    again.close()
    assert found is not None and found.plan is not None
    assert found.plan.test_poses.shape == (0, 2) and found.plan.weights.shape == (0,)
    np.testing.assert_array_equal(found.plan.configurations, made.configurations)


def test_nothing_decided_writes_nothing(store: SessionStore) -> None:
    campaign = begun(store)
    number = store.record(campaign, decision(standstill(1)))
    store.decide(campaign, [])
    assert len(store.history(number)) == 1


def test_a_migration_that_fails_leaves_the_file_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = opened(tmp_path)
    store.record(begun(store), decision(standstill(1)))
    store.close()
    before = (tmp_path / FILE).read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(store_file, "MIGRATIONS", (*MIGRATIONS, "INSERT INTO nowhere VALUES (1);"))
        with pytest.raises(StoreError, match="nowhere"):
            opened(tmp_path)
    assert (tmp_path / FILE).read_bytes() == before
    again = opened(tmp_path)
    found = again.current()
    again.close()
    assert found is not None and len(found.records) == 1


# ── campaigns ────────────────────────────────────────────────────────────────────────────────────────


def test_the_end_is_noted_once_and_nothing_new_is_no_event(tmp_path: Path) -> None:
    store, state = noted(tmp_path)
    text, verdict = "All is well.", Verdict("pass", ())
    result = CampaignResult("reached", text, 1e-5, (), None, verdict, None, None, (), 4, 60)
    after = state.decided(NextStep("done", text, outcome="reached", result=result))
    count = "SELECT COUNT(*) AS n FROM events"
    noted_before = store._one(count)["n"]
    store.note(state, after)
    store.note(after, after)
    assert store._one(count)["n"] == noted_before + 1
    store.close()
    with reopened(tmp_path) as stored:
        assert stored.finished == "reached"


def test_a_journal_beside_a_record_becomes_the_newest_campaign_of_it(tmp_path: Path) -> None:
    begin_campaign(tmp_path, "newer", ROBOT, GOALS, "1.2.3").close()
    old_journal(tmp_path)
    with reopened(tmp_path) as stored:
        assert stored.campaign_id == "abc" and len(stored.rows) == 3
    assert not (tmp_path / JOURNAL).exists()
    database = sqlite3.connect(tmp_path / CAMPAIGN_FILE)
    assert [name for (name,) in database.execute("SELECT plan_id FROM campaigns ORDER BY number")] == [
        "newer",
        "abc",
    ]
    database.close()


def test_a_record_without_a_current_campaign_is_none_and_is_free(tmp_path: Path) -> None:
    store = begin_campaign(tmp_path, "abc", ROBOT, GOALS, "1.2.3")
    state = begin(PROBLEM)
    store.note(state, state)
    store.close()
    changed(tmp_path / CAMPAIGN_FILE, "DELETE FROM current")
    assert open_campaign(tmp_path, ROBOT) is None
    assert open_campaign(tmp_path, ROBOT) is None  # the first look has closed it


def test_a_journal_of_any_size_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = old_journal(tmp_path)
    monkeypatch.setattr(store_file, "MOST_BYTES", 100)
    with pytest.raises(FileFormatError, match="at most 100"):
        open_campaign(tmp_path, ROBOT)
    assert journal.exists() and not (tmp_path / CAMPAIGN_FILE).exists()


def test_rows_that_are_no_record_are_named() -> None:
    row = {"standstill": 4, "start": 1, "stop": None, "joints": "[0, 0]", "samples": "[1, 1]"}
    with pytest.raises(FileFormatError, match="standstill 4"):
        record_of("memory", row, 2, 2)
