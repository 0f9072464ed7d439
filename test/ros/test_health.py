# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Every node says on /diagnostics how it is, in every state, and what to do where something is missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import pytest
from bench import Bench
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition

from calib_planner.ros.parameters import EVENTS
from calib_planner.ros.settings import NODES

OWN: dict[str, dict[str, Any]] = {"page": {"port": 0}}
"""Part → parameters of its test."""
PARTS = {
    "planner": {"robot", "search"},
    "identifier": {"campaign", "estimate", "store", "stream joint_states", "stream tracker/point"},
    "simulator": {"robot"},
    "campaign": {"campaign"},
    "executor": {"controller", "execution"},
    "page": {"page"},
}
"""Part → what it says besides how the node is, once it is configured."""


def kind_of(part: str) -> Any:
    if part == "page":
        pytest.importorskip("aiohttp")
    module = import_module(f"calib_planner.ros.nodes.{part}")
    return getattr(module, f"{part.capitalize()}Node")


def newest(heard: list[DiagnosticArray], name: str) -> dict[str, DiagnosticStatus]:
    """Part → status, of the newest message of a node."""
    own = [m for m in heard if m.status and m.status[0].name == f"{name}: node"]
    return {s.name.removeprefix(f"{name}: "): s for s in own[-1].status} if own else {}


@pytest.mark.parametrize("part", NODES)
def test_a_node_says_in_every_state_how_it_is(bench: Bench, part: str) -> None:
    kind, name = kind_of(part), NODES[part][1]
    heard = bench.hear(DiagnosticArray, "/diagnostics", EVENTS)
    bench.start(kind, autostart=False, diagnostics_period=0.05, robot="planar_2r", **OWN.get(part, {}))

    def says(level: bytes, words: str) -> dict[str, DiagnosticStatus]:
        def is_said() -> bool:
            own = newest(heard, name).get("node")
            return own is not None and own.level == level and words in own.message

        bench.wait(is_said)
        return newest(heard, name)

    assert set(says(DiagnosticStatus.WARN, f"ros2 lifecycle set /{name} configure, and activate")) == {"node"}
    assert bench.change_state(name, Transition.TRANSITION_CONFIGURE)
    says(DiagnosticStatus.WARN, f"ros2 lifecycle set /{name} activate")
    assert bench.change_state(name, Transition.TRANSITION_ACTIVATE)
    found = says(DiagnosticStatus.OK, "active")
    assert set(found) == {"node", *PARTS[part]}
    assert all(s.message for s in found.values()) and {s.hardware_id for s in found.values()} == {"planar_2r"}


@pytest.mark.parametrize("part", NODES)
def test_a_node_that_cannot_be_configured_says_why(bench: Bench, part: str) -> None:
    name = NODES[part][1]
    heard = bench.hear(DiagnosticArray, "/diagnostics", EVENTS)
    bench.start(kind_of(part), diagnostics_period=0.05, cell="/none/cell.yaml", **OWN.get(part, {}))
    bench.wait(lambda: newest(heard, name).get("node", DiagnosticStatus()).level == DiagnosticStatus.ERROR)
    said = newest(heard, name)["node"].message
    assert "/none/cell.yaml" in said and f"remedy it, then: ros2 lifecycle set /{name} configure" in said
