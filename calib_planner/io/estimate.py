"""Estimates as YAML: the keys are those of ``identify --json``, and what it takes to rebuild the robot.

What is written comes back to the bit. A number that is unknown (NaN) is null; one that is infinite is ``.inf``: a
test pose whose accuracy rests on what the data cannot see. Writing what was read gives the same file.

    base: {x, y, z, yaw, pitch, roll, rx, ry, rz}    # the robot in the tracker's frame, see saved_estimate
    targets: [[x, y, z], …]                          # in the tip's frame
"""

from __future__ import annotations

import re
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calib_planner.arrays import FloatArray, frozen
from calib_planner.errors import FileFormatError, InputError, UnknownNameError
from calib_planner.identification import ChiSquare, Estimate, JointCorrections, NoiseLevels, Reason, Verdict
from calib_planner.io.yaml import check_keys, read_document, read_value, write_document
from calib_planner.robot import Element, Robot

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


# ── What an estimate file says, and the calibrated robot rebuilt from it ────────────────────────────────────
# The nominal values of base and targets are the closed form's, not the robot's: they are places, not errors. So a
# file holds both as they were found. A chain begins with the base's pose,
#
#     T(x, y, z) Rz(yaw) Ry(pitch) Rx(roll) Rx(rx) Ry(ry) Rz(rz),
#
# roll, pitch and yaw being the closed form's orientation, and rx, ry and rz what was identified beyond it.

BASE = ("x", "y", "z", "yaw", "pitch", "roll", "rx", "ry", "rz")
"""The numbers of a base pose, in the order of the chain's first elements."""
SAME = 1e-9
"""Nominal values may differ by this much between the estimate and the robot [m | rad]."""


@dataclass(frozen=True, eq=False)
class SavedCorrections:
    """The complete model: joint corrections and the geometry that belongs with them.

    Attributes:
        corrections: φ of every joint.
        parameters: P names.
        values: (P,) their values beside the corrections, not those of the geometry alone [m | rad].
    """

    corrections: JointCorrections
    parameters: tuple[str, ...]
    values: FloatArray


