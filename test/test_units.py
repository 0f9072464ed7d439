# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Quantities as people write them."""

from __future__ import annotations

import numpy as np
import pytest

from calib_planner.units import PER_UNIT, lengths, quantity


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("2e-5", "m", 2e-5),
        ("20um", "m", 2e-5),
        ("20 µm", "m", 2e-5),
        ("20 μm", "m", 2e-5),
        ("0.02mm", "m", 2e-5),
        (" -1.5 cm ", "m", -1.5e-2),
        ("1in", "m", 0.0254),
        ("3m", "m", 3.0),
        ("+.5", "m", 0.5),
        ("1E3nm", "m", 1e-6),
        ("90deg", "rad", np.pi / 2),
        ("90°", "rad", np.pi / 2),
        ("2mrad", "rad", 2e-3),
        ("2min", "s", 120.0),
        ("1.5h", "s", 5400.0),
        ("500 g", "kg", 0.5),
        ("inf", "m", np.inf),
    ],
)
def test_quantities(text: str, unit: str, value: float) -> None:
    assert quantity(text, unit) == pytest.approx(value, rel=1e-15)


def test_decimal_units_are_exact() -> None:
    """A number in mm or µm is the one that is written in metres."""
    for digits in (3, 7, 20, 57, 123, 999):
        assert quantity(f"{digits}um") == float(f"{digits}e-6")
        assert quantity(f"{digits}mm") == float(f"{digits}e-3")
        assert quantity(f"{digits / 100}mm") == float(f"{digits / 100}e-3")


@pytest.mark.parametrize("text", ["", "mm", "1 2", "1 ft", "1mm2", "0,5mm", "1e", "0x10", "1_000", "--1", "1m m"])
def test_what_is_no_length(text: str) -> None:
    with pytest.raises(ValueError, match=r"\[m\].*m, cm, mm, um, nm, in"):
        quantity(text)
    assert "um" in PER_UNIT["m"]


def test_another_kind_of_unit_is_refused() -> None:
    with pytest.raises(ValueError, match=r"number \[rad\]"):
        quantity("1mm", "rad")


def test_lengths_that_are_compared_have_one_unit() -> None:
    assert lengths(8.303e-3, 6.17e-5) == ("8.30 mm", "0.0617 mm")
    assert lengths(5.26e-4, 4.66e-4) == ("526 µm", "466 µm")
    assert lengths(0.123, 1e-3, 4e-9) == ("123 mm", "1.00 mm", "0.000004 mm")
    assert lengths(2e-5, np.inf) == ("20.0 µm", "unlimited") and lengths(np.inf) == ("unlimited",)
    assert lengths(0.0, 9.994e-4) == ("0 µm", "999 µm")
