# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""An irreducible set of parameters, of matrices whose dependencies are known."""

from __future__ import annotations

import numpy as np
import pytest

from calib_planner.robot import analyse, describe

NAMES = ("q1", "base.rz", "d1", "d2", "q2", "target_1.x", "q3")


def dependent(equations: int = 20) -> np.ndarray:
    """q1 = 2 · base.rz, q2 = d1 − 3 · d2, and q3 moves nothing; lengths differ by orders of size."""
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(equations, 7)) * np.array([1.0, 1.0, 1e-3, 1e-3, 1.0, 50.0, 0.0])
    matrix[:, 0] = 2.0 * matrix[:, 1]
    matrix[:, 4] = matrix[:, 2] - 3.0 * matrix[:, 3]
    return matrix


def test_base_and_targets_come_first_and_of_dependent_ones_the_first_stay() -> None:
    matrix = dependent()
    seen = analyse(matrix, NAMES)
    assert seen.free == (1, 5, 2, 3) and seen.rank == 4 == np.linalg.matrix_rank(matrix)
    assert seen.fixed == (0, 4, 6)
    expected = np.zeros((3, 7))
    expected[0, [0, 1]] = 1.0, -2.0
    expected[1, [4, 2, 3]] = 1.0, -1.0, 3.0
    expected[2, 6] = 1.0
    np.testing.assert_allclose(seen.directions, expected, atol=1e-9)
    np.testing.assert_array_equal(seen.directions != 0, expected != 0)
    np.testing.assert_allclose(matrix @ seen.directions.T, 0.0, atol=1e-12)
    assert seen.combinations == ("1·q1 - 2·base.rz", "1·q2 - 1·d1 + 3·d2", "q3")


@pytest.mark.parametrize("equations", [20, 5, 4])
def test_a_length_is_how_far_a_parameter_moves_the_points_beside_those_before_it(equations: int) -> None:
    matrix = dependent(equations)
    seen = analyse(matrix, NAMES)
    assert len(seen.free) == 4
    for k, (index, length) in enumerate(zip(seen.free, seen.lengths, strict=True)):
        before, own = matrix[:, list(seen.free[:k])], matrix[:, index]
        rest = own - (before @ np.linalg.lstsq(before, own, rcond=None)[0] if k else 0.0)
        assert length == pytest.approx(np.linalg.norm(rest), rel=1e-9, abs=0.0)
    np.testing.assert_allclose(matrix @ seen.directions.T, 0.0, atol=1e-9 * np.abs(matrix).max())


def test_fewer_equations_than_parameters_free_no_more_than_there_are() -> None:
    matrix = np.random.default_rng(1).normal(size=(3, 7))
    seen = analyse(matrix, NAMES)
    assert seen.free == (1, 5, 0) and len(seen.fixed) == 4
    assert analyse(matrix, NAMES, tolerance=0.0).free == seen.free
    np.testing.assert_allclose(matrix @ seen.directions.T, 0.0, atol=1e-9)
    nothing = analyse(np.zeros((6, 7)), NAMES)
    assert nothing.rank == 0 and nothing.fixed == (1, 5, 0, 2, 3, 4, 6)
    np.testing.assert_array_equal(nothing.directions, np.eye(7)[list(nothing.fixed)])
    assert nothing.combinations == tuple(NAMES[i] for i in nothing.fixed)


def test_how_little_is_nothing() -> None:
    """A share of the column's own length, the least length that somebody states, and 1e-12 m per unit."""
    rng = np.random.default_rng(2)
    matrix = rng.normal(size=(10, 3))
    matrix[:, 2] = matrix[:, 0] + 1e-4 * matrix[:, 2]
    names = ("a", "b", "c")
    rest = np.array(analyse(matrix, names, tolerance=1e-12).lengths)
    share = rest[2] / np.linalg.norm(matrix[:, 2])
    assert analyse(matrix, names, tolerance=0.9 * share).free == (0, 1, 2)
    assert analyse(matrix, names, tolerance=1.1 * share).free == (0, 1)
    for factor, free in ((0.9, (0, 1, 2)), (1.1, (0, 1))):
        assert analyse(matrix, names, tolerance=1e-12, shortest=factor * rest * [0.0, 0.0, 1.0]).free == free
    for size, free in ((0.5e-12, (0, 1)), (2e-12, (0, 1, 2))):
        matrix[:, 2] = size * np.where(np.arange(10) % 2, 1.0, -1.0)
        for tolerance in (1e-6, 1e-14):
            assert analyse(matrix, names, tolerance).free == free


@pytest.mark.parametrize(("share", "said"), [(0.9e-4, "1·q3 - 1·d1"), (1.2e-4, "1·q3 - 1·d1 - 0.00012·d2")])
def test_shares_that_are_not_worth_a_word(share: float, said: str) -> None:
    """Of unit columns: d1 and d2 move the points by millimetres per unit, q3 as d1 does and a little as d2."""
    matrix = np.random.default_rng(3).normal(size=(30, 3))
    matrix *= 1e-3 / np.linalg.norm(matrix, axis=0)
    matrix[:, 2] = matrix[:, 0] + share * matrix[:, 1]
    seen = analyse(matrix, ("d1", "d2", "q3"))
    assert seen.combinations == (said,)
    np.testing.assert_allclose(seen.directions, [[-1.0, -share, 1.0]], rtol=1e-9)


def test_a_combination_in_words() -> None:
    direction = np.array([0.0, -1.23456, 1.0, 0.5])
    assert describe(direction, ("a", "b", "c", "d"), 2) == "1·c - 1.23·b + 0.5·d"
    assert describe(-direction, ("a", "b", "c", "d"), 2) == "- 1·c + 1.23·b - 0.5·d"
    assert describe(np.array([0.0, 2.0]), ("a", "b"), 1) == "b"
