# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What a URDF says of links and joints, and which chain of them is the robot.

Only links and joints of the chain matter. Whatever else is wrong in a file does not stop the calibration of the
arm: a joint beside the chain whose link is missing, elements of other programs, a macro that was not expanded, a
namespace prefix that nobody declared, blank lines in front of the XML declaration. The parser (expat) therefore
takes tags as they are written, without namespaces. Document type declarations are refused: no entity is ever
expanded.

*Which chain.* It goes from the base link (the root, if none is given) to the tip link. Where none is given, the
tip is the only end of the tree that moves with all joints. Ends that move with fewer joints of the same chain are
frames on the way. Of several ends, the link named ``tool0`` (with or without a prefix) is the tip, that being its
meaning in ROS-Industrial's descriptions, if the others move with all of its joints (flanges, fingers) or with
fewer joints (balancers), and not with as many others (a second arm). If nothing singles out one end, the file is
refused with the list of ends.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.errors import FileFormatError, InputError
from calib_planner.robot import believable_limits, limit_remarks, rotation
from calib_planner.units import brief, listed

MOVING = ("revolute", "continuous", "prismatic")
TYPES = (*MOVING, "fixed", "floating", "planar")
MODEL_FORMATS = {"sdf": ", an SDF model", "mujoco": ", a MuJoCo model"}
X_AXIS = "1 0 0"
"""The axis of a joint where none is given."""
DECLARATION = re.compile(rb"\A(?:\xef\xbb\xbf)?\s*<\?xml.*?\?>", re.DOTALL)
"""The XML declaration, and what stands in front of it."""
EXPRESSION = re.compile(r"\$[({]")
"""What xacro would have replaced."""
TOOL_FRAME = re.compile(r"(?:.*[_/-])?tool0")
"""The tip of an arm in ROS-Industrial's descriptions."""
SAME_PLACE = 1e-9
"""Two ends of one link that differ by no more than this are one place [m | 1]."""


# ── the document ─────────────────────────────────────────────────────────────────────────────────────


def without_declaration(data: bytes) -> bytes:
    """The document, every byte in its place, with blanks instead of its XML declaration and byte order mark.

    The parser refuses a declaration behind a blank line. The text is UTF-8 whatever the declaration says.
    """
    return DECLARATION.sub(lambda head: re.sub(rb"[^\r\n]", b" ", head[0]), data)


def root_of(text: str, source: str) -> ElementTree.Element:
    """The root element of a URDF, with tags as they are written; ``source`` names the text in errors.

    Raises:
        FileFormatError: Not well-formed XML, a document type declaration, or not a ``<robot>``.
    """
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate(encoding="utf-8")
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = lambda *_: refuse_declaration(source)
    try:
        parser.Parse(without_declaration(text.encode("utf-8")), True)
        root: ElementTree.Element = builder.close()
    except expat.ExpatError as error:
        raise FileFormatError(source, "XML", error, "well-formed XML") from None
    if root.tag != "robot":
        got = f"<{root.tag}>" + MODEL_FORMATS.get(root.tag, "")
        advice = "export the robot as URDF" if root.tag in MODEL_FORMATS else ""
        raise FileFormatError(source, "root element", got, "<robot>, a URDF", advice)
    return root


def refuse_declaration(source: str) -> None:
    """A document type declaration may declare entities; none is ever expanded."""
    raise FileFormatError(source, "document", "a document type declaration", "plain URDF without one")


def has_macros(root: ElementTree.Element) -> bool:
    """Whether xacro would add links or joints to the file, or replace something in them."""
    if any(str(item.tag).startswith("xacro:") for item in root):
        return True
    wanted = (item for name in ("link", "joint") for item in root.findall(name))
    own = (part for item in wanted for part in (item, *(i for i in item if i.tag not in ("visual", "collision"))))
    return any(EXPRESSION.search(value) for part in own for value in part.attrib.values())


