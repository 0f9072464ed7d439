# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Stores killed at system calls, on full disks and after power cuts; ``make prove`` disturbs at every call."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from robots import repeats

BENCH = Path(__file__).parents[2] / "bench" / "crashes.py"


@pytest.mark.skipif(sys.platform != "linux" or shutil.which("cc") is None, reason="needs Linux and a C compiler")
def test_nothing_acknowledged_is_lost_at_any_system_call() -> None:
    options = ["--every", str(repeats(40, 1)), "--draws", str(repeats(2, 4))]
    done = subprocess.run([sys.executable, str(BENCH), *options], capture_output=True, text=True)
    programs = json.loads(done.stdout)["programs"]
    assert set(programs) == {"session", "campaign", "journal", "file"}
    assert [p["wrong"] for p in programs.values()] == [[]] * 4 and done.returncode == 0, done.stderr
    assert all(p["calls"] >= p["steps"] > 1 for p in programs.values())
    assert set().union(*(p["runs"] for p in programs.values())) == {"killed", "full", "cut"}
    assert sum(p["refused"] for p in programs.values()) > 0
