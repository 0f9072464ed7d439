# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The identifier killed with ``kill -9`` at random instants, again and again: nothing acknowledged is lost.

A *campaign* measures the rows of one plan; it has many *lives*. In a life a real identifier node runs in a
process of its own and is fed over topics, with stamps that run ahead of the clock: rows that are missing, now and
then a recording of an earlier row once more, now and then ``~/undo_measurement``. Another process kills it. The
next life goes on with the same store. After every kill the store is opened and compared with everything that this
program has heard:

* *lost*: a measurement that was told accepted, counted by an estimate or told undone, and is not so in the store;
* *twice*: one row of the plan, which is measured once, is in use as two measurements;
* *strange*: a row of the store that nobody measured, or one that was withdrawn without a request;
* *unreadable*: the store cannot be opened, or SQLite finds it damaged;
* *not restarted*: the next life is not ready within a minute, or wrote a traceback;
* *differs*: at the end of the campaign the estimate is not, to 1e-12, the one of a campaign without kills.

Each of them is a fault, and makes the exit status 1.

When to kill is chosen by *phase*, so that short phases are met as often as long ones: the node's methods note in
memory that both processes share in which phase they are, and the killing process waits for the n-th time that a
phase is entered and a random time more. A node starts in some tenths of a second because its process is forked
from this one, which has imported everything and has not touched ROS. Everything random comes from the seed; where
in the code a kill hits depends on the machine as well.

Stamps run a hundred times as fast as the clock, so that what is a moment to DDS is seconds to them. Nothing
of that may be lost, or what is measured would depend on it. So the topics are reliable and transient local: a
fresh node, and one who listens to it, hear all from the beginning. And each stream waits for the other as long
as a row takes (``SKEW``), since one may be fetched some messages later. Every row is shown once.

    python bench/kills.py                       # 1 000 kills, a quarter of an hour on two cores
    python bench/kills.py --count 20 --seed 7

JSON goes to stdout, a line per campaign to stderr; ``--keep FOLDER`` keeps logs and stores.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import mmap
import os
import pickle
import random
import signal
import sqlite3
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import UndoMeasurement
from geometry_msgs.msg import PointStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from calib_planner import Plan, Robot
from calib_planner.acquisition import NANO
from calib_planner.errors import CalibPlannerError
from calib_planner.io import KEPT, UNDONE, Record, SessionStore, open_store, stored_model
from calib_planner.planning import PlanQuality
from calib_planner.ros.messages import joints_message, plan_to_message, point_message
from calib_planner.ros.nodes import identifier
from calib_planner.ros.parameters import HISTORY, LATCHED
from calib_planner.ros.processes import own_domain
from calib_planner.ros.session import Session
from calib_planner.simulation import random_deviations

store_room: Any = sys.modules[SessionStore.__module__]
"""The module behind the door: its functions are wrapped to find the instants of a kill, which is no use of it."""
FILE, Store = store_room.FILE, store_room.Store
NAME = "calibration_identifier"
ROWS = 8
"""Configurations of the plan."""
NOISE = 3e-5 / np.sqrt(40.0)
"""Of a row's point [m]: the mean of the 40 points, each of 0.03 mm, that the identifier averages."""
DEEP = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SETTLE = round(0.11 * NANO)
"""What the identifier leaves out before it averages, and one message [ns]."""
LENGTH, AGAIN = 80, 60
"""Points of a row, and of one that is shown once more. Of these a node may miss the first, since it sees at the
fifth message that a clock was set back. If it misses so many that the rest is not of the time that it averaged
before, that rest is too short to be averaged."""
SKEW = 3.0
"""Longest time that a stream waits for the other [s]: a row and the way on, 2.8 s; rows are 3.8 s apart."""
PATIENCE = 60.0
"""Time in which a node has to be ready, on a busy machine [s]."""
LAST_WORDS = 0.03
"""After a kill, time in which what the node had sent before is still heard [s]."""
SAME = 1e-12
"""Largest difference of two estimates from the same numbers, which are added up in another order."""

