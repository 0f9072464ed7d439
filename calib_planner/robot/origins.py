# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot's calibration as the poses of its joints: what URDF and kinematics files can say.

A robot from a URDF has, for every joint, ``P · A · R(q + δ) · A⁻¹``: its origin P with placement errors, the
turn A to an oblique axis, and the motion with offset δ. The offset commutes with the motion, so

    P · A R(q + δ) A⁻¹ = P' · A R(q) A⁻¹     with  P' = P · A R(δ) A⁻¹,

also for a sliding joint: the origin P' holds the whole calibration, and the joint coordinate stays what
the controller calls it. What stands between (fixed joints) carries no parameters and stays.

Any other chain (robot YAML) is cut after each motion: P' is all that stands between two motions, and what
follows the last one is the pose of the tip. The base's pose in the tracker's frame and the targets are no
part of the robot and belong to no origin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_planner.arrays import FloatArray, check_array, frozen
from calib_planner.errors import InputError
from calib_planner.robot.chain import Robot
from calib_planner.robot.elements import Element, pose_elements, roll_pitch_yaw, rotation

BASE_COUNT = 9
"""Elements of the base pose, which every chain begins with."""

POSE_KINDS = ("Tx", "Ty", "Tz", "Rz", "Ry", "Rx", "Rx", "Ry", "Rz")
"""What ``pose_elements`` makes."""


@dataclass(frozen=True, eq=False)
class Origin:
    """A pose: ``xyz`` (3,) [m] and ``rpy`` (3,) [rad] as in URDF, Rz(yaw) Ry(pitch) Rx(roll)."""

    xyz: FloatArray
    rpy: FloatArray

    def __post_init__(self) -> None:
        for name in ("xyz", "rpy"):
            value = check_array(name, getattr(self, name), (3,))
            object.__setattr__(self, name, frozen(value + 0.0))  # no -0.0


@dataclass(frozen=True, eq=False)
class JointOrigins:
    """Poses of all joints of a robot.

    Attributes:
        joints: Joint name → pose of its frame at coordinate zero, in chain order: in the frame of the
            parent link (robots from a URDF), or in the frame after the motion of the joint before.
        axes: Joint name → (3,) unit direction in which its coordinate grows, in its own frame.
        tip: Pose of the tip after the last motion; ``None`` for robots from a URDF, where fixed joints say it.
    """

    joints: Mapping[str, Origin]
    axes: Mapping[str, FloatArray]
    tip: Origin | None


@dataclass(frozen=True)
class _Span:
    """Elements [first, motion] of one joint; those of [turn, motion) turn to an oblique axis."""

    name: str
    first: int
    turn: int
    motion: int


def joint_origins(robot: Robot) -> JointOrigins:
    """The poses of the robot's joints, offsets folded in; exact to rounding."""
    spans, end = _spans(robot)
    return JointOrigins(
        joints={s.name: _origin(robot.elements, s) for s in spans},
        axes={s.name: _axis(robot.elements, s) for s in spans},
        tip=None if end is None else _as_origin(*pose_of(robot.elements[end:])),
    )


def with_origins(robot: Robot, origins: Mapping[str, Origin], tip: Origin | None = None) -> Robot:
    """The robot with its joints at these poses, offsets and placement errors at zero.

    Args:
        robot: Gives joints, axes, limits, what is fixed, base and targets.
        origins: Joint name → pose, for every joint.
        tip: Pose of the tip, for robots that are not from a URDF; theirs if ``None``.

    Raises:
        InputError: Not exactly the robot's joints, or a tip for a robot from a URDF.
    """
    if set(origins) != set(robot.joint_names):
        raise InputError("origins", ", ".join(origins), f"the joints {', '.join(robot.joint_names)}")
    spans, end = _spans(robot)
    if tip is not None and end is None:
        raise InputError("tip", "a pose", "none: fixed joints place the tip of a robot from a URDF")
    elements = list(robot.elements[:BASE_COUNT])
    done = BASE_COUNT
    for span in spans:
        pose = origins[span.name]
        elements += robot.elements[done : span.first]
        elements += pose_elements(span.name, pose.xyz, pose.rpy)
        elements += robot.elements[span.turn : span.motion]
        elements.append(replace(robot.elements[span.motion], value=0.0))
        done = span.motion + 1
    if tip is None:
        elements += robot.elements[done:]
    else:
        elements += [Element(e.kind, e.value) for e in pose_elements("", tip.xyz, tip.rpy)]
    return _rebuilt(robot, tuple(elements))


