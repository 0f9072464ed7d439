# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Elasticity: the joints give way under the weight of the arm.

A mass at p_m that hangs on the links behind joint l turns that joint, with axis w_l through o_l, by a moment

    τ_lm(q) = (w_l × (p_m − o_l)) · d ,

d being the unit vector downwards; a sliding joint feels τ_lm = w_l · d. Moments are those of a unit weight:
metres of horizontal lever arm. A joint of compliance κ gives way by δ_l = κ τ, so that a point moves by

    Σ_lm c_l(q) τ_lm(q) u_lm ,        c_l = ∂p/∂q_l ,   u_lm ~ N(0, σ_g²)  [rad/m].

The coefficient u_lm holds compliance times weight. Where nothing is known of the links, unit masses stand at
elbow, wrist and tip. Where masses and centres of gravity are known, they are one mass (of weight one
altogether), and a payload is another: one coefficient per joint and mass. A payload has weight one when it
weighs what was stated, and m over that when it weighs m at a visit. The coefficients predict; lumped masses,
friction and play that depends on the moment are in them, so they are not compliances.

Beside known links a unit mass stays at the tip until a payload is stated: no file holds the flange's adapter
and the reflectors. By the left-out score of fitted rows of two measured robots with published masses, links and
tip are as good as unit masses at elbow, wrist and tip (IRB 120: 4 better; UR10, 100 and 30 rows of two series:
1.4 better to 0.5 worse, each within its standard error). Links alone are worse (6.5; 1.5 with 100 rows), and
links beside all three unit masses change nothing (0.2 worse; 0.0).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, IntArray, check_array, check_number, frozen
from calib_planner.error_model.poses import Poses
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.robot import Robot, lumped

MOUNTINGS = {"floor": (0.0, 0.0, -1.0), "ceiling": (0.0, 0.0, 1.0)}
"""Mounting → direction downwards in the frame of the robot's base. A wall needs a direction."""
PAYLOAD = "payload"
"""Name of the mass that may differ from visit to visit."""
LINKS = "links"
"""Name of the mass of all links, where they are known."""


@dataclass(frozen=True)
class Mass:
    """A part of a mass.

    Attributes:
        name: The mass it belongs to; parts of one name share their coefficients.
        joint: Number of the joint whose motion carries it; ``None``: fixed to the tip.
        xyz: Where it is in the frame of that joint's link, or of the tip [m].
        weight: Its share of the mass.
    """

    name: str
    joint: int | None = None
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    weight: float = 1.0


@dataclass(frozen=True)
class Payload:
    """What the robot carries beside itself.

    Attributes:
        mass: The mass that its coefficients stand for [kg].
        xyz: Its centre of gravity in the frame of the tip [m].
    """

    mass: float
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        mass = check_number("payload.mass", self.mass, low=0.0, low_open=True, unit="kg")
        x, y, z = (float(v) for v in check_array("payload.xyz", self.xyz, (3,), meaning="centre of gravity in m"))
        object.__setattr__(self, "mass", mass)
        object.__setattr__(self, "xyz", (x, y, z))


