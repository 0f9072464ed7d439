# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The campaign store: exact, durable against kill -9 and full disks, and never another's file."""

from __future__ import annotations

import random
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robots import changed
from stores import MODEL, assert_same, begun, decision, opened, standstill

from calib_planner import Plan, Robot
from calib_planner.acquisition import Rejection, RejectionReason, Standstill
from calib_planner.errors import FileFormatError, InputError, StoreError
from calib_planner.io import LONGEST, SessionStore, StoredModel, UnavailableStore, open_campaign, stored_model
from calib_planner.io import store as store_file
from calib_planner.io.store import FILE, MIGRATIONS

MOVED = Rejection(3, 4, RejectionReason.MOVED, "moved", np.full(2, np.nan), np.array([3, 0]))


# ── exact ────────────────────────────────────────────────────────────────────────────────────────────


def test_what_was_written_comes_back_to_the_bit(tmp_path: Path, planned: Plan) -> None:
    written = [
        decision(standstill(1)),
        decision(standstill(2, seen=(False, True)), unused=(1,), reason="target 2 …"),
        decision(
            Rejection(3, 4, RejectionReason.MOVED, "moved", np.full(2, np.nan), np.array([3, 0])),
            "moved",
            index=None,
        ),
        decision(standstill(4), "not_in_plan", index=None),
    ]
    weightless = changed(planned, weights=np.full(1, np.nan), value_bound=float("nan"), lower_bound=float("inf"))
    store = opened(tmp_path)
    assert store.current() is None
    campaign = begun(store, "p", weightless)
    numbers = [store.record(campaign, d) for d in written]
    assert numbers == sorted(set(numbers)) and numbers[0] > 0
    store.close()

    again = opened(tmp_path)
    found = again.current()
    again.close()
    assert found is not None and (found.number, found.plan_id) == (campaign, "p")
    for a, number, b in zip(written, numbers, found.records, strict=True):
        assert_same(replace(a, number=number), b)
    assert found.plan is not None
    for name, x in weightless.values().items():
        y = found.plan.values()[name]
        assert np.array_equal(x, y, equal_nan=True) if isinstance(x, np.ndarray) else x == y or x != x, name


def test_the_last_decision_counts_and_all_stay(store: SessionStore) -> None:
    campaign = begun(store)
    first, second = (decision(standstill(k)) for k in (1, 2))
    first = replace(first, number=store.record(campaign, first))
    second = replace(second, number=store.record(campaign, second))
    store.decide(campaign, [first.now("outlier", "far away", (0,)), second.now("undone", "on request")])
    store.decide(campaign, [first.now("accepted", "")])
    found = store.current()
    assert found is not None
    assert [(d.number, d.status) for d in found.records] == [
        (first.number, "accepted"),
        (second.number, "undone"),
    ]
    trail = store.history(first.number)
    assert [(t["status"], t["reason"]) for t in trail] == [
        ("accepted", ""),
        ("outlier", "far away"),
        ("accepted", ""),
    ]


def test_texts_from_the_wire_are_bounded(store: SessionStore) -> None:
    campaign = begun(store)
    store.record(campaign, decision(standstill(1), frame="f" * 10**6, reason="r" * 10**6))
    found = store.current()
    assert found is not None
    assert len(found.records[0].frame) == len(found.records[0].reason) == LONGEST
    with pytest.raises(InputError, match="plan_id"):
        store.begin("p" * 10**6, None)


def test_sql_in_texts_is_text(store: SessionStore, planned: Plan) -> None:
    evil = "'); DROP TABLE decisions; --\0"
    campaign = begun(store, evil, planned)
    store.record(campaign, decision(standstill(1), frame=evil, reason=evil))
    found = store.current()
    assert found is not None and found.plan_id == evil and found.records[0].reason == evil


# ── plans come and go ────────────────────────────────────────────────────────────────────────────────


def test_a_plan_that_comes_back_finds_its_measurements(store: SessionStore, planned: Plan) -> None:
    first = begun(store, "a", planned)
    store.record(first, decision(standstill(1)))
    second = begun(store, "b", planned)
    assert second != first
    found = store.current()
    assert found is not None and found.number == second and not found.records
    back = store.begin("a", changed(planned, seconds=9.0))
    assert back.number == first and len(back.records) == 1


def test_another_plan_of_the_same_name_is_refused(store: SessionStore, planned: Plan) -> None:
    campaign = begun(store, "a", planned)
    other = replace(planned, configurations=planned.configurations + 1e-12)
    for wrong in (other, None):
        with pytest.raises(InputError, match=r"plan_id.*another folder"):
            store.begin("a", wrong)
    found = store.current()
    assert found is not None and found.number == campaign


