# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes, on a ROS domain that nobody else uses.

``Nodes`` ends them when it is left. They also end with the process that started them, even if that is killed:

    python -m calib_planner.ros.processes NAME_node …

runs a node and watches standard input, whose other end the process that started it holds and never writes to.
When that process ends, the system closes that end: then the node is told to end, as Ctrl-C would tell it, and a
node that does not end in time is ended.
"""

from __future__ import annotations

import itertools
import os
import pkgutil
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from calib_planner.errors import CalibPlannerError
from calib_planner.ros import nodes as nodes_folder
from calib_planner.ros.nodes import end_quietly

PATIENCE = 8.0
"""Time that a node has to end by itself before it is killed [s]."""
LAST_WORDS = 2.0
"""Time that it then has to write to its log what it was doing [s]."""
DOMAINS = 100
"""ROS allows domains up to 101 without clashes with ephemeral ports; 0 is the default of everybody."""
PARTICIPANTS = 32
"""Participants of a domain that rmw_fastrtps looks for on one machine when discovery is local."""
CLAIM = 119
"""A participant's number that is never reached; its port is the last but one of a domain."""
_domains = itertools.count(os.getpid() * 37)


class ProcessFailed(CalibPlannerError):
    """A node ended by itself."""


@dataclass
class _Child:
    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def last_lines(self, count: int = 15) -> str:
        return "\n".join(self.log.read_text(errors="replace").splitlines()[-count:])


@contextmanager
def own_domain() -> Iterator[int]:
    """A ROS domain id from 1 to 100 that nobody else on this machine uses until the context is left.

    A participant listens at a port that follows from its domain and its number in the domain, counted from 0
    (RTPS 2.5, 9.6.2.3): a domain whose ports are all free has no participant. A socket at the port of ``CLAIM``
    keeps the domain from other callers of this function; the system closes it when the process ends.

    Raises:
        CalibPlannerError: All domains are in use.
    """
    for _ in range(DOMAINS):
        domain = 1 + next(_domains) % DOMAINS
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as claim:
            if not _bound(claim, domain, CLAIM) or _inhabited(domain):
                continue
            yield domain
            return
    raise CalibPlannerError(f"all ROS domains from 1 to {DOMAINS} are in use on this machine")


def _inhabited(domain: int) -> bool:
    for participant in range(PARTICIPANTS):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
            if not _bound(listener, domain, participant):
                return True
    return False


def _bound(listener: socket.socket, domain: int, participant: int) -> bool:
    """Whether the discovery port of a participant was free for a socket, which then holds it."""
    try:
        listener.bind(("", 7400 + 250 * domain + 10 + 2 * participant))
    except OSError:
        return False
    return True


