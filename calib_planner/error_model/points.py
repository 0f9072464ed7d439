# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What is new at each point: the instrument's noise and a floor.

The instrument says how it errs in each direction, a covariance Σ_it that depends on where the point is
(``Noise``, or the standard deviations that came with the data). It may be wrong by a factor, which the data can
tell: its square root is the scale ``instrument``, one where the instrument is believed. Below it lies a floor of
the same size in all directions, ``floor``: a reflector that does not sit the same each time, air, what no other
term holds. Where no instrument is stated the floor is all there is.

    cov ε_it = scale² Σ_it + floor² I
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.error_model.poses import Poses
from calib_planner.tracker import Noise


@dataclass(frozen=True)
class Points:
    """Errors of a point.

    Attributes:
        noise: The instrument in the frame of the points, or ``None`` where only the data or nothing says it.
        estimate_scale: Whether the data decide by which factor the instrument's statement is wrong.
        floor: Whether there is a floor below the instrument.
    """

    noise: Noise | None = None
    estimate_scale: bool = False
    floor: bool = True

    name: ClassVar[str] = "points"
    title: ClassVar[str] = "noise of the instrument and of each point"

    @property
    def scales(self) -> tuple[str, ...]:
        """Names of the scales of the error model that this term uses."""
        wanted = (("instrument", self.estimate_scale), ("floor", self.floor))
        return tuple(name for name, there in wanted if there)

    def parts(
        self, poses: Poses, values: dict[str, float], stated: FloatArray | None = None
    ) -> dict[str, FloatArray]:
        """Scale → (N, 3·targets, 3·targets) its part of the covariance of a visit [m²].

        The part ``instrument`` is there whenever somebody states the noise; it is a scale only if it is
        estimated.

        Args:
            poses: Where the points are.
            values: The scales.
            stated: (N, targets, 3, 3) covariance that came with the data [m²]; it goes before ``noise``.
        """
        targets = len(poses.robot.targets)
        if stated is None and self.noise is not None:
            stated = self.noise.covariance(poses.points)
        result: dict[str, FloatArray] = {}
        if stated is not None:
            blocks = np.zeros((len(poses), targets, 3, targets, 3))
            every = np.arange(targets)
            blocks[:, every, :, every, :] = np.moveaxis(stated, 1, 0) * values.get("instrument", 1.0) ** 2
            result["instrument"] = blocks.reshape(len(poses), 3 * targets, 3 * targets)
        if self.floor:
            block = values["floor"] ** 2 * np.eye(3 * targets)
            result["floor"] = np.broadcast_to(block, (len(poses), 3 * targets, 3 * targets))
        return result

    def noise_of(self, points: FloatArray, values: dict[str, float], standard: FloatArray) -> FloatArray:
        """(…, 3) errors of the instrument at ``points`` (…, 3) [m].

        Args:
            points: Where the points are [m].
            values: The scales.
            standard: (…, 3) errors of covariance I.
        """
        if self.noise is None:
            return np.zeros(points.shape)
        factor = values.get("instrument", 1.0) * np.linalg.cholesky(self.noise.covariance(points))
        return np.asarray((factor @ standard[..., None])[..., 0])

    def floor_of(self, values: dict[str, float], standard: FloatArray) -> FloatArray:
        """(…, 3) errors of the floor [m], from ``standard`` (…, 3) errors of covariance I."""
        return (values["floor"] if self.floor else 0.0) * standard
