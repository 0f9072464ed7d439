"""Forward kinematics and all its derivatives as one straight-line program of array operations.

Derivation. Let the frame before element e have origin o_e and axes R_e, all in the base frame, and let
w_e = R_e·(unit axis of e). Differentiating the product (2) with respect to the amount of e gives, for a
point p carried by the chain,

    column_e = ∂p/∂amount_e = w_e                for a translation
                              w_e × (p − o_e)    for a rotation                            (J of eq. (3))

and, because ∂w/∂amount = w_e × w for everything behind a rotation e,

    ∂²p/∂amount_a ∂amount_b = w_a × column_b     with a before b, a a rotation; 0 if a is a translation.

So axes and columns of the elements are all that positions, the identification Jacobian and its joint
derivatives need. ``compile_program`` walks the chain once with symbols in place of numbers. Products with
0 and ±1, shared subexpressions and results that nobody asked for vanish there; what is left runs over a
block of configurations at a time, one contiguous vector per scalar quantity (structure of arrays), in
buffers that stay in the cache. The program depends on the chain's *structure* (which amounts are zero or
quarter turns), not on its numbers, so that one program serves a whole identification.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_planner.robot.elements import Element

BLOCK = 1024
"""Configurations per pass: the live vectors of a six-joint robot then fit the second-level cache."""

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
    amounts: NDArray[Any],
    columns: Sequence[int],
    axes: Sequence[int],
    origins: Sequence[int] = (),
) -> Structure:
    """Classify each constant amount (flat order) and describe the chain."""
    elements = [*trunk, *(e for branch in branches for e in branch)]
    coded = [(e.kind, e.joint, e.sign, _code(e, amount)) for e, amount in zip(elements, amounts, strict=True)]
    split, start = [], len(trunk)
    for branch in branches:
        split.append(tuple(coded[start : start + len(branch)]))
        start += len(branch)
    trunk_code = tuple(coded[: len(trunk)])
    return Structure(trunk_code, tuple(split), tuple(columns), tuple(axes), tuple(origins))


def _code(element: Element, amount: complex) -> int:
    if amount == 0:
        return 0
    if element.is_rotation and element.joint is None and np.isrealobj(amount):
        turns = float(np.real(amount)) / (np.pi / 2)
        if abs(turns - round(turns)) < 1e-15:
            return round(turns) % 4
    return GENERAL


# ── symbols ──────────────────────────────────────────────────────────────────────────────────────────

Ref = tuple[int, int]
"""A signed reference ``(sign, node)``; sign 0 is the number zero, node 0 is the number one."""
ZERO: Ref = (0, 0)
ONE: Ref = (1, 0)


class _Tracer:
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
class _Frame:
    """Origin and axes of a frame in the base frame, as symbols; ``axes[c]`` is column c."""

    origin: list[Ref]
    axes: list[list[Ref]]

    def copy(self) -> _Frame:
        return _Frame(list(self.origin), [list(column) for column in self.axes])


def _walk(
    tracer: _Tracer,
    frame: _Frame,
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


def _amount(tracer: _Tracer, index: int, joint: int | None, code: int) -> Ref:
    """Symbol of value + δ + q; the constant part is a scalar, the joint's part a vector."""
    constant = ZERO if code == 0 else tracer.node("amount", index)
    if joint is None:
        return constant
    return tracer.add(tracer.node("joint", joint, vector=True), constant)


