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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    """

    joint: str
    type: str = "revolute"
    theta: float = 0.0
    d: float = 0.0
    a: float = 0.0
    alpha: float = 0.0
    sign: float = 1.0


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
    return tuple(elements)


def dh_levels(rows: Sequence[DhRow], *, modified: bool) -> dict[str, tuple[str, ...]]:
    """Parameters of the levels ``offsets``, ``lengths`` and ``dh``, each in chain order.

    ``offsets`` is the joints' zeros: θ of revolute and d of prismatic joints. ``lengths`` is the other a and d
    that are not zero: a zero is a matter of how the frames were laid. ``dh`` is every θ, d, a and α.
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
        "dh": tuple(f"{row.joint}.{quantity}" for row in rows for quantity in order),
    }
