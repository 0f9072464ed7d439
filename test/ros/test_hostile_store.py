# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot that answers nonsense, and stores that are none: each with a campaign of its own.

Apart from ``test_hostile_campaign.py``, whose campaign lives for all of its tests: where two nodes of a process
have one name, the end of one ends what the other says on ``/rosout``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from bench import Bench
from desk import ASKED, Desk, S
from fake_cell import FakeCell

from calib_planner.io.store import CAMPAIGN_FILE as FILE
from calib_planner.io.store import JOURNAL
from calib_planner.io.store import JOURNAL_FORMAT as FORMAT
from calib_planner.ros.nodes.campaign import CampaignNode

INF = float("inf")


def test_a_robot_that_answers_nonsense(bench: Bench) -> None:
    """A status that is none, a message of a million characters, feedback of no goal: a failure of the place."""
    cell = bench.start(FakeCell)
    cell.answer = lambda q: "nonsense" if q[0] > 0.5 else "ok"
    desk = Desk(bench)
    assert desk.call("start")[0]
    done = desk.until(S.DONE, 60.0)
    assert done.outcome == S.OUTCOME_REACHED and done.excluded >= 1
    assert all(0 < len(e.reason) <= 500 for e in desk.node.campaign.exclusions)
    assert all(len(m.reason) <= 1000 for m in desk.heard)


HEAD = {"format": FORMAT, "campaign": "x", "robot": "planar_2r", "joint_names": ["q1", "q2"], "targets": 1}
ROW = {"measured": 1, "role": "fit", "configuration": [0.1, 0.2], "points": [[1.0, 0.0, 0.0]]}
JOURNALS: dict[str, list[Any]] = {
    "numbers beyond all": [HEAD, ROW | {"measured": INF}],
    "a role of its own": [HEAD, ROW | {"role": "../../escaped"}],
    "joints": [HEAD, ROW | {"configuration": [0.1] * 10_000}],
    "points": [HEAD, ROW | {"points": "../../escaped"}],
    "other joints": [HEAD | {"joint_names": ["q1"] * 10_000}],
    "nested": ["[" * 100_000],
    "no journal": ["../../escaped"],
    "a list": [[HEAD]],
}


@pytest.mark.parametrize("case", JOURNALS)
def test_a_journal_that_is_none_is_left_alone(bench: Bench, tmp_path: Path, case: str) -> None:
    lines = [x if isinstance(x, str) and x.startswith("[") else json.dumps(x) for x in JOURNALS[case]]
    (tmp_path / JOURNAL).write_text("\n".join(lines) + "\n")
    before = (tmp_path / JOURNAL).read_bytes()
    desk = Desk(bench, store_folder=str(tmp_path))
    assert desk.node.is_active and "cannot go on" in desk.now.reason and len(desk.now.reason) <= 1000
    assert [p.name for p in tmp_path.iterdir()] == [JOURNAL] and (tmp_path / JOURNAL).read_bytes() == before


def test_a_campaign_whose_name_leaves_the_folder_writes_nothing_there(bench: Bench, tmp_path: Path) -> None:
    store = tmp_path / "a" / "store"
    store.mkdir(parents=True)
    (store / JOURNAL).write_text(json.dumps(HEAD | {"campaign": "/../../../escaped"}) + "\n")
    bench.start(FakeCell)
    desk = Desk(bench, elsewhere=True)
    desk.node = bench.start(CampaignNode, **(ASKED | {"store_folder": str(store)}))
    bench.wait(lambda: desk.call("pause")[0])
    assert desk.call("resume")[0]
    assert "were not written" in desk.until(S.DONE, 60.0).reason
    names = {FILE, "campaign_journal_converted_1.jsonl"}
    assert {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()} == {
        f"a/store/{n}" for n in names
    }
