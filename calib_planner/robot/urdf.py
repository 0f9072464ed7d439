"""Robots from URDF: the kinematic chain between two links.

Each joint becomes ``Tx Ty Tz · Rz Ry Rx`` (its origin, with six placement errors named after the joint) and
one rotation or translation about its axis with the offset parameter ``<joint>.offset``. Axes other than
±x, ±y, ±z are reached by two constant rotations and left by their inverse.

Only kinematics is read, with the standard library's parser; a document type declaration is refused, so no
entity is ever expanded. Fixed joints keep their place in the chain, as constants. Which joints make the chain,
and what is refused in it (mimic, floating and planar joints), is in ``urdf_tree``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.errors import CalibPlannerError, FileFormatError
from calib_planner.robot.chain import Robot, target_elements
from calib_planner.robot.elements import Element, pose_elements
from calib_planner.robot.joint_names import check_joint_names
from calib_planner.robot.urdf_tree import MOVING, TreeJoint, read_chain

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
