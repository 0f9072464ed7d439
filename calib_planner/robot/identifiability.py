# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Which parameters the data can tell apart, and in whose favour ties are broken.

The columns of the stacked, weighted Jacobian are scaled to unit length and taken in order of priority. A
column that lies (to the tolerance) in the span of those already taken is not identifiable beside them: it is
fixed at its nominal value, and the combination that the data cannot see is named. Priority: base pose and
target offsets first — without them no residual means anything — then the order of the request.

Only the triangle R of the scaled columns (QR) is worked on: it has the same lengths, angles and combinations as
the equations, and one row per parameter.

What noise leaves of a parameter beside its predecessors is a standard deviation σ/‖column ⟂ predecessors‖. One
that could be half a metre or a radian for all the data say is as unseen as one without any column.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.robot.parameters import is_nuisance

TOLERANCE = 1e-6
"""A unit column this close to the span of its predecessors is taken as dependent."""
SMALL = 1e-4
"""Shares of a unit column below this are not named in a combination."""
ROUNDING = 1e-9
"""Shares below this are none."""
NO_LEVER = 1e-12
"""A parameter that moves the targets by less than this per unit does not move them at all [m]."""


@dataclass(frozen=True)
class Identifiability:
    """What can be identified.

    Attributes:
        free: Indices of the parameters to solve for, in priority order.
        combinations: For each parameter fixed, the combination of parameters whose change no measurement
            shows, e.g. ``"1·joint_1.offset - 1·base.rz"`` (coefficients in parameter units).
        fixed: Index of the parameter fixed for each combination.
        directions: (fixed, P) the same combinations as changes of the parameters, 1 for the one fixed.
        lengths: For each free parameter, how far it moves the points beside its predecessors, per unit
            (length of the stacked column's part).
    """

    free: tuple[int, ...]
    combinations: tuple[str, ...]
    fixed: tuple[int, ...]
    directions: FloatArray
    lengths: tuple[float, ...]

    @property
    def rank(self) -> int:
        return len(self.free)


def analyse(
    jacobian: FloatArray, names: Sequence[str], tolerance: float = TOLERANCE, shortest: FloatArray | None = None
) -> Identifiability:
    """Choose an irreducible set of parameters.

    Args:
        jacobian: (equations, P), weights of the equations around one [m/m | m/rad].
        names: P parameter names.
        tolerance: See ``TOLERANCE``.
        shortest: (P,) least length of what a column adds to its predecessors; default none.
    """
    norms = np.linalg.norm(jacobian, axis=0)
    scale = np.where(norms > NO_LEVER * np.sqrt(len(jacobian)), norms, 0.0)
    unit = np.divide(jacobian, scale, out=np.zeros(jacobian.shape), where=scale > 0)
    if len(unit) > unit.shape[1]:
        unit = np.linalg.qr(unit, mode="r")
    first = [i for i, n in enumerate(names) if is_nuisance(n)]
    order = first + [i for i in range(len(names)) if i not in first]
    columns = np.ascontiguousarray(unit.T)
    basis = np.empty((min(unit.shape), len(unit)))
    triangle = np.zeros((len(basis), len(basis)))  # of the free columns: their coordinates in the basis
    free: list[int] = []
    fixed: list[int] = []
    shares: list[FloatArray] = []
    lengths: list[float] = []
    least = np.zeros(len(names)) if shortest is None else shortest
    for i in order:
        known = basis[: len(free)]
        share = known @ columns[i]
        rest = columns[i] - share @ known
        again = known @ rest  # twice is enough (Kahan): orthogonal to rounding
        share += again
        rest -= again @ known
        size = float(np.sqrt(rest @ rest))
        if size > tolerance and size * scale[i] > least[i] and len(free) < len(basis):
            triangle[: len(free), len(free)] = share
            triangle[len(free), len(free)] = size
            basis[len(free)] = rest / size
            free.append(i)
            lengths.append(size * float(scale[i]))
        else:
            fixed.append(i)
            shares.append(share)
    directions = _directions(triangle[: len(free), : len(free)], shares, scale, free, fixed)
    combinations = tuple(
        describe(np.where(np.abs(d) * scale > SMALL * scale[i], d, 0.0), names, first=i)
        for d, i in zip(directions, fixed, strict=True)
    )
    return Identifiability(tuple(free), combinations, tuple(fixed), directions, tuple(lengths))


def _directions(
    triangle: FloatArray, shares: list[FloatArray], scale: FloatArray, free: list[int], fixed: list[int]
) -> FloatArray:
    """(fixed, P) changes of the parameters that no point shows: the fixed one by one, and what undoes it.

    ``triangle`` (free, free) and ``shares``, each (the free ones before it,), are the free and the fixed columns
    in the orthonormal basis.
    """
    from scipy.linalg import solve_triangular  # 0.1 s, which only who analyses parameters waits for

    directions = np.zeros((len(fixed), len(scale)))
    directions[np.arange(len(fixed)), fixed] = 1.0
    if free and fixed:
        columns = np.zeros((len(free), len(fixed)))
        for column, share in zip(columns.T, shares, strict=True):
            column[: len(share)] = share
        weights = solve_triangular(triangle, columns, check_finite=False)
        weights[np.abs(weights) <= ROUNDING] = 0.0
        directions[:, free] = -weights.T * scale[fixed][:, None] / scale[free]
    return directions


def describe(direction: FloatArray, names: Sequence[str], first: int) -> str:
    """A combination in words: ``first``, then the others in their order."""
    order = [first] + [k for k in np.flatnonzero(direction) if k != first]
    text = " ".join(f"{'+' if direction[k] >= 0 else '-'} {abs(direction[k]):.3g}·{names[k]}" for k in order)
    return names[first] if len(order) == 1 else text.removeprefix("+ ")
