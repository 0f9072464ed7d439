# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""URDF in and out: the chain between two links as a robot, its speed limits, and a calibrated URDF.

*Reading.* Each joint of the chain becomes ``Tx Ty Tz · Rz Ry Rx`` (its origin, with six placement errors named
after the joint) and one rotation or translation about its axis, with the offset parameter ``<joint>.offset``. An
axis other than ±x, ±y, ±z is reached by two constant rotations and left by their inverse. Fixed joints keep their
place in the chain, as constants. ``urdf_tree`` says which chain that is; what stands beside it does not matter.
Mass and centre of gravity of the links that the chain carries (``<inertial>``) are kept as they stand.

*Writing.* The calibrated URDF is the source, byte for byte, except for the origins of the joints that changed.
The parser (expat) says at which byte each ``<joint>`` of the robot, its ``<origin>`` and its first child begin;
only attribute values of origins are replaced, and of those only the numbers that changed. Comments, white space,
order, quotes, line ends, byte order mark and everything that other programs keep in the file stay. Where an
``<origin>`` or an attribute is missing and needed, it is inserted. ``robot.origins`` derives what an origin is.
The pose of the base in the tracker's frame and the targets have no place in a URDF (``UrdfChanges.not_written``).
Limits stay: they are in the controller's joint coordinates, and those keep their meaning.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from calib_planner.arrays import FloatArray, frozen
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError
from calib_planner.io.text import decode, read_bytes, user_path, write_text
from calib_planner.io.urdf_tree import (
    X_AXIS,
    UrdfChain,
    UrdfJoint,
    chain_of,
    fixed_pose,
    floats,
    has_macros,
    refuse_declaration,
    root_of,
    unit,
    without_declaration,
)
from calib_planner.io.xacro import read_urdf_text, split_arguments
from calib_planner.robot import (
    Element,
    JointOrigins,
    LinkMass,
    Origin,
    Robot,
    check_joint_names,
    joint_origins,
    not_in_origins,
    pose_elements,
    target_elements,
)
from calib_planner.units import brief

URDF = "a URDF"
EXPAND = "expand it first: xacro FILE.urdf.xacro > robot.urdf"
ATTRIBUTE = re.compile(rb"""\s+([^\s=/>"']+)\s*=\s*("[^"]*"|'[^']*')""")
"""One attribute; of a document that is well formed, which the parser has checked."""
ROUNDING = 1e-15
"""A number that changed by no more than this did not change [m | rad]."""
AXIS_TOLERANCE = 1e-9


# ── a robot ──────────────────────────────────────────────────────────────────────────────────────────


def read_urdf(source: str | Path, base_link: str | None = None, tip_link: str | None = None) -> Robot:
    """Read the chain from ``base_link`` (default: the root) to ``tip_link`` (default: the only tip).

    Args:
        source: The file; behind the name of a xacro file may stand arguments, ``name:=value``.
        base_link, tip_link: The ends of the chain.
    """
    return parse_urdf(read_urdf_text(source), str(source), base_link, tip_link)


def parse_urdf(text: str, source: str, base_link: str | None = None, tip_link: str | None = None) -> Robot:
    """Like ``read_urdf``, from the text itself; ``source`` names it in errors.

    Raises:
        FileFormatError: Not XML, not a URDF, or no single serial chain between the links.
    """
    root = root_of(text, source)
    try:
        return _robot(root, source, chain_of(root, source, base_link, tip_link))
    except FileFormatError as error:
        if not has_macros(root):
            raise
        reason = str(error).removeprefix(f"{source}: ")
        advice = f"{EXPAND} (as it stands, {reason})"
        raise FileFormatError(source, "document", "a xacro file", "plain URDF", advice) from None


def read_chain(source: str | Path, base_link: str | None = None, tip_link: str | None = None) -> UrdfChain:
    """What the file of ``read_urdf`` says of the chain, and what stands beside it.

    Raises:
        FileFormatError: As ``read_urdf``.
    """
    return parse_chain(read_urdf_text(source), str(source), base_link, tip_link)


def parse_chain(text: str, source: str, base_link: str | None = None, tip_link: str | None = None) -> UrdfChain:
    """Like ``read_chain``, from the text itself; ``source`` names it in errors.

    Raises:
        FileFormatError: As ``parse_urdf``.
    """
    return chain_of(root_of(text, source), source, base_link, tip_link)


