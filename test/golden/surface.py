# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the nodes offer to ROS, seen from outside: parameters, topics, services, actions; and the interfaces.

The nodes run as processes, by the entry points of setup.py, on a ROS domain of their own, all at their defaults.
Nothing of this package is imported here, so that it may move.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from cases import ROOT
from golden import entry_points

MSG_DEFS = ROOT / "msg_defs"
NODES = {
    "planner_node": "calibration_planner",
    "identifier_node": "calibration_identifier",
    "simulator_node": "tracker_simulator",
    "campaign_node": "calibration_campaign",
}
"""Executable → node."""

PATIENCE = 60.0
"""Longest time until all nodes are active and seen [s]."""
STABLE = 2.0
"""What did not change for so long is settled [s]."""
ENDING = 15.0
"""Time a node has to end after SIGINT before it is killed [s]."""

CHILD = """
import os, signal, sys, threading
def follow():
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)
threading.Thread(target=follow, daemon=True).start()
sys.path.insert(0, sys.argv.pop(1))
from golden import load
sys.exit(load(sys.argv.pop(1))())
"""
"""Runs an entry point; ends when whoever started it is no more, since that closes its standard input."""


def interfaces() -> dict[str, list[str]]:
    """File below msg_defs → its lines without comments; constants and fields in their order."""
    files = sorted(p for kind in ("msg", "srv", "action") for p in (MSG_DEFS / kind).glob(f"*.{kind}"))
    return {str(p.relative_to(MSG_DEFS)): _lines(p.read_text()) for p in files}


def _lines(text: str) -> list[str]:
    bare = (" ".join(line.split("#")[0].split()) for line in text.splitlines())
    return [line for line in bare if line]


@contextmanager
def running(domain: int, folder: Path) -> Iterator[None]:
    """All nodes as processes; logs in ``folder``."""
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    here, targets = str(Path(__file__).parent), entry_points()
    with ExitStack() as stack:
        children = []
        for executable in NODES:
            log = stack.enter_context((folder / f"{executable}.log").open("wb"))
            command = [sys.executable, "-c", CHILD, here, targets[executable]]
            children.append(
                subprocess.Popen(
                    command,
                    cwd=ROOT,
                    env=environment,
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                )
            )
        try:
            yield
        finally:
            for child in children:
                child.send_signal(signal.SIGINT)
            for child in children:
                try:
                    child.wait(ENDING)
                except subprocess.TimeoutExpired:
                    child.kill()
                    child.wait()
                if child.stdin is not None:
                    child.stdin.close()


OPTIONAL = re.compile("/tf_static|/follow_joint_trajectory")
"""Names that nodes offer where ``tf2_msgs`` and ``control_msgs`` are installed: left out everywhere."""


