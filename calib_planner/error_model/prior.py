# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What a user knows of the parameters before the data: a normal distribution, Π_k ~ N(m, C).

It comes from a file, or from an estimate before. A prior adds equations to the least squares (maximum a
posteriori): with C = L Lᵀ, rows L⁻¹ against L⁻¹ (m − Π). It determines parameters that the data hardly show, at
the cost of a little bias in the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from calib_planner.arrays import FloatArray, check_array
from calib_planner.errors import InputError, UnknownNameError


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

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Prior):
            return NotImplemented
        arrays = ((self.values, other.values), (self.covariance, other.covariance))
        same = (self.names, self.source) == (other.names, other.source)
        return same and all(np.array_equal(one, two) for one, two in arrays)

    def __hash__(self) -> int:
        return hash((self.names, self.source))

    @cached_property
    def root(self) -> FloatArray:
        """(K, K) L, lower, of C = L Lᵀ [m | rad]."""
        scale = self.std
        return np.asarray(
            scale[:, None] * np.linalg.cholesky(np.asarray(self.covariance) / np.outer(scale, scale))
        )

    @property
    def std(self) -> FloatArray:
        """(K,) standard deviations [m | rad]."""
        return np.sqrt(np.diag(np.asarray(self.covariance)))

    def places(self, names: Sequence[str]) -> list[int]:
        """Where the K names are among ``names``.

        Raises:
            UnknownNameError: One is not there.
        """
        for name in self.names:
            if name not in names:
                raise UnknownNameError("prior", name, list(names))
        return [list(names).index(name) for name in self.names]

    def rows(self, names: Sequence[str]) -> FloatArray:
        """(K, P) L⁻¹ with a column for each of the P parameters ``names``: the whitened equations of the prior.

        Raises:
            UnknownNameError: The prior speaks of a parameter that is not among ``names``.
        """
        at = self.places(names)
        rows = np.zeros((len(at), len(names)))
        rows[:, at] = solve_triangular(self.root, np.eye(len(at)), lower=True)
        return rows
