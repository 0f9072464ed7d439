# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What is on the disk after a crash at every system call, on a full disk, and after a power cut.

A *program* writes in steps, and acknowledges each: the store of an identifier, the record of a campaign, a
journal of an earlier version, a file of results. One run without disturbance tells what a reader finds after each
step. Then the program is run again and again:

* **killed** at each of its system calls that change the folder, in writes after none, one, half or all but one of
  the bytes;
* with a **full disk** at each call, for one call or for several: a step that failed is made again once there is
  room, and in the end everything is there as without disturbance;
* after a **power cut** before each call: of what was not yet synchronised any part may be there or not, whole or
  torn, file by file, and so may names in a folder (drawn with a seed).

Each time a reader has to find what it finds after all acknowledged steps, or after one more: the one under way.

    python bench/crashes.py                     # everything: about a minute
    python bench/crashes.py --every 10 --only session

JSON goes to stdout. Exit status 1 if something was not as it has to be.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from system_calls import (
    CREATE,
    FOLDER,
    NOTE,
    RENAME,
    SYNC,
    TRUNCATE,
    UNLINK,
    WRITE,
    Call,
    Control,
    acknowledge,
    calls,
    forked,
    interposed,
)

from calib_planner import Plan, Robot
from calib_planner.acquisition import Standstill
from calib_planner.campaign import FIT, VALIDATION, CampaignProblem, NextStep, PlannedConfiguration, Round, begin
from calib_planner.errors import CalibPlannerError
from calib_planner.io import (
    ACCEPTED,
    UNDONE,
    Record,
    StoredModel,
    begin_campaign,
    open_campaign,
    open_store,
    stored_goals,
    write_text,
)
from calib_planner.planning import PlanQuality

STORE: Any = sys.modules[open_store.__module__]
"""The module behind the door, for the names of its files."""
CAMPAIGN_FILE, FILE, JOURNAL, JOURNAL_FORMAT = (
    STORE.CAMPAIGN_FILE,
    STORE.FILE,
    STORE.JOURNAL,
    STORE.JOURNAL_FORMAT,
)
ROBOT = Robot.load("planar_2r")
MODEL = StoredModel(ROBOT.name, ROBOT.joint_names, 1, "links: [1, 0.7]")
PROBLEM = CampaignProblem(ROBOT, [0.2, 0.9], 1e-5)
GOALS = {"required_accuracy": 1e-5, "test_poses": "0.2 0.9", "budget": 60}
Q = np.random.default_rng(0).uniform(-1.5, 1.5, (8, 2))
POINTS = np.random.default_rng(1).normal(size=(8, 1, 3)) / 3.0

Step = Callable[[], Any]


@dataclass(frozen=True)
class Program:
    """What writes.

    Attributes:
        steps: Takes a folder; the steps, which may be made again after they failed.
        found: Takes a folder; what a reader finds, comparable.
        between: Takes what is found before a step, after it, and between; whether that may be.
    """

    steps: Callable[[Path], list[Step]]
    found: Callable[[Path], Any]
    between: Callable[[Any, Any, Any], bool] = lambda before, after, got: False


# ── the store of an identifier ───────────────────────────────────────────────────────────────────────


def plan(count: int) -> Plan:
    """A plan of the first so many configurations."""
    unknown = PlanQuality(np.full(1, np.nan), np.full(len(ROBOT.parameter_names), np.nan))
    names = ROBOT.parameter_names, ROBOT.joint_names
    numbers = Q[:count], np.ones(count, int), Q[:1], np.ones(1), 3e-5
    return Plan(ROBOT.name, *names, *numbers, quality=unknown)


def record(k: int) -> Record:
    """An accepted standstill at configuration ``k``."""
    start = 1_700_000_000_000_000_000 + k
    stood = Standstill(start, start + 7, Q[k], POINTS[k], np.full(1, 1e-5), np.array([40]))
    return Record(stood, ACCEPTED, "", k, 0, frame="laser")