# ── phases of a node's life ──────────────────────────────────────────────────────────────────────────

LATER = {
    "starting": 0.4,
    "reading the store": 0.005,
    "listening": 0.2,
    "taking a plan": 0.005,
    "accepting": 0.005,
    "writing": 0.002,
    "estimating": 0.02,
    "publishing": 0.0005,
    "undoing": 0.005,
    "ending": 0.02,
    "compacting": 0.001,
}
"""Phase → longest time from its beginning to the kill [s], about what it lasts; inner phases hide outer ones."""
PHASES = tuple(LATER)
TURNS = {
    "accepting": (1, 2, 3),
    "writing": (1, 2, 3, 4, 5),
    "estimating": (1, 2, 3),
    "publishing": (1, 2, 3, 4, 5),
    "compacting": (1, 2, 2, 2),
}
"""Phases that a life enters more than once → how often before the kill; at first a store is only looked into."""
SPIED = (
    (identifier.IdentifierNode, "_enter_session", "reading the store"),
    (identifier.IdentifierNode, "_on_plan", "taking a plan"),
    (identifier.IdentifierNode, "_handle", "accepting"),
    (identifier.IdentifierNode, "_withdraw", "undoing"),
    (identifier.IdentifierOutput, "record", "publishing"),
    (identifier.IdentifierOutput, "estimate", "publishing"),
    (Session, "estimate", "estimating"),
    (Store, "_note_settings", "writing"),
    (SessionStore, "_enter", "writing"),
    (SessionStore, "record", "writing"),
    (SessionStore, "decide", "writing"),
    (SessionStore, "withdraw", "writing"),
    (Store, "close", "compacting"),
)
"""Class, method and its phase; to close a store moves what was written ahead into its file."""


class Marks:
    """Memory that processes share: the phase now, and how often each phase was entered."""

    def __init__(self) -> None:
        self._words = memoryview(mmap.mmap(-1, 4096)).cast("I")

    @property
    def phase(self) -> str:
        """The phase now."""
        return PHASES[self._words[0]]

    def entered(self, phase: str) -> int:
        """How often a phase was entered."""
        return int(self._words[1 + PHASES.index(phase)])

    def enter(self, phase: str) -> int:
        """Enter a phase; returns the number of the one before, for ``leave``."""
        number, before = PHASES.index(phase), int(self._words[0])
        self._words[0] = number
        self._words[1 + number] += 1
        return before

    def leave(self, before: int) -> None:
        """Back to the phase before; after the start that is to listen."""
        self._words[0] = before or (PHASES.index("listening") if self.entered("listening") else 0)


def spy(marks: Marks) -> None:
    """Have the classes of this process, which will be a node, note their phases."""

    def spied(method: Callable[..., Any], phase: str) -> Callable[..., Any]:
        def noted(*args: Any, **others: Any) -> Any:
            before = marks.enter(phase)
            try:
                return method(*args, **others)
            finally:
                marks.leave(before)

        return noted

    for kind, name, phase in SPIED:
        setattr(kind, name, spied(getattr(kind, name), phase))
    activate, close = identifier.IdentifierNode.activate, identifier.IdentifierNode.close

    def activated(node: Any) -> None:
        activate(node)
        marks.enter("listening")

    def closed(node: Any) -> bool:
        marks.enter("ending")
        return close(node)

    setattr(identifier.IdentifierNode, "activate", activated)  # noqa: B010
    setattr(identifier.IdentifierNode, "close", closed)  # noqa: B010


@dataclass(frozen=True)
class Aim:
    """When to kill: ``later`` [s] after a phase is entered for the ``turn``-th time, from 1."""

    phase: str
    turn: int
    later: float

    @classmethod
    def drawn(cls, rng: random.Random) -> Aim:
        """At random, every phase as often."""
        phase = rng.choice(PHASES)
        turn = rng.choice(TURNS.get(phase, (1,)))
        return cls(phase, turn, rng.random() * LATER[phase])


