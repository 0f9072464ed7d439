# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the parts of the robot, its base and its targets are: the parameters of the chain, eq. (1)–(3).

The columns are those of the identification Jacobian, ∂g/∂Π. What is known of a parameter before the data is a
normal distribution around its nominal value, or nothing (a *flat* prior, precision zero, as in the paper). Base
and targets are where somebody has put them: they are always flat. A part of the chain is made to a tolerance: a
length is within ``placement.length`` and an angle within ``placement.angle`` of the data sheet, two standard
deviations of the error model. The zero of a joint is set by hand and hardly known (``ZERO``). A prior that the
user states for some parameters replaces the tolerance of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray
from calib_planner.error_model.poses import Poses
from calib_planner.error_model.prior import Prior
from calib_planner.errors import UnknownNameError
from calib_planner.robot import Robot

ZERO = 0.02
"""Standard deviation of the zero of a joint, in any unit [rad | m]."""
BoolArray = NDArray[np.bool_]
PRIORS = ("tolerance", "flat")


@dataclass(frozen=True)
class Placement:
    """The parameters of the chain.

    Attributes:
        prior: ``tolerance`` or ``flat``.
        stated: What the user knows of some parameters, in place of their tolerance; ``None``: nothing.
    """

    prior: str = "tolerance"
    stated: Prior | None = None

    name: ClassVar[str] = "placement"
    title: ClassVar[str] = "lengths, axes and zeros of the chain, base and targets: what a URDF can hold"

    def __post_init__(self) -> None:
        if self.prior not in PRIORS:
            raise UnknownNameError("placement.prior", self.prior, PRIORS)

    @property
    def scales(self) -> tuple[str, ...]:
        """Names of the standard deviations of the error model that this term uses."""
        return ("placement.length", "placement.angle") if self.prior == "tolerance" else ()

    def names(self, robot: Robot) -> tuple[str, ...]:
        """P names, the order of the columns."""
        return robot.parameter_names

    def size(self, robot: Robot) -> int:
        """P."""
        return len(robot.parameter_names)

    def columns(self, poses: Poses) -> FloatArray:
        """(N, 3·targets, P) ∂position/∂parameter [m/m | m/rad]."""
        return poses.jacobian

    def variances(self, robot: Robot, values: dict[str, float]) -> FloatArray:
        """(P,) prior variance of each parameter [m² | rad²], infinite where it is flat."""
        variances = np.full(len(robot.parameter_names), np.inf)
        for name, rows in self._rows(robot).items():
            variances[rows] = values[name] ** 2
        if self.prior == "tolerance":
            variances[joint_zeros(robot)] = ZERO**2
        if self.stated is not None:
            variances[self.stated.places(robot.parameter_names)] = self.stated.std**2
        return variances

    def means(self, robot: Robot) -> FloatArray:
        """(P,) expected deviations from the nominal values [m | rad]; 0 where nothing is stated."""
        means = np.zeros(len(robot.parameter_names))
        if self.stated is not None:
            places = self.stated.places(robot.parameter_names)
            nominal = np.array([p.nominal for p in robot.parameters])
            means[places] = np.asarray(self.stated.values) - nominal[places]
        return means

    def gradients(self, robot: Robot, values: dict[str, float]) -> dict[str, FloatArray]:
        """Scale → (P,) derivative of ``variances`` by its logarithm."""
        result: dict[str, FloatArray] = {}
        for name, rows in self._rows(robot).items():
            gradient = np.zeros(len(robot.parameter_names))
            gradient[rows] = 2.0 * values[name] ** 2
            result[name] = gradient
        return result

    def _rows(self, robot: Robot) -> dict[str, BoolArray]:
        """Scale → (P,) whether a parameter's prior is that scale."""
        rows = _toleranced(robot)
        if self.stated is not None:
            free = np.ones(len(robot.parameter_names), bool)
            free[self.stated.places(robot.parameter_names)] = False
            rows = {n: r & free for n, r in rows.items()}
        return {n: r for n, r in rows.items() if n in self.scales and r.any()}


@lru_cache(maxsize=64)
def _toleranced(robot: Robot) -> dict[str, BoolArray]:
    """Scale → (P,) whether a parameter of the chain, no joint's zero, is such a length or angle."""
    free = is_placement(robot.parameter_names) & ~joint_zeros(robot)
    angle = np.array([p.unit == "rad" for p in robot.parameters], bool)
    return {"placement.length": free & ~angle, "placement.angle": free & angle}


@lru_cache(maxsize=64)
def joint_zeros(robot: Robot) -> BoolArray:
    """(P,) whether a parameter acts as a joint does, wherever the robot stands.

    Of two that act alike (a joint's offset and a rotation about the same axis) both are zeros.
    """
    names = robot.parameter_names
    low, high = robot.joint_limits.T
    sample = np.random.default_rng(0).uniform(low, high, (8, len(low)))
    # Targets off every axis: an unknown one starts at the tip, where the last joint moves nothing.
    robot = robot.with_targets(robot.target_offsets + np.array([0.13, 0.17, 0.19]))
    columns, joints = robot.jacobian(sample), robot.joint_jacobian(sample)
    least = 1e-9 * np.abs(joints).max()
    like = [np.abs(columns[..., :, None] - s * joints[..., None, :]).max(axis=(0, 1)) < least for s in (1, -1)]
    acts = dict(zip(robot.parameter_names, (like[0] | like[1]).any(axis=1), strict=True))
    return np.array([acts.get(n, False) for n in names], bool) & is_placement(names)


def is_placement(names: Sequence[str]) -> BoolArray:
    """(P,) whether a parameter belongs to the chain; the others place the base or a target."""
    return np.array([not n.startswith(("base.", "target_")) for n in names], bool)