@dataclass(frozen=True)
class Gravity:
    """The elastic term.

    Attributes:
        masses: What hangs on the joints beside a payload; empty: unit masses at elbow, wrist and tip.
        mounting: ``floor``, ``ceiling``, or the direction downwards (3,) in the frame of the robot's base.
        payload: The payload; ``None``: nothing is known of one.
        vertical: The direction upwards (3,) in the frame of the points, which goes before the mounting; this
            follows from it when the base is identified (``placed``). ``None``: the mounting is as it says.
    """

    masses: tuple[Mass, ...] = ()
    mounting: str | tuple[float, float, float] = "floor"
    payload: Payload | None = None
    vertical: tuple[float, float, float] | None = None

    name: ClassVar[str] = "gravity"
    title: ClassVar[str] = "joints that give way under the weight of the arm"
    scales: ClassVar[tuple[str, ...]] = ("gravity",)

    def __post_init__(self) -> None:
        if any(mass.name == PAYLOAD for mass in self.masses):
            raise InputError("gravity.masses", PAYLOAD, "other names", "state it as the payload of the term")
        if isinstance(self.mounting, str):
            if self.mounting not in MOUNTINGS:
                raise UnknownNameError("mounting", self.mounting, [*MOUNTINGS, "a direction x, y, z"])
        else:
            object.__setattr__(self, "mounting", _direction("mounting", self.mounting, "downwards"))
        if self.vertical is not None:
            object.__setattr__(self, "vertical", _direction("vertical", self.vertical, "upwards"))

    @property
    def down(self) -> FloatArray:
        """(3,) unit vector downwards in the frame of the robot's base."""
        return np.array(MOUNTINGS[self.mounting] if isinstance(self.mounting, str) else self.mounting)

    def masses_of(self, robot: Robot) -> tuple[Mass, ...]:
        """The masses stated, or unit masses at elbow, wrist and tip of this robot; then the payload."""
        payload = () if self.payload is None else (Mass(PAYLOAD, None, self.payload.xyz),)
        if self.masses:
            return (*self.masses, *payload)
        count = len(robot.joint_names)
        joints = [j for j in dict.fromkeys(((count - 1) // 2, count - 2)) if 0 < j < count - 1]
        words = ["elbow", "wrist"] if len(joints) == 2 else ["middle"]
        return (*(Mass(w, j) for w, j in zip(words, joints, strict=False)), Mass("tip"), *payload)

    def with_payload(self, payload: Payload | None) -> Gravity:
        """The same with another payload, which goes before the unit mass at the tip that known links have."""
        known = any(mass.name == LINKS for mass in self.masses)
        rest = tuple(mass for mass in self.masses if not (known and mass.name == "tip"))
        tip = (Mass("tip"),) if known and payload is None else ()
        return replace(self, masses=(*rest, *tip), payload=payload)

    def placed(self, robot: Robot) -> Gravity:
        """With the mounting that follows from ``vertical`` for a robot whose base pose is known."""
        if self.vertical is None:
            return self
        return replace(self, mounting=downwards(robot, self.vertical), vertical=None)

    def names(self, robot: Robot) -> tuple[str, ...]:
        """K names ``gravity.<mass>.<joint>``, mass by mass, for the joints that carry it."""
        return tuple(f"gravity.{mass}.{robot.joint_names[j]}" for mass, j in self._pairs(robot))

    def size(self, robot: Robot) -> int:
        """K."""
        return len(self.joints(robot))

    def columns(self, poses: Poses) -> FloatArray:
        """(N, 3·targets, K) c_l τ_lm [m per rad/m]."""
        return np.asarray(poses.levers[:, :, self.joints(poses.robot)] * self.moments(poses)[:, None, :])

    def deflection(self, poses: Poses, coefficients: FloatArray) -> FloatArray:
        """(N, joints) δ for coefficients (K,), in units of ``joint_units``."""
        result = np.zeros(poses.q.shape)
        np.add.at(result.T, self.joints(poses.robot), (self.moments(poses) * coefficients).T)
        return result

    def variances(self, robot: Robot, values: dict[str, float]) -> FloatArray:
        """(K,) prior variance of each coefficient [rad²/m²]."""
        return np.full(self.size(robot), values["gravity"] ** 2)

    def gradients(self, robot: Robot, values: dict[str, float]) -> dict[str, FloatArray]:
        """Scale → (K,) derivative of ``variances`` by its logarithm."""
        return {"gravity": 2.0 * self.variances(robot, values)}

    def _pairs(self, robot: Robot) -> list[tuple[str, int]]:
        """(mass, joint) of every coefficient: the joints between the base and a part of the mass."""
        last: dict[str, int] = {}
        for part in self.masses_of(robot):
            at = len(robot.joint_names) - 1 if part.joint is None else part.joint
            last[part.name] = max(at, last.get(part.name, -1))
        return [(mass, j) for mass, end in last.items() for j in self._loaded(robot, end)]

    def _loaded(self, robot: Robot, end: int) -> list[int]:
        """The joints that a mass behind joint ``end`` loads: those before it, and those coupled to them."""
        if robot.coupling is None:
            return list(range(end + 1))
        return [int(j) for j in np.flatnonzero(np.abs(robot.coupling[: end + 1]).sum(axis=0) > 0.0)]

    def joints(self, robot: Robot) -> IntArray:
        """(K,) the joint of every coefficient."""
        return _carried(self, robot)[2][1]

    def moment_gradients(self, poses: Poses) -> FloatArray:
        """(N, K, joints) ∂τ/∂q [m/rad | m/m].

        A joint k in front of joint l turns its moment as a whole; one behind it moves the mass alone:

            ∂τ_lm/∂q_k = (w_k × (w_l × (p_m − o_l))) · d     for k ≤ l ,
                         (w_l × (w_k × (p_m − o_k))) · d     for k > l ,

        where both turn. A sliding k ≤ l carries joint and mass along and changes nothing, behind l it moves the
        mass by w_k; the force w_l · d along a sliding l changes as w_l is turned.
        """
        robot, arms = poses.robot, self._arms(poses)
        axes, sideways = self._axes(poses)
        turns, order = robot.joint_is_revolute, np.arange(len(robot.joint_names))
        lever = np.where(turns[:, None, None], _cross(axes, arms), axes)  # how the mass moves with joint k
        whole = (lever[:, :, None] * sideways[None, None]).sum(axis=3)  # lever_l · (d × w_k)
        alone = np.swapaxes(whole, 1, 2) * turns[:, None, None]
        in_front = order[None, :] <= order[:, None]  # k ≤ l, as [l, k]
        rate = np.where(in_front[..., None], whole * turns[:, None], alone)
        load = self._loads(poses)
        moved = (load != 0.0)[:, None] * rate * load[:, :, None]  # what a link carries no joint behind it moves
        if robot.coupling is not None:
            moved = np.einsum("jl,pjin,ik->plkn", robot.coupling, moved, robot.coupling)
        return np.ascontiguousarray(self._per_mass(robot, moved).transpose(2, 0, 1))

    def _axes(self, poses: Poses) -> tuple[FloatArray, FloatArray]:
        """w_l and d × w_l of every joint, (joints, 3, N) each; d is downwards. Kept with the poses."""
        axes, key = poses.posture.joint_axes.transpose(1, 2, 0), ("sideways", self)
        if key not in poses.cache:
            poses.cache[key] = _cross(self._down(poses.robot)[:, None], axes)
        return axes, poses.cache[key]

    def _down(self, robot: Robot) -> FloatArray:
        """(3,) d, unit vector downwards in the frame of the points."""
        return np.asarray(robot.base_pose[0] @ self.placed(robot).down)

    def _loads(self, poses: Poses) -> FloatArray:
        """(parts, joints, N or 1) weight of every part of a mass, at the joints that carry it."""
        load = _carried(self, poses.robot)[0]
        if poses.payload is None or self.payload is None:
            return load
        share = poses.payload / self.payload.mass
        loads = np.array([part.name == PAYLOAD for part in self.masses_of(poses.robot)])
        return np.asarray(load * np.where(loads[:, None, None], share, 1.0))

    def _per_mass(self, robot: Robot, parts: FloatArray) -> FloatArray:
        """(parts, joints, …, N) → (K, …, N): parts of a mass added up, at the joints that carry it."""
        _, mass_of, pairs = _carried(self, robot)
        if (count := mass_of.max() + 1) < len(mass_of):
            sums = np.zeros((count, *parts.shape[1:]))
            np.add.at(sums, mass_of, parts)
            parts = sums
        return np.asarray(parts[pairs])

    def _arms(self, poses: Poses) -> FloatArray:
        """(parts, joints, 3, N) from every joint to every part of a mass [m]; kept with the poses."""
        key = ("arms", self)
        if key not in poses.cache:
            origins = poses.posture.joint_origins.transpose(1, 2, 0)
            parts = self.masses_of(poses.robot)
            points = [poses.robot.link_points(poses.q, part.joint, part.xyz).T for part in parts]
            poses.cache[key] = np.stack(points)[:, None] - origins
        return poses.cache[key]

    def moments(self, poses: Poses) -> FloatArray:
        """(N, K) τ [m], or the force along a sliding joint, of a unit weight; kept with the poses."""
        key = ("moments", self)
        if key not in poses.cache:
            poses.cache[key] = self._moments(poses)
        return poses.cache[key]

    def _moments(self, poses: Poses) -> FloatArray:
        robot, (axes, sideways) = poses.robot, self._axes(poses)
        turning = (self._arms(poses) * sideways).sum(axis=2)  # (w × arm) · d = arm · (d × w)
        pull = np.einsum("x,lxn->ln", self._down(robot), axes)
        felt = np.where(robot.joint_is_revolute[:, None], turning, pull) * self._loads(poses)
        if robot.coupling is not None:
            felt = np.einsum("jl,pjn->pln", robot.coupling, felt)
        return np.ascontiguousarray(self._per_mass(robot, felt).T)


@lru_cache(maxsize=64)
def _carried(gravity: Gravity, robot: Robot) -> tuple[FloatArray, IntArray, tuple[IntArray, IntArray]]:
    """Weights (parts, joints, 1) at the joints that carry them, the number of each part's mass in the order of
    the coefficients, and (mass, joint) of every coefficient."""
    parts, pairs = gravity.masses_of(robot), gravity._pairs(robot)
    joints, names = np.arange(len(robot.joint_names)), list(dict.fromkeys(part.name for part in parts))
    rows = [part.weight * (joints <= (len(joints) if part.joint is None else part.joint)) for part in parts]
    mass_of = np.array([names.index(part.name) for part in parts], np.int64)
    chosen = np.array([[names.index(mass), joint] for mass, joint in pairs], np.int64).T
    return frozen(np.array(rows, float)[:, :, None]), mass_of, (chosen[0], chosen[1])


def _cross(u: FloatArray, v: FloatArray) -> FloatArray:
    """Cross product over the axis before the last; the other axes broadcast."""
    x = u[..., 1, :] * v[..., 2, :] - u[..., 2, :] * v[..., 1, :]
    result: FloatArray = np.empty((*x.shape[:-1], 3, x.shape[-1]))
    result[..., 0, :] = x
    np.subtract(u[..., 2, :] * v[..., 0, :], u[..., 0, :] * v[..., 2, :], out=result[..., 1, :])
    np.subtract(u[..., 0, :] * v[..., 1, :], u[..., 1, :] * v[..., 0, :], out=result[..., 2, :])
    return result


def gravity_of(robot: Robot) -> Gravity:
    """The elastic term with what the robot's file says of its links, where that can be believed."""
    if robot.mass_fault:
        return Gravity()
    parts = lumped(robot.link_masses)
    total = sum(part.mass for part in parts)
    links = (Mass(LINKS, part.joint, part.xyz, part.mass / total) for part in parts)
    return Gravity((*links, Mass("tip")))


def downwards(robot: Robot, up: ArrayLike) -> tuple[float, float, float]:
    """The mounting of a robot whose base pose is known, from the vertical ``up`` (3,) of the tracker's frame."""
    x, y, z = -robot.base_pose[0].T @ check_array("up", up, (3,))
    return float(x), float(y), float(z)


def _direction(field: str, given: ArrayLike, way: str) -> tuple[float, float, float]:
    """A unit vector."""
    clean = check_array(field, given, (3,), meaning=f"the direction {way}")
    length = float(np.linalg.norm(clean))
    if not length > 0.0:
        raise InputError(field, "0, 0, 0", f"a direction {way}")
    x, y, z = (float(v) for v in (clean if abs(length - 1.0) < 1e-12 else clean / length))
    return x, y, z
