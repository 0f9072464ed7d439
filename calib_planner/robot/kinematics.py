# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics and all its derivatives as one straight-line program of array operations.

Derivation. Let the frame before element e have origin o_e and axes R_e, all in the base frame, and let
w_e = R_e·(unit axis of e). Differentiating the product (2) with respect to the amount of e gives, for a
point p carried by the chain,

    column_e = ∂p/∂amount_e = w_e                for a translation
                              w_e × (p − o_e)    for a rotation                            (J of eq. (3))

and, because ∂w/∂amount = w_e × w for everything behind a rotation e,

    ∂²p/∂amount_a ∂amount_b = w_a × column_b     with a before b, a a rotation; 0 if a is a translation.

So axes and columns of the elements are all that positions, the identification Jacobian and its joint
derivatives need.

``trace`` walks the chain once with symbols in place of numbers. A symbol is a signed reference to a node; a
node is an operation on earlier nodes, a scalar (the constant part of an amount) or a vector (a joint's
coordinates over many configurations). Equal operations become one node, products with 0 and ±1 vanish, and so
does what nobody wants.

``compile_program`` turns what is left into operations on blocks of configurations, one contiguous vector per
scalar quantity (structure of arrays), in buffers that stay in the cache. Sines and cosines of all joints come
from one tangent of the half angle,

    t = tan(q/2),   d = 2/(1 + t²),   cos q = d − 1,   sin q = t·d,

which NumPy vectorises where it does not vectorise sine and cosine. ``kernel.c`` does the same in one call and
saves the time that NumPy takes per operation; where it is not built, and for complex numbers, NumPy does it.

The program depends on the chain's *structure* (which amounts are zero or quarter turns), not on its numbers, so
that one program serves a whole identification.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_planner.robot.elements import Element

try:
    import calib_planner.robot._kernel as _kernel
except ImportError:  # not built: NumPy does the same, more slowly
    _kernel = None

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

    def node(self, op: str, a: int, b: int = 0, vector: bool | None = None) -> Ref:
        """The node of an operation; ``vector`` is said where ``a`` and ``b`` are no nodes."""
        return 1, self._number((op, a, b), vector)

    def _number(self, key: tuple[str, int, int], vector: bool | None = None) -> int:
        number = self._known.get(key)
        if number is None:
            number = self._known[key] = len(self.nodes)
            self.nodes.append(key)
            if vector is None:
                vector = self.is_vector[key[1]] or self.is_vector[key[2]]
            self.is_vector.append(vector)
        return number

    def mul(self, x: Ref, y: Ref) -> Ref:
        (sign, a), (other, b) = x, y
        sign *= other
        if sign == 0:
            return ZERO
        if a == 0 or b == 0:
            return sign, a or b
        return sign, self._number(("mul", a, b) if a < b else ("mul", b, a))

    def add(self, x: Ref, y: Ref) -> Ref:
        (sign, a), (other, b) = x, y
        if sign == 0 or other == 0:
            return y if sign == 0 else x
        if sign == other:
            return sign, self._number(("add", a, b) if a < b else ("add", b, a))
        if a == b:
            return ZERO
        return 1, self._number(("sub", a, b) if sign > 0 else ("sub", b, a))

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
        seen.append((axis, frame.origin, kind[0] == "R"))  # an element makes new lists
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
            cos, sin = tracer.node("cos", angle), tracer.node("sin", angle)
        sin = (sin[0] * int(sign), sin[1])
        u, v = frame.axes[(a + 1) % 3], frame.axes[(a + 2) % 3]
        mul, add, sub = tracer.mul, tracer.add, tracer.sub
        frame.axes[(a + 1) % 3] = [add(mul(cos, x), mul(sin, y)) for x, y in zip(u, v, strict=True)]
        frame.axes[(a + 2) % 3] = [sub(mul(cos, y), mul(sin, x)) for x, y in zip(u, v, strict=True)]
    return seen


def _amount(tracer: Tracer, index: int, joint: int | None, code: int) -> Ref:
    """Symbol of value + δ + q; the constant part is a scalar, the joint's part a vector."""
    constant = ZERO if code == 0 else tracer.node("amount", index, vector=False)
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


