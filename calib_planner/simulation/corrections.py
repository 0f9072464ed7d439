"""Joint functions of the simulated robot, as short Fourier series."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_array, check_configurations
from calib_planner.errors import InputError
from calib_planner.robot import Robot


@dataclass(frozen=True, eq=False)
class JointCorrections:
    """φ of every joint.

    Attributes:
        joint_names: Order of joint arrays.
        scale: (joints,) x = scale · (q − shift).
        shift: (joints,) [rad | m].
        cosines: (joints, harmonics) a, the first harmonic first [rad | m].
        sines: (joints, harmonics) b [rad | m].
    """

    joint_names: tuple[str, ...]
    scale: ArrayLike
    shift: ArrayLike
    cosines: ArrayLike
    sines: ArrayLike

    def __post_init__(self) -> None:
        put, joints = object.__setattr__, len(self.joint_names)
        put(self, "joint_names", tuple(self.joint_names))
        for name in ("scale", "shift"):
            put(self, name, check_array(name, getattr(self, name), (joints,)))
        for name in ("cosines", "sines"):
            put(self, name, check_array(name, getattr(self, name), (joints, None)))
        if np.shape(self.cosines) != np.shape(self.sines):
            raise InputError("sines", np.shape(self.sines), f"as many as cosines, {np.shape(self.cosines)}")

    def at(self, q: ArrayLike) -> FloatArray:
        """φ(q): (N, joints) readings → (N, joints) [rad | m]."""
        clean = check_configurations("configurations", q, self.joint_names)
        x = (clean - np.asarray(self.shift)) * np.asarray(self.scale)
        cosine, sine = harmonics(x, np.shape(self.cosines)[1])
        cosines, sines = np.asarray(self.cosines), np.asarray(self.sines)
        return np.einsum("njh,jh->nj", cosine, cosines) + np.einsum("njh,jh->nj", sine, sines)

    def actual(self, q: ArrayLike) -> FloatArray:
        """Where the joints are when they read ``q``: (N, joints)."""
        return check_configurations("configurations", q, self.joint_names) + self.at(q)

    def reading(self, actual: ArrayLike) -> FloatArray:
        """What the joints read when they are at ``actual``: (N, joints), the inverse of ``actual``."""
        wanted = check_configurations("configurations", actual, self.joint_names)
        q = np.array(wanted)
        for _ in range(50):  # φ is a few milliradians and flat: each round gains two digits or more
            error = wanted - q - self.at(q)
            q = q + error
            if np.abs(error).max(initial=0.0) < 1e-15:
                break
        return q


def phases(robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Scale and shift (joints,) of x: turning joints as they are, sliding ones over half a turn."""
    low, high = robot.joint_limits.T
    turns = robot.joint_is_revolute
    return np.where(turns, 1.0, np.pi / (high - low)), np.where(turns, 0.0, low)


def harmonics(x: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """cos n x and sin n x, n = 1 … count: (N, joints) → two of (N, joints, count)."""
    turned = np.exp(1j * x)[..., None] ** np.arange(1, count + 1)
    return turned.real, turned.imag
