# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Some of bench/faults_nodes.py: campaigns with faults through the nodes, on a clock that waits for them."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from robots import repeats

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "bench"))
import faults_nodes

SAMPLE = ["beam_breaks", "reseat_0.03mm"]
SEED = 100
"""The bench begins at 0."""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    """The campaign with a fault, measured once for all tests, or for a second time."""

    @functools.cache
    def measured(fault: str, again: bool = False) -> Any:
        return faults_nodes.run(fault, SEED, tmp_path_factory.mktemp("campaign"))

    return measured


@pytest.mark.parametrize("fault", repeats(SAMPLE, list(faults_nodes.cases())))
def test_no_campaign_with_a_fault_is_wrong_lost_or_hung(fault: str, campaign: Callable[..., Any]) -> None:
    found = campaign(fault)
    assert found.end in ("PASS", "WARN", "FAIL"), found
    assert found.measured >= 4 and found.validated == 4


def test_the_same_seed_gives_the_same_campaign(campaign: Callable[..., Any]) -> None:
    one, other = campaign("beam_breaks"), campaign("beam_breaks", again=True)
    assert one.end == other.end == "PASS"
    assert (one.worst, one.at_pose, one.told) == (other.worst, other.at_pose, other.told)
