"""URDF in and out: the chain between two links as a robot, its speed limits, and a calibrated URDF.

*Reading.* Each joint of the chain becomes ``Tx Ty Tz · Rz Ry Rx`` (its origin, with six placement errors named
after the joint) and one rotation or translation about its axis, with the offset parameter ``<joint>.offset``. An
axis other than ±x, ±y, ±z is reached by two constant rotations and left by their inverse. Fixed joints keep their
place in the chain, as constants. Of joints outside the chain only the links that they join are read, so that an
oddity of a gripper does not stop the calibration of the arm. Mass and centre of gravity of the links that the
chain carries (``<inertial>``) are kept as they stand. A document type declaration is refused: no entity is
ever expanded.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from calib_planner.arrays import FloatArray, frozen
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError
from calib_planner.io.text import decode, read_bytes, read_text, user_path, write_text
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
    rotation,
    target_elements,
)
from calib_planner.units import brief

URDF = "a URDF"
MOVING = ("revolute", "continuous", "prismatic")
TYPES = (*MOVING, "fixed", "floating", "planar")
MODEL_FORMATS = {"sdf": ", an SDF model", "mujoco": ", a MuJoCo model"}
X_AXIS = "1 0 0"
"""The axis of a joint where none is given."""
ATTRIBUTE = re.compile(rb"""\s+([^\s=/>"']+)\s*=\s*("[^"]*"|'[^']*')""")
"""One attribute; of a document that is well formed, which the parser has checked."""
ROUNDING = 1e-15
"""A number that changed by no more than this did not change [m | rad]."""
AXIS_TOLERANCE = 1e-9


# ── a robot ──────────────────────────────────────────────────────────────────────────────────────────


def read_urdf(path: Path, base_link: str | None = None, tip_link: str | None = None) -> Robot:
    """Read the chain from ``base_link`` (default: the root) to ``tip_link`` (default: the only tip)."""
    return parse_urdf(read_text(path, "readable URDF text"), str(path), base_link, tip_link)


def parse_urdf(text: str, source: str, base_link: str | None = None, tip_link: str | None = None) -> Robot:
    """Like ``read_urdf``, from the text itself; ``source`` names it in errors.

    Raises:
        FileFormatError: Not XML, not a URDF, or no single serial chain between the links.
    """
    root = _root(text, source)
    if root.tag != "robot":
        got = f"<{root.tag}>" + MODEL_FORMATS.get(root.tag, "")
        advice = "export the robot as URDF" if root.tag in MODEL_FORMATS else ""
        raise FileFormatError(source, "root element", got, "<robot>, a URDF", advice)
    if any("xacro" in item.tag or "${" in "".join(item.attrib.values()) for item in root.iter()):
        raise _xacro(source)
    chain = _chain(source, root, base_link, tip_link)
    moving = [j.name for j in chain if j.type in MOVING]
    check_joint_names(source, moving)
    elements = [*pose_elements("base", np.zeros(3), np.zeros(3))]
    lengths: list[str] = []
    full: list[str] = []
    for joint in chain:
        xyz, axis = joint.xyz, joint.axis
        pose = pose_elements(joint.name, xyz, joint.rpy)
        if joint.type == "fixed":
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
            joint_limits=np.array([j.limits for j in chain if j.type in MOVING]),
            levels={**levels, "full": tuple(full)},
            parameter_names=(*lengths, *offsets),
            source=source,
            from_urdf=True,
            link_masses=_link_masses(source, root, chain, moving),
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
    return parse_speed_limits(read_text(path, URDF), str(path), joint_names)


def parse_speed_limits(text: str, path: str, joint_names: Sequence[str]) -> FloatArray | None:
    """Like ``read_speed_limits``, from the text itself; ``path`` names it in errors."""
    limits: dict[str, float] = {}
    for item in _root(text, path).findall("joint"):
        name, limit = item.get("name", ""), item.find("limit")
        word = "0" if limit is None else limit.get("velocity", "0")
        speed = _floats(word, 1)
        if speed is None:
            where = f"joint {name!r} limit velocity"
            raise FileFormatError(path, where, brief(word), "a finite number [rad/s | m/s]")
        limits[name] = float(speed[0])
    speeds = np.array([limits.get(name, 0.0) for name in joint_names])
    return frozen(speeds) if (speeds > 0).all() else None


def _root(text: str, source: str) -> ElementTree.Element:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise _declaration(source)
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        if "<xacro:" in text:
            raise _xacro(source) from None
        raise FileFormatError(source, "XML", error, "well-formed XML") from None


def _declaration(source: str) -> FileFormatError:
    return FileFormatError(source, "document", "a document type declaration", "plain URDF without one")


def _xacro(source: str) -> FileFormatError:
    advice = "expand it first: xacro FILE.urdf.xacro > robot.urdf"
    return FileFormatError(source, "document", "a xacro file", "plain URDF", advice)


# ── joints and the tree of links ─────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class _Joint:
    """One ``<joint>``: which links it joins; its numbers are read, and checked, when they are wanted."""

    source: str
    name: str
    type: str
    parent: str
    child: str
    item: ElementTree.Element

    @property
    def xyz(self) -> FloatArray:
        """(3,) of the origin [m]."""
        return self._numbers(" origin xyz", "origin", "xyz", "0 0 0", 3)

    @property
    def rpy(self) -> FloatArray:
        """(3,) of the origin [rad]."""
        return self._numbers(" origin rpy", "origin", "rpy", "0 0 0", 3)

    @property
    def axis(self) -> FloatArray:
        """(3,) unit vector; x for a joint that does not move."""
        axis = np.array([1.0, 0.0, 0.0])
        if self.type in MOVING:
            axis = self._numbers(" axis", "axis", "xyz", X_AXIS, 3)
        if not axis.any():
            raise self.error(" axis", "0 0 0", "a direction")
        return _unit(axis)

    def placed(self) -> tuple[FloatArray | None, FloatArray | None]:
        """``xyz`` and ``rpy``, or ``None`` for what is no such numbers: of joints outside the chain."""
        item = self.item.find("origin")
        texts = ("0 0 0" if item is None else item.get(key, "0 0 0") for key in ("xyz", "rpy"))
        xyz, rpy = (_floats(text, 3) for text in texts)
        return xyz, rpy

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper limit [rad | m]; zeros for a joint that does not move."""
        if self.type == "continuous":
            return -np.pi, np.pi
        if self.type not in MOVING:
            return 0.0, 0.0
        if self.item.find("limit") is None:
            raise self.error("", "no <limit>", "<limit lower= upper=>")
        low, high = (float(self._numbers(" limit", "limit", k, "0", 1)[0]) for k in ("lower", "upper"))
        if not low < high:
            advice = "give the range that may be used, or make the joint fixed"
            raise self.error(" limit", f"[{low}, {high}]", "lower < upper", advice)
        return low, high

    def error(self, part: str, got: object, expected: str, advice: str = "") -> FileFormatError:
        return FileFormatError(self.source, f"joint {self.name!r}{part}", got, expected, advice)

    def check_usable(self) -> None:
        """Refuse a joint of the chain whose coordinate is not measured, or that has more than one."""
        mimic = self.item.find("mimic")
        avoid = "choose base_link and tip_link (--base-link, --tip-link) that avoid it"
        if mimic is not None and self.type != "fixed":
            leader = mimic.get("joint") or "another joint"
            advice = f"its coordinate follows {leader!r} and is not measured; {avoid}"
            raise self.error("", "a mimic joint in the chain", "joints with their own coordinate", advice)
        if self.type in ("floating", "planar"):
            got = f"a {self.type} joint in the chain"
            raise self.error("", got, f"{', '.join(MOVING)} or fixed", avoid)

    def _numbers(self, part: str, tag: str, key: str, default: str, count: int) -> FloatArray:
        item = self.item.find(tag)
        text = default if item is None else item.get(key, default)
        values = _floats(text, count)
        if values is None:
            raise self.error(part, brief(text, 80), f"{count} finite numbers")
        return values


def _axis_elements(joint: _Joint, axis: FloatArray, index: int) -> list[Element]:
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


def _chain(source: str, root: ElementTree.Element, base_link: str | None, tip_link: str | None) -> list[_Joint]:
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
        above = ", ".join(j.parent for j in _climb(source, by_child, tip_link, None))
        raise FileFormatError(source, "base_link", repr(base_link), f"a link above {tip_link!r}: {above}")
    for joint in chain:
        joint.check_usable()
    if not any(j.type in MOVING for j in chain):
        raise FileFormatError(source, f"chain from {top!r} to {tip_link!r}", "no moving joint", "at least one")
    return chain


def _link_masses(
    source: str, root: ElementTree.Element, chain: list[_Joint], moving: list[str]
) -> tuple[LinkMass, ...]:
    """The ``<inertial>`` of every link that the chain carries, seen from the last joint that moves before it.

    Links beside the chain count where only fixed joints hold them: where a gripper's fingers stand is not known.
    """
    links = {str(item.get("name")): item for item in root.findall("link")}
    fixed: dict[str, list[_Joint]] = {}
    for joint in _by_child(source, root, list(links)).values():
        if joint.type == "fixed":
            fixed.setdefault(joint.parent, []).append(joint)
    result: list[LinkMass] = []
    for joint in chain:
        if joint.type == "fixed":
            continue
        waiting: list[tuple[str, FloatArray, FloatArray]] = [(joint.child, np.eye(3), np.zeros(3))]
        while waiting:
            link, turn, place = waiting.pop()
            inertial = _inertial(links[link])
            if inertial is not None:
                x, y, z = (float(v) for v in place + turn @ inertial[1])
                result.append(LinkMass(moving.index(joint.name), inertial[0], (x, y, z)))
            for below in fixed.get(link, ()):
                xyz, rpy = below.placed()
                if xyz is not None and rpy is not None:
                    roll, pitch, yaw = rpy
                    further = turn @ rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll)
                    waiting.append((below.child, further, place + turn @ xyz))
    return tuple(result)


def _inertial(link: ElementTree.Element) -> tuple[float, FloatArray] | None:
    """Mass [kg] and centre of gravity (3,) [m], NaN where they are no numbers; ``None`` without a mass."""
    inertial = link.find("inertial")
    weight = None if inertial is None else inertial.find("mass")
    if inertial is None or weight is None:
        return None
    mass = _floats(weight.get("value", ""), 1)
    origin = inertial.find("origin")
    centre = _floats("0 0 0" if origin is None else origin.get("xyz", "0 0 0"), 3)
    return np.nan if mass is None else float(mass[0]), np.full(3, np.nan) if centre is None else centre


def _by_child(source: str, root: ElementTree.Element, links: list[str]) -> dict[str, _Joint]:
    by_child: dict[str, _Joint] = {}
    for item in root.findall("joint"):
        parent, child = item.find("parent"), item.find("child")
        above, below = ("" if end is None else end.get("link", "") for end in (parent, child))
        joint = _Joint(source, item.get("name", ""), item.get("type", ""), above, below, item)
        if not joint.name or parent is None or child is None:
            raise joint.error("", "no name, parent or child", "all three")
        if joint.type not in TYPES:
            raise joint.error(" type", repr(joint.type), f"{', '.join(MOVING)} or fixed")
        for link in (above, below):
            if link not in links:
                raise joint.error("", f"an unknown link {link!r}", f"one of the links: {', '.join(links)}")
        if joint.child in by_child:
            both = f"joints {by_child[joint.child].name!r} and {joint.name!r} above it"
            raise FileFormatError(source, f"link {joint.child!r}", both, "one joint above each link: a tree")
        by_child[joint.child] = joint
    if by_child and len(by_child) == len(links):
        raise FileFormatError(source, "joints", "a loop of joints without a root", "a tree of links")
    return by_child


def _only_tip(source: str, links: list[str], by_child: Mapping[str, _Joint], base_link: str | None) -> str:
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
    advice = "name the chain's last link (--tip-link)" if tips else ""
    raise FileFormatError(source, "tip_link", got, "one", advice)


def _climb(source: str, by_child: Mapping[str, _Joint], link: str, base_link: str | None) -> list[_Joint]:
    """The joints above ``link``, topmost first, up to ``base_link`` or the root."""
    chain: list[_Joint] = []
    while link != base_link and link in by_child:
        if len(chain) == len(by_child):
            raise FileFormatError(source, f"link {link!r}", "a loop of joints", "a tree of links")
        chain.append(by_child[link])
        link = by_child[link].parent
    return chain[::-1]


def _floats(text: str, count: int) -> FloatArray | None:
    """(count,) the finite numbers that a text holds, or ``None`` if it does not hold exactly those."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        return None
    return values if values.shape == (count,) and np.isfinite(values).all() else None


def _unit(direction: FloatArray) -> FloatArray:
    """(3,) of length 1; scaled first, so that squares of tiny or huge numbers neither vanish nor overflow."""
    direction = direction / (np.abs(direction).max() or 1.0)
    return direction / (np.linalg.norm(direction) or 1.0)


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
        source: The URDF that the robot was read from (``robot.source``).
        field: The argument or option that named ``path``, for the error.

    Raises:
        InputError: The robot is not from a URDF, ``path`` is its source or cannot be written.
        FileFormatError: The source is not readable, or not (or no longer) the URDF of this robot.
    """
    require_urdf(robot, field)
    origin = user_path(robot.source if source is None else source)
    if user_path(path).resolve() == origin.resolve():
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
    parser = expat.ParserCreate(encoding="utf-8", namespace_separator="}")

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

    def doctype(*_: object) -> None:
        raise _declaration(source)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_tags.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
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
    axis = _floats(joint.axis or X_AXIS, 3)
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
    """The attribute's text with the numbers that changed replaced; its white space stays."""
    if _floats(old, 3) is None:  # character references: equal to no number as they stand
        return _text(value)
    new = iter(value)

    def number(match: re.Match[str]) -> str:
        v = float(next(new))
        return match[0] if float(match[0]) == v else repr(v)

    return re.sub(r"\S+", number, old)


def _says(text: str, value: FloatArray) -> bool:
    numbers = _floats(text, 3)
    return numbers is not None and bool((np.abs(numbers - value) <= ROUNDING).all())


def _text(value: FloatArray) -> str:
    return " ".join(map(repr, value.tolist()))
