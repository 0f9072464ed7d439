# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The campaign below the node: outliers with a trail, restarts, kill -9, disks in trouble."""

from __future__ import annotations

import multiprocessing
import os
import random
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TextIO

import numpy as np
import pytest
from robots import repeats
from sessions import HOW, PLAN, ROBOT, assert_same_estimate, begun, measure, opened, planned, seen

from calib_planner import Estimate
from calib_planner.acquisition import Rejection, RejectionReason, Standstill
from calib_planner.error_model import ErrorModel
from calib_planner.errors import InputError, StoreError
from calib_planner.io import NOT_STORED, StoredModel, UnavailableStore
from calib_planner.ros import session
from calib_planner.ros.session import MOST_REJECTIONS, Session, TooFew, condition_of

# ── outliers ─────────────────────────────────────────────────────────────────────────────────────────


def test_an_outlier_is_told_kept_and_measured_again() -> None:
    campaign = begun(opened(""))
    assert set(measure(campaign, *(seen(k) for k in range(8)))) == {"accepted"}
    assert measure(campaign, seen(8, 1e-3)) == ["accepted", "8 outlier"]
    outlier = campaign.records[-1]
    assert "standard deviations" in outlier.reason and outlier.unused == (0,)
    assert campaign.rejections == {"outlier": 1} and len(campaign.accepted) == 8
    assert 8 in campaign.missing() and campaign.done()[8] == 0
    assert measure(campaign, seen(8, attempt=1)) == ["accepted"] and campaign.records[-1].repetition == 0
    assert 8 not in campaign.missing()
    trail = [t["status"] for t in campaign.store.history(outlier.number)]
    assert trail == ["accepted", "outlier"]


def test_the_estimate_does_not_see_the_outlier() -> None:
    rows = range(10)
    clean, dirty = begun(opened("")), begun(opened(""))
    measure(clean, *(seen(k) for k in rows if k != 4))
    measure(dirty, *(seen(k, 1e-2 if k == 4 else 0.0) for k in rows))
    a, b = clean.newest, dirty.newest
    assert isinstance(a, Estimate) and isinstance(b, Estimate)
    # An impossible point keeps the weight of an error of its own size; scales settle to a percent.
    assert (np.abs(a.fit.values - b.fit.values) < 1e-2 * a.fit.std).all()
    assert a.points.used == b.points.used == 9
    assert condition_of(a) == pytest.approx(condition_of(b), rel=1e-3) and condition_of(a) > 1


def test_a_long_plan_is_brought_up_to_date_and_its_end_is_a_full_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """In between close to the full fit; files and a complete plan have what a session made anew has."""
    monkeypatch.setattr(session, "UPDATED_FROM", 9)
    campaign, settled = begun(opened("")), []
    for row in range(12):
        measure(campaign, seen(row))
        settled.append(campaign.settled)
        if row == 10:
            quick, full = campaign.newest, campaign.settle(HOW)
            assert isinstance(quick, Estimate) and isinstance(full, Estimate) and quick is not full
            assert (np.abs(quick.fit.values - full.fit.values) < 0.3 * full.fit.std).all()
            assert campaign.settle(HOW) is full and campaign.newest is full
    assert settled == [*[True] * 8, False, False, False, True]
    monkeypatch.undo()
    again = begun(opened(""))
    measure(again, *(seen(row) for row in range(12)))
    assert_same_estimate(campaign.newest, again.newest)


def test_the_error_model_and_the_accuracy_frame_are_those_of_the_settings() -> None:
    campaign = begun(opened(""))
    measure(campaign, *(seen(k) for k in range(8)))
    papers = campaign.estimate(replace(HOW, error_model=ErrorModel.paper()))
    assert isinstance(papers, Estimate) and papers.knowledge.model.is_papers
    assert not campaign.problem(HOW).model.is_papers
    refused = campaign.estimate(replace(HOW, accuracy_frame="robot"))
    assert isinstance(refused, TooFew) and "test_poses" in refused.message and "world" in refused.message


