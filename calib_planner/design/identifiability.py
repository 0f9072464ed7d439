"""Which parameters the data can tell apart, and in whose favour ties are broken.

The columns of the stacked, weighted Jacobian are scaled to unit length and taken in order of priority. A
column that lies (to the tolerance) in the span of those already taken is not identifiable beside them: it is
held at its nominal value, and the combination that the data cannot see is named. Priority: base pose and
target offsets first — without them no residual means anything — then the order of the request.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib_planner._arrays import FloatArray

TOLERANCE = 1e-6
"""A unit column this close to the span of its predecessors is taken as dependent."""
NO_LEVER = 1e-12
"""A parameter that moves the targets by less than this per unit does not move them at all [m]."""


@dataclass(frozen=True)
class Identifiability:
    """What can be identified.

    Attributes:
        kept: Indices of the parameters to solve for, in priority order.
        combinations: For each parameter held, the combination of parameters whose change no measurement
            shows, e.g. ``"1·joint_1.offset - 1·base.rz"`` (coefficients in parameter units).
        held: Index of the parameter held for each combination.
    """

    kept: tuple[int, ...]
    combinations: tuple[str, ...]
    held: tuple[int, ...]

    @property
    def rank(self) -> int:
        return len(self.kept)


def analyse(jacobian: FloatArray, names: Sequence[str], tolerance: float = TOLERANCE) -> Identifiability:
    """Choose an irreducible set of parameters.

    Args:
        jacobian: (equations, P), weights of the equations around one [m/m | m/rad].
        names: P parameter names.
        tolerance: See ``TOLERANCE``.
    """
    norms = np.linalg.norm(jacobian, axis=0)
    scale = np.where(norms > NO_LEVER * np.sqrt(len(jacobian)), norms, 0.0)
    unit = np.divide(jacobian, scale, out=np.zeros_like(jacobian), where=scale > 0)
    first = [i for i, n in enumerate(names) if n.startswith(("base.", "target_"))]
    order = first + [i for i in range(len(names)) if i not in first]
    basis = np.empty((min(jacobian.shape), jacobian.shape[0]))
    kept: list[int] = []
    held: list[int] = []
    combinations: list[str] = []
    for i in order:
        rest = unit[:, i].copy()
        for _ in range(2):  # twice is enough (Kahan): orthogonal to rounding
            rest -= basis[: len(kept)].T @ (basis[: len(kept)] @ rest)
        size = float(np.linalg.norm(rest))
        if size > tolerance and len(kept) < len(basis):
            basis[len(kept)] = rest / size
            kept.append(i)
        else:
            held.append(i)
            combinations.append(_describe(unit, scale, names, kept, i))
    return Identifiability(tuple(kept), tuple(combinations), tuple(held))


def _describe(unit: FloatArray, scale: FloatArray, names: Sequence[str], kept: list[int], i: int) -> str:
    """The null combination: parameter i against those that imitate it."""
    if scale[i] == 0.0:
        return names[i]
    share = np.linalg.lstsq(unit[:, kept], unit[:, i], rcond=None)[0] if kept else np.zeros(0)
    terms = [(names[i], 1.0)]
    terms += [
        (names[k], -value * scale[i] / scale[k])
        for k, value in zip(kept, share, strict=True)
        if abs(value) > 1e-4
    ]
    text = " ".join(f"{'+' if c >= 0 else '-'} {abs(c):.3g}·{n}" for n, c in terms)
    return text.removeprefix("+ ")
