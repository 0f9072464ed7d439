# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics near a start, for many goals at once: bounded Levenberg–Marquardt.

The residual of configuration q against the goal position g and, unless only the position counts, rotation R_g is

    r(q) = [ g − p(q) ;  L · log(R_g R(q)ᵀ) ]        [m], with a lever L that turns radians into metres,

and its derivative follows from the joints' axes a and origins o, for what the point p and the orientation do:

    ∂p/∂q = a × (p − o),  ω = a  (turning),      ∂p/∂q = a,  ω = 0  (sliding).

J = [∂p/∂q; L ω] is exact where it matters: with φ = log(R_g Rᵀ), a turn ω changes φ by −Jr⁻¹(φ) ω, and
φᵀ Jr⁻¹(φ) = φᵀ, so Jᵀr is the exact gradient of −½|r|² whatever the remaining error. Each step solves

    (JᵀJ + λ d I) Δ = Jᵀr,    d = max diag(JᵀJ),

the shortest where many would do, with the damping λ of each row raised after a failure and lowered after a
success; joints at a bound that the step would cross do not move. Where the iteration rests without having reached
the goal, the rest may be a saddle (an arm stretched out that has to bend: the gradient along the bend is zero
by symmetry). Such rows start again a little to either side along the directions that hardly move the tip, and
the best end counts, the nearest among equals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.robot.chain import Robot

ITERATIONS = 100
LONGEST_STEP = 0.2
"""Longest step of an iteration [rad | m]: the solution is sought near the start."""

DAMPING = 1e-3
"""Share of damping to begin with: near singularities the first steps stay small."""

REST = 1e-14
"""A row rests when its residual, gradient or gain falls below this."""

TOLERANCE = 1e-11
"""A residual that counts as reached [m], well below what is promised."""

BLOCK = 20_000
"""Rows solved at a time, for the memory."""

SINGULAR = 0.03
"""A direction counts as singular when its singular value is below this share of the largest."""

NUDGES = (0.03, -0.03, 0.3, -0.3)
"""How far from a saddle a row starts again [rad | m]."""


@dataclass(frozen=True, eq=False)
class Goals:
    """Where a point of the tip's frame shall be, in the frame of ``Robot.posture``.

    Attributes:
        point: (3,) the point, in the tip's frame [m].
        xyz: (N, 3) where it shall be [m].
        rotation: (N, 3, 3) how the tip shall be turned; ``None``: any way.
        lever: What a radian counts [m].
    """

    point: FloatArray
    xyz: FloatArray
    rotation: FloatArray | None
    lever: float

    def rows(self, which: IntArray) -> Goals:
        """The goals with these numbers."""
        turned = None if self.rotation is None else self.rotation[which]
        return Goals(self.point, self.xyz[which], turned, self.lever)


def goals_of(robot: Robot, q: FloatArray, point: FloatArray, position_only: bool, lever: float) -> Goals:
    """The goals that this robot reaches at ``q`` (N, joints)."""
    posture = robot.posture(q)
    xyz = posture.tip_origin + posture.tip_rotation @ point
    return Goals(point, xyz, None if position_only else posture.tip_rotation, lever)


