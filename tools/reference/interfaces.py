# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/reference/interfaces.md: what the nodes offer and take, and every message, service and action. Needs ROS.

The nodes are made and activated, and asked for their publishers, subscriptions, services and actions; the
interfaces are read from their text, with the comments.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from markdown import MADE, code, escaped, joined, table

DEFINITIONS = Path(__file__).resolve().parents[2] / "msg_defs"
KINDS = {"msg": ("Messages", ("",)), "srv": ("Services", ("Request", "Response"))}
KINDS["action"] = ("Actions", ("Goal", "Result", "Feedback"))
LINE = re.compile(r"^(?P<type>[\w/\[\]<=]+)\s+(?P<name>\w+)\s*(?:=\s*(?P<value>\S+))?\s*(?:#\s*(?P<text>.*))?$")

INTRODUCTION = """\
What the nodes offer and take with their default parameters, and every field of package `calib_planner_msgs` with
its unit. Names without a leading `/` are relative; `~` is the node's name. *Latched* (transient local): a late
joiner gets the newest. Left out are parameter services, logging, and what
[lifecycle nodes](https://design.ros2.org/articles/node_lifecycle.html) have. The quality of service of our topics
can be overridden by parameters `qos_overrides.TOPIC.publisher.…`."""

LEFT_OUT = re.compile(
    r"rosout|parameter_events|transition_event|_state$|_states$|_transitions$|_graph$|"
    r"get_type_description|/(get|set|describe|list)_parameter|set_parameters_atomically"
)
KEPT = "joint_states"
DOMAIN = 187
"""Away from nodes that run on this machine."""
NAMESPACE = "/cell"
"""Where the nodes are asked, so that relative names can be told from absolute ones."""


def page() -> str:
    """The page."""
    lines = ["# ROS 2 interfaces", "", MADE, "", INTRODUCTION, ""]
    for name, rows in nodes().items():
        lines += [f"## {name}", "", *table(("name", "what", "type", "quality"), rows)]
    for folder, (title, parts) in KINDS.items():
        lines += [f"## {title}", ""]
        for path in sorted((DEFINITIONS / folder).iterdir()):
            lines += _interface(path, parts)
    return joined(lines)


# ---- the nodes -----------------------------------------------------------------------------------
def nodes() -> dict[str, list[tuple[str, ...]]]:
    """Node name → rows (name, kind, type, quality of service) of all that it offers and takes."""
    from rclpy.context import Context

    from calib_planner.ros.nodes.campaign import CampaignNode
    from calib_planner.ros.nodes.executor import ExecutorNode
    from calib_planner.ros.nodes.identifier import IdentifierNode
    from calib_planner.ros.nodes.planner import PlannerNode
    from calib_planner.ros.nodes.simulator import SimulatorNode

    context = Context()
    context.init(args=["--ros-args", "-r", f"__ns:={NAMESPACE}"], domain_id=DOMAIN)
    found = {}
    try:
        for kind in (PlannerNode, IdentifierNode, ExecutorNode, SimulatorNode, CampaignNode):
            node = kind(context=context)
            node.trigger_configure()
            node.trigger_activate()
            found[node.get_name()] = sorted(set(_ends(node)), key=lambda row: (_ORDER.index(row[1]), row[0]))
            node.trigger_deactivate()
            node.destroy_node()
    finally:
        context.try_shutdown()
    return found


_ORDER = ("offers action", "offers service", "publishes", "hears", "calls")


def _ends(node: Any) -> Iterator[tuple[str, ...]]:
    from rclpy.action import get_action_server_names_and_types_by_node

    own = f"{NAMESPACE}/{node.get_name()}/"
    for words, ends in (("publishes", node.publishers), ("hears", node.subscriptions)):
        for end in ends:
            topic = getattr(end, "topic_name", None) or end.topic
            yield from _end(own, topic, words, end.msg_type, _quality(end.qos_profile))
    for words, services in (("offers service", node.services), ("calls", node.clients)):
        for service in services:
            yield from _end(own, getattr(service, "service_name", service.srv_name), words, service.srv_type)
    for name, kinds in get_action_server_names_and_types_by_node(node, node.get_name(), NAMESPACE):
        if not kinds[0].startswith("control_msgs/"):  # optional: the page is the same with and without it
            yield code(_short(own, name)), "offers action", code(kinds[0].replace("/action/", "/")), ""


def _end(own: str, name: str, words: str, kind: Any, quality: str = "") -> Iterator[tuple[str, ...]]:
    if _short(own, name) == KEPT or not LEFT_OUT.search(name):
        package = kind.__module__.split(".")[0]
        yield code(_short(own, name)), words, code(f"{package}/{kind.__name__}"), quality


def _short(own: str, name: str) -> str:
    return "~/" + name.removeprefix(own) if name.startswith(own) else name.removeprefix(f"{NAMESPACE}/")


def _quality(profile: Any) -> str:
    words = ["latched"] if profile.durability.name == "TRANSIENT_LOCAL" else []
    return ", ".join([*words, profile.reliability.name.lower().replace("_", " "), f"depth {profile.depth}"])


# ---- the definitions -----------------------------------------------------------------------------
def _interface(path: Path, parts: tuple[str, ...]) -> Iterator[str]:
    text = path.read_text(encoding="utf-8")
    yield from (f"### {path.stem}", "")
    for part, block in zip(parts, re.split(r"^---$", text, flags=re.MULTILINE), strict=True):
        words, constants, fields = parsed(block)
        yield from (escaped(words), "", f"**{part}**" if part else "", "")
        yield from table(("constant", "value", "meaning"), constants)
        yield from table(("field", "type", "meaning"), fields)


def parsed(block: str) -> tuple[str, list[tuple[str, ...]], list[tuple[str, ...]]]:
    """A part of a definition: its comment, rows (constant, value, meaning) and (field, type, meaning).

    Raises:
        ValueError: A line that is none of these.
    """
    words: list[str] = []
    paragraph = True
    constants: list[tuple[str, ...]] = []
    fields: list[tuple[str, ...]] = []
    last = fields
    for line in block.strip().splitlines():
        if not line:
            paragraph = True
        elif line.startswith("#"):
            begun = "" if paragraph else f"{words.pop()} "
            words.append(begun + line.lstrip("# "))
            paragraph = False
        elif line.lstrip().startswith("#"):  # a comment that goes on
            last[-1] = (*last[-1][:2], f"{last[-1][2]} {escaped(line.lstrip('# '))}")
        elif match := LINE.match(line):
            last = constants if match["value"] else fields
            second = match["value"] or match["type"]
            last.append((code(match["name"]), code(second), escaped(match["text"] or "")))
        else:
            raise ValueError(f"not a field, constant or comment: {line!r}")
    return "\n\n".join(words), constants, fields
