# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The system as a program sees it, with disks that fill, clocks that are set, and an end at any system call.

``system_calls.c`` is compiled and loaded before the C library (``LD_PRELOAD``). It counts calls that change the
files of one folder; what shall happen at which call, and how far the clock is ahead, stands in memory that
processes share, ``Control``. Needs Linux and a C compiler.

    if __name__ == "__main__":
        with interposed() as control:       # starts this program once more, with the library, and there goes on
            control.folder = b"/tmp/store"
            control.full_from = 3           # the third call finds the disk full
"""

from __future__ import annotations

import ctypes
import mmap
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SOURCE = Path(__file__).with_suffix(".c")
WRITE, TRUNCATE, SYNC, UNLINK, RENAME, CREATE, NOTE, FOLDER = range(1, 9)
"""Kinds of calls in the log, as in ``system_calls.c``."""


class Control(ctypes.Structure):
    """``struct control`` of ``system_calls.c``, which says what each field is."""

    _fields_ = (
        *(
            (name, ctypes.c_int64)
            for name in ("clock_offset", "count", "kill_at", "torn", "full_from", "full_until")
        ),
        ("logging", ctypes.c_int64),
        ("acknowledged", ctypes.c_int64),
        ("folder", ctypes.c_char * 512),
    )

    def begin(self, folder: Path, **others: int) -> None:
        """Count anew, the calls that change ``folder``; all else as it usually is, or as ``others`` say."""
        ctypes.memset(ctypes.byref(self), 0, ctypes.sizeof(self))
        self.folder = os.fsencode(folder)
        for name, value in others.items():
            setattr(self, name, value)


@dataclass(frozen=True)
class Call:
    """A call in the log: its kind, path, offset or size or number of steps, and bytes."""

    kind: int
    path: str
    offset: int
    data: bytes


def library(folder: Path) -> Path:
    """The compiled library, made in ``folder``.

    Raises:
        RuntimeError: It cannot be made here.
    """
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None or not sys.platform.startswith("linux"):
        raise RuntimeError("this needs Linux and a C compiler")
    made = folder / "system_calls.so"
    subprocess.run([compiler, "-O1", "-shared", "-fPIC", "-o", made, SOURCE, "-ldl"], check=True)
    return made


def control_of(path: Path) -> Control:
    """The shared memory in a file, which is made if it is not there."""
    with open(path, "a+b") as file:
        file.truncate(mmap.PAGESIZE)
        return Control.from_buffer(mmap.mmap(file.fileno(), mmap.PAGESIZE))


def environment(folder: Path) -> dict[str, str]:
    """Variables with which a program is started so that ``control_of(folder / "control")`` rules it."""
    control_of(folder / "control")
    preload = os.pathsep.join(filter(None, (str(library(folder)), os.environ.get("LD_PRELOAD", ""))))
    shared = {"SYSTEM_CALLS_CONTROL": str(folder / "control"), "SYSTEM_CALLS_LOG": str(folder / "calls")}
    return os.environ | shared | {"LD_PRELOAD": preload}


def interposed() -> Control:
    """The control of this process; a process without the library starts this program again with it, and ends."""
    path = os.environ.get("SYSTEM_CALLS_CONTROL")
    if path is not None:
        return control_of(Path(path))
    with tempfile.TemporaryDirectory(prefix="system_calls_") as folder:
        again = subprocess.run([sys.executable, *sys.argv], env=environment(Path(folder)))
    raise SystemExit(again.returncode)


def acknowledge(steps: int) -> None:
    """Note that so many steps have been acknowledged, here and in the log."""
    ctypes.CDLL(None).system_calls_acknowledge(ctypes.c_int64(steps))


def calls(path: Path) -> Iterator[Call]:
    """The calls in a log."""
    with open(path, "rb") as log:
        while len(head := log.read(32)) == 32:
            kind, name, offset, size = (
                int.from_bytes(head[k : k + 8], "little", signed=True) for k in (0, 8, 16, 24)
            )
            yield Call(kind, os.fsdecode(log.read(name)), offset, log.read(size))


def forked(work: Any) -> int:
    """Status of a child that does ``work`` and ends: 0, 1 after an exception, or minus its signal."""
    if pid := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    status = 1
    try:
        work()
        status = 0
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(status)
