# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What is known of a robot, and how well: (M2), (M3) and the prediction of any point.

Measuring the configurations q_i gives, with the columns J⁺ of parameters and other coefficients β, their prior
precision M₀ and the covariance R_i of a visit,

    M = M₀ + Σ_i J⁺_iᵀ R_i⁻¹ J⁺_i ,     C = M⁻¹ .                                                            (M2)

What remains uncertain at test poses, stacked in J⁺_0 (rows x, y, z of every pose and target), is one of two
things. *world* is the error of the position in the frame of the points,

    ρ0² = trace(J⁺_0 C J⁺_0ᵀ) / (poses · targets) ,                                                          (M3)

eq. (14) for one pose and target. *robot* is the same up to a rigid motion of the base, for users who register the
robot anew: a small motion moves a point p by a + b × p, the columns G = [I, −p×]; what it explains is taken off,

    ρ² = trace(Q J⁺_0 C J⁺_0ᵀ Q) / (poses · targets) ,      Q = I − G (GᵀG)⁻¹ Gᵀ .

Neither depends on how the parameters are chosen. A direction of β that no measurement and no prior shows (a zero
eigenvalue of M) makes both infinite if the test poses feel it, and nothing otherwise.

The covariance of a predicted measurement is a sum of four: *parameters*, which remain uncertain even if all other
coefficients were known, J (M_ΠΠ)⁻¹ Jᵀ; *systematic*, what the uncertainty of gravity and joint functions adds to
that, J⁺ C J⁺ᵀ − J (M_ΠΠ)⁻¹ Jᵀ; *repeatability*, of the visit; and *noise*, of the point.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

from calib_planner.arrays import FloatArray, check_configurations
from calib_planner.error_model.gravity import PAYLOAD, Payload
from calib_planner.error_model.model import ErrorModel
from calib_planner.error_model.poses import Poses
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.robot import Robot

ACCURACIES = ("world", "robot")
ROUNDING = 1e-13
"""Eigenvalues of the information, scaled to unit diagonal, below this are zero."""
FELT = 1e-6
"""A test pose feels a hidden direction that moves it by more than this share of what moves it most."""
FLATTEST = 1e-3
"""Test poses whose points are thinner than this share of their extent lie in a plane."""
UNKNOWN = 1.0
"""Standard deviation of a target that has just been put on [m]."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted measurements of N configurations.

    Attributes:
        mean: (N, targets, 3) positions [m].
        parameters, systematic, repeatability, noise: (N, targets, 3, 3) covariances [m²].
    """

    mean: FloatArray
    parameters: FloatArray
    systematic: FloatArray
    repeatability: FloatArray
    noise: FloatArray

    @property
    def position(self) -> FloatArray:
        """(N, targets, 3, 3) covariance of where the point is on average: parameters and systematic [m²]."""
        return self.parameters + self.systematic

    @property
    def total(self) -> FloatArray:
        """(N, targets, 3, 3) covariance of measured − predicted [m²]."""
        return self.position + self.repeatability + self.noise


@dataclass(frozen=True, eq=False)
class Accuracy:
    """(M3) at test poses.

    Attributes:
        kind: ``world`` or ``robot``.
        value: Root mean square over poses and targets [m]; infinite if the test poses need what is not known.
        per_pose: (K,) the same of each pose [m].
    """

    kind: str
    value: float
    per_pose: FloatArray


