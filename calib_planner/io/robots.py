# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Robots from files: those that come with the package, users' URDFs, and users' YAML files.

A robot YAML holds the chain of eq. (2) element by element:

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
    levels: {elbow: [l1, dq2]}    # optional, further levels
    couple: [j3+=j2]              # optional: the controller shows j3 plus j2, see ``robot.coupling``
    masses:                       # optional: what a joint carries; mass [kg], centre of gravity [m]
      - {joint: q2, mass: 4.2, xyz: [0.4, 0, 0.05]}

In place of ``elements``, a table, standard (``dh``) or modified (``modified_dh``), see ``robot.dh_elements``:

    dh:
      length_unit: mm             # of a and d: m (default) or mm
      angle_unit: deg             # of alpha and theta: rad (default) or deg
      rows:                       # what is not given is 0; type: revolute (default), prismatic or fixed
        - {joint: q1, theta: 0, d: 0, a: 1000, alpha: 0}
        - {joint: q2, type: prismatic, sign: -1, alpha: 90}

A table brings its own ``lengths`` and ``offsets``, unless they are given, and the level ``dh``. Six placement
errors ``<joint>.x … <joint>.rz`` in front of every joint are added to either; they make up the level ``full``.
A centre of gravity is in the frame right behind the joint's motion, or for a table in the frame of its row, as
makers of robots publish it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from calib_planner.errors import CalibPlannerError, FileFormatError, InputError, UnknownNameError
from calib_planner.io.text import read_text
from calib_planner.io.urdf import read_urdf
from calib_planner.io.xacro import split_arguments
from calib_planner.io.yaml import Node, parse_yaml
from calib_planner.robot import (
    KINDS,
    ROW_TYPES,
    DhRow,
    Element,
    LinkMass,
    Robot,
    believable_limits,
    check_joint_names,
    dh_elements,
    dh_levels,
    limit_remarks,
    parse_coupling,
    pose_elements,
    pose_of,
    re_placed,
    register_file_reader,
    rotation,
    target_elements,
)

URDF_SUFFIXES = (".urdf", ".xml", ".xacro", ".sdf")
"""Files that are read as URDF; what is another format after all is told so by its content."""
YAML_SUFFIXES = (".yaml", ".yml")
ROBOT_YAML = "readable YAML of a robot"
CHAINS = ("elements", "dh", "modified_dh")
LEVELS = ("lengths", "offsets", "levels")
KEYS = ("name", "description", "joints", *CHAINS, "targets", "base", *LEVELS, "couple", "masses")
ELEMENT_KEYS = ("type", "value", "joint", "sign", "parameter")
TABLE_KEYS = ("rows", "length_unit", "angle_unit")
ROW_KEYS = ("joint", "type", "theta", "d", "a", "alpha", "sign")
MASS_KEYS = ("joint", "mass", "xyz")
JOINT_KEYS = ("name", "lower", "upper", "unit")
ANGLES = {"rad": 1.0, "deg": np.pi / 180.0}
LENGTHS = {"m": 1.0, "mm": 1e-3}
PLACEMENT_ERRORS = ("x", "y", "z", "rx", "ry", "rz")
Levels = Mapping[str, tuple[str, ...]]


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
    path, arguments = split_arguments(source)
    shipped = str(source) in shipped_robots()
    if shipped:
        path = config_folder() / "robots" / f"{source}.yaml"
    suffix = path.suffix.lower()
    if not path.is_file() or suffix not in (*YAML_SUFFIXES, *URDF_SUFFIXES):
        if path.is_file():
            kinds = ", ".join((*URDF_SUFFIXES, *YAML_SUFFIXES))
            raise InputError("robot", source, f"a file of a robot, whose name ends in one of {kinds}")
        raise UnknownNameError(
            "robot", str(source), [*shipped_robots(), "PATH.urdf", "PATH.yaml (an existing file)"]
        )
    if suffix in URDF_SUFFIXES:
        return read_urdf(source if arguments else path, base_link, tip_link)
    for field, link in (("base_link", base_link), ("tip_link", tip_link)):
        if link is not None:
            advice = f"leave it out: {path.name} is one chain"
            raise InputError(field, repr(link), "no link beside a robot YAML, only beside a URDF", advice)
    return _shipped_robot(path) if shipped else read_robot_yaml(path)


@cache
def _shipped_robot(path: Path) -> Robot:
    """The robot of a file of the package, read and compiled once: robots are immutable."""
    return read_robot_yaml(path)


def read_robot_yaml(path: Path) -> Robot:
    """Read a robot from a YAML file.

    Raises:
        FileFormatError: Names the key at fault, what it holds and what is valid.
    """
    return parse_robot_yaml(read_text(path, ROBOT_YAML), path)