def wait_and_kill(marks: Marks, pid: int, aim: Aim) -> None:
    """What the killing process does."""
    while aim.phase != "starting" and marks.entered(aim.phase) < aim.turn:
        time.sleep(2e-5)
    time.sleep(aim.later)
    os.kill(pid, signal.SIGKILL)


def forked(work: Callable[[], Any]) -> int:
    """The process id of a child that does ``work`` and ends; it is killed when this process ends."""
    parent = os.getpid()
    if pid := os.fork():
        return pid
    try:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() == parent:
            work()
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(0)


# ── what is measured, and what was heard of it ───────────────────────────────────────────────────────


def robot() -> Robot:
    """The robot of all campaigns."""
    return Robot.load("planar_2r").with_parameters("lengths+offsets")


def plan() -> Plan:
    """Its plan: random configurations, whose promises nobody looks at."""
    nominal = robot()
    low, high = nominal.joint_limits.T
    q = np.random.default_rng(5).uniform(low, high, (ROWS, len(low)))
    unknown = PlanQuality(np.full(1, np.nan), np.full(len(nominal.parameter_names), np.nan))
    return Plan(
        nominal.name,
        nominal.parameter_names,
        nominal.joint_names,
        q,
        np.ones(ROWS, int),
        q[:1],
        np.ones(1),
        3e-5,
        quality=unknown,
    )


def points() -> np.ndarray:
    """(ROWS, 3) where the tracker sees the target at each row [m], the same at every attempt."""
    nominal, planned = robot(), plan()
    true = nominal.with_deviations(random_deviations(nominal, 6))
    noise = [NOISE * np.random.default_rng(row).standard_normal(3) for row in range(ROWS)]
    return true.positions(planned.configurations)[:, 0] + np.array(noise)


@dataclass
class Heard:
    """What a campaign has been told so far, and what it was shown.

    Attributes:
        accepted: Number of a measurement → its row, as last told in use.
        undone: Numbers of those that were told undone.
        configurations: How many the newest estimate counts.
        asked: Whether an undo was asked for that nobody has answered.
        shown: (row, first stamp, last stamp) [ns] of every standstill that was shown.
        stored: (row, stamp before its rest) [ns] of those that the store has, in use or withdrawn.
        stamp: The newest stamp [ns].
    """

    accepted: dict[int, int] = field(default_factory=dict)
    undone: set[int] = field(default_factory=set)
    configurations: int = 0
    asked: bool = False
    shown: list[tuple[int, int, int]] = field(default_factory=list)
    stored: list[tuple[int, int]] = field(default_factory=list)
    stamp: int = 1000 * NANO

    def told(self, message: Measurement) -> None:
        """Take what the node says about a standstill."""
        if message.status == Measurement.ACCEPTED and message.id not in self.undone:
            self.accepted[message.id] = message.configuration_index


def records(folder: Path) -> list[Record]:
    """All records of the store's current session.

    Raises:
        CalibPlannerError: It cannot be read.
    """
    model = stored_model(str(folder)) if (folder / FILE).exists() else None
    if model is None:
        return []
    store = open_store(str(folder), model, {}, "")
    try:
        found = store.current()
        return [] if found is None else list(found.records)
    finally:
        store.close()


