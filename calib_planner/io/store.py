# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What a session and a campaign leave on disk: nothing that was acknowledged is ever lost.

*The store* of an identifier, ``campaign.sqlite`` in a folder that the user chose; without a folder the same in
memory. Its tables only grow. A *standstill* is raw data and never changes. What was decided about it is a row of
the log ``decisions``: a later decision replaces an earlier one, and both stay. The *role* of a standstill, fit or
validation, is part of the decision. A *record* is a standstill with its last decision. A *session* (table
``campaigns``) is what was measured of one campaign, under however many plans, or of one plan that is part of
none; table ``plans`` says which plans were taken, the newest last. Only the pointer to the current session
moves, and a session in which nothing was measured gives way to the next. The model's source text, the settings
and the version of the package that wrote are kept beside.

SQLite writes ahead with ``synchronous=FULL``: a commit that returned survives ``kill -9`` and a power cut, one
that did not leaves nothing behind. ``locking_mode=EXCLUSIVE`` keeps a second process out and needs no file of
shared memory, which a full disk could tear. A file of another robot, of a newer schema or one that is damaged
is refused and left as it is. When the disk is full or gone, ``StoreError`` says so, nothing changes, and the
next attempt may succeed.

*The record of a campaign*, ``adaptive_campaign.sqlite``, has the same tables and a lock of its own, because two
nodes may share a folder. A campaign is a row of ``campaigns``; what it has to reach, and within which budget, is
a row of ``settings``: the names of parameters with their values. Its measurements are standstills, of which only
joints and points are known, with the number under which the identifier published them (``told``). What else
happened is an event, a JSON object. The state is rebuilt by ``from_measurements``: what was planned and not
measured is planned anew.

    {"measured": 7, "role": "fit", "configuration": […], "points": [[x, y, z]]}      a standstill, accepted
    {"withdrawn": 7}                                  the standstill is undone
    {"joined": true}                                  the validation so far is part of the fit from here on
    {"failed": […], "role": "fit", "reason": "…"}     an attempt at a configuration that gave no measurement
    {"excluded": […], "radius": 0.05, "reason": "…", …}
    {"dropped": 7, …}                                 where this was measured, no more is measured
    {"round": {"number": 0, "measured": 0, …}}        what was known after a batch
    {"finished": "reached"}

Earlier versions wrote these objects as lines of ``campaign_journal.jsonl``, below a line of what it is about. It
is converted when its folder is opened, in one transaction, and then renamed; a torn last line is ignored. Kinds
of events that are not listed here are those of other versions; they are ignored.

Numbers are JSON, which Python writes and reads exactly to the bit; null is NaN (a target not seen).
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.acquisition import REJECTIONS, Rejection, RejectionReason, Standstill
from calib_planner.arrays import FloatArray, frozen, plain
from calib_planner.campaign import (
    FIT,
    VALIDATION,
    CampaignProblem,
    CampaignState,
    Exclusion,
    PlannedConfiguration,
    Round,
    from_measurements,
)
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError, StoreError
from calib_planner.io.plan import parse_plan
from calib_planner.io.text import settle, user_path
from calib_planner.io.yaml import Node
from calib_planner.measurements import Measurements
from calib_planner.planning import Plan
from calib_planner.robot import Robot
from calib_planner.units import cut

# ── records ──────────────────────────────────────────────────────────────────────────────────────────

ACCEPTED, OUTLIER, UNDONE, NOT_STORED = "accepted", "outlier", "undone", "not_stored"
NOT_IN_PLAN, CLOCK_OFFSET = "not_in_plan", "clock_offset"
DECISIONS = {
    ACCEPTED: "It is used.",
    OUTLIER: "It disagrees with the other measurements. Check the reflector's seat, measure again.",
    UNDONE: "It was withdrawn on request. Measure again if it is still needed.",
    NOT_STORED: "It could not be written to disk. Make space or repair the folder, measure again.",
    NOT_IN_PLAN: "No planned configuration is near. Check the pose, or allow unplanned measurements.",
    CLOCK_OFFSET: "The clocks of joints and tracker differ. Synchronise them, measure again.",
    **REJECTIONS,
}
"""Everything that can be decided about a standstill, with what to do."""
KEPT = (ACCEPTED, OUTLIER)
"""Decisions about standstills that the identification is given; it rejects outliers itself, every time anew."""
WIRE = ("configurations", "test_poses")
"""What is finite in a plan that came in a message, which has no weights."""
LONGEST = 500
"""Characters kept of a text that came over a wire."""
ROLES = (FIT, VALIDATION)
"""What a plan and a measurement can be for."""


@dataclass(frozen=True, eq=False)
class Record:
    """A standstill and what was decided about it.

    Attributes:
        acquired: The standstill, or why it was none.
        status: A key of ``DECISIONS``.
        reason: In words; empty when accepted in full.
        index: Row of the plan, or ``None``.
        repetition: Number of this measurement at its configuration, from 0.
        unused: Targets, from 0, that the identification rejected.
        number: Its number in the store, ascending; 0: not stored.
        frame: Frame of its points.
        role: What it is for, ``fit`` or ``validation``; ``index`` is a row of the newest plan for that.
    """

    acquired: Standstill | Rejection
    status: str
    reason: str
    index: int | None
    repetition: int
    unused: tuple[int, ...] = ()
    number: int = 0
    frame: str = ""
    role: str = FIT

    @property
    def standstill(self) -> Standstill:
        """The standstill of a record that was accepted at least once."""
        if not isinstance(self.acquired, Standstill):
            raise TypeError(f"standstill {self.number} was rejected: {self.acquired.message}")
        return self.acquired

    def now(self, status: str, reason: str, unused: tuple[int, ...] = ()) -> Record:
        """The same standstill, decided otherwise."""
        return replace(self, status=status, reason=reason, unused=unused)