@dataclass(frozen=True, eq=False)
class Knowledge:
    """Mean and covariance of the coefficients of one robot.

    Attributes:
        robot: Nominal, with base and targets about where they are; its active parameters come first in β.
        model: How it errs.
        coefficients: (coefficients,) mean of β: deviations of the active parameters, then the others.
        covariance: (coefficients, coefficients) C, zero in hidden directions.
        hidden: (coefficients, directions) directions that nothing shows.
    """

    robot: Robot
    model: ErrorModel
    coefficients: FloatArray
    covariance: FloatArray
    hidden: FloatArray

    @staticmethod
    def of_plan(
        robot: Robot, model: ErrorModel, q: ArrayLike, payload: ArrayLike | None = None, repetitions: int = 1
    ) -> Knowledge:
        """What measuring ``q`` (N, joints) ``repetitions`` times each will tell; the mean stays at nominal.

        ``payload``: as in ``poses``.
        """
        matrix = prior_information(robot, model) + repetitions * information(robot, model, q, payload).sum(axis=0)
        return Knowledge.from_information(robot, model, matrix)

    @staticmethod
    def from_information(robot: Robot, model: ErrorModel, matrix: FloatArray) -> Knowledge:
        """The inverse of M on the space that it shows; ``matrix`` (coefficients, coefficients)."""
        return Knowledge(robot, model, np.zeros(len(matrix)), *covariance(matrix))

    @property
    def placed(self) -> Robot:
        """The robot with the parameters at their means; right where the joints stand, see ``actual``."""
        names = self.robot.parameter_names
        return self.robot.with_deviations(dict(zip(names, self.coefficients[: len(names)], strict=True)))

    # ── prediction ───────────────────────────────────────────────────────────────────────────────────

    def poses(self, q: ArrayLike, payload: ArrayLike | None = None) -> Poses:
        """Configurations (N, joints) with parameters and deflections at their means.

        Args:
            q: (N, joints) readings [rad | m].
            payload: Mass of the payload, one or (N,) [kg]; ``None``: what the elastic term states.
        """
        clean = check_configurations("configurations", q, self.robot.joint_names)
        readings = Poses(self.placed, clean, self.model.payloads(payload, len(clean)))
        return self.model.deflected(readings, self.coefficients)

    def carrying(self, payload: Payload | None) -> Knowledge:
        """The same robot when it carries this payload, or none: what it knows of its joints stays.

        A joint's coefficient is its compliance times the weight of what was carried, whose centre of gravity does
        not matter; so it grows with the mass. Where the measurements show no gravity, no payload matters.

        Raises:
            InputError: A payload, where the measurements had none that could tell what it does.
        """
        gravity = self.model.gravity
        if gravity is None or gravity.payload == payload:
            return self
        if gravity.payload is None:
            assert payload is not None
            self.model.payloads(payload.mass, 1)
        model = replace(self.model, gravity=replace(gravity, payload=payload))
        old = self.model.names(self.robot)
        place = [old.index(name) for name in model.names(self.robot)]
        factor = np.ones(len(place))
        if payload is not None and gravity.payload is not None:
            own = [i for i, name in enumerate(model.names(self.robot)) if name.startswith(f"gravity.{PAYLOAD}.")]
            factor[own] = payload.mass / gravity.payload.mass
        return replace(
            self,
            model=model,
            coefficients=self.coefficients[place] * factor,
            covariance=self.covariance[np.ix_(place, place)] * np.outer(factor, factor),
            hidden=self.hidden[place] * factor[:, None],
        )

    def actual(self, q: ArrayLike, payload: ArrayLike | None = None) -> FloatArray:
        """(N, joints) where the joints stand on average when they read ``q`` (N, joints) [rad | m].

        ``payload``: as in ``poses``.
        """
        return self.poses(q, payload).actual

    def reading(self, actual: ArrayLike, payload: ArrayLike | None = None) -> FloatArray:
        """(N, joints) what the joints read when they stand at ``actual`` (N, joints): its inverse."""
        wanted = check_configurations("configurations", actual, self.robot.joint_names)
        q = np.array(wanted)
        for _ in range(50):  # a few milliradians that change slowly: each round gains two digits or more
            error = wanted - self.actual(q, payload)
            q = q + error
            if np.abs(error).max(initial=0.0) < 1e-15:
                break
        return q

    def predict(self, q: ArrayLike, payload: ArrayLike | None = None) -> Prediction:
        """Mean and covariance of what would be measured; arguments as for ``poses``."""
        poses = self.poses(q, payload)
        n, targets = len(poses), len(self.robot.targets)
        columns = self.model.columns(poses).reshape(n, targets, 3, -1)
        count = len(self.robot.parameter_names)
        own = _spread(columns[..., :count], self._parameters_alone)
        noise = _diagonal_blocks(self.model.visit_covariance(poses, points_only=True), targets)
        both = _diagonal_blocks(self.model.visit_covariance(poses), targets)
        return Prediction(poses.points, own, _spread(columns, self.covariance) - own, both - noise, noise)

    @cached_property
    def _parameters_alone(self) -> FloatArray:
        """(P, P) covariance of the parameters if all other coefficients were known."""
        count = len(self.robot.parameter_names)
        own, cross = self.covariance[:count, :count], self.covariance[:count, count:]
        if not cross.shape[1]:
            return own
        scale = np.sqrt(np.maximum(np.diag(self.covariance)[count:], 0.0))
        scale = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
        rest = np.outer(scale, scale)
        rest *= self.covariance[count:, count:]
        scaled = cross * scale
        with suppress(np.linalg.LinAlgError):  # a coefficient that is known has a row of zeros
            regular = rest.copy()
            regular[np.diag_indices(len(rest))] += ROUNDING
            root = np.linalg.cholesky(regular)
            white = solve_triangular(root, scaled.T, lower=True)
            return np.asarray(own - white.T @ white)
        return own - scaled @ np.linalg.pinv(rest, rcond=1e-12, hermitian=True) @ scaled.T

    # ── accuracy ─────────────────────────────────────────────────────────────────────────────────────

    def accuracy(
        self,
        test_poses: ArrayLike,
        kind: str = "world",
        payload: ArrayLike | None = None,
        weights: ArrayLike | None = None,
    ) -> Accuracy:
        """(M3) at ``test_poses`` (K, joints), the mean over the poses with ``weights`` (K,), equal by default.

        ``payload``: as in ``poses``.

        Raises:
            UnknownNameError: ``kind`` is neither ``world`` nor ``robot``.
            InputError: ``robot`` for fewer than four test poses, or for points in a line or a plane.
        """
        poses = self.poses(test_poses, payload)
        blocks = accuracy_rows(poses.points, self.model.columns(poses), kind)
        per_pose = np.sqrt([error_variance(rows, self.covariance, self.hidden) for rows in blocks])
        share = np.ones(len(poses)) if weights is None else np.asarray(weights, float)
        counted = share > 0.0
        mean = float(share[counted] @ per_pose[counted] ** 2 / share.sum()) if len(poses) else np.nan
        return Accuracy(kind, float(np.sqrt(mean)), per_pose)

    # ── a few more points ────────────────────────────────────────────────────────────────────────────

    def with_new_targets(self, xyz: ArrayLike) -> Knowledge:
        """The same robot with targets put on anew, about at ``xyz`` (targets, 3) of the tip's frame [m].

        Nothing is known of their places but that (``UNKNOWN``); a few points tell them (``updated``).
        """
        names = self.model.names(self.robot)
        count = len(self.robot.parameter_names)
        chosen = [i for i, n in enumerate(names) if i >= count or not n.startswith("target_")]
        robot = self.robot.with_targets(xyz)
        chain = [n for n in self.robot.parameter_names if not n.startswith("target_")]
        new = [f"target_{t + 1}.{a}" for t in range(len(robot.targets)) for a in "xyz"]
        robot = replace(robot, parameter_names=(*chain, *new))
        old = [chosen.index(names.index(n)) for n in chain]
        place = np.array([*old, *([-1] * len(new)), *range(len(chain), len(chosen))])
        there = place >= 0
        coefficients = np.where(there, self.coefficients[chosen][place], 0.0)
        covariance = self.covariance[np.ix_(chosen, chosen)][np.ix_(place, place)] * np.outer(there, there)
        covariance[~there, ~there] = UNKNOWN**2
        hidden = self.hidden[chosen][place] * there[:, None]
        return Knowledge(robot, self.model, coefficients, covariance, hidden)

    def updated(
        self,
        q: ArrayLike,
        points: FloatArray,
        seen: NDArray[np.bool_] | None = None,
        rounds: int = 3,
        payload: ArrayLike | None = None,
    ) -> Knowledge:
        """With a few more visits ``q`` (N, joints) and their ``points`` (N, targets, 3) [m]; the scales stay.

        Linearised anew ``rounds`` times at the new mean. ``seen`` (N, targets): which points were measured;
        ``payload``: as in ``poses``.
        """
        mean, mask = self.coefficients, np.ones(points.shape[:2], bool) if seen is None else seen
        use = np.repeat(mask, 3, axis=1).ravel()
        for _ in range(rounds):
            poses = replace(self, coefficients=mean).poses(q, payload)
            columns = self.model.columns(poses)
            rows = columns.reshape(-1, len(mean))[use]
            apart = np.where(mask[:, :, None], points - poses.points, 0.0).ravel()[use]
            covariance = _block_diagonal(self.model.visit_covariance(poses))[np.ix_(use, use)]
            gain = self.covariance @ rows.T
            inner = np.linalg.cholesky(rows @ gain + covariance)
            white = np.linalg.solve(inner, gain.T)
            right = np.linalg.solve(inner, apart + rows @ (mean - self.coefficients))
            mean = self.coefficients + white.T @ right
        return replace(self, coefficients=mean, covariance=self.covariance - white.T @ white)


