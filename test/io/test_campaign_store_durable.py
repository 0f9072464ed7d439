# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The campaign store on full and read-only disks and under kill -9: nothing told to be kept is lost."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from stores import assert_same, begun, decision, opened, standstill

from calib_planner import Plan
from calib_planner.errors import StoreError
from calib_planner.io import LONGEST, SessionStore
from calib_planner.io.store import FILE


def test_a_full_database_changes_nothing_and_recovers(store: SessionStore) -> None:
    campaign = begun(store)
    kept = store.record(campaign, decision(standstill(1)))
    pages = store._database.execute("PRAGMA page_count").fetchone()[0]
    store._database.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(StoreError, match="full"):
        for k in range(1000):
            kept = store.record(campaign, decision(standstill(k)))
    for _ in range(3):
        with pytest.raises(StoreError, match="full"):
            store.record(campaign, decision(standstill(1), frame="x" * LONGEST))
    found = store.current()
    assert found is not None and found.records[-1].number == kept
    store._database.execute("PRAGMA max_page_count = 100000")
    assert store.record(campaign, decision(standstill(2))) == kept + 1


def test_a_read_only_disk_changes_nothing_and_recovers(store: SessionStore, planned: Plan) -> None:
    campaign = begun(store)
    number = store.record(campaign, decision(standstill(1)))
    store._database.execute("PRAGMA query_only = ON")  # answers as a file system mounted read-only does
    for attempt in (
        lambda: store.record(campaign, decision(standstill(2))),
        lambda: store.decide(campaign, [decision(standstill(1), number=number)]),
        lambda: store.begin("other", planned),
        lambda: store.restart("p", None),
    ):
        with pytest.raises(StoreError, match="readonly"):
            attempt()
    store._database.execute("PRAGMA query_only = OFF")
    found = store.current()
    assert found is not None and found.number == campaign and [d.number for d in found.records] == [number]
    assert store.record(campaign, decision(standstill(2))) == number + 1


LIMITED = """
    import resource, sys
    from dataclasses import replace
    from stores import *
    from calib_planner.errors import StoreError
    store = opened(sys.argv[1])
    campaign = begun(store)
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, hard))
    kept, refused = [], 0
    for k in range(400):
        try:
            kept.append(store.record(campaign, decision(standstill(k))))
        except StoreError as error:
            refused += 1
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    after = [store.record(campaign, decision(standstill(k))) for k in range(5)]
    print(refused, *kept, *after)
"""


def run_script(script: str, folder: Path) -> subprocess.Popen[str]:
    paths = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[2])])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([paths, os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-c", textwrap.dedent(script), str(folder)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


def test_writes_that_the_system_refuses(tmp_path: Path) -> None:
    pytest.importorskip("resource")
    with run_script(LIMITED, tmp_path) as process:
        refused, *kept = map(int, process.communicate(timeout=120)[0].split())
    assert process.returncode == 0 and refused > 10 and len(kept) > 10
    store = opened(tmp_path)
    found = store.current()
    store.close()
    assert found is not None and [d.number for d in found.records] == kept


def test_a_file_that_is_taken_away_is_noticed(tmp_path: Path, store: SessionStore) -> None:
    campaign = begun(store)
    (tmp_path / FILE).rename(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match="put it back"):
        store.record(campaign, decision(standstill(1)))
    (tmp_path / "elsewhere").rename(tmp_path / FILE)
    assert store.record(campaign, decision(standstill(1))) == 1


@pytest.mark.parametrize("folder", ["file/below", "file"])
def test_a_folder_that_cannot_be_made(tmp_path: Path, folder: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="choose a folder"):
        opened(tmp_path / folder)


# ── kill -9 ──────────────────────────────────────────────────────────────────────────────────────────

WRITERS = """
    import os, sys
    from dataclasses import replace
    from stores import *

    def tell(text):
        os.write(1, f"{text}\\n".encode())  # a line at once, or none of it, whenever the process is killed

    def write():
        store = opened(sys.argv[1])
        found = store.current() or store.begin("p", None)
        state = {d.number: d.status for d in found.records}
        tell(" ".join([str(os.getpid()), *(f"{n}:{s}" for n, s in state.items())]))
        k = len(state)
        while True:
            k += 1
            d = decision(standstill(k))
            number = store.record(found.number, d)
            tell(f"{number}:accepted")
            if k % 3 == 0:
                store.decide(found.number, [replace(d, number=number).now("undone", "")])
                tell(f"{number}:undone")

    for _ in range(8):
        child = os.fork()
        if child == 0:
            write()
        os.waitpid(child, 0)
        tell("killed")
"""
"""Eight processes, one after the other, that write until somebody kills them; the imports are made once."""


def test_nothing_acknowledged_is_lost_by_kill_9(tmp_path: Path) -> None:
    rng = random.Random(7)
    told: dict[int, str] = {}
    with run_script(WRITERS, tmp_path) as process:
        assert process.stdout is not None
        for _ in range(8):
            writer, *first = process.stdout.readline().split()
            restored = {int(n): s for n, s in (word.split(":") for word in first)}
            # At most the one step under way at the kill was committed without having been told.
            news = set(restored.items()) - set(told.items())
            assert len(news) <= 1 and set(told) <= set(restored)
            assert all(restored[n] == s or restored[n] == "undone" for n, s in told.items())
            told = restored
            for _ in range(rng.randrange(1, 40)):
                number, status = process.stdout.readline().strip().split(":")
                told[int(number)] = status
            os.kill(int(writer), signal.SIGKILL)
            while (line := process.stdout.readline()) != "killed\n":
                told[int(line.split(":")[0])] = line.strip().split(":")[1]
    assert len(told) > 30
    store = opened(tmp_path)
    found = store.current()
    store.close()
    assert found is not None
    for d in found.records:
        assert_same(d, replace(decision(standstill(d.number)), number=d.number, status=d.status))


def test_a_store_that_is_closed_while_others_use_it_refuses_them(tmp_path: Path) -> None:
    store, met = opened(tmp_path), []
    number = begun(store)

    def use(read: bool) -> None:
        for seed in range(10**6):
            try:
                _ = store.empty if read else store.record(number, decision(standstill(seed)))
            except StoreError as error:
                met.append(error)
                return

    threads = [threading.Thread(target=use, args=(k % 2 == 0,)) for k in range(4)]
    for thread in threads:
        thread.start()
    time.sleep(0.05)
    store.close()
    for thread in threads:
        thread.join(20.0)
    assert len(met) == 4
