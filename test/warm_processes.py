# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m MODULE …`` without the time of its imports, for tests of nodes as processes.

A process that has imported the nodes forks once per command; nothing of ROS has begun in it. The command is a
process like any other, with a number, streams, words and an environment of its own: signals, kill -9, the end of
its parent's streams and exit statuses are real. That a node starts in a process that nobody has warmed is shown
by the tests of the demo and of the launch files.

``python warm_processes.py NUMBER`` is that process; it serves the socket of that number until the other end
closes, and kills then what is left.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import pkgutil
import runpy
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

LONGEST = 1 << 17
"""Longest command with its environment [bytes]."""
NODES = "calib_planner.ros.nodes"
AS_MAIN = (NODES + ".", "calib_planner.ros.processes", "calib_planner.ros.demo")
"""What commands run as ``__main__``: not there by its own name, as it is not in a process of its own."""
LEFT = "the middleware's participant outlives the program:"
"""What is said when Python ends with a participant at work: Fast DDS may hang or crash when its library ends."""


class Forked:
    """A process as ``subprocess.Popen`` gives it, forked from the warm one."""

    def __init__(self, control: socket.socket, job: dict[str, Any], streams: Sequence[Any]) -> None:
        self.returncode: int | None = None
        self.stdin: IO[bytes] | None = None
        self._status, its_status = os.pipe()
        its, theirs = [its_status], []
        for number, stream in enumerate(streams):
            if stream == subprocess.PIPE:
                assert number == 0, "only the input can be a pipe"
                end, own = os.pipe()
                self.stdin = os.fdopen(own, "wb", buffering=0)
                theirs.append(end)
            elif stream in (None, subprocess.DEVNULL):
                theirs.append(os.open(os.devnull, os.O_RDWR) if stream else os.dup(number))
            elif stream == subprocess.STDOUT:
                theirs.append(os.dup(theirs[1]))
            else:
                theirs.append(os.dup(stream if isinstance(stream, int) else stream.fileno()))
        socket.send_fds(control, [json.dumps(job).encode()], [*theirs, *its])
        for descriptor in (*theirs, *its):
            os.close(descriptor)
        self.pid = int(self._line())

    def _line(self) -> bytes:
        line = b""
        while not line.endswith(b"\n"):
            some = os.read(self._status, 1)
            assert some, "the process that forks has ended"
            line += some
        return line

    def wait(self, timeout: float | None = None) -> int:
        """The exit status, negative for a signal.

        Raises:
            subprocess.TimeoutExpired: It is still at work after so many seconds.
        """
        if self.returncode is None:
            if not select.select([self._status], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
            self.returncode = int(self._line())
            os.close(self._status)
        return self.returncode

    def poll(self) -> int | None:
        """The exit status, if it has ended."""
        try:
            return self.wait(0.0)
        except subprocess.TimeoutExpired:
            return None

    def send_signal(self, number: int) -> None:
        """Nothing, if it has ended."""
        if self.poll() is None:
            with suppress(ProcessLookupError):  # its end is being told
                os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_: object) -> None:
        if self.stdin is not None:
            self.stdin.close()
        self.wait()


class Warm:
    """The process that forks; a context manager that ends it."""

    def __init__(self) -> None:
        self._control, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with its:
            command = [sys.executable, __file__, str(its.fileno())]
            environment = os.environ | {"PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}
            self._server = subprocess.Popen(
                command, env=environment, pass_fds=[its.fileno()], start_new_session=True
            )

    def popen(
        self,
        command: Sequence[str],
        *,
        stdin: Any = None,
        stdout: Any = None,
        stderr: Any = None,
        env: Mapping[str, str] | None = None,
        start_new_session: bool = False,
    ) -> Forked:
        """As ``subprocess.Popen`` for ``[sys.executable, "-m", module, …]``; forked while this returns."""
        assert command[:2] == [sys.executable, "-m"]
        environment = dict(os.environ if env is None else env)
        job = {"words": list(command[2:]), "env": environment, "folder": os.getcwd(), "apart": start_new_session}
        return Forked(self._control, job, (stdin, stdout, stderr))

    def __enter__(self) -> Warm:
        return self

    def __exit__(self, *_: object) -> None:
        self._control.close()
        self._server.wait()


# ── inside the process that forks ────────────────────────────────────────────────────────────────────


def warm_up() -> None:
    """Import what the commands import."""
    from rclpy.type_support import check_for_type_support

    importlib.import_module("calib_planner.ros.demo")
    for module in pkgutil.iter_modules(importlib.import_module(NODES).__path__, NODES + "."):
        importlib.import_module(module.name)
    for name, module in list(sys.modules.items()):
        if name.endswith((".msg", ".srv", ".action")):
            for kind in vars(module).values():
                if hasattr(kind, "__import_type_support__"):
                    check_for_type_support(kind)
    for name in [name for name in sys.modules if name.startswith(AS_MAIN)]:
        del sys.modules[name]
    gc.collect()
    gc.freeze()  # or the first collection of every fork would copy all of it


def serve(control: socket.socket) -> dict[str, Any]:
    """Fork for every job; in the fork, the job. Without a job, the other end has closed."""
    ended, woken = socket.socketpair()
    woken.setblocking(False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(woken.fileno(), warn_on_full_buffer=False)
    running: dict[int, int] = {}
    while True:
        ready = select.select([control, ended], [], [])[0]
        if ended in ready:
            ended.recv(1 << 10)
        for pid in list(running):
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                told(running.pop(pid), os.waitstatus_to_exitcode(status))
        if control not in ready:
            continue
        words, given, *_ = socket.recv_fds(control, LONGEST, 4)
        if not words:
            for pid in running:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
            return {}
        *streams, status_pipe = given
        pid = os.fork()
        if not pid:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            for one in (control, ended, woken):
                one.close()
            for descriptor in (status_pipe, *running.values()):
                os.close(descriptor)
            for own, its in enumerate(streams):
                os.dup2(its, own)
                os.close(its)
            job: dict[str, Any] = json.loads(words)
            return job
        for descriptor in streams:
            os.close(descriptor)
        running[pid] = status_pipe
        os.write(status_pipe, b"%d\n" % pid)


def participant_threads() -> list[str]:
    """The threads of Fast DDS's participants in this process, by name."""
    names = []
    for path in Path("/proc/self/task").glob("*/comm"):
        with suppress(OSError):  # it has just ended
            names.append(path.read_text().strip())
    return sorted(name for name in names if name.startswith("dds.") and name != "dds.shm.wdog")


def told(pipe: int, status: int) -> None:
    """Tell the exit status; nobody may listen any more."""
    with suppress(BrokenPipeError):
        os.write(pipe, b"%d\n" % status)
    os.close(pipe)


def main() -> None:
    """In the fork, run the module as ``python -m`` does; it ends as it ends there."""
    warm_up()
    with socket.socket(fileno=int(sys.argv[1])) as control:
        job = serve(control)
    if not job:
        return
    if job["apart"]:
        os.setsid()
    os.chdir(job["folder"])
    os.environ.clear()
    os.environ.update(job["env"])
    module, *sys.argv[1:] = job["words"]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        if threads := participant_threads():
            print(LEFT, *threads, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