def standstill_row(acquired: Standstill | Rejection, frame: str) -> dict[str, Any]:
    """The columns of a standstill."""
    row: dict[str, Any] = {"start": acquired.start, "stop": acquired.end, "joints": _text(acquired.joints)}
    row |= {"samples": json.dumps(acquired.samples.tolist()), "frame": frame[:LONGEST]}
    if isinstance(acquired, Rejection):
        return row | {"rejected": acquired.reason.value, "message": acquired.message[:LONGEST]}
    return row | {"points": _text(acquired.points), "std": _text(acquired.std), "message": ""}


def record_of(path: str | Path, row: Mapping[str, Any], joints: int, targets: int) -> Record:
    """A record out of the columns of a standstill and of a decision about it.

    Raises:
        FileFormatError: A number of joints or targets that does not fit, or damaged columns.
    """
    where = f"standstill {row['standstill']}"

    def array(key: str, *shape: int) -> FloatArray:
        return Node(path, f"{where}, {key}", json.loads(row[key])).array(shape, finite=False)

    try:
        start, end, q = int(row["start"]), int(row["stop"]), array("joints", joints)
        samples = frozen(np.array(json.loads(row["samples"]), np.int64))
        if samples.shape != (targets,):
            raise FileFormatError(path, f"{where}, samples", f"{samples.size} targets", f"{targets} targets")
        if row["rejected"] is not None:
            acquired: Standstill | Rejection
            acquired = Rejection(start, end, RejectionReason(row["rejected"]), row["message"], q, samples)
        else:
            acquired = Standstill(start, end, q, array("points", targets, 3), array("std", targets), samples)
        decided = (row["status"], row["reason"], row["configuration"], row["repetition"])
        unused = tuple(json.loads(row["unused"]))
        role = row["role"] or FIT  # stores of earlier versions named none
        if role not in ROLES:
            raise FileFormatError(path, f"{where}, role", cut(role, 100), " or ".join(ROLES))
        return Record(acquired, *decided, unused, row["standstill"], row["frame"], role)
    except (TypeError, ValueError, KeyError, IndexError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(path, where, cut(error, 100), "what this package wrote there") from None


def plan_text(plan: Plan | None) -> str | None:
    """A plan as JSON of its fields, exact to the bit; ``None`` for none."""
    if plan is None:
        return None
    return json.dumps(plain(plan.values(), keep_infinite=True, keep_nan=True))


def plan_of(path: str | Path, text: str | None) -> Plan | None:
    """What ``plan_text`` wrote.

    Raises:
        FileFormatError: Damaged.
    """
    if text is None:
        return None
    try:
        document = json.loads(text)
    except (TypeError, ValueError) as error:
        raise FileFormatError(path, "plan", error, "a plan as JSON") from None
    return parse_plan(Node(path, "plan", document), WIRE)


def same_plan(one: Plan | None, other: Plan | None) -> bool:
    """Whether two plans are of the same measurements; their quality does not count."""
    if one is None or other is None:
        return one is other
    names = ("robot", "joint_names", "parameters", "configurations", "repetitions", "test_poses")
    return all(np.array_equal(getattr(one, n), getattr(other, n)) for n in names)


def _text(values: FloatArray) -> str:
    """Numbers as JSON, NaN as null."""
    return json.dumps(plain(values))


# ── the store ────────────────────────────────────────────────────────────────────────────────────────

CURRENT = "SELECT c.* FROM campaigns AS c JOIN current ON current.campaign = c.number"
NAMED = """
    SELECT p.*, c.campaign_id FROM plans AS p JOIN campaigns AS c ON c.number = p.campaign
    WHERE p.plan_id = ? AND p.plan IS NOT NULL ORDER BY p.number DESC LIMIT 1
"""
LATEST = """
    SELECT s.*, d.* FROM decisions AS d JOIN standstills AS s ON s.number = d.standstill
    WHERE d.number IN (SELECT MAX(number) FROM decisions WHERE campaign = ? GROUP BY standstill)
    ORDER BY d.standstill
"""
WITHDRAW = """
    INSERT INTO decisions (campaign, standstill, status, reason, configuration, repetition, unused, at, role)
    SELECT campaign, standstill, ?, ?, configuration, repetition, '[]', ?, role FROM decisions
    WHERE number IN (SELECT MAX(number) FROM decisions WHERE standstill = ? GROUP BY campaign)
"""


@dataclass(frozen=True)
class StoredModel:
    """Which robot a store belongs to.

    Attributes:
        name: Of the robot.
        joint_names: Order of joint arrays.
        targets: Number of targets.
        source: The text it was read from, a robot YAML or URDF.
        origin: Where that came from: the name of a shipped robot, or of a topic.
    """

    name: str
    joint_names: tuple[str, ...]
    targets: int
    source: str
    origin: str = ""

    @property
    def sha256(self) -> str:
        """Hash of the source text."""
        return hashlib.sha256(self.source.encode("utf-8", "surrogatepass")).hexdigest()

    @property
    def marks(self) -> dict[str, object]:
        """What tells the robot from another one."""
        marks = {"robot": self.name, "joint_names": list(self.joint_names), "targets": self.targets}
        return marks | {"model of the robot, sha256": self.sha256}


@dataclass(frozen=True, eq=False)
class NamedPlan:
    """A plan with its name, and what it is for: ``fit`` or ``validation``."""

    plan_id: str
    plan: Plan
    role: str = FIT


@dataclass(frozen=True, eq=False)
class StoredSession:
    """Plans, and what was measured and decided under them.

    Attributes:
        number: Number of the session; 0: it is not stored yet.
        plans: The newest plan of each role, the one that is measured now last; empty without a plan.
        records: Every standstill with the last decision about it, in the order of measuring.
        campaign_id: The campaign that the plans are part of; empty: none.
    """

    number: int
    plans: tuple[NamedPlan, ...] = ()
    records: tuple[Record, ...] = ()
    campaign_id: str = ""

    @property
    def plan_id(self) -> str:
        """Name of the plan that is measured now; empty without a plan."""
        return self.plans[-1].plan_id if self.plans else ""

    @property
    def plan(self) -> Plan | None:
        """The plan that is measured now."""
        return self.plans[-1].plan if self.plans else None


class Store:
    """An open file of tables, which grow by transactions only.

    Attributes:
        path: The file; ``None`` in memory.
        model: Which robot it belongs to.
        trouble: Why the last attempt to write failed; empty once one succeeded.
    """

    def __init__(self, path: Path | None, database: sqlite3.Connection, model: StoredModel) -> None:
        self.path, self.model, self._database = path, model, database
        self._file = None if path is None else identity(path)
        self._turn = threading.RLock()  # SQLite crashes if it is closed while another thread reads
        self.trouble = ""

    def close(self) -> None:
        """Let the file go; what was committed is there already."""
        with self._turn:
            self._database.close()

    def history(self, standstill: int) -> list[dict[str, Any]]:
        """All decisions about a standstill, oldest first: session (key ``campaign``), status, reason, at."""
        sql = "SELECT campaign, status, reason, at FROM decisions WHERE standstill = ? ORDER BY number"
        return [dict(r) for r in self._rows(sql, standstill)]

    def _rows(self, sql: str, *values: object) -> list[Mapping[str, Any]]:
        try:
            with self._turn:
                return self._database.execute(sql, values).fetchall()
        except sqlite3.Error as error:
            raise StoreError(self.path, str(error), "check the disk") from None

    def _one(self, sql: str, *values: object) -> Mapping[str, Any] | None:
        return next(iter(self._rows(sql, *values)), None)

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """One transaction: committed to disk, or as if it had never been."""
        with self._turn:
            try:
                if self.path is not None and identity(self.path) != self._file:
                    raise StoreError(self.path, "the file was moved, removed or replaced", "put it back")
                self._database.execute("BEGIN IMMEDIATE")
                yield self._database
                self._database.execute("COMMIT")
            except BaseException as error:
                with suppress(sqlite3.Error):  # a roll-back that fails is made up for by the next BEGIN
                    if self._database.in_transaction:  # SQLite may have rolled back itself
                        self._database.execute("ROLLBACK")
                self.trouble = str(error)
                if isinstance(error, sqlite3.Error):
                    advice = "make space or repair the disk; it is tried again"
                    raise StoreError(self.path, str(error), advice) from None
                raise
            self.trouble = ""

    def _stored_model(self) -> StoredModel | None:
        row = self._one("SELECT * FROM model")
        if row is None:
            return None
        joints = tuple(json.loads(row["joint_names"]))
        return StoredModel(row["name"], joints, row["targets"], row["source"], row["origin"])

    def _write_model(self, write: sqlite3.Connection) -> None:
        model = self.model
        columns = {"one": 1, "name": model.name, "joint_names": json.dumps(model.joint_names)}
        columns |= {"targets": model.targets, "origin": model.origin, "sha256": model.sha256}
        _insert(write, "model", columns | {"source": model.source, "at": _now()})

    def _note_settings(self, settings: Mapping[str, object], version: str) -> None:
        document = json.dumps(settings, sort_keys=True, default=list)
        last = self._one("SELECT * FROM settings ORDER BY number DESC LIMIT 1")
        if last is None or (last["document"], last["version"]) != (document, version):
            with self._writing() as write:
                self._write_settings(write, settings, version)

    @staticmethod
    def _write_settings(write: sqlite3.Connection, settings: Mapping[str, object], version: str) -> None:
        document = json.dumps(settings, sort_keys=True, default=list)
        _insert(write, "settings", {"version": version, "document": document, "at": _now()})


class SessionStore(Store):
    """The open store of an identifier; ``open_store`` makes one."""

    def current(self) -> StoredSession | None:
        """The session that goes on; ``None`` in a new store.

        Raises:
            FileFormatError: Damaged rows.
            StoreError: The file cannot be read now.
        """
        row = self._one(CURRENT)
        return None if row is None else self._session(row)

    def find(
        self, plan_id: str, plan: Plan | None, campaign_id: str = "", role: str = FIT
    ) -> StoredSession | None:
        """The newest session that a plan belongs to: its campaign's, or its own; ``None`` if there is none.

        Raises:
            InputError: There is another plan of this name, or a name is too long.
            StoreError: The file cannot be read now.
        """
        for field, name in (("plan_id", plan_id), ("campaign_id", campaign_id)):
            if len(name) > LONGEST:
                raise InputError(field, f"{len(name)} characters", f"at most {LONGEST} characters")
        named = self._one(NAMED, plan_id)
        if named is not None:
            other = plan_of(self.path or "memory", named["plan"])
            same = (named["campaign_id"], named["purpose"]) == (campaign_id, role) and same_plan(other, plan)
            if not same:
                advice = "give the new plan a name of its own, or choose another folder"
                raise InputError("plan_id", repr(plan_id), "a name that no other plan in the store has", advice)
        of = "campaign_id = ?" if campaign_id else "campaign_id = '' AND plan_id = ?"
        name = campaign_id or plan_id
        row = self._one(f"SELECT * FROM campaigns WHERE {of} ORDER BY number DESC LIMIT 1", name)
        return None if row is None else self._session(row)

    @property
    def empty(self) -> bool:
        """Whether nothing was ever recorded."""
        return self._one("SELECT 1 FROM standstills LIMIT 1") is None

    def begin(
        self,
        plan_id: str,
        plan: Plan | None,
        decided: Sequence[Record] = (),
        campaign_id: str = "",
        role: str = FIT,
    ) -> StoredSession:
        """Make a plan the one that is measured now, in the session it belongs to, which is made if need be.

        Args:
            plan_id, plan: The plan.
            decided: What is decided about standstills under the new plan: what a new session takes over from
                another one, or what belongs to another row or role than before.
            campaign_id: The campaign that the plan is part of; empty: none.
            role: What the plan is for.

        Raises:
            InputError: There is another plan of this name.
            StoreError: It cannot be written.
        """
        known = self.find(plan_id, plan, campaign_id, role)
        return self._enter(known, plan_id, plan, decided, campaign_id, role)

    def restart(self, plan_id: str, plan: Plan | None, campaign_id: str = "", role: str = FIT) -> StoredSession:
        """A session of the same plan with nothing measured; the former stays in the file.

        Raises:
            StoreError: It cannot be written.
        """
        return self._enter(None, plan_id, plan, (), campaign_id, role)

    def _enter(
        self,
        known: StoredSession | None,
        plan_id: str,
        plan: Plan | None,
        decided: Sequence[Record],
        campaign_id: str,
        role: str,
    ) -> StoredSession:
        with self._writing() as write:
            number = 0 if known is None else known.number
            if known is None:
                columns = {"plan_id": plan_id, "campaign_id": campaign_id, "at": _now()}
                number = _insert(write, "campaigns", columns)
            if plan is not None and (known is None or known.plan_id != plan_id):
                told = "SELECT 1 FROM plans WHERE campaign = ? AND plan_id = ?"
                text = None if write.execute(told, (number, plan_id)).fetchone() else plan_text(plan)
                named: dict[str, Any] = {"campaign": number, "plan_id": plan_id, "purpose": role, "plan": text}
                _insert(write, "plans", named | {"at": _now()})
            self._point_at(write, number)
            for record in decided:
                _decide(write, number, record.number, record)
            row = write.execute("SELECT * FROM campaigns WHERE number = ?", (number,)).fetchone()
        return self._session(row)

    def record(self, session: int, record: Record) -> int:
        """Write a standstill and what was decided about it; returns its number.

        Raises:
            StoreError: It cannot be written; nothing was.
        """
        with self._writing() as write:
            number = _insert(write, "standstills", standstill_row(record.acquired, record.frame))
            _decide(write, session, number, record)
        return number

    def decide(self, session: int, records: Sequence[Record]) -> None:
        """Write what is decided about standstills now, all of it or nothing.

        Raises:
            StoreError: It cannot be written; nothing was.
        """
        if records:
            with self._writing() as write:
                for record in records:
                    _decide(write, session, record.number, record)

    def withdraw(self, record: Record) -> None:
        """Write that a standstill is not used any more, in every session that has it.

        Raises:
            StoreError: It cannot be written; nothing was.
        """
        with self._writing() as write:
            write.execute(WITHDRAW, (record.status, record.reason[:LONGEST], _now(), record.number))

    @staticmethod
    def _point_at(write: sqlite3.Connection, number: int) -> None:
        """Make a session the current one; others without a standstill go: plans may come by the thousand."""
        write.execute("INSERT OR REPLACE INTO current VALUES (1, ?)", (number,))
        unused = "{} != ? AND {} NOT IN (SELECT campaign FROM decisions)"
        write.execute(f"DELETE FROM plans WHERE {unused.format('campaign', 'campaign')}", (number,))
        write.execute(f"DELETE FROM campaigns WHERE {unused.format('number', 'number')}", (number,))

    def _session(self, row: Mapping[str, Any]) -> StoredSession:
        where, joints, targets = self.path or "memory", len(self.model.joint_names), self.model.targets
        rows = self._rows(LATEST, row["number"])
        records = tuple(record_of(where, r, joints, targets) for r in rows)
        return StoredSession(row["number"], self._plans(row["number"]), records, row["campaign_id"])

    def _plans(self, session: int) -> tuple[NamedPlan, ...]:
        """The newest plan of each role, the newest of all last."""
        texts: dict[str, str] = {}
        newest: dict[str, str] = {}
        for row in self._rows("SELECT * FROM plans WHERE campaign = ? ORDER BY number", session):
            if row["plan"] is not None:  # it is there once, however often the plan came back
                texts[row["plan_id"]] = row["plan"]
            newest.pop(row["purpose"], None)
            newest[row["purpose"]] = row["plan_id"]
        where, plans = self.path or "memory", []
        for role, plan_id in newest.items():
            plan = plan_of(where, texts.get(plan_id))
            if plan is None or role not in ROLES:
                raise FileFormatError(where, "plans", cut(plan_id, 100), "a plan for fit or validation")
            plans.append(NamedPlan(plan_id, plan, role))
        return tuple(plans)


class UnavailableStore(SessionStore):
    """Stands in for a store that cannot be opened at the moment: empty, and nothing can be written."""

    def __init__(self, model: StoredModel, error: StoreError) -> None:
        super().__init__(None, sqlite3.connect(":memory:", check_same_thread=False), model)
        self.error, self.trouble = error, str(error)

    def _rows(self, sql: str, *values: object) -> list[Mapping[str, Any]]:
        return []

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        # A new one each time: an exception keeps the trace of every raise.
        raise StoreError(self.error.path, self.error.reason)
        yield


def open_store(
    folder: str, model: StoredModel, settings: Mapping[str, object], version: str, field: str = "store_folder"
) -> SessionStore:
    """Open the store in a folder, or make one.

    Args:
        folder: Is made if it is not there; empty: in memory, gone with the process.
        model: The robot it has to belong to; one in which nothing was measured yet takes any.
        settings: What else decides what an estimate is; stored for the record.
        version: Of this package, for the record.
        field: The parameter that named the folder, for errors.

    Raises:
        FileFormatError: Not a store, damaged, of a newer schema, or of another robot; it was not touched.
        InputError: Another process has it.
        StoreError: It cannot be opened or written now.
    """
    path = user_path(folder) / FILE if folder else None
    store = SessionStore(path, connect(path, field), model)
    try:
        stored = store._stored_model()
        if stored is None or (stored != model and store.empty):
            with store._writing() as write:
                for table in ("current", "plans", "campaigns", "model"):
                    write.execute(f"DELETE FROM {table}")
                store._write_model(write)
        else:
            _check_robot(path, stored.marks, model)
        store._note_settings(settings, version)
    except BaseException:
        store.close()
        raise
    return store


def stored_model(folder: str, field: str = "store_folder") -> StoredModel | None:
    """Which robot the store in a folder belongs to; ``None`` without one, or if nothing was measured yet.

    Raises:
        As ``open_store``.
    """
    path = user_path(folder) / FILE
    if not folder or not path.exists():
        return None
    store = SessionStore(path, connect(path, field), StoredModel("", (), 0, ""))
    try:
        return None if store.empty else store._stored_model()
    finally:
        store.close()


def _check_robot(path: Path | None, written: Mapping[str, object], model: StoredModel) -> None:
    """Refuse a file of another robot; ``written`` are the marks of the robot that the file names."""
    for name, got in written.items():
        if got != model.marks[name]:
            advice = "choose another folder, or start with the robot that the file belongs to"
            raise FileFormatError(path, name, cut(got, 100), str(model.marks[name]), advice)


def _decide(write: sqlite3.Connection, session: int, standstill: int, record: Record) -> None:
    columns = {
        "campaign": session,
        "standstill": standstill,
        "status": record.status,
        "reason": record.reason[:LONGEST],
        "configuration": record.index,
        "repetition": record.repetition,
        "unused": json.dumps(record.unused),
        "role": record.role,
    }
    _insert(write, "decisions", columns | {"at": _now()})


def _insert(write: sqlite3.Connection, table: str, columns: Mapping[str, Any]) -> int:
    """Add a row; names of table and columns are this file's own."""
    marks = ", ".join("?" * len(columns))
    sql = f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({marks})"
    return int(write.execute(sql, tuple(columns.values())).lastrowid or 0)


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="milliseconds")


