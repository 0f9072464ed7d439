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
buffers that stay in the cache. Sines and cosines of all joints come from one tangent of the half angle,

    t = tan(q/2),   d = 2/(1 + t²),   cos q = d − 1,   sin q = t·d,

which NumPy vectorises where it does not vectorise sine and cosine. The program depends on the chain's
*structure* (which amounts are zero or quarter turns), not on its numbers, so that one program serves a whole
identification.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_planner.robot.tracing import Ref, Structure, Trace, Tracer, first_turn, trace

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
            stop = min(start + BLOCK, count)
            block = out[:, start:stop]
            table[: self.rows] = block
            for slot, joint in self.joints:
                table[slot] = q[joint, start:stop]
            if start == 0 or stop - start < width:
                views = scratch[:, : stop - start]
                for slot, register in self.registers:
                    table[slot] = views[register]
                for index, (_, _, cos, sin) in enumerate(self.turns):
                    table[cos], table[sin] = waves[:, index, : stop - start]
            self._turn(q[:, start:stop], numbers, angles[:, : stop - start], waves[:, :, : stop - start])
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
    program is kept.
    """
    candidates = [_lay_out(trace(structure, split)) for split in (0, first_turn(structure))]
    return min(candidates, key=lambda program: len(program.vectors) + len(program.copies))


_UFUNCS: dict[str, Callable[..., Any]] = {
    "mul": np.multiply,
    "add": np.add,
    "sub": np.subtract,
}


def _lay_out(traced: Trace) -> Program:
    """Drop dead operations, give live vectors a place, write outputs where they belong."""
    tracer, outputs = traced.tracer, traced.outputs
    needed = _needed(tracer, outputs)
    rows = len(outputs)
    home: dict[int, int] = {}
    computed = {n for n in needed if tracer.is_vector[n] and tracer.nodes[n][0] in _UFUNCS}
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
        vectors.append((_UFUNCS[op], home[a], home[b], home[node]))
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
        turns=_turns(tracer, needed, home, slots),
        joints=tuple(joints),
        constants=tuple(constants),
        copies=tuple(copies),
        slots=slots + 1,
        registers=tuple(registers),
        scratch=used,
        rows=rows,
        shape=traced.shape,
    )


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
    found = []
    for angle, place in places.items():
        found.append((*_angle(tracer, angle), place.get("cos", nowhere), place.get("sin", nowhere)))
    return tuple(found)


def _needed(tracer: Tracer, outputs: list[Ref]) -> list[int]:
    """Nodes that some output depends on, in the order in which they were made."""
    needed = {0}
    stack = [node for sign, node in outputs if sign]
    while stack:
        node = stack.pop()
        if node not in needed:
            needed.add(node)
            stack.extend(_operands(tracer, node))
    return sorted(needed)
