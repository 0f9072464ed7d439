"""A campaign on disk: what was accepted is there before anyone is told so.

One file, ``campaign.sqlite``, in a folder that the user chose (``campaign_schema``); without a folder the same in
memory.

Tables only grow: standstills are raw data, decisions about them are a log (``campaign_records``), and a campaign
is a plan with the decisions made under it. Only the pointer to the current campaign moves, and a campaign in
which nothing was measured gives way to the next. The model's source text, the settings and the version of the
package that wrote are kept beside.

A file of another robot, of a newer schema or one that is damaged is refused and left as it is. When the disk is
full or gone, ``StoreError`` says so, nothing changes, and the next attempt may succeed.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.acquisition import Reason, Rejection, Standstill
from calib_planner.arrays import FloatArray, frozen, plain
from calib_planner.errors import FileFormatError, InputError, StoreError
from calib_planner.io.plan import parse_plan
from calib_planner.io.yaml import Node
from calib_planner.planning import Plan

LATEST = """
    SELECT s.*, d.* FROM decisions AS d JOIN standstills AS s ON s.number = d.standstill
    WHERE d.number IN (SELECT MAX(number) FROM decisions WHERE campaign = ? GROUP BY standstill)
    ORDER BY d.standstill
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


@dataclass(frozen=True, eq=False)
class StoredCampaign:
    """A plan and what was decided under it.

    Attributes:
        number: Of the campaign.
        plan_id, plan: The plan, if any.
        decisions: The last one about every standstill, in the order of measuring.
    """

    number: int
    plan_id: str
    plan: Plan | None
    decisions: tuple[Decision, ...]


