# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Doors whose names are imported when they are first used, so that a program pays only for what it needs.

A room's ``__init__`` lists its names twice: under ``TYPE_CHECKING`` as imports, for type checkers and editors,
and in a table, for programs:

    __getattr__, __dir__, __all__ = lazy_door(__name__, {"csv": "read_data write_measurements"})
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_door(
    room: str, files: Mapping[str, str], *eager: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """The ``__getattr__``, ``__dir__`` and ``__all__`` of a room.

    Args:
        room: Its full name.
        files: File or room below → names that it offers, separated by spaces.
        eager: Names that the door has already.
    """
    file_of = {name: file for file, names in files.items() for name in names.split()}
    every = sorted([*file_of, *eager])

    def get(name: str) -> Any:
        if name not in file_of:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        value = getattr(import_module(f"{room}.{file_of[name]}"), name)
        setattr(sys.modules[room], name, value)
        return value

    return get, lambda: sorted({*vars(sys.modules[room]), *every}), every
