# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``calib-planner`` and ``python SCRIPT`` without the time of their imports, for pages of many commands.

A process that has imported the package forks once per command. The command gets the caller's streams, folder and
words; its status comes back. The first command, the first script, and every script that starts processes itself,
is a process of its own, as a user starts it.

``python warm_commands.py SOCKET`` is that process; it serves until its stdin ends.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import runpy
import select
import shutil
import socket
import subprocess
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

MODULES = ("calib_planner.cli", "scipy.stats", "matplotlib.figure", "matplotlib.backends.backend_agg")
"""What commands and scripts would import."""

CALLER = """#!{python} -IS
import json, os, socket, sys
with socket.socket(socket.AF_UNIX) as server:
    server.connect({address!r})
    words = json.dumps([os.getcwd(), *sys.argv[1:]]).encode()
    socket.send_fds(server, [words], [0, 1, 2])
    sys.exit(int(server.recv(16) or 70))
"""

COMMAND = """#!/bin/sh
mkdir "{first}/{name}" 2>/dev/null && exec "{real}" "$@"
exec "{caller}" {name} "$@"
"""

SCRIPT = """#!/bin/sh
grep -q __main__ "$1" && exec "{real}" "$@"
mkdir "{first}/{name}" 2>/dev/null && exec "{real}" "$@"
exec "{caller}" {name} "$@"
"""


@contextmanager
def warm_commands(folder: Path, environment: dict[str, str]) -> Iterator[Path]:
    """A folder with ``calib-planner`` and ``python`` to put first in PATH; ``folder`` has a short name."""
    address, caller, first, programs = (folder / n for n in ("socket", "caller", "first", "bin"))
    first.mkdir()
    programs.mkdir()
    write(caller, CALLER.format(python=sys.executable, address=str(address)))
    for name, text in (("calib-planner", COMMAND), ("python", SCRIPT)):
        real = Path(sys.executable).with_name(name)
        real = real if real.exists() else Path(shutil.which(name) or name)
        write(programs / name, text.format(first=first, name=name, real=real, caller=caller))
    command = [sys.executable, __file__, str(address)]
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as server:
        assert server.stdin and server.stdout
        assert server.stdout.readline() == b"ready\n"
        yield programs
        server.stdin.close()


def write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
    path.chmod(0o755)


def serve(address: str) -> None:
    """Fork for every caller at the socket."""
    for name in MODULES:
        importlib.import_module(name)
    gc.freeze()  # what is imported stays
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(address)
        listening.listen()
        os.write(1, b"ready\n")
        while listening in select.select([0, listening], [], [])[0]:
            caller, _ = listening.accept()
            if not os.fork():
                answer(caller)
            caller.close()
            with suppress(ChildProcessError):
                while os.waitpid(-1, os.WNOHANG)[0]:
                    pass


def answer(caller: socket.socket) -> None:
    """Do what the caller asks in this fork, and end."""
    words, streams, *_ = socket.recv_fds(caller, 1 << 16, 3)
    for own, its in enumerate(streams):
        os.dup2(its, own)
        os.close(its)
    folder, program, *rest = json.loads(words)
    os.chdir(folder)
    status = 1
    try:
        status = run(program, rest)
        sys.stdout.flush()
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        sys.stdout.flush()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        caller.sendall(str(status).encode())
        os._exit(0)


def run(program: str, words: list[str]) -> int:
    """The exit status of a command or a script that ends by itself."""
    if program == "calib-planner":
        sys.argv = [program, *words]
        return int(importlib.import_module("calib_planner.cli").main())
    sys.argv = words
    sys.path[0] = str(Path(words[0]).parent)
    runpy.run_path(words[0], run_name="__main__")
    return 0


if __name__ == "__main__":
    serve(sys.argv[1])
