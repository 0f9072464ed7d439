"""Do the tracker's distances err, and nothing else? Then its beam was broken, and caught again at a wrong one.

A laser tracker counts distance along its beam. Caught again after a break, it is off by the same amount until the
next break; its angles stay right. The residuals show scatter that noise does not explain, just as of a robot that
no geometry describes — but only along the line of sight p/‖p‖, p in the tracker's frame.

With the distance of every point free, a point has two equations instead of three: those across. Of residuals
whitened by measurement noise let a fit to these leave L, with ν₂ degrees of freedom, and a fit to all L + S, with
ν more. Distances err if

    F = (S/ν)/(L/ν₂) ~ F(ν, ν₂)

is improbable, and they suffice if L is a probable χ². A robot's own errors do not keep to the line of sight. That
is the one to the prediction: without distances nobody knows the size of a robot in an unknown place, and across
its own direction a prediction of any size is nothing.

A wrong distance lasts, from one break to the next. What one of that size does to the parameters if it lasted from
any point to the last says what harm to expect.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import f as fisher_f

from calib_planner._arrays import FloatArray, frozen
from calib_planner.identification.equations import Equations
from calib_planner.identification.order_check import FEWEST_SPARE, Disturbance

NOTHING = 1e-9
"""A combination of unit columns shorter than this is not seen."""


def check_distances(
    equations: Equations, deviations: FloatArray, kept: tuple[int, ...], covariance: FloatArray
) -> Disturbance | None:
    """Ask.

    Args:
        equations: Of the finished fit, each point whitened on its own by measurement noise.
        deviations: (P,) where the fit ended.
        kept: Parameters that were solved for.
        covariance: (P, P) cov(Π̂), for ``shift``.

    Returns:
        The answer; ``None`` where too little is redundant to tell.
    """
    if not kept:
        return None
    residuals, jacobian = equations.linearise(deviations)
    rows = jacobian[:, list(kept)]
    points = equations.robot.positions(equations.data.q, deviations)[equations.use]
    count, spare = len(points), len(rows) - len(kept)
    sight = points / np.linalg.norm(points, axis=1)[:, None]
    white = equations.whitening.apply(sight.ravel()).reshape(count, 3)
    length = np.linalg.norm(white, axis=1)
    along = white / length[:, None]
    system = np.column_stack([rows, residuals])
    own = system[: 3 * count].reshape(count, 3, -1)
    beam = np.einsum("ki,kij->kj", along, own)
    rest = np.vstack([(_across(along) @ own).reshape(2 * count, -1), system[3 * count :]])
    (best, total, _), (_, left, rank) = _solved(system), _solved(rest)
    freedom = len(rest) - rank
    freed = spare - freedom
    if freedom < FEWEST_SPARE or freed < 1:
        return None
    off = beam[:, -1] - beam[:, :-1] @ best
    size = max(float(np.mean((off**2 * (len(rows) / spare) - 1.0) / length**2)), 0.0)
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    basis, triangle = np.linalg.qr(rows / scale)
    pull = np.einsum("kip,ki->kp", basis[: 3 * count].reshape(count, 3, -1), np.sqrt(size) * white)
    lasting = np.cumsum(pull[::-1], axis=0)
    moved = np.abs(np.linalg.lstsq(triangle, lasting.T, rcond=NOTHING)[0]).max(axis=1) / scale
    moved /= np.sqrt(np.maximum(np.diag(covariance)[list(kept)], 1e-300))
    worst = int(np.argmax(moved))
    ratio = max(total - left, 0.0) / freed / max(left / freedom, 1e-300)
    return Disturbance(
        kind="distance",
        row=None,
        target=None,
        probability=float(fisher_f.sf(ratio, freed, freedom)),
        translation=frozen(np.array([np.sqrt(size), 0.0, 0.0])),
        rotation=frozen(np.zeros(3)),
        shift=float(moved[worst]),
        parameter=equations.robot.parameter_names[kept[worst]],
        left=left,
        freedom=freedom,
    )


def _solved(system: FloatArray) -> tuple[FloatArray, float, int]:
    """Least squares of rows (m, p + 1), right-hand side last: solution (p,), sum of squares left, rank."""
    rows, right = system[:, :-1], system[:, -1]
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    solution, _, rank, _ = np.linalg.lstsq(rows / scale, right, rcond=NOTHING)
    return solution / scale, float(np.sum((right - rows @ (solution / scale)) ** 2)), int(rank)


def _across(along: FloatArray) -> FloatArray:
    """(n, 2, 3) two unit vectors that are square to each other and to ``along`` (n, 3)."""
    other = np.eye(3)[np.argmin(np.abs(along), axis=1)]
    first = np.cross(along, other)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(along, first)], axis=1)
