# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Joints that a controller shows against other joints.

Arms with a parallelogram have the drive of the forearm at the shoulder: their controllers show the angle of
joint 3 against the horizontal, which is its own angle and that of joint 2. A chain's motions m (each joint
against the link before it) and the coordinates q that the controller shows are then

    q = K m ,     K = 1 + Σ f e_j e_kᵀ     for every coupling  j += f·k ,

and m = C q with C = K⁻¹. Everything outside the chain is in q: data, plans, corrected joint targets, what the
joints' own errors depend on. Columns follow by the chain rule, ∂p/∂q = ∂p/∂m · C, and moments by virtual work,
τ_q = Cᵀ τ_m.

Limits of the robot's file are those of the motions. The box of q that encloses them is wider, so that plans
keep to both. ``j3+=j2`` is how a coupling is written: the controller adds joint 2 to what it shows as joint 3;
``j6-=0.0125*j5`` has a factor.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib_planner.arrays import FloatArray, frozen
from calib_planner.errors import InputError, UnknownNameError

NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
COUPLING = re.compile(rf"\s*(\S.*?)\s*([+-])=\s*(?:({NUMBER})\s*\*\s*)?(\S.*?)\s*")


@dataclass(frozen=True)
class Coupling:
    """One joint is shown together with another one: its own motion plus ``factor`` times the other's.

    Attributes:
        joint: The joint that is shown so.
        beside: The other joint.
        factor: How much of its motion is added [coordinate of ``joint`` per coordinate of ``beside``].
    """

    joint: str
    beside: str
    factor: float = 1.0

    def __str__(self) -> str:
        size = "" if abs(self.factor) == 1.0 else f"{abs(self.factor):.12g}*"
        return f"{self.joint}{'-' if self.factor < 0 else '+'}={size}{self.beside}"


def parse_coupling(text: str, field: str = "couple") -> Coupling:
    """``j3+=j2``, ``j3-=j2`` or ``j3+=0.5*j2``; ``field`` names the option or key in errors."""
    parts = COUPLING.fullmatch(text)
    if parts is None:
        expected = "JOINT+=JOINT or JOINT-=FACTOR*JOINT"
        raise InputError(field, repr(text), expected, "for example j3+=j2: joint 3 is shown plus joint 2")
    joint, sign, factor, beside = parts.groups()
    return Coupling(joint, beside, float(sign + (factor or "1")))


def coupling_matrix(
    couplings: Sequence[Coupling], joint_names: Sequence[str], field: str = "couple"
) -> FloatArray:
    """(joints, joints) C of m = C q, in the order of ``joint_names``.

    Raises:
        UnknownNameError: A joint that is not there.
        InputError: A joint beside itself, a pair that is stated twice, or couplings that undo each other.
    """
    names = list(joint_names)
    shown = np.eye(len(names))
    for one in couplings:
        for name in (one.joint, one.beside):
            if name not in names:
                raise UnknownNameError(field, name, names)
        if one.joint == one.beside:
            advice = "a wrong gear ratio is corrected in the controller or in the data"
            raise InputError(field, str(one), "two different joints", advice)
        at = names.index(one.joint), names.index(one.beside)
        if shown[at]:
            raise InputError(field, str(one), "each pair of joints once", "leave one of them out")
        if not np.isfinite(one.factor) or not one.factor:
            raise InputError(field, str(one), "a factor other than zero")
        shown[at] = one.factor
    if np.linalg.cond(shown) > 1e8:
        texts, advice = ", ".join(map(str, couplings)), "leave one of them out"
        raise InputError(field, texts, "couplings from which every joint's motion follows", advice)
    return frozen(np.linalg.inv(shown) + 0.0)


def enclosing_limits(limits: FloatArray, coupling: FloatArray) -> FloatArray:
    """(joints, 2) the box of q that holds every motion within ``limits`` (joints, 2)."""
    shown = np.linalg.inv(coupling)[:, :, None] * limits[None]
    return np.stack([shown.min(axis=2).sum(axis=1), shown.max(axis=2).sum(axis=1)], axis=1)