def faults(folder: Path, heard: Heard) -> list[tuple[str, str]]:
    """(kind, text) of what is not in the store as it was told; ``heard`` goes on with what is there."""
    try:
        kept = records(folder)
        if (folder / FILE).exists():
            with sqlite3.connect(folder / FILE) as raw:
                if (state := raw.execute("PRAGMA integrity_check").fetchone()[0]) != "ok":
                    return [("unreadable", state)]
            raw.close()
    except (CalibPlannerError, sqlite3.Error) as error:
        return [("unreadable", str(error))]
    by_number, bad = {r.number: r for r in kept}, list[tuple[str, str]]()
    in_use = {r.number: r for r in kept if r.status in KEPT}
    withdrawn = {r.number for r in kept if r.status == UNDONE}
    for number, row in heard.accepted.items():
        if number not in in_use and not (heard.asked and number in withdrawn):
            bad.append(("lost", f"measurement {number} of row {row} was accepted: {by_number.get(number)}"))
        elif number in in_use and in_use[number].index != row:
            bad.append(("lost", f"measurement {number} is of row {in_use[number].index} now, not {row}"))
    bad += [("lost", f"{n} was undone: {by_number.get(n)}") for n in heard.undone - withdrawn]
    if len(in_use) < heard.configurations - heard.asked:
        bad.append(("lost", f"{len(in_use)} in use, an estimate counted {heard.configurations}"))
    if len(withdrawn - heard.undone) > heard.asked:
        bad.append(("strange", f"{withdrawn - heard.undone} are withdrawn, nobody asked for that"))
    rows = Counter(r.index for r in in_use.values())
    bad += [("twice", f"row {row} is in use {n} times") for row, n in rows.items() if n > 1]
    seen = points()
    for r in kept:
        if r.status in (*KEPT, UNDONE):
            s, shown = (
                r.standstill,
                [k for k, a, b in heard.shown if a <= r.acquired.start <= r.acquired.end <= b],
            )
            if not shown or r.index not in shown or np.abs(s.points[0] - seen[r.index]).max() > SAME:
                bad.append(("strange", f"{r.number}, row {r.index}, {r.acquired.start}: shown {shown}"))
    heard.accepted = {n: int(r.index or 0) for n, r in in_use.items()}
    heard.undone, heard.asked, heard.configurations = withdrawn, False, len(in_use)
    at_rest = [r for r in kept if r.status in (*KEPT, UNDONE)]
    heard.stored = [(int(r.index or 0), r.acquired.start - SETTLE) for r in at_rest]
    return bad


# ── one life of a node ───────────────────────────────────────────────────────────────────────────────


class Died(Exception):
    """The node is dead."""


