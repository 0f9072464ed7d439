# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The SROS2 policy allows each node exactly what it does on the graph, by relative names."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import pytest
from bench import Bench
from policy import Profile, read_policy
from rclpy.action import get_action_client_names_and_types_by_node, get_action_server_names_and_types_by_node
from rclpy.node import Node

from calib_planner.io import config_folder
from calib_planner.ros.nodes.campaign import CampaignNode
from calib_planner.ros.nodes.executor import ExecutorNode
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.nodes.page import PageNode
from calib_planner.ros.nodes.planner import PlannerNode
from calib_planner.ros.nodes.simulator import SimulatorNode
from calib_planner.ros.ways import FollowJointTrajectory

FILE = config_folder() / "sros2" / "calib_planner.policy.xml"
ABSOLUTE = {"/clock", "/diagnostics", "/parameter_events", "/rosout", "/tf_static"}
NODES = {
    "/calib_planner/planner": PlannerNode,
    "/calib_planner/identifier": IdentifierNode,
    "/calib_planner/simulator": SimulatorNode,
    "/calib_planner/campaign": CampaignNode,
    "/calib_planner/page": PageNode,
    "/calib_planner/executor": ExecutorNode,
}


@pytest.fixture(scope="module")
def profiles() -> dict[str, Profile]:
    return {p.enclave: p for p in read_policy(FILE)}


def test_every_node_has_a_profile(profiles: dict[str, Profile]) -> None:
    modules = Path(SimulatorNode.__init__.__code__.co_filename).parent.glob("[a-z]*.py")
    assert sorted(profiles) == sorted(f"/calib_planner/{p.stem}" for p in modules)
    assert len({p.node for p in profiles.values()}) == len(profiles)


def test_names_are_relative_and_valid(profiles: dict[str, Profile]) -> None:
    for profile in profiles.values():
        for verb, names in profile.allowed.items():
            assert len(set(names)) == len(names), (profile.node, verb)
            for name in names:
                assert name in ABSOLUTE or re.fullmatch(r"(~/)?[a-z_]+(/[a-z_]+)*", name), name


@pytest.mark.parametrize("enclave", NODES)
def test_it_allows_what_the_node_does_and_no_more(
    bench: Bench, profiles: dict[str, Profile], enclave: str
) -> None:
    node = bench.start(NODES[enclave], use_sim_time=True)
    profile = profiles[enclave]
    assert not node.failure and (node.get_name(), node.get_namespace()) == (profile.node, profile.namespace)
    done = doings(node)
    for verb in ("publish", "subscribe", "reply", "request", "execute", "call"):
        optional = set() if FollowJointTrajectory else {"/joint_trajectory_controller/follow_joint_trajectory"}
        optional |= set() if find_spec("tf2_msgs") else {"/tf_static"}
        assert profile.full(verb) - optional == done[verb], (verb, profile.full(verb) ^ done[verb])


def doings(node: Node) -> dict[str, set[str]]:
    """What the graph says of a node, by verb; the topics and services of an action are the action's."""
    who = node.get_name(), node.get_namespace()
    found = {
        "publish": node.get_publisher_names_and_types_by_node(*who),
        "subscribe": node.get_subscriber_names_and_types_by_node(*who),
        "reply": node.get_service_names_and_types_by_node(*who),
        "request": node.get_client_names_and_types_by_node(*who),
        "execute": get_action_server_names_and_types_by_node(node, *who),
        "call": get_action_client_names_and_types_by_node(node, *who),
    }
    return {verb: {name for name, _ in pairs if "/_action/" not in name} for verb, pairs in found.items()}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('version="0.2.0"', 'version="0.1.0"'),
        ("enclaves>", "contexts>"),
        ('publish="ALLOW"', 'publish="YES"'),
        ('reply="ALLOW"', 'answer="ALLOW"'),
        ("topic>", "name>"),
        (' node="tracker_simulator"', ""),
    ],
)
def test_the_checker_finds_what_is_wrong(tmp_path: Path, old: str, new: str) -> None:
    text, broken = FILE.read_text(), tmp_path / "broken.xml"
    assert old in text
    broken.write_text(text.replace(old, new))
    with pytest.raises(ValueError):
        read_policy(broken)
