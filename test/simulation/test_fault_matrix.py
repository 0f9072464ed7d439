# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Some of bench/fault_matrix.py: campaigns with faults end with the truth or with an honest verdict."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from robots import repeats

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "bench"))
import fault_matrix

RIGHT = ["none", "swing_1mm", "outliers_2%", "beam_breaks", "dropouts_30%", "latency", "duplicates_reordered"]
HONEST = ["creep_0.2mm", "outlier_standstills_10%", "clock_-0.3s", "clock_+1s", "rough"]


@pytest.mark.parametrize("seed", repeats([100], [100, 101]))
@pytest.mark.parametrize("fault", RIGHT)
def test_harmless_faults_cost_standstills_at_most(fault: str, seed: int) -> None:
    run = fault_matrix.run("known", fault, seed)
    assert run.verdict in ("PASS", "WARN") and run.worst <= 4.0
    assert run.accepted >= 12 and run.accepted + sum(run.rejected.values()) >= 24


@pytest.mark.parametrize("seed", repeats([100], [100, 101]))
@pytest.mark.parametrize("fault", HONEST)
def test_harmful_faults_are_said(fault: str, seed: int) -> None:
    run = fault_matrix.run("known", fault, seed)
    assert not run.wrong
    assert run.verdict != "refused" or run.reasons