# ── joints ───────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class UrdfJoint:
    """One ``<joint>``: which links it joins; its numbers are read, and checked, when they are wanted."""

    source: str
    name: str
    type: str
    parent: str
    child: str
    item: ElementTree.Element

    @property
    def moves(self) -> bool:
        """Whether it has a coordinate."""
        return self.type in MOVING

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
        if self.moves:
            axis = self._numbers(" axis", "axis", "xyz", X_AXIS, 3)
        if not axis.any():
            raise self.error(" axis", "0 0 0", "a direction")
        return unit(axis)

    def placed(self) -> tuple[FloatArray | None, FloatArray | None]:
        """``xyz`` and ``rpy``, or ``None`` for what is no such numbers: of joints outside the chain."""
        item = self.item.find("origin")
        texts = ("0 0 0" if item is None else item.get(key, "0 0 0") for key in ("xyz", "rpy"))
        xyz, rpy = (floats(text, 3) for text in texts)
        return xyz, rpy

    @cached_property
    def _range(self) -> tuple[float, float, str]:
        """Lower and upper limit [rad | m] and what is to be said of them."""
        if self.type == "continuous":
            return -np.pi, np.pi, ""
        if self.item.find("limit") is None:
            raise self.error("", "no <limit>", "<limit lower= upper=>")
        low, high = (float(self._numbers(" limit", "limit", k, "0", 1)[0]) for k in ("lower", "upper"))
        if not low < high:
            advice = "give the range that may be used, or make the joint fixed"
            raise self.error(" limit", f"[{low}, {high}]", "lower < upper", advice)
        try:
            return believable_limits(self.name, low, high, turns=self.type == "revolute")
        except InputError as error:
            raise self.error(" limit", error.got, error.expected, error.advice) from None

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper limit of a joint that moves [rad | m]."""
        return self._range[:2]

    @property
    def remark(self) -> str:
        """What is to be said of its limits, for ``limit_remarks``; may be empty."""
        return self._range[2]

    def error(self, part: str, got: object, expected: str, advice: str = "") -> FileFormatError:
        return FileFormatError(self.source, f"joint {self.name!r}{part}", got, expected, advice)

    def fault(self, links: Mapping[str, ElementTree.Element]) -> FileFormatError | None:
        """Why it joins no two links of the file; ``None`` if it does."""
        if not self.name or not self.parent or not self.child:
            return self.error("", "no name, parent or child", "all three")
        if self.type not in TYPES:
            return self.error(" type", repr(self.type), f"{', '.join(MOVING)} or fixed")
        for link in (self.parent, self.child):
            if link not in links:
                return self.error("", f"an unknown link {link!r}", f"one of the links: {', '.join(links)}")
        return None

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
        values = floats(text, count)
        if values is None:
            raise self.error(part, brief(text, 80), f"{count} finite numbers")
        return values


def floats(text: str, count: int) -> FloatArray | None:
    """(count,) the finite numbers that a text holds, or ``None`` if it does not hold exactly those."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        return None
    return values if values.shape == (count,) and np.isfinite(values).all() else None


def unit(direction: FloatArray) -> FloatArray:
    """(3,) of length 1; scaled first, so that squares of tiny or huge numbers neither vanish nor overflow."""
    direction = direction / (np.abs(direction).max() or 1.0)
    return direction / (np.linalg.norm(direction) or 1.0)


# ── the tree and the chain ───────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class UrdfChain:
    """The chain that is the robot, and what else there is.

    Attributes:
        joints: From the base link to the tip link, fixed ones included.
        base, tip: The two links.
        links: All links of the file by name.
        below: Link → the sound joints that hang on it.
        remarks: What was chosen, and what is odd, sentences.
        ignored: What the file holds besides, in words.
    """

    joints: tuple[UrdfJoint, ...]
    base: str
    tip: str
    links: Mapping[str, ElementTree.Element]
    below: Mapping[str, tuple[UrdfJoint, ...]]
    remarks: tuple[str, ...]
    ignored: tuple[str, ...]