def parse_robot_yaml(text: str, path: Path) -> Robot:
    """Like ``read_robot_yaml``, from a text that stood in the file ``path``."""
    top = parse_yaml(text, path, ROBOT_YAML).mapping(KEYS, ("joints",))
    try:
        return _robot(top)
    except FileFormatError:
        raise
    except CalibPlannerError as error:
        raise FileFormatError(path, "robot", error, "a consistent chain") from None


def _robot(top: Node) -> Robot:
    joints = [joint.mapping(JOINT_KEYS, ("name", "lower", "upper")) for joint in top["joints"].items()]
    names = tuple(joint["name"].name() for joint in joints)
    check_joint_names(top.path, names)
    chain, levels, stated, remarks = _chain(top, names)
    given = top["masses"].items() if "masses" in top else []
    masses = tuple(_mass(node, names, stated, "elements" in top) for node in given)
    masses = tuple(_moved(mass, stated, chain) for mass in masses) if remarks else masses
    chain = [*_base(top.get("base", {})), *_with_placement_errors(chain, names)]
    full = tuple(f"{names[e.joint]}.{x}" for e in chain if e.joint is not None for x in PLACEMENT_ERRORS)
    levels = _levels(top, {**levels, "full": full}, [e.parameter for e in chain if e.parameter])
    robot = Robot(
        name=top.get("name", Path(top.path).stem).name(),
        elements=tuple(chain),
        targets=target_elements(np.array([t.numbers(3) for t in top.get("targets", [[0, 0, 0]]).items()])),
        joint_names=names,
        joint_limits=np.array([_limits(joint) for joint in joints]),
        levels=levels,
        parameter_names=levels.get("lengths+offsets") or full,
        source=str(top.path),
        link_masses=masses,
    )
    limits = robot.joint_limits.copy()
    for joint, turns in zip(joints, robot.joint_is_revolute, strict=True):
        valid = ANGLES if turns else LENGTHS
        if joint.get("unit", next(iter(valid))).value not in valid:
            kind = "turns" if turns else "slides"
            raise joint["unit"].refused(f"one of: {', '.join(valid)}, as the joint {kind}")
    said: list[tuple[str, str]] = []
    for row, name in enumerate(names):
        low, high, remark = believable_limits(name, *limits[row].tolist(), turns=robot.joint_is_revolute[row])
        limits[row] = low, high
        said.append((name, remark))
    robot = replace(robot, joint_limits=limits, remarks=(*remarks, *limit_remarks(said)))
    if "couple" not in top:
        return robot
    texts = [node.name() for node in top["couple"].items()]
    return robot.with_couplings([parse_coupling(text) for text in texts])


def _chain(top: Node, names: Sequence[str]) -> tuple[list[Element], Levels, list[Element], list[str]]:
    """The chain, the levels that it brings, the chain as it is stated, and what was changed, in words."""
    given = [key for key in CHAINS if key in top]
    if len(given) != 1:
        raise top.error(" and ".join(given) or "no chain", f"exactly one of: {', '.join(CHAINS)}")
    if given != ["elements"]:
        return _table(top[given[0]], names, modified=given == ["modified_dh"])
    chain = [_element(entry, names) for entry in top["elements"].items()]
    return chain, {}, chain, []


def _element(entry: Node, joint_names: Sequence[str]) -> Element:
    entry.mapping(ELEMENT_KEYS, ("type",))
    joint, parameter = (
        None if entry.get(key).value is None else entry[key].name() for key in ("joint", "parameter")
    )
    return Element(
        kind=entry["type"].choice(KINDS),
        value=entry.get("value", 0.0).number(),
        joint=None if joint is None else joint_names.index(_joint_name(entry["joint"], joint_names)),
        sign=_sign(entry.get("sign", 1)),
        parameter=parameter,
    )


def _joint_name(node: Node, joint_names: Sequence[str]) -> str:
    return Node(node.path, node.where, node.name()).choice(joint_names)


def _table(
    table: Node, names: Sequence[str], *, modified: bool
) -> tuple[list[Element], Levels, list[Element], list[str]]:
    table.mapping(TABLE_KEYS, ("rows",))
    length = LENGTHS[table.get("length_unit", "m").choice(LENGTHS)]
    angle = ANGLES[table.get("angle_unit", "rad").choice(ANGLES)]
    scales = {"theta": angle, "d": length, "a": length, "alpha": angle}
    rows = [_row(entry, names, scales) for entry in table["rows"].items()]
    check_joint_names(table.path, [row.joint for row in rows])
    for name in set(names).difference(row.joint for row in rows):
        raise table["rows"].error(f"no row of joint {name!r}", "one row for every joint")
    new, words = re_placed(rows, modified=modified)
    stated = list(dh_elements(rows, names, modified=modified))
    chain = list(dh_elements(new, names, modified=modified)) if words else stated
    return chain, dh_levels(new, modified=modified), stated, words


