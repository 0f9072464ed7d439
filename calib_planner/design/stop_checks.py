"""What was checked at each configuration, what came out, and what was not checked.

Reachable: within the joint limits and allowed by every constraint that is not about the tracker. Visible:
allowed by every constraint that is (those with a ``station``); without any nothing is said about it. What the
tracker would see — range, elevation, incidence — is computed wherever one station is known, be it from a
constraint or from the instrument, and is no verdict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_planner._arrays import FloatArray, check_configurations, frozen
from calib_planner.design.constraints import (
    LineOfSight,
    ReflectorAcceptance,
    TrackerElevation,
    TrackerRange,
)
from calib_planner.design.constraints.self_collision import SelfCollision
from calib_planner.design.feasibility import Constraint
from calib_planner.instrument.noise import LaserTracker, Noise
from calib_planner.instrument.sight import distances, elevations, incidence_cosines
from calib_planner.robot.chain import Robot

VIEWS = (TrackerRange, TrackerElevation, ReflectorAcceptance, LineOfSight)
"""The constraints about the tracker."""
LIMITS = "joint limits"
ROUNDING = 1e-9
"""Beyond a joint limit by less than this is on it [rad | m]."""
NEVER = ("other objects in the cell", "the moves between the stops")
"""What nothing here can check."""


@dataclass(frozen=True, eq=False)
class Sight:
    """What the tracker sees; NaN where that needs more than is known.

    Attributes:
        station: (3,) in the frame of positions [m], or ``None`` if none is known, or several.
        ranges: (N, targets) [m].
        elevations: (N, targets) above the station's horizontal [rad].
        incidences: (N, targets) between the reflector's normal and the beam [rad].
    """

    station: FloatArray | None
    ranges: FloatArray
    elevations: FloatArray
    incidences: FloatArray


@dataclass(frozen=True, eq=False)
class StopChecks:
    """One verdict per configuration, N of them.

    Attributes:
        margins: (N, joints) distance to the nearer of the robot's joint limits, negative beyond [rad | m].
        reachable: (N,) bool.
        visible: (N,) bool, or ``None``: not checked.
        reach_breaks, view_breaks: Per configuration the names of what it breaks.
        checked: Names of what was checked.
        unchecked: Names of what was not.
        sight: What the tracker sees.
    """

    margins: FloatArray
    reachable: NDArray[np.bool_]
    visible: NDArray[np.bool_] | None
    reach_breaks: tuple[tuple[str, ...], ...]
    view_breaks: tuple[tuple[str, ...], ...]
    checked: tuple[str, ...]
    unchecked: tuple[str, ...]
    sight: Sight

    @property
    def breaks(self) -> list[tuple[str, ...]]:
        """All that each configuration breaks."""
        return [a + b for a, b in zip(self.reach_breaks, self.view_breaks, strict=True)]


def check_stops(
    robot: Robot, configurations: FloatArray, constraints: Sequence[Constraint] = (), noise: Noise | None = None
) -> StopChecks:
    """Check configurations (N, joints) [rad | m] against all that is known.

    Raises:
        InputError: Wrong shape, or a constraint that does not fit the robot.
    """
    q = check_configurations("configurations", configurations, robot.joint_names)
    low, high = robot.joint_limits.T
    margins = np.minimum(q - low, high - q)
    kept = {LIMITS: (margins >= -ROUNDING).all(axis=1)}
    seen: dict[str, NDArray[np.bool_]] = {}
    for constraint in constraints:
        masks = seen if isinstance(constraint, VIEWS) else kept
        allowed = constraint.allowed(robot, q)
        masks[constraint.name] = masks.get(constraint.name, True) & allowed
    return StopChecks(
        margins=frozen(margins),
        reachable=frozen(np.all(list(kept.values()), axis=0)),
        visible=frozen(np.all(list(seen.values()), axis=0)) if seen else None,
        reach_breaks=_breaks(kept, len(q)),
        view_breaks=_breaks(seen, len(q)),
        checked=(*kept, *seen),
        unchecked=_unchecked(constraints),
        sight=_sight(robot, q, constraints, noise),
    )


def _breaks(masks: dict[str, NDArray[np.bool_]], count: int) -> tuple[tuple[str, ...], ...]:
    """Per configuration the names of the masks (N,) that are false."""
    return tuple(tuple(name for name, mask in masks.items() if not mask[i]) for i in range(count))


def _unchecked(constraints: Sequence[Constraint]) -> tuple[str, ...]:
    kinds = (*VIEWS, SelfCollision)
    missing = [k.name for k in kinds if not any(isinstance(c, k) for c in constraints)]
    return (*missing, *NEVER)


def _sight(robot: Robot, q: FloatArray, constraints: Sequence[Constraint], noise: Noise | None) -> Sight:
    """From the one station that constraints and instrument agree on."""
    views = [c for c in constraints if isinstance(c, VIEWS)]
    stations = [np.asarray(c.station) for c in views]
    if isinstance(noise, LaserTracker):
        stations.append(np.asarray(noise.station))
    unknown = np.full((len(q), len(robot.targets)), np.nan)
    if not stations or any((s != stations[0]).any() for s in stations):
        return Sight(None, frozen(unknown), frozen(unknown), frozen(unknown))
    station, posture = stations[0], robot.posture(q)
    ups = [np.asarray(c.up) for c in (*views, noise) if isinstance(c, (TrackerElevation, LaserTracker))]
    normals = next((np.asarray(c.normal) for c in views if isinstance(c, ReflectorAcceptance)), None)
    heights = incidences = np.asarray(unknown)
    if ups and all(np.allclose(u, ups[0], rtol=0, atol=ROUNDING) for u in ups):
        heights = elevations(station, ups[0], posture.targets)
    if normals is not None:
        turned = normals @ posture.tip_rotation.transpose(0, 2, 1)
        cosines = incidence_cosines(station, posture.targets, turned)
        incidences = np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)))
    ranges = distances(station, posture.targets)
    return Sight(frozen(station), frozen(ranges), frozen(heights), frozen(incidences))
