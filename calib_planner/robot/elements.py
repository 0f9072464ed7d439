"""Elementary transforms: the letters in which a robot is written, eq. (2).

Each element is a translation along or a rotation about one coordinate axis of the frame that the elements
before it have built. Its amount is

    amount = sign · (value + δ + q_joint)

with the nominal constant ``value`` [m | rad], the deviation ``δ`` of the error parameter that it carries,
if any, and the coordinate ``q_joint`` of the joint that moves it, if any. Every element may carry one named
parameter; a parameter belongs to exactly one element.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray
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
