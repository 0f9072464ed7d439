# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates as YAML: the keys are those of ``identify --json``, and what it takes to rebuild the robot.

What is written comes back to the bit, and writing what was read gives the same file. A number that is unknown
(NaN) is null; one that is infinite is ``.inf``: a test pose whose accuracy rests on parameters that the data do
not determine.

The nominal values of base and targets are the closed form's, not the robot's: they are places, not errors. So a
file holds both as they were identified:

    base: {x, y, z, yaw, pitch, roll, rx, ry, rz}    # the robot in the tracker's frame [m, rad]
    targets: [[x, y, z], …]                          # in the tip's frame [m]

These two, and ``placement_alone``, are of the fit of placement alone: what a URDF can hold. What predicts is in
``error_model``: beside the terms and the model (see ``error_model.to_mapping``) the start of base and targets,
from which their parameters are deviations, and

    names: [...]               # of the coefficients β, parameters first
    coefficients: [...]        # their mean
    covariance: text           # lower triangle, row by row, as base64 of little-endian doubles
    hidden: [[...], ...]       # directions of β that nothing shows

``problem`` holds the measurements and the robot's file, if the writer had them (see ``io.problem``). With it the
whole ``Estimate`` comes back, so that everything made of it can be made again without another fit.

A chain begins with the base's pose, T(x, y, z) Rz(yaw) Ry(pitch) Rx(roll) Rx(rx) Ry(ry) Rz(rz): roll, pitch and
yaw are the closed form's orientation, and rx, ry and rz what was identified beyond it.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calib_planner.arrays import FloatArray, frozen, plain
from calib_planner.error_model import ErrorModel, Knowledge, from_mapping
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.identification import (
    Accuracy,
    Alternative,
    ChiSquare,
    Estimate,
    IdentificationProblem,
    LeftOutError,
    Observability,
    ParameterFit,
    PointNoise,
    Points,
    Reason,
    Residuals,
    ResidualStatistics,
    TermGain,
    Validation,
    Verdict,
)
from calib_planner.io.problem import problem_mapping, saved_problem, saved_robot, urdf_text
from calib_planner.io.yaml import Node, read_document, write_document
from calib_planner.measurements import RejectedPoint
from calib_planner.robot import Robot, is_nuisance, parse_coupling
from calib_planner.units import Told, listed

T = TypeVar("T")
BASE = ("x", "y", "z", "yaw", "pitch", "roll", "rx", "ry", "rz")
"""The numbers of a base pose, in the order of the chain's first elements."""
SAME = 1e-9
"""Nominal values may differ by this much between the estimate and the robot [m | rad]."""
TARGET = re.compile(r"target_([1-9]\d{0,2})\.([xyz])")
PARAMETER_KEYS = ("name", "unit", "nominal", "value", "deviation", "std")
NEEDED = ("robot", "joint_names", "parameters", "covariance", "sigma", "status")
PER_POSE = "predicted_accuracy_per_test_pose"
UNLIMITED = {
    PER_POSE: "predicted",
    "predicted_accuracy": "overall",
    "placement_accuracy_per_test_pose": "placement",
    "parameter_accuracy_per_test_pose": "parameters",
    "required_accuracy": "required",
}
"""Key → field of ``Accuracy`` that can be infinite; JSON has no word for that, YAML has."""