def test_a_point_that_was_an_outlier_is_accepted_again() -> None:
    """A noise that was given too small makes outliers; with the right one they are none."""
    campaign = begun(opened(""))
    measure(campaign, *(seen(k) for k in range(8)), seen(8, 4e-4))
    number = campaign.records[-1].number
    assert campaign.records[-1].status == "outlier"
    campaign.estimate(replace(HOW, sigma=2e-3))
    (back,) = campaign.judge()
    assert (back.number, back.status, back.reason, back.unused) == (number, "accepted", "", ())
    assert [t["status"] for t in campaign.store.history(number)] == ["accepted", "outlier", "accepted"]
    assert not campaign.judge()


def test_undoing_an_outlier() -> None:
    campaign = begun(opened(""))
    measure(campaign, *(seen(k) for k in range(8)), seen(8, 1e-3))
    undone = campaign.undo()
    assert undone is not None and undone.status == "undone" and campaign.rejections == {"undone": 1}


# ── one campaign after another ───────────────────────────────────────────────────────────────────────


def test_a_restart_goes_on_where_it_was(tmp_path: Path) -> None:
    store = opened(tmp_path)
    campaign = begun(store)
    measure(campaign, *(seen(k, 1e-3 if k == 6 else 0.0) for k in range(9)))
    withdrawn = campaign.undo(campaign.records[2].number)
    assert withdrawn is not None and withdrawn.index == 2
    campaign.take(replace(seen(0), joints=PLAN.configurations[0] + 0.5), HOW)
    campaign.refuse(Rejection(1, 2, RejectionReason.MOVED, "moved", np.full(2, np.nan), np.array([3])))
    before = campaign.estimate(HOW)
    campaign.judge()
    store.close()

    store = opened(tmp_path)
    again = begun(store, None)
    assert (again.plan_id, again.missing(), again.rejections) == ("p", campaign.missing(), campaign.rejections)
    told = [(d.number, d.status, d.reason, d.index, d.repetition, d.unused, d.frame) for d in campaign.records]
    assert told == [
        (d.number, d.status, d.reason, d.index, d.repetition, d.unused, d.frame) for d in again.records
    ]
    assert_same_estimate(before, again.estimate(HOW))
    assert not again.judge() and not again.begin("p", PLAN, 0.01)
    store.close()


def test_the_way_does_not_matter() -> None:
    """The same measurements in the store, reached by detours: the same estimate, to the bit."""
    straight, detour = begun(opened("")), begun(opened(""))
    measure(straight, *(seen(k) for k in (0, 1, 2, 4, 6)))
    measure(detour, *(seen(k, 5e-3 if k == 3 else 0.0) for k in (0, 1, 2, 3, 4, 5, 6)))
    for row in (3, 5):
        detour.undo(next(d.number for d in detour.records if d.index == row))
    a, b = straight.estimate(HOW), detour.estimate(HOW)
    assert isinstance(a, Estimate) and isinstance(b, Estimate) and np.array_equal(a.fit.values, b.fit.values)


def test_a_plan_that_comes_back() -> None:
    campaign = begun(opened(""))
    measure(campaign, seen(0), seen(1))
    assert campaign.begin("other", planned(4), 0.01) and not campaign.records
    assert campaign.begin("p", PLAN, 0.01) and [d.index for d in campaign.records] == [0, 1]
    with pytest.raises(InputError, match="plan_id"):
        campaign.begin("p", planned(4), 0.01)
    assert campaign.plan_id == "p" and len(campaign.records) == 2


def test_a_new_plan_can_go_on_with_the_measurements() -> None:
    campaign = begun(opened(""))
    measure(campaign, *(seen(k) for k in range(6)))
    before = campaign.newest
    rest = replace(PLAN, configurations=PLAN.configurations[[3, 4, 8]], repetitions=np.ones(3, int))
    assert campaign.begin("rest", rest, 0.01, keep=True)
    assert [d.index for d in campaign.records] == [None, None, None, 0, 1, None] and campaign.missing() == [2]
    assert_same_estimate(before, campaign.estimate(HOW))
    again = begun(campaign.store, None)
    assert [d.index for d in again.records] == [d.index for d in campaign.records]