# ── the file of a store: made, opened for one process alone, checked, and brought up to date ─────────────────

FILE = "campaign.sqlite"
WRITABLE = "choose a folder that can be written to"
APPLICATION = 0x43504C53
"""SQLite's mark of whose file it is."""
MIGRATIONS = (
    """
    CREATE TABLE model (
        one INTEGER PRIMARY KEY CHECK (one = 1), name TEXT NOT NULL, joint_names TEXT NOT NULL,
        targets INTEGER NOT NULL, origin TEXT NOT NULL, sha256 TEXT NOT NULL, source TEXT NOT NULL,
        at TEXT NOT NULL);
    CREATE TABLE settings (
        number INTEGER PRIMARY KEY, version TEXT NOT NULL, document TEXT NOT NULL, at TEXT NOT NULL);
    CREATE TABLE campaigns (
        number INTEGER PRIMARY KEY AUTOINCREMENT, plan_id TEXT NOT NULL, plan TEXT, at TEXT NOT NULL);
    CREATE TABLE current (
        one INTEGER PRIMARY KEY CHECK (one = 1), campaign INTEGER NOT NULL REFERENCES campaigns);
    CREATE TABLE standstills (
        number INTEGER PRIMARY KEY AUTOINCREMENT, start INTEGER NOT NULL, stop INTEGER NOT NULL,
        joints TEXT NOT NULL, points TEXT, std TEXT, samples TEXT NOT NULL, rejected TEXT,
        message TEXT NOT NULL, frame TEXT NOT NULL);
    CREATE TABLE decisions (
        number INTEGER PRIMARY KEY AUTOINCREMENT, campaign INTEGER NOT NULL REFERENCES campaigns,
        standstill INTEGER NOT NULL REFERENCES standstills, status TEXT NOT NULL, reason TEXT NOT NULL,
        configuration INTEGER, repetition INTEGER NOT NULL, unused TEXT NOT NULL, at TEXT NOT NULL);
    CREATE INDEX decisions_of ON decisions (campaign, standstill, number);
    """,
    """
    ALTER TABLE standstills ADD COLUMN told INTEGER;
    ALTER TABLE decisions ADD COLUMN role TEXT;
    CREATE TABLE events (
        number INTEGER PRIMARY KEY AUTOINCREMENT, campaign INTEGER NOT NULL REFERENCES campaigns,
        document TEXT NOT NULL, at TEXT NOT NULL);
    CREATE INDEX standstills_told ON standstills (told);
    """,
    """
    ALTER TABLE campaigns ADD COLUMN campaign_id TEXT NOT NULL DEFAULT '';
    CREATE TABLE plans (
        number INTEGER PRIMARY KEY AUTOINCREMENT, campaign INTEGER NOT NULL REFERENCES campaigns,
        plan_id TEXT NOT NULL, purpose TEXT NOT NULL, plan TEXT, at TEXT NOT NULL);
    CREATE INDEX plans_named ON plans (plan_id);
    INSERT INTO plans (campaign, plan_id, purpose, plan, at)
        SELECT number, plan_id, 'fit', plan, at FROM campaigns WHERE plan IS NOT NULL ORDER BY number;
    """,
)
"""Entry k makes schema k + 1 out of schema k; an empty file is schema 0."""


