# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What is saved is what was meant: one campaign, without its validation, each standstill once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robots import plan_of, random_configurations
from sessions import HOW, PLAN, ROBOT, assert_same_estimate, begun, measure, opened, planned, seen

from calib_planner import Estimate, Plan
from calib_planner.acquisition import NANO, Rejection, RejectionReason, Standstill
from calib_planner.campaign import FIT, VALIDATION
from calib_planner.errors import InputError
from calib_planner.io import SessionStore, read_data
from calib_planner.ros import session as saving
from calib_planner.ros.session import Session, TooFew

HELD_OUT = plan_of(ROBOT, random_configurations(ROBOT, 4, seed=9))
NEAR = HOW.tolerance


def fitting(session: Session, campaign: str = "one", plan: Plan = PLAN, name: str = "") -> Session:
    """The session, with a plan for the fit."""
    session.begin(name or f"{campaign}-fit", plan, NEAR, campaign_id=campaign)
    return session


def validating(session: Session, campaign: str = "one") -> Session:
    session.begin(f"{campaign}-validation", HELD_OUT, NEAR, campaign_id=campaign, role=VALIDATION)
    return session


def held_out(row: int, error: float = 0.0) -> Standstill:
    return seen(row, error, 7, HELD_OUT)


def validated(store: SessionStore, error: float = 0.0) -> Session:
    """Eight measurements for the fit and two that are held out."""
    session = fitting(begun(store, None))
    take(session, *(seen(k) for k in range(8)))
    take(validating(session), held_out(0, error), held_out(1, error))
    session.estimate(HOW)
    assert not session.judge()
    return session


def again(store: SessionStore) -> Session:
    """A session as a node that starts anew finds it."""
    return begun(store, None)


def take(session: Session, *standstills: Standstill) -> list[str]:
    """What becomes of standstills, without an estimate after each."""
    return [session.take(s, HOW, "laser").status for s in standstills]


def told(session: Session) -> list[tuple[object, ...]]:
    return [(r.number, r.status, r.role, r.index, r.repetition, session.plan_id_of(r)) for r in session.records]


def rows(folder: Path) -> dict[str, int]:
    """Rows of the tables in a folder."""
    return {p.stem: len(read_data(p, ROBOT).data) for p in folder.glob("*.csv")}


# ── one campaign after another ───────────────────────────────────────────────────────────────────────


def test_plans_of_one_campaign_share_their_measurements() -> None:
    session = fitting(begun(opened(""), None))
    take(session, *(seen(k) for k in range(3)))
    more = replace(PLAN, configurations=PLAN.configurations[[2, 1, 5]], repetitions=np.ones(3, int))
    fitting(session, plan=more, name="one-fit-2")
    assert [r.index for r in session.records] == [None, 1, 0] and session.missing() == [2]
    take(session, seen(5))
    assert session.complete and told(session)[-1][2:] == (FIT, 2, 0, "one-fit-2")
    assert told(again(session.store)) == told(session)


@pytest.mark.parametrize("keep", [False, True])
def test_a_campaign_inherits_nothing(tmp_path: Path, keep: bool) -> None:
    """Of the campaign before, of a plan of no campaign, and a plan of none inherits nothing from a campaign."""
    session = begun(opened(""))
    take(session, *(seen(k) for k in range(5)))
    take(fitting(session), *(seen(k) for k in range(6)))
    session.begin("two-fit", PLAN, NEAR, campaign_id="two", keep=keep)
    assert not session.records and isinstance(session.estimate(HOW), TooFew)
    take(session, *(seen(k, attempt=1) for k in range(7)))
    session.begin("q", planned(4), NEAR, keep=keep)
    assert not session.records
    fitting(session, "two")
    saving.save(str(tmp_path), session, HOW)
    assert rows(tmp_path) == {"measurements_two-fit": 7}
    fitting(session, "one")
    assert len(session.records) == 6
    session.begin("p", PLAN, NEAR, keep=keep)
    assert len(session.records) == 5