def not_in_origins(robot: Robot) -> tuple[str, ...]:
    """Parameters that are not zero and that no origin holds: the base's pose and the targets' places.

    Rotations of the base are named together where its orientation is not the identity.
    """
    base = robot.elements[:BASE_COUNT]
    names = [str(e.parameter) for e in base[:3] if e.value]
    if any(e.value for e in base[3:]):
        names += [str(e.parameter) for e in base[6:]]
    return (*names, *(str(e.parameter) for branch in robot.targets for e in branch if e.value))


# ── inside ───────────────────────────────────────────────────────────────────────────────────────────


def _spans(robot: Robot) -> tuple[list[_Span], int | None]:
    """The joints in chain order, and where the tip begins (``None`` in the form of URDF)."""
    motions = [i for i, e in enumerate(robot.elements) if e.joint is not None]
    spans, done = [], BASE_COUNT
    for motion in motions:
        span = _urdf_span(robot, done, motion)
        if span is None:
            return _general_spans(robot, motions)
        spans.append(span)
        done = motion + 1
    loose = [e for e in robot.elements[done:] if e.parameter]
    return _general_spans(robot, motions) if loose else (spans, None)


def _urdf_span(robot: Robot, start: int, motion: int) -> _Span | None:
    """The joint that moves at ``motion``, if it is fixed parts, a pose and perhaps a turn from ``start``."""
    name = _joint_name(robot, motion)
    between = robot.elements[start:motion]
    first = next((i for i, e in enumerate(between, start) if e.parameter == f"{name}.x"), None)
    if first is None:
        return None
    turn = first + len(POSE_KINDS)
    kinds = tuple(e.kind for e in robot.elements[first:turn])
    fixed = (*robot.elements[start:first], *robot.elements[turn:motion])
    turns_only = all(e.is_rotation for e in robot.elements[turn:motion])
    if kinds != POSE_KINDS or turn > motion or any(e.parameter for e in fixed) or not turns_only:
        return None
    return _Span(name, first, turn, motion)


def _general_spans(robot: Robot, motions: Sequence[int]) -> tuple[list[_Span], int]:
    starts = [BASE_COUNT, *(m + 1 for m in motions)]
    spans = [_Span(_joint_name(robot, m), s, m, m) for s, m in zip(starts, motions, strict=False)]
    return spans, starts[-1]


def _joint_name(robot: Robot, motion: int) -> str:
    joint = robot.elements[motion].joint
    assert joint is not None
    return robot.joint_names[joint]


def _origin(elements: Sequence[Element], span: _Span) -> Origin:
    pose, motion = elements[span.first : span.turn], elements[span.motion]
    turn, _ = pose_of(elements[span.turn : span.motion])
    moved, shift = pose_of((replace(motion, joint=None),))
    r, p = pose_of(pose)
    xyz: FloatArray = p + r @ turn @ shift
    rpy = roll_pitch_yaw(r @ turn @ moved @ turn.T)
    if tuple(e.kind for e in pose) == POSE_KINDS:  # numbers that stay, stay to the bit
        xyz = xyz if shift.any() else p
        turned = any(e.value for e in pose[6:]) or (motion.is_rotation and motion.value)
        rpy = rpy if turned else frozen(np.array([e.value for e in pose[5:2:-1]]))
    return Origin(xyz, rpy)


def _axis(elements: Sequence[Element], span: _Span) -> FloatArray:
    turn, _ = pose_of(elements[span.turn : span.motion])
    motion = elements[span.motion]
    return frozen(motion.sign * turn[:, motion.axis] + 0.0)


def pose_of(elements: Sequence[Element]) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and position (3,) [m] after these elements, joints at zero."""
    r: FloatArray = np.eye(3)
    p: FloatArray = np.zeros(3)
    for e in elements:
        amount = e.sign * e.value
        if e.is_rotation:
            r = r @ rotation(e.axis, amount)
        else:
            p = p + r[:, e.axis] * amount
    return r, p


def _as_origin(r: FloatArray, p: FloatArray) -> Origin:
    return Origin(p, roll_pitch_yaw(r))


def _rebuilt(robot: Robot, elements: tuple[Element, ...]) -> Robot:
    """The robot with other elements, its parameters and levels as far as they are still there."""
    there = {e.parameter for e in elements} | {e.parameter for b in robot.targets for e in b}
    levels = {k: tuple(n for n in names if n in there) for k, names in robot.levels.items()}
    return replace(
        robot,
        elements=elements,
        levels={k: names for k, names in levels.items() if names},
        parameter_names=tuple(n for n in robot.parameter_names if n in there),
    )
