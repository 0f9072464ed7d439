"""Estimates as YAML: the keys are those of ``identify --json``, and what it takes to rebuild the robot.

What is written comes back to the bit. A number that is unknown (NaN) is null; one that is infinite is ``.inf``: a
test pose whose accuracy rests on what the data cannot see. Writing what was read gives the same file.

    base: {x, y, z, yaw, pitch, roll, rx, ry, rz}    # the robot in the tracker's frame, see saved_estimate
    targets: [[x, y, z], …]                          # in the tip's frame
"""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calib_planner._arrays import FloatArray, frozen
from calib_planner.errors import FileFormatError
from calib_planner.files.document import check_keys, read_document, read_value, write_document
from calib_planner.files.saved_estimate import BASE, SavedCorrections, SavedEstimate
from calib_planner.identification.estimate import ChiSquare, Estimate
from calib_planner.identification.noise_levels import NoiseLevels
from calib_planner.identification.verdict import Reason, Verdict
from calib_planner.robot.joint_corrections import JointCorrections

T = TypeVar("T")
PARAMETER_KEYS = ("name", "unit", "nominal", "value", "deviation", "std")
NEEDED = ("robot", "joint_names", "parameters", "covariance", "sigma", "status")
SERIES = ("scale", "shift", "cosines", "sines")
PER_POSE = "predicted_accuracy_per_test_pose"
UNLIMITED = (
    PER_POSE,
    "predicted_accuracy",
    "geometry_accuracy_per_test_pose",
    "parameter_accuracy_per_test_pose",
)
"""What can be infinite; JSON has no word for it, YAML has."""


