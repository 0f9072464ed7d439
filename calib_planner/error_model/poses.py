# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Configurations with everything that the terms of the error model need of them, computed once.

A joint that reads q_l stands at q_l + δ_l, where the deflection δ comes from the elastic term and the joint
functions. Positions and derivatives are taken at the deflected joints; what a term depends on (a joint's own
angle, a moment of gravity) is taken at the readings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.robot import Linearisation, Posture, Robot

SLIDE = 0.15
"""A sliding joint errs by as many metres as a turning joint moves a point this far from its axis [m]."""


@dataclass(frozen=True, eq=False)
class Poses:
    """N configurations of one robot.

    Attributes:
        robot: Its active parameters, base and targets are those in force.
        q: (N, joints) readings of the joints [rad | m].
        payload: (N,) mass of the payload at each visit [kg]; ``None``: what the error model states.
        deflection: (N, joints) δ, or ``None`` for none; in units of ``joint_units``.
    """

    robot: Robot
    q: FloatArray
    payload: FloatArray | None = None
    deflection: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.q)

    @cached_property
    def cache(self) -> dict[object, FloatArray]:
        """What a term computes of these readings and needs again; no deflection changes it."""
        return {}

    def deflected(self, deflection: FloatArray) -> Poses:
        """The same readings with a deflection (N, joints); what depends on readings alone is kept."""
        result = replace(self, deflection=deflection)
        result.__dict__["cache"] = self.cache
        if "posture" in self.__dict__:
            result.__dict__["posture"] = self.posture
        return result

    @property
    def actual(self) -> FloatArray:
        """(N, joints) where the joints stand [rad | m]."""
        return self.q if self.deflection is None else self.q + self.deflection * joint_units(self.robot)

    @cached_property
    def linearisation(self) -> Linearisation:
        """Positions and derivatives at the joints as they stand."""
        return self.robot.linearise(self.actual)

    @property
    def points(self) -> FloatArray:
        """(N, targets, 3) predicted positions in the frame of ``Robot.positions`` [m]."""
        return self.linearisation.points.transpose(2, 0, 1)

    @cached_property
    def jacobian(self) -> FloatArray:
        """(N, 3·targets, P) ∂position/∂parameter, rows x, y, z target by target [m/m | m/rad]."""
        return self.linearisation.jacobian()

    @cached_property
    def levers(self) -> FloatArray:
        """(N, 3·targets, joints) c_l = ∂position/∂q_l per unit of ``joint_units`` [m/rad]."""
        columns = self.linearisation.joint_columns
        flat = columns.reshape(columns.shape[0], -1, columns.shape[3])
        return np.ascontiguousarray(flat.transpose(2, 1, 0)) * joint_units(self.robot)

    @cached_property
    def posture(self) -> Posture:
        """Origins and axes of the joints at their readings."""
        return self.robot.posture(self.q)


def joint_units(robot: Robot) -> FloatArray:
    """(joints,) what one unit of a joint's deflection is: 1 rad where it turns, ``SLIDE`` m where it slides."""
    return np.where(robot.joint_is_revolute, 1.0, SLIDE)