def _row(entry: Node, names: Sequence[str], scales: Mapping[str, float]) -> DhRow:
    entry.mapping(ROW_KEYS, ("joint",))
    joint = entry["joint"].name()
    kind = entry.get("type", "revolute").choice(ROW_TYPES)
    if kind == "fixed" and (joint in names or "sign" in entry):
        raise entry.error(f"a sign or the joint {joint!r}", "neither, in a row whose type is fixed")
    if kind != "fixed":
        _joint_name(entry["joint"], names)
    numbers = {key: scale * entry[key].number() for key, scale in scales.items() if key in entry}
    return DhRow(joint, kind, sign=_sign(entry.get("sign", 1)), **numbers)


def _sign(node: Node) -> float:
    sign = node.number()
    if abs(sign) != 1.0:
        raise node.refused("+1 or -1")
    return sign


def _levels(top: Node, own: Levels, known: Sequence[str]) -> Levels:
    """All levels that are not empty; ``own`` are the chain's."""
    levels = {key: top[key].names(known) if key in top else own.get(key, ()) for key in ("offsets", "lengths")}
    levels["lengths+offsets"] = (*levels["lengths"], *levels["offsets"])
    levels |= {key: names for key, names in own.items() if key not in levels}
    for name, node in top.get("levels", {}).mapping().entries():
        if name in levels or name in known or "," in name:
            expected = "a name that no other level or parameter has, without commas"
            raise top["levels"].error(repr(name), expected)
        levels[name] = node.names(known)
    return {key: tuple(names) for key, names in levels.items() if names}


def _mass(node: Node, names: Sequence[str], chain: Sequence[Element], by_elements: bool) -> LinkMass:
    """What a joint carries; seen from the row of a table, its place is turned back to the joint's motion."""
    node.mapping(MASS_KEYS, ("joint", "mass"))
    joint, mass = names.index(_joint_name(node["joint"], names)), node["mass"].number()
    if not mass > 0.0:
        raise node["mass"].refused("a mass above 0 kg")
    place = node.get("xyz", [0.0, 0.0, 0.0]).numbers(3)
    if not by_elements:
        motion = next(i for i, e in enumerate(chain) if e.joint == joint)
        row = [f"{names[joint]}.{quantity}" for quantity in ("theta", "d", "a", "alpha")]
        for e in reversed([e for e in chain[motion + 1 :] if e.parameter in row]):
            shift = e.sign * e.value
            place = rotation(e.axis, shift) @ place if e.is_rotation else place + shift * np.eye(3)[e.axis]
    x, y, z = (float(v) for v in place)
    return LinkMass(joint, mass, (x, y, z))


def _moved(mass: LinkMass, stated: Sequence[Element], chain: Sequence[Element]) -> LinkMass:
    """The mass of a table in the frame that its joint has in the re-placed table."""
    places = []
    for elements in (stated, chain):
        end = next(i for i, e in enumerate(elements) if e.joint == mass.joint) + 1
        places.append(pose_of(elements[:end]))
    (turn, place), (new_turn, new_place) = places
    x, y, z = (float(v) for v in new_turn.T @ (place + turn @ mass.xyz - new_place))
    return replace(mass, xyz=(x, y, z))


def _base(node: Node) -> tuple[Element, ...]:
    node.mapping(("xyz", "rpy"))
    xyz, rpy = (node.get(key, [0, 0, 0]).numbers(3) for key in ("xyz", "rpy"))
    return pose_elements("base", xyz, rpy)


def _limits(joint: Node) -> tuple[float, float]:
    scales = ANGLES | LENGTHS
    scale = scales[joint.get("unit", "rad").choice(scales)]
    return scale * joint["lower"].number(), scale * joint["upper"].number()


def _with_placement_errors(chain: Sequence[Element], joint_names: Sequence[str]) -> list[Element]:
    """The chain with six placement errors in front of every joint."""
    elements: list[Element] = []
    for element in chain:
        if element.joint is not None:
            name = joint_names[element.joint]
            elements += [
                Element(kind, parameter=f"{name}.{x}") for kind, x in zip(KINDS, PLACEMENT_ERRORS, strict=True)
            ]
        elements.append(element)
    return elements


register_file_reader(load_robot)