def write_estimate(path: str | Path, estimate: Estimate | SavedEstimate, field: str = "output") -> None:
    """Write an estimate, [m] and [rad], or one that was read.

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    content = estimate.document if isinstance(estimate, SavedEstimate) else document_of(estimate)
    write_document(path, "estimate", content, field)


def document_of(estimate: Estimate) -> dict[str, Any]:
    """What ``write_estimate`` writes, without its format line, as plain values."""
    result = estimate.to_dict()
    result |= {name: _null(getattr(estimate, name)) for name in UNLIMITED if name in result}
    return result | {"required_accuracy": _null(estimate.required_accuracy), **placement(estimate)}


def placement(estimate: Estimate) -> dict[str, Any]:
    """Where the robot stands in the tracker's frame and the targets in the tip's, as plain values."""
    robot = estimate.calibrated
    base = {name: e.value for name, e in zip(BASE, robot.elements[: len(BASE)], strict=True)}
    return {"base": base, "targets": robot.target_offsets.tolist()}


def read_estimate(path: str | Path) -> SavedEstimate:
    """Read what ``write_estimate`` wrote.

    Raises:
        FileFormatError: Not an estimate of ours; names the key at fault and what is valid.
    """
    return parse_estimate(path, read_document(path, "estimate"))


def parse_estimate(path: str | Path, document: dict[str, Any]) -> SavedEstimate:
    """The estimate that a document holds; ``path`` is for errors, which are those of ``read_estimate``."""
    check_keys(path, "document", document, NEEDED, tuple(document))
    rows = document["parameters"]
    if not isinstance(rows, list) or not rows:
        raise FileFormatError(path, "parameters", repr(rows)[:60], "a list with a row per parameter")
    for i, row in enumerate(rows):
        check_keys(path, f"parameters[{i}]", row, PARAMETER_KEYS)
    columns: dict[str, Any] = {k: [row[k] for row in rows] for k in PARAMETER_KEYS}
    names = read_value(path, "parameters[].name", "tuple[str, ...]", columns["name"])
    if len(set(names)) < len(names):
        raise FileFormatError(path, "parameters[].name", "a name twice", "each name once")
    columns |= {k: _finite(path, f"parameters[].{k}", columns[k], (len(rows),)) for k in PARAMETER_KEYS[2:5]}
    per = document.get(PER_POSE) or []
    return SavedEstimate(
        robot=read_value(path, "robot", "str", document["robot"]),
        joint_names=read_value(path, "joint_names", "tuple[str, ...]", document["joint_names"]),
        parameters=names,
        units=read_value(path, "parameters[].unit", "tuple[str, ...]", columns["unit"]),
        nominal=columns["nominal"],
        values=columns["value"],
        deviations=columns["deviation"],
        std=_array(path, "parameters[].std", columns["std"], (len(rows),)),
        covariance=_array(path, "covariance", document["covariance"], (len(rows), len(rows))),
        sigma=read_value(path, "sigma", "float", _nan(document["sigma"])),
        status=read_value(path, "status", "str", document["status"]),
        base=_base(path, document.get("base")),
        targets=_targets(path, document.get("targets")),
        noise=_made(path, "noise", document.get("noise"), NoiseLevels),
        chi_square=_made(path, "chi_square", document.get("chi_square"), ChiSquare, ("probability",)),
        verdict=_verdict(path, document.get("verdict")),
        predicted_accuracy_per_test_pose=_array(path, PER_POSE, per, (None,)),
        joint_corrections=_corrections(path, document),
        document=document,
    )


# ── parts of a document ──────────────────────────────────────────────────────────────────────────────


def _array(path: str | Path, key: str, value: Any, shape: tuple[int | None, ...]) -> FloatArray:
    """Numbers, null being NaN, of a shape in which ``None`` is any length."""
    array: FloatArray = read_value(path, key, "FloatArray", _nan(value))
    if len(array.shape) != len(shape) or any(w not in (None, n) for w, n in zip(shape, array.shape, strict=True)):
        wanted = " × ".join("any" if n is None else str(n) for n in shape)
        raise FileFormatError(path, key, f"shape {array.shape}", f"numbers, {wanted}")
    return frozen(array)


def _base(path: str | Path, value: Any) -> FloatArray | None:
    if value is None:
        return None
    base = check_keys(path, "base", value, BASE)
    return _finite(path, "base", [base[name] for name in BASE], (len(BASE),))


def _targets(path: str | Path, value: Any) -> FloatArray | None:
    return None if value is None else _finite(path, "targets", value, (None, 3))


def _finite(path: str | Path, key: str, value: Any, shape: tuple[int | None, ...]) -> FloatArray:
    array = _array(path, key, value, shape)
    if not np.isfinite(array).all():
        raise FileFormatError(path, key, "a number that is not finite", "finite numbers")
    return array


def _made(path: str | Path, key: str, value: Any, kind: type[T], more: tuple[str, ...] = ()) -> T | None:
    """A dataclass from the mapping of its fields; keys in ``more`` are derived from them.

    Fields with a default may be missing: an older version did not know them.
    """
    if value is None:
        return None
    kinds = {f.name: str(f.type) for f in fields(kind)}  # type: ignore[arg-type]
    needed = [f.name for f in fields(kind) if f.default is MISSING]  # type: ignore[arg-type]
    found = check_keys(path, key, value, needed, (*kinds, *more))

    def item(name: str) -> Any:
        given = _nan(found[name]) if kinds[name] == "float" else found[name]
        return read_value(path, f"{key}.{name}", kinds[name], given)

    return kind(**{name: item(name) for name in kinds if name in found})


def _corrections(path: str | Path, document: dict[str, Any]) -> SavedCorrections | None:
    given = document.get("joint_corrections")
    if given is None:
        return None
    top = "joint_corrections"
    found = check_keys(path, top, given, ("parameters", *SERIES), tuple(given))
    names, count = [row["name"] for row in document["parameters"]], len(document["joint_names"])
    values = check_keys(path, f"{top}.parameters", found["parameters"], names)
    shapes = {"scale": (count,), "shift": (count,), "cosines": (count, None), "sines": (count, None)}
    series = {name: _finite(path, f"{top}.{name}", found[name], shapes[name]) for name in SERIES}
    if series["cosines"].shape != series["sines"].shape:
        got = f"shape {series['sines'].shape}"
        raise FileFormatError(path, f"{top}.sines", got, f"shape {series['cosines'].shape}, as cosines")
    corrections = JointCorrections(tuple(document["joint_names"]), **series)
    numbers = _finite(path, f"{top}.parameters", [values[n] for n in names], (len(names),))
    return SavedCorrections(corrections, tuple(names), numbers)


def _verdict(path: str | Path, value: Any) -> Verdict | None:
    if value is None:
        return None
    found = check_keys(path, "verdict", value, ("level", "reasons"))
    if not isinstance(found["reasons"], list):
        raise FileFormatError(path, "verdict.reasons", repr(found["reasons"])[:60], "a list of reasons")
    made = [_made(path, f"verdict.reasons[{i}]", r, Reason) for i, r in enumerate(found["reasons"])]
    reasons = tuple(r for r in made if r is not None)
    return Verdict(read_value(path, "verdict.level", "str", found["level"]), reasons)


# ── unknown numbers ──────────────────────────────────────────────────────────────────────────────────


def _nan(value: Any) -> Any:
    """null as NaN, also in lists."""
    if isinstance(value, list):
        return [_nan(v) for v in value]
    return np.nan if value is None else value


def _null(value: Any) -> Any:
    """Arrays to lists and NaN to null; infinities stay."""
    if isinstance(value, np.ndarray):
        return _null(value.tolist())
    if isinstance(value, list):
        return [_null(v) for v in value]
    return None if np.isnan(value) else value