def write_estimate(
    path: str | Path,
    estimate: Estimate | SavedEstimate,
    field: str = "output",
    problem: IdentificationProblem | None = None,
) -> None:
    """Write an estimate, [m] and [rad], or one that was read.

    Args:
        path: The file.
        estimate: The estimate.
        field: The argument or option that named the path, for the error.
        problem: What it answers; without it no report can be made of the file.

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    content = estimate.document if isinstance(estimate, SavedEstimate) else document_of(estimate, problem)
    write_document(path, "estimate", content, field)


def document_of(estimate: Estimate, problem: IdentificationProblem | None = None) -> dict[str, Any]:
    """What ``write_estimate`` writes, without its format line, as plain values."""
    content = estimate.to_dict()
    if problem is not None:
        content["problem"] = problem_mapping(problem) | {"spare": estimate.residuals.spare}
    unlimited = {key: getattr(estimate.accuracy, name) for key, name in UNLIMITED.items() if key in content}
    content["error_model"] |= plain(_knowledge_mapping(estimate.knowledge))
    couple = [str(one) for one in estimate.calibrated.couplings]
    content |= {"couple": couple} if couple else {}
    return content | plain(unlimited, keep_infinite=True) | placement(estimate)


def placement(estimate: Estimate) -> dict[str, Any]:
    """Where the robot stands in the tracker's frame and the targets in the tip's, as plain values."""
    return _places_of(estimate.calibrated)


def _knowledge_mapping(known: Knowledge) -> dict[str, Any]:
    """What predicts again, but for the model itself."""
    lower = known.covariance[np.tril_indices(len(known.coefficients))]
    return {
        "names": known.model.names(known.robot),
        "coefficients": known.coefficients,
        "covariance": base64.b64encode(lower.astype("<f8").tobytes()).decode(),
        "hidden": known.hidden.T,
        "start": _places_of(known.robot),
    }


def _places_of(robot: Robot) -> dict[str, Any]:
    base = {name: e.value for name, e in zip(BASE, robot.elements[: len(BASE)], strict=True)}
    return {"base": base, "targets": robot.target_offsets.tolist()}


def read_estimate(path: str | Path) -> SavedEstimate:
    """Read what ``write_estimate`` wrote.

    Raises:
        FileFormatError: Not an estimate of ours; names the key at fault and what is valid.
    """
    return parse_estimate(read_document(path, "estimate"))


def parse_estimate(top: Node) -> SavedEstimate:
    """The estimate that a document holds; errors are those of ``read_estimate``."""
    top.mapping(None, NEEDED)
    rows = [row.mapping(PARAMETER_KEYS, PARAMETER_KEYS) for row in top["parameters"].items()]
    names, count = tuple(row["name"].of_kind("str") for row in rows), len(rows)
    if len(set(names)) < count:
        raise top["parameters"].error("a name twice", "each name once")

    def column(key: str, *, finite: bool = True) -> FloatArray:
        values = Node(top.path, f"parameters[].{key}", [row[key].value for row in rows])
        return values.array((count,), finite=finite)

    base, targets = top.get("base"), top.get("targets")
    return SavedEstimate(
        robot=top["robot"].of_kind("str"),
        joint_names=top["joint_names"].of_kind("tuple[str, ...]"),
        couple=top.get("couple", []).of_kind("tuple[str, ...]"),
        parameters=names,
        units=tuple(row["unit"].of_kind("str") for row in rows),
        nominal=column("nominal"),
        values=column("value"),
        deviations=column("deviation"),
        std=column("std", finite=False),
        covariance=top["covariance"].array((count, count), finite=False),
        sigma=_float(top["sigma"]),
        status=top["status"].of_kind("str"),
        base=None if base.value is None else _in_order(base, BASE),
        targets=None if targets.value is None else targets.array((None, 3)),
        noise=_noise(top.get("noise")),
        chi_square=_made(top.get("chi_square"), ChiSquare, ("probability",)),
        verdict=_verdict(top.get("verdict")),
        predicted_accuracy_per_test_pose=Node(top.path, PER_POSE, top.get(PER_POSE).value or []).array(
            (None,), finite=False
        ),
        placement_alone=_placement_alone(top, names),
        learnt=_learnt(top.get("error_model")),
        document=dict(top.value),
        path=str(top.path),
    )


def _in_order(node: Node, names: Sequence[str]) -> FloatArray:
    """(names,) the numbers of a mapping with exactly these keys."""
    node.mapping(names, names)
    return Node(node.path, node.where, [node.value[name] for name in names]).array((len(names),))


def _float(node: Node) -> float:
    """A number, null being NaN."""
    return np.nan if node.value is None else float(node.of_kind("float"))


def _made(node: Node, kind: type[T], more: tuple[str, ...] = ()) -> T | None:
    """A dataclass from the mapping of its fields; keys in ``more`` are derived from them.

    Fields with a default may be missing: an older version did not know them.
    """
    if node.value is None:
        return None
    kinds = {f.name: str(f.type) for f in fields(kind)}  # type: ignore[arg-type]
    needed = [f.name for f in fields(kind) if f.default is MISSING]  # type: ignore[arg-type]
    node.mapping((*kinds, *more), needed)

    def item(name: str) -> Any:
        return _float(node[name]) if kinds[name] == "float" else node[name].of_kind(kinds[name])

    return kind(**{name: item(name) for name in kinds if name in node})


def _noise(node: Node) -> PointNoise | None:
    """Noise of a point; older files split it in another way, which is left aside."""
    if node.value is None:
        return None
    node.mapping()
    if "measurement" in node:
        return None
    node.mapping(None, ("sigma", "source"))
    return PointNoise(_float(node["sigma"]), node["source"].of_kind("str"))


def _placement_alone(top: Node, names: tuple[str, ...]) -> FloatArray | None:
    if "placement_alone" not in top:
        return None
    alone = top["placement_alone"].mapping(None, ("parameters",))
    return _in_order(alone["parameters"], names)


def _learnt(node: Node) -> SavedKnowledge | None:
    if node.value is None:
        return None
    node.mapping(None, ("model", "names", "coefficients", "covariance", "hidden", "start"))
    start = node["start"].mapping(("base", "targets"), ("base", "targets"))
    names = node["names"].of_kind("tuple[str, ...]")
    count, model = len(names), node["model"].mapping()
    hidden = node["hidden"].array((None, count)) if node["hidden"].value else np.empty((0, count))
    return SavedKnowledge(
        model=model.build(lambda: from_mapping(model.value)),
        names=names,
        coefficients=node["coefficients"].array((count,)),
        covariance=_symmetric(node["covariance"], count),
        hidden=frozen(hidden.T),
        base=_in_order(start["base"], BASE),
        targets=start["targets"].array((None, 3)),
    )


def _symmetric(node: Node, count: int) -> FloatArray:
    """(count, count) from the text of its lower triangle."""
    try:
        lower = np.frombuffer(base64.b64decode(node.text(), validate=True), "<f8")
    except (binascii.Error, ValueError):
        raise node.error("text", "base64 of doubles, as it was written") from None
    if lower.size != count * (count + 1) // 2 or not np.isfinite(lower).all():
        raise node.error(f"{lower.size} numbers", f"{count * (count + 1) // 2} finite ones")
    result = np.zeros((count, count))
    result[np.tril_indices(count)] = lower
    return frozen(result + np.tril(result, -1).T)


def _verdict(node: Node) -> Verdict | None:
    if node.value is None:
        return None
    node.mapping(("level", "reasons"), ("level", "reasons"))
    if not isinstance(node["reasons"].value, list):
        raise node["reasons"].refused("a list of reasons")
    reasons = [_made(r, Reason) for r in (node["reasons"].items() if node["reasons"].value else [])]
    return Verdict(node["level"].of_kind("str"), tuple(r for r in reasons if r is not None))


@dataclass(frozen=True, eq=False)
class SavedKnowledge:
    """What an error model learnt; see ``Knowledge``.

    Attributes:
        model: The terms with their estimated scales.
        names: Of the coefficients β.
        coefficients: (coefficients,) their mean.
        covariance: (coefficients, coefficients).
        hidden: (coefficients, directions).
        base: (9,) the base's pose at the start, see ``BASE`` [m, rad].
        targets: (targets, 3) at the start [m].
    """

    model: ErrorModel
    names: tuple[str, ...]
    coefficients: FloatArray
    covariance: FloatArray
    hidden: FloatArray
    base: FloatArray
    targets: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class SavedEstimate(Told):
    """What an estimate file says.

    Attributes:
        robot: Name of the robot.
        joint_names: Order of joint arrays.
        parameters: P names, the order of all parameter arrays.
        units: ``m`` or ``rad``.
        nominal: (P,) values before; for base and targets the closed-form start [unit].
        values: (P,) identified [unit].
        deviations: (P,) identified value − nominal [unit]; 0 where fixed.
        std: (P,) standard deviations [unit], NaN where fixed.
        covariance: (P, P), eq. (11); zero where fixed.
        sigma: Standard deviation of one coordinate that the covariance rests on [m].
        status: A key of ``identification.estimate.STATUS``.
        base: (9,) the base's pose, see ``BASE`` [m, rad]; ``None`` if the file does not say.
        targets: (targets, 3) in the tip's frame [m]; ``None`` if the file does not say.
        noise: Of a point; ``None`` in older files.
        chi_square: Whether measurement noise alone explains the residuals, or ``None``.
        verdict: Whether the calibration is good, or ``None``.
        predicted_accuracy_per_test_pose: (K,) [m]; infinite where it rests on what the data cannot see.
        placement_alone: (P,) values of a fit of placement alone [unit]; ``None`` in older files.
        learnt: What predicts, or ``None`` in older files.
        document: Everything that the file holds, as plain values.
        couple: Joints that the controller shows against others, ``j3+=j2``.
        path: The file.
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
    noise: PointNoise | None
    chi_square: ChiSquare | None
    verdict: Verdict | None
    predicted_accuracy_per_test_pose: FloatArray
    placement_alone: FloatArray | None
    learnt: SavedKnowledge | None
    document: dict[str, Any]
    couple: tuple[str, ...] = ()
    path: str = ""

    def _facts(self) -> list[tuple[str, object]]:
        return [
            *([("verdict", self.verdict.level)] if self.verdict is not None else []),
            ("robot", self.robot),
            ("parameters", len(self.parameters)),
            ("status", self.status),
            ("file", self.path),
        ]

    def nominal_robot(self) -> Robot:
        """The nominal robot, from the file alone, with its nominal targets.

        Raises:
            FileFormatError: The file does not hold it.
        """
        robot = saved_robot(self._problem)
        return robot.with_couplings([parse_coupling(text) for text in self.couple])

    def nominal_urdf(self) -> str:
        """The text of the nominal robot's URDF, from the file alone.

        Raises:
            FileFormatError: The file does not hold it.
        """
        return urdf_text(self._problem)

    def problem(self, robot: Robot) -> IdentificationProblem:
        """The problem that it answers, for the nominal ``robot``; what a prior said is in the error model.

        Raises:
            FileFormatError: The file does not hold it.
            InputError, UnknownNameError: As ``knowledge``.
        """
        self.check_robot(robot)
        model = self.knowledge(robot).model
        node = self._problem
        targets = node["targets"].array((None, 3))
        alike = replace(robot.with_targets(targets), parameter_names=self.parameters)
        part = Node(node.path, node.where, {k: v for k, v in node.value.items() if k != "spare"})
        return saved_problem(part, alike, model)

    def estimate(self, robot: Robot) -> Estimate:
        """The whole estimate again, for the nominal ``robot``.

        Raises:
            FileFormatError: The file does not hold what it takes: it is of an older version.
            InputError, UnknownNameError: As ``knowledge``.
        """
        return _whole(self, robot)

    @property
    def _problem(self) -> Node:
        node = Node(self.path, "problem", self.document.get("problem"))
        if node.value is None:
            advice = "identify again; or give the robot with --robot for all but the report"
            raise node.error("nothing", "the measurements and the robot's file", advice)
        return node.mapping(None, ("robot", "targets"))

    def calibrated(self, robot: Robot) -> Robot:
        """The nominal ``robot`` with all identified values, base and targets too: ``Estimate.calibrated`` again.

        Raises:
            InputError: The estimate is of another robot or version of it, or the file lacks base and targets.
            UnknownNameError: The robot has no parameter of that name.
        """
        moved = self.corrected(robot)
        if self.base is None or self.targets is None:
            raise InputError("estimate", "no base or targets", "a file that holds them", "identify again")
        return replace(_put(moved, self.base, self.targets), parameter_names=self.parameters)

    def knowledge(self, robot: Robot) -> Knowledge:
        """What predicts as the estimate did, for the nominal ``robot``.

        Raises:
            InputError: The estimate is of another robot or version of it, or holds no error model.
            UnknownNameError: The robot has no parameter of that name.
        """
        self.check_robot(robot)
        saved = self.learnt
        if saved is None:
            raise InputError("estimate", "no error model", "an estimate that holds one", "identify again")
        placed = replace(_put(robot, saved.base, saved.targets), parameter_names=self.parameters)
        if saved.model.names(placed) != saved.names:
            advice = "give the robot that the estimate was made with"
            raise InputError("estimate.error_model", "coefficients of another robot", "the robot's", advice)
        return Knowledge(placed, saved.model, saved.coefficients, saved.covariance, saved.hidden)

    def corrected(self, robot: Robot) -> Robot:
        """The nominal ``robot`` with the errors of its own chain; base and targets stay.

        Raises:
            InputError, UnknownNameError: As ``calibrated``.
        """
        self.check_robot(robot)
        names = self.chain_parameters
        values = self.values if self.placement_alone is None else self.placement_alone
        deviations = dict(zip(self.parameters, (values - self.nominal).tolist(), strict=True))
        return robot.with_deviations({n: deviations[n] for n in names})

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
        couple = [str(one) for one in robot.couplings]
        if sorted(self.couple) != sorted(couple):
            wanted = f"{listed(self.couple, none='none')}, as the data of the estimate were shown"
            got = f"coupled joints {listed(couple, none='none')}"
            raise InputError("robot", got, wanted, "give --couple, or couple: in the robot YAML, as for identify")
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
        return tuple(n for n in self.parameters if not is_nuisance(n))


