# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What Python programs may import: the names of all doors, with arguments, as docs/api-policy.md says."""

from __future__ import annotations

import inspect
from importlib import import_module
from types import ModuleType
from typing import Any

ROOMS = "robot tracker error_model acquisition planning identification compensation campaign simulation io report"


def doors() -> dict[str, dict[str, Any]]:
    """Door → name → its arguments, those with a default marked; empty for what cannot be called."""
    every = ("calib_planner", *(f"calib_planner.{room}" for room in ROOMS.split()))
    return {door: _offered(import_module(door)) for door in every}


def _offered(door: ModuleType) -> dict[str, Any]:
    there = {n: v for n, v in vars(door).items() if not n.startswith("_") and not inspect.ismodule(v)}
    own = [n for n, v in there.items() if getattr(v, "__module__", None) in (None, "builtins") or _ours(v)]
    names = sorted({*own, *getattr(door, "__all__", ())} - {"TYPE_CHECKING", "lazy_door"})
    return {name: _arguments(getattr(door, name)) for name in names}


def _ours(value: Any) -> bool:
    return str(value.__module__).startswith("calib_planner")


def _arguments(value: object) -> str:
    if not callable(value):
        return ""
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):
        return ""
    marks = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}
    return ", ".join(
        marks.get(p.kind, "") + p.name + ("=…" if p.default is not p.empty else "") for p in parameters
    )
