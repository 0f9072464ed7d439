"""Planning for real robots: the error that no geometric model holds, as part of the problem.

What a full geometric fit leaves on a real robot is far above the instrument's noise. On the measured UR10
it is, to a log likelihood ratio of 1 800 over 1 500 coordinates, an error of each joint's transmission: a
function of that joint's angle alone, of a few tenths of a milliradian, with a correlation length of some degrees.
With c_l(q) = ∂p/∂q_l, independent f_l of unit variance and correlation ρ, and a white part,

    e(q) = Σ_l σ_l c_l(q) f_l(q_l) + white,     ρ(q_l, q'_l) = exp(−(2 sin((q_l − q'_l)/2))² / 2ℓ²),          (1)
    Σ(q) = Σ_l σ_l² c_l c_lᵀ + s² I + instrument.                                                         (2)

Two things follow for a plan: a configuration tells less the longer the joints' levers are — just the stretched
ones that plain optimal plans run to — and two configurations that share a joint angle share its error.

The estimator is the ordinary one, regularised: Gaussian priors P on the parameters and weights W = Σ(q)⁻¹ per
configuration, ignoring correlation between configurations (it cannot be trusted that far): with X = W^½ J,

    Π̂ = B Xᵀ W^½ y,     B = (P⁻¹ + XᵀX)⁻¹.

For y = JΠ + e, Π ~ N(0, P), the expected squared prediction error at a test pose * is closed:

    E‖J*(Π̂ − Π) − e*‖² = tr J* B (P⁻¹ + S) B J*ᵀ − 2 tr(B Xᵀ W^½ K_{X*} J*) + tr Σ*,                     (3)

S = XᵀW^½ K W^½X with the true covariance K of the chosen rows: I in the diagonal blocks (whitened), (1) between.
With a_il = X_iᵀ W_i^½ c_l(q_i) σ_l all of it is sums of outer products of p-vectors:

    S = XᵀX + Σ_{i≠j} Σ_l ρ_l(i, j) a_il a_jlᵀ,   X_iᵀ W_i^½ K_{i*} J* = Σ_l ρ_l(i, *) a_il (J*ᵀ c*_l σ_l)ᵀ.   (4)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_planner.arrays import FloatArray, check_number
from calib_planner.robot import Robot, is_nuisance
from calib_planner.tracker import Noise

FLAT_PRIOR = 1.0
"""Prior standard deviation of base and target parameters [m | rad]: next to nothing is known of them."""


@dataclass(frozen=True)
class ModelDiscrepancy:
    """How far the real robot is expected from any geometric model.

    Attributes:
        joint_sigma: Transmission error of one turning joint, standard deviation [rad].
        joint_length: Its correlation length ℓ in joint angle [rad].
        slide_sigma: The same for sliding joints [m].
        slide_length: The same for sliding joints [m].
        point_sigma: s, white part of one coordinate [m].
        length_std: Prior standard deviation of every length parameter [m].
        angle_std: Prior standard deviation of every angle parameter [rad].
    """

    joint_sigma: float = 3.5e-4
    joint_length: float = 0.07
    slide_sigma: float = 5e-5
    slide_length: float = 0.02
    point_sigma: float = 1.2e-4
    length_std: float = 5e-4
    angle_std: float = 1e-3

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            may_be_zero = name in ("joint_sigma", "slide_sigma", "point_sigma")
            value = check_number(
                f"discrepancy.{name}", getattr(self, name), low=0, low_open=not may_be_zero, high=10
            )
            object.__setattr__(self, name, value)

    def joint_columns(self, robot: Robot, q: FloatArray) -> FloatArray:
        """σ_l c_l(q): (N, 3·targets, joints) [m]."""
        sigma = np.where(robot.joint_is_revolute, self.joint_sigma, self.slide_sigma)
        return np.ascontiguousarray(robot.joint_jacobian(q)) * sigma

    def covariance(self, robot: Robot, q: FloatArray, noise: Noise, repetitions: int = 1) -> FloatArray:
        """Σ(q) of eq. (2), (N, 3·targets, 3·targets) [m²]; its inverse is the estimator's weight."""
        columns = self.joint_columns(robot, q)
        result = columns @ np.swapaxes(columns, 1, 2)
        instrument = noise.covariance(robot.positions(q)) / repetitions
        for t in range(len(robot.targets)):
            part = slice(3 * t, 3 * t + 3)
            result[:, part, part] += instrument[:, t] + self.point_sigma**2 * np.eye(3)
        return result

    def correlation(self, robot: Robot, q: FloatArray, other: FloatArray) -> FloatArray:
        """ρ_l of every pair: (N, joints), (M, joints) → (joints, N, M)."""
        turns = robot.joint_is_revolute[:, None, None]
        difference = q.T[:, :, None] - other.T[:, None, :]
        apart = np.where(turns, 2.0 * np.sin(difference / 2.0), difference)
        length = np.where(turns, self.joint_length, self.slide_length)
        return np.exp(-((apart / length) ** 2) / 2.0)

    def prior_std(self, robot: Robot) -> FloatArray:
        """(P,) prior standard deviation of each active parameter [m | rad]."""
        std = [self.length_std if p.unit == "m" else self.angle_std for p in robot.parameters]
        return np.where([is_nuisance(n) for n in robot.parameter_names], FLAT_PRIOR, std)