def trace(structure: Structure, split: int) -> tuple[Tracer, list[Ref]]:
    """All that the structure wants, traced from a frame of its own behind the first ``split`` elements.

    Returns:
        The nodes, and the outputs: positions, columns, axes, origins, three components each.
    """
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
    return tracer, outputs


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


# ── the program ──────────────────────────────────────────────────────────────────────────────────────

BLOCK = 2048
"""Configurations per pass: the live vectors of a six-joint robot then fit the second-level cache."""


@dataclass(frozen=True)
class Program:
    """A compiled chain; ``run`` evaluates it.

    Attributes:
        scalars: Operations on plain numbers, done once per call: ``(op, a, b, node)``.
        vectors: Operations on blocks: ``(ufunc, a, b, slot)``, slots index a table of operands.
        turns: ``(joint, node, cos slot, sin slot)``: joint angles whose cosine and sine are needed, the scalar
            ``node`` (0 for none) being added to the joint.
        joints: ``(slot, joint)`` pairs: where joint vectors are read.
        constants: ``(slot, node)`` pairs: where scalar results enter the vector part.
        copies: ``(row, sign, slot)``: outputs that are (negated) copies; sign 0 means zero.
        slots: Number of operand slots; the first ``rows`` are the output rows themselves.
        registers: Which scratch register backs each slot beyond the rows and inputs.
        scratch: Number of scratch registers.
        rows: Number of output rows: positions, columns, axes, origins, in that order.
        shape: ``(targets, columns, axes)``.
    """

    scalars: tuple[tuple[str, int, int, int], ...]
    vectors: tuple[tuple[Callable[..., Any], int, int, int], ...]
    turns: tuple[tuple[int, int, int, int], ...]
    joints: tuple[tuple[int, int], ...]
    constants: tuple[tuple[int, int], ...]
    copies: tuple[tuple[int, int, int], ...]
    slots: int
    registers: tuple[tuple[int, int], ...]
    scratch: int
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
        if _kernel is not None and q.dtype == amounts.dtype == np.float64:
            out = np.empty((self.rows, q.shape[1]))
            _kernel.run(self.code, amounts, q, out)
            return out
        return self.run_numpy(q, amounts)

    def run_numpy(self, q: NDArray[Any], amounts: NDArray[Any]) -> NDArray[Any]:
        """The same without the compiled kernel; also for complex numbers."""
        dtype = np.result_type(q.dtype, amounts.dtype, np.float64)
        count = q.shape[1]
        out = np.empty((self.rows, count), dtype)
        numbers = self._run_scalars(amounts)
        table: list[Any] = [None] * self.slots
        for slot, node in self.constants:
            table[slot] = dtype.type(numbers[node])
        width = min(BLOCK, count)
        scratch = np.empty((self.scratch, width), dtype)
        angles, waves = np.empty((len(self.turns), width), dtype), np.empty((2, len(self.turns), width), dtype)
        for start in range(0, count, BLOCK):
            end = min(start + BLOCK, count)
            block = out[:, start:end]
            table[: self.rows] = block
            for slot, joint in self.joints:
                table[slot] = q[joint, start:end]
            if start == 0 or end - start < width:
                views = scratch[:, : end - start]
                for slot, register in self.registers:
                    table[slot] = views[register]
                for index, (_, _, cos, sin) in enumerate(self.turns):
                    table[cos], table[sin] = waves[:, index, : end - start]
            self._turn(q[:, start:end], numbers, angles[:, : end - start], waves[:, :, : end - start])
            for ufunc, a, b, slot in self.vectors:
                ufunc(table[a], table[b], table[slot])
            for row, sign, slot in self.copies:
                if sign == 0:
                    block[row] = 0.0
                elif sign > 0:
                    block[row] = table[slot]
                else:
                    np.negative(table[slot], block[row])
        return out

    @cached_property
    def code(self) -> NDArray[np.int32]:
        """The program as numbers for ``kernel.c``, whose ``unpack`` has the layout."""
        scalar = [(_SCALARS.index(op), a, b, node) for op, a, b, node in self.scalars]
        vector, registers, scratch = _fused(self)
        parts = (scalar, vector, self.turns, self.joints, self.constants, self.copies, registers)
        counts = [len(part) for part in parts]
        joints = 1 + max([j for _, j in self.joints] + [t[0] for t in self.turns], default=-1)
        nodes = 1 + max([0, *(s[3] for s in self.scalars)])
        head = [*counts[:3], joints, *counts[3:6], self.slots, self.rows, counts[6]]
        flat = [number for part in parts for entry in part for number in entry]
        return np.array([*head, scratch, nodes, *flat], np.int32)

    def _turn(self, q: NDArray[Any], numbers: dict[int, Any], angles: NDArray[Any], waves: NDArray[Any]) -> None:
        """Cosines and sines of the joint angles of one block, (turns, n), into ``waves`` (2, turns, n)."""
        for row, (joint, node, _, _) in zip(angles, self.turns, strict=True):
            np.multiply(q[joint], 0.5, row)
            if node:
                row += 0.5 * numbers[node]
        cos, sin = waves
        np.tan(angles, angles)
        np.multiply(angles, angles, cos)
        cos += 1.0
        np.divide(2.0, cos, cos)
        np.multiply(angles, cos, sin)
        cos -= 1.0

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
    """Trace the chain with symbols and lay the result out as a program.

    The chain may be traced in the base frame, or in the frame behind its first turning joint with the results
    turned into the base frame at the end: an arm that moves in a plane there is mostly zeros. The shorter
    program is used.
    """
    shape = (len(structure.branches), len(structure.columns), len(structure.axes))
    traces = [trace(structure, split) for split in dict.fromkeys((0, first_turn(structure)))]
    return _lay_out(*min(traces, key=lambda traced: _operations(*traced)), shape)