@contextmanager
def _disk(path: Path | None, advice: str) -> Iterator[None]:
    """Errors of the operating system and of SQLite become ``StoreError``."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        raise StoreError(path, getattr(error, "strerror", None) or str(error), advice) from None


def connect(path: Path | None, field: str) -> sqlite3.Connection:
    """Open the file, which may be new, for this process alone; ``None``: in memory. Errors as ``open_store``."""
    with _disk(path, WRITABLE):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_symlink():
                raise FileFormatError(
                    path, field, "a symbolic link", "a file in this folder itself", "move it away"
                )
        # The node is made in one thread and spun in another; only one at a time uses the store.
        name = ":memory:" if path is None else str(path)
        database = sqlite3.connect(name, timeout=1.0, isolation_level=None, check_same_thread=False)
    database.row_factory = sqlite3.Row
    try:
        _prepare(database, path, field)
    except BaseException:
        database.close()
        raise
    return database


def _prepare(database: sqlite3.Connection, path: Path | None, field: str) -> None:
    """Take the file for this process, check that it is ours and whole, bring its schema up to date."""
    try:
        database.execute("PRAGMA locking_mode = EXCLUSIVE")
        owner = int(database.execute("PRAGMA application_id").fetchone()[0])
        schema = int(database.execute("PRAGMA user_version").fetchone()[0])
        used = bool(database.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()[0])
        if used and owner != APPLICATION:
            raise FileFormatError(path, field, "a database of another program", "a campaign store, or no file")
        if schema > len(MIGRATIONS):
            got, most = f"schema {schema}, written by a newer version", f"a schema up to {len(MIGRATIONS)}"
            raise FileFormatError(path, field, got, most, "update calib_planner or choose another folder")
        if used and (fault := database.execute("PRAGMA integrity_check(1)").fetchone()[0]) != "ok":
            raise sqlite3.DatabaseError(fault)
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA synchronous = FULL")
        database.execute("PRAGMA foreign_keys = ON")
        if schema < len(MIGRATIONS):
            mark = f"PRAGMA application_id = {APPLICATION}; PRAGMA user_version = {len(MIGRATIONS)};"
            database.executescript(f"BEGIN IMMEDIATE; {''.join(MIGRATIONS[schema:])} {mark} COMMIT;")
            if path is not None:
                settle(path.parent)
    except sqlite3.OperationalError as error:
        if "locked" in str(error):
            advice = "end the other node or choose another folder"
            raise InputError(
                field, f"{path}, which another process uses", "a folder of its own", advice
            ) from None
        raise StoreError(path, str(error), "make space, or choose a folder that can be written to") from None
    except sqlite3.DatabaseError as error:
        advice = "move the file away or choose another folder; it was left as it is"
        raise FileFormatError(path, field, error, "a campaign store that is whole", advice) from None


def identity(path: Path) -> tuple[int, int] | None:
    """What tells the file from another one put in its place; ``None`` if it is not there."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