class Cell:
    """Robot and tracker, and who listens to the identifier.

    Args:
        domain: ROS domain, on which there is one identifier, which is fresh.
        node: Process id of the node.
        heard: Is brought up to date with everything that is heard.
    """

    def __init__(self, domain: int, node: int, heard: Heard) -> None:
        self._pid, self.heard, self.estimate = node, heard, CalibrationEstimate()
        self._made, self._context = ExitStack(), Context()
        self._plan, self._names, self._points = plan(), robot().joint_names, points()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self._made.callback(rclpy.shutdown, context=self._context)
        self._node = Node("cell", context=self._context, enable_rosout=False, start_parameter_services=False)
        self._made.callback(self._node.destroy_node)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._made.callback(self._executor.shutdown)
        self._joints = self._node.create_publisher(JointState, "joint_states", DEEP)
        self._tracker = self._node.create_publisher(PointStamped, "tracker/point", DEEP)
        plans = self._node.create_publisher(PlanMessage, "calibration_planner/current_plan", LATCHED)
        self._node.create_subscription(Measurement, f"{NAME}/measurements", heard.told, HISTORY)
        self._node.create_subscription(CalibrationEstimate, f"{NAME}/estimate", self._on_estimate, LATCHED)
        self._undo = self._node.create_client(UndoMeasurement, f"{NAME}/undo_measurement")
        plans.publish(plan_to_message(self._plan, "p", 0, "base"))

    def close(self) -> None:
        """Leave the domain."""
        self._made.close()

    def _on_estimate(self, message: CalibrationEstimate) -> None:
        self.estimate = message
        if message.plan_id == "p":
            self.heard.configurations = message.configurations

    def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Whether it comes true in time.

        Raises:
            Died: The node is dead; what it had said is heard.
        """
        deadline = time.monotonic() + seconds
        while not condition():
            if ended(self._pid):
                self.listen(LAST_WORDS)
                raise Died
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(0.005)
        return True

    def listen(self, seconds: float) -> None:
        """Hear what comes."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self._executor.spin_once(0.005)

    def ready(self) -> bool:
        """Wait until the node hears both streams and has the plan."""

        def there() -> bool:
            hears = self._joints.get_subscription_count() and self._tracker.get_subscription_count()
            return bool(hears) and self.estimate.plan_id == "p"

        return self.wait(there, PATIENCE)

    def show(self, row: int, stamp: int, length: int = LENGTH) -> int:
        """A standstill of so many points of 100 Hz at a row, and the way on; returns the last stamp [ns]."""
        q, last = self._plan.configurations[row], stamp + length * 10**7
        self.heard.shown.append((row, stamp, last))  # a node may have all it needs, and be dead, before the end
        self.heard.stamp = max(self.heard.stamp, last)
        for i in range(length + 10):
            stamp += 10**7 if i < length else NANO // 5
            here = q if i < length else q + 0.01 * (20 + i - length)
            self._joints.publish(joints_message(self._names, here, stamp))
            self._tracker.publish(point_message(self._points[row], stamp, "laser"))
            if not i % 10:
                self.wait(lambda: True, 0.0)
        self.heard.stamp = max(self.heard.stamp, stamp)
        return stamp

    def measure(self, row: int) -> bool:
        """Show a row; whether it is told accepted."""

        def told() -> bool:
            known = {row for number, row in self.heard.accepted.items() if number not in self.heard.undone}
            return row in known

        self.show(row, self.heard.stamp + NANO)
        return self.wait(told, PATIENCE)

    def undo(self) -> bool:
        """Withdraw the newest measurement; whether that was answered."""
        if not self.wait(self._undo.service_is_ready, PATIENCE):
            return False
        self.heard.asked = True
        answer = self._undo.call_async(UndoMeasurement.Request())
        if not self.wait(answer.done, 10.0):
            return False
        response = answer.result()
        if response.status == UndoMeasurement.Response.SUCCESS:
            self.heard.accepted.pop(response.id, None)
            self.heard.undone.add(response.id)
            self.heard.configurations = min(self.heard.configurations, len(self.heard.accepted))
        self.heard.asked = False
        return True


def ended(pid: int) -> bool:
    """Whether a child has ended; it stays to be waited for."""
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


@dataclass
class Life:
    """One life of a node.

    Attributes:
        phase: In which it was killed; empty if it was not.
        heard: What the campaign has been told by now.
        faults: (kind, text) of each.
        checked: Measurements whose acknowledgement was compared with the store.
        values, covariance: Of the newest estimate.
        replayed, undone: Whether a row was shown once more, a measurement withdrawn.
    """

    phase: str
    heard: Heard
    faults: list[tuple[str, str]]
    checked: int = 0
    values: list[float] = field(default_factory=list)
    covariance: list[float] = field(default_factory=list)
    replayed: bool = False
    undone: bool = False


def compacted_often() -> None:
    """Have SQLite move what was written ahead into its file at nearly every commit, not after 1 000 pages."""
    connect = store_room.connect

    def connected(path: Path | None, name: str) -> sqlite3.Connection:
        database = connect(path, name)
        database.execute("PRAGMA wal_autocheckpoint = 5")
        return database

    setattr(store_room, "connect", connected)  # noqa: B010


def node_process(folder: Path, domain: int, marks: Marks) -> None:
    """What the node's process does; in every second campaign the store's file is written at most commits."""
    os.environ |= {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(folder)}
    log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(log, stream)
    spy(marks)
    if folder.name.endswith(("1", "3", "5", "7", "9")):
        compacted_often()
    words = ["--ros-args", "-p", "robot:=planar_2r", "-p", f"store_folder:='{folder / 'store'}'"]
    words += ["-p", f"skew:={SKEW}"]
    for topic in ("joint_states", "tracker/point"):
        words += ["-p", f"qos_overrides./{topic}.subscription.reliability:=reliable"]
        words += ["-p", f"qos_overrides./{topic}.subscription.durability:=transient_local"]
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    status = identifier.main(words)
    sys.stdout.flush()
    os._exit(status)


