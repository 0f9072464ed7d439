"""Elasticity: the joints give way under the weight of the arm.

A mass at p_m that hangs on the links behind joint l turns that joint, with axis w_l through o_l, by a moment

    τ_lm(q) = (w_l × (p_m − o_l)) · d ,

d being the unit vector downwards; a sliding joint feels τ_lm = w_l · d. Moments are those of a unit weight:
metres of horizontal lever arm. A joint of compliance κ gives way by δ_l = κ τ, so that a point moves by

    Σ_lm c_l(q) τ_lm(q) u_lm ,        c_l = ∂p/∂q_l ,   u_lm ~ N(0, σ_g²)  [rad/m].

The coefficient u_lm holds compliance times weight. Where nothing is known of the links, unit masses stand at
elbow, wrist and tip. Where masses and centres of gravity are known, they are one mass (of weight one altogether),
and a payload is another: one coefficient per joint and mass. The coefficients predict; lumped masses, friction
and play that depends on the moment are in them, so they are not compliances.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_array
from calib_planner.error_model.poses import Poses
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.robot import Element, Robot, target_elements

MOUNTINGS = {"floor": (0.0, 0.0, -1.0), "ceiling": (0.0, 0.0, 1.0)}
"""Mounting → direction downwards in the frame of the robot's base. A wall needs a direction."""
PAYLOAD = "payload"
"""The mass that may differ from visit to visit."""


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
class Gravity:
    """The elastic term.

    Attributes:
        masses: What hangs on the joints; empty: unit masses at elbow, wrist and tip.
        mounting: ``floor``, ``ceiling``, or the direction downwards (3,) in the frame of the robot's base.
    """

    masses: tuple[Mass, ...] = ()
    mounting: str | tuple[float, float, float] = "floor"

    name: ClassVar[str] = "gravity"
    title: ClassVar[str] = "joints that give way under the weight of the arm"
    scales: ClassVar[tuple[str, ...]] = ("gravity",)

    def __post_init__(self) -> None:
        if isinstance(self.mounting, str):
            if self.mounting not in MOUNTINGS:
                raise UnknownNameError("mounting", self.mounting, [*MOUNTINGS, "a direction x, y, z"])
            return
        down = check_array("mounting", self.mounting, (3,), meaning="the direction downwards")
        length = float(np.linalg.norm(down))
        if not length > 0.0:
            raise InputError("mounting", "0, 0, 0", "a direction downwards")
        x, y, z = (float(v) for v in down / length)
        object.__setattr__(self, "mounting", (x, y, z))

    @property
    def down(self) -> FloatArray:
        """(3,) unit vector downwards in the frame of the robot's base."""
        return np.array(MOUNTINGS[self.mounting] if isinstance(self.mounting, str) else self.mounting)

    def masses_of(self, robot: Robot) -> tuple[Mass, ...]:
        """The masses stated, or unit masses at elbow, wrist and tip of this robot."""
        if self.masses:
            return self.masses
        count = len(robot.joint_names)
        joints = [j for j in dict.fromkeys(((count - 1) // 2, count - 2)) if 0 < j < count - 1]
        words = ["elbow", "wrist"] if len(joints) == 2 else ["middle"]
        return (*(Mass(w, j) for w, j in zip(words, joints, strict=False)), Mass("tip"))

    def names(self, robot: Robot) -> tuple[str, ...]:
        """K names ``gravity.<mass>.<joint>``, mass by mass, for the joints that carry it."""
        return tuple(f"gravity.{mass}.{robot.joint_names[j]}" for mass, j in self._pairs(robot))

    def size(self, robot: Robot) -> int:
        """K."""
        return len(self._pairs(robot))

    def columns(self, poses: Poses) -> FloatArray:
        """(N, 3·targets, K) c_l τ_lm [m per rad/m]."""
        joints = [j for _, j in self._pairs(poses.robot)]
        return np.asarray(poses.levers[:, :, joints] * self._moments(poses)[:, None, :])

    def deflection(self, poses: Poses, coefficients: FloatArray) -> FloatArray:
        """(N, joints) δ for coefficients (K,), in units of ``joint_units``."""
        result = np.zeros(poses.q.shape)
        joints = np.array([j for _, j in self._pairs(poses.robot)], int)
        np.add.at(result.T, joints, (self._moments(poses) * coefficients).T)
        return result

    def variances(self, robot: Robot, values: dict[str, float]) -> FloatArray:
        """(K,) prior variance of each coefficient [rad²/m²]."""
        return np.full(len(self._pairs(robot)), values["gravity"] ** 2)

    def gradients(self, robot: Robot, values: dict[str, float]) -> dict[str, FloatArray]:
        """Scale → (K,) derivative of ``variances`` by its logarithm."""
        return {"gravity": 2.0 * self.variances(robot, values)}

    def _pairs(self, robot: Robot) -> list[tuple[str, int]]:
        """(mass, joint) of every coefficient: the joints between the base and a part of the mass."""
        last: dict[str, int] = {}
        for part in self.masses_of(robot):
            at = len(robot.joint_names) - 1 if part.joint is None else part.joint
            last[part.name] = max(at, last.get(part.name, -1))
        return [(mass, j) for mass, end in last.items() for j in range(end + 1)]

    def _moments(self, poses: Poses) -> FloatArray:
        """(N, K) τ [m], or the force along a sliding joint, of a unit weight."""
        robot, posture = poses.robot, poses.posture
        down = robot.base_pose[0] @ self.down
        turns, joints = robot.joint_is_revolute, len(robot.joint_names)
        total: dict[str, FloatArray] = {}
        for part in self.masses_of(robot):
            arm = link_points(robot, poses.q, part.joint, part.xyz)[:, None, :] - posture.joint_origins
            turning = np.cross(posture.joint_axes, arm) @ down
            felt = np.where(turns, turning, posture.joint_axes @ down) * part.weight
            if part.joint is not None:
                felt[:, part.joint + 1 :] = 0.0
            if part.name == PAYLOAD and poses.load is not None:
                felt *= poses.load[:, None]
            total[part.name] = total.get(part.name, np.zeros((len(poses), joints))) + felt
        return np.stack([total[mass][:, j] for mass, j in self._pairs(robot)], axis=1)


def downwards(robot: Robot, up: ArrayLike) -> tuple[float, float, float]:
    """The mounting of a robot whose base pose is known, from the vertical ``up`` (3,) of the tracker's frame."""
    x, y, z = -robot.base_pose[0].T @ check_array("up", up, (3,))
    return float(x), float(y), float(z)


def link_points(robot: Robot, q: FloatArray, joint: int | None, xyz: ArrayLike) -> FloatArray:
    """(N, 3) where ``xyz`` (3,) of the link that joint number ``joint`` moves is; ``None``: of the tip [m]."""
    x, y, z = check_array("mass", xyz, (3,))
    part = _link(robot, joint, (float(x), float(y), float(z)))
    return part.positions(q[:, : len(part.joint_names)])[:, 0]


@lru_cache(maxsize=64)
def _link(robot: Robot, joint: int | None, xyz: tuple[float, float, float]) -> Robot:
    """The robot up to a link, its target being at ``xyz`` of that link; a simulation asks at every sample."""
    branch = target_elements(np.array([xyz]))
    if joint is None:
        return replace(robot, targets=branch, parameter_names=())
    end = next(i for i, e in enumerate(robot.elements) if e.joint == joint) + 1
    # A joint with an oblique axis is turned back behind its motion; its link is there.
    before, behind = robot.elements[end - 2], robot.elements[end : end + 2]
    if len(behind) == 2 and behind[0] == Element(before.kind, -before.value) and before.value:
        end += 2
    return Robot(
        name=robot.name,
        elements=robot.elements[:end],
        targets=branch,
        joint_names=robot.joint_names[: joint + 1],
        joint_limits=robot.joint_limits[: joint + 1],
    )
