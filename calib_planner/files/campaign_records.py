"""What a campaign keeps of every standstill, and how it stands in the rows of its store.

A *standstill* is raw data and never changes. What is thought of it is a *decision*; a later decision replaces an
earlier one, and both stay. What a campaign uses is therefore a fold: per standstill the last decision.

Numbers are JSON, which Python writes and reads exactly to the bit; null is NaN (a target that was not seen).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner._arrays import FloatArray, frozen
from calib_planner.design.plan import Plan
from calib_planner.errors import FileFormatError
from calib_planner.files.document import read_value
from calib_planner.files.plan_yaml import parse_plan
from calib_planner.instrument.standstill import Reason, Rejection, Standstill

ACCEPTED, OUTLIER, UNDONE = "accepted", "outlier", "undone"
KEPT = (ACCEPTED, OUTLIER)
"""Decisions about standstills that the identification is given; it rejects outliers itself, every time anew."""
WIRE = ("configurations", "test_poses")
"""What is finite in a plan that came in a message, which has no weights."""
LONGEST = 500
"""Characters kept of a text that came over a wire."""


@dataclass(frozen=True, eq=False)
class Decision:
    """What becomes of a standstill.

    Attributes:
        found: The standstill, or why it was none.
        status: ``accepted``, ``outlier``, ``undone``, ``not_in_plan``, … or the value of a ``Reason``.
        reason: In words; empty when accepted in full.
        index: Row of the plan, or ``None``.
        repetition: Number of this measurement at its configuration, from 0.
        unused: Targets, from 0, that the identification rejected.
        number: Its number in the store, ascending; 0: not stored.
        frame: Frame of its points.
    """

    found: Standstill | Rejection
    status: str
    reason: str
    index: int | None
    repetition: int
    unused: tuple[int, ...] = ()
    number: int = 0
    frame: str = ""

    @property
    def standstill(self) -> Standstill:
        """What was found, of a decision that was accepted at least once."""
        if not isinstance(self.found, Standstill):
            raise TypeError(f"standstill {self.number} was rejected: {self.found.message}")
        return self.found

    def now(self, status: str, reason: str, unused: tuple[int, ...] = ()) -> Decision:
        """The same standstill, decided otherwise."""
        return replace(self, status=status, reason=reason, unused=unused)


# ── rows ─────────────────────────────────────────────────────────────────────────────────────────────


def standstill_row(found: Standstill | Rejection, frame: str) -> dict[str, Any]:
    """The columns of a standstill."""
    row: dict[str, Any] = {"start": found.start, "stop": found.stop, "joints": _text(found.joints)}
    row |= {"samples": json.dumps(found.samples.tolist()), "frame": frame[:LONGEST]}
    if isinstance(found, Rejection):
        return row | {"rejected": found.reason.value, "message": found.message[:LONGEST]}
    return row | {"points": _text(found.points), "std": _text(found.std), "message": ""}


def decision_row(decision: Decision) -> dict[str, Any]:
    """The columns of a decision."""
    return {
        "status": decision.status,
        "reason": decision.reason[:LONGEST],
        "configuration": decision.index,
        "repetition": decision.repetition,
        "unused": json.dumps(decision.unused),
    }


def decision_of(path: str | Path, row: Mapping[str, Any], joints: int, targets: int) -> Decision:
    """A standstill with a decision about it, out of the columns of both.

    Raises:
        FileFormatError: A number of joints or targets that does not fit, or damaged columns.
    """
    where = f"standstill {row['standstill']}"
    try:
        return Decision(
            _found(path, where, row, joints, targets),
            row["status"],
            row["reason"],
            row["configuration"],
            row["repetition"],
            tuple(json.loads(row["unused"])),
            row["standstill"],
            row["frame"],
        )
    except (TypeError, ValueError, KeyError, IndexError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(path, where, str(error)[:100], "what this package wrote there") from None


def _found(
    path: str | Path, where: str, row: Mapping[str, Any], joints: int, targets: int
) -> Standstill | Rejection:
    start, stop = int(row["start"]), int(row["stop"])
    q = _array(path, f"{where}, joints", row["joints"], (joints,))
    samples = frozen(np.array(json.loads(row["samples"]), np.int64))
    if samples.shape != (targets,):
        raise FileFormatError(path, f"{where}, samples", f"{samples.size} targets", f"{targets} targets")
    if row["rejected"] is not None:
        return Rejection(start, stop, Reason(row["rejected"]), row["message"], q, samples)
    points = _array(path, f"{where}, points", row["points"], (targets, 3))
    std = _array(path, f"{where}, std", row["std"], (targets,))
    return Standstill(start, stop, q, points, std, samples)


# ── plans ────────────────────────────────────────────────────────────────────────────────────────────


def plan_text(plan: Plan | None) -> str | None:
    """A plan as JSON of its fields, exact to the bit; ``None`` for none."""
    if plan is None:
        return None
    values = {f.name: getattr(plan, f.name) for f in fields(plan)}
    return json.dumps({k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()})


def plan_of(path: str | Path, text: str | None) -> Plan | None:
    """What ``plan_text`` wrote.

    Raises:
        FileFormatError: Damaged.
    """
    if text is None:
        return None
    try:
        document = json.loads(text)
    except (TypeError, ValueError) as error:
        raise FileFormatError(path, "plan", error, "a plan as JSON") from None
    return parse_plan(path, document, WIRE)


def same_plan(one: Plan | None, other: Plan | None) -> bool:
    """Whether two plans ask for the same: what was found on the way to them does not count."""
    if one is None or other is None:
        return one is other
    names = ("robot", "joint_names", "parameters", "configurations", "repetitions", "test_poses")
    return all(np.array_equal(getattr(one, n), getattr(other, n)) for n in names)


# ── numbers ──────────────────────────────────────────────────────────────────────────────────────────


def _text(values: FloatArray) -> str:
    """Numbers as JSON, NaN as null."""
    return json.dumps(_null(values.tolist()))


def _null(value: Any) -> Any:
    if isinstance(value, list):
        return [_null(v) for v in value]
    return None if np.isnan(value) else value


def _array(path: str | Path, where: str, text: str, shape: tuple[int, ...]) -> FloatArray:
    values = np.asarray(json.loads(text), dtype=float)  # None becomes NaN
    array: FloatArray = read_value(path, where, "FloatArray", values)
    if array.shape != shape:
        raise FileFormatError(path, where, f"shape {array.shape}", f"shape {shape}, as the robot and its targets")
    return frozen(array)