def chain_of(
    root: ElementTree.Element, source: str, base_link: str | None = None, tip_link: str | None = None
) -> UrdfChain:
    """The chain from ``base_link`` (default: the tip's root) to ``tip_link`` (default: see above).

    Raises:
        FileFormatError: Not a tree, no single tip, no such links, or a joint between them that cannot be used.
    """
    tree = _Tree(root, source)
    for label, link in (("base_link", base_link), ("tip_link", tip_link)):
        if link is not None and link not in tree.links:
            raise FileFormatError(source, label, repr(link), f"one of: {', '.join(tree.links)}")
    remark = ""
    if tip_link is None:
        tip_link, remark = tree.only_tip(base_link)
    chain = tree.climb(tip_link, base_link)
    top = chain[0].parent if chain else tip_link
    if base_link is not None and base_link != top:
        above = ", ".join(j.parent for j in tree.climb(tip_link, None))
        raise FileFormatError(source, "base_link", repr(base_link), f"a link above {tip_link!r}: {above}")
    for joint in chain:
        joint.check_usable()
    if not any(j.moves for j in chain):
        raise FileFormatError(source, f"chain from {top!r} to {tip_link!r}", "no moving joint", "at least one")
    remarks = [remark, *limit_remarks((j.name, j.remark) for j in chain if j.moves)]
    return UrdfChain(
        joints=tuple(chain),
        base=top,
        tip=tip_link,
        links=tree.links,
        below=tree.below,
        remarks=tuple(filter(None, remarks)),
        ignored=tuple(tree.ignored(chain)),
    )


