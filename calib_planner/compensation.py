# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Corrected joint targets, for a controller that cannot change its model.

The controller believes in the nominal robot: at joint angles q it takes the tool to be at the pose T_nom(q). The
real, calibrated robot has it at T_cal(q). ``compensate`` finds angles q′ near q with

    T_cal(q′) = T_nom(q),

so that a controller told q′ has the real tool where the plan, made with the nominal model, says. If the joints
turn by φ(q) beyond what they read, the computed angles are those they must be at, and q′ is what they must read.
Both poses are in the robot's own base frame: where the base stands before the tracker plays no part. The pose is
that of the tip's frame; ``position_only`` asks for one point only (a target: where it is on the nominal robot,
and where it is on the calibrated one). That is the right question if the orientation does not
matter, if the robot has fewer than six joints, or if the orientation of the calibrated tip is not known: a single
reflector says where a point of the tool is, never how the tool is turned about it.

How accurate that is no solver can say: its residual is rounding. What is expected at a target is the uncertainty
of what is known, (M3), what the correction leaves out (gravity and joint functions, if placement alone is
corrected), the repeatability of the robot, and the distance that remains where a target cannot be reached:

    e² = accuracy² + left out² + repeatability² + remaining²     at the reflectors, root mean square.

The base stands where the user registers it, so that accuracy is up to a rigid motion of all targets; for fewer
than four, or for targets in a plane, it is in the frame of the points.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_planner.arrays import FloatArray, check_configurations, check_number, frozen
from calib_planner.error_model import Knowledge, without_rigid_motion
from calib_planner.errors import InputError
from calib_planner.robot import Goals, Robot, goals_of, residuals, solve

POSITION_TOLERANCE = 1e-9
"""A remaining position error [m] up to which a target counts as reached."""

ROTATION_TOLERANCE = 1e-9
"""A remaining rotation error [rad] up to which a target counts as reached."""

FAR = 0.1
"""A correction [rad | m] beyond which a row is called far."""

LEVER = 0.5
"""What a radian counts beside a metre where not both can be had [m]."""

STATUS = {
    "reached": "The corrected target puts the real tool where the nominal model says.",
    "far": "Reached, but a joint moves by more than 0.1 rad or m: near a singular posture. Check the way there.",
    "at_limit": "A joint limit is in the way; this is the closest within the limits, with the error given.",
    "closest": "No configuration nearby reaches it; this is the closest, with the error given. For a point, or a "
    "robot with fewer than six joints, ask for the position only.",
    "outside_limits": "The nominal target lies outside the joint limits; the correction goes no further out.",
}
"""Every status a row can have, with advice."""