class Nodes:
    """Starts nodes of this package; a context manager that ends them in any case.

    Args:
        folder: The folder for a log per node.
        domain: ROS domain id.
        popen: Starts a process, as ``subprocess.Popen`` does.
    """

    def __init__(self, folder: Path, domain: int, popen: Callable[..., Any] = subprocess.Popen) -> None:
        self._folder, self._children, self._popen = folder, list[_Child](), popen
        # Whoever has a profile of Fast DDS has said there who is to be discovered.
        chosen = "FASTRTPS_DEFAULT_PROFILES_FILE" in os.environ
        self._environment = os.environ | ({} if chosen else {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"})
        self._environment |= {
            "ROS_DOMAIN_ID": str(domain),
            "PYTHONUNBUFFERED": "1",
            "PYTHONFAULTHANDLER": "1",
        }

    def start(self, module: str, parameters: Mapping[str, object] | None = None) -> None:
        """Start a node by the name of its executable (``planner_node`` …), with node parameters."""
        command = [sys.executable, "-m", "calib_planner.ros.processes", module, "--ros-args"]
        for name, value in (parameters or {}).items():
            command += ["-p", f"{name}:={value}"]
        self._folder.mkdir(parents=True, exist_ok=True)
        log = self._folder / f"{module}.log"
        with log.open("wb") as sink:
            process = self._popen(
                command,
                stdin=subprocess.PIPE,  # closed by the system when this process ends, however it does
                stdout=sink,
                stderr=subprocess.STDOUT,
                env=self._environment,
                start_new_session=True,  # or Ctrl-C would reach them twice
            )
        self._children.append(_Child(module, process, log))

    def end_one(self, module: str, number: signal.Signals = signal.SIGINT) -> int:
        """End one node and set its log aside, so that it may be started again; returns its exit status."""
        child = next(c for c in self._children if c.name == module)
        with undisturbed():
            status = self._end(number, [child])[module]
        self._children.remove(child)
        child.log.rename(child.log.with_suffix(f".{child.process.pid}.log"))
        return status

    @property
    def processes(self) -> dict[str, int]:
        """Process id of each node."""
        return {c.name: c.process.pid for c in self._children}

    def check(self) -> None:
        """Raise ``ProcessFailed`` if a node has ended."""
        for child in self._children:
            status = child.process.poll()
            if status is not None:
                raise ProcessFailed(f"{child.name} ended with status {status}:\n{child.last_lines()}")

    def end(self, number: signal.Signals = signal.SIGINT) -> dict[str, int]:
        """End all nodes; returns the exit status of each (negative: had to be killed)."""
        with undisturbed():
            return self._end(number, self._children)

    def _end(self, number: signal.Signals, children: Sequence[_Child]) -> dict[str, int]:
        running = [c for c in children if c.process.poll() is None]
        for child in running:
            child.process.send_signal(number)
        deadline = time.monotonic() + PATIENCE
        for child in running:
            try:
                child.process.wait(max(deadline - time.monotonic(), 0.01))
            except subprocess.TimeoutExpired:
                _abort(child.process)
        for child in children:
            if child.process.stdin is not None:
                child.process.stdin.close()
        return {c.name: int(c.process.returncode) for c in children}

    def logs(self) -> dict[str, str]:
        """The last lines of each node's output."""
        return {c.name: c.last_lines() for c in self._children}

    def __enter__(self) -> Nodes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()


def _abort(process: subprocess.Popen[bytes]) -> None:
    """Kill a process; before, Python writes to the log where each of its threads is."""
    process.send_signal(signal.SIGABRT)
    try:
        process.wait(LAST_WORDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextmanager
def undisturbed() -> Iterator[list[int]]:
    """Let Ctrl-C wait meanwhile: it must not leave nodes behind, and it is not lost either.

    Yields:
        The signals that have come; what takes long looks at it now and then.

    Raises:
        KeyboardInterrupt: Afterwards, if a signal came that this process handles.
    """
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    handled = [n for n in (signal.SIGINT, signal.SIGTERM) if callable(signal.getsignal(n))]
    before = {n: signal.signal(n, lambda number, frame: came.append(number)) for n in handled}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        raise KeyboardInterrupt


def node_names() -> Sequence[str]:
    """Executables of all nodes of this package, sorted."""
    names = (module.name for module in pkgutil.iter_modules(nodes_folder.__path__))
    return tuple(f"{name}_node" for name in sorted(names))


# ── inside the process of a node ─────────────────────────────────────────────────────────────────────


def end_with_parent() -> None:
    """Watch standard input from now on."""
    threading.Thread(target=_watch, daemon=True, name="parent").start()


def _watch() -> None:
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(PATIENCE)
    os._exit(1)


def main() -> None:
    """Run the node of the executable ``NAME_node`` (``nodes/NAME.py``) with what follows on the command line."""
    if len(sys.argv) < 2 or not sys.argv[1].isidentifier():
        raise SystemExit("usage: python -m calib_planner.ros.processes NAME_node [--ros-args …]")
    end_quietly()
    end_with_parent()
    node = sys.argv.pop(1).removesuffix("_node")
    runpy.run_module(f"calib_planner.ros.nodes.{node}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