def test_a_measurement_that_is_undone_does_not_come_back_with_a_plan() -> None:
    """It is undone under every plan that it was carried to, and the others are in use as before."""
    session = begun(opened(""))
    measure(session, *(seen(k) for k in range(6)))
    assert session.begin("other", planned(4, seed=5), 0.01, keep=True) and len(session.records) == 6
    measure(session, seen(0, plan=planned(4, seed=5)))
    number = session.records[2].number
    assert session.undo(number) is not None
    assert session.begin("p", PLAN, 0.01, keep=True)
    assert [r.index for r in session.records] == [0, 1, 3, 4, 5] and session.rejections == {"undone": 1}
    again = begun(session.store, None)
    assert [r.index for r in again.records] == [0, 1, 3, 4, 5] and 2 in again.missing()
    statuses = [d["status"] for d in session.store.history(number)]
    assert sorted(statuses) == ["accepted", "accepted", "undone", "undone"]


def test_reset_leaves_the_old_campaign_in_the_store() -> None:
    campaign = begun(opened(""))
    measure(campaign, seen(0), seen(1))
    number = campaign.records[0].number
    assert campaign.reset() == 2 and not campaign.records and campaign.missing() == list(range(12))
    assert len(campaign.store.history(number)) == 1
    measure(campaign, seen(0))
    assert [d.index for d in begun(campaign.store, None).records] == [0]


def test_rejections_cannot_fill_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calib_planner.ros.session.MOST_REJECTIONS", 20)
    assert MOST_REJECTIONS > 20
    campaign = begun(opened(""))
    wrong = Rejection(1, 2, RejectionReason.MOVED, "moved", np.zeros(2), np.array([3]))
    numbers = [campaign.refuse(replace(wrong, end=2 + k)).number for k in range(50)]
    assert sum(n > 0 for n in numbers) == 20 and campaign.rejections == {"moved": 50}
    assert measure(campaign, seen(0)) == ["accepted"]


# ── disks in trouble ─────────────────────────────────────────────────────────────────────────────────


def test_what_cannot_be_written_is_not_accepted() -> None:
    campaign = begun(opened(""))
    measure(campaign, *(seen(k) for k in range(8)))
    before = campaign.newest
    campaign.store._database.execute("PRAGMA query_only = ON")
    decision = campaign.take(seen(8), HOW)
    assert decision.status == NOT_STORED and decision.reason.startswith("not stored: ") and decision.number == 0
    assert len(campaign.records) == 8 and campaign.newest is before and campaign.store.trouble
    with pytest.raises(StoreError):
        campaign.undo()
    with pytest.raises(StoreError):
        campaign.reset()
    assert len(campaign.records) == 8 and campaign.begin("second", planned(4), 0.01)
    assert campaign.take(seen(8, plan=PLAN), HOW).status == "not_in_plan"
    campaign.store._database.execute("PRAGMA query_only = OFF")
    assert measure(campaign, seen(0, plan=planned(4))) == ["accepted"] and not campaign.store.trouble
    again = begun(campaign.store, None)
    assert again.plan_id == "second" and len(again.records) == 1


def test_what_is_seen_otherwise_is_written_when_that_is_possible() -> None:
    campaign = begun(opened(""))
    measure(campaign, *(seen(k) for k in range(8)))
    assert campaign.take(seen(8, 1e-3), HOW).status == "accepted"
    campaign.store._database.execute("PRAGMA query_only = ON")
    campaign.estimate(HOW)
    (changed,) = campaign.judge()
    assert changed.status == "outlier" and not campaign.judge()
    campaign.store._database.execute("PRAGMA query_only = OFF")
    assert not campaign.judge()
    assert [t["status"] for t in campaign.store.history(changed.number)] == ["accepted", "outlier"]


def test_a_store_that_cannot_be_opened_stops_acceptance_only() -> None:
    store = UnavailableStore(StoredModel(ROBOT.name, ROBOT.joint_names, 1, ""), StoreError("/mnt", "read-only"))
    campaign = begun(store)
    assert campaign.plan_id == "p" and measure(campaign, seen(0)) == [NOT_STORED]
    assert "read-only" in campaign.take(seen(0), HOW).reason


# ── kill -9 ──────────────────────────────────────────────────────────────────────────────────────────

SERVER = multiprocessing.get_context("forkserver")
"""Processes of its own that have all modules from the beginning: to import them takes longer than a campaign."""
SERVER.set_forkserver_preload(["calib_planner.ros.session", "calib_planner.simulation", "pytest"])