@dataclass(frozen=True, eq=False)
class SavedEstimate:
    """What an estimate file says.

    Attributes:
        robot: Name of the robot.
        joint_names: Order of joint arrays.
        parameters: P names, the order of all parameter arrays.
        units: ``m`` or ``rad``.
        nominal: (P,) values before; for base and targets the closed-form start [unit].
        values: (P,) identified [unit].
        deviations: (P,) identified value − nominal [unit]; 0 where held.
        std: (P,) standard deviations [unit], NaN where held.
        covariance: (P, P), eq. (11); zero where held.
        sigma: Standard deviation of one coordinate that the covariance rests on [m].
        status: A key of ``identification.estimate.STATUS``.
        base: (9,) the base's pose, see ``BASE`` [m, rad]; ``None`` if the file does not say.
        targets: (targets, 3) in the tip's frame [m]; ``None`` if the file does not say.
        noise: The parts of the scatter, or ``None``.
        chi_square: Whether measurement noise alone explains the residuals, or ``None``.
        verdict: Whether the calibration is good, or ``None``.
        predicted_accuracy_per_test_pose: (K,) [m]; infinite where it rests on what the data cannot see.
        joint_corrections: Errors of the joints' transmissions with their geometry, or ``None``.
        document: Everything that the file holds, as plain values.
    """

    robot: str
    joint_names: tuple[str, ...]
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    nominal: FloatArray
    values: FloatArray
    deviations: FloatArray
    std: FloatArray
    covariance: FloatArray
    sigma: float
    status: str
    base: FloatArray | None
    targets: FloatArray | None
    noise: NoiseLevels | None
    chi_square: ChiSquare | None
    verdict: Verdict | None
    predicted_accuracy_per_test_pose: FloatArray
    joint_corrections: SavedCorrections | None
    document: dict[str, Any]

    def calibrated(self, robot: Robot) -> Robot:
        """The nominal ``robot`` with all parameters found, base and targets too: ``Estimate.calibrated`` again.

        Raises:
            InputError: The estimate is of another robot or version of it, or the file lacks base and targets.
            UnknownNameError: The robot has no parameter of that name.
        """
        moved = self.corrected(robot)
        if self.base is None or self.targets is None:
            raise InputError("estimate", "no base or targets", "a file that holds them", "identify again")
        count = len(BASE)
        head = (replace(e, value=float(v)) for e, v in zip(moved.elements[:count], self.base, strict=True))
        placed = replace(moved, elements=(*head, *moved.elements[count:])).with_targets(self.targets)
        return replace(placed, parameter_names=self.parameters)

    def complete(self, robot: Robot) -> Robot:
        """The geometry that belongs with ``joint_corrections``, right at their ``actual``; base and targets too.

        Without corrections it is ``calibrated``.

        Raises:
            InputError, UnknownNameError: As ``calibrated``.
        """
        placed, found = self.calibrated(robot), self.joint_corrections
        if found is None:
            return placed
        values = dict(zip(found.parameters, found.values.tolist(), strict=True))

        def moved(e: Element) -> Element:
            return replace(e, value=values.get(e.parameter or "", e.value))

        branches = tuple(tuple(map(moved, branch)) for branch in placed.targets)
        return replace(placed, elements=tuple(map(moved, placed.elements)), targets=branches)

    def corrected(self, robot: Robot) -> Robot:
        """The nominal ``robot`` with the errors of its own chain; base and targets stay.

        Raises:
            InputError, UnknownNameError: As ``calibrated``.
        """
        self.check_robot(robot)
        names = self.chain_parameters
        found = dict(zip(self.parameters, self.deviations.tolist(), strict=True))
        return robot.with_deviations({n: found[n] for n in names})

    def check_robot(self, robot: Robot) -> None:
        """Refuse a robot that is not the nominal one of this estimate.

        Raises:
            InputError, UnknownNameError: As ``calibrated``.
        """
        if set(self.joint_names) != set(robot.joint_names):
            wanted = f"the robot's joints {', '.join(robot.joint_names)}"
            raise InputError(
                "estimate", f"joints {', '.join(self.joint_names)}", wanted, "give the robot it is of"
            )
        nominal = {p.name: p.nominal for p in robot.with_parameters(robot.available_parameters).parameters}
        starts = dict(zip(self.parameters, self.nominal.tolist(), strict=True))
        for name in self.chain_parameters:
            if name not in nominal:
                raise UnknownNameError("estimate", name, list(nominal))
            if not abs(starts[name] - nominal[name]) <= SAME:
                got, wanted = f"nominal {starts[name]!r}", f"{nominal[name]!r}, the robot's"
                advice = "give the robot that the estimate was made with"
                raise InputError(f"estimate: {name}", got, wanted, advice)

    @property
    def chain_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that are neither the base's nor the targets'."""
        return tuple(n for n in self.parameters if not n.startswith(("base.", "target_")))


# ── A robot with a saved estimate applied: what every use of a calibration begins with ──────────────────────

TARGET = re.compile(r"target_([1-9]\d{0,2})\.([xyz])")


def calibrated_robot(robot: Robot, saved: SavedEstimate) -> Robot:
    """The robot with the parameters and targets of a saved estimate as its nominal ones.

    The pose of the base is left out: it says where the robot stood before the tracker.

    Args:
        robot: The nominal robot that the estimate was made with.
        saved: The estimate; ``read_estimate``.

    Raises:
        InputError: The estimate is of another robot, or of another version of it.
        UnknownNameError: The robot has no parameter of that name.
    """
    targets: dict[tuple[int, int], float] = {}
    for name, value in zip(saved.parameters, saved.values.tolist(), strict=True):
        target = TARGET.fullmatch(name)
        if target:
            targets[int(target[1]) - 1, "xyz".index(target[2])] = value
    moved = saved.corrected(robot)
    return moved.with_targets(_places(robot, targets)) if targets else moved


def _places(robot: Robot, targets: dict[tuple[int, int], float]) -> FloatArray:
    """(targets, 3) the robot's targets [m], or as many as the estimate has, at the places found."""
    count = max(len(robot.targets), *(t + 1 for t, _ in targets))
    places = np.zeros((count, 3))
    places[: len(robot.targets)] = robot.target_offsets
    for at, value in targets.items():
        places[at] = value
    return places
