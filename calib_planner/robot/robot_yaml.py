"""Robots as YAML: the chain of eq. (2) written down element by element.

    name: planar_2r
    joints:                       # order of all joint arrays
      - {name: q1, lower: -180, upper: 180, unit: deg}
    elements:                     # amount = sign · (value + deviation + joint)
      - {type: Rz, joint: q1, parameter: dq1}
      - {type: Tx, value: 1.0, parameter: l1}
    targets: [[0, 0, 0]]          # optional, in the tip's frame [m]
    base: {xyz: [0, 0, 0], rpy: [0, 0, 0]}    # optional [m, rad]
    lengths: [l1]                 # the parameters of the level "lengths"
    offsets: [dq1]                # the parameters of the level "offsets"

Six placement errors ``<joint>.x … <joint>.rz`` in front of every joint are added here; they make up the level
``full``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib_planner.errors import CalibPlannerError, FileFormatError
from calib_planner.robot.chain import Robot, target_elements
from calib_planner.robot.elements import Element, pose_elements

KEYS = ("name", "description", "joints", "elements", "targets", "base", "lengths", "offsets")
ELEMENT_KEYS = ("type", "value", "joint", "sign", "parameter")
JOINT_KEYS = ("name", "lower", "upper", "unit")
UNITS = {"rad": 1.0, "deg": np.pi / 180.0, "m": 1.0, "mm": 1e-3}


def read_robot_yaml(path: Path) -> Robot:
    """Read a robot from a YAML file.

    Raises:
        FileFormatError: Names the key at fault, what it holds and what is valid.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise FileFormatError(path, "file", str(error).replace("\n", " "), "readable YAML") from None
    return _Reader(path).robot(document)


class _Reader:
    """Reads one document; holds the path for the errors, nothing else."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def robot(self, document: Any) -> Robot:
        top = self.mapping("document", document, KEYS, required=("joints", "elements"))
        joints = [
            self.mapping(f"joints[{i}]", j, JOINT_KEYS, required=("name", "lower", "upper"))
            for i, j in enumerate(self.sequence("joints", top["joints"]))
        ]
        names = tuple(str(j["name"]) for j in joints)
        limits = np.array([self.limits(f"joints[{i}]", j) for i, j in enumerate(joints)])
        base = self.mapping("base", top.get("base", {}), ("xyz", "rpy"))
        chain = [
            *pose_elements(
                "base",
                self.vector("base.xyz", base.get("xyz", [0, 0, 0])),
                self.vector("base.rpy", base.get("rpy", [0, 0, 0])),
            )
        ]
        full: list[str] = []
        for i, item in enumerate(self.sequence("elements", top["elements"])):
            element = self.element(f"elements[{i}]", item, names)
            if element.joint is not None:
                errors = _placement_errors(names[element.joint])
                full += [str(e.parameter) for e in errors]
                chain += errors
            chain.append(element)
        targets = [
            self.vector(f"targets[{i}]", t)
            for i, t in enumerate(self.sequence("targets", top.get("targets", [[0, 0, 0]])))
        ]
        known = {e.parameter for e in chain}
        lengths = self.names("lengths", top.get("lengths", []), known)
        offsets = self.names("offsets", top.get("offsets", []), known)
        levels = {
            "offsets": offsets,
            "lengths": lengths,
            "lengths+offsets": lengths + offsets,
            "full": tuple(full),
        }
        try:
            return Robot(
                name=str(top.get("name", self.path.stem)),
                elements=tuple(chain),
                targets=target_elements(np.array(targets)),
                joint_names=names,
                joint_limits=limits,
                levels={k: v for k, v in levels.items() if v},
                parameter_names=lengths + offsets or tuple(full),
                source=str(self.path),
            )
        except FileFormatError:
            raise
        except CalibPlannerError as error:
            raise FileFormatError(self.path, "robot", error, "a consistent chain") from None

    def element(self, where: str, item: Any, joint_names: tuple[str, ...]) -> Element:
        entry = self.mapping(where, item, ELEMENT_KEYS, required=("type",))
        joint = entry.get("joint")
        if joint is not None and joint not in joint_names:
            raise FileFormatError(self.path, f"{where}.joint", repr(joint), f"one of: {', '.join(joint_names)}")
        parameter = entry.get("parameter")
        try:
            return Element(
                kind=str(entry["type"]),
                value=self.number(f"{where}.value", entry.get("value", 0.0)),
                joint=None if joint is None else joint_names.index(joint),
                sign=self.number(f"{where}.sign", entry.get("sign", 1)),
                parameter=None if parameter is None else str(parameter),
            )
        except FileFormatError:
            raise
        except CalibPlannerError as error:
            raise FileFormatError(self.path, where, item, str(error)) from None

    def limits(self, where: str, joint: Mapping[str, Any]) -> tuple[float, float]:
        unit = str(joint.get("unit", "rad"))
        if unit not in UNITS:
            raise FileFormatError(self.path, f"{where}.unit", unit, f"one of: {', '.join(UNITS)}")
        return tuple(  # type: ignore[return-value]
            UNITS[unit] * self.number(f"{where}.{key}", joint[key]) for key in ("lower", "upper")
        )

    def mapping(
        self, where: str, item: Any, keys: tuple[str, ...], required: tuple[str, ...] = ()
    ) -> dict[str, Any]:
        if not isinstance(item, Mapping):
            raise FileFormatError(self.path, where, type(item).__name__, f"a mapping with keys {', '.join(keys)}")
        for key in item:
            if key not in keys:
                raise FileFormatError(self.path, where, f"unknown key {key!r}", f"only: {', '.join(keys)}")
        for key in required:
            if key not in item:
                raise FileFormatError(self.path, where, f"no key {key!r}", f"{key!r} to be given")
        return dict(item)

    def sequence(self, where: str, item: Any) -> list[Any]:
        if not isinstance(item, list) or not item:
            raise FileFormatError(self.path, where, repr(item)[:80], "a list with at least one entry")
        return item

    def number(self, where: str, item: Any) -> float:
        if isinstance(item, bool) or not isinstance(item, (int, float)) or not np.isfinite(item):
            raise FileFormatError(self.path, where, repr(item)[:80], "a finite number")
        return float(item)

    def vector(self, where: str, item: Any) -> np.ndarray:
        if not isinstance(item, list) or len(item) != 3:
            raise FileFormatError(self.path, where, repr(item)[:80], "three numbers")
        return np.array([self.number(f"{where}[{i}]", v) for i, v in enumerate(item)])

    def names(self, where: str, item: Any, known: set[str | None]) -> tuple[str, ...]:
        if not isinstance(item, list):
            raise FileFormatError(self.path, where, repr(item)[:80], "a list of parameter names")
        for name in item:
            if name not in known:
                valid = ", ".join(sorted(n for n in known if n))
                raise FileFormatError(self.path, where, repr(name), f"only: {valid}")
        return tuple(str(n) for n in item)


def _placement_errors(joint: str) -> list[Element]:
    return [Element(k + a, parameter=f"{joint}.{'r' * (k == 'R')}{a}") for k in "TR" for a in "xyz"]
