"""A calibrated URDF: the source, byte for byte, but for the origins of the joints that changed.

The parser (expat) says at which byte each ``<joint>`` of the robot, its ``<origin>`` and its first child begin;
only attribute values of origins are replaced, and of those only the numbers that changed. Comments, white
space, order, quotes, line ends, byte order mark and everything that other programs keep in the file stay.
Where an ``<origin>`` or an attribute is missing and needed, it is inserted.

What an origin holds is derived in ``robot.origins``. The pose of the base in the tracker's frame and the
targets are not in the URDF: they are named in ``UrdfChanges.not_written``. Limits stay: they are in the
controller's joint coordinates, and those keep their meaning.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.errors import FileFormatError, InputError
from calib_planner.files.text import decode, read_bytes, write_text
from calib_planner.robot.chain import Robot
from calib_planner.robot.origins import JointOrigins, Origin, joint_origins, not_in_origins

WHAT = "a URDF"
ATTRIBUTE = re.compile(rb"""\s+([^\s=/>"']+)\s*=\s*("[^"]*"|'[^']*')""")
"""One attribute; of a document that is well formed, which the parser has checked."""

ROUNDING = 1e-15
"""A number that changed by no more than this did not change [m | rad]."""
AXIS_TOLERANCE = 1e-9
X_AXIS = "1 0 0"
"""What URDF takes where no axis is given."""


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
class _Joint:
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
        source: The URDF that the robot was read from (``robot.source``).
        field: The argument or option that named ``path``, for the error.

    Raises:
        InputError: The robot is not from a URDF, ``path`` is its source or cannot be written.
        FileFormatError: The source is not readable, or not (or no longer) the URDF of this robot.
    """
    require_urdf(robot, field)
    origin = Path(robot.source if source is None else source).expanduser()
    if Path(path).expanduser().resolve() == origin.resolve():
        raise InputError(field, str(path), "another file than the nominal URDF", "keep the nominal one")
    text = decode(origin, WHAT, read_bytes(origin, WHAT))
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
        found = _edits(data, source, name, joints.get(name), origin, wanted)
        edits += found
        changed += [name] if found else []
    for start, end, new in sorted(edits, reverse=True):
        data = data[:start] + new + data[end:]
    return data.decode("utf-8"), UrdfChanges(tuple(changed), not_in_origins(robot))


def require_urdf(robot: Robot, field: str) -> None:
    """Refuse a robot that is not from a URDF; ``field`` names the option for the error."""
    if joint_origins(robot).tip is not None:
        advice = "write the kinematics YAML instead, or give the robot as a URDF"
        raise InputError(field, f"robot {robot.name!r} from {robot.source}", "a robot from a URDF", advice)


# ── finding ──────────────────────────────────────────────────────────────────────────────────────────


def _find_joints(data: bytes, source: str, names: tuple[str, ...]) -> dict[str, _Joint]:
    """The robot's joints, directly below ``<robot>``; those elsewhere are other programs'."""
    joints: dict[str, _Joint] = {}
    open_tags: list[str] = []
    current: list[_Joint] = []
    parser = expat.ParserCreate(encoding="utf-8", namespace_separator="}")

    def start(tag: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        if open_tags == ["robot"] and tag == "joint":
            name = attributes.get("name", "")
            if name in joints and name in names:
                raise FileFormatError(source, f"joint {name!r}", "twice", "each joint name once")
            joints[name] = _Joint()
            current[:] = [joints[name]]
        elif open_tags == ["robot", "joint"]:
            _note_child(current[0], tag, attributes, at)
        open_tags.append(tag)

    def doctype(*_: object) -> None:
        raise FileFormatError(source, "document", "a document type declaration", "plain URDF without one")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_tags.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise FileFormatError(source, "XML", error, "well-formed XML") from None
    return joints


def _note_child(joint: _Joint, tag: str, attributes: dict[str, str], at: int) -> None:
    if joint.inside < 0:
        joint.inside = at
    if tag == "origin" and joint.origin < 0:
        joint.origin, joint.numbers = at, attributes
    elif tag == "axis" and joint.axis is None:
        joint.axis = attributes.get("xyz", X_AXIS)


# ── changing ─────────────────────────────────────────────────────────────────────────────────────────


def _edits(
    data: bytes, source: str, name: str, joint: _Joint | None, origin: Origin, wanted: JointOrigins
) -> list[tuple[int, int, bytes]]:
    """What to replace, as (start, end, new), so that the joint has this origin."""
    if joint is None:
        raise FileFormatError(source, f"joint {name!r}", "nothing", "this joint of the robot", "give its URDF")
    axis = _numbers(joint.axis or X_AXIS)
    if axis is None or np.abs(_unit(axis) - wanted.axes[name]).max() > AXIS_TOLERANCE:
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
    """The attribute's text with the numbers that changed replaced, its white space kept."""
    if _numbers(old) is None:  # character references: equal to no number as they stand
        return _text(value)
    new = iter(value)

    def number(match: re.Match[str]) -> str:
        v = float(next(new))
        return match[0] if float(match[0]) == v else repr(v)

    return re.sub(r"\S+", number, old)


def _says(text: str, value: FloatArray) -> bool:
    numbers = _numbers(text)
    return numbers is not None and bool((np.abs(numbers - value) <= ROUNDING).all())


def _unit(direction: FloatArray) -> FloatArray:
    direction = direction / (np.abs(direction).max() or 1.0)
    return direction / (np.linalg.norm(direction) or 1.0)


def _numbers(text: str) -> FloatArray | None:
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        return None
    return numbers if numbers.shape == (3,) else None


def _text(value: FloatArray) -> str:
    return " ".join(map(repr, value.tolist()))
