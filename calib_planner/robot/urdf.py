"""Robots from URDF: the kinematic chain between two links.

Each joint becomes ``Tx Ty Tz · Rz Ry Rx`` (its origin, with six placement errors named after the joint) and
one rotation or translation about its axis with the offset parameter ``<joint>.offset``. Axes other than
±x, ±y, ±z are reached by two constant rotations and left by their inverse.

Only kinematics is read, with the standard library's parser; a document type declaration is refused, so no
entity is ever expanded. Fixed joints keep their place in the chain, as constants. Mimic joints in the chain
are refused: their coordinate is not a measured one.
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

MOVING = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class UrdfJoint:
    """One ``<joint>``: name, type, parent and child link, origin, axis, limits ([rad] or [m])."""

    name: str
    type: str
    parent: str
    child: str
    xyz: FloatArray
    rpy: FloatArray
    axis: FloatArray
    limits: tuple[float, float]
    mimic: bool


def read_urdf(path: Path, base_link: str | None = None, tip_link: str | None = None) -> Robot:
    """Read the chain from ``base_link`` (default: the root) to ``tip_link`` (default: the only leaf)."""
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
        raise FileFormatError(source, "XML", error, "well-formed XML") from None
    if root.tag != "robot":
        raise FileFormatError(source, "root element", f"<{root.tag}>", "<robot>")
    joints = [_joint(source, item) for item in root.findall("joint")]
    links = [str(item.get("name")) for item in root.findall("link")]
    chain = _chain(source, joints, links, base_link, tip_link)
    return _robot(source, str(root.get("name", "robot")), chain)


def _joint(source: str, item: ElementTree.Element) -> UrdfJoint:
    name = item.get("name", "")
    where = f"joint {name!r}"
    kind = item.get("type", "")
    parent, child = item.find("parent"), item.find("child")
    if not name or parent is None or child is None:
        raise FileFormatError(source, where, "no name, parent or child", "all three")
    if kind not in (*MOVING, "fixed", "floating", "planar"):
        raise FileFormatError(source, f"{where} type", repr(kind), f"{', '.join(MOVING)} or fixed")
    origin, axis, limit = item.find("origin"), item.find("axis"), item.find("limit")
    zero = "0 0 0"
    direction = _vector(source, f"{where} axis", "1 0 0" if axis is None else axis.get("xyz", ""))
    length = float(np.linalg.norm(direction))
    if length == 0 and kind in MOVING:
        raise FileFormatError(source, f"{where} axis", "0 0 0", "a direction")
    return UrdfJoint(
        name=name,
        type=kind,
        parent=parent.get("link", ""),
        child=child.get("link", ""),
        xyz=_vector(source, f"{where} origin xyz", zero if origin is None else origin.get("xyz", zero)),
        rpy=_vector(source, f"{where} origin rpy", zero if origin is None else origin.get("rpy", zero)),
        axis=direction / (length or 1.0),
        limits=_limits(source, where, kind, limit),
        mimic=item.find("mimic") is not None,
    )


def _limits(source: str, where: str, kind: str, limit: ElementTree.Element | None) -> tuple[float, float]:
    if kind == "continuous":
        return -np.pi, np.pi
    if limit is None or kind not in MOVING:
        if kind in ("revolute", "prismatic"):
            raise FileFormatError(source, where, "no <limit>", "<limit lower= upper=>")
        return 0.0, 0.0
    low, high = (_floats(source, f"{where} limit", limit.get(k, "0"), 1)[0] for k in ("lower", "upper"))
    if not low < high:
        raise FileFormatError(source, f"{where} limit", f"[{low}, {high}]", "lower < upper")
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


def _chain(
    source: str,
    joints: list[UrdfJoint],
    links: list[str],
    base_link: str | None,
    tip_link: str | None,
) -> list[UrdfJoint]:
    """The joints from base to tip, found by climbing from the tip."""
    by_child = {j.child: j for j in joints}
    parents = {j.parent for j in joints}
    for label, link in (("base link", base_link), ("tip link", tip_link)):
        if link is not None and link not in links:
            raise FileFormatError(source, label, repr(link), f"one of: {', '.join(links)}")
    if tip_link is None:
        leaves = [link for link in links if link not in parents and link in by_child]
        if len(leaves) != 1:
            raise FileFormatError(
                source,
                "tip link",
                f"{len(leaves)} possible tips: {', '.join(leaves)}",
                "one",
                "name it",
            )
        tip_link = leaves[0]
    chain: list[UrdfJoint] = []
    link = tip_link
    while link != base_link and link in by_child:
        if len(chain) > len(joints):
            raise FileFormatError(source, "joints", "a loop", "a tree of links")
        joint = by_child[link]
        if joint.type in ("floating", "planar") or joint.mimic:
            kind = "mimic" if joint.mimic else joint.type
            raise FileFormatError(
                source,
                f"joint {joint.name!r}",
                f"a {kind} joint in the chain",
                f"{', '.join(MOVING)} or fixed",
                "choose base and tip links that avoid it",
            )
        chain.append(joint)
        link = joint.parent
    if base_link is not None and link != base_link:
        raise FileFormatError(source, "base link", repr(base_link), f"a link above {tip_link!r}")
    if not any(j.type in MOVING for j in chain):
        raise FileFormatError(source, "chain", "no moving joint", "at least one")
    return chain[::-1]


def _robot(source: str, name: str, chain: list[UrdfJoint]) -> Robot:
    zero = np.zeros(3)
    elements = [*pose_elements("base", zero, zero)]
    moving = [j for j in chain if j.type in MOVING]
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