class Watcher:
    """A node that asks the others what they offer."""

    def __init__(self, domain: int) -> None:
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node

        self._rclpy, self._context = rclpy, Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self._node = Node("golden_watcher", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._rclpy.shutdown(context=self._context)

    def active(self, name: str) -> bool:
        """Whether the lifecycle node is active."""
        from lifecycle_msgs.srv import GetState

        answer = self._ask(GetState, f"{name}/get_state", GetState.Request())
        return answer is not None and answer.current_state.label == "active"

    def parameters(self, name: str) -> dict[str, Any]:
        """Each parameter with type, value, ranges, choices and whether it is read-only."""
        from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
        from rclpy.parameter import parameter_value_to_python

        listed = self._ask(ListParameters, f"{name}/list_parameters", ListParameters.Request())
        names = sorted(listed.result.names)
        described = self._ask(
            DescribeParameters, f"{name}/describe_parameters", DescribeParameters.Request(names=names)
        )
        got = self._ask(GetParameters, f"{name}/get_parameters", GetParameters.Request(names=names))
        found = {}
        for item, value in zip(described.descriptors, got.values, strict=True):
            plain = parameter_value_to_python(value)
            choices = re.search(r"one of: ([^;]*)", item.additional_constraints)
            if OPTIONAL.search(item.name):
                continue
            found[item.name] = {
                "type": type(plain).__name__,
                "default": plain if isinstance(plain, (bool, int, float, str)) else list(plain),
                "read_only": item.read_only,
                "ranges": [
                    [r.from_value, r.to_value, r.step] for r in (*item.floating_point_range, *item.integer_range)
                ],
                "choices": choices[1].split(", ") if choices else [],
                "description": item.description,
                "additional_constraints": item.additional_constraints,
            }
        return found

    def surface(self, name: str) -> dict[str, Any]:
        """Topics with types and qualities of service, services, clients and actions of a node."""
        from rclpy.action import get_action_client_names_and_types_by_node as action_clients
        from rclpy.action import get_action_server_names_and_types_by_node as action_servers

        node, who = self._node, (name, "/")
        every = {
            "publishers": {
                topic: {"types": types, "qos": self._qos(node.get_publishers_info_by_topic(topic), name)}
                for topic, types in node.get_publisher_names_and_types_by_node(*who)
            },
            "subscriptions": {
                topic: {"types": types, "qos": self._qos(node.get_subscriptions_info_by_topic(topic), name)}
                for topic, types in node.get_subscriber_names_and_types_by_node(*who)
            },
            "services": dict(node.get_service_names_and_types_by_node(*who)),
            "clients": dict(node.get_client_names_and_types_by_node(*who)),
            "action_servers": dict(action_servers(node, *who)),
            "action_clients": dict(action_clients(node, *who)),
        }
        return {kind: {k: v for k, v in names.items() if not OPTIONAL.search(k)} for kind, names in every.items()}

    def _qos(self, endpoints: Sequence[Any], name: str) -> list[str]:
        """Of the node's ends of a topic. How deep a queue is stays on its side; see parameters qos_overrides."""
        mine = [e.qos_profile for e in endpoints if e.node_name == name]
        return sorted(f"{q.reliability.name} {q.durability.name}" for q in mine)

    def _ask(self, kind: Any, service: str, request: Any, seconds: float = 5.0) -> Any:
        """The answer, or ``None`` if there is none in time."""
        client = self._node.create_client(kind, service)
        try:
            deadline = time.monotonic() + seconds
            while not client.service_is_ready():
                if time.monotonic() > deadline:
                    return None
                self._executor.spin_once(0.05)
            future = client.call_async(request)
            self._executor.spin_until_future_complete(future, seconds)
            return future.result() if future.done() else None
        finally:
            self._node.destroy_client(client)


def nodes(domain: int, folder: Path, expected: Any = None) -> dict[str, Any]:
    """What all nodes offer, once it is as expected or has settled.

    Args:
        domain: ROS domain id, of nobody else.
        folder: Gets the nodes' logs.
        expected: Discovery takes its time: what is equal to this needs no more waiting.
    """
    with running(domain, folder):
        watcher = Watcher(domain)
        try:
            deadline = time.monotonic() + PATIENCE
            for name in NODES.values():
                while not watcher.active(name):
                    if time.monotonic() > deadline:
                        logs = "\n".join(p.read_text(errors="replace")[-2000:] for p in folder.glob("*.log"))
                        raise AssertionError(f"{name} is not active after {PATIENCE} s:\n{logs}")
            found = {name: {"parameters": watcher.parameters(name)} for name in NODES.values()}
            before: Any = None
            since = time.monotonic()
            while True:
                now = {name: watcher.surface(name) for name in NODES.values()}
                if expected is not None and all(now[n] == _topics(expected.get(n, {})) for n in now):
                    break
                if now != before:
                    before, since = now, time.monotonic()
                elif time.monotonic() - since > STABLE:
                    break
                time.sleep(0.1)
            return {name: found[name] | now[name] for name in found}
        finally:
            watcher.close()


def _topics(surface: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in surface.items() if k != "parameters"}


def own_domain() -> int:
    """A ROS domain id between 215 and 231: free of ephemeral ports, and no other test here uses these."""
    return 215 + os.getpid() % 17


def settled_nodes() -> dict[str, Any]:
    """What all nodes offer, for ``update``."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        return nodes(own_domain(), Path(folder))
