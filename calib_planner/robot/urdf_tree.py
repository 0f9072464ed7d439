"""The tree of links in a URDF, and the one serial chain asked for.

Only who is joined to whom is read here, of all joints; the numbers are read later, of the joints in the chain, so
that an oddity of a gripper does not stop the calibration of the arm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree

from calib_planner.errors import FileFormatError

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
        joint = _joint(source, item)
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


def _joint(source: str, item: ElementTree.Element) -> TreeJoint:
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
