# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Limits and reflectors that cannot be meant as they stand: a table by hand."""

from __future__ import annotations

import numpy as np
import pytest

from calib_planner import InputError, Robot
from calib_planner.robot import believable_limits, check_reflectors, limit_remarks

PI = np.pi


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (-2.0, 2.5),
        (0.0, 4 * PI),  # two turns
        (-4 * PI, 1.0),
        (-12.56, 12.56),
        (-6 * PI, 6 * PI),  # further, of whole half turns
        (-PI, 7 * PI),
        (-18.85, 18.85),  # written with two decimals
        (-719 * PI, 0.0),
        (0.0, 5.0009 * PI),
        (-4.9991 * PI, 0.0),
    ],
)
def test_limits_of_an_arm_stay(low: float, high: float) -> None:
    assert believable_limits("j", low, high, turns=True) == (low, high, "")


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (-180.0, 180.0),
        (-120.0, 35.0),
        (0.0, 90.0),
        (-13.0, 13.0),
        (-720.0, 1.0),
        (-10.0, 720.0),
        (-5.0011 * PI, 0.0),
    ],
)
def test_more_than_two_turns_are_degrees(low: float, high: float) -> None:
    *limits, said = believable_limits("j", low, high, turns=True)
    assert limits == pytest.approx([low * PI / 180.0, high * PI / 180.0])
    assert said == f"{low:g} and {high:g} rad: they are read as degrees"


@pytest.mark.parametrize("far", [721.0, 1e16, 720 * PI, 1000 * PI])
def test_huge_numbers_are_no_limits(far: float) -> None:
    for low, high in ((-far, far), (-1.0, far), (-far, 1.0)):
        *limits, said = believable_limits("j", low, high, turns=True)
        assert limits == [-PI, PI]
        assert said.endswith("treated as continuous, from -180 to 180 degrees")


def test_a_sliding_joint_of_hundreds_of_metres_is_refused() -> None:
    for low, high in ((-100.0, 100.0), (0.0, 13.0), (-99.0, 0.0)):
        assert believable_limits("lift", low, high, turns=False) == (low, high, "")
    for low, high in ((-100.5, 0.0), (0.0, 100.5), (-300.0, 20.0)):
        with pytest.raises(InputError, match=r"limits of lift.*millimetres"):
            believable_limits("lift", low, high, turns=False)


def test_what_is_said_alike_is_one_sentence() -> None:
    assert limit_remarks([("a", "x"), ("b", ""), ("c", "y"), ("d", "x")]) == [
        "limits of a, d are x",
        "limits of c are y",
    ]


def test_a_reflector_is_no_farther_than_the_arm_is_long_or_than_a_metre() -> None:
    """1.8 m of planar arm; a shorter one may still carry a metre. All segments count, wherever the base is."""
    robot = Robot.load("planar_2r")
    large = Robot.load("kuka_kr270").with_base(np.eye(3), [3.0, -1.0, 2.0])
    length = 0.75 + 0.35 + 1.25 + np.hypot(0.055, 1.1) + 0.23
    short = robot.with_deviations({"l1": -0.75, "l2": -0.6})
    for arm, most in ((robot, 1.8), (short, 1.0), (large, length)):
        for way in ([0.0, 0.6, 0.8], [-1.0, 0.0, 0.0]):
            near, far = ((most + d) * np.array(way) for d in (-1e-6, 1e-6))
            check_reflectors(arm.with_targets([near, 0.5 * near]))
            with pytest.raises(
                InputError, match=r"tool.*reflector 2 at .* from the flange.*millimetres\?"
            ) as caught:
                check_reflectors(arm.with_targets([near, far, far]), "tool")
            assert f"{most:.3g}" in str(caught.value)
