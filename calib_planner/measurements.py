# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What was measured: joint values, the points that the tracker saw there, and points that are not believed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_planner.arrays import FloatArray, IntArray, check_array, check_configurations
from calib_planner.errors import InputError
from calib_planner.units import Told, counted, listed

SAME_JOINT = 2e-4
"""Joint values closer than this belong to visits of one configuration [rad | m]."""


@dataclass(frozen=True)
class RejectedPoint:
    """A measured point that the identification did not use, or that it used and doubts.

    Attributes:
        row: Row of the measurements, from 0.
        target: Target, from 1 as in the column names of files.
        reason: Why, in words.
        normalised_residual: Length of its residual in standard deviations of what it should be.
        residual: Length of its residual [m].
    """

    row: int
    target: int
    reason: str
    normalised_residual: float
    residual: float


@dataclass(frozen=True, eq=False, repr=False)
class Measurements(Told):
    """N configurations and the points measured there (A1, A2 of the paper).

    Attributes:
        joint_names: Order of the columns of ``configurations``.
        configurations: (N, joints) [rad | m].
        points: (N, targets, 3) in the tracker's frame [m]; NaN where a target was not measured.
        std: (N, targets, 3) standard deviation of each coordinate [m], or ``None`` where unknown.
        payload: (N,) mass that the robot carried at each visit [kg], or ``None`` where nobody stated one.
    """

    joint_names: tuple[str, ...]
    configurations: ArrayLike
    points: ArrayLike
    std: ArrayLike | None = None
    payload: ArrayLike | None = None

    def _facts(self) -> list[tuple[str, object]]:
        seen = self.p[self.seen]
        extent = np.ptp(seen, axis=0).tolist() if len(seen) else [0.0, 0.0, 0.0]
        said = [word for word, value in (("std", self.std), ("payload", self.payload)) if value is not None]
        return [
            ("visits", len(self)),
            ("points", f"{len(seen)} of {counted(self.p.shape[1], 'target')}"),
            ("joints", listed(self.joint_names, 8)),
            ("extent", " × ".join(f"{1e3 * v:.0f}" for v in extent) + " mm"),
            *([("with", " and ".join(said))] if said else []),
        ]

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "joint_names", tuple(self.joint_names))
        q = check_configurations("configurations", self.configurations, self.joint_names)
        put(self, "configurations", q)
        meaning = "(configurations, targets, xyz) in m"
        points = check_array("points", self.points, (len(q), None, 3), finite=False, meaning=meaning)
        if np.isinf(points).any():
            raise InputError("points", "an infinite coordinate", "finite numbers, NaN if not measured")
        partly = np.isnan(points).any(axis=2) & ~np.isnan(points).all(axis=2)
        if partly.any():
            i, t = (int(v) for v in np.argwhere(partly)[0])
            raise InputError(f"points[{i}], target {t + 1}", "some of x, y, z", "all three coordinates or none")
        put(self, "points", points)
        if self.std is not None:
            std = check_array("std", self.std, points.shape, finite=False, meaning=meaning)
            if (std[~np.isnan(points)] <= 0).any() or np.isnan(std[~np.isnan(points)]).any():
                raise InputError("std", "a value <= 0 or missing", "a standard deviation > 0 [m]")
            put(self, "std", std)
        if self.payload is not None:
            payload = check_array("payload", self.payload, (len(q),), meaning="mass at each configuration in kg")
            if (payload < 0).any():
                raise InputError("payload", f"{payload.min():g} kg", "masses of 0 kg or more")
            put(self, "payload", payload)

    def __len__(self) -> int:
        return len(self.q)

    @property
    def q(self) -> FloatArray:
        """(N, joints), ``configurations`` as the array the constructor made."""
        return np.asarray(self.configurations)

    @property
    def p(self) -> FloatArray:
        """(N, targets, 3), ``points`` as the array the constructor made."""
        return np.asarray(self.points)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(N, targets), whether each target was measured."""
        return ~np.isnan(self.p[:, :, 0])

    def select(self, rows: ArrayLike) -> Measurements:
        """Some of the rows, in the order given."""
        rows = np.asarray(rows)
        std, payload = (None if a is None else np.asarray(a)[rows] for a in (self.std, self.payload))
        return Measurements(self.joint_names, self.q[rows], self.p[rows], std, payload)

    def without(self, rejected: Iterable[RejectedPoint]) -> Measurements:
        """The same rows with the rejected points marked as not measured."""
        points = np.array(self.p)
        for point in rejected:
            points[point.row, point.target - 1] = np.nan
        return replace(self, points=points)

    def in_order_of(self, joint_names: Sequence[str]) -> Measurements:
        """The same with the joint columns in another order.

        Raises:
            InputError: The names are not the same set.
        """
        if set(joint_names) != set(self.joint_names):
            raise InputError("joint names", ", ".join(self.joint_names), f"the robot's: {', '.join(joint_names)}")
        order = [self.joint_names.index(n) for n in joint_names]
        return replace(self, joint_names=tuple(joint_names), configurations=self.q[:, order])


def configuration_labels(q: FloatArray) -> IntArray:
    """(N,) number of the configuration of each row of ``q`` (N, joints); repetitions share it."""
    from scipy.sparse import coo_array  # 0.2 s, all three, which commands without measurements do not wait for
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(q).query_pairs(SAME_JOINT, p=np.inf, output_type="ndarray")
    if not len(pairs):
        return np.arange(len(q))
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(q), len(q)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)
