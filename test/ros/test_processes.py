# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes: they end when told to, with status 0, and with the process that started them."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from robots import repeats
from warm_processes import LEFT, Warm

from calib_planner.errors import CalibPlannerError
from calib_planner.ros import processes
from calib_planner.ros.processes import Nodes, node_names, own_domain

PARENT = """
import sys, time
from pathlib import Path
from calib_planner.ros import processes
from calib_planner.ros.processes import Nodes, own_domain

with own_domain() as domain:
    nodes = Nodes(Path(sys.argv[1]), domain)
    for module in sys.argv[2:]:
        nodes.start(module)
    print(*nodes.processes.values(), flush=True)
    time.sleep(600)
"""


PARAMETERS = {"page_node": {"port": 0}}
"""A free port: another test may have a page at the default one."""
NOT_OF_THE_DEMO = ("campaign_node", "executor_node", "page_node")
"""Started here in processes of their own, by an interpreter that has imported nothing; the others by the demo."""


def running(pid: int) -> bool:
    """Whether a process is at work; one that only waits to be collected is not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait(condition: Callable[[], bool], seconds: float = 40.0) -> bool:
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    return condition()


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes by /proc")
def test_nodes_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    names = repeats(NOT_OF_THE_DEMO, node_names())
    command = [sys.executable, "-c", PARENT, str(tmp_path), *names]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pids = [int(word) for word in parent.stdout.readline().split()]
        try:
            logs = [tmp_path / f"{name}.log" for name in names]
            assert len(pids) == len(names) and wait(lambda: all(log.stat().st_size for log in logs))
            assert all(running(pid) for pid in pids), [log.read_text() for log in logs]
            parent.kill()
            assert wait(lambda: not any(running(pid) for pid in pids))
        finally:
            parent.kill()
            for pid in filter(running, pids):
                os.kill(pid, signal.SIGKILL)
    for log in logs:
        assert "Traceback" not in log.read_text(), log.read_text()


@pytest.mark.parametrize("number", repeats([signal.SIGTERM], [signal.SIGINT, signal.SIGTERM]))
def test_every_node_ends_with_status_0(warm: Warm, tmp_path: Path, number: signal.Signals) -> None:
    with own_domain() as domain, Nodes(tmp_path, domain, warm.popen) as nodes:
        for name in node_names():
            nodes.start(name, PARAMETERS.get(name))
        logs = [tmp_path / f"{name}.log" for name in node_names()]
        assert wait(lambda: all(log.stat().st_size for log in logs))
        nodes.check()
        assert nodes.end(number) == dict.fromkeys(node_names(), 0), nodes.logs()
    for log in logs:
        assert "Traceback" not in log.read_text() and LEFT not in log.read_text(), log.read_text()


INTERRUPTED = """
import os, signal, sys

class Interrupting:
    left = int(sys.argv[1])

    def find_spec(self, *others):
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGINT)

name = sys.argv[2]
sys.argv = [f"/somewhere/{name}_node"]
from importlib import import_module  # as the script that starts a node
sys.meta_path.insert(0, Interrupting())
import_module(f"calib_planner.ros.nodes.{name}").main()
"""
"""Starts a node, and sends SIGINT to itself as the n-th module is searched."""


@pytest.mark.parametrize("name", [name.removesuffix("_node") for name in node_names()])
@pytest.mark.parametrize("seed", repeats(range(1), range(15)))
def test_ctrl_c_while_modules_are_imported_ends_a_node_without_a_word(name: str, seed: int) -> None:
    searched = 4 + int(np.random.default_rng(seed + 100 * len(name)).integers(300))
    command = [sys.executable, "-c", INTERRUPTED, str(searched), name]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGINT, "", ""), searched


@pytest.mark.parametrize("seed", repeats(range(1), range(10)))
def test_ctrl_c_several_times_ends_all_nodes_with_status_0(warm: Warm, tmp_path: Path, seed: int) -> None:
    """A terminal tells all of its processes, ``ros2 launch`` tells them again, and people do."""
    draw = np.random.default_rng(seed)
    names = node_names()
    with own_domain() as domain, Nodes(tmp_path, domain, warm.popen) as nodes:
        for name in names:
            nodes.start(name, PARAMETERS.get(name))
        logs = {name: tmp_path / f"{name}.log" for name in names}
        assert wait(lambda: all(log.stat().st_size for log in logs.values()))
        nodes.check()
        again = [(float(t), name) for name in names for t in draw.uniform(0.0, 0.5, draw.integers(1, 4))]
        began = time.monotonic()
        for name in names:
            os.kill(nodes.processes[name], signal.SIGINT)
        for instant, name in sorted(again):
            time.sleep(max(0.0, began + instant - time.monotonic()))  # the instants are what is tried
            with suppress(ProcessLookupError):  # it has ended
                os.kill(nodes.processes[name], signal.SIGINT)
        assert nodes.end(signal.SIGINT) == dict.fromkeys(names, 0), nodes.logs()
    for log in logs.values():
        lines = log.read_text().splitlines()
        wrong = [line for line in lines if "Traceback" in line or "[ERROR]" in line]
        # The executor starts without control_msgs, and says so.
        assert not [line for line in wrong if "control_msgs is not installed" not in line], lines


def test_one_node_ends_and_is_started_again(warm: Warm, tmp_path: Path) -> None:
    with own_domain() as domain, Nodes(tmp_path, domain, warm.popen) as nodes:
        log = tmp_path / "simulator_node.log"
        for _ in range(2):
            nodes.start("simulator_node")
            assert wait(lambda: log.stat().st_size)
            pid = nodes.processes["simulator_node"]
            nodes.check()
            assert nodes.end_one("simulator_node") == 0 and not running(pid)
            assert not log.exists() and log.with_suffix(f".{pid}.log").stat().st_size
        assert nodes.processes == {} == nodes.end()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_nodes_are_ended_waits_and_is_not_lost(number: signal.Signals) -> None:
    outer = signal.signal(number, signal.default_int_handler)
    ended = False
    try:
        with pytest.raises(KeyboardInterrupt), processes.undisturbed():
            os.kill(os.getpid(), number)
            ended = True
        assert ended and signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, outer)


def test_a_module_that_is_none_is_refused() -> None:
    command = [sys.executable, "-m", "calib_planner.ros.processes", "../planner_node"]
    ended = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert ended.returncode == 1 and "usage" in ended.stderr and "Traceback" not in ended.stderr


def test_a_domain_is_given_to_one_at_a_time_and_only_if_nobody_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    def again() -> int:
        monkeypatch.setattr(processes, "_domains", itertools.repeat(domain - 1))
        with own_domain() as given:
            return given

    context = Context()
    with own_domain() as domain:
        with pytest.raises(CalibPlannerError, match="in use"):
            again()
        rclpy.init(args=[], context=context, domain_id=domain)
        node = Node("inhabitant", context=context)
    with pytest.raises(CalibPlannerError, match="in use"):
        again()
    node.destroy_node()
    rclpy.shutdown(context=context)
    assert again() == domain


def test_a_node_starts_without_what_it_does_not_need_at_once() -> None:
    """Pictures, reports and bags take longer to import than all the rest of a node."""
    # The page is made of reports.
    names = [name.removesuffix("_node") for name in node_names() if name != "page_node"]
    modules = ", ".join(f"calib_planner.ros.nodes.{name}" for name in names)
    late = ("matplotlib", "jinja2", "rosbags", "scipy.stats", "scipy.optimize", "calib_planner.report")
    program = f"import sys, {modules}; print(*(m for m in {late} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
