# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Tests of the nodes: left out without ROS, on a ROS domain of their own, a fresh context per test."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

try:
    import rclpy  # noqa: F401
except ImportError as missing:
    # A skip raised here would end pytest when this folder is named on its command line.
    REASON = f"test/ros is left out, it needs ROS 2 (source env.sh): {missing}"
    collect_ignore_glob = ["test_*.py"]
else:
    REASON = ""
    if os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") == "rmw_fastrtps_cpp":
        # On this machine, without Fast DDS's shared memory: a node that is killed while it makes a piece of it
        # has every participant of the machine wait for ever. With LOCALHOST, rmw_fastrtps adds it itself.
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(Path(__file__).parents[2] / "bench" / "loopback.xml")
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
    else:
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.pop("ROS_LOCALHOST_ONLY", None)
    sys.path.insert(0, str(Path(__file__).parent))
    from bench import Bench
    from warm_processes import Warm

    @pytest.fixture(scope="session")
    def warm() -> Iterator[Warm]:
        with Warm() as made:
            yield made

    @pytest.fixture
    def bench() -> Iterator[Bench]:
        with Bench() as made:
            yield made


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if REASON:
        terminalreporter.write_line(REASON, yellow=True)
