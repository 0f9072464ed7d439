# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How far each measured point is from where an estimate puts it: for ``~/residuals`` and ``~/markers``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from calib_planner_msgs.msg import Residuals
from geometry_msgs.msg import Vector3

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.identification import Estimate
from calib_planner.io import Record
from calib_planner.ros.messages import stamp_message


@dataclass(frozen=True, eq=False)
class PointResiduals:
    """N points in the order of measuring, all targets of a standstill together.

    Attributes:
        ids: (N,) numbers of their standstills, ``Measurement.id``.
        targets: (N,) their targets, from 0.
        points: (N, 3) measured positions in the tracker's frame [m].
        vectors: (N, 3) measured − estimated position in the tracker's frame [m].
        used: (N,) whether they are used for the estimate.
    """

    ids: IntArray
    targets: IntArray
    points: FloatArray
    vectors: FloatArray
    used: np.ndarray


def residuals_of(estimate: Estimate | object, records: Sequence[Record]) -> PointResiduals:
    """The points of the measurements that an estimate was fitted to; none if there is no estimate.

    Args:
        estimate: The estimate, or anything else if there is none.
        records: Its measurements, in its order.
    """
    if not isinstance(estimate, Estimate) or not records:
        none, nowhere = np.zeros(0, np.int64), np.zeros((0, 3))
        return PointResiduals(none, none, nowhere, nowhere, none.astype(bool))
    vectors = estimate.residuals.vectors
    points = np.array([r.standstill.points for r in records])
    used = np.ones(vectors.shape[:2], bool)
    for point in estimate.points.rejected:
        used[point.row, point.target - 1] = False
    rows, targets = np.nonzero(np.isfinite(vectors).all(axis=2) & np.isfinite(points).all(axis=2))
    ids = np.array([r.number for r in records])[rows]
    return PointResiduals(ids, targets, points[rows, targets], vectors[rows, targets], used[rows, targets])


def residuals_message(residuals: PointResiduals, plan_id: str, stamp: int, frame_id: str) -> Residuals:
    """The message for an estimate with this stamp [ns]; ``frame_id`` is the tracker's frame."""
    message = Residuals(
        plan_id=plan_id,
        ids=residuals.ids.tolist(),
        targets=residuals.targets.tolist(),
        residuals=[Vector3(x=x, y=y, z=z) for x, y, z in residuals.vectors.tolist()],
        used=residuals.used.tolist(),
    )
    message.header.stamp, message.header.frame_id = stamp_message(stamp), frame_id
    return message
