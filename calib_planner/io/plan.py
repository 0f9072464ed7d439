"""Plans as YAML, exact to the bit: what was written is what is read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.errors import FileFormatError
from calib_planner.io.yaml import check_keys, read_document, read_value, write_document
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
    return parse_plan(path, read_document(path, "plan"))


def parse_plan(path: str | Path, document: Any, finite: Sequence[str] = FINITE) -> Plan:
    """The plan in a mapping of its fields, of which the arrays in ``finite`` have to be.

    Raises:
        FileFormatError: As ``read_plan``; ``path`` is for the error.
    """
    document = check_keys(path, "document", document, KEYS)
    values = {n: read_value(path, n, KINDS[n], document[n]) for n in KEYS}
    for name, axes in SHAPES.items():
        wanted = tuple(len(values[a]) for a in axes)
        if values[name].shape != wanted:
            expected = f"an array of shape {wanted} (as {', '.join(axes)})"
            raise FileFormatError(path, name, f"shape {values[name].shape}", expected)
    for name in finite:
        if not np.isfinite(values[name]).all():
            raise FileFormatError(path, name, "a number that is not finite", "finite numbers only")
    if not (values["repetitions"] >= 1).all():
        raise FileFormatError(path, "repetitions", "a number below 1", "whole numbers >= 1")
    return Plan.from_values(values)
