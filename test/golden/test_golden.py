# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What users get from ``calib-planner`` is what ``expected/`` says; see README.md."""

from __future__ import annotations

from pathlib import Path

import pytest
from cases import CASES, REAL, Case
from golden import COARSE, EXACT, EXPECTED, SEARCHED, Inputs, Tolerance, answer, changes, differences, kept
from robots import repeats

MOST_SHOWN = 20


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    return Inputs(tmp_path_factory.mktemp("inputs"))


@pytest.mark.parametrize("case", repeats([c for c in CASES if not c.heavy], CASES), ids=lambda c: c.name)
def test_users_get_the_same(case: Case, inputs: Inputs, tmp_path: Path) -> None:
    if case.real and not REAL.is_dir():
        pytest.skip(f"no measured data in {REAL}")
    found = changes(case, answer(case, inputs, tmp_path))
    more = [f"… and {len(found) - MOST_SHOWN} more"] if len(found) > MOST_SHOWN else []
    advice = f"intended? python test/golden/update.py {case.name}"
    assert not found, "\n".join([f"calib-planner {case.line}", *found[:MOST_SHOWN], *more, advice])


def test_every_expected_file_has_its_case() -> None:
    names = [c.name for c in CASES]
    assert len(set(names)) == len(names)
    assert {p.stem for p in EXPECTED.glob("*.json")} == {*names, "doors", "nodes", "interfaces", "arithmetic"}


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        (1.0, 1.0 + 1e-13, True),
        (1.0, 1.0 + 1e-11, False),
        (0.0, 1e-30, False),
        ({"std": 0.0}, {"std": 1e-15}, False),
        ({"deviation": 0.0}, {"deviation": 1e-15}, True),
        ({"deviation": 0.0}, {"deviation": 1e-13}, False),
        ([1.0, 0.0], [1.0, 1e-15], True),
        ([1.0, 0.0], [1.0, 1e-13], False),
        ([[1.0, 0.0], [0.0, 2.0]], [[1.0, 0.0], [1e-15, 2.0]], True),
        (1, 1.0, False),
        (1.0, True, False),
        (1, True, False),
        (None, 0.0, False),
        ([1.0], [1.0, 2.0], False),
        ({"a": 1}, {"a": 1, "b": 2}, False),
        ({"a": 1, "b": 2}, {"a": 1}, False),
        ({"status": "ok"}, {"status": "Ok"}, False),
        ({"message": "Done."}, {"message": "Ready."}, True),
        ({"message": "Done."}, {"message": ""}, False),
        ({"message": "Done."}, {"message": None}, False),
        ({"combination": "1·a + 0.333·b"}, {"combination": "1·a + 0.334·b"}, True),
        ({"combination": "1·a + 0.333·b"}, {"combination": "1·a + 0.333·c"}, False),
        ({"combination": "1·a + 0.333·b"}, {"combination": "1·a + 0.393·b"}, False),
    ],
)
def test_what_counts_as_the_same(old: object, new: object, same: bool) -> None:
    assert (not list(differences(old, new))) == same


@pytest.mark.parametrize(
    ("tolerance", "old", "new", "same"),
    [
        (COARSE, {"sigma": 1e-5}, {"sigma": 1.0001e-5}, True),
        (COARSE, {"sigma": 1e-5}, {"sigma": 1.01e-5}, False),
        (COARSE, {"status": "ok"}, {"status": "singular"}, False),
        (SEARCHED, {"value": 1.0}, {"value": 1.1}, True),
        (SEARCHED, {"value": 1.0}, {"value": 1.5}, False),
        (SEARCHED, {"lower_bound": 1.0}, {"lower_bound": 1.1}, False),
        (SEARCHED, {"configurations": [[1.0, 2.0]]}, {"configurations": [[3.0, 4.0]]}, True),
        (SEARCHED, {"configurations": [[1.0, 2.0]]}, {"configurations": [[3.0]]}, False),
        (SEARCHED, {"configurations": [1.0]}, {"configurations": [None]}, False),
        (SEARCHED, {"bound": "proven"}, {"bound": "none"}, False),
    ],
)
def test_what_counts_as_the_same_on_another_machine(
    tolerance: Tolerance, old: object, new: object, same: bool
) -> None:
    assert (not list(differences(old, new, tolerance))) == same
    assert list(differences(old, new, EXACT))


def test_long_lists_are_summed_without_losing_an_entry() -> None:
    rows: list[list[float | None]] = [[0.1 * i - 3.05 + j for j in range(4)] for i in range(50)]
    before = kept(rows)
    assert rows[20][1] == pytest.approx(-0.05)
    assert before["shape"] == [50, 4] and not list(differences(before, kept(rows)))
    for value in (-0.05 + 1e-9, 0.05, None):
        changed = [list(row) for row in rows]
        changed[20][1] = value
        assert list(differences(before, kept(changed))), value
    swapped = [*rows[:20], rows[21], rows[20], *rows[22:]]
    assert list(differences(before, kept(swapped)))
