# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The sensitivity d(q) = tr(G I_1(q)) as what it is: a polynomial in the joints, known from few values.

With isotropic noise and G = S Sᵀ, d(q) = ‖J(q) S‖²_F / (σ² + σ_c²).

Structure. Every joint moves one element, so that the entries of J are, in each joint that turns, combinations of
1, cos q and sin q, and in each joint that slides affine. Hence d is a trigonometric polynomial of degree 2 (a
quadratic) in each, and its values on a grid of 5 (3) nodes per joint *are* d: 5⁶ evaluations for six joints.
Joints on which d does not depend show up as vanishing coefficients and are dropped: with isotropic noise always
the first axis, unless the base is unknown, and the last where nothing behind it matters.

Rounding. Values of d carry errors of about eps per operation relative to ‖J‖‖S‖, ``amplification`` says how much
larger they may be in the first boxes, halving takes weighted means and adds a few eps each; all this and the size
of the coefficients dropped are the polynomial's ``allowance``, to be added to every result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.planning.certify.bernstein import Axis, along, amplification
from calib_planner.planning.certify.branch_and_bound import DEEPEST
from calib_planner.planning.information import InformationModel
from calib_planner.tracker import Isotropic

EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class Polynomial:
    """d in the joints it depends on.

    Attributes:
        axes: Of the k active joints.
        active: Their indices.
        tensor: Coefficients of the harmonics of ``bernstein``, one axis per active joint.
        allowance: How much larger than the Bernstein coefficients of a box d may be there.
    """

    axes: tuple[Axis, ...]
    active: tuple[int, ...]
    tensor: FloatArray
    allowance: float


def square_root(gradient: FloatArray) -> FloatArray:
    """S (p, r) with S Sᵀ ⪰ G: negative eigenvalues, which are rounding, are taken as zero."""
    values, vectors = np.linalg.eigh(0.5 * (gradient + gradient.T))
    keep = values > 0
    return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))


def sensitivity(model: InformationModel, root: FloatArray, q: FloatArray) -> tuple[FloatArray, float]:
    """d (N,) and the largest error of the computed values."""
    assert isinstance(model.noise, Isotropic)
    steps = len(model.robot.elements) + 3 + 2 * len(root)
    parts, largest = [], 0.0
    for start in range(0, len(q), 8192):
        rows = model.whitened(q[start : start + 8192])
        seen = rows @ root
        parts.append(np.einsum("nij,nij->n", seen, seen))
        largest = max(largest, float(np.einsum("nij,nij->n", rows, rows).max()))
    d = np.concatenate(parts)
    error = 4.0 * EPS * steps * float(np.sqrt(largest) * np.linalg.norm(root))
    return d, 2.0 * error * float(np.sqrt(d.max())) + error**2


def polynomial(model: InformationModel, root: FloatArray) -> Polynomial:
    """Sample d on the grid of nodes and drop the joints it does not depend on."""
    robot = model.robot
    limits = zip(robot.joint_limits, robot.joint_is_revolute, strict=True)
    axes = [Axis.of(float(low), float(high), bool(turns)) for (low, high), turns in limits]
    grid = np.stack(np.meshgrid(*[a.nodes for a in axes], indexing="ij"), axis=-1)
    values, error = sensitivity(model, root, grid.reshape(-1, len(axes)))
    tensor = values.reshape(grid.shape[:-1])
    for k, axis in enumerate(axes):
        tensor = along(axis.analysis(), tensor, k)
    active: list[int] = []
    dropped = 0.0
    for k in range(len(axes)):
        at = len(active)
        rest = float(np.abs(np.delete(tensor, 0, axis=at)).sum())
        if rest <= 1e-10 * float(np.abs(tensor).sum()):
            tensor, dropped = np.take(tensor, 0, axis=at), dropped + rest
        else:
            active.append(k)
    used = tuple(axes[k] for k in active)
    rounding = error + 64.0 * EPS * len(axes) * float(values.max())
    halving = 64.0 * EPS * DEEPEST * len(used) * float(np.abs(tensor).sum())
    allowance = amplification(used) * rounding + dropped + halving
    return Polynomial(used, tuple(active), tensor, allowance)
