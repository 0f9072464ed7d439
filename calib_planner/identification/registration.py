# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the tracker stands and where the targets sit, in closed form: no initial guess.

With the tip at rotation R_i and position o_i in the base frame, a target at t in the tip's frame is seen at

    p_i = R_b (R_i t + o_i) + t_b.

Multiplying by C = R_bᵀ and writing d = R_bᵀ t_b makes it linear in everything unknown:

    C p_i − d − R_i t = o_i.

Least squares gives C, which is projected onto the rotations (Kabsch); with R_b fixed, t_b and t are linear
again and solved anew. Unknown target offsets need the base; with known offsets the same equations hold with
t on the right-hand side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.errors import NotEnoughDataError
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot

THIN = 1e-2
"""Points thinner than this share of their extent keep to a plane: what is across it is noise and tolerances."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Where the tracker's frame is, and the targets in the tip's.

    Attributes:
        rotation, origin: R_b (3, 3) and t_b (3,) [m]; none (1 and 0) where the tip's poses hold them already.
        offsets: t of each target (targets, 3) [m].
    """

    rotation: FloatArray
    origin: FloatArray
    offsets: FloatArray

    def positions(self, poses: tuple[FloatArray, FloatArray]) -> FloatArray:
        """(N, targets, 3) [m] of the tip's rotations (N, 3, 3) and origins (N, 3)."""
        rotations, origins = poses
        points = self.offsets @ np.swapaxes(rotations, 1, 2) + origins[:, None]
        return np.asarray(points @ self.rotation.T + self.origin)

    def of(self, robot: Robot, *, base: bool, tool: bool) -> Robot:
        """``robot`` there, as far as it was unknown."""
        robot = robot.with_base(self.rotation, self.origin) if base else robot
        return robot.with_targets(self.offsets) if tool else robot


CAUCHY_ROUNDS = 30
"""Most rounds of the weights of a robust registration."""


def register(robot: Robot, data: Measurements, *, base: bool, tool: bool, robust: bool = False) -> Robot:
    """``robot`` with the base pose and target offsets that fit the nominal kinematics best.

    Args:
        base: The tracker's pose is unknown; otherwise the robot's base pose is kept.
        tool: The target offsets are unknown; otherwise the robot's targets are kept.
        robust: Whether far points count little.

    Raises:
        NotEnoughDataError: Fewer equations than unknowns, or all configurations alike.
    """
    if not (base or tool):
        return robot
    poses = tip_poses(robot, data.q, at_base=base)
    placed, weights = place(robot, data, poses, base=base, tool=tool), np.ones(data.seen.shape)
    for _ in range(CAUCHY_ROUNDS if robust else 0):
        lengths = np.linalg.norm(data.p - placed.positions(poses), axis=2)
        scale = float(np.nanmedian(lengths))
        if scale == 0.0:
            break
        new = np.where(data.seen, 1.0 / (1.0 + (lengths / scale) ** 2), 0.0)
        settled, weights = np.nanmax(np.abs(new - weights)) < 1e-3, new
        placed = place(robot, data, poses, base=base, tool=tool, weights=weights)
        if settled:
            break
    return placed.of(robot, base=base, tool=tool)


def place(
    robot: Robot,
    data: Measurements,
    poses: tuple[FloatArray, FloatArray],
    *,
    base: bool,
    tool: bool,
    weights: FloatArray | None = None,
) -> Placement:
    """The same for the ``tip_poses`` of these data, without making a robot.

    Args:
        weights: (N, targets) >= 0, how much each point counts; default all alike.
    """
    return place_points(robot, data.p, poses, base=base, tool=tool, weights=weights)


def place_points(
    robot: Robot,
    points: FloatArray,
    poses: tuple[FloatArray, FloatArray],
    *,
    base: bool,
    tool: bool,
    weights: FloatArray | None = None,
) -> Placement:
    """The same for ``points`` (N, targets, 3) [m], NaN where not measured."""
    rotations, origins = poses
    row, target = np.nonzero(~np.isnan(points[:, :, 0]))
    p, r, o = points[row, target], rotations[row], origins[row]
    root = np.ones(len(row)) if weights is None else np.sqrt(weights[row, target])
    offsets = robot.target_offsets
    matrix: FloatArray = np.eye(3)
    xyz: FloatArray = np.zeros(3)
    if base:
        matrix = _base_rotation(p, r, o, target, None if tool else offsets, root)
    targets = len(robot.targets)
    # p − R_b o = t_b + R_b R_i t, linear in t_b and t once R_b is known.
    columns = [np.broadcast_to(np.eye(3), r.shape)] if base else []
    lever = matrix @ r if base else r
    if tool:
        blocks = np.zeros((len(row), 3, targets, 3))
        blocks[np.arange(len(row)), :, target] = lever
        columns.append(blocks.reshape(len(row), 3, 3 * targets))
    right = p - (o @ matrix.T if base else o)
    if not tool:
        right = right - np.einsum("nij,nj->ni", lever, offsets[target])
    system = np.concatenate(columns, axis=2) * root[:, None, None]
    solution = _solve(system.reshape(3 * len(row), -1), (right * root[:, None]).ravel())
    if base:
        xyz, solution = solution[:3], solution[3:]
    return Placement(matrix, xyz, solution.reshape(targets, 3) if tool else offsets)


