# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Names of parameters: their roles, and what a request makes of them, by hand."""

from __future__ import annotations

import pytest

from calib_planner import FileFormatError, InputError, UnknownNameError
from calib_planner.robot import check_joint_names, grouped, is_nuisance, role_of, target_parameters
from calib_planner.robot.parameters import BASE_PARAMETERS, resolve_parameters

AVAILABLE = ("base.x", "l1", "l2", "q1", "q2", *target_parameters(2))
LEVELS = {"lengths": ("l1", "l2"), "offsets": ("q1", "q2")}


def test_roles() -> None:
    roles = {"base.x": "base", "base.rz": "base", "target_1.x": "target", "target_12.z": "target"}
    roles |= dict.fromkeys(("l1", "basement.x", "base_2.x", "target.x", "target_x.x", "a.base", "q1"), "chain")
    for name, role in roles.items():
        assert role_of(name) == role
        assert is_nuisance(name) == (role != "chain")


def test_names_of_targets_count_from_one() -> None:
    assert target_parameters(2) == tuple(f"target_{t}.{a}" for t in "12" for a in "xyz")
    names = ["q1", "base.x", "target_2.x", "base.rz", "l1.x", "target_2.z", "target_1.x"]
    assert grouped(names) == ["q1", "base.*", "target_2.*", "l1.x", "target_1.*"]


@pytest.mark.parametrize(
    ("request_", "unknown", "names"),
    [
        ("offsets", (), ["q1", "q2"]),
        (" l2 , offsets", (), ["l2", "q1", "q2"]),
        (["q2", "l1"], ("base",), [*BASE_PARAMETERS, "q2", "l1"]),
        ("l1", ("tool",), ["l1", *target_parameters(2)]),
        ("l1", ("tool", " base "), [*BASE_PARAMETERS, "l1", *target_parameters(2)]),
        # What is named keeps its place and comes once.
        (
            "l1,target_2.x,base.x",
            ("base", "tool"),
            [
                *BASE_PARAMETERS[1:],
                "l1",
                "target_2.x",
                "base.x",
                *target_parameters(1),
                "target_2.y",
                "target_2.z",
            ],
        ),
    ],
)
def test_a_request(request_: str | list[str], unknown: tuple[str, ...], names: list[str]) -> None:
    assert resolve_parameters(request_, unknown, AVAILABLE, LEVELS, 2) == tuple(names)


@pytest.mark.parametrize("word", ["", "axis", "bas", "basement", "lengths", "to", "tools", "zero"])
def test_only_base_and_tool_may_be_unknown(word: str) -> None:
    with pytest.raises(UnknownNameError, match="base, tool"):
        resolve_parameters("lengths", (word,), AVAILABLE, LEVELS, 2)


@pytest.mark.parametrize(
    ("request_", "words"),
    [("l1,q1,l1", "at most once, got l1"), ("q2,lengths,l2,q2", "got l2, q2"), ([], "at least one parameter")],
)
def test_twice_or_nothing_is_refused(request_: str | list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        resolve_parameters(request_, (), AVAILABLE, LEVELS, 2)


@pytest.mark.parametrize(
    "names", [["a", "b", "a"], ["base", "b"], ["b", "target_3"], ["a,b"], [" a"], ["a "], [" "]]
)
def test_names_of_joints_that_would_be_taken_for_others(names: list[str]) -> None:
    with pytest.raises(FileFormatError, match=r"robot\.urdf"):
        check_joint_names("robot.urdf", names)
    check_joint_names("robot.urdf", ["a", "base_2", "target", "target_x", "a b"])