def test_a_restarted_campaign_keeps_the_old_one(store: SessionStore, planned: Plan) -> None:
    first = begun(store, "a", planned)
    number = store.record(first, decision(standstill(1)))
    assert store.restart("a", planned).number != first
    found = store.current()
    assert found is not None and not found.records and len(store.history(number)) == 1
    store.record(found.number, decision(standstill(2)))
    begun(store, "b", planned)
    assert store.begin("a", planned).number == found.number


def test_a_new_plan_can_take_measurements_over(store: SessionStore, planned: Plan) -> None:
    first = begun(store, "a", planned)
    kept = decision(standstill(1))
    kept = replace(kept, number=store.record(first, kept), index=3, repetition=2)
    store.begin("b", planned, [kept])
    found = store.current()
    assert found is not None and len(found.records) == 1
    assert_same(found.records[0], kept)


def test_plans_by_the_thousand_leave_no_trace(store: SessionStore, planned: Plan) -> None:
    for k in range(300):
        begun(store, f"plan {k}", planned)
    count = store._one("SELECT COUNT(*) FROM campaigns")
    assert count is not None and count[0] == 1


# ── whose file ───────────────────────────────────────────────────────────────────────────────────────


def content(folder: Path) -> bytes:
    return (folder / FILE).read_bytes()


@pytest.mark.parametrize(
    ("other", "field"),
    [
        (replace(MODEL, name="leg"), "robot"),
        (replace(MODEL, joint_names=("q2", "q1")), "joint_names"),
        (replace(MODEL, targets=1), "targets"),
        (replace(MODEL, source=MODEL.source + " "), "sha256"),
    ],
)
def test_a_store_of_another_robot_is_refused(tmp_path: Path, other: StoredModel, field: str) -> None:
    store = opened(tmp_path)
    store.record(begun(store), decision(standstill(1)))
    store.close()
    before = content(tmp_path)
    with pytest.raises(FileFormatError, match=field) as caught:
        opened(tmp_path, other)
    assert "another folder" in str(caught.value) and content(tmp_path) == before
    opened(tmp_path).close()


def test_a_store_in_which_nothing_was_measured_takes_another_robot(tmp_path: Path, planned: Plan) -> None:
    store = opened(tmp_path)
    store.begin("a", planned)
    store.close()
    other = replace(MODEL, name="leg", joint_names=("h",), targets=1, origin="robot_description")
    store = opened(tmp_path, other)
    assert store.current() is None and store.empty and stored_model(str(tmp_path / "none")) is None
    found = Standstill(0, 1, np.ones(1), np.ones((1, 3)), np.ones(1), np.array([1]))
    store.record(begun(store), decision(found))
    store.close()
    assert stored_model(str(tmp_path)) == other
    with pytest.raises(FileFormatError, match="robot"):
        opened(tmp_path)


def test_a_store_that_cannot_be_opened_takes_nothing(planned: Plan) -> None:
    store = UnavailableStore(MODEL, StoreError("/mnt/x", "no space left"))
    assert store.current() is None and store.empty and store.find("a", planned) is None
    for attempt in (
        lambda: store.begin("a", planned),
        lambda: store.restart("a", planned),
        lambda: store.record(1, decision(standstill(1))),
        lambda: store.decide(1, [decision(standstill(1))]),
    ):
        with pytest.raises(StoreError, match="no space left"):
            attempt()


def test_the_model_and_the_settings_are_kept(tmp_path: Path) -> None:
    for sigma in (1e-5, 1e-5, 2e-5):
        opened(tmp_path, sigma=sigma).close()
    database = sqlite3.connect(tmp_path / FILE)
    assert database.execute("SELECT source, sha256 FROM model").fetchall() == [(MODEL.source, MODEL.sha256)]
    rows = database.execute("SELECT version, document FROM settings ORDER BY number").fetchall()
    assert rows == [("1.2.3", '{"sigma": 1e-05}'), ("1.2.3", '{"sigma": 2e-05}')]


def test_a_newer_schema_is_refused(tmp_path: Path) -> None:
    opened(tmp_path).close()
    database = sqlite3.connect(tmp_path / FILE)
    assert database.execute("PRAGMA user_version").fetchone() == (len(MIGRATIONS),)
    database.execute(f"PRAGMA user_version = {len(MIGRATIONS) + 1}")
    database.close()
    before = content(tmp_path)
    with pytest.raises(FileFormatError, match="newer version"):
        opened(tmp_path)
    assert content(tmp_path) == before