def solve(robot: Robot, goals: Goals, start: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """(N, joints) within the bounds, near ``start``, where the robot is closest to its goals.

    Args:
        robot: The robot.
        goals: N goals.
        start: (N, joints) within the bounds [rad | m].
        low, high: (N, joints) bounds [rad | m]; may be infinite.
    """
    blocks = [np.arange(i, min(i + BLOCK, len(start))) for i in range(0, len(start), BLOCK)]
    return np.vstack([_solve(robot, goals.rows(b), start[b], low[b], high[b]) for b in blocks])


def _solve(robot: Robot, goals: Goals, start: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    q = _descend(robot, goals, start, low, high)
    left = np.linalg.norm(residuals(robot, goals, q), axis=1)
    for nudge in NUDGES:
        stuck = np.flatnonzero(left > TOLERANCE)
        if not stuck.size:
            break
        rows, starts = _nudged(robot, goals.rows(stuck), q[stuck], nudge)
        rows = stuck[rows]
        ends = _descend(robot, goals.rows(rows), np.clip(starts, low[rows], high[rows]), low[rows], high[rows])
        reached = np.linalg.norm(residuals(robot, goals.rows(rows), ends), axis=1)
        best = _best_of_each(rows, reached, np.linalg.norm(ends - start[rows], axis=1))
        best = best[reached[best] < left[rows[best]] - TOLERANCE]
        q[rows[best]], left[rows[best]] = ends[best], reached[best]
    return _unwound(robot, q, start, low, high)


def _unwound(robot: Robot, q: FloatArray, start: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """``q`` without whole turns that a joint made on the way, where the bounds allow it."""
    whole = 2 * np.pi * np.round((q - start) / (2 * np.pi)) * robot.joint_is_revolute
    back = q - whole
    return np.where((back >= low) & (back <= high), back, q)


def residuals(robot: Robot, goals: Goals, q: FloatArray) -> FloatArray:
    """(N, 3 or 6) what is left [m]: position, then lever × rotation vector."""
    return _residual_and_jacobian(robot, goals, q)[0]


def _descend(robot: Robot, goals: Goals, start: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Levenberg–Marquardt for all rows side by side; rows that rest drop out."""
    q = start.copy()
    r, jacobian = _residual_and_jacobian(robot, goals, q)
    damping = np.full(len(q), DAMPING)
    active = np.arange(len(q))
    for _ in range(ITERATIONS):
        step = _step(r[active], jacobian[active], damping[active], q[active], low[active], high[active])
        trial = np.clip(q[active] + step, low[active], high[active])
        new_r, new_jacobian = _residual_and_jacobian(robot, goals.rows(active), trial)
        before, after = (np.linalg.norm(x, axis=1) for x in (r[active], new_r))
        better = after < before
        moved = np.abs(trial - q[active]).max(axis=1)
        done = active[better]
        q[done], r[done], jacobian[done] = trial[better], new_r[better], new_jacobian[better]
        damping[active] = np.where(better, damping[active] / 10, damping[active] * 10).clip(1e-15, 1e15)
        ends = np.minimum(before, after)
        # A gain of a share of 1e-12 is rounding or a valley without end.
        resting = (ends < REST) | (moved < REST) | (better & (before - after < 1e-12 * before))
        active = active[~resting & (damping[active] < 1e10)]
        if not active.size:
            break
    return q


def _step(
    r: FloatArray, jacobian: FloatArray, damping: FloatArray, q: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """(N, joints) the damped step, which does not cross bounds, of at most the longest length."""
    gradient = np.einsum("nij,ni->nj", jacobian, r)
    fixed = ((q <= low) & (gradient < 0)) | ((q >= high) & (gradient > 0))
    free = np.where(fixed[:, None, :], 0.0, jacobian)
    normal = np.einsum("nij,nik->njk", free, free)
    n = q.shape[1]
    largest = normal[:, range(n), range(n)].max(axis=1, keepdims=True) + np.finfo(float).tiny ** 0.5
    normal[:, range(n), range(n)] += (damping[:, None] + 1e-15) * largest + np.where(fixed, 1.0, 0.0)
    step: FloatArray = np.linalg.solve(normal, np.where(fixed, 0.0, gradient)[:, :, None])[:, :, 0]
    length = np.abs(step).max(axis=1, keepdims=True)
    return step * np.minimum(1.0, LONGEST_STEP / np.maximum(length, LONGEST_STEP))


def _residual_and_jacobian(robot: Robot, goals: Goals, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N, m) residual and (N, m, joints) J, with m = 3 or 6."""
    from scipy.spatial.transform import Rotation  # 0.1 s, which only inverse kinematics waits for

    posture = robot.posture(q)
    xyz = posture.tip_origin + posture.tip_rotation @ goals.point
    turning = robot.joint_is_revolute[:, None]
    axes = posture.joint_axes
    arm = np.cross(axes, xyz[:, None, :] - posture.joint_origins)
    columns = np.where(turning, arm, axes)
    r = goals.xyz - xyz
    if goals.rotation is not None:
        turned = goals.rotation @ posture.tip_rotation.transpose(0, 2, 1)
        angle = Rotation.from_matrix(turned).as_rotvec()
        r = np.concatenate([r, goals.lever * angle], axis=1)
        columns = np.concatenate([columns, np.where(turning, goals.lever * axes, 0.0)], axis=2)
    jacobian: FloatArray = columns.transpose(0, 2, 1)
    return r, jacobian if robot.coupling is None else jacobian @ robot.coupling


def _nudged(robot: Robot, goals: Goals, q: FloatArray, nudge: float) -> tuple[IntArray, FloatArray]:
    """Numbers of rows and starts beside them, along each row's singular directions."""
    _, jacobian = _residual_and_jacobian(robot, goals, q)
    _, values, directions = np.linalg.svd(jacobian, full_matrices=False)
    rows, which = np.nonzero(values <= SINGULAR * values[:, :1])
    return rows, q[rows] + nudge * directions[rows, which]


def _best_of_each(rows: IntArray, reached: FloatArray, away: FloatArray) -> IntArray:
    """Of the entries of each row the one that came closest, among those that arrived the nearest."""
    order = np.lexsort((away, np.maximum(reached, TOLERANCE), rows))
    return order[np.unique(rows[order], return_index=True)[1]]
