"""What is known of the parameters before the data: a Gaussian, Π_k ~ N(m, C).

A prior adds equations to the least squares (maximum a posteriori): with C = L Lᵀ, rows L⁻¹ against L⁻¹ (m − Π).
It steadies parameters that the data hardly see, and costs a little bias in those they do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from calib_planner._arrays import FloatArray, check_array
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.robot.chain import Robot

LENGTH_STD = 5e-4
"""How far lengths of an assembled industrial robot typically are from the data sheet [m]."""
ANGLE_STD = 1e-3
"""The same for angles between axes [rad]."""
OFFSET_STD = 0.02
"""The same for the zeros of joints, which are set by hand, in any unit [rad | m]."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Expected values and their covariance.

    Attributes:
        names: K parameter names, each once.
        values: (K,) expected values, not deviations [m | rad].
        covariance: (K, K), or (K,) standard deviations of independent parameters [m | rad].
        source: Where it comes from, in words.
    """

    names: tuple[str, ...]
    values: ArrayLike
    covariance: ArrayLike
    source: str = "given"

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "names", tuple(self.names))
        count = len(self.names)
        if not count or len(set(self.names)) < count:
            raise InputError("prior.names", ", ".join(self.names) or "nothing", "parameter names, each once")
        put(self, "values", check_array("prior.values", self.values, (count,)))
        covariance = np.asarray(self.covariance, float)
        if covariance.ndim == 1:
            std = check_array("prior.std", covariance, (count,))
            if (std <= 0).any():
                name = self.names[int(np.argmin(std))]
                raise InputError(f"prior.std of {name}", std.min(), "a standard deviation > 0 [m | rad]")
            covariance = np.diag(std**2)
        covariance = check_array("prior.covariance", covariance, (count, count))
        scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        unit = covariance / np.where(np.outer(scale, scale) > 0, np.outer(scale, scale), 1.0)
        if (scale == 0).any() or not np.allclose(unit, unit.T, atol=1e-9) or np.linalg.eigvalsh(unit)[0] <= 1e-14:
            raise InputError("prior.covariance", "not positive definite", "a symmetric positive definite matrix")
        put(self, "covariance", covariance)

    def rows(self, names: Sequence[str], values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The prior as equations for parameters ``names`` (P) now at ``values`` (P,).

        Returns:
            (K, P) whitened rows and (K,) right-hand sides: rows · ΔΠ = right.

        Raises:
            UnknownNameError: The prior speaks of a parameter that is not among ``names``.
        """
        for name in self.names:
            if name not in names:
                raise UnknownNameError("prior", name, list(names))
        at = [list(names).index(n) for n in self.names]
        scale = np.sqrt(np.diag(np.asarray(self.covariance)))
        lower = np.linalg.cholesky(np.asarray(self.covariance) / np.outer(scale, scale))
        inverse = solve_triangular(lower, np.diag(1.0 / scale), lower=True)
        rows = np.zeros((len(at), len(names)))
        rows[:, at] = inverse
        return rows, inverse @ (np.asarray(self.values) - values[at])


def typical_prior(robot: Robot, length_std: float = LENGTH_STD, angle_std: float = ANGLE_STD) -> Prior | None:
    """Nominal values with typical manufacturing errors for all active parameters but base and targets.

    Joint zeros get ``OFFSET_STD``, next to nothing. ``None`` if there is no parameter left.
    """
    zeros = _joint_zeros(robot)
    known = [p for p in robot.parameters if not p.name.startswith(("base.", "target_"))]
    if not known:
        return None
    usual = {"m": length_std, "rad": angle_std}
    std = np.array([OFFSET_STD if p.name in zeros else usual[p.unit] for p in known])
    text = f"typical: {1e3 * length_std:g} mm, {1e3 * angle_std:g} mrad"
    return Prior(tuple(p.name for p in known), np.array([p.nominal for p in known]), std, text)


def _joint_zeros(robot: Robot) -> set[str]:
    """Names of the active parameters that act as a joint does, wherever the robot stands."""
    low, high = robot.joint_limits.T
    sample = np.random.default_rng(0).uniform(low, high, (8, len(low)))
    # Reflectors off every axis: an unknown one starts at the tip, where the last joint moves nothing.
    robot = robot.with_targets(robot.target_offsets + np.array([0.13, 0.17, 0.19]))
    columns, joints = robot.jacobian(sample), robot.joint_jacobian(sample)
    size = np.abs(joints).max()
    return {
        name
        for k, name in enumerate(robot.parameter_names)
        if any(
            min(np.abs(columns[..., k] - s * joints[..., j]).max() for s in (1, -1)) < 1e-9 * size
            for j in range(joints.shape[2])
        )
    }
