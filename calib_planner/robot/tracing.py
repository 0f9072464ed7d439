"""The chain with symbols in place of numbers: what forward kinematics and its derivatives are made of.

A symbol is a signed reference to a node; a node is an operation on earlier nodes, a scalar (the constant part of
an amount) or a vector (a joint's coordinates over many configurations). Equal operations become one node,
products with 0 and ±1 vanish. ``trace`` walks a chain once and names the nodes of everything asked for; the
derivation is in ``program``, which turns them into array operations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_planner.robot.elements import Element

GENERAL = -1
"""Structure code of an amount that may be any number; 0..3 are exact quarter turns, 0 also zero length."""


@dataclass(frozen=True)
class Structure:
    """What the compiler needs to know of a chain; hashable, so that programs can be shared.

    Attributes:
        trunk: Elements up to the tip, as ``(kind, joint, sign, code)``.
        branches: The same for each target, from the tip to the target.
        columns: Flat element indices whose columns are wanted (trunk first, then branch after branch).
        axes: Flat element indices whose axes are wanted.
        origins: Trunk element indices whose origins are wanted, as they are behind the element.
    """

    trunk: tuple[tuple[str, int | None, float, int], ...]
    branches: tuple[tuple[tuple[str, int | None, float, int], ...], ...]
    columns: tuple[int, ...]
    axes: tuple[int, ...]
    origins: tuple[int, ...] = ()


def structure_of(
    trunk: Sequence[Element],
    branches: Sequence[Sequence[Element]],
    codes: Sequence[int],
    columns: Sequence[int],
    axes: Sequence[int],
    origins: Sequence[int] = (),
) -> Structure:
    """Describe the chain, given the code of each constant amount (flat order)."""
    elements = [*trunk, *(e for branch in branches for e in branch)]
    coded = [(e.kind, e.joint, e.sign, code) for e, code in zip(elements, codes, strict=True)]
    split, start = [], len(trunk)
    for branch in branches:
        split.append(tuple(coded[start : start + len(branch)]))
        start += len(branch)
    trunk_code = tuple(coded[: len(trunk)])
    return Structure(trunk_code, tuple(split), tuple(columns), tuple(axes), tuple(origins))


def codes_of(amounts: NDArray[Any], turning: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Structure code of each constant amount.

    Args:
        amounts: (elements,) real or complex [rad | m].
        turning: (elements,) whether each is a rotation without a joint.
    """
    if np.iscomplexobj(amounts):
        return np.where(amounts == 0, 0, GENERAL).astype(np.int8)
    turns = amounts / (np.pi / 2)
    whole = np.rint(turns)
    exact = turning & (np.abs(turns - whole) < 1e-15)
    return np.where(amounts == 0, 0, np.where(exact, whole % 4, GENERAL)).astype(np.int8)


# ── symbols ──────────────────────────────────────────────────────────────────────────────────────────

Ref = tuple[int, int]
"""A signed reference ``(sign, node)``; sign 0 is the number zero, node 0 is the number one."""
ZERO: Ref = (0, 0)
ONE: Ref = (1, 0)


class Tracer:
    """Builds the operation list; equal operations become one node, products with 0 and ±1 vanish."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, int, int]] = [("one", 0, 0)]
        self.is_vector: list[bool] = [False]
        self._known: dict[tuple[str, int, int], int] = {}

    def node(self, op: str, a: int, b: int = 0, vector: bool = False) -> Ref:
        key = (op, a, b)
        if key not in self._known:
            self._known[key] = len(self.nodes)
            self.nodes.append(key)
            self.is_vector.append(vector)
        return 1, self._known[key]

    def mul(self, x: Ref, y: Ref) -> Ref:
        sign = x[0] * y[0]
        if sign == 0:
            return ZERO
        if x[1] == 0 or y[1] == 0:
            return sign, x[1] or y[1]
        a, b = sorted((x[1], y[1]))
        return sign, self.node("mul", a, b, self.is_vector[a] or self.is_vector[b])[1]

    def add(self, x: Ref, y: Ref) -> Ref:
        if x[0] == 0 or y[0] == 0:
            return y if x[0] == 0 else x
        if x[1] == y[1] and x[0] == -y[0]:
            return ZERO
        vector = self.is_vector[x[1]] or self.is_vector[y[1]]
        if x[0] == y[0]:
            a, b = sorted((x[1], y[1]))
            return x[0], self.node("add", a, b, vector)[1]
        positive, negative = (x, y) if x[0] > 0 else (y, x)
        return self.node("sub", positive[1], negative[1], vector)

    def sub(self, x: Ref, y: Ref) -> Ref:
        return self.add(x, (-y[0], y[1]))

    def cross(self, u: Sequence[Ref], v: Sequence[Ref]) -> list[Ref]:
        return [self.sub(self.mul(u[i], v[j]), self.mul(u[j], v[i])) for i, j in ((1, 2), (2, 0), (0, 1))]


@dataclass
class Frame:
    """Origin and axes of a frame in the base frame, as symbols; ``axes[c]`` is column c."""

    origin: list[Ref]
    axes: list[list[Ref]]

    def copy(self) -> Frame:
        return Frame(list(self.origin), [list(column) for column in self.axes])


def _walk(
    tracer: Tracer,
    frame: Frame,
    chain: Sequence[tuple[str, int | None, float, int]],
    first: int,
) -> list[tuple[list[Ref], list[Ref], bool]]:
    """Apply a chain to ``frame``; returns (axis, origin, is rotation) of each element before it acts."""
    seen = []
    for index, (kind, joint, sign, code) in enumerate(chain, start=first):
        a = "xyz".index(kind[1])
        axis = frame.axes[a]
        seen.append((list(axis), list(frame.origin), kind[0] == "R"))
        if joint is None and code == 0:
            continue
        if kind[0] == "T":
            size, node = _amount(tracer, index, joint, code)
            length = (size * int(sign), node)
            frame.origin = [tracer.add(o, tracer.mul(w, length)) for o, w in zip(frame.origin, axis, strict=True)]
            continue
        if joint is None and code != GENERAL:
            cos, sin = ((ONE, ZERO), (ZERO, ONE), ((-1, 0), ZERO), (ZERO, (-1, 0)))[code]
        else:
            angle = _amount(tracer, index, joint, code)[1]
            vector = tracer.is_vector[angle]
            cos = tracer.node("cos", angle, vector=vector)
            sin = tracer.node("sin", angle, vector=vector)
        sin = (sin[0] * int(sign), sin[1])
        u, v = frame.axes[(a + 1) % 3], frame.axes[(a + 2) % 3]
        mul, add, sub = tracer.mul, tracer.add, tracer.sub
        frame.axes[(a + 1) % 3] = [add(mul(cos, x), mul(sin, y)) for x, y in zip(u, v, strict=True)]
        frame.axes[(a + 2) % 3] = [sub(mul(cos, y), mul(sin, x)) for x, y in zip(u, v, strict=True)]
    return seen


def _amount(tracer: Tracer, index: int, joint: int | None, code: int) -> Ref:
    """Symbol of value + δ + q; the constant part is a scalar, the joint's part a vector."""
    constant = ZERO if code == 0 else tracer.node("amount", index)
    if joint is None:
        return constant
    return tracer.add(tracer.node("joint", joint, vector=True), constant)