def _robot(root: ElementTree.Element, source: str, whole: UrdfChain) -> Robot:
    chain = whole.joints
    moving = [j.name for j in chain if j.moves]
    check_joint_names(source, moving)
    elements = [*pose_elements("base", np.zeros(3), np.zeros(3))]
    lengths: list[str] = []
    full: list[str] = []
    for joint in chain:
        xyz, axis = joint.xyz, joint.axis
        pose = pose_elements(joint.name, xyz, joint.rpy)
        if not joint.moves:
            elements += [Element(e.kind, e.value) for e in pose if e.value != 0.0]
            continue
        elements += [*pose, *_axis_elements(joint, axis, moving.index(joint.name))]
        named = [str(e.parameter) for e in pose if e.parameter]
        full += named
        lengths += [n for n, v in zip(named, xyz, strict=False) if v != 0.0]
    offsets = tuple(f"{name}.offset" for name in moving)
    levels = {"offsets": offsets, "lengths": tuple(lengths), "lengths+offsets": (*lengths, *offsets)}
    try:
        return Robot(
            name=str(root.get("name", "robot")),
            elements=tuple(elements),
            targets=target_elements(np.zeros((1, 3))),
            joint_names=tuple(moving),
            joint_limits=np.array([j.limits for j in chain if j.moves]),
            levels={**levels, "full": tuple(full)},
            parameter_names=(*lengths, *offsets),
            source=source,
            from_urdf=True,
            links=(whole.base, whole.tip),
            link_masses=_link_masses(whole, moving),
            remarks=whole.remarks,
        )
    except FileFormatError:
        raise
    except CalibPlannerError as error:
        raise FileFormatError(source, "robot", error, "a consistent chain") from None


def read_speed_limits(path: str | Path, joint_names: Sequence[str]) -> FloatArray | None:
    """(joints,) speed limits in the order of ``joint_names`` [rad/s | m/s].

    They are no part of a ``Robot``: timetables depend on them, positions do not. ``None`` unless every joint has
    a limit above zero: exporters write 0 for a limit that nobody entered.

    Raises:
        FileFormatError: Not readable, not XML, or a velocity that is no number.
    """
    return parse_speed_limits(read_urdf_text(path), str(path), joint_names)


def parse_speed_limits(text: str, path: str, joint_names: Sequence[str]) -> FloatArray | None:
    """Like ``read_speed_limits``, from the text itself; ``path`` names it in errors."""
    limits: dict[str, float] = {}
    for item in root_of(text, path).findall("joint"):
        name, limit = item.get("name", ""), item.find("limit")
        if name not in joint_names:
            continue
        word = "0" if limit is None else limit.get("velocity", "0")
        speed = floats(word, 1)
        if speed is None:
            where = f"joint {name!r} limit velocity"
            raise FileFormatError(path, where, brief(word), "a finite number [rad/s | m/s]")
        limits[name] = float(speed[0])
    speeds = np.array([limits.get(name, 0.0) for name in joint_names])
    return frozen(speeds) if (speeds > 0).all() else None


def _axis_elements(joint: UrdfJoint, axis: FloatArray, index: int) -> list[Element]:
    """The moving element, turned to its axis (3,)."""
    letter = "T" if joint.type == "prismatic" else "R"
    name = f"{joint.name}.offset"
    main = int(np.argmax(np.abs(axis)))
    if abs(abs(axis[main]) - 1.0) < 1e-12:
        sign = float(np.sign(axis[main]))
        return [Element(letter + "xyz"[main], joint=index, sign=sign, parameter=name)]
    x, y, z = axis
    yaw, pitch = float(np.arctan2(y, x)), float(np.arctan2(np.hypot(x, y), z))
    turn = [Element("Rz", yaw), Element("Ry", pitch)]
    back = [Element("Ry", -pitch), Element("Rz", -yaw)]
    return [*turn, Element(letter + "z", joint=index, parameter=name), *back]