class CampaignStore:
    """An open store; ``open_store`` makes one.

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

    # ── what there is ────────────────────────────────────────────────────────────────────────────────

    def current(self) -> StoredCampaign | None:
        """The campaign that goes on; ``None`` in a new store.

        Raises:
            FileFormatError: Damaged rows.
            StoreError: The file cannot be read now.
        """
        row = self._one("SELECT c.* FROM campaigns AS c JOIN current ON current.campaign = c.number")
        return None if row is None else self._campaign(row)

    def find(self, plan_id: str, plan: Plan | None) -> StoredCampaign | None:
        """The newest campaign of a plan; ``None`` if there is none.

        Raises:
            InputError: There is another plan of this name, or the name is too long.
            StoreError: The file cannot be read now.
        """
        if len(plan_id) > LONGEST:
            raise InputError("plan_id", f"{len(plan_id)} characters", f"at most {LONGEST} characters")
        row = self._one("SELECT * FROM campaigns WHERE plan_id = ? ORDER BY number DESC LIMIT 1", plan_id)
        if row is None:
            return None
        known = self._campaign(row)
        if not same_plan(known.plan, plan):
            advice = "give the new plan a name of its own, or choose another folder"
            raise InputError("plan_id", repr(plan_id), "a name that no other plan in the store has", advice)
        return known

    @property
    def empty(self) -> bool:
        """Whether nothing was ever recorded."""
        return self._one("SELECT 1 FROM standstills LIMIT 1") is None

    def history(self, standstill: int) -> list[dict[str, Any]]:
        """All that was ever decided about a standstill, oldest first: campaign, status, reason, at."""
        sql = "SELECT campaign, status, reason, at FROM decisions WHERE standstill = ? ORDER BY number"
        return [dict(r) for r in self._rows(sql, standstill)]

    # ── what is added ────────────────────────────────────────────────────────────────────────────────

    def begin(self, plan_id: str, plan: Plan | None, carried: Sequence[Decision] = ()) -> StoredCampaign:
        """Make a plan's campaign the current one: the one there is, or a new one.

        Args:
            carried: What a new campaign takes over from another, as decided under the new plan.

        Raises:
            InputError: There is another plan of this name.
            StoreError: It cannot be written.
        """
        known = self.find(plan_id, plan)
        if known is None:
            return self._new(plan_id, plan, carried)
        with self._writing() as write:
            self._point_at(write, known.number)
        return known

    def restart(self, plan_id: str, plan: Plan | None) -> StoredCampaign:
        """A campaign of the same plan with nothing measured; the former stays in the file.

        Raises:
            StoreError: It cannot be written.
        """
        return self._new(plan_id, plan, ())

    def record(self, campaign: int, decision: Decision) -> int:
        """Write a standstill and what was decided about it; returns its number.

        Raises:
            StoreError: It cannot be written; nothing was.
        """
        with self._writing() as write:
            number = _insert(write, "standstills", standstill_row(decision.found, decision.frame))
            _decide(write, campaign, number, decision)
        return number

    def decide(self, campaign: int, decisions: Sequence[Decision]) -> None:
        """Write what is thought of standstills now, all of it or nothing.

        Raises:
            StoreError: It cannot be written; nothing was.
        """
        if decisions:
            with self._writing() as write:
                for decision in decisions:
                    _decide(write, campaign, decision.number, decision)

    # ── inside ───────────────────────────────────────────────────────────────────────────────────────

    def _new(self, plan_id: str, plan: Plan | None, carried: Sequence[Decision]) -> StoredCampaign:
        with self._writing() as write:
            columns = {"plan_id": plan_id, "plan": plan_text(plan), "at": _now()}
            number = _insert(write, "campaigns", columns)
            self._point_at(write, number)
            for decision in carried:
                _decide(write, number, decision.number, decision)
        return StoredCampaign(number, plan_id, plan, tuple(carried))

    @staticmethod
    def _point_at(write: sqlite3.Connection, number: int) -> None:
        """Make a campaign the current one; others without a standstill go: plans may come by the thousand."""
        write.execute("INSERT OR REPLACE INTO current VALUES (1, ?)", (number,))
        write.execute(
            "DELETE FROM campaigns WHERE number != ? AND number NOT IN (SELECT campaign FROM decisions)",
            (number,),
        )

    def _campaign(self, row: Mapping[str, Any]) -> StoredCampaign:
        where, joints, targets = self.path or "memory", len(self.model.joint_names), self.model.targets
        rows = self._rows(LATEST, row["number"])
        decisions = tuple(decision_of(where, r, joints, targets) for r in rows)
        return StoredCampaign(row["number"], row["plan_id"], plan_of(where, row["plan"]), decisions)

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
            yield from self._transaction()

    def _transaction(self) -> Iterator[sqlite3.Connection]:
        try:
            if self.path is not None and identity(self.path) != self._file:
                raise StoreError(self.path, "the file was moved, removed or replaced", "put it back")
            self._database.execute("BEGIN IMMEDIATE")
            yield self._database
            self._database.execute("COMMIT")
        except sqlite3.Error as error:
            self._roll_back()
            self.trouble = str(error)
            raise StoreError(self.path, str(error), "make space or repair the disk; it is tried again") from None
        except BaseException as error:
            self._roll_back()
            self.trouble = str(error)
            raise
        self.trouble = ""

    def _roll_back(self) -> None:
        # SQLite may have rolled back itself; a roll-back that fails is made up for by the next BEGIN.
        try:
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")
        except sqlite3.Error:
            return


class UnavailableStore(CampaignStore):
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


# ── opening ──────────────────────────────────────────────────────────────────────────────────────────


def open_store(
    folder: str, model: StoredModel, settings: Mapping[str, object], version: str, field: str = "store_folder"
) -> CampaignStore:
    """Open the store in a folder, or make one.

    Args:
        folder: Is made if it is not there; empty: in memory, gone with the process.
        model: The robot it has to belong to; one in which nothing was measured yet takes any.
        settings: What else decides what an estimate is; kept for the record.
        version: Of this package, for the record.
        field: The parameter that named the folder, for errors.

    Raises:
        FileFormatError: Not a store, damaged, of a newer schema, or of another robot; it was not touched.
        InputError: Another process has it.
        StoreError: It cannot be opened or written now.
    """
    path = Path(folder).expanduser() / FILE if folder else None
    database = connect(path, field)
    try:
        prepare(database, path, field)
        store = CampaignStore(path, database, model)
        _check_model(store)
        _note_settings(store, settings, version)
    except BaseException:
        database.close()
        raise
    return store


def stored_model(folder: str, field: str = "store_folder") -> StoredModel | None:
    """Which robot the store in a folder belongs to; ``None`` without one, or if nothing was measured yet.

    Raises:
        As ``open_store``.
    """
    path = Path(folder).expanduser() / FILE
    if not folder or not path.exists():
        return None
    database = connect(path, field)
    try:
        prepare(database, path, field)
        store = CampaignStore(path, database, StoredModel("", (), 0, ""))
        row = store._one("SELECT * FROM model")
        return None if row is None or store.empty else _model_of(row)
    finally:
        database.close()


def _model_of(row: Mapping[str, Any]) -> StoredModel:
    joints = tuple(json.loads(row["joint_names"]))
    return StoredModel(row["name"], joints, row["targets"], row["source"], row["origin"])


def _check_model(store: CampaignStore) -> None:
    model, row = store.model, store._one("SELECT * FROM model")
    found = None if row is None else _model_of(row)
    if found is None or (found != model and store.empty):
        with store._writing() as write:
            write.execute("DELETE FROM current")
            write.execute("DELETE FROM campaigns")
            write.execute("DELETE FROM model")
            columns = {"one": 1, "name": model.name, "joint_names": json.dumps(model.joint_names)}
            columns |= {"targets": model.targets, "origin": model.origin, "sha256": model.sha256}
            _insert(write, "model", columns | {"source": model.source, "at": _now()})
        return
    advice = "choose another folder, or start with the robot that the store belongs to"
    for field, got, expected in (
        ("robot", found.name, model.name),
        ("joint_names", found.joint_names, model.joint_names),
        ("targets", found.targets, model.targets),
        ("model of the robot, sha256", found.sha256, model.sha256),
    ):
        if got != expected:
            raise FileFormatError(store.path, field, got, str(expected), advice)


def _note_settings(store: CampaignStore, settings: Mapping[str, object], version: str) -> None:
    document = json.dumps(settings, sort_keys=True, default=list)
    last = store._one("SELECT * FROM settings ORDER BY number DESC LIMIT 1")
    if last is None or (last["document"], last["version"]) != (document, version):
        with store._writing() as write:
            _insert(write, "settings", {"version": version, "document": document, "at": _now()})


def _decide(write: sqlite3.Connection, campaign: int, standstill: int, decision: Decision) -> None:
    columns = {"campaign": campaign, "standstill": standstill, **decision_row(decision), "at": _now()}
    _insert(write, "decisions", columns)


def _insert(write: sqlite3.Connection, table: str, columns: Mapping[str, Any]) -> int:
    """Add a row; names of table and columns are this file's own."""
    marks = ", ".join("?" * len(columns))
    sql = f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({marks})"
    return int(write.execute(sql, tuple(columns.values())).lastrowid or 0)


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="milliseconds")


