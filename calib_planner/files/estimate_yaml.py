"""Estimates as YAML: the keys are those of ``identify --json``; unknown numbers are null."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner._arrays import FloatArray, frozen
from calib_planner.errors import FileFormatError
from calib_planner.files.document import check_keys, read_document, read_value, write_document
from calib_planner.identification.estimate import Estimate

PARAMETER_KEYS = ("name", "unit", "nominal", "value", "deviation", "std")


@dataclass(frozen=True, eq=False)
class SavedEstimate:
    """What an estimate file says about the parameters.

    Attributes:
        robot: Name of the robot.
        joint_names: Order of joint arrays.
        parameters: P names, the order of all parameter arrays.
        units: ``m`` or ``rad``.
        nominal: (P,) [unit].
        deviations: (P,) identified value − nominal [unit].
        std: (P,) standard deviations [unit], NaN where held.
        covariance: (P, P), eq. (11).
        sigma: Standard deviation of one coordinate that the covariance rests on [m].
        status: A key of ``identification.estimate.STATUS``.
        document: Everything that the file holds, as plain values.
    """

    robot: str
    joint_names: tuple[str, ...]
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    nominal: FloatArray
    deviations: FloatArray
    std: FloatArray
    covariance: FloatArray
    sigma: float
    status: str
    document: dict[str, Any]


def write_estimate(path: str | Path, estimate: Estimate, field: str = "output") -> None:
    """Write an estimate, [m] and [rad].

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    write_document(path, "estimate", estimate.to_dict(), field)


def read_estimate(path: str | Path) -> SavedEstimate:
    """Read what ``write_estimate`` wrote.

    Raises:
        FileFormatError: Not an estimate of ours; names the key at fault and what is valid.
    """
    document = read_document(path, "estimate")
    needed = ("robot", "joint_names", "parameters", "covariance", "sigma", "status")
    check_keys(path, "document", document, needed, tuple(document))
    rows = document["parameters"]
    if not isinstance(rows, list) or not rows:
        raise FileFormatError(path, "parameters", repr(rows)[:60], "a list with a row per parameter")
    for i, row in enumerate(rows):
        check_keys(path, f"parameters[{i}]", row, PARAMETER_KEYS)
    columns = {k: [_nan(row[k]) for row in rows] for k in PARAMETER_KEYS}

    def value(key: str, kind: str, item: Any) -> Any:
        return read_value(path, key, kind, item)

    covariance = value("covariance", "FloatArray", document["covariance"])
    if covariance.shape != (len(rows), len(rows)):
        wanted = f"a square matrix of {len(rows)} rows, one per parameter"
        raise FileFormatError(path, "covariance", f"shape {covariance.shape}", wanted)
    numbers = {k: value(f"parameters[].{k}", "FloatArray", columns[k]) for k in PARAMETER_KEYS[2:]}
    return SavedEstimate(
        robot=value("robot", "str", document["robot"]),
        joint_names=value("joint_names", "tuple[str, ...]", document["joint_names"]),
        parameters=value("parameters[].name", "tuple[str, ...]", columns["name"]),
        units=value("parameters[].unit", "tuple[str, ...]", columns["unit"]),
        nominal=frozen(numbers["nominal"]),
        deviations=frozen(numbers["deviation"]),
        std=frozen(numbers["std"]),
        covariance=frozen(covariance),
        sigma=value("sigma", "float", _nan(document["sigma"])),
        status=value("status", "str", document["status"]),
        document=document,
    )


def _nan(value: Any) -> Any:
    return np.nan if value is None else value
