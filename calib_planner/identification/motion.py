"""Where a robot puts the measured points and how each parameter moves them, computed once for each place.

A fit, its covariance, its residuals and the questions asked of them are about few places in parameter space. To
compute positions and Jacobian at one costs more than anything that is done with them there, so the last ones are
remembered, and that of the nominal values, where every identification begins and comes back to.
"""

from __future__ import annotations

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.robot.chain import Robot

MOST_PLACES = 2
"""Places that are remembered beside the nominal one."""


class Motion:
    """Positions and Jacobian of ``robot`` at configurations ``q`` (N, joints) [rad | m]."""

    def __init__(self, robot: Robot, q: FloatArray) -> None:
        self.robot, self.q = robot, q
        self._nominal = bytes(8 * len(robot.parameter_names))
        self._known: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def at(self, deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N, targets, 3) positions [m] and (N, targets, 3, P) Jacobian [m/m | m/rad]; read-only.

        Args:
            deviations: (P,) of the active parameters [m | rad].
        """
        key = _key(deviations)
        found = self._known.pop(key, None)
        if found is None:
            points, jacobian = self.robot.positions_and_jacobian(self.q, deviations)
            found = np.ascontiguousarray(points), np.ascontiguousarray(jacobian).reshape(*points.shape, -1)
        return self._remember(key, *found)

    def carry(self, before: FloatArray, after: FloatArray) -> None:
        """A step so small that the points move linearly and the Jacobian stays what it is; both (P,)."""
        points, jacobian = self.at(before)
        self._remember(_key(after), points + jacobian @ (after - before), jacobian)

    def _remember(self, key: bytes, *found: FloatArray) -> tuple[FloatArray, FloatArray]:
        points, jacobian = found
        for array in (points, jacobian):
            array.setflags(write=False)
        self._known[key] = points, jacobian
        others = [k for k in self._known if k != self._nominal]
        for old in others[:-MOST_PLACES]:
            del self._known[old]
        return points, jacobian


def _key(deviations: FloatArray) -> bytes:
    """Adding zero makes −0 the nominal 0."""
    return (deviations + 0.0).tobytes()
