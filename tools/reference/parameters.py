# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/reference/parameters.md: the parameters of the nodes, from their dataclasses. Needs ROS."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, fields
from typing import Any

from markdown import MADE, code, escaped, joined, table

INTRODUCTION = """\
Every parameter of every node, as declared in `calib_planner/ros/settings.py`. A node refuses names that it does
not know and values of another type or out of range, at start as later, and says what would be valid. The same,
ready to be edited: `config/planner.yaml`, `config/identifier.yaml`, `config/simulator.yaml`,
`config/campaign.yaml`.

```text
source env.sh
planner_node --ros-args --params-file config/planner.yaml
ros2 param describe /calibration_planner sigma
```

*Fixed* is what cannot be changed after start; what is *taken at configure* can be changed before the lifecycle
transition of that name."""


def page() -> str:
    """The page."""
    from calib_planner.ros.settings import NODES

    lines = ["# Node parameters", "", MADE, "", INTRODUCTION]
    for name, (kind, node) in NODES.items():
        lines += ["", f"## {node}", "", f"Executable `{name}_node`.", ""]
        lines += table(("parameter", "default", "range", "meaning"), map(_row, fields(kind)), "parameters")
    return joined(lines)


def _row(item: Field[Any]) -> tuple[str, ...]:
    return code(item.name), _default(item), "; ".join(_range(item)) or "any text", _meaning(item)


def _default(item: Field[Any]) -> str:
    value = item.default
    shown = "[" + ", ".join(value) + "]" if isinstance(value, tuple) else str(value)
    if isinstance(value, bool):
        shown = shown.lower()
    return (code(shown) or "empty") + (f" {item.metadata['unit']}" if item.metadata["unit"] else "")


def _range(item: Field[Any]) -> Iterator[str]:
    data = item.metadata
    if data["low"] is not None:
        yield f"{data['low']:g} … {data['high']:.15g}"
    if data.get("choices"):
        yield ", ".join(code(c) for c in data["choices"])
    if isinstance(item.default, tuple):
        yield "list of texts"
    elif type(item.default) in (bool, int):
        yield {bool: "true, false", int: "whole"}[type(item.default)]


def _meaning(item: Field[Any]) -> str:
    from calib_planner.ros.parameters import taken_at_configure

    words = [escaped(item.metadata["description"])]
    if item.metadata.get("read_only"):
        words.append("*fixed*")
    if taken_at_configure(item):
        words.append("*taken at configure*")
    return "; ".join(words)