def session_steps(folder: Path) -> list[Step]:
    """Measuring, undoing, another plan, the beginning of another session; with a restart in between."""
    now: dict[str, Any] = {"numbers": {}}

    def opened() -> None:
        now["store"] = open_store(str(folder), MODEL, {"sigma": 3e-5}, "1.2.3")
        now["store"]._database.execute("PRAGMA wal_autocheckpoint = 20")  # many a commit is followed by one

    def measured(k: int) -> Step:
        def step() -> None:
            now["numbers"][k] = now["store"].record(now["session"], record(k))

        return step

    def begun(plan_id: str, count: int) -> Step:
        def step() -> None:
            now["session"] = now["store"].begin(plan_id, plan(count), (), "c", FIT).number

        return step

    def decided(k: int, status: str) -> Step:
        def step() -> None:
            known = replace(record(k), number=now["numbers"][k])
            now["store"].decide(now["session"], [known.now(status, "seen otherwise")])

        return step

    def withdrawn(k: int) -> Step:
        return lambda: now["store"].withdraw(replace(record(k), number=now["numbers"][k]).now(UNDONE, ""))

    def restarted() -> None:
        now["session"] = now["store"].restart("p", plan(4), "c").number

    def closed() -> None:
        now["store"].close()

    life = [opened, begun("p", 4), measured(0), measured(1), decided(1, "outlier"), measured(2), withdrawn(0)]
    life += [closed, opened, begun("q", 6), measured(3), measured(4), decided(1, ACCEPTED), restarted]
    return [*life, measured(5), closed]


def session_found(folder: Path) -> Any:
    """Plan, records and trail of decisions of the current session, and how many standstills there are in all."""
    if not (folder / FILE).exists():
        return None
    store = open_store(str(folder), MODEL, {"sigma": 3e-5}, "1.2.3")
    try:
        current = store.current()
        if current is None:
            return None
        (count,) = store._database.execute("SELECT COUNT(*) FROM standstills").fetchone()
        told = [
            (r.number, r.status, r.reason, r.index, r.acquired.start, r.standstill.points.tolist(), r.unused)
            for r in current.records
        ]
        trail = [[d["status"] for d in store.history(r.number)] for r in current.records]
        return current.number, current.plan_id, told, trail, count
    finally:
        store.close()


# ── the record of a campaign ─────────────────────────────────────────────────────────────────────────


def campaign_steps(folder: Path) -> list[Step]:
    """A campaign with everything that can happen, a restart in between; then another one takes its place."""
    stops = tuple(PlannedConfiguration(q, FIT if k < 5 else VALIDATION) for k, q in enumerate(Q))
    known = Round(0, 3, 2, 1e-4, 1e-6, 3e-5, 4.0, 2, "more")
    events = [
        lambda s: s.decided(NextStep(FIT, "", stops, queue=tuple(range(8)), round=known)),
        lambda s: s.measured(0, Q[0], POINTS[0], 11),
        lambda s: s.measured(1, Q[1], POINTS[1], 12),
        lambda s: s.unreachable(2, "a wall"),
        lambda s: s.failed(3, "moved"),
        lambda s: s.measured(3, Q[3], POINTS[3], 14),
        lambda s: s.withdrawn(12, "undone"),
        lambda s: s.skipped(4),
        lambda s: s.measured(5, Q[5], POINTS[5], 15),
        lambda s: s.decided(NextStep(FIT, "", joins=True)),
        lambda s: s.measured(6, Q[6], POINTS[6], 17),
    ]
    now: dict[str, Any] = {"state": begin(PROBLEM)}

    def begun(name: str) -> Step:
        def step() -> None:
            now["store"] = begin_campaign(folder, name, ROBOT, GOALS | {"seed": len(name)}, "1.2.3")
            now["state"] = begin(PROBLEM)

        return step

    def noted(event: Any) -> Step:
        def step() -> None:
            after = event(now["state"])
            now["store"].note(now["state"], after)
            now["state"] = after

        return step

    def closed() -> None:
        now["store"].close()

    def reopened() -> None:
        stored = open_campaign(folder, ROBOT)
        assert stored is not None
        now["store"] = stored.store

    first, second = events[:7], events[7:]
    life = [begun("one"), *map(noted, first), closed, reopened, *map(noted, second), closed]
    return [*life, begun("another"), *map(noted, events[:3]), closed]