# ── What a campaign keeps of every standstill, and how it stands in the rows of its store ───────────────────
# A *standstill* is raw data and never changes. What is thought of it is a *decision*; a later decision replaces
# an earlier one, and both stay. What a campaign uses is therefore a fold: per standstill the last decision.
#
# Numbers are JSON, which Python writes and reads exactly to the bit; null is NaN (a target that was not seen).

ACCEPTED, OUTLIER, UNDONE = "accepted", "outlier", "undone"
KEPT = (ACCEPTED, OUTLIER)
"""Decisions about standstills that the identification is given; it rejects outliers itself, every time anew."""
WIRE = ("configurations", "test_poses")
"""What is finite in a plan that came in a message, which has no weights."""
LONGEST = 500
"""Characters kept of a text that came over a wire."""


@dataclass(frozen=True, eq=False)
class Decision:
    """What becomes of a standstill.

    Attributes:
        found: The standstill, or why it was none.
        status: ``accepted``, ``outlier``, ``undone``, ``not_in_plan``, … or the value of a ``Reason``.
        reason: In words; empty when accepted in full.
        index: Row of the plan, or ``None``.
        repetition: Number of this measurement at its configuration, from 0.
        unused: Targets, from 0, that the identification rejected.
        number: Its number in the store, ascending; 0: not stored.
        frame: Frame of its points.
    """

    found: Standstill | Rejection
    status: str
    reason: str
    index: int | None
    repetition: int
    unused: tuple[int, ...] = ()
    number: int = 0
    frame: str = ""

    @property
    def standstill(self) -> Standstill:
        """What was found, of a decision that was accepted at least once."""
        if not isinstance(self.found, Standstill):
            raise TypeError(f"standstill {self.number} was rejected: {self.found.message}")
        return self.found

    def now(self, status: str, reason: str, unused: tuple[int, ...] = ()) -> Decision:
        """The same standstill, decided otherwise."""
        return replace(self, status=status, reason=reason, unused=unused)


# ── rows ─────────────────────────────────────────────────────────────────────────────────────────────


def standstill_row(found: Standstill | Rejection, frame: str) -> dict[str, Any]:
    """The columns of a standstill."""
    row: dict[str, Any] = {"start": found.start, "stop": found.stop, "joints": _text(found.joints)}
    row |= {"samples": json.dumps(found.samples.tolist()), "frame": frame[:LONGEST]}
    if isinstance(found, Rejection):
        return row | {"rejected": found.reason.value, "message": found.message[:LONGEST]}
    return row | {"points": _text(found.points), "std": _text(found.std), "message": ""}


def decision_row(decision: Decision) -> dict[str, Any]:
    """The columns of a decision."""
    return {
        "status": decision.status,
        "reason": decision.reason[:LONGEST],
        "configuration": decision.index,
        "repetition": decision.repetition,
        "unused": json.dumps(decision.unused),
    }