def prior_information(robot: Robot, model: ErrorModel) -> FloatArray:
    """M₀ (coefficients, coefficients), zero where flat."""
    return model.precision(robot)


def information(robot: Robot, model: ErrorModel, q: ArrayLike, payload: ArrayLike | None = None) -> FloatArray:
    """J⁺_iᵀ R_i⁻¹ J⁺_i of each configuration (N, joints): (N, coefficients, coefficients).

    ``payload``: as in ``Knowledge.poses``.
    """
    clean = check_configurations("configurations", q, robot.joint_names)
    poses = Poses(robot, clean, model.payloads(payload, len(clean)))
    columns = model.columns(poses)
    white = np.linalg.solve(np.linalg.cholesky(model.visit_covariance(poses)), columns)
    return np.asarray(white.transpose(0, 2, 1) @ white)


def covariance(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse of an information matrix on the space that it shows, and a basis of the rest.

    Scaled to unit diagonal first, so that the rank does not depend on the units of the coefficients.

    Returns:
        (p, p) pseudo-inverse C, and (p, p − rank) hidden directions (unit columns).
    """
    diagonal = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale = np.where(diagonal > 0, diagonal, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    shown = values > ROUNDING * max(float(values[-1]), 1e-300)
    basis = vectors[:, shown] / scale[:, None]
    hidden = vectors[:, ~shown] / scale[:, None]
    if hidden.size:
        hidden = hidden / np.linalg.norm(hidden, axis=0)
    return (basis / values[shown]) @ basis.T, hidden


def accuracy_rows(points: FloatArray, columns: FloatArray, kind: str) -> FloatArray:
    """(K, 3·targets, p) the rows of (M3): J⁺_0, for ``robot`` without what a rigid motion explains.

    Args:
        points: (K, targets, 3) at the test poses [m].
        columns: (K, 3·targets, p) J⁺_0.
        kind: ``world`` or ``robot``.

    Raises:
        UnknownNameError: Another kind.
        InputError: See ``without_rigid_motion``.
    """
    if kind not in ACCURACIES:
        raise UnknownNameError("accuracy_frame", kind, ACCURACIES)
    if kind == "world":
        return columns
    flat = without_rigid_motion(points, columns.reshape(-1, columns.shape[2]))
    return flat.reshape(columns.shape)


def error_variance(rows: FloatArray, inverse: FloatArray, hidden: FloatArray) -> float:
    """ρ0² of (M3) for the rows (3·targets, p) of one test pose [m²]: the mean over its targets.

    Infinite if the pose feels a direction that nothing shows.

    Args:
        rows: From ``accuracy_rows``.
        inverse: (p, p) C, and ``hidden`` (p, directions): from ``covariance``.
    """
    if hidden.size and np.abs(rows @ hidden).max() > FELT * np.abs(rows).max():
        return float("inf")
    return max(float(np.sum((rows @ inverse) * rows)), 0.0) / (len(rows) / 3)


def without_rigid_motion(points: FloatArray, rows: FloatArray) -> FloatArray:
    """What a common small motion of all points does not explain: Q · rows.

    A column that it explains but for rounding is zero: nothing is felt there, not even relative to the others.

    Args:
        points: (K, targets, 3) at the test poses [m].
        rows: (3·K·targets, n).

    Raises:
        InputError: Fewer than four test poses, or all points in a line or a plane.
    """
    advice = "give at least four test poses that are not in one plane, or ask for the accuracy 'world'"
    if len(points) < 4:
        raise InputError("test_poses", f"{len(points)} poses", "at least 4 for the accuracy 'robot'", advice)
    flat = points.reshape(-1, 3)
    centred = flat - flat.mean(axis=0)
    extent = np.linalg.svd(centred, compute_uv=False)
    if not extent[2] > FLATTEST * extent[0]:
        raise InputError("test_poses", "points in a line or a plane", "points in space", advice)
    turns = np.cross(np.eye(3)[None], centred[:, None, :]).transpose(0, 2, 1)  # b × p
    motion = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=2).reshape(-1, 6)
    basis = np.linalg.qr(motion)[0]
    left = rows - basis @ (basis.T @ rows)
    left[:, np.linalg.norm(left, axis=0) <= ROUNDING * np.linalg.norm(rows, axis=0)] = 0.0
    return np.asarray(left)


def _spread(columns: FloatArray, matrix: FloatArray) -> FloatArray:
    """J C Jᵀ of every target: columns (N, targets, 3, K) → (N, targets, 3, 3)."""
    half = (columns.reshape(-1, columns.shape[-1]) @ matrix).reshape(columns.shape)
    return np.asarray(half @ columns.swapaxes(2, 3))


def _diagonal_blocks(covariance: FloatArray, targets: int) -> FloatArray:
    """(N, 3·targets, 3·targets) → (N, targets, 3, 3)."""
    every = np.arange(targets)
    blocks = covariance.reshape(-1, targets, 3, targets, 3)[:, every, :, every, :]
    return np.asarray(np.moveaxis(blocks, 0, 1))


def _block_diagonal(blocks: FloatArray) -> FloatArray:
    """(N, m, m) → (N·m, N·m)."""
    n, m, _ = blocks.shape
    result = np.zeros((n, m, n, m))
    result[np.arange(n), :, np.arange(n), :] = blocks
    return result.reshape(n * m, n * m)