def _whole(saved: SavedEstimate, robot: Robot) -> Estimate:
    """The estimate from the keys of its document, which are those of ``Estimate.to_dict``."""
    top = Node(saved.path, "", saved.document)
    needed = ("residuals", "normalised_residuals", "left_out", "placement_alone", "rejected", "suspects", "rank")
    top.mapping(None, (*needed, "problem", "alternatives", "residual_before", "residual_after", "chi_square"))
    problem, known = saved.problem(robot), saved.knowledge(robot)
    alone, shape = top["placement_alone"], problem.data.p.shape
    test_poses = problem.test_pose_array

    def per_pose(key: str) -> FloatArray:
        values = top.get(key, []).value if len(test_poses) else []
        return Node(saved.path, key, values).array((len(test_poses),), finite=False)

    def statistics(node: Node) -> ResidualStatistics:
        return _field(node, ResidualStatistics)

    return top.build(
        lambda: Estimate(
            calibrated=saved.calibrated(robot),
            knowledge=known,
            fit=ParameterFit(
                saved.parameters,
                saved.units,
                saved.nominal,
                saved.deviations,
                saved.std,
                saved.covariance,
                top["iterations"].of_kind("int"),
                saved.status,
            ),
            observability=Observability(
                rank=top["rank"].of_kind("int"),
                fixed=tuple(row["parameter"] for row in top["unidentifiable"].value),
                unidentifiable=tuple(row["combination"] for row in top["unidentifiable"].value),
                resolved_by_prior=top["resolved_by_prior"].of_kind("tuple[str, ...]"),
                nearly_dependent=top["nearly_dependent"].of_kind("tuple[str, ...]"),
                prior=str(top["prior"].value or ""),
            ),
            points=Points(
                measured=top["measurements"].of_kind("int"),
                used=top["used"].of_kind("int"),
                rejected=_fields(top["rejected"], RejectedPoint),
                suspects=_fields(top["suspects"], RejectedPoint),
                copies=top["copies"].of_kind("int"),
                moved_since=top["moved_since"].value,
            ),
            residuals=Residuals(
                vectors=top["residuals"].array(shape, finite=False),
                normalised=top["normalised_residuals"].array(shape[:2], finite=False),
                gate=_float(top["gate"]),
                before=statistics(top["residual_before"]),
                after=statistics(top["residual_after"]),
                placement_alone=statistics(alone["residual_after"]),
                sigma=_float(top["sigma_estimate"]),
                spare=_float(top["problem"].get("spare")),
                chi_square=saved.chi_square or ChiSquare(np.nan, 0),
            ),
            noise=saved.noise or PointNoise(saved.sigma, "residuals"),
            accuracy=Accuracy(
                test_poses=test_poses,
                predicted=per_pose(PER_POSE),
                placement=per_pose("placement_accuracy_per_test_pose"),
                knowledge=known,
                frame=problem.accuracy_frame,
                required=np.nan if problem.required_accuracy is None else problem.required_accuracy,
            ),
            left_out=_field(top["left_out"], LeftOutError),
            placement_alone=_field(alone["left_out"], LeftOutError),
            terms=_fields(top["error_model"]["terms"], TermGain),
            alternatives=_fields(top["alternatives"], Alternative),
            seconds=_float(top["seconds"]),
            validation=_field(top["validation"], Validation) if "validation" in top else None,
            verdict=saved.verdict or Verdict("FAIL", ()),
        )
    )