def live(folder: Path, domain: int, heard: Heard, aim: Aim | None, rng: random.Random) -> Life:
    """A life from its start to its end, in a process that has not touched ROS.

    Args:
        folder: Of the campaign.
        domain: ROS domain.
        heard: What the campaign has been told so far.
        aim: When to kill; ``None``: not at all.
        rng: Draws what the life does.
    """
    folder.mkdir(parents=True, exist_ok=True)
    marks = Marks()
    node = forked(lambda: node_process(folder, domain, marks))
    killer = 0 if aim is None else forked(lambda: wait_and_kill(marks, node, aim))
    life = Life("", heard, [])
    cell = Cell(domain, node, heard)
    try:
        act(cell, life, rng, aim)
        os.kill(node, signal.SIGINT)
        if not cell.wait(lambda: False, PATIENCE):
            life.faults.append(("not restarted", f"it does not end, {marks.phase}"))
    except Died:
        pass
    finally:
        cell.close()
        for pid in filter(None, (node, killer)):
            if not ended(pid):
                os.kill(pid, signal.SIGKILL)
        status = os.waitpid(node, 0)[1]
        if killer:
            os.waitpid(killer, 0)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL and not life.faults:
        life.phase = marks.phase
    elif status:
        life.faults.append(("not restarted", f"it ended with status {status}"))
    log = (folder / "log").read_text(errors="replace") if (folder / "log").exists() else ""
    if "Traceback" in log or "not started" in log:
        life.faults.append(("not restarted", log[-3000:]))
    life.values, life.covariance = list(cell.estimate.value), list(cell.estimate.covariance)
    life.checked = len(heard.accepted) + len(heard.undone)
    life.faults += faults(folder / "store", heard)
    return life


def act(cell: Cell, life: Life, rng: random.Random, aim: Aim | None) -> None:
    """What happens in the cell: rows that are missing are measured; in a life with a kill, some more happens."""
    heard = cell.heard
    if not cell.ready():
        life.faults.append(("not restarted", "it is not ready"))
        return
    missing = [row for row in range(ROWS) if row not in heard.accepted.values()]
    rng.shuffle(missing)
    soon = aim is not None and aim.phase in ("undoing", "ending", "compacting")
    for k, row in enumerate(missing if aim is None else missing[: 1 if soon else rng.randrange(1, 4)]):
        if not cell.measure(row):
            life.faults.append(("lost", f"row {row} was shown and is not accepted"))
            return
        if aim is not None and not k and heard.stored and rng.random() < 0.25:
            life.replayed = True
            cell.show(*rng.choice(heard.stored), AGAIN)
    if aim is None:
        cell.wait(lambda: cell.estimate.complete, PATIENCE)
    elif aim.phase == "undoing" or rng.random() < 0.15:
        life.undone = cell.undo()


# ── campaigns ────────────────────────────────────────────────────────────────────────────────────────


def in_a_process(work: Callable[[], Life]) -> Life:
    """The result of ``work``, done in a process of its own, so that this one never touches ROS."""
    reader, writer = os.pipe()

    def answer() -> None:
        with os.fdopen(writer, "wb") as out:
            pickle.dump(work(), out)

    pid = forked(answer)
    os.close(writer)
    with os.fdopen(reader, "rb") as answered:
        data = answered.read()
    os.waitpid(pid, 0)
    if not data:
        raise RuntimeError("a life ended without a result, see the trace above")
    life: Life = pickle.loads(data)
    return life


LOOPBACK = Path(__file__).with_name("loopback.xml")
"""Profile of Fast DDS: on this machine only, without shared memory."""


