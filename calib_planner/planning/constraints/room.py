# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the robot may be: a box, a floor, narrower joint limits, and whatever the user's function says.

Conditions on the robot's posture share one pass of kinematics, however many they are (``PostureConstraint``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_planner.arrays import FloatArray, check_array, check_number, frozen
from calib_planner.errors import InfeasibleError, InputError, UnknownNameError
from calib_planner.robot import Capsules, Posture, Robot
from calib_planner.tracker import check_direction


class PostureConstraint:
    """A condition on where joints, tip and targets are; children define ``margins``."""

    def allowed(self, robot: Robot, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) [rad | m] → (N,) bool."""
        return self.holds(robot, robot.posture(q))

    def holds(self, robot: Robot, posture: Posture) -> NDArray[np.bool_]:
        """N postures of ``robot`` → (N,) bool."""
        return np.asarray((self.margins(robot, posture) >= 0).all(axis=1))

    def margins(self, robot: Robot, posture: Posture) -> FloatArray:
        """(N, K) by how much N postures of ``robot`` keep each of K inequalities; negative where they do not.

        In the unit of the inequality, finite and smooth up to isolated kinks: the search follows the gradients.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class WorkspaceBox(PostureConstraint):
    """Every target p is in a box with axes along the frame's: low ≤ p ≤ high, coordinate by coordinate.

    Attributes:
        low, high: (3,) corners in the frame of positions [m]; ±inf leaves a side open.
        tip: Whether the tip's origin has to be inside as well.
    """

    low: ArrayLike
    high: ArrayLike
    tip: bool = False
    name: str = "workspace box"

    def __post_init__(self) -> None:
        low, high = (check_array(k, getattr(self, k), (3,), finite=False) for k in ("low", "high"))
        if not (low < high).all():
            raise InputError("workspace box", f"{low.tolist()} to {high.tolist()}", "low < high on every axis")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def margins(self, robot: Robot, posture: Posture) -> FloatArray:
        points = posture.targets
        if self.tip:
            points = np.concatenate([points, posture.tip_origin[:, None]], axis=1)
        low, high = np.asarray(self.low), np.asarray(self.high)
        below, above = np.isfinite(low), np.isfinite(high)
        both = np.concatenate([points[..., below] - low[below], high[above] - points[..., above]], axis=2)
        return both.reshape(len(both), both.shape[1] * both.shape[2])


@dataclass(frozen=True, eq=False)
class MinimumHeight(PostureConstraint):
    """Everything that moves stays above a floor.

    With u the unit vector up, h(x) = x·u is linear, so that over a segment it is least at an end: a capsule of
    radius r is above the height h₀ when both ends x have h(x) − r ≥ h₀. Looked at are the targets (r = 0) and
    the capsules behind joint 1, that is the origins of joints 2, 3, … and the tip, each with the larger radius
    of the two capsules that meet there. The base column and joint 1 stand where they stand; if joint 1
    slides, its origin counts too.

    Attributes:
        height: h₀, along ``up`` from the origin of the frame of positions [m].
        up: (3,) direction, in the frame of positions.
        capsules: The body's radii; ``None`` takes the bare origins, r = 0.
    """

    height: float
    up: ArrayLike = (0.0, 0.0, 1.0)
    capsules: Capsules | None = None
    name: str = "minimum height"

    def __post_init__(self) -> None:
        object.__setattr__(self, "height", check_number("height", self.height, unit="m"))
        object.__setattr__(self, "up", check_direction("up", self.up))

    def margins(self, robot: Robot, posture: Posture) -> FloatArray:
        up = np.asarray(self.up)
        origins = np.concatenate([posture.joint_origins, posture.tip_origin[:, None]], axis=1)
        heights = origins @ up
        if self.capsules is not None:
            radii = np.concatenate([[0.0], self.capsules.of(robot)[1:], [0.0]])
            heights -= np.maximum(radii[1:], radii[:-1])
        first = 1 if robot.joint_is_revolute[0] else 0
        return np.concatenate([heights[:, first:], posture.targets @ up], axis=1) - self.height


@dataclass(frozen=True, eq=False)
class JointRange:
    """Joint limits narrower than the robot's: low_j ≤ q_j ≤ high_j for the joints named.

    Unlike narrowing the robot itself, this is about measuring only: test poses may lie outside. ``Feasibility``
    and the search take it as limits, so that it costs nothing however narrow it is.

    Attributes:
        ranges: Joint name → (low, high) [rad | m].
    """

    ranges: Mapping[str, ArrayLike] = field(default_factory=dict)
    name: str = "joint range"

    def __post_init__(self) -> None:
        clean = {}
        for joint, pair in dict(self.ranges).items():
            low, high = check_array(f"range of {joint}", pair, (2,))
            if not low < high:
                raise InputError(f"range of {joint}", f"[{low:g}, {high:g}]", "low < high, in rad or m")
            clean[str(joint)] = (float(low), float(high))
        object.__setattr__(self, "ranges", clean)

    def limits(self, robot: Robot) -> FloatArray:
        """(joints, 2) the robot's limits cut down to the ranges [rad | m].

        Raises:
            UnknownNameError: A joint that the robot does not have.
            InfeasibleError: A range outside the robot's limits.
        """
        limits = np.array(robot.joint_limits)
        for joint, pair in self.ranges.items():
            if joint not in robot.joint_names:
                raise UnknownNameError("joint range", joint, robot.joint_names)
            row = robot.joint_names.index(joint)
            low, high = np.asarray(pair)
            own = limits[row].copy()
            limits[row] = max(own[0], low), min(own[1], high)
            if not limits[row, 0] < limits[row, 1]:
                text = f"{joint} within [{low:g}, {high:g}] is outside the robot's [{own[0]:g}, {own[1]:g}]"
                raise InfeasibleError(self.name, f"{text} rad or m; check units (degrees?)")
        return limits

    def allowed(self, robot: Robot, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) → (N,)."""
        low, high = self.limits(robot).T
        return np.asarray(((low <= q) & (q <= high)).all(axis=1))


@dataclass(frozen=True)
class MotionLimits:
    """Limits of the joints' own motions, where a controller shows some joints against others.

    The box of what is shown encloses them and is wider; ``Feasibility`` adds this by itself.
    """

    name: str = "joint limits behind the coupling"

    def allowed(self, robot: Robot, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) → (N,)."""
        return np.asarray(~robot.beyond_limits(q).any(axis=1))


@dataclass(frozen=True, eq=False)
class Custom:
    """The user's own condition.

    Attributes:
        name: How messages call it.
        function: q (N, joints) [rad | m], read-only → (N,) bool. For an executor of processes it has to be
            importable: a function of a module, no lambda.
    """

    name: str
    function: Callable[[FloatArray], NDArray[np.bool_]]

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise InputError(f"constraint {self.name}", type(self.function).__name__, "a function of q")

    def allowed(self, robot: Robot, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) → (N,).

        Raises:
            InputError: The function failed, or returned something else.
        """
        where, wanted = f"constraint {self.name!r}", f"a boolean array of shape ({len(q)},)"
        try:
            answer = np.asarray(self.function(frozen(q)))
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise InputError(where, reason, wanted, "correct the function") from error
        if answer.shape != (len(q),) or answer.dtype != np.bool_:
            got = f"{answer.dtype} of shape {answer.shape}"
            raise InputError(where, got, wanted, "one True or False per configuration")
        return answer