def decision_of(path: str | Path, row: Mapping[str, Any], joints: int, targets: int) -> Decision:
    """A standstill with a decision about it, out of the columns of both.

    Raises:
        FileFormatError: A number of joints or targets that does not fit, or damaged columns.
    """
    where = f"standstill {row['standstill']}"
    try:
        return Decision(
            _found(path, where, row, joints, targets),
            row["status"],
            row["reason"],
            row["configuration"],
            row["repetition"],
            tuple(json.loads(row["unused"])),
            row["standstill"],
            row["frame"],
        )
    except (TypeError, ValueError, KeyError, IndexError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(path, where, str(error)[:100], "what this package wrote there") from None


def _found(
    path: str | Path, where: str, row: Mapping[str, Any], joints: int, targets: int
) -> Standstill | Rejection:
    start, stop = int(row["start"]), int(row["stop"])
    q = _array(path, f"{where}, joints", row["joints"], (joints,))
    samples = frozen(np.array(json.loads(row["samples"]), np.int64))
    if samples.shape != (targets,):
        raise FileFormatError(path, f"{where}, samples", f"{samples.size} targets", f"{targets} targets")
    if row["rejected"] is not None:
        return Rejection(start, stop, Reason(row["rejected"]), row["message"], q, samples)
    points = _array(path, f"{where}, points", row["points"], (targets, 3))
    std = _array(path, f"{where}, std", row["std"], (targets,))
    return Standstill(start, stop, q, points, std, samples)


# ── plans ────────────────────────────────────────────────────────────────────────────────────────────


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
    """Whether two plans ask for the same: what was found on the way to them does not count."""
    if one is None or other is None:
        return one is other
    names = ("robot", "joint_names", "parameters", "configurations", "repetitions", "test_poses")
    return all(np.array_equal(getattr(one, n), getattr(other, n)) for n in names)


# ── numbers ──────────────────────────────────────────────────────────────────────────────────────────


def _text(values: FloatArray) -> str:
    """Numbers as JSON, NaN as null."""
    return json.dumps(plain(values))


def _array(path: str | Path, where: str, text: str, shape: tuple[int, ...]) -> FloatArray:
    return Node(path, where, json.loads(text)).array(shape, finite=False)


# ── The file of a campaign store: made, opened for one process alone, checked, and brought up to date ───────
# SQLite with a write-ahead log and ``synchronous=FULL``: a commit that returned survives ``kill -9`` and a power
# cut, one that did not leaves nothing behind. ``locking_mode=EXCLUSIVE`` keeps a second process out and needs no
# file of shared memory, which a full disk could tear.

FILE = "campaign.sqlite"
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
)
"""Entry k makes schema k + 1 out of schema k; an empty file is schema 0."""


def connect(path: Path | None, field: str) -> sqlite3.Connection:
    """Open the file, which may be new; ``None``: in memory. Errors are those of ``open_store``."""
    try:
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_symlink():
                raise FileFormatError(path, field, "a symbolic link", "a file in this folder itself")
        # The node is made in one thread and spun in another; only one at a time uses the store.
        name = ":memory:" if path is None else str(path)
        database = sqlite3.connect(name, timeout=1.0, isolation_level=None, check_same_thread=False)
    except (OSError, sqlite3.Error) as error:
        advice = "choose a folder that can be written to"
        raise StoreError(path, getattr(error, "strerror", None) or str(error), advice) from None
    database.row_factory = sqlite3.Row
    return database


def prepare(database: sqlite3.Connection, path: Path | None, field: str) -> None:
    """Take the file for this process, check that it is ours and whole, bring its schema up to date."""
    try:
        database.execute("PRAGMA locking_mode = EXCLUSIVE")
        found = int(database.execute("PRAGMA application_id").fetchone()[0])
        schema = int(database.execute("PRAGMA user_version").fetchone()[0])
        used = bool(database.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()[0])
        if used and found != APPLICATION:
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
            _migrate(database, schema)
            _settle(path)
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


def _migrate(database: sqlite3.Connection, schema: int) -> None:
    script = "".join(MIGRATIONS[schema:])
    mark = f"PRAGMA application_id = {APPLICATION}; PRAGMA user_version = {len(MIGRATIONS)};"
    database.executescript(f"BEGIN IMMEDIATE; {script} {mark} COMMIT;")


def _settle(path: Path | None) -> None:
    """Have the folder know the new file for good."""
    if path is not None:
        handle = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(handle)
        except OSError:  # not every file system can
            pass
        finally:
            os.close(handle)


def identity(path: Path) -> tuple[int, int] | None:
    """What tells the file from another one put in its place; ``None`` if it is not there."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
