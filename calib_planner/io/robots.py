"""The robots that come with the package, and ``load_robot`` for those and for files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError, UnknownNameError
from calib_planner.io.urdf import read_urdf
from calib_planner.io.yaml import YamlReader, brief
from calib_planner.robot import (
    KINDS,
    ROW_TYPES,
    DhRow,
    Element,
    Robot,
    check_joint_names,
    dh_elements,
    dh_levels,
    pose_elements,
    register_file_reader,
    target_elements,
)

URDF_SUFFIXES = (".urdf", ".xml", ".xacro", ".sdf")
"""Files that are read as URDF; what is another format after all is told so by its content."""
YAML_SUFFIXES = (".yaml", ".yml")


def config_folder() -> Path:
    """The folder ``config/``: beside the package in a checkout, below ``share/`` once installed."""
    for parent in Path(__file__).resolve().parents:
        for folder in (parent / "config", parent / "share" / "calib_planner" / "config"):
            if (folder / "robots").is_dir():
                return folder
    raise FileNotFoundError("calib_planner's config/ folder is neither beside nor above the package")


def shipped_robots() -> Sequence[str]:
    """Names of the shipped robots, sorted."""
    return sorted(p.stem for p in (config_folder() / "robots").glob("*.yaml"))


def load_robot(source: str | Path, *, base_link: str | None = None, tip_link: str | None = None) -> Robot:
    """See ``Robot.load``."""
    path = Path(source).expanduser()
    shipped = str(source) in shipped_robots()
    if shipped:
        path = config_folder() / "robots" / f"{source}.yaml"
    suffix = path.suffix.lower()
    if not path.is_file() or suffix not in (*YAML_SUFFIXES, *URDF_SUFFIXES):
        raise UnknownNameError(
            "robot", str(source), [*shipped_robots(), "PATH.urdf", "PATH.yaml (an existing file)"]
        )
    if suffix in URDF_SUFFIXES:
        return read_urdf(path, base_link, tip_link)
    for field, link in (("base_link", base_link), ("tip_link", tip_link)):
        if link is not None:
            advice = f"leave it out: {path.name} is one chain"
            raise InputError(field, repr(link), "no link beside a robot YAML, only beside a URDF", advice)
    return _shipped_robot(path) if shipped else read_robot_yaml(path)


@cache
def _shipped_robot(path: Path) -> Robot:
    """The robot of a file of the package, read and compiled once: robots are immutable."""
    return read_robot_yaml(path)


# ── Robots as YAML: the chain of eq. (2) element by element, or a Denavit–Hartenberg table ──────────────────
#     name: planar_2r
#     joints:                       # order of all joint arrays
#       - {name: q1, lower: -180, upper: 180, unit: deg}
#     elements:                     # amount = sign · (value + deviation + joint)
#       - {type: Rz, joint: q1, parameter: dq1}
#       - {type: Tx, value: 1.0, parameter: l1}
#     targets: [[0, 0, 0]]          # optional, in the tip's frame [m]
#     base: {xyz: [0, 0, 0], rpy: [0, 0, 0]}    # optional [m, rad]
#     lengths: [l1]                 # the parameters of the level "lengths"
#     offsets: [dq1]                # the parameters of the level "offsets"
#     levels: {elbow: [l1, dq2]}    # optional, further levels
#
# In place of ``elements``, a table, standard (``dh``) or modified (``modified_dh``), as in ``dh.py``:
#
#     dh:
#       length_unit: mm             # of a and d: m (default) or mm
#       angle_unit: deg             # of alpha and theta: rad (default) or deg
#       rows:                       # what is not given is 0; type: revolute (default), prismatic or fixed
#         - {joint: q1, theta: 0, d: 0, a: 1000, alpha: 0}
#         - {joint: q2, type: prismatic, sign: -1, alpha: 90}
#
# A table brings its own ``lengths`` and ``offsets``, unless they are given, and the level ``dh``. Six placement
# errors ``<joint>.x … <joint>.rz`` in front of every joint are added to either; they make up the level ``full``.

CHAINS = ("elements", "dh", "modified_dh")
KEYS = ("name", "description", "joints", *CHAINS, "targets", "base", "lengths", "offsets", "levels")
ELEMENT_KEYS = ("type", "value", "joint", "sign", "parameter")
TABLE_KEYS = ("rows", "length_unit", "angle_unit")
ROW_KEYS = ("joint", "type", "theta", "d", "a", "alpha", "sign")
JOINT_KEYS = ("name", "lower", "upper", "unit")
ANGLES = {"rad": 1.0, "deg": np.pi / 180.0}
LENGTHS = {"m": 1.0, "mm": 1e-3}
PLACEMENT_ERRORS = ("x", "y", "z", "rx", "ry", "rz")
Levels = Mapping[str, tuple[str, ...]]


def read_robot_yaml(path: Path) -> Robot:
    """Read a robot from a YAML file.

    Raises:
        FileFormatError: Names the key at fault, what it holds and what is valid.
    """
    reader = _Reader(path)
    document = reader.document()
    try:
        return reader.robot(document)
    except FileFormatError:
        raise
    except CalibPlannerError as error:
        raise reader.error("robot", error, "a consistent chain") from None


class _Reader(YamlReader):
    """Reads one document."""

    def robot(self, document: Any) -> Robot:
        top = self.mapping("document", document, KEYS, required=("joints",))
        joints = [
            self.mapping(f"joints[{i}]", j, JOINT_KEYS, required=("name", "lower", "upper"))
            for i, j in enumerate(self.sequence("joints", top["joints"]))
        ]
        names = tuple(self.text(f"joints[{i}].name", j["name"]) for i, j in enumerate(joints))
        check_joint_names(self.path, names)
        chain, levels = self.chain(top, names)
        chain = [*self.base(top.get("base", {})), *_with_placement_errors(chain, names)]
        full = tuple(f"{names[e.joint]}.{x}" for e in chain if e.joint is not None for x in PLACEMENT_ERRORS)
        levels = self.levels(top, {**levels, "full": full}, [e.parameter for e in chain if e.parameter])
        robot = Robot(
            name=self.text("name", top.get("name", self.path.stem)),
            elements=tuple(chain),
            targets=target_elements(self.targets(top.get("targets", [[0, 0, 0]]))),
            joint_names=names,
            joint_limits=np.array([self.limits(f"joints[{i}]", j) for i, j in enumerate(joints)]),
            levels=levels,
            parameter_names=levels.get("lengths+offsets") or full,
            source=str(self.path),
        )
        self.check_units(robot, joints)
        return robot

    def chain(self, top: Mapping[str, Any], names: Sequence[str]) -> tuple[list[Element], Levels]:
        """The chain and the levels that it brings."""
        given = [key for key in CHAINS if key in top]
        if len(given) != 1:
            raise self.error(
                "document", " and ".join(given) or "no chain", f"exactly one of: {', '.join(CHAINS)}"
            )
        if given != ["elements"]:
            return self.table(given[0], top[given[0]], names)
        items = enumerate(self.sequence("elements", top["elements"]))
        return [self.element(f"elements[{i}]", item, names) for i, item in items], {}

    def element(self, where: str, item: Any, joint_names: Sequence[str]) -> Element:
        entry = self.mapping(where, item, ELEMENT_KEYS, required=("type",))
        names = {
            key: None if entry.get(key) is None else self.text(f"{where}.{key}", entry[key])
            for key in ("joint", "parameter")
        }
        joint = names["joint"]
        return Element(
            kind=self.choice(f"{where}.type", entry["type"], KINDS),
            value=self.number(f"{where}.value", entry.get("value", 0.0)),
            joint=None if joint is None else joint_names.index(self.choice(f"{where}.joint", joint, joint_names)),
            sign=self.sign(f"{where}.sign", entry.get("sign", 1)),
            parameter=names["parameter"],
        )

    def table(self, key: str, item: Any, names: Sequence[str]) -> tuple[list[Element], Levels]:
        """A Denavit–Hartenberg table."""
        table = self.mapping(key, item, TABLE_KEYS, required=("rows",))
        length = LENGTHS[self.choice(f"{key}.length_unit", table.get("length_unit", "m"), LENGTHS)]
        angle = ANGLES[self.choice(f"{key}.angle_unit", table.get("angle_unit", "rad"), ANGLES)]
        scales = {"theta": angle, "d": length, "a": length, "alpha": angle}
        items = enumerate(self.sequence(f"{key}.rows", table["rows"]))
        rows = [self.row(f"{key}.rows[{i}]", entry, names, scales) for i, entry in items]
        check_joint_names(self.path, [row.joint for row in rows])
        for name in set(names).difference(row.joint for row in rows):
            raise self.error(f"{key}.rows", f"no row of joint {name!r}", "one row for every joint")
        modified = key == "modified_dh"
        return list(dh_elements(rows, names, modified=modified)), dh_levels(rows, modified=modified)

    def row(self, where: str, item: Any, names: Sequence[str], scales: Mapping[str, float]) -> DhRow:
        entry = self.mapping(where, item, ROW_KEYS, required=("joint",))
        joint = self.text(f"{where}.joint", entry["joint"])
        kind = self.choice(f"{where}.type", entry.get("type", "revolute"), ROW_TYPES)
        if kind == "fixed" and (joint in names or "sign" in entry):
            raise self.error(where, f"a sign or the joint {joint!r}", "neither, in a row whose type is fixed")
        if kind != "fixed":
            self.choice(f"{where}.joint", joint, names)
        numbers = {k: s * self.number(f"{where}.{k}", entry[k]) for k, s in scales.items() if k in entry}
        return DhRow(joint, kind, sign=self.sign(f"{where}.sign", entry.get("sign", 1)), **numbers)

    def sign(self, where: str, item: Any) -> float:
        sign = self.number(where, item)
        if abs(sign) != 1.0:
            raise self.error(where, brief(item), "+1 or -1")
        return sign

    def levels(self, top: Mapping[str, Any], own: Levels, known: Sequence[str]) -> Levels:
        """All levels that are not empty; ``own`` are the chain's."""
        found = {
            key: self.names(key, top[key], known) if key in top else own.get(key, ())
            for key in ("offsets", "lengths")
        }
        found["lengths+offsets"] = (*found["lengths"], *found["offsets"])
        found |= {key: names for key, names in own.items() if key not in found}
        further = top.get("levels", {})
        for key in self.mapping("levels", further, tuple(further) if isinstance(further, Mapping) else ()):
            name = self.text("levels", key)
            if name in found or name in known or "," in name:
                raise self.error(
                    "levels", repr(name), "a name that no other level or parameter has, without commas"
                )
            found[name] = self.names(f"levels.{name}", further[key], known)
        return {key: tuple(names) for key, names in found.items() if names}

    def base(self, item: Any) -> tuple[Element, ...]:
        base = self.mapping("base", item, ("xyz", "rpy"))
        xyz, rpy = (self.vector(f"base.{k}", base.get(k, [0, 0, 0])) for k in ("xyz", "rpy"))
        return pose_elements("base", xyz, rpy)

    def targets(self, item: Any) -> FloatArray:
        return np.array([self.vector(f"targets[{i}]", t) for i, t in enumerate(self.sequence("targets", item))])

    def limits(self, where: str, joint: Mapping[str, Any]) -> tuple[float, float]:
        scales = ANGLES | LENGTHS
        scale = scales[self.choice(f"{where}.unit", joint.get("unit", "rad"), scales)]
        lower, upper = (scale * self.number(f"{where}.{key}", joint[key]) for key in ("lower", "upper"))
        return lower, upper

    def check_units(self, robot: Robot, joints: Sequence[Mapping[str, Any]]) -> None:
        """A unit that is given must be one of the joint's kind."""
        for i, (joint, turns) in enumerate(zip(joints, robot.joint_is_revolute, strict=True)):
            valid = ANGLES if turns else LENGTHS
            if joint.get("unit", next(iter(valid))) not in valid:
                kind = "turns" if turns else "slides"
                expected = f"one of: {', '.join(valid)}, as the joint {kind}"
                raise self.error(f"joints[{i}].unit", repr(joint["unit"]), expected)


def _with_placement_errors(chain: Sequence[Element], joint_names: Sequence[str]) -> list[Element]:
    """The chain with six placement errors in front of every joint."""
    found: list[Element] = []
    for element in chain:
        if element.joint is not None:
            name = joint_names[element.joint]
            found += [
                Element(kind, parameter=f"{name}.{x}") for kind, x in zip(KINDS, PLACEMENT_ERRORS, strict=True)
            ]
        found.append(element)
    return found


register_file_reader(load_robot)
