# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What doors, nodes and interfaces offer is what ``expected/`` says."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import pytest
from doors import doors
from golden import differences, kept, stored
from surface import interfaces, nodes, own_domain


def test_doors_offer_the_same() -> None:
    changed = list(differences(stored("doors"), doors()))
    assert not changed, "\n".join([*changed[:20], "intended? python test/golden/update.py doors"])


def test_interfaces_are_the_same() -> None:
    assert interfaces() == stored("interfaces")


@pytest.mark.ros
def test_nodes_offer_the_same(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2 (source env.sh)")
    expected = stored("nodes")
    found = list(islice(differences(expected, kept(nodes(own_domain(), tmp_path, expected))), 20))
    assert not found, "\n".join([*found, "intended? python test/golden/update.py nodes"])
