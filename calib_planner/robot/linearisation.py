# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the robot is at a batch of configurations, and how points move with parameters and joints.

``Posture`` holds the frames of the chain, ``Linearisation`` eq. (3) and one order beyond.

From the axes w_e and columns of the elements (see ``kinematics``) with e_a the element of parameter a and e_k
that of joint k, both rotations:

    ∂J_a/∂q_k = w_k × J_a     where e_k is before or at e_a,
                w_a × J_k     where e_a is before e_k,

a term with a translation in front being zero. For a scalar f(J) with G_a = ∂f/∂J_a the triple product turns
the gradient in q into running sums over the parameters in chain order, no second derivative ever stored:

    ∂f/∂q_k = w_k · Σ_{a at or behind k} J_a × G_a  +  J_k · Σ_{a before k, rotation} G_a × w_a .
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.robot.kinematics import _kernel


@dataclass(frozen=True)
class Layout:
    """Where parameters and joints sit in the chain.

    Attributes:
        parameter_elements: Flat element index of each active parameter.
        parameter_rotates: Whether each active parameter is an angle.
        joint_elements: Element index of each joint.
        joint_rotates: Whether each joint is revolute.
    """

    parameter_elements: tuple[int, ...]
    parameter_rotates: tuple[bool, ...]
    joint_elements: tuple[int, ...]
    joint_rotates: tuple[bool, ...]

    @cached_property
    def running_sums(self) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
        """What ``pull_back`` needs: parameters in chain order; places of the rotations in that order; for each
        joint the number of parameters in front of it; 1 for joints that turn, 0 for those that slide."""
        elements = np.array(self.parameter_elements, np.int64)
        order = np.argsort(elements, kind="stable")
        front = np.flatnonzero(np.array(self.parameter_rotates, bool)[order])
        before = np.searchsorted(elements[order], np.array(self.joint_elements), side="left")
        return order, front, before, np.array(self.joint_rotates, float)

    @cached_property
    def code(self) -> NDArray[np.int32]:
        """The same for ``kernel.c``: P parameters in chain order, whether each of these turns, for each joint the
        number of parameters in front of it, and whether it turns."""
        order, _, before, turning = self.running_sums
        rotates = np.array(self.parameter_rotates, bool)[order]
        return np.concatenate([order, rotates, before, turning]).astype(np.int32)