def campaign_to_its_end(folder: Path, out: Connection) -> None:
    """What the process does: measure what is still to be done, say what was decided, and wait to be killed."""

    def say(*words: object) -> None:
        os.write(out.fileno(), f"{' '.join(map(str, words))}\n".encode())

    campaign = begun(opened(folder))
    campaign.estimate(HOW)
    campaign.judge()
    say("open", *sorted(d.number for d in campaign.records))
    for attempt, row in schedule(campaign):
        if attempt == "undo":
            undone = campaign.undo(row)
            assert undone is not None
            say("undone", undone.number)
            campaign.estimate(HOW)
            campaign.judge()
            continue
        for word in measure(campaign, seen(row, 2e-3 if row == 5 and attempt == 0 else 0.0, attempt)):
            say(word, campaign.records[-1].number)
    say("complete")
    time.sleep(600.0)


def schedule(campaign: Session) -> list[tuple[object, int]]:
    """What is still to be done: rows 0 to 11, where 5 goes wrong first and 7 is withdrawn and measured again."""
    done = {(d.index, d.acquired.start, tuple(d.acquired.points.ravel())) for d in everything(campaign)}  # type: ignore[union-attr]
    steps: list[tuple[object, int]] = []
    for row in range(12):
        first = (row, seen(row).start, tuple(seen(row, 2e-3 if row == 5 else 0.0).points.ravel()))
        if first not in done:
            steps.append((0, row))
    if steps:
        return steps
    seven = [d for d in campaign.records if d.index == 7]
    again = {(row, tuple(seen(row, 0.0, 1).points.ravel())) for row in (5, 7)}
    for d in seven:
        if tuple(d.standstill.points.ravel()) == tuple(seen(7).points.ravel()):
            steps.append(("undo", d.number))
    have = {(d.index, tuple(d.standstill.points.ravel())) for d in campaign.records}
    return steps + [(1, row) for row, points in sorted(again) if (row, points) not in have]


def everything(campaign: Session) -> list[object]:
    found = campaign.store.current()
    assert found is not None
    return [d for d in found.records if isinstance(d.acquired, Standstill)]


@contextmanager
def run_campaign(folder: Path) -> Iterator[tuple[BaseProcess, TextIO]]:
    """The process, and what it says line by line; killed at the end, if it was not before."""
    reader, writer = SERVER.Pipe(duplex=False)
    process = SERVER.Process(target=campaign_to_its_end, args=(folder, writer), daemon=True)
    process.start()
    writer.close()  # the process's own is left, and goes with it
    with reader, open(reader.fileno(), closefd=False) as lines:
        try:
            yield process, lines
        finally:
            process.kill()
            process.join()


def final(folder: Path) -> tuple[list[tuple[object, ...]], object]:
    store = opened(folder)
    campaign = begun(store)
    estimate = campaign.estimate(HOW)
    campaign.judge()
    store.close()
    return [(d.index, d.status, tuple(d.standstill.points.ravel())) for d in campaign.records], estimate


def finish(folder: Path) -> None:
    """Run until there is nothing left to do."""
    for _ in range(3):
        store = opened(folder)
        left = schedule(begun(store))
        store.close()
        if not left:
            return
        with run_campaign(folder) as (process, lines):
            while "complete" not in lines.readline():
                assert process.is_alive()
    raise AssertionError("not finished")


def test_kill_9_at_any_moment_costs_nothing_that_was_told(tmp_path: Path) -> None:
    finish(tmp_path / "undisturbed")
    wanted, estimate = final(tmp_path / "undisturbed")
    assert [i for i, status, _ in wanted if status == "outlier"] == [5]
    rng, folder = random.Random(3), tmp_path / "killed"
    told: set[int] = set()
    for _ in range(repeats(4, 10)):
        with run_campaign(folder) as (process, lines):
            first = lines.readline().split()
            assert told <= {int(n) for n in first[1:]}, "told and lost"
            told = {int(n) for n in first[1:]}
            for _ in range(rng.randrange(4)):
                note(lines.readline(), told)
            process.kill()
            for line in lines:
                note(line, told)
    finish(folder)
    found, again = final(folder)
    assert found == wanted
    assert_same_estimate(estimate, again)


def note(line: str, told: set[int]) -> None:
    words = line.split()
    if not line.endswith("\n") or words[0] in ("complete", "open"):
        return
    if words[0] == "accepted":
        told.add(int(words[-1]))
    elif words[0] == "undone":
        told.discard(int(words[-1]))
