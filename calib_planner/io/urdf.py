"""Robots from URDF: the kinematic chain between two links.

Each joint becomes ``Tx Ty Tz · Rz Ry Rx`` (its origin, with six placement errors named after the joint) and
one rotation or translation about its axis with the offset parameter ``<joint>.offset``. Axes other than
±x, ±y, ±z are reached by two constant rotations and left by their inverse.

Only kinematics is read, with the standard library's parser; a document type declaration is refused, so no
entity is ever expanded. Fixed joints keep their place in the chain, as constants. Which joints make the chain,
and what is refused in it (mimic, floating and planar joints), is in ``urdf_tree``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from calib_planner.arrays import FloatArray, frozen
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError
from calib_planner.io.text import decode, read_bytes, read_text, write_text
from calib_planner.robot import (
    Element,
    JointOrigins,
    Origin,
    Robot,
    check_joint_names,
    joint_origins,
    not_in_origins,
    pose_elements,
    target_elements,
)

MODEL_FORMATS = {"sdf": ", an SDF model", "mujoco": ", a MuJoCo model"}


@dataclass(frozen=True)
class UrdfJoint:
    """One ``<joint>`` of the chain: name, type, origin, unit axis, limits ([rad] or [m])."""

    name: str
    type: str
    xyz: FloatArray
    rpy: FloatArray
    axis: FloatArray
    limits: tuple[float, float]


def read_urdf(path: Path, base_link: str | None = None, tip_link: str | None = None) -> Robot:
    """Read the chain from ``base_link`` (default: the root) to ``tip_link`` (default: the only tip)."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, "file", error, "readable URDF text") from None
    return parse_urdf(text, str(path), base_link, tip_link)


