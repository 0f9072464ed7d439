# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Reads an SROS2 policy file, and refuses one that is not of the form that ``ros2 security`` takes (0.2.0)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

VERBS = {
    "topics": ("topic", {"publish", "subscribe"}),
    "services": ("service", {"reply", "request"}),
    "actions": ("action", {"execute", "call"}),
}
FORM = {"policy": "enclaves", "enclaves": "enclave", "enclave": "profiles", "profiles": "profile"}
ATTRIBUTES = {"policy": {"version"}, "enclave": {"path"}, "profile": {"ns", "node"}}


@dataclass(frozen=True)
class Profile:
    """What a node may do: names as written, by verb (publish, subscribe, reply, request, execute, call)."""

    enclave: str
    namespace: str
    node: str
    allowed: dict[str, list[str]]

    def full(self, verb: str) -> set[str]:
        """Names with their namespace, as on the graph."""
        base = self.namespace.rstrip("/")
        whole = {"/": lambda n: n, "~": lambda n: f"{base}/{self.node}{n[1:]}"}
        return {whole.get(n[0], lambda n: f"{base}/{n}")(n) for n in self.allowed.get(verb, [])}


def read_policy(path: Path) -> list[Profile]:
    """The profiles of a file.

    Raises:
        ValueError: Not a policy; the text says where.
    """
    root = ET.parse(path).getroot()
    _check(root, "policy")
    if root.get("version") != "0.2.0":
        raise ValueError(f"version {root.get('version')}, not 0.2.0")
    enclaves = root.findall("enclaves/enclave")
    return [_profile(e.get("path", ""), p) for e in enclaves for p in e.findall("profiles/profile")]


def _check(element: ET.Element, tag: str) -> None:
    expected = ATTRIBUTES.get(tag, set())
    if element.tag != tag or set(element.attrib) != expected or not len(element):
        raise ValueError(f"<{element.tag} {element.attrib}>: not a <{tag}> with {sorted(expected)} and contents")
    if tag in FORM:
        for child in element:
            _check(child, FORM[tag])


def _profile(enclave: str, element: ET.Element) -> Profile:
    allowed: dict[str, list[str]] = {}
    for group in element:
        kind, verbs = VERBS.get(group.tag, ("", set()))
        if not group.attrib or not set(group.attrib) <= verbs or set(group.attrib.values()) != {"ALLOW"}:
            raise ValueError(f"<{group.tag} {group.attrib}>")
        names = [(child.text or "").strip() for child in group]
        if not names or any(child.tag != kind or child.attrib or len(child) for child in group):
            raise ValueError(f"<{group.tag}> with {[child.tag for child in group]}")
        for verb in group.attrib:
            if verb in allowed:
                raise ValueError(f"{verb} is there twice")
            allowed[verb] = names
    return Profile(enclave, element.get("ns", ""), element.get("node", ""), allowed)
