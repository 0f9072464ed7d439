# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Visits of one plan keep apart: no two of them where one would repeat the errors of the other.

A robot comes back to a configuration with nearly the same error: the joints' functions and gravity are those of
before, and only the repeatability is new. A second visit there is a *repetition*; it takes less time than a visit
elsewhere, and a plan counts it apart. So the m configurations of a plan that expects a real robot
are to be different. The distance of q and q' is the chord

    d² = Σ_j 2 (1 − cos(q_j − q'_j))        (sliding joints: π times the share of the range)

so that a turn more is no other place. With pairs nearer than δ = APART · MARGIN, the search minimises

    −log Ψ + Σ_{i<k} STIFFNESS · max(0, 1 − d_ik/δ)² ,

which is nothing where all are apart. It does not hold δ to the last digit; it holds APART, since what a plan
gains by moving two visits together is far less steep: at most some tenths of log Ψ in all. Starts are shaken,
because copies do not know where to go.
"""

from __future__ import annotations

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.planning.search.descent import Objective
from calib_planner.robot import Robot

APART = 0.1
"""Least distance of two visits: joint functions of real robots vary within 0.06 to 0.07 rad, so that a joint that
has moved so far shows little of the error that it had (see docs/planning-real-robots.md)."""
MARGIN = 1.15
"""δ over APART: what a pair that is pulled together may give way."""
STIFFNESS = 5.0
"""At APART the cost falls by 2·STIFFNESS·(1 − 1/MARGIN)/δ = 11 per radian: twice what some tenths of log Ψ
pull that are gained within APART."""


def nearest(robot: Robot, q: FloatArray) -> FloatArray:
    """(…) the least distance d of two configurations of each plan ``q`` (…, m, joints); infinite if m = 1."""
    squares, _ = _squares(robot, q)
    m = q.shape[-2]
    return np.asarray(np.sqrt((squares + np.diag(np.full(m, np.inf))).min(axis=(-1, -2), initial=np.inf)))


def repelling(objective: Objective, robot: Robot, size: int) -> Objective:
    """``objective`` of plans as rows of ``size``·joints coordinates, with the cost of pairs that are near."""
    if size == 1:
        return objective
    delta, others = APART * MARGIN, 1.0 - np.eye(size)

    def together(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        value, gradient = objective(rows)
        squares, rates = _squares(robot, rows.reshape(len(rows), size, -1))
        d = np.sqrt(squares)
        near = np.maximum(0.0, 1.0 - d / delta) * others
        if not near.any():
            return value, gradient
        cost = 0.5 * STIFFNESS * np.sum(near**2, axis=(1, 2))
        push = -STIFFNESS / delta * near / np.maximum(d, 1e-12)
        return value + cost, gradient + np.sum(push[..., None] * rates, axis=2).reshape(gradient.shape)

    return together


def _squares(robot: Robot, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """d² (…, m, m), and its derivative by the first configuration (…, m, m, joints)."""
    low, high = robot.joint_limits.T
    scale = np.where(robot.joint_is_revolute, 1.0, np.pi / (high - low))
    apart = (q[..., :, None, :] - q[..., None, :, :]) * scale
    turned = robot.joint_is_revolute
    squares = np.where(turned, 2.0 * (1.0 - np.cos(apart)), apart**2).sum(axis=-1)
    return np.asarray(squares), np.asarray(np.where(turned, 2.0 * np.sin(apart), 2.0 * apart) * scale)
