# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the tracker can see: range, elevation, the reflector's cone, a clear beam. See ``tracker.visibility``."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_array, check_number
from calib_planner.errors import InputError
from calib_planner.planning.constraints.room import PostureConstraint
from calib_planner.robot import Capsules, Posture, Robot, segments
from calib_planner.tracker import (
    check_direction,
    distances,
    elevations,
    incidence_cosines,
    segment_distances,
    shortened,
)

STATION = "station"


@dataclass(frozen=True, eq=False)
class TrackerRange(PostureConstraint):
    """Every target p is neither too near nor too far: minimum ≤ |p − s| ≤ maximum.

    Attributes:
        station: (3,) s in the frame of positions [m].
        minimum, maximum: Distances [m].
    """

    station: ArrayLike
    minimum: float = 0.0
    maximum: float = float("inf")
    name: str = "tracker range"

    def __post_init__(self) -> None:
        object.__setattr__(self, STATION, check_array(STATION, self.station, (3,)))
        object.__setattr__(self, "minimum", check_number("minimum", self.minimum, low=0, unit="m"))
        object.__setattr__(self, "maximum", float(self.maximum))
        if not self.minimum < self.maximum:
            raise InputError("tracker range", f"{self.minimum} to {self.maximum}", "minimum < maximum, in m")

    def margins(self, robot: Robot, posture: Posture) -> FloatArray:
        d = distances(np.asarray(self.station), posture.targets)
        beyond = [] if np.isinf(self.maximum) else [self.maximum - d]
        return np.concatenate([d - self.minimum, *beyond], axis=1)


@dataclass(frozen=True, eq=False)
class TrackerElevation(PostureConstraint):
    """The beam to every target leaves the station at an elevation ε the head can turn to: low ≤ ε ≤ high.

    Attributes:
        station: (3,) in the frame of positions [m].
        up: (3,) direction of the station's vertical axis, in the frame of positions.
        low, high: Angles above the horizontal, −π/2 … π/2 [rad].
    """

    station: ArrayLike
    up: ArrayLike = (0.0, 0.0, 1.0)
    low: float = -np.pi / 2
    high: float = np.pi / 2
    name: str = "tracker elevation"

    def __post_init__(self) -> None:
        object.__setattr__(self, STATION, check_array(STATION, self.station, (3,)))
        object.__setattr__(self, "up", check_direction("up", self.up))
        for key in ("low", "high"):
            angle = check_number(key, getattr(self, key), low=-np.pi / 2, high=np.pi / 2, unit="rad")
            object.__setattr__(self, key, angle)
        if not self.low < self.high:
            raise InputError("tracker elevation", f"{self.low} to {self.high}", "low < high, in rad")

    def margins(self, robot: Robot, posture: Posture) -> FloatArray:
        angle = elevations(np.asarray(self.station), np.asarray(self.up), posture.targets)
        return np.concatenate([angle - self.low, self.high - angle], axis=1)


@dataclass(frozen=True, eq=False)
class ReflectorAcceptance(PostureConstraint):
    """The beam falls into every reflector's cone.

    A reflector with normal n (tip frame) looks along R n, R the tip's rotation. It returns a beam that comes
    from within the half angle β₀ of that: (R n)·(s − p) ≥ cos β₀ · |s − p|. β₀ is about 30° for a corner cube,
    50–75° for a cat's eye.

    Attributes:
        station: (3,) s in the frame of positions [m].
        normal: (3,) for all targets, or (targets, 3), in the tip's frame; scaled to length 1.
        half_angle: β₀ in (0, π] [rad].
    """

    station: ArrayLike
    normal: ArrayLike
    half_angle: float = np.pi / 6
    name: str = "reflector acceptance"

    def __post_init__(self) -> None:
        object.__setattr__(self, STATION, check_array(STATION, self.station, (3,)))
        normals = check_direction("normal", np.atleast_2d(np.asarray(self.normal, float)), (None, 3))
        object.__setattr__(self, "normal", normals)
        angle = check_number("half_angle", self.half_angle, low=0, low_open=True, high=np.pi, unit="rad")
        object.__setattr__(self, "half_angle", angle)

    def margins(self, robot: Robot, posture: Posture) -> FloatArray:
        """N postures → (N, targets), of the cosine.

        Raises:
            InputError: Neither one normal nor one per target.
        """
        normals, targets = np.asarray(self.normal), len(robot.targets)
        if len(normals) not in (1, targets):
            raise InputError("normal", f"{len(normals)} normals", f"one, or {targets}: one per target")
        turned = normals @ posture.tip_rotation.transpose(0, 2, 1)
        cosines = incidence_cosines(np.asarray(self.station), posture.targets, turned)
        return cosines - np.cos(self.half_angle)


@dataclass(frozen=True, eq=False)
class LineOfSight(PostureConstraint):
    """The beam from the station to every target passes the robot's own links.

    The beam s–p has to keep the distance r_k from the axis of every capsule k of the body, where the body is the
    base column and the links up to the last joint. The flange behind the last joint carries the reflector and
    is left to ``ReflectorAcceptance``. A reflector close to the wrist lies within the capsule of the forearm
    whatever the configuration, so the last ``near`` metres of the beam are not looked at either.

    Attributes:
        station: (3,) s in the frame of positions [m].
        capsules: The body.
        near: Length of beam in front of the target that may be inside a capsule [m]; ``None`` for the largest
            radius of the body.
    """

    station: ArrayLike
    capsules: Capsules = field(default_factory=Capsules)
    near: float | None = None
    name: str = "line of sight"

    def __post_init__(self) -> None:
        object.__setattr__(self, STATION, check_array(STATION, self.station, (3,)))
        if self.near is not None:
            object.__setattr__(self, "near", check_number("near", self.near, low=0, unit="m"))

    def margins(self, robot: Robot, posture: Posture) -> FloatArray:
        station = np.asarray(self.station)
        radii = self.capsules.of(robot)[:-1]
        start, end = (points[:, None, :-1] for points in segments(robot, posture))
        near = float(radii.max()) if self.near is None else self.near
        ends = shortened(station, posture.targets, near)[:, :, None]
        clearance = segment_distances(np.broadcast_to(station, ends.shape), ends, start, end) - radii
        return clearance.reshape(len(clearance), clearance.shape[1] * clearance.shape[2])
