# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of each joint's own transmission and encoder: a function of that joint's angle alone.

Gears, couplings and encoders turn joint l by φ_l(q_l) more than it says, the same each time. A point moves by
c_l(q) φ_l(q_l). Nothing is known of φ but how large and how smooth it is: it is a Gaussian process with the
kernel

    k(Δ) = σ² (exp((cos Δ − 1)/ℓ²) − I) / (1 − I) ,        I = e^{−κ} I_0(κ) ,   κ = 1/ℓ² ,

which is periodic, as a turning joint is, and close to a Gaussian of length ℓ for small ℓ. The constant part I is
taken out: it is the joint's zero, a parameter of the chain. By the Jacobi–Anger expansion
exp(κ cos Δ) = I_0(κ) + 2 Σ_n I_n(κ) cos nΔ it is exactly the Fourier series

    φ_l(q) = Σ_n a_n cos n x + b_n sin n x ,   var a_n = var b_n = σ² λ_n ,   λ_n = 2 e^{−κ} I_n(κ)/(1 − I),

with x = q where the joint turns and half a turn over its range where it slides. The sum ends at ``harmonics`` and
λ is scaled to the sum one. With I_n' = (I_{n−1} + I_{n+1})/2 its derivative by log ℓ is closed, too. Several
components, a short and a long ℓ, add their variances to the same coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from scipy.special import ive

from calib_planner.arrays import FloatArray, check_count
from calib_planner.error_model.poses import Poses
from calib_planner.errors import UnknownNameError
from calib_planner.robot import Robot

COMPONENTS = {"smooth": 12, "short": 64}
"""Component → harmonics that its lengths need."""


@dataclass(frozen=True)
class JointFunctions:
    """The errors of the joints' transmissions.

    Attributes:
        components: Names among ``COMPONENTS``, each once; their σ [rad] and ℓ [rad] are scales of the error
            model. harmonics: Where the Fourier series end; 0: as the components need it.
    """

    components: tuple[str, ...] = ("smooth", "short")
    harmonics: int = 0

    name: ClassVar[str] = "joint_functions"
    titles: ClassVar[dict[str, str]] = {
        "smooth": "gears and encoders: errors of a few waves a turn of a joint",
        "short": "gears and encoders: errors that change within some degrees of a joint",
    }

    def __post_init__(self) -> None:
        for component in self.components:
            if component not in COMPONENTS or self.components.count(component) > 1:
                raise UnknownNameError("joint_functions", component, tuple(COMPONENTS))
        if not self.components:
            raise UnknownNameError("joint_functions", "nothing", tuple(COMPONENTS))
        count = check_count("joint_functions.harmonics", self.harmonics, low=0, high=1000)
        count = count or max(COMPONENTS[c] for c in self.components)
        object.__setattr__(self, "harmonics", count)

    @property
    def scales(self) -> tuple[str, ...]:
        """Names of σ and ℓ of every component."""
        return tuple(f"{c}.{s}" for c in self.components for s in ("size", "length"))

    def names(self, robot: Robot) -> tuple[str, ...]:
        """K = joints · 2 · harmonics names ``<joint>.cos1 …, <joint>.sin1 …``."""
        return _names(robot.joint_names, self.harmonics)

    def size(self, robot: Robot) -> int:
        """K."""
        return 2 * self.harmonics * len(robot.joint_names)

    def columns(self, poses: Poses) -> FloatArray:
        """(N, 3·targets, K) c_l cos n x_l and c_l sin n x_l [m/rad]."""
        waves, levers = self.remembered_waves(poses), poses.levers
        return (levers[..., None] * waves[:, None]).reshape(*levers.shape[:2], -1)

    def deflection(self, poses: Poses, coefficients: FloatArray) -> FloatArray:
        """(N, joints) φ_l(q_l) for coefficients (K,), in units of ``joint_units``."""
        per_joint = coefficients.reshape(len(poses.robot.joint_names), -1)
        return np.asarray(np.einsum("njk,jk->nj", self.remembered_waves(poses), per_joint))

    def waves(self, poses: Poses) -> FloatArray:
        """(N, joints, 2·harmonics) cos n x, then sin n x, n = 1 …"""
        low, high = poses.robot.joint_limits.T
        turns = poses.robot.joint_is_revolute
        x = np.where(turns, poses.q, np.pi * (poses.q - low) / (high - low))
        turned = np.exp(1j * x)[..., None] ** np.arange(1, self.harmonics + 1)
        return np.concatenate([turned.real, turned.imag], axis=2)

    def remembered_waves(self, poses: Poses) -> FloatArray:
        """The same, remembered with the poses; not to be written to."""
        key = ("waves", self.harmonics)
        if key not in poses.cache:
            poses.cache[key] = self.waves(poses)
        return poses.cache[key]

    def variances(self, robot: Robot, values: dict[str, float]) -> FloatArray:
        """(K,) prior variance of each coefficient [rad²]."""
        shares = [
            values[f"{c}.size"] ** 2 * spectrum(values[f"{c}.length"], self.harmonics)[0] for c in self.components
        ]
        return self._spread(robot, np.sum(shares, axis=0))

    def shares(self, robot: Robot, values: dict[str, float]) -> dict[str, FloatArray]:
        """Component → (K,) its share of the variance, and so of the mean, of each coefficient."""
        total = self.variances(robot, values)
        alone = {c: JointFunctions((c,), self.harmonics).variances(robot, values) for c in self.components}
        return {c: np.divide(v, total, out=np.zeros(len(total)), where=total > 0.0) for c, v in alone.items()}

    def gradients(self, robot: Robot, values: dict[str, float]) -> dict[str, FloatArray]:
        """Scale → (K,) derivative of ``variances`` by its logarithm."""
        result = {}
        for c in self.components:
            share, gradient = spectrum(values[f"{c}.length"], self.harmonics)
            variance = values[f"{c}.size"] ** 2
            result[f"{c}.size"] = self._spread(robot, 2.0 * variance * share)
            result[f"{c}.length"] = self._spread(robot, variance * gradient)
        return result

    def _spread(self, robot: Robot, per_order: FloatArray) -> FloatArray:
        return np.concatenate([per_order] * (2 * len(robot.joint_names)))


@lru_cache(64)
def _names(joints: tuple[str, ...], harmonics: int) -> tuple[str, ...]:
    orders = range(1, harmonics + 1)
    return tuple(f"{joint}.{wave}{n}" for joint in joints for wave in ("cos", "sin") for n in orders)


@lru_cache(256)  # a fit wants the same lengths again and again, and Bessel functions take a tenth of its time
def spectrum(length: float, harmonics: int) -> tuple[FloatArray, FloatArray]:
    """(harmonics,) λ_n, of sum one, and dλ_n/d log ℓ, for the length ℓ [rad]; not to be written to."""
    kappa = 1.0 / length**2
    bessel = ive(np.arange(harmonics + 2), kappa)
    share = bessel[1:-1]
    by_kappa = 0.5 * (bessel[:-2] + bessel[2:]) - share  # of exp(−κ) I_n(κ)
    total = share.sum()
    gradient = (by_kappa - share * by_kappa.sum() / total) / total
    spectra = share / total, -2.0 * kappa * gradient
    for values in spectra:
        values.flags.writeable = False
    return spectra
