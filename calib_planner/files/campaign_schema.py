"""The file of a campaign store: made, opened for one process alone, checked, and brought up to date.

SQLite with a write-ahead log and ``synchronous=FULL``: a commit that returned survives ``kill -9`` and a power
cut, one that did not leaves nothing behind. ``locking_mode=EXCLUSIVE`` keeps a second process out and needs no
file of shared memory, which a full disk could tear.
"""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

from calib_planner.errors import FileFormatError, InputError, StoreError

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