# ── the chain ────────────────────────────────────────────────────────────────────────────────────────


def first_turn(structure: Structure) -> int:
    """Number of trunk elements up to and with the first turning joint."""
    for index, (kind, joint, _, _) in enumerate(structure.trunk):
        if kind[0] == "R" and joint is not None:
            return index + 1
    return 0


@dataclass(frozen=True)
class Trace:
    """What was asked for, in symbols.

    Attributes:
        tracer: Holds the nodes.
        outputs: Positions, columns, axes, origins, three components each.
        shape: ``(targets, columns, axes)``.
    """

    tracer: Tracer
    outputs: list[Ref]
    shape: tuple[int, int, int]


def trace(structure: Structure, split: int) -> Trace:
    """All that the structure asks for, traced from a frame of its own behind the first ``split`` elements."""
    tracer = Tracer()
    outer = _unit_frame()
    seen = _walk(tracer, outer, structure.trunk[:split], 0)
    behind = [origin for _, origin, _ in seen[1:]] + [list(outer.origin)] * bool(split)
    frame = _unit_frame()
    seen += _walk(tracer, frame, structure.trunk[split:], split)
    behind += [origin for _, origin, _ in seen[split + 1 :]] + [list(frame.origin)]
    owner: list[int | None] = [None] * len(seen)
    inner_points = []
    for target, branch in enumerate(structure.branches):
        local = frame.copy()
        seen += _walk(tracer, local, branch, len(seen))
        owner += [target] * len(branch)
        inner_points.append(local.origin)
    points = [_to_base(tracer, outer, point, at=True) for point in inner_points]
    outputs = [ref for point in points for ref in point]
    for e in structure.columns:
        axis, origin, rotates = seen[e]
        sign = _element_sign(structure, e)
        for target, point in enumerate(inner_points if e >= split else points):
            if owner[e] not in (None, target):
                outputs += [ZERO] * 3
                continue
            arm = [tracer.sub(p, o) for p, o in zip(point, origin, strict=True)]
            column = tracer.cross(axis, arm) if rotates else axis
            column = _to_base(tracer, outer, column) if e >= split else column
            outputs += [(sign * s, n) for s, n in column]
    for e in structure.axes:
        sign = _element_sign(structure, e)
        axis = _to_base(tracer, outer, seen[e][0]) if e >= split else seen[e][0]
        outputs += [(sign * s, n) for s, n in axis]
    for e in structure.origins:
        outputs += _to_base(tracer, outer, behind[e], at=True) if e >= split else behind[e]
    return Trace(tracer, outputs, (len(points), len(structure.columns), len(structure.axes)))


def _unit_frame() -> Frame:
    return Frame([ZERO] * 3, [[ONE, ZERO, ZERO], [ZERO, ONE, ZERO], [ZERO, ZERO, ONE]])


def _to_base(tracer: Tracer, frame: Frame, vector: Sequence[Ref], *, at: bool = False) -> list[Ref]:
    """A vector (or, with ``at``, a point) of ``frame`` in the base frame."""
    result = []
    for i in range(3):
        total = frame.origin[i] if at else ZERO
        for j in range(3):
            total = tracer.add(total, tracer.mul(frame.axes[j][i], vector[j]))
        result.append(total)
    return result


def _element_sign(structure: Structure, e: int) -> int:
    flat = [*structure.trunk, *(item for branch in structure.branches for item in branch)]
    return int(flat[e][2])
