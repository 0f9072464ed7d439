# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Elementary transforms, in which a robot is written, eq. (2), and Denavit–Hartenberg tables as such chains.

Each element is a translation along or a rotation about one coordinate axis of the frame that the elements
before it have built. Its amount is

    amount = sign · (value + δ + q_joint)

with the nominal constant ``value`` [m | rad], the deviation ``δ`` of the error parameter that it carries,
if any, and the coordinate ``q_joint`` of the joint that moves it, if any. Every element may carry one named
parameter; a parameter belongs to exactly one element.

Row i of a Denavit–Hartenberg table is four elements. Standard (distal: Denavit and Hartenberg 1955, Paul), from
frame i−1 to i, with joint i about or along z of frame i−1:

    Rz(θ) · Tz(d) · Tx(a) · Rx(α)

Modified (proximal: Khalil and Kleinfinger 1986, Craig), with joint i about or along z of frame i, and the a and
α of the row that Craig numbers i−1:

    Rx(α) · Tx(a) · Rz(θ) · Tz(d)

The table's θ of a revolute joint and d of a prismatic one are constants to which sign · q is added. All four
are named parameters, ``<joint>.theta``, ``.d``, ``.a`` and ``.alpha``, and their values are the table's: what
is identified goes straight back into it, whatever the joint's sign.