def test_a_name_belongs_to_one_plan_of_one_campaign_and_role() -> None:
    session = validated(opened(""))
    before = told(session)
    for name, campaign, role, plan in [
        ("one-fit", "two", FIT, PLAN),
        ("one-fit", "", FIT, PLAN),
        ("one-fit", "one", VALIDATION, PLAN),
        ("one-fit", "one", FIT, planned(4)),
        ("one-validation", "one", FIT, HELD_OUT),
        ("x", "y" * 501, FIT, PLAN),
    ]:
        with pytest.raises(InputError, match=r"plan_id|campaign_id"):
            session.begin(name, plan, NEAR, campaign_id=campaign, role=role)
        assert told(session) == before


# ── validation ───────────────────────────────────────────────────────────────────────────────────────


def test_a_validation_takes_no_part_in_the_fit(tmp_path: Path) -> None:
    """The estimate is that of the fit, bit for bit, also with a validation far off; and so after a restart."""
    alone = fitting(begun(opened(""), None))
    take(alone, *(seen(k) for k in range(8)))
    alone.estimate(HOW)
    session = validated(opened(tmp_path / "store"), error=5e-3)
    a, b = alone.newest, session.newest
    assert isinstance(a, Estimate) and isinstance(b, Estimate)
    np.testing.assert_array_equal(a.fit.values, b.fit.values)
    assert a.points == b.points and a.validation is None
    assert b.validation is not None and 4e-3 < b.validation.rms < 6e-3 and b.validation.count == 2
    assert session.configurations == 8 and session.missing() == [2, 3] and not session.complete
    assert [r.role for r in session.records] == [FIT] * 8 + [VALIDATION] * 2
    assert {r.status for r in session.records} == {"accepted"}, "the fit judges its own points only"
    saving.save(str(tmp_path), session, HOW)
    assert rows(tmp_path) == {"measurements_one-fit": 8, "validation_one-fit": 2}
    session.store.close()
    restarted = again(opened(tmp_path / "store"))
    assert told(restarted) == told(session) and restarted.plan_id == "one-validation"
    c = restarted.estimate(HOW)
    assert_same_estimate(b, c)
    assert isinstance(c, Estimate) and c.validation is not None and c.validation.rms == b.validation.rms
    restarted.store.close()


def test_a_validation_does_not_make_the_fit_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    session = validated(opened(""))
    made: list[object] = []
    identified = saving.identify
    monkeypatch.setattr(saving, "identify", lambda *a: made.append(a) or identified(*a))
    measure(session, held_out(2))
    assert not made and isinstance(session.newest, Estimate) and session.newest.validation.count == 3
    session.undo()
    session.estimate(HOW)
    assert not made
    session.estimate(replace(HOW, sigma=1e-4))
    assert len(made) == 1
    session.undo(session.records[0].number)
    session.estimate(replace(HOW, sigma=1e-4))
    assert len(made) == 2


def test_outliers_of_the_fit_are_found_between_held_out_measurements() -> None:
    session = fitting(begun(opened(""), None))
    take(session, *(seen(k) for k in range(5)))
    take(validating(session), held_out(0), held_out(1))
    take(fitting(session), seen(5), seen(6), seen(7))
    assert measure(session, seen(8, 1e-3)) == ["accepted", "8 outlier"]
    assert [r.status for r in session.of(VALIDATION)] == ["accepted"] * 2 and session.done()[8] == 0


def test_a_validation_joins_the_fit_only_where_a_plan_for_the_fit_wants_it() -> None:
    session = validated(opened(""))
    fitting(session)
    assert len(session.of(VALIDATION)) == 2, "a plan that has none of its configurations"
    both = np.vstack([PLAN.configurations, HELD_OUT.configurations[:1], PLAN.configurations[:1] + NEAR / 2])
    session.begin("v2", plan_of(ROBOT, PLAN.configurations[:1]), NEAR, campaign_id="one", role=VALIDATION)
    take(session, seen(0, attempt=3))
    fitting(session, plan=plan_of(ROBOT, both[:-1]), name="one-fit-2")
    assert [r.index for r in session.of(FIT)] == [0, 1, 2, 3, 4, 5, 6, 7, 12], "the one that is wanted"
    assert len(session.of(VALIDATION)) == 2, "row 0 is measured for the fit already"
    assert session.missing() == [8, 9, 10, 11] and told(again(session.store)) == told(session)
    estimate = session.estimate(HOW)
    assert isinstance(estimate, Estimate) and estimate.points.used == 9 and estimate.validation.count == 2


