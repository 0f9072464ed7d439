"""Which geometric parameters a robot has, and how a request names them.

A request is a level — ``offsets``, ``lengths``, ``lengths+offsets`` (the paper's), ``full`` (six placement
errors per joint) — or a list of names; ``unknown`` adds the pose of the base in the tracker's frame and the
target offsets. Order: base, then chain, then targets for levels; a list keeps the order it came in.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from calib_planner.errors import FileFormatError, InputError, UnknownNameError

UNKNOWNS = ("base", "tool")
BASE_PARAMETERS = ("base.x", "base.y", "base.z", "base.rx", "base.ry", "base.rz")


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
    before, after = [], []
    for word in (w.strip() for w in unknown):
        if word == "base":
            before = list(BASE_PARAMETERS)
        elif word == "tool":
            after = [f"target_{t + 1}.{a}" for t in range(target_count) for a in "xyz"]
        else:
            raise UnknownNameError("unknown", word, UNKNOWNS)
    names = [n for n in before if n not in chosen] + chosen + [n for n in after if n not in chosen]
    doubled = sorted({n for n in names if names.count(n) > 1})
    if doubled:
        raise InputError("parameters", ", ".join(doubled), "each parameter at most once")
    if not names:
        raise InputError("parameters", "nothing", "at least one parameter", f"levels: {', '.join(levels)}")
    return tuple(names)


# ── Joint names from files: what they may be, since the names of parameters are made of them ────────────────

RESERVED = re.compile(r"base|target_[0-9]+")
"""Prefixes of the parameters that place base and targets."""


def check_joint_names(path: object, names: Sequence[str]) -> None:
    """Refuse names that would give two parameters one name, or that no list of names could hold.

    Raises:
        FileFormatError: Naming the joint.
    """
    for name in names:
        where = f"joint {name!r}"
        if list(names).count(name) > 1:
            raise FileFormatError(path, where, "this name twice", "each name once", "rename one of them")
        if RESERVED.fullmatch(name):
            expected = "a name other than base and target_1, target_2, …"
            raise FileFormatError(
                path, where, "a name that base or target parameters have", expected, "rename it"
            )
        if not name.strip() or "," in name or name != name.strip():
            raise FileFormatError(path, where, repr(name), "a name without commas and outer spaces", "rename it")