def _link_masses(chain: UrdfChain, moving: list[str]) -> tuple[LinkMass, ...]:
    """The ``<inertial>`` of every link that the chain carries, seen from the last joint that moves before it.

    Links beside the chain count where only fixed joints hold them: where a gripper's fingers stand is not known.
    """
    result: list[LinkMass] = []
    for joint in chain.joints:
        if not joint.moves:
            continue
        waiting: list[tuple[str, FloatArray, FloatArray]] = [(joint.child, np.eye(3), np.zeros(3))]
        seen: set[str] = set()
        while waiting:
            link, turn, place = waiting.pop()
            if link in seen:  # beside the chain the file need not be a tree
                continue
            seen.add(link)
            inertial = _inertial(chain.links[link])
            if inertial is not None:
                x, y, z = (float(v) for v in place + turn @ inertial[1])
                result.append(LinkMass(moving.index(joint.name), inertial[0], (x, y, z)))
            for below in chain.below.get(link, ()):
                pose = fixed_pose([below]) if below.type == "fixed" else None
                if pose is not None:
                    waiting.append((below.child, turn @ pose[0], place + turn @ pose[1]))
    return tuple(result)


def _inertial(link: ElementTree.Element) -> tuple[float, FloatArray] | None:
    """Mass [kg] and centre of gravity (3,) [m], NaN where they are no numbers; ``None`` without a mass."""
    inertial = link.find("inertial")
    weight = None if inertial is None else inertial.find("mass")
    if inertial is None or weight is None:
        return None
    mass = floats(weight.get("value", ""), 1)
    origin = inertial.find("origin")
    centre = floats("0 0 0" if origin is None else origin.get("xyz", "0 0 0"), 3)
    return np.nan if mass is None else float(mass[0]), np.full(3, np.nan) if centre is None else centre


# ── a calibrated URDF ────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class UrdfChanges:
    """What was done to a URDF.

    Attributes:
        joints: Names of the joints whose origin was changed.
        not_written: Parameters that are not zero and have no place in a URDF: ``base.*``, ``target_*``.
    """

    joints: tuple[str, ...]
    not_written: tuple[str, ...]


@dataclass
class _Place:
    """Where a joint stands in the file [bytes from the start], and what its nominal origin and axis are."""

    inside: int = -1  # of the first child
    origin: int = -1  # of <origin>
    numbers: dict[str, str] = field(default_factory=dict)  # attributes of <origin>
    axis: str | None = None  # attribute xyz of <axis>


def write_calibrated_urdf(
    path: str | Path, robot: Robot, source: str | Path | None = None, field: str = "--urdf-output"
) -> UrdfChanges:
    """Write the URDF of a calibrated robot.

    Args:
        path: The file to write; not the source.
        robot: The calibrated robot, e.g. ``Estimate.calibrated``; its values are nominal + deviation.
        source: The URDF that the robot was read from (``robot.source``); a xacro file is expanded first.
        field: The argument or option that named ``path``, for the error.

    Raises:
        InputError: The robot is not from a URDF, ``path`` is its source or cannot be written.
        FileFormatError: The source is not readable, or not (or no longer) the URDF of this robot.
    """
    require_urdf(robot, field)
    given = robot.source if source is None else source
    origin, _ = split_arguments(given)
    if user_path(path).resolve() == origin.resolve():
        raise InputError(field, str(path), "another file than the nominal URDF", "keep the nominal one")
    text, raw = read_urdf_text(given), decode(origin, URDF, read_bytes(origin, URDF))
    if raw.removeprefix("\ufeff") == text:  # not expanded: a byte order mark stays
        text = raw
    calibrated, changes = calibrated_urdf(text, robot, str(origin))
    write_text(path, calibrated, field)
    return changes


def calibrated_urdf(text: str, robot: Robot, source: str = "URDF") -> tuple[str, UrdfChanges]:
    """The text of the URDF with the origins of the calibrated robot; ``source`` names it in errors.

    Raises:
        InputError: The robot is not from a URDF.
        FileFormatError: Not the URDF of this robot.
    """
    require_urdf(robot, "robot")
    data = text.encode("utf-8")
    joints = _find_joints(data, source, robot.joint_names)
    wanted = joint_origins(robot)
    edits: list[tuple[int, int, bytes]] = []
    changed = []
    for name, origin in wanted.joints.items():
        own = _edits(data, source, name, joints.get(name), origin, wanted)
        edits += own
        changed += [name] if own else []
    for start, end, new in sorted(edits, reverse=True):
        data = data[:start] + new + data[end:]
    return data.decode("utf-8"), UrdfChanges(tuple(changed), not_in_origins(robot))


