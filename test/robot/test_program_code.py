# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The program as numbers, as ``kernel.c`` reads it, says what NumPy does: read here by a few lines of Python."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from robots import mixed, random_chain

from calib_planner import Robot
from calib_planner.robot import Element, kinematics
from calib_planner.robot.kinematics import Program

ROBOTS: dict[str, Callable[[], Robot]] = {
    "planar_2r": lambda: Robot.load("planar_2r"),
    "ur10e": lambda: Robot.load("ur10e").with_targets([[0.1, 0.0, 0.2], [0.0, 0.1, 0.1]]),
    "kuka_kr270": lambda: Robot.load("kuka_kr270").with_parameters("full", ("base", "tool")),
    "mixed": lambda: mixed().with_parameters("full", ("base", "tool")),
    "random 1": lambda: random_chain(1),
    "random 2": lambda: random_chain(2),
}
WIDTHS = (4, 6, 4, 2, 2, 3, 2)
"""Numbers of a scalar operation, a vector operation, a turn, an input, a constant, a copy, a register."""
OPERATIONS: list[Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = [
    lambda a, b, c, d: a * b,
    lambda a, b, c, d: a + b,
    lambda a, b, c, d: a - b,
    lambda a, b, c, d: a * b + c * d,
    lambda a, b, c, d: a * b - c * d,
    lambda a, b, c, d: a * b + c,
    lambda a, b, c, d: a * b - c,
    lambda a, b, c, d: c - a * b,
]


def flat(robot: Robot) -> list[Element]:
    """All elements, of the trunk and then of the branches."""
    return [*robot.elements, *(e for branch in robot.targets for e in branch)]


def parts_of(program: Program) -> tuple[list[int], list[list[list[int]]]]:
    """Joints, slots, rows, scratch registers, nodes; and the entries of each part, see ``WIDTHS``."""
    code = program.code.tolist()
    scalars, vectors, turns, joints, inputs, constants, copies, slots, rows, registers, scratch, nodes = code[:12]
    parts, at = [], 12
    for count, width in zip((scalars, vectors, turns, inputs, constants, copies, registers), WIDTHS, strict=True):
        parts.append([code[k : k + width] for k in range(at, at + count * width, width)])
        at += count * width
    assert at == len(code)
    return [joints, slots, rows, scratch, nodes], parts


def interpreted(program: Program, q: np.ndarray, amounts: np.ndarray) -> np.ndarray:
    (joints, slots, rows, scratch, nodes), parts = parts_of(program)
    scalars, vectors, turns, inputs, constants, copies, registers = parts
    count = q.shape[1]
    node, out = np.full(nodes, np.nan), np.full((rows, count), np.nan)
    q, memory = q[:joints], np.full((scratch, count), np.nan)  # no more than the code says that it needs
    node[0] = 1.0
    for operation, a, b, to in scalars:
        if operation == 0:
            node[to] = amounts[a]
        elif operation < 3:
            node[to] = (np.cos, np.sin)[operation - 1](node[a])
        else:
            node[to] = (node[a] * node[b], node[a] + node[b], node[a] - node[b])[operation - 3]
    table: list[np.ndarray] = [*out, *np.full((slots - rows, count), np.nan)]
    for slot, joint in inputs:
        table[slot] = q[joint]
    for slot, number in constants:
        table[slot] = np.full(count, node[number])
    for slot, register in registers:
        table[slot] = memory[register]
    for joint, number, cos, sin in turns:
        angle = q[joint] + (node[number] if number else 0.0)
        table[cos], table[sin] = np.cos(angle), np.sin(angle)
    for operation, a, b, c, d, to in vectors:
        table[to][:] = OPERATIONS[operation](table[a], table[b], table[c], table[d])
    for row, sign, slot in copies:
        out[row] = sign * table[slot] if sign else 0.0
    return out


@pytest.mark.parametrize("everything", [False, True], ids=["positions", "everything"])
@pytest.mark.parametrize("name", ROBOTS)
def test_the_code_says_what_numpy_does(name: str, everything: bool) -> None:
    robot, rng = ROBOTS[name](), np.random.default_rng(0)
    wanted = (robot._layout.parameter_elements + robot._layout.joint_elements) * everything
    for amounts in (robot._nominal_amounts, robot._nominal_amounts + 1e-3):
        program = robot._program(amounts, wanted, wanted)
        q = rng.uniform(-2.0, 2.0, (len(robot.joint_names), 3))
        expected = program.run_numpy(q, amounts)
        np.testing.assert_allclose(interpreted(program, q, amounts), expected, rtol=0, atol=1e-13)
        assert np.isfinite(expected).all()


def program_of_all(robot: Robot) -> Program:
    """What computes the columns of every parameter and every joint."""
    wanted = robot._layout.parameter_elements + robot._layout.joint_elements
    return robot._program(robot._nominal_amounts, wanted, wanted)


@pytest.mark.parametrize("name", ROBOTS)
def test_nothing_is_computed_in_vain(name: str) -> None:
    """No product stands apart from the one sum that needs it, and every part counts what the others use."""
    program = program_of_all(ROBOTS[name]())
    (joints, slots, rows, scratch, nodes), parts = parts_of(program)
    scalars, vectors, turns, inputs, constants, copies, registers = parts
    operands = {0: 2, 1: 2, 2: 2, 3: 4, 4: 4, 5: 3, 6: 3, 7: 3}
    uses = Counter(slot for operation, *entry in vectors for slot in entry[: operands[operation]])
    uses.update(slot for _, sign, slot in copies if sign)
    summed = {slot for operation, a, b, *_ in vectors if operation in (1, 2) for slot in (a, b)}
    for operation, *_, to in vectors:
        assert to < rows or uses[to] > 0
        assert operation != 0 or to < rows or to not in summed or uses[to] > 1
    assert joints == 1 + max([joint for _, joint in inputs] + [turn[0] for turn in turns])
    assert nodes == 1 + max([0, *(entry[3] for entry in scalars)])
    assert scratch == len({register for _, register in registers}) <= len(registers)
    assert slots >= 1 + max(slot for part in (inputs, constants, registers) for slot, _ in part)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_shorter_of_both_programs_is_taken_by_counting(name: str) -> None:
    """Traced from the base or from behind the first joint that turns: fewer operations and copies."""
    robot = ROBOTS[name]()
    wanted = robot._layout.parameter_elements + robot._layout.joint_elements
    structure = kinematics.structure_of(
        robot.elements,
        robot.targets,
        kinematics.codes_of(
            robot._nominal_amounts, np.array([e.is_rotation and e.joint is None for e in flat(robot)])
        ),
        wanted,
        wanted,
    )
    turning = [k for k, e in enumerate(robot.elements) if e.is_rotation and e.joint is not None]
    split = kinematics.first_turn(structure)
    assert split == (turning[0] + 1 if turning else 0)
    shape, lengths = (len(robot.targets), len(wanted), len(wanted)), []
    for each in (0, split):
        traced = kinematics.trace(structure, each)
        program = kinematics._lay_out(*traced, shape)
        lengths.append(len(program.vectors) + len(program.copies))
        assert kinematics._operations(*traced) == lengths[-1]
    taken = kinematics.compile_program(structure)
    assert len(taken.vectors) + len(taken.copies) == min(lengths)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_program_may_be_traced_from_any_element(name: str) -> None:
    """Positions, columns, axes and origins of all elements are those of the trace in the base frame."""
    robot = ROBOTS[name]()
    wanted, trunk = tuple(range(len(flat(robot)))), tuple(range(len(robot.elements)))
    amounts = robot._nominal_amounts + 1e-3 * (robot._nominal_amounts != 0.0)
    turning = np.array([e.is_rotation and e.joint is None for e in flat(robot)])
    structure = kinematics.structure_of(
        robot.elements, robot.targets, kinematics.codes_of(amounts, turning), wanted, trunk, trunk
    )
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (len(robot.joint_names), 2))
    shape, expected = (len(robot.targets), len(wanted), len(trunk)), None
    for split in (0, kinematics.first_turn(structure), len(trunk) // 2):
        program = kinematics._lay_out(*kinematics.trace(structure, split), shape)
        got = program.run_numpy(q, amounts)
        expected = got if expected is None else expected
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(interpreted(program, q, amounts), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_register_is_free_again_when_its_vector_has_been_read(name: str) -> None:
    """There are as many as vectors live at once: from the operation that makes one to the last that reads it."""
    program = program_of_all(ROBOTS[name]())
    (_, _, _, scratch, _), parts = parts_of(program)
    plain = [((a, b), slot) for _, a, b, slot in program.vectors]
    fused = [(tuple(entry[1:5]), entry[5]) for entry in parts[1]]
    for vectors, registers, count in ((plain, program.registers, program.scratch), (fused, parts[6], scratch)):
        made = {slot: step for step, (_, slot) in enumerate(vectors)}
        last = {slot: step for step, (operands, _) in enumerate(vectors) for slot in operands}
        last |= {slot: len(vectors) for _, sign, slot in program.copies if sign}
        slots = [slot for slot, _ in registers]
        live = [sum(made[s] <= step <= last[s] for s in slots) for step in range(len(vectors))]
        assert count == max(live, default=0)