# ── the program ──────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Program:
    """A compiled chain; ``run`` evaluates it.

    Attributes:
        scalars: Operations on plain numbers, done once per call: ``(op, a, b, node)``.
        vectors: Operations on blocks: ``(ufunc, a, b, slot)``, slots index a table of operands.
        joints: ``(slot, joint)`` pairs: where joint vectors are read.
        constants: ``(slot, node)`` pairs: where scalar results enter the vector part.
        copies: ``(row, sign, slot)``: outputs that are (negated) copies; sign 0 means zero.
        slots: Number of operand slots; the first ``rows`` are the output rows themselves.
        registers: Which scratch register backs each slot beyond the rows and inputs.
        rows: Number of output rows: positions, columns, axes, origins, in that order.
        shape: ``(targets, columns, axes)``.
    """

    scalars: tuple[tuple[str, int, int, int], ...]
    vectors: tuple[tuple[Callable[..., Any], int, int, int], ...]
    joints: tuple[tuple[int, int], ...]
    constants: tuple[tuple[int, int], ...]
    copies: tuple[tuple[int, int, int], ...]
    slots: int
    registers: tuple[tuple[int, int], ...]
    rows: int
    shape: tuple[int, int, int]

    def run(self, q: NDArray[Any], amounts: NDArray[Any]) -> NDArray[Any]:
        """Evaluate all outputs.

        Args:
            q: Joint coordinates, shape (joints, N), each row contiguous [rad | m].
            amounts: value + δ of each element, flat order [rad | m].

        Returns:
            Array of shape (rows, N): positions 3 per target, then 3 per target of each wanted column, then
            3 of each wanted axis, then 3 of each wanted origin; all in the base frame.
        """
        dtype = np.result_type(q.dtype, amounts.dtype, np.float64)
        count = q.shape[1]
        out = np.empty((self.rows, count), dtype)
        numbers = self._run_scalars(amounts)
        table: list[Any] = [None] * self.slots
        for slot, node in self.constants:
            table[slot] = dtype.type(numbers[node])
        scratch = np.empty((1 + max((r for _, r in self.registers), default=-1), BLOCK), dtype)
        for start in range(0, count, BLOCK):
            stop = min(start + BLOCK, count)
            block = out[:, start:stop]
            table[: self.rows] = block
            for slot, joint in self.joints:
                table[slot] = q[joint, start:stop]
            for slot, register in self.registers:
                table[slot] = scratch[register, : stop - start]
            for ufunc, a, b, slot in self.vectors:
                if b < 0:
                    ufunc(table[a], table[slot])
                else:
                    ufunc(table[a], table[b], table[slot])
            for row, sign, slot in self.copies:
                if sign == 0:
                    block[row] = 0.0
                elif sign > 0:
                    block[row] = table[slot]
                else:
                    np.negative(table[slot], block[row])
        return out

    def _run_scalars(self, amounts: NDArray[Any]) -> dict[int, Any]:
        numbers: dict[int, Any] = {0: 1.0}
        for op, a, b, node in self.scalars:
            if op == "amount":
                numbers[node] = amounts[a]
            elif op in ("cos", "sin"):
                numbers[node] = getattr(np, op)(numbers[a])
            elif op == "mul":
                numbers[node] = numbers[a] * numbers[b]
            else:
                numbers[node] = numbers[a] + (numbers[b] if op == "add" else -numbers[b])
        return numbers


@lru_cache(maxsize=256)
def compile_program(structure: Structure) -> Program:
    """Trace the chain with symbols and lay the result out as a program."""
    tracer = _Tracer()
    frame = _Frame([ZERO] * 3, [[ONE, ZERO, ZERO], [ZERO, ONE, ZERO], [ZERO, ZERO, ONE]])
    seen = _walk(tracer, frame, structure.trunk, 0)
    behind = [origin for _, origin, _ in seen[1:]] + [list(frame.origin)]
    owner: list[int | None] = [None] * len(seen)
    points = []
    for target, branch in enumerate(structure.branches):
        local = frame.copy()
        seen += _walk(tracer, local, branch, len(seen))
        owner += [target] * len(branch)
        points.append(local.origin)
    outputs = [ref for point in points for ref in point]
    for e in structure.columns:
        axis, origin, rotates = seen[e]
        sign = _element_sign(structure, e)
        for target, point in enumerate(points):
            if owner[e] not in (None, target):
                outputs += [ZERO] * 3
                continue
            arm = [tracer.sub(p, o) for p, o in zip(point, origin, strict=True)]
            column = tracer.cross(axis, arm) if rotates else axis
            outputs += [(sign * s, n) for s, n in column]
    for e in structure.axes:
        sign = _element_sign(structure, e)
        outputs += [(sign * s, n) for s, n in seen[e][0]]
    for e in structure.origins:
        outputs += behind[e]
    return _lay_out(tracer, outputs, (len(points), len(structure.columns), len(structure.axes)))