def require_urdf(robot: Robot, field: str) -> None:
    """Refuse a robot that is not from a URDF; ``field`` names the option for the error."""
    if joint_origins(robot).tip is not None:
        advice = "write the kinematics YAML instead, or give the robot as a URDF"
        raise InputError(field, f"robot {robot.name!r} from {robot.source}", "a robot from a URDF", advice)


def _find_joints(data: bytes, source: str, names: tuple[str, ...]) -> dict[str, _Place]:
    """The robot's joints, directly below ``<robot>``; those elsewhere are other programs'."""
    joints: dict[str, _Place] = {}
    open_tags: list[str] = []
    current: list[_Place] = []
    parser = expat.ParserCreate(encoding="utf-8")

    def start(tag: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        if open_tags == ["robot"] and tag == "joint":
            name = attributes.get("name", "")
            if name in joints and name in names:
                raise FileFormatError(source, f"joint {name!r}", "twice", "each joint name once")
            joints[name] = _Place()
            current[:] = [joints[name]]
        elif open_tags == ["robot", "joint"]:
            _note_child(current[0], tag, attributes, at)
        open_tags.append(tag)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_tags.pop()
    parser.StartDoctypeDeclHandler = lambda *_: refuse_declaration(source)
    try:
        parser.Parse(without_declaration(data), True)
    except expat.ExpatError as error:
        raise FileFormatError(source, "XML", error, "well-formed XML") from None
    return joints


def _note_child(joint: _Place, tag: str, attributes: dict[str, str], at: int) -> None:
    if joint.inside < 0:
        joint.inside = at
    if tag == "origin" and joint.origin < 0:
        joint.origin, joint.numbers = at, attributes
    elif tag == "axis" and joint.axis is None:
        joint.axis = attributes.get("xyz", X_AXIS)


def _edits(
    data: bytes, source: str, name: str, joint: _Place | None, origin: Origin, wanted: JointOrigins
) -> list[tuple[int, int, bytes]]:
    """What to replace, as (start, end, new), so that the joint has this origin."""
    if joint is None:
        raise FileFormatError(source, f"joint {name!r}", "nothing", "this joint of the robot", "give its URDF")
    axis = floats(joint.axis or X_AXIS, 3)
    if axis is None or np.abs(unit(axis) - wanted.axes[name]).max() > AXIS_TOLERANCE:
        expected = f"{_text(wanted.axes[name])}, the robot's"
        raise FileFormatError(source, f"joint {name!r} axis", joint.axis, expected, "give the robot's own URDF")
    values = {"xyz": origin.xyz, "rpy": origin.rpy}
    changed = {k: v for k, v in values.items() if not _says(joint.numbers.get(k, "0 0 0"), v)}
    if not changed:
        return []
    if joint.origin < 0:
        return [_new_origin(data, joint.inside, changed)]
    return [_new_attribute(data, joint.origin, key, value) for key, value in changed.items()]


def _new_origin(data: bytes, at: int, values: dict[str, FloatArray]) -> tuple[int, int, bytes]:
    """A whole ``<origin>`` before the joint's first child, on a line of its own if that is."""
    before = data[:at]
    indent = before[len(before.rstrip()) :]
    inner = "".join(f' {key}="{_text(value)}"' for key, value in values.items())
    return at, at, f"<origin{inner}/>".encode() + indent


def _new_attribute(data: bytes, tag: int, key: str, value: FloatArray) -> tuple[int, int, bytes]:
    end = tag + len(b"<origin")
    while match := ATTRIBUTE.match(data, end):
        end = match.end()
        if match[1].decode() == key:
            old = match[2][1:-1].decode()
            return match.start(2) + 1, match.end(2) - 1, _replaced(old, value).encode()
    return end, end, f' {key}="{_text(value)}"'.encode()


def _replaced(old: str, value: FloatArray) -> str:
    """The attribute's text with the numbers that changed replaced; its white space stays."""
    if floats(old, 3) is None:  # character references: equal to no number as they stand
        return _text(value)
    new = iter(value)

    def number(match: re.Match[str]) -> str:
        v = float(next(new))
        return match[0] if float(match[0]) == v else repr(v)

    return re.sub(r"\S+", number, old)


def _says(text: str, value: FloatArray) -> bool:
    numbers = floats(text, 3)
    return numbers is not None and bool((np.abs(numbers - value) <= ROUNDING).all())


def _text(value: FloatArray) -> str:
    return " ".join(map(repr, value.tolist()))