def parse_urdf(text: str, source: str, base_link: str | None = None, tip_link: str | None = None) -> Robot:
    """Like ``read_urdf``, from the text itself; ``source`` names it in errors.

    Raises:
        FileFormatError: Not XML, not a URDF, or no single serial chain between the links.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise FileFormatError(source, "document", "a document type declaration", "plain URDF without one")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        if "<xacro:" in text:
            raise _xacro(source) from None
        raise FileFormatError(source, "XML", error, "well-formed XML") from None
    if root.tag != "robot":
        got = f"<{root.tag}>" + MODEL_FORMATS.get(root.tag, "")
        advice = "export the robot as URDF" if root.tag in MODEL_FORMATS else ""
        raise FileFormatError(source, "root element", got, "<robot>, a URDF", advice)
    if any("xacro" in item.tag or "${" in "".join(item.attrib.values()) for item in root.iter()):
        raise _xacro(source)
    joints = [_joint(source, joint) for joint in read_chain(source, root, base_link, tip_link)]
    return _robot(source, str(root.get("name", "robot")), joints)


def _xacro(source: str) -> FileFormatError:
    advice = "expand it first: xacro FILE.urdf.xacro > robot.urdf"
    return FileFormatError(source, "document", "a xacro file", "plain URDF", advice)


def _joint(source: str, joint: TreeJoint) -> UrdfJoint:
    where = f"joint {joint.name!r}"
    origin, axis, limit = (joint.item.find(tag) for tag in ("origin", "axis", "limit"))
    xyz, rpy = (
        _vector(source, f"{where} origin {key}", "0 0 0" if origin is None else origin.get(key, "0 0 0"))
        for key in ("xyz", "rpy")
    )
    direction = np.array([1.0, 0.0, 0.0])
    if axis is not None and joint.type in MOVING:
        direction = _vector(source, f"{where} axis", axis.get("xyz", "1 0 0"))
    size = float(np.abs(direction).max())
    if size == 0:
        raise FileFormatError(source, f"{where} axis", "0 0 0", "a direction")
    direction = direction / size  # first, so that squares of tiny or huge numbers neither vanish nor overflow
    direction = direction / np.linalg.norm(direction)
    return UrdfJoint(joint.name, joint.type, xyz, rpy, direction, _limits(source, where, joint.type, limit))


def _limits(source: str, where: str, kind: str, limit: ElementTree.Element | None) -> tuple[float, float]:
    if kind == "continuous":
        return -np.pi, np.pi
    if limit is None or kind not in MOVING:
        if kind in ("revolute", "prismatic"):
            raise FileFormatError(source, where, "no <limit>", "<limit lower= upper=>")
        return 0.0, 0.0
    low, high = (_floats(source, f"{where} limit", limit.get(k, "0"), 1)[0] for k in ("lower", "upper"))
    if not low < high:
        advice = "give the range that may be used, or make the joint fixed"
        raise FileFormatError(source, f"{where} limit", f"[{low}, {high}]", "lower < upper", advice)
    return low, high


def _floats(source: str, where: str, text: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise FileFormatError(source, where, repr(text)[:80], f"{count} finite numbers")
    return values


def _vector(source: str, where: str, text: str) -> FloatArray:
    return np.array(_floats(source, where, text, 3))


def _robot(source: str, name: str, chain: list[UrdfJoint]) -> Robot:
    zero = np.zeros(3)
    elements = [*pose_elements("base", zero, zero)]
    moving = [j for j in chain if j.type in MOVING]
    check_joint_names(source, [j.name for j in moving])
    lengths: list[str] = []
    full: list[str] = []
    for joint in chain:
        pose = pose_elements(joint.name, joint.xyz, joint.rpy)
        if joint.type == "fixed":
            elements += [Element(e.kind, e.value) for e in pose if e.value != 0.0]
            continue
        elements += pose
        named = [str(e.parameter) for e in pose if e.parameter]
        full += named
        lengths += [n for n, v in zip(named, joint.xyz, strict=False) if v != 0.0]
        elements += _axis_elements(joint, moving.index(joint))
    offsets = tuple(f"{j.name}.offset" for j in moving)
    try:
        return Robot(
            name=name,
            elements=tuple(elements),
            targets=target_elements(np.zeros((1, 3))),
            joint_names=tuple(j.name for j in moving),
            joint_limits=np.array([j.limits for j in moving]),
            levels={
                "offsets": offsets,
                "lengths": tuple(lengths),
                "lengths+offsets": (*lengths, *offsets),
                "full": tuple(full),
            },
            parameter_names=(*lengths, *offsets),
            source=source,
            from_urdf=True,
        )
    except FileFormatError:
        raise
    except CalibPlannerError as error:
        raise FileFormatError(source, "robot", error, "a consistent chain") from None


def _axis_elements(joint: UrdfJoint, index: int) -> list[Element]:
    """The moving element, turned to its axis."""
    letter = "T" if joint.type == "prismatic" else "R"
    name = f"{joint.name}.offset"
    main = int(np.argmax(np.abs(joint.axis)))
    if abs(abs(joint.axis[main]) - 1.0) < 1e-12:
        sign = float(np.sign(joint.axis[main]))
        return [Element(letter + "xyz"[main], joint=index, sign=sign, parameter=name)]
    x, y, z = joint.axis
    yaw, pitch = float(np.arctan2(y, x)), float(np.arctan2(np.hypot(x, y), z))
    turn = [Element("Rz", yaw), Element("Ry", pitch)]
    back = [Element("Ry", -pitch), Element("Rz", -yaw)]
    return [*turn, Element(letter + "z", joint=index, parameter=name), *back]


# ── The tree of links in a URDF, and the one serial chain asked for ─────────────────────────────────────────
# Only who is joined to whom is read here, of all joints; the numbers are read later, of the joints in the chain,
# so that an oddity of a gripper does not stop the calibration of the arm.

MOVING = ("revolute", "continuous", "prismatic")
TYPES = (*MOVING, "fixed", "floating", "planar")


@dataclass(frozen=True)
class TreeJoint:
    """One ``<joint>``: what it joins, and the XML element that holds the rest."""

    name: str
    type: str
    parent: str
    child: str
    mimics: str
    item: ElementTree.Element


def read_chain(
    source: str, root: ElementTree.Element, base_link: str | None = None, tip_link: str | None = None
) -> list[TreeJoint]:
    """The joints from ``base_link`` (default: the tip's root) to ``tip_link`` (default: the only tip), in order.

    Raises:
        FileFormatError: Not a tree, no single tip, no such links, or a joint between them that cannot be used.
    """
    links = [str(item.get("name")) for item in root.findall("link")]
    for label, link in (("base_link", base_link), ("tip_link", tip_link)):
        if link is not None and link not in links:
            raise FileFormatError(source, label, repr(link), f"one of: {', '.join(links)}")
    by_child = _by_child(source, root, links)
    if tip_link is None:
        tip_link = _only_tip(source, links, by_child, base_link)
    chain = _climb(source, by_child, tip_link, base_link)
    top = chain[0].parent if chain else tip_link
    if base_link is not None and base_link != top:
        above = [j.parent for j in _climb(source, by_child, tip_link, None)]
        raise FileFormatError(
            source, "base_link", repr(base_link), f"a link above {tip_link!r}: {', '.join(above)}"
        )
    for joint in chain:
        _check_usable(source, joint)
    if not any(j.type in MOVING for j in chain):
        raise FileFormatError(source, f"chain from {top!r} to {tip_link!r}", "no moving joint", "at least one")
    return chain


def _by_child(source: str, root: ElementTree.Element, links: list[str]) -> dict[str, TreeJoint]:
    by_child: dict[str, TreeJoint] = {}
    for item in root.findall("joint"):
        joint = _tree_joint(source, item)
        for link in (joint.parent, joint.child):
            if link not in links:
                expected = f"one of the links: {', '.join(links)}"
                raise FileFormatError(source, f"joint {joint.name!r}", f"an unknown link {link!r}", expected)
        if joint.child in by_child:
            both = f"joints {by_child[joint.child].name!r} and {joint.name!r} above it"
            raise FileFormatError(source, f"link {joint.child!r}", both, "one joint above each link: a tree")
        by_child[joint.child] = joint
    if by_child and len(by_child) == len(links):
        raise FileFormatError(source, "joints", "a loop of joints without a root", "a tree of links")
    return by_child


def _tree_joint(source: str, item: ElementTree.Element) -> TreeJoint:
    name, kind = item.get("name", ""), item.get("type", "")
    parent, child = item.find("parent"), item.find("child")
    if not name or parent is None or child is None:
        raise FileFormatError(source, f"joint {name!r}", "no name, parent or child", "all three")
    if kind not in TYPES:
        raise FileFormatError(source, f"joint {name!r} type", repr(kind), f"{', '.join(MOVING)} or fixed")
    mimic = item.find("mimic")
    mimics = "" if mimic is None else mimic.get("joint") or "another joint"
    return TreeJoint(name, kind, parent.get("link", ""), child.get("link", ""), mimics, item)


def _only_tip(source: str, links: list[str], by_child: Mapping[str, TreeJoint], base_link: str | None) -> str:
    """The only leaf that a joint moves, seen from the base link if one is given.

    Leaves that nothing moves are frames on the base, as many robot descriptions have them.
    """
    parents = {joint.parent for joint in by_child.values()}
    tips = []
    for link in links:
        if link in parents or link not in by_child:
            continue
        chain = _climb(source, by_child, link, base_link)
        if chain and base_link in (None, chain[0].parent) and any(j.type != "fixed" for j in chain):
            tips.append(link)
    if len(tips) == 1:
        return tips[0]
    got = f"{len(tips)} possible tips: {', '.join(tips) or 'no moving joint leads to a link'}"
    raise FileFormatError(
        source, "tip_link", got, "one", "name the chain's last link (--tip-link)" if tips else ""
    )


def _climb(source: str, by_child: Mapping[str, TreeJoint], link: str, base_link: str | None) -> list[TreeJoint]:
    """The joints above ``link``, topmost first, up to ``base_link`` or the root."""
    chain: list[TreeJoint] = []
    while link != base_link and link in by_child:
        if len(chain) == len(by_child):
            raise FileFormatError(source, f"link {link!r}", "a loop of joints", "a tree of links")
        chain.append(by_child[link])
        link = by_child[link].parent
    return chain[::-1]


def _check_usable(source: str, joint: TreeJoint) -> None:
    where, avoid = (
        f"joint {joint.name!r}",
        "choose base_link and tip_link (--base-link, --tip-link) that avoid it",
    )
    if joint.mimics and joint.type != "fixed":
        advice = f"its coordinate follows {joint.mimics!r} and is not measured; {avoid}"
        raise FileFormatError(
            source, where, "a mimic joint in the chain", "joints with their own coordinate", advice
        )
    if joint.type in ("floating", "planar"):
        expected = f"{', '.join(MOVING)} or fixed"
        raise FileFormatError(source, where, f"a {joint.type} joint in the chain", expected, avoid)


# ── How fast the joints of a URDF may move: the ``velocity`` of their ``<limit>`` ───────────────────────────
# Not part of a ``Robot``: where things are does not depend on it, only timetables do.

URDF = "a URDF"


def read_speed_limits(path: str | Path, joint_names: Sequence[str]) -> FloatArray | None:
    """(joints,) speed limits in the order of ``joint_names`` [rad/s | m/s].

    ``None`` unless every joint has one above zero: exporters write 0 for a limit that nobody entered.

    Raises:
        FileFormatError: Not readable, not XML, or a velocity that is no number.
    """
    return parse_speed_limits(read_text(path, URDF), str(path), joint_names)


def parse_speed_limits(text: str, path: str, joint_names: Sequence[str]) -> FloatArray | None:
    """Like ``read_speed_limits``, from the text itself; ``path`` names it in errors."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # no entity is ever expanded
        raise FileFormatError(path, "document", "a document type declaration", "plain URDF without one")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise FileFormatError(path, "XML", error, "well-formed XML") from None
    found = {j.get("name", ""): _velocity(path, j) for j in root.findall("joint")}
    speeds = np.array([found.get(name, 0.0) for name in joint_names])
    return frozen(speeds) if (speeds > 0).all() else None


def _velocity(path: str, joint: ElementTree.Element) -> float:
    """The joint's speed limit [rad/s | m/s]; 0 where there is none."""
    limit = joint.find("limit")
    word = "0" if limit is None else limit.get("velocity", "0")
    try:
        speed = float(word)
    except ValueError:
        speed = np.nan
    if not np.isfinite(speed):
        where = f"joint {joint.get('name', '')!r} limit velocity"
        raise FileFormatError(path, where, repr(word)[:60], "a finite number [rad/s | m/s]")
    return speed


# ── A calibrated URDF: the source, byte for byte, but for the origins of the joints that changed ────────────
# The parser (expat) says at which byte each ``<joint>`` of the robot, its ``<origin>`` and its first child begin;
# only attribute values of origins are replaced, and of those only the numbers that changed. Comments, white
# space, order, quotes, line ends, byte order mark and everything that other programs keep in the file stay.
# Where an ``<origin>`` or an attribute is missing and needed, it is inserted.
#
# What an origin holds is derived in ``robot.origins``. The pose of the base in the tracker's frame and the
# targets are not in the URDF: they are named in ``UrdfChanges.not_written``. Limits stay: they are in the
# controller's joint coordinates, and those keep their meaning.

URDF = "a URDF"
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
    text = decode(origin, URDF, read_bytes(origin, URDF))
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