@dataclass(frozen=True)
class Linearisation:
    """Positions and derivatives of N configurations, structure of arrays: the last axis is N.

    Attributes:
        points: (targets, 3, N) target positions, base frame [m].
        columns: (P, targets, 3, N) derivative by each parameter [m / unit].
        motion_columns: (joints, targets, 3, N) derivative by each joint's own motion [m / rad or 1].
        parameter_axes: (P, 3, N) axis of the element of each parameter, base frame.
        joint_axes: (joints, 3, N) axis of each joint, base frame.
        layout: Chain order of parameters and joints.
        coupling: (joints, joints) C of ``robot.coupling``; ``None``: each joint is shown by itself.
    """

    points: FloatArray
    columns: FloatArray
    motion_columns: FloatArray
    parameter_axes: FloatArray
    joint_axes: FloatArray
    layout: Layout
    coupling: FloatArray | None = None

    @cached_property
    def joint_columns(self) -> FloatArray:
        """(joints, targets, 3, N) derivative by each joint's coordinate [m / rad or 1]."""
        if self.coupling is None:
            return self.motion_columns
        return np.einsum("jk,jtxn->ktxn", self.coupling, self.motion_columns)

    def jacobian(self) -> FloatArray:
        """Identification Jacobian (N, 3·targets, P), rows x, y, z target by target, contiguous."""
        p, t, _, n = self.columns.shape
        return np.ascontiguousarray(self.columns.reshape(p, 3 * t, n).transpose(2, 1, 0))

    def pull_back(self, weights: FloatArray) -> FloatArray:
        """Gradient in the joints of Σ weights · J.

        Args:
            weights: (N, 3·targets, P or more), ∂f/∂J in the order of ``jacobian``; columns beyond the P-th do not
                matter.

        Returns:
            (N, joints), ∂f/∂q.
        """
        gradient = self._pull_back(weights)
        return gradient if self.coupling is None else gradient @ self.coupling

    def _pull_back(self, weights: FloatArray) -> FloatArray:
        """The same by the motions."""
        arrays = (self.columns, self.parameter_axes, self.motion_columns, self.joint_axes)
        if _kernel is not None and weights.flags.c_contiguous and all(a.flags.c_contiguous for a in arrays):
            out = np.empty((len(weights), len(self.joint_axes)))
            _kernel.pull_back(self.layout.code, *arrays, weights, out)
            return out
        return self.pull_back_numpy(weights)

    def pull_back_numpy(self, weights: FloatArray) -> FloatArray:
        """``pull_back`` by the motions, without the compiled kernel."""
        p, targets, _, n = self.columns.shape
        weights = np.ascontiguousarray(weights[:, :, :p].transpose(2, 1, 0)).reshape(p, targets, 3, n)
        lay = self.layout
        order, front, before, turning = lay.running_sums
        # Running sums from the tip: Σ J_a × G_a over the parameters at or behind each place of the chain.
        twists = _cross(self.columns, weights).sum(axis=1)[order]
        behind = np.zeros((len(order) + 1, *twists.shape[1:]))
        np.cumsum(twists[::-1], axis=0, out=behind[1:])
        gradient = (self.joint_axes * behind[len(order) - before]).sum(axis=1) * turning[:, None]
        if front.size:
            # Running sums from the base: Σ G_a × w_a over the rotations in front of each place.
            pushes = _cross(weights[order][front], self.parameter_axes[order][front][:, None])
            ahead = np.zeros((len(front) + 1, *pushes.shape[1:]))
            np.cumsum(pushes, axis=0, out=ahead[1:])
            rotations = np.searchsorted(front, before)
            gradient += (self.motion_columns * ahead[rotations]).sum(axis=(1, 2))
        return gradient.T

    def pull_back_levers(self, weights: FloatArray, layout: Layout) -> FloatArray:
        """Gradient in the joints of Σ weights · ``joint_columns``.

        Args:
            weights: (N, 3·targets, joints).
            layout: The chain's, with the joints as its parameters.

        Returns:
            (N, joints).
        """
        if self.coupling is not None:  # to the motions, whose columns these are sums of
            weights = weights @ self.coupling.T
        moved, axes = self.motion_columns, self.joint_axes
        return Linearisation(self.points, moved, moved, axes, axes, layout, self.coupling).pull_back(weights)


def _cross(u: FloatArray, v: FloatArray) -> FloatArray:
    """Cross product over the axis before the last; the other axes broadcast."""
    ux, uy, uz = u[..., 0, :], u[..., 1, :], u[..., 2, :]
    vx, vy, vz = v[..., 0, :], v[..., 1, :], v[..., 2, :]
    first = uy * vz
    out = np.empty((*first.shape[:-1], 3, first.shape[-1]))
    np.subtract(first, uz * vy, out=out[..., 0, :])
    np.subtract(uz * vx, ux * vz, out=out[..., 1, :])
    np.subtract(ux * vy, uy * vx, out=out[..., 2, :])
    return out


# ── posture ──────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class Posture:
    """Frames of the chain for N configurations, T targets.

    All in the frame of ``Robot.positions``: the base frame, or the tracker's once the base pose is set.

    Attributes:
        joint_origins: (N, joints, 3) a point on each joint's axis, moved along by a sliding joint [m].
        joint_axes: (N, joints, 3) unit direction in which each joint's coordinate grows: turning
            right-handed about it, or sliding along it.
        tip_origin: (N, 3) origin of the tip's frame [m].
        tip_rotation: (N, 3, 3) the tip's axes as columns: ``tip_rotation @ v_tip = v_base``.
        targets: (N, T, 3) the targets [m].
    """

    joint_origins: FloatArray
    joint_axes: FloatArray
    tip_origin: FloatArray
    tip_rotation: FloatArray
    targets: FloatArray

    def __len__(self) -> int:
        return len(self.tip_origin)

    def rows(self, which: IntArray) -> Posture:
        """The postures with these numbers."""
        return Posture(
            self.joint_origins[which],
            self.joint_axes[which],
            self.tip_origin[which],
            self.tip_rotation[which],
            self.targets[which],
        )