class _Tree:
    """All links, and the joints that join two of them; those that do not are kept with what is wrong."""

    def __init__(self, root: ElementTree.Element, source: str) -> None:
        self.root, self.source = root, source
        self.links = {str(item.get("name")): item for item in root.findall("link")}
        self.joints: list[UrdfJoint] = []
        self.faults: list[tuple[UrdfJoint, FileFormatError]] = []
        for item in root.findall("joint"):
            ends = (item.find("parent"), item.find("child"))
            above, below = ("" if end is None else end.get("link", "") for end in ends)
            joint = UrdfJoint(source, item.get("name", ""), item.get("type", ""), above, below, item)
            fault = joint.fault(self.links)
            if fault is None:
                self.joints.append(joint)
            else:
                self.faults.append((joint, fault))
        self.above: dict[str, list[UrdfJoint]] = {}
        self.below: dict[str, tuple[UrdfJoint, ...]] = {}
        for joint in self.joints:
            self.above.setdefault(joint.child, []).append(joint)
            self.below[joint.parent] = (*self.below.get(joint.parent, ()), joint)

    def climb(self, link: str, base_link: str | None) -> list[UrdfJoint]:
        """The joints above ``link``, topmost first, up to ``base_link`` or the root."""
        chain: list[UrdfJoint] = []
        while link != base_link:
            above = self.above.get(link, [])
            broken = next((error for joint, error in self.faults if joint.child == link), None)
            if not above:
                if broken is not None:
                    raise broken
                break
            if len(above) > 1:
                both = f"joints {above[0].name!r} and {above[1].name!r} above it"
                raise FileFormatError(self.source, f"link {link!r}", both, "one joint above each link: a tree")
            if len(chain) == len(self.joints):
                raise FileFormatError(self.source, f"link {link!r}", "a loop of joints", "a tree of links")
            chain.append(above[0])
            link = above[0].parent
        return chain[::-1]

    def only_tip(self, base_link: str | None) -> tuple[str, str]:
        """The tip, and which choice was made, a sentence; see the top of this file."""
        if self.joints and len(self.above) == len(self.links):
            raise FileFormatError(self.source, "joints", "a loop of joints without a root", "a tree of links")
        chains, broken = self._ends(base_link)
        if not chains and broken is not None:
            raise broken
        moving = {link: [j.name for j in chain if j.type != "fixed"] for link, chain in chains.items()}
        ends = [
            link
            for link, own in moving.items()
            if not any(len(own) < len(other) and own == other[: len(own)] for other in moving.values())
        ]
        if len(ends) == 1 or (ends and self._one_place([chains[link] for link in ends])):
            return ends[0], ""
        tools = [link for link in self._on_the_way(chains) if TOOL_FRAME.fullmatch(link)]
        if len(tools) == 1:
            tool = [j.name for j in self.climb(tools[0], base_link) if j.type != "fixed"]
            rest = [link for link in ends if link != tools[0]]
            if all(len(moving[link]) < len(tool) or moving[link][: len(tool)] == tool for link in rest):
                others = listed(rest, 6)
                return tools[
                    0
                ], f"the chain ends at {tools[0]}; further ends of the file are {others} (--tip-link)"
        got = f"{len(ends)} possible tips: {', '.join(ends) or 'no moving joint leads to a link'}"
        advice = "name the chain's last link (--tip-link)" if ends else ""
        common = _common([chains[link] for link in ends])
        if any(j.moves for j in common):
            advice += f", or {common[-1].child!r}, from which they go on"
        if not ends and self.faults:
            raise self.faults[0][1]
        raise FileFormatError(self.source, "tip_link", got, "one", advice)

    def _ends(self, base_link: str | None) -> tuple[dict[str, list[UrdfJoint]], FileFormatError | None]:
        """Leaves that something moves, seen from the base link, with their chains; why another has none.

        Leaves that nothing moves are frames on the base, as many robot descriptions have them.
        """
        chains: dict[str, list[UrdfJoint]] = {}
        broken: FileFormatError | None = None
        for link in self.links:
            if link in self.below or link not in self.above:
                continue
            try:
                chain = self.climb(link, base_link)
            except FileFormatError as error:
                broken = broken or error
                continue
            if chain and base_link in (None, chain[0].parent) and any(j.type != "fixed" for j in chain):
                chains[link] = chain
        return chains, broken

    def _on_the_way(self, chains: Mapping[str, Sequence[UrdfJoint]]) -> list[str]:
        """Links that something moves on the ways to the ends, in the order of the file."""
        moved: set[str] = set()
        for chain in chains.values():
            first = next((i for i, j in enumerate(chain) if j.moves), len(chain))
            moved |= {j.child for j in chain[first:]}
        return [link for link in self.links if link in moved]

    def _one_place(self, chains: Sequence[Sequence[UrdfJoint]]) -> bool:
        """Whether the ends of these chains are one frame behind the same joints."""
        frames = []
        for chain in chains:
            last = max(i for i, j in enumerate(chain) if j.type != "fixed")
            if chain[: last + 1] != chains[0][: last + 1]:
                return False
            frame = fixed_pose(chain[last + 1 :])
            if frame is None:
                return False
            frames.append(np.column_stack(frame))
        return all(np.abs(frame - frames[0]).max() <= SAME_PLACE for frame in frames)

    def ignored(self, chain: Sequence[UrdfJoint]) -> list[str]:
        """What the file holds beside the chain, in words."""
        words = []
        beside = [j.name for j in self.joints if j not in chain]
        if beside:
            words.append(f"joints beside the chain: {listed(beside, 12)}")
        words += [f"a joint that joins no two links: {error}" for _, error in self.faults]
        tags = Counter(str(item.tag) for item in self.root if item.tag not in ("link", "joint"))
        if tags:
            words.append("elements of other programs: " + ", ".join(f"{n} × {tag}" for tag, n in tags.items()))
        return words


def fixed_pose(joints: Sequence[UrdfJoint]) -> tuple[FloatArray, FloatArray] | None:
    """Rotation (3, 3) and place (3,) [m] behind joints that do not move; ``None`` if one has no numbers."""
    turn: FloatArray = np.eye(3)
    place: FloatArray = np.zeros(3)
    for joint in joints:
        xyz, rpy = joint.placed()
        if xyz is None or rpy is None:
            return None
        place = place + turn @ xyz
        turn = turn @ rotation_of(rpy)
    return turn, place


def rotation_of(rpy: FloatArray) -> FloatArray:
    """(3, 3) of roll, pitch and yaw (3,) [rad]."""
    roll, pitch, yaw = rpy
    return np.asarray(rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll))


def _common(chains: Sequence[Sequence[UrdfJoint]]) -> list[UrdfJoint]:
    """The joints that all chains begin with."""
    same: list[UrdfJoint] = []
    for joints in zip(*chains, strict=False):
        if any(j is not joints[0] for j in joints):
            break
        same.append(joints[0])
    return same