def test_a_validation_alone_is_saved_as_one(tmp_path: Path) -> None:
    session = validating(begun(opened(""), None))
    take(session, held_out(0))
    assert isinstance(session.estimate(HOW), TooFew)
    saving.save(str(tmp_path), session, HOW)
    assert rows(tmp_path) == {"validation_one-validation": 1}


def test_a_reset_forgets_both() -> None:
    session = validated(opened(""))
    assert session.reset() == 10 and not session.records and session.campaign_id == "one"
    assert measure(fitting(session), seen(0)) == ["accepted"] and len(again(session.store).records) == 1


def test_what_a_plan_changes_is_stored_when_that_is_possible() -> None:
    session = validated(opened(""))
    session.store._database.execute("PRAGMA query_only = ON")
    both = plan_of(ROBOT, np.vstack([HELD_OUT.configurations[:1], PLAN.configurations]))
    fitting(session, plan=both, name="one-fit-2")
    assert len(session.of(FIT)) == 9 and session.records[0].index == 1
    assert take(session, seen(8)) == ["not_stored"]
    session.store._database.execute("PRAGMA query_only = OFF")
    take(session, seen(8))
    assert told(again(session.store)) == told(session) and len(session.records) == 11


# ── a recording that is played twice ─────────────────────────────────────────────────────────────────


def test_a_recording_played_twice_counts_once(tmp_path: Path) -> None:
    store = opened(tmp_path)
    session = begun(store)
    played = [seen(k, 1e-3 if k == 6 else 0.0) for k in range(10)]
    take(session, *played)
    session.estimate(HOW)
    assert len(session.judge()) == 1
    session.undo(session.records[2].number)
    numbers = [r.number for r in session.records]
    expected = ["undone" if k == 2 else "outlier" if k == 6 else "accepted" for k in range(10)]
    assert take(session, *played) == expected
    assert [r.number for r in session.records] == numbers
    # Begun in the middle of a standstill: its end is averaged, which is seen a little elsewhere.
    halves = [
        replace(s, start=s.start + NANO // 2, joints=s.joints + 1e-5, points=s.points + 1e-5) for s in played
    ]
    assert {session.take(h, HOW).status for h in halves} == {"accepted", "outlier", "undone"}
    store.close()
    restarted = again(opened(tmp_path))
    take(restarted, *played, *halves)
    assert [r.number for r in restarted.records] == numbers and restarted.rejections == session.rejections
    assert restarted.reset() == 9 and take(restarted, *played[:4]) == ["accepted"] * 4
    restarted.store.close()


def test_the_same_time_elsewhere_is_another_measurement() -> None:
    """The clock of a simulation begins at zero each time."""
    session = begun(opened(""))
    take(session, seen(0))
    assert session.take(replace(seen(1), start=seen(0).start, end=seen(0).end), HOW).status == "accepted"
    assert session.take(replace(seen(0), start=5 * NANO, end=6 * NANO), HOW).status == "accepted"
    assert len(session.records) == 3


def test_what_was_refused_counts_once_and_may_be_accepted_later(tmp_path: Path) -> None:
    session = again(opened(tmp_path))
    moved = Rejection(1, 2, RejectionReason.MOVED, "moved", np.zeros(2), np.array([3]))
    first = session.refuse(moved), session.take(seen(0), HOW)
    second = session.refuse(moved), session.take(seen(0), HOW)
    assert [r.number for r in first] == [r.number for r in second] == [1, 2]
    session.store.close()
    session = again(opened(tmp_path))
    session.refuse(moved)
    assert session.rejections == {"moved": 1, "not_in_plan": 1}
    session.begin("p", PLAN, NEAR)
    assert take(session, seen(0)) == ["accepted"]
    session.store.close()
