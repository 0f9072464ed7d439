"""Denavit–Hartenberg tables, standard and modified, as chains of elementary transforms.

Row i of a table is four elements. Standard (distal: Denavit and Hartenberg 1955, Paul), from frame i−1 to i,
with joint i about or along z of frame i−1:

    Rz(θ) · Tz(d) · Tx(a) · Rx(α)

Modified (proximal: Khalil and Kleinfinger 1986, Craig), with joint i about or along z of frame i, and the a and α
of the row that Craig numbers i−1:

    Rx(α) · Tx(a) · Rz(θ) · Tz(d)

The table's θ of a revolute joint and d of a prismatic one are constants to which sign · q is added. All four
are named parameters, ``<joint>.theta``, ``.d``, ``.a`` and ``.alpha``, and their values are the table's: what is
identified goes straight back into it, whatever the joint's sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib_planner.robot.elements import Element

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