Where two consecutive axes are nearly parallel, by an angle α ≠ 0, their common normal is far away and leaps with
every tilt: tables of calibrated arms have d of hundreds of metres there, with the opposite d in the next row. No
fit of these numbers succeeds. ``re_placed`` turns such a link to Hayati's form (Hayati and Mirmirani 1985), in
which d is zero and a second tilt β takes its place. Motions about z commute with shifts and turns along z, so
that

    Tz(d) Tx(a) Rx(α)  =  Rz(Δ) Tx(a') Rx(α') Ry(β') Rz(γ) Tz(−c) ,     c = −d / cos α ,

is the same robot: the link's end is moved along the second axis into the plane through the first frame that is
perpendicular to the first axis. There it stands at (a, d tan α), at the distance a' and turned by Δ. Δ goes to θ
of the joint before, γ and −c to θ and d of the joint behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.errors import InputError, UnknownNameError

KINDS = ("Tx", "Ty", "Tz", "Rx", "Ry", "Rz")


@dataclass(frozen=True)
class Element:
    """One elementary transform.

    Attributes:
        kind: ``Tx``, ``Ty``, ``Tz`` (translation) or ``Rx``, ``Ry``, ``Rz`` (rotation, right-handed).
        value: Nominal constant amount [m] or [rad].
        joint: Index of the joint that moves it, or ``None``.
        sign: +1 or −1, multiplies the whole amount.
        parameter: Name of its error parameter, or ``None``.
    """

    kind: str
    value: float = 0.0
    joint: int | None = None
    sign: float = 1.0
    parameter: str | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UnknownNameError("element", self.kind, KINDS)
        if not np.isfinite(self.value):
            raise InputError(f"element {self.kind}", self.value, "a finite amount")
        if abs(self.sign) != 1.0:
            raise InputError(f"element {self.kind}: sign", self.sign, "+1 or -1")

    def moved(self, delta: float) -> Element:
        """The same with an amount that is larger by ``delta`` [m | rad]."""
        value = self.value + delta
        if not isfinite(value):
            return replace(self, value=value)  # which says what is wrong
        result = object.__new__(Element)  # all else was checked when this one was made
        result.__dict__.update(self.__dict__, value=value)
        return result

    @property
    def axis(self) -> int:
        """0, 1, 2 for x, y, z."""
        return "xyz".index(self.kind[1])

    @property
    def is_rotation(self) -> bool:
        return self.kind[0] == "R"

    @property
    def unit(self) -> str:
        return "rad" if self.is_rotation else "m"


def rotation(axis: int, angle: float) -> FloatArray:
    """Rotation matrix, shape (3, 3), by ``angle`` [rad] about coordinate axis ``axis`` (0, 1, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def roll_pitch_yaw(matrix: FloatArray) -> FloatArray:
    """(3,) angles [rad] with ``Rz(yaw) Ry(pitch) Rx(roll) = matrix`` (3, 3), exact also at pitch ±90°."""
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    pitch = np.arctan2(-matrix[2, 0], np.hypot(matrix[0, 0], matrix[1, 0]))
    # The rest about x, taken from what yaw and pitch leave: they need not be well determined themselves.
    rest = rotation(1, pitch).T @ rotation(2, yaw).T @ matrix
    return np.array([np.arctan2(rest[2, 1], rest[1, 1]), pitch, yaw])


def pose_elements(prefix: str, xyz: FloatArray, rpy: FloatArray) -> tuple[Element, ...]:
    """A constant pose with its six placement errors ``prefix.x … prefix.rz``.

    ``Tx Ty Tz · Rz(yaw) Ry(pitch) Rx(roll) · Rx(δ) Ry(δ) Rz(δ)``: the translations are errors of ``xyz``
    itself, in the parent frame [m]; the rotations are small angles about the axes of the placed
    frame [rad], free of the singularities of roll-pitch-yaw.
    """
    translations = tuple(
        Element("T" + a, float(v), parameter=f"{prefix}.{a}") for a, v in zip("xyz", xyz, strict=True)
    )
    nominal = tuple(Element("R" + a, float(v)) for a, v in zip("zyx", rpy[::-1], strict=True))
    errors = tuple(Element("R" + a, parameter=f"{prefix}.r{a}") for a in "xyz")
    return translations + nominal + errors


# ── Denavit–Hartenberg tables ─────────────────────────────────────────────────────────────────────────

ROW_TYPES = ("revolute", "prismatic", "fixed")
STANDARD = (("Rz", "theta"), ("Tz", "d"), ("Tx", "a"), ("Rx", "alpha"))
MODIFIED = (("Rx", "alpha"), ("Tx", "a"), ("Rz", "theta"), ("Tz", "d"))
MOVES = {"revolute": "theta", "prismatic": "d"}
"""The quantity to which the joint's coordinate is added."""


@dataclass(frozen=True)
class DhRow:
    """One row of a table, its values checked where it was read.

    Attributes:
        joint: Name of the joint, or of the row if it is fixed; the prefix of its parameters.
        type: ``revolute``, ``prismatic``, or ``fixed`` for a row without a joint (a flange, a bracket).
        theta: θ, or what the controller's zero adds to it [rad].
        d: d, or what the controller's zero adds to it [m].
        a: Length of the common normal [m].
        alpha: Twist of the common normal [rad].
        sign: +1, or −1 for a joint that counts against its axis; 1 for a fixed row.
        beta: Second tilt of a link in Hayati's form, ``None`` in any other [rad].
    """

    joint: str
    type: str = "revolute"
    theta: float = 0.0
    d: float = 0.0
    a: float = 0.0
    alpha: float = 0.0
    sign: float = 1.0
    beta: float | None = None


def dh_elements(rows: Sequence[DhRow], joint_names: Sequence[str], *, modified: bool) -> tuple[Element, ...]:
    """The chain of a table, base to tip; joints are numbered as in ``joint_names``, which has all of them."""
    elements: list[Element] = []
    for row in rows:
        index = None if row.type == "fixed" else list(joint_names).index(row.joint)
        for kind, quantity in MODIFIED if modified else STANDARD:
            value, name = float(getattr(row, quantity)), f"{row.joint}.{quantity}"
            if quantity != MOVES.get(row.type):
                elements.append(Element(kind, value, parameter=name))
            elif row.sign == 1.0:
                elements.append(Element(kind, value, joint=index, parameter=name))
            else:  # an element's sign turns its constant too, and the table's constant is not to be turned
                elements += [Element(kind, joint=index, sign=-1.0), Element(kind, value, parameter=name)]
            if row.beta is not None and quantity == ("a" if modified else "alpha"):
                elements.append(Element("Ry", row.beta, parameter=f"{row.joint}.beta"))
    return tuple(elements)


def dh_levels(rows: Sequence[DhRow], *, modified: bool) -> dict[str, tuple[str, ...]]:
    """Parameters of the levels ``offsets``, ``lengths`` and ``dh``, each in chain order.

    ``offsets`` is the joints' zeros: θ of revolute and d of prismatic joints. ``lengths`` is the other a and d
    that are not zero: a zero is a matter of how the frames were laid. ``dh`` is every θ, d, a and α; of a link in
    Hayati's form β instead of the d before it.
    """
    order = [quantity for _, quantity in (MODIFIED if modified else STANDARD)]
    lengths = [
        f"{row.joint}.{quantity}"
        for row in rows
        for quantity in order
        if quantity in ("a", "d") and quantity != MOVES.get(row.type) and getattr(row, quantity) != 0.0
    ]
    return {
        "offsets": tuple(f"{row.joint}.{MOVES[row.type]}" for row in rows if row.type in MOVES),
        "lengths": tuple(lengths),
        "dh": tuple(name for names in _table_names(rows, order, modified=modified) for name in names),
    }


def _table_names(rows: Sequence[DhRow], order: Sequence[str], *, modified: bool) -> list[list[str]]:
    """Per row the parameters of the level ``dh``."""
    names = [[f"{row.joint}.{quantity}" for quantity in order] for row in rows]
    for at, row in enumerate(rows):
        if row.beta is not None:
            names[at].append(f"{row.joint}.beta")
            first = at - 1 if modified else at
            names[first].remove(f"{rows[first].joint}.d")
    return names


NEARLY_PARALLEL = 0.05
"""Axes within this angle of parallel have no common normal that could be relied on: manufacturing errors of a
milliradian turn it by a degree and more [rad]."""


def re_placed(rows: Sequence[DhRow], *, modified: bool) -> tuple[list[DhRow], list[str]]:
    """The table with Hayati's form for links between nearly parallel axes, and which they are, in words.

    Axes that are exactly parallel stay as they are: any common normal will do.
    """
    new = list(rows)
    words: list[str] = []
    for at in range(len(new) - 1):
        before, behind = new[at], new[at + 1]
        alpha = (behind if modified else before).alpha
        tilt = abs(np.sin(alpha))
        if {before.type, behind.type} != {"revolute"} or not 1e-12 < tilt < NEARLY_PARALLEL:
            continue
        a = (behind if modified else before).a
        turn, reach, twist, beta, rest, shift = _hayati(before.d, a, alpha)
        before = replace(before, theta=before.theta + turn, d=0.0)
        behind = replace(behind, theta=behind.theta + rest, d=behind.d + shift)
        link = replace(behind if modified else before, a=reach, alpha=twist, beta=beta)
        new[at : at + 2] = [before, link] if modified else [link, behind]
        instead = f"{link.joint}.beta instead of {before.joint}.d"
        words.append(
            f"the axes of {before.joint} and {behind.joint} are parallel to {1e3 * tilt:.3g} mrad: their rows "
            f"are re-placed by Hayati's convention ({instead}); identified values are those of the new rows"
        )
    return new, words


def _hayati(d: float, a: float, alpha: float) -> tuple[float, float, float, float, float, float]:
    """Δ, a', α', β', γ and −c of the equation at the top of this file."""
    aside = d * np.tan(alpha)
    turn = float(np.arctan2(aside, a))
    # Rx(α') Ry(β') Rz(γ) = Rz(−Δ) Rx(α): the first row and the last column hold the angles.
    matrix = rotation(2, -turn) @ rotation(0, alpha)
    twist = float(np.arctan2(-matrix[1, 2], matrix[2, 2]))
    beta = float(np.arcsin(np.clip(matrix[0, 2], -1.0, 1.0)))
    rest = float(np.arctan2(-matrix[0, 1], matrix[0, 0]))
    return turn, float(np.hypot(a, aside)), twist, beta, rest, float(d / np.cos(alpha))