# ── the record of a campaign ─────────────────────────────────────────────────────────────────────────

CAMPAIGN_FILE = "adaptive_campaign.sqlite"
JOURNAL = "campaign_journal.jsonl"
JOURNAL_FORMAT = "calib_planner campaign journal 1"
WRITTEN = "the record of a campaign that this package wrote"
MOST_BYTES = 200_000_000

TOLD = """
    SELECT MAX(s.number) FROM standstills AS s JOIN decisions AS d ON d.standstill = s.number
    WHERE d.campaign = ? AND s.told = ?
"""
JOIN = f"""
    INSERT INTO decisions (campaign, standstill, status, reason, repetition, unused, at, role)
    SELECT campaign, standstill, status, reason, repetition, unused, ?2, '{FIT}' FROM decisions
    WHERE number IN (SELECT MAX(number) FROM decisions WHERE campaign = ?1 GROUP BY standstill)
    AND status = '{ACCEPTED}'
"""


StoredRow = tuple[int, str, list[float], list[Any], list[Any]]


@dataclass(frozen=True, eq=False)
class StoredCampaign:
    """What the record of a campaign holds.

    Attributes:
        store: The open file.
        campaign_id: Name of the campaign.
        rows: ``(number, role, configuration, points, std)`` of each measurement in use: (joints,) [rad | m],
            (targets, 3) [m] and (targets,) [m], ``None`` where a target was not seen or nobody said how well.
        exclusions: Configurations given up.
        finished: The outcome; empty while it is not ended.
        failures: ``(role, configuration, reason)`` of each attempt that gave no measurement.
        dropped: Numbers of measurements at whose configurations no more is measured.
        spared: Those of them whose configurations a person wanted to skip.
        rounds: What was known after each batch.
    """

    store: CampaignStore
    campaign_id: str
    rows: tuple[StoredRow, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    finished: str = ""
    failures: tuple[tuple[str, FloatArray, str], ...] = ()
    dropped: tuple[int, ...] = ()
    spared: tuple[int, ...] = ()
    rounds: tuple[Round, ...] = ()

    def state(self, problem: CampaignProblem) -> CampaignState:
        """The campaign as far as it came.

        Raises:
            InputError: The measurements do not fit the robot.
        """
        ordered = sorted(self.rows, key=lambda r: r[1] != FIT)
        parts = [[r for r in ordered if (r[1] == FIT) == own] for own in (True, False)]
        data = [_measurements(problem.robot.joint_names, part) for part in parts]
        state = from_measurements(problem, data[0], data[1], self.exclusions)
        pairs = zip(state.measurements, ordered, strict=True)
        measurements = tuple(replace(m, number=row[0]) for m, row in pairs)
        tried = tuple(PlannedConfiguration(q, role) for role, q, _ in self.failures)
        first = len(state.configurations)
        return replace(
            state,
            configurations=(*state.configurations, *tried),
            measurements=measurements,
            failures=tuple((first + k, reason) for k, (_, _, reason) in enumerate(self.failures)),
            dropped=tuple(dict.fromkeys(m.index for m in measurements if m.number in self.dropped)),
            spared=tuple(dict.fromkeys(m.index for m in measurements if m.number in self.spared)),
            rounds=self.rounds,
        )


class CampaignStore(Store):
    """The open record of a campaign; made by ``begin_campaign`` or ``open_campaign``."""

    def note(self, before: CampaignState, after: CampaignState) -> None:
        """Write what became of ``before``.

        Raises:
            StoreError: It cannot be written; nothing was.
        """
        events: list[dict[str, Any]] = []
        was = [c.role for c in before.configurations]
        if was != [c.role for c in after.configurations[: len(was)]]:
            events.append({"joined": True})
        now = {r.number: r for r in after.measurements}
        then = {r.number: r for r in before.measurements}
        events += [{"withdrawn": number} for number in then if number not in now]
        for number, row in now.items():
            if then.get(number) is not row:
                event = {"measured": number, "role": after.configurations[row.index].role}
                std = None if row.std is None else row.std.max(axis=1)  # coordinates of one standstill are alike
                event |= {"configuration": row.q.tolist(), "points": plain(row.points), "std": plain(std)}
                events.append(event)
        for index, reason in after.failures[len(before.failures) :]:
            planned = after.configurations[index]
            event = {"failed": planned.q.tolist(), "role": planned.role, "reason": reason[:LONGEST]}
            events.append(event)
        for e in after.exclusions[len(before.exclusions) :]:
            event = {"excluded": e.q.tolist(), "radius": e.radius, "reason": e.reason[:LONGEST]}
            events.append(event | {"asked": e.requested})
        for index in after.dropped[len(before.dropped) :]:
            event = {"dropped": next(r.number for r in after.measurements if r.index == index)}
            events.append(event | {"asked": index in after.spared})
        events += [{"round": plain(asdict(r))} for r in after.rounds[len(before.rounds) :]]
        if after.result is not None and before.result is None:
            events.append({"finished": after.outcome})
        if events:
            with self._writing() as write:
                self._write(write, events)

    def _begin(self, write: sqlite3.Connection, campaign_id: str) -> None:
        if self._stored_model() is None:
            self._write_model(write)
        number = _insert(write, "campaigns", {"plan_id": campaign_id, "at": _now()})
        write.execute("INSERT OR REPLACE INTO current VALUES (1, ?)", (number,))

    def _write(self, write: sqlite3.Connection, events: Sequence[Mapping[str, Any]]) -> None:
        """Write events, in the order in which they happened."""
        campaign = int(write.execute(CURRENT).fetchone()["number"])
        for event in events:
            if "measured" in event or "withdrawn" in event:  # a number told again replaces the former measurement
                told = int(event["measured"] if "measured" in event else event["withdrawn"])
                former = write.execute(TOLD, (campaign, told)).fetchone()[0]
                write.execute(WITHDRAW, (UNDONE, "", _now(), former))
            if "measured" in event:
                role = _role(event["role"])
                q, points = np.array(event["configuration"], float), np.array(event["points"], float)
                unknown, said = np.full(self.model.targets, np.nan), event.get("std")
                std = unknown if said is None else np.array(said, float)
                stood = Standstill(0, 0, q, points, std, np.zeros(self.model.targets, np.int64))
                number = _insert(write, "standstills", standstill_row(stood, "") | {"told": told})
                _decide(write, campaign, number, Record(stood, ACCEPTED, "", None, 0, role=role))
            elif "withdrawn" not in event:
                if "joined" in event:
                    write.execute(JOIN, (campaign, _now()))
                document = json.dumps(event, allow_nan=False)
                _insert(write, "events", {"campaign": campaign, "document": document, "at": _now()})

    def _stored(self) -> StoredCampaign | None:
        """The current campaign; ``None`` if there is none."""
        current = self._one(CURRENT)
        if current is None:
            return None
        rows: list[StoredRow] = []
        path, joints = self.path or "memory", len(self.model.joint_names)
        sql = "SELECT document FROM events WHERE campaign = ? ORDER BY number"
        with _readable(path):
            for row in self._rows(LATEST, current["number"]):
                if row["status"] == ACCEPTED:
                    stood = record_of(path, row, joints, self.model.targets).standstill
                    points, std = plain(stood.points), plain(stood.std)
                    rows.append((row["told"], row["role"], stood.joints.tolist(), points, std))
            _measurements(self.model.joint_names, rows)  # refuses what is no measurement
            exclusions, failures, dropped, spared, rounds, finished = [], [], [], [], [], ""
            for event in (json.loads(row["document"]) for row in self._rows(sql, current["number"])):
                if "excluded" in event:
                    q = np.array(event["excluded"], float).reshape(joints)
                    others = float(event["radius"]), str(event["reason"]), bool(event["asked"])
                    exclusions.append(Exclusion(-1, q, *others))
                elif "failed" in event:
                    tried = frozen(np.array(event["failed"], float).reshape(joints))
                    failures.append((_role(event["role"]), tried, str(event["reason"])))
                elif "joined" in event:
                    failures = [(FIT, q, reason) for _, q, reason in failures]
                elif "dropped" in event:
                    dropped.append(int(event["dropped"]))
                    spared += dropped[-1:] if event.get("asked", False) else []  # not said by earlier versions
                elif "round" in event:
                    rounds.append(_round(event["round"]))
                elif "finished" in event:
                    finished = str(event["finished"])
        lists = tuple(failures), tuple(dropped), tuple(spared), tuple(rounds)
        return StoredCampaign(self, current["plan_id"], tuple(rows), tuple(exclusions), finished, *lists)

    def _goals(self) -> dict[str, Any]:
        last = self._one("SELECT document FROM settings ORDER BY number DESC LIMIT 1")
        return {} if last is None else dict(json.loads(last["document"]))


def _role(name: object) -> str:
    if name not in ROLES:
        raise InputError("role", cut(name, 100), " or ".join(ROLES))
    return str(name)


def _round(values: Mapping[str, Any]) -> Round:
    """A round out of JSON, in which numbers that are not finite are null."""
    nan, inf = float("nan"), float("inf")
    unknown: dict[str, Any] = {"accuracy": inf, "floor": nan, "sigma": nan, "left_out": nan}
    unknown["left"] = inf if values["measured"] else nan
    return Round(**{name: unknown[name] if value is None else value for name, value in values.items()})


def begin_campaign(
    folder: str | Path,
    campaign_id: str,
    robot: Robot,
    goals: Mapping[str, object],
    version: str,
    field: str = "store_folder",
) -> CampaignStore:
    """A new record in ``folder``, which is made if need be; one that is there is kept beside under another name.

    Args:
        folder: The folder.
        campaign_id: Name of the campaign.
        robot: The robot that is measured.
        goals: What the campaign has to reach, and how: names of parameters and their values, which JSON can hold.
        version: Of this package, for the record.
        field: The parameter that named the folder, for errors.

    Raises:
        FileFormatError: A symbolic link stands in its place.
        InputError: Another process has the one that is there.
        StoreError: It cannot be written.
    """
    path = user_path(folder) / CAMPAIGN_FILE
    with _disk(path, WRITABLE):
        _set_aside(path, campaign_id, field)
    store = CampaignStore(path, connect(path, field), _model(robot))
    try:
        with store._writing() as write:
            store._begin(write, campaign_id)
            store._write_settings(write, goals, version)
    except BaseException:
        store.close()
        raise
    return store


USED = """
SELECT (SELECT COUNT(*) FROM campaigns WHERE plan_id != ?) + (SELECT COUNT(*) FROM standstills)
     + (SELECT COUNT(*) FROM events)
"""
"""How many campaigns but one, and things that happened, are in a record."""


def _set_aside(path: Path, campaign_id: str, field: str) -> None:
    """Keep a record and a journal that are there beside, under names that no file has.

    A record stays, and the campaign begins in it, if none began there, or only this one and nothing happened;
    a full disk leaves such a record.
    """
    folder, fresh = path.parent, False
    if path.exists():
        try:
            database = connect(path, field)
            try:
                fresh = not database.execute(USED, (campaign_id,)).fetchone()[0]
            finally:
                database.close()
        except (FileFormatError, sqlite3.DatabaseError):  # what is damaged or foreign is kept as well
            if path.is_symlink():
                raise
    parts = [JOURNAL] if fresh else [CAMPAIGN_FILE, f"{CAMPAIGN_FILE}-wal", JOURNAL]
    names = [name for name in parts if path.with_name(name).exists()]
    pairs: list[tuple[Path, Path]] = []
    for k in count():
        prefix = f"before_{campaign_id}_{k}" if k else f"before_{campaign_id}"
        pairs = [(path.with_name(name), path.with_name(f"{prefix}_{name}")) for name in names]
        if not any(aside.exists() for _, aside in pairs):
            break
    for path, aside in pairs:
        path.rename(aside)
    if pairs:
        settle(folder)


def open_campaign(folder: str | Path, robot: Robot, field: str = "store_folder") -> StoredCampaign | None:
    """What the record in ``folder`` holds; ``None`` if there is none. A journal is converted first.

    Raises:
        FileFormatError: Not such a record, damaged, or of another robot; it was not touched.
        InputError: Another process has it.
        StoreError: It cannot be opened or written now.
    """
    path = user_path(folder) / CAMPAIGN_FILE
    journal, model = path.with_name(JOURNAL), _model(robot)
    lines = _journal_lines(journal, model)
    new = not path.exists()
    if new and not lines:
        return None
    store = CampaignStore(path, connect(path, field), model)
    try:
        stored = store._stored_model()
        if stored is not None:
            _check_robot(path, stored.marks, model)
        if lines:
            _convert(store, journal, lines)
        campaign = store._stored()
        if campaign is None:
            store.close()
        return campaign
    except BaseException:
        store.close()
        if new:
            with suppress(OSError):
                path.unlink(missing_ok=True)
        raise


def stored_goals(folder: str | Path, field: str = "store_folder") -> dict[str, Any] | None:
    """What the campaign recorded in ``folder`` has to reach, and how: names of parameters and their values.

    Empty where earlier versions wrote none; ``None`` if there is no record.

    Raises:
        FileFormatError, InputError, StoreError: As ``open_campaign``.
    """
    path = user_path(folder) / CAMPAIGN_FILE
    if not path.exists():
        return {} if path.with_name(JOURNAL).exists() else None
    store = CampaignStore(path, connect(path, field), StoredModel("", (), 0, ""))
    try:
        with _readable(path):
            return store._goals()
    finally:
        store.close()


def _model(robot: Robot) -> StoredModel:
    return StoredModel(robot.name, robot.joint_names, len(robot.targets), "")


def _measurements(joint_names: tuple[str, ...], rows: Sequence[StoredRow]) -> Measurements | None:
    """With standard deviations if they are known of all points."""
    if not rows:
        return None
    points, std = np.array([r[3] for r in rows], float), np.array([r[4] for r in rows], float)  # None: NaN
    seen = ~np.isnan(points[:, :, 0])
    each = np.where(seen[:, :, None], std[:, :, None], np.nan) * np.ones(3)
    known = bool((std[seen] > 0.0).all())
    return Measurements(joint_names, np.array([r[2] for r in rows], float), points, each if known else None)


@contextmanager
def _readable(path: str | Path) -> Iterator[None]:
    """Whatever is wrong with the content is an error of the file."""
    try:
        yield
    except StoreError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, CalibPlannerError) as error:
        raise FileFormatError(path, "events", cut(error, 200), WRITTEN, "move the file away") from None