def _element_sign(structure: Structure, e: int) -> int:
    flat = [*structure.trunk, *(item for branch in structure.branches for item in branch)]
    return int(flat[e][2])


_UFUNCS: dict[str, Callable[..., Any]] = {
    "mul": np.multiply,
    "add": np.add,
    "sub": np.subtract,
    "cos": np.cos,
    "sin": np.sin,
}


def _lay_out(tracer: _Tracer, outputs: list[Ref], shape: tuple[int, int, int]) -> Program:
    """Drop dead operations, give live vectors a place, write outputs where they belong."""
    needed = _needed(tracer, outputs)
    rows = len(outputs)
    home: dict[int, int] = {}
    computed = {n for n in needed if tracer.is_vector[n] and tracer.nodes[n][0] != "joint"}
    for row, (sign, node) in enumerate(outputs):
        if sign > 0 and node in computed and node not in home:
            home[node] = row
    last_use: dict[int, int] = {}
    order = [n for n in needed if n in computed]
    for step, node in enumerate(order):
        for operand in _operands(tracer, node):
            last_use[operand] = step
    for _, node in outputs:
        last_use[node] = len(order)
    slots = rows
    joints: list[tuple[int, int]] = []
    constants: list[tuple[int, int]] = []
    registers: list[tuple[int, int]] = []
    free: list[int] = []
    used = 0
    for node in needed:
        op, a, _ = tracer.nodes[node]
        if op == "joint" or not tracer.is_vector[node]:
            home[node] = slots
            (joints if op == "joint" else constants).append((slots, a if op == "joint" else node))
            slots += 1
    vectors = []
    held: dict[int, int] = {}
    for step, node in enumerate(order):
        if node not in home:
            register = free.pop() if free else used
            used = max(used, register + 1)
            held[node] = register
            home[node] = slots
            registers.append((slots, register))
            slots += 1
        op, a, b = tracer.nodes[node]
        second = home[b] if op in ("mul", "add", "sub") else -1
        vectors.append((_UFUNCS[op], home[a], second, home[node]))
        for operand in _operands(tracer, node):
            if last_use[operand] == step and operand in held:
                free.append(held.pop(operand))
    copies = [
        (row, sign, home[node] if sign else 0)
        for row, (sign, node) in enumerate(outputs)
        if sign == 0 or home[node] != row
    ]
    scalars = [(*tracer.nodes[n], n) for n in needed if not tracer.is_vector[n] and tracer.nodes[n][0] != "one"]
    return Program(
        scalars=tuple(scalars),
        vectors=tuple(vectors),
        joints=tuple(joints),
        constants=tuple(constants),
        copies=tuple(copies),
        slots=slots,
        registers=tuple(registers),
        rows=rows,
        shape=shape,
    )


def _operands(tracer: _Tracer, node: int) -> tuple[int, ...]:
    op, a, b = tracer.nodes[node]
    if op in ("mul", "add", "sub"):
        return (a,) if a == b else (a, b)
    return (a,) if op in ("cos", "sin") else ()


def _needed(tracer: _Tracer, outputs: list[Ref]) -> list[int]:
    """Nodes that some output depends on, in the order in which they were made."""
    needed = {0}
    stack = [node for sign, node in outputs if sign]
    while stack:
        node = stack.pop()
        if node not in needed:
            needed.add(node)
            stack.extend(_operands(tracer, node))
    return sorted(needed)
