# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Which geometric parameters a robot has, what each is about, and how a request names them.

A request is a level — ``offsets``, ``lengths``, ``lengths+offsets`` (the paper's), ``full`` (six placement
errors per joint) — or a list of names; ``unknown`` adds the pose of the base in the tracker's frame and the
target offsets. Order: base, then chain, then targets for levels; a list keeps the order it came in.

Every parameter has one of three roles, and its name tells it: ``base`` (``base.x … base.rz``, the pose of the
base in the tracker's frame), ``target`` (``target_1.x …``, the place of a reflector on the tool), ``chain`` (the
robot itself). Base and target belong to the measuring setup: they are nuisance parameters.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from calib_planner.errors import FileFormatError, InputError, UnknownNameError

BASE, TARGET, CHAIN = "base", "target", "chain"
"""The roles of parameters."""
UNKNOWNS = ("base", "tool")
BASE_PARAMETERS = ("base.x", "base.y", "base.z", "base.rx", "base.ry", "base.rz")
SETUP = re.compile(r"base|target_[0-9]+")
"""Prefixes of the parameters that place base and targets; no joint may be called so."""


def role_of(name: str) -> str:
    """The role of the parameter of that name: ``base``, ``target`` or ``chain``."""
    prefix = name.partition(".")[0]
    if not SETUP.fullmatch(prefix):
        return CHAIN
    return BASE if prefix == BASE else TARGET


def is_nuisance(name: str) -> bool:
    """Whether the parameter of that name places base or targets rather than being the robot's."""
    return role_of(name) != CHAIN


def target_parameters(count: int) -> tuple[str, ...]:
    """Names of the parameters of ``count`` targets: ``target_1.x``, ``target_1.y``, …"""
    return tuple(f"target_{t}.{axis}" for t in range(1, count + 1) for axis in "xyz")


def grouped(names: Iterable[str]) -> list[str]:
    """Parameter names with ``base.x, base.y, …`` as ``base.*``, targets likewise; other names as they are."""
    return list(dict.fromkeys(n.partition(".")[0] + ".*" if is_nuisance(n) else n for n in names))


@dataclass(frozen=True)
class Parameter:
    """One named geometric parameter.

    Attributes:
        name: Its name, unique in the robot.
        unit: ``m`` or ``rad``.
        nominal: Nominal value [unit].
        element: Flat index of the element that carries it.
    """

    name: str
    unit: str
    nominal: float
    element: int

    @property
    def role(self) -> str:
        """``base``, ``target`` or ``chain``."""
        return role_of(self.name)


def resolve_parameters(
    request: str | Sequence[str],
    unknown: Iterable[str],
    available: Sequence[str],
    levels: Mapping[str, Sequence[str]],
    target_count: int,
) -> tuple[str, ...]:
    """Turn a request into parameter names.

    Raises:
        UnknownNameError: For a name that is neither a level nor a parameter of the robot.
        InputError: For an empty request or a name given twice.
    """
    words = request.split(",") if isinstance(request, str) else list(request)
    chosen: list[str] = []
    for word in (w.strip() for w in words):
        if word in levels:
            chosen += levels[word]
        elif word in available:
            chosen.append(word)
        else:
            raise UnknownNameError("parameters", word, [*levels, *available])
    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    for word in (w.strip() for w in unknown):
        if word == "base":
            before = BASE_PARAMETERS
        elif word == "tool":
            after = target_parameters(target_count)
        else:
            raise UnknownNameError("unknown", word, UNKNOWNS)
    names = [n for n in before if n not in chosen] + chosen + [n for n in after if n not in chosen]
    doubled = sorted({n for n in names if names.count(n) > 1})
    if doubled:
        raise InputError("parameters", ", ".join(doubled), "each parameter at most once")
    if not names:
        raise InputError("parameters", "nothing", "at least one parameter", f"levels: {', '.join(levels)}")
    return tuple(names)


def check_joint_names(path: object, names: Sequence[str]) -> None:
    """Refuse joint names that would give two parameters one name, or that no list of names could hold.

    Raises:
        FileFormatError: Naming the joint.
    """
    for name in names:
        where = f"joint {name!r}"
        if list(names).count(name) > 1:
            raise FileFormatError(path, where, "this name twice", "each name once", "rename one of them")
        if SETUP.fullmatch(name):
            expected = "a name other than base and target_1, target_2, …"
            raise FileFormatError(
                path, where, "a name that base or target parameters have", expected, "rename it"
            )
        if not name.strip() or "," in name or name != name.strip():
            raise FileFormatError(path, where, repr(name), "a name without commas and outer spaces", "rename it")