@dataclass(frozen=True, eq=False)
class Compensation:
    """Corrected joint targets.

    Attributes:
        joint_names: Order of joint arrays.
        targets: (N, joints) the nominal targets q [rad | m].
        corrected: (N, joints) what to tell the controller, q′ [rad | m].
        position_error: (N,) distance that remains, calibrated at q′ from nominal at q [m].
        rotation_error: (N,) angle that remains [rad]; NaN where only the position counts.
        position_error_before: (N,) the same without correction, calibrated at q [m].
        rotation_error_before: (N,) the same without correction [rad].
        status: N keys of ``STATUS``.
        expected_error: (N,) root mean square error of the reflectors that is to be expected [m]; NaN where nobody
            knows.
        accuracy_frame: ``robot`` or ``world``: what that error is up to; empty where nobody knows it.
    """

    joint_names: tuple[str, ...]
    targets: FloatArray
    corrected: FloatArray
    position_error: FloatArray
    rotation_error: FloatArray
    position_error_before: FloatArray
    rotation_error_before: FloatArray
    status: tuple[str, ...]
    expected_error: FloatArray
    accuracy_frame: str

    @property
    def reached(self) -> NDArray[np.bool_]:
        """(N,) whether the remaining errors are within the tolerances."""
        return _reached(self.position_error, self.rotation_error)

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers, [m] and [rad]."""
        return {
            "joint_names": list(self.joint_names),
            "targets": self.targets.tolist(),
            "corrected": self.corrected.tolist(),
            "position_error": self.position_error.tolist(),
            "rotation_error": _or_none(self.rotation_error),
            "position_error_before": self.position_error_before.tolist(),
            "rotation_error_before": _or_none(self.rotation_error_before),
            "status": list(self.status),
            "expected_error": _or_none(self.expected_error),
            "accuracy_frame": self.accuracy_frame or None,
            "reached": int(self.reached.sum()),
        }


def compensate(
    nominal: Robot,
    calibrated: Robot,
    targets: ArrayLike,
    *,
    position_only: bool = False,
    target: int = 0,
    limits: bool = True,
    lever: float = LEVER,
    corrections: Knowledge | None = None,
    known: Knowledge | None = None,
) -> Compensation:
    """Correct joint targets for the difference between the two robots.

    Args:
        nominal: The controller's model.
        calibrated: The real robot, e.g. ``Estimate.calibrated``; the same joints.
        targets: (N, joints) nominal joint targets in the order of ``joint_names`` [rad | m].
        position_only: Match one point instead of the tip's pose: the target of number ``target``.
        target: Number of that target, from 0.
        limits: Stay within the nominal robot's joint limits. A joint with limits of exactly ±π is
            taken for a continuous one, without any.
        lever: What a radian counts beside a metre where not both can be had [m].
        corrections: What the joints do beyond what they read, as learnt together with ``calibrated``.
        known: What the expected error rests on: ``corrections`` unless they are left out on purpose.

    Raises:
        InputError: Other joints, wrong shape, no such target, or a lever that is not positive.
    """
    if calibrated.joint_names != nominal.joint_names:
        raise InputError(
            "calibrated", ", ".join(calibrated.joint_names), f"joints {', '.join(nominal.joint_names)}"
        )
    check_number("lever", lever, low=1e-6, high=1e6)
    q = check_configurations("targets", targets, nominal.joint_names)
    here, there = _point(nominal, position_only, target), _point(calibrated, position_only, target)
    nominal, calibrated = _unplaced(nominal), _unplaced(calibrated)
    goals = replace(goals_of(nominal, q, here, position_only, lever), point=there)
    low, high = _bounds(nominal, q, limits)
    corrected = solve(calibrated, goals, q, low, high)
    actual, uncorrected = corrected, q
    if corrections is not None:
        corrected = np.clip(corrections.reading(corrected), low, high)
        actual, uncorrected = corrections.actual(corrected), corrections.actual(q)
    after, before = _errors(calibrated, goals, actual), _errors(calibrated, goals, uncorrected)
    known = corrections if known is None else known
    expected: FloatArray = np.full(len(q), np.nan)
    frame = ""
    if known is not None:
        left_out = None if corrections is not None else calibrated
        expected, frame = _expected(known, corrected, after[0], left_out)
    return Compensation(
        joint_names=nominal.joint_names,
        targets=q,
        corrected=frozen(corrected),
        position_error=after[0],
        rotation_error=after[1],
        position_error_before=before[0],
        rotation_error_before=before[1],
        status=_status(nominal, q, corrected, after, (low, high), limits),
        expected_error=frozen(expected),
        accuracy_frame=frame,
    )


def _expected(
    known: Knowledge, q: FloatArray, remaining: FloatArray, alone: Robot | None
) -> tuple[FloatArray, str]:
    """(N,) expected error e at readings ``q`` (N, joints) [m], and the frame of the accuracy in it.

    Args:
        known: What is known of the robot.
        q: (N, joints) what the joints read.
        remaining: (N,) distance that the correction leaves [m].
        alone: The robot, in its own base frame, that was corrected instead of ``known``.
    """
    accuracy = known.accuracy(q)
    with suppress(InputError):  # too few, or in a plane
        accuracy = known.accuracy(q, "robot")
    spread = np.trace(known.predict(q).repeatability, axis1=2, axis2=3).mean(axis=1)
    left_out = np.zeros(len(q))
    if alone is not None:
        there = _unplaced(known.placed).positions(known.actual(q))
        same = alone.with_targets(known.placed.target_offsets).positions(q)
        apart = there - same
        if accuracy.kind == "robot":
            apart = without_rigid_motion(there, apart.reshape(-1, 1)).reshape(there.shape)
        left_out = np.sum(apart**2, axis=2).mean(axis=1)
    return np.sqrt(accuracy.per_pose**2 + spread + left_out + remaining**2), accuracy.kind


def _point(robot: Robot, position_only: bool, target: int) -> FloatArray:
    if not position_only:
        return np.zeros(3)
    count = len(robot.targets)
    if not 0 <= target < count:
        raise InputError("target", target, f"a number from 0 to {count - 1}", "the robot has no such target")
    return robot.target_offsets[target]


def _unplaced(robot: Robot) -> Robot:
    """The robot in its own base frame."""
    return robot.with_base(np.eye(3), np.zeros(3))


def _bounds(robot: Robot, q: FloatArray, limits: bool) -> tuple[FloatArray, FloatArray]:
    """(N, joints) lower and upper; a target beyond a limit widens it, as the controller took it."""
    low, high = robot.joint_limits.T
    endless = robot.joint_is_revolute & (low == -np.pi) & (high == np.pi)
    if not limits:
        endless = np.ones_like(endless)
    low, high = np.where(endless, -np.inf, low), np.where(endless, np.inf, high)
    return np.minimum(low, q), np.maximum(high, q)


def _errors(robot: Robot, goals: Goals, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N,) distances [m] and angles [rad], the latter NaN where any will do."""
    r = residuals(robot, goals, q)
    angle = np.full(len(q), np.nan) if goals.rotation is None else np.linalg.norm(r[:, 3:], axis=1) / goals.lever
    return frozen(np.linalg.norm(r[:, :3], axis=1)), frozen(angle)


def _status(
    robot: Robot,
    q: FloatArray,
    corrected: FloatArray,
    errors: tuple[FloatArray, FloatArray],
    bounds: tuple[FloatArray, FloatArray],
    limits: bool,
) -> tuple[str, ...]:
    low, high = robot.joint_limits.T
    outside = limits & (np.isfinite(bounds[0]) & ((q < low) | (q > high))).any(axis=1)
    reached = _reached(*errors)
    at_bound = ((corrected <= bounds[0]) | (corrected >= bounds[1])).any(axis=1)
    far = np.abs(corrected - q).max(axis=1) > FAR
    cases = [outside, reached & far, reached, at_bound]
    return tuple(np.select(cases, ["outside_limits", "far", "reached", "at_limit"], "closest").tolist())


def _reached(position_error: FloatArray, rotation_error: FloatArray) -> NDArray[np.bool_]:
    return (position_error <= POSITION_TOLERANCE) & (np.nan_to_num(rotation_error) <= ROTATION_TOLERANCE)


def _or_none(values: FloatArray) -> list[float | None]:
    return [None if np.isnan(v) else v for v in values.tolist()]