def _field(node: Node, kind: type[T]) -> T:
    """A dataclass from the mapping of its fields; null is NaN, or ``None`` where a field can be that."""
    node.mapping()
    values: dict[str, Any] = {}
    for f in fields(kind):  # type: ignore[arg-type]
        if f.name in node:
            value = node[f.name].value
            value = np.nan if value is None and f.type == "float" else value
            values[f.name] = tuple(value) if isinstance(value, list) else value
        elif f.default is MISSING:
            raise node.error(f"no key {f.name!r}", "what identify wrote", "identify again")
    return kind(**values)


def _fields(node: Node, kind: type[T]) -> tuple[T, ...]:
    return tuple(_field(item, kind) for item in node.items()) if node.value else ()


def _put(robot: Robot, base: FloatArray, targets: FloatArray) -> Robot:
    """The robot with its base's pose (9,) and targets (targets, 3) at these values."""
    count = len(BASE)
    head = (replace(e, value=float(v)) for e, v in zip(robot.elements[:count], base, strict=True))
    return replace(robot, elements=(*head, *robot.elements[count:])).with_targets(targets)


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
    own = saved.values if saved.placement_alone is None else saved.placement_alone
    for name, value in zip(saved.parameters, own.tolist(), strict=True):
        target = TARGET.fullmatch(name)
        if target:
            targets[int(target[1]) - 1, "xyz".index(target[2])] = value
    moved = saved.corrected(robot)
    return moved.with_targets(_places(robot, targets)) if targets else moved


def _places(robot: Robot, targets: dict[tuple[int, int], float]) -> FloatArray:
    """(targets, 3) the robot's targets [m], or as many as the estimate has, at the identified places."""
    count = max(len(robot.targets), *(t + 1 for t, _ in targets))
    places = np.zeros((count, 3))
    places[: len(robot.targets)] = robot.target_offsets
    for at, value in targets.items():
        places[at] = value
    return places