def campaign_found(folder: Path) -> Any:
    """What the record says, its goals, and what the records that were set aside say."""
    aside = []
    for path in sorted(folder.glob(f"before_*_{CAMPAIGN_FILE}")):
        with tempfile.TemporaryDirectory(prefix="aside_") as copied:
            for part in folder.glob(f"{path.name}*"):  # what could not be taken over stands in a file beside
                shutil.copy(part, Path(copied) / part.name.replace(path.name, CAMPAIGN_FILE))
            aside.append(one_campaign(Path(copied)))
    return one_campaign(folder), aside


def one_campaign(folder: Path) -> Any:
    """What a record says; ``None`` without one."""
    goals = stored_goals(folder)
    stored = open_campaign(folder, ROBOT)
    if stored is None:
        return None
    stored.store.close()
    left_out = [(e.q.tolist(), e.radius, e.reason, e.requested) for e in stored.exclusions]
    failures = [(role, q.tolist(), reason) for role, q, reason in stored.failures]
    others = stored.dropped, [repr(r) for r in stored.rounds], stored.finished
    return stored.campaign_id, goals, stored.rows, left_out, failures, *others


def set_aside(before: Any, after: Any, got: Any) -> bool:
    """While a campaign takes the place of another one there may be none; the former is kept in any case."""
    (former, _), (_, kept) = before, after
    return got[0] is None and (got[1] == kept or (former is None and not got[1]))


def journal_steps(folder: Path) -> list[Step]:
    """A journal of an earlier version is converted."""

    def written() -> None:
        head = {"format": JOURNAL_FORMAT, "campaign": "old", "robot": ROBOT.name, "targets": 1}
        head |= {"joint_names": list(ROBOT.joint_names)}
        told = [
            {"measured": k, "role": FIT, "configuration": Q[k].tolist(), "points": POINTS[k].tolist()}
            for k in (1, 2)
        ]
        write_text(folder / JOURNAL, "".join(json.dumps(line) + "\n" for line in (head, *told)))

    def converted() -> None:
        stored = open_campaign(folder, ROBOT)
        assert stored is not None
        stored.store.close()

    return [written, converted]


# ── a file of results ────────────────────────────────────────────────────────────────────────────────


def file_steps(folder: Path) -> list[Step]:
    """A file is written, and written anew."""
    return [lambda n=n: write_text(folder / "estimate.yaml", f"{n}\n" * 5000) for n in range(3)]  # type: ignore[misc]


def file_found(folder: Path) -> Any:
    """Its text."""
    path = folder / "estimate.yaml"
    return path.read_text() if path.exists() else None


PROGRAMS = {
    "session": Program(session_steps, session_found),
    "campaign": Program(campaign_steps, campaign_found, set_aside),
    "journal": Program(journal_steps, one_campaign),
    "file": Program(file_steps, file_found),
}

# ── disturbances ─────────────────────────────────────────────────────────────────────────────────────


@dataclass
class Found:
    """What came of a program.

    Attributes:
        calls: System calls that change its folder.
        steps: Its steps.
        runs: Disturbed runs by kind.
        wrong: What was not as it has to be, in words.
        refused: Steps that a full disk refused, all kinds of runs together.
    """

    calls: int = 0
    steps: int = 0
    runs: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    refused: int = 0