@contextmanager
def without_shared_memory() -> Iterator[None]:
    """Until it is left, nodes that are made speak by UDP on this machine.

    A process that is killed leaves its pieces of DDS's shared memory behind; one that is killed while it makes a
    piece leaves it half made, and every process that opens it later waits for ever for the other half (boost's
    ``managed_open_or_create``; eProsima/Fast-DDS#1144). rmw_fastrtps adds shared memory by itself where discovery
    is kept to the machine, whatever ``FASTDDS_BUILTIN_TRANSPORTS`` says, so that it takes a profile.
    """
    wanted = {
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(LOOPBACK),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
    }
    before = {name: os.environ.get(name) for name in wanted}
    os.environ |= wanted
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            os.environ |= {name: value} if value is not None else {}


@dataclass
class Found:
    """What came of all campaigns; counts are of lives unless they say otherwise."""

    kills: int = 0
    campaigns: int = 0
    phases: Counter[str] = field(default_factory=Counter)
    acknowledged_checked: int = 0
    replayed: int = 0
    undone: int = 0
    ended_by_themselves: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    texts: list[str] = field(default_factory=list)
    minutes: float = 0.0

    def add(self, life: Life, where: str) -> None:
        """Count a life."""
        self.kills += bool(life.phase)
        self.phases[life.phase or "none"] += 1
        self.acknowledged_checked += life.checked
        self.replayed += life.replayed
        self.undone += life.undone
        self.ended_by_themselves += not life.phase
        for kind, text in life.faults:
            self.blame(kind, f"{where}: {text}")

    def blame(self, kind: str, text: str) -> None:
        """Count a fault."""
        self.faults[kind] += 1
        self.texts.append(f"{kind}: {text}"[:3000])


def run(count: int, seed: int, folder: Path, say: Callable[[str], None] = lambda _: None) -> Found:
    """Campaigns until a node was killed so many times, or until ten faults were found."""
    found, began, rng = Found(), time.monotonic(), random.Random(seed)
    gc.freeze()
    with without_shared_memory(), own_domain() as domain:

        def lived(place: str, heard: Heard, aim: Aim | None) -> Life:
            turn = random.Random(rng.random())
            return in_a_process(lambda: live(folder / place, domain, heard, aim, turn))

        wanted = lived("undisturbed", Heard(), None)
        for kind, text in wanted.faults:
            found.blame(kind, f"undisturbed: {text}")
        while found.kills < count and len(found.texts) < 10:
            name, heard = f"campaign_{found.campaigns}", Heard()
            while len(heard.accepted) < ROWS and found.kills < count:
                aim = Aim.drawn(rng)
                life = lived(name, heard, aim)
                found.add(life, f"{name}, {aim}")
                heard = life.heard
            last = lived(name, heard, None)
            for kind, text in last.faults:
                found.blame(kind, f"{name}, last life: {text}")
            found.campaigns += 1
            for a, b in ((wanted.values, last.values), (wanted.covariance, last.covariance)):
                if len(a) != len(b) or not np.abs(np.subtract(a, b)).max() <= SAME:
                    found.blame("differs", f"{name}: {a} {b}")
            say(f"{name}: {found.kills} kills, {dict(found.faults)}")
    found.minutes = (time.monotonic() - began) / 60.0
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="kills")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for logs and stores")
    chosen = parser.parse_args(arguments)
    with ExitStack() as made:
        if chosen.keep is not None and chosen.keep.exists() and any(chosen.keep.iterdir()):
            parser.error(
                f"--keep {chosen.keep} is not empty: what is there would be taken for stores of this run"
            )
        folder = chosen.keep or Path(made.enter_context(tempfile.TemporaryDirectory(prefix="kills_")))
        found = run(
            chosen.count, chosen.seed, folder.resolve(), lambda text: print(text, file=sys.stderr, flush=True)
        )
    answer = {k: v for k, v in vars(found).items() if k != "texts"} | {"seed": chosen.seed, "texts": found.texts}
    print(json.dumps(answer, indent=1))
    return int(bool(found.texts))


if __name__ == "__main__":
    raise SystemExit(main())
