# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Makes ``robots`` and the tools importable from every test folder; and mixes tests that wait with others.

What is imported and collected stays for the whole run: Python's collector of garbage does not look through it
again and again, which took a twentieth of the processor time, and it looks less often than usual for what is new,
which took another fiftieth.
"""

import gc
import os
import random
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


LONG = (
    *("test_docs.py", "test_golden.py", "test_robust.py", "test_campaign.py", "test_reproduction.py"),
    *("test_campaign_node.py", "test_hostile_peer.py", "test_page_node.py", "test_campaign_goes_on.py"),
)
"""Files of half a minute each: if one of them came last, one process would work on it while others are done."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One process more than there are cores: the nodes' tests wait half of their time."""
    return len(os.sched_getaffinity(0)) + 1


def pytest_collection() -> None:
    gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)  # tests leave little garbage in cycles
    gc.enable()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--shuffle", type=int, metavar="SEED", help="files, and tests in a file, in random order")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files with nodes, which wait, evenly among the others, so that no core waits; the long ones first."""
    paths = list(dict.fromkeys(item.path for item in items))
    seed = config.getoption("shuffle")
    if seed is not None:
        draw = random.Random(seed)
        draw.shuffle(paths)
        draw.shuffle(items)
        items.sort(key=lambda item: paths.index(item.path))
        return
    place: dict[Path, float] = {}
    for nodes in (True, False):
        some = sorted((p for p in paths if (p.parent.name == "ros") == nodes), key=lambda p: p.name not in LONG)
        place |= {path: k / len(some) for k, path in enumerate(some)}
    items.sort(key=lambda item: (place[item.path], item.path))
