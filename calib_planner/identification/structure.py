"""Do the residuals know where the robot stood? Then something is missing from the model.

After a good fit residuals are independent. Three questions, each with an answer that is normal if they are:

*Neighbours.* With each configuration's nearest other in joint space, S = Σ w_ij r_i·r_j; its variance is
Σ_{i<j} (w_ij + w_ji)² tr(C²), C the second moment of r (Moran 1950, for vectors).

*One configuration.* Its targets' residuals: S = Σ r_t·r_u over pairs, of variance (pairs) tr(C²).

*One joint.* The part of r_i along c_l = ∂p/∂q_l, in order of q_l: neighbours in one joint's angle that err alike
mean an error of that joint's transmission. S = Σ y_i y_{i+1}, of variance (n − 1) (Σ y²/n)².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import ndtr

from calib_planner._arrays import FloatArray, IntArray
from calib_planner.identification.discrepancy import joint_features
from calib_planner.robot.chain import Robot

SIGNIFICANT = 1e-4
"""A structure less probable than this by chance is one."""
FEWEST = 10
"""Configurations below which nothing can be seen."""


@dataclass(frozen=True)
class Structure:
    """One answer.

    Attributes:
        kind: ``neighbours`` in joint space, ``configuration`` or ``joint``.
        joint: Name of the joint; empty for the other kinds.
        correlation: Of neighbours, 0 if independent.
        probability: Of a correlation as large, by chance.
        amplitude: Root mean square of the joint's apparent error [rad | m]; of the residuals [m] for other kinds.
        unit: Of ``amplitude``.
    """

    kind: str
    joint: str
    correlation: float
    probability: float
    amplitude: float
    unit: str


def residual_structure(
    robot: Robot, q: FloatArray, residuals: FloatArray, use: NDArray[np.bool_], labels: IntArray
) -> tuple[Structure, ...]:
    """Ask both questions.

    Args:
        robot: Gives the joints' levers.
        q: (N, joints).
        residuals: (N, targets, 3) measured − predicted [m].
        use: (N, targets) points that count.
        labels: (N,) configuration of each row; repetitions are averaged first.
    """
    rows = np.flatnonzero(use.any(axis=1))
    _, first, owner = np.unique(labels[rows], return_index=True, return_inverse=True)
    if len(first) < FEWEST:
        return ()
    q = q[rows[first]]
    weight = use[rows].astype(float)[:, :, None]
    total = np.zeros((len(first), *residuals.shape[1:]))
    count = np.zeros((len(first), use.shape[1], 1))
    np.add.at(total, owner, np.where(use[rows][:, :, None], residuals[rows], 0.0))
    np.add.at(count, owner, weight)
    mean = total / np.maximum(count, 1.0)
    levers = robot.joint_jacobian(q).reshape(*mean.shape, -1) * (count > 0)[..., None]
    joints = (_one_joint(robot, k, q[:, k], mean, levers[..., k]) for k in range(q.shape[1]))
    points = mean.sum(axis=1) / np.maximum((count > 0).sum(axis=1), 1)
    found = (_neighbours(robot, q, points), _configuration(mean, count[..., 0] > 0), *joints)
    return tuple(s for s in found if s is not None)


def _neighbours(robot: Robot, q: FloatArray, r: FloatArray) -> Structure:
    features = joint_features(robot, q)
    nearest = cKDTree(features).query(features, k=2)[1][:, 1]
    n = len(r)
    mutual = nearest[nearest] == np.arange(n)
    moment = r.T @ r / n
    statistic = float(np.sum(r * r[nearest]))
    # A mutual pair has weight 2 and is counted once, any other has weight 1.
    pairs = 4.0 * mutual.sum() / 2 + (~mutual).sum()
    deviation = float(np.sqrt(pairs * np.sum(moment**2)))
    z = statistic / deviation if deviation > 0 else 0.0
    size = float(np.trace(moment))
    correlation = statistic / (n * size) if size > 0 else 0.0
    return Structure("neighbours", "", correlation, float(ndtr(-z)), float(np.sqrt(size)), "m")


def _configuration(r: FloatArray, seen: NDArray[np.bool_]) -> Structure | None:
    pairs = int(np.sum(seen.sum(axis=1) * (seen.sum(axis=1) - 1)) // 2)
    moment = np.einsum("nta,ntb->ab", r, r) / seen.sum()
    size = float(np.trace(moment))
    if not pairs or size == 0.0:
        return None
    total = r.sum(axis=1)
    statistic = 0.5 * float(np.sum(total**2) - np.sum(r**2))
    z = statistic / np.sqrt(pairs * float(np.sum(moment**2)))
    return Structure("configuration", "", statistic / (pairs * size), float(ndtr(-z)), float(np.sqrt(size)), "m")


def _one_joint(robot: Robot, k: int, angle: FloatArray, r: FloatArray, lever: FloatArray) -> Structure | None:
    length = np.sqrt(np.sum(lever**2, axis=(1, 2)))
    if np.ptp(angle) < 1e-6 or length.max() < 1e-6:
        return None
    order = np.argsort(angle, kind="stable")
    along = np.sum(lever * r, axis=(1, 2))
    y = (along / np.maximum(length, 1e-3 * length.max()))[order]
    square = float(np.mean(y**2))
    if square == 0.0:
        return None
    correlation = float(np.sum(y[1:] * y[:-1])) / ((len(y) - 1) * square)
    probability = float(ndtr(-correlation * np.sqrt(len(y) - 1)))
    amplitude = float(np.sqrt(square / np.mean(length**2)))
    unit = "rad" if robot.joint_is_revolute[k] else "m"
    return Structure("joint", robot.joint_names[k], correlation, probability, amplitude, unit)