def _base_rotation(
    p: FloatArray,
    r: FloatArray,
    o: FloatArray,
    target: IntArray,
    offsets: FloatArray | None,
    root: FloatArray,
) -> FloatArray:
    n, p = len(p), _without_thickness(p, root)
    blocks = np.zeros((n, 3, 3, 3))
    for axis in range(3):
        blocks[:, axis, axis, :] = p
    columns = [blocks.reshape(n, 3, 9), np.broadcast_to(-np.eye(3), (n, 3, 3))]
    right = o
    if offsets is None:
        lever = np.zeros((n, 3, int(target.max()) + 1, 3))
        lever[np.arange(n), :, target] = -r
        columns.append(lever.reshape(n, 3, -1))
    else:
        right = o + np.einsum("nij,nj->ni", r, offsets[target])
    system = (np.concatenate(columns, axis=2) * root[:, None, None]).reshape(3 * n, -1)
    # Points in one plane leave C short of a column or row; the projection restores it.
    solution = np.linalg.lstsq(system, (right * root[:, None]).ravel(), rcond=1e-10)[0]
    u, values, vt = np.linalg.svd(solution[:9].reshape(3, 3))
    if values[1] < 1e-3:
        raise NotEnoughDataError(
            3 * n,
            system.shape[1],
            "the measured configurations do not determine the tracker's pose: "
            "measure at least 4 configurations that differ in several joints",
        )
    sign = np.sign(np.linalg.det(u @ vt))
    return (u @ np.diag([1.0, 1.0, sign]) @ vt).T


def _without_thickness(p: FloatArray, root: FloatArray) -> FloatArray:
    """Points (n, 3) about their centre, weighted by ``root``²; without their distance from a plane they keep to.

    d takes up the centre. Noise across the plane of a robot that moves in one would tell a column of C.
    """
    weights = root[:, None] ** 2
    p = p - np.sum(p * weights, axis=0) / np.sum(weights, axis=0)
    squares, axes = np.linalg.eigh(p.T @ (p * weights))
    return p - np.outer(p @ axes[:, 0], axes[:, 0]) if squares[0] < THIN**2 * squares[2] else p


def _solve(system: FloatArray, right: FloatArray) -> FloatArray:
    if system.shape[0] < system.shape[1]:
        raise NotEnoughDataError(
            system.shape[0],
            system.shape[1],
            f"{system.shape[0]} equations for {system.shape[1]} unknowns of tracker and target pose: "
            "measure more configurations",
        )
    return np.asarray(np.linalg.lstsq(system, right, rcond=1e-10)[0], np.float64)


def tip_poses(robot: Robot, q: FloatArray, *, at_base: bool) -> tuple[FloatArray, FloatArray]:
    """Rotation (N, 3, 3) and origin (N, 3) of the tip, from four points fixed to it."""
    if at_base:
        robot = robot.with_base(np.eye(3), np.zeros(3))
    frame = np.vstack([np.zeros(3), np.eye(3)])
    points = replace(robot, parameter_names=()).with_targets(frame).positions(q)
    return (points[:, 1:] - points[:, :1]).transpose(0, 2, 1), points[:, 0]


MISPLACED = 0.02
"""Points farther than this are of a robot that stands elsewhere: nominal arms err by a few millimetres [m]."""
NO_BETTER = 2.0
"""Of two explanations the simpler one is taken unless the other is this many times closer."""

EXPLAINED = 0.1
"""A place that leaves more of the distances than this share explains nothing: units or joints are wrong."""


@dataclass(frozen=True)
class Misplacement:
    """What has to be unknown for the points to fit the nominal robot.

    Attributes:
        unknown: ``base``, ``tool``, both, or nothing.
        before: Median distance of the points from the robot as it was given [m].
        after: The same with ``unknown`` fitted [m].
        unexplained: Whether the points are far from the robot wherever it and its targets stand.
    """

    unknown: tuple[str, ...]
    before: float
    after: float
    unexplained: bool = False


def find_misplacement(robot: Robot, data: Measurements) -> Misplacement:
    """Whether base or targets stand elsewhere than the robot says: the simplest explanation that fits.

    Args:
        robot: With base and targets as they were given.
        data: The measurements.
    """
    seen = data.seen
    before = _median(robot, data)
    best = Misplacement((), before, before)
    if not before > MISPLACED or 3 * int(seen.sum()) <= 6 + 3 * seen.shape[1]:
        return best
    nothing = best
    for unknown in (("tool",), ("base",), ("base", "tool")):
        try:
            base, tool = "base" in unknown, "tool" in unknown
            after = _median(register(robot, data, base=base, tool=tool, robust=True), data)
        except NotEnoughDataError:
            continue
        if after * NO_BETTER < best.after:
            best = Misplacement(unknown, before, after)
    return best if best.after < EXPLAINED * before else replace(nothing, unexplained=True)


def _median(robot: Robot, data: Measurements) -> float:
    """Median distance of the points from where ``robot`` has them [m]; NaN without points."""
    if not data.seen.any():
        return float("nan")
    points = replace(robot, parameter_names=()).positions(data.q)
    return float(np.median(np.linalg.norm(data.p - points, axis=2)[data.seen]))