def test_an_older_schema_is_brought_up_to_date(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = opened(tmp_path)
    store.record(begun(store), decision(standstill(1)))
    store.close()

    more = (*MIGRATIONS, "ALTER TABLE standstills ADD COLUMN note TEXT;")
    monkeypatch.setattr(store_file, "MIGRATIONS", more)
    store = opened(tmp_path)
    found = store.current()
    assert found is not None and len(found.records) == 1
    store._one("SELECT note FROM standstills")
    store.close()
    assert sqlite3.connect(tmp_path / FILE).execute("PRAGMA user_version").fetchone() == (len(more),)


def test_a_file_of_another_program_is_refused(tmp_path: Path) -> None:
    database = sqlite3.connect(tmp_path / FILE)
    database.execute("CREATE TABLE recipes (name TEXT)")
    database.close()
    before = content(tmp_path)
    with pytest.raises(FileFormatError, match="another program"):
        opened(tmp_path)
    assert content(tmp_path) == before


@pytest.mark.parametrize("text", [b"not a database at all " * 100, b"SQLite format 3\0" + b"\xff" * 5000])
def test_what_is_no_database_is_refused(tmp_path: Path, text: bytes) -> None:
    (tmp_path / FILE).write_bytes(text)
    with pytest.raises(FileFormatError, match="store_folder"):
        opened(tmp_path)
    assert content(tmp_path) == text


def test_damage_is_found_on_opening(tmp_path: Path) -> None:
    store = opened(tmp_path)
    campaign = begun(store)
    for k in range(150):  # most of the file is rows then, not room for more
        store.record(campaign, decision(standstill(k)))
    store.close()
    whole = content(tmp_path)
    rng, refused = random.Random(1), 0
    for _ in range(30):
        broken = bytearray(whole)
        at = rng.randrange(4096, len(whole) - 512)
        broken[at : at + 512] = rng.randbytes(512)
        (tmp_path / FILE).write_bytes(broken)
        try:
            store = opened(tmp_path)
        except FileFormatError:
            refused += 1
            assert content(tmp_path) == bytes(broken)
            continue
        try:
            found = store.current()
        except (FileFormatError, StoreError):
            refused += 1
        else:  # an unused part of the file was hit
            assert found is not None
            for k, d in enumerate(found.records):
                assert_same(d, replace(decision(standstill(k)), number=k + 1))
        store.close()
    assert refused >= 15


def test_two_processes_cannot_share_a_folder(tmp_path: Path, store: SessionStore) -> None:
    with pytest.raises(InputError, match="another process uses"):
        opened(tmp_path)
    store.record(begun(store), decision(standstill(1)))


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / FILE).symlink_to(tmp_path / "victim")
    with pytest.raises(FileFormatError, match="symbolic link"):
        opened(tmp_path / "in")
    assert not (tmp_path / "victim").exists()


def test_without_a_folder_it_is_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    store = opened("")
    store.record(begun(store), decision(standstill(1)))
    found = store.current()
    assert found is not None and len(found.records) == 1 and not list(tmp_path.iterdir())


def test_a_folder_of_the_version_before_is_read_whole(tmp_path: Path) -> None:
    """``written_before`` is what the store and the journal wrote when they were two modules; nothing is lost."""
    for file in (Path(__file__).parent / "written_before").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    store = opened(tmp_path)
    found = store.current()
    assert (
        found is not None and found.plan_id == "p" and found.plan is not None and found.plan.robot == "planar_2r"
    )
    assert [r.status for r in found.records] == ["undone", "accepted", "accepted"]
    assert [row["status"] for row in store.history(1)] == ["accepted", "undone"]
    for k, record in enumerate(found.records, 1):
        written = decision(standstill(k, seen=(True, k != 2)), number=k)
        assert_same(written if k > 1 else written.now("undone", "by hand"), record)
    assert store.record(found.number, decision(standstill(4))) == 4
    store.close()

    journal = (tmp_path / "campaign_journal.jsonl").read_bytes()
    stored = open_campaign(tmp_path, Robot.load("planar_2r"))
    assert stored is not None and stored.campaign_id == "abc" and not stored.finished
    assert [(number, role) for number, role, *_ in stored.rows] == [(11, "fit"), (14, "fit"), (15, "validation")]
    q, points = (
        np.random.default_rng(0).uniform(-1.5, 1.5, (6, 2)),
        np.random.default_rng(1).normal(size=(6, 1, 3)),
    )
    for (_, _, configuration, measured, _), k in zip(stored.rows, (0, 3, 4), strict=True):
        assert configuration == q[k].tolist() and measured == (points[k] / 3.0).tolist()
    assert [(e.q.tolist(), e.reason, e.requested) for e in stored.exclusions] == [
        (q[2].tolist(), "a wall", False)
    ]
    assert [row["status"] for row in stored.store.history(2)] == ["accepted", "undone"]
    stored.store.close()
    files = {f.name for f in tmp_path.iterdir()}
    assert files == {FILE, "adaptive_campaign.sqlite", "campaign_journal_converted_1.jsonl"}
    assert (tmp_path / "campaign_journal_converted_1.jsonl").read_bytes() == journal