@dataclass(frozen=True, eq=False)
class Disturbance:
    """Runs one program again and again.

    Args:
        program: The program.
        control: Of this process and its children.
        folder: For all its files.
    """

    program: Program
    control: Control
    folder: Path
    found: Found = field(default_factory=Found)
    states: list[Any] = field(default_factory=list)

    def fresh(self) -> Path:
        """An empty folder for the program."""
        place = self.folder / "place"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        return place

    def work(self, place: Path) -> None:
        """Make all steps and acknowledge each."""
        for k, step in enumerate(self.program.steps(place), 1):
            step()
            acknowledge(k)

    def undisturbed(self) -> list[Call]:
        """Find out what a reader finds after each step; returns the calls of the whole program."""
        place, count = self.fresh(), len(self.program.steps(Path()))
        self.states.append(self.read(place))
        for k in range(1, count + 1):
            place = self.fresh()
            # Ended as by kill -9 after the k-th step, since a store that is open cannot be read.
            forked(lambda place=place, k=k: [step() for step in self.program.steps(place)[:k]] and os._exit(0))  # type: ignore[misc]
            self.states.append(self.read(place))
        place, log = self.fresh(), Path(os.environ["SYSTEM_CALLS_LOG"])
        log.write_bytes(b"")
        os.truncate(log, 0)
        self.control.begin(place, logging=1)
        assert forked(lambda: self.work(place)) == 0
        self.found.calls, self.found.steps = self.control.count, count
        self.control.begin(Path())
        return list(calls(log))

    def read(self, place: Path) -> Any:
        """What a reader finds, or what it says instead."""
        try:
            return self.program.found(place)
        except CalibPlannerError as error:
            return f"unreadable: {error}"

    def judge(self, what: str, place: Path, acknowledged: int) -> None:
        """Compare what is found with the steps acknowledged, or one more."""
        got = self.read(place)
        allowed = self.states[acknowledged : acknowledged + 2]
        self.found.runs[what.split()[0]] += 1
        if got in allowed or (len(allowed) > 1 and self.program.between(*allowed, got)):
            return
        self.found.wrong.append(f"{what}, {acknowledged} steps acknowledged: {got}"[:400])

    def kill(self, numbers: Sequence[int], sizes: dict[int, int]) -> None:
        """End the program at each of the calls; ``sizes`` are bytes that a call writes."""
        for number in numbers:
            size = sizes.get(number, 0)
            for torn in sorted({0, *((1, size // 2, size - 1) if size > 2 else ())}):
                place = self.fresh()
                self.control.begin(place, kill_at=number, torn=torn)
                status = forked(lambda place=place: self.work(place))  # type: ignore[misc]
                acknowledged = self.control.acknowledged
                self.control.begin(Path())
                if status != -signal.SIGKILL:
                    self.found.wrong.append(f"killed at call {number}: the program ended with {status}")
                self.judge(f"killed at call {number} after {torn} bytes", place, acknowledged)

    def fill(self, numbers: Sequence[int], lasting: Sequence[int]) -> None:
        """Let the disk be full from each of the calls on, for one call or more; then there is room again."""
        for number in numbers:
            for some in lasting:
                place = self.fresh()
                self.control.begin(place, full_from=number, full_until=number + some)
                if (status := forked(lambda place=place: self.patient(place))) != 0:  # type: ignore[misc]
                    self.found.wrong.append(f"full at call {number} for {some}: ended with {status}")
                self.control.full_from = 0
                self.found.refused += self.control.torn
                self.control.begin(Path())
                self.judge(f"full at call {number} for {some} calls", place, self.found.steps)

    def patient(self, place: Path) -> None:
        """Make all steps, each until it succeeds; in ``torn`` is counted how often one was refused."""
        for k, step in enumerate(self.program.steps(place), 1):
            for _ in range(200):
                try:
                    step()
                    break
                except CalibPlannerError as error:
                    self.control.torn += 1
                    text = str(error)
                    if str(place) not in text or not any(
                        word in text for word in ("space", "full", "choose", "disk")
                    ):
                        raise AssertionError(f"it does not say where and what to do: {text}") from None
            else:
                raise AssertionError(f"step {k} never succeeds")
            acknowledge(k)

    def cut(self, made: Sequence[Call], numbers: Sequence[int], rng: random.Random, draws: int) -> None:
        """Cut the power before each of the calls in the log."""
        for number in numbers:
            for draw in range(draws):
                place = self.fresh()
                acknowledged = Disk(place, rng if draw else None).replay(made[:number])
                self.judge(f"cut before call {number}, draw {draw}", place, acknowledged)


class Disk:
    """A disk after a power cut.

    Args:
        place: Where its files are put.
        rng: Draws what of the unsynchronised is there; ``None``: nothing of it.
    """

    def __init__(self, place: Path, rng: random.Random | None) -> None:
        self._place, self._rng = place, rng
        self._durable: dict[int, bytearray] = {}  # file → its bytes on the disk
        self._pending: dict[int, list[Call]] = {}  # file → what was written since
        self._names: dict[str, int] = {}  # names now
        self._kept: dict[str, int] = {}  # names on the disk
        self._changes: dict[str, list[tuple[str, int | None]]] = {}  # folder → names that changed since

    def replay(self, made: Sequence[Call]) -> int:
        """Do all calls, cut the power, write what is left; returns how many steps had been acknowledged."""
        acknowledged = 0
        for call in made:
            if call.kind == NOTE:
                acknowledged = call.offset
            elif call.kind in (WRITE, TRUNCATE):
                self._pending[self._file(call.path)].append(call)
            elif call.kind == SYNC:
                self._sync(call.path)
            elif call.kind == CREATE:
                self._file(call.path)
            elif call.kind == UNLINK:
                self._name(call.path, None)
                self._names.pop(call.path, None)
            elif call.kind == RENAME:
                target = os.fsdecode(call.data)
                self._names[target] = self._names.pop(call.path)
                self._name(call.path, None)
                self._name(target, self._names[target])
            else:
                assert call.kind == FOLDER
        self._write()
        return acknowledged

    def _file(self, path: str) -> int:
        if path not in self._names:
            self._names[path] = number = len(self._durable)
            self._durable[number], self._pending[number] = bytearray(), []
            self._name(path, number)
        return self._names[path]

    def _name(self, path: str, number: int | None) -> None:
        self._changes.setdefault(os.path.dirname(path), []).append((path, number))

    def _sync(self, path: str) -> None:
        if path in self._names:
            number = self._names[path]
            for call in self._pending[number]:
                apply(self._durable[number], call)
            self._pending[number] = []
        else:
            for name, file in self._changes.pop(path, []):
                self._keep(name, file)

    def _keep(self, name: str, file: int | None) -> None:
        if file is None:
            self._kept.pop(name, None)
        else:
            self._kept[name] = file

    def _write(self) -> None:
        rng = self._rng
        for changes in self._changes.values():  # a journal of the file system keeps their order
            for name, file in changes[: rng.randint(0, len(changes)) if rng else 0]:
                self._keep(name, file)
        for name, number in self._kept.items():
            content = self._durable[number]
            for call in self._pending[number]:
                if rng and rng.random() < 0.5:
                    torn = rng.randrange(0, len(call.data) + 1, 512) if call.data and rng.random() < 0.3 else None
                    apply(content, replace(call, data=call.data[:torn]))
            path = self._place / Path(name).name
            path.write_bytes(content)


def apply(content: bytearray, call: Call) -> None:
    """Do a write or a truncation."""
    size = call.offset + len(call.data) if call.kind == WRITE else call.offset
    if len(content) < size:
        content.extend(bytes(size - len(content)))
    if call.kind == WRITE:
        content[call.offset : size] = call.data
    else:
        del content[size:]


def run(name: str, control: Control, folder: Path, every: int, seed: int, draws: int) -> Found:
    """All disturbances of a program, at every so many calls."""
    rng = random.Random(seed)
    test = Disturbance(PROGRAMS[name], control, folder)
    made = test.undisturbed()
    counted = [c for c in made if c.kind != NOTE]
    sizes = {k: len(c.data) if c.kind == WRITE else 0 for k, c in enumerate(counted, 1)}
    first = rng.randint(1, every)
    numbers = range(first, test.found.calls + 1, every)
    test.kill(numbers, sizes)
    test.fill(numbers, (1, 3, 30)[: max(1, 3 // every)])
    test.cut(made, range(first, len(made) + 1, every), rng, draws)
    return test.found


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--every", type=int, default=1, help="disturb at every so many calls")
    parser.add_argument("--draws", type=int, default=4, help="power cuts at each call; the first leaves nothing")
    parser.add_argument("--only", nargs="*", choices=[*PROGRAMS], default=[*PROGRAMS])
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    control, began, answer = interposed(), time.monotonic(), {}
    with tempfile.TemporaryDirectory(prefix="crashes_") as folder:
        for name in chosen.only:
            with suppress(KeyboardInterrupt):
                found = run(name, control, Path(folder).resolve(), chosen.every, chosen.seed, chosen.draws)
                answer[name] = vars(found)
    print(json.dumps({"programs": answer, "minutes": (time.monotonic() - began) / 60.0}, indent=1))
    return int(any(found["wrong"] for found in answer.values()))


if __name__ == "__main__":
    sys.exit(main())