# ── the journal of earlier versions ──────────────────────────────────────────────────────────────────


def _convert(store: CampaignStore, journal: Path, lines: list[dict[str, Any]]) -> None:
    """Take a journal over, unless that was done before a crash, and rename it."""
    with _readable(journal):
        campaign_id = str(lines[0]["campaign"])[:100]
        known = "SELECT number FROM campaigns WHERE plan_id = ?"
        if store._one(known, campaign_id) is None:
            with store._writing() as write:
                store._begin(write, campaign_id)
                store._write(write, lines[1:])
                store._stored()  # refuses what does not fit the robot
        row = store._one(known, campaign_id)
    with _disk(journal, WRITABLE):
        journal.rename(journal.with_name(f"campaign_journal_converted_{row['number'] if row else 0}.jsonl"))


def _journal_lines(path: Path, model: StoredModel) -> list[dict[str, Any]]:
    """The lines of a journal, without a torn last one; empty if there is no journal."""
    with _disk(path, "choose a folder that can be read"):
        if not path.exists():
            return []
        if path.stat().st_size > MOST_BYTES:
            raise FileFormatError(path, "size", f"{path.stat().st_size} bytes", f"at most {MOST_BYTES}")
        whole = path.read_bytes()
    lines: list[dict[str, Any]] = []
    for number, line in enumerate(whole[: whole.rfind(b"\n") + 1].splitlines(), 1):
        event = None
        with suppress(ValueError, RecursionError):
            event = json.loads(line)
        if not isinstance(event, dict):
            raise FileFormatError(path, f"line {number}", ascii(line[:40]), WRITTEN, "move the file away")
        lines.append(event)
    if not lines or lines[0].get("format") != JOURNAL_FORMAT:
        raise FileFormatError(path, "line 1", "something else", WRITTEN, "move the file away")
    _check_robot(path, {name: lines[0].get(name) for name in ("robot", "joint_names", "targets")}, model)
    return lines