def _operations(tracer: Tracer, outputs: list[Ref]) -> int:
    """Vector operations and copies of the program that ``_lay_out`` makes of a trace."""
    computed = _computed(tracer, _needed(tracer, outputs))
    written_in_place = computed & {node for sign, node in outputs if sign > 0}
    return len(computed) + len(outputs) - len(written_in_place)


_SCALARS = ("amount", "cos", "sin", "mul", "add", "sub")
_VECTORS = (np.multiply, np.add, np.subtract)
"""Operations in the order in which ``kernel.c`` numbers them."""
_UFUNCS: dict[str, Callable[..., Any]] = {"mul": np.multiply, "add": np.add, "sub": np.subtract}


def _fused(program: Program) -> tuple[list[tuple[int, ...]], list[tuple[int, int]], int]:
    """The vector operations with products taken into the sum that alone needs them.

    Returns:
        ``(operation, a, b, c, d, slot)``, operations numbered as in ``kernel.c``: a·b, a + b, a − b, a·b + c·d,
        a·b − c·d, a·b + c, a·b − c, c − a·b; then registers and their number as in ``Program``.
    """
    uses = Counter(slot for _, a, b, _ in program.vectors for slot in (a, b))
    uses.update(slot for _, _, slot in program.copies)
    products = {
        slot: (a, b)
        for ufunc, a, b, slot in program.vectors
        if ufunc is np.multiply and slot >= program.rows and uses[slot] == 1
    }
    sums = [(a, b) for ufunc, a, b, _ in program.vectors if ufunc is not np.multiply]
    taken = {slot for pair in sums for slot in pair if slot in products}
    result: list[tuple[int, ...]] = []
    for ufunc, a, b, slot in program.vectors:
        number, plus = _VECTORS.index(ufunc), ufunc is np.add
        if slot in taken:
            continue
        left, right = (products.get(s) if s in taken and number else None for s in (a, b))
        if left and right:
            result.append((3 if plus else 4, *left, *right, slot))
        elif left:
            result.append((5 if plus else 6, *left, b, b, slot))
        elif right:
            result.append((5 if plus else 7, *right, a, a, slot))
        else:
            result.append((number, a, b, a, a, slot))
    return result, *_registers(result, {slot for slot, _ in program.registers}, program)


def _registers(
    vectors: list[tuple[int, ...]], slots: set[int], program: Program
) -> tuple[list[tuple[int, int]], int]:
    """``(slot, register)`` of those ``slots`` that ``vectors`` make, and how many registers there are."""
    last = {slot: step for step, (_, *operands, _) in enumerate(vectors) for slot in operands}
    last.update({slot: len(vectors) for _, _, slot in program.copies})
    free: list[int] = []
    place: dict[int, int] = {}
    used = 0
    for step, (_, *operands, slot) in enumerate(vectors):
        if slot in slots:
            place[slot] = free.pop() if free else used
            used = max(used, place[slot] + 1)
        for operand in set(operands):
            if operand in place and last[operand] == step:
                free.append(place[operand])
    return list(place.items()), used


