"""Plans as YAML, exact to the bit: what was written is what is read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib_planner.io.yaml import Node, read_document, write_document
from calib_planner.planning import KEYS, KINDS, Plan

SHAPES: dict[str, tuple[str, ...]] = {
    "configurations": ("configurations", "joint_names"),
    "repetitions": ("configurations",),
    "test_poses": ("weights", "joint_names"),
    "weights": ("weights",),
    "predicted_accuracy_per_test_pose": ("weights",),
    "parameter_std": ("parameters",),
}
"""Per array the fields whose lengths its axes have."""

FINITE = ("configurations", "test_poses", "weights")


def write_plan(path: str | Path, plan: Plan, field: str = "output") -> None:
    """Write a plan [rad | m].

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    write_document(path, "plan", plan.values(), field)


def read_plan(path: str | Path) -> Plan:
    """Read a plan.

    Raises:
        FileFormatError: Not a plan of ours; names the key at fault, what it holds and what is valid.
    """
    return parse_plan(read_document(path, "plan"))


def parse_plan(document: Node, finite: Sequence[str] = FINITE) -> Plan:
    """The plan in a mapping of its values, of which the arrays in ``finite`` have to be.

    Raises:
        FileFormatError: As ``read_plan``.
    """
    document.mapping(KEYS, KEYS, "was it written by another version?")
    values = {name: document[name].of_kind(KINDS[name]) for name in KEYS}
    for name, axes in SHAPES.items():
        wanted = tuple(len(values[a]) for a in axes)
        if values[name].shape != wanted:
            expected = f"an array of shape {wanted} (as {', '.join(axes)})"
            raise document[name].error(f"shape {values[name].shape}", expected)
    for name in finite:
        if not np.isfinite(values[name]).all():
            raise document[name].error("a number that is not finite", "finite numbers only")
    if not (values["repetitions"] >= 1).all():
        raise document["repetitions"].error("a number below 1", "whole numbers >= 1")
    return Plan.from_values(values)
