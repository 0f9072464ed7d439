# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Makes ``robots`` and the tools importable from every test folder; the nodes' tests, which wait, come first.

What is imported and collected stays for the whole run: Python's collector of garbage does not look through it
again and again, which took a twentieth of the processor time.
"""

import gc
import os
import signal
import sys
import threading
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
pytest_plugins = ["processor_time"]

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    # A shell that starts us in the background has SIGINT ignored, and every process of a test would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)


LONG = ("test_docs.py", "test_golden.py", "test_robust.py", "test_campaign.py", "test_reproduction.py")
"""Files of half a minute each: if one of them came last, one process would work on it while others are done."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One process more than there are cores: the nodes' tests wait half of their time."""
    return len(os.sched_getaffinity(0)) + 1


def pytest_collection() -> None:
    gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: (item.path.parent.name != "ros", item.path.name not in LONG))