def _lay_out(tracer: Tracer, outputs: list[Ref], shape: tuple[int, int, int]) -> Program:
    """Drop dead operations, give live vectors a place, write outputs where they belong."""
    needed = _needed(tracer, outputs)
    rows = len(outputs)
    home: dict[int, int] = {}
    computed = _computed(tracer, needed)
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
        if node in computed:
            continue
        home[node] = slots
        slots += 1
        if op == "joint":
            joints.append((home[node], a))
        elif not tracer.is_vector[node]:
            constants.append((home[node], node))
    vectors = []
    register_of: dict[int, int] = {}
    for step, node in enumerate(order):
        if node not in home:
            register = free.pop() if free else used
            used = max(used, register + 1)
            register_of[node] = register
            home[node] = slots
            registers.append((slots, register))
            slots += 1
        op, a, b = tracer.nodes[node]
        vectors.append((_UFUNCS[op], home[a], home[b], home[node]))
        for operand in _operands(tracer, node):
            if last_use[operand] == step and operand in register_of:
                free.append(register_of.pop(operand))
    copies = [
        (row, sign, home[node] if sign else 0)
        for row, (sign, node) in enumerate(outputs)
        if sign == 0 or home[node] != row
    ]
    scalars = [(*tracer.nodes[n], n) for n in needed if not tracer.is_vector[n] and tracer.nodes[n][0] != "one"]
    return Program(
        scalars=tuple(scalars),
        vectors=tuple(vectors),
        turns=_turns(tracer, needed, home, slots),
        joints=tuple(joints),
        constants=tuple(constants),
        copies=tuple(copies),
        slots=slots + 1,
        registers=tuple(registers),
        scratch=used,
        rows=rows,
        shape=shape,
    )


def _computed(tracer: Tracer, needed: list[int]) -> set[int]:
    """Those nodes that are vector operations."""
    return {n for n in needed if tracer.is_vector[n] and tracer.nodes[n][0] in _UFUNCS}


def _operands(tracer: Tracer, node: int) -> tuple[int, ...]:
    op, a, b = tracer.nodes[node]
    if op in ("mul", "add", "sub"):
        return (a,) if a == b else (a, b)
    if op in ("cos", "sin"):
        # A joint's angle is made by ``Program._turn``; only its constant part is an operand here.
        return tuple(n for n in _angle(tracer, a)[1:] if n) if tracer.is_vector[node] else (a,)
    return ()


def _angle(tracer: Tracer, node: int) -> tuple[int, int]:
    """A joint angle's node taken apart: the joint, and the scalar node added to it or 0."""
    op, a, b = tracer.nodes[node]
    if op == "joint":
        return a, 0
    joint, constant = (a, b) if tracer.is_vector[a] else (b, a)
    return tracer.nodes[joint][1], constant


def _turns(
    tracer: Tracer, needed: list[int], home: dict[int, int], nowhere: int
) -> tuple[tuple[int, int, int, int], ...]:
    """Each joint angle once, with the slots of its cosine and sine (``nowhere`` if not needed)."""
    places: dict[int, dict[str, int]] = {}
    for node in needed:
        op, a, _ = tracer.nodes[node]
        if op in ("cos", "sin") and tracer.is_vector[node]:
            places.setdefault(a, {})[op] = home[node]
    turns = []
    for angle, place in places.items():
        turns.append((*_angle(tracer, angle), place.get("cos", nowhere), place.get("sin", nowhere)))
    return tuple(turns)


def _needed(tracer: Tracer, outputs: list[Ref]) -> list[int]:
    """Nodes that some output depends on, in the order in which they were made, operands first."""
    wanted = [True] + [False] * (len(tracer.nodes) - 1)
    for sign, node in outputs:
        if sign:
            wanted[node] = True
    for node in range(len(wanted) - 1, 0, -1):
        if wanted[node]:
            for operand in _operands(tracer, node):
                wanted[operand] = True
    return [node for node, needed in enumerate(wanted) if needed]
